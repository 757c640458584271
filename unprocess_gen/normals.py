"""Normals in single precision, to within a known error, and the exact one of a word where that is asked for.

A value that is rounded in the end, to a count or to a DN, need not be known to the last bit: where it lies farther from
where the rounding turns than it can be off, the quick form decides as the exact one would. The few that lie nearer are
made again, of the exact normal. So frames are those of `effects.normals`, to the byte.

A word's tail probability is f / 2**32, where f = i + ½ and i are its lower 31 bits. The quick quantile is a line in f
over each of 128 pieces of every octave: one load of eight bytes a value, where the quadratics take three. Measured,
AVX2, nanoseconds a value: 0.8 instead of 1.4, and eight values at a time in what follows.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.compiled import inner
from unprocess_gen.records import Float
from unprocess_gen.tables import OCTAVES, SEGMENTS, normal_table

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
TWO52_BITS, TWO52, ONE_BITS = np.uint64(0x4330000000000000), 2.0**52, np.uint64(0x3FF0000000000000)
POSITION_BITS = np.uint64(52 - (SEGMENTS.bit_length() - 1))
POSITION_MASK = np.uint64(2 ** (52 - (SEGMENTS.bit_length() - 1)) - 1)
FIRST_ROW = np.uint64(1023 * SEGMENTS)


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
    odd = np.uint64(((np.uint64(word) & _LOW31_64) << _1 | _1) | TWO52_BITS).view(np.float64) - TWO52
    bits = np.float64(odd).view(np.uint64)
    row = (bits >> POSITION_BITS) - FIRST_ROW
    t = np.uint64((bits & POSITION_MASK) | ONE_BITS).view(np.float64) - 1.0
    z: float = quadratics[0][row] + t * (quadratics[1][row] + t * quadratics[2][row])
    return np.uint64(np.float64(z).view(np.uint64) ^ (np.uint64(word) & _SIGN_64) << _32).view(np.float64)
