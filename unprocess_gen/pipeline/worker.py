"""Make one shard: decode its sources, simulate their pairs, write a temporary tar file, commit it.

A worker is a process of the pool, the coordinator itself if ``n_jobs=1``, or a process of a cluster. A process of the
pool exits within a second once its coordinator has died (`_exit_with_parent`): loky alone would keep the process, and
its memory, for minutes.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import RESUME, MachineError, SourceError
from unprocess_gen.core.files import array_xxh3, machine_error, machine_errors
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.keys import pair_key
from unprocess_gen.dataset.row import columns_of, failed_row, has_frames, pair_row, row_json
from unprocess_gen.dataset.shards import ShardWriter, shard_name, targets_cell
from unprocess_gen.pipeline.deaths import counted_attempt
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.pairs import PlannedImage, plan_pixels
from unprocess_gen.pipeline.tasks import RunContext, ShardReport, ShardResult, ShardTask, commit_shard
from unprocess_gen.planning.source_noise import source_noise_dn
from unprocess_gen.simulation import self_test
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.reading import ReadFile, read_bytes, reading_ahead, source_file

PARENT_POLL_S = 0.5
WATCHDOG = "unprocess_gen watchdog"
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Parameters of glibc's mallopt (malloc.h)."""
KEPT_BYTES = 2**29
"""Freed memory that a worker keeps: the working memory of one 50-megapixel image."""


def make_and_commit(context: RunContext, task: ShardTask) -> ShardReport:
    """Make one shard and commit it; raise MachineError if disk, memory or self-test fail."""
    folder = OutFolder(context.config.out)
    with machine_errors(folder.path, RESUME), counted_attempt(folder, task) as (deadly, mark):
        return commit_shard(folder, make_shard(context, task, deadly, mark), columns_of(context.config))


def make_shard(
    context: RunContext,
    task: ShardTask,
    deadly: Sequence[Source] = (),
    mark: Callable[[Source], None] = lambda source: None,
) -> ShardResult:
    """Write one shard to a temporary file; raise MachineError if disk, memory or self-test fail.

    ``deadly`` sources are not read: they get the row ``worker_died``. ``mark`` is called with each other one before.
    """
    _prepare_process(context.coordinator_pid)
    made = ShardResult(ShardReport(task.shard, killers=[source.name for source in deadly]))
    busy, source = context.busy_path(task.shard), task.sources[0]
    path = Path(context.scratch) / f"{shard_name(task.shard)}.{os.getpid()}.{time.monotonic_ns()}"
    try:
        with (
            _one_opencv_thread(),
            ShardWriter(path, threaded=context.core_to_spare) as writer,
            reading_ahead(context.config.source.place, read_bytes, task.sources) as read,
        ):
            for source in task.sources:
                if source in deadly:
                    detail = f"four workers died at {source.name}; its shard is retried by the next run"
                    made.rows.append(failed_row(source, None, task.shard, context.config.seed, "worker_died", detail))
                    continue
                busy.write_text(str(source.index))
                mark(source)
                made.rows += make_image(context, made, source, writer, read)
        busy.unlink(missing_ok=True)
        if any(map(has_frames, made.rows)):
            made.path, made.bytes, made.sha256 = str(path), writer.bytes, writer.sha256
        else:
            path.unlink()
        return made
    except MemoryError as error:
        if os.getpid() != context.coordinator_pid:
            os._exit(1)  # same path as an OOM kill: the coordinator retries the shard alone
        raise MachineError(f"source {source.name}: out of memory; {RESUME}") from error
    except OSError as error:
        for unfinished in (path, busy):
            with suppress(OSError):
                unfinished.unlink()
        raise machine_error(error, Path(context.scratch), RESUME) from error


