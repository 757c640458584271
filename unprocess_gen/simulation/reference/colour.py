"""Camera matrices with their sources, and the linear RGB → camera matrix of a mix of cameras.

Matrices are tuples of nine Python floats, computed in a fixed order of operations, because the matrix products of
libraries round differently between machines. Inverses are computed with exact fractions and rounded once.

White must stay exactly white in any order of additions. `normalise_rows` therefore rounds the rows of ``rgb2cam`` to a
power-of-two grid on which they sum to exactly 1. This moves an entry by at most two units of 2**-52, relative to the
largest entry. Without it, 24 % of white pixels differ from 1 by one rounding error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import repeat
from operator import add, mul

Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""Nine entries, row by row."""

CAMERAS: dict[str, Matrix] = {
    # XYZ (D65) -> camera, in the order of the manifest's weights. Values: Brooks et al. 2019, unprocess.py,
    # random_ccm(). Names: LibRaw, colordata.cpp. The first matrix is not in LibRaw. Its entries are multiples of 1/128,
    # as in an Android DNG, so by elimination it is the Nexus 6P.
    "nexus_6p": (1.0234, -0.2969, -0.2266, -0.5625, 1.6328, -0.0469, -0.0703, 0.2188, 0.6406),
    "sony_a7r": (0.4913, -0.0541, -0.0202, -0.613, 1.3513, 0.2906, -0.1564, 0.2151, 0.7183),  # LibRaw: ILCE-7R
    "olympus_em10": (0.838, -0.263, -0.0639, -0.2887, 1.0725, 0.2496, -0.0627, 0.1427, 0.5438),  # LibRaw: E-M10
    # LibRaw: DSC-RX100M (II to V); the first RX100 differs. The Darmstadt dataset used the RX100 IV.
    "sony_rx100": (0.6596, -0.2079, -0.0562, -0.4782, 1.3016, 0.1933, -0.097, 0.1581, 0.5181),
}

RGB2XYZ: Matrix = (
    # Linear sRGB -> XYZ (D65), http://www.brucelindbloom.com/index.html?Eqn_RGB_XYZ_Matrix.html
    *(0.4124564, 0.3575761, 0.1804375),
    *(0.2126729, 0.7151522, 0.0721750),
    *(0.0193339, 0.1191920, 0.9503041),
)

IDENTITY: Matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

MAX_CONDITION = 1e10
"""Largest accepted condition number; a larger one loses more than ten decimal digits when inverted (own choice)."""


def matrix(numbers: Sequence[float]) -> Matrix:
    """Convert nine numbers to a matrix.

    Parameters
    ----------
    numbers : sequence of float
        Entries, row by row.

    Returns
    -------
    Matrix
        The entries as floats.

    Raises
    ------
    ValueError
        If there are not nine numbers.
    """
    if len(numbers) != 9:
        raise ValueError(f"a camera matrix has nine numbers, got {len(numbers)}")
    a, b, c, d, e, f, g, h, i = map(float, numbers)
    return a, b, c, d, e, f, g, h, i


def multiply(left: Matrix, right: Matrix) -> Matrix:
    """Multiply two matrices; each entry is summed from left to right.

    Parameters
    ----------
    left, right : Matrix
        Factors.

    Returns
    -------
    Matrix
        The product.
    """
    a, b, c, d, e, f, g, h, i = left
    r, s, t, u, v, w, x, y, z = right
    return (
        *(a * r + b * u + c * x, a * s + b * v + c * y, a * t + b * w + c * z),
        *(d * r + e * u + f * x, d * s + e * v + f * y, d * t + e * w + f * z),
        *(g * r + h * u + i * x, g * s + h * v + i * y, g * t + h * w + i * z),
    )


def transform(entries: Matrix, vector: Sequence[float]) -> tuple[float, float, float]:
    """Multiply a matrix by a vector; each sum is computed from left to right.

    Parameters
    ----------
    entries : Matrix
        The matrix.
    vector : sequence of float
        Three values.

    Returns
    -------
    tuple of three floats
        The product.
    """
    x, y, z = vector
    first, second, third = (entries[row] * x + entries[row + 1] * y + entries[row + 2] * z for row in (0, 3, 6))
    return first, second, third


def mix(matrices: Sequence[Matrix], weights: Sequence[float]) -> Matrix:
    """Return the weighted sum of XYZ → camera matrices, added in order; Brooks et al. mix before they normalise."""
    mixed = [0.0] * 9
    for weight, entries in zip(weights, matrices, strict=True):
        mixed = [*map(add, mixed, map(mul, repeat(weight), entries))]
    return matrix(mixed)


def rgb2cam(xyz2cam: Matrix) -> Matrix:
    """Compute the linear sRGB → camera matrix whose rows sum to exactly 1, so that white stays white.

    Raises ValueError if the matrix from XYZ (D65) is not finite, not invertible (`MAX_CONDITION`), or has a row that
    sums to 0.
    """
    return normalise_rows(multiply(xyz2cam, RGB2XYZ))


