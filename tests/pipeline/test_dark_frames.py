"""Noise from dark frames: datasets name each frame, keep every promise, and refuse frames that do not fit."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.dark_frames import banded, save_frames
from helpers.datasets import Make, TreeHash
from helpers.noise_faults import replace_noisy_frames
from helpers.photographs import pixels
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.config.schema import replaced
from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.planning.effect_selection import facts_of
from unprocess_gen.planning.plan import plan_pairs
from unprocess_gen.reports.noise_check.alarms import Checker
from unprocess_gen.reports.noise_check.repetition import measure_noise
from unprocess_gen.simulation.facts import DarkFrames
from unprocess_gen.sources.dark_frames import open_dark_frames

NOISE = ("noise=sony_a7s2", "noise.iso=1600", "sensor=generic_14bit", "camera=identity", "gains=unity")
SCALE = (16383 - 1024) / (16300 - 512)


@pytest.fixture(scope="module")
def darks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("darks") / "iso1600"
    save_frames(folder, 3)
    (folder / "notes.txt").write_text("not a frame")
    return folder


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return photographs that fit into a dark frame, and one that is larger."""
    folder = tmp_path_factory.mktemp("pictures") / "p"
    folder.mkdir()
    for number, (height, width) in enumerate(((40, 50), (69, 90), (101, 213))):
        Image.fromarray(pixels(number, height, width)).save(folder / f"{number}.png")
    return folder


