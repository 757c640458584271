"""Run shard tasks in worker processes of this machine; the only module that uses joblib.

What happens when a worker dies, usually because the system is out of memory:

1. loky stops all workers of the pool within half a second and raises TerminatedWorkerError in `run_tasks`.
2. `run_tasks` retries each shard that was in progress alone (`_run_alone`), then continues with a new pool.
3. If the worker of such a shard dies again, the shard's rows get the provisional reason ``worker_died``; a later run
   retries the shard.

If the coordinator dies, its workers exit by themselves (`worker._exit_with_parent`). With ``n_jobs=1`` the coordinator
does the work, so killing it ends the run; a rerun resumes.

Workers commit their shards themselves and report counts, so a slow shard delays no other one.
"""

from __future__ import annotations

import os
import signal
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

from unprocess_gen.pipeline.tasks import RunContext, ShardReport, ShardTask
from unprocess_gen.pipeline.worker import commit_provisional, make_and_commit


def effective_jobs(n_jobs: int, tasks: int) -> int:
    """Number of workers to start: -1 means all cores that this process may use, and there are no more than tasks."""
    if tasks <= 1:
        return 1  # without joblib, whose import takes 0.15 s
    if n_jobs == -1:
        from joblib import cpu_count

        n_jobs = cpu_count()
    return min(n_jobs, tasks)


def own_cores() -> int:
    """Return the number of cores this process may use, regardless of its container's share of CPU time."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_tasks(context: RunContext, tasks: Sequence[ShardTask], n_jobs: int) -> Iterator[ShardReport]:
    """Make and commit the shards of all tasks; yield a report of each as soon as it is committed.

    With one job joblib is not imported (0.1 s, 8 MB) and the coordinator makes the shards.
    """
    if n_jobs == 1:
        yield from (make_and_commit(context, task) for task in tasks)
        return
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    waiting = list(tasks)
    while waiting:
        done: set[int] = set()
        try:
            for result in _run_pool(context, waiting, n_jobs):
                done.add(result.shard)
                yield result
            return
        except TerminatedWorkerError:
            waiting = [task for task in waiting if task.shard not in done]
        in_progress = [task for task in waiting if task.busy_path(context).exists()]
        for task in in_progress or waiting[:n_jobs]:
            yield from _run_alone(context, task)
            waiting.remove(task)


def _run_alone(context: RunContext, task: ShardTask) -> Iterator[ShardReport]:
    """Retry one shard with no other worker running; if the worker dies again, commit provisional rows."""
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    try:
        yield from _run_pool(context, [task], n_jobs=2)  # n_jobs=1 would make the coordinator do the work, and die
    except TerminatedWorkerError:
        killer = task.busy_source(context) or task.sources[0]
        yield commit_provisional(context, task, killer, deaths=2)


def _run_pool(context: RunContext, tasks: Sequence[ShardTask], n_jobs: int) -> Iterator[ShardReport]:
    """Yield the reports of a pool of workers as they come; raise TerminatedWorkerError if a worker dies."""
    from joblib import Parallel, delayed

    parallel = Parallel(n_jobs=n_jobs, return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*tasks.*", module="joblib")  # tasks cancelled by an interrupt
        # where psutil is installed, loky replaces a worker that keeps 300 MB of freed memory, and no work is lost
        warnings.filterwarnings("ignore", message="A worker stopped", module="joblib")
        with interrupts_ignored():
            start_tracker()
            results = parallel(delayed(_make_in)(Path.cwd(), context, task) for task in tasks)
        with closing(results):
            yield from results


def _make_in(folder: Path, context: RunContext, task: ShardTask) -> ShardReport:
    """Make and commit a shard in a folder, because loky keeps workers that an earlier run started in another one."""
    os.chdir(folder)
    return make_and_commit(context, task)


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
