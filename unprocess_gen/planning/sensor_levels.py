"""Warn about a camera's noise in the raw levels of the default sensor."""

from __future__ import annotations

from typing import Any

from unprocess_gen.config.defaults import default_options, default_values
from unprocess_gen.config.interpretation import is_physical
from unprocess_gen.config.option_files import conf_dir, group_options
from unprocess_gen.config.schema import Config
from unprocess_gen.config.yaml_files import read_yaml_mapping

LEVEL_NAMES = ("bits", "black_level_dn", "white_level_dn")


def sensor_warning(config: Config) -> str:
    """Return a warning if the sensor is the default one and a physical profile was calibrated with other levels.

    The sentence names the option with the profile's bits and the settings that give its levels; else it is empty.
    """
    calibrated, chosen = ({key: getattr(group, key) for key in LEVEL_NAMES} for group in (config.noise, config.sensor))
    default = {key: default_values("sensor")[key] for key in LEVEL_NAMES}
    if not is_physical(config.noise) or chosen != default or calibrated == default:
        return ""
    return (
        f"noise={config.noise.name} was calibrated with {_levels_text(calibrated)}, but is simulated with "
        f"{_levels_text(chosen)} of the default sensor={default_options()['sensor']}; "
        f"{' '.join(fitting_sensor(calibrated, config.noise.name))} gives the calibrated levels"
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
