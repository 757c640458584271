"""The colour filter array as data: which channel each site of the 2x2 tile sees, and taking the mosaic.

The tile is anchored at the top-left pixel of the full frame, so a part of a frame needs to know where it was cut out
(``origin``). Any height and width works, odd ones and single pixels too; nothing is padded or cropped.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.types import Float, Frame

CHANNELS = "RGB"
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Filters of the sites (0, 0), (0, 1), (1, 0), (1, 1), as the DNG tag CFAPattern lists them."""


def tile(pattern: str, origin: tuple[int, int] = (0, 0)) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the channel (0 red, 1 green, 2 blue) of each site ``[y % 2][x % 2]``, seen from ``origin``.

    Raises ValueError for a pattern that is not one of `PATTERNS`.

    >>> tile("RGGB")
    ((0, 1), (1, 2))
    >>> tile("RGGB", origin=(0, 1))
    ((1, 0), (2, 1))
    """
    if pattern not in PATTERNS:
        raise ValueError(f"pattern is {pattern!r}, expected one of {', '.join(PATTERNS)}")
    y0, x0 = origin

    def channel(y: int, x: int) -> int:
        return CHANNELS.index(pattern[(y + y0) % 2 * 2 + (x + x0) % 2])

    return (channel(0, 0), channel(0, 1)), (channel(1, 0), channel(1, 1))


def mosaic(camera_rgb: Float, pattern: str, origin: tuple[int, int] = (0, 0)) -> Float:
    """Keep one channel per site: ``[H, W, 3]`` becomes ``[H, W]``, values unchanged.

    ``origin`` is the row and column of the top-left pixel in the full frame.
    """
    raw = np.empty(camera_rgb.shape[:2])
    sites = tile(pattern, origin)
    for y in (0, 1):
        for x in (0, 1):
            raw[y::2, x::2] = camera_rgb[y::2, x::2, sites[y][x]]
    return raw


PLANES = ("R", "G of the red rows", "G of the blue rows", "B")
"""The planes of a packed frame in their order, which is that of Brooks et al. 2019 (unprocess.py, mosaic())."""


def plane_sites(pattern: str, origin: tuple[int, int] = (0, 0)) -> tuple[tuple[int, int], ...]:
    """Return row and column in the 2x2 tile, seen from ``origin``, of each of `PLANES`: the same order for any pattern.

    >>> plane_sites("GBRG")
    ((1, 0), (1, 1), (0, 0), (0, 1))
    """
    sites = tile(pattern, origin)
    red = next((y, x) for y in (0, 1) for x in (0, 1) if sites[y][x] == 0)
    y, x = red
    return red, (y, 1 - x), (1 - y, x), (1 - y, 1 - x)


def pack(mosaic: Frame, pattern: str, origin: tuple[int, int] = (0, 0)) -> Frame:
    """Return a mosaic ``[H, W]``, H and W even, as the planes ``[4, H / 2, W / 2]`` of `PLANES`; a copy.

    Raises ValueError where a side is odd.
    """
    height, width = mosaic.shape
    if height % 2 or width % 2:
        raise ValueError(f"a mosaic of {width} x {height} sites has no whole planes: packing needs even sides")
    planes: Frame = np.empty((4, height // 2, width // 2), dtype=mosaic.dtype)
    for plane, (y, x) in zip(planes, plane_sites(pattern, origin), strict=True):
        plane[:] = mosaic[y::2, x::2]
    return planes


def unpack(planes: Frame, pattern: str, origin: tuple[int, int] = (0, 0)) -> Frame:
    """Return the mosaic ``[H, W]`` of packed planes ``[4, H / 2, W / 2]``: the inverse of `pack`."""
    mosaic: Frame = np.empty((2 * planes.shape[1], 2 * planes.shape[2]), dtype=planes.dtype)
    for plane, (y, x) in zip(planes, plane_sites(pattern, origin), strict=True):
        mosaic[y::2, x::2] = plane
    return mosaic
