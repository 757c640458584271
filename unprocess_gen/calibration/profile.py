"""Write measured noise as a noise profile in YAML, and as a list of estimates in JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from unprocess_gen.calibration.body import BodyResult
from unprocess_gen.calibration.captures import CaptureSet, Sensor
from unprocess_gen.calibration.frame_sums import plane_names
from unprocess_gen.calibration.gain import Estimate, estimate
from unprocess_gen.calibration.iso_laws import DIGITS, black_law, branches, gain_law, rounded, shape_law, std_law
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


def head(start: str, isos: Sequence[float], sha256: str, notes: Sequence[str], name: str, sensor: Sensor) -> list[str]:
    """Return the comments and the first keys of a profile."""
    return [
        f"# {start}, ISO {', '.join(f'{iso:g}' for iso in isos)}.",
        "# SHA-256 of the list of their SHA-256, one a line in ascending order:",
        f"# {sha256}",
        "# Ranges in comments are 95 % intervals, systematic errors included. The JSON file of this name has all.",
        *(f"# Note: {note}" for note in notes),
        f"name: {name}",
        'scatter: "off"',
        "units: dn",
        "black: subtracted",
        f"bits: {sensor.bits}",
        f"black_level_dn: {sensor.black_dn:.0f}",
        f"white_level_dn: {sensor.white_dn:.0f}",
    ]


def profile_yaml(found: Calibration, name: str, two_parameter: bool) -> str:
    """Return the noise profile, with uncertainties and the digest of the captures in comments."""
    sensor, isos = found.sensor, [result.iso for result in found.isos]
    start = f"Measured {MARK} on {len(found.captures.captures)} raw frames"
    lines = head(start, isos, found.captures.sha256, found.notes, name, sensor)
    if two_parameter and len(isos) == 1:
        result = found.isos[0]
        b = dark_variance(result)
        lines += [
            f"a: {yaml_text(rounded(result.gain.sensor.value))}   # {_range(result.gain.sensor)} DN per electron",
            f"b: {yaml_text(rounded(b.value))}   # {_range(b)} DN², without rounding",
            "negative_variance: refuse",
        ]
        return "\n".join(lines) + "\n"
    lines.append("branches:")
    for branch in iso_branches(found.isos):
        lines += _branch_lines([found.isos[place] for place in branch], sensor, two_parameter, found.known)
    if not two_parameter:
        lines += _body_lines(found)
    return "\n".join([*lines, *_provenance(found, two_parameter)]) + "\n"


def iso_branches(isos: Sequence[IsoResult]) -> list[list[int]]:
    """Return the places of the ISOs of each branch: those of a gain mode whose gains follow one law."""
    result = []
    for mode in branches([one.iso for one in isos], [one.read for one in isos]):
        chosen = [isos[place] for place in mode]
        law = gain_law([one.iso for one in chosen], [one.gain.sensor for one in chosen])
        result += [mode] if law is not None else [[place] for place in mode]
    return result


def dark_variance(result: IsoResult) -> Estimate:
    """Return the variance of a site without light, DN², all dark noise but rounding."""
    others = (result.row, result.column, result.column_temporal, result.dsnu_dn)
    value = result.read.value**2 + sum(one.value**2 for one in others)
    error = 2 * math.sqrt(sum((one.value * one.error) ** 2 for one in (result.read, *others)))
    return estimate(value, error, 0.0)


def _branch_lines(
    results: Sequence[IsoResult], sensor: Sensor, two_parameter: bool, known: KnownGain | None
) -> list[str]:
    """Return the lines of a branch."""
    isos = [result.iso for result in results]
    gains, reads = [one.gain.sensor for one in results], [one.read for one in results]
    gain_by_iso = gain_law(isos, gains)
    origin = known.source if known else _ranges(isos, gains)
    lines = [f"  - iso: [{isos[0]:g}, {isos[-1]:g}]", f"    dn_per_e: {yaml_text(gain_by_iso)}   # {origin}"]
    if two_parameter:
        variances = [dark_variance(result) for result in results]
        reads = [estimate(math.sqrt(b.value), b.error / 2 / math.sqrt(b.value)) for b in variances]
        law = std_law(isos, reads)
        return [*lines, "    read_law: gaussian", f"    read_std_dn: {yaml_text(law)}   # {_ranges(isos, reads)}"]
    if any(result.shape.is_tukey for result in results):
        shapes = [result.shape.shape if result.shape.is_tukey else NORMAL_SHAPE for result in results]
        errors = [result.shape.interval for result in results]
        lines += ["    read_law: tukey_lambda"]
        lines += [f"    read_shape: {yaml_text(shape_law(isos, shapes))}   # {_ranges(isos, errors)}"]
    else:
        lines += ["    read_law: gaussian"]
    lines.append(f"    read_std_dn: {yaml_text(std_law(isos, reads))}   # {_ranges(isos, reads)}")
    for name, values in (
        ("row_std_dn", [one.row for one in results]),
        ("column_std_dn", [one.column for one in results]),
        ("column_temporal_std_dn", [one.column_temporal for one in results]),
    ):
        law = std_law(isos, values)
        if name == "column_temporal_std_dn":  # the key takes no table
            law = (
                law if not isinstance(law, list) or law[0] == "root" else rounded(max(value.value for value in values))
            )
            if not any(value.value for value in values):
                continue
        lines.append(f"    {name}: {yaml_text(law)}   # {_ranges(isos, values)}")
    blacks = [_by_colour([one.value for one in result.black], sensor) for result in results]
    lines.append(f"    black_error_dn: {yaml_text(black_law(isos, blacks, bool(site_names(sensor))))}")
    return lines


def _by_colour(values: Sequence[float], sensor: Sensor) -> list[float]:
    """Return the values of planes as R, G1, B, G2; their mean for a monochrome sensor."""
    names = site_names(sensor)
    if not names:
        return [sum(values) / len(values)]
    return [values[names.index(name)] for name in ("R", "Gr", "B", "Gb")]


def _body_lines(found: Calibration) -> list[str]:
    """Return the lines of the numbers that do not depend on ISO."""
    known = {one.name: one.number for one in _of_body(found) if one.site is None}
    lines = []
    gains = _gains_by_colour(found)
    if gains is not None:
        lines.append(f"gain_by_colour: {yaml_text(gains)}   # red, green, blue, relative to dn_per_e")
    row = max((result.row_correlation for result in found.isos), key=lambda one: abs(one.value) / max(one.error, 1e-9))
    if abs(row.value) > 4 * row.error and abs(row.value) > 0.02:
        lines.append(f"row_correlation: {yaml_text(rounded(max(min(row.value, 0.95), -0.95)))}   # {_range(row)}")
    for name, number in known.items():
        if name in ("dark_doubling_c", "dead_pixel_level", "dsnu_std_e", "hot_pixel_e_per_s") and number is None:
            continue
        comment = "not known" if number is None else _range(number)
        lines.append(f"{name}: {'null' if number is None else yaml_text(rounded(number.value))}   # {comment}")
    if known["dark_e_per_s"] is not None:
        celsius = found.body.dark_reference_c
        comment = "of the captures" if celsius else "assumed: the captures do not state their temperature"
        lines.append(f"dark_reference_c: {celsius or 25.0:g}   # {comment}")
        lines.append(
            "# the camera subtracts the mean dark signal (sensor.dark_offset=removed)"
            if found.body.is_mean_removed
            else "# the camera keeps the mean dark signal: set sensor.dark_offset=kept"
        )
    return lines


def _gains_by_colour(found: Calibration) -> list[float] | None:
    """Return the gains of red, green and blue relative to the sensor's, if they differ at most ISOs."""
    names = site_names(found.sensor)
    differing = [result.gain for result in found.isos if result.gain.has_colours]
    if not names or 2 * len(differing) <= len(found.isos):
        return None
    relative = [[plane.value / gain.sensor.value for plane in gain.planes] for gain in differing]
    means = [sum(values) / len(values) for values in zip(*relative, strict=True)]
    by_name = dict(zip(names, means, strict=True))
    return [rounded(by_name["R"]), rounded((by_name["Gr"] + by_name["Gb"]) / 2), rounded(by_name["B"])]


