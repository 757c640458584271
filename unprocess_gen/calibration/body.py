"""Combine what all ISOs show of numbers that do not depend on ISO: fixed patterns, dark current, defects, full well."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from unprocess_gen.calibration.captures import Sensor
from unprocess_gen.calibration.gain import Estimate, combined, estimate, root_estimate, weighted_slope
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
class Body:
    """Numbers of the camera body by name, None for those that captures do not show; temperature of the dark current.

    PRNU is that of the sensor, then of each plane; the others are of the sensor.
    """

    numbers: dict[str, list[Estimate | None]]
    reference_c: float | None

    def __getitem__(self, name: str) -> Estimate | None:
        """Return an estimate of the sensor."""
        return self.numbers[name][0]


def measure_body(results: Sequence[IsoResult], sensor: Sensor) -> Body:
    """Combine the results of all ISOs."""
    planes = (range(4), *((plane,) for plane in range(4)))
    prnus = [_prnu(results, chosen) for chosen in planes] if any(result.prnu_squares for result in results) else []
    currents = _dark_currents(results)
    warmest = max(currents, default=None)
    current = combined(currents[warmest]) if warmest is not None else None
    wells = [result.full_well_dn.over(result["dn_per_e"]) for result in results if result.full_well_dn]
    well = wells[0] if wells else None
    hot_share, hot_current = _hot(results, sensor, well.value if well else math.inf)
    dead_share, dead_level = _dead(results, sensor.black_dn)
    dsnus = [
        result["dsnu_std_dn"].scaled(1 / result["dn_per_e"].value) for result in results if result["dsnu_std_dn"].value
    ]
    numbers = {
        "dsnu_std_e": combined(dsnus) if dsnus else None,
        "dark_e_per_s": current if current is not None and current.low > 0 else None,
        "dark_doubling_c": _doubling(currents),
        "hot_pixel_share": hot_share,
        "hot_pixel_e_per_s": hot_current,
        "dead_pixel_share": dead_share,
        "dead_pixel_level": dead_level,
        "full_well_e": well,
    }
    prnu = prnus[0] if prnus and prnus[0].value > 0 else None
    listed = {"prnu_std": [prnu, *prnus[1:]]} | {name: [number] for name, number in numbers.items()}
    return Body(listed, warmest or None)


def without_dark_current(result: IsoResult, body: Body) -> IsoResult:
    """Return a result whose read noise does not contain the dark current of its darks: K²·D·t less variance."""
    current, doubling = body["dark_e_per_s"], body["dark_doubling_c"]
    if current is None:
        return result
    celsius, warmth = result.dark.frames[0].temperature_c, 1.0
    if celsius is not None and body.reference_c is not None and doubling is not None:
        warmth = 2 ** ((celsius - body.reference_c) / doubling.value)
    added = current.scaled(result["dn_per_e"].value ** 2 * result.dark.exposure_s * warmth)
    reads = [
        root_estimate(read.value**2 - added.value, math.hypot(2 * read.value * read.error, added.error))
        for read in result.numbers["read_std_dn"]
    ]
    return replace(result, numbers=result.numbers | {"read_std_dn": reads})


def _prnu(results: Sequence[IsoResult], planes: Sequence[int]) -> Estimate:
    """Return the PRNU of planes: √((fixed variance of flats - of darks) / signal²), weighted over ISOs."""
    squares = [result.prnu_squares[plane] for result in results if result.prnu_squares for plane in planes]
    values, errors = np.array(squares).T
    weights, sites = 1 / errors**2, results[0].dark.measured.sites * len(planes)
    square = float(weights @ values / weights.sum())
    # the pixels are a sample of the sensor's
    return root_estimate(square, math.hypot(float(weights.sum()) ** -0.5, square * math.sqrt(2 / sites)))


def _dark_currents(results: Sequence[IsoResult]) -> dict[float, list[Estimate]]:
    """Return the dark currents of all ISOs by temperature (0 if it is not stated): slope of σ²/K² over the exposure."""
    currents = defaultdict(list)
    for result in results:
        sensor, *planes = result.numbers["dn_per_e"]
        gains = np.array([gain.value for gain in (planes if result.has_colours else [sensor] * 4)])
        by_temperature = defaultdict(list)
        for dark in result.darks:
            by_temperature[dark.frames[0].temperature_c or 0.0].append(dark)
        for temperature, darks in by_temperature.items():
            seconds = np.array([dark.exposure_s for dark in darks])
            if seconds.max() < LEAST_EXPOSURE_RATIO * seconds.min() or seconds.max() == 0:
                continue
            electrons = np.array([(dark.measured.variance / gains**2).mean() for dark in darks])
            errors = np.array([np.linalg.norm(dark.measured.error / gains**2) / 4 for dark in darks])
            slope = weighted_slope(seconds, electrons, errors)
            gain_error = 2 * slope.value * sensor.error / sensor.value
            currents[temperature].append(estimate(slope.value, math.hypot(slope.error, gain_error)))
    return dict(currents)


def _doubling(currents: dict[float, list[Estimate]]) -> Estimate | None:
    """Return the rise of the temperature that doubles the dark current; None without two temperatures."""
    points = [(celsius, combined(values)) for celsius, values in sorted(currents.items())]
    points = [(celsius, value) for celsius, value in points if value.low > 0]
    if len(points) < 2 or points[-1][0] - points[0][0] < LEAST_WARMING_C:
        return None
    numbers = [(celsius, value.value, value.error) for celsius, value in points]
    celsius, values, errors = np.array(numbers).T
    slope = weighted_slope(celsius, np.log2(values), errors / values / math.log(2))
    return estimate(1 / slope.value, slope.error / slope.value**2) if slope.value > 0 else None


def _hot(results: Sequence[IsoResult], sensor: Sensor, full_well_e: float) -> tuple[Estimate | None, Estimate | None]:
    """Return share and mean current of hot pixels, from the darks that show the most currents.

    The currents are exponentially distributed (the profile's law), so those above a threshold have the mean of all plus
    the threshold. Full pixels are censored: they add to the sum of the currents, but not to their number.
    """
    from scipy.special import gammaincinv

    measured = list[tuple[int, float, int, float]]()
    for result in results:
        gain, dark = result["dn_per_e"].value, result.darks[-1]
        if dark.exposure_s < LEAST_HOT_EXPOSURE_S:
            continue
        limit = LARGEST_HOT * min(sensor.white_dn - float(dark.measured.mean_dn.max()), full_well_e * gain)
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
    mean, ends = total / known, total / gammaincinv(known, (0.975, 0.025))
    return share.scaled(math.exp(min(least / mean, 1.0))), Estimate(mean, *map(float, ends))


def share_estimate(count: int, sites: int) -> Estimate:
    """Return the share of rare pixels with its exact Poisson interval."""
    from scipy.special import gammaincinv  # scipy.stats takes seconds to import

    low = float(gammaincinv(count, 0.025)) if count else 0.0
    return Estimate(count / sites, low / sites, float(gammaincinv(count + 1, 0.975)) / sites)


def _dead(results: Sequence[IsoResult], black_dn: float) -> tuple[Estimate | None, Estimate | None]:
    """Return share of dead pixels and their value relative to black, from the brightest flats."""
    bright = [flat for result in results for flat in usable(result.flats) if flat.dead_dn is not None]
    if not bright:
        return None, None
    flat = max(bright, key=lambda flat: flat.signal_dn / math.sqrt(float(flat.measured.variance.mean())))
    dead_dn, sites = np.asarray(flat.dead_dn), 4 * flat.measured.sites
    share = share_estimate(len(dead_dn), sites)
    if not len(dead_dn) or not black_dn:
        return share, None
    level = dead_dn / black_dn
    return share, estimate(min(float(np.median(level)), 1.0), float(level.std()) / math.sqrt(len(level)), 0.0)
