"""Check noise profiles: those with two numbers, and physical profiles with branches by ISO."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from decimal import Decimal
from typing import Any

import numpy as np

from unprocess_gen.config.distributions import highest, lowest, parse_drawn
from unprocess_gen.config.forms import ISO_FORMS
from unprocess_gen.config.interpretation import (
    branch_of,
    is_physical,
    noise_distributions,
    row_of_stop,
    table_words,
)
from unprocess_gen.config.limits import (
    BLACK_ERROR,
    BLACK_LEVEL,
    EXPOSURE_S,
    ISO,
    ISO_RANGE,
    MAX_BRANCH_NUMBER,
    MAX_ISO,
    READ_SHAPE,
    TEMPERATURE_C,
    VARIANCE_SLOPE,
    WHITE_LEVEL,
    IsoForm,
)
from unprocess_gen.config.schema import (
    ASSUMABLE,
    PHYSICAL_NUMBERS,
    BranchConfig,
    NoiseConfig,
    ProvenanceConfig,
    SceneConfig,
)
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.values import is_number, one_of, value_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.simulation.effects.lens_shading import illumination_at

MAX_ELECTRONS = 1e9
"""Largest mean of an exact Poisson count (`simulation.reference.poisson`); no pixel holds as many electrons."""


HEAVIEST_TAILS = -0.45
"""Least shape of ``tukey_lambda``, whose table is 7 % wider than the distribution, so that its variance is 1."""

FARTHEST_NORMAL = 6.4
"""No normal deviate of a 32-bit uniform is farther from 0."""


def check_noise(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Raise ConfigError unless a noise profile can be simulated at the ISO, exposure and temperature of a scene."""
    if is_physical(noise):
        _check_physical(noise, scene)
    else:
        _check_two_numbers(noise)


def _check_two_numbers(noise: NoiseConfig) -> None:
    if noise.iso is not None:
        raise ConfigError(
            f"noise.iso={value_text(noise.iso)}: noise={noise.name} holds for one ISO; expected null; choose "
            "a physical profile"
        )
    _, b = noise_distributions(noise)
    if noise.law == "poisson" and (noise.black == "included" or lowest(b) < 0):
        raise ConfigError(
            "noise.law=poisson: expected noise.black=subtracted and noise.b of 0 or more; set noise.law=gaussian"
        )
    if noise.units == "normalized":
        if noise.black == "included":
            raise ConfigError("noise.black=included: normalized units have black at 0; expected subtracted")
        offset = 0.0
    else:
        _check_calibration(noise)
        offset = _black_variance(noise)
    if noise.law == "poisson":
        _check_countable(noise)
    if lowest(b) + offset < 0 and noise.negative_variance == "refuse":
        raise ConfigError(
            f"noise.b={value_text(noise.b)}: variance at black is {lowest(b) + offset:.6g}; expected 0 or more; "
            "set noise.negative_variance=clip to use max(0, variance)"
        )


def _check_calibration(noise: NoiseConfig) -> None:
    levels = (noise.bits, noise.black_level_dn, noise.white_level_dn)
    if any(level is None for level in levels):
        raise ConfigError(
            f"noise.units=dn: {noise.name} needs bits, black_level_dn and white_level_dn of its calibration, "
            f"got {', '.join(value_text(level) for level in levels)}"
        )
    assert noise.bits is not None and noise.black_level_dn is not None and noise.white_level_dn is not None
    settings_of(NoiseConfig)["bits"].check("noise.bits", noise.bits)
    BLACK_LEVEL.check_in("noise.black_level_dn", noise.black_level_dn, noise)
    WHITE_LEVEL.check_in("noise.white_level_dn", noise.white_level_dn, noise)


def _black_variance(noise: NoiseConfig) -> float:
    """Return the least that an included black level adds to the variance at black, DN² of the profile."""
    if noise.black != "included" or noise.black_level_dn is None:
        return 0.0
    return lowest(parse_drawn("noise.a", noise.a, VARIANCE_SLOPE)) * noise.black_level_dn


def _check_countable(noise: NoiseConfig) -> None:
    """Raise ConfigError if white is more than `MAX_ELECTRONS`; a = 0 means no shot noise, so nothing is counted."""
    span = 1 if noise.units == "normalized" else (noise.white_level_dn or 0) - (noise.black_level_dn or 0)
    a = parse_drawn("noise.a", noise.a, VARIANCE_SLOPE)
    if a.numbers != (0.0,) and lowest(a) * MAX_ELECTRONS < span:
        raise ConfigError(
            f"noise.a={value_text(noise.a)}: noise.law=poisson counts up to {MAX_ELECTRONS:g} electrons, so a must be "
            f"0, or at least {span / MAX_ELECTRONS:g}"
        )


# ------------------------------------------------------------------------------------------ physical noise profiles


