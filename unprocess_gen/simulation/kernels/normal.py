"""Normals in single precision, to within known errors, and the exact one of a word where that is asked for.

A value that is rounded in the end, to a count or to a DN, need not be known to the last bit: where it lies farther from
where the rounding turns than it can be off, the quick form decides as the exact one would. The few that lie nearer are
made again, of the exact normal. So frames are those of `effects.normals`, to the byte.

A word's tail probability p is f / 2**32, where f = i + ½ and i are its lower 31 bits. There are two quick forms:

Lines: the quantile is a line in f over each of 128 pieces of every octave: one load of eight bytes a value, where the
quadratics take three. Measured, AVX2, nanoseconds a value: 0.8 instead of 1.4, and eight values at a time in what
follows.

Polynomials: the quantile is a polynomial in √(-log2 p), over all p at once, and the logarithm's mantissa is one too: no
loads, so that eight values are had at a time from their words on. Nanoseconds a value: 0.9 to a 40,000th of a standard
deviation, 0.7 to a 1700th. In two loops, as what stands in one is a chain of forty operations that each wait for the
one before.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner, kernel
from unprocess_gen.core.lookup_tables import OCTAVES, SEGMENTS, normal_table
from unprocess_gen.core.types import Float
from unprocess_gen.simulation.kernels.simd import (
    WIDE,
    Numbers,
    Vector,
    bare,
    bits_of,
    float_of,
    load,
    root,
    store,
    to_float32,
)

Float32 = NDArray[np.float32]

PIECES = 128
"""Lines to an octave."""
PIECE_BITS = PIECES.bit_length() - 1

ROUNDING = 2.0**-21
"""What single precision adds to the error, in units of the farthest quantile and of a line's rise over its octave."""

_LOW31, _SIGN, _HALF = np.uint32(0x7FFFFFFF), np.uint32(0x80000000), np.float32(0.5)
_PIECE_SHIFT = np.uint32(23 - PIECE_BITS)
_FIRST_PIECE = np.uint32(126 << PIECE_BITS)

_LOW32, _32 = np.uint64(0xFFFFFFFF), np.uint64(32)
_LOW31_64, _SIGN_64, _1 = np.uint64(0x7FFFFFFF), np.uint64(0x80000000), np.uint64(1)
_TWO52_BITS, _TWO52, _ONE_BITS = np.uint64(0x4330000000000000), 2.0**52, np.uint64(0x3FF0000000000000)
_POSITION_BITS = np.uint64(52 - (SEGMENTS.bit_length() - 1))
_POSITION_MASK = np.uint64(2 ** (52 - (SEGMENTS.bit_length() - 1)) - 1)
_FIRST_ROW = np.uint64(1023 * SEGMENTS)


class Quantiles(NamedTuple):
    """A symmetric law in both forms.

    ``lines`` ``[4097]``: value at f = 0 and slope in f, two float32 in the low and the high half of a number; the last
    is the median, where f may round to. ``error``: no quick value is farther from the exact one. ``quadratics``: the
    columns of the exact table (`tables.normal_table`).
    """

    lines: NDArray[np.uint64]
    error: float
    quadratics: tuple[Float, Float, Float]


@functools.lru_cache(maxsize=1)
def normal_quantiles() -> Quantiles:
    """Return both forms of the normal law."""
    return quantiles(normal_table())


def quantiles(table: Float) -> Quantiles:
    """Return both forms of the law whose quadratics are in ``table``."""
    per_segment = PIECES // SEGMENTS
    rows = np.repeat(table, per_segment, axis=0)
    t = np.tile(np.arange(per_segment + 1) / PIECES, 1)
    at = np.tile(np.arange(per_segment), len(table))
    low, high = t[at], t[at + 1]
    z_low, z_high, z_middle = (rows[:, 0] + x * (rows[:, 1] + x * rows[:, 2]) for x in (low, high, (low + high) / 2))
    f_low = np.repeat(2.0 ** (np.arange(OCTAVES) - 1), PIECES) * (1 + np.tile(np.arange(PIECES) / PIECES, OCTAVES))
    f_high = f_low + np.repeat(2.0 ** (np.arange(OCTAVES) - 1), PIECES) / PIECES
    slope = (z_high - z_low) / (f_high - f_low)
    start = z_low - slope * f_low + (z_middle - (z_low + z_high) / 2) / 2
    lines = np.stack([start, slope], axis=1).astype(np.float32)
    low_bits, high_bits = lines.view(np.uint32).astype(np.uint64).T
    off = max(
        float(np.abs(z - (lines[:, 0].astype(np.float64) + lines[:, 1].astype(np.float64) * f)).max())
        for z, f in ((z_low, f_low), (z_middle, (f_low + f_high) / 2), (z_high, f_high))
    )
    farthest = float(np.abs(table[:, 0]).max() + np.abs(slope * f_high).max())
    median = np.zeros(1, dtype=np.uint64)
    q0, q1, q2 = (np.ascontiguousarray(column) for column in table.T)
    both = np.concatenate([high_bits << _32 | low_bits, median])
    return Quantiles(both, off + ROUNDING * farthest, (q0, q1, q2))


