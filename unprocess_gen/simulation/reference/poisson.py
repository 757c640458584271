"""Draw Poisson counts by inverting the distribution function of 32-bit random words (NumPy reference).

A count is the smallest k with P(K <= k) >= u for the probability u of its word. It increases with the normal deviate
that `noise.normals` computes from the same word. For all rates up to 1e9, the fraction of words that give k or less is
P(K <= k) to within 2**-32. `kernels.poisson` computes the same counts.

From rate 64 (`LIMIT`), the count is floor(x) with Γ(x, rate) / Γ(x) = Φ(w) for the normal deviate w (Giles, "Algorithm
955: approximation of the inverse Poisson cumulative distribution function", ACM TOMS 42(1), 2016). With s = w / √rate,

    x = rate + √rate·w + w²·A(s) + B(s) + C(s) / rate + D(s) / rate² + E(s) / rate³.

This is the expansion of Giles and of Temme, ordered by powers of s, so that it holds in the tails. The truncation error
is 2e-12 of the distribution function at rate 64.

Below 64, the count comes from tables of P(K <= k): 81 cells of √rate, each with seven derivatives in the rate. Their
error is at most 6e-12. Tables are computed with `decimal` and single operations + - × ÷, in 0.05 s.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from decimal import Decimal, localcontext
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.exact_distributions import DIGITS, normal_cdf, normal_density
from unprocess_gen.core.random_streams import Words
from unprocess_gen.simulation.lookup_tables import sha256
from unprocess_gen.simulation.reference.noise import normals

LIMIT = 64.0
"""Smallest rate for which counts are computed by the expansion."""


TABLES_SHA256 = "c928d1d632cfd8f69d4ed02bca71681d1ef1124be3140089f2529a881334b0b2"
"""SHA-256 of all tables (`digest`)."""


# Coefficients of the expansion, lowest power of s first. A wrong one breaks the distribution, which tests compare.
A = (
    *(1 / 6, -1 / 72, 1 / 270, -23 / 17280, 19 / 34020, -11237 / 43545600, 13 / 102060, -2482411 / 37623398400),
    *(53741 / 1515591000, -272785979 / 13905608048640, 51173 / 4605822000),
)

B = (
    *(1 / 3, -1 / 36, 7 / 810, -137 / 38880, 5 / 3024, -165779 / 195955200, 301 / 656100, -1219369 / 4702924800),
    *(32976641 / 218245104000, -84622554329 / 938628543283200),
)

C = (
    *(-8 / 405, 671 / 38880, -5189 / 408240, 2647909 / 293932800, -9683 / 1530900, 834145 / 188116992),
    *(-678871967 / 218245104000, 14645993203 / 6704489594880, -19607719333 / 12767338584000),
)

D = (
    *(-16 / 25515, 274867 / 146966400, -39281 / 13778100, 5006651 / 1511654400, -4372075159 / 1309470624000),
    362985384281 / 117328567910400,
)

E = (5408 / 3444525, -18075959 / 4232632320, 27968607743 / 3928411872000, -9969287490329 / 1055957111193600)

TAIL_CELLS = 8
"""Cells of the normal tail table per standard deviation."""

LAST_TAIL_CELL = 51

ORDER = 7
"""Degree of the polynomials in the tables of distribution functions."""

RATE_CELLS = 10
"""Cells per unit of √rate; a rate is within a tenth of its standard deviation of the centre of its cell."""

CELLS = int(8 * RATE_CELLS) + 1
"""Number of cells; the last one serves √rate that rounds up to 8."""

MOST = 128
"""Upper bound of all counts for rates below `LIMIT`."""


class Tables(NamedTuple):
    """Tables for Poisson counts, read-only.

    Attributes
    ----------
    tails : ndarray of float64, [52, 8]
        Upper normal tail at z: polynomial of row floor(8 z) in z minus the centre of the cell.
    cdf : ndarray of float64, [N, 8]
        P(K <= k): polynomial of row ``first[c] + k`` in the rate minus ``middle[c]``, for cell c = floor(10 √rate) and
        k from ``least[c]`` to ``most[c]``. The probability of other counts is below 2**-34.
    first, least, most : ndarray of int64, [81]
        Row offset, smallest k and largest k of each cell.
    middle : ndarray of float64, [81]
        Rate at the centre of each cell.
    """

    tails: Float
    cdf: Float
    first: NDArray[np.int64]
    least: NDArray[np.int64]
    most: NDArray[np.int64]
    middle: Float


@functools.lru_cache(maxsize=1)
def poisson_tables() -> Tables:
    """Compute the read-only tables once per process; MachineError if they do not have the published SHA-256."""
    root = (2 * np.arange(CELLS) + 1) / (2 * RATE_CELLS)
    middle = root * root
    polynomials = _cdf_polynomials(middle)
    least, most = _range(middle, polynomials)
    counts = np.arange(MOST)
    kept = (counts >= least[:, None]) & (counts <= most[:, None])
    ends = np.cumsum(most - least + 1)
    first = ends - most - 1
    tables = Tables(_tails(), polynomials[kept], first, least, most, middle)
    if (actual := digest(tables)) != TABLES_SHA256:
        raise MachineError(f"the Poisson tables have SHA-256 {actual}; expected {TABLES_SHA256}; use another Python")
    for table in tables:
        table.flags.writeable = False
    return tables


def digest(tables: Tables) -> str:
    """Return the SHA-256 of all tables, concatenated as little-endian float64."""
    return sha256(np.concatenate([table.ravel().astype(np.float64) for table in tables]))


def _tails() -> Float:
    """Return `Tables.tails`, correctly rounded; the derivatives are Hermite polynomials times the density."""
    rows = []
    with localcontext(prec=DIGITS):
        for cell in range(LAST_TAIL_CELL + 1):
            z = (Decimal(cell) + Decimal("0.5")) / TAIL_CELLS
            term, before = -normal_density(z), Decimal(0)  # -φ·He_n / (n + 1)! for n = 0, up to the sign
            row = [1 - normal_cdf(z), term]
            for n in range(1, ORDER):  # He_n = z·He_(n-1) - (n - 1)·He_(n-2); each derivative changes the sign
                term, before = -(z * term + before * (n - 1) / n) / (n + 1), term
                row.append(term)
            rows.append([float(value) for value in row])
    return np.array(rows)


def _cdf_polynomials(middle: Float) -> Float:
    """Return P(K <= k) and its derivatives in the rate, divided by n!, at each centre, [CELLS, MOST, 8].

    The derivative of P(K <= k) is -P(K = k); the derivative of P(K = k) is P(K = k - 1) - P(K = k).
    """
    with localcontext(prec=DIGITS):
        none = np.array([float((-Decimal(float(rate))).exp()) for rate in middle])
    share = np.zeros((CELLS, MOST))
    share[:, 0] = none
    for k in range(1, MOST):  # drop negligible terms, which would underflow
        share[:, k] = np.where(share[:, k - 1] > 1e-60, share[:, k - 1], 0) * middle / k
    terms = [np.cumsum(share, axis=1), -share]
    for n in range(2, ORDER + 1):
        before = np.pad(terms[-1][:, :-1], ((0, 0), (1, 0)))
        terms.append((before - terms[-1]) / n)
    return np.stack(terms, axis=-1)


def _range(middle: Float, polynomials: Float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return for each cell the smallest and the largest k that any rate in the cell needs."""
    root = np.arange(CELLS + 1) / RATE_CELLS
    edge = root * root
    at_lowest = _horner(polynomials, (edge[:-1] - middle)[:, None])
    at_highest = _horner(polynomials, (edge[1:] - middle)[:, None])
    least = np.maximum((at_lowest < 2.0**-34).sum(axis=1) - 1, 0)
    most = (1 - at_highest > 2.0**-34).sum(axis=1)
    return least, most


