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

from unprocess_gen.config.interpretation import BurstRule, PatchRule
from unprocess_gen.core.arrays import MOSAIC, PACKED, Srgb
from unprocess_gen.core.random_streams import PATCH, even_corner, frame_word, purpose
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.kernels.draws import draws


def list_patches(
    rule: PatchRule | None,
    stream_key: int,
    height: int,
    width: int,
    layout: str = MOSAIC,
    epoch: int = 0,
    burst: BurstRule | None = None,
) -> tuple[Patch, ...]:
    """List the patches of an image in order; random ones are elsewhere in each epoch.

    Patches of bursts are in pixels of their frames. They keep the margin of `BurstRule` from the edges of the picture.
    """
    side = 2 if layout == PACKED else 1
    if burst is not None:
        return _list_bursts(rule, burst, stream_key, (height, width), side, epoch)
    if rule is None:
        return (Patch(width // side * side, height // side * side),)
    corners: Iterable[tuple[int, int]]
    if rule.kind == "grid":
        rows, columns = (range(0, length - rule.side + 1, rule.stride) for length in (height, width))
        corners = itertools.product(rows, columns)
    else:
        words, _ = draws(stream_key, rule.count, purpose(PATCH), frame_word(0, epoch))
        corners = (even_corner(place, rule.side, height, width) for place in words.tolist())
    return tuple(Patch(rule.side, rule.side, number, y, x) for number, (y, x) in enumerate(corners))


def _list_bursts(
    rule: PatchRule | None, burst: BurstRule, stream_key: int, picture: tuple[int, int], side: int, epoch: int
) -> tuple[Patch, ...]:
    """List the patches of bursts, whose corners are at sites (0, 0) of the sensor's tiles; none if none fits."""
    target = picture if rule is None else (rule.side, rule.side)
    margins = burst.margin(*target)
    firsts = [-(-margin // burst.tile) * burst.tile for margin in margins]
    ends = [length - margin for length, margin in zip(picture, margins, strict=True)]
    if rule is None:
        height, width = (
            (end - first) // (burst.downscale * side) * side for first, end in zip(firsts, ends, strict=True)
        )
        corner = firsts[0] // burst.downscale, firsts[1] // burst.downscale
        return (Patch(width, height, 0, *corner),) if min(height, width) > 0 else ()
    places = [range(first, end - rule.side + 1, burst.tile) for first, end in zip(firsts, ends, strict=True)]
    if not all(places):
        return ()
    corners: Iterable[tuple[int, int]]
    if rule.kind == "grid":
        rows, columns = (place[:: rule.stride // burst.tile] for place in places)
        corners = itertools.product(rows, columns)
    else:
        words, _ = draws(stream_key, rule.count, purpose(PATCH), frame_word(0, epoch))
        corners = ((places[0][y * len(places[0]) >> 32], places[1][x * len(places[1]) >> 32])
                   for y, x, *_ in words.tolist())  # fmt: skip
    length = rule.side // burst.downscale
    return tuple(
        Patch(length, length, number, y // burst.downscale, x // burst.downscale)
        for number, (y, x) in enumerate(corners)
    )


def crop_patch(srgb: Srgb, patch: Patch) -> Srgb:
    """Cut the pixels of a patch from [H, W, 3]."""
    y, x = patch.origin
    return srgb[y : y + patch.height, x : x + patch.width]
