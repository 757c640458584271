"""Make a dataset: plan the shards, let workers make them, commit them in order, finish.

A shard is the unit of work, retry and completion. Workers (loky processes, one shard a task) write aside and return
rows; the coordinator commits in shard order, so the folder looks the same whatever finished first. Results come through
joblib's ordered generator: at most two shards a worker wait for an earlier one. This is the only room that names
joblib.

A worker whose coordinator is gone ends within a second (`_end_with_parent`): otherwise loky would keep it, and its
memory, for minutes. When a worker dies (out of memory, most likely) loky ends all of them, within half a second. Each
shard that was being made then is tried again alone; where its worker dies again, the photograph it was at has killed
twice: its shard is given up for this run, with provisional rows ``worker_died``, and the next run tries it again. With
one job the coordinator is the worker, and dies itself.
"""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tqdm import tqdm

from unprocess_gen.config.interpretation import patch_rule
from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml, source_kind
from unprocess_gen.core.errors import MachineError, SourceError
from unprocess_gen.core.files import array_xxh3, machine_error
from unprocess_gen.core.types import Counts, Pair, Patch, Plan, Row, Source, Srgb
from unprocess_gen.dataset.keys import group_by_image, pair_key, patch_key
from unprocess_gen.dataset.manifest import failed_row, pair_row, row_json
from unprocess_gen.dataset.shards import CLEAN, ShardWriter, noisy_member, shard_name
from unprocess_gen.pipeline.workspace import ShardResult, Workspace
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import plan_pairs
from unprocess_gen.simulation import self_test as selftest
from unprocess_gen.simulation.pair import make_pairs
from unprocess_gen.sources.listing import source_file
from unprocess_gen.sources.loader import list_photographs, load_source
from unprocess_gen.sources.patches import crop_patch, list_patches
from unprocess_gen.sources.video.decode import is_installed

PACKAGES = (
    *("unprocess_gen", "numpy", "opencv-python-headless", "numba", "llvmlite", "joblib", "xxhash"),
    *(("av",) if is_installed() else ()),
)
PARENT_POLL_S = 0.5
COMPILING_POLL_S = 0.1
PLAIN_LINE_S = 5.0
"""Seconds between progress lines where there is no terminal."""
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""What glibc's mallopt goes by (malloc.h)."""
KEPT_BYTES = 2**29
"""Freed memory that a worker keeps: what an image of 50 megapixels takes."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What a run came to: rows by status, how many were made just now, and where.

    ``sites`` holds the sum of width x height, and of each of the manifest's counts (`COUNTS`).
    """

    out: Path
    pairs: int
    failed: dict[str, int]
    sites: dict[str, int]
    shards: int
    bytes: int
    made: int
    seconds: float

    @property
    def rows(self) -> int:
        """Pairs and failures together."""
        return self.pairs + sum(self.failed.values())


@dataclass(frozen=True, slots=True)
class ShardTask:
    """One shard's worth of work, as it travels to a worker."""

    shard: int
    sources: tuple[Source, ...]


@dataclass(frozen=True, slots=True)
class RunContext:
    """What every task of a run shares: the settings, where to write aside, and whose run it is.

    ``core_to_spare``: there are more cores than workers, so that each can have a thread that writes.
    """

    config: Config
    tmp: str
    coordinator_pid: int
    core_to_spare: bool = False


def generate(config: Config) -> Summary:
    """Make, or go on making, the dataset that ``config`` describes; ``config`` has passed `config.check`.

    Raises ConfigError, LockedError, DamageError and MachineError as `workspace.Workspace` does.
    """
    started = time.monotonic()
    listing = list_photographs(config.source)
    with Workspace(Path(config.out), dataset_yaml(config)) as workspace:
        workspace.open()
        if workspace.complete:
            facts = workspace.check_complete(listing.sources)
            return _summary(workspace.out, facts, made=0, started=started)
        workspace.begin(listing.sources)
        tasks = shard_tasks(listing.sources, config.output.pairs_per_shard)
        done = set(workspace.committed(len(tasks)))
        todo = [task for task in tasks if task.shard not in done]
        n_jobs = effective_jobs(config.n_jobs, len(todo))
        bench = RunContext(config, str(workspace.tmp), os.getpid(), core_to_spare=n_jobs < _own_cores())
        given_up: dict[int, ShardResult] = {}
        warned, rows_made = False, 0
        with Progress(len(listing.sources), sum(len(task.sources) for task in tasks if task.shard in done)) as progress:
            progress.say_compiling_once(_compiling_path(bench))
            for made in run_tasks(bench, todo, n_jobs):
                if made.killer is None:
                    workspace.commit(made)
                else:
                    given_up[made.shard] = made
                    print(f"gen-dataset: {made.killer}: its worker died twice; run again to retry it", file=sys.stderr)
                if made.self_test and not warned:
                    warned = True
                    print(f"gen-dataset: the self-test failed: {made.self_test}; going on as told", file=sys.stderr)
                rows_made += len(made.rows)
                progress.advance(made.rows)
        seconds = time.monotonic() - started
        try:
            pairs, failed, sites = tally(workspace.all_rows(len(tasks), given_up))
        except OSError as error:
            raise machine_error(error, workspace.out) from error
        facts = workspace.finish(
            len(tasks),
            given_up,
            {
                "pairs": pairs,
                "failed": failed,
                "sites": sites,
                "not_matched": listing.not_matched,
                "skipped_links": listing.skipped_links,
                "source": {"kind": source_kind(config), "root": _absolute(config.source.root)},
                "run": {"seconds": round(seconds, 3), "n_jobs": n_jobs, "shards_made": len(todo), **machine()},
                "versions": {package: version(package) for package in PACKAGES},
            },
        )
    return _summary(Path(config.out), facts, made=rows_made, started=started)


