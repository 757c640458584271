"""The work of a shard, its result and its record.

``.work/rows/00000.json`` is a line of JSON, then the shard's lines of the manifest. A worker puts the tar in place
first and the record second, so the record is the commit. Any number of writers may commit a shard, to the same bytes.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from unprocess_gen.config.schema import Config
from unprocess_gen.core.records import Count, check_record, parse_record
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.dataset_json import ShardFacts, check_shard
from unprocess_gen.dataset.keys import group_by_image
from unprocess_gen.dataset.manifest import csv_lines
from unprocess_gen.dataset.row import has_frames
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.folder import WORK, OutFolder
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.simulation.frames import Counts

FAILURES_SHOWN = 3
"""Failed sources that a run names; the manifest lists all."""


@dataclass(slots=True)
class StageTimes:
    """Processor time of the thread that makes pairs: to read and decode sources, and to plan and simulate pairs."""

    decode_s: float = 0.0
    simulate_s: float = 0.0

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of the body to a stage, ``decode_s`` or ``simulate_s``, even if it fails."""
        started = time.thread_time()
        try:
            yield
        finally:
            setattr(self, stage, getattr(self, stage) + time.thread_time() - started)

    def add(self, other: StageTimes) -> None:
        """Add the times of another shard."""
        self.decode_s += other.decode_s
        self.simulate_s += other.simulate_s


@dataclass(frozen=True, slots=True)
class RunContext:
    """Settings and places that all tasks of a run share.

    ``scratch`` is a local folder for unfinished files. Workers end with the process ``coordinator_pid``, unless it is
    None. With ``core_to_spare``, each worker hashes and writes in a second thread.
    """

    settings: PairSettings
    scratch: str
    coordinator_pid: int | None
    core_to_spare: bool = False

    @property
    def config(self) -> Config:
        """The config of the run."""
        return self.settings.config

    @property
    def compiling_path(self) -> Path:
        """The file that a worker creates before it compiles kernels."""
        return Path(self.scratch) / "compiling"

    def busy_path(self, shard: int) -> Path:
        """The file that contains the index of the source in progress while a shard is made."""
        return Path(self.scratch) / f"{shard}.busy"

    def images_in_progress(self) -> int:
        """Number of images that workers have finished in shards that are not committed."""
        per_shard, count = self.config.output.pairs_per_shard, 0
        with suppress(OSError):  # the run has ended and deleted the folder
            for busy in Path(self.scratch).glob("*.busy"):
                with suppress(OSError, ValueError):  # the shard was finished, or its file is being written
                    count += int(busy.read_text()) % per_shard
        return count


@dataclass(frozen=True, slots=True)
class ShardTask:
    """The work of one shard: its number and its sources."""

    shard: int
    sources: tuple[Source, ...]


@dataclass(slots=True)
class ShardReport:
    """A shard as the coordinator reports it: numbers of its sources, of those that failed, and of its rows.

    ``killers`` are names of sources at which workers died. ``self_test`` are failures that ``self_test=go_on`` accepts,
    each once. ``warnings`` are about sources.
    """

    shard: int
    images: int = 0
    failed: int = 0
    rows: int = 0
    times: StageTimes = field(default_factory=StageTimes)
    self_test: dict[str, None] = field(default_factory=dict)
    killers: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


@dataclass(slots=True)
class ShardResult:
    """A shard while it is made, and when it is finished.

    ``path`` is its temporary file, None without pairs; ``bytes`` and ``sha256`` are those of the file. ``rows`` are
    those of the manifest, in source order.
    """

    report: ShardReport
    path: str | None = None
    bytes: int = 0
    sha256: str | None = None
    rows: list[Row] = field(default_factory=list)

    def entry(self) -> dict[str, Any]:
        """Entry of the shard in ``dataset.json``."""
        statuses = Counter(row["status"] for row in self.rows)
        return {
            **({"provisional": True} if any(row["reason"] == "worker_died" for row in self.rows) else {}),
            **({"self_test": "; ".join(self.report.self_test)} if self.report.self_test else {}),
            "file": None if self.path is None else tar_name(self.report.shard),
            "pairs": statuses["ok"],
            "failed": statuses["failed"],
            "bytes": self.bytes,
            "sha256": self.sha256,
        }


@dataclass(slots=True)
class Made:
    """Result of one call: what it made and found done, and how many failures the user has seen.

    Rows and shards that it made, shards that it found done, processor time of the stages, and number of workers.
    """

    rows: int = 0
    shards: int = 0
    done: int = 0
    times: StageTimes = field(default_factory=StageTimes)
    n_jobs: int = 1
    failures_shown: int = 0
    self_test: dict[str, None] = field(default_factory=dict)

    def add(self, report: ShardReport) -> list[str]:
        """Add a committed shard; return what the user should read about it, unless enough was shown before."""
        warnings = [
            f"{name}: its worker died four times; run the same command again to retry it" for name in report.killers
        ]
        if report.self_test and not self.self_test:
            failures = "; ".join(report.self_test)
            warnings.append(f"the self-test failed: {failures}; continuing because of self_test=go_on")
        shown = report.warnings[: FAILURES_SHOWN - self.failures_shown]
        self.failures_shown += len(shown)
        self.self_test |= report.self_test
        self.rows += report.rows
        self.shards += 1
        self.times.add(report.times)
        return warnings + shown


