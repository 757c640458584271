"""Generate ``docs/reference/scenes.md``: which effects each scene calls for with each physical noise profile."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache

import unprocess_gen as ug
from unprocess_gen.config.interpretation import assumed_numbers, branch_of
from unprocess_gen.config.option_files import group_options
from unprocess_gen.config.schema import Config, NoiseConfig, SceneConfig
from unprocess_gen.config.serialization import read_option
from unprocess_gen.planning.advice import physical_profiles
from unprocess_gen.planning.effect_selection import Prediction
from unprocess_gen.planning.plan import plan_levels
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.simulation.effects import BY_NAME
from unprocess_gen.simulation.facts import Facts

FACTS = Facts(width=6000, height=4000, codes=256, dark_code=0, bright_code=255)
"""A photograph of 24 megapixels with black and white in it."""

SENSORS = {10: "generic_10bit", 12: "imx385_12bit", 14: "generic_14bit"}

SCENES = ("daylight", "indoor", "low_light", "night", "long_exposure", "video_night")

INTRODUCTION = """\
# Effects by scene

This page lists the effects that `effects.all=auto` simulates, for each scene and physical noise profile. The
predictions are for a photograph of 24 megapixels with codes from 0 to 255. The sensor has the bits of the profile.
Light is divided by the mean of the scene's range. The [atlas of effects](effects.md) has the meaning and a picture of
each effect.

The number after an effect is its ratio to the noise that hides it; for the full well it is an upper limit. For hot and
dead pixels it is the number of pixels above the noise. All omitted effects together stay below a tenth of the noise. An
effect with an asterisk uses an assumed number: a typical value, because [no source](noise_profiles.md) gives one for
this camera."""

REASONS = {
    "daylight": "There is much light. PRNU grows faster with the signal than shot noise does, so it is visible. "
    "Offsets that are the same in a row, a column or a plane are visible too. In a millisecond, dark current is "
    "negligible.",
    "indoor": "There is less light, at a higher gain. For most profiles, the exposure is still too short for dark "
    "current.",
    "low_light": "Dark current becomes visible if the read noise is small.",
    "night": "There are few electrons, so PRNU is too small to see. Compared with so little light, the dark current "
    "of a tenth of a second is visible.",
    "long_exposure": "In half a minute at 35 °C, dark current adds electrons everywhere, and more pixels are hot.",
    "video_night": "The sensor is warm, so dark current is visible although the exposure is short. PRNU is too small "
    "to see.",
}
"""Why the effects of each scene are simulated."""


@cache
def _base() -> Config:
    return ug.load_config([])


@cache
def _profile(name: str) -> NoiseConfig:
    return read_option("noise", name)


@cache
def _scene(name: str) -> SceneConfig:
    """Return a scene whose light is divided by the mean of its range."""
    scene = read_option("scene", name)
    ratio = scene.exposure_ratio
    return replace(scene, exposure_ratio=(ratio[1] + ratio[2]) / 2) if isinstance(ratio, tuple) else scene


@cache
def predictions_of(scene: str, profile: str) -> tuple[Prediction, ...] | None:
    """Return the predictions of all effects; None if the profile was not calibrated at the ISO of the scene."""
    noise = _profile(profile)
    if branch_of(noise, _scene(scene).iso) is None:
        return None
    assert noise.bits is not None
    sensor = read_option("sensor", SENSORS[noise.bits])
    config = replace(_base(), noise=noise, scene=_scene(scene), sensor=sensor)
    ((_, selection),) = plan_levels(config, "0" * 64, facts=FACTS)
    return None if selection is None else selection.predictions()


def _entry(profile: str, one: Prediction) -> str:
    size = short_number(one.outliers if BY_NAME[one.effect].has_outliers else one.ratio, 2)
    if BY_NAME[one.effect].has_outliers:
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
        blocks.append(table(["profile", "simulated", "omitted"], rows))
    return page(*blocks)