def shard_tasks(sources: Sequence[Source], pairs_per_shard: int) -> list[ShardTask]:
    """Split the listing: shard s holds source indices [s·N, (s+1)·N)."""
    starts = range(0, len(sources), pairs_per_shard)
    return [ShardTask(shard, tuple(sources[at : at + pairs_per_shard])) for shard, at in enumerate(starts)]


def effective_jobs(n_jobs: int, tasks: int) -> int:
    """Return how many workers to use: -1 stands for the cores this process may use, never more than tasks."""
    if n_jobs == -1:
        from joblib import cpu_count

        n_jobs = cpu_count()
    return max(1, min(n_jobs, tasks))


def _own_cores() -> int:
    """Return the cores this process may use, whatever share of their time its container grants."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_tasks(bench: RunContext, tasks: Sequence[ShardTask], n_jobs: int) -> Iterator[ShardResult]:
    """Yield the shards as they are made: in order, but for those that are tried again after a worker died.

    One job needs no joblib, whose import takes 0.1 s and 8 MB.
    """
    if n_jobs == 1:
        yield from (make_shard(bench, task) for task in tasks)
        return
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    waiting = list(tasks)
    while waiting:
        done: set[int] = set()
        try:
            for made in _run_pool(bench, waiting, n_jobs):
                done.add(made.shard)
                yield made
            return
        except TerminatedWorkerError:
            waiting = [task for task in waiting if task.shard not in done]
        suspects = [task for task in waiting if _busy_path(bench, task).exists()]
        for task in suspects or waiting[:n_jobs]:
            yield from _run_alone(bench, task)
            waiting.remove(task)


def _run_alone(bench: RunContext, task: ShardTask) -> Iterator[ShardResult]:
    """Yield a shard that is made by a worker with nobody beside it; given up where that worker dies too."""
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    try:
        yield from _run_pool(bench, [task], n_jobs=2)  # with one job it would be the coordinator that dies
    except TerminatedWorkerError:
        killer = next((one for one in task.sources if str(one.index) == _read_busy(bench, task)), task.sources[0])
        rows = (failed_row(one, None, task.shard, bench.config.seed, "worker_died") for one in task.sources)
        yield ShardResult(task.shard, None, 0, None, tuple(rows), killer=killer.name)


def _run_pool(bench: RunContext, tasks: Sequence[ShardTask], n_jobs: int) -> Iterator[ShardResult]:
    """Yield the shards in order as they are made; TerminatedWorkerError where a worker dies."""
    from joblib import Parallel, delayed

    parallel = Parallel(n_jobs=n_jobs, return_as="generator", batch_size=1, pre_dispatch="2*n_jobs")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*tasks.*", module="joblib")  # of what an interrupt cancelled
        with _interrupts_ignored():
            results = parallel(delayed(make_shard)(bench, task) for task in tasks)
        with closing(results):
            yield from results


def _busy_path(bench: RunContext, task: ShardTask) -> Path:
    """Return the file that names the source which a worker is at, while it makes a shard."""
    return Path(bench.tmp) / f"{task.shard}.busy"


def _read_busy(bench: RunContext, task: ShardTask) -> str:
    try:
        return _busy_path(bench, task).read_text()
    except FileNotFoundError:
        return ""


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore SIGINT while workers start: they inherit that, so that Ctrl-C is the coordinator's alone to answer.

    Blocking it instead does not last: loky's resource tracker unblocks it on its way.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


# --------------------------------------------------------------------------------------------------- in the workers


def make_shard(bench: RunContext, task: ShardTask) -> ShardResult:
    """Make one shard aside and return its rows; MachineError if the disk or the self-test fails."""
    _settle(bench.coordinator_pid)
    failed: dict[str, None] = {}
    path = Path(bench.tmp) / f"{shard_name(task.shard)}.{os.getpid()}.{time.monotonic_ns()}"
    try:
        with ShardWriter(path, beside=bench.core_to_spare) as writer:
            rows = tuple(_make_rows(bench, task, writer, failed))
        _busy_path(bench, task).unlink(missing_ok=True)
        if any(row["status"] == "ok" for row in rows):
            return ShardResult(
                task.shard, str(path), writer.bytes, writer.sha256, rows, self_test="; ".join(failed) or None
            )
        path.unlink()
        return ShardResult(task.shard, None, 0, None, rows)
    except MemoryError as error:
        if os.getpid() != bench.coordinator_pid:
            os._exit(1)  # as if the kernel had ended us: the shard is tried again with nobody beside it
        name = next((one.name for one in task.sources if str(one.index) == _read_busy(bench, task)), "")
        raise MachineError(f"{name}: out of memory; what is committed is kept, run again to go on") from error
    except OSError as error:
        for left in (path, _busy_path(bench, task)):
            with suppress(OSError):
                left.unlink()
        raise machine_error(error, Path(bench.tmp)) from error


def _make_rows(bench: RunContext, task: ShardTask, writer: ShardWriter, failed: dict[str, None]) -> Iterator[Row]:
    for source in task.sources:
        _busy_path(bench, task).write_text(str(source.index))
        yield from make_image(bench, task.shard, source, writer, failed)


def make_image(
    bench: RunContext, shard: int, source: Source, writer: ShardWriter, failed: dict[str, None]
) -> list[Row]:
    """Append one image to a shard, whole or patch by patch, and return its rows.

    Puts what is wrong with this process, where it was told to go on with that, into ``failed``, each once.
    """
    config = bench.config
    try:
        sha256, photograph = load_source(config.source, source, config.output.layout)
    except SourceError as error:
        if error.reason == "unreadable" and source.reason is None and not _is_there(config, source):
            raise MachineError(
                f"source {source.name} is gone since it was listed; what is committed is kept, run again with it back"
            ) from error
        return [failed_row(source, error.sha256, shard, config.seed, error.reason)]
    law = patch_rule(config.source)
    facts = facts_for(config, photograph.srgb, source.frames)
    plans = plan_pairs(config, *source.stream_identity(sha256), facts, source.frame)
    failed |= dict.fromkeys(_self_test(bench, plans))
    rows: list[Row] = []
    height, width = photograph.srgb.shape[:2]
    for patch in list_patches(law, plans[0].stream_key, height, width, config.output.layout):
        key = patch_key(source.index, patch, several=law is not None)
        some: list[Row] = []
        for plan, pair, digests in _add_frames(writer, key, crop_patch(photograph.srgb, patch), patch, plans):
            row_key = pair_key(key, plan, several=len(plans) > 1)
            some.append(pair_row(row_key, source, sha256, photograph.orientation, shard, plan, pair, digests, patch))
        writer.add_rows(key, row_json(some))
        rows += some
    return rows


def _add_frames(
    writer: ShardWriter, key: str, srgb: Srgb, patch: Patch, plans: Sequence[Plan]
) -> Iterator[tuple[Plan, Pair, tuple[str, str]]]:
    """Append a patch's clean frame and all of its noisy ones; yield each pair as it is made, with its digests."""
    clean_xxh3 = ""
    for plan, pair in zip(plans, make_pairs(srgb, plans, patch.origin), strict=True):
        if plan is plans[0]:
            clean_xxh3 = array_xxh3(pair.clean)
            writer.add_frame(key, CLEAN, pair.clean)
        writer.add_frame(key, noisy_member(plan.level, plan.draw), pair.noisy)
        yield plan, pair, (clean_xxh3, array_xxh3(pair.noisy))


