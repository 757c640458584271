"""Run the shards of a frozen run on a Dask cluster; the only module that uses Dask.

A task (`make_shards`) holds numbers of shards. A worker opens the frozen run below ``out``, makes the shards that are
not committed, and reports counts: about once a second while it works, and as the result of the task. Because every
shard is committed by its worker, a task that is lost, retried or submitted twice costs time, but changes no byte.

What happens when something fails:

* A worker dies: Dask retries its tasks on other workers; committed shards are skipped. A shard that ends its workers
  gets provisional rows after `deaths.LIMIT` deaths, which workers count below ``.work``.
* A worker stops responding for ``executor.lost_worker_s``: other workers get its shards.
* A worker is slow: once nothing else is left, idle workers take the last half of the shards in its tasks.
* A worker makes other bytes (canary, self-test): it is retired. Without any other worker the run ends.
* There is no worker for ``executor.no_workers_s``, or the scheduler dies: MachineError. A rerun continues.

Calls that wait for the scheduler run in threads of their own, so that a stopped scheduler does not stop the run from
ending. Design: ``docs/design/pipeline.md``.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import itertools
import logging
import os
import pickle
import platform
import queue
import signal
import threading
import time
import traceback
import uuid
import warnings
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import dask
from dask.typing import Key
from distributed import Client, Future, KilledWorker, LocalCluster, Nanny, Status, get_worker
from distributed.versions import VersionMismatchWarning

from unprocess_gen.config.schema import ExecutorConfig
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import RESUME, ConfigError, MachineError, SourceChangedError, UnprocessGenError
from unprocess_gen.pipeline.deaths import forget_deaths
from unprocess_gen.pipeline.executors.chunks import Chunk, ChunkQueue, Ranges, ranges_of, shards_of
from unprocess_gen.pipeline.executors.local import interrupts_ignored
from unprocess_gen.pipeline.frozen_run import PLAN, FrozenRun, OnCompiling, open_run
from unprocess_gen.pipeline.progress import COMPILING
from unprocess_gen.pipeline.shard_records import ShardRecords
from unprocess_gen.pipeline.storage import Storage
from unprocess_gen.pipeline.tasks import ShardReport
from unprocess_gen.pipeline.worker import KEPT_BYTES

TICK_S = 0.25
"""Time between two checks for lost workers and for the end of a wait."""

POLL_S, CALM_POLL_S = 1.0, 5.0
"""Time between two questions to the scheduler about its workers; the longer one while shards wait for a worker."""

POLL_WORKER_S = 0.01
"""Least part of this time for each worker."""

CALM_AFTER_S = 60.0
"""Time from the start of a run in which workers join, so that they are asked for often."""

REPORT_S = 1.0
"""Shortest time between two reports of a worker while it works."""

REPORT_WORKER_S = 0.02
"""Least part of this time for each worker: a report takes 1 ms of scheduler and client, so all take 5 % of a core."""

CONNECT_S = 30.0
"""Longest time to connect to a scheduler."""

LAST_S = 1.0
"""Longest time to wait for tasks without a shard that is left."""

CLOSE_S = 2.0
"""Longest time to leave a cluster."""

RESULT_S = 10.0
"""Longest time to fetch the result of a finished task, whose worker may have died meanwhile."""

UNFIT_S = 10.0
"""Time to wait for another worker after the last one was retired."""

FAILURES = 20
"""Tasks that may fail one after the other without a finished shard before the run ends."""

TRIES = 3
"""Workers that may report a system error, such as a store that does not answer, without a finished shard meanwhile."""

AVOID_S = 60.0
"""Time in which a worker that reported a system error gets no tasks if there are others."""

IDLE_S = 60
"""Time between two measurements or reports of a cluster that the run does not use."""

QUIET = {
    "distributed.admin.tick.interval": f"{IDLE_S} s",
    "distributed.admin.tick.cycle": f"{IDLE_S} s",
    "distributed.admin.system-monitor.interval": f"{IDLE_S} s",
    "distributed.client.scheduler-info-interval": f"{IDLE_S} s",
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.worker.profile.enabled": False,
}
"""Settings of a cluster that the run starts: its idle scheduler and client take 0.6 % of a core instead of 2.4 %."""

ALLOCATION = {
    f"distributed.nanny.pre-spawn-environ.{variable}": value
    for variable, value in (
        ("MALLOC_ARENA_MAX", 1),
        ("MALLOC_MMAP_MAX_", 0),
        ("MALLOC_TRIM_THRESHOLD_", KEPT_BYTES),
    )
}
"""Variables of glibc with the effect of `worker.keep_memory` in threads too, in which Dask runs tasks.

