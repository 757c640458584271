"""Compute frames with Numba kernels that are tested for equality with ``simulation.reference``."""
