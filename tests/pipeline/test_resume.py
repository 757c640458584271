"""Runs that are killed, stopped, refused or repeated: what is on disk afterwards."""

from __future__ import annotations

import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from helpers.commands import COMMAND, Cli, RunMain, environment
from helpers.datasets import MadeHash, Make, TreeHash
from helpers.photographs import fill, pixels
from helpers.processes import (
    ONE,
    WAIT_S,
    Killed,
    assert_complete,
    committed,
    imported_first,
    kill_group,
    processes_per_core,
    running,
    session,
    unfinished,
    wait_for,
    workers,
)
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.cli.messages import logging_to
from unprocess_gen.core.errors import ConfigError, DamageError, LockedError, MachineError
from unprocess_gen.core.locks import LockFile, host
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline import generate as runner
from unprocess_gen.pipeline.storage.local import LocalStorage
from unprocess_gen.pipeline.workspace import read_dataset

TWO = "output.pairs_per_shard=2"


@pytest.fixture(scope="module")
def forty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill(tmp_path_factory.mktemp("forty") / "p", 40)


@pytest.fixture(scope="module")
def undisturbed(forty: Path, made_hash: MadeHash) -> str:
    return made_hash(forty, ONE)


# Killed ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kills", [3, pytest.param(10, marks=pytest.mark.slow)])
def test_run_killed_repeatedly_ends_as_if_undisturbed(
    kills: int,
    forty: Path,
    undisturbed: str,
    make: Make,
    tree_hash: TreeHash,
    tmp_path: Path,
    figure: Figure,
) -> None:
    """Each kill comes a few random milliseconds after a number of shards that grows from kill to kill."""
    moment = random.Random(385)
    out = tmp_path / "ds"
    env = imported_first(tmp_path, unfinished(out, 36))
    for kill in range(kills):
        with running(f"source.root={forty}", ONE, f"n_jobs={1 + (kill % 3 == 0)}", cwd=tmp_path, **env) as process:
            wait_for(lambda at=3 * kill: (out.exists() and committed(out) >= at) or process.poll() is not None)
            time.sleep(moment.uniform(0, 0.05))
            assert process.poll() is None, process.communicate()
            kill_group(process)
        assert not (out / "dataset.json").exists()
        assert committed(out) >= 3 * kill
    make(forty, out, ONE)
    assert tree_hash(out) == undisturbed
    assert_complete(out)
    figure("resume", f"same bytes after {kill + 1} kills of one run")


FILES = 11
"""Files of a run with three shards: the listing, config.yaml, file and record of each, manifest and dataset.json."""


