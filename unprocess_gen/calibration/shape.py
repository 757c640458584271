"""Fit the distribution of read noise to the integers that a camera recorded, by likelihood.

The value of a site is rounded: P(k) = F((k + ½ - μ)/s) - F((k - ½ - μ)/s), where F is a normal distribution or Tukey's
lambda. μ is the mean of the site's row in its frame plus the offset of its column; neither widens the histogram.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.calibration.frame_sums import TILE
from unprocess_gen.calibration.gain import NORMAL_95, Estimate
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


def joined(parts: Sequence[Histogram]) -> Histogram:
    """Return the histogram of all planes."""
    counts, edges = (np.concatenate([getattr(part, name) for part in parts]) for name in ("counts", "edges"))
    return Histogram(counts, edges, float(np.mean([part.added_dn2 for part in parts])), parts[0].rows)


@dataclass(frozen=True, slots=True)
class Shape:
    """Fitted read noise: standard deviations of both distributions, λ, its error, and which one fits better.

    ``systematic`` bounds the error of λ because means of rows, from few sites, are subtracted.
    """

    normal_std_dn: float
    tukey_std_dn: float
    shape: float
    shape_error: float
    systematic: float
    is_tukey: bool

    @property
    def interval(self) -> Estimate:
        """λ with its 95 % interval."""
        half = NORMAL_95 * self.shape_error + self.systematic
        return Estimate(self.shape, self.shape - half, self.shape + half)

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
    edges = np.asarray((np.arange(-half, half + 2) - 0.5) * width, np.float64)
    counts, moments = np.zeros((4, phases, 2 * half + 1)), np.zeros((4, 3, phases))
    # the mean of rounded values differs from μ by this times -sin 2πμ: the first term of its Fourier series
    ripple = math.exp(-2 * math.pi**2 * max(std_dn**2 - 1 / 12, 0.0)) / math.pi
    sites = 2
    for pixels in frames:
        planes = [pixels[y::2, x::2].astype(np.float32) for y, x in TILE]
        rows = np.array([plane.mean(axis=1) for plane in planes])
        levels = rows.mean(axis=1, keepdims=True)
        offsets = (rows - levels).reshape(2, 2, -1).mean(axis=1).repeat(2, axis=0)  # planes of a row share its offset
        sites = 2 * planes[0].shape[1]
        means = (levels + offsets)[..., None] + columns[:, None, :]
        for number, (plane, exact) in enumerate(zip(planes, means, strict=True)):
            mean = (exact + ripple * np.sin(2 * np.pi * exact)).astype(np.float32)
            if is_coarse:
                phase, place = np.zeros(1, np.int32), np.rint((plane - mean) / width).astype(np.int32)
            else:
                steps = np.rint(mean * PHASES).astype(np.int32)
                phase, place = steps % PHASES, plane.astype(np.int32) - steps // PHASES
                rest = (mean - steps / PHASES).ravel()
                for power in range(3):
                    moments[number, power] += np.bincount(phase.ravel(), rest**power, PHASES)
            place = np.clip(place, -half, half) + half + phase * (2 * half + 1)
            counts[number] += np.bincount(place.ravel(), minlength=counts[number].size).reshape(counts[number].shape)
    return [
        Histogram(total, *_edges(edges, numbers, is_coarse), sites / (sites - 1))
        for total, numbers in zip(counts, moments, strict=True)
    ]


def _edges(edges: Float, moments: Float, is_coarse: bool) -> tuple[Float, float]:
    """Return the edges of the bins of each phase relative to its mean μ, and the variance around that or of rounding.

    ``moments`` are the number of sites of each phase, and the sums of μ and of its square relative to the phase.
    """
    if is_coarse:
        return edges[None], 1 / 12
    count = np.maximum(moments[0], 1)
    mean = moments[1] / count
    variance = float((moments[2] - moments[1] * mean).sum() / count.sum())
    return edges - (np.arange(PHASES) / PHASES + mean)[:, None], variance


def fitted_shares(histogram: Histogram, shape: Shape, is_tukey: bool) -> Float:
    """Return the share of each bin, of all phases, that a fitted distribution gives."""
    std = shape.tukey_std_dn if is_tukey else shape.normal_std_dn
    std = math.sqrt(std * std / histogram.rows + histogram.added_dn2)
    weights = histogram.counts.sum(axis=1) / histogram.counts.sum()
    return np.asarray(weights @ _probabilities(histogram, std, shape.shape if is_tukey else None))


def _probabilities(histogram: Histogram, std: float, shape: float | None) -> Float:
    """Return the probability of each bin by phase: Tukey's lambda, or without a shape a normal distribution."""
    from scipy.special import ndtr, tklmbda

    if shape is None:
        below = np.asarray(ndtr(histogram.edges / std))
    else:
        below = np.asarray(tklmbda(histogram.edges / std * float(tukey_std(shape)), shape))
    below[:, 0], below[:, -1] = 0.0, 1.0  # the last bins extend to infinity
    return np.diff(below, axis=1)


def _surprise(histogram: Histogram, log_std: float, shape: float | None = None) -> float:
    """Return the negative logarithm of the likelihood."""
    if shape is not None and not LEAST_SHAPE < shape < LARGEST_SHAPE:
        return math.inf
    probabilities = np.maximum(_probabilities(histogram, math.exp(log_std), shape), FLOOR)
    return -float((histogram.counts * np.log(probabilities)).sum())


def fit_shape(histogram: Histogram, start: Shape | None = None) -> Shape:
    """Fit a normal distribution and Tukey's lambda to a histogram."""
    from scipy.optimize import minimize, minimize_scalar

    centres = (histogram.edges[:, 1:] + histogram.edges[:, :-1]) / 2
    first = math.sqrt(float((histogram.counts * centres**2).sum() / histogram.counts.sum()))
    ends = math.log(first / 3), math.log(first * 2)
    normal = minimize_scalar(
        lambda log_std: _surprise(histogram, log_std), bounds=ends, method="bounded", options={"xatol": 1e-6}
    )

    def tukey(numbers: Float) -> float:
        return _surprise(histogram, float(numbers[0]), float(numbers[1]))

    starts = [[math.log(start.tukey_std_dn), start.shape]] if start else [[normal.x, 0.1], [normal.x, -0.2]]
    results = [
        minimize(tukey, begin, method="Nelder-Mead", options={"initial_simplex": begin + SIMPLEX, "fatol": 0.01})
        for begin in starts
    ]
    best = min(results, key=lambda result: float(result.fun))

    def std(log_std: float) -> float:
        return math.sqrt(max(math.exp(2 * log_std) - histogram.added_dn2, 0.0) * histogram.rows)

    return Shape(
        normal_std_dn=std(normal.x),
        tukey_std_dn=std(best.x[0]),
        shape=float(best.x[1]),
        shape_error=_shape_error(tukey, best.x),
        systematic=OF_ROWS * (histogram.rows - 1),
        is_tukey=bool(best.fun < normal.fun - EVIDENCE),
    )


OF_ROWS = 1.8
"""Largest error of λ times the sites of a row. Measured: 0.0034 for λ = -0.24 and rows of 512."""
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
