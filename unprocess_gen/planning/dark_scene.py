"""Warn about dark scenes with a two-parameter noise profile, which ignores their ISO."""

from __future__ import annotations

from functools import cache

from unprocess_gen.config.distributions import highest, lowest, parse_drawn
from unprocess_gen.config.interpretation import is_physical
from unprocess_gen.config.limits import EXPOSURE_RATIO, ISO
from unprocess_gen.config.option_files import conf_dir, group_options
from unprocess_gen.config.schema import Config
from unprocess_gen.config.values import value_range
from unprocess_gen.config.yaml_files import read_yaml_mapping


def dark_scene_warning(config: Config) -> str:
    """Return a warning if a two-parameter profile is used in a dark scene, whose ISO it ignores; else an empty text."""
    if is_physical(config.noise):
        return ""
    ratio = parse_drawn("scene.exposure_ratio", config.scene.exposure_ratio, EXPOSURE_RATIO)
    if highest(ratio) <= 1:
        return ""
    iso = parse_drawn("scene.iso", config.scene.iso, ISO)
    ratios, isos = (value_range((lowest(drawn), highest(drawn))) for drawn in (ratio, iso))
    return (
        f"scene={config.scene.name}: light is divided by {ratios}, but noise={config.noise.name} ignores ISO {isos}; "
        f"physical profiles follow the scene: {', '.join(physical_profiles())}"
    )


@cache
def physical_profiles() -> tuple[str, ...]:
    """Return the names of the built-in physical noise profiles, which takes 0.2 s to read."""
    folder = conf_dir() / "noise"
    return tuple(name for name in group_options("noise") if "branches" in read_yaml_mapping(folder / f"{name}.yaml"))
