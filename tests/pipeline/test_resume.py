"""Runs that are killed, stopped, refused or repeated: what is on disk afterwards."""

from __future__ import annotations

import itertools
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from helpers.cases import slow_except
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
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.locks import LockFile
from unprocess_gen.dataset.dataset_json import read_dataset
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.executors import local
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.verify import verify

TWO = "output.pairs_per_shard=2"


@pytest.fixture(scope="module")
def forty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill(tmp_path_factory.mktemp("forty") / "p", 40)


@pytest.fixture(scope="module")
def undisturbed(forty: Path, made_hash: MadeHash) -> str:
    return made_hash(forty, ONE)


# Killed ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kills", [1, pytest.param(10, marks=pytest.mark.slow)])
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
"""Files of a run with three shards: listing, run.json, config.yaml, tar and record of each, manifest, dataset.json."""


@pytest.fixture(scope="module")
def six(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make photographs p, and their dataset ds in three shards."""
    folder = tmp_path_factory.mktemp("six")
    make(fill(folder / "p", 6), folder / "ds", TWO)
    return folder


@pytest.mark.parametrize("number", slow_except((2, 4), range(FILES)))
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
    make(fill(tmp_path / "p", 5), tmp_path / "ds", TWO)
    renames = [i for i, (what, _) in enumerate(seen) if what != "sync"]
    shards = [[f"shards/shard-{i:05d}.tar", f".work/rows/{i:05d}.json"] for i in range(3)]
    assert [Path(seen[i][1]).relative_to(tmp_path / "ds").as_posix() for i in renames] == [
        *(".work/listing.jsonl", ".work/run.json", "config.yaml", *itertools.chain(*shards)),
        *("manifest.csv", "dataset.json"),
    ]
    assert len(renames) == FILES
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


def test_unfinished_shards_of_a_killed_process_are_deleted_at_the_start(
    begun: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = begun / "ds/.work/tmp/host-1-a/shard-00002.tar.1.1"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half")
    left.parent.with_suffix(".lock").touch()
    there: list[bool] = []
    make_shards = local.make_shards

    def looking(*given: Any) -> Any:
        there.append(left.exists())
        return make_shards(*given)

    monkeypatch.setattr(local, "make_shards", looking)
    make(begun / "p", begun / "ds", TWO)
    assert there == [False]
    assert_complete(begun / "ds")


def test_unfinished_files_of_a_running_process_are_kept(begun: Path, make: Make, tree_hash: TreeHash) -> None:
    with OutFolder(begun / "ds") as other:
        (other.scratch / "half").write_bytes(b"half")
        make(begun / "p", begun / "ds", TWO)
        assert (other.scratch / "half").read_bytes() == b"half"
    assert_complete(begun / "ds")


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("shards/shard-00000.tar", Path.unlink),
        ("shards/shard-00000.tar", lambda path: os.truncate(path, 600)),
        (".work/rows/00000.json", lambda path: path.write_text("{[")),
        (".work/rows/00000.json", lambda path: os.truncate(path, path.stat().st_size - 1)),
    ],
)
def test_damaged_committed_shard_is_regenerated(
    name: str, damage: Callable[[Path], Any], six: Path, begun: Path, make: Make, tree_hash: TreeHash
) -> None:
    damage(begun / "ds" / name)
    assert make(begun / "p", begun / "ds", TWO).made == 4
    assert tree_hash(begun / "ds") == tree_hash(six / "ds")
    assert_complete(begun / "ds")


@pytest.fixture
def finished(six: Path, tmp_path: Path) -> Path:
    """Copy photographs p and their dataset ds."""
    return Path(shutil.copytree(six, tmp_path, dirs_exist_ok=True))


def add(source: Path) -> None:
    Image.fromarray(pixels(77, 9, 9)).save(source / "new.png")


CHANGES: list[tuple[str, Callable[[Path], Any], str]] = [
    ("seed=1", lambda source: None, r"was begun with other settings: seed=1 \(there: 0\)"),
    ("seed=0", add, r"was begun with other sources: new.png is new"),
    ("seed=0", lambda source: (source / "003.png").unlink(), r"was begun with other sources: 003.png was deleted"),
    (
        "seed=0",
        lambda source: (source / "003.png").write_bytes(b"x"),
        r"was begun with other sources: 003.png has 1 bytes, had \d+",
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
    remedy = (
        "remove it" if state == "finished" or "sources" in sentence or "deleted" in sentence else "finish it with .*"
    )
    with pytest.raises(ConfigError, match=f"^out=.*/ds: .*{sentence}.*; choose another out, or {remedy}$"):
        make(folder / "p", folder / "ds", TWO, override)
    assert snapshot(folder / "ds") == before


# Finished -------------------------------------------------------------------------------------------------------------


def test_rerun_removes_what_a_run_killed_at_its_end_left(finished: Path, run_main: RunMain) -> None:
    work = finished / "ds" / ".work"
    (work / "rows").mkdir(parents=True)
    for name in ("lock", "rows/00000.json"):
        (work / name).touch()
    assert run_main("source.root=p", TWO).code == 0
    assert not work.exists()


def test_rerun_of_a_finished_dataset_reports_nothing_to_do(finished: Path, run_main: RunMain) -> None:
    before = snapshot(finished)
    done = run_main("source.root=p", TWO)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("ds is complete: 6 pairs, ")
    assert done.out.endswith("; nothing to do\n")
    assert snapshot(finished) == before


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("shards/shard-00001.tar", Path.unlink, r"shard-00001.tar: is missing, expected "),
        ("shards/shard-00001.tar", lambda path: os.truncate(path, 700), r"has 700 bytes, expected \d+ bytes"),
        ("manifest.csv", Path.unlink, r"manifest.csv: no such manifest"),
    ],
)
def test_damage_of_a_finished_dataset_is_reported(
    name: str, damage: Callable[[Path], Any], message: str, finished: Path, make: Make
) -> None:
    damage(finished / "ds" / name)
    with pytest.raises(DamageError, match=message):
        make(finished / "p", finished / "ds", TWO)


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


@pytest.mark.parametrize("name", ["shards/shard-00000.tar", "manifest.csv", "dataset.json", "photo.jpg"])
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


def test_two_runs_at_once_make_one_dataset(forty: Path, undisturbed: str, tree_hash: TreeHash, tmp_path: Path) -> None:
    arguments = (f"source.root={forty}", ONE, "n_jobs=1")
    with running(*arguments, cwd=tmp_path) as one, running(*arguments, cwd=tmp_path) as other:
        codes = sorted((one.wait(WAIT_S), other.wait(WAIT_S)))
    assert codes in ([0, 0], [0, 11])  # one may be done before the other begins
    assert tree_hash(tmp_path / "ds") == undisturbed


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
    params=[pytest.param(sent, marks=() if sent == SENT[0] else pytest.mark.slow) for sent in SENT],
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


def test_signal_ends_the_run_and_leaves_no_process(stopped: Stopped) -> None:
    assert (stopped.code, stopped.left) == (128 + stopped.number, [])
    assert (stopped.out / ".work/run.json").exists()
    assert not (stopped.out / "dataset.json").exists()
    assert [line for line in stopped.err.splitlines() if not line.startswith("gen-dataset: ")] == []


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
def test_source_that_kills_four_workers_alone_is_retried_by_reruns(
    twelve_undisturbed: str, cli: Cli, make: Make, tree_hash: TreeHash, tmp_path: Path
) -> None:
    """The first death, next to another worker, does not count; the other photographs of the shard are kept."""
    done = run_with_deaths(cli, tmp_path, deaths=5)
    lines = [line for line in done.stderr.splitlines() if "images/s" not in line]
    assert (done.returncode, lines) == (
        3,
        ["gen-dataset: 009.png: its worker died four times; run the same command again to retry it"],
    )
    rows = list(read_rows(tmp_path / "ds/manifest.csv"))
    assert [row["source"] for row in rows if row["reason"] == "worker_died"] == ["009.png"]
    entries = read_dataset(tmp_path / "ds/dataset.json")["shards"]
    assert [entry.get("provisional", False) for entry in entries] == [False, False, True]
    assert len(RawPairs(tmp_path / "ds")) == 11
    assert verify(tmp_path / "ds") == []

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
