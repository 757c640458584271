"""Generate a dataset: list sources, split them into shards, run workers, commit shards, write the manifest.

A shard is the unit of work, retry and commit:

* `tasks`: the records that travel between coordinator and workers.
* `executors.local`: starts worker processes; its docstring says what happens when one dies.
* `executors.dask`: gives shards to the workers of a Dask cluster.
* `worker`: makes one shard in a temporary file, commits it and reports counts.
* `run_records`: what a run keeps until it is finished.
* `workspace`: checks and locks the output folder; writes ``manifest.csv`` and ``dataset.json``.
* `storage`: the files below ``out``.

Shards are committed in any order; the finished dataset does not depend on it. Design: ``docs/design/pipeline.md``.
"""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import dataset_yaml, source_kind
from unprocess_gen.core.paths import AnyPath, absolute_text, any_path
from unprocess_gen.dataset.columns import columns_of
from unprocess_gen.pipeline.executors.local import effective_jobs, own_cores, run_tasks
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.pipeline.run import Run, resolve
from unprocess_gen.pipeline.sizes import check_free_space
from unprocess_gen.pipeline.tasks import FAILURES_SHOWN, RunContext, ShardReport, ShardTask, StageTimes, Tally
from unprocess_gen.pipeline.workspace import Workspace
from unprocess_gen.sources.raw.decode import decoder_versions

PACKAGES = ("unprocess_gen", "numpy", "opencv-python-headless", "numba", "llvmlite", "joblib", "xxhash")
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
        Sum over all pairs of width x height (``all``) and of each of the manifest's counts (`tasks.COUNTS`).
    filtered : int
        Rows of images that ``source.min_side`` leaves out.
    shards, bytes : int
        Number of shards and the sum of their sizes.
    seconds : float
        Time that this run took.
    made : int
        Rows that this run made; 0 if the dataset was complete before.
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
    seconds: float
    made: int = 0
    unmatched: dict[str, int] = field(default_factory=dict)
    times: StageTimes = field(default_factory=StageTimes)
    filtered: int = 0

    @classmethod
    def of(cls, out: str, facts: dict[str, Any], started: float, **made: Any) -> Summary:
        """Describe a dataset by its ``dataset.json``; ``made`` are the fields about this run, which began at a time."""
        return cls(
            out=any_path(out),
            pairs=facts["pairs"],
            failed=facts["failed"],
            sites=facts["sites"],
            shards=len(facts["shards"]),
            bytes=sum(entry["bytes"] for entry in facts["shards"]),
            seconds=time.monotonic() - started,
            filtered=facts.get("filtered", 0),
            **made,
        )

    @property
    def has_frames(self) -> bool:
        """False for a manifest without frames."""
        return self.bytes > 0 or not self.pairs

    @property
    def rows(self) -> int:
        """Pairs, failures and filtered images together."""
        return self.pairs + sum(self.failed.values()) + self.filtered

    def sentence(self, max_failed: int) -> str:
        """Describe the outcome in one line, for the command line."""
        failed = sum(self.failed.values())
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.failed.items())
        stored = f"{self.bytes / 1e6:,.1f} MB" if self.has_frames else "no frames"
        size = f"{self.pairs} pair{'s' * (self.pairs != 1)}, {stored}"
        failures = f"{failed} failed" + (f" ({reasons}; see {self.out}/manifest.csv)" if failed else "")
        if failed > max_failed:
            failures += f", more than source.max_failed={max_failed}"
        if self.filtered:
            failures += f", {self.filtered} filtered (source.min_side)"
        if not self.made:
            return f"{self.out} is complete: {size}, {failures}; nothing to do"
        look = f"gen-dataset preview {self.out} --to {self.out.name}_sheets"
        after = look if self.has_frames else f'ug.LivePairs("{self.out}")'
        part = f" ({self.made} in this run)" if self.made < self.rows else ""
        return f"{self.out}: {size}{part}, {self.seconds:.1f} s, {failures}; next: {after}"


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
    run = resolve(config)
    made, facts = Made(), None
    with Workspace(config.out, dataset_yaml(run.config)) as workspace:
        workspace.open()
        if not workspace.is_complete():
            todo = begin(workspace, run)
            with Progress(len(run.sources), len(run.sources) - images_in(todo), label) as progress:
                for warning in run.warnings():
                    progress.warn(warning)
                execute = EXECUTORS[config.executor.kind] if todo else execute_locally
                made = execute(workspace, run, todo, progress)
            if not workspace.is_complete():  # a concurrent run, if the lock is not honoured, may have finished it
                facts = _finish(workspace, run, made, started)
        facts = facts or workspace.check_complete(run.sources)
    return Summary.of(config.out, facts, started, made=made.rows, times=made.times, unmatched=run.listing.unmatched)


def begin(workspace: Workspace, run: Run) -> list[ShardTask]:
    """Check the opened folder and begin or continue the dataset in it; return the shards that are not committed."""
    workspace.check_begun(run.sources, run.config.source.place)
    tasks = run.tasks()
    done = workspace.records.committed(range(len(tasks)))
    todo = [task for task in tasks if task.shard not in done]
    if run.config.check_disk:
        check_free_space(run.config, [source for task in todo for source in task.sources])
    workspace.begin(run.sources, len(tasks))
    return todo


