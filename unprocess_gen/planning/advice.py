"""Warn about settings that are rarely meant, or that have no effect: a run and ``plan`` show the same sentences."""

from __future__ import annotations

from functools import cache
from typing import Any

from unprocess_gen.config.defaults import default_options, default_values
from unprocess_gen.config.distributions import highest, lowest
from unprocess_gen.config.interpretation import is_physical
from unprocess_gen.config.limits import EXPOSURE_RATIO, ISO, OVERRIDDEN
from unprocess_gen.config.option_files import conf_dir, group_options
from unprocess_gen.config.schema import Config
from unprocess_gen.config.values import value_range
from unprocess_gen.config.yaml_files import read_yaml_mapping
from unprocess_gen.core.fields import value_text

LEVEL_NAMES = ("bits", "black_level_dn", "white_level_dn")

MOST_CLIPPED_LOW = 0.01
"""Fraction of the sites of clean frames of raw sources that may be clipped low without a warning."""

NOUNS = {"camera": "colour matrix", "sensor": "set of raw levels", "noise": "noise profile"}
"""What the options of a body's groups contain."""


def warnings(config: Config) -> list[str]:
    """Return the sentences about a config that its user should read before a run."""
    checks = scene_warning, overridden_warning, sensor_warning, bits_warning
    return [sentence for check in checks if (sentence := check(config))]


def scene_warning(config: Config) -> str:
    """Return a warning if a two-parameter profile ignores a scene that is dark or described; else an empty text."""
    default, scene = default_values("scene"), config.scene
    given = {key: getattr(scene, key) for key in ("iso", "exposure_s", "temperature_c")}
    changed = [f"scene.{key}={value_text(value)}" for key, value in given.items() if value != default[key]]
    ratio = EXPOSURE_RATIO.parse("scene.exposure_ratio", scene.exposure_ratio)
    if is_physical(config.noise) or not (changed or highest(ratio) > 1):
        return ""
    problem = f"{', '.join(changed)}: no effect on noise={config.noise.name}, which holds for one ISO"
    if highest(ratio) > 1:
        drawn = ratio, ISO.parse("scene.iso", scene.iso)
        ratios, isos = (value_range((lowest(number), highest(number))) for number in drawn)
        problem = f"scene={scene.name}: light is divided by {ratios}, but noise={config.noise.name} ignores ISO {isos}"
    return f"{problem}; physical profiles follow the scene: {', '.join(physical_profiles())}"


def overridden_warning(config: Config) -> str:
    """Return a sentence if a number of the noise profile is overridden; else an empty text."""
    profile, mark, _ = config.noise.name.partition(OVERRIDDEN)
    sentence = f"noise={profile}: settings replace numbers of the profile; the column noise has {profile}{OVERRIDDEN}"
    return sentence if mark else ""


def bits_warning(config: Config) -> str:
    """Return a warning if the white level of a sensor needs fewer bits than it has; else an empty text."""
    sensor, needed = config.sensor, config.sensor.white_level_dn.bit_length()
    if sensor.levels == "source" or needed == sensor.bits:
        return ""
    return (
        f"sensor.bits={sensor.bits}: white_level_dn={sensor.white_level_dn} needs {needed} bits, so noisy values reach "
        f"{2**sensor.bits - 1} DN; sensor.bits={needed} clips them at {2**needed - 1}"
    )


@cache
def physical_profiles() -> tuple[str, ...]:
    """Return the names of the built-in physical noise profiles, which takes 0.2 s to read."""
    folder = conf_dir() / "noise"
    return tuple(name for name in group_options("noise") if "branches" in read_yaml_mapping(folder / f"{name}.yaml"))


def sensor_warning(config: Config) -> str:
    """Return a warning if the sensor is the default one and a physical profile was calibrated with other levels.

    The sentence names the option with the profile's bits and the settings that give its levels; else it is empty.
    """
    calibrated, chosen = ({key: getattr(group, key) for key in LEVEL_NAMES} for group in (config.noise, config.sensor))
    default = {key: default_values("sensor")[key] for key in LEVEL_NAMES}
    if not is_physical(config.noise) or chosen != default or calibrated == default:
        return ""
    name = config.noise.name.removesuffix(OVERRIDDEN)
    return (
        f"noise={name} was calibrated with {_levels_text(calibrated)}, but is simulated with "
        f"{_levels_text(chosen)}, the levels of the default sensor={default_options()['sensor']}; "
        f"{' '.join(fitting_sensor(calibrated, name))} gives the calibrated levels"
    )


def fitting_sensor(levels: dict[str, Any], camera: str = "") -> list[str]:
    """Return the overrides of the group ``sensor`` that give some levels: an option, and settings that differ in it.

    Of equal options the one with the name of the camera is preferred.
    """
    options = {name: read_yaml_mapping(conf_dir() / "sensor" / f"{name}.yaml") for name in group_options("sensor")}

    def differences(name: str) -> list[str]:
        return [f"sensor.{key}={value}" for key, value in levels.items() if options[name][key] != value]

    def distance(name: str) -> tuple[bool, int, bool]:
        return options[name]["bits"] != levels["bits"], len(differences(name)), name != camera

    option = min(options, key=distance)
    return [f"sensor={option}", *differences(option)]


def _levels_text(levels: dict[str, Any]) -> str:
    return f"{levels['bits']} bits, black {levels['black_level_dn']}, white {levels['white_level_dn']} DN"


def clipped_low_warning(clipped: int, sites: int) -> str:
    """Return the end of a sentence about sources whose clean frames are often clipped low; else an empty text."""
    if clipped <= MOST_CLIPPED_LOW * sites:
        return ""
    return (
        f"has {clipped / sites:.1%} of the sites of clean frames clipped low, which makes dark areas too bright; "
        f"expected at most {MOST_CLIPPED_LOW:.0%}; choose sensor.clip=sensor, a sensor with a higher black level, or "
        "float32 frames (output.dtype=float32 sensor.clip=none)"
    )


def body_sentence(config: Config) -> str:
    """Return a sentence about the groups for which no numbers of the body are published; empty without any."""
    body = config.body
    missing = [group for group in body.missing if group != "camera" or config.source.kind != "raw"]
    sentences = [f"no {NOUNS[group]} of it is published, so {_chosen(config, group)} applies" for group in missing]
    return f"body={body.name}: {'; '.join(sentences)}" if body.name is not None and sentences else ""


def _chosen(config: Config, group: str) -> str:
    name = getattr(getattr(config, group), "name", None)
    return f"the setting {group}" if name is None else f"{group}={name}"
