"""Patches: squares cut out of a full frame where its Bayer phase is kept.

Every corner lies on an even row and column, so the sensor's pattern is that of each patch. A patch is the cut-out of
its full frame's pair, bit for bit: noise goes by the coordinates of the full frame, and all that was drawn or decided
for an image holds for each of its patches. Where patches overlap they share their noise.

Random corners are whole numbers made from whole numbers: a word times the number of even places, divided by 2**32, so
of n places none is likelier than another by more than n / 2**32.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from unprocess_gen.core.random_streams import patch_words
from unprocess_gen.core.types import MOSAIC, PACKED, Patch, PatchRule, Srgb


def list_patches(
    law: PatchRule | None, stream_key: int, height: int, width: int, layout: str = MOSAIC
) -> tuple[Patch, ...]:
    """Return the patches of an image, in order; without a law the whole image is one.

    Of an odd side packed planes leave out the last row or column, which has no whole 2x2 tiles. Grids go row by row
    from the top-left corner. Random places come from the image's own streams, so no other image, and no patch after
    them, moves them.
    """
    if law is None:
        side = 2 if layout == PACKED else 1
        return (Patch(0, 0, 0, height // side * side, width // side * side),)
    corners = _grid(law, height, width) if law.kind == "grid" else _random(law, stream_key, height, width)
    return tuple(Patch(number, y, x, law.side, law.side) for number, (y, x) in enumerate(corners))


def _grid(law: PatchRule, height: int, width: int) -> Iterator[tuple[int, int]]:
    rows, columns = (range(0, length - law.side + 1, law.stride) for length in (height, width))
    return itertools.product(rows, columns)


def _random(law: PatchRule, stream_key: int, height: int, width: int) -> Iterator[tuple[int, int]]:
    rows, columns = ((length - law.side) // 2 + 1 for length in (height, width))
    for first, second in patch_words(stream_key, law.count):
        yield 2 * (first * rows >> 32), 2 * (second * columns >> 32)


def crop_patch(srgb: Srgb, patch: Patch) -> Srgb:
    """Return the pixels of a patch."""
    return srgb[patch.y : patch.y + patch.height, patch.x : patch.x + patch.width]


def pixels_in_none(cuts: tuple[Patch, ...], height: int, width: int) -> int:
    """Return how many pixels of an image lie in no patch."""
    left = np.ones((height, width), dtype=bool)
    for patch in cuts:
        left[patch.y : patch.y + patch.height, patch.x : patch.x + patch.width] = False
    return int(left.sum())
