"""Generate ``docs/reference/scenes.md``: which effects each scene calls for with each physical noise profile."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache

import unprocess_gen as ug
from unprocess_gen.config.interpretation import assumed_numbers, branch_of
from unprocess_gen.config.option_files import conf_dir, group_options
from unprocess_gen.config.schema import Config, NoiseConfig, SceneConfig, SensorConfig
from unprocess_gen.config.serialization import read_option
from unprocess_gen.core.types import Facts
from unprocess_gen.planning.dark_scene import physical_profiles
from unprocess_gen.planning.effect_contributions import OUTLIERS
from unprocess_gen.planning.effect_selection import Prediction
from unprocess_gen.planning.plan import plan_levels
from unprocess_gen.reports.formatting import short_number

FACTS = Facts(width=6000, height=4000, codes=256, dark_code=0, bright_code=255)
"""A photograph of 24 megapixels with black and white in it."""

SENSORS = {10: "generic_10bit", 12: "imx385_12bit", 14: "generic_14bit"}

SCENES = ("daylight", "indoor", "low_light", "night", "long_exposure", "video_night")

INTRODUCTION = """\
# Effects by scene

Which effects `effects.all=auto` simulates, for each scene and physical noise profile. The photograph has 24 megapixels
and codes from 0 to 255. The sensor has the bits of the profile. Light is divided by the mean of the scene's range.

The number behind an effect is its ratio to the noise that hides it; of the full well, an upper limit. Hot and dead
pixels have the number of pixels above the noise instead. All effects that are left out, together, stay below a tenth
of the noise. Effects with an asterisk use an [assumed number](noise_profiles.md).

![each effect by itself, amplified](effects.png)

Each picture has one effect of `noise=nikon_d850`, amplified (`python docs/draw_effects.py`). Hot and dead pixels are
more frequent there than in the profile, and the full well is smaller."""

REASONS = {
    "daylight": "Light is plentiful: PRNU, which grows faster than shot noise, shows, and so do offsets that are the "
    "same in a row, a column or a plane. A millisecond leaves no time for heat.",
    "indoor": "Less light at a higher gain. The exposure is still too short for most of the heat.",
    "low_light": "Heat begins to show where the read noise is small.",
    "night": "Few electrons: PRNU is too small to see. A tenth of a second of heat shows next to so little light.",
    "long_exposure": "Half a minute at 35 °C: dark current adds electrons everywhere, and more pixels are hot.",
    "video_night": "A warm sensor: heat shows, although the exposure is short. PRNU is too small to see.",
}
"""Why the effects of each scene are simulated."""


@cache
def _base() -> Config:
    return ug.load_config([])


@cache
def _profile(name: str) -> NoiseConfig:
    return read_option(conf_dir() / "noise" / f"{name}.yaml", NoiseConfig)


@cache
def _scene(name: str) -> SceneConfig:
    """Return a scene whose light is divided by the mean of its range."""
    scene = read_option(conf_dir() / "scene" / f"{name}.yaml", SceneConfig)
    ratio = scene.exposure_ratio
    return replace(scene, exposure_ratio=(ratio[1] + ratio[2]) / 2) if isinstance(ratio, list) else scene


def predictions_of(scene: str, profile: str) -> tuple[Prediction, ...] | None:
    """Return the predictions of all effects; None if the profile was not calibrated at the ISO of the scene."""
    noise = _profile(profile)
    if branch_of(noise, _scene(scene).iso) is None:
        return None
    assert noise.bits is not None
    sensor = read_option(conf_dir() / "sensor" / f"{SENSORS[noise.bits]}.yaml", SensorConfig)
    config = replace(_base(), noise=noise, scene=_scene(scene), sensor=sensor)
    ((_, predictions),) = plan_levels(config, "0" * 64, facts=FACTS)
    return predictions


def _entry(profile: str, one: Prediction) -> str:
    size = short_number(one.outliers if one.effect in OUTLIERS else one.ratio, 2)
    if one.effect in OUTLIERS:
        size = f"{size if one.outliers >= 1e-6 else 0} pixels"
    return f"{one.effect}{'*' if assumed_numbers(_profile(profile), one.effect) else ''} {size}"


def scenes_page(table: Callable[[Iterable[str], Iterable[Iterable[str]]], str], page: Callable[..., str]) -> str:
    """Return the page; ``table`` and ``page`` format Markdown (`reference_pages`)."""
    assert set(SCENES) == set(group_options("scene"))
    blocks = [INTRODUCTION]
    for scene in SCENES:
        facts = _scene(scene)
        blocks.append(f"## `{scene}`")
        blocks.append(
            f"ISO {facts.iso:g}, {facts.exposure_s:g} s, {facts.temperature_c:g} °C, light divided by "
            f"{facts.exposure_ratio:g}. {REASONS[scene]}"
        )
        rows = []
        for profile in physical_profiles():
            predictions = predictions_of(scene, profile)
            if predictions is None:
                rows.append([f"`{profile}`", f"not calibrated at ISO {facts.iso:g}", ""])
                continue
            known = [one for one in predictions if one.effect != "quantise"]
            missing = [one.effect for one in known if one.forced and not one.simulated]
            left_out = [_entry(profile, one) for one in known if not one.simulated and not one.forced]
            left_out += [f"{effect} (no number)" for effect in missing]
            rows.append(
                [f"`{profile}`", ", ".join(_entry(profile, one) for one in known if one.simulated), ", ".join(left_out)]
            )
        blocks.append(table(["profile", "simulated", "left out"], rows))
    return page(*blocks)
