"""Generate a dataset: list sources, split them into shards, run workers, commit shards, write the manifest.

A shard is the unit of work, retry and commit:

* `tasks`: the records that travel between coordinator and workers.
* `executors.local`: starts worker processes; its docstring says what happens when one dies.
* `executors.dask`: gives shards to the workers of a Dask cluster.
* `worker`: makes one shard in a temporary file, commits it and reports counts.
* `shard_records`, `listing_record`: what a run keeps until it is finished.
* `workspace`: checks and locks the output folder; writes ``manifest.csv`` and ``dataset.json``.
* `storage`: the files below ``out``.

Shards are committed in any order; the finished dataset does not depend on it. Design: ``docs/design/pipeline.md``.
"""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import Any

from unprocess_gen.config.interpretation import shading_place
from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml, source_kind
from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.core.object_store import AnyPath, any_path
from unprocess_gen.core.types import Source
from unprocess_gen.pipeline.executors.local import effective_jobs, own_cores, run_tasks
from unprocess_gen.pipeline.frozen_run import freeze
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.pipeline.sizes import check_free_space, shards_warning, with_pairs_per_shard
from unprocess_gen.pipeline.storage import open_storage
from unprocess_gen.pipeline.tally import Tally
from unprocess_gen.pipeline.tasks import RunContext, ShardReport, ShardTask, StageTimes
from unprocess_gen.pipeline.workspace import Workspace
from unprocess_gen.planning.dark_scene import dark_scene_warning
from unprocess_gen.sources.dark_frames import open_dark_frames
from unprocess_gen.sources.listing import ClipSizes, Listing, absolute_root
from unprocess_gen.sources.loader import list_photographs
from unprocess_gen.sources.video.decode import is_installed

PACKAGES = (
    *("unprocess_gen", "numpy", "opencv-python-headless", "numba", "llvmlite", "joblib", "xxhash"),
    *(("av",) if is_installed() else ()),
)
"""Packages whose versions ``dataset.json`` records."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Hold the outcome of a run.

    Attributes
    ----------
    out : Path or ObjectPath
        Folder of the dataset.
    pairs : int
        Rows with status ``ok``.
    failed : dict of str to int
        Failed rows by reason.
    sites : dict of str to int
        Sum over all pairs of width x height (``all``) and of each of the manifest's counts (`tally.COUNTS`).
    shards, bytes : int
        Number of shards and the sum of their sizes.
    made : int
        Rows that this run made; 0 if the dataset was complete before.
    seconds : float
        Time that this run took.
    unmatched : dict of str to int
        Files that no include pattern matches, by suffix.
    times : StageTimes
        Processor time of the stages in all workers of this run.
    """

    out: AnyPath
    pairs: int
    failed: dict[str, int]
    sites: dict[str, int]
    shards: int
    bytes: int
    made: int
    seconds: float
    unmatched: dict[str, int] = field(default_factory=dict)
    times: StageTimes = field(default_factory=StageTimes)

    @property
    def rows(self) -> int:
        """Pairs and failures together."""
        return self.pairs + sum(self.failed.values())