def _check_physical(noise: NoiseConfig, scene: SceneConfig) -> None:
    if noise.law != "gaussian":
        raise ConfigError(
            f"noise.law={noise.law}: noise={noise.name} is a physical profile; expected one with two numbers, a and b"
        )
    for key in ("a", "b"):
        if getattr(noise, key) is not None:
            raise ConfigError(
                f"noise.{key}={value_text(getattr(noise, key))}: noise={noise.name} is a physical profile; "
                "expected null; set noise.iso instead"
            )
    if noise.units != "dn" or noise.black != "subtracted":
        raise ConfigError(
            f"noise.units={noise.units}: noise={noise.name} is a physical profile; expected units: dn, black: "
            "subtracted"
        )
    _check_calibration(noise)
    for number, branch in enumerate(noise.branches):
        _check_branch(f"noise.branches[{number}]", noise, branch)
    if noise.lens_shading is not None:
        _check_shading(noise.lens_shading)
    for name in noise.assumed:
        one_of("noise.assumed", name, ASSUMABLE)
    for number, statement in enumerate(noise.provenance):
        _check_provenance(f"noise.provenance[{number}]", statement)
    _check_iso(noise, scene)
    _check_electrons(noise, scene)


def _check_branch(key: str, noise: NoiseConfig, branch: BranchConfig) -> None:
    if len(branch.iso) != 2 or not 0 < branch.iso[0] <= branch.iso[1] <= MAX_ISO:
        raise ConfigError(f"{key}.iso={value_text(branch.iso)}: expected {ISO_RANGE}")
    gains: tuple[float, ...] = ()
    for name, setting in settings_of(BranchConfig).items():
        value = getattr(branch, name)
        if isinstance(setting.limit, IsoForm) and not (value is None and setting.null):
            _check_form(f"{key}.{name}", value, setting.limit, gains)
            if _is_table(value, "by_iso"):
                _check_isos(f"{key}.{name}", value, branch)
        if name == "dn_per_e":
            gains = _gains_at_ends(branch)
            _check_gain(f"{key}.{name}", noise, branch, gains[0])
        setting.check(f"{key}.{name}", value)
    _check_shape(f"{key}.read_shape", branch)
    _check_tails(key, branch)
    _check_black_error(f"{key}.black_error_dn", branch)


def _check_tails(key: str, branch: BranchConfig) -> None:
    """Raise ConfigError for shapes of ``tukey_lambda`` whose variance is mostly in values that are never drawn."""
    shapes = branch.read_shape if isinstance(branch.read_shape, list | tuple) else [branch.read_shape]
    if branch.read_law == "tukey_lambda" and min(filter(is_number, shapes)) < HEAVIEST_TAILS:
        raise ConfigError(
            f"{key}.read_shape={value_text(branch.read_shape)}: draws of 32 bits lack more than 12 % of the variance; "
            f"expected shapes of {HEAVIEST_TAILS:g} or more"
        )


def well_ends_first(noise: NoiseConfig, scene: SceneConfig) -> bool:
    """Return whether a full well can end below white, so that the clean frame depends on the ISO."""
    if not is_physical(noise) or noise.full_well_e is None:
        return False
    assert noise.white_level_dn is not None and noise.black_level_dn is not None
    drawn = parse_drawn("iso", scene.iso if noise.iso is None else noise.iso, ISO)
    low, high = lowest(drawn), highest(drawn)
    gains = [_gain_at(branch, max(low, branch.iso[0])) for branch in noise.branches if _overlaps(branch, low, high)]
    full_dn: float = noise.full_well_e * min(gains)
    return full_dn < noise.white_level_dn - noise.black_level_dn


def _overlaps(branch: BranchConfig, low: float, high: float) -> bool:
    return branch.iso[0] <= high and low <= branch.iso[1]


def _gains_at_ends(branch: BranchConfig) -> tuple[float, float]:
    """Return the system gain at the lowest and the highest ISO of a branch, DN per electron."""
    return _gain_at(branch, branch.iso[0]), _gain_at(branch, branch.iso[1])


def _gain_at(branch: BranchConfig, iso: float) -> float:
    gain = branch.dn_per_e
    if not isinstance(gain, list | tuple):
        return float(gain)
    return float(gain[1] * iso + (gain[2] if len(gain) > 2 else 0.0))


def _check_gain(key: str, noise: NoiseConfig, branch: BranchConfig, lowest_gain: float) -> None:
    """Raise ConfigError if a gain is 0, or so small that white is more than `MAX_ELECTRONS`."""
    assert noise.white_level_dn is not None and noise.black_level_dn is not None
    if not lowest_gain * MAX_ELECTRONS >= noise.white_level_dn - noise.black_level_dn:
        raise ConfigError(
            f"{key}={value_text(branch.dn_per_e)}: expected a gain above 0, with at most {MAX_ELECTRONS:g} electrons "
            "at white"
        )


