"""Make the pairs of an image and their targets: examine, plan, cut and simulate it; this decides what a pair is.

Runs, estimates, replays, the Python functions and benchmarks use it; they differ in where pixels and plans come from.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from unprocess_gen.config.interpretation import BurstRule, burst_rule, patch_rule
from unprocess_gen.config.schema import Config
from unprocess_gen.core.arrays import Array, Srgb
from unprocess_gen.core.source import Source
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.columns import Value
from unprocess_gen.dataset.keys import frame_key, patch_key
from unprocess_gen.dataset.training import frame_noise_std
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.motion import draw_motion
from unprocess_gen.planning.plan import plan_pairs
from unprocess_gen.planning.raw_source import with_raw_sensor
from unprocess_gen.simulation.bursts import BurstLight
from unprocess_gen.simulation.effects import dark_variance_dn2
from unprocess_gen.simulation.facts import DarkFrames, Facts
from unprocess_gen.simulation.frames import Pair, Patch
from unprocess_gen.simulation.pair import linear_rgb, make_pairs
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.sources.dark_frames import DarkFolder, open_dark_frames
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.patches import crop_patch, list_patches

Targets = dict[str, Array]


@dataclass(frozen=True, slots=True)
class PairSettings:
    """A config with the digests of its dark frames, what plans need of them, and access to their pixels."""

    config: Config
    dark_frames: DarkFrames | None = None
    dark_folder: DarkFolder | None = None

    @classmethod
    def read(cls, config: Config) -> PairSettings:
        """Open the dark frames of a config; errors are those of `open_dark_frames`."""
        return cls(*open_dark_frames(config))


@dataclass(frozen=True, slots=True)
class PlannedImage:
    """A decoded image and all that decides its pairs: a plan for each draw of each noise level, and patches.

    ``facts`` are those about the pixels, for physical noise profiles; ``dark_folder`` gives access to the dark frames
    that the plans name. ``config`` is None if the plans are recorded.
    """

    srgb: Srgb
    plans: tuple[Plan, ...]
    patches: tuple[Patch, ...]
    facts: Facts | None = None
    dark_folder: DarkFolder | None = None
    config: Config | None = None

    def pairs(self) -> Iterator[tuple[Patch, Plan, Pair]]:
        """Simulate the pairs of every patch, in the order of the manifest."""
        for sample in self.samples():
            for plan, pair in zip(sample.plans, sample.pairs(), strict=True):
                yield sample.patch, plan, pair

    def samples(self) -> Iterator[Sample]:
        """Yield samples in the order of the manifest: the frames of each burst, or one sample for each patch."""
        rule = None if self.config is None else burst_rule(self.config.source)
        for patch in self.patches:
            if self.plans[0].motion is None:
                yield Sample(self.srgb, patch, self.plans, self.dark_folder)
                continue
            plans = self.plans if rule is None else with_motion(rule, self.plans, patch)
            light = BurstLight(self.srgb, plans[0], [plan.motion for plan in plans if plan.motion], patch)
            for _, of_frame in itertools.groupby(plans, lambda plan: plan.place.frame):
                yield Sample(self.srgb, patch, tuple(of_frame), self.dark_folder, light)


def with_motion(rule: BurstRule, plans: Sequence[Plan], patch: Patch, epoch: int = 0) -> tuple[Plan, ...]:
    """Plans of a burst's frames with the motion of a patch."""
    keys, frames = plans[0].stream_key, {plan.place.frame for plan in plans}
    motions = {frame: draw_motion(rule, keys, patch, frame, epoch) for frame in frames}
    return tuple(plan.replace(motion=motions[plan.place.frame]) for plan in plans)


def facts_of_burst(burst: BurstRule | None, facts: Facts | None) -> Facts | None:
    """Facts about the frames of bursts of a picture; those of the picture without bursts."""
    if burst is None or facts is None:
        return facts
    sides = facts.height // burst.downscale, facts.width // burst.downscale
    return replace(facts, height=sides[0], width=sides[1], frames=burst.frames)


@dataclass(frozen=True, slots=True)
class Sample:
    """Pairs that share a clean frame: a patch of an image, or a frame of a burst, which has ``light``."""

    srgb: Srgb
    patch: Patch
    plans: tuple[Plan, ...]
    dark_folder: DarkFolder | None = None
    light: BurstLight | None = None

    def key(self, index: int, config: Config) -> str:
        """Key of the sample in its shard."""
        key = patch_key(index, self.patch.patch, several=config.source.patch is not None)
        return key if self.light is None else frame_key(key, self.plans[0].place.frame)

    def pairs(self) -> Iterator[Pair]:
        """Simulate the pairs, one for each plan."""
        if self.light is not None:
            return self.light.pairs(self.plans, self.dark_folder)
        return make_pairs(crop_patch(self.srgb, self.patch), self.plans, self.patch.origin, self.dark_folder)

    def targets(self, names: Sequence[str], pair: Pair) -> Targets:
        """Compute targets by name; of a burst, those of its first frame."""
        if self.light is None:
            return targets_of(names, self.srgb, self.plans[0], self.patch, pair)
        return {LINEAR_RGB: self.light.target} if LINEAR_RGB in names and not self.plans[0].place.frame else {}


def plan_pixels(settings: PairSettings, photograph: Photograph, source: Source, sha256: str) -> PlannedImage:
    """Plan the pairs of a decoded image; ``sha256`` is the digest of the source's bytes."""
    srgb, raw = photograph.srgb, photograph.raw
    config = with_raw_sensor(settings.config, raw)
    burst, sides = burst_rule(config.source), (srgb.shape[0], srgb.shape[1])
    facts = facts_for(config, srgb, source.frames, raw, photograph.source, photograph.profile)
    facts = facts_of_burst(burst, facts)
    plans = plan_pairs(config, *source.stream_identity(sha256), facts, source.frame, settings.dark_frames)
    plans = tuple(plan.decoded(photograph.profile, photograph.pixels_xxh3) for plan in plans)
    rule, layout = patch_rule(config.source), config.output.layout
    patches = list_patches(rule, plans[0].stream_key, *sides, layout, burst=burst)
    return PlannedImage(srgb, plans, patches, facts, settings.dark_folder, config)


def targets_of(
    names: Sequence[str], srgb: Srgb, plan: Plan, patch: Patch, pair: Pair, *, of_white: bool = False
) -> Targets:
    """Compute targets by name from the complete image, noise in DN or in units of white."""
    targets: Targets = {}
    for name in names:
        pixels = crop_patch(srgb, patch)
        if name == "srgb":
            targets[name] = pixels.copy()
        elif name == LINEAR_RGB:
            targets[name] = linear_rgb(pixels, plan, patch.origin)
        else:
            frame = pair.clean if name == "variance" else pair.noisy
            std = frame_noise_std(frame, noise_columns(plan), of_white=of_white)
            targets[name] = std * std if name == "variance" else std
    return targets


def noise_columns(plan: Plan) -> dict[str, Value]:
    """Columns of a plan that scale its frames and give their noise."""
    return {
        "black_level_dn": plan.sensor.black_level_dn,
        "white_level_dn": plan.sensor.white_level_dn,
        "pattern": plan.sensor.pattern,
        "layout": plan.output.layout,
        "a_dn": plan.noise.a_dn,
        "dark_variance_dn2": dark_variance_dn2(plan),
        "prnu_std": 0.0 if plan.physics is None else plan.physics.prnu_std,
        "skipped": ";".join(plan.noise.skipped),
        "fixed_pattern_in_clean": plan.averaged,
    }
