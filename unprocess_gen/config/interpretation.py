"""Interpret configuration values: distributions, noise levels, patches, switches and the kind of a noise profile."""

from __future__ import annotations

import dataclasses
from typing import Any

from unprocess_gen.config.accuracy import Budget
from unprocess_gen.config.distributions import highest, lowest, parse_distribution
from unprocess_gen.config.schema import (
    AccuracyConfig,
    BranchConfig,
    Config,
    EffectsConfig,
    GainsConfig,
    NoiseConfig,
    SourceConfig,
)
from unprocess_gen.config.values import is_integer, is_number, value_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import FLOAT32, Distribution, PatchRule

# ---------------------------------------------------------------------------------------------------- distributions

GAIN_DISTRIBUTIONS = ("uniform", "truncated_normal")
INVERSE_GAIN_DISTRIBUTIONS = (*GAIN_DISTRIBUTIONS, "inverse_truncated_normal")
A_DISTRIBUTIONS = ("uniform", "log_uniform")
B_DISTRIBUTIONS = (*A_DISTRIBUTIONS, "log_linear_in_a")
SCENE_DISTRIBUTIONS = ("uniform", "log_uniform", "choice")
"""Allowed distributions of ISO and of the values of a scene."""

MIN_GAIN, MAX_GAIN = 1e-3, 1e3
"""Range of all gains. Chosen: far beyond cameras, and no product or quotient of gains overflows."""

MAX_VARIANCE = 1e15
"""Largest a and b of a profile. Chosen: far beyond sensors, and the conversion to DN does not overflow."""


def gain_distributions(gains: GainsConfig) -> tuple[Distribution, Distribution, Distribution]:
    """Parse the distributions of the gains.

    Parameters
    ----------
    gains : GainsConfig
        The gains of the configuration.

    Returns
    -------
    tuple of Distribution
        Of the red, blue and inverse brightening gain; all draws are from `MIN_GAIN` to `MAX_GAIN`.

    Raises
    ------
    ConfigError
        If a value is no number or distribution, or a draw could be out of range.
    """
    distributions = (
        parse_distribution("gains.red", gains.red, GAIN_DISTRIBUTIONS),
        parse_distribution("gains.blue", gains.blue, GAIN_DISTRIBUTIONS),
        parse_distribution("gains.inverse_rgb", gains.inverse_rgb, INVERSE_GAIN_DISTRIBUTIONS),
    )
    for name, distribution in zip(("red", "blue", "inverse_rgb"), distributions, strict=True):
        if not (lowest(distribution) >= MIN_GAIN and highest(distribution) <= MAX_GAIN):
            value = value_text(getattr(gains, name))
            raise ConfigError(f"gains.{name}={value}: expected a gain above 0, from {MIN_GAIN:g} to {MAX_GAIN:g}")
    return distributions


def noise_distributions(noise: NoiseConfig) -> tuple[Distribution, Distribution]:
    """Parse the distributions of the two numbers of a noise profile.

    Parameters
    ----------
    noise : NoiseConfig
        A profile with two numbers.

    Returns
    -------
    tuple of Distribution
        Of the slope a and the offset b of the variance, in the units of the profile.

    Raises
    ------
    ConfigError
        If a value is no number or distribution, or a draw could be out of range: a negative a, or more than
        `MAX_VARIANCE`.
    """
    a, b = (
        parse_distribution("noise.a", noise.a, A_DISTRIBUTIONS),
        parse_distribution("noise.b", noise.b, B_DISTRIBUTIONS),
    )
    if lowest(a) < 0:
        raise ConfigError(f"noise.a={value_text(noise.a)}: expected a slope of the variance of 0 or more")
    for name, distribution in (("a", a), ("b", b)):
        if max(abs(number) for number in distribution.numbers) > MAX_VARIANCE:
            raise ConfigError(f"noise.{name}={value_text(getattr(noise, name))}: expected at most {MAX_VARIANCE:g}")
    if b.kind == "log_linear_in_a" and not lowest(a) > 0:
        raise ConfigError(f"noise.a={value_text(noise.a)}: expected more than 0, because noise.b depends on ln a")
    return a, b


