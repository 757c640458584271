"""Sweeps that option files describe: how they reach Hydra, and what they generate compared with the command line."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.commands import RunMain
from helpers.datasets import TreeHash, sweep_rows
from helpers.photographs import fill

from unprocess_gen.cli.sweep import named_overrides
from unprocess_gen.config.composition import compose_jobs
from unprocess_gen.config.option_files import OptionFolders, conf_dir

PARAMS = {"camera": "sony_a7r,nexus_6p", "gains.red": "2,2.2"}
SWEEP = {"hydra": {"mode": "MULTIRUN", "sweeper": {"params": PARAMS}}}
FOLDERS = [f"camera={camera},gains.red={red}" for camera in ("sony_a7r", "nexus_6p") for red in ("2", "2.2")]
REST = ("source.root=p", "source.limit=1", "out=sweep", "n_jobs=1", "--config-dir", "mine")
NAMED = [f"{folder},source.limit=1" for folder in FOLDERS]


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """Return a folder of the user's option files, next to a folder ``p`` of one photograph."""
    fill(tmp_path / "p", 1)
    (tmp_path / "mine").mkdir()
    return tmp_path / "mine"


def write(path: Path, content: dict[str, Any], header: str = "# @package _global_\n") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(header + yaml.safe_dump(content, sort_keys=False))


def jobs(*overrides: str, own: Path | None = None, multirun: bool = False) -> list[str]:
    """Return the names of the folders that overrides expand to."""
    jobs = list(compose_jobs(overrides, OptionFolders(own=own), multirun))
    assert all(job.swept is not None for job in jobs)
    return [",".join(named_overrides(job.overrides)) for job in jobs]


def test_sweep_in_a_file_equals_the_command_line(
    mine: Path, run_main: RunMain, tree_hash: TreeHash, tmp_path: Path
) -> None:
    write(mine / "sweep/two.yaml", SWEEP)
    write(mine / "two.yaml", {"defaults": ["config", "_self_"]} | SWEEP, "")
    params = [f"{key}={value}" for key, value in PARAMS.items()]
    found = []
    for arguments in (["-m", *params], ["+sweep=two"], ["-cn", "two"]):
        done = run_main(*arguments, *REST)
        assert done.code == 0, done.err
        rows = [row | {"seconds": ""} for row in sweep_rows(tmp_path / "sweep")]
        found.append((rows, [tree_hash(tmp_path / "sweep" / name) for name in FOLDERS]))
        shutil.rmtree(tmp_path / "sweep")
    assert [(row["folder"], row["overrides"]) for row in found[0][0]] == list(zip(FOLDERS, NAMED, strict=True))
    assert found[1] == found[2] == found[0]


def test_settings_next_to_the_params_hold_for_every_job(mine: Path) -> None:
    write(mine / "sweep/two.yaml", {"defaults": [{"override /isp": "linear"}], "seed": 9} | SWEEP)
    for job in compose_jobs(["+sweep=two"], OptionFolders(own=mine)):
        assert (job.config().seed, job.config().isp.tone) == (9, "none")


def test_overrides_win_over_params_of_a_file_and_multiply_others(mine: Path) -> None:
    write(mine / "sweep/two.yaml", SWEEP)
    assert jobs("+sweep=two", "gains.red=2.3", own=mine) == [
        f"camera={camera},gains.red=2.3" for camera in ("sony_a7r", "nexus_6p")
    ]
    assert jobs("+sweep=two", "camera=convex,identity", "gains.red=2.3", own=mine) == [
        f"camera={camera},gains.red=2.3" for camera in ("convex", "identity")
    ]
    assert jobs("+sweep=two", "seed=1,2", own=mine) == [
        f"{folder},seed={seed}" for seed in (1, 2) for folder in FOLDERS
    ]
    params = {"seed": "range(1,4)", "camera": "glob(sony*)", "source.recursive": True, "noise.draws": 2}
    write(mine / "sweep/forms.yaml", {"hydra": {"mode": "MULTIRUN", "sweeper": {"params": params}}})
    assert jobs("+sweep=forms", own=mine) == [
        f"camera={camera},noise.draws=2,seed={seed},source.recursive=True"
        for seed in (1, 2, 3)
        for camera in ("sony_a7r", "sony_a7s2", "sony_rx100")
    ]