COUNTS = Counts.__struct_fields__
"""Columns of the manifest that count sites."""


def count_rows(rows: Iterable[Row]) -> Counter[str]:
    """Count pairs, notes and filtered images, failures by reason, and over all pairs sites and what `COUNTS` count."""
    counts = Counter[str]()
    for row in rows:
        counts[f"failed.{row['reason']}" if row["status"] == "failed" else str(row["status"])] += 1
        counts["noted"] += row["status"] == "ok" and row["detail"] != ""
        if has_frames(row):
            counts["sites.all"] += int(row["width"] or 0) * int(row["height"] or 0)
            counts.update({f"sites.{name}": int(row[name] or 0) for name in COUNTS})
    return counts


def count_facts(counts: Counter[str]) -> dict[str, Any]:
    """Counts of `count_rows` as ``dataset.json`` has them."""
    failed = {name.removeprefix("failed."): counts[name] for name in sorted(counts) if name.startswith("failed.")}
    others = {name: counts[name] for name in ("filtered", "noted") if counts[name]}
    sites = {name: counts[f"sites.{name}"] for name in ("all", *COUNTS)}
    return {"pairs": counts["ok"], "failed": failed, **others, "sites": sites}


ROWS = f"{WORK}/rows"


class ShardRecord(msgspec.Struct, frozen=True):
    """First line of a shard's record: its entry in ``dataset.json``, counts of its rows, size of the lines below."""

    entry: dict[str, Any]
    counts: dict[str, Count]
    csv_bytes: Count


RecordAndLines = tuple[ShardRecord, bytes]
"""Record of a shard, and its lines of the manifest."""


def commit_shard(folder: OutFolder, result: ShardResult, columns: Sequence[str]) -> ShardReport:
    """Put a finished shard in place, then its record; raise OSError if the storage fails."""
    report = result.report
    if result.path is not None:
        (folder / tar_name(report.shard)).commit(Path(result.path))
    csv = csv_lines(result.rows, columns)
    facts = {"entry": result.entry(), "counts": count_rows(result.rows), "csv_bytes": len(csv)}
    folder.write(_file(report.shard), json.dumps(facts, separators=(",", ":")).encode() + b"\n" + csv)
    images = [rows[0] for rows in group_by_image(result.rows)]
    failed = [row for row in images if row["status"] == "failed"]
    shown = [row for row in failed if row["reason"] != "worker_died"][:FAILURES_SHOWN]
    warnings = [f"{row['source']}: {row['reason']}: {row['detail']}" for row in shown]
    warnings += report.warnings[:FAILURES_SHOWN]
    return replace(report, images=len(images), failed=len(failed), rows=len(result.rows), warnings=warnings)


def done_shards(folder: OutFolder, shards: range) -> set[int]:
    """Find the shards that are done: a record without a provisional row, whose tar has the recorded size."""
    records = zip(shards, read_records(folder, shards), strict=True)
    return {shard for shard, read in records if read is not None and not read[0].entry.get("provisional")}


def read_records(folder: OutFolder, shards: range) -> Iterator[RecordAndLines | None]:
    """Read the records of shards in order; None if there is none, it cannot be read, or the tar has another size.

    Consecutive shards are looked up in listings, those of a part one by one.
    """
    if shards.step > 1:
        return folder.path.map(lambda shard: _read(folder, shard, (folder / tar_name(shard)).size), shards)
    recorded, sizes = (folder / ROWS).entries(), (folder / "shards").entries()

    def read(shard: int) -> RecordAndLines | None:
        is_recorded = Path(_file(shard)).name in recorded
        return _read(folder, shard, lambda: sizes.get(shard_name(shard))) if is_recorded else None

    return folder.path.map(read, shards)


def tar_name(shard: int) -> str:
    """Name of a shard's file below ``out``."""
    return f"shards/{shard_name(shard)}"


def _read(folder: OutFolder, shard: int, tar_bytes: Callable[[], int | None]) -> RecordAndLines | None:
    try:
        line, _, csv = folder.read(_file(shard)).partition(b"\n")
        record = parse_record(line, ShardRecord)
        check_shard(shard, check_record(record.entry, ShardFacts))
    except (OSError, ValueError):
        return None
    fits = record.entry["file"] is None or record.entry["bytes"] == tar_bytes()
    return (record, csv) if fits and len(csv) == record.csv_bytes else None


def _file(shard: int) -> str:
    return f"{ROWS}/{shard:05d}.json"
