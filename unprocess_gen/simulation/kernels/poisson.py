"""Draw Poisson counts by inversion: one 32-bit random word, one count, coupled to the normal of the same word.

Counts equal `reference.poisson`, for rates up to 1e9. They are computed in two steps.

1. Approximately, float32, eight sites at a time, with a bound of the error that is 0 where the count is certain. Below
   rate 5: comparison of the word's rank with the distribution function, summed term by term. From rate 5 up: the first
   terms of the expansion, with an approximate normal.
2. Exactly, float64, for sites of which the caller needs more: by the first terms again where they suffice, otherwise in
   the reference's order of operations. That is the complete expansion from rate 64 up; below, comparisons with the
   distribution function next to an estimate.

Design: ``docs/design/kernels.md``.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.simulation.kernels import normal, simd
from unprocess_gen.simulation.kernels.jit import inner
from unprocess_gen.simulation.kernels.rounding import ROUND32
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, Pointer, Vector
from unprocess_gen.simulation.kernels.strips import Buffers
from unprocess_gen.simulation.reference import poisson as reference
from unprocess_gen.simulation.reference.poisson import LIMIT, ORDER, RATE_CELLS, TAIL_CELLS, poisson_tables

LOW_RATE = 5.0
"""Rate below which counts are found by comparison with the distribution function."""

MAX_THRESHOLD_RATE = 16.0
"""Largest rate for `count_thresholds`; a comparison per threshold takes longer above it."""

FLOAT32_RATE = 5 * 2.0**-24
"""Largest relative error of a rate in float32 for which the bounds of `fill_counts` hold."""

_LOW31, _SIGN = np.uint64(0x7FFFFFFF), np.uint64(0x80000000)
_1, _8, _31, _32 = (np.uint64(number) for number in (1, 8, 31, 32))
_SERIES = reference.A, reference.B, reference.C, reference.D, reference.E
_POWERS = len(reference.A)
_COEFFICIENTS = np.array([(*series, *(0.0,) * (_POWERS - len(series))) for series in _SERIES])


class CountTables(NamedTuple):
    """Tables of approximate and exact counts.

    Attributes
    ----------
    lines : ndarray of uint64
        Approximate normals (`normal.Quantiles`).
    quadratics : ndarray of float64
        Exact normals.
    tails, cdf : ndarray
        Members of `reference.poisson.Tables`.
    cells : ndarray of float64, [81, 4]
        Its ``first``, ``least``, ``most`` and ``middle``.
    """

    lines: NDArray[np.uint64]
    quadratics: Float
    tails: Float
    cdf: Float
    cells: Float


@functools.lru_cache(maxsize=1)
def count_tables() -> CountTables:
    """Return the tables, computed once per process."""
    normals, exact = normal.normal_quantiles(), poisson_tables()
    cells = np.stack([exact.first, exact.least, exact.most, exact.middle], axis=1)
    return CountTables(normals.lines, normals.quadratics, exact.tails, exact.cdf, cells)


# -------------------------------------------------------------------------------------------------- one rate everywhere


@functools.lru_cache(maxsize=8)
def count_thresholds(rate: float) -> tuple[int, NDArray[np.uint32]]:
    """Smallest count of a rate, and the last rank of each count except the largest, in ascending order.

    The rank of a word is its place among all words, ordered by their normals. A count is the smallest one plus the
    number of ranks that the word's rank exceeds: exactly the count of `reference.poisson`, by comparisons only.
    """
    tables = poisson_tables()
    cell = int(np.sqrt(rate) * RATE_CELLS)
    counts = np.arange(tables.least[cell], tables.most[cell] + 1)
    offset, rows = rate - tables.middle[cell], tables.cdf[tables.first[cell] + counts]
    cdf = rows[:, ORDER]
    for n in range(ORDER - 1, -1, -1):
        cdf = rows[:, n] + offset * cdf
    last = np.floor(cdf * 2.0**32 - 0.5) if rate > 0 else np.full(len(counts), 2.0**32)  # (rank + ½) / 2**32 <= cdf
    smallest = int((last < 0).sum())
    return int(tables.least[cell]) + smallest, last[smallest:][last[smallest:] < 2**32 - 1].astype(np.uint32)


@inner
def fill_counts_of_one_rate(
    count: int, words: Pointer, smallest: np.float32, last_ranks: Pointer, steps: int, out: Pointer
) -> None:
    """Fill ``out`` (float32) with the counts of ``words`` by the ``steps`` ranks of `count_thresholds`."""
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        word, above = simd.load(words, x), simd.uint32_zeros()
        rank = word ^ (((word >> _TOP_BIT) - _ONE_BIT) | _SIGN32)
        for k in range(steps):
            above = above - simd.less_than(last_ranks[k], rank)
        simd.store(out, x, simd.to_float32(above) + smallest)


# ------------------------------------------------------------------------------------------------------------ all sites

_TOP_BIT, _ONE_BIT, _SIGN32, _LOW31_32 = (np.uint32(bits) for bits in (31, 1, 0x80000000, 0x7FFFFFFF))
_INFINITE_BITS32, _EVERY_BIT, _23, _0F = np.uint32(0x7F800000), np.uint32(0xFFFFFFFF), np.uint32(23), np.float32(0)


@inner
def fill_counts(
    count: int, words: Pointer, rates: Pointer, tables: CountTables, buffers: Buffers, out: Pointer, error: Pointer
) -> None:
    """Fill ``out`` (float32) with the Poisson counts of ``words``; ``count`` is a multiple of `VECTOR_WIDTH`.

    ``error`` (float32) receives 0 where the count is certain, else a bound of its error, which may be infinite.
    ``rates`` (float32) may differ from the true rates by `FLOAT32_RATE`.
    """
    has_normals = False
    for start in range(0, count, BLOCK):
        first, vectors = np.uint64(start), min(BLOCK, count - start) // VECTOR_WIDTH
        has_low, has_high, highest_low = _range_of_block(first, vectors, rates, buffers)
        if has_low:
            _count_low_rates(first, vectors, highest_low, words, rates, out, error)
        if has_high:
            if not has_normals:
                normal.fill_values_by_lines(count, words, tables.lines, buffers.lines, buffers.normals)
                has_normals = True
            _count_high_rates(first, vectors, has_low, rates, buffers.normals, out, error)


@inner
def _range_of_block(first: np.uint64, vectors: int, rates: Pointer, buffers: Buffers) -> tuple[bool, bool, np.float32]:
    """Compare the rates of a block with `LOW_RATE`: any below it, any not below it, and the highest one below it."""
    any_low = any_high = simd.uint32_zeros()
    low = simd.from_bits(any_low)
    for n in range(vectors):
        rate = simd.load(rates, first + np.uint64(n) * _8)
        is_low = simd.less_than(rate, LOW_RATE)
        any_low, any_high = any_low | is_low, any_high | (is_low ^ _EVERY_BIT)
        low = simd.maximum(simd.from_bits(is_low & simd.to_bits(rate)), low)
    simd.store(buffers.highest, 0, low)
    highest = _0F
    for lane in range(VECTOR_WIDTH):
        highest = simd.maximum(buffers.highest[lane], highest)
    return simd.has_any_bit(any_low), simd.has_any_bit(any_high), highest


CDF_ERROR = 2.0**-18
"""Bound of the error of a distribution function in float32 below rate 5.

