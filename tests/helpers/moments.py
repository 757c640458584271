"""Exact moments of a rounded, clipped Gaussian, and proved bounds, for tests of noise.

Nothing here comes from the package: the moments are sums over the digital numbers a frame can hold, each with its
probability from erfc, and the bounds are Bernstein's inequality.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

REACH = 6.4
"""Standard deviations that the sampler never exceeds (`test_effects` checks 6.34)."""

FALSE_ALARM = 1e-12
"""Probability that a correct comparison fails; with fewer than 10⁵ comparisons, 10⁻⁷ for all tests together."""

SAMPLER_ERROR = 1.5e-7
"""Error bound of the table of normal quantiles (`test_tables` checks it)."""


@dataclass(frozen=True, slots=True)
class Moments:
    """Mean, second to fourth central moment and largest distance from the mean of one random DN."""

    mean: float
    variance: float
    third: float
    fourth: float
    reach: float


def upper_tail(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability that a standard normal exceeds each z; no cancellation anywhere."""
    return np.array([math.erfc(value / math.sqrt(2)) / 2 for value in z])


def shares(mean: float, std: float, low: int, high: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the digital numbers clip(rint(mean + std·n), low, high) can take and the probability of each.

    All of them within nine standard deviations; what lies beyond (10⁻¹⁹) is counted to the ends.
    """
    if std == 0:
        return np.array([min(max(round(mean), low), high)]), np.ones(1)
    first = min(max(math.floor(mean - 9 * std), low), high)
    last = min(max(math.ceil(mean + 9 * std), low), high)
    levels = np.arange(first, last + 1)
    z = (levels[:-1] + 0.5 - mean) / std  # the edges between neighbours
    tail = upper_tail(np.abs(z))
    above, below = np.where(z < 0, 1 - tail, tail), np.where(z < 0, tail, 1 - tail)
    from_above = np.concatenate([[1.0], above]) - np.concatenate([above, [0.0]])
    from_below = np.concatenate([below, [1.0]]) - np.concatenate([[0.0], below])
    return levels, np.where(levels > mean, from_above, from_below)


def moments(mean: float, std: float, low: int, high: int) -> Moments:
    """Return the exact moments of clip(rint(mean + std·n), low, high) for a standard normal n."""
    levels, probability = shares(mean, std, low, high)
    centre = round(mean)
    offset = levels - centre
    shift = float(probability @ offset)
    deviation = offset - shift
    ends = (min(max(round(mean + side * REACH * std), low), high) - centre - shift for side in (-1, 1))
    with np.errstate(under="ignore"):  # a probability below 1e-308 may well come out as 0
        return Moments(
            mean=centre + shift,
            variance=float(probability @ deviation**2),
            third=float(probability @ deviation**3),
            fourth=float(probability @ deviation**4),
            reach=max(abs(end) for end in ends),
        )


def bernstein(variance: float, reach: float, count: int, false_alarm: float = FALSE_ALARM) -> float:
    """Return how far the mean of ``count`` independent values may lie from its expectation.

    Bernstein's inequality: values within ``reach`` of their mean and of the given variance (their average, where they
    differ) exceed the bound on either side with a probability below ``false_alarm``.
    """
    log = math.log(2 / false_alarm)
    linear = log * reach / (3 * count)
    return linear + math.sqrt(linear**2 + 2 * log * variance / count)
