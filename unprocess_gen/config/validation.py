"""Check a configuration before the first image."""

from __future__ import annotations

import dataclasses
import math
from decimal import Decimal
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from unprocess_gen.config.accuracy import choose_methods
from unprocess_gen.config.distributions import highest, lowest, parse_distribution
from unprocess_gen.config.interpretation import (
    A_DISTRIBUTIONS,
    MOST_LEVELS,
    NO_CLIP,
    SCENE_DISTRIBUTIONS,
    SWITCHES,
    YAML_SWITCHES,
    accuracy_budget,
    branch_of,
    dequantize_method,
    effect_switch,
    gain_distributions,
    is_normalised,
    is_physical,
    missing_number,
    noise_distributions,
    noise_levels,
    patch_rule,
    uses_physics,
)
from unprocess_gen.config.schema import (
    BranchConfig,
    CameraConfig,
    Config,
    NoiseConfig,
    SceneConfig,
    SensorConfig,
    SourceConfig,
)
from unprocess_gen.config.values import check_name, in_range, is_integer, is_number, one_of, value_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import FLOAT32, MOSAIC, PACKED, UINT16
from unprocess_gen.simulation.reference import cfa as bayer
from unprocess_gen.simulation.reference import colour

CAMERA_LAWS = ("fixed", "convex", "choice", "identity", "custom")


HIGHLIGHTS = ("per_channel", "gray_mean", "none")


SELF_TESTS = ("stop", "go_on")
"""What a failed self-test does to a run."""


MAX_PAIRS_PER_SHARD = 10**6


def validate_config(config: Config) -> None:
    """Check a configuration before a run.

    Parameters
    ----------
    config : Config
        The composed configuration.

    Raises
    ------
    ConfigError
        If a value is not allowed, or does not fit this machine: no such ``source.root``, Pillow not installed. One
        line with the key, the value and what is allowed.
    """
    check_values(config)
    _check_environment(config.source)


def check_values(config: Config) -> None:
    """Check the values of a configuration, independent of files and installed packages.

    Parameters
    ----------
    config : Config
        The configuration, composed or read from the ``config.yaml`` of a dataset.

    Raises
    ------
    ConfigError
        If a value is not allowed: one line with the key, the value and what is allowed.
    """
    in_range("seed", config.seed, 0, 2**63 - 1)
    if config.n_jobs != -1:
        in_range("n_jobs", config.n_jobs, 1, 1024, " or -1 for one a core")
    one_of("self_test", config.self_test, SELF_TESTS)
    if not config.out:
        raise ConfigError("out='': expected the name of a folder")
    _check_source(config.source)
    _check_camera(config.camera)
    gain_distributions(config.gains)
    one_of("gains.highlight", config.gains.highlight, HIGHLIGHTS)
    if not 0 <= config.gains.threshold < 1:
        raise ConfigError(f"gains.threshold={config.gains.threshold}: expected 0 up to, but not including, 1")
    one_of("isp.tone", config.isp.tone, ("smoothstep", "none"))
    if config.isp.gamma != "srgb" and not (is_number(config.isp.gamma) and 0.1 <= config.isp.gamma <= 10):
        raise ConfigError(f"isp.gamma={value_text(config.isp.gamma)}: expected a number from 0.1 to 10, or srgb")
    _check_sensor(config.sensor)
    _check_scene(config.scene)
    for noise in noise_levels(config.noise):
        _check_noise(noise, config.scene)
    _check_levels(config)
    _check_effects(config)
    _check_accuracy(config)
    _check_output(config)
    in_range("output.pairs_per_shard", config.output.pairs_per_shard, 1, MAX_PAIRS_PER_SHARD)


def _check_environment(source: SourceConfig) -> None:
    if source.root == "":
        raise ConfigError("source.root='': expected a folder or file; null selects the built-in scenes")
    if source.root is not None and not Path(source.root).exists():
        raise ConfigError(
            f"source.root={source.root}: no such folder or file; expected photographs, or null for the built-in scenes"
        )
    if source.clips and source.root is None:
        raise ConfigError("source.clips=true: the built-in scenes are no clips; give source.root=…")
    if source.icc == "refuse" and find_spec("PIL") is None:
        raise ConfigError("source.icc=refuse: needs Pillow to read colour profiles; pip install pillow")