The largest terms: rounding of the exponent 5e-7, the 13 terms of the recurrence 6e-7, their sum 4e-7, the error of the
rate 3e-7, exponential and rank 2e-7.
"""

_RECIPROCALS = np.array([1 / k for k in range(1, 32)], dtype=np.float32)
_LOG2E = 1.4426950408889634
_EXP2 = (1.00000007, 0.693146967, 0.240221197, 0.0555071329, 9.67554206e-3, 1.32764676e-3)
"""Minimax polynomial of 2**f for f from -1/2 to 1/2, relative error 7.5e-8."""


@inner
def _count_low_rates(
    first: np.uint64, vectors: int, highest: np.float32, words: Pointer, rates: Pointer, out: Pointer, error: Pointer
) -> None:
    """Fill up to a block with the counts of rates below `LOW_RATE`; errors are 0 or infinite.

    Terms are summed up to a count that at most 0.4 % of the words exceed. Ranks and the distribution function are
    reduced by ½, so that float32 is precise where they are compared most.
    """
    pairs = (np.int64(highest + 3.1 * np.sqrt(highest)) + 2) // 2
    for n in range(vectors):
        x = first + np.uint64(n) * _8
        rate, word = simd.load(rates, x), simd.load(words, x)
        rank = normal.apply_signs(0.5 - simd.to_float32(word & _LOW31_32) * 2.0**-32, word)
        low, high = rank - CDF_ERROR, rank + CDF_ERROR
        term = _exp_of_minus(rate)
        cdf, certain, possible = term - 0.5, simd.uint32_zeros(), simd.uint32_zeros()
        for pair in range(pairs):
            k = np.uint64(2 * pair)
            certain, possible = certain - simd.less_than(cdf, low), possible - simd.less_than(cdf, high)
            term = term * (rate * _RECIPROCALS[k])
            cdf = cdf + term
            certain, possible = certain - simd.less_than(cdf, low), possible - simd.less_than(cdf, high)
            term = term * (rate * _RECIPROCALS[k + _1])
            cdf = cdf + term
        simd.store(out, x, simd.to_float32(certain))
        is_open = simd.less_than(certain, possible) | simd.less_than(cdf, high)
        simd.store(error, x, simd.from_bits(is_open & _INFINITE_BITS32))


@inner
def _exp_of_minus(x: Vector) -> Vector:
    """Return exp(-x) for x from 0 to 80 in float32, with a relative error of 2e-7 (1 + x / 3)."""
    t = x * -_LOG2E
    shifted = t + ROUND32
    f = t - (shifted - ROUND32)
    c, f2 = _EXP2, f * f
    power = (f * c[1] + c[0]) + f2 * ((f * c[3] + c[2]) + f2 * (f * c[5] + c[4]))
    scaled: Vector = simd.from_bits(simd.to_bits(power) + (simd.to_bits(shifted) << _23))
    return scaled


NORMAL_REACH2 = 9.0, 0.5
"""Squared normals above the sum of these, times 1 and the root of the rate, are not covered by `EXPANSION_ERRORS`."""

EXPANSION_ERRORS = 2e-4, 6.5e-7, 0.034
"""Error of the expansion's first terms: less than the sum of these, times 1, the rate and 1 / rate.

