"""Sweeps that a Hydra launcher or sweeper plugin of the user runs."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

import pytest
from helpers.commands import Cli, RunMain
from helpers.datasets import TreeHash, sweep_rows
from helpers.photographs import fill

needs_joblib_launcher = pytest.mark.skipif(
    find_spec("hydra_plugins") is None or find_spec("hydra_plugins.hydra_joblib_launcher") is None,
    reason="needs the package hydra-joblib-launcher",
)

IN_PROCESS = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=1")
"""joblib runs a single job at a time in the process of the sweep; two at a time would start workers."""

SWEEPER = '''
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper


class TwoSeeds(Sweeper):
    """Try two seeds in two batches; the second depends on the result of the first."""

    def __init__(self, first):
        self.first = first

    def setup(self, *, hydra_context, task_function, config):
        self.config = config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments):
        result = self.launcher.launch([[*arguments, f"seed={self.first}"]], initial_job_idx=0)[0].return_value
        self.launcher.launch([[*arguments, f"seed={self.first + 1 + result}"]], initial_job_idx=1)


ConfigStore.instance().store(
    group="hydra/sweeper",
    name="two_seeds",
    node={"_target_": "hydra_plugins.two_seeds.TwoSeeds", "first": 5},
    provider="two_seeds",
)
'''


@pytest.mark.slow
@needs_joblib_launcher
@pytest.mark.parametrize("n_jobs", [1, 2])
def test_joblib_launcher_generates_the_datasets_of_a_sweep(
    n_jobs: int, cli: Cli, run_main: RunMain, tree_hash: TreeHash, tmp_path: Path
) -> None:
    fill(tmp_path / "p", 2)
    sweep = ("-m", "camera=sony_a7r,nexus_6p", "source.root=p", "n_jobs=1")
    done = cli(*sweep, "out=launched", "hydra/launcher=joblib", f"hydra.launcher.n_jobs={n_jobs}")
    assert done.returncode == 0, done.stderr
    assert run_main(*sweep, "out=own").code == 0

    folders = ["camera=sony_a7r", "camera=nexus_6p"]
    assert sorted(os.listdir(tmp_path / "launched")) == sorted([".hydra", *folders, "sweep.csv"])
    launched, own = sweep_rows(tmp_path / "launched"), sweep_rows(tmp_path / "own")
    assert [row | {"seconds": ""} for row in launched] == [row | {"seconds": ""} for row in own]
    for folder in folders:
        assert tree_hash(tmp_path / "launched" / folder) == tree_hash(tmp_path / "own" / folder)


@needs_joblib_launcher
def test_failing_job_of_a_launcher_decides_the_exit_code(run_main: RunMain, tmp_path: Path) -> None:
    fill(tmp_path / "p", 1)
    done = run_main("-m", "gains.red=0,2", "source.root=p", "n_jobs=1", "out=sweep", *IN_PROCESS)
    assert done.code == 2
    assert done.err.count("gains.red=0: expected a gain above 0") == 1
    assert [(row["folder"], row["exit"]) for row in sweep_rows(tmp_path / "sweep")] == [
        ("gains.red=0", "2"), ("gains.red=2", "0"),
    ]  # fmt: skip


@needs_joblib_launcher
def test_launcher_runs_a_sweep_in_a_file(run_main: RunMain, tmp_path: Path) -> None:
    fill(tmp_path / "p", 1)
    (tmp_path / "mine/sweep").mkdir(parents=True)
    (tmp_path / "mine/sweep/seeds.yaml").write_text(
        "# @package _global_\ndefaults: [{override /hydra/launcher: joblib}]\n"
        "hydra: {mode: MULTIRUN, launcher: {n_jobs: 1}, sweeper: {params: {seed: '1,2'}}}\n"
    )
    done = run_main("+sweep=seeds", "--config-dir", "mine", "source.root=p", "n_jobs=1", "out=sweep")
    assert done.code == 0, done.err
    assert [(row["folder"], row["seed"], row["exit"]) for row in sweep_rows(tmp_path / "sweep")] == [
        ("seed=1", "1", "0"), ("seed=2", "2", "0"),
    ]  # fmt: skip


def test_sweeper_plugin_chooses_the_jobs(cli: Cli, tmp_path: Path) -> None:
    fill(tmp_path / "p", 1)
    (tmp_path / "plugins/hydra_plugins").mkdir(parents=True)
    (tmp_path / "plugins/hydra_plugins/two_seeds.py").write_text(SWEEPER)
    path = os.pathsep.join([str(tmp_path / "plugins"), os.environ.get("PYTHONPATH", "")])
    done = cli(
        "-m", "hydra/sweeper=two_seeds", "hydra.sweeper.first=3", "source.root=p", "n_jobs=1", "out=sweep",
        PYTHONPATH=path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [(row["folder"], row["seed"], row["rows"]) for row in sweep_rows(tmp_path / "sweep")] == [
        ("seed=3", "3", "1"), ("seed=4", "4", "1"),
    ]  # fmt: skip


def test_unknown_launcher_is_refused_in_one_line(run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("-m", "seed=1,2", "hydra/launcher=nope", "out=sweep")
    assert done.code == 2
    assert "hydra/launcher=nope: no such option; expected one of basic" in done.err
    assert not (tmp_path / "sweep").exists()


def test_plan_of_a_sweep_ignores_the_launcher(run_main: RunMain, tmp_path: Path) -> None:
    fill(tmp_path / "p", 1)
    done = run_main("plan", "-m", "seed=1,2", "source.root=p", "n_jobs=1", "hydra/launcher=basic")
    assert (done.code, done.out.count("sources   1")) == (0, 2)
    assert os.listdir(tmp_path) == ["p"]
