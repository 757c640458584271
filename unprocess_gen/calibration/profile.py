"""Write measured noise as a noise profile in YAML, and as a list of estimates in JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import yaml

from unprocess_gen.calibration.body import BodyResult
from unprocess_gen.calibration.captures import CaptureSet, Sensor
from unprocess_gen.calibration.frame_sums import plane_names
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

MARK = "by gen-dataset calibrate"
"""Part of the first line of a profile, by which a later run recognises it."""


class NamedNumber(NamedTuple):
    """An estimate of the list: name, ISO and site (None for all), number (None if captures do not show it), unit."""

    name: str
    iso: float | None
    site: str | None
    number: Estimate | None
    unit: str


class KnownGain(NamedTuple):
    """Gains by ISO of a calibration without flats, with their source and what is known of their error."""

    source: str
    uncertainty: str
    by_iso: Mapping[float, Estimate]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Everything measured on a folder of captures; ``known`` is the gain if they are darks alone."""

    captures: CaptureSet
    isos: list[IsoResult]
    body: BodyResult
    notes: list[str]
    known: KnownGain | None = None

    @property
    def sensor(self) -> Sensor:
        """Levels and pattern of the sensor."""
        return self.captures.sensor


def site_names(sensor: Sensor) -> list[str]:
    """Return the names of the planes of a sensor; none for a monochrome one, whose sites are equal."""
    return [] if sensor.pattern == "MONO" else plane_names(sensor.pattern)


def estimates(calibration: Calibration) -> list[NamedNumber]:
    """Return the list of all estimates."""
    sites, known = site_names(calibration.sensor), calibration.known
    by_iso = [_iso_estimates(result, known, sites) for result in calibration.isos]
    return [*_body_estimates(calibration), *(entry for entries in by_iso for entry in entries)]


def _iso_estimates(result: IsoResult, known: KnownGain | None, sites: Sequence[str]) -> Iterator[NamedNumber]:
    """Yield the estimates of one ISO."""
    iso, shape = result.iso, result.shape
    gain = known.by_iso.get(iso, result.gain.sensor) if known else result.gain.sensor
    yield NamedNumber("dn_per_e", iso, None, gain, "DN/e")
    if result.curves:
        yield NamedNumber("dn_per_e_emva1288", iso, None, estimate(result.emva_gain, result.gain.sensor.error), "DN/e")
    yield NamedNumber("read_std_dn", iso, None, result.read, "DN")
    yield NamedNumber("read_shape", iso, None, shape.interval, "")
    yield NamedNumber("row_std_dn", iso, None, result.row, "DN")
    yield NamedNumber("row_correlation", iso, None, result.row_correlation, "")
    yield NamedNumber("column_std_dn", iso, None, result.column, "DN")
    yield NamedNumber("column_temporal_std_dn", iso, None, result.column_temporal, "DN")
    yield NamedNumber("dsnu_std_dn", iso, None, result.dsnu_dn, "DN")
    yield NamedNumber("black_error_dn", iso, None, result.black[-1], "DN")
    for site, gain in zip(sites, result.gain.planes, strict=False):
        yield NamedNumber("dn_per_e", iso, site, gain, "DN/e")
    for site, read, plane_shape, error in zip(sites, result.reads, result.shapes, result.black, strict=False):
        yield NamedNumber("read_std_dn", iso, site, read, "DN")
        yield NamedNumber("read_shape", iso, site, plane_shape.interval, "")
        yield NamedNumber("black_error_dn", iso, site, error, "DN")


