"""Measure the time to plan an image, next to a pair of 128 x 128 pixels: one thread, interleaved.

    python tests/benchmarks/bench_planning.py [--images 400]

Prints a Markdown table with a row for each setting: microseconds of CPU time per image, and their ratio to the time of
the yardstick, a pair of 128 x 128 pixels with two-number noise and a finished plan. Every image has draws of its own.
All settings take turns. The columns are the median of the images, the shortest time, the ratio of the medians, and the
first image, for which the config is interpreted. The last rows are steps that `unprocess_gen.make_pair` adds for small
arrays: the check of the config, the facts and the digest of the pixels.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers.configs import composed

from unprocess_gen.api import array_identity
from unprocess_gen.config.schema import Config
from unprocess_gen.config.validation import validate_config
from unprocess_gen.planning.effect_selection import facts_of
from unprocess_gen.planning.plan import plan_image, plan_pairs
from unprocess_gen.simulation.pair import make_pair

SETTINGS: dict[str, tuple[str, ...]] = {
    "Brooks' gains, one calibrated ISO": ("noise=imx385_iso3200",),
    "Brooks' gains and noise": ("noise=brooks2019",),
    "Brooks' noise, five levels": ("noise=brooks2019", "noise.levels=5"),
    "physical, daylight": ("noise=sony_a7s2", "scene=daylight"),
    "physical, night": ("noise=sony_a7s2", "scene=night"),
    "physical, night, nothing assumed": ("noise=sony_a7s2", "scene=night", "noise.assumed=[]"),
    "physical, night, all on": ("noise=sony_a7s2", "scene=night", "noise.assumed=[]", "effects.all=on"),
    "physical, by ISO, nothing assumed": ("noise=nikon_d850", "scene=daylight", "noise.assumed=[]"),
    "physical, five levels": ("noise=imx385", "scene=night", "noise.levels=[1600,3200,6400,12800,25600]"),
}

PATCH = np.random.default_rng(0).integers(3, 250, (128, 128, 3), dtype=np.uint8)


def microseconds(call: Callable[[], object]) -> float:
    """Return the CPU time of one call."""
    started = time.thread_time_ns()
    call()
    return (time.thread_time_ns() - started) / 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=400, help="images of each setting")
    options = parser.parse_args()
    configs = {name: composed(*overrides) for name, overrides in SETTINGS.items()}
    for config in configs.values():
        validate_config(config)
    facts, two_numbers = facts_of(PATCH), configs["Brooks' gains, one calibrated ISO"]
    plan = plan_image(two_numbers, "0" * 64)
    make_pair(PATCH, plan)

    def planned(config: Config, image: int) -> Callable[[], object]:
        return partial(plan_pairs, config, f"{image:064x}", 0, facts)

    first = {name: microseconds(planned(config, 0)) for name, config in configs.items()}
    steps = {
        "check of a physical config": partial(validate_config, configs["physical, night"]),
        "facts of the pixels": partial(facts_of, PATCH),
        "digest of the pixels": partial(array_identity, PATCH),
    }
    times: dict[str, list[float]] = {name: [] for name in ("yardstick", *configs, *steps)}
    for image in range(1, options.images + 1):
        times["yardstick"].append(microseconds(partial(make_pair, PATCH, plan)))
        for name, config in configs.items():
            times[name].append(microseconds(planned(config, image)))
        for name, step in steps.items():
            times[name].append(microseconds(step))
    yardstick = statistics.median(times["yardstick"])
    print("| setting | µs per image | lowest | of the yardstick | first image |\n|---|--:|--:|--:|--:|")
    for name, found in times.items():
        middle = statistics.median(found)
        earliest = f"{first[name]:.0f}" if name in first else ""
        print(f"| {name} | {middle:.0f} | {min(found):.0f} | {middle / yardstick:.2f} | {earliest} |")


if __name__ == "__main__":
    main()
