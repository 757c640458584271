"""Compute what the noise law predicts for every DN of the clean frame.

A rounded clean value c means that the unrounded x is within half a DN of it. Expectations are therefore computed for
the lowest, the middle and the highest x. They are split into their mean over the interval, the part that is linear in
x, which `scores` removes, and the rest, whose size is recorded as unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import Float
from unprocess_gen.reports.noise_check.law import Factors, NoiseLaw

Mask = NDArray[np.bool_]

LEAST_STD_DN = 1.0
"""Least standard deviation of noise in rounded frames; below it, rounding errors depend on the noise."""
LEAST_FLOAT_STD = 1e-6
"""Least standard deviation in float32 frames, as a fraction of white minus black: 30 times the rounding error."""
MOST_ELECTRON = 2.0
"""Largest effect of a single electron, in standard deviations of the noise; beyond it, z is too skewed."""
LARGEST_Z = 8.0
"""Bound of z. It changes the mean of z by less than 1e-5 if `MOST_ELECTRON` holds."""
ROUNDING_SQUARE = 1 / 12
"""Standard deviation of ε², with ε the rounding error in units of the interval's width.

It is 0.0745 for an ε drawn from the interval, and 1/12 if all sites are in the middle.
"""


@dataclass(frozen=True, slots=True)
class Cosine:
    """Expectations of cos kz for N clean DN.

    Attributes
    ----------
    mean, slope : ndarray of float64, [N]
        Expectation of ``cos kz - slope · (noisy - c)``, and the derivative of the expectation of cos kz by x (per DN).
    unknown : ndarray of float64, [N]
        Standard deviation of that expectation due to the rounding of x; without rounding, error of ``by_square``.
    by_clean, by_square : ndarray of float64, [N]
        For frames without rounding: coefficients of the difference d of x from the nearest DN, and of d², by which the
        expectation at x differs. 0 for rounded frames.
    by_variance : ndarray of float64, [N]
        Derivative by the variance of the noise (per DN²).
    variance, fixed_variance : ndarray of float64, [N]
        Variance of cos kz at one site, and the part of it that frames of one body share.
    """

    mean: Float
    slope: Float
    unknown: Float
    by_clean: Float
    by_square: Float
    by_variance: Float
    variance: Float
    fixed_variance: Float


@dataclass(frozen=True, slots=True)
class Expectation:
    """Expectations for N clean DN at the sites of one plane.

    Attributes
    ----------
    signal, std : ndarray of float64, [N]
        Signal above black, and standard deviation of the noise without outliers, DN.
    rounding_mean, rounding_std : ndarray of float64, [N]
        Mean and standard deviation of x minus the rounded value, DN.
    outlier_mean, variance, fixed_variance : ndarray of float64, [N]
        Mean of z due to hot and dead pixels; variance of z, and the part of it that frames of one body share.
    cosine, double : Cosine
        Expectations of cos z and cos 2z.
    covariance : ndarray of float64, [N]
        Covariance of cos z and cos 2z.
    """

    signal: Float
    std: Float
    rounding_mean: Float
    rounding_std: Float
    outlier_mean: Float
    variance: Float
    fixed_variance: Float
    cosine: Cosine
    double: Cosine
    covariance: Float


def usable_values(law: NoiseLaw, clean_dn: Float, site: tuple[int, int]) -> Mask:
    """Return which DN of the clean frame can be checked.

    Parameters
    ----------
    law : NoiseLaw
        The predicted noise.
    clean_dn : ndarray of float64, [N]
        DN of the clean frame.
    site : (int, int)
        Row and column of the site in the tile.

    Returns
    -------
    ndarray of bool, [N]
        False near the limits of the sensor, and if the noise is too weak or too few electrons cause it.
    """
    plan = law.plan
    std = np.sqrt(law.variance(law.signal(clean_dn, site)))
    least = LEAST_FLOAT_STD * (plan.white_level_dn - plan.black_level_dn) if plan.normalised else LEAST_STD_DN
    return law.is_far_from_limits(clean_dn, site) & (std >= least) & (law.gain_dn <= MOST_ELECTRON * std)


def expectations(law: NoiseLaw, clean_dn: Float, site: tuple[int, int]) -> Expectation:
    """Compute the expectations for usable DN of the clean frame.

    Parameters
    ----------
    law : NoiseLaw
        The predicted noise.
    clean_dn : ndarray of float64, [N]
        DN that `usable_values` accepts.
    site : (int, int)
        Row and column of the site in the tile.

    Returns
    -------
    Expectation
        One value for each DN.
    """
    plan = law.plan
    signal = law.signal(clean_dn, site)
    std = np.sqrt(law.variance(signal))
    half = 0.0 if plan.clean_normalised else 0.5
    low, high = np.full(signal.shape, -half), np.full(signal.shape, half)
    if not plan.averaged:  # the clean frame has no values below black
        low[clean_dn == plan.black_level_dn] = 0.0
    at = {k: law.factors(signal, k / std) for k in (1, 2, 3, 4)}
    one, two, three = (at[k].value.real for k in (1, 2, 3))
    hot_z = law.hot.value_dn / std
    hot_mean = hot_z * -np.expm1(-LARGEST_Z / np.maximum(hot_z, 1e-3))
    dead_mean = np.clip((law.dead.value_dn - clean_dn) / std, -LARGEST_Z, LARGEST_Z)
    outliers = law.hot.share * np.minimum(2 * hot_z * hot_z, LARGEST_Z**2) + law.dead.share * LARGEST_Z**2
    return Expectation(
        signal=signal,
        std=std,
        rounding_mean=(low + high) / 2,
        rounding_std=(high - low) / math.sqrt(12),
        outlier_mean=law.hot.share * hot_mean + law.dead.share * dead_mean,
        variance=1 + outliers,
        fixed_variance=law.fixed_variance(signal) / std**2 + outliers,
        cosine=_cosine(law, at[1], at[2], low, high),
        double=_cosine(law, at[2], at[4], low, high),
        covariance=(three + one) / 2 - one * two,
    )


def _cosine(law: NoiseLaw, at: Factors, at_double: Factors, low: Float, high: Float) -> Cosine:
    """Return the expectations of cos kz if x is between ``signal + low`` and ``signal + high``.

    ``at`` and ``at_double`` are the factors of the characteristic function at k / std and at 2k / std.
    """
    known = _unrounded(law, at) if law.plan.clean_normalised else _rounded(law, at, low, high)
    one, two = at.value.real, at_double.value.real
    # variance, over fixed patterns, of the mean over frames: E[Re(φ exp(iτF))²] - Re(E[φ exp(iτF)])²
    square = ((at.temporal**2 * at_double.fixed).real + np.abs(at.temporal) ** 2) / 2
    return Cosine(
        *known,
        by_variance=-0.5 * at.tau * at.tau * one,
        variance=(1 + two) / 2 - one * one,
        fixed_variance=np.maximum(square - (at.temporal * at.fixed).real ** 2, 0.0) + 4 * law.dead.share,
    )


def _rounded(law: NoiseLaw, at: Factors, low: Float, high: Float) -> tuple[Float, Float, Float, Float, Float]:
    """Return the attributes of `Cosine` that depend on x, for rounded frames."""
    middle, width = (low + high) / 2, high - low

    def expected(error: Float) -> Float:
        values, moved = at.value.real.copy(), error != 0
        if moved.any():
            tau, error = at.tau[moved], error[moved]
            signal = np.maximum(at.signal[moved] + error, 0.0)
            values[moved] = (law.factors(signal, tau).value * np.exp(1j * tau * error)).real
        return values

    at_low, at_middle, at_high = expected(low), expected(middle), expected(high)
    slope = np.divide(at_high - at_low, width, out=np.zeros_like(width), where=width > 0)
    bend = at_high + at_low - 2 * at_middle  # the parabola through the three has the coefficient 2 bend / width²
    nothing = np.zeros_like(slope)
    return at_middle + bend / 6 - slope * middle, slope, 2 * np.abs(bend) * ROUNDING_SQUARE, nothing, nothing


def _unrounded(law: NoiseLaw, at: Factors) -> tuple[Float, Float, Float, Float, Float]:
    """Return the attributes of `Cosine` that depend on x, for frames without rounding.

    The expectation between two DN is the parabola through those half a DN below, at and above the nearest one. Its
    error is computed a quarter of a DN from it.
    """
    k = at.tau * np.sqrt(law.variance(at.signal))

    def expected(distance: float) -> Float:
        signal = np.maximum(at.signal + distance, 0.0)
        std = np.maximum(np.sqrt(law.variance(signal)), 1e-3 * k / at.tau)
        return np.asarray(law.factors(signal, k / std).value.real)

    middle, low, high = at.value.real, expected(-0.5), expected(0.5)
    slope, square = high - low, 2 * (high + low - 2 * middle)
    error = [np.abs(expected(d) - middle - d * slope - d * d * square) for d in (-0.25, 0.25)]
    return middle, np.zeros_like(slope), np.maximum(*error), slope, square


def spread(values: Expectation, at: NDArray[np.intp], size: int) -> Expectation:
    """Return expectations in arrays of ``size``, with the values at the places ``at`` and zeros elsewhere."""

    def full(array: Float) -> Float:
        wide = np.zeros(size)
        wide[at] = array
        return wide

    changed: Expectation = _changed(values, full)
    return changed


def chosen(values: Expectation, at: NDArray[np.intp]) -> Expectation:
    """Return the expectations at some places."""
    changed: Expectation = _changed(values, lambda array: array[at])
    return changed


def _changed(record: Any, change: Callable[[Float], Float]) -> Any:
    """Return an `Expectation` or a `Cosine` with a function applied to each of its arrays."""
    values = {one.name: getattr(record, one.name) for one in fields(record)}
    return type(record)(
        **{
            n: change(value) if isinstance(value, np.ndarray) else _changed(value, change)
            for n, value in values.items()
        }
    )
