"""Patches: each is the cut-out of its full frame's pair, bit for bit, wherever it lies and however it was made."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.datasets import text_rows as rows
from helpers.noise_fits import dataset_fits
from helpers.photographs import fill, pixels
from helpers.promise_report import Figure
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.config.interpretation import PatchRule
from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml, read_dataset_yaml
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.reports.estimate import estimate_run
from unprocess_gen.reports.plan_text import format_estimate
from unprocess_gen.sources.listing import list_photographs
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import list_patches

GRID, STRIDE, RANDOM = "source.patch=32", "source.patch=[grid,32,18]", "source.patch=[random,30,5]"
LEVELS = ("noise=brooks2019", "noise.levels=2", "noise.draws=2")
BRANCH = "{iso:[100,6400],dn_per_e:2,read_std_dn:3,row_std_dn:2,column_std_dn:2,black_error_dn:[1,-2,3,-4]}"
EVERY_EFFECT = (
    *("noise=nikon_d850", "noise.iso=3200", "effects.all=on", f"noise.branches=[{BRANCH}]", "noise.prnu_std=0.03"),
    *("noise.dark_e_per_s=1000", "noise.hot_pixel_share=0.01", "noise.hot_pixel_e_per_s=100000"),
    *("noise.dead_pixel_share=0.01", "noise.full_well_e=1500", "scene.exposure_s=0.02"),
)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs of even and odd sides, one of 16 bits, and one that no photograph can be made of."""
    folder = tmp_path_factory.mktemp("patches") / "photos"
    folder.mkdir()
    Image.fromarray(pixels(1, 64, 96)).save(folder / "a.png")
    Image.fromarray(pixels(2, 71, 67)).save(folder / "b.png")
    (folder / "c.jpg").write_bytes(b"\xff\xd8\xff")
    Image.fromarray(pixels(4, 33, 140)).save(folder / "d.png")
    return folder


@pytest.fixture(scope="module")
def cut_up(sources: Path, make: Make) -> Path:
    """Random patches of two levels and two draws; a shard holds two photographs."""
    make(sources, sources.parent / "cut_up", *LEVELS, RANDOM, "output.pairs_per_shard=2")
    return sources.parent / "cut_up"


def pair_of(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["source"], int(row.get("level") or 0), int(row.get("draw") or 0)


def assert_cut_outs(patched: Path, full: Path) -> int:
    """Compare every pair of a dataset of patches with the crop of the full image's pair; return their number."""
    frames = {pair_of(sample.row): sample for sample in RawPairs(full)}
    for clean, noisy, row in RawPairs(patched):
        frame, (height, width), (y, x) = frames[pair_of(row)], clean.shape, (row["patch_y"], row["patch_x"])
        np.testing.assert_array_equal(clean, frame.clean[y : y + height, x : x + width])
        np.testing.assert_array_equal(noisy, frame.noisy[y : y + height, x : x + width])
    assert {pair_of(sample.row) for sample in RawPairs(patched)} == frames.keys()
    return len(RawPairs(patched))


# A patch is the cut-out of its full frame's pair ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        LEVELS,
        pytest.param(
            ("noise.law=poisson", "source.dequantize=dither", "gains.highlight=gray_mean"), marks=pytest.mark.slow
        ),
        pytest.param(("noise=nikon_d850", "noise.iso=6400", "effects.prnu=on"), marks=pytest.mark.slow),
        pytest.param((*EVERY_EFFECT, "noise.draws=2", "sensor.saturated=white"), marks=pytest.mark.slow),
        (*EVERY_EFFECT, "clean.includes_fixed_pattern=true"),
        pytest.param(("scene.exposure_ratio=20", "sensor.clip=black"), marks=pytest.mark.slow),
    ],
    ids=["levels", "poisson", "physical", "every effect", "averaged", "dark"],
)
def test_patch_equals_the_crop_of_its_full_pair(
    overrides: tuple[str, ...], sources: Path, make: Make, tmp_path: Path, figure: Figure
) -> None:
    make(sources, tmp_path / "full", *overrides)
    equal = 0
    for number, patch in enumerate((GRID, STRIDE, RANDOM)):
        make(sources, tmp_path / f"patched{number}", *overrides, patch)
        crops = assert_cut_outs(tmp_path / f"patched{number}", tmp_path / "full")
        assert crops >= 14, patch
        equal += crops
    figure("patches", f"{equal} patches are crops of their frames")