def poisson(words: Words, rate: Float) -> Float:
    """Convert random words to Poisson counts.

    Parameters
    ----------
    words : ndarray of uint32
        Random words, any shape.
    rate : ndarray of float64
        Means in counts, at most 1e9 (not checked), of the same shape. Rates that are 0, negative or NaN give 0.

    Returns
    -------
    ndarray of float64
        Counts, same shape.
    """
    high = rate >= LIMIT
    low = (rate > 0) & ~high
    counts = np.zeros(words.shape)
    counts[high] = _by_expansion(words[high], rate[high])
    counts[low] = _by_cdf(words[low], rate[low])
    return counts


def _tail(words: Words) -> Float:
    """Return the tail probability of each word: (i + ½) / 2**32 for its lower 31 bits i."""
    return np.asarray(((words & np.uint32(0x7FFFFFFF)).astype(np.float64) + 0.5) * 2.0**-32)


def _by_expansion(words: Words, rate: Float) -> Float:
    """Return floor(x) for rates from `LIMIT`; a step of Newton's method refines the normal of each word."""
    is_low, z = words >> np.uint32(31) == 1, normals(words)
    z = np.where(is_low, -z, z)
    cell = np.floor(z * TAIL_CELLS)
    row = poisson_tables().tails[cell.astype(np.int64)]
    offset = z - (cell + 0.5) / TAIL_CELLS
    slope = _horner(row[..., 1:] * np.arange(1, ORDER + 1), offset)
    z = z - (_horner(row, offset) - _tail(words)) / slope
    return np.asarray(np.floor(expansion(rate, np.where(is_low, -z, z))))


def expansion(rate: Float, w: Float) -> Float:
    """Return x of the module's docstring, for rates from `LIMIT` and normal deviates of at most 6.34."""
    root = np.sqrt(rate)
    s = w / root
    c, d, e = _powers(C, s), _powers(D, s), _powers(E, s)
    rest = w * w * _powers(A, s) + (_powers(B, s) + (c + (d + e / rate) / rate) / rate)
    return np.asarray(rate + (root * w + rest))


def _powers(coefficients: Sequence[float], s: Float) -> Float:
    """Evaluate a polynomial in s, coefficients from the lowest power."""
    total = np.full_like(s, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = coefficient + s * total
    return total


def _horner(rows: Float, offset: Float) -> Float:
    """Evaluate polynomials whose coefficients are along the last axis, from the lowest power."""
    total = rows[..., -1]
    for n in range(rows.shape[-1] - 2, -1, -1):
        total = rows[..., n] + offset * total
    return np.asarray(total)


def _by_cdf(words: Words, rate: Float) -> Float:
    """Return the smallest k with P(K <= k) >= the probability of a word for rates in (0, `LIMIT`), by bisection."""
    tables, tail = poisson_tables(), _tail(words)
    uniform = np.where(words >> np.uint32(31), tail, 1 - tail)
    cell = np.floor(np.sqrt(rate) * RATE_CELLS).astype(np.int64)
    low, high = tables.least[cell], tables.most[cell] + 1
    for _ in range(MOST.bit_length()):
        k = np.minimum((low + high) // 2, tables.most[cell])
        above = uniform > _horner(tables.cdf[tables.first[cell] + k], rate - tables.middle[cell])
        low, high = np.where(above & (low < high), k + 1, low), np.where(above, high, np.minimum(high, k))
    return np.asarray(low, dtype=np.float64)
