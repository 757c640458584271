"""Generate a dataset in parts that share only the output folder: prepare, part, status and merge.

    prepare    records settings, listing, canary (`frozen_run`) and the number of parts; takes the lock
    part       generates and commits the shards of one part; takes no lock, so parts can run at the same time
    status     lists the parts that are left
    merge      writes manifest and dataset.json when all parts are done; takes the lock

Of S shards, part K of N contains those from K·S // N up to, but not including, (K + 1)·S // N.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import RESUME, ConfigError, DamageError, MachineError
from unprocess_gen.core.files import machine_error
from unprocess_gen.core.object_store import any_path
from unprocess_gen.pipeline.executors.local import effective_jobs, own_cores, run_tasks
from unprocess_gen.pipeline.frozen_run import FrozenRun, freeze, read_plan
from unprocess_gen.pipeline.generate import (
    Summary,
    dataset_json_facts,
    follow,
    shard_tasks,
    summary_of,
    warnings_before,
)
from unprocess_gen.pipeline.progress import COMPILING, LOGGER, Progress
from unprocess_gen.pipeline.shard_records import ShardRecords
from unprocess_gen.pipeline.sizes import check_free_space, with_pairs_per_shard
from unprocess_gen.pipeline.storage import WORK, Storage, open_storage
from unprocess_gen.pipeline.tasks import RunContext
from unprocess_gen.pipeline.workspace import Workspace
from unprocess_gen.sources.dark_frames import open_dark_frames
from unprocess_gen.sources.loader import list_photographs

PARTS = f"{WORK}/parts.json"


@dataclass(frozen=True, slots=True)
class Prepared:
    """Describe a prepared run.

    Attributes
    ----------
    parts, shards, sources : int
        Their numbers.
    complete : bool
        Whether the dataset was finished before.
    warnings : tuple of str
        Sentences that a user should read.
    """

    parts: int
    shards: int
    sources: int
    complete: bool = False
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PartMade:
    """Describe what one call of `make_part` made.

    Attributes
    ----------
    part, parts : int
        Number of the part, and of all parts.
    shards, made : int
        Shards of the part, and those that this call made.
    rows : int
        Rows of the shards that this call made.
    seconds : float
        Time that it took.
    """

    part: int
    parts: int
    shards: int
    made: int
    rows: int
    seconds: float


@dataclass(frozen=True, slots=True)
class PartsStatus:
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
    """Return the shards of one part.

    Parameters
    ----------
    part : int
        Number of the part, from 0.
    parts, shards : int
        Number of all parts and of all shards.

    Returns
    -------
    range
        Numbers of shards; the sizes of two parts differ by at most one.
    """
    return range(part * shards // parts, (part + 1) * shards // parts)


def prepare(config: Config, parts: int) -> Prepared:
    """Freeze a run in parts; a second call with the same settings changes nothing.

    Parameters
    ----------
    config : Config
        Config that `config.validation.validate_config` has accepted.
    parts : int
        Number of parts, at least 1.

    Returns
    -------
    Prepared
        What was frozen.

    Raises
    ------
    ConfigError
        As `generate`; if there are fewer shards than parts; if the run was prepared with another number of parts, or
        begun by another version.
    LockedError, DamageError, MachineError
        As `generate`.
    """
    listing = list_photographs(config.source)
    config, _, _ = open_dark_frames(config)
    config = with_pairs_per_shard(config, listing.sources, open_storage(config.out))
    tasks = shard_tasks(listing.sources, config.output.pairs_per_shard)
    if parts > len(tasks):
        raise ConfigError(
            f"parts={parts}: this dataset has {len(tasks)} shard{'s' * (len(tasks) != 1)}; expected 1 to {len(tasks)}; "
            "lower parts or output.pairs_per_shard"
        )
    with Workspace(config.out, dataset_yaml(config)) as workspace:
        workspace.open()
        if workspace.is_complete():
            workspace.check_complete(listing.sources)
            return Prepared(parts, len(tasks), len(listing.sources), complete=True)
        workspace.check_begun(listing.sources, config.source.root)
        known = _read_parts(workspace.storage, workspace.out)
        if known not in (None, parts):
            raise ConfigError(
                f"parts={parts}: {config.out} was prepared with parts={known}; expected that number; choose another out"
            )
        done = workspace.records.committed(range(len(tasks)))
        if config.check_disk:
            check_free_space(config, [task for task in tasks if task.shard not in done], any_path(config.out))
        workspace.begin(listing.sources, len(tasks))
        freeze(workspace, config, listing, partial(LOGGER.info, COMPILING))
        workspace.storage.create(PARTS, json.dumps({"parts": parts}) + "\n")
    return Prepared(parts, len(tasks), len(listing.sources), warnings=warnings_before(config, listing))


def make_part(out: str, part: int, n_jobs: int | None = None, root: str | None = None) -> PartMade | None:
    """Make and commit the shards of one part that are not committed yet.

    Parameters
    ----------
    out : str
        Folder of the dataset.
    part : int
        Number of the part, from 0.
    n_jobs : int, optional
        Number of worker processes, -1 for all cores; by default as prepared.
    root : str, optional
        Place of the sources on this host; by default as prepared.

    Returns
    -------
    PartMade or None
        What this call made; None if the dataset is finished.

    Raises
    ------
    ConfigError
        If ``out`` was not prepared, or by another version or with other settings; if there is no such part, or
        ``n_jobs`` is not allowed.
    CanaryError
        If this host makes other bytes than the host that prepared the run.
    MachineError
        If the self-test fails, a file cannot be read or written, or a source was changed or deleted.
    """
    started = time.monotonic()
    if n_jobs is not None:
        settings_of(Config)["n_jobs"].check("n_jobs", n_jobs)
    if _is_complete(out):
        return None
    run = FrozenRun(out, root)
    parts = _parts(run.storage, out)
    if not 0 <= part < parts:
        raise ConfigError(f"part {part}: {out} has {parts} parts; expected 0 to {parts - 1}")
    wanted = shards_of_part(part, parts, run.plan.shards)
    try:
        done = run.records.committed(wanted)
        todo = list(run.tasks(shard for shard in wanted if shard not in done))
        jobs = effective_jobs(run.plan.n_jobs if n_jobs is None else n_jobs, len(todo))
        scratch, spare = str(run.storage.scratch), jobs < own_cores()
        context = RunContext(run.config, scratch, os.getpid(), core_to_spare=spare, counts_deaths=True)
        with Progress(sum(len(task.sources) for task in todo), 0, f"part {part} of {parts}") as progress:
            run.check_host(progress.report_compiling)
            progress.watch_compiling(context.compiling_path)
            rows, _ = follow(run_tasks(context, todo, jobs), progress)
    except OSError as error:
        raise machine_error(error, any_path(out), RESUME) from error
    finally:
        run.storage.close()
    return PartMade(part, parts, len(wanted), len(todo), rows, time.monotonic() - started)


def parts_status(out: str) -> PartsStatus:
    """Return which parts of a prepared run are left.

    Parameters
    ----------
    out : str
        Folder of the dataset.

    Returns
    -------
    PartsStatus
        A shard with provisional rows counts as done, because a merge accepts it.

    Raises
    ------
    ConfigError
        If ``out`` was not prepared.
    DamageError
        If a record of the run cannot be read.
    """
    storage = open_storage(out)
    if _is_complete(out):
        return PartsStatus(0, 0, 0, (), complete=True)
    plan = read_plan(storage, out)
    parts = _parts(storage, out)
    recorded = ShardRecords(storage, out).recorded(range(plan.shards))
    left = (part for part in range(parts) if not recorded.issuperset(shards_of_part(part, parts, plan.shards)))
    return PartsStatus(parts, plan.shards, len(recorded), tuple(left))


def merge(out: str) -> tuple[Summary, int]:
    """Write manifest and ``dataset.json`` of a run whose parts are done.

    Parameters
    ----------
    out : str
        Folder of the dataset.

    Returns
    -------
    summary : Summary
        Counts of the dataset; ``made`` is 0 if it was finished before.
    max_failed : int
        ``source.max_failed`` as prepared; 0 if the dataset was finished before.

    Raises
    ------
    ConfigError
        If ``out`` was not prepared, or by another version or with other settings.
    MachineError
        If parts are left, which the message names; nothing is written then. If a file cannot be read or written.
    LockedError
        If a run holds the folder.
    """
    started = time.monotonic()
    status = parts_status(out)
    if status.complete:
        facts = Workspace(out, "").facts()
        assert facts is not None
        return summary_of(out, facts, started), 0
    if status.left:
        raise MachineError(
            f"merge: {out}: parts left: {left_text(status.left)} (of {status.parts}), "
            f"{status.shards - status.committed} of {status.shards} shards; run gen-dataset part {out} K for each, "
            "then merge again; nothing was written"
        )
    run = FrozenRun(out)
    with Workspace(out, run.storage.read("config.yaml")) as workspace:
        workspace.storage.hold()
        parts = _parts(run.storage, out)
        facts = workspace.finish(
            run.plan.shards,
            lambda tally: dataset_json_facts(
                run.config, run.plan.not_matched, run.plan.skipped_links, tally, {"parts": parts}
            ),
            run.config.output.parquet,
        )
    found = summary_of(out, facts, started)
    return replace(found, made=found.rows), run.plan.max_failed


def left_text(parts: Sequence[int]) -> str:
    """Return numbers as ranges, as batch systems take them: ``3,7-9``.

    Parameters
    ----------
    parts : sequence of int
        Ascending numbers.

    Returns
    -------
    str
        Both ends of a range are included; empty without numbers.
    """
    runs: list[tuple[int, int]] = []
    for part in parts:
        if runs and runs[-1][1] == part - 1:
            runs[-1] = runs[-1][0], part
        else:
            runs.append((part, part))
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)


def _is_complete(out: str) -> bool:
    return Workspace(out, "").is_complete()


def _parts(storage: Storage, out: str) -> int:
    parts = _read_parts(storage, out)
    if parts is None:
        raise ConfigError(f"out={out}: has no parts; expected a folder that gen-dataset prepare has begun; prepare it")
    return parts


def _read_parts(storage: Storage, out: str) -> int | None:
    try:
        return int(json.loads(storage.read(PARTS))["parts"])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise DamageError(
            f"{out}/{PARTS}: cannot be read ({error_in_one_line(error)}); remove the folder and start again"
        ) from error
