"""Dark-shading maps: what is subtracted, how a map is chosen, and what datasets with a map promise."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.dark_frames import banded
from helpers.datasets import Make, TreeHash
from helpers.photographs import pixels
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.api import RawPair
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import DarkFrames
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.reader import RawPairs
from unprocess_gen.sources.dark_frames import open_dark_frames

NOISE = ("noise=sony_a7s2", "noise.iso=1600", "camera=identity", "gains=unity", "sensor.bits=14",
         "sensor.black_level_dn=512", "sensor.white_level_dn=16300")  # fmt: skip
"""A profile whose DN are those of the sensor, so that dark frames are not scaled."""
NARROW = ("sensor=generic_14bit", "sensor.white_level_dn=16383", "sensor.black_level_dn=1024")
"""A sensor to which dark frames are scaled."""
SHAPE = (70, 90)
BLACK_DN = 512
RAMP = np.add.outer(np.arange(SHAPE[0]) % 7, np.arange(SHAPE[1]) // 5)
"""Integer shading of 0 to 23 DN, with an edge in each direction that shows where a site of the map is."""


def shaded(seed: int, std: float = 3.0) -> np.ndarray:
    """Return a dark frame with the shading `RAMP`."""
    return banded(seed, SHAPE, BLACK_DN, std) + RAMP.astype(np.uint16)


def save_shaded(folder: Path, count: int, std: float = 3.0) -> Path:
    """Write dark frames with the shading `RAMP`; return the folder."""
    folder.mkdir(parents=True)
    for number in range(count):
        np.save(folder / f"dark{number}.npy", shaded(number, std))
    return folder


def save_map(path: Path, values: np.ndarray) -> Path:
    """Write a map as an NPY file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values)
    return path


def sha256_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def with_frames(folder: Path, *overrides: str) -> ug.Config:
    return ug.load_config([*NOISE, f"noise.dark_frames={folder}", *overrides])


def with_map(folder: Path, shading: object, *overrides: str) -> ug.Config:
    return with_frames(folder, f"noise.dark_shading={shading}", *overrides)


def described(folder: Path, shading: object, *overrides: str) -> DarkFrames:
    """Return what a run knows about frames and map."""
    _, frames, _ = open_dark_frames(with_map(folder, shading, *overrides))
    assert frames is not None
    return frames


@pytest.fixture(scope="module")
def darks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_shaded(tmp_path_factory.mktemp("darks") / "iso1600", 3)