# ----------------------------------------------------------------------------------------------------- noise levels

MAX_LEVELS = 100
"""Most noise levels, and most draws at each level: keys have two digits for them."""


def noise_levels(noise: NoiseConfig) -> tuple[NoiseConfig, ...]:
    """Split a noise profile into its noise levels.

    Parameters
    ----------
    noise : NoiseConfig
        The profile, with ``levels`` as the user wrote it.

    Returns
    -------
    tuple of NoiseConfig
        One profile for each level. A number of levels gives equal profiles, whose parameters are drawn separately.

    Raises
    ------
    ConfigError
        If ``levels`` is neither a number of levels nor a list of levels that fit the profile.
    """
    levels = 1 if noise.levels is None else noise.levels
    if is_integer(levels) and 1 <= levels <= MAX_LEVELS:
        return (noise,) * levels
    if not isinstance(levels, list) or not 1 <= len(levels) <= MAX_LEVELS:
        raise ConfigError(
            f"noise.levels={value_text(levels)}: expected how many, 1 to {MAX_LEVELS}, or a list of ISOs or {{a, b}}"
        )
    return tuple(_level(noise, level) for level in levels)


def _level(noise: NoiseConfig, level: Any) -> NoiseConfig:
    if is_physical(noise) and is_number(level):
        return dataclasses.replace(noise, iso=level)
    if not is_physical(noise) and isinstance(level, dict) and level.keys() == {"a", "b"}:
        return dataclasses.replace(noise, a=level["a"], b=level["b"])
    wanted = "an ISO" if is_physical(noise) else "{a: …, b: …}"
    raise ConfigError(
        f"noise.levels={value_text(noise.levels)}: {value_text(level)} is not {wanted}; expected a list of them for "
        f"noise={noise.name}, or how many levels"
    )


# --------------------------------------------------------------------------------------------------- noise profiles

EFFECT_NUMBERS = {
    "prnu": ("prnu_std",),
    "dark_current": ("dark_e_per_s",),
    "hot_pixels": ("hot_pixel_share", "hot_pixel_e_per_s"),
    "full_well": ("full_well_e",),
    "dead_pixels": ("dead_pixel_share",),
}
"""Keys of a profile that must have a number for an effect to be simulated."""

BRANCH_NUMBERS = {"row": "row_std_dn", "column": "column_std_dn", "black_error": "black_error_dn"}
"""Key of each branch of a profile that must have a number for an effect to be simulated."""


def is_physical(noise: NoiseConfig) -> bool:
    """Return whether a noise profile is physical: in electrons, with separate effects.

    Parameters
    ----------
    noise : NoiseConfig
        The profile.

    Returns
    -------
    bool
        True for a physical profile, False for one with two numbers, a and b.
    """
    return bool(noise.branches)


def uses_physics(noise: NoiseConfig) -> bool:
    """Return whether pairs of a noise profile are simulated by the kernels of the physical effects.

    Parameters
    ----------
    noise : NoiseConfig
        The profile.

    Returns
    -------
    bool
        True for physical profiles, and for two numbers with ``law=poisson``, which need Poisson counts.
    """
    return is_physical(noise) or noise.law == "poisson"


def branch_of(noise: NoiseConfig, iso: float) -> BranchConfig | None:
    """Find the numbers of a physical profile at an ISO.

    Parameters
    ----------
    noise : NoiseConfig
        A physical profile.
    iso : float
        The ISO.

    Returns
    -------
    BranchConfig or None
        The first branch whose range contains the ISO; None if no branch does.
    """
    return next((branch for branch in noise.branches if branch.iso[0] <= iso <= branch.iso[1]), None)


def missing_number(noise: NoiseConfig, effect: str) -> str | None:
    """Find a number that a physical profile lacks to simulate an effect.

    Parameters
    ----------
    noise : NoiseConfig
        A physical profile.
    effect : str
        One of `noise.EFFECTS`.

    Returns
    -------
    str or None
        Key of the first missing number; None if the profile has all of them.
    """
    if effect in BRANCH_NUMBERS and any(getattr(branch, BRANCH_NUMBERS[effect]) is None for branch in noise.branches):
        return BRANCH_NUMBERS[effect]
    return next((key for key in EFFECT_NUMBERS.get(effect, ()) if getattr(noise, key) is None), None)


