"""Write measured noise as a noise profile in YAML, and as a list of estimates in JSON.

Numbers of several ISOs are tables in branches, one for each gain mode of the sensor. The variance of read noise in one
gain mode, c0 + c1·ISO + c2·ISO², is convex. A value below the line through the two ISOs before it therefore means that
the sensor has switched its conversion gain: a new branch begins.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from unprocess_gen.calibration.calibrate import NULL, Calibration
from unprocess_gen.calibration.captures import Sensor
from unprocess_gen.calibration.gain import SIGNIFICANT, Estimate, combined, estimate
from unprocess_gen.calibration.iso_results import IsoResult
from unprocess_gen.calibration.planes import plane_names
from unprocess_gen.calibration.shape import NORMAL_SHAPE
from unprocess_gen.config.limits import NAME
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import write_file
from unprocess_gen.core.libraries import require
from unprocess_gen.core.output_paths import check_output_file
from unprocess_gen.simulation.reference.cfa import MONO

MARK = "by gen-dataset calibrate"
"""Part of the first line of a profile, by which a later run recognises it."""
UNITS = {"dn_per_e": "DN/e", "b_dn2": "DN²", "dark_e_per_s": "e/s", "hot_pixel_e_per_s": "e/s"}
"""Units of numbers; others are in DN or in electrons as their names end, or without a unit."""
ENDS = ("value", "low", "high")
DIGITS, SHAPE_DIGITS = 7, 4
"""Digits of numbers in a profile, and of shapes."""
ASSUMED_C = 25.0
"""Temperature of darks that do not state it."""
SAME_GAIN = 0.003
"""Largest difference of the gains of colours that are not written."""
LEAST_CORRELATION = 0.02
"""Least correlation of neighbouring rows that is written."""
MODE_RATIO = 0.85
"""Ratio of read noise to the least read noise of a gain mode, below which it belongs to another mode."""
LEAST = 1e-3
"""Least standard deviation of a table relative to its largest, because 0 has no logarithm."""


def check_outputs(to: Path) -> None:
    """Refuse, before any work, names to which a profile cannot be written."""
    if to.suffix != ".yaml" or not NAME.allows(to.stem):
        raise ConfigError(f"--to {to}: is no name of a profile; expected {NAME}, and .yaml")
    check_output_file(to, f"--to {to}", "an earlier profile of this verb", MARK.lower().encode())
    to_json = to.with_suffix(".json")
    check_output_file(to_json, f"--to {to}: {to_json.name}", "an earlier list of estimates", b'{"name": "')
    require("scipy", "calibrate: fits need scipy", "calibrate")


def write_profile(to: Path, profile: str, listed: str) -> None:
    """Write the text of a profile, and of a list of estimates next to it."""
    write_file(to, profile)
    write_file(to.with_suffix(".json"), listed)


# ----------------------------------------------------------------------------------------------------------- estimates


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


def site_names(sensor: Sensor) -> list[str]:
    """Names of the planes of a sensor; none for a monochrome one, whose sites are equal."""
    return [] if sensor.pattern == MONO else plane_names(sensor.pattern)


def estimates(calibration: Calibration) -> list[NamedNumber]:
    """All estimates: those of all ISOs together, then those of each ISO, of the sensor and then of its sites."""
    sites = [None, *site_names(calibration.captures.sensor)]
    listed = [NamedNumber(name, None, None, number) for name, number in calibration.shared.items()]
    for result in calibration.isos:
        for name, numbers in result.numbers.items():
            listed += [NamedNumber(name, result.iso, *both) for both in zip(sites, numbers, strict=False)]
    return listed


def estimates_json(named: Sequence[NamedNumber], digits: int = DIGITS) -> str:
    """The list of estimates as JSON, an object a line; null where the captures do not show a number."""
    lines = []
    for entry in named:
        values = [getattr(entry.number, end, math.inf) for end in ENDS]
        value, *interval = (rounded(value, digits) if math.isfinite(value) else None for value in values)
        number = {"value": value, "interval": interval, "unit": entry.unit}
        lines.append({"name": entry.name, "iso": entry.iso, "site": entry.site, **number})
    return "[\n" + ",\n".join(map(json.dumps, lines)) + "\n]\n"


# ---------------------------------------------------------------------------------------------------------------- YAML


def profile_yaml(start: str, sha256: str, notes: Sequence[str], profile: Mapping[str, Any]) -> str:
    """A profile as YAML, with the source and notes in comments; ``start`` is the source in words."""
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
    """The first keys of a profile."""
    levels = {"bits": sensor.bits, "black_level_dn": round(sensor.black_dn), "white_level_dn": round(sensor.white_dn)}
    return {"name": name, "scatter": "off", "units": "dn", "black": "subtracted", **levels}


def provenance(numbers: Sequence[str], isos: Sequence[float], source: str, uncertainty: str) -> dict[str, Any]:
    """A statement of sources, which `plan` prints."""
    return {"numbers": [*numbers], "iso": [isos[0], isos[-1]], "source": source, "uncertainty": uncertainty}


def measured_yaml(calibration: Calibration, name: str) -> str:
    """The noise profile of measured frames."""
    isos, digest = [result.iso for result in calibration.isos], calibration.captures.sha256
    places = modes(isos, [result["read_std_dn"] for result in calibration.isos])
    branches = [_branch([calibration.isos[place] for place in mode], calibration.captures.sensor) for mode in places]
    profile = profile_head(name, calibration.captures.sensor) | {"branches": branches} | _common_keys(calibration)
    listed = {entry.name for entry in estimates(calibration) if entry.number is not None}
    written = [key for key in (*branches[0], *profile) if key in listed]
    source = f"calibrate, own flats and darks, {len(calibration.captures.captures)} frames, SHA-256 {digest[:16]}"
    profile["provenance"] = [provenance(written, isos, source, f"95 % intervals in {name}.json")]
    frames = f"{len(calibration.captures.captures)} raw frames, ISO {', '.join(f'{iso:g}' for iso in isos)}"
    return profile_yaml(f"Measured {MARK} on {frames}", digest, calibration.captures.notes, profile)


AGAINST_ISO = {"dn_per_e": "DN per electron", "read_std_dn": "read noise (DN)", "row_std_dn": "row noise (DN)"}
"""Numbers that are printed and drawn for each ISO, and their labels."""


def dark_variance(result: IsoResult) -> Estimate:
    """Variance of a site without light, DN², all dark noise but rounding."""
    names = ("read_std_dn", "row_std_dn", "column_std_dn", "column_temporal_std_dn", "dsnu_std_dn")
    stds = [result[name] for name in names]
    error = 2 * math.sqrt(sum((std.value * std.error) ** 2 for std in stds))
    return estimate(sum(std.value**2 for std in stds), error, 0.0)


def _branch(results: Sequence[IsoResult], sensor: Sensor) -> dict[str, Any]:
    """A branch of neighbouring ISOs: gain, and noise without light."""
    isos, shapes = [result.iso for result in results], [result.shape for result in results]
    branch: dict[str, Any] = {"iso": [isos[0], isos[-1]], "read_law": "gaussian"}
    if any(shape.is_tukey for shape in shapes):
        values = [shape.interval.value if shape.is_tukey else NORMAL_SHAPE for shape in shapes]
        branch |= {"read_law": "tukey_lambda", "read_shape": std_table(isos, values, SHAPE_DIGITS)}
    for name in ("dn_per_e", "read_std_dn", "row_std_dn", "column_std_dn"):
        branch[name] = std_table(isos, [result[name].value for result in results])
    if (temporal := max(result["column_temporal_std_dn"].value for result in results)) > 0:  # the key takes no table
        branch["column_temporal_std_dn"] = rounded(temporal)
    names = site_names(sensor)
    # of red, both greens and blue; a monochrome sensor has one
    places = [1 + names.index(name) for name in ("R", "Gr", "B", "Gb")] if names else [0]
    blacks = [[round(result.numbers["black_error_dn"][place].value, 4) for place in places] for result in results]
    return branch | {"black_error_dn": table(isos, blacks if names else [black for (black,) in blacks])}


def _common_keys(calibration: Calibration) -> dict[str, Any]:
    """The keys that do not depend on ISO; null for numbers that the captures do not show."""
    keys: dict[str, Any] = {} if (gains := _gains_by_colour(calibration)) is None else {"gain_by_colour": gains}
    rows = [result["row_correlation"] for result in calibration.isos]
    row = max(rows, key=lambda number: abs(number.value) / max(number.error, 1e-9))
    if abs(row.value) > max(4 * row.error, LEAST_CORRELATION):
        keys["row_correlation"] = rounded(max(min(row.value, 0.95), -0.95))
    for name, number in calibration.shared.items():
        if number is not None or name in NULL:
            keys[name] = None if number is None else rounded(number.value)
    if calibration.shared["dark_e_per_s"] is not None:
        keys["dark_reference_c"] = ASSUMED_C if calibration.celsius is None else calibration.celsius
    return keys


def _gains_by_colour(calibration: Calibration) -> list[float] | None:
    """The gains of red, green and blue relative to the sensor's, if they differ by more than their errors."""
    sites, colours = site_names(calibration.captures.sensor), list[Estimate]()
    for colour in "RGB" if sites else "":
        places = [1 + place for place, site in enumerate(sites) if site[0] == colour]
        gains = [(result["dn_per_e"].value, result.numbers["dn_per_e"]) for result in calibration.isos]
        colours.append(combined([planes[place].scaled(1 / gain) for gain, planes in gains for place in places]))
    differ = any(abs(gain.value - 1) > max(4 * gain.error, SAME_GAIN) for gain in colours)
    return [rounded(gain.value) for gain in colours] if differ else None