@pytest.fixture(scope="module")
def ramp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a map of the shading in DN of the frames."""
    return save_map(tmp_path_factory.mktemp("ramp") / "ramp.npy", (RAMP + BLACK_DN).astype(np.float32))


def black_pair(config: ug.Config, shape: tuple[int, int] = SHAPE) -> RawPair:
    """Return the pair of a black photograph."""
    return ug.make_pair(np.zeros((*shape, 3), np.uint8), config)


# What is subtracted ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(40, 50), (150, 200)], ids=["inside", "repeated"])
def test_map_is_subtracted_at_the_place_of_its_frame(darks: Path, ramp: Path, shape: tuple[int, int]) -> None:
    """Both pairs have the same frame, place and dither, so they differ by the integer map exactly."""
    median = "noise.dark_frames_level=median"
    kept, removed = black_pair(with_frames(darks, median), shape), black_pair(with_map(darks, ramp), shape)
    y, x = kept.plan.noise.dark.shift
    expected = np.tile(RAMP, (5, 5))[y : y + shape[0], x : x + shape[1]]
    difference = kept.noisy.astype(int) - removed.noisy
    # without a stated level, the black level of the frames is their median, which contains that of the shading
    np.testing.assert_array_equal(difference, expected - (described(darks, "keep", median).black_dn - BLACK_DN))
    np.testing.assert_array_equal(kept.clean, removed.clean)


def test_mean_of_the_frames_as_a_map_equals_remove(darks: Path, tmp_path: Path) -> None:
    mean = np.mean([np.load(path) for path in sorted(darks.glob("*.npy"))], axis=0)
    by_hand = black_pair(with_map(darks, save_map(tmp_path / "mean.npy", mean)))
    removed = black_pair(with_map(darks, "remove"))
    np.testing.assert_array_equal(by_hand.noisy, removed.noisy)
    different = {name for name in removed.row if removed.row[name] != by_hand.row[name]}
    assert different == {"dark_shading"}


def test_map_above_black_equals_map_with_black(darks: Path, tmp_path: Path) -> None:
    values = RAMP + BLACK_DN + np.arange(90) % 8 / 8  # exact in float32 with and without black
    above, level = save_map(tmp_path / "above.npy", values - BLACK_DN), f"noise.dark_frames_black_dn={BLACK_DN}"
    pairs = [black_pair(with_map(darks, place, level)) for place in (save_map(tmp_path / "dn.npy", values), above)]
    np.testing.assert_array_equal(pairs[0].noisy, pairs[1].noisy)
    assert [pair.plan.noise.dark.black_dn for pair in pairs] == [0, BLACK_DN]
    assert [described(darks, above, level).shading.black_dn, described(darks, "remove").shading.black_dn] == [512, 0]  # type: ignore[union-attr]


def test_black_level_of_unlabelled_frames_follows_from_a_map_above_black(darks: Path, tmp_path: Path) -> None:
    """The median of the frames contains that of the shading; used as black level, it would darken the noisy frames."""
    above = save_map(tmp_path / "above.npy", RAMP - 1.5)  # the map lacks a black error of 1.5 DN
    frames = described(darks, above)
    assert frames.shading is not None
    assert frames.black_dn == frames.shading.black_dn == pytest.approx(BLACK_DN + 1.5, abs=1)
    assert frames.shading.residual_dn == 0
    residual = black_pair(with_map(darks, above)).noisy.astype(float) - BLACK_DN
    assert np.median(residual) == pytest.approx(0, abs=0.5)
    stated = described(darks, above, f"noise.dark_frames_black_dn={BLACK_DN}")
    assert stated.black_dn == BLACK_DN
    assert stated.shading is not None and stated.shading.residual_dn == pytest.approx(1.5, abs=1)


def test_map_with_another_black_error_is_refused(darks: Path, tmp_path: Path) -> None:
    above = save_map(tmp_path / "above.npy", RAMP - 6.0)
    with pytest.raises(ConfigError, match=r"the median of the dark frames minus the map is [56]"):
        described(darks, above, f"noise.dark_frames_black_dn={BLACK_DN}")


def test_map_keeps_the_noise_that_the_mean_of_few_frames_takes(tmp_path: Path, ramp: Path) -> None:
    """The mean of N frames contains 1/N of their variance, and a map of many frames contains none of it."""
    save_shaded(tmp_path / "two", 2)
    variance = 3.0**2 * (1 + 1 / 4 + 1 / 9) + 1 / 12
    assert described(tmp_path / "two", ramp).variance_dn2 == pytest.approx(variance + 1 / 12, rel=0.1)
    assert described(tmp_path / "two", "remove").variance_dn2 == pytest.approx(variance / 2 + 1 / 12, rel=0.15)


def test_one_frame_is_enough_with_a_map(tmp_path: Path, ramp: Path) -> None:
    save_shaded(tmp_path / "one", 1)
    residual = black_pair(with_map(tmp_path / "one", ramp)).noisy - float(BLACK_DN)
    assert residual.std() == pytest.approx(3.0 * (1 + 1 / 4 + 1 / 9) ** 0.5, rel=0.1)
    with pytest.raises(ConfigError, match="the mean of one dark frame is the frame itself"):
        described(tmp_path / "one", "remove")


def test_map_is_scaled_like_its_frame(darks: Path, ramp: Path) -> None:
    scaled = black_pair(with_map(darks, ramp, *NARROW, "effects.dead_pixels=off"))
    frame = shaded([sha256_of(darks / f"dark{number}.npy") for number in range(3)].index(scaled.plan.noise.dark.sha256))
    y, x = scaled.plan.noise.dark.shift
    expected = (frame.astype(int) - RAMP - BLACK_DN)[y:, x:] * (16383 - 1024) / (16300 - 512)
    assert np.abs(scaled.noisy[: SHAPE[0] - y, : SHAPE[1] - x] - 1024.0 - expected).max() <= 1


# Files and choice -----------------------------------------------------------------------------------------------------


def test_formats_of_maps_give_the_same_pixels(darks: Path, ramp: Path, tmp_path: Path) -> None:
    values = RAMP + BLACK_DN
    cv2.imwrite(str(tmp_path / "a.png"), values.astype(np.uint16))
    cv2.imwrite(str(tmp_path / "b.TIFF"), values.astype(np.uint16))
    cv2.imwrite(str(tmp_path / "c.tif"), values.astype(np.float32))
    for dtype in ("uint16", "int32", "float32", "float64", ">f4"):
        save_map(tmp_path / f"{dtype.replace('>', 'big')}.npy", values.astype(dtype))
    expected = black_pair(with_map(darks, ramp)).noisy
    files = sorted(tmp_path.iterdir())
    assert len(files) == 8
    for path in files:
        np.testing.assert_array_equal(black_pair(with_map(darks, path)).noisy, expected, err_msg=path.name)


def test_raw_file_is_a_map(tmp_path: Path, run_main: RunMain, make: Make) -> None:
    pytest.importorskip("rawpy")
    make(None, tmp_path / "ds", "source.limit=1", "scene.exposure_ratio=10000", *NOISE)
    assert run_main("dng", tmp_path / "ds", "--keys", "0", "--to", tmp_path / "raw").code == 0
    (tmp_path / "darks").mkdir()
    (noisy,) = (tmp_path / "raw").glob("*noisy*")
    noisy.rename(tmp_path / "darks/dark.dng")
    (clean,) = (tmp_path / "raw").glob("*clean*")
    shading = described(tmp_path / "darks", clean).shading
    assert shading is not None
    assert (shading.file, shading.black_dn) == (clean.name, 0)


@pytest.mark.parametrize("name", ["iso1600.npy", "A7S2_ISO-1600.NPY", "darkshading iso 1600 v2.npy"])
def test_map_of_a_folder_is_chosen_by_the_iso_in_its_name(name: str, darks: Path, ramp: Path, tmp_path: Path) -> None:
    for iso in (100, 16, 160, 16000):
        save_map(tmp_path / f"iso{iso}.npy", np.full(SHAPE, BLACK_DN, np.uint16))
    (tmp_path / "iso1600.txt").write_text("not a map")
    shutil.copy(ramp, tmp_path / name)
    pair = black_pair(with_map(darks, tmp_path))
    assert pair.row["dark_shading"] == sha256_of(ramp)
    np.testing.assert_array_equal(pair.noisy, black_pair(with_map(darks, ramp)).noisy)


def test_iso_of_the_scene_chooses_the_map(darks: Path, ramp: Path, tmp_path: Path) -> None:
    shutil.copy(ramp, tmp_path / "iso3200.npy")
    config = with_map(darks, tmp_path, "noise.iso=null", "scene.iso=3200")
    assert black_pair(config).row["dark_shading"] == sha256_of(ramp)


def refusal(run_main: RunMain, darks: Path, shading: object, *overrides: str) -> str:
    """Return the one line with which a run refuses a map; nothing is written."""
    places = f"noise.dark_frames={darks}", f"noise.dark_shading={shading}"
    done = run_main(*NOISE, *places, "source.limit=1", "out=refused", *overrides)
    assert (done.code, done.err.count("\n")) == (2, 1), done.err
    assert not Path("refused").exists()
    return done.err


def test_missing_iso_is_refused_with_those_that_exist(
    darks: Path, ramp: Path, run_main: RunMain, tmp_path: Path
) -> None:
    for name in ("iso400.npy", "iso800.npy", "iso12800.tif"):
        shutil.copy(ramp, tmp_path / name)
    assert "contains no map of ISO 1600; expected one; its maps are of ISO 400, 800, 12800" in refusal(
        run_main, darks, tmp_path
    )
    assert "is of ISO 800 by its name; expected ISO 1600" in refusal(run_main, darks, tmp_path / "iso800.npy")


def test_several_maps_of_one_iso_are_refused(darks: Path, ramp: Path, run_main: RunMain, tmp_path: Path) -> None:
    for name in ("iso1600.npy", "ISO_1600.npy"):
        shutil.copy(ramp, tmp_path / name)
    assert "several maps of ISO 1600: ISO_1600.npy, iso1600.npy; expected one" in refusal(run_main, darks, tmp_path)


def test_folder_without_maps_is_refused(darks: Path, run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    assert "contains no map with its ISO in its name; expected a file such as iso1600.npy" in refusal(
        run_main, darks, tmp_path / "maps"
    )


WITH_NAN = np.where(RAMP == 5, np.nan, BLACK_DN)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (np.full((70, 92), 512.0), "the map has 92 x 70 pixels; expected those of every dark frame; "),
        (np.zeros((70, 90, 3)), "is float64 [70, 90, 3]; expected a mosaic [H, W] of integers or floats"),
        (np.zeros(SHAPE, complex), "is complex128"),
        (WITH_NAN, "has values that are not finite; expected numbers at all sites"),
        (np.full(SHAPE, 1024.0), "the median of the dark frames minus the map is -50"),
    ],
    ids=["size", "colours", "complex", "nan", "black"],
)
def test_map_that_does_not_fit_is_refused(
    values: np.ndarray, sentence: str, darks: Path, run_main: RunMain, tmp_path: Path
) -> None:
    assert sentence in refusal(run_main, darks, save_map(tmp_path / "map.npy", values))


def test_file_that_is_no_map_is_refused(darks: Path, run_main: RunMain, tmp_path: Path) -> None:
    for name in ("a.npy", "a.png", "a.tif"):
        (tmp_path / name).write_bytes(b"not a map")
        assert "cannot be decoded" in refusal(run_main, darks, tmp_path / name)


def test_other_words_are_refused(darks: Path, run_main: RunMain) -> None:
    sentence = "noise.dark_shading=removed: no such file or folder; expected keep, remove, or a dark-shading map"
    assert sentence in refusal(run_main, darks, "removed")
    assert "expected keep, remove, a map" in refusal(run_main, darks, "''")
    assert "maps are read from a local folder only" in refusal(run_main, darks, "s3://bucket/iso1600.npy")
    digest = f"noise.dark_shading_sha256={'0' * 64}"
    assert "noise.dark_shading_sha256 names a map" in refusal(run_main, darks, "remove", digest)
    assert "noise.dark_shading is missing" in refusal(run_main, darks, "keep", digest)
    assert "noise.dark_shading_sha256=x: expected 64" in refusal(run_main, darks, "keep", "noise.dark_shading_sha256=x")


def test_map_needs_dark_frames(ramp: Path, run_main: RunMain) -> None:
    done = run_main(*NOISE, f"noise.dark_shading={ramp}", "source.limit=1")
    assert (done.code, "there are no dark frames; give noise.dark_frames=FOLDER" in done.err) == (2, True)


# Datasets -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures") / "p"
    folder.mkdir()
    for number, (height, width) in enumerate(((40, 50), (69, 90), (101, 213))):
        Image.fromarray(pixels(number, height, width)).save(folder / f"{number}.png")
    return folder


@pytest.fixture(scope="module")
def maps(ramp: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of maps for three ISOs."""
    folder = tmp_path_factory.mktemp("maps") / "a7s2"
    for iso in (800, 3200):
        save_map(folder / f"iso{iso}.npy", np.full(SHAPE, BLACK_DN, np.uint16))
    shutil.copy(ramp, folder / "iso1600.npy")
    return folder


