"""Colour filter array: the channel of each CFA site, mosaics and packed planes.

The 2x2 tile is aligned with the first pixel of the full frame, so functions take the position (``origin``) of a crop.
Any height and width works unless a function states otherwise; nothing is padded or cropped.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.arrays import Float, Frame, Srgb

CHANNELS = "RGB"
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Filters of the sites (0, 0), (0, 1), (1, 0), (1, 1), in the order of the DNG tag CFAPattern."""

MONO = "MONO"
"""The pattern of a sensor without colour filters: all sites record the mean of the channels (`planning.plan`)."""

ONE_COLOUR = ("RRRR", "GGGG", "BBBB")
"""Patterns with the same filter at all sites; no sensor has them."""


def filters(pattern: str) -> str:
    """Return the letters of the filters of the 2x2 tile, row by row.

    Parameters
    ----------
    pattern : str
        One of `PATTERNS` or `ONE_COLOUR`, or `MONO`.

    Returns
    -------
    str
        Four letters; green for `MONO`, whose channels are equal.

    Raises
    ------
    ValueError
        If the pattern is unknown.
    """
    if pattern not in (*PATTERNS, *ONE_COLOUR, MONO):
        raise ValueError(f"pattern={pattern}: unknown CFA pattern; expected one of {', '.join((*PATTERNS, MONO))}")
    return "GGGG" if pattern == MONO else pattern


def tile(pattern: str, origin: tuple[int, int] = (0, 0)) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the channel of each site of the 2x2 tile.

    Parameters
    ----------
    pattern : str
        As for `filters`.
    origin : (int, int)
        Row and column in the full frame of the site at [0][0].

    Returns
    -------
    tuple of two tuples of two ints
        Channel (0 red, 1 green, 2 blue) of the site at [y % 2][x % 2].

    Raises
    ------
    ValueError
        If the pattern is unknown.

    Examples
    --------
    >>> tile("RGGB")
    ((0, 1), (1, 2))
    >>> tile("RGGB", origin=(0, 1))
    ((1, 0), (2, 1))
    """
    letters, (y0, x0) = filters(pattern), origin

    def channel(y: int, x: int) -> int:
        return CHANNELS.index(letters[(y + y0) % 2 * 2 + (x + x0) % 2])

    return (channel(0, 0), channel(0, 1)), (channel(1, 0), channel(1, 1))


def mosaic(camera_rgb: Float | Srgb, pattern: str, origin: tuple[int, int] = (0, 0)) -> Float:
    """Sample one channel per CFA site, [H, W, 3] to [H, W]; ``origin`` is the first pixel's place in the full frame."""
    raw = np.empty(camera_rgb.shape[:2])
    sites = tile(pattern, origin)
    for y in (0, 1):
        for x in (0, 1):
            raw[y::2, x::2] = camera_rgb[y::2, x::2, sites[y][x]]
    return raw


def plane_sites(pattern: str, origin: tuple[int, int] = (0, 0)) -> tuple[tuple[int, int], ...]:
    """Return the position in the 2x2 tile of the site of each packed plane.

    Parameters
    ----------
    pattern : str
        As for `filters`.
    origin : (int, int)
        Row and column in the full frame of the tile's first site.

    Returns
    -------
    tuple of four (int, int)
        Row and column of R, G of the red rows, G of the blue rows and B, as in Brooks et al. 2019 (unprocess.py,
        mosaic()); the four sites row by row if all have the same filter.

    Examples
    --------
    >>> plane_sites("GBRG")
    ((1, 0), (1, 1), (0, 0), (0, 1))
    """
    if pattern in (*ONE_COLOUR, MONO):
        return (0, 0), (0, 1), (1, 0), (1, 1)
    sites = tile(pattern, origin)
    red = next((y, x) for y in (0, 1) for x in (0, 1) if sites[y][x] == 0)
    y, x = red
    return red, (y, 1 - x), (1 - y, x), (1 - y, 1 - x)


def pack(mosaic: Frame, pattern: str, origin: tuple[int, int] = (0, 0)) -> Frame:
    """Convert a mosaic [H, W] to planes [4, H / 2, W / 2] in the order of `plane_sites`, a copy of the same dtype.

    Raises ValueError if a side is odd.
    """
    height, width = mosaic.shape
    if height % 2 or width % 2:
        raise ValueError(f"mosaic={width} x {height}: odd side; expected even width and height for packed planes")
    planes: Frame = np.empty((4, height // 2, width // 2), dtype=mosaic.dtype)
    for plane, (y, x) in zip(planes, plane_sites(pattern, origin), strict=True):
        plane[:] = mosaic[y::2, x::2]
    return planes


def unpack(planes: Frame, pattern: str, origin: tuple[int, int] = (0, 0)) -> Frame:
    """Convert packed planes to a mosaic: the inverse of `pack`.

    Parameters
    ----------
    planes : ndarray, [4, H / 2, W / 2]
        Planes in the order of `plane_sites`.
    pattern : str
        One of `PATTERNS`.
    origin : (int, int)
        Row and column of the mosaic's first site in the full frame.

    Returns
    -------
    ndarray, [H, W]
        Mosaic of the same dtype.
    """
    mosaic: Frame = np.empty((2 * planes.shape[1], 2 * planes.shape[2]), dtype=planes.dtype)
    for plane, (y, x) in zip(planes, plane_sites(pattern, origin), strict=True):
        mosaic[y::2, x::2] = plane
    return mosaic