The last term is the truncation, from rate 5 up. The others are errors of the approximate normal, 6e-6 (8 + √rate),
which is at most 6e-6 (8 + 12.5 + rate / 50), of the rate, and of rounding to float32.
"""

TRUNCATION_ERRORS = 2e-7, 0.0325
"""Error of the first terms in float64 with exact normals: less than the sum of these, times 3 + √rate and 1 / rate."""

_TERMS, _RECIPROCAL_TERM = (1 / 6, -1 / 72, 3.74468638e-3, -1.52239065e-3, 6.95733048e-4), -0.0305402523
"""Coefficients of x - rate - √rate·z ≈ (z² + 2)·P(s) + c / rate, s = z / √rate.

The first two are coefficients of the expansion; the others minimise the largest error times the rate.
"""


@inner
def _count_high_rates(
    first: np.uint64, vectors: int, has_low: bool, rates: Pointer, normals: Pointer, out: Pointer, error: Pointer
) -> None:
    """Fill up to a block with the counts of rates from `LOW_RATE` up; ``has_low`` keeps the counts of lower rates."""
    c, (error_of_1, error_of_rate, error_of_reciprocal) = _TERMS, EXPANSION_ERRORS
    for n in range(vectors):
        x = first + np.uint64(n) * _8
        rate, z = simd.load(rates, x), simd.load(normals, x)
        reciprocal, root = 1.0 / rate, simd.square_root(rate)
        s, z2 = z * (root * reciprocal), z * z
        s2 = s * s
        terms = (s * c[1] + c[0]) + s2 * ((s * c[3] + c[2]) + s2 * c[4])
        value = (rate - 0.5) + (root * z + ((z2 + 2.0) * terms + reciprocal * _RECIPROCAL_TERM))
        counted = (value + ROUND32) - ROUND32
        most = (rate * error_of_rate + reciprocal * error_of_reciprocal) + (1.0 + error_of_1)
        is_open = simd.less_than(1.5 - most, simd.absolute(value - counted))
        is_far = simd.less_than(root * NORMAL_REACH2[1] + (NORMAL_REACH2[0] - 1e-3), z2)
        bound = simd.maximum(simd.from_bits(simd.to_bits(most) & is_open), simd.from_bits(is_far & _INFINITE_BITS32))
        if has_low:
            is_low = simd.less_than(rate, LOW_RATE)
            counted = simd.select(is_low, simd.load(out, x), counted)
            bound = simd.select(is_low, simd.load(error, x), bound)
        simd.store(out, x, counted)
        simd.store(error, x, bound)


# ------------------------------------------------------------------------------------------------------ uncertain sites


@inner
def exact_count(word: np.uint32, rate: float, tables: CountTables) -> float:
    """Return the count of a word, in the reference's order of operations."""
    if not rate > 0.0:
        return 0.0
    z = normal.exact_value(word, tables.quadratics)
    if rate >= LOW_RATE:
        least, most = _bounds_by_first_terms(rate, z)
        if least == most:
            return float(least)
    if rate >= LIMIT:
        tail = (np.float64(word & np.uint32(0x7FFFFFFF)) + 0.5) * 2.0**-32
        w = _refine_normal(tail, abs(z), tables.tails)
        return float(np.floor(_expansion(rate, -w if np.uint64(word) & _SIGN else w)))
    return float(_count_by_cdf(word, rate, z, tables))


