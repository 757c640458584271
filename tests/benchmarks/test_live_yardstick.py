"""The plain NumPy pipeline that live pairs are compared with has their distribution."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets import Make

import unprocess_gen as ug

sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "experiments"))
from live_pairs_numpy import NumpyPairs

from unprocess_gen.sources import synthetic

SIDE, EPOCHS = 96, 60
SETTINGS = {
    "two numbers": ("noise=imx385_iso3200",),
    "night": ("noise=sony_a7s2", "scene=night"),
    "daylight": ("noise=sony_a7s2", "scene=daylight"),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_moments_are_those_of_live_pairs(name: str, make: Make, tmp_path: Path) -> None:
    """Fixed patterns differ, since the bodies have other random numbers; noise that is new in each epoch must not."""
    make(None, tmp_path / "ds", *SETTINGS[name], "source.limit=1")
    live = ug.LivePairs(tmp_path / "ds", patch=SIDE)
    row = ug.RawPairs(tmp_path / "ds")[0].row
    srgb = synthetic.picture(str(row["source"]))
    plain = NumpyPairs([row], lambda _: srgb, SIDE)
    camera, sums = plain.images[0], np.zeros((2, 5))
    for epoch in range(EPOCHS):
        clean, noisy, crop = live[epoch, 0]
        y, x = crop["patch_y"], crop["patch_x"]
        exact = camera.unprocess(srgb[y : y + SIDE, x : x + SIDE], camera.matrix, camera.gains)
        assert (np.abs(camera.round(exact).astype(int) - clean) <= 1).all()
        assert (camera.round(exact) == clean).mean() > 0.99
        ours = camera.round(camera.noisy(exact, plain.rng, y, x))
        sums += [moments(noisy, exact), moments(ours, exact)]
    found, expected = sums / EPOCHS
    np.testing.assert_allclose(expected[:3], found[:3], rtol=0.03)
    np.testing.assert_allclose(expected[3], found[3], rtol=0.12)  # variance of row means: 60 x 96 rows, 2 % each
    assert abs(expected[4] - found[4]) < 0.02 * np.sqrt(found[2])


def moments(noisy: np.ndarray, clean: np.ndarray) -> list[float]:
    """Variance of the darker and the brighter half of the sites, and of all; variance of row means; mean."""
    noise, bright = noisy - clean.astype(float), clean > np.median(clean)
    return [noise[~bright].var(), noise[bright].var(), noise.var(), noise.mean(axis=1).var(), noise.mean()]
