"""Warn about dark scenes with a two-parameter noise profile, which ignores their ISO."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from unprocess_gen.config.distributions import highest, lowest, parse_drawn
from unprocess_gen.config.interpretation import is_physical
from unprocess_gen.config.limits import EXPOSURE_RATIO, ISO
from unprocess_gen.config.option_files import conf_dir, group_options
from unprocess_gen.config.schema import Config
from unprocess_gen.config.values import value_range
from unprocess_gen.config.yaml_files import read_yaml_mapping


def dark_scene_warning(config: Config, ratios: Sequence[float] = ()) -> str:
    """Return a warning if a two-parameter profile is used in a dark scene, whose ISO it ignores; else an empty text."""
    if is_physical(config.noise):
        return ""
    if not ratios:
        drawn = parse_drawn("scene.exposure_ratio", config.scene.exposure_ratio, EXPOSURE_RATIO)
        ratios = lowest(drawn), highest(drawn)
    if max(ratios) <= 1:
        return ""
    ratios = [float(f"{ratio:.3g}") for ratio in ratios]
    iso = parse_drawn("scene.iso", config.scene.iso, ISO)
    return (
        f"scene={config.scene.name}: light is divided by {value_range(ratios)}, but noise={config.noise.name} "
        f"ignores ISO {value_range((lowest(iso), highest(iso)))}; physical profiles follow the scene: "
        f"{', '.join(physical_profiles())}"
    )


@cache
def physical_profiles() -> tuple[str, ...]:
    """Return the names of the built-in physical noise profiles, which takes 0.2 s to read."""
    folder = conf_dir() / "noise"
    return tuple(name for name in group_options("noise") if "branches" in read_yaml_mapping(folder / f"{name}.yaml"))
