"""Check a configuration before the first image, so that no run fails on a value that was wrong from the start.

`CHOICES`, `INTEGER_RANGES` and `SCENE_RANGES` hold the limits of single values. The functions below them check values
that depend on each other. Noise profiles: `noise_validation`.
"""

from __future__ import annotations

import dataclasses
import math
from functools import reduce
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from unprocess_gen.config.accuracy import choose_methods
from unprocess_gen.config.distributions import highest, lowest, parse_distribution
from unprocess_gen.config.interpretation import (
    MAX_LEVELS,
    NO_CLIP,
    SCENE_DISTRIBUTIONS,
    SWITCHES,
    YAML_SWITCHES,
    accuracy_budget,
    dequantize_method,
    effect_switch,
    gain_distributions,
    is_normalised,
    is_physical,
    missing_number,
    noise_levels,
    patch_rule,
    uses_physics,
)
from unprocess_gen.config.noise_validation import check_noise
from unprocess_gen.config.schema import (
    CameraConfig,
    Config,
    SceneConfig,
    SensorConfig,
    SourceConfig,
)
from unprocess_gen.config.values import check_name, in_range, is_integer, is_number, one_of, value_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import FLOAT32, MOSAIC, PACKED, UINT16
from unprocess_gen.simulation.reference import cfa, colour

# ------------------------------------------------------------------------------------------- limits of single values

CAMERA_LAWS = ("fixed", "convex", "choice", "identity", "custom")
HIGHLIGHTS = ("per_channel", "gray_mean", "none")

CHOICES = {
    "self_test": ("stop", "go_on"),
    "source.icc": ("ignore", "refuse"),
    "camera.law": CAMERA_LAWS,
    "gains.highlight": HIGHLIGHTS,
    "isp.tone": ("smoothstep", "none"),
    "sensor.pattern": cfa.PATTERNS,
    "sensor.clip": ("sensor", "black", NO_CLIP),
    "sensor.saturated": ("noisy", "pinned"),
    "sensor.dark_offset": ("removed", "kept"),
    "noise.units": ("dn", "normalized"),
    "noise.black": ("subtracted", "included"),
    "noise.negative_variance": ("refuse", "clip"),
    "noise.law": ("gaussian", "poisson"),
    "output.dtype": (UINT16, FLOAT32),
    "output.layout": (MOSAIC, PACKED),
}
"""Keys whose value is one of a few strings."""

INTEGER_RANGES = {
    "seed": (0, 2**63 - 1),
    "source.max_pixels": (1, 2**40),
    "source.max_failed": (0, 10**9),
    "source.downscale": (1, 64),
    "sensor.bits": (1, 16),
    "noise.draws": (1, MAX_LEVELS),
    "output.pairs_per_shard": (1, 10**6),
}
"""Lowest and highest integer of keys whose limits depend on no other key."""

SCENE_RANGES = {
    "exposure_s": (1e-7, 1e5),
    "temperature_c": (-100.0, 150.0),
    "exposure_ratio": (1e-3, 1e6),
}
"""Range of all draws of a scene's values (chosen, far beyond cameras)."""

# --------------------------------------------------------------------------------------------------- public functions


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
    for key, allowed in CHOICES.items():
        one_of(key, _value(config, key), allowed)
    for key, (low, high) in INTEGER_RANGES.items():
        in_range(key, _value(config, key), low, high)
    for group in ("camera", "noise", "scene", "accuracy"):
        check_name(f"{group}.name", getattr(config, group).name)
    if config.n_jobs != -1:
        in_range("n_jobs", config.n_jobs, 1, 1024, " or -1 for one per core")
    if not config.out:
        raise ConfigError("out='': expected the name of a folder")
    _check_source(config.source)
    _check_camera(config.camera)
    gain_distributions(config.gains)
    if not 0 <= config.gains.threshold < 1:
        raise ConfigError(f"gains.threshold={config.gains.threshold}: expected 0 up to, but not including, 1")
    if config.isp.gamma != "srgb" and not (is_number(config.isp.gamma) and 0.1 <= config.isp.gamma <= 10):
        raise ConfigError(f"isp.gamma={value_text(config.isp.gamma)}: expected a number from 0.1 to 10, or srgb")
    _check_sensor(config.sensor)
    _check_scene(config.scene)
    for noise in noise_levels(config.noise):
        check_noise(noise, config.scene)
    _check_levels(config)
    _check_effects(config)
    _check_accuracy(config)
    _check_output(config)


def _value(config: Config, key: str) -> Any:
    return reduce(getattr, key.split("."), config)


# ---------------------------------------------------------------------------------------- source, camera and sensor


def _check_environment(source: SourceConfig) -> None:
    if source.root == "":
        raise ConfigError("source.root='': expected a folder or file; null selects the built-in scenes")
    if source.root is not None and not Path(source.root).exists():
        raise ConfigError(
            f"source.root={source.root}: no such folder or file; expected photographs, or null for the built-in scenes"
        )
    if source.clips and source.root is None:
        raise ConfigError(
            "source.clips=true: the built-in scenes are not clips; expected folders or videos; give source.root=…"
        )
    if source.icc == "refuse" and find_spec("PIL") is None:
        raise ConfigError("source.icc=refuse: needs Pillow to read colour profiles; pip install pillow")


