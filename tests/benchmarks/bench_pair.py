"""Measure the speed of a pair relative to a yardstick: two accuracy tiers, interleaved, one process, one thread.

    python tests/benchmarks/bench_pair.py PHOTO [PHOTO ...] [--yardstick naive.py] [--rounds 5]

Prints nanoseconds per pixel for each photograph (medians), and the speed of each tier relative to the yardstick
(medians of the ratios of each round). The yardstick is `helpers.algorithm1`, or any module with the functions
unprocess(rgb, dtype), add_noise(raw) and to_dn(raw).
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from omegaconf import OmegaConf

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers import algorithm1

from unprocess_gen.config.schema import AccuracyConfig, Config, GainsConfig, NoiseConfig
from unprocess_gen.core.types import Patch, Plan, Source
from unprocess_gen.dataset.manifest import pair_row
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.sources.image.decode import decode

TIERS = ("exact", "fast")


def fixed_plan(tier: str) -> Plan:
    """Return the same plan for every photograph, with the accuracy budget of a tier."""
    noise = NoiseConfig("imx385_iso3200", "dn", "subtracted", 12, 240, 4095, 6.955588, 38.117816)
    budget = OmegaConf.load(Path(__file__).parents[2] / "conf" / "accuracy" / f"{tier}.yaml")
    accuracy = OmegaConf.to_object(OmegaConf.merge(AccuracyConfig, budget))
    assert isinstance(accuracy, AccuracyConfig)
    return plan_image(Config(gains=GainsConfig(2.1, 1.7, 0.8), noise=noise, accuracy=accuracy), "0" * 64)


def own_yardstick(plan: Plan) -> Callable[[np.ndarray], object]:
    """Return a function that simulates a pair by `algorithm1` with the parameters of a plan."""
    tiny = make_pair(np.zeros((1, 1, 3), np.uint8), plan)
    values = pair_row("", Source(0, "", "", 0), "", 1, 0, plan, tiny, ("", ""), Patch(0, 0, 0, 1, 1))
    row = {name: str(value) for name, value in values.items()}
    rng = np.random.default_rng(0)

    def pair(rgb: np.ndarray) -> object:
        raw = algorithm1.unprocess(rgb, row)
        return algorithm1.to_dn(raw, 4095), algorithm1.to_dn(algorithm1.add_noise(raw, row, rng), 4095)

    return pair


def other_yardstick(path: str) -> Callable[[np.ndarray], object]:
    """Return a function that simulates a pair by the module at ``path``."""
    spec = importlib.util.spec_from_file_location("yardstick", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def pair(rgb: np.ndarray) -> object:
        raw = module.unprocess(rgb, np.float64)
        return module.to_dn(raw), module.to_dn(module.add_noise(raw))

    return pair


def seconds(call: Callable[[], object]) -> float:
    """Return the CPU time of a call in this thread, which other processes do not change."""
    started = time.thread_time()
    call()
    return time.thread_time() - started


def main() -> None:
    """Measure every photograph given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+")
    parser.add_argument("--yardstick")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    plans = {tier: fixed_plan(tier) for tier in TIERS}
    naive = other_yardstick(options.yardstick) if options.yardstick else own_yardstick(plans["exact"])
    found = []
    for photo in options.photos:
        rgb = decode(Path(photo).read_bytes(), max_pixels=2**26, icc="ignore").srgb
        calls = [partial(naive, rgb), *(partial(make_pair, rgb, plan) for plan in plans.values())]
        for call in calls[1:]:
            call()
        rounds = np.array([[seconds(call) for call in calls] for _ in range(options.rounds)])
        times_ns = np.median(rounds, axis=0) * 1e9 / (rgb.shape[0] * rgb.shape[1])
        found.append(np.median(rounds[:, :1] / rounds[:, 1:], axis=0))
        tiers = (
            f"{tier} {ns:.2f} ({ratio:.1f})" for tier, ns, ratio in zip(TIERS, times_ns[1:], found[-1], strict=True)
        )
        print(f"{Path(photo).name}: yardstick {times_ns[0]:.0f} ns per pixel,", ", ".join(tiers))
    for tier, ratios in zip(TIERS, np.transpose(found), strict=True):
        print(f"{tier}: median ratio {np.median(ratios):.1f}, {ratios.min():.1f} to {ratios.max():.1f}")


if __name__ == "__main__":
    main()
