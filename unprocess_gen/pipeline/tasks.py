"""Define what a coordinator and its workers exchange: context of a run; task, result, report and counts of a shard."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from unprocess_gen.config.schema import Config
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.keys import group_by_image
from unprocess_gen.dataset.manifest import has_frames
from unprocess_gen.dataset.row import Row
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.simulation.frames import Counts

Item = TypeVar("Item")

FAILURES_SHOWN = 3
"""Failed sources that a run names; the manifest lists all."""


@dataclass(slots=True)
class StageTimes:
    """Add up the processor time of the thread that makes pairs.

    Attributes
    ----------
    decode_s, simulate_s : float
        Seconds to read and decode sources, and to plan and simulate pairs.
    """

    decode_s: float = 0.0
    simulate_s: float = 0.0

    @contextmanager
    def adding(self, stage: str) -> Iterator[None]:
        """Add the time of the body to a stage, ``decode_s`` or ``simulate_s``, even if it fails."""
        started = time.thread_time()
        try:
            yield
        finally:
            setattr(self, stage, getattr(self, stage) + time.thread_time() - started)

    def each_simulated(self, pairs: Iterable[Item]) -> Iterator[Item]:
        """Yield the items, and add the time that each of them takes to ``simulate_s``."""
        remaining = iter(pairs)
        while True:
            with self.adding("simulate_s"):
                try:
                    pair = next(remaining)
                except StopIteration:
                    return
            yield pair

    def add(self, other: StageTimes) -> None:
        """Add the times of another shard."""
        self.decode_s += other.decode_s
        self.simulate_s += other.simulate_s


@dataclass(frozen=True, slots=True)
class ShardLog:
    """Hold what a worker notes while it makes a shard.

    Attributes
    ----------
    failures : dict of str to None
        Failures of the self-test, each once, if ``self_test=go_on`` accepts them.
    times : StageTimes
        Processor time of the stages.
    notes : list of str
        Warnings about sources.
    """

    failures: dict[str, None] = field(default_factory=dict)
    times: StageTimes = field(default_factory=StageTimes)
    notes: list[str] = field(default_factory=list)

    @property
    def self_test(self) -> str | None:
        """Failures of the self-test in one line, None without any."""
        return "; ".join(self.failures) or None


@dataclass(frozen=True, slots=True)
class RunContext:
    """Hold what all tasks of a run share.

    Attributes
    ----------
    settings : PairSettings
        The settings; ``config.out`` is where shards are committed.
    scratch : str
        Local folder for unfinished files.
    coordinator_pid : int or None
        Process that started the workers, with which they end; None if they end on their own.
    core_to_spare : bool
        Whether each worker hashes and writes in a second thread (more cores than workers).
    counts_deaths : bool
        Whether the deaths of workers at a shard are counted below ``out`` (`run_records.Deaths`), because nothing else
        sees them.
    """

    settings: PairSettings
    scratch: str
    coordinator_pid: int | None
    core_to_spare: bool = False
    counts_deaths: bool = False

    @property
    def config(self) -> Config:
        """The config of the run."""
        return self.settings.config

    @property
    def compiling_path(self) -> Path:
        """The file that a worker creates before it compiles kernels."""
        return Path(self.scratch) / "compiling"

    def images_in_progress(self) -> int:
        """Count the images that workers have finished in shards that are not committed."""
        per_shard, count = self.config.output.pairs_per_shard, 0
        with suppress(OSError):  # the run has ended and deleted the folder
            for busy in Path(self.scratch).glob("*.busy"):
                with suppress(OSError, ValueError):  # the shard was finished, or its file is being written
                    count += int(busy.read_text()) % per_shard
        return count


@dataclass(frozen=True, slots=True)
class ShardTask:
    """Hold the work of one shard: its number and its sources."""

    shard: int
    sources: tuple[Source, ...]

    def busy_path(self, context: RunContext) -> Path:
        """Return the file that contains the index of the source in progress; it exists while the shard is made."""
        return Path(context.scratch) / f"{self.shard}.busy"

    def busy_source(self, context: RunContext) -> Source | None:
        """Return the source at which the last worker of this shard ended, None if it was at none."""
        try:
            index = self.busy_path(context).read_text()
        except OSError:
            return None
        return next((source for source in self.sources if str(source.index) == index), None)


@dataclass(frozen=True, slots=True)
class ShardResult:
    """Hold a finished shard: its temporary file and its rows.

    Attributes
    ----------
    shard : int
        Number of the shard.
    path : str or None
        Temporary file; None if every source failed, because a shard without pairs has no file.
    bytes : int
        Size of the file; 0 without one.
    sha256 : str or None
        Hex digest of the file.
    rows : tuple of Row
        Manifest rows, in source order.
    killer : str or None
        Source at which workers died, and how often. The rows are then provisional and there is no file.
    log : ShardLog
        What the worker noted.
    """

    shard: int
    path: str | None
    bytes: int
    sha256: str | None
    rows: tuple[Row, ...]
    killer: str | None = None
    log: ShardLog = field(default_factory=ShardLog)

    def entry(self) -> dict[str, Any]:
        """Return the shard's entry in ``dataset.json``."""
        return {
            **({"provisional": True} if self.killer else {}),
            **({"self_test": self.log.self_test} if self.log.self_test else {}),
            "file": None if self.path is None else f"shards/{shard_name(self.shard)}",
            "pairs": sum(row["status"] == "ok" for row in self.rows),
            "failed": sum(row["status"] == "failed" for row in self.rows),
            "bytes": self.bytes,
            "sha256": self.sha256,
        }

    def report(self) -> ShardReport:
        """Describe the shard for the coordinator."""
        images = [rows[0] for rows in group_by_image(self.rows)]
        failed = [row for row in images if row["status"] == "failed"]
        details = [f"{row['source']}: {row['reason']}: {row['detail']}" for row in failed[:FAILURES_SHOWN]]
        failures = () if self.killer else (*details, *self.log.notes[:FAILURES_SHOWN])
        counts = len(images), len(failed), len(self.rows)
        return ShardReport(self.shard, *counts, self.killer, self.log, failures)


