"""Pixels before the pipeline: averaging in integers, and the dither of 8-bit codes."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.photographs import pixels
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference.unprocess import dequantise
from unprocess_gen.simulation.tone_curves import linear_table
from unprocess_gen.sources.listing import list_photographs
from unprocess_gen.sources.loader import downscaled, load_source


@given(side=st.integers(1, 9), seed=st.integers(0, 99), deep=st.booleans())
def test_downscaled_code_is_nearest_to_the_exact_mean(side: int, seed: int, deep: bool) -> None:
    srgb = pixels(seed, 19, 23, np.uint16 if deep else np.uint8)
    found = downscaled(srgb, side)
    assert found.shape == (19 // side, 23 // side, 3)
    y, x = found.shape[0] - 1, found.shape[1] - 1
    square = srgb[y * side : (y + 1) * side, x * side : (x + 1) * side, 1]
    mean = Fraction(int(square.sum()), side * side) * (1 if deep else 257)
    assert abs(Fraction(int(found[y, x, 1])) - mean) <= Fraction(1, 2)


def test_black_and_white_stay_black_and_white_when_downscaled() -> None:
    for code, wanted in ((0, 0), (255, 65535)):
        assert (downscaled(np.full((64, 64, 3), code, dtype=np.uint8), 64) == wanted).all()
    assert (downscaled(np.full((64, 64, 3), 65535, dtype=np.uint16), 64) == 65535).all()


def test_a_photograph_too_small_to_be_downscaled_is_too_small(tmp_path: Path) -> None:
    Image.fromarray(pixels(1, 3, 9)).save(tmp_path / "small.png")
    config = SourceConfig(root=str(tmp_path), include=["*"], downscale=4)
    with pytest.raises(SourceError, match=r"^too_small: 9 x 3 pixels are less than one square"):
        load_source(config, list_photographs(config).sources[0])


@pytest.mark.parametrize("override", ["source.downscale=2", "source.dequantize=dither", "source.dequantize=dither_all"])
def test_downscaled_and_dithered_pairs_are_regenerated_from_rows(
    override: str, photos: Path, make: Make, tmp_path: Path
) -> None:
    make(photos, tmp_path / "ds", override)
    replayed = list(replay(read_rows(tmp_path / "ds" / "manifest.csv"), str(photos)))
    assert len(replayed) >= 12
    assert [one for one in replayed if one.complaint] == []


@pytest.fixture(scope="module")
def dithered(settings: Settings) -> object:
    return plan_image(settings("source.dequantize=dither"), "d" * 64)


CURVE = linear_table("smoothstep", 2.2, 256)


def test_dither_moves_codes_uniformly_by_half_a_code(dithered: object) -> None:
    """Each of 257 offsets is as likely; 120,000 of them: six standard errors of mean and variance."""
    moved = dequantise(np.full((200, 200, 3), 100, dtype=np.uint8), dithered).astype(int) - 25_700  # type: ignore[arg-type]
    assert (moved.min(), moved.max()) == (-128, 128)
    assert abs(moved.mean()) < 6 * 74.2 / np.sqrt(moved.size)
    assert abs(moved.var() / ((257**2 - 1) / 12) - 1) < 6 * np.sqrt(0.8 / moved.size)


def test_black_white_and_highlights_are_not_moved(dithered: object) -> None:
    codes = np.arange(256, dtype=np.uint8).reshape(1, 256, 1).repeat(40, axis=0).repeat(3, axis=2)
    moved = (dequantise(codes, dithered) != codes.astype(np.uint16) * 257).any(axis=(0, 2))  # type: ignore[arg-type]
    assert moved.tolist() == [0 < code < 255 and CURVE[code] <= 0.9 for code in range(256)]


def test_dither_all_fills_every_band_and_keeps_white(settings: Settings) -> None:
    """Codes keep their order, every 16-bit code above the first half code occurs, and only white is white."""
    plan = plan_image(settings("source.dequantize=dither_all"), "d" * 64)
    codes = np.arange(240, 256, dtype=np.uint8)
    moved = dequantise(codes[None, :, None].repeat(9000, axis=0).repeat(3, axis=2), plan)
    lowest, highest = moved.min(axis=(0, 2)).astype(int), moved.max(axis=(0, 2)).astype(int)
    assert (lowest[1:] - highest[:-1] == 1).all()
    assert (lowest[-1], highest[-1], highest[-2]) == (65535, 65535, 65534)
    assert set(moved[:, 13].ravel().tolist()) == set(range(253 * 257 - 128, 253 * 257 + 129))
    assert set(moved[:, 14].ravel().tolist()) == set(range(254 * 257 - 128, 65535))
    assert (dequantise(np.zeros((9, 9, 3), dtype=np.uint8), plan) == 0).all()


def test_channels_are_moved_independently(dithered: object) -> None:
    moved = dequantise(np.full((100, 100, 3), 77, dtype=np.uint8), dithered).reshape(-1, 3)  # type: ignore[arg-type]
    assert np.abs(np.corrcoef(moved.T) - np.eye(3)).max() < 6 / 100


def test_dither_of_a_crop_is_the_crop_of_the_dither(dithered: object) -> None:
    srgb = pixels(3, 40, 90)
    full = dequantise(srgb, dithered)  # type: ignore[arg-type]
    np.testing.assert_array_equal(dequantise(srgb[7:, 65:], dithered, (7, 65)), full[7:, 65:])  # type: ignore[arg-type]


def test_16_bit_photographs_are_not_dithered(dithered: object, settings: Settings) -> None:
    deep = pixels(5, 20, 30, np.uint16)
    plain = plan_image(settings(), "d" * 64)
    np.testing.assert_array_equal(make_pair(deep, dithered).noisy, make_pair(deep, plain).noisy)  # type: ignore[arg-type]


def test_dataset_of_a_single_picture_equals_that_of_its_folder(make: Make, tmp_path: Path) -> None:
    picture = tmp_path / "photos" / "%one.png"
    picture.parent.mkdir()
    Image.fromarray(pixels(1, 9, 14)).save(picture)
    make(picture, tmp_path / "one")
    make(picture.parent, tmp_path / "all")

    assert (tmp_path / "one" / "manifest.csv").read_bytes() == (tmp_path / "all" / "manifest.csv").read_bytes()
    (replayed,) = replay(read_rows(tmp_path / "one" / "manifest.csv"), str(picture))
    assert (replayed.source, replayed.complaint) == ("%25one.png", "")


def test_summary_and_plan_name_files_that_nothing_matches(run_main: RunMain, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    Image.fromarray(pixels(1, 9, 14)).save(photos / "a.png")
    (photos / "b.JXL").touch()
    for command in ([], ["plan"]):
        done = run_main(*command, f"source.root={photos}", "n_jobs=1")
        assert "1 file is not matched by source.include (1 .jxl)" in done.out, done


def test_clip_of_different_photographs_gives_warnings(run_main: RunMain, tmp_path: Path) -> None:
    Image.fromarray(pixels(1, 9, 14)).save(tmp_path / "a.png")
    Image.fromarray(pixels(2, 12, 8)).save(tmp_path / "b.png")
    done = run_main(f"source.root={tmp_path}", "source.clips=true", "n_jobs=1")
    assert (done.code, "all 2 photographs are in one folder" in done.err) == (0, True), done
    planned = run_main("plan", f"source.root={tmp_path}", "source.clips=true", "n_jobs=1")
    assert "photographs are in one folder" in planned.out


def test_row_of_a_scene_that_does_not_exist_is_refused() -> None:
    with pytest.raises(SourceError, match=r"^unreadable: synthetic picture 'p0.png'"):
        load_source(SourceConfig(root=None), Source(0, "p0.png", "p0.png", 0))
