"""Check noise profiles: those with two numbers, and physical profiles with branches by ISO."""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Sequence
from decimal import Decimal
from typing import Any

import numpy as np

from unprocess_gen.config import limits
from unprocess_gen.config.distributions import highest, lowest, parse_drawn
from unprocess_gen.config.interpretation import branch_of, is_physical, noise_distributions
from unprocess_gen.config.limits import ISO_RANGE, MAX_BRANCH_NUMBER
from unprocess_gen.config.schema import (
    ASSUMABLE,
    PHYSICAL_NUMBERS,
    BranchConfig,
    NoiseConfig,
    ProvenanceConfig,
    SceneConfig,
)
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.values import one_of, refusal
from unprocess_gen.core.fields import is_number, value_text
from unprocess_gen.simulation.effects.lens_shading import illumination_at

MAX_ELECTRONS = 1e9
"""Largest mean of an exact Poisson count (`simulation.reference.poisson`); no pixel holds as many electrons."""


HEAVIEST_TAILS = -0.45
"""Least shape of ``tukey_lambda``, whose table is 7 % wider than the distribution, so that its variance is 1."""

FARTHEST_NORMAL = 6.4
"""No normal deviate of a 32-bit uniform is farther from 0."""

DARKEST = 0.01
"""Least relative illumination. Chosen: far below the illumination of lenses."""


