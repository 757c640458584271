"""Check noise profiles: those with two numbers, and physical profiles with branches by ISO."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal

import numpy as np

from unprocess_gen.config import limits
from unprocess_gen.config.distributions import highest, lowest
from unprocess_gen.config.interpretation import branch_of, is_physical, noise_distributions
from unprocess_gen.config.iso_forms import value_at
from unprocess_gen.config.schema import (
    NoiseConfig,
    SceneConfig,
)
from unprocess_gen.config.values import refusal
from unprocess_gen.core.fields import value_text
from unprocess_gen.simulation.effects.lens_shading import illumination_at

MAX_ELECTRONS = 1e9
"""Largest mean of an exact Poisson count (`simulation.reference.poisson`); no pixel holds as many electrons."""

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
        if not min(value_at(branch.dn_per_e, iso) for iso in branch.iso) * MAX_ELECTRONS >= _span(noise):
            expected = f"expected a gain above 0, with at most {MAX_ELECTRONS:g} electrons at white"
            raise refusal(f"noise.branches[{number}].dn_per_e", branch.dn_per_e, expected)
    if noise.lens_shading is not None:
        _check_shading(noise.lens_shading)
    _check_iso(noise, scene)
    _check_electrons(noise, scene)


def well_ends_first(noise: NoiseConfig, scene: SceneConfig) -> bool:
    """True if a full well can end below white, so that the clean frame depends on the ISO."""
    if not is_physical(noise) or noise.full_well_e is None:
        return False
    drawn = limits.ISO.parse("iso", scene.iso if noise.iso is None else noise.iso)
    low, high = lowest(drawn), highest(drawn)
    branches = [branch for branch in noise.branches if branch.iso[0] <= high and low <= branch.iso[1]]
    return bool(
        noise.full_well_e * min(value_at(branch.dn_per_e, max(low, branch.iso[0])) for branch in branches)
        < _span(noise)
    )


# ------------------------------------------------------------------------------------------- numbers of the profile


def _check_shading(coefficients: Sequence[float]) -> None:
    """Raise ConfigError unless the relative illumination is from `DARKEST` to 1 in all of the frame."""
    first, second, third = coefficients
    places = illumination_at(np.arange(257) / 256, (first, second, third))
    if min(places) < DARKEST or max(places) > 1:
        within = f"the relative illumination within the frame is {min(places):.3g} to {max(places):.3g}"
        raise refusal("noise.lens_shading", coefficients, f"{within}; expected {DARKEST:g} to 1")


def _check_iso(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Raise ConfigError if an ISO could be drawn for which the profile was not calibrated."""
    key, value = ("scene.iso", scene.iso) if noise.iso is None else ("noise.iso", noise.iso)
    drawn = limits.ISO.parse(key, value)
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
    seconds = highest(limits.EXPOSURE_S.parse("scene.exposure_s", scene.exposure_s))
    celsius = highest(limits.TEMPERATURE_C.parse("scene.temperature_c", scene.temperature_c))
    doublings = (Decimal(celsius) - Decimal(noise.dark_reference_c)) / Decimal(noise.dark_doubling_c)
    most = (Decimal(MAX_ELECTRONS) / 8).ln()  # a hot pixel has up to 8 times the mean
    for key in ("dark_e_per_s", "hot_pixel_e_per_s"):
        rate = Decimal((getattr(noise, key) or 0.0) * seconds)
        if rate > 0 and rate.ln() + doublings * Decimal(2).ln() > most:
            where = f"in {seconds:g} s at {celsius:g} degrees Celsius"
            raise refusal(f"noise.{key}", getattr(noise, key), f"more than {MAX_ELECTRONS:g} electrons {where}")
