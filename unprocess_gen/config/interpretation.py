"""Interpret configuration values: distributions, noise levels, patches, switches and the kind of a noise profile."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from unprocess_gen.config.accuracy import Budget
from unprocess_gen.config.distributions import lowest, parse_drawn
from unprocess_gen.config.limits import (
    DEQUANTIZE,
    GAIN,
    INVERSE_GAIN,
    ISO,
    LEVELS,
    MAX_LEVELS,
    MAX_PATCH,
    MAX_RANDOM_PATCHES,
    MIN_PATCH,
    PATCH,
    SWITCH,
    VARIANCE_OFFSET,
    VARIANCE_SLOPE,
)
from unprocess_gen.config.schema import (
    AccuracyConfig,
    BranchConfig,
    Config,
    EffectsConfig,
    GainsConfig,
    NoiseConfig,
    ProvenanceConfig,
    SourceConfig,
)
from unprocess_gen.config.values import is_integer, is_number, value_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import FLOAT32, Distribution, PatchRule

SHADING_WORDS = ("keep", "remove")
"""Values of ``noise.dark_shading`` that are no path of a map."""

# ---------------------------------------------------------------------------------------------------- distributions


def gain_distributions(gains: GainsConfig) -> tuple[Distribution, Distribution, Distribution]:
    """Parse the distributions of the gains.

    Parameters
    ----------
    gains : GainsConfig
        The gains of the configuration.

    Returns
    -------
    tuple of Distribution
        Of the red, blue and inverse brightening gain; all draws are within `limits.GAIN`.

    Raises
    ------
    ConfigError
        If a value is no number or distribution, or a draw could be out of range.
    """
    return (
        parse_drawn("gains.red", gains.red, GAIN),
        parse_drawn("gains.blue", gains.blue, GAIN),
        parse_drawn("gains.inverse_rgb", gains.inverse_rgb, INVERSE_GAIN),
    )


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
        If a value is no number or distribution, or a draw could be out of range.
    """
    a = parse_drawn("noise.a", noise.a, VARIANCE_SLOPE)
    b = parse_drawn("noise.b", noise.b, VARIANCE_OFFSET)
    if b.kind == "log_linear_in_a" and not lowest(a) > 0:
        raise ConfigError(f"noise.a={value_text(noise.a)}: expected more than 0, because noise.b depends on ln a")
    return a, b


# ----------------------------------------------------------------------------------------------------- noise levels


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
        raise ConfigError(f"noise.levels={value_text(levels)}: expected {LEVELS}")
    return tuple(_level(noise, level) for level in levels)


def _level(noise: NoiseConfig, level: Any) -> NoiseConfig:
    if is_physical(noise) and is_number(level):
        return dataclasses.replace(noise, iso=level)
    if not is_physical(noise) and isinstance(level, dict) and level.keys() == {"a", "b"}:
        return dataclasses.replace(noise, a=level["a"], b=level["b"])
    wanted = "an ISO" if is_physical(noise) else "{a: …, b: …}"
    advice = "; for ISOs, choose a physical profile" if is_number(level) else ""
    raise ConfigError(
        f"noise.levels={value_text(noise.levels)}: {value_text(level)} is not {wanted}; expected a list of them for "
        f"noise={noise.name}, or how many levels{advice}"
    )


# --------------------------------------------------------------------------------------------------- noise profiles

EFFECT_NUMBERS = {
    "prnu": ("prnu_std",),
    "dark_current": ("dark_e_per_s",),
    "hot_pixels": ("hot_pixel_share", "hot_pixel_e_per_s"),
    "full_well": ("full_well_e",),
    "dead_pixels": ("dead_pixel_share",),
    "gain_by_colour": ("gain_by_colour",),
    "lens_shading": ("lens_shading",),
}
"""Keys of a profile that must have a number for an effect to be simulated."""

