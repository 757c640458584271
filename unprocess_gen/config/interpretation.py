"""Turn checked configuration values into the numbers that planning uses."""

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

MIN_GAIN, MAX_GAIN = 1e-3, 1e3
"""Chosen: no camera comes near either, and no product or quotient of them overflows."""


MAX_VARIANCE = 1e15
"""Chosen: far above any sensor, and nothing overflows on the way to DN."""


GAIN_DISTRIBUTIONS = ("uniform", "truncated_normal")


INVERSE_GAIN_DISTRIBUTIONS = (*GAIN_DISTRIBUTIONS, "inverse_truncated_normal")


A_DISTRIBUTIONS = ("uniform", "log_uniform")


B_DISTRIBUTIONS = (*A_DISTRIBUTIONS, "log_linear_in_a")


def gain_distributions(gains: GainsConfig) -> tuple[Distribution, Distribution, Distribution]:
    """Return the laws of the red, blue and inverse brightening gain; ConfigError unless every draw is above 0."""
    laws = (
        parse_distribution("gains.red", gains.red, GAIN_DISTRIBUTIONS),
        parse_distribution("gains.blue", gains.blue, GAIN_DISTRIBUTIONS),
        parse_distribution("gains.inverse_rgb", gains.inverse_rgb, INVERSE_GAIN_DISTRIBUTIONS),
    )
    for name, drawn in zip(("red", "blue", "inverse_rgb"), laws, strict=True):
        if not (lowest(drawn) >= MIN_GAIN and highest(drawn) <= MAX_GAIN):
            value = value_text(getattr(gains, name))
            raise ConfigError(f"gains.{name}={value}: a gain must be above 0, from {MIN_GAIN:g} to {MAX_GAIN:g}")
    return laws


def noise_distributions(noise: NoiseConfig) -> tuple[Distribution, Distribution]:
    """Return the laws of a and b; ConfigError where a can be negative."""
    a, b = (
        parse_distribution("noise.a", noise.a, A_DISTRIBUTIONS),
        parse_distribution("noise.b", noise.b, B_DISTRIBUTIONS),
    )
    if lowest(a) < 0:
        raise ConfigError(f"noise.a={value_text(noise.a)}: the variance's slope must be 0 or more")
    for name, drawn in (("a", a), ("b", b)):
        if max(abs(number) for number in drawn.numbers) > MAX_VARIANCE:
            raise ConfigError(f"noise.{name}={value_text(getattr(noise, name))}: expected at most {MAX_VARIANCE:g}")
    if b.kind == "log_linear_in_a" and not lowest(a) > 0:
        raise ConfigError(f"noise.a={value_text(noise.a)}: noise.b depends on its logarithm, so it must be above 0")
    return a, b


def dequantize_method(source: SourceConfig) -> str:
    """Return ``off`` or ``dither``."""
    return YAML_SWITCHES.get(source.dequantize, source.dequantize)


def patch_rule(source: SourceConfig) -> PatchRule | None:
    """Return how images are cut into patches, None where they stay whole; ConfigError where it cannot be meant."""
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
        f"count is 1 to {MOST_RANDOM_PATCHES}"
    )


def _is_patch_length(value: Any) -> bool:
    return is_integer(value) and MIN_PATCH <= value <= MAX_PATCH and value % 2 == 0


def _is_patch_count(value: Any) -> bool:
    return is_integer(value) and 1 <= value <= MOST_RANDOM_PATCHES


def patch_setting(source: SourceConfig) -> list[Any] | None:
    """Return ``source.patch`` in the one spelling of ``config.yaml``."""
    law = patch_rule(source)
    return None if law is None else [law.kind, law.side, law.stride or law.count]


