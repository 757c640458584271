"""Simulate clean and noisy raw frames from pixels and a plan; ``pair`` is the module to read first."""