BRANCH_NUMBERS = {
    "shot": ("dn_per_e",),
    "read": ("read_law", "read_shape", "read_std_dn"),
    "row": ("row_std_dn",),
    "column": ("column_std_dn",),
    "column_temporal": ("column_temporal_std_dn",),
    "black_error": ("black_error_dn",),
}
"""Keys of each branch of a profile that must have a value for an effect to be simulated."""

HEAT = ("dark_reference_c", "dark_doubling_c")
"""Keys that dark current and hot pixels depend on too."""


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


@functools.lru_cache(maxsize=256)
def row_of_stop(iso: float) -> int:
    """Return the row of a table ``by_stop``: ⌊2·log2(ISO / 100)⌋, in exact arithmetic; 0 below ISO 100.

    Parameters
    ----------
    iso : float
        The ISO.

    Returns
    -------
    int
        Row, from 0. Rows 2k and 2k + 1 are for ISO 100·2^k to 100·2^(k + 1).

    Examples
    --------
    >>> [row_of_stop(iso) for iso in (100, 141, 142, 200, 6400, 25600)]
    [0, 0, 1, 2, 12, 16]
    """
    ratio = (Fraction(iso) / 100) ** 2
    return max((ratio.numerator // ratio.denominator).bit_length() - 1, 0)


def table_words(value: Any) -> tuple[list[str], list[Any]]:
    """Split a number of a branch into its leading words and the rest.

    Parameters
    ----------
    value : Any
        Such as ``["by_colour", "by_stop", [1, 2, 3, 4], …]``.

    Returns
    -------
    words : list of str
        The words before the first value that is none; empty if the value is not a list.
    rest : list
        The values after them.
    """
    if not isinstance(value, list):
        return [], [value]
    count = next((place for place, one in enumerate(value) if not isinstance(one, str)), len(value))
    return value[:count], value[count:]


def provenance_at(noise: NoiseConfig, isos: Sequence[float]) -> list[ProvenanceConfig]:
    """Return the statements about the source of a physical profile's numbers at some ISOs.

    Parameters
    ----------
    noise : NoiseConfig
        A physical profile.
    isos : sequence of float
        ISOs for which it is used.

    Returns
    -------
    list of ProvenanceConfig
        In the order of the profile: statements without a range of ISO, and those whose range contains one of them.
    """
    return [one for one in noise.provenance if not one.iso or any(one.iso[0] <= iso <= one.iso[1] for iso in isos)]


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
    for key in BRANCH_NUMBERS.get(effect, ()):
        if any(getattr(branch, key) is None for branch in noise.branches):
            return key
    return next((key for key in EFFECT_NUMBERS.get(effect, ()) if getattr(noise, key) is None), None)


def uses_dark_frames(noise: NoiseConfig) -> bool:
    """Return whether the noise of the read-out is sampled from dark frames.

    Parameters
    ----------
    noise : NoiseConfig
        The profile.

    Returns
    -------
    bool
        True if a folder of dark frames is given, or the digest of a recorded set.
    """
    return noise.dark_frames is not None or noise.dark_frames_sha256 is not None


def shading_place(noise: NoiseConfig) -> str | None:
    """Return the place of the dark-shading map.

    Parameters
    ----------
    noise : NoiseConfig
        The profile.

    Returns
    -------
    str or None
        A file or folder; None if ``noise.dark_shading`` is one of `SHADING_WORDS`.
    """
    return None if noise.dark_shading in SHADING_WORDS else noise.dark_shading


def run_iso(config: Config) -> float:
    """Return the ISO of a run with dark frames, which has only one.

    Parameters
    ----------
    config : Config
        The configuration, with ``noise.dark_frames``.

    Returns
    -------
    float
        ``noise.iso``, or that of the scene.
    """
    iso = config.scene.iso if config.noise.iso is None else config.noise.iso
    return parse_drawn("iso", iso, ISO).numbers[0]


def without_dark_frames(config: Config) -> Config:
    """Return a copy of a configuration with the noise of the profile in place of dark frames.

    Parameters
    ----------
    config : Config
        The configuration.

    Returns
    -------
    Config
        For measurements that need no real dark frames, such as times.
    """
    noise = dataclasses.replace(
        config.noise,
        dark_frames=None,
        dark_frames_sha256=None,
        dark_frames_black_dn=None,
        dark_shading="keep",
        dark_shading_sha256=None,
    )
    return dataclasses.replace(config, noise=noise)


def uses_assumed(config: Config) -> bool:
    """Return whether effects with assumed numbers are simulated like others.

    Parameters
    ----------
    config : Config
        The configuration.

    Returns
    -------
    bool
        True with ``effects.assumed=use`` and a physical profile that marks numbers as assumed.
    """
    return config.effects.assumed == "use" and is_physical(config.noise) and bool(config.noise.assumed)


def assumed_numbers(noise: NoiseConfig, effect: str) -> tuple[str, ...]:
    """Return the assumed numbers of a physical profile that an effect depends on.

    Parameters
    ----------
    noise : NoiseConfig
        A physical profile.
    effect : str
        One of `noise.EFFECTS`.

    Returns
    -------
    tuple of str
        Keys of ``noise``, in the order of the tables of effects.
    """
    heat = HEAT if effect in ("dark_current", "hot_pixels") else ()
    keys = (*EFFECT_NUMBERS.get(effect, ()), *BRANCH_NUMBERS.get(effect, ()), *heat)
    return tuple(key for key in keys if key in noise.assumed)


# ------------------------------------------------------------------------------------------------------------ source


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
    raise ConfigError(f"source.patch={value_text(source.patch)}: expected {PATCH}")


def _is_patch_length(value: Any) -> bool:
    return is_integer(value) and MIN_PATCH <= value <= MAX_PATCH and value % 2 == 0


def _is_patch_count(value: Any) -> bool:
    return is_integer(value) and 1 <= value <= MAX_RANDOM_PATCHES


def canonical_patch(source: SourceConfig) -> list[Any] | None:
    """Return ``source.patch`` in the one spelling that ``config.yaml`` uses: ``[kind, side, stride or count]``."""
    rule = patch_rule(source)
    return None if rule is None else [rule.kind, rule.side, rule.stride or rule.count]


# ---------------------------------------------------------------------------------------------- switches and choices

NO_CLIP = "none"
"""Value of ``sensor.clip`` with which noisy frames are not clipped."""


def saturated_as(config: Config) -> str:
    """Return the noisy value of sites whose clean frame is saturated.

    Without a full well, and without clipping of the noisy frame, nothing stops noise above white. Otherwise half of it
    is cut off, and the mean of the noisy frame at white is below white.

    Parameters
    ----------
    config : Config
        The configuration.

    Returns
    -------
    str
        ``noisy`` or ``pinned``: ``sensor.saturated``, with ``auto`` decided.
    """
    if config.sensor.saturated != "auto":
        return config.sensor.saturated
    limited = config.noise.full_well_e is not None or config.sensor.clip != NO_CLIP
    return "pinned" if is_physical(config.noise) and limited else "noisy"


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
    return str(SWITCH.word(getattr(effects, effect) or effects.all))


def dequantize_method(source: SourceConfig) -> str:
    """Return how 8-bit codes are dequantized.

    Parameters
    ----------
    source : SourceConfig
        The source of the configuration.

    Returns
    -------
    str
        ``off``, or ``dither`` and ``dither_all``: codes get a random offset of up to half a code.
    """
    return str(DEQUANTIZE.word(source.dequantize))


def has_float_clean(config: Config) -> bool:
    """Return whether clean frames are normalised and noisy frames are integer DN.

    Parameters
    ----------
    config : Config
        The configuration.

    Returns
    -------
    bool
        True with ``output.clean_dtype=float32`` and ``output.dtype=uint16``.
    """
    return config.output.clean_dtype == FLOAT32 and not is_normalised(config)


def is_normalised(config: Config) -> bool:
    """Return whether noisy frames are normalised.

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
