"""Make shards in worker processes of this machine; the only module that uses joblib.

When a worker dies, usually because the system is out of memory, loky stops all workers of the pool within half a second
and raises TerminatedWorkerError. The other shards continue in a new pool. Those that were in progress are made at the
end, each with no other one: a source that kills four workers there gets the row ``worker_died`` (`deaths`).

If the coordinator dies, its workers exit by themselves (`worker._exit_with_parent`). With ``n_jobs=1`` or one
shard the coordinator does the work, so killing it ends the run; a rerun resumes.
"""

from __future__ import annotations

import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from unprocess_gen.core.errors import MachineError
from unprocess_gen.pipeline.deaths import count_death, deadly_sources, read_deaths, shards_with_deaths, write_deaths
from unprocess_gen.pipeline.executors.cores import own_cores, usable_cores
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.pipeline.tasks import Made, RunContext, ShardReport, ShardTask
from unprocess_gen.pipeline.worker import make_and_commit


def make_shards(
    folder: OutFolder, settings: PairSettings, tasks: Sequence[ShardTask], progress: Progress, made: Made
) -> Iterator[ShardReport]:
    """Make and commit shards; yield a report of each as soon as it is committed.

    With one job joblib is not imported (0.1 s, 8 MB) and the coordinator makes the shards.
    """
    made.n_jobs = n_jobs = effective_jobs(settings.config.n_jobs, len(tasks))
    context = RunContext(settings, str(folder.scratch), os.getpid(), core_to_spare=n_jobs < own_cores())
    progress.watch(context)
    if n_jobs == 1:
        yield from (make_and_commit(context, task) for task in tasks)
    else:
        yield from _make_in_pools(folder, context, tasks, n_jobs)


def _make_in_pools(
    folder: OutFolder, context: RunContext, tasks: Sequence[ShardTask], n_jobs: int
) -> Iterator[ShardReport]:
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    known, make = shards_with_deaths(folder), partial(make_and_commit, context)
    waiting = {task.shard: task for task in tasks if task.shard not in known}
    alone = [task for task in tasks if task.shard in known]
    try:
        while waiting:
            try:
                for report in run_pool(make, [*waiting.values()], n_jobs):
                    del waiting[report.shard]
                    yield report
            except TerminatedWorkerError:
                in_progress = sorted(shards_with_deaths(folder) & waiting.keys()) or [*waiting][:n_jobs]
                for shard in in_progress:
                    write_deaths(folder, shard, [])  # any of them may have ended the pool
                    alone.append(waiting.pop(shard))
    except BaseException:
        with suppress(OSError, MachineError):  # this end of the workers is no death
            for shard in shards_with_deaths(folder) & waiting.keys():
                write_deaths(folder, shard, [])
        raise
    for task in alone:
        yield from _make_alone(folder, context, task)


def _make_alone(folder: OutFolder, context: RunContext, task: ShardTask) -> Iterator[ShardReport]:
    """Make a shard with no other worker running, without the sources that kill their workers."""
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    while True:
        deaths = read_deaths(folder, task.shard)
        if len(deadly_sources(task, deaths)) == len(task.sources):
            yield make_and_commit(context, task)  # reads no source
            return
        try:
            # n_jobs=1 would make the coordinator do the work, and die
            yield from run_pool(partial(make_and_commit, context), [task], n_jobs=2)
            return
        except TerminatedWorkerError:
            count_death(folder, task, deaths)
        except BaseException:
            with suppress(OSError, MachineError):
                write_deaths(folder, task.shard, deaths)
            raise


def run_pool(work: Callable[[Any], Any], tasks: Iterable[Any], n_jobs: int, in_order: bool = False) -> Iterator[Any]:
    """Yield the results of a pool of workers as they come, or in order; TerminatedWorkerError if a worker dies."""
    from joblib import Parallel, delayed

    order = "generator" if in_order else "generator_unordered"
    parallel = Parallel(n_jobs=n_jobs, return_as=order, batch_size=1, pre_dispatch="2*n_jobs")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*tasks.*", module="joblib")  # tasks cancelled by an interrupt
        # where psutil is installed, loky replaces a worker that keeps 300 MB of freed memory, and no work is lost
        warnings.filterwarnings("ignore", message="A worker stopped", module="joblib")
        with interrupts_ignored():
            start_tracker()
            results = parallel(delayed(_work_in)(Path.cwd(), work, task) for task in tasks)
        with closing(results):
            yield from results


def _work_in(folder: Path, work: Callable[[Any], Any], task: Any) -> Any:
    """Call ``work`` in a folder, because loky reuses workers that an earlier run started in another folder."""
    os.chdir(folder)
    return work(task)


@contextmanager
def interrupts_ignored() -> Iterator[None]:
    """Ignore SIGINT and SIGHUP while workers and loky's tracker start.

    The new processes inherit this, so that only the coordinator answers Ctrl-C and the loss of its terminal. Blocking
    the signals instead has no lasting effect, because the tracker unblocks them when it starts.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGHUP") if hasattr(signal, name)]  # Windows has no SIGHUP
    before = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def start_tracker() -> None:
    """Start loky's tracker process without stderr, where it prints tracebacks after the death of a worker."""
    from joblib.externals.loky.backend.resource_tracker import ensure_running

    with ExitStack() as stack:
        with suppress(OSError):  # stderr is closed
            stderr = os.dup(2)
            stack.callback(os.close, stderr)
            stack.callback(os.dup2, stderr, 2)
            with Path(os.devnull).open("wb") as nothing:
                os.dup2(nothing.fileno(), 2)
        ensure_running()


def effective_jobs(n_jobs: int, tasks: int) -> int:
    """Number of workers to start: -1 means all cores that this process may use, and there are no more than tasks."""
    return max(1, min(usable_cores() if n_jobs == -1 else n_jobs, tasks))
