"""Draw Poisson counts by inversion: one 32-bit random word, one count, coupled to the normal of the same word.

Counts are those of `reference.poisson`, for rates up to 1e9. They are computed in two steps.

1. Approximation, float32. From rate 16 up: the terms A and B of the expansion with an approximate normal, eight sites
   at a time. Below 16: comparison of the normal with two tabulated thresholds, the normals at which the count changes.
   Either decides the count unless the value is within its error bound of a change.
2. The remaining sites exactly, float64, in the reference's order of operations: the complete expansion from rate 64 up,
   otherwise a guess from a table that is at most one too low, and one comparison with the distribution function.

The tables take 92 kB, of which a scene uses a small part. Timings and rejected alternatives:
``docs/design/kernels.md``.
"""

from __future__ import annotations

import functools
from decimal import Decimal
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.types import Float
from unprocess_gen.simulation.kernels.normal import (
    exact_value,
    fill_values_by_lines,
    normal_quantiles,
    pack_lines,
)
from unprocess_gen.simulation.kernels.rounding import ROUND32
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    Pointer,
    Vector,
    absolute,
    from_bits,
    less_than,
    load,
    low_half,
    maximum,
    minimum,
    movemask,
    select,
    store,
    to_float32,
    to_uint32,
)
from unprocess_gen.simulation.kernels.strips import Float32, Workspace, list_lanes
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
    SHORT_REACH,
    TAIL_CELLS,
    A,
    B,
    C,
    D,
    E,
    poisson_tables,
)

MAX_FLOAT32_RATE = 2.0**22
"""Largest rate whose counts are exact integers in float32; counts of higher rates are rounded to float32."""

_LOW31, _SIGN = np.uint64(0x7FFFFFFF), np.uint64(0x80000000)
_1, _6, _8, _31, _32 = (np.uint64(number) for number in (1, 6, 8, 31, 32))
_0F, _1F, _8F = np.float32(0.0), np.float32(1.0), np.float32(8.0)
_A0, _A1, _A2, _A3, _A4 = (np.float32(a) for a in A[:5])
_B0, _B1, _B2, _B3 = (np.float32(b) for b in B[:4])
_REACH = np.float32(SHORT_REACH)
_ERROR, _NORMAL_ERROR, _LOW_ERROR = (np.float32(e) for e in (SHORT_ERROR, NORMAL_ERROR, LOW_ERROR))
_ONE_BITS32 = np.uint32(0x3F800000)
_POWERS = len(A)
_COEFFICIENTS = np.array([(*series, *(0.0,) * (_POWERS - len(series))) for series in (A, B, C, D, E)])
_GUESSES = 13 * NORMAL_CELLS


# --------------------------------------------------------------------------------------------------------------- tables

LOW_ROOT = 4
"""Square root of the rate below which thresholds decide counts."""

_PER_ROOT, _PER_NORMAL, _ROW = 16, 16, 64
"""Cells per unit of the root and of the normal, and thresholds per cell: enough for counts at rate 16."""

_BUCKETS = 13 * _PER_NORMAL
_FARTHEST, _NEVER = 12.0, 63
"""Most that a threshold needs to be, and the row of thresholds that makes every site uncertain."""

_LAST_ROOT32, _K_BITS, _EVERY_BIT = np.float32(LOW_ROOT - 2.0**-20), np.uint32(_ROW - 1), np.uint32(2**32 - 1)
_LOW_ROOT32, _CELLS32, _LEAST32 = np.float32(LOW_ROOT), np.float32(_PER_ROOT), np.float32(-LEAST_NORMAL)


class CountTables(NamedTuple):
    """Hold the tables of approximate and exact counts.

    Attributes
    ----------
    lines : ndarray of uint64
        Approximate normals (`normal.Quantiles`).
    quadratics : ndarray of float64
        Exact normals.
    thresholds : ndarray of uint64, [64 * 64 + 1]
        Normal at which the count rises above k, as a line in √rate, by cell floor(16 √rate) and k.
    errors : ndarray of float32, [64]
        Largest error of the thresholds of a cell, and of the approximate normals.
    rows : ndarray of uint16, [64 * 208]
        First of the two thresholds to compare, by cell of √rate and cell floor(16 (z + 6.5)) of the normal.
    tails, cdf, first, smallest, largest, middle, guess : ndarray
        Columns of `reference.poisson.Tables`, contiguous.
    """

    lines: NDArray[np.uint64]
    quadratics: Float
    thresholds: NDArray[np.uint64]
    errors: Float32
    rows: NDArray[np.uint16]
    tails: Float
    cdf: Float
    first: NDArray[np.int64]
    smallest: NDArray[np.int64]
    largest: NDArray[np.int64]
    middle: Float
    guess: NDArray[np.int8]


