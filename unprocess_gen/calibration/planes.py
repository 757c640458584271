"""Split mosaics into planes, and name the distances of neighbouring sites."""

from __future__ import annotations

from typing import Any

from unprocess_gen.simulation.reference.cfa import MONO

TILE = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Places of the CFA tile; a plane is the set of all sites at one of them."""
NEIGHBOURS = {
    "adjacent sites": ((0, 1), (1, 0), (1, 1), (1, -1)),
    "neighbours": ((0, 2), (2, 0), (2, 2), (2, -2)),
}
"""Distances of the sites of pairs in rows and columns, by the name of the check of their correlation."""


def plane_names(pattern: str) -> list[str]:
    """Names of the planes in the order of the tile: R, B, and Gr or Gb; without filters, row and column in the tile."""
    if pattern == MONO:
        return ["00", "01", "10", "11"]
    rows = pattern[:2], pattern[2:]
    return [colour if colour != "G" else "Gr" if "R" in row else "Gb" for row in rows for colour in row]


def planes_of(mosaic: Any) -> list[Any]:
    """The planes of a mosaic of even sides, as views."""
    return [mosaic[y::2, x::2] for y, x in TILE]
