"""Frames are prepared for training as the guide on loading says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unprocess_gen as ug
from unprocess_gen.simulation.reference.cfa import PATTERNS, unpack

ROW = {"pattern": "RGGB", "black_level_dn": 240, "white_level_dn": 4095, "a_dn": 5.0, "dark_variance_dn2": 30.0}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_packing_is_undone_by_unpacking(pattern: str) -> None:
    mosaic = np.arange(48, dtype=np.uint16).reshape(6, 8)

    planes = ug.pack(mosaic, pattern)

    assert planes.shape == (4, 3, 4)
    assert planes[0, 0, 0] == mosaic[divmod(pattern.index("R"), 2)]
    assert np.array_equal(unpack(planes, pattern), mosaic)


def test_light_keeps_noise_below_black() -> None:
    light = ug.to_light(np.array([0, 240, 4095, 4200], np.uint16), ROW)

    assert light.dtype == np.float32
    assert light.tolist() == pytest.approx([-240 / 3855, 0, 1, 3960 / 3855], rel=1e-6)


@pytest.mark.parametrize("row", [{}, {"black_level_dn": 0}, {"black_level_dn": 0, "white_level_dn": None}])
def test_row_without_levels_is_refused_in_a_sentence(row: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="is missing from the row; expected the row of a pair"):
        ug.to_light([1, 2], row)


def test_noise_map_is_zero_where_a_fitted_variance_is_negative() -> None:
    assert ug.noise_std([240, 250], ROW | {"dark_variance_dn2": -30.0}).tolist() == pytest.approx([0, np.sqrt(20)])
    with pytest.raises(ValueError, match="dark_variance_dn2 is missing from the row; expected a row of a pair"):
        ug.noise_std([240], {"black_level_dn": 240, "white_level_dn": 4095})


def test_batches_have_one_type_in_each_column(dataset: Path) -> None:
    """As PyTorch's ``default_collate`` needs it."""
    pairs = ug.RawPairs(dataset)
    batch = pairs.__getitems__([1, 0])
    assert [item.row["key"] for item in batch] == [pairs[1].row["key"], pairs[0].row["key"]]
    assert all((item.noisy == pairs[number].noisy).all() for item, number in zip(batch, (1, 0), strict=True))
    for name in batch[0].row:
        kinds = {type(item.row[name]) for item in batch}
        assert len(kinds) == 1 and kinds <= {int, float, str, bool}, name
    np.testing.assert_array_equal(ug.develop(batch[0].noisy, batch[0].row), ug.develop(*pairs[1][1:]))


@pytest.mark.parametrize(
    "overrides",
    [
        ["noise=nikon_d850", "scene=long_exposure", "effects.hot_pixels=off"],
        ["noise=sony_a7s2", "scene=night", "effects.hot_pixels=off"],
        ["noise=canon_5d4", "scene=night", "effects.all=on", "effects.hot_pixels=off", "effects.dead_pixels=off"],
    ],
)
def test_dark_variance_is_that_of_black_frames(overrides: list[str]) -> None:
    """Offsets of rows add a term of their own to the variance of a frame, so the bound has their share."""
    config = ug.load_config([*overrides, "sensor=generic_14bit", "effects.dead_pixels=off", "effects.black_error=off"])
    pair = ug.make_pair(np.zeros((256, 384, 3), np.uint8), config)

    measured = np.var(pair.noisy.astype(float) - pair.clean)
    expected = pair.row["dark_variance_dn2"] + 1 / 12  # black is an integer, so only the noisy frame is rounded
    rows = pair.row["row_std_dn"] ** 2
    error = np.hypot(expected * np.sqrt(2 / pair.noisy.size), rows * np.sqrt(2 / 256))

    assert abs(measured - expected) < 5 * error + 0.02 * expected * (pair.row["read_law"] != "gaussian")
    assert pair.row["dark_variance_dn2"] > 1.01 * pair.row["b_dn2"]
