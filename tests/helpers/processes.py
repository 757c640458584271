"""Runs in processes of their own: start, watch, kill, and check what they leave."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from helpers.commands import COMMAND, environment

WAIT_S = 300


ONE = "output.pairs_per_shard=1"


SLOW_DISK = """
import os, time

fsync = os.fsync


def slow(handle):
    time.sleep(0.01)
    fsync(handle)


os.fsync = slow
"""
"""Module for `imported_first`: a shard takes 0.04 s or more to commit, so that a run does not end before its kill."""


def imported_first(folder: Path, code: str) -> dict[str, str]:
    """Return an environment in which every Python process runs ``code`` first, from a new folder in ``folder``."""
    site = folder / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(code)
    return {"PYTHONPATH": os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])}


@contextmanager
def running(*arguments: object, cwd: Path, **env: str) -> Iterator[subprocess.Popen[str]]:
    """Start ``gen-dataset`` in a new session; processes of it that are left afterwards are killed."""
    process = subprocess.Popen(
        [str(COMMAND), *map(str, arguments)], cwd=cwd, env=environment(**env), text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        yield process
    finally:
        for pid in session(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.communicate()


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
    """Return the worker processes of a run."""
    return [pid for pid in session(leader) if b"popen_loky_posix" in Path(f"/proc/{pid}/cmdline").read_bytes()]


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


def kill_group(process: subprocess.Popen[str]) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def assert_complete(out: Path) -> None:
    assert sorted(os.listdir(out)) == ["config.yaml", "dataset.json", "manifest.csv", "shards"]
    entries = json.loads((out / "dataset.json").read_text())["shards"]
    assert sorted(os.listdir(out / "shards")) == [Path(entry["file"]).name for entry in entries]


class Killed(BaseException):
    """Simulate a kill at this point."""