def _check_source(source: SourceConfig) -> None:
    if not source.include and not (source.clips and source.video):
        raise ConfigError("source.include=[]: expected at least one pattern such as '*.jpg'")
    if source.limit is not None:
        in_range("source.limit", source.limit, 1, 10**9, " or null")
    in_range("source.max_pixels", source.max_pixels, 1, 2**40)
    in_range("source.max_failed", source.max_failed, 0, 10**9)
    in_range("source.downscale", source.downscale, 1, 64)
    one_of("source.dequantize", dequantize_method(source), ("off", "dither"))
    patch_rule(source)
    one_of("source.icc", source.icc, ("ignore", "refuse"))


def _check_camera(camera: CameraConfig) -> None:
    one_of("camera.law", camera.law, CAMERA_LAWS)
    check_name("camera.name", camera.name)
    if camera.law == "fixed":
        one_of("camera.name", camera.name, tuple(colour.CAMERAS))
    elif camera.law != "custom":
        one_of("camera.name", camera.name, (camera.law,))
    if camera.law != "custom":
        if camera.xyz2cam is not None:
            raise ConfigError(f"camera.xyz2cam={camera.xyz2cam}: a matrix needs camera.law=custom, not {camera.law}")
        return
    if camera.xyz2cam is None:
        raise ConfigError("camera.xyz2cam=null: camera=custom needs nine numbers, XYZ to camera, row by row")
    try:
        colour.rgb2cam(colour.matrix(camera.xyz2cam))
    except ValueError as error:
        raise ConfigError(f"camera.xyz2cam={camera.xyz2cam}: {error}") from error
    if camera.name in (*colour.CAMERAS, *CAMERA_LAWS) and camera.name != "custom":
        raise ConfigError(f"camera.name={camera.name}: is taken; give a camera of your own another name")


def _check_sensor(sensor: SensorConfig) -> None:
    in_range("sensor.bits", sensor.bits, 1, 16)
    in_range("sensor.black_level_dn", sensor.black_level_dn, 0, 2**sensor.bits - 2)
    in_range(
        "sensor.white_level_dn",
        sensor.white_level_dn,
        sensor.black_level_dn + 1,
        2**sensor.bits - 1,
        " (above the black level, within the bits)",
    )
    one_of("sensor.pattern", sensor.pattern, bayer.PATTERNS)
    one_of("sensor.clip", sensor.clip, ("sensor", "black", NO_CLIP))
    one_of("sensor.saturated", sensor.saturated, ("noisy", "pinned"))
    one_of("sensor.dark_offset", sensor.dark_offset, ("removed", "kept"))
    if sensor.units != "image" and not (is_integer(sensor.units) and 1 <= sensor.units <= 10**6):
        raise ConfigError(
            f"sensor.units={value_text(sensor.units)}: expected image, or a number of bodies, 1 to 1000000"
        )


def _check_levels(config: Config) -> None:
    noise = config.noise
    in_range("noise.draws", noise.draws, 1, MOST_LEVELS)
    if len(noise_levels(noise)) == 1:
        return
    if noise.full_well_e is not None:
        raise ConfigError(
            f"noise.levels={value_text(noise.levels)}: with noise.full_well_e the clean frame depends on the ISO"
        )
    if config.clean.includes_fixed_pattern:
        raise ConfigError(
            "clean.includes_fixed_pattern=true: the fixed pattern depends on the ISO; leave noise.levels out"
        )


def _check_noise(noise: NoiseConfig, scene: SceneConfig) -> None:
    check_name("noise.name", noise.name)
    one_of("noise.units", noise.units, ("dn", "normalized"))
    one_of("noise.black", noise.black, ("subtracted", "included"))
    one_of("noise.negative_variance", noise.negative_variance, ("refuse", "clip"))
    one_of("noise.law", noise.law, ("gaussian", "poisson"))
    if is_physical(noise):
        if noise.law != "gaussian":
            raise ConfigError(
                f"noise.law={noise.law}: is of profiles with two numbers; noise={noise.name} draws electrons"
            )
        _check_physical(noise, scene)
        return
    if noise.iso is not None:
        raise ConfigError(
            f"noise.iso={value_text(noise.iso)}: noise={noise.name} holds for one ISO; choose a physical profile"
        )
    _, b = noise_distributions(noise)
    if noise.law == "poisson" and (noise.black == "included" or lowest(b) < 0):
        raise ConfigError("noise.law=poisson: needs the black level subtracted and b of 0 or more")
    if noise.units == "normalized":
        if noise.black == "included":
            raise ConfigError("noise.black=included: normalized units have black at 0, so it must be subtracted")
        offset = 0.0
    else:
        _check_calibration(noise)
        offset = _black_share(noise)
    if noise.law == "poisson":
        _check_countable(noise)
    if lowest(b) + offset < 0 and noise.negative_variance == "refuse":
        raise ConfigError(
            f"noise.b={value_text(noise.b)}: the variance at black is {lowest(b) + offset:.6g}, below 0; "
            "say noise.negative_variance=clip if max(0, variance) is meant"
        )


