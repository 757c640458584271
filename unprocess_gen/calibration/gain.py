"""Fit the system gain to variances of flats, by photon transfer, with its statistical and its systematic error.

The variance of flats minus the variance of darks is K·m·(1 + q·m) at the signal m. K is fitted to signals up to 10 %
and up to 30 % of white, with and without q. If these fits differ by more than their statistical errors allow, the
interval contains all.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unprocess_gen.core.types import Float

RANGES = (0.1, 0.3)
"""Largest signals of the fits, as fractions of white above black."""
EMVA_RANGE = 0.7
"""Largest signal of EMVA 1288's fit, as a fraction of that at the largest variance."""
SIGNIFICANT = 3.0
"""Standard errors from which a difference is systematic."""
NORMAL_95 = 1.96
"""Half the 95 % interval of a normal distribution, in standard errors."""
UNSEEN_CURVATURE = 0.015
"""Relative systematic error of a gain from too few levels to show it. Real sensors: EMVA 1288 reference set 001."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its 95 % interval, systematic error included."""

    value: float
    low: float
    high: float

    @property
    def error(self) -> float:
        """Half the interval in standard errors of a normal distribution."""
        return (self.high - self.low) / 2 / NORMAL_95

    def scaled(self, factor: float) -> Estimate:
        """Return the number in other units."""
        return Estimate(self.value * factor, self.low * factor, self.high * factor)


def estimate(value: float, error: float, least: float = -math.inf) -> Estimate:
    """Return a number with a normal standard error; ``least`` limits the interval."""
    return Estimate(value, max(value - NORMAL_95 * error, least), value + NORMAL_95 * error)


def root_estimate(variance: float, error: float) -> Estimate:
    """Return the root of a variance with its standard error; 0 if it is less than 3 standard errors."""
    value, positive = math.sqrt(variance) if variance > SIGNIFICANT * error else 0.0, max(variance, 0.0)
    return Estimate(value, math.sqrt(max(positive - NORMAL_95 * error, 0.0)), math.sqrt(positive + NORMAL_95 * error))


