"""Combine what all ISOs show of numbers that do not depend on ISO: fixed patterns, dark current, defects, full well."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from unprocess_gen.calibration.gain import (
    Estimate,
    combined,
    estimate,
    root_estimate,
    weighted_slope,
)
from unprocess_gen.calibration.measure import IsoResult, usable

LEAST_EXPOSURE_RATIO = 2.0
"""Least ratio of exposures from which dark current is measured."""
LEAST_HOT_EXPOSURE_S = 0.2
"""Least exposure of darks that show hot pixels. Chosen: their excess is some electrons then."""
LARGEST_HOT = 0.95
"""Signal of hot pixels, as a fraction of white and of the full well, from which their current is not known."""
LEAST_WARMING_C = 4.0
"""Least range of temperatures from which their effect is measured."""


@dataclass(frozen=True, slots=True)
class BodyResult:
    """Numbers of the camera body; None for those that the captures do not show."""

    prnu: Estimate | None = None
    prnus: tuple[Estimate, ...] = ()
    dsnu_e: Estimate | None = None
    dark_e_per_s: Estimate | None = None
    dark_reference_c: float | None = None
    dark_doubling_c: Estimate | None = None
    hot_share: Estimate | None = None
    hot_e_per_s: Estimate | None = None
    dead_share: Estimate | None = None
    dead_level: Estimate | None = None
    full_well_e: Estimate | None = None
    is_mean_removed: bool = True


def measure_body(results: Sequence[IsoResult], black_dn: float) -> BodyResult:
    """Combine the results of all ISOs."""
    has_flats = any(usable(result.flats) for result in results)
    prnus = tuple(_prnu(results, (plane,)) for plane in range(4)) if has_flats else ()
    currents = _dark_currents(results)
    doubling = _doubling(currents)
    warmest = max(currents, default=None)
    current = combined(currents[warmest]) if warmest is not None else None
    if current is not None and current.low <= 0:
        current = None
    wells = [_in_electrons(result.full_well_dn, result.gain.sensor) for result in results if result.full_well_dn]
    hot_share, hot_e_per_s = _hot(results, wells[0].value if wells else math.inf)
    dead_share, dead_level = _dead(results, black_dn)
    dsnu = [result.dsnu_dn.scaled(1 / result.gain.sensor.value) for result in results if result.dsnu_dn.value]
    return BodyResult(
        prnu=_positive(_prnu(results, range(4))) if has_flats else None,
        prnus=prnus,
        dsnu_e=combined(dsnu) if dsnu else None,
        dark_e_per_s=current,
        dark_reference_c=warmest if warmest else None,
        dark_doubling_c=doubling,
        hot_share=hot_share,
        hot_e_per_s=hot_e_per_s,
        dead_share=dead_share,
        dead_level=dead_level,
        full_well_e=wells[0] if wells else None,
        is_mean_removed=_is_mean_removed(results),
    )


def without_dark_current(result: IsoResult, body: BodyResult) -> IsoResult:
    """Return a result whose read noise does not contain the dark current of its darks: K²·D·t less variance."""
    if body.dark_e_per_s is None:
        return result
    celsius, doubling = result.dark.frames[0].temperature_c, body.dark_doubling_c
    warmth = 1.0
    if celsius is not None and body.dark_reference_c is not None and doubling is not None:
        warmth = 2 ** ((celsius - body.dark_reference_c) / doubling.value)
    added = body.dark_e_per_s.scaled(result.gain.sensor.value**2 * result.dark.exposure_s * warmth)

    def corrected(read: Estimate) -> Estimate:
        return root_estimate(read.value**2 - added.value, math.hypot(2 * read.value * read.error, added.error))

    return replace(result, read=corrected(result.read), reads=[corrected(read) for read in result.reads])


def _in_electrons(number: Estimate, gain: Estimate) -> Estimate:
    """Return a number in DN in electrons; its interval contains the error of the gain."""
    value, gain_error = number.value / gain.value, (gain.high - gain.low) / 2 / gain.value
    below, above = (math.hypot(end / number.value - 1, gain_error) * value for end in (number.low, number.high))
    return Estimate(value, value - below, value + above)


def _positive(number: Estimate) -> Estimate | None:
    return number if number.value > 0 else None


def _prnu(results: Sequence[IsoResult], planes: Sequence[int]) -> Estimate:
    """Return the PRNU of planes: √((fixed variance of flats - of darks) / signal²), weighted over levels."""
    measured = [
        (*result.prnu_squares[plane], result.dark.measured.sites)
        for result in results
        if result.prnu_squares
        for plane in planes
    ]
    values, errors, sites = np.array(measured).T
    weights = 1 / errors**2
    square = float(weights @ values / weights.sum())
    # the pixels are a sample of the sensor's
    error = math.hypot(float(weights.sum()) ** -0.5, square * math.sqrt(2 / (sites[0] * len(planes))))
    return root_estimate(square, error)


def _dark_currents(results: Sequence[IsoResult]) -> dict[float, list[Estimate]]:
    """Return the dark currents of all ISOs by temperature (0 if it is not stated): slope of σ²/K² over the exposure."""
    currents = defaultdict(list)
    for result in results:
        gain, by_temperature = result.gain, defaultdict(list)
        gains = np.array([plane.value for plane in gain.planes] if gain.has_colours else [gain.sensor.value] * 4)
        for dark in result.darks:
            by_temperature[dark.frames[0].temperature_c or 0.0].append(dark)
        for temperature, darks in by_temperature.items():
            seconds = np.array([dark.exposure_s for dark in darks])
            if seconds.max() < LEAST_EXPOSURE_RATIO * seconds.min() or seconds.max() == 0:
                continue
            electrons = np.array([(dark.measured.variance / gains**2).mean() for dark in darks])
            errors = np.array([np.linalg.norm(dark.measured.error / gains**2) / 4 for dark in darks])
            slope, error = weighted_slope(seconds, electrons, errors)
            gain_error = 2 * slope * gain.sensor.error / gain.sensor.value
            currents[temperature].append(estimate(slope, math.hypot(error, gain_error)))
    return dict(currents)


def _doubling(currents: dict[float, list[Estimate]]) -> Estimate | None:
    """Return the rise of the temperature that doubles the dark current; None without two temperatures."""
    points = [(celsius, combined(values)) for celsius, values in currents.items()]
    points = [(celsius, value) for celsius, value in points if value.low > 0]
    if len(points) < 2 or max(points)[0] - min(points)[0] < LEAST_WARMING_C:
        return None
    celsius = np.array([point[0] for point in points])
    logs = np.array([math.log2(point[1].value) for point in points])
    errors = np.array([point[1].error / point[1].value / math.log(2) for point in points])
    slope, error = weighted_slope(celsius, logs, errors)
    return estimate(1 / slope, error / slope**2) if slope > 0 else None


def _is_mean_removed(results: Sequence[IsoResult]) -> bool:
    """True if the mean of darks stays while their variance rises: the camera subtracts the mean dark signal."""
    for result in results:
        first, last = result.darks[0].measured, result.darks[-1].measured
        rise = (last.variance.mean() - first.variance.mean()) / result.gain.sensor.value
        if rise > 0 and last.mean_dn.mean() - first.mean_dn.mean() > rise / 2 > 0.5:
            return False
    return True


def _hot(results: Sequence[IsoResult], full_well_e: float) -> tuple[Estimate | None, Estimate | None]:
    """Return share and mean current of hot pixels, from the darks that show the most currents.

    The currents are exponentially distributed (the profile's law), so those above a threshold have the mean of all plus
    the threshold. Full pixels are censored: they add to the sum of the currents, but not to their number.
    """
    from scipy.stats import chi2

    measured = list[tuple[int, float, int, float]]()
    for result in results:
        gain, dark = result.gain.sensor.value, result.darks[-1]
        if dark.exposure_s < LEAST_HOT_EXPOSURE_S:
            continue
        limit = LARGEST_HOT * min(dark.hot_white_dn, full_well_e * gain)
        known = int(np.count_nonzero(dark.hot_dn < limit))
        above = float((np.minimum(dark.hot_dn, limit) - dark.hot_threshold_dn).sum()) / (gain * dark.exposure_s)
        least = dark.hot_threshold_dn / (gain * dark.exposure_s)
        measured.append((known, least, len(dark.hot_dn), max(above, 1e-3 * least)))
    if not measured:
        return None, None
    known, least, count, total = max(measured, key=lambda numbers: numbers[0])
    share = share_estimate(count, 4 * results[0].dark.measured.sites)
    if not known:
        return share, None
    mean, ends = total / known, 2 * total / chi2.ppf((0.975, 0.025), 2 * known)
    return share.scaled(math.exp(min(least / mean, 1.0))), Estimate(mean, *map(float, ends))


def share_estimate(count: int, sites: int) -> Estimate:
    """Return the share of rare pixels with its exact Poisson interval."""
    from scipy.stats import chi2

    low = chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    return Estimate(count / sites, float(low) / sites, float(chi2.ppf(0.975, 2 * count + 2)) / 2 / sites)


def _dead(results: Sequence[IsoResult], black_dn: float) -> tuple[Estimate | None, Estimate | None]:
    """Return share of dead pixels and their value relative to black, from the brightest flats."""
    bright = [flat for result in results for flat in usable(result.flats) if flat.is_bright]
    if not bright:
        return None, None
    flat = max(bright, key=lambda flat: flat.signal_dn / math.sqrt(float(flat.measured.variance.mean())))
    share = share_estimate(len(flat.dead_dn), 4 * flat.measured.sites)
    if not len(flat.dead_dn) or not black_dn:
        return share, None
    level = flat.dead_dn / black_dn
    return share, estimate(min(float(np.median(level)), 1.0), float(level.std()) / math.sqrt(len(level)), 0.0)