def _check_physical(noise: NoiseConfig, scene: SceneConfig) -> None:
    for key in ("a", "b"):
        if getattr(noise, key) is not None:
            raise ConfigError(
                f"noise.{key}={value_text(getattr(noise, key))}: noise={noise.name} is a physical profile; set iso"
            )
    if noise.units != "dn" or noise.black != "subtracted":
        raise ConfigError(f"noise.units={noise.units}: a physical profile is in dn, with the black level subtracted")
    _check_calibration(noise)
    for number, branch in enumerate(noise.branches):
        _check_branch(f"noise.branches[{number}]", branch)
        _check_gain(f"noise.branches[{number}].dn_per_e", noise, branch)
    for key, low, high in RATES:
        value = getattr(noise, key)
        if value is not None and not (math.isfinite(value) and low <= value <= high):
            raise ConfigError(f"noise.{key}={value}: expected {low:g} to {high:g}")
    for name in noise.assumed:
        one_of("noise.assumed", name, tuple(key for key, _, _ in RATES))
    _check_iso(noise, scene)
    _check_electrons(noise, scene)


RATES = (
    ("prnu_std", 0.0, 0.5),
    ("dark_e_per_s", 0.0, 1e6),
    ("dark_reference_c", -273.0, 200.0),
    ("dark_doubling_c", 0.1, 100.0),
    ("hot_pixel_share", 0.0, 1.0),
    ("hot_pixel_e_per_s", 0.0, 1e6),
    ("dead_pixel_share", 0.0, 1.0),
    ("full_well_e", 1.0, 1e9),
)
"""Numbers of a physical profile that do not depend on ISO, and what they can be at all (chosen, far beyond sensors)."""


FORM_NUMBERS = {"per_iso": (1, 2), "root": (1, 3), "line": (3, 3), "scale_line": (3, 3)}
"""The forms of `physics.FORMS`, and how many numbers each takes."""


def _check_branch(key: str, branch: BranchConfig) -> None:
    if len(branch.iso) != 2 or not 0 < branch.iso[0] <= branch.iso[1] <= 1e7:
        raise ConfigError(f"{key}.iso={value_text(branch.iso)}: expected the lowest and the highest ISO, [100, 6400]")
    one_of(f"{key}.read_law", branch.read_law, ("gaussian", "tukey"))
    _check_form(f"{key}.dn_per_e", branch.dn_per_e, ("per_iso",))
    _check_form(f"{key}.read_std_dn", branch.read_std_dn, ("root", "line", "scale_line"))
    for name in ("row_std_dn", "column_std_dn"):
        if getattr(branch, name) is not None:
            _check_form(f"{key}.{name}", getattr(branch, name), ("root", "line"))
    shape = parse_distribution(f"{key}.read_shape", branch.read_shape, ("choice",))
    if not (lowest(shape) > -0.5 and highest(shape) < 10):
        raise ConfigError(
            f"{key}.read_shape={value_text(branch.read_shape)}: Tukey's law has a variance for shapes above -0.5 only"
        )
    _check_black_error(f"{key}.black_error_dn", branch.black_error_dn)


MAX_ELECTRONS = 1e9
"""Counts are exact up to this mean (`poisson`), which no pixel holds."""


def _check_countable(noise: NoiseConfig) -> None:
    """Refuse a gain so small that white is more electrons than can be counted; without shot noise nothing is."""
    span = 1 if noise.units == "normalized" else (noise.white_level_dn or 0) - (noise.black_level_dn or 0)
    a = parse_distribution("noise.a", noise.a, A_DISTRIBUTIONS)
    if a.numbers != (0.0,) and lowest(a) * MAX_ELECTRONS < span:
        raise ConfigError(
            f"noise.a={value_text(noise.a)}: noise.law=poisson counts up to {MAX_ELECTRONS:g} electrons, so a must be "
            f"0, or at least {span / MAX_ELECTRONS:g}"
        )


