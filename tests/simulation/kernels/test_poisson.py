"""Poisson counts follow their distribution to one word in 2**32 at every rate; kernels equal the reference."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable

import mpmath
import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.kernels import approximate_counts, counts_of_one_rate, exact_counts
from helpers.kernels import counts as fast
from helpers.promise_report import Figure

from unprocess_gen.core.errors import MachineError
from unprocess_gen.simulation.kernels.poisson import (
    FLOAT32_RATE,
    MAX_THRESHOLD_RATE,
    count_thresholds,
)
from unprocess_gen.simulation.reference import poisson as poissons
from unprocess_gen.simulation.reference.poisson import LIMIT, poisson, poisson_tables

WORDS = 2**32
SIGN = 2**31

SMALL = (1e-12, 1e-9, 1e-6, 1e-3, 0.00999999, 0.01, 0.0400001, 0.3, 1.0, 3.7, 12.5, 30.25, 50.0, 63.99)
BIG = (100.0, 1e3, 12345.678, 1e5, 1e6, 1e7, 1e9)
PROFILE_RANGES = (*SMALL, math.nextafter(LIMIT, 0), LIMIT, math.nextafter(LIMIT, 99), *BIG)

Draw = Callable[[np.ndarray, np.ndarray], np.ndarray]


def word(rank: np.ndarray) -> np.ndarray:
    """Return the word whose normal is the ``rank``-th of all, counted from the smallest."""
    rank = np.asarray(rank, dtype=np.int64)
    return np.where(rank < SIGN, rank | SIGN, WORDS - 1 - rank).astype(np.uint32)


def random_rates(count: int, seed: int) -> np.ndarray:
    """Return rates of all magnitudes: uniform in their logarithm, in the square root below 64, and around the limit."""
    uniform = np.random.default_rng(seed).random((3, count // 3))
    return np.concatenate([10 ** (21 * uniform[0] - 12), (8.1 * uniform[1]) ** 2, 50 + 150 * uniform[2]])


# The law --------------------------------------------------------------------------------------------------------------


@functools.cache
def law(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the counts k that matter at this rate and P(K <= k), to 1e-12.

    The probability of the mode comes from `mpmath`. Others follow from their neighbour by the factor k / rate, until
    they are below 1e-18 of it; they are summed from both ends.
    """
    mode = math.floor(rate)
    width = math.ceil(9 * math.sqrt(rate) + 20)
    with mpmath.workdps(40):
        mean = mpmath.mpf(rate)
        top = float(mpmath.exp(mode * mpmath.log(mean) - mean - mpmath.loggamma(mode + 1)))
    with np.errstate(under="ignore"):
        up = top * np.cumprod(rate / np.arange(mode + 1, mode + width + 1))
        down = top * np.cumprod(np.arange(mode, max(mode - width, 0), -1) / rate)
    share = np.concatenate([down[::-1], [top], up])
    counts = np.arange(mode - len(down), mode + width + 1)
    from_below = np.cumsum(share)
    from_above = 1 - (np.cumsum(share[::-1])[::-1] - share)
    return counts, np.where(counts < mode, from_below, from_above)


