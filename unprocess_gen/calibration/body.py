"""Combine what all ISOs show of the body: fixed patterns, dark current, hot pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from unprocess_gen.calibration.captures import Sensor
from unprocess_gen.calibration.gain import (
    Estimate,
    combined,
    estimate,
    root_estimate,
    weighted_mean,
    weighted_slope,
)
from unprocess_gen.calibration.measure import IsoResult

LEAST_EXPOSURE_RATIO = 2.0
"""Least ratio of exposures from which dark current is measured."""
LEAST_HOT_EXPOSURE_S = 0.2
"""Least exposure of darks that show hot pixels. Chosen: their excess is some electrons then."""
LARGEST_HOT = 0.95
"""Signal of hot pixels, as a fraction of white, from which their current is not known."""


def measure_body(results: Sequence[IsoResult], sensor: Sensor) -> dict[str, Estimate | None]:
    """Combine the results of all ISOs: numbers of the camera body by name, None for those that captures do not show."""
    prnu = _prnu(results)
    currents = [current for result in results if (current := _dark_current(result)) is not None]
    hot_share, hot_current = _hot(results, sensor)
    dsnus = [
        result["dsnu_std_dn"].scaled(1 / result["dn_per_e"].value) for result in results if result["dsnu_std_dn"].value
    ]
    return {
        "prnu_std": prnu if prnu is not None and prnu.value > 0 else None,
        "dsnu_std_e": combined(dsnus) if dsnus else None,
        "dark_e_per_s": current if currents and (current := combined(currents)).low > 0 else None,
        "hot_pixel_share": hot_share,
        "hot_pixel_e_per_s": hot_current,
    }


def _prnu(results: Sequence[IsoResult]) -> Estimate | None:
    """Return the PRNU: √((fixed variance of flats - of darks) / signal²), weighted over ISOs."""
    squares = [result.prnu_square for result in results if result.prnu_square is not None]
    if not squares:
        return None
    square, error = weighted_mean(*np.transpose(squares))
    # the pixels are a sample of the sensor's
    return root_estimate(square, math.hypot(error, square * math.sqrt(2 / 4 / results[0].dark.measured.sites)))


def _dark_current(result: IsoResult) -> Estimate | None:
    """Return the dark current that an ISO shows: slope of σ²/K² over the exposure; None without several exposures."""
    seconds = np.array([dark.exposure_s for dark in result.darks])
    if seconds.max() < LEAST_EXPOSURE_RATIO * seconds.min() or seconds.max() == 0:
        return None
    sensor, *planes = result.numbers["dn_per_e"]
    gains = np.array([gain.value for gain in planes or [sensor] * 4])
    electrons = np.array([(dark.measured.variance / gains**2).mean() for dark in result.darks])
    errors = np.array([np.linalg.norm(dark.measured.error / gains**2) / 4 for dark in result.darks])
    slope = weighted_slope(seconds, electrons, errors)
    return estimate(slope.value, math.hypot(slope.error, 2 * slope.value * sensor.error / sensor.value))


def _hot(results: Sequence[IsoResult], sensor: Sensor) -> tuple[Estimate | None, Estimate | None]:
    """Return share and mean current of hot pixels, from the darks that show the most currents.

    The currents are exponentially distributed (the profile's law), so those above a threshold have the mean of all plus
    the threshold. Full pixels are censored: they add to the sum of the currents, but not to their number.
    """
    from scipy.special import gammaincinv  # scipy.stats takes seconds to import

    measured = list[tuple[int, float, int, float]]()
    for result in results:
        gain, dark = result["dn_per_e"].value, result.darks[-1]
        if dark.exposure_s < LEAST_HOT_EXPOSURE_S:
            continue
        limit = LARGEST_HOT * (sensor.white_dn - float(dark.measured.mean_dn.max()))
        above = float((np.minimum(dark.hot_dn, limit) - dark.hot_threshold_dn).sum()) / (gain * dark.exposure_s)
        least = dark.hot_threshold_dn / (gain * dark.exposure_s)
        measured.append((int((dark.hot_dn < limit).sum()), least, len(dark.hot_dn), max(above, 1e-3 * least)))
    if not measured:
        return None, None
    known, least, count, total = max(measured)
    sites = 4 * results[0].dark.measured.sites
    low = float(gammaincinv(count, 0.025)) if count else 0.0  # exact Poisson interval
    share = Estimate(count, low, float(gammaincinv(count + 1, 0.975))).scaled(1 / sites)
    if not known:
        return share, None
    mean, ends = total / known, total / gammaincinv(known, (0.975, 0.025))
    return share.scaled(math.exp(min(least / mean, 1.0))), Estimate(mean, *map(float, ends))
