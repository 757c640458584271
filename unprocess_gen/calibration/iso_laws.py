"""Write numbers of several ISOs as tables, in branches: one for each gain mode of the sensor.

The variance of read noise in one gain mode, c0 + c1·ISO + c2·ISO², is convex. A value below the line through the two
ISOs before it therefore means that the sensor has switched its conversion gain: a new branch begins.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

from unprocess_gen.calibration.gain import SIGNIFICANT, Estimate

MODE_RATIO = 0.85
"""Ratio of read noise to the least read noise of a gain mode, below which it belongs to another mode."""
LEAST = 1e-3
"""Least standard deviation of a table relative to its largest, because 0 has no logarithm."""
DIGITS = 7


def modes(isos: Sequence[float], reads: Sequence[Estimate]) -> list[list[int]]:
    """Return the places of the ISOs of each gain mode."""
    result = [[0]]
    for place in range(1, len(isos)):
        mode = result[-1]
        last = reads[mode[-1]].value ** 2
        slope = 0.0
        if len(mode) > 1:
            slope = (last - reads[mode[-2]].value ** 2) / (isos[mode[-1]] - isos[mode[-2]])
        least = math.sqrt(max(last + max(slope, 0.0) * (isos[place] - isos[mode[-1]]), 0.0))
        read = reads[place]
        margin = MODE_RATIO if len(mode) > 1 else 1.0
        if read.value + SIGNIFICANT * math.hypot(read.error, reads[mode[-1]].error) < margin * least:
            result.append([place])
        else:
            mode.append(place)
    return result


def table(isos: Sequence[float], values: Sequence[float], digits: int = DIGITS) -> Any:
    """Return gains, standard deviations or shapes of a branch as one number, or as a table ``by_iso``."""
    if len(isos) == 1 or not any(values):
        return rounded(values[0], digits)
    written = [rounded(value or LEAST * max(values), digits) for value in values]
    return ["by_iso", *itertools.chain(*zip(isos, written, strict=True))]


def black_law(isos: Sequence[float], blacks: Sequence[Sequence[float]]) -> Any:
    """Return black errors (R, G1, B, G2, or one) as numbers, or as a table ``by_iso``."""
    values = [[round(value, 4) for value in black] if len(black) > 1 else round(black[0], 4) for black in blacks]
    return values[0] if len(isos) == 1 else ["by_iso", *itertools.chain(*zip(isos, values, strict=True))]


def rounded(value: float, digits: int = DIGITS) -> float:
    """Return a number with the digits that a profile has."""
    return float(f"{value:.{digits}g}")