def test_frames_of_a_clip_have_patches_at_the_same_places(make: Make, tmp_path: Path) -> None:
    for clip, frame in ((clip, frame) for clip in ("one", "two") for frame in range(3)):
        (tmp_path / "clips" / clip).mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels(frame + 7 * len(clip), 60, 80)).save(tmp_path / "clips" / clip / f"{clip}{frame}.png")
    for name, patch in (("full", "source.patch=null"), ("patched", RANDOM)):
        make(tmp_path / "clips", tmp_path / name, "source.clips=true", *EVERY_EFFECT, "noise.draws=2", patch)
    assert assert_cut_outs(tmp_path / "patched", tmp_path / "full") == 6 * 5 * 2
    corners = {
        (row["clip"], row["frame"], row["patch"], row["patch_y"], row["patch_x"]) for row in rows(tmp_path / "patched")
    }
    assert len(corners) == 30
    assert len({(clip, *corner) for clip, _, *corner in corners}) == 10


def test_patches_are_cut_after_downscaling(sources: Path, make: Make, tmp_path: Path) -> None:
    for name, patch in (("full", "source.patch=null"), ("patched", "source.patch=[grid,16,8]")):
        make(sources, tmp_path / name, "source.downscale=2", "source.dequantize=dither", patch)
    assert assert_cut_outs(tmp_path / "patched", tmp_path / "full") > 0


OWN = {
    *("key", "shard", "width", "height", "patch", "patch_y", "patch_x", "clean_xxh3", "noisy_xxh3", "saturated"),
    *("clean_clipped_low", "clean_clipped_high", "noisy_clipped_low", "noisy_clipped_high", "zero_variance"),
}
"""What a patch does not share with its full frame."""


def test_patches_share_the_plan_of_their_image(sources: Path, make: Make, tmp_path: Path) -> None:
    for name, patch in (("full", "source.patch=null"), ("patched", "source.patch=16")):
        make(sources, tmp_path / name, "noise=nikon_d850", "scene=night", "noise.draws=2", patch, "source.limit=1")
    shared = {pair_of(row): {name: row[name] for name in row if name not in OWN} for row in rows(tmp_path / "full")}
    for row in rows(tmp_path / "patched"):
        assert {name: row[name] for name in row if name not in OWN} == shared[pair_of(row)]


def test_counts_of_tiling_patches_add_up_to_the_image(sources: Path, make: Make, tmp_path: Path) -> None:
    """64 x 96 pixels, all of them in one patch of 32 x 32."""
    settings = ("source.limit=1", "noise=imx385_iso25600")
    one = make(sources, tmp_path / "full", *settings)
    many = make(sources, tmp_path / "patched", *settings, GRID)
    assert many.sites == one.sites
    assert min(many.sites["saturated"], many.sites["noisy_clipped_high"]) > 0


# Places ---------------------------------------------------------------------------------------------------------------

lengths = st.integers(1, 100).map(lambda half: 2 * half)
sizes = st.integers(0, 300)


@given(lengths, lengths, sizes, sizes)
def test_grid_contains_every_place_at_its_stride(side: int, stride: int, down: int, right: int) -> None:
    height, width = side + down, side + right
    found = list_patches(PatchRule("grid", side, stride=stride), 0, height, width)
    wanted = [(y, x) for y in range(0, down + 1, stride) for x in range(0, right + 1, stride)]
    assert [patch.origin for patch in found] == wanted
    assert [patch.patch for patch in found] == list(range(len(wanted)))


@given(lengths, sizes, sizes, st.integers(0, 2**64 - 1))
def test_random_places_are_even_and_inside(side: int, down: int, right: int, key: int) -> None:
    for patch in list_patches(PatchRule("random", side, count=20), key, side + down, side + right):
        assert (patch.patch_y % 2, patch.patch_x % 2, patch.height, patch.width) == (0, 0, side, side)
        assert 0 <= patch.patch_y <= down
        assert 0 <= patch.patch_x <= right