def from_primaries(rgb2cam: Matrix, to_srgb: Sequence[float] | None) -> Matrix:
    """Compute the matrix from linear RGB of a photograph to the camera.

    Parameters
    ----------
    rgb2cam : Matrix
        Matrix from linear sRGB to the camera, whose rows sum to 1.
    to_srgb : sequence of float, optional
        Matrix from the primaries of the photograph to linear sRGB, whose rows sum to nearly 1; None for sRGB.

    Returns
    -------
    Matrix
        The product, whose rows sum to exactly 1.
    """
    if to_srgb is None:
        return rgb2cam
    a, b, c, d, e, f, g, h, i = multiply(rgb2cam, matrix(to_srgb))
    return *unit_row(a, b, c), *unit_row(d, e, f), *unit_row(g, h, i)


def normalise_rows(entries: Matrix) -> Matrix:
    """Divide each row by its sum, and round it to a grid on which its entries sum to exactly 1 in any order.

    Raises ValueError as `rgb2cam`.
    """
    if not _is_well_conditioned(entries):
        if not all(map(math.isfinite, entries)):
            raise ValueError("a camera matrix has finite entries")
        if not condition(entries) <= MAX_CONDITION:
            raise ValueError(f"the camera matrix is not invertible (condition number above {MAX_CONDITION:g})")
    a, b, c, d, e, f, g, h, i = entries
    return *unit_row(a, b, c), *unit_row(d, e, f), *unit_row(g, h, i)


def unit_row(a: float, b: float, c: float) -> tuple[float, float, float]:
    """Return one row divided by its sum, on the grid of `normalise_rows`; the largest entry is 1 minus the others."""
    total = a + b + c
    if abs(total) <= 1e-9 * max(abs(a), abs(b), abs(c)):
        raise ValueError("a row of the camera matrix sums to zero, so white cannot be kept")
    a, b, c = a / total, b / total, c / total
    sizes = abs(a), abs(b), abs(c)
    # The sum of two entries is 1 minus the third entry; the grid must represent these sums, too.
    reach = max(*sizes, abs(1 - a), abs(1 - b), abs(1 - c))
    grid = math.ldexp(1.0, max(math.frexp(reach)[1], 1) - 53)
    a, b, c = math.floor(a / grid + 0.5) * grid, math.floor(b / grid + 0.5) * grid, math.floor(c / grid + 0.5) * grid
    largest = sizes.index(max(sizes))
    if largest == 0:
        return 1.0 - (b + c), b, c
    return (a, 1.0 - (a + c), c) if largest == 1 else (a, b, 1.0 - (a + b))


def invert(entries: Matrix) -> Matrix:
    """Invert a matrix exactly, rounding each entry once.

    Parameters
    ----------
    entries : Matrix
        Any matrix.

    Returns
    -------
    Matrix
        The inverse.

    Raises
    ------
    ValueError
        If the matrix is singular.
    """
    return matrix([float(entry) for entry in exact_inverse(entries)])


def exact_inverse(entries: Sequence[float | Fraction]) -> list[Fraction]:
    """Invert nine numbers, row by row, in fractions; ValueError if the matrix is singular."""
    a, b, c, d, e, f, g, h, i = (Fraction(entry) for entry in entries)
    cofactors = (
        *(e * i - f * h, c * h - b * i, b * f - c * e),
        *(f * g - d * i, a * i - c * g, c * d - a * f),
        *(d * h - e * g, b * g - a * h, a * e - b * d),
    )
    determinant = a * cofactors[0] + b * cofactors[3] + c * cofactors[6]
    if determinant == 0:
        raise ValueError("the camera matrix is singular")
    return [cofactor / determinant for cofactor in cofactors]


def condition(entries: Matrix) -> float:
    """Return the condition number in the maximum row sum norm; infinity for a singular matrix."""
    try:
        inverse = invert(entries)
    except (ValueError, OverflowError):
        return math.inf
    return _norm(entries) * _norm(inverse)


def _is_well_conditioned(entries: Matrix) -> bool:
    """Return whether the determinant alone proves a condition number of at most 2e9; False if it does not.

    With m the largest entry, the norms of the matrix and its adjoint are at most 3m and 6m², so the condition number is
    at most 18m³ divided by the determinant. The determinant in float64 is within 40 · 2**-53 · m³. Exact fractions, as
    in `condition`, take 0.1 ms longer, as long as the rest of a plan.
    """
    a, b, c, d, e, f, g, h, i = entries
    largest = max(max(entries), -min(entries))
    determinant = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
    return 1e-50 < largest < 1e50 and abs(determinant) > 1e-8 * largest * largest * largest


def _norm(entries: Matrix) -> float:
    """Return the maximum row sum norm."""
    return max(sum(abs(entry) for entry in entries[row : row + 3]) for row in (0, 3, 6))
