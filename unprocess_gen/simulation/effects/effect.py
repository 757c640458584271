"""Define what each effect of the sensor states: its numbers, streams, prediction and slots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent
from unprocess_gen.simulation.numbers import Number
from unprocess_gen.simulation.plan import NUMBERS, Plan
from unprocess_gen.simulation.slots import FrameWords

Shape = tuple[int, int]
SlotValues = dict[str, Any]
"""What an effect fills, by the names of the members of `slots.Slots` and `slots.Patterns`."""


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

    def slots(self, plan: Plan) -> SlotValues:
        """Return the slots that the effect fills, by the names of the members of `slots.Slots` and `slots.Patterns`."""
        return {}

    def variance(self, frame: FrameFacts, level_dn: float) -> float:
        """Return the variance of a pixel, DN², at a signal in DN above black."""
        return 0.0

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict the contribution at a signal in DN above black, where the other noise has a variance in DN²."""
        return independent(frame, self.variance(frame, level_dn))

    def reason_to_keep(self, frame: FrameFacts, on: frozenset[str]) -> str:
        """Return why the effects ``on`` need this one, however small it is; empty if they do not."""
        return ""

    def outliers(self, frame: FrameFacts, level_dn: float, masking: float) -> float:
        """Predict the fraction of pixels that the effect moves by more than one standard deviation."""
        return 0.0
