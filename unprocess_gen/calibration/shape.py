"""Fit the distribution of read noise to the integers that a camera recorded, by likelihood.

The value of a site is rounded: P(r) = F((r + ½)/s) - F((r - ½)/s) for its difference r from μ, where F is a normal
distribution or Tukey's lambda. μ is the mean of the site's row in its frame plus the offset of its column; neither
widens the histogram of r. The fixed pattern of sites does: F is that of the sum with a normal distribution of the
pattern's standard deviation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.calibration.deviations import NORMAL_95
from unprocess_gen.calibration.frame_sums import Measurement
from unprocess_gen.calibration.gain import Estimate
from unprocess_gen.calibration.planes import planes_of
from unprocess_gen.core.arrays import Bool, Float
from unprocess_gen.core.exact_distributions import tukey_std

NORMAL_SHAPE = 0.1349
"""Shape at which Tukey's lambda is nearest to the normal distribution."""
LEAST_SHAPE, LARGEST_SHAPE = -0.449, 2.0
PARTS, REACH = 16, 8
"""Bins of a standard deviation, and half the range in standard deviations; values beyond are in the last bins."""
STEPS = np.array([2e-3, 1e-2])
"""Steps in the logarithm of the standard deviation and in λ over which probabilities change linearly."""
FLOOR = 1e-9
"""Probability of values that no distribution explains, such as defects."""
ROW_FACTOR = 2.0
"""λ is too near to `NORMAL_SHAPE` by this fraction over the sites of a row, whose mean is subtracted. Measurement."""
EVIDENCE = 8.0
"""Logarithm of the ratio of likelihoods from which Tukey's lambda is chosen."""


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts of r in bins of a width (DN) around 0; sites whose mean is subtracted; deviation of the fixed pattern."""

    counts: Float
    width: float
    sites: int
    pattern_dn: float

    @property
    def centres(self) -> Float:
        """Centres of the bins, DN."""
        return np.asarray((np.arange(len(self.counts)) - len(self.counts) // 2) * self.width)


@dataclass(frozen=True, slots=True)
class ReadShape:
    """Fitted read noise: standard deviations of both distributions, λ with its interval, and which one fits better."""

    normal_std_dn: float
    tukey_std_dn: float
    interval: Estimate
    is_tukey: bool

    @property
    def shape(self) -> float:
        """λ."""
        return self.interval.value

    @property
    def std_dn(self) -> float:
        """Standard deviation of the distribution that fits better."""
        return self.tukey_std_dn if self.is_tukey else self.normal_std_dn


def fill_histogram(frames: Iterable[NDArray[np.uint16]], measured: Measurement, defects: Bool) -> Histogram:
    """The histogram of the sites that are no defects [4, H, W], of the frames that were measured."""
    columns, is_seen = measured.column_offsets, measured.dsnu > 2 * measured.fixed_error
    pattern = float(np.where(is_seen, measured.dsnu, 0.0).mean())
    width, half = math.sqrt(float(measured.variance.mean()) + pattern) / PARTS, PARTS * REACH
    counts = np.zeros(2 * half + 1)
    for pixels in frames:
        planes = np.where(defects, measured.mean_dn[:, None, None], planes_of(pixels)).astype(np.float32)
        rows = planes.mean(axis=2, keepdims=True, dtype=np.float64)
        levels = rows.mean(axis=1, keepdims=True)
        # planes of a row share its offset
        offsets = (rows - levels).reshape(2, 2, -1, 1).mean(axis=1).repeat(2, axis=0)
        rest = planes - (levels + offsets + columns[:, None, :]).astype(np.float32)
        places = np.clip(np.rint(rest / np.float32(width)), -half, half).astype(np.int32) + half
        counts += np.bincount(places[~defects], minlength=2 * half + 1)
    return Histogram(counts, width, 2 * columns.shape[1], math.sqrt(pattern))


def cumulative(std: float, shape: float | None) -> Callable[[Float], Float]:
    """F of Tukey's lambda, or without a shape of a normal distribution."""
    from scipy.special import ndtr, tklmbda

    if shape is None:
        return lambda values: np.asarray(ndtr(values / std))
    scale = float(tukey_std(shape)) / std
    return lambda values: np.asarray(tklmbda(values * scale, shape))