def noise_levels(noise: NoiseConfig) -> tuple[NoiseConfig, ...]:
    """Return the profile of each noise level; ConfigError where ``noise.levels`` is no list and no number of levels."""
    levels = 1 if noise.levels is None else noise.levels
    if is_integer(levels) and 1 <= levels <= MOST_LEVELS:
        return (noise,) * levels
    if not isinstance(levels, list) or not 1 <= len(levels) <= MOST_LEVELS:
        raise ConfigError(
            f"noise.levels={value_text(levels)}: expected how many, 1 to {MOST_LEVELS}, or a list of ISOs or {{a, b}}"
        )
    return tuple(_level(noise, level) for level in levels)


def _level(noise: NoiseConfig, level: Any) -> NoiseConfig:
    if is_physical(noise) and is_number(level):
        return dataclasses.replace(noise, iso=level)
    if not is_physical(noise) and isinstance(level, dict) and level.keys() == {"a", "b"}:
        return dataclasses.replace(noise, a=level["a"], b=level["b"])
    wanted = "an ISO" if is_physical(noise) else "{a: …, b: …}"
    raise ConfigError(f"noise.levels: {value_text(level)}: expected {wanted} for noise={noise.name}")


def uses_physics(noise: NoiseConfig) -> bool:
    """Whether pairs are made by the kernels of the physical effects: counts of electrons, not Gaussian noise alone."""
    return is_physical(noise) or noise.law == "poisson"


def is_physical(noise: NoiseConfig) -> bool:
    """Whether a profile speaks of electrons, not of a variance with two numbers."""
    return bool(noise.branches)


SCENE_DISTRIBUTIONS = ("uniform", "log_uniform", "choice")
"""What ISO and the numbers of a scene can be drawn from."""


def branch_of(noise: NoiseConfig, iso: float) -> BranchConfig | None:
    """Return what a physical profile says at an ISO; None where it says nothing."""
    return next((branch for branch in noise.branches if branch.iso[0] <= iso <= branch.iso[1]), None)


EFFECT_NUMBERS = {
    "prnu": ("prnu_std",),
    "dark_current": ("dark_e_per_s",),
    "hot_pixels": ("hot_pixel_share", "hot_pixel_e_per_s"),
    "full_well": ("full_well_e",),
    "dead_pixels": ("dead_pixel_share",),
}
"""The numbers of a profile that an effect cannot do without."""


BRANCH_NUMBERS = {"row": "row_std_dn", "column": "column_std_dn", "black_error": "black_error_dn"}
"""The same, of those that depend on ISO."""


def missing_number(noise: NoiseConfig, effect: str) -> str | None:
    """Return a number that a physical profile would have to give for an effect and does not; None if all is there."""
    missing = (key for key in EFFECT_NUMBERS.get(effect, ()) if getattr(noise, key) is None)
    if effect in BRANCH_NUMBERS and any(getattr(branch, BRANCH_NUMBERS[effect]) is None for branch in noise.branches):
        return BRANCH_NUMBERS[effect]
    return next(missing, None)


def effect_switch(effects: EffectsConfig, effect: str) -> str:
    """Return auto, on or off for an effect: what is said of it by name, else what ``all`` says."""
    said = getattr(effects, effect) or effects.all
    return YAML_SWITCHES.get(said, said)


def accuracy_budget(accuracy: AccuracyConfig) -> Budget:
    """Return the budget that the settings give."""
    return Budget(**dataclasses.asdict(accuracy))


NO_CLIP = "none"
"""What `sensor.clip` says where noisy frames are not clipped."""


def is_normalised(config: Config) -> bool:
    """Whether frames are float32, 0 at black and 1 at white, and not rounded."""
    return config.output.dtype == FLOAT32


SWITCHES = ("auto", "on", "off")


YAML_SWITCHES = {"True": "on", "False": "off"}
"""What YAML makes of an unquoted on and off in a file."""


MIN_PATCH, MAX_PATCH, MOST_RANDOM_PATCHES = 2, 2**15, 10**4
"""Sides and strides of patches in pixels, and how many can be asked for at random places: four digits in a key."""


MOST_LEVELS = 100
"""Levels, and draws at each: two digits in a key."""