def words_up_to(counts: np.ndarray, rate: np.ndarray, drawn: Draw) -> np.ndarray:
    """Return how many of all 2**32 words give ``counts`` or less, by bisection: counts increase with the rank."""
    low, high = np.zeros(counts.shape, dtype=np.int64), np.full(counts.shape, WORDS)
    while (low < high).any():
        middle = np.minimum((low + high) // 2, WORDS - 1)
        up = drawn(word(middle), rate) <= counts
        low, high = np.where(up & (low < high), middle + 1, low), np.where(up, high, np.minimum(high, middle))
    return low


def error_in_words(rate: float, drawn: Draw = fast, most: int = 400) -> np.ndarray:
    """Return the words that give k or less minus their expected number, for up to ``most`` counts between the tails."""
    counts, cdf = law(rate)
    chosen = np.unique(np.linspace(0, len(counts) - 1, most).astype(np.int64))
    found = words_up_to(counts[chosen], np.full(len(chosen), rate), drawn)
    return np.asarray(found - cdf[chosen] * WORDS)


LEAST_ERROR, COMPUTED_ERROR = 0.5, 0.05
"""Integer words approximate a distribution function to half a word; computing adds a twentieth, 1e-11."""


@pytest.mark.parametrize("rate", slow_except((1e-3, 3.7, 63.99, LIMIT, 1e5), PROFILE_RANGES))
def test_counts_follow_the_distribution_to_one_word(rate: float, figure: Figure) -> None:
    """The promise is one word in 2**32. The error is little more than half a word, the smallest possible."""
    error = np.abs(error_in_words(rate)).max()
    assert error <= LEAST_ERROR + COMPUTED_ERROR
    figure("poisson", f"at most {error:.2f} of 2^32 words off")


def test_the_distribution_holds_at_the_ends_of_every_cell() -> None:
    for cell, inside in itertools.product(range(80), (1e-9, 1 - 1e-9)):
        rate = ((cell + inside) / 10) ** 2
        assert np.abs(error_in_words(rate, most=150)).max() <= LEAST_ERROR + COMPUTED_ERROR, rate


@pytest.mark.parametrize("count", [180, pytest.param(6000, marks=pytest.mark.slow)])
def test_the_distribution_holds_at_random_rates(count: int, figure: Figure) -> None:
    errors = []
    for rate in random_rates(count, seed=2):
        errors.append(np.abs(error_in_words(min(float(rate), 1e7), most=150)).max())
        assert errors[-1] <= LEAST_ERROR + COMPUTED_ERROR, rate
    figure("poisson", f"{len(errors)} random rates: at most {max(errors):.2f} of 2^32 words off")


# Order and coupling ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", slow_except((1e-3, 3.7, 63.99, LIMIT, 1e5), PROFILE_RANGES))
def test_counts_increase_with_the_words_normal(rate: float) -> None:
    """Words are tested where the count changes, in both tails, and at random."""
    counts, _ = law(rate)
    chosen = counts[np.unique(np.linspace(0, len(counts) - 1, 100).astype(np.int64))]
    edges = words_up_to(chosen, np.full(len(chosen), rate), fast)
    rank = np.concatenate([(edges[:, None] + np.arange(-20, 21)).ravel(), np.arange(200), WORDS - 1 - np.arange(200)])
    rank = np.concatenate([rank, np.random.default_rng(3).integers(0, WORDS, 20_000)])
    rank = np.unique(np.clip(rank, 0, WORDS - 1))
    for drawn in (fast, poisson):
        assert (np.diff(drawn(word(rank), np.full(rank.shape, rate))) >= 0).all()


def test_a_larger_rate_never_gives_a_smaller_count() -> None:
    words = np.repeat(np.random.default_rng(5).integers(0, WORDS, 300, dtype=np.uint32), 400)
    rates = np.tile(np.sort(random_rates(400 // 3 * 3 + 3, seed=6)[:400]), 300)
    assert (np.diff(fast(words, rates).reshape(300, 400), axis=1) >= 0).all()


# The two forms --------------------------------------------------------------------------------------------------------

EDGE_WORDS = [0, 1, 2, SIGN // 2, SIGN - 2, SIGN - 1, SIGN, SIGN + 1, SIGN + 2, 3 * (SIGN // 2), WORDS - 2, WORDS - 1]
NO_RATES = [0.0, -0.0, -5e-324]
TINY_RATES = [5e-324, 2.0**-1050, 2.3e-308, 1e-300, 1e-100, 1e-20, 2.0**-53, 2.0**-34]


def pairs(words: list[int], rates: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return every word with every rate."""
    return np.repeat(np.array(words, dtype=np.uint32), len(rates)), np.tile(np.array(rates), len(words))


def test_kernels_equal_the_reference_for_all_magnitudes() -> None:
    rng = np.random.default_rng(7)
    rates = random_rates(300_000, seed=8)
    words = rng.integers(0, WORDS, len(rates), dtype=np.uint32)
    words[::4] = (2 ** (31 * rng.random(len(words[::4])))).astype(np.uint32) ^ (words[::4] & np.uint32(SIGN))  # tails
    assert (fast(words, rates) == poisson(words, rates)).all()


def test_kernels_equal_the_reference_at_the_edges() -> None:
    rates = [
        *NO_RATES,
        *TINY_RATES,
        *PROFILE_RANGES,
        *(math.nextafter((c / 10) ** 2, s) for c in range(82) for s in (0, 99)),
    ]
    words, every = pairs(EDGE_WORDS, rates)
    counts = fast(words, every)
    assert (counts == poisson(words, every)).all()
    assert np.isfinite(counts).all()
    assert (counts >= 0).all()
    assert (counts == np.rint(counts)).all()
    words, none = pairs(EDGE_WORDS, [*NO_RATES, *TINY_RATES[:-1], -1.0, -1e300, math.nan])  # words resolve 2**-33
    assert (poisson(words, none) == 0).all()
    assert (exact_counts(words, none) == 0).all()


def test_kernels_equal_the_reference_where_counts_change() -> None:
    rates = np.repeat(random_rates(1200, seed=9), 12)
    counts = np.floor(rates + np.sqrt(rates) * np.tile(np.linspace(-5, 6, 12), 1200))
    edges = words_up_to(counts, rates, fast)
    for step in (-2, -1, 0, 1):
        words = word(np.clip(edges + step, 0, WORDS - 1))
        assert (fast(words, rates) == poisson(words, rates)).all()


# Approximate counts ---------------------------------------------------------------------------------------------------

STEPS = np.concatenate([np.arange(3), 2 ** np.arange(2, 26)])
"""Distances in rank from the words at which a count changes, up to 1 % of all words."""


def words_near_changes(rate: float, dense: int) -> np.ndarray:
    """Return the words at and near every change of the count, and ``dense`` words of evenly spaced normals."""
    found, _ = law(rate)
    edges = words_up_to(found, np.full(len(found), rate), poisson)
    normal = np.linspace(-6.34, 6.34, dense)
    rank = [math.erfc(-z / math.sqrt(2)) / 2 * WORDS for z in normal]
    ranks = np.concatenate([(edges[:, None] + STEPS).ravel(), (edges[:, None] - 1 - STEPS).ravel(), np.rint(rank)])
    return word(np.unique(np.clip(ranks, 0, WORDS - 1)))


def wrong(rate: float, dense: int, rate_error: float = 0.0) -> int:
    """Return how many counts are farther from the exact ones than their bounds."""
    words = words_near_changes(rate, dense)
    rates = np.full(words.shape, rate)
    approximate, error = approximate_counts(words, rates, rate_error=rate_error)
    return int((np.abs(approximate - poisson(words, rates)) > error).sum())


CELLS = 64
"""Cells of √rate below rate 16 in which counts are tested."""


RATE_ERRORS = slow_except((0.8 * FLOAT32_RATE,), (-0.8 * FLOAT32_RATE, 0.0, 0.8 * FLOAT32_RATE))


@pytest.mark.parametrize("rate_error", RATE_ERRORS)
@pytest.mark.parametrize(
    ("inside", "dense"),
    [
        pytest.param((1e-7, 1 - 1e-7), 400, id="two rates"),
        pytest.param(np.linspace(1e-9, 1 - 1e-9, 17), 5000, id="many rates", marks=pytest.mark.slow),
    ],
)
def test_counts_of_low_rates_are_within_their_bounds(inside: tuple[float, ...], dense: int, rate_error: float) -> None:
    """Rates are in every cell and next to its ends, words where counts change and everywhere between."""
    found = {}
    for cell, part in itertools.product(range(CELLS), inside):
        rate = ((cell + part) / 16) ** 2
        if number := wrong(rate, dense, rate_error):
            found[rate] = number
    assert found == {}


@pytest.mark.parametrize("rate_error", RATE_ERRORS)
@pytest.mark.parametrize(
    "rate",
    slow_except(
        (5.0, 25.0, 1234.5),
        (5.0, 5.1, 6.3, 8.1, 11.3, 16.1, 19.3, 25.0, 36.4, 49.9, 64.0, 100.3, 1234.5, 1e5, 2.0**21),
    ),
)
def test_counts_by_expansion_are_within_their_bounds(rate: float, rate_error: float) -> None:
    assert wrong(rate, 20_000, rate_error) == 0


@pytest.mark.parametrize(
    ("rate", "share"),
    [(0.1, 0.004), (4.9, 0.004), (5.1, 0.018), (1e4, 0.014)],
)
def test_few_counts_are_uncertain(rate: float, share: float, figure: Figure) -> None:
    """Each costs as much as tens of approximate ones."""
    words = np.random.default_rng(13).integers(0, WORDS, 2**18, dtype=np.uint32)
    listed = (approximate_counts(words, np.full(words.shape, rate))[1] > 0).mean()
    assert listed <= share
    figure("poisson", f"{listed:.2%} of counts are computed twice at rate {rate:g}")


def test_bounds_hold_for_huge_rates() -> None:
    """Counts beyond float32's integers are rounded to float32; the read-out allows for that error."""
    rates = np.geomspace(2.0**20, 1e9, 20_000)
    words = np.random.default_rng(14).integers(0, WORDS, rates.size, dtype=np.uint32)
    approximate, error = approximate_counts(words, rates)
    off = np.abs(approximate.astype(np.float64) - poisson(words, rates))
    assert (off <= error + rates * 2.0**-23).all()
    assert (error[rates > 2.0**22] > 0).all()


# One rate everywhere --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [0.0, 1e-12, 0.01, 0.3, 7.99, MAX_THRESHOLD_RATE])
def test_counts_by_thresholds_equal_the_reference_for_every_word(rate: float) -> None:
    """Counts change only at the thresholds, so the words next to them decide for all."""
    smallest, ranks = count_thresholds(rate)
    edges = (ranks.astype(np.int64)[:, None] + np.arange(-2, 4)).ravel()
    dense = np.random.default_rng(15).integers(0, WORDS, 20_000)
    words = word(np.unique(np.clip(np.concatenate([edges, dense, [0, SIGN - 1, SIGN, WORDS - 1]]), 0, WORDS - 1)))
    expected = poisson(words, np.full(words.shape, rate))
    assert (counts_of_one_rate(words, rate) == expected).all()
    assert smallest == expected[0]
    assert smallest + len(ranks) == expected[-1]
    assert (np.diff(ranks.astype(np.int64)) > 0).all() or rate < 1e-9


# Tables ---------------------------------------------------------------------------------------------------------------


def test_tables_with_another_hash_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    poisson_tables.cache_clear()
    monkeypatch.setattr(poissons, "TABLES_SHA256", "0" * 64)
    with pytest.raises(MachineError, match="expected 0000"):
        poisson_tables()
    poisson_tables.cache_clear()