def test_random_places_are_uniform() -> None:
    """64 x 64 places, 16 cells a side, 10,000 patches: no count is six standard deviations from the mean of 625."""
    found = np.array([patch.origin for patch in list_patches(PatchRule("random", 2, count=10_000), 3, 128, 128)])
    for axis in found.T:
        counts = np.bincount(axis // 8, minlength=16)
        assert np.abs(counts - 625).max() < 6 * np.sqrt(625)
    assert abs(np.corrcoef(found.T)[0, 1]) < 6 / 100


def test_random_places_are_the_same_on_every_machine() -> None:
    """The words are Philox's (`test_streams`), the rest is integer arithmetic; more patches move none."""
    few, many = (list_patches(PatchRule("random", 128, count=n), 0x0123456789ABCDEF, 2160, 2880) for n in (3, 100))
    assert [patch.origin for patch in few] == [(1662, 92), (166, 2310), (1910, 72)]
    assert many[:3] == few


# The setting ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spellings", "canonical"),
    [
        (("null",), None),
        (("128", "[grid,128]", "[grid,128,128]"), ["grid", 128, 128]),
        (("[grid,128,64]",), ["grid", 128, 64]),
        (("[random,128,16]",), ["random", 128, 16]),
    ],
)
def test_spellings_of_a_patch_setting_give_one_config_yaml(
    spellings: tuple[str, ...], canonical: object, settings: Settings, tmp_path: Path
) -> None:
    texts = {dataset_yaml(settings(f"source.patch={spelling}")) for spelling in spellings}
    assert len(texts) == 1
    assert yaml.safe_load(texts.copy().pop())["source"]["patch"] == canonical
    (tmp_path / "config.yaml").write_text(next(iter(texts)))
    assert dataset_yaml(read_dataset_yaml(tmp_path / "config.yaml")[0]) == texts.pop()


IMPOSSIBLE = (
    *("0", "127", "32770", "2.0", "true", "wide", "[]", "{a:1}", "[128]", "[grid]", "[grid,8,3]", "[grid,8,8,8]"),
    *("[random,8]", "[random,7,1]", "[random,8,10001]", "[random,8,1.5]", "[spiral,8,8]"),
)


def test_impossible_patch_settings_are_refused_and_their_limits_accepted(settings: Settings) -> None:
    for value in IMPOSSIBLE:
        with pytest.raises(ConfigError, match=r"^source\.patch=.*: expected null, a side, \[grid, side\], ") as caught:
            validate_config(settings(f"source.patch={value}"))
        assert "\n" not in str(caught.value)
    for value in ("2", "[grid,2,32768]", "[random,32768,10000]"):
        validate_config(settings(f"source.patch={value}"))


# Too small ------------------------------------------------------------------------------------------------------------


def test_image_smaller_than_a_patch_is_too_small(make: Make, tmp_path: Path) -> None:
    for name, size in (("fits.png", (40, 40)), ("high.png", (90, 39)), ("wide.png", (39, 90))):
        (tmp_path / "p").mkdir(exist_ok=True)
        Image.fromarray(pixels(len(name), *size)).save(tmp_path / "p" / name)
    made = make(tmp_path / "p", tmp_path / "ds", "source.patch=[random,40,2]")
    assert [(row["key"], row["status"], row["reason"], row["patch"]) for row in rows(tmp_path / "ds")] == [
        *(("00000000-p0000", "ok", "", "0"), ("00000000-p0001", "ok", "", "1")),
        *(("00000001", "failed", "too_small", ""), ("00000002", "failed", "too_small", "")),
    ]
    assert (made.pairs, made.failed) == (2, {"too_small": 2})


