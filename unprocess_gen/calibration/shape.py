"""Fit the distribution of read noise to the integers that a camera recorded, by likelihood.

The value of a site is rounded: P(k) = F((k + ½ - μ)/s) - F((k - ½ - μ)/s), where F is a normal distribution or Tukey's
lambda. μ is the mean of the site's row in its frame plus the offset of its column; neither widens the histogram.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.calibration.frame_sums import TILE
from unprocess_gen.core.exact_distributions import tukey_std
from unprocess_gen.core.types import Float

NORMAL_SHAPE = 0.1349
"""Shape at which Tukey's lambda is nearest to the normal distribution."""
LEAST_SHAPE, LARGEST_SHAPE = -0.449, 2.0
PHASES = 8
"""Parts of a DN to which the means of rows are rounded, for noise below `COARSE_DN`."""
COARSE_DN = 4.0
"""Standard deviation from which rounding is only a variance of 1/12, and bins are wider than phases."""
REACH = 8.0
"""Half the range of the histogram, in standard deviations; values beyond are in its last bins."""
SIMPLEX = np.array([[0.0, 0.0], [0.02, 0.0], [0.0, 0.05]])
"""First steps of the search in the logarithm of the standard deviation and in λ."""
FLOOR = 1e-9
"""Probability of values that no distribution explains, such as defects."""


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts of values by phase and bin, and edges of the bins relative to μ, DN; ``rows`` corrects the variance."""

    counts: Float
    edges: Float
    added_dn2: float
    rows: float

    def plus(self, other: Histogram) -> Histogram:
        """Return the counts of both, which have the same edges."""
        return Histogram(self.counts + other.counts, self.edges, self.added_dn2, self.rows)


@dataclass(frozen=True, slots=True)
class Shape:
    """Fitted read noise: standard deviations of both distributions, λ, its error, and which one fits better."""

    normal_std_dn: float
    tukey_std_dn: float
    shape: float
    shape_error: float
    is_tukey: bool

    @property
    def std_dn(self) -> float:
        """Standard deviation of the distribution that fits better."""
        return self.tukey_std_dn if self.is_tukey else self.normal_std_dn


def histograms(frames: Iterable[NDArray[np.uint16]], columns: Float, std_dn: float) -> list[Histogram]:
    """Return the histogram of each plane; ``columns`` [4, W/2] are offsets, ``std_dn`` about the standard deviation."""
    is_coarse = std_dn >= COARSE_DN
    width = std_dn / PHASES if is_coarse else 1.0
    half = math.ceil(REACH * std_dn / width) + 2
    phases = 1 if is_coarse else PHASES
    edges = (np.arange(-half, half + 2) - 0.5) * width
    counts = np.zeros((4, phases, 2 * half + 1))
    # the mean of rounded values differs from μ by this times -sin 2πμ: the first term of its Fourier series
    ripple = math.exp(-2 * math.pi**2 * max(std_dn**2 - 1 / 12, 0.0)) / math.pi
    length = 2
    for pixels in frames:
        for total, (y, x), offsets in zip(counts, TILE, columns, strict=True):
            plane = pixels[y::2, x::2].astype(np.float32)
            length = plane.shape[1]
            mean = plane.mean(axis=1, keepdims=True) + offsets
            mean = (mean + ripple * np.sin(2 * np.pi * mean)).astype(np.float32)
            if is_coarse:
                phase, place = 0, np.rint((plane - mean) / width).astype(np.int32)
            else:
                steps = np.rint(mean * PHASES).astype(np.int32)
                phase, place = steps % PHASES, plane.astype(np.int32) - steps // PHASES
            place = np.clip(place, -half, half) + half + phase * (2 * half + 1)
            total += np.bincount(place.ravel(), minlength=total.size).reshape(total.shape)
    shifts = np.zeros(1) if is_coarse else np.arange(PHASES) / PHASES
    # the mean is rounded to a phase; values are rounded to a DN
    added_dn2 = 1 / 12 if is_coarse else 1 / (12 * PHASES**2)
    return [Histogram(total, edges - shifts[:, None], added_dn2, length / (length - 1)) for total in counts]


def fit_shape(histogram: Histogram, start: Shape | None = None) -> Shape:
    """Fit a normal distribution and Tukey's lambda to a histogram."""
    from scipy.optimize import minimize, minimize_scalar
    from scipy.special import ndtr, tklmbda

    counts, edges = histogram.counts, histogram.edges
    centres = (edges[:, 1:] + edges[:, :-1]) / 2
    first = math.sqrt(float((counts * centres**2).sum() / counts.sum()))

    def surprise(distribution: Callable[[Float], Float]) -> float:
        """Negative logarithm of the likelihood; the last bins extend to infinity."""
        below = distribution(edges)
        below[:, 0], below[:, -1] = 0.0, 1.0
        return -float((counts * np.log(np.maximum(np.diff(below, axis=1), FLOOR))).sum())

    def tukey(numbers: Float) -> float:
        log_std, shape = float(numbers[0]), float(numbers[1])
        if not LEAST_SHAPE < shape < LARGEST_SHAPE:
            return math.inf
        scale = math.exp(log_std) / float(tukey_std(shape))
        return surprise(lambda x: np.asarray(tklmbda(x / scale, shape)))

    normal = minimize_scalar(
        lambda log_std: surprise(lambda x: np.asarray(ndtr(x / math.exp(log_std)))),
        bounds=(math.log(first / 3), math.log(first * 2)),
        method="bounded",
        options={"xatol": 1e-6},
    )
    starts = [[math.log(start.tukey_std_dn), start.shape]] if start else [[normal.x, 0.1], [normal.x, -0.2]]
    results = [
        minimize(
            tukey,
            begin,
            method="Nelder-Mead",
            options={
                "initial_simplex": [begin, (begin[0] + 0.02, begin[1]), (begin[0], begin[1] + 0.05)],
                "fatol": 0.01,
            },
        )
        for begin in starts
    ]
    best = min(results, key=lambda result: float(result.fun))

    def std(log_std: float) -> float:
        return math.sqrt(max(math.exp(2 * log_std) - histogram.added_dn2, 0.0) * histogram.rows)

    shape = float(best.x[1])
    return Shape(
        std(normal.x), std(best.x[0]), shape, _shape_error(tukey, best.x), bool(best.fun < normal.fun - EVIDENCE)
    )


EVIDENCE = 8.0
"""Logarithm of the ratio of likelihoods from which Tukey's lambda is chosen."""


def _shape_error(surprise: Callable[[Float], float], best: Float) -> float:
    """Return the standard error of λ from the curvature of the likelihood at its maximum."""
    steps = np.array([2e-3, 1e-2])

    def value(first: float, second: float) -> float:
        return surprise(best + steps * (first, second))

    middle = value(0, 0)
    own = [value(1, 0) + value(-1, 0) - 2 * middle, value(0, 1) + value(0, -1) - 2 * middle]
    mixed = (value(1, 1) - value(1, -1) - value(-1, 1) + value(-1, -1)) / 4
    determinant = own[0] * own[1] - mixed * mixed
    return float(steps[1] * math.sqrt(own[0] / determinant)) if min(own[0], determinant) > 0 else math.inf