def probabilities(values: Float, std: float, shape: float | None) -> Float:
    """P(r)."""
    below = cumulative(std, shape)
    return np.asarray(below(values + 0.5) - below(values - 0.5))


def fit_shape(histogram: Histogram) -> ReadShape:
    """Fit a normal distribution and Tukey's lambda to a histogram."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.optimize import minimize, minimize_scalar

    used, end = (histogram.counts > 0) | (histogram.pattern_dn > 0), histogram.centres[-1:]
    counts, values = histogram.counts[used], histogram.centres[used]

    def likelihoods(values: Float, log_std: float, shape: float | None = None) -> Float:
        below = cumulative(math.exp(log_std), shape)
        inner = below(values + 0.5) - below(values - 0.5)
        if histogram.pattern_dn > 0:  # all bins are used
            inner = gaussian_filter1d(inner, histogram.pattern_dn / histogram.width, mode="constant", truncate=REACH)
        return np.maximum(np.where(np.abs(values) == end, below(-end), inner), FLOOR)

    def surprise(log_std: float, shape: float | None = None) -> float:
        """The negative logarithm of the likelihood."""
        if shape is not None and not LEAST_SHAPE < shape < LARGEST_SHAPE:
            return math.inf
        return -float(counts @ np.log(likelihoods(values, log_std, shape)))

    whole = float(counts @ values**2 / counts.sum())
    first = math.log(max(whole - histogram.pattern_dn**2, whole / 64)) / 2
    normal = minimize_scalar(surprise, bounds=(first - 1, first + 1), method="bounded", options={"xatol": 1e-6})
    results = [
        minimize(
            lambda numbers: surprise(*numbers.tolist()),
            begin,
            method="Nelder-Mead",
            options={"initial_simplex": begin + np.array([[0, 0], [0.02, 0], [0, 0.05]]), "fatol": 0.01},
        )
        for begin in ((normal.x, 0.1), (normal.x, -0.2))
    ]
    best = min(results, key=lambda result: float(result.fun))
    error = _error_of_shape(best.x, lambda numbers: likelihoods(histogram.centres, *numbers), histogram)
    pull = float(best.x[1] - NORMAL_SHAPE) / histogram.sites
    systematic = abs(pull) * (1 if pull < 0 else 4) + _rounding_error(math.exp(best.x[0]), best.x[1])
    shape, half = float(best.x[1]) + ROW_FACTOR * pull, math.hypot(NORMAL_95 * error, systematic)
    normal_std, tukey_std_dn = np.exp([normal.x, best.x[0]]) * math.sqrt(histogram.sites / (histogram.sites - 1))
    interval = Estimate(shape, shape - half, shape + half)
    return ReadShape(float(normal_std), float(tukey_std_dn), interval, bool(best.fun < normal.fun - EVIDENCE))


def _error_of_shape(best: Float, likelihoods: Callable[[Float], Float], histogram: Histogram) -> float:
    """The standard error of λ, from Fisher's information of both numbers."""
    expected, total = likelihoods(best), histogram.counts.sum()
    slopes = [(likelihoods(best + step) - likelihoods(best - step)) / 2 / step.sum() for step in np.diag(STEPS)]
    weights = np.full(len(expected), histogram.width)
    weights[[0, -1]] = 1.0  # these have all values beyond
    relative = np.stack(slopes) / expected
    return math.sqrt(np.linalg.inv(relative * weights * expected * total @ relative.T)[1, 1])


def _rounding_error(std: float, shape: float) -> float:
    """An error of λ because the mean of rounded values is not μ, which widens the histogram of weak noise."""
    lattice = np.arange(-REACH, REACH, dtype=np.float64) + 0.25
    off = float(lattice @ probabilities(lattice, std, shape))
    return 2 * (off / std) ** 2