Arenas of threads return freed memory to the system, so a run with large arrays takes a quarter longer without them.
"""

LOST = (KilledWorker, OSError, asyncio.CancelledError, concurrent.futures.CancelledError)
"""Exceptions of a task whose workers, or whose result, were lost; TimeoutError is an OSError."""

LOGGERS = ("distributed", "tornado", "asyncio")
"""Loggers whose messages are hidden during a run; what they report becomes one sentence."""


# ------------------------------------------------------------------------------------------------------------- workers


@dataclass(frozen=True, slots=True)
class ChunkRequest:
    """Hold what a task needs.

    Attributes
    ----------
    out : str
        Folder of the dataset, absolute, or its URL.
    root : str or None
        Absolute place of the sources.
    plan_sha256 : str
        Digest of the frozen plan.
    ranges : tuple of (int, int)
        The shards.
    report_s : float
        Shortest time between two reports.
    topic : str
        Dask topic of the progress.
    """

    out: str
    root: str | None
    plan_sha256: str
    ranges: Ranges = ()
    report_s: float = REPORT_S
    topic: str = field(default_factory=lambda: f"unprocess_gen-{uuid.uuid4().hex}")


@dataclass(frozen=True, slots=True)
class ChunkResult:
    """Hold the outcome of a task.

    Attributes
    ----------
    worker : str
        Address of the worker.
    host : str
        Name of its host.
    reports : tuple of ShardReport
        Shards that this task made; those that were committed before have none.
    seconds : float
        Time that it took to make them.
    error : UnprocessGenError or None
        Error that ended the task.
    unusable : bool
        Whether the error is the worker's: it can make no shard of this run.
    bug : str or None
        Traceback of an unexpected error.
    """

    worker: str
    host: str
    reports: tuple[ShardReport, ...] = ()
    seconds: float = 0.0
    error: UnprocessGenError | None = None
    unusable: bool = False
    bug: str | None = None

    @property
    def place(self) -> str:
        """Name of the worker in messages."""
        return f"Dask worker {self.worker} on {self.host}"


def make_shards(request: ChunkRequest) -> ChunkResult:
    """Make and commit shards in a Dask worker; errors are part of the result, so that no worker logs a traceback."""
    worker = get_worker()
    place = (str(worker.address), platform.node())
    reports: list[ShardReport] = []
    started = time.monotonic()
    try:
        try:
            report_compiling = partial(worker.log_event, request.topic, COMPILING)
            run = open_run(request.out, request.plan_sha256, request.root, report_compiling)
        except MachineError as error:
            return ChunkResult(*place, error=error, unusable=True)
        started = time.monotonic()
        try:
            for report in run.make(_while_planned(run, shards_of(request.ranges))):
                reports.append(report)
                _send_progress(worker, request, reports)
                if report.killer is not None:
                    break  # a retry of this task would try the provisional shard again
        finally:
            _leave(run)
        return ChunkResult(*place, tuple(reports), time.monotonic() - started)
    except UnprocessGenError as error:
        return ChunkResult(*place, tuple(reports), time.monotonic() - started, error)
    except Exception:
        return ChunkResult(*place, tuple(reports), time.monotonic() - started, bug=traceback.format_exc())


def _while_planned(run: FrozenRun, shards: Iterable[int]) -> Iterator[int]:
    """Yield shards until the run has ended, which another worker may have done meanwhile."""
    return itertools.takewhile(lambda shard: run.storage.size(PLAN) is not None, shards)


def _leave(run: FrozenRun) -> None:
    """Delete the unfinished files of this process and, if the run has ended, records that were written after it."""
    with suppress(OSError):
        if run.storage.size(PLAN) is None and run.storage.size("dataset.json") is not None:
            run.storage.remove_work(keep_records=False)
    run.storage.close()


def _send_progress(worker: Any, request: ChunkRequest, reports: list[ShardReport]) -> None:
    """Send the reports since the last message, at most once in ``request.report_s``."""
    sent, sent_s = getattr(_SENT, "state", (0, 0.0)) if len(reports) > 1 else (0, 0.0)
    now = time.monotonic()
    if now - sent_s >= request.report_s:
        worker.log_event(request.topic, pickle.dumps(tuple(reports[sent:])))
        sent, sent_s = len(reports), now
    _SENT.state = (sent, sent_s)


_SENT = threading.local()
"""Number of reports of the task of this thread that were sent, and the time of the last message."""


# --------------------------------------------------------------------------------------------------------- coordinator


@dataclass(frozen=True, slots=True)
class Poll:
    """Hold what the scheduler knows of its workers: when it heard of each, and the keys of its tasks."""

    last_seen: dict[str, float]
    keys: dict[str, frozenset[Key]]


@dataclass(slots=True)
class Workers:
    """Follow which workers respond.

    Attributes
    ----------
    lost_worker_s : float
        Time without a sign of life after which a worker is lost.
    retired : set of str
        Addresses of workers that make other bytes.
    failing : dict of str to float
        Workers that reported a system error, and the time until which others are preferred.
    most : int
        Largest number of workers at a time.
    """

    lost_worker_s: float
    retired: set[str] = field(default_factory=set)
    failing: dict[str, float] = field(default_factory=dict)
    most: int = 0
    _signs: dict[str, tuple[float, float]] = field(default_factory=dict)

    def update(self, poll: Poll, now_s: float) -> None:
        """Take note of an answer of the scheduler."""
        self._signs = {
            address: self._signs[address] if self._signs.get(address, (None,))[0] == seen else (seen, now_s)
            for address, seen in poll.last_seen.items()
        }
        self.most = max(self.most, len(self.live(now_s)))

    def live(self, now_s: float) -> set[str]:
        """Return the workers that respond and are not retired."""
        return {address for address, (_, at) in self._signs.items() if now_s - at < self.lost_worker_s} - self.retired

    def preferred(self, now_s: float) -> set[str]:
        """Return the workers that should get tasks: those that respond, without failing ones if there are others."""
        live = self.live(now_s)
        return {address for address in live if self.failing.get(address, now_s) <= now_s} or live

    def lost(self, now_s: float) -> set[str]:
        """Return the workers that the scheduler knows and that do not respond."""
        return {address for address, (_, at) in self._signs.items() if now_s - at >= self.lost_worker_s}

    def avoided(self, now_s: float) -> bool:
        """Return whether the scheduler knows workers that should get no tasks."""
        return len(self.preferred(now_s)) < len(self._signs)


class DaskRun:
    """Make shards on the workers of a connected cluster.

    Parameters
    ----------
    client : Client
        The connection.
    executor : ExecutorConfig
        Settings.
    request : ChunkRequest
        What all tasks have in common.
    records : ShardRecords
        The committed shards.
    shards : iterable of int
        Shards to make, ascending.
    on_compiling : callable
        Called when the first worker compiles kernels.

    Attributes
    ----------
    workers : Workers
        The workers so far.
    """

    def __init__(
        self,
        client: Client,
        executor: ExecutorConfig,
        request: ChunkRequest,
        records: ShardRecords,
        shards: Iterable[int],
        on_compiling: OnCompiling,
    ) -> None:
        self._client, self._executor, self._request, self._records = client, executor, request, records
        self._chunks = ChunkQueue(shards, executor.chunk_s)
        self._running: dict[Key, tuple[Future[ChunkResult], Chunk]] = {}
        self._events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._failures = 0
        self._reported_by: list[str] = []
        self._unfit: UnprocessGenError | None = None
        self._over = threading.Event()
        self._report_compiling: OnCompiling | None = on_compiling
        self._worked_s = self._answered_s = time.monotonic()
        self.workers = Workers(executor.lost_worker_s)

    def reports(self) -> Iterator[ShardReport]:
        """Yield a report of each shard as soon as a worker has committed it.

        Raises
        ------
        MachineError
            If the scheduler or all workers are lost, no worker makes the bytes of this host, or a worker reports a
            system error.
        ConfigError
            If a worker has another version of unprocess_gen, or cannot import it.
        """
        self._client.subscribe_topic(self._request.topic, self._receive)
        threading.Thread(target=self._poll, daemon=True).start()
        try:
            while self._chunks.left:
                with suppress(queue.Empty):
                    kind, content = self._events.get(timeout=TICK_S)
                    yield from getattr(self, f"_on_{kind}")(content)
                self._check()
                self._submit()
            self._await_workers()
        finally:
            self._over.set()
            for future, _ in self._running.values():
                future.release()

    def _await_workers(self) -> None:
        """Wait shortly for workers that have committed their last shard, and now delete their unfinished files."""
        until = time.monotonic() + LAST_S
        while self._running and time.monotonic() < until:
            with suppress(queue.Empty):
                kind, content = self._events.get(timeout=TICK_S)
                if kind == "done":
                    self._running.pop(content[0], None)

    def _receive(self, event: tuple[float, str | bytes]) -> None:
        """Take the progress of a worker, in the thread of the client."""
        content = event[1]
        self._events.put(("compiling", None) if isinstance(content, str) else ("progress", pickle.loads(content)))

    def _poll(self) -> None:
        """Ask the scheduler for its workers until the run ends; in a thread, because the scheduler may be stopped."""
        workers, calm_s = 0, time.monotonic() + CALM_AFTER_S
        while not self._over.wait(self._poll_s(workers, time.monotonic() > calm_s)):
            with suppress(Exception):  # the client has lost the scheduler; `_check` reports it
                info = self._client.scheduler_info(n_workers=-1)["workers"]
                keys = self._client.processing()
                workers = len(info)
                poll = Poll(
                    {address: float(worker["last_seen"]) for address, worker in info.items()},
                    {address: frozenset(keys.get(address, ())) for address in info},
                )
                self._events.put(("poll", poll))

    def _poll_s(self, workers: int, is_calm: bool) -> float:
        """Return the time until the next question: short if a worker is missing, may be idle, or may soon be lost."""
        if not workers:
            return TICK_S
        if not is_calm or not self._chunks.waits:
            return max(POLL_S, POLL_WORKER_S * workers)
        return max(POLL_S, POLL_WORKER_S * workers, min(CALM_POLL_S, self._executor.lost_worker_s / 4))

    # ------------------------------------------------------------------------------------------------------ submission

    def _submit(self) -> None:
        """Submit chunks until each worker has `window` of them."""
        workers = self.workers.preferred(time.monotonic())
        while workers and len(self._running) < self._executor.window * len(workers):
            chunk = self._chunks.take(len(workers), time.monotonic())
            if chunk is None:
                return
            self._start(chunk, sorted(workers) if self.workers.avoided(time.monotonic()) else None)

    def _start(self, chunk: Chunk, workers: list[str] | None) -> None:
        """Submit one chunk, preferably to some workers."""
        report_s = max(REPORT_S, REPORT_WORKER_S * self.workers.most)
        future = self._client.submit(
            make_shards,
            replace(self._request, ranges=ranges_of(chunk.shards), report_s=report_s),
            key=f"make_shards-{uuid.uuid4().hex}",
            pure=False,
            workers=workers,
            allow_other_workers=workers is not None,
        )
        self._running[future.key] = (future, chunk)
        future.add_done_callback(self._fetch)

    def _fetch(self, future: Future[ChunkResult]) -> None:
        """Fetch the result of a finished task, in a thread of the client."""
        outcome: ChunkResult | BaseException
        try:
            outcome = future.result(timeout=RESULT_S)
        except BaseException as error:  # also CancelledError
            outcome = error
        self._events.put(("done", (future.key, outcome)))

    # ---------------------------------------------------------------------------------------------------------- events

    def _on_compiling(self, _: None) -> Iterator[ShardReport]:
        """Report once that workers compile kernels."""
        if self._report_compiling is not None:
            self._report_compiling()
            self._report_compiling = None
        return iter(())

    def _on_progress(self, reports: Iterable[ShardReport]) -> Iterator[ShardReport]:
        """Count finished shards."""
        now = time.monotonic()
        for report in reports:
            if self._chunks.finish(report.shard, now):
                self._failures = 0
                self._reported_by.clear()
                yield report

    def _on_done(self, event: tuple[Key, Any]) -> Iterator[ShardReport]:
        """Take the outcome of a task."""
        key, outcome = event
        if key not in self._running:
            return  # released
        future, chunk = self._running.pop(key)
        future.release()
        if isinstance(outcome, ChunkResult):
            yield from self._on_progress(outcome.reports)
            self._chunks.measure(len(outcome.reports), outcome.seconds)
            yield from self._on_progress(self._committed(chunk))
            self._check_result(outcome)
        else:
            yield from self._on_progress(self._committed(chunk))
            self._check_failure(outcome)
        self._chunks.end(chunk)

    def _on_poll(self, poll: Poll) -> Iterator[ShardReport]:
        """Give shards of lost workers to others, and shards of slow workers to idle ones."""
        now = self._answered_s = time.monotonic()
        self.workers.update(poll, now)
        for address in self.workers.lost(now):
            for key in poll.keys.get(address, ()):
                if key in self._running:
                    future, chunk = self._running.pop(key)
                    future.release()
                    self._chunks.end(chunk)
        idle = [
            address
            for address in sorted(self.workers.preferred(now))
            if not poll.keys.get(address) and not self._chunks.waits
        ]
        running = [chunk for _, chunk in self._running.values()]
        for address, chunk in zip(idle, self._chunks.share(running, len(idle), now), strict=False):
            self._start(chunk, [address])
        return iter(())

    def _committed(self, chunk: Chunk) -> Iterator[ShardReport]:
        """Yield reports of committed shards of a chunk whose reports were lost with a worker."""
        for shard in chunk.shards:
            if shard in self._chunks.left and self._records.is_committed(shard):
                yield self._records.record(shard).report

    # ---------------------------------------------------------------------------------------------------------- checks

    def _check(self) -> None:
        """Raise MachineError if the scheduler is lost, or no worker has responded for too long."""
        now = time.monotonic()
        if self._client.status != "running":
            raise MachineError(f"{self._place}: the Dask scheduler ended or cannot be reached; {RESUME}")
        limit = self._executor.no_workers_s
        if now - self._answered_s > limit:
            raise MachineError(f"{self._place}: the Dask scheduler has not answered for {limit:g} s; {RESUME}")
        if self.workers.live(now):
            self._worked_s = now
        elif self._unfit is not None and now - self._worked_s > min(limit, UNFIT_S):
            raise self._unfit
        elif now - self._worked_s > limit:
            raise MachineError(
                f"executor.no_workers_s={limit:g}: no Dask worker responded for this time; start workers, then rerun; "
                "finished shards are kept"
            )

    @property
    def _place(self) -> str:
        return f"executor.address={self._executor.address or 'null'}"

    def _check_result(self, result: ChunkResult) -> None:
        """Retire an unusable worker; raise the error of a task that other workers would repeat."""
        if result.bug is not None:
            raise RuntimeError(f"{result.place}:\n{result.bug}")
        if result.error is None:
            return
        error = type(result.error)(f"{result.place}: {result.error}")
        if result.unusable:
            self._unfit = error
            self._retire(result.worker)
            return
        if not isinstance(error, MachineError) or isinstance(error, SourceChangedError):
            raise error
        now = time.monotonic()
        self.workers.failing[result.worker] = now + AVOID_S
        self._reported_by.append(result.worker)
        workers = set(self._reported_by)
        if len(workers) >= TRIES or (len(self._reported_by) >= TRIES and not self.workers.live(now) - workers):
            raise error

    def _retire(self, address: str) -> None:
        """Close a worker, in a thread, because a stopped scheduler never answers."""
        self.workers.retired.add(address)

        def retire() -> None:
            with suppress(Exception):  # the client has lost the scheduler; `_check` reports it
                while not self._over.is_set() and not self._client.retire_workers([address], close_workers=True):
                    time.sleep(TICK_S)  # until the scheduler has released the result of its last task

        threading.Thread(target=retire, daemon=True).start()

    def _check_failure(self, error: BaseException) -> None:
        """Accept the loss of a task's workers; raise for other failures, and for too many one after the other."""
        self._failures += 1
        if not isinstance(error, LOST):
            raise ConfigError(
                f"{self._place}: workers cannot run unprocess_gen ({error_in_one_line(error)}); expected the versions "
                "of this host on scheduler and workers"
            ) from error
        if self._failures >= FAILURES:
            raise MachineError(
                f"{self._place}: {self._failures} tasks lost their workers, and no shard was finished meanwhile; read "
                f"the logs of the workers; {RESUME}"
            ) from error


