"""Compute each step of the simulation in NumPy, as the article states it; the results define those of the kernels."""
