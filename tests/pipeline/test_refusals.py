"""Refused folders, true reasons of errors, changed sources, sweeps, progress without a terminal's width."""

from __future__ import annotations

import csv
import errno
import io
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.commands import RunMain, messages, run_process
from helpers.datasets import Make, Settings, flip
from helpers.photographs import fill
from helpers.processes import ONE

from unprocess_gen.cli.messages import logging_to_stderr
from unprocess_gen.cli.process_limits import LEAST_ADDRESS_SPACE
from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.paths import LocalPath
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline import progress as progress_module
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.pipeline.tasks import RunContext
from unprocess_gen.pipeline.verify import verify, verify_sweep


@pytest.fixture(scope="module")
def made(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with photographs ``p`` (one fails) and their dataset ``ds``."""
    folder = tmp_path_factory.mktemp("made")
    (fill(folder / "p", 4) / "003.png").write_bytes(b"not a photograph")
    make(folder / "p", folder / "ds", ONE, "source.max_failed=1")
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy"


# Folders --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("inside", ["ds/other", "ds/shards/other", "ds/shards/a/b", "link/other"])
def test_out_inside_a_finished_dataset_is_refused_with_2(
    inside: str, copy: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(copy)
    (copy / "link").symlink_to("ds")
    before = sorted(copy.rglob("*"))
    done = run_main("source.limit=1", f"out={inside}")
    assert (done.code, done.out) == (2, "")
    assert (
        done.err == f"gen-dataset: out={inside}: is inside the dataset {copy}/ds; expected a folder outside of it; "
        "choose another out\n"
    )
    assert sorted(copy.rglob("*")) == before
    assert verify(copy / "ds") == []


def test_out_inside_an_unfinished_dataset_is_refused(run_main: RunMain, tmp_path: Path) -> None:
    assert run_main("part", "0/2", f"source.root={fill(tmp_path / 'p', 2)}", ONE, "n_jobs=1", "out=ds").code == 0
    done = run_main("source.limit=1", "out=ds/inner")
    assert (done.code, "is inside the dataset" in done.err) == (2, True)


# Reasons --------------------------------------------------------------------------------------------------------------


def test_unreadable_shard_is_a_system_error(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = LocalPath.open

    def refuse(self: LocalPath, *given: Any, **options: Any) -> Any:
        if self.suffix == ".tar":
            raise PermissionError(errno.EACCES, "Permission denied", str(self))
        return opened(self, *given, **options)

    monkeypatch.setattr(LocalPath, "open", refuse)
    with pytest.raises(MachineError, match=r"shard-00000.tar: Permission denied$"):
        verify(copy / "ds")


def run_limited(kilobytes: int, folder: Path, *arguments: str, **env: str) -> subprocess.CompletedProcess[str]:
    """Run the command with a limit of its address space."""
    command = f'ulimit -v {kilobytes}; exec "$0" -m unprocess_gen source.limit=2 {ONE} "$@"'
    return run_process("bash", "-c", command, sys.executable, *arguments, cwd=folder, **env)


@pytest.mark.parametrize(("kilobytes", "n_jobs"), [(60_000, 1), (LEAST_ADDRESS_SPACE // 1024 - 1, 2)])
def test_small_address_space_ends_with_5_and_one_line(kilobytes: int, n_jobs: int, tmp_path: Path) -> None:
    done = run_limited(kilobytes, tmp_path, f"n_jobs={n_jobs}")
    assert (done.returncode, done.stdout) == (5, "")
    assert done.stderr == (
        f"gen-dataset: ulimit -v {kilobytes}: not enough address space; expected at least "
        f"{LEAST_ADDRESS_SPACE // 1024} (KiB); raise the limit\n"
    )


@pytest.mark.slow
@pytest.mark.parametrize(("kilobytes", "n_jobs"), [(LEAST_ADDRESS_SPACE // 1024, 1), (1_500_000, 2)])
def test_smallest_accepted_address_space_compiles_and_runs(kilobytes: int, n_jobs: int, tmp_path: Path) -> None:
    env = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    done = run_limited(kilobytes, tmp_path, f"n_jobs={n_jobs}", "noise=sony_a7s2", **env)
    assert done.returncode == 0, done.stderr


# Changed sources ------------------------------------------------------------------------------------------------------


HARMS = {"changed": lambda path: flip(path, 50), "deleted": os.unlink, "cut": lambda path: os.truncate(path, 9)}


@pytest.mark.parametrize("harm", HARMS.values(), ids=HARMS)
@pytest.mark.parametrize("verb", [("replay", "ds"), ("verify", "ds", "--regenerate", "9")])
def test_changed_source_ends_with_5_and_advice(
    harm: Callable[[Path], None], verb: tuple[str, ...], copy: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(copy)
    harm(copy / "p/001.png")
    done = run_main(*verb, "source.root=p")
    assert done.code == 5
    (line,) = [line for line in done.err.splitlines() if "00000001" in line]
    assert line.endswith("; restore the file, or regenerate the dataset")


def test_edited_row_is_damage_and_no_changed_source(copy: Path) -> None:
    row = dict(next(read_rows(copy / "ds/manifest.csv")))
    (result,) = replay([row | {"red_gain": 1.0}], str(copy / "p"))
    assert (result.exit_code, result.source_changed) == (4, False)


# Failures -------------------------------------------------------------------------------------------------------------


def test_run_names_the_first_three_sources_that_fail(run_main: RunMain, tmp_path: Path) -> None:
    for path in sorted(fill(tmp_path / "p", 6).iterdir())[1:]:
        path.write_bytes(b"")
    done = run_main("source.root=p", "n_jobs=1")
    lines = [f"gen-dataset: 00{number}.png: empty: 00{number}.png has 0 bytes" for number in (1, 2, 3)]
    assert (done.code, messages(done.err)) == (3, lines)


# Sweeps ---------------------------------------------------------------------------------------------------------------


def sweep(folder: Path, copy: Path, *rows: tuple[str, str]) -> Path:
    folder.mkdir()
    with (folder / "sweep.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([("folder", "exit"), *rows])
    for name, code in rows:
        if code == "0":
            shutil.copytree(copy / "ds", folder / name)
    return folder


def test_every_dataset_of_a_sweep_is_verified_and_unfinished_ones_are_named(copy: Path, tmp_path: Path) -> None:
    folder = sweep(tmp_path / "sweep", copy, ("camera=sony_a7r", "0"), ("camera=convex", "0"), ("seed=1", "5"))
    (folder / "camera=convex/shards/shard-00001.tar").unlink()
    (folder / "seed=2/.work").mkdir(parents=True)
    (folder / "notes").mkdir()
    results = [(result.folder, [str(damage) for damage in result.damages]) for result in verify_sweep(folder)]
    assert results == [
        ("camera=sony_a7r", []),
        ("camera=convex", ["shards/shard-00001.tar: is missing"]),
        ("seed=1", ["dataset.json: is missing: the job ended with exit code 5; rerun the sweep to finish it"]),
        ("seed=2", ["dataset.json: is missing: the sweep ended before this job; rerun the sweep to finish it"]),
    ]


# Progress -------------------------------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    """A terminal that reports no width."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("quiet", [False, True])
def test_bar_is_shown_without_a_terminal_width_unless_quiet(quiet: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setattr(os, "get_terminal_size", lambda *_: os.terminal_size((0, 0)))
    with logging_to_stderr(quiet=quiet), monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", terminal)
        with Progress(4) as progress:
            progress.advance(2, failed=1)
            progress.warn("a warning")
            progress.advance(2)
    assert "gen-dataset: a warning\n" in terminal.getvalue()
    assert all((text in terminal.getvalue()) is not quiet for text in ("4/4", "100%", "failed=1"))


def test_lines_name_the_job_and_time_left_without_compiling(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The first image is finished after a minute of compiling, the next two in six seconds."""
    clock = iter((0.0, 60.0, 66.0))
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: next(clock))
    with logging_to_stderr(), Progress(9, label="3/20 seed=1") as progress:
        progress.advance(1)
        progress.advance(2)
    assert capfd.readouterr() == ("", "gen-dataset: 3/20 seed=1: 3/9 images, 0.3 images/s, 0 failed, 18 s left\n")


def test_progress_counts_images_inside_shards(settings: Settings, tmp_path: Path) -> None:
    context = RunContext(PairSettings(settings("output.pairs_per_shard=8")), str(tmp_path), None)
    for shard, image in ((0, 3), (2, 17)):
        (tmp_path / f"{shard}.busy").write_text(str(image))
    assert context.images_in_progress() == 3 + 1