def combined(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean of independent estimates, weighted by their errors."""
    weights = np.array([1 / max(number.error, 1e-300) ** 2 for number in estimates])
    values = np.array([number.value for number in estimates])
    mean = float(weights @ values / weights.sum())
    excess = float(weights @ (values - mean) ** 2) / max(len(values) - 1, 1)
    return estimate(mean, math.sqrt(max(excess, 1.0) if excess > 4 else 1.0) / math.sqrt(float(weights.sum())))


def weighted_slope(x: Float, y: Float, errors: Float) -> tuple[float, float]:
    """Return the slope of a line through values with standard errors, and its standard error."""
    design = np.stack([x, np.ones_like(x)])
    covariance = np.linalg.inv((design / errors**2) @ design.T)
    return float((covariance @ design / errors**2 @ y)[0]), math.sqrt(covariance[0, 0])


@dataclass(frozen=True, slots=True)
class Transfer:
    """Points of a photon transfer curve of one plane: flats of one level each, and their darks.

    Attributes
    ----------
    signal, variance, error
        mean minus the mean of the darks (DN); variance minus the variance of the darks, and its standard error (DN²)
    dark_error
        standard errors of the variances of the darks (DN²)
    dark
        number of the darks of each point; points of the same darks share their error
    """

    signal: Float
    variance: Float
    error: Float
    dark_error: Float
    dark: Float

    def upto(self, limit_dn: float) -> Transfer:
        """Return the points with a signal of at most ``limit_dn``."""
        chosen = self.signal <= limit_dn
        return Transfer(*(getattr(self, name)[chosen] for name in Transfer.__slots__))

    @property
    def covariance(self) -> Float:
        """Covariance of the variances."""
        same = self.dark[:, None] == self.dark[None, :]
        return np.asarray(np.diag(self.error**2) + same * np.outer(self.dark_error, self.dark_error))


@dataclass(frozen=True, slots=True)
class Fit:
    """Gain of one range with or without q: value, standard error, q (per DN), χ² and its degrees of freedom."""

    gain: float
    error: float
    q: float
    chi2: float
    degrees: int


def fit_curve(points: Transfer, with_q: bool) -> Fit | None:
    """Fit K, and q if wanted, by generalised least squares; None for too few points."""
    design = np.stack([points.signal, points.signal**2])[: 1 + with_q].T
    degrees = len(points.signal) - design.shape[1]
    if degrees < (1 if with_q else 0) or not len(points.signal):
        return None
    inverse = np.linalg.inv(points.covariance)
    covariance = np.linalg.inv(design.T @ inverse @ design)
    numbers = covariance @ design.T @ inverse @ points.variance
    residual = points.variance - design @ numbers
    q = float(numbers[1] / numbers[0]) if with_q else 0.0
    return Fit(float(numbers[0]), math.sqrt(covariance[0, 0]), q, float(residual @ inverse @ residual), degrees)


@dataclass(frozen=True, slots=True)
class Gain:
    """Fitted gains of all planes and of the sensor; q and χ² belong to the chosen fit, means of the planes."""

    sensor: Estimate
    planes: list[Estimate]
    q: float
    chi2: float
    is_systematic: bool
    has_colours: bool


def fit_gain(curves: Sequence[Transfer], span_dn: float) -> Gain:
    """Fit the gain of each plane and of all planes."""
    ranges = [*RANGES, max(float(curve.signal.max()) for curve in curves) / span_dn]
    if sum(len(curve.upto(RANGES[-1] * span_dn).signal) for curve in curves) >= 3 * len(curves):
        ranges.pop()
    by_kind = {}
    for share, with_q in itertools.product(ranges, (False, True)):
        fits = [fit_curve(curve.upto(share * span_dn), with_q) for curve in curves]
        if all(fit is not None for fit in fits):
            by_kind[share, with_q] = [fit for fit in fits if fit is not None]
    base = by_kind[ranges[-1], False]
    means = {kind: _mean(fits) for kind, fits in by_kind.items()}
    value, error = means[ranges[-1], False]
    differences = [
        (other - value, math.sqrt(max(own**2 - error**2, 0.0))) for kind, (other, own) in means.items() if own > error
    ]
    is_systematic = any(abs(difference) > SIGNIFICANT * spread for difference, spread in differences)
    is_systematic |= _chi2(base) > 1 + SIGNIFICANT * math.sqrt(2 / max(sum(fit.degrees for fit in base), 1))
    low, high = value - NORMAL_95 * error, value + NORMAL_95 * error
    chosen = base
    if is_systematic:
        chosen = by_kind.get((ranges[-1], True), base)
        value = _mean(chosen)[0]
        # residuals beyond the noise are systematic too
        inflated = {kind: _mean(fits)[1] * math.sqrt(max(_chi2(fits), 1.0)) for kind, fits in by_kind.items()}
        low = min(means[kind][0] - NORMAL_95 * inflated[kind] for kind in means)
        high = max(means[kind][0] + NORMAL_95 * inflated[kind] for kind in means)
    if len(by_kind) == 1:
        low, high = low - UNSEEN_CURVATURE * value, high + UNSEEN_CURVATURE * value
    sensor = Estimate(value, low, high)
    planes = [
        Estimate(fit.gain, fit.gain - (value - low) * fit.error / error, fit.gain + (high - value) * fit.error / error)
        if not is_systematic and len(by_kind) > 1
        else Estimate(fit.gain, *_widened(fit, value, low, high))
        for fit in chosen
    ]
    q, chi2 = float(np.mean([fit.q for fit in chosen])), _chi2(chosen)
    return Gain(sensor, planes, q, chi2, is_systematic, _have_colours(chosen))


def _mean(fits: Sequence[Fit]) -> tuple[float, float]:
    """Return the mean gain of the planes, weighted by their errors, and its standard error."""
    weights = np.array([1 / fit.error**2 for fit in fits])
    return float(weights @ [fit.gain for fit in fits] / weights.sum()), float(weights.sum() ** -0.5)


def _chi2(fits: Sequence[Fit]) -> float:
    """Return χ² over its degrees of freedom."""
    return sum(fit.chi2 for fit in fits) / max(sum(fit.degrees for fit in fits), 1)


def _widened(fit: Fit, value: float, low: float, high: float) -> tuple[float, float]:
    """Return the interval of a plane: its statistical error, and the relative interval of the sensor."""
    return (
        fit.gain - math.hypot(NORMAL_95 * fit.error, (value - low) / value * fit.gain),
        fit.gain + math.hypot(NORMAL_95 * fit.error, (high - value) / value * fit.gain),
    )


def _have_colours(fits: Sequence[Fit]) -> bool:
    """True if the gains of planes differ by more than their errors, and by more than 0.3 %."""
    value, _ = _mean(fits)
    far = [abs(fit.gain - value) for fit in fits]
    return any(distance > max(4 * fit.error, 0.003 * value) for distance, fit in zip(far, fits, strict=True))


def emva_gain(curve: Transfer) -> float:
    """Return the gain by the rule of EMVA 1288: the slope up to 70 % of the signal at the largest variance."""
    saturation = float(curve.signal[np.argmax(curve.variance)])
    chosen = curve.upto(max(EMVA_RANGE * saturation, float(curve.signal.min())))
    return float(chosen.signal @ chosen.variance / (chosen.signal @ chosen.signal))
