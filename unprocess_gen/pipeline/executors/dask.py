"""Run the shards of a frozen run on a Dask cluster; the only module that uses Dask.

The coordinator gives each worker chunks of shards (`Chunk`). A worker opens the frozen run below ``out``, makes the
shards of a chunk that are not committed, and reports them about once a second and as the result of the task. Workers
commit shards themselves, so a chunk that is lost or made twice costs time, but changes no byte.

What happens when something fails:

* A worker dies, or sends no sign of life for ``executor.lost_worker_s``: other workers get the shards of its chunks.
  A shard that ends its workers gets provisional rows after `run_records.MAX_DEATHS` deaths, counted below ``.work``.
* A worker is slow: once no shard waits, idle workers take shards from the end of its chunks.
* A worker makes other bytes (canary, self-test): it gets no chunk. Without any other worker the run ends.
* A worker reports a system error: it gets no chunk for `PAUSE_S`. The run ends if this repeats (`TRIES`).
* There is no worker for ``executor.no_workers_s``, or the scheduler dies or stops: MachineError. A rerun continues.

One thread asks the scheduler for its workers, so that a stopped scheduler does not stop the run from ending.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import pickle
import platform
import signal
import threading
import time
import traceback
import uuid
import warnings
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, Status, as_completed, get_worker
from distributed.versions import VersionMismatchWarning

from unprocess_gen.config.schema import ExecutorConfig
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import RESUME, ConfigError, MachineError, SourceChangedError, UnprocessGenError
from unprocess_gen.pipeline.executors.local import interrupts_ignored
from unprocess_gen.pipeline.frozen_run import FrozenRun, open_run
from unprocess_gen.pipeline.run_records import ShardRecords, forget_deaths
from unprocess_gen.pipeline.storage import Storage
from unprocess_gen.pipeline.tasks import ShardReport
from unprocess_gen.pipeline.worker import KEPT_BYTES

TICK_S = 0.1
"""Time between two looks at what workers report."""

POLL_S, POLL_WORKER_S = 1.0, 0.01
"""Time between two questions to the scheduler about its workers, and the least part of it for each worker."""

REPORTS = 30
"""Reports of a worker in the time of a chunk, about one in a second: a report takes 1 ms of the client."""

CONNECT_S, CLOSE_S = 30.0, 2.0
"""Longest times to connect to a scheduler and to leave it."""

LAST_S = 1.0
"""Grace period for tasks whose shards are all committed."""

UNFIT_S = 10.0
"""Time to wait for a worker that makes the bytes of this host."""

TRIES, PAUSE_S = 3, 5.0
"""System errors of workers without a finished shard meanwhile that end a run, and the pause of such a worker."""

LOSSES = 20
"""Times that workers are lost one after the other, without a finished shard meanwhile, before the run ends."""

PATIENCE = 2.0
"""Shard times after which an idle worker makes a shard that another worker has not finished."""

ALLOCATION = {"MALLOC_ARENA_MAX": 1, "MALLOC_MMAP_MAX_": 0, "MALLOC_TRIM_THRESHOLD_": KEPT_BYTES}
"""Variables of glibc with the effect of `worker.keep_memory` in threads, in which Dask runs tasks.

