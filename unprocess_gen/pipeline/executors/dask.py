"""Make the shards of a run on a Dask cluster; the only module that uses Dask.

A shard is a future, and a worker has at most `IN_FLIGHT` of them. Workers commit shards themselves, so a shard that is
made twice costs time, but changes no byte. Dask gives the shards of lost workers to others and retries those that fail.

* Workers count their deaths (`deaths`), so a shard that Dask gives up is submitted again, without its deadly sources.
* There is no worker for ``executor.no_workers_s``, or the scheduler ends: MachineError. A rerun continues.
"""

from __future__ import annotations

import logging
import time
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from importlib.metadata import version

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, wait
from distributed.versions import VersionMismatchWarning

from unprocess_gen.config.schema import ExecutorConfig, replaced
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import RESUME, ConfigError, MachineError
from unprocess_gen.core.paths import absolute_text
from unprocess_gen.pipeline.deaths import count_death, deadly_sources, read_deaths
from unprocess_gen.pipeline.executors.local import effective_jobs, interrupts_ignored
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.pipeline.tasks import Made, RunContext, ShardReport, ShardTask
from unprocess_gen.pipeline.worker import KEPT_BYTES, make_and_commit

IN_FLIGHT = 2
"""Shards of a worker: one in progress, and the next one, so that no worker waits."""

RETRIES = 2
"""Times that Dask repeats a shard that ended with an error."""

POLL_S = 1.0
"""Longest time between two looks at the number of workers."""

CONNECT_S = 30.0

ALLOCATION = {"MALLOC_ARENA_MAX": 1, "MALLOC_MMAP_MAX_": 0, "MALLOC_TRIM_THRESHOLD_": KEPT_BYTES}
"""Variables of glibc with the effect of `worker.keep_memory` in threads, in which Dask runs tasks.

Without them a run with large arrays takes a quarter longer, because arenas of threads return freed memory.
"""

LOGGERS = ("distributed", "distributed.client", "tornado", "tornado.application", "asyncio")
"""Loggers whose messages are hidden during a run; what they report becomes one sentence."""


def make_shards(
    folder: OutFolder, settings: PairSettings, tasks: Sequence[ShardTask], progress: Progress, made: Made
) -> Iterator[ShardReport]:
    """Make and commit shards; yield a report of each as soon as a worker has committed it.

    MachineError if the scheduler or all workers are lost, or a shard fails repeatedly; ConfigError if a worker has
    another version of unprocess_gen, or cannot import it.
    """
    config = settings.config
    places = {"out": absolute_text(config.out), "noise.dark_frames": absolute_text(config.noise.dark_frames)}
    places |= {"source.root": absolute_text(config.source.place)}
    context = RunContext(PairSettings.read(replaced(config, places)), "", None)
    address = f"executor.address={config.executor.address or 'null'}"
    with connected(config.executor, effective_jobs(config.n_jobs, len(tasks))) as client:
        try:
            yield from _committed(client, folder, context, tasks)
            made.n_jobs = client.scheduler_info(n_workers=0)["n_workers"]
        except (CancelledError, OSError) as error:
            raise MachineError(f"{address}: the Dask scheduler ended or cannot be reached; {RESUME}") from error
        except ImportError as error:
            raise ConfigError(
                f"{address}: workers cannot run unprocess_gen ({error_in_one_line(error)}); expected the versions of "
                "this host on scheduler and workers"
            ) from error


def make_on_worker(expected: str, context: RunContext, task: ShardTask) -> ShardReport:
    """Make and commit a shard in a Dask worker, which must have the expected version of unprocess_gen."""
    if version("unprocess_gen") != expected:
        raise ConfigError(
            f"executor=dask: a worker has unprocess_gen {version('unprocess_gen')}, this host {expected}; expected the "
            "same version on all hosts"
        )
    with OutFolder(context.config.out) as folder:
        return make_and_commit(replace(context, scratch=str(folder.scratch)), task)


def _committed(
    client: Client, folder: OutFolder, context: RunContext, tasks: Sequence[ShardTask]
) -> Iterator[ShardReport]:
    """Yield the reports of shards; those that end their workers are submitted again, at the end."""
    limit_s, waiting = context.config.executor.no_workers_s, deque(tasks)
    running: dict[Future[ShardReport], ShardTask] = {}
    deaths: dict[int, list[int]] = {}
    seen_s = time.monotonic()
    while waiting or running:
        workers = client.scheduler_info(n_workers=0)["n_workers"]
        if workers:
            seen_s = time.monotonic()
        elif time.monotonic() - seen_s > limit_s:
            raise MachineError(
                f"executor.no_workers_s={limit_s:g}: no Dask worker for this time; start workers, then rerun; finished "
                "shards are kept"
            )
        while waiting and len(running) < IN_FLIGHT * workers:
            arguments = version("unprocess_gen"), context, waiting.popleft()
            running[client.submit(make_on_worker, *arguments, pure=False, retries=RETRIES)] = arguments[-1]
        if not running:
            time.sleep(POLL_S / 10)
            continue
        with client.as_current(), suppress(TimeoutError):
            wait(list(running), POLL_S, "FIRST_COMPLETED")
        for future in [future for future in running if future.done()]:
            task = running.pop(future)
            try:
                yield future.result()
            except KilledWorker:
                count_death(folder, task, deaths.get(task.shard, []))
                deaths[task.shard] = read_deaths(folder, task.shard)
                if len(deadly_sources(task, deaths[task.shard])) == len(task.sources):
                    yield make_on_worker(version("unprocess_gen"), context, task)  # reads no source
                else:
                    waiting.append(task)


@contextmanager
def connected(executor: ExecutorConfig, n_jobs: int) -> Iterator[Client]:
    """Connect to a scheduler, or start one with ``n_jobs`` workers; leave or end it afterwards.

    Raises MachineError if no scheduler answers or no worker can be started, ConfigError if the address is not one.
    """
    address = executor.address
    with ExitStack() as stack:
        for logger in map(logging.getLogger, LOGGERS):
            stack.callback(vars(logger).update, handlers=logger.handlers, propagate=logger.propagate)
            logger.handlers, logger.propagate = [logging.NullHandler()], False
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore", VersionMismatchWarning)
        try:
            scheduler = address or stack.enter_context(start_cluster(n_jobs))
            timeout_s = min(CONNECT_S, executor.no_workers_s)
            client = stack.enter_context(Client(scheduler, timeout=timeout_s, set_as_default=False))
        except OSError as error:
            raise MachineError(
                f"executor.address={address}: no Dask scheduler answers; start one with dask scheduler, then rerun"
            ) from error
        except (ValueError, KeyError, TypeError, ImportError) as error:
            raise ConfigError(
                f"executor.address={address}: cannot be used ({error_in_one_line(error)}); expected the address of a "
                "Dask scheduler, such as tcp://10.0.0.1:8786"
            ) from error
        yield client


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
