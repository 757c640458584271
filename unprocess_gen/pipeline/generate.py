"""Generate a dataset: find the shards that are missing, make and commit them, and finish when none is missing.

`generate` does this for all shards, `make_part` for those of a part, `merge` finishes a run in parts. Read on in `run`
(what a run is, how it begins), `executors` (processes that make shards), `worker` (make one, commit it) and `tasks`
(a shard is done when its record has no provisional row and its tar the recorded size).
Design: ``docs/design/pipeline.md``.
"""

from __future__ import annotations

import itertools
import platform
import shlex
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml
from unprocess_gen.core.errors import RESUME, ConfigError, MachineError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.dataset.dataset_json import dataset_facts, dataset_text
from unprocess_gen.dataset.manifest import write_manifest
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.pipeline.run import (
    LISTING,
    Run,
    RunFile,
    begin,
    check_finished,
    check_settings,
    check_version,
    read_run,
    resolve,
    resolve_part,
)
from unprocess_gen.pipeline.sizes import check_free_space
from unprocess_gen.pipeline.tasks import Made, StageTimes, count_facts, done_shards, read_records
from unprocess_gen.sources.raw.decode import decoder_versions

PACKAGES = ("unprocess_gen", "numpy", "opencv-python-headless", "numba", "llvmlite", "joblib", "xxhash")
"""Packages whose versions ``dataset.json`` records."""

RANGES_SHOWN = 20
"""Ranges of missing shards that an error names."""