@pytest.fixture(scope="module")
def six(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make photographs p, and their dataset ds in three shards."""
    folder = tmp_path_factory.mktemp("six")
    make(fill(folder / "p", 6), folder / "ds", TWO)
    return folder


@pytest.mark.parametrize("number", range(FILES))
def test_run_killed_around_any_rename_can_be_resumed(
    number: int,
    six: Path,
    make: Make,
    tree_hash: TreeHash,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    figure: Figure,
) -> None:
    for renamed in (False, True):
        source, out = six / "p", tmp_path / f"ds-{renamed}"
        seen: list[Path] = []

        def stops(place: Any, old: Any, new: Any, renamed: bool = renamed, seen: list[Path] = seen) -> None:
            stop = len(seen) == number and tmp_path in Path(new).parents
            seen.append(Path(new))
            if not stop or renamed:
                place(old, new)
            if stop:
                raise Killed

        with monkeypatch.context() as patch, pytest.raises(Killed):
            for name in ("replace", "link"):
                patch.setattr(os, name, partial(stops, getattr(os, name)))
            make(source, out, TWO)
        make(source, out, TWO)
        assert tree_hash(out) == tree_hash(six / "ds"), renamed
        assert_complete(out)
    figure("resume", "same bytes after a kill before or after each rename")


def test_every_rename_of_a_run_is_tested(make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def placed(place: Any, old: Any, new: Any) -> None:
        seen.append(Path(new).relative_to(tmp_path / "ds").as_posix())
        place(old, new)

    for name in ("replace", "link"):
        monkeypatch.setattr(os, name, partial(placed, getattr(os, name)))
    make(fill(tmp_path / "p", 5), tmp_path / "ds", TWO)
    assert seen == [
        ".work/sources/00000.json", ".work/listing.json", "config.yaml", "shards/shard-00000.tar",
        ".work/rows/00000.json", "shards/shard-00001.tar", ".work/rows/00001.json", "shards/shard-00002.tar",
        ".work/rows/00002.json", "manifest.csv", "dataset.json",
    ]  # fmt: skip
    assert len(seen) == FILES


def test_files_are_synced_before_their_rename(make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a loss of power no file may have its final name without its contents; its folder is synced next."""
    seen: list[tuple[str, str]] = []

    def path_of(handle: int) -> str:
        return str(Path(f"/proc/self/fd/{handle}").readlink())

    def placed(place: Any, old: Any, new: Any) -> None:
        seen.append((f"rename {old}", str(new)))
        place(old, new)

    monkeypatch.setattr(os, "fsync", lambda handle: seen.append(("sync", path_of(handle))))
    for name in ("replace", "link"):
        monkeypatch.setattr(os, name, partial(placed, getattr(os, name)))
    make(fill(tmp_path / "p", 2), tmp_path / "ds", ONE)
    renames = [i for i, (what, _) in enumerate(seen) if what != "sync"]
    assert len(renames) == 9
    for i in renames:
        old, new = seen[i][0].removeprefix("rename "), seen[i][1]
        assert ("sync", old) in seen[:i], old
        assert seen[i + 1] == ("sync", str(Path(new).parent)), new


# Begun ----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def begun_template(six: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make photographs p, and a dataset ds of which two shards of three are committed."""
    folder = Path(shutil.copytree(six / "p", tmp_path_factory.mktemp("begun") / "p")).parent
    replace = os.replace

    def stops(old: Any, new: Any) -> None:
        if Path(new).name == "shard-00002.tar":
            raise Killed
        replace(old, new)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        patch.setattr(os, "replace", stops)
        make(folder / "p", folder / "ds", TWO)
    assert committed(folder / "ds") == 2
    return folder


@pytest.fixture
def begun(begun_template: Path, tmp_path: Path) -> Path:
    """Copy photographs p, and a dataset ds of which two shards of three are committed."""
    return Path(shutil.copytree(begun_template, tmp_path, dirs_exist_ok=True))


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_resumed_run_makes_only_missing_shards(begun: Path, make: Make) -> None:
    before = snapshot(begun / "ds/shards")
    summary = make(begun / "p", begun / "ds", TWO)
    assert (summary.made, summary.rows) == (2, 6)
    after = snapshot(begun / "ds/shards")
    assert {name: after[name] for name in before} == before


def leave(folder: Path) -> Path:
    """Write half a shard as a process of this host that has ended."""
    folder.mkdir(parents=True)
    ended = {"host": host(), "pid": os.getpid(), "start": "0", "mark": "0"}
    (folder / "owner").write_text(json.dumps(ended))
    (folder / "shard-00002.tar.1.1").write_bytes(b"half")
    return folder / "shard-00002.tar.1.1"


def test_unfinished_shards_are_deleted_at_the_start(begun: Path, make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    left = [leave(begun / "ds/.work/tmp/host-1-a"), begun / "ds/.work/tmp/shard-00002.tar.1.1"]
    left[1].write_bytes(b"half")  # as version 0.1 left it
    there: list[bool] = []
    count_jobs = runner.effective_jobs

    def counted(*given: Any) -> int:
        there.extend(path.exists() for path in left)
        return count_jobs(*given)

    monkeypatch.setattr(runner, "effective_jobs", counted)
    make(begun / "p", begun / "ds", TWO)
    assert there == [False, False]


def test_unfinished_files_are_deleted_at_the_end(begun: Path, make: Make) -> None:
    of_another_host = begun / "ds/.work/tmp/elsewhere-1-a"
    of_another_host.mkdir(parents=True)
    os.utime(of_another_host, (0, 0))
    (begun / "ds/.work/manifest.csv.part").write_text("half")
    make(begun / "p", begun / "ds", TWO)
    assert_complete(begun / "ds")


def test_unfinished_files_of_a_running_process_are_kept(begun: Path, make: Make, tree_hash: TreeHash) -> None:
    other = LocalStorage(begun / "ds")
    (other.scratch / "half").write_bytes(b"half")
    make(begun / "p", begun / "ds", TWO)
    assert (other.scratch / "half").read_bytes() == b"half"
    other.close()
    assert_complete(begun / "ds")


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: os.truncate(path, 600)], ids=["deleted", "cut off"])
def test_incomplete_committed_shard_is_regenerated(
    damage: Callable[[Path], Any], six: Path, begun: Path, make: Make, tree_hash: TreeHash
) -> None:
    damage(begun / "ds/shards/shard-00000.tar")
    assert make(begun / "p", begun / "ds", TWO).made == 4
    assert tree_hash(begun / "ds") == tree_hash(six / "ds")


