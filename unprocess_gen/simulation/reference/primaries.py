"""Matrices from the primaries of RGB colour spaces to those of sRGB, in fractions, rounded once.

White becomes white: colours are adapted to `D50` by Bradford's matrix, as in ICC profiles (relative colorimetric).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from fractions import Fraction

from unprocess_gen.simulation.plan import CameraPlan, SourcePlan
from unprocess_gen.simulation.reference.colour import (
    IDENTITY,
    RGB2XYZ,
    Matrix,
    exact_inverse,
    from_primaries,
    invert,
    matrix,
    multiply,
)

Exact = list[Fraction]
"""Nine entries of a matrix, row by row, or three of a vector."""

D65 = 0.3127, 0.3290
"""Chromaticities x, y of the white of sRGB, Display P3 and BT.2020."""

PRIMARIES: dict[str, tuple[float, ...]] = {
    "srgb": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *D65),  # IEC 61966-2-1
    "p3": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *D65),  # SMPTE EG 432-1
    "rec2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65),  # ITU-R BT.2020
    "acescg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),  # AP1, S-2014-004
}
"""Chromaticities x, y of red, green, blue and white of colour spaces."""

D50 = [Fraction(9642, 10000), Fraction(1), Fraction(8249, 10000)]
"""XYZ of the white of ICC profiles (ISO 15076-1)."""

BRADFORD = [Fraction(n, 10000) for n in (8951, 2664, -1614, -7502, 17135, 367, 389, -685, 10296)]
"""Matrix from XYZ to the cone responses that are scaled to adapt colours to another white (ISO 15076-1, annex E)."""


def primaries2xyz(chromaticities: Sequence[float | Fraction]) -> Exact:
    """Compute the matrix from linear RGB to XYZ with the white `D50`; its columns are the colorants of ICC profiles.

    Parameters
    ----------
    chromaticities : sequence of float or Fraction
        x, y of red, green, blue and white.

    Returns
    -------
    list of nine fractions
        The matrix, row by row.

    Raises
    ------
    ValueError
        If the primaries lie on a line, or white is no light.
    """
    x, y = ([Fraction(number) for number in chromaticities[start::2]] for start in (0, 1))
    red_x, green_x, blue_x, white_x = x
    red_y, green_y, blue_y, white_y = y
    if white_y <= 0:
        raise ValueError("white has no luminance; expected y above 0")
    white = [white_x / white_y, Fraction(1), (1 - white_x - white_y) / white_y]
    sums = [1 - red_x - red_y, 1 - green_x - green_y, 1 - blue_x - blue_y]
    primaries = [red_x, green_x, blue_x, red_y, green_y, blue_y, *sums]
    amounts = _product(exact_inverse(primaries), white)
    responses = _product(BRADFORD, white)
    if min(responses) <= 0:
        raise ValueError("white is no light; expected positive responses of the cones")
    gains = [new / old for new, old in zip(_product(BRADFORD, D50), responses, strict=True)]
    adapted = [gains[n // 3] * entry for n, entry in enumerate(BRADFORD)]
    return _product(exact_inverse(BRADFORD), _product(adapted, [e * amounts[n % 3] for n, e in enumerate(primaries)]))


@functools.cache
def _xyz2srgb() -> Exact:
    return exact_inverse(primaries2xyz(PRIMARIES["srgb"]))


def xyz2srgb(colorants: Sequence[float | Fraction]) -> Matrix:
    """Compute the matrix from linear RGB to linear sRGB, given its matrix to XYZ with the white `D50`.

    Parameters
    ----------
    colorants : sequence of float or Fraction
        Matrix to XYZ, nine numbers row by row.

    Returns
    -------
    Matrix
        The matrix to linear sRGB, each entry rounded once.
    """
    return matrix([float(entry) for entry in _product(_xyz2srgb(), [Fraction(entry) for entry in colorants])])


def primaries2srgb(chromaticities: Sequence[float | Fraction]) -> Matrix:
    """Compute the matrix from linear RGB to linear sRGB; arguments and errors are those of `primaries2xyz`."""
    return xyz2srgb(primaries2xyz(chromaticities))


CAMERA, XYZ = "camera", "xyz"
"""Primaries of linear sources without an RGB space: sensor RGB; XYZ with white D65, as for `CAMERAS`."""


@functools.lru_cache(maxsize=1024)
def to_camera(rgb2cam: Matrix, primaries: str) -> Matrix:
    """Compute the matrix from the linear RGB of a linear source to the camera.

    Parameters
    ----------
    rgb2cam : Matrix
        Matrix from linear sRGB to the camera.
    primaries : str
        `XYZ`, a name of `PRIMARIES`, or the eight numbers of `primaries2xyz`, separated by ``;``.

    Returns
    -------
    Matrix
        The product; its rows sum to 1, so that white stays white, except from XYZ.
    """
    if primaries == XYZ:
        return multiply(rgb2cam, invert(RGB2XYZ))
    return from_primaries(rgb2cam, None if primaries == "srgb" else _to_srgb(primaries))


@functools.lru_cache(maxsize=64)
def _to_srgb(primaries: str) -> Matrix:
    return primaries2srgb(PRIMARIES.get(primaries) or [*map(float, primaries.split(";"))])


def light_colours(source: SourcePlan, camera: CameraPlan) -> tuple[Matrix, tuple[float, float, float]]:
    """Choose the matrix from the linear RGB of a source to the camera, and the inverse gains of the channels.

    Parameters
    ----------
    source : SourcePlan
        Its ``primaries``, if it is a linear source; sensor RGB (`CAMERA`) needs neither matrix nor gains. The
        ``profile`` of a photograph.
    camera : CameraPlan
        Matrix from linear sRGB, and gains.

    Returns
    -------
    Matrix, tuple of three floats
        The matrix, and factors of red, green and blue.
    """
    if source.primaries == CAMERA:
        return IDENTITY, (1.0, 1.0, 1.0)
    if source.is_linear:
        return to_camera(camera.rgb2cam, source.primaries), camera.inverse_gains
    return from_primaries(camera.rgb2cam, source.profile.to_srgb), camera.inverse_gains


def _product(left: Exact, right: Exact) -> Exact:
    """Multiply a matrix by a matrix, or by a vector."""
    step = len(right) // 3
    return [
        left[row] * right[column] + left[row + 1] * right[step + column] + left[row + 2] * right[2 * step + column]
        for row in (0, 3, 6)
        for column in range(step)
    ]
