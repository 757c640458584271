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


class Named(NamedTuple):
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


def estimates(found: Calibration) -> list[Named]:
    """Return the list of all estimates."""
    sites = site_names(found.sensor)
    return [*_of_body(found), *(one for result in found.isos for one in _of_iso(result, found.known, sites))]


def _of_iso(result: IsoResult, known: KnownGain | None, sites: Sequence[str]) -> Iterator[Named]:
    """Yield the estimates of one ISO."""
    iso, shape = result.iso, result.shape
    gain = known.by_iso.get(iso, result.gain.sensor) if known else result.gain.sensor
    yield Named("dn_per_e", iso, None, gain, "DN/e")
    if result.curves:
        yield Named("dn_per_e_emva1288", iso, None, estimate(result.emva_gain, result.gain.sensor.error), "DN/e")
    yield Named("read_std_dn", iso, None, result.read, "DN")
    yield Named("read_shape", iso, None, shape.interval, "")
    yield Named("row_std_dn", iso, None, result.row, "DN")
    yield Named("row_correlation", iso, None, result.row_correlation, "")
    yield Named("column_std_dn", iso, None, result.column, "DN")
    yield Named("column_temporal_std_dn", iso, None, result.column_temporal, "DN")
    yield Named("dsnu_std_dn", iso, None, result.dsnu_dn, "DN")
    black = Estimate(*(sum(getattr(one, end) for one in result.black) / 4 for end in ("value", "low", "high")))
    yield Named("black_error_dn", iso, None, black, "DN")
    for site, gain in zip(sites, result.gain.planes, strict=False):
        yield Named("dn_per_e", iso, site, gain, "DN/e")
    for site, read, one, error in zip(sites, result.reads, result.shapes, result.black, strict=False):
        yield Named("read_std_dn", iso, site, read, "DN")
        yield Named("read_shape", iso, site, one.interval, "")
        yield Named("black_error_dn", iso, site, error, "DN")


def _of_body(found: Calibration) -> Iterator[Named]:
    """Yield the estimates that do not depend on ISO."""
    body = found.body
    yield Named("prnu_std", None, None, body.prnu, "")
    for site, prnu in zip(site_names(found.sensor), body.prnus, strict=False):
        yield Named("prnu_std", None, site, prnu, "")
    yield Named("dsnu_std_e", None, None, body.dsnu_e, "e")
    yield Named("dark_e_per_s", None, None, body.dark_e_per_s, "e/s")
    yield Named("dark_doubling_c", None, None, body.dark_doubling_c, "degrees Celsius")
    yield Named("hot_pixel_share", None, None, body.hot_share, "")
    yield Named("hot_pixel_e_per_s", None, None, body.hot_e_per_s, "e/s")
    yield Named("dead_pixel_share", None, None, body.dead_share, "")
    yield Named("dead_pixel_level", None, None, body.dead_level, "")
    yield Named("full_well_e", None, None, body.full_well_e, "e")


def estimates_json(named: Sequence[Named], digits: int = DIGITS) -> str:
    """Return the list of estimates as JSON, an object a line; null where the captures do not show a number."""
    lines = []
    for one in named:
        ends = {end: None if one.number is None else rounded(getattr(one.number, end), digits) for end in ENDS}
        ends = {end: value if value is None or math.isfinite(value) else None for end, value in ends.items()}
        lines.append(json.dumps({"name": one.name, "iso": one.iso, "site": one.site, **ends, "unit": one.unit}))
    return "[\n" + ",\n".join(lines) + "\n]\n"


ENDS = ("value", "low", "high")
ASSUMED_C = 25.0
"""Temperature of darks that do not state it."""

UNKNOWN = {
    "prnu_std": "more flats of each level show it",
    "dark_e_per_s": "darks of several exposures, up to some seconds, show it",
    "hot_pixel_share": "darks of 0.2 s or more show it",
    "dead_pixel_share": "flats above 5 % of white show it",
    "full_well_e": "a series of flats up to saturation, at the lowest ISO, shows it",
}
"""What shows a number that the captures do not."""


