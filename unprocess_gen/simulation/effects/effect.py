"""Define what each effect of the sensor states: its numbers, formulas, streams, prediction and slots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import Words, words
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.numbers import Number
from unprocess_gen.simulation.plan import NUMBERS, Physics, Plan
from unprocess_gen.simulation.slots import FrameWords

Shape = tuple[int, int]
SlotValues = dict[str, Any]
"""What an effect fills, by the names of the members of `slots.Slots` and `slots.Patterns`."""


def frame_words(plan: Plan, stream: int, shape: tuple[int, ...], origin: Shape = (0, 0)) -> Words:
    """Return the random words of a plan's frame, level and draw, [H, W]."""
    place = plan.place
    numbers = {"frame": place.frame_word, "level": place.level, "draw": place.draw}
    return words(plan.stream_key, stream, (shape[0], shape[1]), origin=origin, **numbers)


@dataclass(frozen=True)
class Crop:
    """Crop of a frame that is simulated.

    Attributes
    ----------
    plan : Plan
        Parameters of the pair.
    physics : Physics
        Numbers of its physical profile.
    shape, origin : (int, int)
        Height and width, and row and column of the first pixel in the full frame.
    dark_pixels : DarkPixels or None
        Access to the dark frame that the plan names.
    relative_gain : ndarray of float64, [H, W]
        System gain of each site relative to ``dn_per_e``.
    """

    plan: Plan
    physics: Physics
    shape: Shape
    origin: Shape = (0, 0)
    dark_pixels: DarkPixels | None = None
    relative_gain: Float | float = 1.0

    def frame_words(self, stream: int, shape: Shape | None = None, origin: Shape | None = None) -> Words:
        """Return the random words of a frame, [H, W]; of the crop, or of another one."""
        return frame_words(self.plan, stream, shape or self.shape, self.origin if origin is None else origin)

    def body_words(self, stream: int, shape: Shape | None = None, origin: Shape | None = None, draw: int = 0) -> Words:
        """Return the random words of a fixed pattern of the camera body, [H, W]; of the crop, or of another one."""
        origin = self.origin if origin is None else origin
        return words(self.physics.body_key, stream, shape or self.shape, origin=origin, draw=draw)

    def by_site(self, sites: Sequence[float]) -> Float:
        """Repeat the values of the sites (0, 0), (0, 1), (1, 0), (1, 1) of the 2x2 tile, [H, W]."""
        tile = np.array(sites).reshape(2, 2)
        y, x = (np.arange(start, start + count) % 2 for start, count in zip(self.origin, self.shape, strict=True))
        return np.asarray(tile[y[:, None], x[None, :]])


def slot_words(plan: Plan, stream: int) -> FrameWords:
    """Return the random words of a plan's frame, level and draw for a slot."""
    return FrameWords(plan.stream_key, stream, plan.place.level, plan.place.draw, plan.place.frame_word)


class Effect:
    """Effect of the sensor; a method that an effect does not define changes nothing.

    Attributes
    ----------
    name : str
        Name in settings and rows.
    stream : int
        Number of its random stream, of an effect that has one.
    meaning : str
        One phrase for users.
    numbers : tuple of str
        Fields of `plan.Physics` that hold its numbers.
    keys : mapping of str to Number
        Keys of the profile from which no field of `Physics` follows directly.
    heat : bool
        Whether the numbers depend on the temperature.
    has_switch : bool
        Whether ``effects.<name>`` switches it; otherwise other settings decide.
    is_fixed : bool
        Whether it is the same in all frames of a camera body. Clean frames may contain it; then only the rounding of
        the clean frame masks it.
    is_before_well : bool
        Whether it acts before the full well limits the electrons of a pixel.
    is_in_dark_frames : bool
        Whether dark frames contain it.
    in_both_frames : bool
        Whether the clean frame has it too, so that no noise hides it.
    has_outliers : bool
        Whether it changes few pixels, but these visibly.
    masks : bool
        Whether it is random noise of single pixels, which masks other effects.
    """

    name: ClassVar[str]
    stream: ClassVar[int]
    meaning: ClassVar[str]
    numbers: ClassVar[tuple[str, ...]] = ()
    keys: ClassVar[Mapping[str, Number]] = {}
    heat: ClassVar[bool] = False
    has_switch: ClassVar[bool] = True
    is_fixed: ClassVar[bool] = False
    is_before_well: ClassVar[bool] = False
    is_in_dark_frames: ClassVar[bool] = False
    in_both_frames: ClassVar[bool] = False
    has_outliers: ClassVar[bool] = False
    masks: ClassVar[bool] = False

    @property
    def declared(self) -> dict[str, Number]:
        """Numbers by the names of their fields."""
        return {name: NUMBERS[name] for name in self.numbers}

    def light_factor(self, crop: Crop) -> Float | None:
        """Return the factor on the light of the clean frame, [H, W] of float32 values; None if it is 1."""

    def plane_gains(self, plan: Plan) -> tuple[float, ...] | None:
        """Return the system gain of the four sites of the 2x2 tile relative to ``dn_per_e``; None if it is 1."""

    def electrons(self, electrons: Float, crop: Crop) -> Float:
        """Return the electrons of each site after the effect, [H, W]."""
        return electrons

    def noise_dn(self, crop: Crop) -> Float | None:
        """Return independent noise of each site, [H, W] DN."""

    def row_offset_dn(self, crop: Crop) -> Float | float:
        """Return the offset of each row, [H, 1] DN."""
        return 0.0

    def column_offset_dn(self, crop: Crop) -> Float | float:
        """Return the offset of each column, [1, W] DN."""
        return 0.0

    def plane_offset_dn(self, crop: Crop) -> Float | float:
        """Return the offset of the colour plane of each site, [H, W] DN."""
        return 0.0

    def site_offset_dn(self, crop: Crop) -> Float | NDArray[np.float32] | None:
        """Return other offsets by site, [H, W] DN."""

    def output_dn(self, noisy_dn: Float, crop: Crop) -> Float:
        """Return the values that the converter sees, [H, W] DN."""
        return noisy_dn

    def mean_electrons(self, crop: Crop) -> Float | float | None:
        """Return the electrons that the effect adds to the average of many frames."""

    def slots(self, plan: Plan) -> SlotValues:
        """Return the slots that the effect fills, by the names of the members of `slots.Slots` and `slots.Patterns`."""
        return {}

    def variance(self, frame: FrameFacts, level_dn: float) -> float:
        """Return the variance of a pixel, DN², at a signal in DN above black."""
        return 0.0

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict the contribution at a signal in DN above black, where the other noise has a variance in DN²."""
        return independent(frame, self.variance(frame, level_dn))

    def outliers(self, frame: FrameFacts, level_dn: float, masking: float) -> float:
        """Predict the fraction of pixels that the effect moves by more than one standard deviation."""
        return 0.0
