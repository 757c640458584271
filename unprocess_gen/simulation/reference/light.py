"""Compute the white-balance gains of a camera under a light, from its matrix and the chromaticity of the light.

Only + − × ÷ and √ are used, so that gains have the same bits on every machine. The matrix is for D65. A camera's
matrix for lamps differs, so the gains under them are approximate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from unprocess_gen.simulation.reference.colour import Matrix, transform

XY = tuple[float, float]
"""CIE 1931 chromaticity."""


@dataclass(frozen=True, slots=True)
class Light:
    """Range of a light, in kelvin; its locus is that of daylight, or Planck's.

    ``offset`` is the distance from the locus in CIE 1960 uv, towards green, and ``scatter`` the largest deviation from
    it.
    """

    low_k: float
    high_k: float
    on_daylight: bool
    offset: float = 0.0
    scatter: float = 0.0

    def kelvin(self, share: float) -> float:
        """Return the colour temperature at a share of the range of its reciprocal; 0 for the highest."""
        if self.low_k == self.high_k:
            return self.low_k
        coolest, warmest = 1e6 / self.high_k, 1e6 / self.low_k
        return 1e6 / (coolest + share * (warmest - coolest))

    def xy(self, kelvin: float, side: float) -> XY:
        """Return a chromaticity of the light; ``side`` is the deviation in units of ``scatter``, -1 to 1."""
        return chromaticity(self, kelvin, self.offset + side * self.scatter)


LIGHTS: Mapping[str, Light] = {
    # Colour temperatures: those that camera makers state for their presets. Nikon (D800 manual, section White Balance):
    # daylight 5200 K, cloudy 6000 K, shade 8000 K, incandescent 3000 K; others, not checked in a manual: shade 7000 K,
    # tungsten 3200 K. The ranges extend to what the presets are meant for: sun with sky 5000 to 5800 K, overcast to
    # 6800 K, blue sky to 9000 K, household lamps from 2700 K. Scatter across the locus: 0.006 for fluorescent lamps,
    # the tolerance of ANSI C78.377, and half of it for the others (chosen).
    "daylight": Light(5000.0, 5800.0, True, 0.0, 0.003),
    "cloudy": Light(5800.0, 6800.0, True, 0.0, 0.003),
    "shade": Light(6800.0, 9000.0, True, 0.0, 0.003),
    "tungsten": Light(2700.0, 3200.0, False, 0.0, 0.003),
    # Exif, LightSource: white (3250 to 3800 K) and cool white (3800 to 4500 K) fluorescent lamps, widened by 50 K and
    # 100 K.
    "fluorescent": Light(3200.0, 4600.0, False, 0.003, 0.006),
    # CIE 15: D50 and D65 are 5003 K and 6504 K on the daylight locus, A is 2856 K on Planck's.
    "d65": Light(6504.0, 6504.0, True),
    "d50": Light(5003.0, 5003.0, True),
    "a": Light(2856.0, 2856.0, False),
}
"""The lights by name. Within a range, the reciprocal of the colour temperature is uniform."""


def daylight_xy(kelvin: float) -> XY:
    """Return the chromaticity of a phase of daylight of 4000 to 25000 K (CIE 15:2004, section 3.1).

    x_D by two cubics in 1/T, and y_D = −3 x² + 2.87 x − 0.275.
    """
    t = 1000.0 / kelvin
    if kelvin <= 7000:
        x = 0.244063 + t * (0.09911 + t * (2.9678 - t * 4.6070))
    else:
        x = 0.237040 + t * (0.24748 + t * (1.9018 - t * 2.0064))
    return x, -3.0 * x * x + 2.87 * x - 0.275


def planckian_xy(kelvin: float) -> XY:
    """Return the chromaticity of a black body of 1000 to 15000 K.

    Rational functions of Krystek (Color Research and Application 10, 1985), within 8e-5 in u and 6e-5 in v.
    """
    t = kelvin
    u = (0.860117757 + t * (1.54118254e-4 + t * 1.28641212e-7)) / (1.0 + t * (8.42420235e-4 + t * 7.08145163e-7))
    v = (0.317398726 + t * (4.22806245e-5 + t * 4.20481691e-8)) / (1.0 - t * (2.89741816e-5 - t * 1.61456053e-7))
    return _xy(u, v)


def chromaticity(light: Light, kelvin: float, distance: float) -> XY:
    """Return the chromaticity at a distance from the locus of a light, in CIE 1960 uv; above 0 towards green.

    The point is on the normal of the locus, whose direction is that between 5 K less and 5 K more.
    """
    locus = daylight_xy if light.on_daylight else planckian_xy
    (u, v), (u0, v0), (u1, v1) = (_uv(*locus(kelvin + step)) for step in (0.0, -5.0, 5.0))
    du, dv = u1 - u0, v1 - v0
    length = math.sqrt(du * du + dv * dv)
    return _xy(u + distance * dv / length, v - distance * du / length) if distance else locus(kelvin)


def camera_gains(xyz2cam: Matrix, xy: XY) -> tuple[float, float]:
    """Return the gains of red and blue that make a neutral surface gray.

    Parameters
    ----------
    xyz2cam : Matrix
        Matrix from XYZ to the camera.
    xy : XY
        Chromaticity of the light.

    Returns
    -------
    tuple of float
        Green divided by red, and green divided by blue, of the camera's response to the light.
    """
    x, y = xy
    xyz = x / y, 1.0, (1.0 - x - y) / y
    red, green, blue = transform(xyz2cam, xyz)
    if not (red > 0 and green > 0 and blue > 0):
        raise ValueError("the camera's response to this light is not positive")
    return green / red, green / blue


def _uv(x: float, y: float) -> tuple[float, float]:
    """Convert CIE 1931 xy to CIE 1960 uv."""
    scale = 12.0 * y - 2.0 * x + 3.0
    return 4.0 * x / scale, 6.0 * y / scale


def _xy(u: float, v: float) -> XY:
    """Convert CIE 1960 uv to CIE 1931 xy."""
    scale = 2.0 * u - 8.0 * v + 4.0
    return 3.0 * u / scale, 2.0 * v / scale