def _is_there(config: Config, source: Source) -> bool:
    return Path(source_file(config.source.root or "", source.path)).exists()


def _settle(coordinator_pid: int) -> None:
    """Keep OpenCV to one thread, and memory; keep a worker from answering Ctrl-C and from outliving its coordinator."""
    import cv2

    cv2.setNumThreads(1)
    _keep_memory()
    if os.getpid() != coordinator_pid and not any(thread.name == WATCHDOG for thread in threading.enumerate()):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        threading.Thread(target=_end_with_parent, args=(coordinator_pid,), name=WATCHDOG, daemon=True).start()


def _keep_memory() -> None:
    """Have freed memory kept for the next image, up to `KEPT_BYTES` of it.

    By itself glibc gives large arrays back at once, and the system hands them out again page by page, cleared: a tenth
    of a run. Other C libraries have their own way.
    """
    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)


def _self_test(bench: RunContext, plans: Sequence[Plan]) -> list[str]:
    """Prove the kernels that an image's plans need, and no other, for each takes seconds to compile.

    Returns what is wrong with this process; MachineError unless told to go on with it.
    """
    failed: list[str] = []
    for kernels in dict.fromkeys(map(selftest.kernels, plans)):
        if not selftest.are_compiled(kernels):
            _compiling_path(bench).touch()
        if bench.config.self_test == "stop":
            selftest.check(kernels, ", or say self_test=go_on")
        failed += selftest.failures(kernels)
    return failed