def _check_form(key: str, value: Any, limit: IsoForm, gains: tuple[float, ...]) -> None:
    """Raise ConfigError unless a value is a number or an allowed form; ``gains`` are those at which lines are used."""
    if is_number(value) and 0 <= value <= MAX_BRANCH_NUMBER:
        return
    form, numbers = (value[0], value[1:]) if isinstance(value, list | tuple) and value else (None, [])
    if form not in limit.forms:
        raise ConfigError(f"{key}={value_text(value)}: expected {limit}")
    if form == "by_iso":
        if not all(is_number(number) and 0 < number <= MAX_BRANCH_NUMBER for number in numbers):
            raise ConfigError(f"{key}={value_text(value)[:60]}: expected numbers above 0, up to {MAX_BRANCH_NUMBER:g}")
        return
    most = len(ISO_FORMS[form].numbers)
    fewest = most - ISO_FORMS[form].optional
    if not (
        fewest <= len(numbers) <= most
        and all(is_number(number) and abs(number) <= MAX_BRANCH_NUMBER for number in numbers)
    ):
        count = f"{fewest}" if fewest == most else f"{fewest} to {most}"
        raise ConfigError(
            f"{key}={value_text(value)}: {form} takes {count} finite numbers of at most {MAX_BRANCH_NUMBER:g}"
        )
    if form in ("per_iso", "root"):
        if min(numbers) < 0:
            raise ConfigError(f"{key}={value_text(value)}: expected numbers of 0 or more")
        return
    slope, intercept, scatter = numbers
    largest = max(slope * math.log(gain) for gain in gains) + intercept + FARTHEST_NORMAL * abs(scatter)
    if largest > math.log(MAX_BRANCH_NUMBER):
        raise ConfigError(
            f"{key}={value_text(value)}: exceeds {MAX_BRANCH_NUMBER:g} DN within the ISO range; expected slope, "
            "intercept and scatter of ln(standard deviation) against ln(gain)"
        )


def _is_table(value: Any, form: str) -> bool:
    return isinstance(value, list | tuple) and bool(value) and value[0] == form


def _check_isos(key: str, value: list[Any], branch: BranchConfig) -> None:
    """Raise ConfigError unless the ISOs of a table ``by_iso`` ascend and contain the range of the branch."""
    isos = value[1::2]
    if len(value) % 2 == 0 or not isos or any(low >= high for low, high in itertools.pairwise(isos)):
        raise ConfigError(f"{key}={value_text(value)[:60]}: expected pairs of ISO and value, ISOs in ascending order")
    if not isos[0] <= branch.iso[0] <= branch.iso[1] <= isos[-1]:
        raise ConfigError(
            f"{key}={value_text(value)[:60]}: has ISO {isos[0]:g} to {isos[-1]:g}; expected values for the ISOs of "
            f"the branch, {branch.iso[0]:g} to {branch.iso[1]:g}"
        )


def _check_stops(key: str, value: list[Any], rows: int, branch: BranchConfig) -> None:
    """Raise ConfigError unless a table ``by_stop`` has a row for every ISO of the branch."""
    needed = row_of_stop(branch.iso[1]) + 1
    if branch.iso[0] < 100 or rows < needed:
        raise ConfigError(
            f"{key}={value_text(value)[:60]}: has {rows} rows from ISO 100; the branch, ISO {branch.iso[0]:g} to "
            f"{branch.iso[1]:g}, needs {needed}; expected two rows for each full stop"
        )


def _check_shape(key: str, branch: BranchConfig) -> None:
    value = branch.read_shape
    if _is_table(value, "by_iso"):
        if not all(map(is_number, value[1:])):
            raise ConfigError(f"{key}={value_text(value)[:60]}: expected pairs of ISO and shape")
        _check_isos(key, value, branch)
        shapes = value[2::2]
    elif _is_table(value, "by_stop"):
        shapes = value[1:]
        _check_stops(key, value, len(shapes), branch)
    else:
        parse_drawn(key, value, READ_SHAPE)
        return
    parse_drawn(key, ["choice", *shapes], READ_SHAPE)


BLACK_ERROR_WORDS: tuple[list[str], ...] = (
    [],
    ["by_log_iso"],
    ["by_stop"],
    ["by_colour"],
    ["by_colour", "by_stop"],
    ["by_colour", "by_log_iso"],
)
"""Words that may precede the black-level errors of a branch."""


DARKEST = 0.01
"""Least relative illumination. Chosen: far below that of lenses."""