@inner
def _bounds_by_first_terms(rate: float, z: float) -> tuple[float, float]:
    """Return bounds of the count of a rate from `LOW_RATE` up, from the exact normal of its word."""
    root = np.sqrt(rate)
    if z * z > NORMAL_REACH2[0] + NORMAL_REACH2[1] * root:
        return 0.0, np.inf
    c, s, reciprocal = _TERMS, z / root, 1.0 / rate
    terms = c[0] + s * (c[1] + s * (c[2] + s * (c[3] + s * c[4])))
    value = rate + (root * z + ((z * z + 2.0) * terms + reciprocal * _RECIPROCAL_TERM))
    error = TRUNCATION_ERRORS[0] * (3.0 + root) + TRUNCATION_ERRORS[1] * reciprocal
    return np.floor(value - error), np.floor(value + error)


@inner
def _refine_normal(tail: float, z: float, tails: Pointer) -> float:
    """Return the upper normal quantile of ``tail`` by one Newton step from ``z``, in the reference's order."""
    cell = np.int64(z * TAIL_CELLS)
    offset, start = z - (cell + 0.5) / TAIL_CELLS, cell * (ORDER + 1)
    value, slope = tails[start + ORDER], tails[start + ORDER] * ORDER
    for n in range(ORDER - 1, 0, -1):
        value = tails[start + n] + offset * value
        slope = tails[start + n] * n + offset * slope
    value = tails[start] + offset * value
    return float(z - (value - tail) / slope)


@inner
def _expansion(rate: float, w: float) -> float:
    """Return x of the expansion, in the order of `reference.poisson.expansion`."""
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
def _count_by_cdf(word: np.uint32, rate: float, z: float, tables: CountTables) -> float:
    """Return the least k with P(K <= k) >= u, from an estimate by the normal of the word up or down."""
    root = np.sqrt(rate)
    record = simd.pointer_to(tables.cells, 4 * np.int64(root * RATE_CELLS))
    first, least, most, offset = np.int64(record[0]), record[1], record[2], rate - record[3]
    # rank of the word by its normal: invert the top bit, and the other bits too if it was 0
    bits = np.uint64(word)
    uniform = (np.float64(bits ^ (_SIGN | (((bits >> _31) - _1) & _LOW31))) + 0.5) * 2.0**-32
    k = np.int64(simd.minimum(simd.maximum(np.floor(rate + root * z + (z * z - 1.0) / 6.0), least), most))
    while k <= most and uniform > _cdf_at(tables.cdf, first + k, offset):
        k += 1
    while k > least and not uniform > _cdf_at(tables.cdf, first + k - 1, offset):
        k -= 1
    return float(k)


@inner
def _cdf_at(cdf: Pointer, row: int, offset: float) -> float:
    """Return P(K <= k) of a table row, ``offset`` from the middle of its cell, in the reference's order."""
    start = row * (ORDER + 1)
    total: float = cdf[start + ORDER]
    for n in range(ORDER - 1, -1, -1):
        total = cdf[start + n] + offset * total
    return total