@dataclass(frozen=True, slots=True)
class Summary:
    """The outcome of a run.

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
    noted : int
        Rows of pairs with a note about their source (column ``detail``).
    is_raw : bool
        True for raw sources.
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
    noted: int = 0
    is_raw: bool = False

    @classmethod
    def of(cls, out: AnyPath, facts: dict[str, Any], started: float, **made: Any) -> Summary:
        """Describe a dataset by its ``dataset.json``; ``made`` are the fields about this run, which began at a time."""
        return cls(
            out=out,
            pairs=facts["pairs"],
            failed=facts["failed"],
            sites=facts["sites"],
            shards=len(facts["shards"]),
            bytes=sum(entry["bytes"] for entry in facts["shards"]),
            seconds=time.monotonic() - started,
            filtered=facts.get("filtered", 0),
            noted=facts.get("noted", 0),
            is_raw=facts["source"]["kind"] == "raw",
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

    def sentence(self, max_failed: int, has_next: bool = True) -> str:
        """Describe the outcome, and the next step, in one line, for the command line."""
        failed = sum(self.failed.values())
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.failed.items())
        stored = f"{self.bytes / 1e6:,.1f} MB" if self.has_frames else "no frames"
        size = f"{self.pairs} pair{'s' * (self.pairs != 1)}, {stored}"
        failures = f"{failed} failed" + (f" ({reasons}; see {self.out}/manifest.csv)" if failed else "")
        if failed > max_failed:
            failures += f", more than source.max_failed={max_failed}"
        if self.filtered:
            failures += f", {self.filtered} filtered (source.min_side)"
        if self.noted:
            failures += f", {self.noted} noted (column detail)"
        if not self.made:
            return f"{self.out} is complete: {size}, {failures}; nothing to do"
        look = shlex.join(["gen-dataset", "preview", str(self.out), "--to", f"{self.out.name}_sheets"])
        look = look if self.has_frames else f'ug.LivePairs("{self.out}")'
        after = f"; next: {look}" if has_next and self.pairs else ""
        part = f" ({self.made} in this run)" if self.made < self.rows else ""
        return f"{self.out}: {size}{part}, {self.seconds:.1f} s, {failures}{after}"


def generate(config: Config, label: str = "") -> Summary:
    """Generate the dataset that a config describes, or resume it; ``label`` names the job of a sweep.

    ConfigError if ``out`` cannot be written, is not empty or inside a dataset, or was begun with other settings or
    sources; LockedError if another run holds it; DamageError if it is finished and a file is missing or has another
    size; MachineError if the disk is too small or fails, ``out`` or a source was deleted, or memory runs out.
    """
    started = time.monotonic()
    run = resolve(config)
    with OutFolder(config.out) as folder:
        folder.open()
        facts, made = folder.finished(), Made()
        if facts is None:
            folder.lock()
            facts = folder.finished()  # another run may have ended since
        if facts is not None:
            check_finished(folder, run.config, run.sources, facts)
        else:
            made = _make(folder, run, None, label)
            facts = folder.finished()  # by a concurrent run, where there is no lock
        if facts is not None:
            with suppress(OSError):  # may be read-only
                folder.remove_work()
        else:
            process = {
                "seconds": round(time.monotonic() - started, 3),
                **{stage: round(stage_s, 3) for stage, stage_s in asdict(made.times).items()},
                "executor": config.executor.kind,
                "n_jobs": made.n_jobs,
                "shards_made": made.shards,
                "max_failed": config.source.max_failed,
            }
            facts = _finish(folder, run.file(None), process)
    return Summary.of(folder.path, facts, started, made=made.rows, times=made.times, unmatched=run.listing.unmatched)


def make_part(config: Config, part: int, parts: int, label: str = "") -> Made | None:
    """Make and commit the missing shards of part ``part`` of ``parts``; None if the dataset is finished.

    Raises as `generate`; also ConfigError if the run was begun by another version or with another number of parts.
    """
    with OutFolder(config.out) as folder:
        folder.open()
        if folder.finished() is not None:
            check_settings(folder, dataset_yaml(PairSettings.read(config).config))
            return None
        run = resolve_part(folder, config)
        if parts > run.shards:
            raise ConfigError(
                f"part {part}/{parts}: this dataset has {run.shards} shard{'s' * (run.shards != 1)}; expected N "
                f"from 1 to {run.shards}; lower N or output.pairs_per_shard"
            )
        made = _make(folder, run, (part, parts), label)
        if folder.finished() is not None:  # another process made the part and merged
            folder.remove_work()
        return made


def merge(out: str) -> tuple[Summary, int]:
    """Write manifest and ``dataset.json`` of a run whose parts are done; return also ``source.max_failed``.

    ConfigError if no run has begun, MachineError if shards are missing, which the message names; nothing is written
    then. LockedError if a run holds the folder.
    """
    started = time.monotonic()
    with OutFolder(out) as folder:
        most_shards = (folder / LISTING).size()  # each shard is looked for; it has a source, which takes a line
        known = read_run(folder, most_shards)
        if known is not None:
            check_version(folder, known)
            folder.lock()
        facts = folder.finished()
        if facts is not None:
            summary = Summary.of(folder.path, facts, started)
            max_failed = (facts["run"] or {}).get("max_failed")
            return summary, sum(summary.failed.values()) if max_failed is None else max_failed
        if known is None:
            raise ConfigError(f"merge: {out}: no run has begun there; expected one; run gen-dataset part K/N first")
        check_settings(folder, known.config)
        process = {"max_failed": known.max_failed} | ({"parts": known.parts} if known.parts else {})
        facts = _finish(folder, known, process)
    summary = Summary.of(folder.path, facts, started)
    return replace(summary, made=summary.rows), known.max_failed


def _make(folder: OutFolder, run: Run, part: tuple[int, int] | None, label: str) -> Made:
    """Make and commit the shards that are not done, all or those of part K of N."""
    if run.config.executor.kind == "dask":
        from unprocess_gen.pipeline.executors.dask import make_shards
    else:
        from unprocess_gen.pipeline.executors.local import make_shards
    first, parts = part or (0, 1)
    shards = range(first, run.shards, parts)
    done = done_shards(folder, shards)
    todo = [run.task(shard) for shard in shards if shard not in done]
    if run.config.check_disk:
        check_free_space(run.config, [source for task in todo for source in task.sources])
    begin(folder, run, parts if part else None)
    made, images = Made(done=len(done)), sum(len(task.sources) for task in todo)
    total = images if part else len(run.sources)
    label = ": ".join(filter(None, (label, part and f"part {first} of {parts}")))
    with machine_errors(folder.path, RESUME), Progress(total, total - images, label) as progress:
        for warning in run.warnings():
            progress.warn(warning)
        for report in make_shards(folder, run.settings, todo, progress, made) if todo else ():
            for warning in made.add(report):
                progress.warn(warning)
            progress.advance(report.images, report.failed)
    return made


def _finish(folder: OutFolder, run: RunFile, process: dict[str, Any]) -> dict[str, Any]:
    """Write ``manifest.csv``, then ``dataset.json``, whose contents are returned, with facts on the process.

    If a row is provisional, ``.work`` is kept, so that the next run retries it. MachineError if shards are missing.
    """
    entries, missing, counts = list[dict[str, Any]](), list[int](), Counter[str]()

    def lines() -> Iterator[bytes]:
        for shard, read in enumerate(read_records(folder, range(run.shards))):
            if read is None:
                missing.append(shard)
                continue
            record, csv = read
            entries.append(record.entry)
            counts.update(record.counts)
            yield csv

    with machine_errors(folder.path, RESUME):
        manifest = folder.scratch / "manifest.csv"
        digest = write_manifest(manifest, run.columns, lines())
        if missing:
            raise _missing_error(folder, run, missing)
        (folder / "manifest.csv").commit(manifest)
        decoders = decoder_versions(run.source.kind)
        heic = ["pillow-heif"] if find_spec("pillow_heif") else []
        versions = {package: version(package) for package in (*PACKAGES, *heic)} | decoders
        machine = {"host": platform.node(), "platform": platform.platform(), "python": platform.python_version()}
        facts = count_facts(counts) | run.facts() | {"run": process | machine, "versions": versions}
        dataset = dataset_facts(run.config, digest, entries, facts)
        folder.write("dataset.json", dataset_text(dataset).encode())
        if not any(entry.get("provisional") for entry in entries):
            folder.remove_work()
    return dataset


def _missing_error(folder: OutFolder, run: RunFile, missing: Sequence[int]) -> MachineError:
    """Name the missing shards of a run, and their parts if it has some."""
    parts = sorted({shard % run.parts for shard in missing}) if run.parts else []
    named = f"parts {_ranges(parts)} of {run.parts} are not done, with " if parts else ""
    return MachineError(
        f"merge: {folder}: {named}{len(missing)} of {run.shards} shards missing ({_ranges(missing)}); run "
        f"gen-dataset part K/{run.parts or 'N'} with the same settings for each, then merge again; nothing was written"
    )


def _ranges(numbers: Sequence[int]) -> str:
    """Numbers as ranges, as batch systems take them: ``3,7-9``; at most `RANGES_SHOWN`."""
    runs = itertools.groupby(enumerate(numbers), lambda item: item[1] - item[0])
    ranges = [[number for _, number in run] for _, run in itertools.islice(runs, RANGES_SHOWN + 1)]
    texts = [str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in ranges[:RANGES_SHOWN]]
    return ",".join(texts) + ", …" * (len(ranges) > RANGES_SHOWN)
