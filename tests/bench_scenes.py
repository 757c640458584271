"""What scenes cost, and what leaving effects out saves and loses: one process, one thread, in turns.

    python tests/bench_scenes.py PHOTO [PHOTO ...] [--profiles sony_a7s2,imx385] [--rounds 5] [--costs | --daylight]

Prints a Markdown table, a line for each scene and physical profile: nanoseconds of processor time a pixel under
``effects=auto`` and with everything on that has a number (assumed numbers count as sourced ones, so that auto decides
about all), their ratio, the ratio of auto to the two-parameter profile imx385_iso3200, all as medians over photographs
and rounds; and the error accepted: what auto left out, RMS over the noise that hides it, in the worst statistic
(`omission`), measured on a cut-out of each photograph, all together, by the reference forms. With ``--costs``: what
each effect adds, all others being on. With ``--daylight``: every profile as it stands, assumed numbers left out, beside
the two-parameter model of the same tier.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from unprocess_gen.cli.hydra_app import conf_dir
from unprocess_gen.config.schema import Config
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import Float, Plan, Srgb
from unprocess_gen.planning import effect_selection as planner
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.kernels import physical as electrons
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference import noise as effects
from unprocess_gen.simulation.reference.noise import EFFECTS
from unprocess_gen.simulation.reference.sensor import to_dn
from unprocess_gen.simulation.reference.unprocess import unprocess
from unprocess_gen.sources.image.decode import decode

SCENES = ("daylight", "indoor", "low_light", "night", "video_night", "long_exposure")
PROFILES = ("sony_a7s2", "nikon_d850", "imx385", "canon_5d4", "canon_70d", "canon_700d", "oppo_reno10x")
COST_SCENES = ("daylight", "night")
"""Many electrons a pixel, and few: counts below 64 are the dearer ones."""

ISOS = ("noise.iso=1600", "noise.iso=3200", "noise.iso=6400")
"""What is taken, in turn, where a profile was not calibrated at the scene's ISO."""

CUT = (384, 512)
"""Of the reference forms, which take 3 microseconds a pixel."""


def settings(*overrides: str) -> Config:
    ConfigStore.instance().store(name="gen_dataset_schema", node=Config)
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        node = compose("config", overrides=list(overrides))
    loaded = OmegaConf.to_container(node, resolve=True)
    config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Config), loaded))
    assert isinstance(config, Config)
    validate_config(config)
    return config


def physical(*said: str) -> Config:
    """Settings of a scene and a profile, at the scene's ISO if the profile has it."""
    if not are_taken(*said):
        said = (*said, next(iso for iso in ISOS if are_taken(*said, iso)))
    return settings(*said)


def are_taken(*said: str) -> bool:
    try:
        settings(*said)
    except ConfigError:
        return False
    return True


def unrounded(srgb: Srgb, plan: Plan) -> tuple[Float, Float]:
    """The clean and the noisy frame in DN, before rounding."""
    light = unprocess(srgb, plan) * plan.exposure
    if plan.averaged:
        light = effects.respond(light, plan)
    clean_dn = to_dn(light, plan.black_level_dn, plan.white_level_dn, plan.brightest)
    return clean_dn, effects.noisy(clean_dn, plan)


def omission(srgb: Srgb, everything: Plan, auto: Plan, frames: int = 1) -> dict[str, Float]:
    """What ``auto`` leaves out of ``everything``, squared, over the variance that hides it, for each statistic.

    One value for each pixel, row, column and colour plane of the mean over the ``frames`` of a still clip. What hides
    is the noise of ``auto`` at the local signal.
    """
    clean_dn = unrounded(srgb, auto)[0]
    clips = ([unrounded(srgb, replace(plan, frame=n))[1] for n in range(frames)] for plan in (everything, auto))
    with_all, with_some = (np.mean(clip, axis=0) for clip in clips)
    left_out = with_all - with_some
    variance = effects.noise_variance(clean_dn, auto) + 1 / 12
    if auto.physics is not None and "dark_current" in auto.effects:
        variance = variance + auto.physics.dn_per_e**2 * auto.physics.dark_e
    variance = variance / frames
    height, width = left_out.shape
    planes = [(left_out[y::2, x::2], variance[y::2, x::2]) for y in range(min(height, 2)) for x in range(min(width, 2))]
    return {
        "pixel": (left_out**2 / variance).ravel(),
        "row mean": left_out.mean(1) ** 2 / (variance.mean(1) / width),
        "column mean": left_out.mean(0) ** 2 / (variance.mean(0) / height),
        "plane mean": np.array([part.mean() ** 2 / (noise.mean() / part.size) for part, noise in planes]),
    }


def nanoseconds(srgb: Srgb, plan: Plan) -> float:
    """One pair of a body that was not seen before, nanoseconds of processor time a pixel."""
    electrons.prnu_response.cache_clear()
    started = time.thread_time()
    make_pair(srgb, plan)
    return (time.thread_time() - started) * 1e9 / (srgb.shape[0] * srgb.shape[1])


def planned(config: Config, srgb: Srgb, switch: str, number: int) -> Plan:
    config.effects.all = switch
    return plan_image(config, f"{number:064x}", 0, planner.facts_of(srgb))


