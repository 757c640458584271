"""Runs in processes of their own: start, watch, kill, and check what they leave."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from helpers.commands import COMMAND, environment
from unprocess_gen.core.locks import LockFile

WAIT_S = 300

ONE = "output.pairs_per_shard=1"
COUNT = 12
"""Photographs of the fixture `twelve`."""

SLOW_DISK = """
import os, time

fsync = os.fsync


def slow(handle):
    time.sleep(0.01)
    fsync(handle)


os.fsync = slow
"""
"""Module for `imported_first`: a shard takes 0.04 s or more to commit."""


def unfinished(out: Path, shards: int) -> str:
    """Return `SLOW_DISK` for a run to ``out`` that does not end before it is killed, however late that is.

    Once ``shards`` are committed, each process waits at its next write until its parent has ended.
    """
    return f"""{SLOW_DISK}
import pathlib

folder, parent = pathlib.Path({str(out / "shards")!r}), os.getppid()


def waits(handle):
    while len(list(folder.glob("*.tar"))) >= {shards} and os.getppid() == parent:
        time.sleep(0.01)
    slow(handle)


os.fsync = waits
"""


def slow_shards(seconds: float) -> str:
    """Return a module for `imported_first`: a shard takes ``seconds`` longer."""
    return f"""
import time
from unprocess_gen.pipeline import worker

make_shard = worker.make_shard


def slow(*given):
    time.sleep({seconds})
    return make_shard(*given)


worker.make_shard = slow
"""


def imported_first(folder: Path, code: str) -> dict[str, str]:
    """Return an environment in which every Python process runs ``code`` first, from a new folder in ``folder``."""
    site = folder / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(code)
    return {"PYTHONPATH": os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])}


@contextmanager
def ended_with_tests(process: subprocess.Popen[Any]) -> Iterator[None]:
    """Kill the group that ``process`` leads if the tests are killed: a shell sees the end of its input."""
    command = ["sh", "-c", f"read line || kill -s KILL -- -{process.pid} 2>/dev/null"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, text=True, start_new_session=True) as guard:
        try:
            yield
        finally:
            guard.communicate("\n")


@contextmanager
def running(*arguments: object, cwd: Path, **env: str) -> Iterator[subprocess.Popen[str]]:
    """Start ``gen-dataset`` in a new session; processes of it that are left afterwards are killed."""
    process = subprocess.Popen(
        [str(COMMAND), *map(str, arguments)], cwd=cwd, env=environment(**env), text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        with ended_with_tests(process):
            yield process
    finally:
        kill_session(process.pid)
        process.communicate()


def with_signal(pid: int, number: int) -> None:
    """Send a signal to a process that may have ended."""
    with suppress(ProcessLookupError):
        os.kill(pid, number)


def kill_session(leader: int) -> None:
    """Kill the processes of a session that are alive."""
    for pid in session(leader):
        with_signal(pid, signal.SIGKILL)


def session(leader: int) -> list[int]:
    """Return the processes of a session that are alive."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] not in "ZX":
            found.append(int(stat.parent.name))
    return found


def workers(leader: int) -> list[int]:
    """Return the worker processes of a run, which may be ending meanwhile."""
    found = []
    for pid in session(leader):
        with suppress(OSError):
            if b"popen_loky_posix" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
    return found


def stop(pids: Iterable[int]) -> None:
    """Stop processes by SIGSTOP, and wait until they have stopped: the signal may reach them amid a system call."""
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
        wait_for(lambda pid=pid: Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T")


def handles_signals(pid: int) -> bool:
    """Return whether a process has a handler for SIGTERM."""
    caught = Path(f"/proc/{pid}/status").read_text().partition("SigCgt:")[2].split()[0]
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def wait_for(what: Callable[[], Any], seconds: float = WAIT_S) -> Any:
    until = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.005)
    return found


def processes_per_core() -> float:
    """Return how many running processes share a core, at least 1, for limits of time on a busy machine."""
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def committed(out: Path) -> int:
    return len(list((out / "shards").glob("*.tar")))


def free_port() -> int:
    """Return a TCP port that no process listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def kill_group(process: subprocess.Popen[str]) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


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


def assert_complete(out: Path) -> None:
    assert sorted(os.listdir(out)) == ["config.yaml", "dataset.json", "manifest.csv", "shards"]
    entries = json.loads((out / "dataset.json").read_text())["shards"]
    assert sorted(os.listdir(out / "shards")) == [Path(entry["file"]).name for entry in entries]


class Killed(BaseException):
    """Simulate a kill at this point."""


def interrupt(*_: object) -> None:
    """Simulate Ctrl-C in place of a function."""
    raise KeyboardInterrupt
