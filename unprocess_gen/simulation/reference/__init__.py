"""Compute each step of the simulation in NumPy, as the article states it; this defines the results of the kernels."""
