"""A sweep: one dataset for each combination, and sweep.csv."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import COMMAND, environment, fill

Door = Callable[..., Any]
Make = Callable[..., Any]
Hash = Callable[[Path], str]

TWO_BY_TWO = ("-m", "camera=sony_a7r,nexus_6p", "noise=imx385_iso1600,imx385_iso3200", "source.root=p", "out=sweep")
COMBINATIONS = [
    (camera, noise) for camera in ("sony_a7r", "nexus_6p") for noise in ("imx385_iso1600", "imx385_iso3200")
]
FOLDERS = [f"camera={camera},noise={noise}" for camera, noise in COMBINATIONS]


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return fill(tmp_path / "p", 3)


def test_every_combination_is_a_dataset_of_its_own(door: Door, source: Path, tmp_path: Path) -> None:
    done = door(*TWO_BY_TWO, "n_jobs=1")
    assert done.code == 0, done.err
    assert sorted(os.listdir(tmp_path / "sweep")) == sorted([*FOLDERS, "sweep.csv"])
    assert sorted(os.listdir(tmp_path)) == ["p", "sweep"]


def test_sweep_csv_tells_of_every_job(door: Door, source: Path, tmp_path: Path) -> None:
    door(*TWO_BY_TWO, "n_jobs=1")
    expected = [{"folder": folder, "overrides": folder, "rows": "3", "failed": "0", "exit": "0"} for folder in FOLDERS]
    assert sorted(table(tmp_path / "sweep"), key=str) == sorted(expected, key=str)


def test_sweep_csv_has_the_columns_of_the_contract_and_line_feeds(door: Door, source: Path, tmp_path: Path) -> None:
    door("-m", "source.root=p", "out=sweep", "n_jobs=1")
    content = (tmp_path / "sweep/sweep.csv").read_bytes()
    assert content.startswith(b"folder,overrides,rows,failed,exit\n")
    assert b"\r" not in content


def test_a_dataset_of_a_sweep_is_that_of_a_single_run(
    door: Door, source: Path, make: Make, tree_hash: Hash, tmp_path: Path
) -> None:
    door(*TWO_BY_TWO, "n_jobs=1")
    for (camera, noise), folder in zip(COMBINATIONS, FOLDERS, strict=True):
        make(source, tmp_path / folder, f"camera={camera}", f"noise={noise}")
        assert tree_hash(tmp_path / "sweep" / folder) == tree_hash(tmp_path / folder)


def test_a_job_that_fails_stops_no_other_and_the_worst_code_is_returned(
    door: Door, source: Path, tmp_path: Path
) -> None:
    done = door("-m", "gains.red=0,2", "source.root=p", "out=sweep", "n_jobs=1")
    assert done.code == 2
    assert [(row["folder"], row["rows"], row["failed"], row["exit"]) for row in table(tmp_path / "sweep")] == [
        ("gains.red=0", "", "", "2"), ("gains.red=2", "3", "0", "0"),
    ]  # fmt: skip
    assert (tmp_path / "sweep/gains.red=2/dataset.json").exists()


def test_the_error_of_a_job_is_one_line_that_names_it(door: Door, source: Path) -> None:
    done = door("-m", "gains.red=0,2", "source.root=p", "out=sweep", "n_jobs=1")
    errors = [line for line in done.err.splitlines() if "images/s" not in line]
    assert errors == ["gen-dataset: gains.red=0: gains.red=0: a gain must be above 0, from 0.001 to 1000"]


def test_an_option_that_is_not_there_stops_no_other_job(door: Door, source: Path, tmp_path: Path) -> None:
    done = door("source.root=p", "-m", "camera=sony_a7r,nosuch,nexus_6p", "out=sweep", "n_jobs=1")
    assert done.code == 2
    assert "gen-dataset: camera=nosuch: camera=nosuch: no such option; expected one of choice, " in done.err
    with (tmp_path / "sweep/sweep.csv").open(newline="") as stream:
        assert [(row["folder"], row["exit"]) for row in csv.DictReader(stream)] == [
            ("camera=sony_a7r", "0"),
            ("camera=nosuch", "2"),
            ("camera=nexus_6p", "0"),
        ]


def test_a_glob_stands_for_the_options_that_match(door: Door, source: Path, tmp_path: Path) -> None:
    assert door("-m", "camera=glob(s*)", "source.root=p", "out=sweep", "n_jobs=1").code == 0
    assert sorted(os.listdir(tmp_path / "sweep")) == ["camera=sony_a7r", "camera=sony_rx100", "sweep.csv"]


def test_a_sweep_in_which_every_job_is_refused_writes_nothing(door: Door, source: Path, tmp_path: Path) -> None:
    assert door("-m", "gains.red=0,-1", "source.root=p", "out=sweep").code == 2
    assert sorted(os.listdir(tmp_path)) == ["p"]


def test_failed_photographs_of_a_job_are_counted_and_end_with_3(door: Door, source: Path, tmp_path: Path) -> None:
    (source / "001.png").write_bytes(b"")
    assert door("-m", "seed=1,2", "source.root=p", "out=sweep", "n_jobs=1").code == 3
    assert [(row["rows"], row["failed"], row["exit"]) for row in table(tmp_path / "sweep")] == [("3", "1", "3")] * 2


def test_a_setting_is_worse_than_a_failed_photograph(door: Door, source: Path) -> None:
    (source / "001.png").write_bytes(b"")
    assert door("-m", "gains.red=2,0", "source.root=p", "out=sweep", "n_jobs=1").code == 2


def test_a_second_sweep_does_nothing_and_tells_the_same(door: Door, source: Path, tmp_path: Path) -> None:
    door("-m", "seed=1,2", "source.root=p", "out=sweep", "n_jobs=1")
    before = (tmp_path / "sweep/sweep.csv").read_bytes()
    done = door("-m", "seed=1,2", "source.root=p", "out=sweep", "n_jobs=1")
    assert (done.code, done.out.count("nothing to do")) == (0, 2)
    assert (tmp_path / "sweep/sweep.csv").read_bytes() == before


def test_another_sweep_into_the_same_folder_keeps_the_rows_of_the_first(
    door: Door, source: Path, tmp_path: Path
) -> None:
    for seeds in ("seed=1,2", "seed=2,3"):
        door("-m", seeds, "source.root=p", "out=sweep", "n_jobs=1")
    assert sorted(row["folder"] for row in table(tmp_path / "sweep")) == ["seed=1", "seed=2", "seed=3"]


@pytest.mark.parametrize("excluded", ["n_jobs=2", "out=sweep", "source.root=p"])
def test_keys_that_do_not_decide_the_data_are_not_in_the_names(
    excluded: str, door: Door, source: Path, tmp_path: Path
) -> None:
    door("-m", "seed=1", "source.root=p", "out=sweep", "n_jobs=1", excluded)
    assert sorted(os.listdir(tmp_path / "sweep")) == ["seed=1", "sweep.csv"]


def test_a_sweep_of_nothing_has_a_folder_with_a_name(door: Door, source: Path, tmp_path: Path) -> None:
    door("-m", "source.root=p", "out=sweep", "n_jobs=1")
    assert sorted(os.listdir(tmp_path / "sweep")) == ["default", "sweep.csv"]


def test_a_value_with_a_slash_nests_no_folders(door: Door, source: Path, tmp_path: Path) -> None:
    (source / "sub").mkdir()
    (source / "001.png").rename(source / "sub/001.png")
    done = door("-m", "source.include=['sub/*.png'],['0*.png']", "source.root=p", "out=sweep", "n_jobs=1")
    assert done.code == 0, done.err
    folders = sorted(path.name for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert len(folders) == 2
    assert [name for name in folders if "%2F" in name]
    assert all((tmp_path / "sweep" / name / "dataset.json").exists() for name in folders)


def test_long_overrides_still_name_a_folder_each(door: Door, source: Path, tmp_path: Path) -> None:
    numbers = ",".join(["0.123456789012345678"] * 12)
    one, other = (f"['*.png','{numbers}{end}']" for end in "ab")
    done = door("-m", f"source.include={one},{other}", "source.root=p", "out=sweep", "n_jobs=1")
    assert done.code == 0, done.err
    folders = [path.name for path in (tmp_path / "sweep").iterdir() if path.is_dir()]
    assert len(folders) == 2
    assert max(len(name) for name in folders) <= 255


def test_plan_of_a_sweep_tells_of_every_job_and_writes_nothing(door: Door, source: Path, tmp_path: Path) -> None:
    done = door("plan", *TWO_BY_TWO)
    assert (done.code, done.out.count("sources   3")) == (0, 4)
    assert sorted(os.listdir(tmp_path)) == ["p"]


def test_plan_of_a_sweep_that_was_made_leaves_its_table_alone(door: Door, source: Path, tmp_path: Path) -> None:
    door("-m", "seed=1,2", "source.root=p", "out=sweep", "n_jobs=1")
    before = (tmp_path / "sweep/sweep.csv").read_bytes()
    door("plan", "-m", "seed=1,2", "source.root=p", "out=sweep")
    assert (tmp_path / "sweep/sweep.csv").read_bytes() == before


def test_a_sweep_that_is_killed_is_finished_by_a_rerun(door: Door, make: Make, tree_hash: Hash, tmp_path: Path) -> None:
    source = fill(tmp_path / "p", 12)
    arguments = (*TWO_BY_TWO, "n_jobs=1", "output.pairs_per_shard=1")
    folders = [f"{folder},output.pairs_per_shard=1" for folder in FOLDERS]
    process = subprocess.Popen(
        [str(COMMAND), *arguments], cwd=tmp_path, env=environment(), stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    until = time.monotonic() + 60
    while len(list((tmp_path / "sweep").glob("*/shards/*.tar"))) < 18 and process.poll() is None:
        assert time.monotonic() < until
        time.sleep(0.002)
    assert process.poll() is None
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert len(list((tmp_path / "sweep").glob("*/dataset.json"))) in (1, 2)

    done = door(*arguments)
    assert (done.code, done.out.count("nothing to do") >= 1) == (0, True)
    assert sorted(os.listdir(tmp_path / "sweep")) == sorted([*folders, "sweep.csv"])
    assert [row["exit"] for row in table(tmp_path / "sweep")] == ["0"] * 4
    for (camera, noise), folder in zip(COMBINATIONS, folders, strict=True):
        make(source, tmp_path / folder, f"camera={camera}", f"noise={noise}", "output.pairs_per_shard=1")
        assert tree_hash(tmp_path / "sweep" / folder) == tree_hash(tmp_path / folder)