@pytest.fixture(scope="module")
def overrides(darks: Path, maps: Path) -> tuple[str, ...]:
    return (*NOISE, f"noise.dark_frames={darks}", f"noise.dark_shading={maps}", "output.pairs_per_shard=2")


@pytest.fixture(scope="module")
def made(pictures: Path, overrides: tuple[str, ...], make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "ds"
    make(pictures, out, *overrides)
    return out


def test_dataset_records_digest_and_place_of_the_map(made: Path, ramp: Path, maps: Path) -> None:
    digest = sha256_of(ramp)
    assert {row["dark_shading"] for row in read_rows(made / "manifest.csv")} == {digest}
    text = (made / "config.yaml").read_text(encoding="utf-8")
    assert f"dark_shading_sha256: {digest}\n" in text
    assert "dark_shading:" not in text and str(maps) not in text
    assert json.loads((made / "dataset.json").read_text())["dark_frames"]["shading"] == str(maps / "iso1600.npy")


def test_config_without_a_map_is_recorded_as_before(darks: Path, pictures: Path, make: Make, tmp_path: Path) -> None:
    """The settings keep and remove mean and record the same as before maps."""
    for word, recorded in (("keep", False), ("remove", True)):
        make(pictures, tmp_path / word, *NOISE, f"noise.dark_frames={darks}", f"noise.dark_shading={word}")
        text = (tmp_path / word / "config.yaml").read_text(encoding="utf-8")
        assert ("  dark_shading: remove\n" in text, "dark_shading_sha256" in text) == (recorded, False)
        assert "shading" not in json.loads((tmp_path / word / "dataset.json").read_text())["dark_frames"]


def test_jobs_parts_and_names_change_no_byte(
    made: Path, pictures: Path, overrides: tuple[str, ...], ramp: Path, make: Make, run_main: RunMain,
    tree_hash: TreeHash, tmp_path: Path,
) -> None:  # fmt: skip
    make(pictures, tmp_path / "jobs", *overrides, f"noise.dark_shading={ramp}", n_jobs=2)
    assert tree_hash(tmp_path / "jobs") == tree_hash(made)
    assert run_main("prepare", "parts=2", f"source.root={pictures}", *overrides, "out=ds").code == 0
    for part in (1, 0):
        done = run_main("part", "ds", part)
        assert done.code == 0, done.err
    assert run_main("merge", "ds").code == 0
    assert tree_hash(tmp_path / "ds") == tree_hash(made)


def test_rows_replay_with_recorded_and_moved_maps(made: Path, maps: Path, run_main: RunMain, tmp_path: Path) -> None:
    shutil.copy(maps / "iso1600.npy", tmp_path / "any_name.npy")
    moved = shutil.copytree(maps, tmp_path / "moved")
    for words in ([], [f"noise.dark_shading={moved}"], ["--dark-shading", tmp_path / "any_name.npy"]):
        done = run_main("replay", made, *words)
        assert (done.code, done.out.split(";")[0]) == (0, "3 pairs are the same, bit for bit"), done.err
    assert run_main("verify", made, "--regenerate", "2", f"noise.dark_shading={moved}").code == 0
    assert {result.complaint for result in ug.replay(made, dark_shading=moved)} == {""}


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("moved", "no such file or folder"),
        ("changed", "has the SHA-256 "),
        ("other folder", "has no such map; expected the dark-shading map with the SHA-256 "),
    ],
)
def test_map_that_is_missing_or_changed_is_refused(
    fault: str, sentence: str, pictures: Path, darks: Path, ramp: Path, make: Make, run_main: RunMain, tmp_path: Path
) -> None:
    place = Path(shutil.copy(ramp, tmp_path / "map.npy"))
    make(pictures, tmp_path / "ds", *NOISE, f"noise.dark_frames={darks}", f"noise.dark_shading={place}")
    words = []
    if fault == "moved":
        place.rename(tmp_path / "elsewhere.npy")
    elif fault == "changed":
        save_map(place, np.full(SHAPE, BLACK_DN, np.uint16))
    else:
        (tmp_path / "empty").mkdir()
        words = [f"noise.dark_shading={tmp_path}/empty"]
    done = run_main("replay", "ds", "--keys", "0", *words)
    assert (done.code, done.err.count("\n")) == (5, 1)
    assert sentence in done.err
    assert str(tmp_path) in done.err
    again = run_main("again", "ds", "out=new", *words)
    assert again.code in (2, 5)
    assert again.err.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_dataset_is_regenerated_from_its_config(made: Path, run_main: RunMain, tmp_path: Path, maps: Path) -> None:
    done = run_main("again", made, f"out={tmp_path}/again")
    assert done.code == 0, done.err
    assert "the same as" in done.out
    moved = shutil.copytree(maps, tmp_path / "moved")
    done = run_main("again", made, f"out={tmp_path}/moved_again", f"noise.dark_shading={moved}")
    assert (done.code, "the same as" in done.out) == (0, True)


