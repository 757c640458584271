"""Compute the matrix and the gains of a camera at the white point of a frame, as the DNG specification describes it.

DNG Specification 1.4, chapter 6: XYZ → camera is AnalogBalance · CameraCalibration · ColorMatrix, in which the last two
are interpolated between two lights by the reciprocal of the colour temperature. Where it is silent about the
search for the white point, Adobe's DNG SDK 1.4 is followed. Only + − × ÷ are used: rows have the result.
"""

from __future__ import annotations

from dataclasses import dataclass

from unprocess_gen.simulation.reference.colour import IDENTITY, Matrix, invert, matrix, multiply, transform
from unprocess_gen.simulation.reference.light import XY, camera_gains

Neutral = tuple[float, float, float]
"""Camera values of a neutral surface."""

D50: XY = (0.3457, 0.3585)
"""Chromaticity at which the search for the white point begins (dng_color_spec::NeutralToXY)."""
MOST_ITERATIONS, CLOSE = 30, 1e-7
"""Most steps of the search, and the distance at which it ends."""

LIGHT_K = {
    **dict.fromkeys((3, 17), 2850.0), 24: 3200.0, 23: 5000.0, **dict.fromkeys((1, 4, 9, 18, 20), 5500.0),
    **dict.fromkeys((10, 19, 21), 6500.0), **dict.fromkeys((11, 22), 7500.0), 12: 6400.0, 13: 5050.0,
    **dict.fromkeys((2, 14), 4150.0), 15: 3525.0, 16: 2925.0,
}  # fmt: skip
"""Colour temperature of each EXIF LightSource (dng_camera_profile::IlluminantToTemperature)."""


@dataclass(frozen=True, slots=True)
class DngColour:
    """Colour tags of a DNG: ColorMatrix1, and 2 if there is one, and CameraCalibration1 and 2.

    ``lights_k`` are the colour temperatures of the CalibrationIlluminants, 0 if unknown; ``balance`` is AnalogBalance,
    ``neutral`` AsShotNeutral, ``white_xy`` AsShotWhiteXY. ``has_third``: there is a ColorMatrix3 (DNG 1.6), which is
    not used.
    """

    matrices: tuple[Matrix, ...]
    lights_k: tuple[float, ...]
    calibrations: tuple[Matrix, ...] = (IDENTITY, IDENTITY)
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    neutral: Neutral | None = None
    white_xy: XY | None = None
    has_third: bool = False

    def matrix_at(self, white: XY) -> Matrix:
        """Matrix from XYZ to the camera at a white point; the first one if only one light is known."""
        if len(self.matrices) == 1 or not all(self.lights_k) or self.lights_k[0] == self.lights_k[1]:
            mixed, calibration = self.matrices[0], self.calibrations[0]
        else:
            low, high = sorted(range(2), key=lambda n: self.lights_k[n])
            mired, warm, cold = (1 / kelvin for kelvin in (temperature(white), self.lights_k[low], self.lights_k[high]))
            share = min(max((mired - cold) / (warm - cold), 0.0), 1.0)
            mixed, calibration = (
                matrix([share * a + (1 - share) * b for a, b in zip(pair[low], pair[high], strict=True)])
                for pair in (self.matrices, self.calibrations)
            )
        calibrated = multiply(calibration, mixed)
        return matrix([self.balance[place // 3] * entry for place, entry in enumerate(calibrated)])

    def white(self) -> XY:
        """White point of the frame: AsShotWhiteXY, else from AsShotNeutral, else D50."""
        if self.white_xy is not None or self.neutral is None:
            return self.white_xy or D50
        last = before = D50
        for _ in range(MOST_ITERATIONS):
            before, last = last, _chromaticity(transform(invert(self.matrix_at(last)), self.neutral))
            if abs(last[0] - before[0]) + abs(last[1] - before[1]) < CLOSE:
                return last
        return (last[0] + before[0]) / 2, (last[1] + before[1]) / 2

    def gains(self) -> tuple[float, float] | None:
        """Gains of red and blue that make the white point gray; None if no tag states it."""
        if self.neutral is not None:
            red, green, blue = self.neutral
            return green / red, green / blue
        return None if self.white_xy is None else camera_gains(self.matrix_at(self.white_xy), self.white_xy)


def temperature(white: XY) -> float:
    """Correlated colour temperature of a chromaticity, kelvin, between 1667 and 100,000 (McCamy 1992)."""
    n = (white[0] - 0.3320) / (0.1858 - white[1])
    return min(max(((449.0 * n + 3525.0) * n + 6823.3) * n + 5520.33, 1667.0), 100_000.0)


def _chromaticity(xyz: Neutral) -> XY:
    total = xyz[0] + xyz[1] + xyz[2]
    if not (total > 0 and xyz[1] > 0):
        raise ValueError("the white point has no chromaticity")
    return xyz[0] / total, xyz[1] / total
