"""Name the draws of an image's parameters by their counters in the stream ``parameters``."""

from __future__ import annotations

from enum import IntEnum

from unprocess_gen.simulation.effects import NUMBERS


class Draw(IntEnum):
    """Counters of the draws; all datasets depend on them: add new ones, never renumber.

    Numbers of effects have counters of their own (`Number.counter`): 14 to 17, and 19.
    """

    WEIGHT_0, WEIGHT_1, WEIGHT_2, WEIGHT_3 = range(4)
    CHOICE = 4
    RED, BLUE, INVERSE_RGB = range(5, 8)
    A, B = range(8, 10)
    ISO, EXPOSURE_S, TEMPERATURE_C, EXPOSURE_RATIO = range(10, 14)
    SENSOR_UNIT = 18
    LIGHT, CCT, LIGHT_DISTANCE = range(20, 23)


EFFECT_COUNTERS = tuple(number.counter for number in NUMBERS.values() if number.counter >= 0)

DRAW_COUNT = max(*EFFECT_COUNTERS, *Draw) + 1
"""Draws of an image."""

NOISE_COUNTERS = (Draw.A, Draw.B, Draw.ISO, *EFFECT_COUNTERS)
"""Counters that every noise level draws separately."""
