"""A sweep: one dataset for each combination, and sweep.csv."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.commands import RunMain, environment, messages
from helpers.datasets import Make, TreeHash, sweep_rows
from helpers.photographs import fill
from helpers.processes import WAIT_S

from unprocess_gen.cli.sweep import SHARES, named_overrides, write_row

PATHS = os.pathsep.join(filter(None, sys.path))


TWO_BY_TWO = ("-m", "camera=sony_a7r,nexus_6p", "noise=imx385_iso1600,imx385_iso3200", "source.root=p", "out=sweep")
COMBINATIONS = [
    (camera, noise) for camera in ("sony_a7r", "nexus_6p") for noise in ("imx385_iso1600", "imx385_iso3200")
]
FOLDERS = [f"camera={camera},noise={noise}" for camera, noise in COMBINATIONS]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return fill(tmp_path / "p", 3)


def test_every_combination_has_its_own_dataset_and_row(
    run_main: RunMain, source: Path, make: Make, tree_hash: TreeHash, tmp_path: Path
) -> None:
    done = run_main(*TWO_BY_TWO, "n_jobs=1")
    assert done.code == 0, done.err
    assert sorted(os.listdir(tmp_path / "sweep")) == sorted([*FOLDERS, "sweep.csv"])
    assert sorted(os.listdir(tmp_path)) == ["p", "sweep"]

    rows = sweep_rows(tmp_path / "sweep")
    assert [row["folder"] for row in rows] == [row["overrides"] for row in rows] == FOLDERS
    assert [(row["camera"], row["noise"]) for row in rows] == COMBINATIONS
    assert [(row["rows"], row["failed"], row["exit"]) for row in rows] == [("3", "0", "0")] * 4

    for (camera, noise), folder in zip(COMBINATIONS, FOLDERS, strict=True):
        make(source, tmp_path / folder, f"camera={camera}", f"noise={noise}")
        assert tree_hash(tmp_path / "sweep" / folder) == tree_hash(tmp_path / folder)


def test_sweep_csv_has_the_columns_of_the_contract_and_agrees_with_the_datasets(
    run_main: RunMain, source: Path, tmp_path: Path
) -> None:
    run_main("-m", "gains=paper_max,fig6_bottom", "source.root=p", "out=sweep", "n_jobs=1")
    content = (tmp_path / "sweep/sweep.csv").read_bytes()
    shares = ",".join(f"{name}_share" for name in SHARES)
    columns = f"folder,overrides,gains,rows,failed,filtered,{shares},seconds,bytes,exit"
    assert (content.split(b"\n")[0].decode(), b"\r" in content) == (columns, False)
    for row in sweep_rows(tmp_path / "sweep"):
        folder = tmp_path / "sweep" / row["folder"]
        sites = json.loads((folder / "dataset.json").read_text())["sites"]
        assert [float(row[f"{name}_share"]) for name in SHARES] == [sites[name] / sites["all"] for name in SHARES]
        assert int(row["bytes"]) == sum(path.stat().st_size for path in (folder / "shards").iterdir())
        assert float(row["seconds"]) > 0


def test_sweeps_over_other_keys_share_one_table(run_main: RunMain, source: Path, tmp_path: Path) -> None:
    for swept in ("seed=1,2", "isp=linear,srgb"):
        run_main("-m", swept, "source.root=p", "out=sweep", "n_jobs=1")
    rows = sweep_rows(tmp_path / "sweep")
    assert sorted((row["seed"], row["isp"]) for row in rows) == [("", "linear"), ("", "srgb"), ("1", ""), ("2", "")]


@pytest.mark.parametrize(
    ("swept", "message"),
    [
        ("gains.red=2,0", "gains.red=0: gains.red=0: expected a gain above 0, from 0.001 to 1000"),
        ("camera=sony_a7r,nosuch", "camera=nosuch: camera=nosuch: no such option; expected one of canon_5d4, "),
    ],
)
def test_refused_job_refuses_the_sweep(
    swept: str, message: str, run_main: RunMain, source: Path, tmp_path: Path
) -> None:
    done = run_main("-m", swept, "source.root=p", "out=sweep", "n_jobs=1")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert done.err.startswith(f"gen-dataset: {message}")
    assert sorted(os.listdir(tmp_path)) == ["p"]


def test_job_that_fails_while_it_runs_does_not_stop_the_others(run_main: RunMain, source: Path, tmp_path: Path) -> None:
    (source / "001.png").write_bytes(b"")  # a failed image: exit code 3
    (tmp_path / "sweep/seed=1").mkdir(parents=True)
    (tmp_path / "sweep/seed=1/shards").touch()
    sweep = ("-m", "seed=1,2", "source.root=p", "out=sweep", "n_jobs=1")
    done = run_main(*sweep)
    assert [message.split(": ")[1] for message in messages(done.err) if "seed=1: " in message] == ["seed=1"]
    first, second = sweep_rows(tmp_path / "sweep")
    assert (first["folder"], first["rows"], first["exit"]) == ("seed=1", "", str(done.code))  # the worst
    assert (second["folder"], second["rows"], second["failed"], second["exit"]) == ("seed=2", "3", "1", "3")
    (tmp_path / "sweep/seed=1/shards").unlink()
    assert run_main(*sweep).code == 3
    assert [row["exit"] for row in sweep_rows(tmp_path / "sweep")] == ["3", "3"]


def test_repeated_sweep_and_its_plan_change_nothing(run_main: RunMain, source: Path, tmp_path: Path) -> None:
    sweep = ("-m", "seed=1,2", "source.root=p", "out=sweep", "n_jobs=1")
    done = run_main(*sweep)
    assert ("1/2 seed=1" in done.err, "2/2 seed=2" in done.err) == (True, True)
    before = (tmp_path / "sweep/sweep.csv").read_bytes()

    done = run_main(*sweep)
    assert (done.code, done.out.count("nothing to do")) == (0, 2)
    assert (tmp_path / "sweep/sweep.csv").read_bytes() == before

    run_main("plan", *sweep)
    assert (tmp_path / "sweep/sweep.csv").read_bytes() == before


def test_plan_of_a_sweep_prints_what_is_common_a_table_and_totals(
    run_main: RunMain, source: Path, tmp_path: Path
) -> None:
    done = run_main("plan", *TWO_BY_TWO, "scene.iso=200", "n_jobs=1")
    assert (done.code, [done.out.count(label) for label in ("sources   3", "effects ", "bytes  ")]) == (0, [1, 1, 0])
    rows = re.findall(r"^ +(\d)  +3  .* a_dn ([\d.]+), b_dn2 [\d.]+ +(\S+)$", done.out, re.MULTILINE)
    assert rows == [(str(k + 1), ("3.513", "6.956")[k % 2], folder) for k, folder in enumerate(FOLDERS)]
    assert re.search(r"^warning   scene.iso=200: .*imx385_iso1600(.*\n)+? +in jobs 1, 3$", done.out, re.MULTILINE)
    totals = r"^totals    4 jobs: 12 pairs in 4 shards, [\d,]+ bytes, about [\d.]+ (s|min); \S+ GB free$"
    assert re.search(totals, done.out, re.MULTILINE)
    assert messages(done.err) == [f"gen-dataset: {k + 1}/4 {folder}" for k, folder in enumerate(FOLDERS)]
    assert sorted(os.listdir(tmp_path)) == ["p"]


def test_sweep_into_a_dataset_changes_nothing(
    run_main: RunMain, make: Make, source: Path, tree_hash: TreeHash, tmp_path: Path
) -> None:
    make(source, tmp_path / "ds")
    before = tree_hash(tmp_path / "ds")
    done = run_main("-m", "seed=1,2", f"source.root={source}", "out=ds")
    assert (done.code, done.err.count("is inside the dataset")) == (2, 2)
    assert tree_hash(tmp_path / "ds") == before
    assert not (tmp_path / "ds/sweep.csv").exists()


def test_repair_of_a_sweep_leaves_jobs_without_a_dataset(run_main: RunMain, source: Path, tmp_path: Path) -> None:
    run_main("-m", "seed=1", f"source.root={source}", "out=sweep", "n_jobs=1")
    write_row(tmp_path / "sweep", {"folder": "seed=2", "exit": "5"})
    done = run_main("verify", "sweep", "--repair")
    assert (done.code, done.out) == (4, "sweep/seed=1 is intact\nsweep: 1 of 2 datasets are intact\n")
    assert "sweep/seed=2: dataset.json: is missing: the job ended with exit code 5" in done.err


def test_rerun_makes_what_a_killed_sweep_lacks(
    run_main: RunMain, source: Path, make: Make, tree_hash: TreeHash, tmp_path: Path
) -> None:
    for out in ("sweep/seed=1", "two"):
        make(source, tmp_path / out, f"seed={1 + (out == 'two')}")
    done = run_main("-m", "seed=1,2", "source.root=p", "out=sweep", "n_jobs=1")
    assert (done.code, done.out.count("nothing to do")) == (0, 1)
    assert tree_hash(tmp_path / "sweep/seed=2") == tree_hash(tmp_path / "two")
    assert [row["exit"] for row in sweep_rows(tmp_path / "sweep")] == ["0"] * 2


def test_too_many_jobs_are_refused_at_once(run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("-m", "seed=range(0,1000000000)", "out=sweep")
    assert (done.code, done.err) == (2, "gen-dataset: a sweep of more than 100000 jobs; expected fewer values\n")
    assert os.listdir(tmp_path) == []


def test_processes_that_share_a_folder_keep_each_others_rows(tmp_path: Path) -> None:
    """Two processes write 60 tables each; without a lock, rows are lost within the first few."""
    code = (
        "import sys; from pathlib import Path; from unprocess_gen.cli.sweep import write_row\n"
        "for i in range(60):\n"
        "    name = f'{sys.argv[1]}{i}'\n"
        "    write_row(Path('.'), {'folder': name})"
    )
    running = [
        subprocess.Popen([sys.executable, "-c", code, name], cwd=tmp_path, env=environment(PYTHONPATH=PATHS))
        for name in "ab"
    ]
    assert [process.wait(WAIT_S) for process in running] == [0, 0]
    names = sorted(f"{name}{i}" for name in "ab" for i in range(60))
    assert sorted(row["folder"] for row in sweep_rows(tmp_path)) == names
    assert os.listdir(tmp_path) == ["sweep.csv"]


@pytest.mark.parametrize(("content", "code"), [(b"folder\xff\n", 4), (b'folder\n"' + b"a" * 200_000, 4), (None, 4)])
def test_unreadable_sweep_csv_ends_in_one_line(
    content: bytes | None, code: int, run_main: RunMain, source: Path, tmp_path: Path
) -> None:
    (tmp_path / "sweep").mkdir()
    path = tmp_path / "sweep/sweep.csv"
    path.mkdir() if content is None else path.write_bytes(content)
    done = run_main("-m", "seed=1", "source.root=p", "out=sweep", "n_jobs=1", "-q")
    assert (done.code, done.err.count("\n")) == (code, 1), done.err
    assert "sweep/sweep.csv: " in done.err


def test_names_omit_keys_that_do_not_decide_data() -> None:
    overrides = ["seed=1", "executor=dask", "executor.address=x", "+experiment=e", "output.dtype=uint16", "+sweep=s"]
    overrides += ["n_jobs=1", "out=sweep", "source.root=p", "check_disk=false", "self_test=go_on", "source.list=l"]
    assert named_overrides(overrides) == ["+experiment=e", "output.dtype=uint16", "seed=1"]


def test_swept_lists_of_sources_have_folders_of_their_own(run_main: RunMain, source: Path, tmp_path: Path) -> None:
    for number in range(2):
        (tmp_path / f"{number}.txt").write_text(f"p/00{number}.png\n")
    run_main("-m", "source.list='0.txt','1.txt'", "out=sweep", "n_jobs=1")
    rows = sweep_rows(tmp_path / "sweep")
    assert [(row["folder"], row["rows"]) for row in rows] == [(f"source.list='{name}.txt'", "1") for name in "01"]


def test_name_of_a_folder_has_swept_keys_only(run_main: RunMain, source: Path, tmp_path: Path) -> None:
    globs = ",".join(f"*{number:020d}" for number in range(9))
    run = ("-m", "source.limit=1,2", f"source.include=['*.png',{globs}]", "source.root=p", "out=sweep", "n_jobs=1")
    assert run_main(*run).code == 0
    row, other = sweep_rows(tmp_path / "sweep")
    assert [(row["folder"], globs.split(",")[8] in row["overrides"]) for row in (row, other)] == [
        ("source.limit=1", True),
        ("source.limit=2", True),
    ]


def test_folder_of_another_job_is_refused_and_its_row_stays(run_main: RunMain, source: Path, tmp_path: Path) -> None:
    sweep = ("-m", "seed=1,2", "source.root=p", "out=sweep", "n_jobs=1")
    done = run_main(*sweep, "isp=linear")
    assert (done.code, messages(done.out)[-1]) == (0, "sweep: 2 of 2; next: gen-dataset verify sweep")
    before = (tmp_path / "sweep/sweep.csv").read_bytes()
    done = run_main(*sweep, "isp=srgb")
    assert (done.code, done.err.count("was begun with other settings: isp.")) == (2, 2)
    assert messages(done.out)[-1] == "sweep: 0 of 2"
    assert (tmp_path / "sweep/sweep.csv").read_bytes() == before


def test_folders_name_recipes_and_one_job_all_its_settings(run_main: RunMain, source: Path, tmp_path: Path) -> None:
    common = ("source.root=p", "source.limit=1", "n_jobs=1", "out=sweep")
    assert run_main("-m", "+experiment=ipol_demo,many_highlights", "seed=3", *common).code == 0
    assert run_main("-m", "seed=4", *common).code == 0
    assert [row["folder"] for row in sweep_rows(tmp_path / "sweep")] == [
        *("experiment=ipol_demo", "experiment=many_highlights", "seed=4,source.limit=1")
    ]