# ------------------------------------------------------------------------------------------------------------ source

MIN_PATCH, MAX_PATCH = 2, 2**15
"""Range of the sides and strides of patches, pixels."""

MAX_RANDOM_PATCHES = 10**4
"""Most patches at random places of one image: keys have four digits for them."""


def patch_rule(source: SourceConfig) -> PatchRule | None:
    """Interpret ``source.patch``.

    Parameters
    ----------
    source : SourceConfig
        ``patch`` is None, a side, ``[grid, side]``, ``[grid, side, stride]`` or ``[random, side, count]``.

    Returns
    -------
    PatchRule or None
        How to cut images into patches; None if images are not cut.

    Raises
    ------
    ConfigError
        If the value has another form, or a number is odd or out of range.
    """
    match ["grid", source.patch] if is_integer(source.patch) else source.patch:
        case None:
            return None
        case ["grid", side] if _is_patch_length(side):
            return PatchRule("grid", side, stride=side)
        case ["grid", side, stride] if _is_patch_length(side) and _is_patch_length(stride):
            return PatchRule("grid", side, stride=stride)
        case ["random", side, count] if _is_patch_length(side) and _is_patch_count(count):
            return PatchRule("random", side, count=count)
    raise ConfigError(
        f"source.patch={value_text(source.patch)}: expected null, a side, [grid, side], [grid, side, stride] or "
        f"[random, side, count]; side and stride are even, {MIN_PATCH} to {MAX_PATCH} pixels, "
        f"count is 1 to {MAX_RANDOM_PATCHES}"
    )


def _is_patch_length(value: Any) -> bool:
    return is_integer(value) and MIN_PATCH <= value <= MAX_PATCH and value % 2 == 0


def _is_patch_count(value: Any) -> bool:
    return is_integer(value) and 1 <= value <= MAX_RANDOM_PATCHES


def canonical_patch(source: SourceConfig) -> list[Any] | None:
    """Return ``source.patch`` in the one spelling that ``config.yaml`` uses: ``[kind, side, stride or count]``."""
    rule = patch_rule(source)
    return None if rule is None else [rule.kind, rule.side, rule.stride or rule.count]


# ---------------------------------------------------------------------------------------------- switches and choices

SWITCHES = ("auto", "on", "off")

YAML_SWITCHES = {"True": "on", "False": "off"}
"""Text of the booleans that YAML reads from on and off without quotes."""

NO_CLIP = "none"
"""Value of ``sensor.clip`` with which noisy frames are not clipped."""


def effect_switch(effects: EffectsConfig, effect: str) -> str:
    """Return the switch of an effect.

    Parameters
    ----------
    effects : EffectsConfig
        The switches of the configuration.
    effect : str
        One of `noise.EFFECTS`.

    Returns
    -------
    str
        ``auto``, ``on`` or ``off``: the effect's own switch if it is set, otherwise that of ``all``.
    """
    switch = getattr(effects, effect) or effects.all
    return YAML_SWITCHES.get(switch, switch)


def dequantize_method(source: SourceConfig) -> str:
    """Return how 8-bit codes are dequantized.

    Parameters
    ----------
    source : SourceConfig
        The source of the configuration.

    Returns
    -------
    str
        ``off``, or ``dither``: codes get a random offset of up to half a code.
    """
    return YAML_SWITCHES.get(source.dequantize, source.dequantize)


def is_normalised(config: Config) -> bool:
    """Return whether frames are normalised.

    Parameters
    ----------
    config : Config
        The configuration.

    Returns
    -------
    bool
        True for float32 frames, 0 at black and 1 at white, not rounded; False for integer DN.
    """
    return config.output.dtype == FLOAT32


def accuracy_budget(accuracy: AccuracyConfig) -> Budget:
    """Convert the configured limits on errors.

    Parameters
    ----------
    accuracy : AccuracyConfig
        The limits of the configuration.

    Returns
    -------
    Budget
        The same limits, for `accuracy.choose_methods`.
    """
    return Budget(**dataclasses.asdict(accuracy))
