"""Measure the speed of pairs as ratios, all in one run: one process, one thread, in turns.

    python tests/benchmarks/bench_goals.py [PHOTO_OR_FOLDER ...] [--rounds 5]

Without photographs, the image is a frame of 2.4 megapixels made of synthetic pictures. In each round the benchmark
measures both sides of a ratio directly after each other: the shortest processor time of several calls. The Markdown
table shows the median ratio over rounds and images, the lowest and the highest one, and nanoseconds per site of both
sides. Planning is compared with a pair of 128 x 128 pixels. The yardstick is Algorithm 1 in float64 NumPy
(`helpers.algorithm1`).
"""

from __future__ import annotations

import argparse
import functools
import itertools
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers import algorithm1
from helpers.configs import composed

from unprocess_gen.config.schema import Config
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.row import pair_row
from unprocess_gen.pipeline.pairs import PairSettings, plan_pixels
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import plan_pairs
from unprocess_gen.reports.timing import measure_in_turns, thread_ns
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.kernels.site_patterns import forget_patterns
from unprocess_gen.simulation.pair import make_pair, make_pairs
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.tone_curves import linear_table
from unprocess_gen.sources import synthetic
from unprocess_gen.sources.image.decode import Photograph, decode
from unprocess_gen.sources.linear.pixels import linear_photograph

TWO_NUMBERS = "noise=imx385_iso3200"
PROFILES = ("sony_a7s2", "nikon_d850")
GIVEN = "noise.assumed=[]"
EVERY_EFFECT = f"effects.all=on {GIVEN} noise.full_well_e=60000"
LEVELS = 5
LEAST_NS = 20_000_000
"""Processor time of the calls from which the shortest is taken."""


@dataclass(frozen=True)
class Work:
    """A call to be timed, and the number of sites that it simulates; `forget_patterns` before it is free."""

    call: Callable[[], object]
    sites: int
    is_new_body: bool = True

    def ns_per_site(self, least_ns: int) -> float:
        """The shortest time of a repetition, of at least two that take ``least_ns`` together."""
        times: list[float] = []
        while len(times) < 2 or sum(times) * self.sites < least_ns:
            if self.is_new_body:
                forget_patterns()
            times.append(thread_ns(self.call, self.sites))
        return min(times)


@dataclass(frozen=True)
class Row:
    """Ratio of the times of two sides."""

    what: str
    settings: str
    work: Work
    against: Work

    def table_row(self, times: Sequence[tuple[float, float]]) -> str:
        """The row of the Markdown table for the times of both sides."""
        ratios = [ns / against for ns, against in times]
        middle, lowest, highest = (f"{value:.3g}" for value in (statistics.median(ratios), min(ratios), max(ratios)))
        sides = " / ".join(f"{statistics.median(side):.1f}" for side in zip(*times, strict=True))
        return f"| {self.what} | `{self.settings}` | {middle} | {lowest} to {highest} | {sides} |"


# Yardsticks -----------------------------------------------------------------------------------------------------------


def yardstick(plan: Plan) -> Callable[[Srgb], object]:
    """A function that simulates a pair by `algorithm1` with the parameters of a plan."""
    tiny = make_pair(np.zeros((1, 1, 3), np.uint8), plan)
    values = pair_row("", Source(0, "", "", 0), "", 1, 0, plan, tiny, ("", ""), Patch(1, 1))
    row = {name: str(value) for name, value in values.items()}
    rng = np.random.default_rng(0)

    def pair(rgb: Srgb) -> object:
        raw, white = algorithm1.unprocess(rgb, row), 2**plan.sensor.bits - 1
        return algorithm1.to_dn(raw, white), algorithm1.to_dn(algorithm1.add_noise(raw, row, rng), white)

    return pair


# Rows -----------------------------------------------------------------------------------------------------------------


@functools.cache
def config_of(settings: str) -> Config:
    config = composed(*settings.split())
    validate_config(config)
    return config