def cut(srgb: Srgb) -> Srgb:
    top, left = ((side - most) // 2 if side > most else 0 for side, most in zip(srgb.shape[:2], CUT, strict=True))
    return np.ascontiguousarray(srgb[top : top + CUT[0], left : left + CUT[1]])


def in_turns(srgb: Srgb, plans: dict[str, Plan], rounds: int) -> dict[str, list[float]]:
    for plan in plans.values():
        nanoseconds(srgb, plan)
    taken: dict[str, list[float]] = {name: [] for name in plans}
    for _ in range(rounds):
        for name, plan in plans.items():
            taken[name].append(nanoseconds(srgb, plan))
    return taken


def line(scene: str, noise: str, photos: list[Srgb], rounds: int) -> str:
    config = physical(f"scene={scene}", f"noise={noise}", "noise.assumed=[]")
    two = settings("noise=imx385_iso3200")
    ratios, times, left_out = [], {"two": [], "auto": [], "on": []}, set()
    squares: dict[str, list[Float]] = {"": [np.zeros(1)]}
    for number, srgb in enumerate(photos):
        plans = {"two": plan_image(two, f"{number:064x}")}
        plans |= {switch: planned(config, srgb, switch, number) for switch in ("auto", "on")}
        left_out |= set(plans["on"].effects) - set(plans["auto"].effects)
        taken = in_turns(srgb, plans, rounds)
        for name, seconds in taken.items():
            times[name] += seconds
        ratios += zip(taken["on"], taken["auto"], taken["two"], strict=True)
        part = cut(srgb)
        part_plans = [planned(config, part, switch, number) for switch in ("on", "auto")]
        left_out |= set(part_plans[0].effects) - set(part_plans[1].effects)
        for statistic, values in omission(part, *part_plans).items():
            squares.setdefault(statistic, []).append(values)
    error = max(math.sqrt(np.concatenate(values).mean()) for values in squares.values())
    auto, on = (statistics.median(times[name]) for name in ("auto", "on"))
    saved = statistics.median(auto / on for on, auto, _ in ratios)
    beside = statistics.median(auto / two for _, auto, two in ratios)
    iso = plans["on"].physics.iso if plans["on"].physics is not None else 0
    names = ", ".join(effect for effect in EFFECTS if effect in left_out) or "nothing"
    return (
        f"| {scene} | {noise}, ISO {iso:g} | {auto:.1f} | {on:.1f} | {saved:.2f} | {beside:.1f} | {names} "
        f"| {error:.3f} |"
    )


def daylight(photos: list[Srgb], rounds: int) -> None:
    """Print what the profiles' pairs take beside the two-parameter model's, median and most of the photographs'."""
    print("| profile | `exact` | `fast` |\n|---|--:|--:|")
    for noise in PROFILES:
        told = []
        for tier in ("exact", "fast"):
            ours = physical("scene=daylight", f"noise={noise}", f"accuracy={tier}")
            two = settings("noise=imx385_iso3200", f"accuracy={tier}")
            ratios = []
            for number, srgb in enumerate(photos):
                plans = {"ours": planned(ours, srgb, "auto", number), "two": plan_image(two, f"{number:064x}")}
                taken = in_turns(srgb, plans, rounds)
                ratios.append(min(taken["ours"]) / min(taken["two"]))
            told.append(f"{statistics.median(ratios):.2f} ({max(ratios):.2f})")
        print(f"| {noise} | {told[0]} | {told[1]} |", flush=True)


def costs(photo: Srgb, rounds: int) -> None:
    """Print what each effect adds to a pair with all the others, on the photograph at 2880x2160: shortest times."""
    srgb = cv2.resize(photo, (2880, 2160), interpolation=cv2.INTER_AREA)
    print("| effect | " + " | ".join(COST_SCENES) + " |\n|---|" + "--:|" * len(COST_SCENES))
    table: dict[str, list[float]] = {effect: [] for effect in EFFECTS}
    for scene in COST_SCENES:
        config = physical(f"scene={scene}", "noise=nikon_d850", "noise.assumed=[]", "noise.full_well_e=60000")
        plan = planned(config, srgb, "on", 0)
        assert plan.physics is not None
        plan = replace(plan, effects=EFFECTS, physics=replace(plan.physics, column_std_dn=0.1))
        plans = {"all": plan} | {
            effect: replace(plan, effects=tuple(other for other in EFFECTS if other != effect)) for effect in EFFECTS
        }
        taken = in_turns(srgb, plans, rounds)
        for effect in EFFECTS:
            table[effect].append(min(taken["all"]) - min(taken[effect]))
    for effect, values in table.items():
        print(f"| {effect} | " + " | ".join(f"{value:.1f}" for value in values) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+")
    parser.add_argument("--profiles", default="sony_a7s2,nikon_d850,imx385")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--costs", action="store_true")
    parser.add_argument("--daylight", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    photos = [decode(Path(photo).read_bytes(), max_pixels=2**26, icc="ignore").srgb for photo in options.photos]
    if options.costs:
        costs(photos[0], options.rounds)
        return
    if options.daylight:
        daylight(photos, options.rounds)
        return
    print(
        "| scene | profile | auto, ns/pixel | all on | auto / all | auto / two-parameter | left out | error accepted |"
    )
    print("|---|---|--:|--:|--:|--:|---|--:|")
    for scene in SCENES:
        for noise in options.profiles.split(","):
            print(line(scene, noise, photos, options.rounds), flush=True)


if __name__ == "__main__":
    main()