def _check_shading(coefficients: Sequence[float]) -> None:
    """Raise ConfigError unless the relative illumination is from `DARKEST` to 1 in all of the frame."""
    settings_of(NoiseConfig)["lens_shading"].check("noise.lens_shading", coefficients)
    first, second, third = coefficients
    places = illumination_at(np.arange(257) / 256, (first, second, third))
    if min(places) < DARKEST or max(places) > 1:
        raise ConfigError(
            f"noise.lens_shading={value_text(coefficients)}: the relative illumination within the frame is "
            f"{min(places):.3g} to {max(places):.3g}; expected {DARKEST:g} to 1"
        )


def _check_black_error(key: str, branch: BranchConfig) -> None:
    value = branch.black_error_dn
    if value is None or _is_black_error(value):
        return
    words, rest = table_words(value)
    has_rows = words[-1:] in (["by_log_iso"], ["by_stop"])
    rows = rest if has_rows else [rest]
    if (
        words not in BLACK_ERROR_WORDS
        or not isinstance(value, list | tuple)
        or not rows
        or not all(isinstance(row, list | tuple) and len(row) == 4 and all(map(_is_black_error, row)) for row in rows)
    ):
        raise ConfigError(f"{key}={value_text(value)[:60]}: expected {BLACK_ERROR}")
    if words[-1:] == ["by_stop"]:
        _check_stops(key, list(value), len(rows), branch)


def _is_black_error(value: Any) -> bool:
    return is_number(value) and abs(value) <= MAX_BRANCH_NUMBER


PROVENANCE_NUMBERS = (
    *("black_level_dn", "white_level_dn"),
    *(name for name in settings_of(BranchConfig) if name not in ("iso", "read_law")),
    *PHYSICAL_NUMBERS,
)
"""Keys whose source a profile may state."""


def _check_provenance(key: str, statement: ProvenanceConfig) -> None:
    if not statement.numbers:
        raise ConfigError(f"{key}.numbers=[]: expected at least one of {', '.join(PROVENANCE_NUMBERS)}")
    for name in statement.numbers:
        one_of(f"{key}.numbers", name, PROVENANCE_NUMBERS)
    iso = statement.iso
    if iso and (len(iso) != 2 or not 0 < iso[0] <= iso[1] <= MAX_ISO):
        raise ConfigError(f"{key}.iso={value_text(iso)}: expected {ISO_RANGE}, or [] for all ISOs")
    for name in ("source", "uncertainty"):
        settings_of(ProvenanceConfig)[name].check(f"{key}.{name}", getattr(statement, name))


def _check_iso(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Raise ConfigError if an ISO could be drawn for which the profile was not calibrated."""
    key, value = ("scene.iso", scene.iso) if noise.iso is None else ("noise.iso", noise.iso)
    drawn = parse_drawn(key, value, ISO)
    ends = drawn.numbers
    branches = [(branch.iso[0], branch.iso[1]) for branch in noise.branches]
    ranges, expected = _merged(branches), ""
    if all(branch_of(noise, iso) is not None for iso in ends):
        if drawn.kind in ("constant", "choice") or any(low <= min(ends) and max(ends) <= high for low, high in ranges):
            return
        expected = "; expected a distribution within one of these ranges"
    texts = ", ".join(f"{low:g}" if low == high else f"{low:g} to {high:g}" for low, high in ranges)
    advice = "" if noise.iso is not None else "; give noise.iso=…"
    raise ConfigError(f"{key}={value_text(value)}: noise={noise.name} is calibrated for ISO {texts}{expected}{advice}")


def _merged(branches: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return ranges in ascending order; those that touch or overlap become one."""
    ranges: list[tuple[float, float]] = []
    for low, high in sorted(branches):
        if ranges and low <= ranges[-1][1]:
            ranges[-1] = ranges[-1][0], max(high, ranges[-1][1])
        else:
            ranges.append((low, high))
    return ranges


def _check_electrons(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Raise ConfigError if the dark current could exceed `MAX_ELECTRONS`."""
    seconds = highest(parse_drawn("scene.exposure_s", scene.exposure_s, EXPOSURE_S))
    celsius = highest(parse_drawn("scene.temperature_c", scene.temperature_c, TEMPERATURE_C))
    for key in ("dark_e_per_s", "hot_pixel_e_per_s"):
        rate = Decimal((getattr(noise, key) or 0.0) * seconds)
        doublings = (Decimal(celsius) - Decimal(noise.dark_reference_c)) / Decimal(noise.dark_doubling_c)
        most = (Decimal(MAX_ELECTRONS) / 8).ln()  # a hot pixel has up to 8 times the mean
        if rate > 0 and rate.ln() + doublings * Decimal(2).ln() > most:
            raise ConfigError(
                f"noise.{key}={getattr(noise, key)}: more than {MAX_ELECTRONS:g} electrons in {seconds:g} s at "
                f"{celsius:g} degrees Celsius"
            )
