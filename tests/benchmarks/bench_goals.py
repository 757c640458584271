"""Measure the goals for the speed of pairs as ratios, all in one run: one process, one thread, in turns.

    python tests/benchmarks/bench_goals.py [PHOTO_OR_FOLDER ...] [--rounds 5] [--yardstick naive.py]

Without photographs, the image is a frame of 2.4 megapixels made of synthetic scenes. In each round the benchmark
measures both sides of a ratio directly after each other: the shortest processor time of several calls. The Markdown
table shows the median ratio over rounds and images, the lowest and the highest one, and nanoseconds per site of both
sides. The time of a noisy frame alone is what a further draw of the noise adds.

Yardsticks are plain NumPy and scipy: Algorithm 1 in float64 (`helpers.algorithm1`, or any module with the functions
unprocess(rgb, dtype), add_noise(raw) and to_dn(raw)), and the sampling that the authors of ELD and of PMN published.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import itertools
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers import algorithm1
from helpers.configs import composed

from unprocess_gen.config.schema import Config
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.types import FLOAT32, PACKED, Patch, Plan, Source, Srgb
from unprocess_gen.dataset.manifest import pair_row
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import plan_pairs
from unprocess_gen.simulation.pair import make_pair, make_pairs
from unprocess_gen.sources.image.decode import decode
from unprocess_gen.sources.scenes import synthetic

Call = Callable[[], object]

TWO_NUMBERS = "noise=imx385_iso3200"
PROFILES = ("sony_a7s2", "nikon_d850")
GIVEN = "noise.assumed=[]"
EVERY_EFFECT = f"effects.all=on {GIVEN} noise.full_well_e=60000"
ELD_LAW = {
    "daylight": "noise=heteroscedastic noise.law=poisson noise.a=0.0228 noise.b=0.0522 scene=daylight",
    "night": "noise=heteroscedastic noise.law=poisson noise.a=1.46 noise.b=4.7 scene=night",
}
"""System gain and read noise of the Sony A7S II at ISO 100 and 6400 by ELD's regression, DN of the default sensor."""
PMN_LAW = {scene: f"noise=nikon_d850 scene={scene} effects.assumed=off" for scene in ELD_LAW}
"""A profile with every part of PMN's law, black-level errors included, and no other effect."""
FIXED_PATTERNS = {"prnu", "hot_pixels", "dead_pixels", "column"}
LEVELS = 5
LEAST_NS = 20_000_000
"""Processor time of the calls from which the shortest is taken."""
PATCHES = 16
"""Patches per measurement, at different places of the frame."""


# Timing ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Work:
    """Calls to be timed, and the number of sites that they simulate together.

    ``prepare`` returns the calls of one repetition; its own time does not count.
    """

    prepare: Callable[[], Sequence[Call]]
    sites: int

    def ns_per_site(self, least_ns: int) -> float:
        """Return the shortest processor time of a repetition, of at least two that take ``least_ns`` together."""
        times_ns: list[int] = []
        while len(times_ns) < 2 or sum(times_ns) < least_ns:
            calls = self.prepare()
            started = time.thread_time_ns()
            for call in calls:
                call()
            times_ns.append(time.thread_time_ns() - started)
        return min(times_ns) / self.sites


@dataclass(frozen=True)
class FurtherFrame:
    """Time of one more noisy frame: that of `LEVELS` draws minus that of one pair, divided by the further draws."""

    levels: Work
    one: Work

    def ns_per_site(self, least_ns: int) -> float:
        more, less = self.levels.ns_per_site(least_ns), self.one.ns_per_site(least_ns)
        return (more - less) / (LEVELS - 1)


@dataclass(frozen=True)
class Row:
    """Ratio of the times of two sides, and its goal: an upper bound, or with ``least`` a lower one.

    Without ``against`` the row is the time itself in microseconds.
    """

    what: str
    settings: str
    work: Work | FurtherFrame
    against: Work | FurtherFrame | None
    goal: float
    least: bool = False


