"""Interpret configuration values: distributions, noise levels, patches, switches and the kind of a noise profile."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from unprocess_gen.config import limits
from unprocess_gen.config.distributions import Distribution, lowest
from unprocess_gen.config.schema import (
    BRANCH_FIELDS,
    BranchConfig,
    Config,
    EffectsConfig,
    GainsConfig,
    NoiseConfig,
    ProvenanceConfig,
    SourceConfig,
)
from unprocess_gen.config.values import refusal
from unprocess_gen.core.arrays import FLOAT32
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import is_integer, is_number, value_text
from unprocess_gen.core.suggestions import did_you_mean
from unprocess_gen.simulation.effects import BY_NAME
from unprocess_gen.simulation.effects.dark_current import HEAT

# ---------------------------------------------------------------------------------------------------- distributions


def gain_distributions(gains: GainsConfig) -> tuple[Distribution, Distribution, Distribution]:
    """Parse the distributions of the gains."""
    white_balance = ("red", "blue")
    if gains.light is not None:
        for name in white_balance:
            if getattr(gains, name) is not None:
                problem = f"gains.light={gains.light} gives this gain; expected null, or gains.light=null"
                raise refusal(f"gains.{name}", getattr(gains, name), problem)
        gains = dataclasses.replace(gains, red=1.0, blue=1.0)
    return (
        limits.GAIN.parse("gains.red", gains.red),
        limits.GAIN.parse("gains.blue", gains.blue),
        limits.INVERSE_GAIN.parse("gains.inverse_rgb", gains.inverse_rgb),
    )


def noise_distributions(noise: NoiseConfig) -> tuple[Distribution, Distribution]:
    """Parse the distributions of the two numbers of a noise profile."""
    a = limits.VARIANCE_SLOPE.parse("noise.a", noise.a)
    b = limits.VARIANCE_OFFSET.parse("noise.b", noise.b)
    if b.kind == "log_linear_in_a" and not lowest(a) > 0:
        raise refusal("noise.a", noise.a, "expected more than 0, because noise.b depends on ln a")
    return a, b


def lights(config: Config) -> tuple[tuple[str, float], ...]:
    """Lights from which the gains follow, and their shares; none if the gains are drawn by themselves."""
    gains, scene = config.gains, config.scene
    if gains.light != "scene":
        return () if gains.light is None else ((gains.light, 1.0),)
    if scene.light is None:
        problem = f"scene={scene.name} states no light, which gains.light=scene needs; expected {limits.SCENE_LIGHT}"
        raise refusal("scene.light", None, problem)
    if isinstance(scene.light, str):
        return ((scene.light, 1.0),)
    return tuple(zip(scene.light[::2], scene.light[1::2], strict=True))


# ----------------------------------------------------------------------------------------------------- noise levels


def noise_levels(noise: NoiseConfig) -> tuple[NoiseConfig, ...]:
    """Split a noise profile into its noise levels."""
    levels = 1 if noise.levels is None else noise.levels
    if is_integer(levels) and 1 <= levels <= limits.MAX_LEVELS:
        return (noise,) * levels
    if not isinstance(levels, list | tuple) or not 1 <= len(levels) <= limits.MAX_LEVELS:
        raise refusal("noise.levels", levels, f"expected {limits.LEVELS}")
    return tuple(_level(noise, level) for level in levels)


def _level(noise: NoiseConfig, level: Any) -> NoiseConfig:
    if is_physical(noise) and is_number(level):
        return dataclasses.replace(noise, iso=level)
    if not is_physical(noise) and isinstance(level, dict) and level.keys() == {"a", "b"}:
        return dataclasses.replace(noise, a=level["a"], b=level["b"])
    wanted = "an ISO" if is_physical(noise) else "{a: …, b: …}"
    advice = "; for ISOs, choose a physical profile" if is_number(level) else ""
    expected = f"expected a list of them for noise={noise.name}, or how many levels"
    raise refusal("noise.levels", noise.levels, f"{value_text(level)} is not {wanted}; {expected}{advice}")


# --------------------------------------------------------------------------------------------------- noise profiles


def is_physical(noise: NoiseConfig) -> bool:
    """True if a noise profile is physical: in electrons, with separate effects."""
    return bool(noise.branches)


def branch_of(noise: NoiseConfig, iso: float) -> BranchConfig | None:
    """Find the numbers of a physical profile at an ISO."""
    return next((branch for branch in noise.branches if branch.iso[0] <= iso <= branch.iso[1]), None)


def provenance_at(noise: NoiseConfig, isos: Sequence[float]) -> list[ProvenanceConfig]:
    """Statements about the source of a physical profile's numbers at some ISOs."""
    return [fact for fact in noise.provenance if not fact.iso or any(fact.iso[0] <= iso <= fact.iso[1] for iso in isos)]


@functools.cache
def needed_numbers(effect: str) -> tuple[str, ...]:
    """Keys of a profile that must have a number for an effect to be simulated."""
    declared = BY_NAME[effect].declared
    return tuple(number.key or name for name, number in declared.items() if not number.optional)


def missing_number(noise: NoiseConfig, effect: str) -> str | None:
    """First key that a physical profile lacks to simulate an effect; None if it has all."""
    for key in needed_numbers(effect):
        groups = noise.branches if key in BRANCH_FIELDS else (noise,)
        if any(getattr(group, key) is None for group in groups):
            return key
    return None


def uses_dark_frames(noise: NoiseConfig) -> bool:
    """True if the noise of the read-out is sampled from dark frames."""
    return noise.dark_frames is not None or noise.dark_frames_sha256 is not None


