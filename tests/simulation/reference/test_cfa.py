"""Colour filter array: four patterns, any origin, any size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.simulation.reference.cfa import PATTERNS, mosaic, tile

R, G, B = 0, 1, 2

TILES = {
    "RGGB": ((R, G), (G, B)),
    "BGGR": ((B, G), (G, R)),
    "GRBG": ((G, R), (B, G)),
    "GBRG": ((G, B), (R, G)),
}


def coloured(height: int, width: int) -> np.ndarray:
    """Return an image whose values encode their position: channel · 10⁶ + row · 10³ + column."""
    y, x, c = np.ogrid[:height, :width, :3]
    return (c * 10**6 + y * 10**3 + x).astype(np.float64)


@pytest.mark.parametrize("pattern", TILES)
def test_a_tile_contains_its_pattern_row_by_row(pattern: str) -> None:
    assert tile(pattern) == TILES[pattern]


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ((0, 0), ((R, G), (G, B))),
        ((0, 1), ((G, R), (B, G))),
        ((1, 0), ((G, B), (R, G))),
        ((1, 1), ((B, G), (G, R))),
        ((2, 2), ((R, G), (G, B))),
        ((101, 4096), ((G, B), (R, G))),
    ],
)
def test_an_origin_shifts_the_tile(origin: tuple[int, int], expected: tuple[tuple[int, int], ...]) -> None:
    assert tile("RGGB", origin) == expected


@pytest.mark.parametrize("pattern", ["RGBG", "rggb", "", "XTRANS"])
def test_an_unknown_pattern_is_refused_with_the_known_ones(pattern: str) -> None:
    with pytest.raises(ValueError, match=rf"pattern={pattern}: .*expected one of RGGB, BGGR, GRBG, GBRG"):
        tile(pattern)


@given(st.sampled_from(PATTERNS), st.integers(1, 9), st.integers(1, 9))
def test_every_site_records_its_filters_channel_at_any_size(pattern: str, height: int, width: int) -> None:
    raw = mosaic(coloured(height, width), pattern)
    assert raw.shape == (height, width)
    for y in range(height):
        for x in range(width):
            assert raw[y, x] == TILES[pattern][y % 2][x % 2] * 10**6 + y * 10**3 + x


@given(st.sampled_from(PATTERNS), st.data())
def test_the_mosaic_of_a_crop_is_the_cropped_mosaic(pattern: str, data: st.DataObject) -> None:
    colours = coloured(11, 12)
    top, left = data.draw(st.integers(0, 10)), data.draw(st.integers(0, 11))
    bottom, right = data.draw(st.integers(top + 1, 11)), data.draw(st.integers(left + 1, 12))
    cut = mosaic(colours[top:bottom, left:right], pattern, (top, left))
    assert (cut == mosaic(colours, pattern)[top:bottom, left:right]).all()