def _provenance(found: Calibration, two_parameter: bool) -> list[str]:
    """Return the statements of sources, which `plan` prints: the form of the calibration, and its uncertainty."""
    isos, known = [result.iso for result in found.isos], found.known
    numbers = ["read_std_dn"] + ([] if two_parameter else ["row_std_dn", "column_std_dn", "black_error_dn"])
    gain = max((one.gain.sensor.high - one.gain.sensor.low) / 2 / one.gain.sensor.value for one in found.isos)
    read = max((one.read.high - one.read.low) / 2 / max(one.read.value, 1e-9) for one in found.isos)
    form = "calibrate --from darks, own darks" if known else "calibrate, own flats and darks"
    frames = f"{form}, {len(found.captures.captures)} frames, SHA-256 {found.captures.sha256[:16]}"
    measured = f"read noise {read:.2%} (95 %, systematic errors included)"
    statements = [(numbers, frames, measured)]
    if known:
        statements.insert(0, (["dn_per_e"], known.source, known.uncertainty))
    else:
        statements = [(["dn_per_e", *numbers], frames, f"gain {gain:.2%}, {measured}")]
    return ["provenance:", *(line for one in statements for line in provenance_lines(*one, isos))]


def provenance_lines(numbers: Sequence[str], source: str, uncertainty: str, isos: Sequence[float]) -> list[str]:
    """Return the lines of a statement of the source of numbers."""
    return [
        f"  - numbers: [{', '.join(numbers)}]",
        f"    iso: [{isos[0]:g}, {isos[-1]:g}]",
        f"    source: {json.dumps(source, ensure_ascii=False)}",
        f"    uncertainty: {json.dumps(uncertainty, ensure_ascii=False)}",
    ]


def _ranges(isos: Sequence[float], numbers: Sequence[Estimate]) -> str:
    """Return the intervals at each ISO as text."""
    if len(isos) == 1:
        return _range(numbers[0])
    return "; ".join(f"ISO {iso:g}: {_range(number)}" for iso, number in zip(isos, numbers, strict=True))


def _range(number: Estimate) -> str:
    return f"{number.low:.4g} to {number.high:.4g}"


def yaml_text(value: Any) -> str:
    """Return a number or a list as YAML."""
    if isinstance(value, list):
        return f"[{', '.join(map(yaml_text, value))}]"
    if isinstance(value, float):
        text = repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
        mantissa, e, exponent = text.partition("e")  # YAML reads a number with an exponent only if it has a point
        return f"{mantissa if '.' in mantissa or not e else mantissa + '.0'}{e}{exponent}"
    return str(value)
