"""Compute frames with Numba kernels that are tested for equality with ``simulation.reference``.

`render` is the entry. Modules in the order of the data: `philox` (random words), `clean` (codes to the clean frame),
`normal` and `poisson` (draws), `site_patterns`, `gaussian` and `electrons` (noise), `readout` (rounding,
clipping, counts). `simd`, `rounding` and `strips` hold what they share.
"""
