"""Noise levels and draws of one clean frame, and frames of a clip: shared and separate parameters."""

from __future__ import annotations

import itertools
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets import Make, Settings, text_rows
from helpers.photographs import fill, pixels
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.planning.effect_selection import facts_of
from unprocess_gen.planning.plan import plan_pairs


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = fill(tmp_path_factory.mktemp("levels") / "p", 3)
    Image.fromarray(pixels(9, 160, 200)).save(folder / "large.png")
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff")
    return folder


@pytest.fixture(scope="module")
def many(photographs: Path, make: Make) -> Path:
    out = photographs.parent / "many"
    make(photographs, out, "noise=brooks2019", "noise.levels=3", "noise.draws=2", "output.pairs_per_shard=2")
    return out


def residuals(out: Path, source: str) -> dict[str, np.ndarray]:
    return {
        row["key"]: (noisy.astype(float) - clean).ravel()
        / np.sqrt(row["a_dn"] * (clean - 240.0).ravel() + row["b_dn2"])
        for clean, noisy, row in RawPairs(out)
        if row["source"] == source
    }


def test_there_is_one_row_per_pair_and_per_failure(many: Path) -> None:
    keys = [row["key"] for row in text_rows(many)]
    pairs = [f"-l{level:02d}d{draw:02d}" for level, draw in itertools.product(range(3), range(2))]
    assert keys == [
        *(f"0000000{index}{pair}" for index in range(3) for pair in pairs),
        "00000003",
        *(f"00000004{pair}" for pair in pairs),
    ]


def test_a_sample_has_one_clean_frame_and_all_noisy_ones(many: Path) -> None:
    with tarfile.open(many / "shards" / "shard-00000.tar") as shard:
        names = [name.partition(".")[2] for name in shard.getnames() if name.startswith("00000001.")]
    assert names == [
        *("clean.npy", "noisy.npy", "noisy.l00d01.npy", "noisy.l01d00.npy", "noisy.l01d01.npy"),
        *("noisy.l02d00.npy", "noisy.l02d01.npy", "json"),
    ]


def test_the_pairs_of_an_image_differ_in_noise_only(many: Path) -> None:
    own = {"key", "level", "draw", "a_dn", "b_dn2", "dark_variance_dn2", "noisy_xxh3"}
    own |= {"noisy_clipped_low", "noisy_clipped_high"}
    for _, some in itertools.groupby(text_rows(many), key=lambda row: row["key"][:8]):
        shared = [{name: value for name, value in row.items() if name not in own} for row in some]
        assert all(one == shared[0] for one in shared)


def test_levels_draw_their_own_profile_and_draws_share_it(many: Path) -> None:
    levels = {(row["level"], row["a_dn"], row["b_dn2"]) for row in text_rows(many) if row["source"] == "large.png"}
    assert len(levels) == 3
    assert len({a for _, a, _ in levels}) == 3


def test_noise_of_levels_and_draws_is_independent(many: Path, figure: Figure) -> None:
    """Tolerance: six standard errors of a correlation over 32,000 sites, each 0.0056."""
    found = np.corrcoef(list(residuals(many, "large.png").values()))
    assert found.shape == (6, 6)
    assert np.abs(found - np.eye(6)).max() < 6 / np.sqrt(32_000)
    figure("levels", f"largest correlation of noise {np.abs(found - np.eye(6)).max():.1g} over 32,000 sites")


def test_the_first_level_and_draw_equals_a_single_pair(
    many: Path, photographs: Path, make: Make, tmp_path: Path
) -> None:
    make(photographs, tmp_path / "one", "noise=brooks2019")
    first = {row["source"]: row["noisy_xxh3"] for row in text_rows(many) if row["key"].endswith(("l00d00", "3"))}
    assert {row["source"]: row["noisy_xxh3"] for row in text_rows(tmp_path / "one")} == first


def test_every_pair_is_regenerated_from_its_row(many: Path, photographs: Path, figure: Figure) -> None:
    assert verify(many) == []
    replayed = list(replay(read_rows(many / "manifest.csv"), str(photographs)))
    assert len(replayed) == 24
    assert [one for one in replayed if one.complaint] == []
    figure("levels", f"{sum(not one.complaint for one in replayed)} of {len(replayed)} pairs regenerated")


def test_levels_can_be_isos_of_a_physical_profile(photographs: Path, make: Make, tmp_path: Path) -> None:
    make(photographs, tmp_path / "ds", "noise=nikon_d850", "noise.levels=[100,800,6400]")
    found = [(row["iso"], row["dn_per_e"]) for row in text_rows(tmp_path / "ds") if row["source"] == "large.png"]
    gains = [float(gain) for _, gain in found]
    assert [iso for iso, _ in found] == ["100.0", "800.0", "6400.0"]
    np.testing.assert_allclose(np.array(gains) / gains[0], [1, 8, 64], rtol=1e-12)


