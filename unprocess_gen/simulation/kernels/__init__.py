"""Compute frames with Numba kernels that are tested for equality with ``simulation.reference``.

Modules in the order of the data: `philox` (random words), `clean` (codes to the clean frame), `normal` and `poisson`
(draws), `gaussian`, `gaussian_float32` and `physical` (noise models, entry points), `readout` (rounding, clipping,
counts). `simd`, `rounding` and `segments` hold what they share; `float_draws` serves frames in float32.
"""
