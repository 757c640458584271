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

WAIT_S = 60


ONE = "output.pairs_per_shard=1"


@contextmanager
def running(*arguments: object, cwd: Path) -> Iterator[subprocess.Popen[str]]:
    """Start ``gen-dataset`` in a new session; processes of it that are left afterwards are killed."""
    process = subprocess.Popen(
        [str(COMMAND), *map(str, arguments)], cwd=cwd, env=environment(), text=True, start_new_session=True,
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


def wait_for(what: Callable[[], Any], seconds: float = WAIT_S) -> Any:
    until = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.002)
    return found


def committed(out: Path) -> int:
    return len(list((out / "shards").glob("*.tar")))


def kill_group(process: subprocess.Popen[str]) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def assert_whole(out: Path) -> None:
    assert sorted(os.listdir(out)) == ["config.yaml", "dataset.json", "manifest.csv", "shards"]
    entries = json.loads((out / "dataset.json").read_text())["shards"]
    assert sorted(os.listdir(out / "shards")) == [Path(entry["file"]).name for entry in entries]


class Killed(BaseException):
    """Simulate a kill at this point."""
