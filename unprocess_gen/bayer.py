"""The colour filter array as data: which channel each site of the 2x2 tile sees, and taking the mosaic.

The tile is anchored at the top-left pixel of the full frame, so a part of a frame needs to know where it was cut out
(``origin``). Any height and width works, odd ones and single pixels too; nothing is padded or cropped.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.records import Float

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
