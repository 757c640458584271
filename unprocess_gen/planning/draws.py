"""Name the draws of an image's parameters by their counters in the stream ``parameters``."""

from __future__ import annotations

from enum import IntEnum, unique


@unique
class Draw(IntEnum):
    """Counters of the draws; all datasets depend on them: add new ones, never renumber.

    The scatter of a camera body has a stream of its own (`Number.counter`).
    """

    WEIGHT_0, WEIGHT_1, WEIGHT_2, WEIGHT_3 = range(4)
    CHOICE = 4
    RED, BLUE, INVERSE_RGB = range(5, 8)
    A, B = range(8, 10)
    ISO, EXPOSURE_S, TEMPERATURE_C, EXPOSURE_RATIO = range(10, 14)
    SENSOR_UNIT = 18
    LIGHT, CCT, LIGHT_DISTANCE = range(20, 23)
    EV = 23


DRAW_COUNT = max(Draw) + 1
"""Draws of an image."""

NOISE_COUNTERS = (Draw.A, Draw.B, Draw.ISO)
"""Counters that every noise level draws separately."""