@dataclass(frozen=True)
class Bench:
    """Work on one image, whose parameters are drawn from ``number``."""

    srgb: Srgb
    number: int = 0
    patch_side: int = 128

    @property
    def sites(self) -> int:
        return self.srgb[..., 0].size

    def plans(self, settings: str) -> tuple[Plan, ...]:
        config = config_of(settings)
        source = linear_photograph(config.source, self.srgb).source if config.source.kind == "linear" else None
        return plan_pairs(config, f"{self.number:064x}", facts=facts_for(config, self.srgb, source=source))

    def pair(self, settings: str, is_new_body: bool = True) -> Work:
        """A full frame."""
        (plan,) = self.plans(settings)
        return Work(lambda: make_pair(self.srgb, plan), self.sites, is_new_body)

    def levels(self, settings: str) -> Work:
        """All noise levels of a full frame; sites are those of one frame."""
        plans = self.plans(settings)
        assert len(plans) == LEVELS
        return Work(lambda: [None for _ in make_pairs(self.srgb, plans)], self.sites)

    def patches(self, settings: str, is_new_place: bool = False) -> Work:
        """16 patches; with ``is_new_place`` at other places of the sensor, whose fixed patterns no pair before had."""
        (plan,) = self.plans(settings)
        side = self.patch_side
        places = (np.linspace(0, full - side, 4).astype(int).tolist() for full in self.srgb.shape[:2])
        cut_outs = [(self.srgb[y : y + side, x : x + side], (y, x)) for y, x in itertools.product(*places)]
        sites = len(cut_outs) * side * side
        return Work(lambda: [make_pair(patch, plan, place) for patch, place in cut_outs], sites, is_new_place)

    def planning(self, settings: str) -> Work:
        """Plan 20 images in the time per site of a patch."""
        config, images = config_of(settings), itertools.count()
        facts = facts_for(config, self.srgb)

        def plan() -> object:
            return [plan_pairs(config, f"{next(images):064x}", facts=facts) for _ in range(20)]

        return Work(plan, 20 * self.patch_side**2)

    def burst(self, side: int) -> tuple[Work, Work]:
        """A burst of 14 frames at a quarter of the resolution; its 14 pairs, and 14 warps by OpenCV in float32."""
        config = config_of(f"{TWO_NUMBERS} source.burst={{frames:14,shift:2}} source.patch=[random,{4 * side},1]")
        settings, source = PairSettings.read(config), Source(0, "", "", 0)
        image = plan_pixels(settings, Photograph(self.srgb, 1), source, f"{self.number:064x}")
        (plan,), frame = self.plans(TWO_NUMBERS), np.ascontiguousarray(self.srgb[:side, :side])
        light, motion = np.ones((4 * side, 4 * side, 3), np.float32), np.array([[1, 0.01, 1.3], [-0.01, 1, 2.7]])

        def parts() -> object:
            warps = [cv2.warpAffine(light, motion, light.shape[:2], flags=cv2.INTER_LINEAR) for _ in range(14)]
            return warps, [make_pair(frame, plan) for _ in range(14)]

        sites = 14 * side * side
        return Work(lambda: list(image.pairs()), sites, False), Work(parts, sites, False)

    def light_and_16_bits(self) -> tuple[Bench, Bench]:
        """The light of the image as a linear source, and the image in 16 bits."""
        codes = self.srgb.astype(np.uint16) * (257 if self.srgb.itemsize == 1 else 1)
        light = linear_table("smoothstep", 2.2, 65536)[codes].astype(np.float32)
        return replace(self, srgb=light), replace(self, srgb=codes)

    def naive(self) -> Work:
        (plan,) = self.plans(TWO_NUMBERS)
        simulate = yardstick(plan)
        return Work(lambda: simulate(self.srgb), self.sites)

    def rows(self) -> Iterator[Row]:
        """Yield every ratio."""
        naive, two = self.naive(), self.pair(TWO_NUMBERS)
        for tier in ("exact", "fast"):
            settings = f"{TWO_NUMBERS} accuracy={tier}"
            yield Row("two numbers, against naive float64 NumPy", settings, self.pair(settings), naive)
        for more, scene, profile in itertools.product(("", GIVEN, EVERY_EFFECT), ("daylight", "night"), PROFILES):
            settings = f"noise={profile} scene={scene} {more}".strip()
            yield Row("physical, against two numbers", settings, self.pair(settings), two)
        daylight, night = "noise=sony_a7s2 scene=daylight", "noise=nikon_d850 scene=night"
        for settings in (TWO_NUMBERS, daylight, night):
            yield Row(
                "float32, against uint16", settings, self.pair(f"{settings} output.dtype=float32"), self.pair(settings)
            )
        light, codes = self.light_and_16_bits()
        for settings in (TWO_NUMBERS, daylight, night):
            linear = light.pair(f"source.kind=linear {settings}")
            yield Row("a linear source, against 16 bits", settings, linear, codes.pair(settings))
        burst, parts = self.burst(96 if min(self.srgb.shape[:2]) > 400 else 8)
        yield Row("a burst, against its pairs and OpenCV's warps", TWO_NUMBERS, burst, parts)
        for settings in (daylight, night):
            levels = self.levels(f"{settings} noise.levels={LEVELS}")
            yield Row("five levels, against one", f"{settings} noise.levels=5", levels, self.pair(settings))
        for settings, is_new in ((TWO_NUMBERS, False), (daylight, False), (f"{daylight} {GIVEN}", True)):
            what = (
                f"patches of {self.patch_side}², {'new places' if is_new else 'places seen before'}, against the frame"
            )
            yield Row(what, settings, self.patches(settings, is_new), self.pair(settings, is_new))
        for settings in ("noise=brooks2019", "noise=sony_a7s2 scene=night", night):
            yield Row("planning, against a patch", settings, self.planning(settings), self.patches(TWO_NUMBERS))


def table(images: Sequence[Bench], rounds: int, least_ns: int = LEAST_NS) -> str:
    """The Markdown table of all ratios."""
    lines: dict[tuple[str, str], tuple[Row, list[tuple[float, float]]]] = {}
    for bench in images:
        rows = {(row.what, row.settings): row for row in bench.rows()}
        for row in rows.values():
            for work in (row.work, row.against):
                work.ns_per_site(0)  # compiles kernels and fills caches
        sides = {
            key: lambda _, row=row: (row.work.ns_per_site(least_ns), row.against.ns_per_site(least_ns))
            for key, row in rows.items()
        }
        for key, times in measure_in_turns(sides, rounds).items():
            lines.setdefault(key, (rows[key], []))[1].extend(times)
    head = "| what | settings | ratio | lowest to highest | ns per site |\n|---|---|--:|--:|--:|"
    return "\n".join([head, *(row.table_row(times) for row, times in lines.values())])


def synthetic_frame() -> Srgb:
    """A frame of 1024 x 2304 pixels: six synthetic pictures of all kinds."""
    names = [name for name in synthetic.NAMES if name not in synthetic.SIZES][:6]
    scenes = [synthetic.picture(name) for name in names]
    return np.concatenate([np.concatenate(scenes[first : first + 3], axis=1) for first in (0, 3)])


def main() -> None:
    """Measure synthetic pictures, or every photograph given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    files = [file for path in options.photos for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    images = [decode(file.read_bytes(), max_pixels=2**26, icc="ignore").srgb for file in files] or [synthetic_frame()]
    benches = [Bench(srgb, number) for number, srgb in enumerate(images)]
    print(table(benches, options.rounds))


if __name__ == "__main__":
    main()