# ----------------------------------------------------------------------------------------------------------- clusters


@contextmanager
def connected(executor: ExecutorConfig, n_jobs: int, storage: Storage) -> Iterator[Client]:
    """Connect to a scheduler, or start one with ``n_jobs`` workers, and leave or end it afterwards.

    Parameters
    ----------
    executor : ExecutorConfig
        Settings.
    n_jobs : int
        Number of workers to start if ``executor.address`` is None.
    storage : Storage
        Where the dataset is written.

    Yields
    ------
    Client
        The connection. Messages of Dask are hidden while it is in use.

    Raises
    ------
    MachineError
        If no scheduler answers at the address, or the workers cannot be started.
    ConfigError
        If the address is not one.
    """
    with ExitStack() as stack:
        stack.enter_context(_silenced())
        if executor.address is None:
            scheduler: Any = stack.enter_context(_local_cluster(executor, n_jobs, storage))
        else:
            scheduler = executor.address
        try:
            client = Client(
                scheduler, timeout=min(CONNECT_S, executor.no_workers_s), set_as_default=False, name="unprocess_gen"
            )
        except OSError as error:
            raise MachineError(
                f"executor.address={executor.address}: no Dask scheduler answers; start one with dask scheduler, then "
                "rerun"
            ) from error
        except (ValueError, KeyError, TypeError, ImportError) as error:
            raise ConfigError(
                f"executor.address={executor.address}: cannot be used ({error_in_one_line(error)}); expected the "
                "address of a Dask scheduler, such as tcp://10.0.0.1:8786"
            ) from error
        try:
            yield client
        finally:
            with suppress(Exception):
                client.close(timeout=CLOSE_S)


