"""Calibrate a camera: measure its captures ISO by ISO, and combine what all ISOs show of the sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from unprocess_gen.calibration.captures import CaptureSet, Sensor, common
from unprocess_gen.calibration.gain import Estimate, combined, estimate, root_estimate, weighted_mean, weighted_slope
from unprocess_gen.calibration.iso_results import IsoResult, Watch, measure_iso

LEAST_EXPOSURE_RATIO = 2.0
"""Least ratio of exposures from which dark current is measured."""
LEAST_HOT_EXPOSURE_S = 0.2
"""Least exposure of darks that show hot pixels. Chosen: their excess is some electrons then."""
LARGEST_HOT = 0.95
"""Signal of hot pixels, as a fraction of white, from which their current is not known."""
NULL = ("prnu_std", "dark_e_per_s", "hot_pixel_share")
"""Numbers that are null in a profile if captures do not show them; others are left out."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Everything measured on captures.

    ``shared`` are the numbers of all ISOs together, None where captures do not show them; ``celsius`` is the
    temperature of the darks, if it is stated.
    """

    captures: CaptureSet
    isos: list[IsoResult]
    shared: dict[str, Estimate | None]
    celsius: float | None


def calibrate(
    captures: CaptureSet, watch: Watch = lambda frames: frames, gains: Mapping[float, Estimate] | None = None
) -> Calibration:
    """Measure each ISO, and what all ISOs show together; ``watch`` shows progress. ConfigError or MachineError.

    Of ISOs whose gain is given, darks alone are measured.
    """
    results = [measure_iso(captures, iso, watch, (gains or {}).get(iso)) for iso in captures.isos]
    hot_share, hot_current = _hot(results, captures.sensor)
    shared = {
        "prnu_std": _prnu(results),
        "dsnu_std_e": _dsnu(results),
        "dark_e_per_s": _dark_current(results),
        "hot_pixel_share": hot_share,
        "hot_pixel_e_per_s": hot_current,
    }
    darks = {capture.path: capture for capture in captures.captures if capture.kind == "dark"}
    advice = "is null: the captures do not show it; the guide on calibration lists the frames that do"
    captures.notes.extend(f"{name} {advice}" for name in NULL if shared[name] is None)
    return Calibration(captures, results, shared, common(darks, "temperature_c"))


def _prnu(results: Sequence[IsoResult]) -> Estimate | None:
    """The PRNU: √((fixed variance of flats - of darks) / signal²), weighted over ISOs."""
    squares = [result.prnu_square for result in results if result.prnu_square is not None]
    if not squares:
        return None
    square, error = weighted_mean(*np.transpose(squares))
    # the pixels are a sample of the sensor's
    prnu = root_estimate(square, math.hypot(error, square * math.sqrt(2 / 4 / results[0].dark.measured.sites)))
    return prnu if prnu.value > 0 else None


def _dsnu(results: Sequence[IsoResult]) -> Estimate | None:
    """The fixed pattern in electrons, from the ISOs that show one."""
    shown = [result for result in results if result["dsnu_std_dn"].value]
    return combined([result["dsnu_std_dn"].scaled(1 / result["dn_per_e"].value) for result in shown]) if shown else None


def _dark_current(results: Sequence[IsoResult]) -> Estimate | None:
    """The dark current: slope of σ²/K² over the exposure, from the ISOs with several exposures."""
    currents = list[Estimate]()
    for result in results:
        seconds = np.array([dark.exposure_s for dark in result.darks])
        if seconds.max() < LEAST_EXPOSURE_RATIO * seconds.min() or seconds.max() == 0:
            continue
        sensor, *planes = result.numbers["dn_per_e"]
        gains = np.array([gain.value for gain in planes or [sensor] * 4])
        electrons = np.array([(dark.measured.variance / gains**2).mean() for dark in result.darks])
        errors = np.array([np.linalg.norm(dark.measured.error / gains**2) / 4 for dark in result.darks])
        slope = weighted_slope(seconds, electrons, errors)
        currents.append(estimate(slope.value, math.hypot(slope.error, 2 * slope.value * sensor.error / sensor.value)))
    current = combined(currents) if currents else None
    return current if current is not None and current.low > 0 else None


def _hot(results: Sequence[IsoResult], sensor: Sensor) -> tuple[Estimate | None, Estimate | None]:
    """Share and mean current of hot pixels, from the darks that show the most currents.

    The currents are exponentially distributed (as in the profile), so those above a threshold have the mean of all plus
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