Without them a run with large arrays takes a quarter longer, because arenas of threads return freed memory.
"""

LOGGERS = ("distributed", "distributed.client", "tornado", "tornado.application", "asyncio")
"""Loggers whose messages are hidden during a run; what they report becomes one sentence."""


# ------------------------------------------------------------------------------------------------------------- workers


@dataclass(frozen=True, slots=True)
class ChunkRequest:
    """Hold what a task needs: dataset, sources, digest of the plan, time between reports, shards, and a Dask topic."""

    out: str
    root: str | None
    plan_sha256: str
    report_s: float
    shards: tuple[int, ...] = ()
    topic: str = field(default_factory=lambda: f"unprocess_gen-{uuid.uuid4().hex}")


@dataclass(frozen=True, slots=True)
class ChunkResult:
    """Hold the outcome of a task.

    Attributes
    ----------
    place : str
        Name of the worker in messages.
    reports : tuple of ShardReport
        Shards that this task made; those that were committed before have none.
    seconds : float
        Time that it took to make them.
    error : UnprocessGenError or None
        Error that ended the task.
    is_unfit : bool
        Whether the error is the worker's: it can make no shard of this run.
    bug : str
        Traceback of an unexpected error; empty without one.
    """

    place: str
    reports: tuple[ShardReport, ...] = ()
    seconds: float = 0.0
    error: UnprocessGenError | None = None
    is_unfit: bool = False
    bug: str = ""


def make_shards(request: ChunkRequest) -> ChunkResult:
    """Make and commit shards in a Dask worker; errors are part of the result, so that no worker logs a traceback."""
    worker = get_worker()
    place = f"Dask worker {worker.address} on {platform.node()}"
    reports: list[ShardReport] = []
    try:
        try:
            run = open_run(request.out, request.plan_sha256, request.root)
        except MachineError as error:
            return ChunkResult(place, error=error, is_unfit=True)
        started = reported = time.monotonic()
        sent = 0
        try:
            for shard in itertools.takewhile(lambda _: not run.has_ended(), request.shards):
                report = run.make(shard)
                reports += [report] if report else []
                if report and report.killer is not None:
                    break  # if another shard ended this worker, the provisional one would be retried
                if time.monotonic() - reported >= request.report_s:
                    worker.log_event(request.topic, pickle.dumps(reports[sent:]))
                    sent, reported = len(reports), time.monotonic()
        finally:
            _leave(run)
        return ChunkResult(place, tuple(reports), time.monotonic() - started)
    except UnprocessGenError as error:
        return ChunkResult(place, tuple(reports), error=error)
    except Exception:
        return ChunkResult(place, tuple(reports), bug=traceback.format_exc())


def _leave(run: FrozenRun) -> None:
    """Delete the unfinished files of this process and, if the run has ended, records that were written after it."""
    with suppress(OSError):
        if run.has_ended() and (run.storage / "dataset.json").size() is not None:
            run.storage.remove_work(keep_records=False)
    run.storage.close()


# --------------------------------------------------------------------------------------------------------- coordinator


@dataclass(slots=True)
class Chunk:
    """Hold shards that one worker makes in order, and the time of the last progress."""

    worker: str
    shards: tuple[int, ...]
    progressed_s: float


class Workers:
    """Follow which workers respond, and which may get chunks.

    Attributes
    ----------
    most : int
        Largest number of workers at a time.
    pauses : dict of str to float
        Time until which a worker gets no chunk; infinite for one that makes other bytes.
    """

    def __init__(self, lost_worker_s: float) -> None:
        self._lost_worker_s, self.most = lost_worker_s, 0
        self.pauses: dict[str, float] = {}
        self._signs: dict[str, tuple[float, float]] = {}

    def update(self, last_seen: dict[str, float], now_s: float) -> None:
        """Record when the scheduler heard of each worker; times of two hosts are not compared."""
        new = {address: (seen, now_s) for address, seen in last_seen.items()}
        old = {address: sign for address, sign in self._signs.items() if last_seen.get(address) == sign[0]}
        self._signs = new | old
        self.most = max(self.most, len(self.live(now_s)))

    def live(self, now_s: float) -> set[str]:
        """Addresses of the workers that respond."""
        return {address for address, (_, sign_s) in self._signs.items() if now_s - sign_s < self._lost_worker_s}

    def usable(self, now_s: float) -> list[str]:
        """Addresses of the workers that may get chunks."""
        return sorted(address for address in self.live(now_s) if self.pauses.get(address, 0) <= now_s)


class DaskRun:
    """Make shards, ascending numbers, on the workers of a connected cluster; ``request`` is common to all tasks."""

    def __init__(
        self, client: Client, executor: ExecutorConfig, request: ChunkRequest, records: ShardRecords, shards: list[int]
    ) -> None:
        self._client, self._executor, self._request, self._records = client, executor, request, records
        self._waiting = deque(shards)
        self._left = set(self._waiting)
        self._shared: set[int] = set()
        self._running: dict[Future[ChunkResult], Chunk] = {}
        self._shard_s: dict[str, float] = {}
        self._events: deque[tuple[float, bytes]] = deque()
        self._completed = as_completed(loop=client.loop, with_results=True)
        self._error: UnprocessGenError | None = None
        self._errors = self._losses = 0
        self._answered_s = self._usable_s = time.monotonic()
        self._over = threading.Event()
        self._place = f"executor.address={executor.address or 'null'}"
        self.workers = Workers(executor.lost_worker_s)

    def reports(self) -> Iterator[ShardReport]:
        """Yield a report of each shard as soon as a worker has committed it.

        Raises MachineError if the scheduler or all workers are lost, no worker makes the bytes of this host, or workers
        report a system error; ConfigError if a worker has another version of unprocess_gen, or cannot import it.
        """
        self._client.subscribe_topic(self._request.topic, self._events.append)
        threading.Thread(target=self._poll, daemon=True).start()
        try:
            while self._left:
                time.sleep(TICK_S)
                while self._events:
                    yield from self._count(pickle.loads(self._events.popleft()[1]))
                for future, result in self._completed.next_batch(block=False):
                    if (chunk := self._running.pop(future, None)) is not None:
                        yield from self._end_chunk(chunk, result)
                yield from self._end_lost_chunks()
                self._check()
                self._assign()
            until_s = time.monotonic() + LAST_S
            while time.monotonic() < until_s and not all(future.done() for future in self._running):
                time.sleep(TICK_S)  # workers delete their unfinished files
        finally:
            self._over.set()
            for future in self._running:
                future.release()

    def _poll(self) -> None:
        """Ask the scheduler for its workers until the run ends."""
        while not self._over.wait(max(POLL_S, POLL_WORKER_S * self.workers.most) if self.workers.most else TICK_S):
            with suppress(Exception):  # the client has lost the scheduler; `_check` reports it
                known = self._client.scheduler_info(n_workers=-1)["workers"]
                self._answered_s = time.monotonic()
                last_seen = {address: float(worker["last_seen"]) for address, worker in known.items()}
                self.workers.update(last_seen, self._answered_s)

    # -------------------------------------------------------------------------------------------------------- reports

    def _count(self, reports: Iterable[ShardReport]) -> Iterator[ShardReport]:
        """Count finished shards that were left."""
        for report in reports:
            if report.shard in self._left:
                self._left.remove(report.shard)
                self._errors = self._losses = 0
                for chunk in self._running.values():
                    if report.shard in chunk.shards:
                        chunk.progressed_s = time.monotonic()
                yield report

    def _end_chunk(self, chunk: Chunk, result: Any) -> Iterator[ShardReport]:
        """Take the result of a chunk's task; shards that are left wait for a worker again."""
        if isinstance(result, ChunkResult):
            yield from self._count(result.reports)
            if result.reports and result.seconds:
                self._shard_s[chunk.worker] = result.seconds / len(result.reports)
            self._check_result(chunk.worker, result)
        elif isinstance(result, tuple) and not isinstance(result[1], KilledWorker | OSError):
            raise ConfigError(
                f"{self._place}: workers cannot run unprocess_gen ({error_in_one_line(result[1])}); expected the "
                "versions of this host on scheduler and workers"
            ) from result[1]
        lost = [shard for shard in chunk.shards if shard in self._left]
        committed = filter(self._records.is_committed, lost)
        yield from self._count([self._records.record(shard).report for shard in committed])
        held = {shard for running in self._running.values() for shard in running.shards}
        self._waiting.extendleft(shard for shard in reversed(lost) if shard in self._left and shard not in held)

    def _end_lost_chunks(self) -> Iterator[ShardReport]:
        """End the chunks of workers that do not respond."""
        live = self.workers.live(time.monotonic())
        lost = [future for future, chunk in self._running.items() if chunk.worker not in live]
        self._losses += bool(lost)
        for future in lost:
            chunk = self._running.pop(future)
            future.release()
            yield from self._end_chunk(chunk, None)

    # ----------------------------------------------------------------------------------------------------- assignment

    def _assign(self) -> None:
        """Give each usable worker as many chunks as `window` allows; without waiting shards, share running ones."""
        workers = self.workers.usable(time.monotonic())
        held = Counter(chunk.worker for chunk in self._running.values())
        for count, worker in itertools.product(range(self._executor.window), workers):
            if self._waiting and held[worker] == count:
                self._start(worker, self._next_shards(worker, len(workers)))
                held[worker] += 1
        for worker in workers:
            if not self._waiting and not held[worker] and (shard := self._shard_to_share(worker)) is not None:
                self._shared.add(shard)
                self._start(worker, (shard,))

    def _next_shards(self, worker: str, workers: int) -> tuple[int, ...]:
        """Take ``chunk_s`` of a worker's work, fewer shards at the end, one if the worker's speed is not known."""
        speed = self._executor.chunk_s / self._shard_s[worker] if worker in self._shard_s else 1
        size = max(1, min(int(speed), len(self._waiting) // (2 * workers)))
        return tuple(self._waiting.popleft() for _ in range(size))

    def _shard_to_share(self, worker: str) -> int | None:
        """Find a shard for an idle worker: the last of the chunk with most shards left; a single one only if late."""
        now, candidates = time.monotonic(), []
        for chunk in self._running.values():
            shards = [shard for shard in chunk.shards if shard in self._left and shard not in self._shared]
            is_late = now - chunk.progressed_s > PATIENCE * self._shard_s.get(worker, math.inf)
            if len(shards) > 1 or (shards and is_late):
                candidates.append(shards)
        return max(candidates, key=len)[-1] if candidates else None

    def _start(self, worker: str, shards: tuple[int, ...]) -> None:
        """Submit a chunk to one worker."""
        request = replace(self._request, shards=shards)
        future = self._client.submit(make_shards, request, pure=False, workers=[worker])
        self._running[future] = Chunk(worker, shards, time.monotonic())
        self._completed.add(future)

    # ---------------------------------------------------------------------------------------------------------- checks

    def _check(self) -> None:
        """Raise MachineError if the scheduler is lost, or no worker is usable for too long."""
        now, limit_s = time.monotonic(), self._executor.no_workers_s
        if self._client.status != "running":
            raise MachineError(f"{self._place}: the Dask scheduler ended or cannot be reached; {RESUME}")
        if now - self._answered_s > limit_s:
            raise MachineError(f"{self._place}: the Dask scheduler has not answered for {limit_s:g} s; {RESUME}")
        if self._losses >= LOSSES:
            raise MachineError(
                f"{self._place}: workers were lost {LOSSES} times, and no shard was finished meanwhile; read the logs "
                f"of the workers; {RESUME}"
            )
        if self.workers.usable(now):
            self._usable_s = now
        elif self._error is not None and now - self._usable_s > min(limit_s, UNFIT_S):
            raise self._error
        elif now - self._usable_s > limit_s:
            raise MachineError(
                f"executor.no_workers_s={limit_s:g}: no Dask worker responded for this time; start workers, then "
                "rerun; finished shards are kept"
            )

    def _check_result(self, worker: str, result: ChunkResult) -> None:
        """Pause a worker that reports a system error; raise the error of a task that other workers would repeat."""
        if result.bug:
            raise RuntimeError(f"{result.place}:\n{result.bug}")
        if result.error is None:
            return
        self._error = type(result.error)(f"{result.place}: {result.error}")
        if not isinstance(result.error, MachineError) or isinstance(result.error, SourceChangedError):
            raise self._error
        now = time.monotonic()
        self.workers.pauses[worker] = math.inf if result.is_unfit else now + PAUSE_S
        self._errors += not result.is_unfit
        if self._errors >= max(TRIES, len(self.workers.live(now))):
            raise self._error


# ----------------------------------------------------------------------------------------------------------- clusters


@contextmanager
def connected(executor: ExecutorConfig, n_jobs: int, storage: Storage) -> Iterator[Client]:
    """Connect to a scheduler, or start one with ``n_jobs`` workers, and leave or end it afterwards.

    Messages of Dask are hidden meanwhile. Raises MachineError if no scheduler answers or no worker can be started,
    ConfigError if the address is not one.
    """
    address, timeout_s = executor.address, min(CONNECT_S, executor.no_workers_s)
    with ExitStack() as stack:
        for logger in map(logging.getLogger, LOGGERS):
            stack.callback(vars(logger).update, handlers=logger.handlers, propagate=logger.propagate)
            logger.handlers, logger.propagate = [logging.NullHandler()], False
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore", VersionMismatchWarning)
        try:
            scheduler = address or start_cluster(n_jobs)
            if isinstance(scheduler, LocalCluster):
                stack.callback(forget_deaths, storage)  # do not count these kills as deaths of workers
                stack.callback(_kill, scheduler)
            client = Client(scheduler, timeout=timeout_s, set_as_default=False, name="unprocess_gen")
        except OSError as error:
            raise MachineError(
                f"executor.address={address}: no Dask scheduler answers; start one with dask scheduler, then rerun"
            ) from error
        except (ValueError, KeyError, TypeError, ImportError) as error:
            raise ConfigError(
                f"executor.address={address}: cannot be used ({error_in_one_line(error)}); expected the address of a "
                "Dask scheduler, such as tcp://10.0.0.1:8786"
            ) from error
        try:
            yield client
        finally:
            with suppress(Exception):
                client.close(timeout=CLOSE_S)


def start_cluster(n_jobs: int) -> LocalCluster:
    """Start a scheduler in this process, and worker processes; raise MachineError if that fails."""
    variables = {f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in ALLOCATION.items()}
    with interrupts_ignored(), dask.config.set(variables):  # workers inherit both
        try:
            return LocalCluster(
                n_workers=n_jobs,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
        except (OSError, RuntimeError) as error:
            raise MachineError(f"executor=dask: workers cannot be started ({error_in_one_line(error)})") from error


def _kill(cluster: LocalCluster) -> None:
    """Kill the workers of a cluster for good. The end of the run removes their unfinished files."""
    for nanny in cluster.workers.values():
        nanny.status = Status.closing_gracefully  # the nanny ends too, instead of starting another worker
        with suppress(ProcessLookupError, TypeError):  # a nanny whose worker has ended has no pid
            os.kill(nanny.pid, getattr(signal, "SIGKILL", signal.SIGTERM))  # Windows ends processes by SIGTERM
    with suppress(Exception):
        cluster.close(timeout=CLOSE_S)
