"""Generate a burst when it is read: its frames share the picture, the patch and the redrawn parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from unprocess_gen.config.interpretation import BurstRule, patch_rule
from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.pipeline.pairs import PairSettings, with_motion
from unprocess_gen.planning.plan import next_dark_frame, redraw_plans
from unprocess_gen.simulation.bursts import BurstLight
from unprocess_gen.simulation.facts import Facts
from unprocess_gen.simulation.frames import Pair, Patch
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.sources.patches import list_patches


def redrawn_burst(settings: PairSettings, plans: Sequence[Plan], facts: Facts | None, epoch: int) -> list[Plan]:
    """Draw the parameters of a burst's frames for an epoch, once for each exposure, except motion."""
    drawn = redraw_plans(settings.config, plans[0], facts, settings.dark_frames, epoch)
    return [drawn[k % len(drawn)].replace(place=plan.place, dark=plan.dark) for k, plan in enumerate(plans)]


def moved_burst(
    settings: PairSettings, rule: BurstRule, plans: Sequence[Plan], patch: Patch, picture: tuple[int, int], epoch: int
) -> tuple[tuple[Plan, ...], Patch]:
    """Draw the motion of a burst's frames, and the place of a random patch, for an epoch."""
    source, layout = settings.config.source, settings.config.output.layout
    patches = list_patches(patch_rule(source), plans[0].stream_key, *picture, layout, epoch, burst=rule)
    return with_motion(rule, plans, patches[patch.patch], epoch), patches[patch.patch]


def burst_pairs(
    settings: PairSettings, srgb: Srgb, plans: Sequence[Plan], patch: Patch, crop: Patch, epoch: int, names: Any
) -> tuple[list[tuple[Plan, Pair]], dict[str, Any]]:
    """Simulate a crop of a burst in an epoch: each frame with its plan, for rows, and the target if it is named.

    The motion of these plans is relative to the crop, whose target begins at the crop.
    """
    motions = [plan.motion for plan in plans if plan.motion]
    light = BurstLight(srgb, plans[0], motions, patch, crop)
    frames = []
    for plan in plans:
        if plan.dark and settings.dark_frames is not None:
            plan = next_dark_frame(plan, settings.dark_frames, epoch)
        (pair,) = light.pairs([plan.replace(epoch=epoch)], settings.dark_folder)
        frames.append((_of_crop(plan, patch, crop), pair))
    return frames, {LINEAR_RGB: light.target} if LINEAR_RGB in names else {}


def _of_crop(plan: Plan, patch: Patch, crop: Patch) -> Plan:
    """Plan whose motion is relative to a crop of its patch: b becomes A c + b - c, with c the corner of the crop."""
    motion = plan.motion
    assert motion is not None
    y, x = ((of_crop - of_patch) * motion.burst_downscale
            for of_crop, of_patch in zip(crop.origin, patch.origin, strict=True))  # fmt: skip
    if not (y or x):
        return plan
    row, column = motion.position(y, x)
    return plan.replace(motion_y=row - y, motion_x=column - x)
