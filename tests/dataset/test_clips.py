"""`RawClips` reads all frames of a clip; fixed patterns stay in them and noise does not."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.datasets import Make

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError

FRAMES, SIDE, GRAY = 8, 128, 180
RECIPE = ("source.clips=true", "output.pairs_per_shard=3", "source.patch=[random,32,2]")


@pytest.fixture(scope="module")
def folder(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of two clips of eight frames, with patches and two noise levels."""
    out = tmp_path_factory.mktemp("clips") / "ds"
    levels = "noise.levels=[{a: 8.0, b: -2040.0}, {a: 28.0, b: -6300.0}]"
    make(None, out, *RECIPE, "source.limit=16", "noise=imx385_iso3200_rvdd", levels)
    return out


def test_clips_hold_the_frames_of_pairs_from_several_shards(folder: Path) -> None:
    clips, pairs = pickle.loads(pickle.dumps(ug.RawClips(folder))), [*ug.RawPairs(folder)]
    assert len(clips) == 2 * 2 * 2
    for clip in clips:
        assert clip.noisy.shape == clip.clean.shape == (FRAMES, 32, 32) and clip.noisy.dtype == np.uint16
        first = clip.rows[0]
        assert len({row["shard"] for row in clip.rows}) > 1
        place = {name: first[name] for name in ("clip", "patch", "level", "draw", "red_gain", "patch_y", "a_dn")}
        frames = [sample for sample in pairs if place.items() <= sample.row.items()]
        assert [row["frame"] for row in clip.rows] == [*range(FRAMES)]
        assert clip.rows == [sample.row for sample in frames]
        np.testing.assert_array_equal(clip.noisy, np.stack([sample.noisy for sample in frames]))
        np.testing.assert_array_equal(clip.clean, np.stack([sample.clean for sample in frames]))


def test_photographs_are_no_clips(dataset: Path) -> None:
    with pytest.raises(ConfigError, match="has no clips"):
        ug.RawClips(dataset)


# Fixed patterns and noise ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a clip whose frames are all the same even gray."""
    folder = tmp_path_factory.mktemp("still") / "photos"
    (folder / "clip").mkdir(parents=True)
    for frame in range(FRAMES):
        cv2.imwrite(str(folder / f"clip/{frame}.png"), np.full((SIDE, SIDE, 3), GRAY, np.uint8))
    return folder


@pytest.mark.parametrize(("effect", "is_fixed"), [("prnu", True), ("shot", False)])
def test_fixed_patterns_stay_and_noise_does_not(
    effect: str, is_fixed: bool, still: Path, make: Make, tmp_path: Path
) -> None:
    effects = ("noise.prnu_std=0.02", "effects.all=off", f"effects.{effect}=on")
    light = ("scene.exposure_ratio=1", "scene.iso=1600", "camera=identity", "gains=fixed")
    make(still, tmp_path / "ds", "source.clips=true", "noise=sony_a7s2", "sensor=sony_a7s2", *effects, *light)
    (clip,) = ug.RawClips(tmp_path / "ds")
    assert (clip.clean == clip.clean[0]).all()
    residual = (clip.noisy.astype(float) - clip.clean).reshape(FRAMES, -1)
    correlations = np.corrcoef(residual)[~np.eye(FRAMES, dtype=bool)]
    assert (np.abs(correlations - is_fixed) < (1e-9 if is_fixed else 6 / SIDE)).all()
