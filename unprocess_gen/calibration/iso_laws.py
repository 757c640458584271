"""Write numbers of several ISOs as functions of ISO: laws where they fit, tables where they do not, in branches.

The variance of read noise in one gain mode, c0 + c1·ISO + c2·ISO², is convex. A value below the line through the two
ISOs before it therefore means that the sensor has switched its conversion gain: a new branch begins.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.calibration.gain import SIGNIFICANT, Estimate
from unprocess_gen.statistics.scores import NORMAL_95

MODE_RATIO = 0.85
"""Ratio of read noise to the least read noise of a gain mode, below which it belongs to another mode."""
CLOSE_RESIDUAL = 1e-3
"""Relative residual up to which a law is good enough, whatever the standard errors."""
DIGITS = 7


class Precision(NamedTuple):
    """Relative residual up to which a law is good enough, and digits of its numbers."""

    close: float = CLOSE_RESIDUAL
    digits: int = DIGITS


MEASURED = Precision()


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


def joined_branches(
    isos: Sequence[float], gains: Sequence[Estimate], places: Iterable[list[int]], precision: Precision = MEASURED
) -> list[list[int]]:
    """Return the places of the ISOs of each branch: a mode whose gains are on one line, or else pairs of neighbours."""

    def is_line(chosen: Sequence[int]) -> bool:
        return gain_law([isos[place] for place in chosen], [gains[place] for place in chosen], precision) is not None

    result: list[list[int]] = []
    for mode in places:
        pairs = [mode] if is_line(mode) else [[*pair] for pair in itertools.pairwise(mode) if is_line(pair)]
        result += sorted([*pairs, *([place] for place in mode if not any(place in pair for pair in pairs))])
    return result


def gain_law(isos: Sequence[float], gains: Sequence[Estimate], precision: Precision = MEASURED) -> Any:
    """Return ``dn_per_e`` as a number or as ``per_iso``; None if no line fits."""
    if len(isos) == 1:
        return rounded(gains[0].value, precision.digits)
    for powers in ((1,), (0, 1)):
        errors = [gain.error for gain in gains]
        coefficients = _fitted(isos, [gain.value for gain in gains], errors, powers, precision.close)
        if coefficients is not None:
            return ["per_iso", *(rounded(number, precision.digits) for number in reversed(coefficients))]
    return None


def std_law(isos: Sequence[float], stds: Sequence[Estimate], precision: Precision = MEASURED) -> Any:
    """Return a standard deviation as a number, as ``root``, or as a table ``by_iso``."""
    close, digits = precision
    if len(isos) == 1 or not any(std.value for std in stds):
        return rounded(stds[0].value, digits)
    values = [std.value for std in stds]
    errors = [(std.high**2 - std.low**2) / 2 / NORMAL_95 for std in stds]
    for powers in ((0,), (0, 2), (0, 1, 2)):
        coefficients = _fitted(isos, [value**2 for value in values], errors, powers, close)
        if coefficients is not None:
            filled = dict(zip(powers, coefficients, strict=True))
            return ["root", *(rounded(filled.get(power, 0.0), digits) for power in range(max(powers) + 1))]
    return _table(isos, [rounded(value or 1e-3 * max(values), digits) for value in values])


def shape_law(isos: Sequence[float], shapes: Sequence[float]) -> Any:
    """Return shapes as a number or as a table ``by_iso``."""
    if len(isos) == 1:
        return round(shapes[0], 4)
    return _table(isos, [round(shape, 4) for shape in shapes])


def _table(isos: Sequence[float], values: Sequence[float]) -> list[Any]:
    return ["by_iso", *itertools.chain(*zip(isos, values, strict=True))]


def black_law(isos: Sequence[float], blacks: Sequence[Sequence[float]], by_colour: bool) -> Any:
    """Return black errors (R, G1, B, G2, or one) as numbers, or as a table by equal parts of ln ISO."""
    words = ["by_colour"] if by_colour else []
    rows = [[round(value, 4) for value in black] for black in blacks]
    if len(isos) == 1:
        return [*words, *rows[0]] if by_colour else rows[0][0]
    logs = np.log(np.array(isos) / isos[0]) / math.log(isos[-1] / isos[0])
    for parts in range(len(isos), 257):
        places = np.minimum((logs * parts + 1e-9).astype(int), parts - 1)
        if len(set(places.tolist())) == len(isos):
            break
    middles = (np.arange(parts) + 0.5) / parts
    nearest = [int(np.argmin(np.abs(logs - middle))) for middle in middles]
    for iso, place in enumerate(places):
        nearest[place] = iso
    fours = [rows[iso] if by_colour else rows[iso][:1] * 4 for iso in nearest]
    return [*words, "by_log_iso", *fours]


def rounded(value: float, digits: int = DIGITS) -> float:
    """Return a number with the digits that a profile has."""
    return float(f"{value:.{digits}g}")


def _fitted(
    isos: Sequence[float], values: Sequence[float], errors: Sequence[float], powers: Sequence[int], close: float
) -> Any:
    """Return coefficients of 0 or more of a polynomial in ISO; None if it misses a value."""
    from scipy.optimize import nnls

    if len(powers) > len(isos):
        return None
    design = np.array([[float(iso) ** power for power in powers] for iso in isos])
    weights = 1 / np.maximum(errors, 1e-9 * max(values))
    scale = design.max(axis=0)
    solution, _ = nnls(design / scale * weights[:, None], np.array(values) * weights)
    coefficients = solution / scale
    residual = np.abs(design @ coefficients - values)
    allowed = np.maximum(SIGNIFICANT * np.array(errors), close * np.array(values))
    return coefficients.tolist() if np.all(residual <= allowed) else None