def test_again_refuses_a_map_that_the_dataset_lacks(
    darks: Path, pictures: Path, ramp: Path, make: Make, run_main: RunMain, tmp_path: Path
) -> None:
    make(pictures, tmp_path / "ds", *NOISE, f"noise.dark_frames={darks}")
    done = run_main("again", "ds", "out=new", f"noise.dark_shading={ramp}")
    assert (done.code, "was generated without dark-shading map; leave it out" in done.err) == (2, True)


def test_resume_refuses_another_map(
    pictures: Path, overrides: tuple[str, ...], maps: Path, make: Make, tmp_path: Path, made: Path, tree_hash: TreeHash
) -> None:
    out = Path(shutil.copytree(made, tmp_path / "ds"))
    make(pictures, out, *overrides)
    assert tree_hash(out) == tree_hash(made)
    other = save_map(tmp_path / "other/iso1600.npy", RAMP + BLACK_DN + 0.25)
    with pytest.raises(ConfigError, match=r"noise\.dark_shading_sha256"):
        make(pictures, out, *overrides, f"noise.dark_shading={other}")


def test_damaged_pair_is_repaired(made: Path, run_main: RunMain, tmp_path: Path, tree_hash: TreeHash) -> None:
    copy = Path(shutil.copytree(made, tmp_path / "ds"))
    for name in ("shards/shard-00000.tar", "manifest.csv"):
        content = bytearray((copy / name).read_bytes())
        content[len(content) // 2] ^= 1
        (copy / name).write_bytes(content)
    done = run_main("verify", copy, "--repair")
    assert done.code == 0, done.err
    assert tree_hash(copy) == tree_hash(made)


def test_pairs_of_patches_are_crops(
    pictures: Path, overrides: tuple[str, ...], make: Make, made: Path, tmp_path: Path
) -> None:
    make(pictures, tmp_path / "ds", *overrides, "source.patch=[grid, 32]")
    full = {str(pair.row["source"]): pair.noisy for pair in RawPairs(made)}
    for sample in RawPairs(tmp_path / "ds"):
        y, x = int(sample.row["patch_y"] or 0), int(sample.row["patch_x"] or 0)
        np.testing.assert_array_equal(sample.noisy, full[str(sample.row["source"])][y : y + 32, x : x + 32])


def test_plan_states_the_map_and_what_it_leaves(run_main: RunMain, overrides: tuple[str, ...], pictures: Path) -> None:
    done = run_main("plan", *overrides, f"source.root={pictures}")
    text = " ".join(done.out.split())
    assert done.code == 0, done.err
    assert "the map iso1600.npy (its DN include the black level) is subtracted" in text
    assert ", which leaves a median of 0 DN, standard deviation 3." in text
    above = f"noise.dark_shading={save_map(Path('above.npy'), RAMP.astype(np.float32))}"
    done = run_main("plan", *overrides, above, "noise.dark_frames_black_dn=512", f"source.root={pictures}")
    assert "the map above.npy (its DN are above the black level 512 DN)" in " ".join(done.out.split())


def test_noise_is_checked_with_the_map(made: Path, maps: Path, run_main: RunMain, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(maps, tmp_path / "moved"))
    done = run_main("verify", made, "--noise")
    assert (done.code, "0 wrong" in done.out) == (0, True), done.err
    copy = Path(shutil.copytree(made, tmp_path / "ds"))
    facts = (copy / "dataset.json").read_text(encoding="utf-8")
    (copy / "dataset.json").write_text(facts.replace(str(maps), str(tmp_path / "none")), encoding="utf-8")
    with_frames_only = run_main("replay", copy, "--keys", "0")
    assert with_frames_only.code == 5
    assert run_main("replay", copy, "--keys", "0", f"noise.dark_shading={moved}").code == 0