def generate(config: Config, label: str = "") -> Summary:
    """Generate the dataset that a config describes, or resume it.

    Parameters
    ----------
    config : Config
        Config that `config.validation.validate_config` has accepted.
    label : str
        Name of the job and its place in a sweep, shown with the progress.

    Returns
    -------
    Summary
        Rows by status, shards, bytes and time.

    Raises
    ------
    ConfigError
        If ``out`` cannot be written, is not empty or inside a dataset, or was begun with other settings or sources.
    LockedError
        If another run holds ``out``.
    DamageError
        If ``out`` is a finished dataset and a file of it is missing or has another size.
    MachineError
        If the dataset will not fit the disk (unless ``check_disk=false``), the disk fails, ``out`` or a source was
        deleted, or memory runs out.
    """
    started = time.monotonic()
    listing = list_photographs(config.source)
    config, dark_frames, dark_folder = open_dark_frames(config)
    config = with_pairs_per_shard(config, listing.sources, open_storage(config.out))
    with Workspace(config.out, dataset_yaml(config)) as workspace:
        workspace.open()
        if workspace.is_complete():
            return summary_of(config.out, workspace.check_complete(listing.sources), started, listing.unmatched)
        workspace.check_begun(listing.sources, config.source.root)
        tasks = shard_tasks(listing.sources, config.output.pairs_per_shard)
        done = workspace.records.committed(range(len(tasks)))
        todo = [task for task in tasks if task.shard not in done]
        if config.check_disk:
            check_free_space(config, todo, any_path(config.out))
        workspace.begin(listing.sources, len(tasks))
        context = RunContext(
            config,
            str(workspace.storage.scratch),
            os.getpid(),
            dark_frames=dark_frames,
            dark_folder=dark_folder,
        )
        images_done = sum(len(task.sources) for task in tasks if task.shard in done)
        with Progress(len(listing.sources), images_done, label) as progress:
            for warning in warnings_before(config, listing):
                progress.warn(warning)
            execute = EXECUTORS[config.executor.kind] if todo else execute_locally
            rows_made, times, n_jobs = execute(Assignment(workspace, listing, todo, context), progress)
        if workspace.is_complete():  # another run was not kept out by the lock, and has finished the dataset
            return summary_of(config.out, workspace.check_complete(listing.sources), started, listing.unmatched)
        run = {
            "seconds": round(time.monotonic() - started, 3),
            **{stage: round(stage_s, 3) for stage, stage_s in asdict(times).items()},
            "executor": config.executor.kind,
            "n_jobs": n_jobs,
            "shards_made": len(todo),
        }
        not_matched, links = listing.not_matched, listing.skipped_links
        facts = workspace.finish(
            len(tasks),
            lambda tally: dataset_json_facts(config, not_matched, links, tally, run),
            config.output.parquet,
        )
    return replace(summary_of(config.out, facts, started, listing.unmatched), made=rows_made, times=times)


def warnings_before(config: Config, listing: Listing) -> tuple[str, ...]:
    """Return what the user should know before a run begins: warnings on sources, shards and a dark scene.

    Parameters
    ----------
    config : Config
        Validated config.
    listing : Listing
        Sources of the run.

    Returns
    -------
    tuple of str
        One sentence each.
    """
    warnings = *listing.warnings, shards_warning(config, listing.sources), dark_scene_warning(config)
    return tuple(filter(None, warnings))


@dataclass(frozen=True, slots=True)
class Assignment:
    """Hold the shards that an executor makes.

    Attributes
    ----------
    workspace : Workspace
        The begun dataset.
    listing : Listing
        All sources.
    tasks : list of ShardTask
        Shards that are not committed.
    context : RunContext
        What workers on this machine share.
    """

    workspace: Workspace
    listing: Listing
    tasks: list[ShardTask]
    context: RunContext


def execute_locally(work: Assignment, progress: Progress) -> tuple[int, StageTimes, int]:
    """Make shards in worker processes of this machine; return number of rows, times and number of workers."""
    n_jobs = effective_jobs(work.context.config.n_jobs, len(work.tasks))
    context = replace(work.context, core_to_spare=n_jobs < own_cores())
    progress.watch_compiling(context.compiling_path)
    return *follow(run_tasks(context, work.tasks, n_jobs), progress), n_jobs


def execute_on_dask(work: Assignment, progress: Progress) -> tuple[int, StageTimes, int]:
    """Make shards on a Dask cluster; return number of rows, times and the largest number of workers at a time."""
    from unprocess_gen.pipeline.executors.dask import ChunkRequest, DaskRun, connected

    config, workspace = work.context.config, work.workspace
    out, root = absolute_root(config.out), absolute_root(config.source.root)
    assert out is not None
    with connected(config.executor, effective_jobs(config.n_jobs, len(work.tasks)), workspace.storage) as client:
        plan = freeze(workspace, config, work.listing, progress.report_compiling)
        request = ChunkRequest(out, root, plan.sha256)
        shards = [task.shard for task in work.tasks]
        run = DaskRun(client, config.executor, request, workspace.records, shards, progress.report_compiling)
        return *follow(run.reports(), progress), run.workers.most


EXECUTORS: dict[str, Callable[[Assignment, Progress], tuple[int, StageTimes, int]]] = {
    "local": execute_locally,
    "dask": execute_on_dask,
}
"""What each value of ``executor.kind`` runs."""