def unknown_numbers(found: Calibration) -> list[str]:
    """Return a note for each number that is null."""
    known = {one.name: one.number for one in _of_body(found) if one.site is None}
    return [
        f"{name} is null: the captures do not show it; {advice}"
        for name, advice in UNKNOWN.items()
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


def measured_yaml(found: Calibration, name: str, two_parameter: bool) -> str:
    """Return the noise profile of measured frames."""
    profile, isos = profile_head(name, found.sensor), [result.iso for result in found.isos]
    if two_parameter and len(isos) == 1:
        result = found.isos[0]
        numbers = {"a": result.gain.sensor, "b": dark_variance(result)}
        profile |= {key: rounded(number.value) for key, number in numbers.items()} | {"negative_variance": "refuse"}
    else:
        branches = [[found.isos[place] for place in places] for places in iso_branches(found.isos)]
        profile["branches"] = [_branch(results, found.sensor, two_parameter) for results in branches]
        if not two_parameter:
            profile |= _of_all_isos(found)
        written = {*profile, *(key for branch in profile["branches"] for key in branch)}
        profile["provenance"] = _provenance(found, written)
    start = f"Measured {MARK} on {len(found.captures.captures)} raw frames, ISO {', '.join(f'{iso:g}' for iso in isos)}"
    return profile_yaml(start, found.captures.sha256, found.notes, profile)


def iso_branches(results: Sequence[IsoResult]) -> list[list[int]]:
    """Return the places of the ISOs of each branch."""
    isos = [one.iso for one in results]
    return joined_branches(isos, [one.gain.sensor for one in results], modes(isos, [one.read for one in results]))


def dark_variance(result: IsoResult) -> Estimate:
    """Return the variance of a site without light, DN², all dark noise but rounding."""
    others = (result.row, result.column, result.column_temporal, result.dsnu_dn)
    value = result.read.value**2 + sum(one.value**2 for one in others)
    error = 2 * math.sqrt(sum((one.value * one.error) ** 2 for one in (result.read, *others)))
    return estimate(value, error, 0.0)


def _branch(results: Sequence[IsoResult], sensor: Sensor, two_parameter: bool) -> dict[str, Any]:
    """Return a branch; the keys of two numbers are gain, and noise without light."""
    isos, reads = [result.iso for result in results], [one.read for one in results]
    gains = [one.gain.sensor for one in results]
    branch = {"iso": [isos[0], isos[-1]], "dn_per_e": gain_law(isos, gains), "read_law": "gaussian"}
    if two_parameter:
        variances = [dark_variance(result) for result in results]
        reads = [estimate(math.sqrt(b.value), b.error / 2 / math.sqrt(b.value)) for b in variances]
        return branch | {"read_std_dn": std_law(isos, reads)}
    if any(result.shape.is_tukey for result in results):
        shapes = [result.shape.shape if result.shape.is_tukey else NORMAL_SHAPE for result in results]
        branch |= {"read_law": "tukey_lambda", "read_shape": shape_law(isos, shapes)}
    branch["read_std_dn"] = std_law(isos, reads)
    branch |= {name: std_law(isos, [getattr(one, name.removesuffix("_std_dn")) for one in results]) for name in LINES}
    if (temporal := max(result.column_temporal.value for result in results)) > 0:  # the key takes no table
        branch["column_temporal_std_dn"] = rounded(temporal)
    blacks = [_by_colour([one.value for one in result.black], sensor) for result in results]
    return branch | {"black_error_dn": black_law(isos, blacks, bool(site_names(sensor)))}


LINES = ("row_std_dn", "column_std_dn")


def _by_colour(values: Sequence[float], sensor: Sensor) -> list[float]:
    """Return the values of planes as R, G1, B, G2; their mean for a monochrome sensor."""
    names = site_names(sensor)
    return [values[names.index(name)] for name in ("R", "Gr", "B", "Gb")] if names else [sum(values) / len(values)]


WITH_DEFAULTS = ("dark_doubling_c", "dead_pixel_level", "dsnu_std_e", "hot_pixel_e_per_s")
"""Keys that are left out if the captures do not show them: null is no value of theirs."""


def _of_all_isos(found: Calibration) -> dict[str, Any]:
    """Return the keys that do not depend on ISO; null for numbers that the captures do not show."""
    known = {one.name: one.number for one in _of_body(found) if one.site is None}
    keys: dict[str, Any] = {} if (gains := _gains_by_colour(found)) is None else {"gain_by_colour": gains}
    row = max((result.row_correlation for result in found.isos), key=lambda one: abs(one.value) / max(one.error, 1e-9))
    if abs(row.value) > 4 * row.error and abs(row.value) > 0.02:
        keys["row_correlation"] = rounded(max(min(row.value, 0.95), -0.95))
    for name, number in known.items():
        if number is not None or name not in WITH_DEFAULTS:
            keys[name] = None if number is None else rounded(number.value)
    if known["dark_e_per_s"] is not None:
        keys["dark_reference_c"] = found.body.dark_reference_c or ASSUMED_C
    return keys


def _gains_by_colour(found: Calibration) -> list[float] | None:
    """Return the gains of red, green and blue relative to the sensor's, if they differ at most ISOs."""
    names = site_names(found.sensor)
    differing = [result.gain for result in found.isos if result.gain.has_colours]
    if not names or 2 * len(differing) <= len(found.isos):
        return None
    relative = [[plane.value / gain.sensor.value for plane in gain.planes] for gain in differing]
    by_name = dict(zip(names, (sum(values) / len(values) for values in zip(*relative, strict=True)), strict=True))
    return [rounded(by_name["R"]), rounded((by_name["Gr"] + by_name["Gb"]) / 2), rounded(by_name["B"])]


ABSOLUTE = ("black_error_dn", "read_shape", "row_correlation")
"""Numbers whose errors are not stated relative to them, because they may be near 0."""


def _provenance(found: Calibration, written: Iterable[str]) -> list[dict[str, Any]]:
    """Return the sources of the numbers of a profile: the form of the calibration, and the largest error of each."""
    isos, known, widths = [result.iso for result in found.isos], found.known, dict[str, tuple[float, str]]()
    for one in estimates(found):
        if one.site is None and one.number is not None and one.number.value and one.name in written:
            half = (one.number.high - one.number.low) / 2
            width, unit = (half, one.unit) if one.name in ABSOLUTE else (100 * half / abs(one.number.value), "%")
            widths[one.name] = max(widths.get(one.name, (0.0, unit)), (width, unit))
    form = "calibrate --from darks, own darks" if known else "calibrate, own flats and darks"
    if known:
        del widths["dn_per_e"]
    source = f"{form}, {len(found.captures.captures)} frames, SHA-256 {found.captures.sha256[:16]}"
    errors = ", ".join(f"{name} ±{width:.2g} {unit}".strip() for name, (width, unit) in widths.items())
    measured = provenance([*widths], isos, source, f"{errors} (95 %, systematic errors included)")
    return [provenance(["dn_per_e"], isos, known.source, known.uncertainty), measured] if known else [measured]
