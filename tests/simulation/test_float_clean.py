"""Clean frames in float32 next to noisy frames in DN: the unrounded mean of the noise, in every file and command."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings

import unprocess_gen as ug
from unprocess_gen import RawPairs
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.reader import mosaic_dn
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.pipeline.verify import verify

NIGHT = ("noise=sony_a7s2", "scene=night", "sensor=generic_14bit")
FLOAT_CLEAN = (*NIGHT, "output.clean_dtype=float32")


@pytest.fixture(scope="module")
def mixed(photos: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Dataset with float32 clean frames, which tests do not modify."""
    out = tmp_path_factory.mktemp("mixed") / "ds"
    make(photos, out, *FLOAT_CLEAN)
    return out


@pytest.fixture(scope="module")
def rounded(photos: Path, make: Make, mixed: Path) -> Path:
    """The same dataset with rounded clean frames."""
    out = mixed.parent / "rounded"
    make(photos, out, *NIGHT)
    return out


def test_clean_frames_are_float32_and_noisy_frames_do_not_change(mixed: Path, rounded: Path) -> None:
    for (clean, noisy, row), (levels, other, of_rounded) in zip(RawPairs(mixed), RawPairs(rounded), strict=True):
        assert (clean.dtype, noisy.dtype) == (np.float32, np.uint16)
        assert (row["dtype"], row["clean_dtype"], of_rounded["clean_dtype"]) == ("uint16", "float32", "")
        assert np.array_equal(noisy, other)
        span_dn = row["white_level_dn"] - row["black_level_dn"]
        dn = clean.astype(np.float64) * span_dn + row["black_level_dn"]
        assert np.abs(dn - levels).max() <= 0.5 + 1e-3
        assert 0 <= clean.min() <= clean.max() <= 1


def test_every_byte_is_verified_and_every_pair_regenerated(mixed: Path, photos: Path) -> None:
    assert verify(mixed) == []
    again = list(replay(read_rows(mixed / "manifest.csv"), str(photos)))
    assert len(again) == 13
    assert not any(one.complaint for one in again)


def test_plan_warns_of_rounded_clean_frames_only(photos: Path, run_main: RunMain) -> None:
    assert "no denoiser exceeds a PSNR" in run_main("plan", *NIGHT, f"source.root={photos}").out
    assert "no denoiser exceeds a PSNR" not in run_main("plan", *FLOAT_CLEAN, f"source.root={photos}").out


def test_frames_are_developed_and_converted_to_dn(mixed: Path) -> None:
    clean, noisy, row = RawPairs(mixed)[0]
    dn = mosaic_dn(clean, row)
    assert row["black_level_dn"] <= dn.min() <= dn.max() <= row["white_level_dn"]
    assert np.array_equal(mosaic_dn(noisy, row), noisy)
    rounded = np.rint(dn).astype(np.uint16)
    difference = ug.develop(clean, row).astype(int) - ug.develop(rounded, row)
    assert np.abs(difference).mean() < 8


def test_rounded_clean_frame_next_to_float32_is_refused(settings: Settings) -> None:
    with pytest.raises(ConfigError, match=r"output\.clean_dtype=uint16: .* expected float32 or null"):
        validate_config(settings("output.dtype=float32", "output.clean_dtype=uint16"))


def test_patches_and_packed_planes_have_float32_clean_frames(
    photos: Path, make: Make, tree_hash: Callable[[Path], str], tmp_path: Path
) -> None:
    overrides = (*FLOAT_CLEAN, "output.layout=packed", "source.patch=[grid,16]", "noise.levels=[800,6400]")
    make(photos, tmp_path / "ds", *overrides)
    for clean, noisy, row in RawPairs(tmp_path / "ds"):
        assert (clean.dtype, clean.shape) == (np.float32, (4, 8, 8))
        assert (noisy.dtype, noisy.shape) == (np.uint16, (4, 8, 8))
        assert row["clean_dtype"] == "float32"
    assert verify(tmp_path / "ds") == []