def follow(reports: Iterable[ShardReport], progress: Progress) -> tuple[int, StageTimes]:
    """Show the progress and warnings of committed shards.

    Parameters
    ----------
    reports : iterable of ShardReport
        Reports in any order.
    progress : Progress
        Counts their images.

    Returns
    -------
    rows : int
        Number of rows that were made.
    times : StageTimes
        Sum of the times of all stages.
    """
    warned, rows, clip_sizes, times = False, 0, ClipSizes(), StageTimes()
    for report in reports:
        if report.killer is not None:
            progress.warn(f"{report.killer}; run the same command again to retry it")
        if report.self_test and not warned:
            warned = True
            progress.warn(f"the self-test failed: {report.self_test}; continuing because of self_test=go_on")
        for warning in clip_sizes.warnings(report.frame_sizes):
            progress.warn(warning)
        rows += report.rows
        times.add(report.times)
        progress.advance(report.images, report.failed)
    return rows, times


def dataset_json_facts(
    config: Config, not_matched: int, skipped_links: int, tally: Tally, run: dict[str, Any]
) -> dict[str, Any]:
    """Return what ``dataset.json`` holds apart from digests and shards.

    Parameters
    ----------
    config : Config
        The config.
    not_matched, skipped_links : int
        What the listing left out.
    tally : Tally
        Counts of all rows.
    run : dict
        Facts about the run.

    Returns
    -------
    dict
        Counts, source, run and versions.
    """
    return {
        **tally.facts(),
        "not_matched": not_matched,
        "skipped_links": skipped_links,
        "source": {"kind": source_kind(config), "root": absolute_root(config.source.root)},
        **_dark_facts(config),
        "run": run | machine(),
        "versions": {package: version(package) for package in PACKAGES},
    }


def shard_tasks(sources: Sequence[Source], pairs_per_shard: int) -> list[ShardTask]:
    """Split the listing into tasks: shard s holds source indices [s·N, (s+1)·N), N = ``pairs_per_shard``."""
    starts = range(0, len(sources), pairs_per_shard)
    return [ShardTask(shard, tuple(sources[at : at + pairs_per_shard])) for shard, at in enumerate(starts)]


def machine() -> dict[str, Any]:
    """Return the names of host, platform and Python version.

    Returns
    -------
    dict of str to str
        ``host``, ``platform``, ``python``; for ``dataset.json``, where they decide no byte of the data.
    """
    return {"host": platform.node(), "platform": platform.platform(), "python": platform.python_version()}


def _dark_facts(config: Config) -> dict[str, Any]:
    """Return what ``dataset.json`` records about dark frames: their place, number, sizes, noise and map."""
    root, shading = absolute_root(config.noise.dark_frames), absolute_root(shading_place(config.noise))
    if root is None:
        return {}
    places = {"root": root} | ({} if shading is None else {"shading": shading})
    try:
        _, dark_frames, folder = open_dark_frames(config)
    except (ConfigError, MachineError):  # parts of a run may be merged where the frames are not
        return {"dark_frames": places}
    assert dark_frames is not None and folder is not None
    return {
        "dark_frames": {
            **places,
            **({} if shading is None else {"shading": absolute_root(folder.shading_place)}),
            "count": len(dark_frames.frames),
            "sizes": sorted({f"{frame.width}x{frame.height}" for frame in dark_frames.frames}),
            "black_dn": dark_frames.black_dn,
            "std_dn": math.sqrt(dark_frames.variance_dn2),
        }
    }


def summary_of(out: str, facts: dict[str, Any], started: float, unmatched: dict[str, int] | None = None) -> Summary:
    """Return the outcome of a run that made nothing.

    Parameters
    ----------
    out : str
        Folder of the dataset.
    facts : dict
        Contents of its ``dataset.json``.
    started : float
        Start of the run (`time.monotonic`).
    unmatched : dict of str to int, optional
        Files that no include pattern matches, by suffix.

    Returns
    -------
    Summary
        With ``made`` 0.
    """
    return Summary(
        out=any_path(out),
        pairs=facts["pairs"],
        failed=facts["failed"],
        sites=facts["sites"],
        shards=len(facts["shards"]),
        bytes=sum(entry["bytes"] for entry in facts["shards"]),
        made=0,
        seconds=time.monotonic() - started,
        unmatched=unmatched or {},
    )
