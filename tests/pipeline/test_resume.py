"""Runs that are killed, stopped, refused or repeated: what is on disk afterwards."""

from __future__ import annotations

import itertools
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.datasets import Make, TreeHash, contents
from helpers.photographs import fill, pixels
from helpers.processes import (
    COUNT,
    ONE,
    WAIT_S,
    Killed,
    assert_complete,
    committed,
    held,
    imported_first,
    interrupt,
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

from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.pipeline.executors import local
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.generate import Summary

FOUR = "output.pairs_per_shard=4"


# Killed ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kills", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_run_killed_repeatedly_ends_as_if_undisturbed(
    kills: int, twelve: Path, resume: Callable[[Path], Summary], tmp_path: Path, figure: Figure
) -> None:
    """Each kill comes a few random milliseconds after a number of shards that grows from kill to kill."""
    moment = random.Random(385)
    out = tmp_path / "ds"
    env = imported_first(tmp_path, unfinished(out, COUNT - 1))
    for kill in range(kills):
        with running(
            f"source.root={twelve / 'p'}", ONE, f"n_jobs={1 + (kill % 3 == 0)}", cwd=tmp_path, **env
        ) as process:
            wait_for(lambda at=kill: (out.exists() and committed(out) >= at) or process.poll() is not None)
            time.sleep(moment.uniform(0, 0.05))
            assert process.poll() is None, process.communicate()
            kill_group(process)
        assert not (out / "dataset.json").exists()
        assert committed(out) >= kill
    resume(out)
    figure("resume", f"same bytes after {kill + 1} kills of one run")


FILES = 11
"""Files of a run with three shards: listing, run.json, config.yaml, tar and record of each, manifest, dataset.json."""