@pytest.fixture(scope="module")
def made(pictures: Path, darks: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "ds"
    make(pictures, out, *NOISE, f"noise.dark_frames={darks}", "noise.draws=2", "output.pairs_per_shard=2")
    return out


def rows(folder: Path) -> list[dict[str, object]]:
    return [dict(row) for row in read_rows(folder / "manifest.csv")]


def test_rows_name_the_dark_frame_and_its_place(made: Path, darks: Path) -> None:
    digests = set(open_frames(darks))
    for row in rows(made):
        assert row["dark_frame"] in digests
        assert (int(row["dark_frame_y"] or 0) % 2, int(row["dark_frame_x"] or 0) % 2) == (0, 0)
        assert row["dark_black_dn"] == black_level(darks)
        assert row["dark_scale"] == SCALE
        assert "dark_frame" in str(row["effects"]).split(";")
        assert "row: contained in the dark frames" in str(row["skipped"]).split(";")


def described(folder: Path, *overrides: str) -> DarkFrames:
    """Return what a run knows about the frames of a folder."""
    _, frames, _ = open_dark_frames(ug.load_config([*NOISE, f"noise.dark_frames={folder}", *overrides]))
    assert frames is not None
    return frames


def black_level(folder: Path) -> float:
    """Return the black level of a folder of dark frames, near 512 DN."""
    black_dn = described(folder).black_dn
    assert black_dn == pytest.approx(512, abs=0.2)
    return black_dn


def open_frames(folder: Path) -> dict[str, np.ndarray]:
    """Return the dark frames of a folder by their SHA-256."""
    config = ug.load_config([*NOISE, f"noise.dark_frames={folder}"])
    _, frames, access = open_dark_frames(config)
    assert frames is not None and access is not None
    return {one.sha256: access.frame(one.sha256) for one in frames.frames}


def test_draws_and_frames_of_a_clip_take_turns_at_one_place(darks: Path) -> None:
    config = ug.load_config([*NOISE, f"noise.dark_frames={darks}", "noise.draws=2"])
    config, frames, _ = open_dark_frames(config)
    assert frames is not None
    facts = facts_of(pixels(1, 40, 50))
    plans = [
        plan for frame in range(3) for plan in plan_pairs(config, "a" * 64, 0, facts, frame=frame, dark_frames=frames)
    ]
    digests = [one.sha256 for one in frames.frames]
    first = digests.index(plans[0].dark.dark_frame)
    assert [plan.dark.dark_frame for plan in plans] == [digests[(first + number) % 3] for number in range(6)]
    assert len({plan.dark.shift for plan in plans}) == 1


def test_effects_are_judged_against_the_noise_of_the_frames(tmp_path: Path) -> None:
    """PRNU of half a percent is visible next to weak noise, and hidden by strong noise."""
    simulated = {}
    for std in (2.0, 1000.0):
        folder = tmp_path / str(std)
        save_frames(folder, 2, black=6000, std=std)
        pair = ug.make_pair(
            np.full((64, 64, 3), 120, np.uint8),
            ug.load_config([*NOISE, f"noise.dark_frames={folder}", "effects.tolerance=0.12"]),
        )
        simulated[std] = pair.plan.noise.effects
        assert pair.plan.noise.b_dn2 == pytest.approx((SCALE * std) ** 2 * (1 + 1 / 4 + 1 / 9), rel=0.2)
    assert "prnu" in simulated[2.0]
    assert "prnu" not in simulated[1000.0]


def test_noise_without_light_is_the_dark_frame(darks: Path) -> None:
    config = ug.load_config([*NOISE[:2], "sensor.black_level_dn=512", "sensor.bits=14", "sensor.white_level_dn=16300",
                             f"noise.dark_frames={darks}", "noise.dark_frames_black_dn=512"])  # fmt: skip
    pair = ug.make_pair(np.zeros((150, 200, 3), np.uint8), config)
    frame = open_frames(darks)[pair.plan.dark.dark_frame]
    y, x = pair.plan.dark.shift
    expected = np.tile(frame, (5, 5))[y : y + 150, x : x + 200]
    np.testing.assert_array_equal(pair.noisy, expected)


def test_black_level_of_frames_is_their_mean(tmp_path: Path) -> None:
    """Frames with a mean of 512.3 DN and hot pixels; their median would be 512."""
    random = np.random.Generator(np.random.Philox(key=3))
    for number in range(4):
        frame = np.rint(random.normal(512.3, 3.0, (300, 400))).astype(np.uint16)
        frame[7 * number + 1, ::100] = 9000  # 4 of 120,000 sites
        np.save(tmp_path / f"{number}.npy", frame)
    assert described(tmp_path).black_dn == pytest.approx(512.3, abs=0.02)


def test_dither_keeps_the_mean_of_fractions(tmp_path: Path) -> None:
    """Without dither a signal of 0.3 DN would vanish in constant frames."""
    np.save(tmp_path / "a.npy", np.full((64, 64), 512, np.uint16))
    config = ug.load_config(["noise=sony_a7s2", "noise.iso=1600", "sensor=generic_14bit", "effects.shot=off",
                             "effects.prnu=off", "effects.dead_pixels=off", "scene.exposure_ratio=200",
                             f"noise.dark_frames={tmp_path}", "output.clean_dtype=float32"])  # fmt: skip
    pair = ug.make_pair(np.full((256, 256, 3), 128, np.uint8), config)
    expected_dn = 1024 + pair.clean.astype(np.float64) * (16383 - 1024)
    for site in (np.s_[::2, ::2], np.s_[::2, 1::2], np.s_[1::2, 1::2]):
        mean_dn = expected_dn[site].mean()
        assert pair.noisy[site].mean() == pytest.approx(mean_dn, abs=5 * 0.6 / 128)


def test_jobs_and_file_names_change_no_byte(
    made: Path, pictures: Path, darks: Path, make: Make, tree_hash: TreeHash, tmp_path: Path
) -> None:
    renamed = tmp_path / "renamed"
    renamed.mkdir()
    for number, path in enumerate(sorted(darks.glob("*.npy"), reverse=True)):
        shutil.copy(path, renamed / f"{number}.npy")
    overrides = (*NOISE, f"noise.dark_frames={renamed}", "noise.draws=2", "output.pairs_per_shard=2")
    make(pictures, tmp_path / "ds", *overrides, n_jobs=2)
    assert tree_hash(tmp_path / "ds") == tree_hash(made)
    assert str(tmp_path) not in (tmp_path / "ds/config.yaml").read_text()


def test_dark_frames_may_be_elsewhere(made: Path, darks: Path, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("replay", made, f"noise.dark_frames={shutil.copytree(darks, tmp_path / 'moved')}")
    assert (done.code, done.out.split(";")[0]) == (0, "6 pairs are the same, bit for bit"), done.err


@pytest.mark.parametrize(
    ("words", "problem"),
    [(("replay", "--keys", "0"), "no file has"), (("again", "out=again"), "the set of frames has")],
)
def test_other_frames_are_refused(
    words: tuple[str, ...], problem: str, made: Path, run_main: RunMain, tmp_path: Path
) -> None:
    save_frames(tmp_path / "others", 1, black=600)
    done = run_main(words[0], made, *words[1:], f"noise.dark_frames={tmp_path}/others")
    assert (done.code, f"{problem} the SHA-256" in done.err) == (5, True), done.err
    assert words[0] == "again" or str(rows(made)[0]["dark_frame"]) in done.err
    assert not (tmp_path / "again").exists()


def test_resume_refuses_changed_frames(pictures: Path, make: Make, tmp_path: Path) -> None:
    save_frames(tmp_path / "d", 2)
    make(pictures, tmp_path / "ds", *NOISE, f"noise.dark_frames={tmp_path}/d")
    save_frames(tmp_path / "d", 3)
    with pytest.raises(ConfigError, match=r"begun with other settings: noise\.dark_frames_sha256"):
        make(pictures, tmp_path / "ds", *NOISE, f"noise.dark_frames={tmp_path}/d")


def test_frame_that_changes_during_a_run_stops_it(tmp_path: Path) -> None:
    (digest,) = save_frames(tmp_path, 1)
    _, _, access = open_dark_frames(ug.load_config([*NOISE, f"noise.dark_frames={tmp_path}"]))
    assert access is not None
    np.save(tmp_path / "dark0.npy", banded(9))
    with pytest.raises(MachineError, match=f"expected {digest}"):
        access.frame(digest)


def test_dataset_json_describes_the_frames(made: Path, darks: Path) -> None:
    facts = json.loads((made / "dataset.json").read_text())["dark_frames"]
    assert facts["root"] == str(darks)
    assert (facts["count"], facts["sizes"], facts["black_dn"]) == (3, ["90x70"], black_level(darks))
    assert facts["std_dn"] == pytest.approx(SCALE * 3 * (1 + 1 / 4 + 1 / 9) ** 0.5, rel=0.1)


def test_plan_describes_frames_and_what_they_contain(run_main: RunMain, darks: Path, pictures: Path) -> None:
    done = run_main("plan", *NOISE, f"noise.dark_frames={darks}", f"source.root={pictures}")
    text = " ".join(done.out.split())
    assert done.code == 0, done.err
    assert (
        f"3 dark frames in {darks}: 90 x 70 pixels, black level {black_level(darks):g} DN, standard deviation 3."
        in text
    )
    assert re.search(r"^dark_frame .* 3 of 3 +sampled from dark frames$", done.out, re.MULTILINE)
    assert text.count("contained in the dark frames") >= 5


def test_hidden_companions_are_no_dark_frames(run_main: RunMain, darks: Path, pictures: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(darks, tmp_path / "darks")
    (folder / "._0.npy").write_bytes(b"\0\5\x16\7")
    (folder / "folder.npy").mkdir()
    done = run_main("plan", *NOISE, f"noise.dark_frames={folder}", f"source.root={pictures}")
    assert done.code == 0, done.err
    assert f"3 dark frames in {folder}" in " ".join(done.out.split())
    assert done.out.count("noise.dark_frames: hidden files and folders are left out: 1 ._*") == 1


@pytest.fixture
def reported(make: Make, tmp_path: Path, darks: Path) -> Path:
    """Return a dataset with dark frames that may be moved, and enough sites for a check of the noise."""
    shutil.copytree(darks, tmp_path / "darks")
    overrides = *NOISE, f"noise.dark_frames={tmp_path / 'darks'}", "source.limit=1", "source.patch=[grid, 256]"
    make(None, tmp_path / "ds", *overrides, "scene.exposure_ratio=50")
    return tmp_path / "ds"


def page_of(dataset: Path, run_main: RunMain, *words: object) -> str:
    """Return the text of the report that the command writes."""
    done = run_main("report", dataset, *words)
    assert (done.code, done.err) == (0, "")
    return " ".join((dataset / "report.html").read_text(encoding="utf-8").split())


def test_report_states_why_dark_frames_are_not_checked(reported: Path, run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "darks").rename(tmp_path / "moved")
    page = page_of(reported, run_main)
    assert f"Pairs with dark frames are not checked: noise.dark_frames={tmp_path}/darks: no such folder" in page
    assert "All agree" not in page and "enough sites" not in page
    assert "All agree" in page_of(reported, run_main, f"noise.dark_frames={tmp_path}/moved")
    save_frames(tmp_path / "darks", 1, std=5.0)
    assert "not checked: noise.dark_frames=" in page_of(reported, run_main)
    assert run_main("report", reported, f"noise.dark_frames={tmp_path}/none").code == 2


def test_noise_of_dark_frames_is_checked_with_their_folder(reported: Path, run_main: RunMain, tmp_path: Path) -> None:
    count = len(rows(reported))
    (tmp_path / "darks").rename(tmp_path / "moved")
    done = run_main("verify", reported, "--noise")
    assert (done.code, done.err) == (0, "")
    assert "a dark frame that is not available; noise.dark_frames=FOLDER names their folder" in done.out
    moved = f"noise.dark_frames={tmp_path / 'moved'}"
    done = run_main("verify", reported, "--noise", moved)
    assert f"noise of {count} pairs checked, 0 wrong\n" in done.out
    assert run_main("verify", reported, "--noise", f"noise.dark_frames={tmp_path / 'none'}").code == 2
    save_frames(tmp_path / "others", 1, std=5.0)
    assert run_main("verify", reported, "--noise", f"noise.dark_frames={tmp_path / 'others'}").code == 5
    draws = np.random.default_rng(0)
    replace_noisy_frames(
        reported, lambda clean, noisy, row: np.rint(noisy + draws.normal(0, 4, noisy.shape)).astype(np.uint16)
    )
    assert run_main("verify", reported, "--noise", moved).code == 4


@pytest.mark.parametrize(
    "overrides",
    [(*NOISE, "effects.all=on"), ("noise=canon_5d4", "scene=night", "output.dtype=float32", "sensor.clip=none")],
)
def test_sums_of_dark_frames_raise_no_alarm(overrides: tuple[str, ...], darks: Path) -> None:
    config, _, access = open_dark_frames(ug.load_config([*overrides, f"noise.dark_frames={darks}"]))
    checker = Checker(2)
    for number in range(2):
        pair = ug.make_pair(pixels(number, 200, 300), replaced(config, {"seed": number}))
        checker.add(measure_noise(pair.clean, pair.noisy, pair.row, access))
        checker.add(measure_noise(pair.clean, pair.noisy, pair.row))
    assert (checker.count, checker.unchecked, checker.alarms) == (2, 2, [])


# Files and refusals ---------------------------------------------------------------------------------------------------


def test_formats_give_the_same_pixels(tmp_path: Path) -> None:
    frame = banded(5)
    cv2.imwrite(str(tmp_path / "a.png"), frame)
    cv2.imwrite(str(tmp_path / "b.TIFF"), frame)
    np.save(tmp_path / "c.npy", frame)
    frames = open_frames(tmp_path)
    assert len(frames) == 3
    for found in frames.values():
        np.testing.assert_array_equal(found, frame)


def test_raw_files_state_black_level_and_pattern(tmp_path: Path, run_main: RunMain, make: Make) -> None:
    pytest.importorskip("rawpy")
    make(None, tmp_path / "ds", "source.limit=1", "scene.exposure_ratio=10000", "sensor=generic_14bit", *NOISE[:2])
    assert run_main("dng", tmp_path / "ds", "--keys", "0", "--clean", "--to", tmp_path / "raw").code == 0
    assert described(tmp_path / "raw").black_dn == 1024
    with pytest.raises(ConfigError, match=r"has the CFA pattern RGGB; expected sensor\.pattern=GBRG"):
        described(tmp_path / "raw", "sensor.pattern=GBRG")


def as_array(shape: tuple[int, ...], value: int = 512, dtype: str = "uint16") -> np.ndarray:
    return np.full(shape, value, dtype=dtype)


@pytest.mark.parametrize(
    ("array", "sentence"),
    [
        (as_array((62, 90)), "has 90 x 62 pixels; expected 64 x 64 or more"),
        (as_array((70, 90, 3)), r"is uint16 \[70, 90, 3\]; expected a mosaic \[H, W\] of uint16"),
        (as_array((70, 90), 16384), "values up to 16384 DN; expected DN of the profile, which has 14 bits"),
    ],
    ids=["small", "colours", "bits"],
)
def test_frame_that_does_not_fit_is_refused(array: np.ndarray, sentence: str, tmp_path: Path) -> None:
    save_frames(tmp_path, 1)
    np.save(tmp_path / "odd.npy", array)
    with pytest.raises(ConfigError, match=sentence):
        open_frames(tmp_path)


def test_file_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    for name in ("a.npy", "a.png", "a.tif", "a.dng"):
        (tmp_path / name).write_bytes(b"not a frame")
        with pytest.raises(ConfigError, match=r"cannot be decoded|begins with"):
            open_frames(tmp_path)
        (tmp_path / name).unlink()


REFUSED = [
    (["noise=imx385_iso3200"], "gives no DN per electron"),
    ([*NOISE[:1], "scene=night", "noise.iso=[choice, 800, 1600]"], "the frames are of one ISO"),
    ([*NOISE, "clean.includes_fixed_pattern=true"], "clean.includes_fixed_pattern=true"),
    ([*NOISE, "effects.row=on"], "effects.row=on: the dark frames contain it"),
    (
        [*NOISE, "noise.dark_frames=s3://bucket/darks"],
        "s3://bucket/darks: dark frames are read from a local folder only",
    ),
]


@pytest.mark.parametrize(("overrides", "sentence"), REFUSED)
def test_settings_that_contradict_dark_frames_are_refused(
    overrides: list[str], sentence: str, darks: Path, run_main: RunMain
) -> None:
    done = run_main(f"noise.dark_frames={darks}", *overrides, "source.limit=1")
    assert (done.code, sentence in done.err, done.err.count("\n")) == (2, True, 1), done.err


def test_live_pairs_have_another_dark_frame_in_each_epoch(made: Path) -> None:
    live, stored = ug.LivePairs(made), ug.RawPairs(made)
    np.testing.assert_array_equal(live[0].noisy, stored[0].noisy)
    first, second = live[0], live[1, 0]
    np.testing.assert_array_equal(first.clean, second.clean)
    assert first.row["dark_frame"] != second.row["dark_frame"]
    assert first.row["noisy_xxh3"] != second.row["noisy_xxh3"]
