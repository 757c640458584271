"""Draw Poisson counts by inversion: one 32-bit random word, one count, coupled to the normal of the same word.

A count is the quantile of its word's probability u: the least k with P(K <= k) >= u. So it rises with the normal that
`reference.noise.normals` gives for the word. The rate is 0 to 1e9. For every k, the fraction of all 2**32 words with
counts up to k equals P(K <= k) within 2**-32.

From rate 64 up (`LIMIT`), the count is floor(x), where x > 0 solves Gamma(x, rate) / Gamma(x) = Phi(w) (Giles,
"Algorithm 955: approximation of the inverse Poisson cumulative distribution function", ACM TOMS 42(1), 2016). With
s = w / √rate,

    x = rate + √rate·w + w²·A(s) + B(s) + C(s) / rate + D(s) / rate² + E(s) / rate³,

the expansion of Giles and of Temme, with all powers of s kept together so that it holds into the tails. Truncation
changes the distribution function by 2e-12 at rate 64.

Counts are computed in two steps. Both give the same counts as `reference.poisson`.

1. Approximation, float32, from rate 6 up (`SHORT_LEAST`): the terms A and B with an approximate normal. It decides the
   count unless x is within its error bound of an integer: 0.05 at rate 8, a thousandth at high rates.
2. The remaining sites exactly, float64. From rate 64 up: the complete expansion, with w refined by a Newton step to
   1e-13. Below 64: comparison of u with the distribution function, tabulated with seven derivatives in the middle of 81
   cells of √rate (272 kB; error 6e-12). A first guess is at most one too low, so one comparison decides.

Timings and rejected alternatives: ``docs/design/kernels.md``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.types import Float
from unprocess_gen.simulation.kernels.normal import QuantileTables, exact_value, fill_approximate_values
from unprocess_gen.simulation.kernels.rounding import ROUND, ROUND32
from unprocess_gen.simulation.kernels.segments import Float32
from unprocess_gen.simulation.reference.poisson import (
    GUESS_UNIT,
    LEAST_NORMAL,
    LIMIT,
    LOW_ERROR,
    NORMAL_CELLS,
    NORMAL_ERROR,
    ORDER,
    RATE_CELLS,
    SHORT_ERROR,
    SHORT_LEAST,
    SHORT_REACH,
    TAIL_CELLS,
    A,
    B,
    C,
    D,
    E,
    Tables,
)

_LOW31, _SIGN = np.uint64(0x7FFFFFFF), np.uint64(0x80000000)
_1, _31 = np.uint64(1), np.uint64(31)
_0F, _1F, _8F = np.float32(0.0), np.float32(1.0), np.float32(8.0)
_A0, _A1, _A2, _A3, _A4 = (np.float32(a) for a in A[:5])
_B0, _B1, _B2, _B3 = (np.float32(b) for b in B[:4])
_MIN_RATE, _MAX_NORMAL = np.float32(SHORT_LEAST), np.float32(SHORT_REACH)
_ERROR, _NORMAL_ERROR, _LOW_ERROR = (np.float32(e) for e in (SHORT_ERROR, NORMAL_ERROR, LOW_ERROR))
_POWERS = len(A)
_COEFFICIENTS = np.array([(*series, *(0.0,) * (_POWERS - len(series))) for series in (A, B, C, D, E)])
_MIN_ROOT = np.float32(np.sqrt(SHORT_LEAST * 1.000001))
_UNCERTAIN, _CERTAIN = np.float32(9.0), np.float32(-1.0)


class CountBuffers(NamedTuple):
    """Hold the scratch arrays for one segment of counts.

    Python allocates them: each allocation in a kernel takes 50 ms to compile.
    """

    normals: Float32
    line_buffer: NDArray[np.uint64]
    rounded_rate: Float
    residual: Float32  # rate - rounded_rate, then count - rounded_rate
    rate: Float32
    excess: Float32  # error bound minus distance to the nearest integer: not negative if the count is uncertain
    is_uncertain: NDArray[np.uint8]
    uncertain_groups: NDArray[np.uint64]  # the same memory, eight flags at a time
    uncertain: NDArray[np.int64]
    high_rate: NDArray[np.int64]
    low_rate: NDArray[np.int64]
    rows: NDArray[np.int64]
    offsets: Float


def allocate_count_buffers(count: int) -> CountBuffers:
    """Allocate zeroed buffers for segments of up to ``count`` sites, a multiple of 8."""
    normals, residual, rate, excess = np.zeros((4, count), dtype=np.float32)
    rounded_rate, offsets = np.zeros((2, count))
    uncertain, high_rate, low_rate, rows = np.zeros((4, count + 8), dtype=np.int64)
    line_buffer, flags = np.zeros(count, dtype=np.uint64), np.zeros(count + 8, dtype=np.uint8)
    return CountBuffers(
        normals, line_buffer, rounded_rate, residual, rate, excess, flags, flags.view(np.uint64), uncertain, high_rate,
        low_rate, rows, offsets,
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------------------ all sites


@inner
def fill_counts(
    words: NDArray[np.uint32], rates: Float, normal: QuantileTables, tables: Tables, buffers: CountBuffers, out: Float
) -> None:
    """Fill ``out`` with the Poisson counts of ``words`` at mean ``rates``, all ``[n]``.

    ``rates`` are from 0 to 1e9 and must not share memory with ``out``.
    """
    count = out.shape[0]
    fill_approximate_values(words, normal.lines, buffers.line_buffer, buffers.normals[:count])
    _approximate_all(rates, buffers, out)
    uncertain = compact_indices(buffers.is_uncertain, buffers.uncertain_groups, count, buffers.uncertain)
    if uncertain > 0:
        recompute_exact_counts(words, rates, normal, tables, buffers, uncertain, out)


@inner
def _approximate_all(rates: Float, buffers: CountBuffers, out: Float) -> None:
    """Fill ``out`` with approximate counts and flag the uncertain ones, without branches.

    Float32, except for the rounded rate. A rate of 0 is certain to give a count of 0.
    """
    normals, rounded_rate, residual = buffers.normals, buffers.rounded_rate, buffers.residual
    rate32, excess = buffers.rate, buffers.excess
    for n in range(out.shape[0]):
        rounded_rate[n] = (rates[n] + ROUND) - ROUND
        residual[n] = np.float32(rates[n] - rounded_rate[n])
        rate32[n] = np.float32(rates[n])
    for n in range(out.shape[0]):
        rate, z = rate32[n], normals[n]
        root = np.sqrt(max(rate, _MIN_RATE))
        inverse = _1F / root
        s = z * inverse
        s2, i2 = s * s, inverse * inverse
        a = (_A0 + s * _A1) + s2 * ((_A2 + s * _A3) + s2 * _A4)
        b = (_B0 + s * _B1) + s2 * (_B2 + s * _B3)
        x = (residual[n] + root * z) + (z * z * a + b)
        error = _NORMAL_ERROR * (_8F + root) + i2 * (_ERROR + _LOW_ERROR * (i2 * i2))
        error = error if abs(z) < _MAX_NORMAL else _UNCERTAIN
        error = error if rate >= _MIN_RATE else _UNCERTAIN
        error = error if rate > _0F else _CERTAIN
        rounded = (x + ROUND32) - ROUND32
        excess[n] = error - abs(x - rounded)
        residual[n] = rounded - (_1F if rounded > x else _0F)
    flag_uncertain(excess, out.shape[0], buffers.is_uncertain)
    for n in range(out.shape[0]):
        out[n] = rounded_rate[n] + np.float64(residual[n]) if rate32[n] > _0F else 0.0


@inner
def approximate_counts(
    residual: Float32,
    root: Float32,
    inverse: Float32,
    normals: Float32,
    root_range: tuple[np.float32, np.float32],
    rounded: Float32,
    excess: Float32,
) -> None:
    """Replace rounded rates by approximate counts in float32; a count is uncertain if its ``excess`` is not negative.

    A rate is ``rounded`` plus ``residual``; ``root`` and ``inverse`` are its square root and the reciprocal of that. If
    the root is outside ``root_range``, the count is replaced by a normal that is not rounded. Overwrites ``residual``.
    """
    low, high = root_range
    # Three loops, in which every conditional chooses between two computed values: with more arrays in one loop, or with
    # branches, LLVM emits scalar code, which takes twice as long.
    for n in range(residual.shape[0]):
        z = normals[n]
        s = z * inverse[n]
        s2 = s * s
        a = (_A0 + s * _A1) + s2 * ((_A2 + s * _A3) + s2 * _A4)
        b = (_B0 + s * _B1) + s2 * (_B2 + s * _B3)
        excess[n] = (residual[n] + root[n] * z) + (z * z * a + b)
        residual[n] = residual[n] + root[n] * z
    for n in range(residual.shape[0]):
        x, i2 = excess[n], inverse[n] * inverse[n]
        rounded_x = (x + ROUND32) - ROUND32
        error = _NORMAL_ERROR * (_8F + root[n]) + i2 * (_ERROR + _LOW_ERROR * (i2 * i2))
        error = error if abs(normals[n]) < _MAX_NORMAL else _UNCERTAIN
        margin = error - abs(x - rounded_x)
        margin = margin if root[n] >= _MIN_ROOT else _UNCERTAIN  # at the lowest rates x may be NaN
        margin = margin if root[n] > low else _CERTAIN
        excess[n] = margin if root[n] < high else _CERTAIN
        one = _1F if rounded_x > x else _0F
        count = rounded_x - one
        count = count if root[n] > low else residual[n]
        residual[n] = count if root[n] < high else residual[n]
    for n in range(residual.shape[0]):
        rounded[n] = rounded[n] + residual[n]


@inner
def none_within(root: Float32, root_range: tuple[np.float32, np.float32]) -> bool:
    """Return whether no root of a rate is within ``root_range``, so that all counts are replaced by normals."""
    low, high = root_range
    within = np.int32(0)
    for n in range(root.shape[0]):
        within = np.int32(within + (root[n] > low and root[n] < high))
    return bool(within == 0)


@inner
def fill_normal_counts(residual: Float32, root: Float32, normals: Float32, rounded: Float32) -> None:
    """Replace rounded rates by normals of the same mean and variance, not rounded."""
    for n in range(residual.shape[0]):
        rounded[n] = rounded[n] + (residual[n] + root[n] * normals[n])


@inner
def flag_uncertain(excess: Float32, count: int, is_uncertain: NDArray[np.uint8]) -> None:
    """Set ``is_uncertain`` to 1 for sites whose ``excess`` is not negative, and to 0 for others."""
    for n in range(count):
        is_uncertain[n] = excess[n] >= _0F


@inner
def compact_indices(
    flags: NDArray[np.uint8], groups: NDArray[np.uint64], count: int, indices: NDArray[np.int64]
) -> int:
    """List the indices of the set ones among the first ``count`` flags, and return their number.

    ``groups`` is a view of ``flags``, eight at a time.
    """
    flags[count : count + 8] = 0
    found = 0
    for group in range((count + 7) // 8):
        if groups[group] != 0:
            for n in range(8 * group, 8 * group + 8):
                indices[found] = n
                found += flags[n]
    return found


# ------------------------------------------------------------------------------------------------------ uncertain sites


@inner
def recompute_exact_counts(
    words: NDArray[np.uint32],
    rates: Float,
    normal: QuantileTables,
    tables: Tables,
    buffers: CountBuffers,
    uncertain: int,
    out: Float | Float32,
) -> None:
    """Recompute the first ``uncertain`` counts listed in the buffers, which also hold the approximate normals."""
    high, low = _split_by_rate(rates, buffers.uncertain, uncertain, buffers.high_rate, buffers.low_rate)
    if high > 0:
        _count_high_rates(words, rates, normal.quadratics, tables.tails, buffers.high_rate[:high], out)
    if low > 0:
        indices, rows, offsets = buffers.low_rate[:low], buffers.rows, buffers.offsets
        cells = (tables.first, tables.least, tables.most, tables.middle)
        _guess_low_rates(rates, buffers.normals, cells, tables.guess, indices, rows, offsets, out)
        _correct_guesses(words, tables.cdf, indices, rows, offsets, out)


@inner
def _split_by_rate(
    rates: Float,
    uncertain: NDArray[np.int64],
    count: int,
    high_rate: NDArray[np.int64],
    low_rate: NDArray[np.int64],
) -> tuple[int, int]:
    """Split the listed indices into rates of at least `LIMIT` and lower ones; return how many there are of each."""
    high, low = 0, 0
    for m in range(count):
        n = uncertain[m]
        high_rate[high] = low_rate[low] = n
        high += rates[n] >= LIMIT
        low = m + 1 - high
    return high, low


@inner
def _count_high_rates(
    words: NDArray[np.uint32],
    rates: Float,
    quadratics: tuple[Float, Float, Float],
    tails: Float,
    indices: NDArray[np.int64],
    out: Float,
) -> None:
    """Compute the counts at ``indices`` by the complete expansion, in the reference's order of operations."""
    for n in indices:
        tail = (np.float64(words[n] & _LOW31) + 0.5) * 2.0**-32
        z = exact_value(words[n], quadratics)
        w = _refine_normal(tail, abs(z), tails)
        out[n] = np.floor(_expansion(rates[n], -w if words[n] & _SIGN else w))


