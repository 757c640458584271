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
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.calibration.deviations import NORMAL_95, influence
from unprocess_gen.core.arrays import Float

RANGES = (0.1, 0.3)
"""Largest signals of the fits, as fractions of white above black; the second range has `LEAST_LEVELS` or more."""
LEAST_LEVELS = 4
"""Fewest levels of flats of a fit."""
SIGNIFICANT = 3.0
"""Standard errors from which a difference is systematic."""

UNEVEN = 0.01
"""Relative error of the variance of a level by uneven steps of the converter: that of the CCD of EMVA 1288 set 001."""


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
        """The number in other units."""
        return Estimate(self.value * factor, self.low * factor, self.high * factor)


def estimate(value: float, error: float, least: float = -math.inf) -> Estimate:
    """A number with a normal standard error; ``least`` limits the interval."""
    return Estimate(value, max(value - NORMAL_95 * error, least), value + NORMAL_95 * error)


def root_estimate(variance: float, error: float) -> Estimate:
    """The root of a variance with its standard error; below 3 standard errors 0, with an interval from 0."""
    half, is_seen = NORMAL_95 * error, variance > SIGNIFICANT * error
    value, low = (math.sqrt(variance), math.sqrt(variance - half)) if is_seen else (0.0, 0.0)
    return Estimate(value, low, math.sqrt(max(variance, 0.0) + half))


def weighted_mean(values: Any, errors: Any) -> tuple[float, float]:
    """The mean of independent values with standard errors, and its standard error."""
    weights = 1 / np.square(np.maximum(errors, 1e-300))
    return float(weights @ values / weights.sum()), float(weights.sum() ** -0.5)


def combined(estimates: Sequence[Estimate]) -> Estimate:
    """The mean of independent estimates; the interval is wider if they differ by more than their errors."""
    values, errors = (np.array([getattr(number, name) for number in estimates]) for name in ("value", "error"))
    mean, error = weighted_mean(values, errors)
    excess = float(np.square((values - mean) / np.maximum(errors, 1e-300)).sum()) / max(len(values) - 1, 1)
    return estimate(mean, error * math.sqrt(excess if excess > 4 else 1.0))


def weighted_slope(x: Float, y: Float, errors: Float) -> Estimate:
    """The slope of a line through values with standard errors."""
    slopes, _ = influence(np.stack([x, np.ones_like(x)]), 1 / errors**2)
    return estimate(float(slopes @ y), float(np.linalg.norm(slopes * errors)))


@dataclass(frozen=True, slots=True)
class Transfer:
    """Points of a photon transfer curve of one plane: flats of one level each, and their darks.

    ``signal`` is the mean above the darks (DN), ``variance`` that above the darks with its ``error``; ``dark_error`` is
    that of the darks (DN²). ``dark`` numbers the darks of a point: points of the same darks share their error.
    """

    signal: Float
    variance: Float
    error: Float
    dark_error: Float
    dark: Float

    def upto(self, limit_dn: float) -> Transfer:
        """The points with a signal of at most ``limit_dn``."""
        chosen = self.signal <= limit_dn
        return Transfer(*(getattr(self, name)[chosen] for name in Transfer.__slots__))

    @property
    def covariance(self) -> Float:
        """Covariance of the variances."""
        same = self.dark[:, None] == self.dark[None, :]
        return np.asarray(np.diag(self.error**2) + same * np.outer(self.dark_error, self.dark_error))


def _fit_plane(points: Transfer, with_q: bool) -> tuple[float, float, float, int] | None:
    """Fit K, and q if wanted, by generalised least squares; return K, its error, χ² and its degrees of freedom."""
    design = np.stack([points.signal, points.signal**2])[: 1 + with_q]
    degrees = len(points.signal) - len(design)
    if degrees < with_q:
        return None
    covariance, precision = points.covariance, np.linalg.inv(points.covariance)
    by_point = influence(design, precision)
    residual = points.variance - by_point @ points.variance @ design
    error = math.sqrt(float(by_point[0] @ covariance @ by_point[0]))
    return float(by_point[0] @ points.variance), error, float(residual @ precision @ residual), degrees


class JointFit(NamedTuple):
    """Fit of all planes by one rule: their gains with standard errors, the mean and its error, χ² and its degrees."""

    planes: list[Estimate]
    gain: float
    error: float
    chi2: float
    degrees: int

    @property
    def interval(self) -> Estimate:
        """Mean with an interval that residuals beyond the noise widen."""
        return estimate(self.gain, self.error * math.sqrt(max(self.chi2 / max(self.degrees, 1), 1.0)))


def _joint_fit(curves: Sequence[Transfer], limit_dn: float, with_q: bool) -> JointFit | None:
    fits = [fit for curve in curves if (fit := _fit_plane(curve.upto(limit_dn), with_q)) is not None]
    if len(fits) < len(curves):
        return None
    gains, errors, chi2, degrees = np.array(fits).T
    return JointFit([estimate(*fit[:2]) for fit in fits], *weighted_mean(gains, errors), chi2.sum(), int(degrees.sum()))


def fit_gain(curves: Sequence[Transfer], span_dn: float) -> list[Estimate]:
    """Fit the gain of the sensor, then of each plane."""
    first, least = (share * span_dn for share in RANGES)
    largest = max(least, *(float(np.sort(curve.signal)[LEAST_LEVELS - 1]) for curve in curves))
    fits = {
        (limit_dn, with_q): joint
        for limit_dn, with_q in itertools.product((first, largest), (False, True))
        if (joint := _joint_fit(curves, limit_dn, with_q)) is not None
    }
    base = fits[largest, False]
    is_systematic = base.chi2 > base.degrees + SIGNIFICANT * math.sqrt(2 * base.degrees)
    for other in fits.values():
        own = math.sqrt(max(other.error**2 - base.error**2, 0.0))  # the fits share the points of the smaller range
        is_systematic |= other.error > base.error and abs(other.gain - base.gain) > SIGNIFICANT * own
    if not is_systematic:
        return [estimate(base.gain, base.error), *base.planes]
    chosen, intervals = fits[largest, True], [fit.interval for fit in fits.values()]
    sensor = Estimate(chosen.gain, min(fit.low for fit in intervals), max(fit.high for fit in intervals))
    below, above = (abs(end - chosen.gain) for end in (sensor.low, sensor.high))  # planes share the systematic error
    return [sensor, *(Estimate(plane.value, plane.low - below, plane.high + above) for plane in chosen.planes)]


def gain_change(curves: Sequence[Transfer], dark_dn2: float) -> Estimate:
    """Relative change of the gain from black to the brightest level; ``dark_dn2`` is the variance of the darks."""
    numbers = [[curve.signal, curve.variance, curve.error / len(curves) ** 0.5] for curve in curves]
    signal, variance, error = np.mean(numbers, axis=0)
    errors = np.hypot(error, UNEVEN * (variance + dark_dn2))
    by_point = influence(np.stack([signal, signal**2]), 1 / errors**2)
    gain, slope = by_point @ variance
    return estimate(slope, float(np.linalg.norm(by_point[1] * errors))).scaled(float(signal[-1] / gain))
