"""Generate ``docs/reference/effects.md``, the atlas of effects, and state what its pictures show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from scene_page import SCENES, predictions_of

from unprocess_gen.config.option_files import group_options
from unprocess_gen.config.schema import BranchConfig, NoiseConfig
from unprocess_gen.config.settings import settings_of
from unprocess_gen.planning.advice import physical_profiles
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.simulation.effects import BY_NAME, EFFECTS, PHYSICAL_EFFECTS, profile_keys

PROFILE, SENSOR, RANGE_DN = "nikon_d850", "generic_14bit", 16383 - 1024
"""Profile and sensor of the pictures, and DN from its black to its white level."""

OTHER_PROFILE = "noise=imx385_iso12800"
"""Profile of the picture of `heteroscedastic`."""


class Picture(NamedTuple):
    """What a picture shows: the scene, the DN that are drawn black and white, and numbers that the profile lacks.

    ``in_scene`` adds the noise of the scene with and without the effect, ``ratio`` divides the light.
    """

    scene: str
    limit_dn: float
    numbers: Mapping[str, Any] = MappingProxyType({})
    in_scene: bool = False
    ratio: float | None = None
    also_on: tuple[str, ...] = ()


PICTURES = {
    "heteroscedastic": Picture("daylight", 2000),
    "lens_shading": Picture("daylight", 1000, {"lens_shading": [-0.3, 0.0, 0.0]}),
    "prnu": Picture("daylight", 100),
    "shot": Picture("low_light", 200, in_scene=True),
    "dark_current": Picture("long_exposure", 50, in_scene=True, ratio=100),
    "hot_pixels": Picture("long_exposure", 100, {"hot_pixel_share": 2e-3}, in_scene=True),
    "full_well": Picture("long_exposure", 4000, {"full_well_e": 4000.0}),
    "gain_by_colour": Picture("daylight", 100, {"gain_by_colour": [1.5, 1.0, 0.7]}, also_on=("shot",)),
    "read": Picture("night", 80, in_scene=True),
    "row": Picture("night", 5),
    "column": Picture("long_exposure", 0.2),
    "column_temporal": Picture("long_exposure", 0.2, {"column_temporal_std_dn": 0.05}),
    "black_error": Picture("night", 2),
    "dsnu": Picture("long_exposure", 10, {"dsnu_std_e": 2.0}),
    "dead_pixels": Picture("daylight", 4000, {"dead_pixel_share": 1e-3}),
    "quantise": Picture("daylight", 1),
}
"""Pictures by effect; the numbers are raised or given so that 128 x 128 pixels show the effect."""

INTRODUCTION = """\
# Atlas of effects

Each effect by itself, amplified, and in a scene that calls for it, in the order in which light meets them. The
pictures show a part of a synthetic picture, one pixel per site. `python docs/draw_effects.py` draws all of them.

- Left: the frame with the effect minus the frame without, and no other effect. Grey is no difference. The text states
  the DN that are drawn black and white, and the amplification compared with a frame drawn from black to white level.
- Middle and right: all noise (noisy minus clean frame) that `effects.all=auto` simulates in the scene, and the same
  without this effect, both drawn from -3 to 3 standard deviations. The other effects have no such pictures: no scene
  calls for them, or they show in means over frames, rows, columns or planes only.

The table counts the profiles for which `auto` simulates an effect, of those that are calibrated at the ISO of the
scene. [Effects by scene](scenes.md) has the ratios behind it."""

NO_PICTURE = "It has no picture: it is what your own [dark frames](../guides/dark_frames.md) contain."


def calls(effect: str, scene: str, profile: str = PROFILE) -> bool:
    """Whether ``auto`` simulates an effect in a scene with a profile that is calibrated there."""
    return any(one.effect == effect and one.simulated for one in predictions_of(scene, profile) or ())


def _count(effect: str, scene: str) -> str:
    calibrated = [profile for profile in physical_profiles() if predictions_of(scene, profile) is not None]
    count = sum(calls(effect, scene, profile) for profile in calibrated)
    return f"{count} of {len(calibrated)}" if count else "–"


def _text(value: Any) -> str:
    return f"[{','.join(map(_text, value))}]" if isinstance(value, list) else f"{value:g}"


def _section(effect: str) -> list[str]:
    """Return heading, sentence, numbers and picture of an effect."""
    meaning = BY_NAME[effect].meaning
    blocks = [f"## `{effect}`", f"{meaning[0].upper()}{meaning[1:]}."]
    keys = {**settings_of(NoiseConfig), **settings_of(BranchConfig)}
    if numbers := [key for key, (one, _) in profile_keys().items() if one.name == effect]:
        units = {name: f", {keys[name].unit}" if keys[name].unit else "" for name in numbers}
        blocks.append("\n".join(f"- `{name}`: {keys[name].meaning}{units[name]}" for name in numbers))
    if effect not in PICTURES:
        return [*blocks, NO_PICTURE]
    picture = PICTURES[effect]
    shown = f"noise={PROFILE} scene={picture.scene}" if effect in PHYSICAL_EFFECTS else OTHER_PROFILE
    changed = "".join(f", `{name}={_text(value)}`" for name, value in picture.numbers.items())
    factor = short_number(RANGE_DN / 2 / picture.limit_dn, 2)
    also = f", {' and '.join(f'`{name}`' for name in picture.also_on)} on" if picture.also_on else ""
    light = f", `scene.exposure_ratio={picture.ratio:g}`" if picture.ratio else ""
    where = " Middle and right: all noise of the scene, with and without it." if picture.in_scene else ""
    called = calls(effect, picture.scene) or not picture.in_scene
    assert called, f"effects.all=auto omits {effect} in scene={picture.scene}: leave `in_scene` out of its picture"
    text = f"`{shown}`{light}{changed}{also}: ±{picture.limit_dn:g} DN, {factor} times.{where}"
    return [*blocks, f"![{effect} by itself](effects/{effect}.jpg)", text]


def effects_page(table: Callable[[Iterable[str], Iterable[Iterable[str]]], str], page: Callable[..., str]) -> str:
    """Return the page; ``table`` and ``page`` format Markdown (`reference_pages`)."""
    assert set(SCENES) == set(group_options("scene"))
    names = [effect.name for effect in EFFECTS]
    lacking = " ".join(sorted({*names} - {*PICTURES, "dark_frame"}))
    assert not lacking, f"no picture of {lacking}: add to PICTURES, then run `python docs/draw_effects.py {lacking}`"
    assert {*PICTURES} <= {*names}, f"PICTURES names no effects: {sorted({*PICTURES} - {*names})}; remove them"
    rows = [[f"[`{name}`](#{name})", *(_count(name, scene) for scene in SCENES)] for name in PHYSICAL_EFFECTS]
    head = ["effect", *(f"[`{scene}`](scenes.md#{scene})" for scene in SCENES)]
    return page(INTRODUCTION, table(head, rows), *(block for name in names for block in _section(name)))
