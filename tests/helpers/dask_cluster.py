"""A Dask scheduler and workers in processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from helpers.commands import environment
from helpers.processes import ended_with_tests, kill_session, session, wait_for


@dataclass
class DaskCluster:
    """Hold the processes of a cluster; each is the leader of a session, to which nannies' workers belong too."""

    folder: Path
    scheduler: subprocess.Popen[bytes]
    env: dict[str, str]
    stack: ExitStack
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def address(self) -> str:
        return str(json.loads((self.folder / "scheduler.json").read_text())["address"])

    @property
    def overrides(self) -> tuple[str, str]:
        return "executor=dask", f"executor.address={self.address}"

    def add_worker(self, *arguments: str, **env: str) -> subprocess.Popen[bytes]:
        """Start a nanny with one worker of one thread."""
        options = ("--nthreads", "1", "--no-dashboard", "--local-directory", str(self.folder))
        worker = _start(self.stack, self.folder, self.env | env, "worker", self.address, *options, *arguments)
        self.workers.append(worker)
        return worker

    def processes(self) -> list[int]:
        """Return the processes of all workers: those that make shards, and their nannies."""
        return [pid for worker in self.workers for pid in session(worker.pid)]

    def makers(self) -> list[int]:
        """Return the processes that make shards."""
        return [pid for pid in self.processes() if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def _start(stack: ExitStack, folder: Path, env: dict[str, str], *arguments: str) -> subprocess.Popen[bytes]:
    """Start a process in a new session, all of which is killed when the stack closes."""
    with (folder / f"{arguments[0]}.log").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]],
            cwd=folder, env=environment(**env), stdout=log, stderr=log, start_new_session=True,
        )  # fmt: skip
    stack.callback(process.wait)
    stack.callback(kill_session, process.pid)
    stack.enter_context(ended_with_tests(process))
    return process


@contextmanager
def dask_cluster(folder: Path, workers: int = 2, env: dict[str, str] | None = None) -> Iterator[DaskCluster]:
    """Start a scheduler and workers; all their processes are killed afterwards."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    options: Sequence[str] = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    with ExitStack() as stack:
        scheduler = _start(stack, folder, env or {}, "scheduler", *options)
        cluster = DaskCluster(folder, scheduler, env or {}, stack)
        wait_for(lambda: file.exists() and file.read_text().strip().endswith("}"), 60)
        for _ in range(workers):
            cluster.add_worker()
        yield cluster