@pytest.fixture(scope="module")
def three(twelve: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the twelve photographs p, and their dataset ds in three shards."""
    folder = Path(shutil.copytree(twelve / "p", tmp_path_factory.mktemp("three") / "p")).parent
    make(folder / "p", folder / "ds", FOUR)
    return folder


@pytest.mark.parametrize("number", slow_except((2, 4), range(FILES)))
def test_run_killed_around_any_rename_can_be_resumed(
    number: int, three: Path, make: Make, tree_hash: TreeHash, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    figure: Figure,
) -> None:  # fmt: skip
    for renamed in (False, True):
        out = tmp_path / f"ds-{renamed}"
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
            make(three / "p", out, FOUR)
        make(three / "p", out, FOUR)
        assert tree_hash(out) == tree_hash(three / "ds"), renamed
        assert_complete(out)
    figure("resume", "same bytes after a kill before or after each rename")


def test_files_are_synced_before_their_rename(
    three: Path, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    make(three / "p", tmp_path / "ds", FOUR)
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
def begun_template(three: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with photographs p, and a dataset ds of which two shards of three are committed."""
    folder = Path(shutil.copytree(three / "p", tmp_path_factory.mktemp("begun") / "p")).parent
    replace = os.replace

    def stops(old: Any, new: Any) -> None:
        if Path(new).name == "shard-00002.tar":
            raise Killed
        replace(old, new)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        patch.setattr(os, "replace", stops)
        make(folder / "p", folder / "ds", FOUR)
    assert committed(folder / "ds") == 2
    return folder


@pytest.fixture
def begun(begun_template: Path, tmp_path: Path) -> Path:
    """Copy photographs p, and a dataset ds of which two shards of three are committed."""
    return Path(shutil.copytree(begun_template, tmp_path, dirs_exist_ok=True))


@pytest.fixture
def finished(three: Path, tmp_path: Path) -> Path:
    """Copy photographs p and their dataset ds."""
    return Path(shutil.copytree(three, tmp_path, dirs_exist_ok=True))


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Return the time and the bytes of each file."""
    return {name: ((folder / name).stat().st_mtime_ns, content) for name, content in contents(folder).items()}


def test_resumed_run_makes_only_missing_shards(begun: Path, make: Make) -> None:
    before = snapshot(begun / "ds/shards")
    summary = make(begun / "p", begun / "ds", FOUR)
    assert (summary.made, summary.rows) == (4, 12)
    after = snapshot(begun / "ds/shards")
    assert {name: after[name] for name in before} == before


def test_unfinished_files_of_a_killed_process_are_deleted_at_the_start(
    begun: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = begun / "ds/.work/tmp/host-1-a/shard-00002.tar.1.1"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half")
    left.parent.with_suffix(".lock").touch()
    monkeypatch.setattr(local, "make_shards", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make(begun / "p", begun / "ds", FOUR)
    assert not left.exists()


def test_unfinished_files_of_a_running_process_are_kept(begun: Path, make: Make) -> None:
    with OutFolder(begun / "ds") as other:
        (other.scratch / "half").write_bytes(b"half")
        make(begun / "p", begun / "ds", FOUR)
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
    name: str, damage: Callable[[Path], Any], three: Path, begun: Path, make: Make, tree_hash: TreeHash
) -> None:
    damage(begun / "ds" / name)
    assert make(begun / "p", begun / "ds", FOUR).made == 8
    assert tree_hash(begun / "ds") == tree_hash(three / "ds")
    assert_complete(begun / "ds")


def add(source: Path) -> None:
    Image.fromarray(pixels(77, 9, 9)).save(source / "new.png")


CHANGES: list[tuple[str, Callable[[Path], Any], str]] = [
    ("seed=1", lambda source: None, r"was begun with other settings: seed=1 \(there: 0\)"),
    ("seed=0", add, "was begun with other sources: new.png is new"),
    ("seed=0", lambda source: (source / "003.png").unlink(), "was begun with other sources: 003.png was deleted"),
    ("seed=0", lambda source: (source / "003.png").write_bytes(b"x"), r"sources: 003.png has 1 bytes, had \d+"),
]


@pytest.mark.parametrize("state", ["begun", "finished"])
@pytest.mark.parametrize(("override", "change", "sentence"), CHANGES)
def test_changed_settings_or_sources_are_refused_and_change_nothing(
    state: str, override: str, change: Callable[[Path], Any], sentence: str, request: pytest.FixtureRequest, make: Make
) -> None:
    folder: Path = request.getfixturevalue(state)
    before = snapshot(folder / "ds")
    change(folder / "p")
    remedy = "finish it with .*" if state == "begun" and "settings" in sentence else "remove it"
    with pytest.raises(ConfigError, match=f"^out=.*/ds: .*{sentence}.*; choose another out, or {remedy}$"):
        make(folder / "p", folder / "ds", FOUR, override)
    assert snapshot(folder / "ds") == before


# Finished -------------------------------------------------------------------------------------------------------------


def test_rerun_removes_what_a_run_killed_at_its_end_left(finished: Path, run_main: RunMain) -> None:
    work = finished / "ds" / ".work"
    (work / "rows").mkdir(parents=True)
    for name in ("lock", "rows/00000.json"):
        (work / name).touch()
    assert run_main("source.root=p", FOUR).code == 0
    assert not work.exists()


def test_rerun_of_a_finished_dataset_reports_nothing_to_do(finished: Path, run_main: RunMain) -> None:
    before = snapshot(finished)
    done = run_main("source.root=p", FOUR)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("ds is complete: 12 pairs, ")
    assert done.out.endswith("; nothing to do\n")
    assert snapshot(finished) == before


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("shards/shard-00001.tar", Path.unlink, r"shard-00001.tar: is missing, expected .*verify \S*ds --repair"),
        ("shards/shard-00001.tar", lambda path: os.truncate(path, 700), r"has 700 bytes, expected \d+ bytes"),
        ("manifest.csv", Path.unlink, r"manifest.csv: no such manifest"),
    ],
)
def test_damage_of_a_finished_dataset_is_reported(
    name: str, damage: Callable[[Path], Any], message: str, finished: Path, make: Make
) -> None:
    damage(finished / "ds" / name)
    with pytest.raises(DamageError, match=message):
        make(finished / "p", finished / "ds", FOUR)


# Lock and foreign files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["shards/shard-00000.tar", "manifest.csv", "dataset.json", "photo.jpg"])
def test_folder_with_foreign_files_is_refused_and_unchanged(name: str, make: Make, tmp_path: Path) -> None:
    path, entry = tmp_path / "ds" / name, name.split("/")[0]
    path.parent.mkdir(parents=True)
    path.write_text("precious")
    message = (
        f"out=.*/ds: contains {entry}, but no config.yaml; expected an empty folder or a dataset; choose another out"
    )
    with pytest.raises(ConfigError, match=message):
        make(fill(tmp_path / "p", 1), tmp_path / "ds")
    assert path.read_text() == "precious"
    assert os.listdir(tmp_path / "ds") == [entry]


def test_foreign_shard_is_refused(begun: Path, make: Make) -> None:
    (begun / "ds/shards/shard-00009.tar").write_text("stale")
    with pytest.raises(ConfigError, match=r"unexpected file .*shard-00009.tar; expected only committed shards"):
        make(begun / "p", begun / "ds", FOUR)


def test_folder_locked_by_another_run_is_refused_with_11(run_main: RunMain, tmp_path: Path) -> None:
    fill(tmp_path / "p", 1)
    with held(tmp_path / "ds"):
        done = run_main("source.root=p")
    message = "gen-dataset: out=ds: another run is writing to it; wait for that run, or choose another out\n"
    assert done == (11, "", message)
    assert list((tmp_path / "ds").rglob("*")) == [tmp_path / "ds/.work"]


def test_two_runs_at_once_make_one_dataset(
    twelve: Path, assert_undisturbed: Callable[[Path], None], tmp_path: Path
) -> None:
    arguments = (f"source.root={twelve / 'p'}", ONE, "n_jobs=1")
    with running(*arguments, cwd=tmp_path) as one, running(*arguments, cwd=tmp_path) as other:
        codes = sorted((one.wait(WAIT_S), other.wait(WAIT_S)))
    assert codes in ([0, 0], [0, 11])  # one may be done before the other begins
    assert_undisturbed(tmp_path / "ds")


# Stopped --------------------------------------------------------------------------------------------------------------

SENT = [
    (signal.SIGINT, "group", "photographs"),  # Ctrl-C
    (signal.SIGTERM, "process", "photographs"),  # kill
    (signal.SIGHUP, "group", "photographs"),  # a terminal that closes
    *itertools.product((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), ("process", "group"), ("scenes",)),
]
"""Workers are busy with scenes for minutes; with photographs they wait for the disk."""


@pytest.mark.parametrize(("number", "whom", "sources"), slow_except(SENT[:1], SENT))
def test_signal_ends_the_run_and_leaves_no_process(
    number: signal.Signals, whom: str, sources: str, twelve: Path, tmp_path: Path
) -> None:
    out, source, env = tmp_path / "ds", "source.limit=400", {}
    if sources == "photographs":
        source, env = f"source.root={twelve / 'p'}", imported_first(tmp_path, unfinished(out, COUNT - 2))
    with running(source, ONE, "n_jobs=2", cwd=tmp_path, **env) as process:
        wait_for(lambda: committed(out) or process.poll() is not None)
        assert workers(process.pid), process.communicate()
        (os.killpg if whom == "group" else os.kill)(process.pid, number)
        _, err = process.communicate(timeout=15 * processes_per_core())
        wait_for(lambda: not session(process.pid), 5 * processes_per_core())
    assert process.returncode == 128 + number
    assert (out / ".work/run.json").exists()
    assert not (out / "dataset.json").exists()
    assert [line for line in err.splitlines() if not line.startswith("gen-dataset: ")] == []
