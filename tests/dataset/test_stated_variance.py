"""The variance that rows, noise maps and targets state is that of noisy minus clean, PRNU of the body included."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import Make
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.dataset.reader import mosaic_dn

BODIES, CODES, SIDE = ("sony_a7s2", "canon_5d4", "nikon_d850"), (128, 200, 254), 320
ERROR = 5 * math.sqrt(2 / (SIDE // 2) ** 2)
"""Five standard errors of the variance of the sites of a plane, as a share of it."""


def ratios(clean: Any, noisy: Any, row: Any, stated_dn2: Any) -> Iterator[float]:
    """Yield the variance of each plane that is not clipped, in units of the stated one; black errors are a mean.

    The light before rounding is the same at all sites, so only the noisy frame is rounded.
    """
    for plane in (np.s_[y::2, x::2] for y in (0, 1) for x in (0, 1)):
        stated = float(np.mean(stated_dn2[plane])) + 1 / 12
        if clean[plane].max() + 8 * math.sqrt(stated) < row["white_level_dn"]:
            yield float(np.var(noisy[plane].astype(float) - clean[plane])) / stated


@pytest.mark.parametrize("body", BODIES)
def test_stated_variance_is_that_of_stored_and_live_pairs(body: str, make: Make, tmp_path: Path) -> None:
    """In the default scene, where PRNU is up to four fifths of the variance; each picture has a body of its own."""
    (tmp_path / "flats").mkdir()
    for code in CODES:
        Image.fromarray(np.full((SIDE, SIDE, 3), code, np.uint8)).save(tmp_path / "flats" / f"{code}.png")
    make(tmp_path / "flats", tmp_path / "ds", f"body={body}", "effects.hot_pixels=off", "isp=srgb", "gains=fixed")
    found: list[float] = []
    for clean, noisy, row in ug.RawPairs(tmp_path / "ds"):
        assert "prnu" in row["effects"].split(";")
        found += ratios(clean, noisy, row, ug.noise_std(clean, row) ** 2)
        found += ratios(clean, noisy, row, ug.noise_std(noisy, row) ** 2)  # what a denoiser knows
    stored = len(found)
    live = ug.LivePairs(tmp_path / "ds", targets=["variance"])
    for sample in (live[epoch, number] for epoch in (0, 1) for number in range(len(CODES))):
        found += ratios(*sample[:3], sample.targets["variance"])
    assert stored >= 20 and len(found) == 2 * stored
    assert max(abs(ratio - 1) for ratio in found) <= ERROR


@pytest.mark.parametrize(
    "override",
    ["clean.includes_fixed_pattern=true", "effects.prnu=off", "effects.shot=off", "output.dtype=float32"],
)
def test_stated_variance_has_the_simulated_terms_only(override: str) -> None:
    config = ug.load_config(["body=sony_a7s2", "effects.hot_pixels=off", "effects.read=on", override])
    pair = ug.make_pair(np.full((SIDE, SIDE, 3), 200, np.uint8), config)
    clean, noisy = (mosaic_dn(frame, pair.row) for frame in (pair.clean, pair.noisy))
    found = [*ratios(clean, noisy, pair.row, ug.noise_std(clean, pair.row) ** 2)]
    assert found == pytest.approx([1] * 4, abs=ERROR)