@inner
def quick_normals(
    words: NDArray[np.uint32], lines: NDArray[np.uint64], pairs: NDArray[np.uint64], out: Float32
) -> None:
    """Fill ``out`` with the quick values of ``words``; ``pairs`` is room for the lines.

    Numbers are seen as bits one by one: a view of an array takes Numba a quarter of a second to compile.
    """
    count = out.shape[0]
    for n in range(count):
        out[n] = np.float32(np.int32(words[n] & _LOW31)) + _HALF
    for n in range(count):
        pairs[n] = lines[np.uint64((np.float32(out[n]).view(np.uint32) >> _PIECE_SHIFT) - _FIRST_PIECE)]
    for n in range(count):
        start, slope = np.uint32(pairs[n] & _LOW32), np.uint32(pairs[n] >> _32)
        out[n] = start.view(np.float32) + slope.view(np.float32) * out[n]
    for n in range(count):
        out[n] = np.uint32(np.float32(out[n]).view(np.uint32) ^ (words[n] & _SIGN)).view(np.float32)


@inner
def exact_normal(word: np.uint32, quadratics: tuple[Float, Float, Float]) -> float:
    """Return the value of a word as `effects.by_inverse_cdf`."""
    odd = np.uint64(((np.uint64(word) & _LOW31_64) << _1 | _1) | _TWO52_BITS).view(np.float64) - _TWO52
    bits = np.float64(odd).view(np.uint64)
    row = (bits >> _POSITION_BITS) - _FIRST_ROW
    t = np.uint64((bits & _POSITION_MASK) | _ONE_BITS).view(np.float64) - 1.0
    z: float = quadratics[0][row] + t * (quadratics[1][row] + t * quadratics[2][row])
    return np.uint64(np.float64(z).view(np.uint64) ^ (np.uint64(word) & _SIGN_64) << _32).view(np.float64)


# ------------------------------------------------------------------------------------------------------ polynomials

FINE_ERROR = 2.5e-5
"""Standard deviations that no normal by the fine polynomials is off by more, over all words."""

CENTRE = np.float32(9775.0441)
"""What is taken from a depth in `fine_normal`, so that its terms stay small: 3.375 · 2**11.5."""


def _single(*coefficients: float) -> tuple[np.float32, ...]:
    return tuple(np.float32(one) for one in coefficients)


# Least greatest errors (Remez, by iterated weights on 4001 nodes), of log2(m) - (m - 1), times 2**23, for m in [1, 2],
# and of the quantile for depths of 2**11.5 to √33 · 2**11.5. What they leave, before rounding to float32: 1.8e-6 in the
# logarithm and 2.1e-5 standard deviations; 6.4e-4 and 1.6e-4.
_FINE_LOG2 = _single(-17113098, 42890644, -44811848, 27569396, -10627677, 2308114.25, -215512.344)
_FINE_QUANTILE = _single(
    3.372473, 4.44874051e-04, -2.84176638e-09, 2.20292561e-13, -2.1180979e-17, 2.20518879e-21, -4.88991725e-27,
    -1.15461396e-29, -3.53712128e-33, 4.32072602e-37,
)  # fmt: skip
_COARSE_LOG2 = _single(-9677272, 17178896, -8823765, 1327485.62)
_COARSE_QUANTILE = _single(
    -2.24054217, 1.0469046e-03, -1.3891615e-07, 1.98390731e-11, -1.80084456e-15, 9.96128569e-20, -3.05291064e-24,
    3.96620536e-29,
)  # fmt: skip