@dataclass(frozen=True, slots=True)
class ShardReport:
    """Describe a committed shard.

    Attributes
    ----------
    shard : int
        Number of the shard.
    images, failed, rows : int
        Number of its sources, of those that failed, and of its rows.
    killer, log
        As in `ShardResult`.
    failures : tuple of str
        The first sources that failed, and why.
    """

    shard: int
    images: int
    failed: int
    rows: int
    killer: str | None = None
    log: ShardLog = field(default_factory=ShardLog)
    failures: tuple[str, ...] = ()


COUNTS = tuple(field.name for field in fields(Counts))
"""Columns of the manifest that count sites."""


@dataclass(slots=True)
class Tally:
    """Count the rows of a dataset.

    Attributes
    ----------
    pairs : int
        Rows with status ``ok``.
    failed : dict of str to int
        Failed rows by reason.
    sites : dict of str to int
        Sum over all pairs of width x height (``all``) and of each of the manifest's counts (`COUNTS`).
    filtered : int
        Rows with status ``filtered``; ``dataset.json`` omits 0.
    """

    pairs: int = 0
    failed: dict[str, int] = field(default_factory=dict)
    sites: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("all", *COUNTS), 0))
    filtered: int = 0

    @classmethod
    def of(cls, rows: Iterable[Row]) -> Tally:
        """Count rows."""
        tally = cls()
        for row in rows:
            tally.add_row(row)
        return tally

    def add_row(self, row: Row) -> None:
        """Count one row."""
        if row["status"] == "filtered":
            self.filtered += 1
            return
        if row["status"] == "failed":
            self.failed[str(row["reason"])] = self.failed.get(str(row["reason"]), 0) + 1
            return
        self.pairs += 1
        if not has_frames(row):
            return
        self.sites["all"] += int(row["width"] or 0) * int(row["height"] or 0)
        for name in COUNTS:
            self.sites[name] += int(row[name] or 0)

    def add(self, other: Tally) -> None:
        """Add the counts of other rows."""
        self.pairs += other.pairs
        self.filtered += other.filtered
        for mine, others in ((self.failed, other.failed), (self.sites, other.sites)):
            for name, count in others.items():
                mine[name] = mine.get(name, 0) + count

    def facts(self) -> dict[str, Any]:
        """Counts as ``dataset.json`` holds them."""
        filtered = {"filtered": self.filtered} if self.filtered else {}
        failed = dict(sorted(self.failed.items()))
        return {"pairs": self.pairs, "failed": failed, **filtered, "sites": dict(self.sites)}