def assumed_numbers(noise: NoiseConfig, effect: str) -> tuple[str, ...]:
    """Keys of a physical profile that an effect depends on and that the profile marks as assumed."""
    keys = (*needed_numbers(effect), *(HEAT if BY_NAME[effect].heat else ()))
    return tuple(key for key in keys if key in noise.assumed)


# ------------------------------------------------------------------------------------------------------------ source


@dataclass(frozen=True, slots=True)
class PatchRule:
    """Rule for cutting square patches of ``side`` pixels from each image.

    ``kind`` is ``grid`` (corners every ``stride`` pixels) or ``random`` (``count`` patches); the other number is 0.
    """

    kind: str
    side: int
    stride: int = 0
    count: int = 0


def patch_rule(source: SourceConfig) -> PatchRule | None:
    """Interpret ``source.patch``."""
    match ["grid", source.patch] if is_integer(source.patch) else source.patch:
        case None:
            return None
        case ["grid", side] if _is_patch_length(side):
            return PatchRule("grid", side, stride=side)
        case ["grid", side, stride] if _is_patch_length(side) and _is_patch_length(stride):
            return PatchRule("grid", side, stride=stride)
        case ["random", side, count] if _is_patch_length(side) and _is_patch_count(count):
            return PatchRule("random", side, count=count)
    raise refusal("source.patch", source.patch, f"expected {limits.PATCH}")


def _is_patch_length(value: Any) -> bool:
    return is_integer(value) and limits.MIN_PATCH <= value <= limits.MAX_PATCH and value % 2 == 0


def _is_patch_count(value: Any) -> bool:
    return is_integer(value) and 1 <= value <= limits.MAX_RANDOM_PATCHES


def canonical_patch(source: SourceConfig) -> list[Any] | None:
    """Return ``source.patch`` in the one spelling that ``config.yaml`` uses: ``[kind, side, stride or count]``."""
    rule = patch_rule(source)
    return None if rule is None else [rule.kind, rule.side, rule.stride or rule.count]


RADIANS_PER_DEGREE = math.pi / 180


@dataclass(frozen=True, slots=True)
class BurstRule:
    """Settings of bursts: the largest motion in pixels of the picture and in degrees, exposures ``ev`` in stops."""

    frames: int = 14
    shift: float = 24.0
    rotation_deg: float = 1.0
    downscale: int = 4
    ev: tuple[float, ...] = (0.0,)
    phase: str = "centre"

    @property
    def tile(self) -> int:
        """Side of a 2 x 2 tile of the sensor in pixels of the picture."""
        return 2 * self.downscale

    @property
    def exposures(self) -> tuple[float, ...]:
        """Exposures in stops that a frame has; frame k has the one with number k modulo their count."""
        return self.ev[: self.frames]

    def margin(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the picture that frames may show beyond a target of these sides."""
        angle, before = RADIANS_PER_DEGREE * self.rotation_deg, 0 if self.phase == "centre" else self.downscale - 1
        sides, reach = (height + before, width + before), self.shift + before / 2
        # upper bounds of sin a and 1 - cos a, times half of each side
        turned, rest = (tuple(factor * side / 2 for side in sides) for factor in (angle, angle * angle / 2))
        spare = 1 if self.rotation_deg else 0
        return math.ceil(reach + rest[0] + turned[1]) + spare, math.ceil(reach + rest[1] + turned[0]) + spare


def burst_rule(source: SourceConfig) -> BurstRule | None:
    """Interpret ``source.burst``; omitted keys have the defaults of `BurstRule`."""
    burst = source.burst
    if burst is None:
        return None
    if not isinstance(burst, dict):
        raise refusal("source.burst", burst, f"expected {limits.BURST}")
    for name, value in burst.items():
        if name not in limits.BURST_KEYS:
            names, close = ", ".join(limits.BURST_KEYS), did_you_mean(str(name), limits.BURST_KEYS)
            raise ConfigError(f"source.burst.{name}: no such key; expected one of {names}{close}")
        limit = limits.BURST_KEYS[name]
        if not limit.allows(value):
            raise refusal(f"source.burst.{name}", value, f"expected {limit}")
    numbers = {name: float(burst[name]) for name in ("shift", "rotation_deg") if name in burst}
    ev = {"ev": tuple(map(float, burst["ev"]))} if "ev" in burst else {}
    return BurstRule(**{**burst, **numbers, **ev})


def canonical_burst(source: SourceConfig) -> dict[str, Any] | None:
    """Return ``source.burst`` with all of its keys, as ``config.yaml`` has it."""
    rule = burst_rule(source)
    return None if rule is None else {**dataclasses.asdict(rule), "ev": list(rule.ev)}


# ---------------------------------------------------------------------------------------------- switches and choices

UNCLIPPED = "none"
"""Value of ``sensor.clip`` with which noisy frames are not clipped."""


def saturated_as(config: Config) -> str:
    """Noisy value of sites whose clean frame is saturated.

    Without a full well, and without clipping of the noisy frame, nothing stops noise above white. Otherwise half of it
    is cut off, and the mean of the noisy frame at white is below white.
    """
    if config.sensor.saturated != "auto":
        return config.sensor.saturated
    limited = config.noise.full_well_e is not None or config.sensor.clip != UNCLIPPED
    return "white" if is_physical(config.noise) and limited else "noisy"


def effect_switch(effects: EffectsConfig, effect: str) -> str:
    """Switch of an effect."""
    return str(getattr(effects, effect) or effects.all)


def has_float_clean(config: Config) -> bool:
    """True if clean frames are normalised and noisy frames are integer DN."""
    return config.output.clean_dtype == FLOAT32 and not is_normalised(config)


def is_normalised(config: Config) -> bool:
    """True if noisy frames are normalised."""
    return config.output.dtype == FLOAT32
