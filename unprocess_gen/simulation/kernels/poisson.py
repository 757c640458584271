"""Poisson counts by inversion: one counted 32-bit uniform, one count, coupled to the normal of the same word.

The count is the quantile of the word's own probability: the least k with P(K <= k) >= u. So it rises with the normal
that `effects.normals` makes of the word, and for every rate from 0 to 1e9 and every k, the share of all 2**32 words
that give k or less is P(K <= k) to within 2**-32: half a word from counting words, and errors below 1e-11 from here.

From 64 up (`LIMIT`), the count is floor(x), where x > 0 is the real number with Gamma(x, rate) / Gamma(x) = Phi(w)
(Giles, "Algorithm 955: approximation of the inverse Poisson cumulative distribution function", ACM TOMS 42(1), 2016).
With s = w / √rate,

    x = rate + √rate·w + w²·A(s) + B(s) + C(s) / rate + D(s) / rate² + E(s) / rate³,

the expansion of Giles and of Temme with all powers of s kept together, so that it holds into the tails; cut where it
costs 2e-12 of the distribution function at rate 64. A short form of it, of quick normals (`normals`) and in single
precision, is certain but within a thousandth or so of an integer, from 6 up (`SHORT_LEAST`; at 8 within a twentieth);
only there is the count made in full, from 64 up of w sharpened by a Newton step (1e-13).

Below 64 the full form compares the distribution function itself with u. It is tabulated for the middles of 81 cells of
√rate, each P(K <= k) with its seven derivatives in the rate (272 kB), which gives it to 6e-12 within the cell. One
comparison decides, since a guess from √rate and the normal, made exact to half a count by a small table, leaves two.

Both forms give the same counts; the tables are made of `decimal` and of single + - × ÷, in 0.05 s.

Measured, nanoseconds a value with its normal, AVX2, one thread of a busy machine, rows of 1024 words, rates spread
evenly in their logarithm: from 64 up 3.7 (5.6 by double precision), 4.0 from 20 to 64, 6.2 from 6 to 20, 16 below 6, 12
where all kinds are mixed at random; at 1e6, where one in a hundred is computed in full, 6.6, and at 1e9 40. The
reference takes 1500.
Tried and dropped: a test of each count as it comes instead of lists of those left open (21 where kinds are mixed: no
processor can predict it); helpers that take a row of a table (90: a view counts references); nine tables through a
function that is not inlined (75); signed indices, which may count from the end (19 below 64); counting up from 0 by
the recurrence of the shares (time grows with the rate, and exp(-rate) is needed first).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.types import Float
from unprocess_gen.simulation.kernels.normal import Quantiles, exact_normal, quick_normals
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

# ------------------------------------------------------------------------------------------------------------- tables


# ---------------------------------------------------------------------------------------------------------- reference


# ---------------------------------------------------------------------------------------------------------- fast form

_ROUND, _ROUND32 = 1.5 * 2.0**52, np.float32(1.5 * 2.0**23)
_LOW31, _SIGN = np.uint64(0x7FFFFFFF), np.uint64(0x80000000)
_1, _31 = np.uint64(1), np.uint64(31)
_0F, _1F, _8F = np.float32(0.0), np.float32(1.0), np.float32(8.0)
_A0, _A1, _A2, _A3, _A4 = (np.float32(a) for a in A[:5])
_B0, _B1, _B2, _B3 = (np.float32(b) for b in B[:4])
_LEAST, _REACH = np.float32(SHORT_LEAST), np.float32(SHORT_REACH)
_ERROR, _NORMAL_ERROR, _LOW_ERROR = (np.float32(e) for e in (SHORT_ERROR, NORMAL_ERROR, LOW_ERROR))
_POWERS = len(A)
_COEFFICIENTS = np.array([(*one, *(0.0,) * (_POWERS - len(one))) for one in (A, B, C, D, E)])
_LEAST_ROOT = np.float32(np.sqrt(SHORT_LEAST * 1.000001))
_OPEN, _CLOSED = np.float32(9.0), np.float32(-1.0)


class Counting(NamedTuple):
    """What a run of counts is made in. Python makes it: in a kernel each array takes a twentieth second to compile."""

    normals: NDArray[np.float32]
    pairs: NDArray[np.uint64]
    whole: Float  # the rate, rounded
    part: NDArray[np.float32]  # what it is more than that; then what the count is more
    rate: NDArray[np.float32]
    near: NDArray[np.float32]  # not negative: too near to an integer
    open: NDArray[np.uint8]
    eights: NDArray[np.uint64]  # the same, eight at a time
    listed: NDArray[np.int64]
    high: NDArray[np.int64]
    low: NDArray[np.int64]
    rows: NDArray[np.int64]
    offsets: Float


def room_for(count: int) -> Counting:
    """Return the room for runs of up to ``count`` counts, a multiple of 8."""
    normals, part, rate, near = np.zeros((4, count), dtype=np.float32)
    whole, offsets = np.zeros((2, count))
    listed, high, low, rows = np.zeros((4, count + 8), dtype=np.int64)
    pairs, flags = np.zeros(count, dtype=np.uint64), np.zeros(count + 8, dtype=np.uint8)
    eights = flags.view(np.uint64)
    return Counting(normals, pairs, whole, part, rate, near, flags, eights, listed, high, low, rows, offsets)


@inner
def draw(
    words: NDArray[np.uint32], rates: Float, normal: Quantiles, tables: Tables, room: Counting, out: Float
) -> None:
    """Fill ``out`` with what `poisson` gives, all ``[n]``.

    ``rates`` are means in counts up to 1e9 (the caller sees to that); ``out`` may not lie where they do.
    """
    count = out.shape[0]
    quick_normals(words, normal.lines, room.pairs, room.normals[:count])
    _short(rates, room, out)
    left = list_open(room.open, room.eights, count, room.listed)
    if left > 0:
        settle(words, rates, normal, tables, room, left, out)


@inner
def short_counts(
    part: NDArray[np.float32],
    root: NDArray[np.float32],
    inverse: NDArray[np.float32],
    normals: NDArray[np.float32],
    reach: tuple[np.float32, np.float32],
    whole: NDArray[np.float32],
    near: NDArray[np.float32],
) -> None:
    """Do `_short` of rates that are 0 at least, in single precision; flagged where ``near`` is not negative.

    A rate is ``whole`` (an integer, replaced by the count), ``part``, its ``root`` and the root's ``inverse``. Where
    the root does not lie within ``reach``, a normal, not rounded, stands for the count. Overwrites ``part``.
    """
    low, high = reach
    # Three loops, and every choice one between two values that are there: of more arrays at once, or of branches, LLVM
    # makes scalar code, which takes twice the time.
    for n in range(part.shape[0]):
        z = normals[n]
        s = z * inverse[n]
        s2 = s * s
        a = (_A0 + s * _A1) + s2 * ((_A2 + s * _A3) + s2 * _A4)
        b = (_B0 + s * _B1) + s2 * (_B2 + s * _B3)
        near[n] = (part[n] + root[n] * z) + (z * z * a + b)
        part[n] = part[n] + root[n] * z
    for n in range(part.shape[0]):
        x, i2 = near[n], inverse[n] * inverse[n]
        rounded = (x + _ROUND32) - _ROUND32
        error = _NORMAL_ERROR * (_8F + root[n]) + i2 * (_ERROR + _LOW_ERROR * (i2 * i2))
        error = error if abs(normals[n]) < _REACH else _OPEN
        quick = error - abs(x - rounded)
        quick = quick if root[n] >= _LEAST_ROOT else _OPEN  # of the lowest rates x may be no number
        quick = quick if root[n] > low else _CLOSED
        near[n] = quick if root[n] < high else _CLOSED
        one = _1F if rounded > x else _0F
        count = rounded - one
        count = count if root[n] > low else part[n]
        part[n] = count if root[n] < high else part[n]
    for n in range(part.shape[0]):
        whole[n] = whole[n] + part[n]


@inner
def all_near_normal(root: NDArray[np.float32], reach: tuple[np.float32, np.float32]) -> bool:
    """Whether no root of a rate lies within ``reach``."""
    low, high = reach
    within = np.int32(0)
    for n in range(root.shape[0]):
        within = np.int32(within + (root[n] > low and root[n] < high))
    return bool(within == 0)


@inner
def normal_counts(
    part: NDArray[np.float32],
    root: NDArray[np.float32],
    normals: NDArray[np.float32],
    whole: NDArray[np.float32],
) -> None:
    """Do `short_counts` by normals alone, not rounded."""
    for n in range(part.shape[0]):
        whole[n] = whole[n] + (part[n] + root[n] * normals[n])


@inner
def flag(near: NDArray[np.float32], count: int, open_ones: NDArray[np.uint8]) -> None:
    """Flag which of ``near`` are not negative."""
    for n in range(count):
        open_ones[n] = near[n] >= _0F


@inner
def settle(
    words: NDArray[np.uint32],
    rates: Float,
    normal: Quantiles,
    tables: Tables,
    room: Counting,
    left: int,
    out: Float | NDArray[np.float32],
) -> None:
    """Make the first ``left`` counts that are listed as open; ``room`` holds the quick normals."""
    highs, lows = _by_side(rates, room.listed, left, room.high, room.low)
    if highs > 0:
        _by_exact_normal(words, rates, normal.quadratics, tables.tails, room.high[:highs], out)
    if lows > 0:
        low, rows, offsets = room.low[:lows], room.rows, room.offsets
        cells = (tables.first, tables.least, tables.most, tables.middle)
        _guess(rates, room.normals, cells, tables.guess, low, rows, offsets, out)
        _compare(words, tables.cdf, low, rows, offsets, out)


@inner
def _short(rates: Float, room: Counting, out: Float) -> None:
    """Fill ``out`` with floor(x) by the short form, and flag where that is not certain; no branches.

    In single precision, of which the rate as a whole number is kept out. No light is certain to give none.
    """
    normals, whole, part, single, near = room.normals, room.whole, room.part, room.rate, room.near
    for n in range(out.shape[0]):
        whole[n] = (rates[n] + _ROUND) - _ROUND
        part[n] = np.float32(rates[n] - whole[n])
        single[n] = np.float32(rates[n])
    for n in range(out.shape[0]):
        rate, z = single[n], normals[n]
        root = np.sqrt(max(rate, _LEAST))
        inverse = _1F / root
        s = z * inverse
        s2, i2 = s * s, inverse * inverse
        a = (_A0 + s * _A1) + s2 * ((_A2 + s * _A3) + s2 * _A4)
        b = (_B0 + s * _B1) + s2 * (_B2 + s * _B3)
        x = (part[n] + root * z) + (z * z * a + b)
        error = _NORMAL_ERROR * (_8F + root) + i2 * (_ERROR + _LOW_ERROR * (i2 * i2))
        error = error if abs(z) < _REACH else _OPEN
        error = error if rate >= _LEAST else _OPEN
        error = error if rate > _0F else _CLOSED
        rounded = (x + _ROUND32) - _ROUND32
        near[n] = error - abs(x - rounded)
        part[n] = rounded - (_1F if rounded > x else _0F)
    flag(near, out.shape[0], room.open)
    for n in range(out.shape[0]):
        out[n] = whole[n] + np.float64(part[n]) if single[n] > _0F else 0.0


@inner
def list_open(open_ones: NDArray[np.uint8], eights: NDArray[np.uint64], count: int, listed: NDArray[np.int64]) -> int:
    """List which of the first ``count`` flags are set, and return how many; eight stand together in ``eights``."""
    open_ones[count : count + 8] = 0
    left = 0
    for eight in range((count + 7) // 8):
        if eights[eight] != 0:
            for n in range(8 * eight, 8 * eight + 8):
                listed[left] = n
                left += open_ones[n]
    return left


@inner
def _by_side(
    rates: Float, listed: NDArray[np.int64], left: int, high: NDArray[np.int64], low: NDArray[np.int64]
) -> tuple[int, int]:
    """Part what is listed by the side of `LIMIT` that its rate is on."""
    highs, lows = 0, 0
    for m in range(left):
        n = listed[m]
        high[highs] = low[lows] = n
        highs += rates[n] >= LIMIT
        lows = m + 1 - highs
    return highs, lows


@inner
def _by_exact_normal(
    words: NDArray[np.uint32],
    rates: Float,
    quadratics: tuple[Float, Float, Float],
    tails: Float,
    high: NDArray[np.int64],
    out: Float,
) -> None:
    """Fill in the counts listed in ``high``, in the order of the reference."""
    for n in high:
        tail = (np.float64(words[n] & _LOW31) + 0.5) * 2.0**-32
        z = exact_normal(words[n], quadratics)
        w = _sharpened(tail, abs(z), tails)
        out[n] = np.floor(_x(rates[n], -w if words[n] & _SIGN else w))


@inner
def _sharpened(tail: float, z: float, tails: Float) -> float:
    """Return the upper quantile of ``tail`` by a Newton step from z, in the order of the reference."""
    cell = int(z * TAIL_CELLS)
    offset = z - (cell + 0.5) / TAIL_CELLS
    value, slope = tails[cell, ORDER], tails[cell, ORDER] * ORDER
    for n in range(ORDER - 1, 0, -1):
        value = tails[cell, n] + offset * value
        slope = tails[cell, n] * n + offset * slope
    value = tails[cell, 0] + offset * value
    return float(z - (value - tail) / slope)


@inner
def _x(rate: float, w: float) -> float:
    """Return x, in the order of `expansion`."""
    root = np.sqrt(rate)
    s = w / root
    # Not plain numbers, for each of which Numba would compile a function.
    a, b, c = _power_sum(np.int64(0), s), _power_sum(np.int64(1), s), _power_sum(np.int64(2), s)
    d, e = _power_sum(np.int64(3), s), _power_sum(np.int64(4), s)
    rest = w * w * a + (b + (c + (d + e / rate) / rate) / rate)
    return float(rate + (root * w + rest))


@inner
def _power_sum(which: int, s: float) -> float:
    total = 0.0  # powers that a sum lacks have coefficients of 0, which change no bit
    for n in range(_POWERS - 1, -1, -1):
        total = _COEFFICIENTS[which, n] + s * total
    return total


@inner
def _guess(
    rates: Float,
    normals: NDArray[np.float32],
    cells: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Float],
    guess: NDArray[np.int8],
    low: NDArray[np.int64],
    rows: NDArray[np.int64],
    offsets: Float,
    out: Float,
) -> None:
    """Guess the counts listed in ``low`` to one too few, and find their rows of `Tables.cdf`.

    In the first cell the guess is not that near, and the count is 0 nearly always: there it is 0.
    """
    first, least, most, middle = cells
    for m in range(low.shape[0]):
        n = np.uint64(low[m])
        rate, z = rates[n], np.float64(normals[n])
        root = np.sqrt(rate)
        cell = np.uint64(np.int64(root * RATE_CELLS))  # unsigned: no index counts from the end
        beyond = guess[cell, np.uint64(np.int64((z - LEAST_NORMAL) * NORMAL_CELLS))] * GUESS_UNIT
        k = (np.int64(rate + root * z + beyond + 0.5) - 1) * np.int64(cell > 0)
        k = min(max(k, least[cell]), most[cell])
        rows[m], offsets[m] = first[cell] + k, rate - middle[cell]
        out[n] = k


@inner
def _compare(
    words: NDArray[np.uint32],
    cdf: Float,
    low: NDArray[np.int64],
    rows: NDArray[np.int64],
    offsets: Float,
    out: Float,
) -> None:
    """Add 1 where the guess was one too few; in the first cell, whose row is 0, add as much as it takes."""
    for m in range(low.shape[0]):
        n, row, offset = np.uint64(low[m]), np.uint64(rows[m]), offsets[m]
        # The word's rank by its normal: turned top bit, and the others too where that was 0; no branch to mispredict.
        word = np.uint64(words[n])
        rank = word ^ (_SIGN | (((word >> _31) - _1) & _LOW31))
        uniform = (np.float64(rank) + 0.5) * 2.0**-32
        over = np.int64(uniform > _at_most(cdf, row, offset))
        if row == 0 and over > 0:
            while uniform > _at_most(cdf, np.uint64(over), offset):
                over += 1
        out[n] += over


@inner
def _at_most(cdf: Float, row: int, offset: float) -> float:
    """Return P(K <= k) of a row, in the order of the reference."""
    total: float = cdf[row, ORDER]
    for n in range(ORDER - 1, -1, -1):
        total = cdf[row, n] + offset * total
    return total
