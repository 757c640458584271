"""Measure the time of scenes, and what omitting effects saves and costs in accuracy: one thread, interleaved.

    python tests/benchmarks/bench_scenes.py PHOTO [PHOTO ...] [--profiles sony_a7s2,imx385] [--rounds 5]
        [--costs | --daylight]

Prints a Markdown table with a row for each scene and physical profile. Times are nanoseconds of CPU time per pixel,
medians over photographs and rounds: under ``effects=auto``, with all effects that have a parameter, their ratio, and
the ratio of auto to the two-parameter profile imx385_iso3200. Assumed parameters count as sourced ones, so that auto
decides about all effects. The last column is the accepted error: RMS of the omitted effects divided by the masking
noise, in the worst statistic (`omission`), measured by the reference on a crop of each photograph.

``--costs`` prints the time that each effect adds with all others on. ``--daylight`` compares every profile, without
assumed parameters, with the two-parameter model of the same tier.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers.omissions import SCENES, omission
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import Config
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import Float, Plan, Srgb
from unprocess_gen.planning.effect_selection import facts_of
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference.noise import EFFECTS
from unprocess_gen.sources.image.decode import decode

PROFILES = ("sony_a7s2", "nikon_d850", "imx385", "canon_5d4", "canon_70d", "canon_700d", "oppo_reno10x")
COST_SCENES = ("daylight", "night")
"""Scenes of many and of few electrons per pixel: counts below 64 are slower."""

ISOS = ("noise.iso=1600", "noise.iso=3200", "noise.iso=6400")
"""Alternatives, in this order, if a profile was not calibrated at the ISO of the scene."""

BODIES = itertools.count(1)

CROP = (384, 512)
"""Size of the crop for the reference, which takes 3 microseconds per pixel."""


def settings(*overrides: str) -> Config:
    """Return the validated config of these overrides."""
    ConfigStore.instance().store(name="gen_dataset_schema", node=Config)
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        node = compose("config", overrides=list(overrides))
    loaded = OmegaConf.to_container(node, resolve=True)
    config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Config), loaded))
    assert isinstance(config, Config)
    validate_config(config)
    return config


def physical(*overrides: str) -> Config:
    """Return the config of a scene and a profile, at the ISO of the scene if the profile has it."""
    if not is_valid(*overrides):
        overrides = (*overrides, next(iso for iso in ISOS if is_valid(*overrides, iso)))
    return settings(*overrides)


def is_valid(*overrides: str) -> bool:
    """Return whether these overrides give a valid config."""
    try:
        settings(*overrides)
    except ConfigError:
        return False
    return True


def nanoseconds(srgb: Srgb, plan: Plan) -> float:
    """Return the CPU time of one pair of a new camera body, whose PRNU is not cached, nanoseconds per pixel."""
    if plan.physics is not None:
        plan = replace(plan, physics=replace(plan.physics, body_key=next(BODIES)))
    started = time.thread_time()
    make_pair(srgb, plan)
    return (time.thread_time() - started) * 1e9 / (srgb.shape[0] * srgb.shape[1])


def planned(config: Config, srgb: Srgb, switch: str, number: int) -> Plan:
    """Plan a photograph with ``effects.all`` set to ``switch``."""
    config.effects.all = switch
    return plan_image(config, f"{number:064x}", 0, facts_of(srgb))


def crop(srgb: Srgb) -> Srgb:
    """Return the crop of size `CROP` in the middle."""
    top, left = ((side - most) // 2 if side > most else 0 for side, most in zip(srgb.shape[:2], CROP, strict=True))
    return np.ascontiguousarray(srgb[top : top + CROP[0], left : left + CROP[1]])


def interleaved(srgb: Srgb, plans: dict[str, Plan], rounds: int) -> dict[str, list[float]]:
    """Return the times of each plan, nanoseconds per pixel, measured in turns."""
    for plan in plans.values():
        nanoseconds(srgb, plan)
    times_ns: dict[str, list[float]] = {name: [] for name in plans}
    for _ in range(rounds):
        for name, plan in plans.items():
            times_ns[name].append(nanoseconds(srgb, plan))
    return times_ns


def table_row(scene: str, noise: str, photos: list[Srgb], rounds: int) -> str:
    """Return the Markdown row of a scene and a profile."""
    config = physical(f"scene={scene}", f"noise={noise}", "noise.assumed=[]")
    two = settings("noise=imx385_iso3200")
    ratios, times, omitted = [], {"two": [], "auto": [], "on": []}, set()
    squares: dict[str, list[Float]] = {"": [np.zeros(1)]}
    for number, srgb in enumerate(photos):
        plans = {"two": plan_image(two, f"{number:064x}")}
        plans |= {switch: planned(config, srgb, switch, number) for switch in ("auto", "on")}
        omitted |= set(plans["on"].effects) - set(plans["auto"].effects)
        times_ns = interleaved(srgb, plans, rounds)
        for name, seconds in times_ns.items():
            times[name] += seconds
        ratios += zip(times_ns["on"], times_ns["auto"], times_ns["two"], strict=True)
        part = crop(srgb)
        part_plans = [planned(config, part, switch, number) for switch in ("on", "auto")]
        omitted |= set(part_plans[0].effects) - set(part_plans[1].effects)
        for statistic, values in omission(part, *part_plans).items():
            squares.setdefault(statistic, []).append(values)
    error = max(math.sqrt(np.concatenate(values).mean()) for values in squares.values())
    auto, on = (statistics.median(times[name]) for name in ("auto", "on"))
    saved = statistics.median(auto / on for on, auto, _ in ratios)
    relative = statistics.median(auto / two for _, auto, two in ratios)
    iso = plans["on"].physics.iso if plans["on"].physics is not None else 0
    names = ", ".join(effect for effect in EFFECTS if effect in omitted) or "nothing"
    return (
        f"| {scene} | {noise}, ISO {iso:g} | {auto:.1f} | {on:.1f} | {saved:.2f} | {relative:.1f} | {names} "
        f"| {error:.3f} |"
    )


def daylight(photos: list[Srgb], rounds: int) -> None:
    """Print the time of each profile relative to the two-parameter model: median and maximum over photographs."""
    print("| profile | `exact` | `fast` |\n|---|--:|--:|")
    for noise in PROFILES:
        cells = []
        for tier in ("exact", "fast"):
            profile = physical("scene=daylight", f"noise={noise}", f"accuracy={tier}", "effects.assumed=off")
            two = settings("noise=imx385_iso3200", f"accuracy={tier}")
            ratios = []
            for number, srgb in enumerate(photos):
                plans = {"auto": planned(profile, srgb, "auto", number), "two": plan_image(two, f"{number:064x}")}
                times_ns = interleaved(srgb, plans, rounds)
                ratios.append(min(times_ns["auto"]) / min(times_ns["two"]))
            cells.append(f"{statistics.median(ratios):.2f} ({max(ratios):.2f})")
        print(f"| {noise} | {cells[0]} | {cells[1]} |", flush=True)


def costs(photo: Srgb, rounds: int) -> None:
    """Print the time that each effect adds to all others on a photograph of 2880x2160: differences of minimum times."""
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
        times_ns = interleaved(srgb, plans, rounds)
        for effect in EFFECTS:
            table[effect].append(min(times_ns["all"]) - min(times_ns[effect]))
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
        "| scene | profile | auto, ns/pixel | all on | auto / all | auto / two-parameter | omitted | accepted error |"
    )
    print("|---|---|--:|--:|--:|--:|---|--:|")
    for scene in SCENES:
        for noise in options.profiles.split(","):
            print(table_row(scene, noise, photos, options.rounds), flush=True)


if __name__ == "__main__":
    main()