@inner
def _refine_normal(tail: float, z: float, tails: Float) -> float:
    """Return the upper normal quantile of ``tail`` by one Newton step from ``z``, in the reference's order."""
    cell = int(z * TAIL_CELLS)
    offset = z - (cell + 0.5) / TAIL_CELLS
    value, slope = tails[cell, ORDER], tails[cell, ORDER] * ORDER
    for n in range(ORDER - 1, 0, -1):
        value = tails[cell, n] + offset * value
        slope = tails[cell, n] * n + offset * slope
    value = tails[cell, 0] + offset * value
    return float(z - (value - tail) / slope)


@inner
def _expansion(rate: float, w: float) -> float:
    """Return x of the module's formula, in the order of `reference.poisson.expansion`."""
    root = np.sqrt(rate)
    s = w / root
    # np.int64 instead of literals: Numba would compile one function per literal
    a, b, c = _power_sum(np.int64(0), s), _power_sum(np.int64(1), s), _power_sum(np.int64(2), s)
    d, e = _power_sum(np.int64(3), s), _power_sum(np.int64(4), s)
    rest = w * w * a + (b + (c + (d + e / rate) / rate) / rate)
    return float(rate + (root * w + rest))


@inner
def _power_sum(which: int, s: float) -> float:
    total = 0.0  # missing powers have coefficients of 0, which change no bit
    for n in range(_POWERS - 1, -1, -1):
        total = _COEFFICIENTS[which, n] + s * total
    return total


