"""Sample noise that is one normal deviate per site, with a variance linear in the signal.

`Gaussian` decides every DN as `reference.electrons.noisy` does. Noise is computed in float32, eight sites at a
time, with an error bound; the read-out asks for the exact value of sites whose bound reaches a rounding boundary, about
1 % at a standard deviation of 100 DN. `Gaussian32`, of the tier ``fast``, has polynomials in place of
look-ups and asks for none; its DN count from the black level.

Design: ``docs/design/kernels.md``.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import purpose
from unprocess_gen.simulation.effects.heteroscedastic import STREAM
from unprocess_gen.simulation.kernels import normal, simd
from unprocess_gen.simulation.kernels.jit import inner
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_word_blocks
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, Pointer
from unprocess_gen.simulation.kernels.strips import SIZE, Buffers, Float32, Strip

NORMAL_PURPOSE = np.uint64(purpose(STREAM))

ROUNDING_ERROR, RESIDUAL_ERROR_DN = 2.0**-16, 2.0**-22
"""Bounds of the error of float32 noise: this fraction of the standard deviation, plus this many DN."""
CANCELLATION_FRACTION = 2.0**-4
"""If a or b is negative, sites with a variance below this fraction of abs(b) are recomputed in float64."""

_8, _ONE_BITS = np.uint64(8), np.uint32(0x3F800000)


class Gaussian(NamedTuple):
    """Variance lines of N frames."""

    line: Float  # [N, 2]: a and b
    black_dn: float
    lines: NDArray[np.uint64]  # approximate and exact normals (`normal.Quantiles`)
    quadratics: Float
    error: float  # of an approximate normal, in float32


class Gaussian32(NamedTuple):
    """Variance lines of N frames in float32."""

    line: Float32  # [N, 2]
    black_dn: NDArray[np.float32]  # [SIZE] equal values


VarianceLines = tuple[tuple[float, float], ...]
"""a and b of each frame."""


def variance_lines(lines: VarianceLines, dtype: Any = np.float64) -> NDArray[Any]:
    """Return the variance lines of frames, [N, 2]."""
    with np.errstate(over="ignore"):  # a variance beyond float32 becomes infinite, and the site is clipped
        return np.array(lines).astype(dtype, copy=False)


@functools.lru_cache(maxsize=256)
def gaussian_noise(lines: VarianceLines, black_dn: float, in_float32: bool) -> Gaussian | Gaussian32:
    """Return the noise of frames, which live pairs with the same numbers share."""
    if in_float32:
        return Gaussian32(variance_lines(lines, np.float32), np.full(SIZE, black_dn, dtype=np.float32))
    approximate, error, _, quadratics = normal.normal_quantiles()
    return Gaussian(variance_lines(lines), black_dn, approximate, quadratics, float(error) + ROUNDING_ERROR)


@inner
def draw_gaussian(noise: Gaussian | Gaussian32, n: int, key: PhiloxKey, strip: Strip, buffers: Buffers) -> None:
    """Fill ``words``."""
    fill_word_blocks(key, strip, NORMAL_PURPOSE, buffers.words)


@inner
def approximate_gaussian(noise: Gaussian, n: int, strip: Strip, buffers: Buffers) -> Pointer:
    """Fill ``noise_dn`` with the noise on the rounded clean frame, in float32, and ``error_dn`` with its bounds."""
    normal.fill_values_by_lines(strip.total, buffers.words, noise.lines, buffers.lines, buffers.normals)
    a, b = np.float32(noise.line[2 * n]), np.float32(noise.line[2 * n + 1])
    cancellation = np.float32(abs(b) * CANCELLATION_FRACTION if simd.minimum(a, b) < 0.0 else 0.0)
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        residual = simd.load(buffers.residual_dn, x)
        signal_dn = (simd.load(buffers.rounded_dn, x) - noise.black_dn) + residual
        variance = simd.maximum(signal_dn, 0.0) * a + b
        std = simd.square_root(simd.maximum(variance, 0.0))
        simd.store(buffers.noise_dn, x, residual + std * simd.load(buffers.normals, x))
        cancelled = simd.less_than(simd.absolute(variance), cancellation) & _ONE_BITS
        error_dn = simd.maximum(std * noise.error + RESIDUAL_ERROR_DN, simd.from_bits(cancelled))
        simd.store(buffers.error_dn, x, error_dn)
    return buffers.rounded_dn


@inner
def exact_gaussian_site(noise: Gaussian, n: int, x: int, strip: Strip, buffers: Buffers) -> float:
    """Return the noisy DN of one site, in the reference's order of operations."""
    a, b, clean_dn = noise.line[2 * n], noise.line[2 * n + 1], buffers.unrounded_dn[x]
    std = np.sqrt(simd.maximum(a * simd.maximum(clean_dn - noise.black_dn, 0.0) + b, 0.0))
    return float(clean_dn + std * normal.exact_value(buffers.words[x], noise.quadratics))


@inner
def exact_gaussian(noise: Gaussian, n: int, strip: Strip, buffers: Buffers) -> None:
    """Fill ``exact_dn`` with the noisy DN of all sites."""
    normal.fill_rows(strip.total, buffers.words, buffers.scratch)
    a, b = noise.line[2 * n], noise.line[2 * n + 1]
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        clean_dn = simd.load(buffers.unrounded_dn, x)
        std = simd.square_root(simd.maximum(simd.maximum(clean_dn - noise.black_dn, 0.0) * a + b, 0.0))
        deviate = normal.exact_values(buffers.words, buffers.scratch, x, noise.quadratics)
        simd.store(buffers.exact_dn, x, clean_dn + std * deviate)


@inner
def approximate_gaussian32(noise: Gaussian32, n: int, strip: Strip, buffers: Buffers) -> Pointer:
    """Fill ``noise_dn`` with clean and noise above black, in float32; no site needs more."""
    normal.fill_coarse_depths(strip.total, buffers.words, buffers.depths)
    a, b = noise.line[2 * n], noise.line[2 * n + 1]
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        clean_dn = simd.load(buffers.unrounded_dn, x)
        std = simd.square_root(simd.maximum(simd.maximum(clean_dn, 0.0) * a + b, 0.0))
        deviate = normal.apply_signs(
            std * normal.coarse_normal(simd.load(buffers.depths, x)), simd.load(buffers.words, x)
        )
        simd.store(buffers.noise_dn, x, clean_dn + deviate)
    return noise.black_dn