def test_progress_of_a_resumed_run_counts_finished_images(begun: Path, make: Make, capfd: Any) -> None:
    with logging_to():
        make(begun / "p", begun / "ds", TWO)
    assert "gen-dataset: 6/6 images" in capfd.readouterr().err


@pytest.fixture
def finished(six: Path, tmp_path: Path) -> Path:
    """Copy photographs p and their dataset ds."""
    return Path(shutil.copytree(six, tmp_path, dirs_exist_ok=True))


def add(source: Path) -> None:
    Image.fromarray(pixels(77, 9, 9)).save(source / "new.png")


CHANGES: list[tuple[str, Callable[[Path], Any], str]] = [
    ("seed=1", lambda source: None, r"was begun with other settings: seed=1 \(there: 0\)"),
    ("isp=srgb", lambda source: None, r"was begun with other settings: isp.gamma=srgb \(there: 2.2\); isp.tone=none"),
    ("source.limit=5", lambda source: None, r"was begun with other settings: source.limit=5 \(there: null\)"),
    ("seed=0", add, r"was begun with other sources: new.png is new"),
    ("seed=0", lambda source: (source / "003.png").unlink(), r"was begun with other sources: 003.png was deleted"),
    (
        "seed=0",
        lambda source: (source / "003.png").write_bytes(b"x"),
        r"was begun with other sources: 003.png has 1 bytes, had \d+",
    ),
    (
        "seed=0",
        lambda source: (source / "003.png").rename(source / "x.png"),
        r"was begun with other sources: x.png is new; 003.png was deleted",
    ),
    (
        "seed=0",
        lambda source: [path.unlink() for path in sorted(source.iterdir())[:5]],
        r"000.png was deleted; 001.png was deleted; 002.png was deleted; and 2 more",
    ),
]


@pytest.mark.parametrize("state", ["begun", "finished"])
@pytest.mark.parametrize(("override", "change", "sentence"), CHANGES)
def test_changed_settings_or_sources_are_refused_and_change_nothing(
    state: str, override: str, change: Callable[[Path], Any], sentence: str, request: pytest.FixtureRequest, make: Make
) -> None:
    folder: Path = request.getfixturevalue(state)
    before = snapshot(folder / "ds")
    change(folder / "p")
    with pytest.raises(ConfigError, match=f"^out=.*/ds: .*{sentence}.*; choose another out, or remove it$"):
        make(folder / "p", folder / "ds", TWO, override)
    assert snapshot(folder / "ds") == before


def test_scene_run_is_not_resumed_from_a_folder(begun: Path, make: Make) -> None:
    with pytest.raises(ConfigError, match=r"source.kind=synthetic \(there: folder\)"):
        make(None, begun / "ds", TWO)


# Finished -------------------------------------------------------------------------------------------------------------


