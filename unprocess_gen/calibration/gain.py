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
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.types import Float
from unprocess_gen.statistics.scores import NORMAL_95, influence

RANGES = (0.1, 0.3)
"""Largest signals of the fits, as fractions of white above black; the second range has `LEAST_LEVELS` or more."""
SIGNIFICANT = 3.0
"""Standard errors from which a difference is systematic."""
LEAST_LEVELS = 4
"""Fewest levels of flats of a fit."""


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

    def times(self, other: Estimate) -> Estimate:
        """Return the product with an independent number."""
        value, ends = self.value * other.value, ((self.low, other.low), (self.high, other.high))
        below, above = (math.hypot(own / self.value - 1, end / other.value - 1) * value for own, end in ends)
        return Estimate(value, value - below, value + above)

    def over(self, other: Estimate) -> Estimate:
        """Return the ratio to an independent number."""
        return self.times(estimate(1 / other.value, other.error / other.value**2))


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


def weighted_slope(x: Float, y: Float, errors: Float) -> Estimate:
    """Return the slope of a line through values with standard errors."""
    slopes, _ = influence(np.stack([x, np.ones_like(x)]), 1 / errors**2)
    return estimate(float(slopes @ y), float(np.linalg.norm(slopes * errors)))


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


class Fit(NamedTuple):
    """Gain of a plane by one range, with or without q: value, standard error, χ² and its degrees of freedom."""

    gain: float
    error: float
    chi2: float
    degrees: int


def fit_curve(points: Transfer, with_q: bool) -> Fit | None:
    """Fit K, and q if wanted, by generalised least squares; None for too few points."""
    design = np.stack([points.signal, points.signal**2])[: 1 + with_q]
    degrees = len(points.signal) - len(design)
    if degrees < (1 if with_q else 0) or not len(points.signal):
        return None
    covariance, precision = points.covariance, np.linalg.inv(points.covariance)
    by_point = influence(design, precision)
    numbers = by_point @ points.variance
    residual = points.variance - numbers @ design
    error = math.sqrt(float(by_point[0] @ covariance @ by_point[0]))
    return Fit(float(numbers[0]), error, float(residual @ precision @ residual), degrees)


class JointFit(NamedTuple):
    """Fits of all planes by one rule: their mean, its error, and χ² over its degrees of freedom."""

    planes: list[Fit]
    gain: float
    error: float
    chi2: float
    degrees: int

    @property
    def interval(self) -> Estimate:
        """Mean with an interval that residuals beyond the noise widen."""
        return estimate(self.gain, self.error * math.sqrt(max(self.chi2, 1.0)))


def _joint_fit(curves: Sequence[Transfer], limit_dn: float, with_q: bool) -> JointFit | None:
    fits = [fit for curve in curves if (fit := fit_curve(curve.upto(limit_dn), with_q)) is not None]
    if len(fits) < len(curves):
        return None
    gains, errors, chi2, degrees = np.array(fits).T
    weights, freedom = errors**-2, int(degrees.sum())
    mean, error = float(weights @ gains / weights.sum()), float(weights.sum() ** -0.5)
    return JointFit(fits, mean, error, float(chi2.sum()) / max(freedom, 1), freedom)


def fit_gain(curves: Sequence[Transfer], span_dn: float) -> tuple[list[Estimate], bool]:
    """Fit the gain of the sensor, then of each plane; True if the gains of the planes differ."""
    first, least = (share * span_dn for share in RANGES)
    largest = max(least, *(float(np.sort(curve.signal)[LEAST_LEVELS - 1]) for curve in curves))
    fits = {
        (limit_dn, with_q): joint
        for limit_dn, with_q in itertools.product((first, largest), (False, True))
        if (joint := _joint_fit(curves, limit_dn, with_q)) is not None
    }
    chosen = base = fits[largest, False]
    low, high = base.gain - NORMAL_95 * base.error, base.gain + NORMAL_95 * base.error
    is_systematic = base.chi2 > 1 + SIGNIFICANT * math.sqrt(2 / max(base.degrees, 1))
    for other in fits.values():
        own = math.sqrt(max(other.error**2 - base.error**2, 0.0))  # the fits share the points of the smaller range
        is_systematic |= other.error > base.error and abs(other.gain - base.gain) > SIGNIFICANT * own
    if is_systematic:
        chosen = fits[largest, True]
        low, high = min(fit.interval.low for fit in fits.values()), max(fit.interval.high for fit in fits.values())
    sensor, planes = Estimate(chosen.gain, low, high), [estimate(fit.gain, fit.error) for fit in chosen.planes]
    if is_systematic:
        planes = [plane.times(sensor.scaled(1 / chosen.gain)) for plane in planes]
    return [sensor, *planes], _have_colours(chosen)


def _have_colours(chosen: JointFit) -> bool:
    """True if the gains of planes differ by more than their errors, and by more than 0.3 %."""
    return any(abs(fit.gain - chosen.gain) > max(4 * fit.error, 0.003 * chosen.gain) for fit in chosen.planes)
