"""Compute normal deviates from random words: exact in float64, approximate in float32 with a known error bound.

A value that is rounded later, to a count or to a DN, needs few exact bits. If its approximation is farther from a
rounding boundary than its error bound, the exact value rounds alike. Callers recompute the other sites exactly, so
frames equal the frames of `reference.noise.normals` bit for bit.

A word's tail probability is p = f / 2**32, f = i + 1/2, where i is its lower 31 bits; its top bit is the sign. Two
approximations:

Lines
    The quantile is a line in f over each of 128 pieces of every octave. One load of eight bytes per value (the exact
    quadratics need three). Valid for any symmetric distribution; computes eight values at a time.
Polynomials
    The quantile is a polynomial in the depth √(-log2 p), for all p at once, and so is the logarithm's mantissa. No
    loads. Two separate loops, because a single one is a long chain of dependent operations. Tier ``fast`` uses them.

Design: ``docs/design/kernels.md``.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.simulation.kernels import simd
from unprocess_gen.simulation.kernels.jit import inner
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, Pointer, Vector
from unprocess_gen.simulation.lookup_tables import FIRST_LINE, LINE_SHIFT, SEGMENTS, normal_table, quantile_lines

# --------------------------------------------------------------------------------------------------------------- tables

_LOW31, _SIGN, _HALF = np.uint32(0x7FFFFFFF), np.uint32(0x80000000), np.float32(0.5)
_VECTOR_WIDTH, _1, _2, _32 = (np.uint64(number) for number in (VECTOR_WIDTH, 1, 2, 32))
_LINE_SHIFT, _FIRST_LINE = np.uint32(LINE_SHIFT), np.uint32(FIRST_LINE)

_POSITION_BITS = np.uint64(52 - (SEGMENTS.bit_length() - 1))
_POSITION_MASK = np.uint64(2 ** (52 - (SEGMENTS.bit_length() - 1)) - 1)
_ONE_BITS, _FIRST_ROW = np.uint64(0x3FF0000000000000), np.uint64(1022 * SEGMENTS)


class Quantiles(NamedTuple):
    """Exact and approximate quantiles of a symmetric distribution.

    Attributes
    ----------
    lines : ndarray of uint64, [4097]
        Value at f = 0 and slope in f (`pack_lines`). The last one is the median, to which f may round.
    error : float
        Largest difference between a value by lines and the exact one.
    farthest : float
        Largest absolute value.
    quadratics : ndarray of float64, [4096]
        Rows of the exact table (`lookup_tables.normal_table`), each with a fourth number that is not used.
    """

    lines: NDArray[np.uint64]
    error: float
    farthest: float
    quadratics: Float


@functools.lru_cache(maxsize=1)
def normal_quantiles() -> Quantiles:
    """Return the quantiles of the normal distribution, computed once per process."""
    return build_quantiles(normal_table())


def build_quantiles(table: Float) -> Quantiles:
    """Derive the lines and their error from a table of quadratics, float64 ``[OCTAVES * SEGMENTS, 3]``."""
    start, slope, error = quantile_lines(table)
    farthest = float(np.abs(table[:, 0]).max())
    return Quantiles(pack_lines(start, slope), error, farthest, np.pad(table, ((0, 0), (0, 1))).ravel())


def pack_lines(start: NDArray[np.float32], slope: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Store two float32 in the low and high half of a uint64, so that one load gets both."""
    return start.view(np.uint32).astype(np.uint64) | slope.view(np.uint32).astype(np.uint64) << _32


# -------------------------------------------------------------------------------------------------- exact, and by lines


@inner
def exact_value(word: np.uint32, quadratics: Pointer) -> float:
    """Return the quantile of one word, bit for bit as `reference.noise.by_inverse_cdf`."""
    bits = simd.to_bits(np.float64(np.int64(word & _LOW31)) + 0.5)
    row = ((bits >> _POSITION_BITS) - _FIRST_ROW) << _2
    t = simd.from_bits((bits & _POSITION_MASK) | _ONE_BITS) - 1.0
    z = quadratics[row] + t * (quadratics[row + _1] + t * quadratics[row + _2])
    return float(simd.from_bits(simd.to_bits(z) ^ np.uint64(word & _SIGN) << _32))


@inner
def fill_rows(count: int, words: Pointer, rows: Pointer) -> None:
    """Fill ``rows`` (uint32) with the index at which the quadratic of each word begins, for `exact_values`."""
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _VECTOR_WIDTH
        bits = simd.to_bits(simd.to_float64(simd.load(words, x) & _LOW31) + 0.5)
        simd.store(rows, x, simd.to_uint32(((bits >> _POSITION_BITS) - _FIRST_ROW) << _2))