@dataclass
class Measured:
    """Times of a row, one for each round and image, nanoseconds per site."""

    row: Row
    times_ns: list[tuple[float, float]] = field(default_factory=list)

    def measure(self, least_ns: int) -> None:
        against = math.nan if self.row.against is None else self.row.against.ns_per_site(least_ns)
        self.times_ns.append((self.row.work.ns_per_site(least_ns), against))

    @property
    def ratios(self) -> list[float]:
        if self.row.against is None:
            return [ns / 1000 for ns, _ in self.times_ns]
        return [against / ns if self.row.least else ns / against for ns, against in self.times_ns]

    def table_row(self) -> str:
        """Return the row of the Markdown table."""
        row, ratio = self.row, statistics.median(self.ratios)
        is_met = ratio >= row.goal if row.least else ratio <= row.goal
        unit = " µs" if row.against is None else ""
        digits = 1 if ratio >= 20 else 2
        found, lowest, highest = (f"{value:.{digits}f}" for value in (ratio, min(self.ratios), max(self.ratios)))
        sides = [f"{statistics.median(side):.1f}" for side in zip(*self.times_ns, strict=True)]
        return (
            f"| {row.what} | `{row.settings}` | {found}{unit} | {lowest} to {highest} "
            f"| {'≥' if row.least else '≤'} {row.goal:g}{unit} | {'yes' if is_met else 'no'} "
            f"| {'' if unit else ' / '.join(sides)} |"
        )


# Yardsticks -----------------------------------------------------------------------------------------------------------


def own_yardstick(plan: Plan) -> Callable[[Srgb], object]:
    """Return a function that simulates a pair by `algorithm1` with the parameters of a plan."""
    tiny = make_pair(np.zeros((1, 1, 3), np.uint8), plan)
    values = pair_row("", Source(0, "", "", 0), "", 1, 0, plan, tiny, ("", ""), Patch(0, 0, 0, 1, 1))
    row = {name: str(value) for name, value in values.items()}
    rng = np.random.default_rng(0)

    def pair(rgb: Srgb) -> object:
        raw, white = algorithm1.unprocess(rgb, row), 2**plan.bits - 1
        return algorithm1.to_dn(raw, white), algorithm1.to_dn(algorithm1.add_noise(raw, row, rng), white)

    return pair


def other_yardstick(path: str) -> Callable[[Srgb], object]:
    """Return a function that simulates a pair by the module at ``path``."""
    spec = importlib.util.spec_from_file_location("yardstick", path)
    assert spec is not None and spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def pair(rgb: Srgb) -> object:
        raw = module.unprocess(rgb, np.float64)
        return module.to_dn(raw), module.to_dn(module.add_noise(raw))

    return pair


def packed_light(srgb: Srgb, plan: Plan) -> np.ndarray:
    """Return the clean frame as ELD and PMN keep it: float32 planes [4, H / 2, W / 2], 0 at black, 1 at white."""
    return make_pair(srgb, replace(plan, dtype=FLOAT32, layout=PACKED)).clean


def sample_eld(light: np.ndarray, plan: Plan) -> np.ndarray:
    """Sample Poisson counts and Gaussian read noise, as the released code of ELD does (Wei et al., CVPR 2020).

    Its ``noise.py`` draws with NumPy's global generator, converts to float32, and leaves the frame normalised.
    """
    span_dn = plan.white_level_dn - plan.black_level_dn
    dn_per_e, read_std_dn = plan.a_dn, math.sqrt(plan.b_dn2)
    signal_dn = light * span_dn
    noisy_dn = np.random.poisson(signal_dn / dn_per_e).astype(np.float32) * dn_per_e
    noisy_dn = noisy_dn + np.random.randn(*light.shape).astype(np.float32) * read_std_dn
    return noisy_dn / span_dn


def sample_pmn(light: np.ndarray, plan: Plan) -> np.ndarray:
    """Sample the law of PMN (Feng et al., ACM MM 2022): counts, Tukey-λ read noise, rows, colour bias, quantisation.

    Its ``data_process/process.py`` draws the read noise with scipy, models rounding as uniform noise, adds a bias per
    colour plane, clips, and returns float32.
    """
    from scipy import stats  # takes a second, in every process that collects the tests

    physics = plan.physics
    assert physics is not None
    span_dn = plan.white_level_dn - plan.black_level_dn
    signal_dn = light * span_dn
    shot_dn = np.random.poisson(signal_dn / physics.dn_per_e).astype(np.float32) * physics.dn_per_e
    scale_dn = physics.read_std_dn / tukey_std(physics.read_shape)
    read_dn = stats.tukeylambda.rvs(physics.read_shape, scale=scale_dn, size=light.shape).astype(np.float32)
    planes, height, _ = light.shape
    row_dn = np.random.randn(planes, height, 1).astype(np.float32) * physics.row_std_dn
    rounding_dn = np.random.uniform(-0.5, 0.5, light.shape)
    bias_dn = np.array(physics.black_error_dn, dtype=np.float32).reshape(4, 1, 1)
    noisy = (shot_dn + read_dn + row_dn + rounding_dn + bias_dn) / span_dn
    return np.clip(noisy, -plan.black_level_dn / span_dn, 1).astype(np.float32)