@pytest.mark.parametrize(
    "repeated",
    [
        ["+sweep=cameras", "+sweep=gain_extremes"],
        ["+experiment=crvd_like", "+experiment=ipol_demo"],
        ["-m", "seed=1,2", "seed=5"],
        ["-m", "seed=5", "++seed=1,2"],
    ],
)
def test_repeated_groups_and_swept_keys_are_refused(repeated: list[str], run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("plan", *repeated)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    first, second = repeated[-2:]
    assert f"{second}: {first} sets {second.lstrip('+').partition('=')[0]} too; expected one of them; " in done.err


REFUSED = {
    "params without mode": (
        {"sweeper": {"params": {"seed": "1,2"}}}, r"hydra.sweeper.params.seed: .*without hydra.mode: MULTIRUN; add",
    ),
    "other folder": ({"mode": "MULTIRUN", "sweep": {"dir": "elsewhere"}}, r"hydra.sweep.dir=elsewhere: has no effect"),
    "working directory": ({"job": {"chdir": True}}, r"hydra.job.chdir=true: has no effect here"),
    "list of params": ({"mode": "MULTIRUN", "sweeper": {"params": ["seed=1,2"]}}, r".*Cannot merge"),
    "interval": (
        {"mode": "MULTIRUN", "sweeper": {"params": {"gains.red": "interval(1,2)"}}}, r"gains.red=interval\(1,2\): an",
    ),
    "broken values": ({"mode": "MULTIRUN", "sweeper": {"params": {"seed": "choice(1"}}}, r".*choice\(1"),
    "settings of Hydra": (
        {"mode": "MULTIRUN", "sweeper": {"params": {"hydra.verbose": "true,false"}}}, r"hydra.verbose=true,false: ",
    ),
    "removed key": ({"mode": "MULTIRUN", "sweeper": {"params": {"~seed": "1"}}}, r"~seed=1: a setting cannot be"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_sweeps_that_cannot_be_honoured_are_refused(case: str, mine: Path, run_main: RunMain, tmp_path: Path) -> None:
    content, sentence = REFUSED[case]
    write(mine / "sweep/bad.yaml", {"hydra": content})
    done = run_main("+sweep=bad", *REST)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert re.match("gen-dataset: " + sentence, done.err), done.err
    assert not (tmp_path / "sweep").exists()


MISREAD = [
    ("sweep/seeds.yaml", SWEEP, ["+sweep=seeds"], "expected '# @package _global_' as its first line"),
    ("config.yaml", {"seed": 3}, ["--config-name", "config"], "mine/config.yaml has the name of a built-in file"),
    (
        "noise/hides.yaml",
        {"defaults": [{"/sweep@_global_": "inner"}]},
        ["-m", "noise=hides,none"],
        "params.seed: found in an",
    ),
]


@pytest.mark.parametrize(("file", "content", "arguments", "sentence"), MISREAD, ids=[file for file, *_ in MISREAD])
def test_files_that_hydra_would_misread_are_refused(
    file: str, content: dict[str, Any], arguments: list[str], sentence: str, mine: Path, run_main: RunMain
) -> None:
    write(mine / "sweep/inner.yaml", {"hydra": {"sweeper": {"params": {"seed": "1,2"}}}})
    write(mine / file, content, header="")
    done = run_main(*arguments, *REST)
    assert (done.code, done.err.count("\n"), sentence in done.err) == (2, 1, True), done.err


SHIPPED = {"iso_ladder": 5, "cameras": 4, "camera_by_iso": 20, "gain_extremes": 8, "paper_figure6": 4}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_sweeps_have_a_purpose_and_their_jobs(name: str) -> None:
    text = (conf_dir() / "sweep" / f"{name}.yaml").read_text(encoding="utf-8")
    assert "# Purpose: " in text
    assert f"#   gen-dataset +sweep={name} source.root=photos out=sweep" in text
    assert len(set(jobs(f"+sweep={name}"))) == SHIPPED[name]


def test_shipped_sweep_runs_and_shows_its_places(mine: Path, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("+sweep=cameras", "source.root=p", "out=sweep", "n_jobs=1")
    assert (done.code, "3/4 camera=sony_rx100" in done.err) == (0, True), done.err
    assert [row["exit"] for row in sweep_rows(tmp_path / "sweep")] == ["0"] * SHIPPED["cameras"]


def test_cfg_job_prints_every_job_of_a_sweep(mine: Path, run_main: RunMain) -> None:
    done = run_main("+sweep=cameras", "--cfg", "job")
    assert done.code == 0
    cameras = re.findall(r"^camera:\n  name: (\w+)$", done.out, re.MULTILINE)
    assert cameras == ["sony_a7r", "olympus_em10", "sony_rx100", "nexus_6p"]