@inner
def exact_values(words: Pointer, rows: Pointer, x: np.uint64, quadratics: Pointer) -> Vector:
    """Return the quantiles of eight words, the values of `exact_value`."""
    lanes = simd.load(words, x)
    bits = simd.to_bits(simd.to_float64(lanes & _LOW31) + 0.5)
    t = simd.from_bits((bits & _POSITION_MASK) | _ONE_BITS) - 1.0
    start, slope, curvature = simd.load_columns(quadratics, rows, x)
    z = start + t * (slope + t * curvature)
    signed: Vector = simd.from_bits(simd.to_bits(z) ^ (simd.to_uint64(lanes & _SIGN) << _32))
    return signed


@inner
def fill_values_by_lines(count: int, words: Pointer, lines: Pointer, buffer: Pointer, out: Pointer) -> None:
    """Fill ``out`` (float32) with the quantiles of ``words`` by lines; ``buffer`` (uint64) is scratch space."""
    for n in range(count):
        out[n] = np.float32(np.int32(words[n] & _LOW31)) + _HALF
    for n in range(count):
        buffer[n] = lines[np.uint64((simd.to_bits(out[n]) >> _LINE_SHIFT) - _FIRST_LINE)]
    for n in range(count):
        start, slope = simd.from_bits(np.uint32(buffer[n])), simd.from_bits(np.uint32(buffer[n] >> _32))
        out[n] = start + slope * out[n]
    for n in range(count):
        out[n] = simd.from_bits(np.uint32(simd.to_bits(out[n]) ^ (words[n] & _SIGN)))


# ------------------------------------------------------------------------------------------------------- by polynomials

# Minimax polynomials (Remez, by iterated weights on 4001 nodes) of log2(m) - (m - 1), times 2**23, for m in [1, 2], and
# of the quantile for depths of 2**11.5 to √33 · 2**11.5. Errors before rounding to float32: 6.4e-4 in the logarithm and
# 1.6e-4 standard deviations in the quantile.
_COARSE_LOG2 = (-9677272.0, 17178896.0, -8823765.0, 1327485.62)
_COARSE_QUANTILE = (
    -2.24054217, 1.0469046e-03, -1.3891615e-07, 1.98390731e-11, -1.80084456e-15, 9.96128569e-20, -3.05291064e-24,
    3.96620536e-29,
)  # fmt: skip

COARSE_ERROR = 5.8e-4
"""Largest error of `coarse_normal` against the true quantile, in standard deviations."""

_MANTISSA, _ONE_BITS32 = np.uint32(0x7FFFFF), np.uint32(0x3F800000)
_BITS_OF_2_32 = np.uint32((32 + 127) << 23)


@inner
def fill_coarse_depths(count: int, words: Pointer, depths: Pointer) -> None:
    """Fill ``depths`` (float32) with √(-log2 p)·2**11.5 for `coarse_normal`; p is each word's tail probability.

    ``count`` is a multiple of `VECTOR_WIDTH`. For f = m · 2**e, m in [1, 2), the bits of f as a float32, read as an
    integer, are (e + 127 + m - 1) · 2**23.
    """
    c = _COARSE_LOG2
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _VECTOR_WIDTH
        bits = simd.to_bits(simd.to_float32(simd.load(words, x) & _LOW31) + _HALF)
        m = simd.from_bits((bits & _MANTISSA) | _ONE_BITS32)
        log2 = (c[0] + c[1] * m) + (c[2] + c[3] * m) * (m * m)
        simd.store(depths, x, simd.square_root(simd.to_float32(_BITS_OF_2_32 - bits) - log2))


@inner
def coarse_normal(depths: Vector) -> Vector:
    """Return the absolute normal deviates of these depths, with errors up to `COARSE_ERROR`."""
    c, t = _COARSE_QUANTILE, depths
    t2 = t * t
    low = (c[0] + c[1] * t) + (c[2] + c[3] * t) * t2
    normal: Vector = low + ((c[4] + c[5] * t) + (c[6] + c[7] * t) * t2) * (t2 * t2)
    return normal


@inner
def apply_signs(x: Vector, words: Vector) -> Vector:
    """Negate the float32 lanes whose word has its top bit set."""
    signed: Vector = simd.from_bits(simd.to_bits(x) ^ (words & _SIGN))
    return signed