@functools.cache
def tukey_std(shape: float) -> float:
    """Return the standard deviation of Tukey's lambda distribution at scale 1."""
    from scipy import stats

    return float(stats.tukeylambda.std(shape))


# Rows -----------------------------------------------------------------------------------------------------------------


@functools.cache
def config_of(settings: str) -> Config:
    config = composed(*settings.split(), "effects.assumed=off")  # the goals are those of effects with published numbers
    validate_config(config)
    return config


class Bench:
    """Work on one image; plans are drawn once for each text of overrides.

    Parameters
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        The image.
    number : int
        Identity of the image, from which its parameters are drawn.
    patch_side : int
        Side of patches, pixels.
    yardstick : str or None
        Path of a module to use instead of `helpers.algorithm1`.
    """

    def __init__(self, srgb: Srgb, number: int = 0, patch_side: int = 128, yardstick: str | None = None) -> None:
        self.srgb, self.number, self.patch_side, self.yardstick = srgb, number, patch_side, yardstick
        self.sites = srgb.shape[0] * srgb.shape[1]
        self.bodies = itertools.count(1)

    def plans(self, settings: str) -> tuple[Plan, ...]:
        config = config_of(settings)
        return plan_pairs(config, f"{self.number:064x}", facts=facts_for(config, self.srgb))

    def with_new_body(self, plan: Plan) -> Plan:
        """Return the plan with another camera body, whose fixed patterns no pair before had.

        A plan without fixed patterns is the same for every body.
        """
        if plan.physics is None or not {*plan.effects} & FIXED_PATTERNS:
            return plan
        return replace(plan, physics=replace(plan.physics, body_key=next(self.bodies)))

    def pair(self, settings: str, new_body: bool = True) -> Work:
        """Return the work of a full frame; ``new_body`` gives each repetition another camera body."""
        (plan,) = self.plans(settings)

        def prepare() -> list[Call]:
            return [functools.partial(make_pair, self.srgb, self.with_new_body(plan) if new_body else plan)]

        return self.warm(Work(prepare, self.sites))

    def levels(self, settings: str) -> Work:
        """Return the work of all noise levels of a full frame; sites are those of one frame."""
        plans = self.plans(settings)
        assert len(plans) == LEVELS
        return self.warm(Work(lambda: [lambda: [None for _ in make_pairs(self.srgb, plans)]], self.sites))

    def patches(self, settings: str, new_place: bool = False) -> Work:
        """Return the work of `PATCHES` patches; ``new_place`` moves each repetition on the sensor, as random patches.

        Fixed patterns are kept by place.
        """
        (plan,) = self.plans(settings)
        side = self.patch_side
        corners = [*itertools.product(*(np.linspace(0, full - side, 4).astype(int) for full in self.srgb.shape[:2]))]
        assert len(corners) == PATCHES
        cut_outs = [(self.srgb[y : y + side, x : x + side], (int(y), int(x))) for y, x in corners]
        repetitions = itertools.count(1)

        def prepare() -> list[Call]:
            moved = 2 * next(repetitions) if new_place else 0
            return [
                functools.partial(make_pair, patch, plan, (y + moved, x + moved % 4096)) for patch, (y, x) in cut_outs
            ]

        return self.warm(Work(prepare, PATCHES * side * side))

    def naive(self) -> Work:
        (plan,) = self.plans(TWO_NUMBERS)
        simulate = other_yardstick(self.yardstick) if self.yardstick else own_yardstick(plan)
        return Work(lambda: [functools.partial(simulate, self.srgb)], self.sites)

    def sampling(self, settings: str, sample: Callable[[np.ndarray, Plan], np.ndarray]) -> Work:
        """Return the work of a yardstick that adds noise to the clean frame, without making the clean frame."""
        (plan,) = self.plans(settings)
        light = packed_light(self.srgb[: self.srgb.shape[0] // 2 * 2, : self.srgb.shape[1] // 2 * 2], plan)
        return Work(lambda: [functools.partial(sample, light, plan)], light.size)

    def planning(self, settings: str) -> Work:
        """Return the work of planning images, which takes the place of sites."""
        config = config_of(settings)
        facts, images = facts_for(config, self.srgb), itertools.count()
        calls = 20
        return self.warm(
            Work(
                lambda: [
                    functools.partial(plan_pairs, config, f"{next(images):064x}", facts=facts) for _ in range(calls)
                ],
                calls,
            )
        )

    @staticmethod
    def warm(work: Work) -> Work:
        """Compile kernels and fill caches."""
        work.ns_per_site(0)
        return work

    def rows(self) -> Iterator[Row]:
        """Yield every goal."""
        naive, two = self.naive(), self.pair(TWO_NUMBERS)
        fast = self.pair(f"{TWO_NUMBERS} accuracy=fast")
        yield Row("two numbers, against naive float64 NumPy", f"{TWO_NUMBERS} accuracy=exact", two, naive, 60, True)
        yield Row("two numbers, against naive float64 NumPy", f"{TWO_NUMBERS} accuracy=fast", fast, naive, 90, True)
        for scene, goal in (("daylight", 1.6), ("low_light", 2.5), ("night", 2.5)):
            for profile in PROFILES:
                settings = f"noise={profile} scene={scene}"
                yield Row("physical, against two numbers", settings, self.pair(settings), two, goal)
        for more, scene in itertools.product((GIVEN, EVERY_EFFECT), ("daylight", "low_light", "night")):
            for profile in PROFILES:
                settings = f"noise={profile} scene={scene} {more}"
                yield Row("physical, against two numbers", settings, self.pair(settings), two, 4.5)
        for settings in (TWO_NUMBERS, "noise=sony_a7s2 scene=daylight", "noise=nikon_d850 scene=night"):
            floats = self.pair(f"{settings} output.dtype=float32")
            yield Row("float32, against uint16", settings, floats, self.pair(settings), 1.4)
        for settings in ("noise=sony_a7s2 scene=daylight", "noise=nikon_d850 scene=night"):
            levels = self.levels(f"{settings} noise.levels={LEVELS}")
            yield Row("five levels, against one", f"{settings} noise.levels=5", levels, self.pair(settings), 3.5)
        yield from self.patch_rows()
        yield Row("planning an image", "noise=brooks2019", self.planning("noise=brooks2019"), None, 150)
        for profile in PROFILES:
            settings = f"noise={profile} scene=night"
            yield Row("planning an image", settings, self.planning(settings), None, 400)
        for author, law, sample in (("ELD", ELD_LAW, sample_eld), ("PMN", PMN_LAW, sample_pmn)):
            for settings in law.values():
                frame = FurtherFrame(self.levels(f"{settings} noise.draws={LEVELS}"), self.pair(settings))
                yield Row(
                    f"noisy frame, against {author}'s", settings, frame, self.sampling(settings, sample), 25, True
                )

    def patch_rows(self) -> Iterator[Row]:
        """Yield the goals for the time per site of a patch."""
        name = f"patches of {self.patch_side}², against the full frame"
        daylight = "noise=sony_a7s2 scene=daylight"
        for settings, goal in ((TWO_NUMBERS, 1.5), (daylight, 2.0)):
            yield Row(name, settings, self.patches(settings), self.pair(settings), goal)
        settings = f"{daylight} {GIVEN}"
        for what, is_new in (("new places", True), ("places seen before", False)):
            patches, full = self.patches(settings, is_new), self.pair(settings, is_new)
            yield Row(f"{name}, {what}", settings, patches, full, 2.0)


def measured_rows(bench: Bench, rounds: int, least_ns: int) -> list[Measured]:
    """Measure every goal on one image."""
    rows = [Measured(row) for row in bench.rows()]
    for _ in range(rounds):
        for row in rows:
            row.measure(least_ns)
    return rows


def table(rows: Sequence[Measured]) -> str:
    """Return the Markdown table of all goals."""
    head = "| what | settings | ratio | lowest to highest | goal | met | ns per site |\n|---|---|--:|--:|--:|---|--:|"
    return "\n".join([head, *(row.table_row() for row in rows)])


def synthetic_frame() -> Srgb:
    """Return a frame of 1024 x 2304 pixels: six synthetic scenes of all kinds."""
    names = [name for name in synthetic.NAMES if name not in synthetic.SIZES][:6]
    scenes = [synthetic.scene(name) for name in names]
    return np.concatenate([np.concatenate(scenes[at : at + 3], axis=1) for at in (0, 3)])


def photographs(paths: Sequence[Path]) -> Iterator[Srgb]:
    """Decode the photographs; a folder is replaced by its files."""
    for path in paths:
        for file in sorted(path.iterdir()) if path.is_dir() else [path]:
            yield decode(file.read_bytes(), max_pixels=2**26, icc="ignore").srgb


def main() -> None:
    """Measure synthetic scenes, or every photograph given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--yardstick")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    images = photographs(options.photos) if options.photos else iter([synthetic_frame()])
    total: list[Measured] = []
    for number, srgb in enumerate(images):
        found = measured_rows(Bench(srgb, number, yardstick=options.yardstick), options.rounds, LEAST_NS)
        total = total or [Measured(one.row) for one in found]
        for row, one in zip(total, found, strict=True):
            row.times_ns.extend(one.times_ns)
    print(table(total))


if __name__ == "__main__":
    main()
