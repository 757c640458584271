"""Split mosaics into planes, and sum products of neighbouring sites."""

from __future__ import annotations

from typing import Any

import numpy as np

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


def neighbour_products(z: Any) -> dict[str, list[float]]:
    """Sums of the products of z at pairs of sites, by distance of `NEIGHBOURS`.

    The last two columns of z [H, W + 2] are zeros, which keep sites of other rows out.
    """
    flat = np.ascontiguousarray(z).ravel()
    places = {name: [y * z.shape[1] + x for y, x in distances] for name, distances in NEIGHBOURS.items()}
    return {name: [float(flat[n:] @ flat[:-n]) for n in numbers] for name, numbers in places.items()}
