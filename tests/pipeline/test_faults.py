"""Real faults: kills at random moments, full and read-only disks, little memory, deleted folders, signals.

Each fault costs one line and a few seconds and leaves no process. The same command then makes the dataset that an
undisturbed run makes, to the byte. `test_resume` covers kills around each rename and refused reruns. Tests of disks
mount small file systems; without permission to mount they are skipped, and run under ``unshare -Urm``.
"""

from __future__ import annotations

import errno
import hashlib
import itertools
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.commands import Cli, RunMain, messages
from helpers.datasets import Make, TreeHash
from helpers.photographs import fill, pixels
from helpers.processes import (
    COUNT,
    ONE,
    SLOW_DISK,
    WAIT_S,
    Killed,
    committed,
    handles_signals,
    imported_first,
    processes_per_core,
    running,
    session,
    slow_shards,
    wait_for,
    workers,
)
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen.core import paths
from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline import worker
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.generate import Summary
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.pipeline.tasks import ShardReport

Resume = Callable[..., Summary]


def wait_for_the_end(leader: int) -> None:
    """Wait until every process of a run has ended, ten seconds at most if the machine is idle."""
    wait_for(lambda: not session(leader), 10 * processes_per_core())  # a worker that still imports has no watchdog


def after_commits(number: int, action: Callable[[], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Call ``action`` once a run of this process has committed ``number`` shards."""
    commit, done = worker.commit_shard, []

    def commits(folder: OutFolder, made: Any, columns: Any) -> ShardReport:
        report = commit(folder, made, columns)
        done.append(report.shard)
        if len(done) == number:
            action()
        return report

    monkeypatch.setattr(worker, "commit_shard", commits)


# Killed at random moments ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("whom", "kills"), [("coordinator", 34), ("group", 33), ("worker", 33)])
def test_run_killed_at_random_moments_resumes_to_the_same_bytes(
    whom: str, kills: int, twelve: Path, resume: Resume, tmp_path: Path, figure: Figure
) -> None:
    """One kill in four comes anywhere in a run, imports included, the others when workers start or make shards.

    Workers of a killed coordinator end within ten seconds; within one if a core is free. A run whose worker is killed
    ends with 0, or with 3 if the kill hit the retry of a photograph.
    """
    draw, codes = random.Random(whom), Counter[int]()
    env = imported_first(tmp_path, slow_shards(0.2))
    for kill in range(kills):
        out = tmp_path / str(kill) / "ds"
        out.parent.mkdir()
        with running(f"source.root={twelve / 'p'}", ONE, "n_jobs=2", cwd=out.parent, **env) as process:
            if whom == "worker" or draw.random() > 0.25:
                found = wait_for(lambda pid=process.pid: workers(pid))
            time.sleep(draw.uniform(0, 2))
            with suppress(ProcessLookupError):
                if whom == "worker":
                    os.kill(draw.choice(workers(process.pid) or found), signal.SIGKILL)
                else:
                    (os.kill if whom == "coordinator" else os.killpg)(process.pid, signal.SIGKILL)
            _, err = process.communicate(timeout=WAIT_S)
            wait_for_the_end(process.pid)
        codes[process.returncode] += 1
        assert whom != "worker" or process.returncode in (0, 3), err
        assert all("its worker died four times" in line for line in messages(err)), err
        resume(out)
        shutil.rmtree(out)
    assert whom == "worker" or codes[-signal.SIGKILL] >= kills / 2
    figure("resume", f"{whom} killed: same bytes in {kill + 1} of {kills} runs; exit codes {dict(codes)}")


# Workers --------------------------------------------------------------------------------------------------------------

AT_ONE = """
import hashlib, os, pathlib, resource, time

marked, note, sha256 = pathlib.Path(os.environ["MARKED"]), pathlib.Path(os.environ["NOTE"]), hashlib.sha256


def wait():
    if not note.exists():
        note.write_text(str(os.getpid()))
        while note.exists():
            time.sleep(0.01)


def limit():
    size = int(pathlib.Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + int(note.read_text()) * 2**20, -1))


def acting(data=b"", **options):
    if isinstance(data, bytes) and data == marked.read_bytes():
        globals()[os.environ["ACTION"]]()
    return sha256(data, **options)


hashlib.sha256 = acting
"""
"""Module for `imported_first`: when a process hashes one photograph, it acts."""


def acting_at(folder: Path, photograph: Path, action: str) -> dict[str, str]:
    """Return an environment in which processes act when they read ``photograph``.

    ``wait``: the first one waits as long as the file ``note`` exists. ``limit``: every one gets a limit of memory.
    """
    env = imported_first(folder, AT_ONE)
    return env | {"MARKED": str(photograph), "NOTE": str(folder / "note"), "ACTION": action}


def test_killed_worker_is_noticed_within_five_seconds(
    twelve: Path, assert_undisturbed: Callable[[Path], None], tmp_path: Path, figure: Figure
) -> None:
    """The killed worker was at the last photograph, so no other work would reveal its death."""
    env = acting_at(tmp_path, twelve / f"p/{COUNT - 1:03d}.png", "wait")
    with running(f"source.root={twelve / 'p'}", ONE, "n_jobs=2", cwd=tmp_path, **env) as process:
        asleep = int(wait_for(lambda: (tmp_path / "note").exists() and (tmp_path / "note").read_text()))
        wait_for(lambda: len(list((tmp_path / "ds/.work/rows").glob("*.json"))) == COUNT - 1)  # the records too
        idle = set(workers(process.pid)) - {asleep}
        assert len(idle) == 1
        os.kill(asleep, signal.SIGKILL)
        killed = time.monotonic()
        wait_for(lambda: not idle & set(session(process.pid)), 5 * processes_per_core())  # loky ends all workers
        noticed_s = time.monotonic() - killed
        said, err = process.communicate(timeout=WAIT_S)
    assert (process.returncode, messages(err)) == (0, []), err
    assert f"ds: {COUNT} pairs, " in said
    assert_undisturbed(tmp_path / "ds")
    figure("dead-worker", f"noticed after {noticed_s:.1f} s")


@pytest.mark.parametrize(
    ("n_jobs", "megabytes"),
    slow_except([(1, 20), (1, 100)], itertools.product((1, 2), (20, 100))),
)
def test_out_of_memory_is_reported_and_rerun_completes_dataset(
    n_jobs: int, megabytes: int, cli: Cli, make: Make, tree_hash: TreeHash, tmp_path: Path
) -> None:
    """A photograph of few bytes takes 36 MB once decoded, 72 MB while decoding, and its five pairs 144 MB.

    With 20 MB left it cannot be decoded; with 100 MB its pairs cannot be simulated.
    """
    source, settings = fill(tmp_path / "p", 3), (ONE, "noise.levels=5")
    Image.fromarray(np.full((3000, 4000, 3), 90, np.uint8)).save(source / "large.png")
    env = acting_at(tmp_path, source / "large.png", "limit")
    (tmp_path / "note").write_text(str(megabytes))
    done = cli("source.root=p", *settings, f"n_jobs={n_jobs}", **env)
    assert done.returncode in (3, 5), done.stderr
    assert len(messages(done.stderr)) == 1, done.stderr
    assert "large.png" in messages(done.stderr)[0] and "corrupt" not in done.stderr
    for out in ("ds", "undisturbed"):
        make(source, tmp_path / out, *settings)
    assert tree_hash(tmp_path / "ds") == tree_hash(tmp_path / "undisturbed")


# Disks ----------------------------------------------------------------------------------------------------------------


class Disk(NamedTuple):
    """Hold a small file system in memory."""

    folder: Path

    def remount(self, options: str) -> None:
        """Change its size, or make it read-only or writable."""
        subprocess.run(["mount", "-o", f"remount,{options}", self.folder], check=True, capture_output=True)

    @property
    def kilobytes(self) -> int:
        """Kilobytes in use."""
        status = os.statvfs(self.folder)
        return (status.f_blocks - status.f_bfree) * status.f_frsize // 1024


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Disk]:
    folder = tmp_path_factory.mktemp("disk")
    command = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", folder]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("needs the command mount")
    if done.returncode:
        pytest.skip(f"needs to mount a file system ({done.stderr.strip()}); run under: unshare -Urm")
    try:
        yield Disk(folder)
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


@pytest.fixture
def empty_disk(disk: Disk) -> Iterator[Disk]:
    yield disk
    disk.remount("rw,size=4m")
    for path in disk.folder.iterdir():
        shutil.rmtree(path)


def place_of(out: Path) -> str:
    """Return which kind of file met the full disk."""
    if (out / "manifest.csv").exists():
        return "dataset.json"
    if committed(out) == COUNT:
        return "manifest.csv"
    if committed(out) > len(list((out / ".work/rows").glob("*.json"))):
        return "commit"
    return "shard or its rows" if (out / "shards").exists() else "first files"


@pytest.mark.parametrize("n_jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_full_disk_is_a_system_error_that_costs_no_byte(
    n_jobs: int, empty_disk: Disk, twelve: Path, make: Make, resume: Resume, figure: Figure
) -> None:
    """Disks have every size, in steps of 4 KB, from one block to enough, so that every kind of file meets the end.

    A rerun keeps the committed shards, so that its bytes prove them intact.
    """
    places: set[str] = set()
    out = empty_disk.folder / "ds"
    for kilobytes in itertools.count(4, 4):
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        empty_disk.remount(f"size={kilobytes}k")
        try:
            make(twelve / "p", out, ONE, "check_disk=false", n_jobs=n_jobs)
            break
        except MachineError as error:
            assert re.search(rf"{out}.*No space left on device \(.* bytes free\)", str(error)), error
            places.add(place_of(out))
        empty_disk.remount("size=4m")
        resume(out)
    assert places >= {"first files", "shard or its rows", "manifest.csv", "dataset.json"}
    reruns = kilobytes // 4 - 1
    figure("disk-full", f"same bytes in {reruns} of {reruns} reruns, disks of 4 to {kilobytes - 4} KiB")


@pytest.mark.parametrize("name", ["ds", ""])
def test_read_only_disk_is_refused_with_2(name: str, twelve: Path, empty_disk: Disk, run_main: RunMain) -> None:
    empty_disk.remount("ro")
    done = run_main(f"source.root={twelve / 'p'}", f"out={empty_disk.folder / name}", "n_jobs=1")
    assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1)
    assert f"out={empty_disk.folder / name}: cannot be written (Read-only file system)" in done.err


# Faults after any shard -----------------------------------------------------------------------------------------------


def failing_disk(number: int, patch: pytest.MonkeyPatch) -> None:
    """Let no file get its final name; the kernel remounts a file system read-only if it finds an error in it."""

    def refuse(path: Path, file: Path) -> None:
        raise OSError(number, os.strerror(number), str(path))

    patch.setattr(paths.LocalPath, "commit", refuse)


def away(folder: str) -> None:
    Path(folder).rename("away")


FAULTS: dict[str, tuple[tuple[int, ...], Callable[[pytest.MonkeyPatch], Any], str]] = {
    "full disk": (
        (1, COUNT),
        lambda patch: failing_disk(errno.ENOSPC, patch),
        r"No space left on device \(.* bytes free\)",
    ),
    "read-only disk": ((1, COUNT), lambda patch: failing_disk(errno.EROFS, patch), "Read-only file system"),
    "no folder": ((1, COUNT), lambda _: away("ds"), "ds"),
    "no sources": ((2,), lambda _: away("p"), "source.root=p: 002.png was deleted or moved"),
    "no photograph": ((2,), lambda _: away("p/004.png"), "004.png was deleted or moved"),
    "another photograph": (
        (2,),
        lambda _: change("p/004.png"),
        r"source 004.png changed since it was listed: \d+ bytes",
    ),
}
"""After which shards a fault comes, what it is, and what the message says.

A network share that is away for a minute must not give a finished dataset without its photographs.
"""


def change(path: str) -> None:
    shutil.copy(path, "away")
    Path(path).write_bytes(b"shorter")


@pytest.mark.parametrize(("fault", "number"), [(name, number) for name in FAULTS for number in FAULTS[name][0]])
def test_fault_after_any_shard_ends_the_run_with_5_and_a_rerun_completes(
    fault: str, number: int, photographs: Path, run_main: RunMain, resume: Resume, tmp_path: Path
) -> None:
    _, happen, message = FAULTS[fault]
    with pytest.MonkeyPatch.context() as patch:
        after_commits(number, lambda: happen(patch), patch)
        done = run_main("source.root=p", ONE, "n_jobs=1")
    assert (done.code, done.out, len(messages(done.err))) == (5, "", 1), done.err
    assert re.search(message, done.err)
    if fault == "no folder":
        assert not (tmp_path / "ds").exists()
        (tmp_path / "away").rename(tmp_path / "ds")
    elif "photograph" in fault:
        (tmp_path / "away").rename(photographs / "004.png")
    elif fault == "no sources":
        (tmp_path / "away").rename(photographs)
    assert not (tmp_path / "ds/dataset.json").exists()
    resume(tmp_path / "ds", photographs)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["ds", "p"])
def test_folder_deleted_under_two_workers_ends_the_run_with_5(
    what: str, photographs: Path, resume: Resume, tmp_path: Path
) -> None:
    """One worker is at the third photograph; the other has a few left."""
    env = acting_at(tmp_path, shutil.copy(photographs / "002.png", tmp_path / "marked"), "wait")
    with running("source.root=p", ONE, "n_jobs=2", cwd=tmp_path, **env) as process:
        wait_for((tmp_path / "note").exists)
        (tmp_path / what).rename(tmp_path / "away")
        (tmp_path / "note").unlink()
        said, err = process.communicate(timeout=10 * processes_per_core())
        wait_for_the_end(process.pid)
    assert (process.returncode, said, len(messages(err))) == (5, "", 1), err
    (tmp_path / "away").rename(tmp_path / what)
    resume(tmp_path / "ds", photographs)


# Sources that change --------------------------------------------------------------------------------------------------


def bitmap(path: Path, seed: int) -> bytes:
    """Write a photograph in a format of constant size, and return its bytes."""
    Image.fromarray(pixels(seed, 30, 40)).save(path)
    return path.read_bytes()


def begin(make: Make, source: Path, out: Path, shards: int) -> None:
    """Make ``shards`` shards, then stop as if killed."""

    def stop() -> None:
        raise Killed

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        after_commits(shards, stop, patch)
        make(source, out, ONE)


def test_photograph_replaced_after_commit_is_found_by_replay(photographs: Path, make: Make, tmp_path: Path) -> None:
    """The size is the same, and a resumed run reads no committed photograph; the row remains that of its pair."""
    old = bitmap(photographs / "000.bmp", 1)
    begin(make, photographs, tmp_path / "ds", 2)
    shard = (tmp_path / "ds/shards/shard-00000.tar").read_bytes()
    bitmap(photographs / "000.bmp", 2)
    make(photographs, tmp_path / "ds", ONE)
    rows = list(read_rows(tmp_path / "ds/manifest.csv"))
    assert (rows[0]["source"], rows[0]["source_sha256"]) == ("000.bmp", hashlib.sha256(old).hexdigest())
    assert (tmp_path / "ds/shards/shard-00000.tar").read_bytes() == shard
    assert [one.source for one in replay(rows, str(photographs)) if one.complaint] == ["000.bmp"]


@pytest.mark.parametrize("at", [100, -4])
def test_changed_twin_is_refused_by_a_resumed_run(at: int, photographs: Path, make: Make, tmp_path: Path) -> None:
    """Identical files are numbered, so that a changed one would move the noise of another."""
    content = bytearray(bitmap(photographs / "000.bmp", 1) * 2)
    for name in ("000.bmp", "zzz.bmp"):
        (photographs / name).write_bytes(content)
    begin(make, photographs, tmp_path / "ds", 2)
    content[at] ^= 255
    (photographs / "000.bmp").write_bytes(content)
    with pytest.raises(ConfigError, match=r"was begun with other sources: 000\.bmp has other bytes"):
        make(photographs, tmp_path / "ds", ONE)


# Signals --------------------------------------------------------------------------------------------------------------


AT_THE_END = """
import os, signal, threading

shutdown, leader = threading._shutdown, os.getpid() == os.getsid(0)


def signalled():
    if leader:
        os.kill(os.getpid(), int(os.environ["SIGNAL"]))
    shutdown()


threading._shutdown = signalled
"""
"""Module for `imported_first`: it sends a signal while Python waits for its threads at exit."""


@pytest.mark.parametrize("sent", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_signal_at_exit_prints_nothing(
    sent: signal.Signals, twelve: Path, assert_undisturbed: Callable[[Path], None], tmp_path: Path
) -> None:
    """Pressing Ctrl-C twice has the same effect."""
    env = imported_first(tmp_path, AT_THE_END) | {"SIGNAL": str(int(sent))}
    with running(f"source.root={twelve / 'p'}", ONE, "n_jobs=1", cwd=tmp_path, **env) as process:
        _, err = process.communicate(timeout=WAIT_S)
    assert process.returncode in (0, 128 + sent, -sent)
    assert messages(err) == []
    assert_undisturbed(tmp_path / "ds")


IN_A_CALLBACK = """
import ctypes, os, signal, sys, time
from unprocess_gen.cli import main as cli

def slow(arguments):
    @ctypes.CFUNCTYPE(None)
    def callback():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
    callback()
    time.sleep(20)
    return 0

cli.run = slow
sys.exit(cli.main())
"""
"""A run whose signal arrives while C calls Python, as LLVM does when it compiles; C drops exceptions."""


def test_signal_in_a_library_callback_ends_the_run(tmp_path: Path) -> None:
    command = [sys.executable, "-c", IN_A_CALLBACK]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=WAIT_S, restore_signals=True)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (128 + signal.SIGTERM, "", 1)
    assert "finished shards are kept; run the same command again to resume" in done.stderr


@pytest.mark.parametrize("number", [1, pytest.param(40, marks=pytest.mark.slow)])
def test_signal_at_any_moment_ends_the_run_and_rerun_completes(
    number: int, twelve: Path, resume: Resume, tmp_path: Path, figure: Figure
) -> None:
    """The moments begin when the command handles signals.

    A run may also complete if it was nearly done, or if SIGINT arrives in the hundredths of a second for which it is
    ignored while workers start.
    """
    draw, codes, env = random.Random(number), Counter[int](), imported_first(tmp_path, SLOW_DISK)
    for kill in range(number):
        out = tmp_path / str(kill) / "ds"
        out.parent.mkdir()
        sent, n_jobs, group = draw.choice([signal.SIGINT, signal.SIGTERM]), draw.choice([1, 2]), draw.random() < 0.5
        with running(f"source.root={twelve / 'p'}", ONE, f"n_jobs={n_jobs}", cwd=out.parent, **env) as process:
            wait_for(lambda pid=process.pid: handles_signals(pid))
            time.sleep(draw.uniform(0, 1.3 * n_jobs))
            with suppress(ProcessLookupError):
                (os.killpg if group else os.kill)(process.pid, sent)
            _, err = process.communicate(timeout=5 * processes_per_core())
            wait_for_the_end(process.pid)
        codes[process.returncode] += 1
        if (out / "dataset.json").exists():
            assert process.returncode in (0, 128 + sent, -sent), err
        else:
            assert process.returncode == 128 + sent, err
        assert [line for line in messages(err) if not line.startswith("gen-dataset: ")] == []
        resume(out)
    assert codes[130] + codes[143] >= number / 2
    figure("resume", f"signals: same bytes in {kill + 1} of {number} runs; exit codes {dict(codes)}")