def test_failure_of_a_small_image_is_explained(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", "source.patch=14")
    (source,) = list_photographs(config.source).sources
    why = r"too_small: 16 x 12 pixels contain no patch of 14 x 14 \(source.patch\)$"
    with pytest.raises(SourceError, match=f"^{why}"):
        load_source(config.source, source)
    assert "fails     000.png: too_small\n          16 x 12 pixels contain no patch" in planned(config)


def test_plan_reports_patches(sources: Path, settings: Settings) -> None:
    line = "patches   32 x 32, a grid, 32 apart: 4 to 6 per image\n"
    assert line in planned(settings(f"source.root={sources}", GRID))


def planned(config: Config) -> str:
    return format_estimate(estimate_run(config, 1, True))


# The dataset ----------------------------------------------------------------------------------------------------------


def test_every_pair_of_every_patch_has_a_row(cut_up: Path) -> None:
    pairs = [f"-p{patch:04d}-l{level:02d}d{draw:02d}" for patch in range(5) for level in range(2) for draw in range(2)]
    assert [row["key"] for row in rows(cut_up)] == [
        *(f"00000000{pair}" for pair in pairs),
        *(f"00000001{pair}" for pair in pairs),
        "00000002",
        *(f"00000003{pair}" for pair in pairs),
    ]


@pytest.mark.filterwarnings("ignore")  # those of another library
def test_the_webdataset_library_loads_every_patch_as_a_sample(cut_up: Path) -> None:
    wds = pytest.importorskip("webdataset")
    urls = [str(path) for path in sorted((cut_up / "shards").iterdir())]
    samples = list(wds.WebDataset(urls, shardshuffle=False, empty_check=False).decode())
    assert [sample["__key__"] for sample in samples] == [f"0000000{i}-p000{n}" for i in (0, 1, 3) for n in range(5)]
    pairs = iter(RawPairs(cut_up))
    for sample in samples:
        assert [sample["json"]["key"], *(row["key"] for row in sample["json"]["others"])] == [
            f"{sample['__key__']}-l{level:02d}d{draw:02d}" for level in range(2) for draw in range(2)
        ]
        for member in ("noisy.npy", "noisy.l00d01.npy", "noisy.l01d00.npy", "noisy.l01d01.npy"):
            clean, noisy, _ = next(pairs)
            np.testing.assert_array_equal(sample["clean.npy"], clean)
            np.testing.assert_array_equal(sample[member], noisy)


def test_adding_a_photograph_moves_no_other_patches(sources: Path, cut_up: Path, make: Make, tmp_path: Path) -> None:
    more = Path(shutil.copytree(sources, tmp_path / "more"))
    Image.fromarray(pixels(9, 50, 50)).save(more / "0.png")
    make(more, tmp_path / "ds", *LEVELS, RANDOM)
    names = ("source", "patch", "patch_y", "patch_x", "level", "draw", "noisy_xxh3")
    before, after = ([tuple(row[name] for name in names) for row in rows(out)] for out in (cut_up, tmp_path / "ds"))
    assert [row for row in after if row[0] != "0.png"] == before


# Verify, replay, repair -----------------------------------------------------------------------------------------------


def test_every_patch_is_replayed_from_its_row(sources: Path, make: Make, tmp_path: Path) -> None:
    make(sources, tmp_path / "ds", RANDOM, *EVERY_EFFECT, "source.downscale=1", "noise.draws=2")
    assert verify(tmp_path / "ds") == []
    replayed = list(replay(read_rows(tmp_path / "ds" / "manifest.csv"), str(sources)))
    assert len(replayed) == len(RawPairs(tmp_path / "ds"))
    assert [one for one in replayed if one.complaint] == []


def test_row_with_a_moved_patch_differs(cut_up: Path, sources: Path) -> None:
    row = next(read_rows(cut_up / "manifest.csv"))
    (moved,) = replay([{**row, "patch_x": int(row["patch_x"] or 0) ^ 2}], str(sources))
    (outside,) = replay([{**row, "patch_y": 36}], str(sources))
    assert moved.complaint.startswith("the XXH3-128 of clean is ")
    assert "its patch of 30 x 30 pixels at row 36, column " in outside.complaint


def test_damaged_patch_is_named_and_repaired(cut_up: Path, run_main: RunMain, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(cut_up, tmp_path / "ds"))
    path = copy / "shards" / "shard-00000.tar"
    content = bytearray(path.read_bytes())
    content[content.index(b"00000001-p0003.noisy.l01d01.npy") + 512 + 200] ^= 1
    path.write_bytes(content)

    assert [(one.key, one.member) for one in verify(copy)] == [("00000001-p0003", "noisy.l01d01.npy")]
    assert "shards/shard-00000.tar: regenerated" in run_main("verify", copy, "--repair").out
    assert path.read_bytes() == (cut_up / "shards" / "shard-00000.tar").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("side", [16, 64])
def test_fitted_noise_of_small_patches_matches_their_rows(side: int, make: Make, tmp_path: Path) -> None:
    """Few sites give large errors of the fit. The largest of 800 standard normal values is below 5."""
    make(None, tmp_path / "ds", "source.limit=2", f"source.patch=[random,{side},400]")
    found = dataset_fits(tmp_path / "ds")
    assert len(found) > 300
    assert max(one.deviation for one in found) < 5