def make_image(
    context: RunContext, made: ShardResult, source: Source, writer: ShardWriter, read: ReadFile = read_bytes
) -> list[Row]:
    """Append the samples of one image to a shard, and return its rows; notes and times go to ``made``."""
    config, shard, timed = context.config, made.report.shard, made.report.times.timed
    try:
        with timed("decode_s"):
            sha256, photograph = load_source(config.source, source, config.output.layout, read)
    except SourceError as error:
        _check_not_deleted(config, source, error)
        return [failed_row(source, error.sha256, shard, config.seed, error.reason, error.text, error.status)]
    made.report.warnings += [f"{source.name} {photograph.note}"] if photograph.note else []
    with timed("simulate_s"):
        image = plan_pixels(context.settings, photograph, source, sha256)
        noise_dn = None if config.source.place is None else source_noise_dn(photograph.srgb, image.plans[0])
    if config.output.frames:
        _test_kernels(context, image, made)
    identity = source, sha256, photograph.orientation, shard
    rows = list[Row]()
    for made_of in image.samples():
        patch, key, sample = made_of.patch, made_of.key(source.index, config), list[Row]()
        pairs = made_of.pairs() if config.output.frames else itertools.repeat(None)
        for plan in made_of.plans:
            row_key = pair_key(key, plan.place, several=len(made_of.plans) > 1)
            with timed("simulate_s"):
                pair = next(pairs)
            if pair is None:
                sample.append(pair_row(row_key, *identity, plan, None, ("", ""), patch, noise_dn, photograph.note))
                continue
            if not sample:
                with timed("simulate_s"):
                    targets = made_of.targets(config.output.targets, pair)
                clean_xxh3, stored_targets = array_xxh3(pair.clean), targets_cell(targets)
            row = pair_row(
                row_key, *identity, plan, pair, (clean_xxh3, array_xxh3(pair.noisy)), patch, noise_dn, photograph.note
            )
            row = {**row, "targets": stored_targets}
            writer.add_pair(row, {"clean": pair.clean, "noisy": pair.noisy, **targets}, is_first=not sample)
            sample.append(row)
        if config.output.frames:
            writer.add_rows(key, row_json(sample))
        rows += sample
    return rows


def _test_kernels(context: RunContext, image: PlannedImage, made: ShardResult) -> None:
    """Test the kernels that an image needs, no others, because each set takes seconds to compile.

    MachineError if they fail and ``self_test=stop``; else the failures go to ``made``.
    """
    config = context.config
    used = image.plans, config.output.targets
    for kernels in self_test.kernels(*used):
        if not self_test.are_compiled(kernels):
            context.compiling_path.touch()
        made.report.self_test |= dict.fromkeys(self_test.failures(kernels))
    if made.report.self_test and config.self_test == "stop":
        self_test.check(*used, ", or set self_test=go_on")


def _check_not_deleted(config: Config, source: Source, error: SourceError) -> None:
    """Raise MachineError if a source cannot be read because it was deleted after the listing."""
    if error.reason != "unreadable" or source.reason is not None:
        return
    if not source_file(config.source.place or "", source.path).exists():
        raise MachineError(
            f"source.root={config.source.place}: {source.name} was deleted or moved after listing; expected "
            "the listed files; restore it and run the same command again"
        ) from error


def _prepare_process(coordinator_pid: int | None) -> None:
    """Keep freed memory; in a process of the pool also ignore Ctrl-C and start the watchdog."""
    keep_memory()
    if coordinator_pid is None or coordinator_pid == os.getpid():
        return
    if not any(thread.name == WATCHDOG for thread in threading.enumerate()):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if sys.platform != "win32":  # there, os.getppid does not change when the parent process ends
            threading.Thread(target=_exit_with_parent, args=(coordinator_pid,), name=WATCHDOG, daemon=True).start()


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    """Limit OpenCV to one thread: workers use all cores already."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def keep_memory() -> None:
    """Keep up to `KEPT_BYTES` of freed memory in this process for the next image.

    Without this call a run takes 10 % longer: glibc returns large arrays to the system after each image, and the system
    zeroes their pages again. Other C libraries lack mallopt and are left as they are.
    """
    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)


def _exit_with_parent(coordinator_pid: int) -> None:
    while os.getppid() == coordinator_pid:
        time.sleep(PARENT_POLL_S)
    os._exit(1)
