"""Simulate the frames of a burst: the light of one scene, moved and averaged for each frame, then its pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from unprocess_gen.core.arrays import Normalised, Srgb
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.frames import Pair, Patch
from unprocess_gen.simulation.kernels import burst as kernels
from unprocess_gen.simulation.pair import make_pairs
from unprocess_gen.simulation.plan import REFERENCE, Motion, Plan
from unprocess_gen.simulation.reference import burst as reference


class BurstLight:
    """Light of the part of a picture that a burst shows, the light of its frames, and its target.

    Parameters
    ----------
    srgb : ndarray, [H, W, 3]
        Picture: codes, or light of a linear source.
    plan : Plan
        Plan of any frame.
    motions : sequence of Motion
        Motions of the frames.
    patch : Patch
        Patch in pixels of the frames.
    crop : Patch, optional
        Part of the patch that is needed, in the same pixels; all of it by default.

    Raises
    ------
    ValueError
        If a frame shows what is outside the picture.
    """

    def __init__(
        self, srgb: Srgb, plan: Plan, motions: Sequence[Motion], patch: Patch, crop: Patch | None = None
    ) -> None:
        crop, step = crop or patch, motions[0].burst_downscale
        self.crop, self._step = crop, step
        self._arithmetic: Any = reference if plan.accuracy == REFERENCE else kernels
        self._first = crop.patch_y - patch.patch_y, crop.patch_x - patch.patch_x
        box = reference.scene_box(motions, (crop.height, crop.width), self._first)
        ends = (self._first[0] + crop.height) * step, (self._first[1] + crop.width) * step
        starts = (*map(min, box[:2], (self._first[0] * step, self._first[1] * step)),)
        stops = (*map(max, box[2:], ends),)
        origin = patch.patch_y * step, patch.patch_x * step
        top, left = (place + start for place, start in zip(origin, starts, strict=True))
        bottom, right = (place + stop for place, stop in zip(origin, stops, strict=True))
        if min(top, left) < 0 or bottom > srgb.shape[0] or right > srgb.shape[1]:
            raise ValueError(
                f"a frame of the burst shows rows {top} to {bottom - 1} and columns {left} to {right - 1}; expected "
                f"a part of the picture of {srgb.shape[1]} x {srgb.shape[0]} pixels"
            )
        self._corner, self._origin, self._plan = starts, (top, left), plan
        self._pixels = srgb[top:bottom, left:right]

    @cached_property
    def _light(self) -> Normalised:
        light: Normalised = self._arithmetic.scene_light(self._pixels, self._plan, self._origin)
        return light

    def frame(self, motion: Motion) -> Normalised:
        """Light of a frame at the resolution of the sensor, float32 [H, W, 3]."""
        shape = self.crop.height, self.crop.width
        light: Normalised = self._arithmetic.frame_light(self._light, motion, self._corner, self._first, shape)
        return light

    @property
    def target(self) -> Normalised:
        """Light that frame 0 shows, at the resolution of the picture: float32 [s H, s W, 3]."""
        step = self._step
        y, x = (first * step - corner for first, corner in zip(self._first, self._corner, strict=True))
        return np.ascontiguousarray(self._light[y : y + self.crop.height * step, x : x + self.crop.width * step])

    def pairs(self, plans: Sequence[Plan], dark_pixels: DarkPixels | None = None) -> Iterator[Pair]:
        """Simulate the pairs of one frame by `make_pairs`; all plans have the motion of the frame."""
        motion = plans[0].motion
        assert motion is not None
        return make_pairs(self.frame(motion), [plan.of_light for plan in plans], self.crop.origin, dark_pixels)
