"""Compute what is expected of the noise at the sites of one plane, for each DN of the clean frame.

``z`` is noisy minus expected DN over the standard deviation of the noise, limited to ±`LARGEST_Z`. A rounded clean
value c means that the unrounded x is within half a DN of it; unrounded values are collected in narrow bins instead.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import Float
from unprocess_gen.simulation.effects import BY_NAME
from unprocess_gen.simulation.effects.expectation import NORMAL_DISTANCE, Complex, Site
from unprocess_gen.simulation.reference.sensor import noisy_limits

LEAST_STD_DN = 1.0
"""Least standard deviation of noise in rounded frames; below it, rounding errors depend on the noise."""
MOST_BINS = 2**16
"""Bins of an unrounded frame."""
MOST_ELECTRON = 2.0
"""Largest effect of a single electron, in standard deviations of the noise; beyond it, z is too skewed."""
FAR_Z = 16.0
"""Distance of outliers, in standard deviations: Poisson counts that `MOST_ELECTRON` allows hardly ever exceed it."""
LARGEST_Z = 8.0
"""Bound of z. It changes the mean of z by less than 1e-5 if `MOST_ELECTRON` holds."""


class PlaneNoise:
    """Noise that a plan predicts for the sites of one plane: the sum of its effects."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self.effects = [BY_NAME[name].expected(site) for name in site.plan.noise.effects]
        self.offset_dn = np.asarray(sum(effect.offset_dn for effect in self.effects), dtype=np.float32)
        self.defects = [effect.defects for effect in self.effects if effect.defects is not None]
        if any(len(defects.y) for defects in self.defects):
            height, width = site.shape
            self.offset_dn = np.broadcast_to(self.offset_dn, (height // 2, width // 2)).copy()
            for defects in self.defects:
                self.offset_dn[defects.y, defects.x] = np.nan
        self.clean_offset_dn = sum(effect.clean_offset_dn for effect in self.effects)
        self.row_variance = sum(effect.row_variance for effect in self.effects)
        self.row_correlation = sum(effect.row_correlation for effect in self.effects)

    def signal(self, clean_dn: Float) -> Float:
        """Signal above black that causes shot noise, for DN of the clean frame."""
        return np.maximum(clean_dn - self.site.plan.sensor.black_level_dn - self.clean_offset_dn, 0.0)

    def variance(self, signal: Float) -> Float:
        """Variance without defects, DN²."""
        return np.asarray(np.sum([effect.variance(signal) for effect in self.effects], axis=0))

    def temporal_variance(self, signal: Float) -> Float:
        """Part of the variance that is new in every frame, DN²."""
        return np.asarray(np.sum([(not effect.is_fixed) * effect.variance(signal) for effect in self.effects], axis=0))

    def characteristic(self, signal: Float, tau: Float, with_rows: bool = True) -> Complex:
        """Characteristic function E[exp(iτ·noise)] for signals and frequencies (radians per DN)."""
        factors = (effect.factor(signal, tau) for effect in self.effects if with_rows or not effect.row_variance)
        return math.prod(factors, start=np.ones_like(signal))

    @property
    def limits(self) -> tuple[float, float]:
        """Limits of the noisy frame without offsets, by the converter and the full well."""
        plan = self.site.plan
        low, high = noisy_limits(plan.sensor.bits, plan.sensor.black_level_dn, plan.noise.sensor_clip)
        full_dn = min((effect.largest_dn for effect in self.effects), default=math.inf)
        largest = float(np.nanmax(np.abs(self.offset_dn), initial=0.0))
        return low + largest, min(high, plan.sensor.black_level_dn + self.clean_offset_dn + full_dn) - largest

    def far_shares(self, clean_dn: Float) -> Float:
        """Fractions of noise below -`FAR_Z` and above `FAR_Z` standard deviations, [2, N]; NaN beyond a limit."""
        (low, high), distance = self.limits, FAR_Z * np.sqrt(self.variance(self.signal(clean_dn)))
        reached = np.stack([clean_dn - distance > low, clean_dn + distance < high])
        return np.where(reached, np.sum([effect.tail(distance) for effect in self.effects], axis=0), np.nan)

    def is_usable(self, clean_dn: Float, bin_dn: float) -> NDArray[np.bool_]:
        """Mask of DN whose noise is strong enough, and hardly ever at a limit of the sensor."""
        plan, (low, high) = self.site.plan, self.limits
        std = np.sqrt(self.variance(self.signal(clean_dn)))
        distance = NORMAL_DISTANCE * std + sum(effect.tail_dn for effect in self.effects)
        usable = (clean_dn - distance > low) & (clean_dn + distance < high) & (clean_dn < plan.brightest_dn - 0.5)
        if plan.noise.averaged:
            usable &= clean_dn > max(low, 0.0)  # dead pixels
        least = bin_dn if plan.output.normalised else max(LEAST_STD_DN, bin_dn)
        return np.asarray(usable & (std >= least) & (self.site.gain_dn <= MOST_ELECTRON * std))


def bin_width(noise: PlaneNoise) -> float:
    """Width of the bins of clean values, DN: 1, or at most half of the standard deviation at black if not rounded."""
    plan = noise.site.plan
    if not plan.output.clean_normalised:
        return 1.0
    std = math.sqrt(float(noise.variance(np.zeros(1))[0]))
    narrowest = 2.0**plan.sensor.bits / MOST_BINS
    return min(1.0, max(narrowest, 2.0 ** math.floor(math.log2(max(std, narrowest) / 2))))


class Expectation:
    """Expectations for N clean values c in the middle of bins that `PlaneNoise.is_usable` accepts.

    x is the clean value before rounding.

    Attributes
    ----------
    signal, std : ndarray of float64, [N]
        Signal above black, and standard deviation of the noise without defects, DN.
    rounding_mean, rounding_std : ndarray of float64, [N]
        Mean and standard deviation of x - c if it is uniform, DN; 0 in frames that are not rounded.
    unknown_dn : ndarray of float64, [N]
        Half the range of x - c at black and at clipped light, where many sites can have the same x; 0 elsewhere.
    fixed : ndarray of float64, [N]
        Fraction of the variance that frames of one body share.
    cosine, slope : ndarray of float64, [N]
        Expectation of ``cos z - slope · (x - c)``, which hardly depends on x; slope is per DN.
    bend : ndarray of float64, [N]
        Difference of that expectation between the lowest or highest x, and the middle.
    by_variance : ndarray of float64, [N]
        Derivative of the expectation by the variance of the noise (per DN²).
    cosine_variance : ndarray of float64, [N]
        Variance of cos z at one site.
    codes : ndarray of float64, [2, N]
        Bounds on the mean of ±1 by the last bit of the noisy value, and by the last but one.
    far : ndarray of float64, [2, N]
        `PlaneNoise.far_shares`.
    """

    def __init__(self, noise: PlaneNoise, clean_dn: Float, bin_dn: float) -> None:
        plan, signal = noise.site.plan, noise.signal(clean_dn)
        std, is_rounded = np.sqrt(noise.variance(signal)), not plan.output.clean_normalised
        low, high = np.full(len(signal), -bin_dn / 2), np.full(len(signal), bin_dn / 2)
        black_dn, brightest_dn = plan.sensor.black_level_dn, plan.brightest_dn
        is_black = (clean_dn == black_dn) & (not plan.noise.averaged)
        low[is_black] = 0.0  # the clean frame has no values below black
        # light is clipped before it is divided by the exposure ratio
        is_end = is_black | (np.abs(clean_dn - black_dn - (brightest_dn - black_dn) * plan.scene.exposure) <= 0.5)

        def mean_cosine(k: int, error: Float) -> Float:
            """E[cos(k·(noisy - c) / std)] for x = c + error; without rounding, of noisy - x."""
            shift = np.exp(1j * k / std * error) if is_rounded else 1.0
            return np.real(noise.characteristic(np.maximum(signal + error, 0.0), k / std) * shift)

        middle, width = (low + high) / 2, high - low
        at_low, cosine, at_high = (mean_cosine(1, error) for error in (low, middle, high))
        bend = at_high + at_low - 2 * cosine
        self.signal, self.std = signal, std
        self.rounding_mean, self.rounding_std = middle * is_rounded, width / math.sqrt(12) * is_rounded
        self.unknown_dn = width / 2 * (is_end & is_rounded)
        self.fixed = 1 - noise.temporal_variance(signal) / noise.variance(signal)
        self.slope = (at_high - at_low) / width
        # the parabola through the three has the coefficient 2 · bend / width²
        self.cosine = cosine + bend / 6 - self.slope * middle
        self.bend = bend / 2
        self.by_variance = -0.5 * cosine / std**2
        self.cosine_variance = (1 + mean_cosine(2, middle)) / 2 - cosine**2
        self.codes = np.stack([_code_bound(noise, signal, frequency) for frequency in (np.pi, np.pi / 2)])
        self.far = noise.far_shares(clean_dn)


def _code_bound(noise: PlaneNoise, signal: Float, frequency: float) -> Float:
    """Bound on the mean of a square wave of the noisy value, from its odd harmonics and without offsets of rows."""
    tau = (frequency * harmonic * np.ones_like(signal) for harmonic in (1, 3, 5))
    return np.asarray(2 * sum(np.abs(noise.characteristic(signal, value, with_rows=False)) for value in tau))
