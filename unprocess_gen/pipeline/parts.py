"""Generate a dataset in parts that share only the output folder: prepare, part, status and merge.

    prepare    records settings, listing and the number of parts (`frozen_run`); takes the lock
    part       generates and commits the shards of one part; takes no lock, so parts can run at the same time
    status     lists the parts that are left
    merge      writes manifest and dataset.json when all parts are done; takes the lock

Of S shards, part K of N contains those from K·S // N up to, but not including, (K + 1)·S // N.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import replace
from typing import NamedTuple

from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml
from unprocess_gen.config.settings import settings_of
from unprocess_gen.core.errors import RESUME, ConfigError, MachineError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.paths import any_path
from unprocess_gen.dataset.columns import columns_of
from unprocess_gen.pipeline.executors.local import effective_jobs, own_cores, run_tasks
from unprocess_gen.pipeline.frozen_run import FrozenRun, freeze_run, read_plan, recorded_plan
from unprocess_gen.pipeline.generate import Summary, begin, dataset_json_facts, follow, images_in
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.pipeline.run import Run, resolve
from unprocess_gen.pipeline.run_records import ShardRecords
from unprocess_gen.pipeline.storage import Storage
from unprocess_gen.pipeline.tasks import RunContext
from unprocess_gen.pipeline.workspace import Workspace


class PartMade(NamedTuple):
    """Describe what one call of `make_part` made.

    Attributes
    ----------
    parts : int
        Number of all parts.
    shards, made : int
        Shards of the part, and those that this call made.
    rows : int
        Rows of the shards that this call made.
    seconds : float
        Time that it took.
    """

    parts: int
    shards: int
    made: int
    rows: int
    seconds: float


class PartsStatus(NamedTuple):
    """Hold which parts of a run are left.

    Attributes
    ----------
    parts, shards : int
        Number of all parts and shards.
    committed : int
        Number of shards that have records.
    left : tuple of int
        Parts of which a shard has no record, ascending.
    complete : bool
        Whether the dataset is finished.
    """

    parts: int
    shards: int
    committed: int
    left: tuple[int, ...]
    complete: bool = False


def shards_of_part(part: int, parts: int, shards: int) -> range:
    """Return the shards of one part."""
    return range(part * shards // parts, (part + 1) * shards // parts)


def prepare(config: Config, parts: int) -> Run | None:
    """Freeze a run in parts, None if the dataset is finished; a second call with the same settings changes nothing.

    Raises ConfigError as `generate`; if there are fewer shards than parts; if the run was prepared with another number
    of parts, or begun by another version; LockedError, DamageError, MachineError as `generate`.
    """
    run = resolve(config)
    shards = len(run.tasks())
    if parts > shards:
        raise ConfigError(
            f"parts={parts}: this dataset has {shards} shard{'s' * (shards != 1)}; expected 1 to {shards}; "
            "lower parts or output.pairs_per_shard"
        )
    with Workspace(config.out, dataset_yaml(run.config)) as workspace:
        workspace.open()
        if workspace.is_complete():
            workspace.check_complete(run.sources)
            return None
        plan = recorded_plan(workspace.storage)
        if plan is not None and plan.parts != parts:
            raise ConfigError(
                f"parts={parts}: {config.out} was prepared with parts={plan.parts}; expected that number; choose "
                "another out"
            )
        begin(workspace, run)
        freeze_run(workspace, run, parts)
    return run


def make_part(out: str, part: int, n_jobs: int | None = None, root: str | None = None) -> PartMade | None:
    """Make and commit the shards of one part that are not committed yet.

    Raises ConfigError if ``out`` was not prepared, or by another version or with other settings; if there is no such
    part, or ``n_jobs`` is not allowed; MachineError if the self-test fails, a file cannot be read or written, or a
    source was changed or deleted.
    """
    started = time.monotonic()
    if n_jobs is not None:
        settings_of(Config)["n_jobs"].check("n_jobs", n_jobs)
    if _is_complete(out):
        return None
    run = FrozenRun(out, root)
    parts = run.plan.parts
    if not 0 <= part < parts:
        raise ConfigError(f"part {part}: {out} has {parts} parts; expected 0 to {parts - 1}")
    wanted = shards_of_part(part, parts, run.plan.shards)
    with closing(run.storage), machine_errors(any_path(out), RESUME):
        done = run.records.committed(wanted)
        todo = [run.task(shard) for shard in wanted if shard not in done]
        jobs = effective_jobs(run.plan.n_jobs if n_jobs is None else n_jobs, len(todo))
        scratch, spare = str(run.storage.scratch), jobs < own_cores()
        with Progress(images_in(todo), 0, f"part {part} of {parts}") as progress:
            context = RunContext(run.settings, scratch, os.getpid(), core_to_spare=spare, counts_deaths=True)
            progress.watch(context)
            rows = follow(run_tasks(context, todo, jobs), progress).rows
    return PartMade(parts, len(wanted), len(todo), rows, time.monotonic() - started)


def parts_status(out: str) -> PartsStatus:
    """Find the parts of a prepared run that are left.

    Raises ConfigError if ``out`` was not prepared; DamageError if a record of the run cannot be read.
    """
    storage = Storage(out)
    if _is_complete(out):
        return PartsStatus(0, 0, 0, (), complete=True)
    plan = read_plan(storage)
    parts = plan.parts
    recorded = ShardRecords(storage).recorded(range(plan.shards))
    left = (part for part in range(parts) if not recorded.issuperset(shards_of_part(part, parts, plan.shards)))
    return PartsStatus(parts, plan.shards, len(recorded), tuple(left))


def merge(out: str) -> tuple[Summary, int]:
    """Write manifest and ``dataset.json`` of a run whose parts are done.

    Raises ConfigError if ``out`` was not prepared, or by another version or with other settings; MachineError if parts
    are left, which the message names; nothing is written then. If a file cannot be read or written; LockedError if a
    run holds the folder.
    """
    started = time.monotonic()
    status = parts_status(out)
    if status.complete:
        facts = Workspace(out, "").facts()
        assert facts is not None
        return Summary.of(out, facts, started), 0
    if status.left:
        raise MachineError(
            f"merge: {out}: parts left: {left_text(status.left)} (of {status.parts}), "
            f"{status.shards - status.committed} of {status.shards} shards; run gen-dataset part {out} K for each, "
            "then merge again; nothing was written"
        )
    run = FrozenRun(out)
    settings = PairSettings(run.config)
    with suppress(ConfigError, MachineError):  # parts may be merged where the dark frames are not
        settings = run.settings
    with Workspace(out, run.storage.read("config.yaml")) as workspace:
        workspace.storage.hold()
        plan, parts = run.plan, run.plan.parts
        facts = workspace.finish(
            plan.shards,
            columns_of(run.config),
            lambda tally: dataset_json_facts(settings, plan.not_matched, plan.skipped_links, tally, {"parts": parts}),
        )
    summary = Summary.of(out, facts, started)
    return replace(summary, made=summary.rows), plan.max_failed


def left_text(parts: Sequence[int]) -> str:
    """Return numbers as ranges, as batch systems take them: ``3,7-9``."""
    runs: list[tuple[int, int]] = []
    for part in parts:
        if runs and runs[-1][1] == part - 1:
            runs[-1] = runs[-1][0], part
        else:
            runs.append((part, part))
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)


def _is_complete(out: str) -> bool:
    return Workspace(out, "").is_complete()
