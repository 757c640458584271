"""`RawClips` reads all frames of a clip; fixed patterns stay in them and noise does not."""

from __future__ import annotations

import itertools
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, TreeHash, text_rows
from hypothesis import given
from hypothesis import strategies as st

import unprocess_gen as ug
from unprocess_gen.config.schema import OutputConfig
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import Source
from unprocess_gen.pipeline.run import shard_starts

FRAMES, SIDE, GRAY = 8, 128, 180
RECIPE = ("source.clips=true", "output.clips=together", "output.pairs_per_shard=3", "source.patch=[random,32,2]")


# Shards ---------------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(1, 9), min_size=1, max_size=12), st.integers(1, 10))
def test_shards_end_with_clips_and_are_no_longer_than_needed(lengths: list[int], size: int) -> None:
    names = [f"clip-{number}" for number, length in enumerate(lengths) for _ in range(length)]
    sources = [Source(index, str(index), str(index), 1, clip=name) for index, name in enumerate(names)]
    starts = [*shard_starts(sources, OutputConfig(pairs_per_shard=size, clips="together")), len(sources)]
    assert starts[0] == 0
    for first, end in itertools.pairwise(starts):
        before = names[first : end - 1].count(names[end - 1])  # frames of the last clip, except one
        assert end == len(sources) or (names[end - 1] != names[end] and end - first >= size)
        assert end - first - 1 - before < size


def test_a_clip_between_the_files_of_another_is_not_divided() -> None:
    names = ["a", "a/b", "a/b", "a", "c"]
    sources = [Source(index, str(index), str(index), 1, clip=name) for index, name in enumerate(names)]
    assert [*shard_starts(sources, OutputConfig(pairs_per_shard=1, clips="together"))] == [0, 4]


@pytest.fixture(scope="module")
def folder(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of two clips of eight frames, with patches and two noise levels."""
    out = tmp_path_factory.mktemp("clips") / "ds"
    levels = "noise.levels=[{a: 8.0, b: -2040.0}, {a: 28.0, b: -6300.0}]"
    make(None, out, *RECIPE, "source.limit=16", "noise=imx385_iso3200_rvdd", levels)
    return out


def test_each_clip_is_in_one_shard(folder: Path) -> None:
    rows = text_rows(folder)
    assert {(row["clip"], row["shard"]) for row in rows} == {(rows[0]["clip"], "0"), (rows[-1]["clip"], "1")}


def test_parts_repair_and_again_keep_clips_together(
    folder: Path, run_main: RunMain, tree_hash: TreeHash, tmp_path: Path
) -> None:
    overrides = ("noise=imx385_iso3200_rvdd", "noise.levels=[{a: 8.0, b: -2040.0}, {a: 28.0, b: -6300.0}]")
    assert run_main("prepare", "parts=2", *RECIPE, "source.limit=16", *overrides, "out=parts").code == 0
    for part in (1, 0):
        assert run_main("part", "parts", str(part), "n_jobs=1").code == 0
    assert run_main("merge", "parts").code == 0
    assert tree_hash(tmp_path / "parts") == tree_hash(folder)
    (tmp_path / "parts/shards/shard-00001.tar").unlink()
    assert run_main("verify", "parts", "--repair").code == 0
    assert tree_hash(tmp_path / "parts") == tree_hash(folder)


def test_together_needs_clips(run_main: RunMain) -> None:
    done = run_main("output.clips=together", "source.limit=1")
    assert (done.code, "output.clips=together: there are no clips" in done.err) == (2, True)


# Reading --------------------------------------------------------------------------------------------------------------


def test_clips_hold_the_frames_of_pairs_in_order(folder: Path) -> None:
    clips, pairs = pickle.loads(pickle.dumps(ug.RawClips(folder))), [*ug.RawPairs(folder)]
    assert len(clips) == 2 * 2 * 2
    for clip in clips:
        assert clip.noisy.shape == clip.clean.shape == (FRAMES, 32, 32) and clip.noisy.dtype == np.uint16
        first = clip.rows[0]
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
    make(still, tmp_path / "ds", "source.clips=true", "output.clips=together", *settings)
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