# --------------------------------------------------------------------------------------------------------------- tables


def modes(isos: Sequence[float], reads: Sequence[Estimate]) -> list[list[int]]:
    """The places of the ISOs of each gain mode."""
    result = [[0]]
    for place in range(1, len(isos)):
        mode = result[-1]
        last = reads[mode[-1]].value ** 2
        slope = 0.0
        if len(mode) > 1:
            slope = (last - reads[mode[-2]].value ** 2) / (isos[mode[-1]] - isos[mode[-2]])
        least = math.sqrt(max(last + max(slope, 0.0) * (isos[place] - isos[mode[-1]]), 0.0))
        read = reads[place]
        margin = MODE_RATIO if len(mode) > 1 else 1.0
        if read.value + SIGNIFICANT * math.hypot(read.error, reads[mode[-1]].error) < margin * least:
            result.append([place])
        else:
            mode.append(place)
    return result


def table(isos: Sequence[float], values: Sequence[Any]) -> Any:
    """The value of one ISO, or a table ``by_iso``."""
    return values[0] if len(isos) == 1 else ["by_iso", *itertools.chain(*zip(isos, values, strict=True))]


def std_table(isos: Sequence[float], values: Sequence[float], digits: int = DIGITS) -> Any:
    """Gains, standard deviations or shapes of a branch as one number, or as a table ``by_iso``."""
    if len(isos) == 1 or not any(values):
        return rounded(values[0], digits)
    return table(isos, [rounded(value or LEAST * max(values), digits) for value in values])


def rounded(value: float, digits: int = DIGITS) -> float:
    """A number with the digits that a profile has."""
    return float(f"{value:.{digits}g}")
