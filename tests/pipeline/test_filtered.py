"""``source.min_side`` leaves out small images: they have rows, are shown, and are no failures."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, text_rows
from helpers.photographs import fill, pixels
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError

ARGUMENTS = ("source.min_side=20", "n_jobs=1", "output.pairs_per_shard=2")
SMALL = {"001.png", "003.png", "004.png"}
"""Images of a folder of five that are too small. One shard has no pair."""


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Five photographs, of which three are too small."""
    folder = fill(tmp_path / "photos", 5)
    for number, sides in ((0, (20, 30)), (2, (40, 20))):
        Image.fromarray(pixels(number, *sides)).save(folder / f"{number:03d}.png")
    return folder


def test_small_images_are_filtered_and_are_no_failures(photos: Path, run_main: RunMain) -> None:
    done = run_main(f"source.root={photos}", *ARGUMENTS, "out=ds")
    assert done.code == 0
    assert "ds: 2 pairs, " in done.out
    assert ", 0 failed, 3 filtered (source.min_side); next:" in done.out
    rows = {row["source"]: row for row in text_rows(Path("ds"))}
    assert {name for name, row in rows.items() if row["status"] == "filtered"} == SMALL
    assert {row["reason"] for name, row in rows.items() if name in SMALL} == {"too_small"}
    assert "source.min_side=20" in rows["001.png"]["detail"]
    assert len(rows["001.png"]["source_sha256"]) == 64
    facts = json.loads(Path("ds/dataset.json").read_text())
    assert (facts["pairs"], facts["failed"], facts["filtered"]) == (2, {}, 3)
    assert facts["shards"][2]["file"] is None
    assert run_main(f"source.root={photos}", *ARGUMENTS, "out=ds").out.endswith(
        "0 failed, 3 filtered (source.min_side); nothing to do\n"
    )
    assert len(ug.RawPairs("ds")) == 2
    for keys in ((), ("--keys", "0-4")):
        assert run_main("replay", "ds", *keys).out == "2 pairs are the same, bit for bit; 0 are not\n"


def test_pairs_are_those_without_the_filter(photos: Path, make: Make, tmp_path: Path) -> None:
    make(photos, tmp_path / "all")
    make(photos, tmp_path / "large", "source.min_side=20")
    every = {row["source"]: row["noisy_xxh3"] for row in text_rows(tmp_path / "all")}
    large = {row["source"]: row["noisy_xxh3"] for row in text_rows(tmp_path / "large") if row["status"] == "ok"}
    assert large == {name: digest for name, digest in every.items() if name not in SMALL}
    assert "filtered" not in (tmp_path / "all/dataset.json").read_text()


def test_side_is_that_after_downscaling_and_before_patches(tmp_path: Path, make: Make) -> None:
    (tmp_path / "p").mkdir()
    for name, sides in (("a", (39, 60)), ("b", (40, 41)), ("c", (1, 50))):
        Image.fromarray(pixels(1, *sides)).save(tmp_path / f"p/{name}.png")
    made = make(tmp_path / "p", tmp_path / "ds", "source.min_side=20", "source.downscale=2", "source.patch=32")
    assert [(row["status"], row["reason"]) for row in text_rows(tmp_path / "ds")] == [
        ("filtered", "too_small"), ("failed", "too_small"), ("filtered", "too_small")
    ]  # fmt: skip
    assert (made.rows, made.pairs, made.failed, made.filtered) == (3, 0, {"too_small": 1}, 2)


def test_plan_report_and_sweep_show_filtered_images(photos: Path, run_main: RunMain) -> None:
    planned = run_main("plan", f"source.root={photos}", *ARGUMENTS, "out=ds").out
    assert "filtered  3 of 5 sources read, by source.min_side=20\n" in planned
    assert "fails " not in planned
    assert run_main("-m", f"source.root={photos}", *ARGUMENTS[1:], "source.min_side=null,20", "out=sweep").code == 0
    with Path("sweep/sweep.csv").open(newline="") as stream:
        rows = {row["source.min_side"]: (row["rows"], row["failed"], row["filtered"]) for row in csv.DictReader(stream)}
    assert rows == {"null": ("5", "0", "0"), "20": ("5", "0", "3")}
    (filtered,) = Path("sweep").glob("*source.min_side=20")
    assert run_main("report", filtered, "--to", "page.html").code == 0
    page = Path("page.html").read_text(encoding="utf-8")
    assert "failed rows: 0; filtered rows (source.min_side): 3.</p>" in page
    assert "No source failed." in page


def test_filtered_image_has_no_frames(photos: Path, make: Make, run_main: RunMain, tmp_path: Path) -> None:
    make(photos, tmp_path / "ds", "source.min_side=20")
    done = run_main("preview", "ds", "--keys", "1", "--to", "p.png")
    assert done.code == ConfigError.exit_code
    assert "--keys 00000001: filtered (too_small), so it has no frames" in done.err


@pytest.mark.parametrize("value", ["0", "-1", "x", str(2**21)])
def test_wrong_side_is_refused(value: str, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main(f"source.min_side={value}", "out=ds")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert not (tmp_path / "ds").exists()


def test_built_in_scenes_are_filtered_too(make: Make, tmp_path: Path) -> None:
    made = make(None, tmp_path / "ds", "source.limit=1", f"source.min_side={np.iinfo(np.int16).max}")
    assert (made.pairs, made.filtered) == (0, 1)