def test_levels_can_be_pairs_of_numbers(photographs: Path, make: Make, tmp_path: Path) -> None:
    make(photographs, tmp_path / "ds", "noise=heteroscedastic", "noise.levels=[{a:1,b:4},{a:3,b:0}]")
    assert {(row["a_dn"], row["b_dn2"]) for row in text_rows(tmp_path / "ds") if row["status"] == "ok"} == {
        *(("1.0", "4.0"), ("3.0", "0.0"))
    }


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        (("noise.levels=0",), r"noise.levels=0: expected how many, 1 to 100"),
        (
            ("noise.levels=[800]",),
            r"noise.levels=\[800\]: 800 is not {a: …, b: …}; expected a list of them .*; for ISOs, choose a physical",
        ),
        (("noise.draws=0",), r"noise.draws=0: expected 1 to 100"),
        (("noise=nikon_d850", "noise.levels=[100,99]"), r"noise.iso=99: noise=nikon_d850 is calibrated for ISO 100 to"),
        (
            ("noise=nikon_d850", "noise.levels=[{a:1,b:1}]"),
            r"is not an ISO; expected a list of them for noise=nikon_d850",
        ),
        (("noise=nikon_d850", "noise.levels=2", "noise.full_well_e=9000"), r"the clean frame depends on the ISO"),
        (
            ("noise=canon_70d", "noise.levels=[100,800]"),
            r"full_well_e=28300\.0 ends below white .*effects\.full_well=off",
        ),
        (("noise=nikon_d850", "noise.levels=2", "clean.includes_fixed_pattern=true"), r"depends on the ISO"),
    ],
)
def test_contradictory_levels_are_refused(settings: Settings, overrides: tuple[str, ...], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        validate_config(settings(*overrides))


# Clips ----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips of four frames each with static content, and a photograph."""
    folder = tmp_path_factory.mktemp("clips")
    for number, clip in enumerate(("one", "two/deep")):
        (folder / clip).mkdir(parents=True)
        for frame in range(4):
            still = np.clip(pixels(number, 96, 128).astype(int) + (frame > 0), 0, 255).astype(np.uint8)
            Image.fromarray(still).save(folder / clip / f"{frame}.png")
    Image.fromarray(pixels(7, 12, 16)).save(folder / "alone.png")
    return folder


PHYSICAL = ("source.clips=true", "noise=nikon_d850", "noise.scatter=unit", "noise.iso=3200", "effects.prnu=on")


@pytest.fixture(scope="module")
def filmed(clips: Path, make: Make) -> Path:
    make(clips, clips.parent / "filmed", *PHYSICAL)
    return clips.parent / "filmed"


def test_each_folder_is_a_clip_whose_frames_are_in_order(filmed: Path) -> None:
    assert [(row["source"], row["clip"], row["frame"]) for row in text_rows(filmed)] == [
        ("alone.png", ".", "0"),
        *((f"one/{frame}.png", "one", str(frame)) for frame in range(4)),
        *((f"two/deep/{frame}.png", "two/deep", str(frame)) for frame in range(4)),
    ]


DRAWN = ("stream_key", "rgb2cam_00", "red_gain", "inverse_rgb_gain", "b_dn2", "row_std_dn", "body_key")


def test_frames_of_a_clip_share_drawn_parameters(filmed: Path) -> None:
    drawn = {clip: {tuple(row[name] for name in DRAWN) for row in some} for clip, some in by_clip(filmed).items()}
    assert {clip: len(found) for clip, found in drawn.items()} == {".": 1, "one": 1, "two/deep": 1}
    for position in range(len(DRAWN)):
        assert len({next(iter(found))[position] for found in drawn.values()}) == 3


def by_clip(out: Path) -> dict[str, list[dict[str, str]]]:
    found: dict[str, list[dict[str, str]]] = {}
    for row in text_rows(out):
        found.setdefault(row["clip"], []).append(row)
    return found


def test_noise_of_frames_is_independent(filmed: Path) -> None:
    """Tolerance: six standard errors of a correlation over 12,288 sites."""
    frames = [noisy.astype(float) - clean for clean, noisy, row in RawPairs(filmed) if row["clip"] == "one"]
    found = np.corrcoef([(frame - frame.mean(axis=1, keepdims=True)).ravel() for frame in frames])
    assert np.abs(found - np.eye(4)).max() < 6 / np.sqrt(12_288)


def test_another_clip_changes_nothing(clips: Path, filmed: Path, make: Make, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(clips, tmp_path / "clips"))
    shutil.rmtree(copy / "one")
    make(copy, tmp_path / "ds", *PHYSICAL)
    kept = {row["source"]: row["noisy_xxh3"] for row in text_rows(filmed) if row["clip"] != "one"}
    assert {row["source"]: row["noisy_xxh3"] for row in text_rows(tmp_path / "ds")} == kept


def test_a_copied_clip_has_its_own_parameters(clips: Path, make: Make, tmp_path: Path) -> None:
    copy = tmp_path / "clips"
    shutil.copytree(clips / "one", copy / "a")
    shutil.copytree(clips / "one", copy / "b")
    make(copy, tmp_path / "ds", *PHYSICAL)
    assert len({row["stream_key"] for row in text_rows(tmp_path / "ds")}) == 2


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise=canon_70d", "noise.levels=[800,3200]"),
        ("noise=canon_70d", "noise.levels=[100,800]", "effects.full_well=off"),
    ],
)
def test_levels_are_accepted_if_the_full_well_cannot_change_the_clean_frame(
    overrides: tuple[str, ...], settings: Settings
) -> None:
    """The converter ends before the well at these ISOs."""
    config = settings(*overrides)
    validate_config(config)
    plans = plan_pairs(config, "0" * 64, facts=facts_of(np.full((2, 2, 3), 255, np.uint8)))
    assert {plan.brightest for plan in plans} == {1.0}