@functools.lru_cache(maxsize=1)
def count_tables() -> CountTables:
    """Return the tables, computed once per process."""
    normal, exact = normal_quantiles(), poisson_tables()
    thresholds, errors, rows = _threshold_tables(normal.error)
    return CountTables(
        normal.lines, normal.quadratics, thresholds, errors, rows, exact.tails.ravel(), exact.cdf.ravel(), exact.first,
        exact.least, exact.most, exact.middle, exact.guess.ravel(),
    )  # fmt: skip


def _threshold_tables(normal_error: float) -> tuple[NDArray[np.uint64], Float32, NDArray[np.uint16]]:
    """Return `CountTables.thresholds`, ``errors`` and ``rows``.

    A threshold is a line through its values at both ends of a cell. Its error is estimated at three points between
    them, times 1.25. In the first cell, where thresholds tend to infinity, every normal above the lowest threshold is
    uncertain.
    """
    cells = LOW_ROOT * _PER_ROOT
    roots = np.arange(4 * cells + 1) / (4 * _PER_ROOT)
    at = np.stack([_thresholds(root) for root in roots])  # [4 * cells + 1, _ROW]
    points = np.stack([at[step : step + 4 * cells : 4] for step in range(5)])  # [5, cells, _ROW]
    start, end = points[0], points[4]
    slope = (end - start) * _PER_ROOT
    intercept = start - slope * (np.arange(cells) / _PER_ROOT)[:, None]
    line = np.stack([start + (end - start) * (step / 4) for step in range(5)])
    needed = np.abs(points).min(axis=0) < -LEAST_NORMAL
    margin = normal_error + 4e-6  # the second term for the rounding of lines in float32
    error = 1.25 * np.where(needed, np.abs(points - line).max(axis=0), 0).max(axis=1) + margin
    error[0] = _FARTHEST + margin
    intercept[0], slope[0] = end[0] + _FARTHEST, 0
    lowest, highest = points.min(axis=0) - error[:, None], points.max(axis=0) + error[:, None]
    lowest[0], highest[0] = end[0] - margin, np.inf
    edges = np.arange(_BUCKETS) / _PER_NORMAL + LEAST_NORMAL
    least = (highest[:, None, :] < edges[None, :, None]).sum(axis=2)
    following = np.minimum(least + 2, _ROW - 1)
    third = np.take_along_axis(lowest, following, axis=1)
    least = np.where((third > edges + 1 / _PER_NORMAL) & (least < _NEVER - 1), least, _NEVER)
    intercept[:, _NEVER] = np.nan
    intercept = np.pad(intercept.astype(np.float32).ravel(), (0, 1), constant_values=np.nan)
    return (
        pack_lines(intercept, np.pad(slope.astype(np.float32).ravel(), (0, 1))),
        error.astype(np.float32),
        (least + _ROW * np.arange(cells)[:, None]).astype(np.uint16).ravel(),
    )


def _thresholds(root: float) -> Float:
    """Return the normals at which the count rises above k = 0, 1, …, `_ROW` - 1, at most `_FARTHEST` in magnitude."""
    rate = root * root
    with np.errstate(under="ignore"):
        shares = np.cumprod(np.concatenate([[float((-Decimal(rate)).exp())], rate / np.arange(1, 2 * _ROW)]))
    below, above = np.cumsum(shares), np.cumsum(shares[::-1])[::-1] - shares
    inverse = NormalDist().inv_cdf
    thresholds = [
        (-inverse(max(up, 1e-300)) if up < down else inverse(max(down, 1e-300)))
        for up, down in zip(above[:_ROW], below[:_ROW], strict=True)
    ]
    return np.clip(thresholds, -_FARTHEST, _FARTHEST)


# ------------------------------------------------------------------------------------------------------------ all sites


class Rates(NamedTuple):
    """Point to mean counts, and to what approximations need of them."""

    rates: Pointer  # float64
    rounded: Pointer  # float32
    residual: Pointer  # rates - rounded, float32
    root: Pointer
    inverse: Pointer  # 1 / root