def test_rerun_of_a_finished_dataset_reports_nothing_to_do(finished: Path, run_main: RunMain) -> None:
    before = snapshot(finished)
    done = run_main("source.root=p", TWO)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("ds is complete: 6 pairs in 3 shards")
    assert done.out.endswith("; nothing to do\n")
    assert snapshot(finished) == before


def test_finished_dataset_of_scenes_is_complete(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1")
    assert make(None, tmp_path / "ds", "source.limit=1").made == 0


def test_missing_shard_of_a_finished_dataset_is_damage(finished: Path, run_main: RunMain) -> None:
    (finished / "ds/shards/shard-00001.tar").unlink()
    done = run_main("source.root=p", TWO)
    assert (done.code, done.err.count("\n")) == (4, 1)
    assert "shard-00001.tar: is missing, expected " in done.err


def test_shard_of_another_size_is_damage(finished: Path, make: Make) -> None:
    os.truncate(finished / "ds/shards/shard-00001.tar", 700)
    with pytest.raises(DamageError, match=r"shard-00001.tar: has 700 bytes, expected \d+ bytes"):
        make(finished / "p", finished / "ds", TWO)


def test_finished_dataset_without_manifest_is_damage(finished: Path, make: Make) -> None:
    (finished / "ds/manifest.csv").unlink()
    with pytest.raises(DamageError, match=r"manifest.csv: no such manifest"):
        make(finished / "p", finished / "ds", TWO)


def test_finished_dataset_without_config_is_damage(finished: Path, make: Make) -> None:
    (finished / "ds/config.yaml").unlink()
    with pytest.raises((DamageError, ConfigError)):
        make(finished / "p", finished / "ds", TWO, "seed=1")


@pytest.mark.parametrize(
    ("state", "name"),
    [
        ("begun", "config.yaml"),
        ("begun", ".work/sources/00000.json"),
        ("begun", ".work/listing.json"),
        ("finished", "dataset.json"),
    ],
)
def test_unreadable_dataset_file_is_reported_in_one_line(
    state: str, name: str, request: pytest.FixtureRequest, run_main: RunMain
) -> None:
    folder: Path = request.getfixturevalue(state)
    (folder / "ds" / name).write_text("{[")
    done = run_main("source.root=p", TWO, "n_jobs=1")
    assert done.code in (2, 4)
    assert done.err.count("\n") == 1


def test_committed_shard_with_unreadable_rows_is_regenerated(begun: Path, make: Make) -> None:
    (begun / "ds/.work/rows/00000.json").write_text("{[")
    make(begun / "p", begun / "ds", TWO)
    assert_complete(begun / "ds")


def test_committed_shard_with_truncated_rows_is_regenerated(
    begun: Path, make: Make, tree_hash: Callable[[Path], str], tmp_path: Path
) -> None:
    record = begun / "ds/.work/rows/00000.json"
    record.write_bytes(record.read_bytes()[:-1])
    make(begun / "p", begun / "ds", TWO)
    make(begun / "p", tmp_path / "other", TWO)
    assert tree_hash(begun / "ds") == tree_hash(tmp_path / "other")


def test_records_of_many_shards_are_deleted(begun: Path, make: Make) -> None:
    """More files than one thread deletes at a time."""
    for number in range(100, 300):
        (begun / f"ds/.work/rows/{number:05d}.json").write_text("{}")
    make(begun / "p", begun / "ds", TWO)
    assert_complete(begun / "ds")


def test_work_folder_left_by_a_kill_is_deleted(finished: Path, make: Make) -> None:
    (finished / "ds/.work/rows").mkdir(parents=True)
    make(finished / "p", finished / "ds", TWO)
    assert_complete(finished / "ds")


# Lock and foreign files -----------------------------------------------------------------------------------------------


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Lock a folder as a run does."""
    (folder / ".work").mkdir(parents=True, exist_ok=True)
    lock = LockFile(folder / ".work/lock")
    lock.acquire(wait=False)
    try:
        yield
    finally:
        lock.release()


@pytest.mark.parametrize("name", ["shards/shard-00000.tar", "manifest.csv", "dataset.json", "photo.jpg", "thesis.tex"])
def test_folder_with_foreign_files_is_refused_and_unchanged(name: str, make: Make, tmp_path: Path) -> None:
    path, entry = tmp_path / "ds" / name, name.split("/")[0]
    path.parent.mkdir(parents=True)
    path.write_text("precious")
    message = (
        rf"out=.*/ds: contains {entry}, but no config.yaml; expected an empty folder or a dataset; choose another out"
    )
    with pytest.raises(ConfigError, match=message):
        make(fill(tmp_path / "p", 1), tmp_path / "ds")
    assert path.read_text() == "precious"
    assert os.listdir(tmp_path / "ds") == [entry]


def test_foreign_shard_is_refused(begun: Path, make: Make) -> None:
    (begun / "ds/shards/shard-00009.tar").write_text("stale")
    with pytest.raises(ConfigError, match=r"unexpected file .*shard-00009.tar; expected only committed shards"):
        make(begun / "p", begun / "ds", TWO)


def test_folder_locked_by_another_run_is_refused_with_11(run_main: RunMain, tmp_path: Path) -> None:
    fill(tmp_path / "p", 1)
    with held(tmp_path / "ds"):
        done = run_main("source.root=p")
    assert done == (
        11,
        "",
        "gen-dataset: out=ds: another run is writing to it; wait for that run, or choose another out\n",
    )
    assert list((tmp_path / "ds").rglob("*")) == [tmp_path / "ds/.work"]


def test_locked_finished_dataset_is_refused(finished: Path, make: Make) -> None:
    with held(finished / "ds"), pytest.raises(LockedError):
        make(finished / "p", finished / "ds", TWO)


def test_finished_run_releases_its_folder(finished: Path) -> None:
    with held(finished / "ds"):
        pass


def test_two_runs_at_once_make_one_dataset(forty: Path, undisturbed: str, tree_hash: TreeHash, tmp_path: Path) -> None:
    arguments = (f"source.root={forty}", ONE, "n_jobs=1")
    with running(*arguments, cwd=tmp_path) as one, running(*arguments, cwd=tmp_path) as other:
        codes = sorted((one.wait(WAIT_S), other.wait(WAIT_S)))
    assert codes in ([0, 0], [0, 11])  # one may be done before the other begins
    assert tree_hash(tmp_path / "ds") == undisturbed


def test_empty_folder_is_accepted(make: Make, tmp_path: Path) -> None:
    (tmp_path / "ds").mkdir()
    make(fill(tmp_path / "p", 1), tmp_path / "ds")
    assert_complete(tmp_path / "ds")


# Stopped --------------------------------------------------------------------------------------------------------------

LONG = ("source.limit=400", ONE, "n_jobs=2")
"""A run whose workers are busy with scenes for minutes."""


class Stopped(NamedTuple):
    """Hold the exit code, stderr, folder, and processes five seconds after the signal, of a run that got one."""

    number: int
    code: int
    err: str
    left: list[int]
    out: Path


SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SENT = [
    (signal.SIGINT, "group", "photographs"),  # Ctrl-C
    (signal.SIGTERM, "process", "photographs"),  # kill
    (signal.SIGHUP, "group", "photographs"),  # a terminal that closes
    *itertools.product(SIGNALS, ("process", "group"), ("scenes",)),
]


@pytest.fixture(
    scope="module",
    params=[pytest.param(sent, marks=() if sent in SENT[:2] else pytest.mark.slow) for sent in SENT],
    ids=[f"{number.name} to the {whom}, {sources}" for number, whom, sources in SENT],
)
def stopped(request: pytest.FixtureRequest, forty: Path, tmp_path_factory: pytest.TempPathFactory) -> Stopped:
    number, whom, sources = request.param
    folder = tmp_path_factory.mktemp("stopped")
    arguments, env = LONG, {}
    if sources == "photographs":
        arguments, env = (
            (f"source.root={forty}", ONE, "n_jobs=2"),
            imported_first(folder, unfinished(folder / "ds", 36)),
        )
    with running(*arguments, cwd=folder, **env) as process:
        wait_for(lambda: committed(folder / "ds") or process.poll() is not None)
        assert workers(process.pid), process.communicate()
        (os.killpg if whom == "group" else os.kill)(process.pid, number)
        _, err = process.communicate(timeout=15 * processes_per_core())
        until = time.monotonic() + 5 * processes_per_core()
        while (left := session(process.pid)) and time.monotonic() < until:
            time.sleep(0.05)
    return Stopped(number, process.returncode, err, left, folder / "ds")


def test_signal_ends_the_run_with_its_code(stopped: Stopped) -> None:
    assert stopped.code == 128 + stopped.number


def test_signal_leaves_no_process_behind(stopped: Stopped) -> None:
    assert stopped.left == []


def test_signal_leaves_the_dataset_unfinished(stopped: Stopped) -> None:
    assert (stopped.out / ".work/listing.json").exists()
    assert not (stopped.out / "dataset.json").exists()


def test_signal_prints_only_lines_of_gen_dataset(stopped: Stopped) -> None:
    others = [line for line in stopped.err.splitlines() if not line.startswith("gen-dataset: ")]
    assert others == []


@pytest.mark.slow
def test_workers_end_when_their_coordinator_is_killed(tmp_path: Path) -> None:
    """`test_orphaned_workers_do_not_disturb_the_next_run` is the quick form."""
    with running(*LONG, cwd=tmp_path) as process:
        wait_for(lambda: committed(tmp_path / "ds"))
        assert len(workers(process.pid)) == 2
        os.kill(process.pid, signal.SIGKILL)
        wait_for(lambda: not session(process.pid), seconds=10 * processes_per_core())


DEADLY = """
import hashlib, os, pathlib, signal

deaths, killer, sha256 = pathlib.Path(os.environ["DEATHS"]), pathlib.Path(os.environ["KILLER"]), hashlib.sha256


def deadly(data=b"", **options):
    left = int(deaths.read_text())
    if left and isinstance(data, bytes) and data == killer.read_bytes():
        deaths.write_text(str(left - 1))
        os.kill(os.getpid(), signal.SIGKILL)
    return sha256(data, **options)


hashlib.sha256 = deadly
"""
"""Module for `imported_first`: hashing one photograph kills the worker a number of times."""

TWELVE = ("source.root=p", "output.pairs_per_shard=4", "n_jobs=2")


def run_with_deaths(cli: Cli, folder: Path, deaths: int) -> subprocess.CompletedProcess[str]:
    """Make a dataset of twelve photographs; the tenth, in the third shard, kills its worker."""
    fill(folder / "p", 12)
    (folder / "deaths").write_text(str(deaths))
    env = imported_first(folder, DEADLY)
    return cli(*TWELVE, **env, DEATHS=str(folder / "deaths"), KILLER=str(folder / "p/009.png"))


@pytest.fixture(scope="module")
def twelve_undisturbed(make: Make, tree_hash: TreeHash, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("undisturbed")
    make(fill(folder / "p", 12), folder / "ds", "output.pairs_per_shard=4")
    return tree_hash(folder / "ds")


@pytest.mark.slow
def test_worker_that_dies_once_changes_no_byte(
    twelve_undisturbed: str, cli: Cli, tree_hash: TreeHash, tmp_path: Path
) -> None:
    """`test_killed_worker_is_noticed_within_five_seconds` is the quick form."""
    done = run_with_deaths(cli, tmp_path, deaths=1)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "deaths").read_text() == "0"
    assert "12 pairs in 3 shards" in done.stdout
    assert tree_hash(tmp_path / "ds") == twelve_undisturbed
    assert not (tmp_path / "ds/.work").exists()


def test_source_that_kills_two_workers_is_retried_by_reruns(
    twelve_undisturbed: str, cli: Cli, make: Make, tree_hash: TreeHash, tmp_path: Path
) -> None:
    done = run_with_deaths(cli, tmp_path, deaths=2)
    lines = [line for line in done.stderr.splitlines() if "images/s" not in line]
    assert (done.returncode, lines) == (
        3,
        ["gen-dataset: 009.png: its worker died twice; run the same command again to retry it"],
    )
    rows = list(read_rows(tmp_path / "ds/manifest.csv"))
    assert [row["reason"] for row in rows] == [""] * 8 + ["worker_died"] * 4
    entries = read_dataset(tmp_path / "ds/dataset.json")["shards"]
    assert [entry.get("provisional", False) for entry in entries] == [False, False, True]
    assert not (tmp_path / "ds/shards/shard-00002.tar").exists()
    assert len(RawPairs(tmp_path / "ds")) == 8

    assert make(tmp_path / "p", tmp_path / "ds", TWELVE[1]).made == 4
    assert tree_hash(tmp_path / "ds") == twelve_undisturbed
    assert not (tmp_path / "ds/.work").exists()


# System errors --------------------------------------------------------------------------------------------------------


def test_failed_write_ends_with_5_and_a_rerun_finishes(make: Make, tree_hash: TreeHash, tmp_path: Path) -> None:
    """A limit on the size of files acts as a full disk."""
    source = fill(tmp_path / "p", 3)
    Image.fromarray(pixels(5, 300, 300)).save(source / "large.png")
    command = f"ulimit -f 300; exec {COMMAND} source.root=p n_jobs=1 {ONE}"
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )
    assert (done.returncode, done.stdout) == (5, ""), done.stderr
    lines = [line for line in done.stderr.splitlines() if "images/s" not in line]
    assert len(lines) == 1
    assert "File too large" in lines[0] and "bytes free" in lines[0]
    assert committed(tmp_path / "ds") == 3
    assert not (tmp_path / "ds/.work/tmp").exists()
    make(source, tmp_path / "ds", ONE)
    make(source, tmp_path / "undisturbed", ONE)
    assert tree_hash(tmp_path / "ds") == tree_hash(tmp_path / "undisturbed")


def test_deleted_out_is_a_system_error(make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_tasks = runner.run_tasks

    def vanishing(*arguments: Any) -> Iterator[Any]:
        for made in run_tasks(*arguments):
            (tmp_path / "ds").rename(tmp_path / "elsewhere")
            yield made

    monkeypatch.setattr(runner, "run_tasks", vanishing)
    with pytest.raises(MachineError, match=r"was deleted or moved"):
        make(fill(tmp_path / "p", 1), tmp_path / "ds")


# A million rows -------------------------------------------------------------------------------------------------------

MERGE = """
import json, os, resource, sys
from pathlib import Path
from unprocess_gen.dataset.columns import NAMES
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.shard_records import record_name
from unprocess_gen.pipeline.workspace import Workspace

out, shards = Path(sys.argv[1]), int(sys.argv[2])
row = next(read_rows(Path(sys.argv[3])))
record = {"entry": {"file": None, "bytes": 0, "sha256": None}, "rows": [[row[name] for name in NAMES]] * 100}
with Workspace(out, "seed: 0\\n") as workspace:
    workspace.open()
    workspace.begin([], shards)
    first = out / record_name(0)
    first.parent.mkdir()
    first.write_text(json.dumps(record))
    for shard in range(1, shards):
        os.link(first, out / record_name(shard))
    workspace.finish(shards, lambda tally: tally.facts())
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, sum(1 for _ in (out / "manifest.csv").open("rb")))
"""


@pytest.mark.slow
def test_million_rows_are_merged_in_constant_memory(tmp_path: Path) -> None:
    """The rows of committed shards are simulated; memory for everything else is bounded by one shard."""
    manifest = str(Path(__file__).parents[2] / "manifests" / "scenes_imx385_iso3200.csv")
    peaks_kib = []
    for shards in (10, 10_000):
        command = [sys.executable, "-c", MERGE, str(tmp_path / f"ds{shards}"), str(shards), manifest]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        peak_kib, lines = map(int, done.stdout.split())
        assert lines == 100 * shards + 1
        peaks_kib.append(peak_kib)
    assert peaks_kib[1] - peaks_kib[0] < 30_000
