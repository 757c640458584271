"""Write measured noise as a noise profile in YAML, and as a list of estimates in JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import yaml

from unprocess_gen.calibration.captures import CaptureSet, Sensor
from unprocess_gen.calibration.gain import Estimate, combined, estimate
from unprocess_gen.calibration.iso_laws import DIGITS, black_law, modes, rounded, table
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
    """Everything measured on a folder of captures; ``celsius`` is the temperature of the darks, if it is stated."""

    captures: CaptureSet
    isos: list[IsoResult]
    body: dict[str, Estimate | None]
    celsius: float | None
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
    listed = [NamedNumber(name, None, None, number) for name, number in calibration.body.items()]
    for result in calibration.isos:
        listed += _named(result.numbers, result.iso, sites)
    return listed


def _named(numbers: Mapping[str, Sequence[Estimate]], iso: float, sites: Sequence[str]) -> Iterator[NamedNumber]:
    """Yield estimates of the sensor, then of its sites."""
    for name, (sensor, *planes) in numbers.items():
        yield NamedNumber(name, iso, None, sensor)
        yield from (NamedNumber(name, iso, site, plane) for site, plane in zip(sites, planes, strict=False))


def estimates_json(named: Sequence[NamedNumber], digits: int = DIGITS) -> str:
    """Return the list of estimates as JSON, an object a line; null where the captures do not show a number."""
    lines = []
    for one in named:
        values = [getattr(one.number, end, math.inf) for end in ENDS]
        value, *interval = (rounded(value, digits) if math.isfinite(value) else None for value in values)
        number = {"value": value, "interval": interval, "unit": one.unit}
        lines.append({"name": one.name, "iso": one.iso, "site": one.site, **number})
    return "[\n" + ",\n".join(map(json.dumps, lines)) + "\n]\n"


ENDS = ("value", "low", "high")
ASSUMED_C = 25.0
"""Temperature of darks that do not state it."""
SAME_GAIN = 0.003
"""Largest difference of the gains of colours that are not written."""
LEAST_CORRELATION = 0.02
"""Least correlation of neighbouring rows that is written."""
SHAPE_DIGITS = 4

NULL = ("prnu_std", "dark_e_per_s", "hot_pixel_share")
"""Numbers that are null in a profile if captures do not show them; others are left out."""


def unknown_numbers(body: Mapping[str, Estimate | None]) -> list[str]:
    """Return a note for each number that is null."""
    advice = "the captures do not show it; the guide on calibration lists the frames that do"
    return [f"{name} is null: {advice}" for name in NULL if body[name] is None]


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
    isos, digest = [result.iso for result in calibration.isos], calibration.captures.sha256
    places = modes(isos, [result["read_std_dn"] for result in calibration.isos])
    branches = [_branch([calibration.isos[place] for place in mode], calibration.sensor) for mode in places]
    profile = profile_head(name, calibration.sensor) | {"branches": branches} | _common_keys(calibration)
    listed = {entry.name for entry in estimates(calibration) if entry.number is not None}
    written = [key for key in (*branches[0], *profile) if key in listed]
    source = f"calibrate, own flats and darks, {len(calibration.captures.captures)} frames, SHA-256 {digest[:16]}"
    profile["provenance"] = [provenance(written, isos, source, f"95 % intervals in {name}.json")]
    frames = f"{len(calibration.captures.captures)} raw frames, ISO {', '.join(f'{iso:g}' for iso in isos)}"
    return profile_yaml(f"Measured {MARK} on {frames}", digest, calibration.notes, profile)


def dark_variance(result: IsoResult) -> Estimate:
    """Return the variance of a site without light, DN², all dark noise but rounding."""
    names = ("read_std_dn", "row_std_dn", "column_std_dn", "column_temporal_std_dn", "dsnu_std_dn")
    stds = [result[name] for name in names]
    error = 2 * math.sqrt(sum((std.value * std.error) ** 2 for std in stds))
    return estimate(sum(std.value**2 for std in stds), error, 0.0)


def _branch(results: Sequence[IsoResult], sensor: Sensor) -> dict[str, Any]:
    """Return a branch of neighbouring ISOs: gain, and noise without light."""
    isos, shapes = [result.iso for result in results], [result.shape for result in results]
    branch: dict[str, Any] = {"iso": [isos[0], isos[-1]], "read_law": "gaussian"}
    if any(shape.is_tukey for shape in shapes):
        values = [shape.interval.value if shape.is_tukey else NORMAL_SHAPE for shape in shapes]
        branch |= {"read_law": "tukey_lambda", "read_shape": table(isos, values, SHAPE_DIGITS)}
    for name in ("dn_per_e", "read_std_dn", "row_std_dn", "column_std_dn"):
        branch[name] = table(isos, [result[name].value for result in results])
    if (temporal := max(result["column_temporal_std_dn"].value for result in results)) > 0:  # the key takes no table
        branch["column_temporal_std_dn"] = rounded(temporal)
    names = site_names(sensor)
    # of red, both greens and blue; a monochrome sensor has one
    places = [1 + names.index(name) for name in ("R", "Gr", "B", "Gb")] if names else [0]
    blacks = [[result.numbers["black_error_dn"][place].value for place in places] for result in results]
    return branch | {"black_error_dn": black_law(isos, blacks)}


def _common_keys(calibration: Calibration) -> dict[str, Any]:
    """Return the keys that do not depend on ISO; null for numbers that the captures do not show."""
    keys: dict[str, Any] = {} if (gains := _gains_by_colour(calibration)) is None else {"gain_by_colour": gains}
    rows = [result["row_correlation"] for result in calibration.isos]
    row = max(rows, key=lambda number: abs(number.value) / max(number.error, 1e-9))
    if abs(row.value) > max(4 * row.error, LEAST_CORRELATION):
        keys["row_correlation"] = rounded(max(min(row.value, 0.95), -0.95))
    for name, number in calibration.body.items():
        if number is not None or name in NULL:
            keys[name] = None if number is None else rounded(number.value)
    if calibration.body["dark_e_per_s"] is not None:
        keys["dark_reference_c"] = ASSUMED_C if calibration.celsius is None else calibration.celsius
    return keys


def _gains_by_colour(calibration: Calibration) -> list[float] | None:
    """Return the gains of red, green and blue relative to the sensor's, if they differ by more than their errors."""
    sites, colours = site_names(calibration.sensor), list[Estimate]()
    for colour in ("R", "G", "B") if sites else ():
        places = [1 + place for place, site in enumerate(sites) if site[0] == colour]
        relative = [
            result.numbers["dn_per_e"][place].scaled(1 / result["dn_per_e"].value)
            for result in calibration.isos
            for place in places
        ]
        colours.append(combined(relative))
    differ = any(abs(gain.value - 1) > max(4 * gain.error, SAME_GAIN) for gain in colours)
    return [rounded(gain.value) for gain in colours] if differ else None