@inner
def fill_counts(
    count: int,
    words: Pointer,
    rates: Rates,
    root_range: tuple[np.float32, np.float32],
    tables: CountTables,
    workspace: Workspace,
    out: Pointer,
) -> None:
    """Fill ``out`` (float32) with the Poisson counts of ``words``.

    Sites whose root is outside ``root_range`` get a normal deviate of the same mean and variance, not rounded.
    """
    normals, found = workspace.normals, 0
    fill_values_by_lines(count, words, tables.lines, workspace.lines, normals)
    has_low, has_high, is_counted = _survey(count, rates.root, root_range)
    if not is_counted:
        _fill_normal_counts(count, rates, normals, out)
        return
    if has_low:
        found = _count_by_thresholds(count, rates, root_range, tables, workspace, out)
    if has_high:
        found = _count_by_expansion(count, rates, root_range, found, workspace, out)
    for n in range(found):
        x = workspace.uncertain[n]
        out[x] = np.float32(exact_count(words[x], rates.rates[x], tables))


@inner
def _survey(count: int, root: Pointer, root_range: tuple[np.float32, np.float32]) -> tuple[bool, bool, bool]:
    """Return whether any root is below `LOW_ROOT`, whether any is not, and whether any is within ``root_range``."""
    lowest = highest = load(root, np.uint64(0))
    within = less_than(lowest, lowest)
    for n in range(count // VECTOR_WIDTH):
        r = load(root, np.uint64(n) * _8)
        lowest, highest = minimum(r, lowest), maximum(r, highest)
        within = within | (less_than(root_range[0], r) & less_than(r, root_range[1]))
    is_low, all_low = movemask(less_than(lowest, _LOW_ROOT32)), movemask(less_than(highest, _LOW_ROOT32))
    return bool(is_low != 0), bool(all_low != np.uint32(255)), bool(movemask(within) != 0)


@inner
def _fill_normal_counts(count: int, rates: Rates, normals: Pointer, out: Pointer) -> None:
    """Fill ``out`` with normals of the same mean and variance."""
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        store(out, x, load(rates.rounded, x) + (load(rates.residual, x) + load(rates.root, x) * load(normals, x)))


@inner
def _count_by_thresholds(
    count: int,
    rates: Rates,
    root_range: tuple[np.float32, np.float32],
    tables: CountTables,
    workspace: Workspace,
    out: Pointer,
) -> int:
    """Fill ``out`` with the counts of rates below `LOW_ROOT`² and list uncertain sites; return how many.

    Loads in one loop and arithmetic in others, which vectorise.
    """
    low, high = root_range[0], min(root_range[1], _LOW_ROOT32)
    normals, rows, first, second = workspace.normals, workspace.scratch, workspace.lines, workspace.more_lines
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        root = minimum(maximum(load(rates.root, x), _0F), _LAST_ROOT32)
        bucket = to_uint32((load(normals, x) + _LEAST32) * _CELLS32)
        store(rows, x, to_uint32(root * _CELLS32) * np.uint32(_BUCKETS) + bucket)
    for at in range(count):
        row = np.uint64(tables.rows[rows[at]])
        first[at], second[at] = tables.thresholds[row], tables.thresholds[row + _1]
        rows[at], workspace.errors[at] = np.uint32(row), tables.errors[row >> _6]
    found = 0
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        root, z, error = load(rates.root, x), load(normals, x), load(workspace.errors, x)
        above0, above1 = _above(first, x, root, z), _above(second, x, root, z)
        one0, one1 = less_than(_0F, above0) & _ONE_BITS32, less_than(_0F, above1) & _ONE_BITS32
        counted = to_float32(load(rows, x) & _K_BITS) + (from_bits(one0) + from_bits(one1))
        normal = load(rates.rounded, x) + (load(rates.residual, x) + root * z)
        is_counted = less_than(low, root) & less_than(root, high)
        store(out, x, select(is_counted, counted, normal))
        is_sure = less_than(error, absolute(above0)) & less_than(error, absolute(above1))
        found = list_lanes(is_counted & (is_sure ^ _EVERY_BIT), x, found, workspace)
    return found


@inner
def _above(lines: Pointer, x: np.uint64, root: Vector, z: Vector) -> Vector:
    """Return how far normals are above eight packed thresholds (`normal.pack_lines`)."""
    packed = load(lines, x)
    start, slope = from_bits(low_half(packed)), from_bits(low_half(packed >> _32))
    distance: Vector = z - (start + slope * root)
    return distance


@inner
def _count_by_expansion(
    count: int,
    rates: Rates,
    root_range: tuple[np.float32, np.float32],
    found: int,
    workspace: Workspace,
    out: Pointer,
) -> int:
    """Fill ``out`` with the counts of rates from `LOW_ROOT`² up and append uncertain sites; return the length."""
    low, high = root_range
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        root, inverse, z = load(rates.root, x), load(rates.inverse, x), load(workspace.normals, x)
        normal = load(rates.residual, x) + root * z
        value = normal + _short_rest(inverse, z)
        rounded = (value + ROUND32) - ROUND32
        one = from_bits(less_than(value, rounded) & _ONE_BITS32)
        i2 = inverse * inverse
        error = (root + _8F) * _NORMAL_ERROR + i2 * ((i2 * i2) * _LOW_ERROR + _ERROR)
        distance = absolute(value - rounded)
        far = less_than(_REACH, absolute(z))
        is_counted = less_than(low, root) & less_than(root, high)
        is_low = less_than(root, _LOW_ROOT32)
        counted = load(rates.rounded, x) + select(is_counted, rounded - one, normal)
        store(out, x, select(is_low, load(out, x), counted))
        open_lanes = (less_than(distance, error) | far) & is_counted
        found = list_lanes(select(is_low, open_lanes ^ open_lanes, open_lanes), x, found, workspace)
    return found


@inner
def _short_rest(inverse: Vector, z: Vector) -> Vector:
    """Return w²·A(s) + B(s) with the first terms of both, in float32."""
    s = z * inverse
    s2 = s * s
    a = (s * _A1 + _A0) + s2 * ((s * _A3 + _A2) + s2 * _A4)
    b = (s * _B1 + _B0) + s2 * (s * _B3 + _B2)
    rest: Vector = z * z * a + b
    return rest


# ------------------------------------------------------------------------------------------------------ uncertain sites


@inner
def exact_count(word: np.uint32, rate: float, tables: CountTables) -> float:
    """Return the count of a word, in the reference's order of operations."""
    if not rate > 0.0:
        return 0.0
    z = exact_value(word, tables.quadratics)
    if rate >= LIMIT:
        tail = (np.float64(word & np.uint32(0x7FFFFFFF)) + 0.5) * 2.0**-32
        w = _refine_normal(tail, abs(z), tables.tails)
        return float(np.floor(_expansion(rate, -w if np.uint64(word) & _SIGN else w)))
    return float(_count_by_cdf(word, rate, z, tables))


@inner
def _refine_normal(tail: float, z: float, tails: Pointer) -> float:
    """Return the upper normal quantile of ``tail`` by one Newton step from ``z``, in the reference's order."""
    cell = int(z * TAIL_CELLS)
    offset, at = z - (cell + 0.5) / TAIL_CELLS, cell * (ORDER + 1)
    value, slope = tails[at + ORDER], tails[at + ORDER] * ORDER
    for n in range(ORDER - 1, 0, -1):
        value = tails[at + n] + offset * value
        slope = tails[at + n] * n + offset * slope
    value = tails[at] + offset * value
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
    """Return the least k with P(K <= k) >= u: a guess that is at most one too low, then a comparison.

    In the first cell, where counts are almost always 0, the guess is 0 and more comparisons may follow.
    """
    root = np.sqrt(rate)
    cell = np.uint64(np.int64(root * RATE_CELLS))
    at = cell * np.uint64(_GUESSES) + np.uint64(np.int64((z - LEAST_NORMAL) * NORMAL_CELLS))
    k = np.int64(rate + root * z + tables.guess[at] * GUESS_UNIT + 0.5) - 1
    k = min(max(k, tables.smallest[cell]), tables.largest[cell]) if cell > 0 else np.int64(0)
    # rank of the word by its normal: invert the top bit, and the other bits too if it was 0
    bits = np.uint64(word)
    uniform = (np.float64(bits ^ (_SIGN | (((bits >> _31) - _1) & _LOW31))) + 0.5) * 2.0**-32
    row, offset = tables.first[cell] + k, rate - tables.middle[cell]
    if uniform > _cdf_at(tables.cdf, row, offset):
        k += 1
        while cell == 0 and uniform > _cdf_at(tables.cdf, k, offset):
            k += 1
    return float(k)


@inner
def _cdf_at(cdf: Pointer, row: int, offset: float) -> float:
    """Return P(K <= k) of a table row, ``offset`` from the middle of its cell, in the reference's order."""
    at = row * (ORDER + 1)
    total: float = cdf[at + ORDER]
    for n in range(ORDER - 1, -1, -1):
        total = cdf[at + n] + offset * total
    return total