@inner
def _guess_low_rates(
    rates: Float,
    normals: Float32,
    cells: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Float],
    guess: NDArray[np.int8],
    indices: NDArray[np.int64],
    rows: NDArray[np.int64],
    offsets: Float,
    out: Float,
) -> None:
    """Guess the counts at ``indices``, at most one too low, and find their rows of `Tables.cdf`.

    In the first cell, where counts are almost always 0, the guess is 0.
    """
    first, least, most, middle = cells
    for m in range(indices.shape[0]):
        n = np.uint64(indices[m])
        rate, z = rates[n], np.float64(normals[n])
        root = np.sqrt(rate)
        cell = np.uint64(np.int64(root * RATE_CELLS))  # unsigned: Numba need not check for negative indices
        correction = guess[cell, np.uint64(np.int64((z - LEAST_NORMAL) * NORMAL_CELLS))] * GUESS_UNIT
        k = (np.int64(rate + root * z + correction + 0.5) - 1) * np.int64(cell > 0)
        k = min(max(k, least[cell]), most[cell])
        rows[m], offsets[m] = first[cell] + k, rate - middle[cell]
        out[n] = k


@inner
def _correct_guesses(
    words: NDArray[np.uint32],
    cdf: Float,
    indices: NDArray[np.int64],
    rows: NDArray[np.int64],
    offsets: Float,
    out: Float,
) -> None:
    """Add 1 to guesses that are one too low; in the first cell (row 0) add as many as necessary."""
    for m in range(indices.shape[0]):
        n, row, offset = np.uint64(indices[m]), np.uint64(rows[m]), offsets[m]
        # Rank of the word by its normal: invert the top bit, and the other bits too if it was 0. No branch, since half
        # of its predictions would fail.
        word = np.uint64(words[n])
        rank = word ^ (_SIGN | (((word >> _31) - _1) & _LOW31))
        uniform = (np.float64(rank) + 0.5) * 2.0**-32
        over = np.int64(uniform > _cdf_at(cdf, row, offset))
        if row == 0 and over > 0:
            while uniform > _cdf_at(cdf, np.uint64(over), offset):
                over += 1
        out[n] += over


@inner
def _cdf_at(cdf: Float, row: int, offset: float) -> float:
    """Return P(K <= k) of a table row, ``offset`` from the middle of its cell, in the reference's order."""
    total: float = cdf[row, ORDER]
    for n in range(ORDER - 1, -1, -1):
        total = cdf[row, n] + offset * total
    return total