def _check_electrons(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Refuse heat that sets free more electrons than can be counted."""
    seconds = highest(parse_distribution("scene.exposure_s", scene.exposure_s, SCENE_DISTRIBUTIONS))
    celsius = highest(parse_distribution("scene.temperature_c", scene.temperature_c, SCENE_DISTRIBUTIONS))
    for key in ("dark_e_per_s", "hot_pixel_e_per_s"):
        rate = Decimal((getattr(noise, key) or 0.0) * seconds)
        doublings = (Decimal(celsius) - Decimal(noise.dark_reference_c)) / Decimal(noise.dark_doubling_c)
        most = (Decimal(MAX_ELECTRONS) / 8).ln()  # a hot pixel has up to 8 times the mean
        if rate > 0 and rate.ln() + doublings * Decimal(2).ln() > most:
            raise ConfigError(
                f"noise.{key}={getattr(noise, key)}: more than {MAX_ELECTRONS:g} electrons in {seconds:g} s at "
                f"{celsius:g} degrees Celsius"
            )


def _check_gain(key: str, noise: NoiseConfig, branch: BranchConfig) -> None:
    """Refuse a gain of 0, and one so small that white is more electrons than can be counted."""
    assert noise.white_level_dn is not None and noise.black_level_dn is not None
    gain = branch.dn_per_e
    if isinstance(gain, list):
        gain = gain[1] * branch.iso[0] + (gain[2] if len(gain) > 2 else 0.0)
    if not gain * MAX_ELECTRONS >= noise.white_level_dn - noise.black_level_dn:
        raise ConfigError(f"{key}={value_text(branch.dn_per_e)}: expected a gain above 0, at which white is countable")


def _check_form(key: str, value: Any, allowed: tuple[str, ...]) -> None:
    if is_number(value) and value >= 0:
        return
    form, numbers = (value[0], value[1:]) if isinstance(value, list) and value else (None, [])
    if form not in allowed:
        raise ConfigError(f"{key}={value_text(value)}: expected a number of 0 or more, or a form: {', '.join(allowed)}")
    fewest, most = FORM_NUMBERS[form]
    if not (fewest <= len(numbers) <= most and all(is_number(number) and abs(number) <= 1e9 for number in numbers)):
        raise ConfigError(f"{key}={value_text(value)}: {form} takes {fewest} to {most} finite numbers")
    if form in ("per_iso", "root") and (numbers[0] < 0 or min(numbers) < 0):
        raise ConfigError(f"{key}={value_text(value)}: expected numbers of 0 or more")


def _check_black_error(key: str, value: Any) -> None:
    if value is None or is_number(value):
        return
    by_iso = isinstance(value, list) and bool(value) and value[0] == "by_log_iso"
    rows = value[1:] if by_iso else [value]
    if not rows or not all(isinstance(row, list) and len(row) == 4 and all(map(is_number, row)) for row in rows):
        raise ConfigError(
            f"{key}={value_text(value)[:60]}: expected a number, four (the 2x2 sites), or [by_log_iso, [four], …]"
        )


def _check_iso(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Refuse an ISO at which nothing was calibrated, whether it is named, drawn or comes with the scene."""
    key, value = ("scene.iso", scene.iso) if noise.iso is None else ("noise.iso", noise.iso)
    drawn = parse_distribution(key, value, SCENE_DISTRIBUTIONS)
    ends = drawn.numbers
    inside = all(branch_of(noise, iso) is not None for iso in ends)
    if inside and drawn.kind not in ("constant", "choice"):
        inside = any(branch.iso[0] <= min(ends) and max(ends) <= branch.iso[1] for branch in noise.branches)
    if not inside:
        ranges = ", ".join(
            f"{low:g}" if low == high else f"{low:g} to {high:g}" for low, high in (b.iso for b in noise.branches)
        )
        way = "" if noise.iso is not None else f" (that of scene={scene.name}); give noise.iso=…"
        raise ConfigError(f"{key}={value_text(value)}: noise={noise.name} is calibrated for ISO {ranges}{way}")


def _check_scene(scene: SceneConfig) -> None:
    check_name("scene.name", scene.name)
    for key, low, high in (("exposure_s", 1e-7, 1e5), ("temperature_c", -100.0, 150.0), ("exposure_ratio", 1e-3, 1e6)):
        drawn = parse_distribution(f"scene.{key}", getattr(scene, key), SCENE_DISTRIBUTIONS)
        if not low <= lowest(drawn) <= highest(drawn) <= high:
            raise ConfigError(f"scene.{key}={value_text(getattr(scene, key))}: expected {low:g} to {high:g}")


def _check_effects(config: Config) -> None:
    effects = config.effects
    one_of("effects.all", YAML_SWITCHES.get(effects.all, effects.all), SWITCHES)
    if not 0 < effects.tolerance <= 10:
        raise ConfigError(f"effects.tolerance={effects.tolerance}: expected more than 0, up to 10")
    for effect in (one.name for one in dataclasses.fields(effects) if one.name not in ("all", "tolerance")):
        switch = getattr(effects, effect)
        if switch is None:
            continue
        one_of(f"effects.{effect}", YAML_SWITCHES.get(switch, switch), SWITCHES)
        if effect_switch(effects, effect) == "on" and effect != "quantise":
            _check_switched_on(config, effect)


def _check_accuracy(config: Config) -> None:
    check_name("accuracy.name", config.accuracy.name)
    for key in ("clean_dn", "clean_changed_share", "normal_error", "law_distance"):
        value = getattr(config.accuracy, key)
        if not (math.isfinite(value) and value >= 0):
            raise ConfigError(f"accuracy.{key}={value}: expected a number of 0 or more")
    choose_methods(accuracy_budget(config.accuracy), uses_physics(config.noise), is_normalised(config))


def _check_output(config: Config) -> None:
    """Refuse a dtype that cannot hold what is asked for: integers are rounded and clipped, floats are not rounded."""
    one_of("output.dtype", config.output.dtype, (UINT16, FLOAT32))
    one_of("output.layout", config.output.layout, (MOSAIC, PACKED))
    said = config.effects.quantise is not None and effect_switch(config.effects, "quantise")
    if is_normalised(config):
        if said == "on":
            raise ConfigError("effects.quantise=on: output.dtype=float32 is not rounded; say output.dtype=uint16")
        return
    if said == "off":
        raise ConfigError(
            "effects.quantise=off: integer output is always rounded and clipped; output.dtype=float32 is not rounded"
        )
    if config.sensor.clip == NO_CLIP:
        raise ConfigError(
            "sensor.clip=none: output.dtype=uint16 holds nothing beyond the sensor's ends; say output.dtype=float32"
        )


def _check_switched_on(config: Config, effect: str) -> None:
    noise = config.noise
    if (effect == "heteroscedastic") == is_physical(noise):
        offers = "the physical effects" if is_physical(noise) else "heteroscedastic only"
        raise ConfigError(f"effects.{effect}=on: noise={noise.name} offers {offers}")
    number = missing_number(noise, effect)
    if number is not None:
        raise ConfigError(
            f"effects.{effect}=on: noise={noise.name} gives no {number}; set noise.{number}, or leave it off"
        )


def _check_calibration(noise: NoiseConfig) -> None:
    levels = (noise.bits, noise.black_level_dn, noise.white_level_dn)
    if any(level is None for level in levels):
        raise ConfigError(
            f"noise.units=dn: {noise.name} must say the bits, black_level_dn and white_level_dn it was calibrated at, "
            f"got {', '.join(value_text(level) for level in levels)}"
        )
    assert noise.bits is not None and noise.black_level_dn is not None and noise.white_level_dn is not None
    in_range("noise.bits", noise.bits, 1, 32)
    in_range("noise.black_level_dn", noise.black_level_dn, 0, 2**noise.bits - 2)
    in_range("noise.white_level_dn", noise.white_level_dn, noise.black_level_dn + 1, 2**noise.bits - 1)


def _black_share(noise: NoiseConfig) -> float:
    """What the variance at black gains by an included black level, at the least, in the profile's own DN²."""
    if noise.black != "included" or noise.black_level_dn is None:
        return 0.0
    return lowest(parse_distribution("noise.a", noise.a, A_DISTRIBUTIONS)) * noise.black_level_dn