def images_in(tasks: Iterable[ShardTask]) -> int:
    """Number of sources in shards."""
    return sum(len(task.sources) for task in tasks)


@dataclass(slots=True)
class Made:
    """Count what executors made: rows, shards, processor time of the stages, and workers."""

    rows: int = 0
    shards: int = 0
    times: StageTimes = field(default_factory=StageTimes)
    n_jobs: int = 1


def execute_locally(workspace: Workspace, run: Run, todo: list[ShardTask], progress: Progress) -> Made:
    """Make shards in worker processes of this machine."""
    n_jobs = effective_jobs(run.config.n_jobs, len(todo))
    context = RunContext(run.settings, str(workspace.storage.scratch), os.getpid(), core_to_spare=n_jobs < own_cores())
    progress.watch(context)
    return follow(run_tasks(context, todo, n_jobs), progress, n_jobs)


def execute_on_dask(workspace: Workspace, run: Run, todo: list[ShardTask], progress: Progress) -> Made:
    """Make shards on a Dask cluster."""
    from unprocess_gen.pipeline.executors.dask import connected, make_shards

    config = run.config
    places = {"out": absolute_text(config.out), "noise.dark_frames": absolute_text(config.noise.dark_frames)}
    places |= {"source.root": absolute_text(config.source.place)}
    context = RunContext(PairSettings.read(replaced(config, places)), "", None)
    with connected(config.executor, effective_jobs(config.n_jobs, len(todo))) as client:
        made = follow(make_shards(client, context, todo), progress)
        made.n_jobs = client.scheduler_info(n_workers=0)["n_workers"]
        return made


EXECUTORS: dict[str, Callable[[Workspace, Run, list[ShardTask], Progress], Made]] = {
    "local": execute_locally,
    "dask": execute_on_dask,
}
"""Function for each value of ``executor.kind``."""


def follow(reports: Iterable[ShardReport], progress: Progress, n_jobs: int = 1) -> Made:
    """Show the progress and warnings of committed shards, whose reports come in any order."""
    made, shown = Made(n_jobs=n_jobs), 0
    self_test = ""
    for report in reports:
        if report.killer is not None:
            progress.warn(f"{report.killer}; run the same command again to retry it")
        if report.log.self_test and not self_test:
            self_test = report.log.self_test
            progress.warn(f"the self-test failed: {self_test}; continuing because of self_test=go_on")
        for text in report.failures[: FAILURES_SHOWN - shown]:
            progress.warn(text)
        shown = min(FAILURES_SHOWN, shown + len(report.failures))
        made.rows += report.rows
        made.shards += 1
        made.times.add(report.log.times)
        progress.advance(report.images, report.failed)
    return made


def _finish(workspace: Workspace, run: Run, made: Made, started: float) -> dict[str, Any]:
    """Write manifest and ``dataset.json``; return the contents of the latter."""
    facts = {
        "seconds": round(time.monotonic() - started, 3),
        **{stage: round(stage_s, 3) for stage, stage_s in asdict(made.times).items()},
        "executor": run.config.executor.kind,
        "n_jobs": made.n_jobs,
        "shards_made": made.shards,
    }
    listing = run.listing
    return workspace.finish(
        len(run.tasks()),
        columns_of(run.config),
        lambda tally: dataset_json_facts(run.settings, listing.not_matched, listing.skipped_links, tally, facts),
    )


def dataset_json_facts(
    settings: PairSettings, not_matched: int, skipped_links: int, tally: Tally, run: dict[str, Any]
) -> dict[str, Any]:
    """Collect what ``dataset.json`` holds apart from digests and shards: counts, source, run and versions."""
    config = settings.config
    decoders = decoder_versions() if config.source.kind == "raw" else {}
    return {
        **tally.facts(),
        "not_matched": not_matched,
        "skipped_links": skipped_links,
        "source": source_facts(config),
        **_dark_facts(settings),
        "run": run | machine(),
        "versions": {package: version(package) for package in PACKAGES} | decoders,
    }


def source_facts(config: Config) -> dict[str, Any]:
    """Kind and places of the sources, for ``dataset.json`` only."""
    facts = {"kind": source_kind(config), "root": absolute_text(config.source.place)}
    file = absolute_text(config.source.list)
    return facts if file is None else facts | {"list": file}


def machine() -> dict[str, Any]:
    """Names of host, platform and Python version, for ``dataset.json`` only."""
    return {"host": platform.node(), "platform": platform.platform(), "python": platform.python_version()}


def _dark_facts(settings: PairSettings) -> dict[str, Any]:
    """Place, number, sizes and noise of the dark frames; the place alone if they cannot be read here."""
    noise, dark_frames = settings.config.noise, settings.dark_frames
    if noise.dark_frames is None:
        return {}
    facts: dict[str, Any] = {"root": absolute_text(noise.dark_frames)}
    if dark_frames is not None:
        sizes = {f"{frame.width}x{frame.height}" for frame in dark_frames.frames}
        facts |= {"count": len(dark_frames.frames), "sizes": sorted(sizes)}
        facts |= {"black_dn": dark_frames.black_dn, "std_dn": math.sqrt(dark_frames.variance_dn2)}
    return {"dark_frames": facts}
