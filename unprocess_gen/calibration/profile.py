"""Write measured noise as a noise profile in YAML, and as a list of estimates in JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import yaml

from unprocess_gen.calibration.body import Body
from unprocess_gen.calibration.captures import CaptureSet, Sensor
from unprocess_gen.calibration.gain import Estimate, estimate
from unprocess_gen.calibration.iso_laws import (
    DIGITS,
    black_law,
    gain_law,
    joined_branches,
    modes,
    rounded,
    shape_law,
    std_law,
)
from unprocess_gen.calibration.measure import IsoResult
from unprocess_gen.calibration.shape import NORMAL_SHAPE
from unprocess_gen.simulation.reference.cfa import MONO
from unprocess_gen.statistics.mosaics import plane_names

MARK = "by gen-dataset calibrate"
"""Part of the first line of a profile, by which a later run recognises it."""


UNITS = {
    "dn_per_e": "DN/e",
    "b_dn2": "DN²",
    "dark_e_per_s": "e/s",
    "hot_pixel_e_per_s": "e/s",
    "dark_doubling_c": "degrees Celsius",
}
"""Units of numbers; others are in DN or in electrons as their names end, or without a unit."""


class NamedNumber(NamedTuple):
    """An estimate of the list: name, ISO and site (None for all), number (None if captures do not show it)."""

    name: str
    iso: float | None
    site: str | None
    number: Estimate | None

    @property
    def unit(self) -> str:
        """Unit, empty for a number without one."""
        return UNITS.get(self.name, {"dn": "DN", "e": "e"}.get(self.name.rpartition("_")[2], ""))


@dataclass(frozen=True, slots=True)
class Calibration:
    """Everything measured on a folder of captures."""

    captures: CaptureSet
    isos: list[IsoResult]
    body: Body
    notes: list[str]

    @property
    def sensor(self) -> Sensor:
        """Levels and pattern of the sensor."""
        return self.captures.sensor


def site_names(sensor: Sensor) -> list[str]:
    """Return the names of the planes of a sensor; none for a monochrome one, whose sites are equal."""
    return [] if sensor.pattern == MONO else plane_names(sensor.pattern)


def estimates(calibration: Calibration) -> list[NamedNumber]:
    """Return the list of all estimates: those of the body, then those of each ISO."""
    sites = site_names(calibration.sensor)
    listed = list(_named(calibration.body.numbers, None, sites))
    for result in calibration.isos:
        listed += _named(result.numbers, result.iso, sites)
    return listed


def _named(
    numbers: Mapping[str, Sequence[Estimate | None]], iso: float | None, sites: Sequence[str]
) -> Iterator[NamedNumber]:
    """Yield estimates of the sensor, then of its sites."""
    for name, (sensor, *planes) in numbers.items():
        yield NamedNumber(name, iso, None, sensor)
        yield from (NamedNumber(name, iso, site, plane) for site, plane in zip(sites, planes, strict=False))


def estimates_json(named: Sequence[NamedNumber], digits: int = DIGITS) -> str:
    """Return the list of estimates as JSON, an object a line; null where the captures do not show a number."""
    lines = []
    for entry in named:
        ends = {end: None if entry.number is None else rounded(getattr(entry.number, end), digits) for end in ENDS}
        ends = {end: value if value is None or math.isfinite(value) else None for end, value in ends.items()}
        lines.append(json.dumps({"name": entry.name, "iso": entry.iso, "site": entry.site, **ends, "unit": entry.unit}))
    return "[\n" + ",\n".join(lines) + "\n]\n"


ENDS = ("value", "low", "high")
ASSUMED_C = 25.0
"""Temperature of darks that do not state it."""

UNKNOWN_REASONS = {
    "prnu_std": "more flats of each level show it",
    "dark_e_per_s": "darks of several exposures, up to some seconds, show it",
    "hot_pixel_share": "darks of 0.2 s or more show it",
    "dead_pixel_share": "flats above 5 % of white show it",
    "full_well_e": "a series of flats up to saturation, at the lowest ISO, shows it",
}
"""What shows a number that the captures do not."""


def unknown_numbers(calibration: Calibration) -> list[str]:
    """Return a note for each number that is null."""
    return [
        f"{name} is null: the captures do not show it; {advice}"
        for name, advice in UNKNOWN_REASONS.items()
        if calibration.body[name] is None
    ]


# ---------------------------------------------------------------------------------------------------------------- YAML


def profile_yaml(start: str, sha256: str, notes: Sequence[str], profile: Mapping[str, Any]) -> str:
    """Return a profile as YAML, with the source and notes in comments; ``start`` is the source in words."""
    lines = [
        f"# {start}.",
        "# SHA-256 of the list of their SHA-256, one a line in ascending order:",
        f"# {sha256}",
        "# The JSON file of this name lists all estimates with their 95 % intervals, systematic errors included.",
        *(f"# Note: {note}" for note in notes),
    ]
    text = yaml.safe_dump(profile, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None)
    return "\n".join(lines) + "\n" + text


def profile_head(name: str, sensor: Sensor) -> dict[str, Any]:
    """Return the first keys of a profile."""
    levels = {"bits": sensor.bits, "black_level_dn": round(sensor.black_dn), "white_level_dn": round(sensor.white_dn)}
    return {"name": name, "scatter": "off", "units": "dn", "black": "subtracted", **levels}


def provenance(numbers: Sequence[str], isos: Sequence[float], source: str, uncertainty: str) -> dict[str, Any]:
    """Return a statement of sources, which `plan` prints."""
    return {"numbers": [*numbers], "iso": [isos[0], isos[-1]], "source": source, "uncertainty": uncertainty}


def measured_yaml(calibration: Calibration, name: str) -> str:
    """Return the noise profile of measured frames."""
    profile, isos = profile_head(name, calibration.sensor), [result.iso for result in calibration.isos]
    branches = [[calibration.isos[place] for place in places] for places in iso_branches(calibration.isos)]
    profile["branches"] = [_branch(results, calibration.sensor) for results in branches]
    profile |= _common_keys(calibration)
    written = {*profile, *(key for branch in profile["branches"] for key in branch)}
    profile["provenance"] = [_provenance(calibration, written)]
    frames = f"{len(calibration.captures.captures)} raw frames, ISO {', '.join(f'{iso:g}' for iso in isos)}"
    return profile_yaml(f"Measured {MARK} on {frames}", calibration.captures.sha256, calibration.notes, profile)


def iso_branches(results: Sequence[IsoResult]) -> list[list[int]]:
    """Return the places of the ISOs of each branch."""
    isos = [result.iso for result in results]
    gains, reads = ([result[name] for result in results] for name in ("dn_per_e", "read_std_dn"))
    return joined_branches(isos, gains, modes(isos, reads))


def dark_variance(result: IsoResult) -> Estimate:
    """Return the variance of a site without light, DN², all dark noise but rounding."""
    names = ("read_std_dn", "row_std_dn", "column_std_dn", "column_temporal_std_dn", "dsnu_std_dn")
    stds = [result[name] for name in names]
    error = 2 * math.sqrt(sum((std.value * std.error) ** 2 for std in stds))
    return estimate(sum(std.value**2 for std in stds), error, 0.0)


def _branch(results: Sequence[IsoResult], sensor: Sensor) -> dict[str, Any]:
    """Return a branch of neighbouring ISOs: gain, and noise without light."""
    isos, gains = [result.iso for result in results], [result["dn_per_e"] for result in results]
    branch = {"iso": [isos[0], isos[-1]], "dn_per_e": gain_law(isos, gains), "read_law": "gaussian"}
    shapes = [result.shapes[0] for result in results]
    if any(shape.is_tukey for shape in shapes):
        values = [shape.shape if shape.is_tukey else NORMAL_SHAPE for shape in shapes]
        branch |= {"read_law": "tukey_lambda", "read_shape": shape_law(isos, values)}
    for name in ("read_std_dn", "row_std_dn", "column_std_dn"):
        branch[name] = std_law(isos, [result[name] for result in results])
    if (temporal := max(result["column_temporal_std_dn"].value for result in results)) > 0:  # the key takes no table
        branch["column_temporal_std_dn"] = rounded(temporal)
    names = site_names(sensor)
    # of red, both greens and blue; a monochrome sensor has one
    places = [1 + names.index(name) for name in ("R", "Gr", "B", "Gb")] if names else [0]
    blacks = [[result.numbers["black_error_dn"][place].value for place in places] for result in results]
    return branch | {"black_error_dn": black_law(isos, blacks, bool(names))}


WITH_DEFAULTS = ("dark_doubling_c", "dead_pixel_level", "dsnu_std_e", "hot_pixel_e_per_s")
"""Keys that are left out if the captures do not show them: null is no value of theirs."""


def _common_keys(calibration: Calibration) -> dict[str, Any]:
    """Return the keys that do not depend on ISO; null for numbers that the captures do not show."""
    keys: dict[str, Any] = {} if (gains := _gains_by_colour(calibration)) is None else {"gain_by_colour": gains}
    correlations = [result["row_correlation"] for result in calibration.isos]
    row = max(correlations, key=lambda number: abs(number.value) / max(number.error, 1e-9))
    if abs(row.value) > 4 * row.error and abs(row.value) > 0.02:
        keys["row_correlation"] = rounded(max(min(row.value, 0.95), -0.95))
    for name, (number, *_) in calibration.body.numbers.items():
        if number is not None or name not in WITH_DEFAULTS:
            keys[name] = None if number is None else rounded(number.value)
    if calibration.body["dark_e_per_s"] is not None:
        keys["dark_reference_c"] = calibration.body.reference_c or ASSUMED_C
    return keys


def _gains_by_colour(calibration: Calibration) -> list[float] | None:
    """Return the gains of red, green and blue relative to the sensor's, if they differ at most ISOs."""
    names = site_names(calibration.sensor)
    differing = [result.numbers["dn_per_e"] for result in calibration.isos if result.has_colours]
    if not names or 2 * len(differing) <= len(calibration.isos):
        return None
    relative = [[plane.value / sensor.value for plane in planes] for sensor, *planes in differing]
    means = dict(zip(names, (sum(values) / len(values) for values in zip(*relative, strict=True)), strict=True))
    return [rounded(means["R"]), rounded((means["Gr"] + means["Gb"]) / 2), rounded(means["B"])]


ABSOLUTE = ("black_error_dn", "read_shape", "row_correlation")
"""Numbers whose errors are not stated relative to them, because they may be near 0."""


def _provenance(calibration: Calibration, written: Iterable[str]) -> dict[str, Any]:
    """Return the source of the numbers of a profile, and the largest error of each."""
    isos, widths = [result.iso for result in calibration.isos], dict[str, tuple[float, str]]()
    for entry in estimates(calibration):
        if entry.site is None and entry.number is not None and entry.number.value and entry.name in written:
            half = (entry.number.high - entry.number.low) / 2
            width, unit = (half, entry.unit) if entry.name in ABSOLUTE else (100 * half / abs(entry.number.value), "%")
            widths[entry.name] = max(widths.get(entry.name, (0.0, unit)), (width, unit))
    digest = calibration.captures.sha256[:16]
    source = f"calibrate, own flats and darks, {len(calibration.captures.captures)} frames, SHA-256 {digest}"
    errors = ", ".join(f"{name} ±{width:.2g} {unit}".strip() for name, (width, unit) in widths.items())
    return provenance([*widths], isos, source, f"{errors} (95 %, systematic errors included)")