@contextmanager
def _local_cluster(executor: ExecutorConfig, n_jobs: int, storage: Storage) -> Iterator[LocalCluster]:
    """Start a scheduler in this process, and worker processes; kill them afterwards."""
    with (
        interrupts_ignored(),  # workers inherit this
        dask.config.set(QUIET | ALLOCATION | {"distributed.scheduler.worker-ttl": f"{executor.lost_worker_s} s"}),
    ):
        try:
            cluster = LocalCluster(
                n_workers=n_jobs,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                memory_limit=0,
                scheduler_sync_interval=IDLE_S,
                silence_logs=logging.CRITICAL,
            )
        except (OSError, RuntimeError) as error:
            raise MachineError(f"executor=dask: workers cannot be started ({error_in_one_line(error)})") from error
    try:
        yield cluster
    finally:
        for nanny in cluster.workers.values():
            _kill(nanny)
        with suppress(Exception):
            cluster.close(timeout=CLOSE_S)
        forget_deaths(storage)  # the workers that were killed here died of no photograph


def _kill(nanny: Nanny) -> None:
    """Kill a worker process for good. Its shards are committed; the end of the run removes its unfinished files."""
    nanny.status = Status.closing_gracefully  # the nanny ends too, instead of starting another worker
    pid = nanny.pid
    if pid is not None:
        with suppress(ProcessLookupError):
            os.kill(pid, getattr(signal, "SIGKILL", signal.SIGTERM))  # Windows ends processes by SIGTERM


@contextmanager
def _silenced() -> Iterator[None]:
    """Hide messages of Dask and of its libraries, which would interrupt the progress on stderr."""
    loggers = [logging.getLogger(name) for name in LOGGERS]
    loggers += [
        logger
        for name, logger in list(logging.root.manager.loggerDict.items())
        if name.startswith("distributed.") and isinstance(logger, logging.Logger)
    ]
    before = [(logger, logger.disabled) for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VersionMismatchWarning)
        try:
            yield
        finally:
            for logger, disabled in before:
                logger.disabled = disabled