def _check_source(source: SourceConfig) -> None:
    if not source.include and not (source.clips and source.video):
        raise ConfigError("source.include=[]: expected at least one pattern such as '*.jpg'")
    if source.limit is not None:
        in_range("source.limit", source.limit, 1, 10**9, " or null")
    one_of("source.dequantize", dequantize_method(source), ("off", "dither"))
    patch_rule(source)


def _check_camera(camera: CameraConfig) -> None:
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
        raise ConfigError(f"camera.name={camera.name}: is the name of an existing camera; expected a new name")


def _check_sensor(sensor: SensorConfig) -> None:
    in_range("sensor.black_level_dn", sensor.black_level_dn, 0, 2**sensor.bits - 2)
    in_range(
        "sensor.white_level_dn",
        sensor.white_level_dn,
        sensor.black_level_dn + 1,
        2**sensor.bits - 1,
        " (above the black level, within the bits)",
    )
    if sensor.units != "image" and not (is_integer(sensor.units) and 1 <= sensor.units <= 10**6):
        raise ConfigError(
            f"sensor.units={value_text(sensor.units)}: expected image, or a number of bodies, 1 to 1000000"
        )


# ------------------------------------------------------------------------------------------- scene and noise levels


def _check_scene(scene: SceneConfig) -> None:
    for key, (low, high) in SCENE_RANGES.items():
        drawn = parse_distribution(f"scene.{key}", getattr(scene, key), SCENE_DISTRIBUTIONS)
        if not low <= lowest(drawn) <= highest(drawn) <= high:
            raise ConfigError(f"scene.{key}={value_text(getattr(scene, key))}: expected {low:g} to {high:g}")


def _check_levels(config: Config) -> None:
    noise = config.noise
    if len(noise_levels(noise)) == 1:
        return
    if noise.full_well_e is not None:
        raise ConfigError(
            f"noise.levels={value_text(noise.levels)}: with noise.full_well_e the clean frame depends on the ISO; "
            "expected null or one level; leave noise.levels out"
        )
    if config.clean.includes_fixed_pattern:
        raise ConfigError(
            "clean.includes_fixed_pattern=true: the fixed pattern depends on the ISO; expected one level; leave "
            "noise.levels out"
        )


# --------------------------------------------------------------------------------------- effects, accuracy and output


def _check_effects(config: Config) -> None:
    effects = config.effects
    one_of("effects.all", YAML_SWITCHES.get(effects.all, effects.all), SWITCHES)
    if not 0 < effects.tolerance <= 10:
        raise ConfigError(f"effects.tolerance={effects.tolerance}: expected more than 0, up to 10")
    for effect in (field.name for field in dataclasses.fields(effects) if field.name not in ("all", "tolerance")):
        switch = getattr(effects, effect)
        if switch is None:
            continue
        one_of(f"effects.{effect}", YAML_SWITCHES.get(switch, switch), SWITCHES)
        if effect_switch(effects, effect) == "on" and effect != "quantise":
            _check_switched_on(config, effect)


def _check_switched_on(config: Config, effect: str) -> None:
    noise = config.noise
    if (effect == "heteroscedastic") == is_physical(noise):
        offers = "the physical effects, not this one" if is_physical(noise) else "heteroscedastic only"
        raise ConfigError(f"effects.{effect}=on: noise={noise.name} offers {offers}")
    number = missing_number(noise, effect)
    if number is not None:
        raise ConfigError(
            f"effects.{effect}=on: noise={noise.name} gives no {number}; set noise.{number}, or leave it off"
        )


def _check_accuracy(config: Config) -> None:
    for key in ("clean_dn", "clean_changed_share", "normal_error", "law_distance"):
        value = getattr(config.accuracy, key)
        if not (math.isfinite(value) and value >= 0):
            raise ConfigError(f"accuracy.{key}={value}: expected a number of 0 or more")
    choose_methods(accuracy_budget(config.accuracy), uses_physics(config.noise), is_normalised(config))


def _check_output(config: Config) -> None:
    """Raise ConfigError if the output type cannot represent the frames.

    Integers are rounded and clipped; float32 is not.
    """
    quantise = config.effects.quantise and effect_switch(config.effects, "quantise")
    if is_normalised(config):
        if quantise == "on":
            raise ConfigError("effects.quantise=on: output.dtype=float32 is not rounded; set output.dtype=uint16")
        return
    if quantise == "off":
        raise ConfigError(
            "effects.quantise=off: integer output is always rounded and clipped; set output.dtype=float32"
        )
    if config.sensor.clip == NO_CLIP:
        raise ConfigError(
            "sensor.clip=none: output.dtype=uint16 holds no values beyond the sensor's range; set output.dtype=float32"
        )