_MANTISSA, _ONE_BITS32 = np.uint32(0x7FFFFF), np.uint32(0x3F800000)
_BITS_OF_ALL = np.uint32((32 + 127) << 23)
_0, _EIGHT = np.uint64(0), np.uint64(WIDE)


@inner
def fill_depths(count: int, words: Numbers, depths: Numbers) -> None:
    """Fill ``depths`` with √(-log2 p) · 2**11.5, p being the tail probability of a word, for `fine_normal`."""
    for n in range(count // WIDE):
        x = np.uint64(n) * _EIGHT
        octaves, m = _taken_apart(load(words, x))
        store(depths, x, root(octaves - _fine_log2(m)))


@inner
def fill_coarse_depths(count: int, words: Numbers, depths: Numbers) -> None:
    """Do so for `coarse_normal`."""
    for n in range(count // WIDE):
        x = np.uint64(n) * _EIGHT
        octaves, m = _taken_apart(load(words, x))
        store(depths, x, root(octaves - _coarse_log2(m)))


@inner
def _taken_apart(words: Vector) -> tuple[Vector, Vector]:
    """Return m in [1, 2) and (32 - e - (m - 1)) · 2**23 of f = m · 2**e; the bits of a float count the latter."""
    bits = bits_of(to_float32(words & _LOW31) + _HALF)
    return to_float32(_BITS_OF_ALL - bits), float_of((bits & _MANTISSA) | _ONE_BITS32)


@inner
def _fine_log2(m: Vector) -> Vector:
    c = _FINE_LOG2
    m2 = m * m
    log2: Vector = ((c[0] + c[1] * m) + (c[2] + c[3] * m) * m2) + ((c[4] + c[5] * m) + c[6] * m2) * (m2 * m2)
    return log2


@inner
def _coarse_log2(m: Vector) -> Vector:
    c = _COARSE_LOG2
    log2: Vector = (c[0] + c[1] * m) + (c[2] + c[3] * m) * (m * m)
    return log2


@inner
def fine_normal(depths: Vector) -> Vector:
    """Return how many standard deviations from 0 draws of these depths lie, to within `FINE_ERROR`."""
    c = _FINE_QUANTILE
    t = depths - CENTRE
    t2 = t * t
    t4 = t2 * t2
    low = ((c[0] + c[1] * t) + (c[2] + c[3] * t) * t2) + ((c[4] + c[5] * t) + (c[6] + c[7] * t) * t2) * t4
    normal: Vector = low + (c[8] + c[9] * t) * (t4 * t4)
    return normal


@inner
def coarse_normal(depths: Vector) -> Vector:
    """Do so to within `methods.POLYNOMIAL_NORMAL`."""
    c, t = _COARSE_QUANTILE, depths
    t2 = t * t
    low = (c[0] + c[1] * t) + (c[2] + c[3] * t) * t2
    normal: Vector = low + ((c[4] + c[5] * t) + (c[6] + c[7] * t) * t2) * (t2 * t2)
    return normal


@inner
def signed(x: Vector, words: Vector) -> Vector:
    """Return numbers with the signs that their words draw."""
    return float_of(bits_of(x) ^ (words & _SIGN))


@kernel
def fill_fine_normals(words: NDArray[np.uint32], depths: Float32, out: Float32) -> None:
    """Fill ``out`` with the normals of ``words``, to within `FINE_ERROR`; their number is one of whole vectors."""
    drawn, deep, made = bare(words, _0), bare(depths, _0), bare(out, _0)
    fill_depths(words.size, drawn, deep)
    for n in range(words.size // WIDE):
        x = np.uint64(n) * _EIGHT
        store(made, x, signed(fine_normal(load(deep, x)), load(drawn, x)))


@kernel
def fill_coarse_normals(words: NDArray[np.uint32], depths: Float32, out: Float32) -> None:
    """Do so to within `methods.POLYNOMIAL_NORMAL`."""
    drawn, deep, made = bare(words, _0), bare(depths, _0), bare(out, _0)
    fill_coarse_depths(words.size, drawn, deep)
    for n in range(words.size // WIDE):
        x = np.uint64(n) * _EIGHT
        store(made, x, signed(coarse_normal(load(deep, x)), load(drawn, x)))
