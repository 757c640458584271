"""Lens shading: less light towards the corners, in the clean and the noisy frame.

A polynomial in r², as in the opcode FixVignetteRadial of DNG 1.4 and in Lensfun's model "pa"; those correct the shading
or describe it with the centre at 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.simulation.effects.effect import Effect, Shape, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import RadialFactor

PLACES = 64
"""Squares of the distance from the centre at which lens shading is predicted."""

Coefficients = tuple[float, float, float]


def illumination_at(square: Float, coefficients: Coefficients) -> Float:
    """Return the relative illumination at a squared distance from the centre, in units of the corner's.

    Parameters
    ----------
    square : ndarray of float64
        r², 0 in the centre and 1 in the corners.
    coefficients : tuple of three floats
        Coefficients of r², r⁴ and r⁶.

    Returns
    -------
    ndarray of float64
        1 in the centre, same shape.
    """
    first, second, third = coefficients
    return 1 + square * (first + square * (second + square * third))


def illumination(
    coefficients: Coefficients, frame_size: Shape, shape: Shape, origin: Shape = (0, 0)
) -> NDArray[np.float32]:
    """Return the relative illumination of each pixel of a crop at ``origin`` of the full frame, [H, W], at most 1."""
    # Twice the distance from the centre is an integer, so that its square is exact.
    rows, columns = (
        2 * (np.arange(start, start + count) - 0.0) - (full - 1)
        for start, count, full in zip(origin, shape, frame_size, strict=True)
    )
    corner = float(sum((full - 1) ** 2 for full in frame_size)) or 1.0
    square = (rows * rows)[:, None] + (columns * columns)[None, :]
    return np.asarray(illumination_at(square / corner, coefficients)).astype(np.float32)


class LensShading(Effect):
    """Relative illumination of each pixel."""

    name = "lens_shading"
    meaning = "less light towards the corners, in the clean and the noisy frame"
    numbers = ("lens_shading",)
    in_both_frames = True

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict the light that the darkest place loses."""
        places = illumination_at(np.arange(PLACES + 1) / PLACES, frame.physics.lens_shading)
        return independent(frame, 0.0, level_dn * float(1 - places.min()))

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the factor on the light."""
        return {"light": RadialFactor(plan.numbers.lens_shading, plan.numbers.frame_size)}