def _body_estimates(calibration: Calibration) -> Iterator[NamedNumber]:
    """Yield the estimates that do not depend on ISO."""
    body = calibration.body
    yield NamedNumber("prnu_std", None, None, body.prnu, "")
    for site, prnu in zip(site_names(calibration.sensor), body.prnus, strict=False):
        yield NamedNumber("prnu_std", None, site, prnu, "")
    yield NamedNumber("dsnu_std_e", None, None, body.dsnu_e, "e")
    yield NamedNumber("dark_e_per_s", None, None, body.dark_e_per_s, "e/s")
    yield NamedNumber("dark_doubling_c", None, None, body.dark_doubling_c, "degrees Celsius")
    yield NamedNumber("hot_pixel_share", None, None, body.hot_share, "")
    yield NamedNumber("hot_pixel_e_per_s", None, None, body.hot_e_per_s, "e/s")
    yield NamedNumber("dead_pixel_share", None, None, body.dead_share, "")
    yield NamedNumber("dead_pixel_level", None, None, body.dead_level, "")
    yield NamedNumber("full_well_e", None, None, body.full_well_e, "e")


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
    known = {entry.name: entry.number for entry in _body_estimates(calibration) if entry.site is None}
    return [
        f"{name} is null: the captures do not show it; {advice}"
        for name, advice in UNKNOWN_REASONS.items()
        if known[name] is None
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


def measured_yaml(calibration: Calibration, name: str, two_parameter: bool) -> str:
    """Return the noise profile of measured frames."""
    profile, isos = profile_head(name, calibration.sensor), [result.iso for result in calibration.isos]
    if two_parameter and len(isos) == 1:
        result = calibration.isos[0]
        numbers = {"a": result.gain.sensor, "b": dark_variance(result)}
        profile |= {key: rounded(number.value) for key, number in numbers.items()} | {"negative_variance": "refuse"}
    else:
        branches = [[calibration.isos[place] for place in places] for places in iso_branches(calibration.isos)]
        profile["branches"] = [_branch(results, calibration.sensor, two_parameter) for results in branches]
        if not two_parameter:
            profile |= _common_keys(calibration)
        written = {*profile, *(key for branch in profile["branches"] for key in branch)}
        profile["provenance"] = _provenance(calibration, written)
    frames = f"{len(calibration.captures.captures)} raw frames, ISO {', '.join(f'{iso:g}' for iso in isos)}"
    return profile_yaml(f"Measured {MARK} on {frames}", calibration.captures.sha256, calibration.notes, profile)


def iso_branches(results: Sequence[IsoResult]) -> list[list[int]]:
    """Return the places of the ISOs of each branch."""
    isos, reads = [result.iso for result in results], [result.read for result in results]
    return joined_branches(isos, [result.gain.sensor for result in results], modes(isos, reads))


def dark_variance(result: IsoResult) -> Estimate:
    """Return the variance of a site without light, DN², all dark noise but rounding."""
    others = (result.row, result.column, result.column_temporal, result.dsnu_dn)
    value = result.read.value**2 + sum(number.value**2 for number in others)
    error = 2 * math.sqrt(sum((number.value * number.error) ** 2 for number in (result.read, *others)))
    return estimate(value, error, 0.0)


def _branch(results: Sequence[IsoResult], sensor: Sensor, two_parameter: bool) -> dict[str, Any]:
    """Return a branch; the keys of two numbers are gain, and noise without light."""
    isos, reads = [result.iso for result in results], [result.read for result in results]
    gains = [result.gain.sensor for result in results]
    branch = {"iso": [isos[0], isos[-1]], "dn_per_e": gain_law(isos, gains), "read_law": "gaussian"}
    if two_parameter:
        variances = [dark_variance(result) for result in results]
        reads = [estimate(math.sqrt(b.value), b.error / 2 / math.sqrt(b.value)) for b in variances]
        return branch | {"read_std_dn": std_law(isos, reads)}
    if any(result.shape.is_tukey for result in results):
        shapes = [result.shape.shape if result.shape.is_tukey else NORMAL_SHAPE for result in results]
        branch |= {"read_law": "tukey_lambda", "read_shape": shape_law(isos, shapes)}
    branch["read_std_dn"] = std_law(isos, reads)
    branch["row_std_dn"] = std_law(isos, [result.row for result in results])
    branch["column_std_dn"] = std_law(isos, [result.column for result in results])
    if (temporal := max(result.column_temporal.value for result in results)) > 0:  # the key takes no table
        branch["column_temporal_std_dn"] = rounded(temporal)
    blacks = [_by_colour([number.value for number in result.black], sensor) for result in results]
    return branch | {"black_error_dn": black_law(isos, blacks, bool(site_names(sensor)))}


def _by_colour(values: Sequence[float], sensor: Sensor) -> list[float]:
    """Return the values of planes as R, G1, B, G2; for a monochrome sensor the last one, of all planes."""
    names = site_names(sensor)
    return [values[names.index(name)] for name in ("R", "Gr", "B", "Gb")] if names else [values[-1]]


WITH_DEFAULTS = ("dark_doubling_c", "dead_pixel_level", "dsnu_std_e", "hot_pixel_e_per_s")
"""Keys that are left out if the captures do not show them: null is no value of theirs."""


def _common_keys(calibration: Calibration) -> dict[str, Any]:
    """Return the keys that do not depend on ISO; null for numbers that the captures do not show."""
    known = {entry.name: entry.number for entry in _body_estimates(calibration) if entry.site is None}
    keys: dict[str, Any] = {} if (gains := _gains_by_colour(calibration)) is None else {"gain_by_colour": gains}
    correlations = [result.row_correlation for result in calibration.isos]
    row = max(correlations, key=lambda number: abs(number.value) / max(number.error, 1e-9))
    if abs(row.value) > 4 * row.error and abs(row.value) > 0.02:
        keys["row_correlation"] = rounded(max(min(row.value, 0.95), -0.95))
    for name, number in known.items():
        if number is not None or name not in WITH_DEFAULTS:
            keys[name] = None if number is None else rounded(number.value)
    if known["dark_e_per_s"] is not None:
        keys["dark_reference_c"] = calibration.body.dark_reference_c or ASSUMED_C
    return keys


def _gains_by_colour(calibration: Calibration) -> list[float] | None:
    """Return the gains of red, green and blue relative to the sensor's, if they differ at most ISOs."""
    names = site_names(calibration.sensor)
    differing = [result.gain for result in calibration.isos if result.gain.has_colours]
    if not names or 2 * len(differing) <= len(calibration.isos):
        return None
    relative = [[plane.value / gain.sensor.value for plane in gain.planes] for gain in differing]
    by_name = dict(zip(names, (sum(values) / len(values) for values in zip(*relative, strict=True)), strict=True))
    return [rounded(by_name["R"]), rounded((by_name["Gr"] + by_name["Gb"]) / 2), rounded(by_name["B"])]


ABSOLUTE = ("black_error_dn", "read_shape", "row_correlation")
"""Numbers whose errors are not stated relative to them, because they may be near 0."""


def _provenance(calibration: Calibration, written: Iterable[str]) -> list[dict[str, Any]]:
    """Return the sources of the numbers of a profile: the form of the calibration, and the largest error of each."""
    isos, known, widths = [result.iso for result in calibration.isos], calibration.known, dict[str, tuple[float, str]]()
    for entry in estimates(calibration):
        if entry.site is None and entry.number is not None and entry.number.value and entry.name in written:
            half = (entry.number.high - entry.number.low) / 2
            width, unit = (half, entry.unit) if entry.name in ABSOLUTE else (100 * half / abs(entry.number.value), "%")
            widths[entry.name] = max(widths.get(entry.name, (0.0, unit)), (width, unit))
    form = "calibrate --from darks, own darks" if known else "calibrate, own flats and darks"
    if known:
        del widths["dn_per_e"]
    source = f"{form}, {len(calibration.captures.captures)} frames, SHA-256 {calibration.captures.sha256[:16]}"
    errors = ", ".join(f"{name} ±{width:.2g} {unit}".strip() for name, (width, unit) in widths.items())
    measured = provenance([*widths], isos, source, f"{errors} (95 %, systematic errors included)")
    return [provenance(["dn_per_e"], isos, known.source, known.uncertainty), measured] if known else [measured]
