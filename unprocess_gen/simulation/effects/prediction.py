"""Predict what an effect contributes to the statistics of a frame: shared mathematics of the effects' predictions.

A contribution has a random part and an offset common to all pixels. Both are predicted in every statistic: single
pixels and row, column and colour-plane means, of one frame and of the mean over the frames of a clip. The mean over a
clip keeps fixed patterns and averages out temporal noise. Derivations: ``docs/design/effect_selection.md``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from unprocess_gen.simulation.facts import Facts

if TYPE_CHECKING:
    from unprocess_gen.simulation.plan import Physics

STATISTICS = (
    *("pixel", "row mean", "column mean", "plane mean"),
    *("clip's pixel", "clip's row", "clip's column", "clip's plane"),
)
"""Statistics of one frame, then the same of the mean over the frames of a clip. A photograph is a clip of one frame.
Rows record these names."""

MEAN_ABS_NORMAL = 0.7978845608028654
"""Mean absolute value of a standard normal deviate, √(2/π)."""

PerStatistic = Sequence[float]
"""One value for each of `STATISTICS`, or for the first half of them if there is one frame."""


class Contribution(NamedTuple):
    """Contribution of an effect: a variance in each statistic, DN², and an offset of all pixels, DN."""

    variances: PerStatistic
    offset_dn: float = 0.0


class FrameFacts:
    """Facts of a frame on which predictions depend; levels are DN, that of the converter above black.

    A photograph is a clip of one frame, so only the first half of `STATISTICS` is computed for it. ``per_frame`` and
    ``counts`` are the numbers of sites that each statistic is a mean of, in one frame and in all frames of the clip.
    """

    def __init__(self, physics: Physics, facts: Facts, black_level_dn: float, converter_dn: float = math.inf) -> None:
        self.physics, self.facts, self.black_level_dn = physics, facts, black_level_dn
        self.converter_dn = converter_dn
        width, height, frames = facts.width, facts.height, float(facts.frames)
        sites = 1.0, float(width), float(height), float((width + 1) // 2 * ((height + 1) // 2))
        self.per_frame: PerStatistic = sites if facts.frames == 1 else (*sites, *sites)
        self.counts: PerStatistic = (*sites, *(count * frames for count in self.per_frame[4:]))


def independent(
    frame: FrameFacts, variance: float, offset_dn: float = 0.0, fixed_variance: float = 0.0
) -> Contribution:
    """Predict an effect that is independent from pixel to pixel.

    ``variance`` is that of the part that is new in every frame, ``fixed_variance`` of the part that all share, DN².
    """
    if fixed_variance:
        pairs = zip(frame.counts, frame.per_frame, strict=True)
        variances = [variance / count + fixed_variance / sites for count, sites in pairs]
    elif variance:
        variances = [variance / count for count in frame.counts]
    else:
        variances = [0.0] * len(frame.counts)
    return Contribution(variances, offset_dn)


def rare_pixels(frame: FrameFacts, share: float, mean_dn: float, mean_square: float, masking: float) -> Contribution:
    """Predict rare pixels up to one standard deviation of the ``masking`` variance; larger ones count as outliers."""
    fixed_variance = share * min(mean_square, masking)
    return independent(frame, 0.0, share * min(mean_dn, math.sqrt(masking)), fixed_variance)


def offsets_of_columns(frame: FrameFacts, std_dn: float) -> tuple[float, float, float, float]:
    """Return the variances of independent offsets of columns in the statistics of one frame, DN²."""
    variance, width = std_dn * std_dn, frame.facts.width
    return variance, variance / width, variance, variance / max(width // 2, 1)


def new_in_every_frame(frame: FrameFacts, variances: tuple[float, float, float, float]) -> Contribution:
    """Predict temporal offsets from their variances in the statistics of one frame."""
    frames = frame.facts.frames
    return Contribution(variances if frames == 1 else (*variances, *(variance / frames for variance in variances)))


def fixed_in_clip(frame: FrameFacts, variances: tuple[float, float, float, float]) -> Contribution:
    """Predict fixed offsets from their variances in the statistics of one frame."""
    return Contribution(variances if frame.facts.frames == 1 else (*variances, *variances))