def _compiling_path(bench: RunContext) -> Path:
    """Return the file that is there as soon as a worker compiles kernels."""
    return Path(bench.tmp) / "compiling"


WATCHDOG = "unprocess_gen watchdog"


def _end_with_parent(coordinator_pid: int) -> None:
    while os.getppid() == coordinator_pid:
        time.sleep(PARENT_POLL_S)
    os._exit(1)


# ------------------------------------------------------------------------------------------------------- reporting


class Progress:
    """A bar over images on a terminal, a plain line every few seconds elsewhere; both on stderr."""

    def __init__(self, total: int, done: int) -> None:
        self._failed = 0
        self._total, self._done, self._first = total, done, done
        self._started = self._last_line = time.monotonic()
        terminal = sys.stderr.isatty()
        self._bar = tqdm(total=total, initial=done, unit="image", file=sys.stderr, disable=not terminal)
        self._plain = not terminal
        self._over = threading.Event()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._bar.close()

    def say_compiling_once(self, marker: Path) -> None:
        """Say why nothing happens, as soon as a file is there: which kernels a run needs only its workers know."""
        threading.Thread(target=self._say_compiling, args=(marker,), daemon=True).start()

    def _say_compiling(self, marker: Path) -> None:
        while not marker.exists():
            if self._over.wait(COMPILING_POLL_S):
                return
        self._bar.set_postfix_str("compiling the kernels, once on a machine")
        if self._plain:
            print(
                f"gen-dataset: {self._done}/{self._total} images, compiling kernels: 5 to 20 seconds, once on a "
                "machine",
                file=sys.stderr,
                flush=True,
            )

    def advance(self, rows: Iterable[Row]) -> None:
        """Count the images of a committed shard."""
        statuses = [some[0]["status"] for some in group_by_image(rows)]
        self._failed += statuses.count("failed")
        self._done += len(statuses)
        self._bar.set_postfix(failed=self._failed, refresh=False)
        self._bar.update(len(statuses))
        now = time.monotonic()
        if self._plain and (now - self._last_line >= PLAIN_LINE_S or self._done == self._total):
            self._last_line = now
            rate = (self._done - self._first) / max(now - self._started, 1e-9)
            left = (self._total - self._done) / rate
            print(
                f"gen-dataset: {self._done}/{self._total} images, {rate:.1f} images/s, {self._failed} failed, "
                f"{left:.0f} s left",
                file=sys.stderr,
                flush=True,
            )


COUNTS = tuple(field.name for field in fields(Counts))


def tally(rows: Iterable[Row]) -> tuple[int, dict[str, int], dict[str, int]]:
    """Return the pairs, how many rows failed, by reason, and how many sites of the pairs met which limit."""
    pairs = 0
    reasons: dict[str, int] = {}
    sites = dict.fromkeys(("all", *COUNTS), 0)
    for row in rows:
        if row["status"] != "ok":
            reasons[str(row["reason"])] = reasons.get(str(row["reason"]), 0) + 1
            continue
        pairs += 1
        sites["all"] += int(row["width"] or 0) * int(row["height"] or 0)
        for name in COUNTS:
            sites[name] += int(row[name] or 0)
    return pairs, dict(sorted(reasons.items())), sites


def machine() -> dict[str, Any]:
    """Return what this machine calls itself; for ``dataset.json``, which no byte of the data depends on."""
    return {"host": platform.node(), "platform": platform.platform(), "python": platform.python_version()}


def _absolute(root: str | None) -> str | None:
    return None if root is None else os.path.abspath(root)


def _summary(out: Path, facts: dict[str, Any], made: int, started: float) -> Summary:
    return Summary(
        out=out,
        pairs=facts["pairs"],
        failed=facts["failed"],
        sites=facts["sites"],
        shards=len(facts["shards"]),
        bytes=sum(entry["bytes"] for entry in facts["shards"]),
        made=made,
        seconds=time.monotonic() - started,
    )
