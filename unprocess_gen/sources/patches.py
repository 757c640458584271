"""Cut full frames into square patches that keep the CFA phase.

Every corner is at an even row and column, so a patch has the sensor's CFA pattern. A patch is the crop of its full
frame's pair, bit for bit: noise depends on coordinates of the full frame, and everything drawn or decided for an image
holds for its patches. Overlapping patches share their noise.

Random corners are computed with integers: a random word times the number of even positions, divided by 2**32. Of n
positions none is more likely than another by more than n / 2**32.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

from unprocess_gen.config.interpretation import PatchRule
from unprocess_gen.core.arrays import MOSAIC, PACKED, Srgb
from unprocess_gen.core.random_streams import PATCH, even_corner, frame_word, purpose
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.kernels.draws import draws


def list_patches(
    rule: PatchRule | None, stream_key: int, height: int, width: int, layout: str = MOSAIC, epoch: int = 0
) -> tuple[Patch, ...]:
    """List the patches of an image in order; random ones are elsewhere in each epoch."""
    if rule is None:
        side = 2 if layout == PACKED else 1
        return (Patch(width // side * side, height // side * side),)
    corners: Iterable[tuple[int, int]]
    if rule.kind == "grid":
        rows, columns = (range(0, length - rule.side + 1, rule.stride) for length in (height, width))
        corners = itertools.product(rows, columns)
    else:
        words, _ = draws(stream_key, rule.count, purpose(PATCH), frame_word(0, epoch))
        corners = (even_corner(place, rule.side, height, width) for place in words.tolist())
    return tuple(Patch(rule.side, rule.side, number, y, x) for number, (y, x) in enumerate(corners))


def crop_patch(srgb: Srgb, patch: Patch) -> Srgb:
    """Cut the pixels of a patch from [H, W, 3]."""
    y, x = patch.origin
    return srgb[y : y + patch.height, x : x + patch.width]
