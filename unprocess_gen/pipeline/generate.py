"""Generate a dataset: list sources, split them into shards, run workers, commit shards, write the manifest.

A shard is the unit of work, retry and commit:

* `tasks`: the records that travel between coordinator and workers.
* `executors.local`: starts worker processes; its docstring says what happens when one dies.
* `worker`: makes one shard in a temporary file and returns its rows.
* `workspace`: locks the output folder, renames finished shards into place and writes ``manifest.csv`` and
  ``dataset.json``.

The coordinator (this module) commits shards in index order, except retried ones; the finished dataset does not depend
on completion order. Design: ``docs/design/pipeline.md``.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml, source_kind
from unprocess_gen.core.files import RESUME, machine_error
from unprocess_gen.core.types import Counts, Row, Source
from unprocess_gen.dataset.keys import group_by_image
from unprocess_gen.pipeline.executors.local import effective_jobs, own_cores, run_tasks
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.pipeline.sizes import check_free_space
from unprocess_gen.pipeline.tasks import RunContext, ShardResult, ShardTask, StageTimes
from unprocess_gen.pipeline.workspace import Workspace
from unprocess_gen.sources.listing import ClipSizes, Listing
from unprocess_gen.sources.loader import list_photographs
from unprocess_gen.sources.video.decode import is_installed

PACKAGES = (
    *("unprocess_gen", "numpy", "opencv-python-headless", "numba", "llvmlite", "joblib", "xxhash"),
    *(("av",) if is_installed() else ()),
)
"""Packages whose versions ``dataset.json`` records."""

COUNTS = tuple(field.name for field in fields(Counts))


@dataclass(frozen=True, slots=True)
class Summary:
    """Hold the outcome of a run.

    Attributes
    ----------
    out : Path
        Folder of the dataset.
    pairs : int
        Rows with status ``ok``.
    failed : dict of str to int
        Failed rows by reason.
    sites : dict of str to int
        Sum over all pairs of width x height (``all``) and of each of the manifest's counts (``COUNTS``).
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

    out: Path
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
    with Workspace(Path(config.out), dataset_yaml(config)) as workspace:
        workspace.open()
        if workspace.complete:
            facts = workspace.check_complete(listing.sources)
            return _summary(workspace.out, facts, listing, made=0, started=started)
        workspace.check_begun(listing.sources)
        tasks = shard_tasks(listing.sources, config.output.pairs_per_shard)
        done = set(workspace.committed(len(tasks)))
        todo = [task for task in tasks if task.shard not in done]
        if config.check_disk:
            check_free_space(config, todo, workspace.out)
        workspace.begin(listing.sources)
        n_jobs = effective_jobs(config.n_jobs, len(todo))
        context = RunContext(config, str(workspace.tmp), os.getpid(), core_to_spare=n_jobs < own_cores())
        images_done = sum(len(task.sources) for task in tasks if task.shard in done)
        with Progress(len(listing.sources), images_done, label) as progress:
            progress.report_compiling(context.compiling_path)
            for warning in listing.warnings:
                progress.warn(warning)
            provisional, rows_made, times = _run(context, todo, n_jobs, workspace, progress)
        seconds = time.monotonic() - started
        try:
            pairs, failed, sites = tally(workspace.all_rows(len(tasks), provisional))
        except OSError as error:
            raise machine_error(error, workspace.out, RESUME) from error
        facts = workspace.finish(
            len(tasks),
            provisional,
            {
                "pairs": pairs,
                "failed": failed,
                "sites": sites,
                "not_matched": listing.not_matched,
                "skipped_links": listing.skipped_links,
                "source": {"kind": source_kind(config), "root": _absolute(config.source.root)},
                "run": {
                    "seconds": round(seconds, 3),
                    **{stage: round(stage_s, 3) for stage, stage_s in asdict(times).items()},
                    "n_jobs": n_jobs,
                    "shards_made": len(todo),
                    **machine(),
                },
                "versions": {package: version(package) for package in PACKAGES},
            },
        )
    return replace(_summary(Path(config.out), facts, listing, made=rows_made, started=started), times=times)


def _run(
    context: RunContext, tasks: Sequence[ShardTask], n_jobs: int, workspace: Workspace, progress: Progress
) -> tuple[dict[int, ShardResult], int, StageTimes]:
    """Make and commit shards; return the provisional results by shard, the number of rows, and the times of stages."""
    provisional: dict[int, ShardResult] = {}
    warned, rows, clip_sizes, times = False, 0, ClipSizes(), StageTimes()
    for result in run_tasks(context, tasks, n_jobs):
        if result.killer is None:
            workspace.commit(result)
        else:
            provisional[result.shard] = result
            progress.warn(f"{result.killer}: its worker died twice; rerun to retry it")
        if result.self_test and not warned:
            warned = True
            progress.warn(f"the self-test failed: {result.self_test}; continuing because of self_test=go_on")
        for warning in clip_sizes.warnings(result.rows):
            progress.warn(warning)
        rows += len(result.rows)
        times.add(result.times)
        statuses = [rows_of_image[0]["status"] for rows_of_image in group_by_image(result.rows)]
        progress.advance(len(statuses), statuses.count("failed"))
    return provisional, rows, times


def shard_tasks(sources: Sequence[Source], pairs_per_shard: int) -> list[ShardTask]:
    """Split the listing into tasks: shard s holds source indices [s·N, (s+1)·N), N = ``pairs_per_shard``."""
    starts = range(0, len(sources), pairs_per_shard)
    return [ShardTask(shard, tuple(sources[at : at + pairs_per_shard])) for shard, at in enumerate(starts)]


def tally(rows: Iterable[Row]) -> tuple[int, dict[str, int], dict[str, int]]:
    """Count the pairs, the failed rows by reason, and the sites of all pairs that each column of `COUNTS` counts."""
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
    """Return the names of host, platform and Python version.

    Returns
    -------
    dict of str to str
        ``host``, ``platform``, ``python``; for ``dataset.json``, where they decide no byte of the data.
    """
    return {"host": platform.node(), "platform": platform.platform(), "python": platform.python_version()}


def _absolute(root: str | None) -> str | None:
    return None if root is None else os.path.abspath(root)


def _summary(out: Path, facts: dict[str, Any], listing: Listing, made: int, started: float) -> Summary:
    return Summary(
        out=out,
        pairs=facts["pairs"],
        failed=facts["failed"],
        sites=facts["sites"],
        shards=len(facts["shards"]),
        bytes=sum(entry["bytes"] for entry in facts["shards"]),
        made=made,
        seconds=time.monotonic() - started,
        unmatched=listing.unmatched,
    )
