"""`RawClips` reads all frames of a clip; fixed patterns stay in them and noise does not."""

from __future__ import annotations

import itertools
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


@pytest.mark.parametrize("prnu_std", [0.0, 0.02])
def test_fixed_patterns_stay_and_noise_does_not(prnu_std: float, still: Path, make: Make, tmp_path: Path) -> None:
    effects = ("effects.all=off", "effects.shot=on", "effects.read=on", f"effects.prnu={'on' if prnu_std else 'off'}")
    light = ("scene.exposure_ratio=1", "scene.iso=1600", "camera=identity", "gains=fixed")
    settings = ("noise=sony_a7s2", "sensor=sony_a7s2", f"noise.prnu_std={prnu_std}", *effects, *light)
    make(still, tmp_path / "ds", "source.clips=true", *settings)
    (clip,) = ug.RawClips(tmp_path / "ds")
    assert (clip.clean == clip.clean[0]).all()
    black, sites = clip.rows[0]["black_level_dn"], SIDE * SIDE
    signal = clip.clean[0].astype(float) - black
    residual = clip.noisy.astype(float) - clip.clean
    pairs = [*itertools.combinations(range(FRAMES), 2)]
    common = np.mean([(residual[i] * residual[j]).mean() for i, j in pairs])
    changing = residual.var(axis=0, ddof=1).mean()
    expected = (clip.rows[0]["a_dn"] * signal + clip.rows[0]["dark_variance_dn2"]).mean() + 1 / 12
    fixed = (prnu_std**2 * signal**2).mean()
    error = (changing + FRAMES * fixed) * np.sqrt(2 / sites)
    assert common == pytest.approx(fixed, abs=6 * error / FRAMES)
    assert changing == pytest.approx(expected, abs=6 * expected * np.sqrt(2 / (sites * (FRAMES - 1))))