def check_noise(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Raise ConfigError unless a noise profile can be simulated at the ISO, exposure and temperature of a scene."""
    if is_physical(noise):
        _check_physical(noise, scene)
    else:
        _check_two_numbers(noise)


def _check_two_numbers(noise: NoiseConfig) -> None:
    if noise.iso is not None:
        problem = f"noise={noise.name} holds for one ISO; expected null; choose a physical profile"
        raise refusal("noise.iso", noise.iso, problem)
    a, b = noise_distributions(noise)
    black_dn = 0
    if noise.units != "normalized":
        _check_calibration(noise)
        black_dn = (noise.black_level_dn or 0) if noise.black == "included" else 0
    elif noise.black == "included":
        raise refusal("noise.black", noise.black, "normalized units have black at 0; expected subtracted")
    if noise.law == "poisson":
        if noise.black == "included" or lowest(b) < 0:
            expected = "expected noise.black=subtracted and noise.b of 0 or more"
            raise refusal("noise.law", "poisson", f"{expected}; set noise.law=gaussian")
        if a.numbers != (0.0,) and lowest(a) * MAX_ELECTRONS < _span(noise):  # a = 0 is no shot noise: no counts
            expected = f"so a must be 0, or at least {_span(noise) / MAX_ELECTRONS:g}"
            problem = f"noise.law=poisson counts up to {MAX_ELECTRONS:g} electrons, {expected}"
            raise refusal("noise.a", noise.a, problem)
    variance = lowest(b) + lowest(a) * black_dn
    if variance < 0 and noise.negative_variance == "refuse":
        advice = "set noise.negative_variance=clip to use max(0, variance)"
        raise refusal("noise.b", noise.b, f"variance at black is {variance:.6g}; expected 0 or more; {advice}")


def _check_calibration(noise: NoiseConfig) -> None:
    bits, black, white = noise.bits, noise.black_level_dn, noise.white_level_dn
    if bits is None or black is None or white is None:
        needed = f"{noise.name} needs bits, black_level_dn and white_level_dn of its calibration"
        raise refusal("noise.units", "dn", f"{needed}, got {value_text([bits, black, white])[1:-1]}")


def _span(noise: NoiseConfig) -> int:
    """White above black, in the units of the profile."""
    return 1 if noise.units == "normalized" else (noise.white_level_dn or 0) - (noise.black_level_dn or 0)


# ------------------------------------------------------------------------------------------ physical noise profiles


def _check_physical(noise: NoiseConfig, scene: SceneConfig) -> None:
    physical = f"noise={noise.name} is a physical profile; expected"
    if noise.law != "gaussian":
        raise refusal("noise.law", noise.law, f"{physical} one with two numbers, a and b")
    for key in ("a", "b"):
        if getattr(noise, key) is not None:
            raise refusal(f"noise.{key}", getattr(noise, key), f"{physical} null; set noise.iso instead")
    if noise.units != "dn" or noise.black != "subtracted":
        raise refusal("noise.units", noise.units, f"{physical} units: dn, black: subtracted")
    _check_calibration(noise)
    for number, branch in enumerate(noise.branches):
        _check_branch(f"noise.branches[{number}]", branch, _span(noise))
    if noise.lens_shading is not None:
        _check_shading(noise.lens_shading)
    for key, names in (("noise.assumed", noise.assumed), ("noise.unsourced", noise.unsourced)):
        for name in names:
            one_of(key, name, ASSUMABLE)
    for number, statement in enumerate(noise.provenance):
        _check_provenance(f"noise.provenance[{number}]", statement)
    _check_iso(noise, scene)
    _check_electrons(noise, scene)


def _check_branch(key: str, branch: BranchConfig, span: int) -> None:
    if not _is_range(branch.iso):
        raise refusal(f"{key}.iso", branch.iso, f"expected {ISO_RANGE}")
    for name, setting in settings_of(BranchConfig).items():
        value = getattr(branch, name)
        if isinstance(setting.limit, limits.IsoForm) and not (value is None and setting.null):
            _check_form(f"{key}.{name}", value, setting.limit, branch)
        if name == "dn_per_e" and not min(value_at(value, iso) for iso in branch.iso) * MAX_ELECTRONS >= span:
            expected = f"expected a gain above 0, with at most {MAX_ELECTRONS:g} electrons at white"
            raise refusal(f"{key}.{name}", value, expected)
        setting.check(f"{key}.{name}", value)
    _check_shape(f"{key}.read_shape", branch)
    _check_black_error(f"{key}.black_error_dn", branch)


def _is_range(iso: Sequence[float]) -> bool:
    return len(iso) == 2 and 0 < iso[0] <= iso[1] <= limits.ISO.numbers.high


def well_ends_first(noise: NoiseConfig, scene: SceneConfig) -> bool:
    """True if a full well can end below white, so that the clean frame depends on the ISO."""
    if not is_physical(noise) or noise.full_well_e is None:
        return False
    drawn = parse_drawn("iso", scene.iso if noise.iso is None else noise.iso, limits.ISO)
    low, high = lowest(drawn), highest(drawn)
    branches = [branch for branch in noise.branches if branch.iso[0] <= high and low <= branch.iso[1]]
    return bool(
        noise.full_well_e * min(value_at(branch.dn_per_e, max(low, branch.iso[0])) for branch in branches)
        < _span(noise)
    )


# --------------------------------------------------------------------------------------- numbers that depend on ISO


def _check_form(key: str, value: Any, limit: limits.IsoForm, branch: BranchConfig) -> None:
    """Raise ConfigError unless a value is a number or an allowed form."""
    match value:
        case ["line", *numbers]:
            if len(numbers) not in (2, 3) or not all(map(_is_branch_number, numbers)):
                raise refusal(key, value, f"line takes 2 or 3 finite numbers of at most {MAX_BRANCH_NUMBER:g}")
            slope, intercept, scatter = (*numbers, 0.0)[:3]
            largest = max(slope * math.log(iso) for iso in branch.iso) + intercept + FARTHEST_NORMAL * abs(scatter)
            if largest > math.log(MAX_BRANCH_NUMBER):
                line = "slope, intercept and scatter of ln(value) against ln(ISO)"
                raise refusal(key, value, f"exceeds {MAX_BRANCH_NUMBER:g} within the ISO range; expected {line}")
        case ["by_iso", *pairs]:
            if not all(is_number(number) and 0 < number <= MAX_BRANCH_NUMBER for number in pairs):
                raise refusal(key, value, f"expected numbers above 0, up to {MAX_BRANCH_NUMBER:g}")
            _check_isos(key, value, branch)
        case _:
            if not (is_number(value) and 0 <= value <= MAX_BRANCH_NUMBER):
                raise refusal(key, value, f"expected {limit}")


def _is_branch_number(value: Any) -> bool:
    return is_number(value) and abs(value) <= MAX_BRANCH_NUMBER


def _check_isos(key: str, value: Sequence[Any], branch: BranchConfig) -> None:
    """Raise ConfigError unless the ISOs of a table ``by_iso`` ascend and contain the range of the branch."""
    isos = value[1::2]
    ascend = all(map(is_number, isos)) and all(low < high for low, high in itertools.pairwise(isos))
    if len(value) % 2 == 0 or not isos or not ascend:
        raise refusal(key, value, "expected pairs of ISO and value, ISOs in ascending order")
    first, last = branch.iso
    if not isos[0] <= first <= last <= isos[-1]:
        expected = f"expected values for the ISOs of the branch, {first:g} to {last:g}"
        raise refusal(key, value, f"has ISO {isos[0]:g} to {isos[-1]:g}; {expected}")


def _check_shape(key: str, branch: BranchConfig) -> None:
    """Raise ConfigError for a shape, or a table of shapes, out of range.

    The variance of ``tukey_lambda`` with heavier tails is mostly in values that are never drawn.
    """
    value = branch.read_shape
    shapes = _table_values(key, value, branch)
    if not all(is_number(shape) and -0.5 < shape < 10 for shape in shapes):
        raise refusal(key, value, f"expected {limits.READ_SHAPE}")
    if branch.read_law == "tukey_lambda" and min(shapes) < HEAVIEST_TAILS:
        lacking = "draws of 32 bits lack more than 12 % of the variance"
        raise refusal(key, value, f"{lacking}; expected shapes of {HEAVIEST_TAILS:g} or more")


def _table_values(key: str, value: Any, branch: BranchConfig) -> Sequence[Any]:
    """Values of a table ``by_iso``, whose ISOs are checked, or the value itself."""
    if not isinstance(value, list | tuple) or value[:1] not in (["by_iso"], ("by_iso",)):
        return [value]
    _check_isos(key, value, branch)
    return value[2::2]


def _check_black_error(key: str, branch: BranchConfig) -> None:
    value = branch.black_error_dn
    for error in () if value is None else _table_values(key, value, branch):
        four = error if isinstance(error, list | tuple) else [error] * 4
        if len(four) != 4 or not all(map(_is_branch_number, four)):
            raise refusal(key, value, f"expected {limits.BLACK_ERROR}")


# ------------------------------------------------------------------------------------------- numbers of the profile


def _check_shading(coefficients: Sequence[float]) -> None:
    """Raise ConfigError unless the relative illumination is from `DARKEST` to 1 in all of the frame."""
    first, second, third = coefficients
    places = illumination_at(np.arange(257) / 256, (first, second, third))
    if min(places) < DARKEST or max(places) > 1:
        within = f"the relative illumination within the frame is {min(places):.3g} to {max(places):.3g}"
        raise refusal("noise.lens_shading", coefficients, f"{within}; expected {DARKEST:g} to 1")


PROVENANCE_NUMBERS = (
    *("black_level_dn", "white_level_dn"),
    *(name for name in settings_of(BranchConfig) if name not in ("iso", "read_law")),
    *PHYSICAL_NUMBERS,
)
"""Keys whose source a profile may state."""


def _check_provenance(key: str, statement: ProvenanceConfig) -> None:
    if not statement.numbers:
        raise refusal(f"{key}.numbers", [], f"expected at least one of {', '.join(PROVENANCE_NUMBERS)}")
    for name in statement.numbers:
        one_of(f"{key}.numbers", name, PROVENANCE_NUMBERS)
    if statement.iso and not _is_range(statement.iso):
        raise refusal(f"{key}.iso", statement.iso, f"expected {ISO_RANGE}, or [] for all ISOs")
    for name in ("source", "uncertainty"):
        settings_of(ProvenanceConfig)[name].check(f"{key}.{name}", getattr(statement, name))


def _check_iso(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Raise ConfigError if an ISO could be drawn for which the profile was not calibrated."""
    key, value = ("scene.iso", scene.iso) if noise.iso is None else ("noise.iso", noise.iso)
    drawn = parse_drawn(key, value, limits.ISO)
    ranges: list[tuple[float, float]] = []  # of the branches, in ascending order; those that touch are one
    for low, high in sorted((branch.iso[0], branch.iso[1]) for branch in noise.branches):
        if ranges and low <= ranges[-1][1]:
            lower = ranges.pop()
            low, high = lower[0], max(high, lower[1])
        ranges.append((low, high))
    expected = ""
    if all(branch_of(noise, iso) is not None for iso in drawn.numbers):
        within = any(low <= lowest(drawn) and highest(drawn) <= high for low, high in ranges)
        if drawn.kind in ("constant", "choice") or within:
            return
        expected = "; expected a distribution within one of these ranges"
    isos = ", ".join(f"{low:g}" if low == high else f"{low:g} to {high:g}" for low, high in ranges)
    advice = "" if noise.iso is not None else "; give noise.iso=…"
    raise refusal(key, value, f"noise={noise.name} is calibrated for ISO {isos}{expected}{advice}")


def _check_electrons(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Raise ConfigError if the dark current could exceed `MAX_ELECTRONS`."""
    seconds = highest(parse_drawn("scene.exposure_s", scene.exposure_s, limits.EXPOSURE_S))
    celsius = highest(parse_drawn("scene.temperature_c", scene.temperature_c, limits.TEMPERATURE_C))
    doublings = (Decimal(celsius) - Decimal(noise.dark_reference_c)) / Decimal(noise.dark_doubling_c)
    most = (Decimal(MAX_ELECTRONS) / 8).ln()  # a hot pixel has up to 8 times the mean
    for key in ("dark_e_per_s", "hot_pixel_e_per_s"):
        rate = Decimal((getattr(noise, key) or 0.0) * seconds)
        if rate > 0 and rate.ln() + doublings * Decimal(2).ln() > most:
            where = f"in {seconds:g} s at {celsius:g} degrees Celsius"
            raise refusal(f"noise.{key}", getattr(noise, key), f"more than {MAX_ELECTRONS:g} electrons {where}")


def value_at(form: Any, iso: float) -> float:
    """Gain or standard deviation at an ISO without scatter, to the precision of the C library."""
    match form:
        case ["line", slope, intercept, *_]:
            return math.exp(slope * math.log(iso) + intercept)
        case ["by_iso", *pairs]:
            isos, values = ([math.log(number) for number in pairs[start::2]] for start in (0, 1))
            above = min(bisect.bisect_left(isos, math.log(iso)), len(isos) - 1)
            low = max(above - 1, 0)
            share = (math.log(iso) - isos[low]) / (isos[above] - isos[low]) if above else 0.0
            return math.exp(values[low] + share * (values[above] - values[low]))
    return float(form)
