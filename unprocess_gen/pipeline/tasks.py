"""Define what a coordinator and its workers exchange: the context of a run, and task, result and report of a shard."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from unprocess_gen.config.schema import Config
from unprocess_gen.core.types import NO_CLIP, DarkFrames, Row, Source, Value
from unprocess_gen.dataset.keys import group_by_image
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.sources.dark_frames import DarkFolder, open_dark_frames

Item = TypeVar("Item")


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
    def decoding(self) -> Iterator[None]:
        """Add the time of the body to ``decode_s``, even if it fails."""
        started = time.thread_time()
        try:
            yield
        finally:
            self.decode_s += time.thread_time() - started

    @contextmanager
    def simulating(self) -> Iterator[None]:
        """Add the time of the body to ``simulate_s``."""
        started = time.thread_time()
        try:
            yield
        finally:
            self.simulate_s += time.thread_time() - started

    def each_simulated(self, pairs: Iterable[Item]) -> Iterator[Item]:
        """Yield the items, and add the time that each of them takes to ``simulate_s``."""
        remaining = iter(pairs)
        while True:
            with self.simulating():
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
class RunContext:
    """Hold what all tasks of a run share.

    Attributes
    ----------
    config : Config
        The config; its ``out`` is where shards are committed.
    scratch : str
        Local folder for unfinished files.
    coordinator_pid : int or None
        Process that started the workers, with which they end; None if they end on their own.
    core_to_spare : bool
        Whether each worker hashes and writes in a second thread (more cores than workers).
    counts_deaths : bool
        Whether the deaths of workers at a shard are counted below ``out`` (`deaths`), because nothing else sees them.
    marker : str
        Name below ``out`` of the file that contains the index of the source in progress; empty without one.
    on_compiling : callable or None
        Called before kernels are compiled; None for contexts that travel to workers, which write `compiling_path`.
    dark_frames, dark_folder : DarkFrames, DarkFolder, or None
        The dark frames of the config, and access to their pixels; None if it uses none, or a worker is to read them.
    """

    config: Config
    scratch: str
    coordinator_pid: int | None
    core_to_spare: bool = False
    counts_deaths: bool = False
    marker: str = ""
    on_compiling: Callable[[], object] | None = None
    dark_frames: DarkFrames | None = None
    dark_folder: DarkFolder | None = None

    def dark(self) -> tuple[DarkFrames | None, DarkFolder | None]:
        """Return the dark frames of the config, and access to their pixels; this process reads them if it has to."""
        if self.dark_folder is None:
            return open_dark_frames(self.config)[1:]
        return self.dark_frames, self.dark_folder

    def report_compiling(self) -> None:
        """Report that this process is about to compile kernels."""
        self.compiling_path.touch()
        if self.on_compiling is not None:
            self.on_compiling()

    @property
    def compiling_path(self) -> Path:
        """The file that a worker creates before it compiles kernels."""
        return Path(self.scratch) / "compiling"


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
    self_test : str or None
        Failures of the worker's self-test, if ``self_test=go_on`` accepts them.
    times : StageTimes
        Processor time of the worker's stages.
    """

    shard: int
    path: str | None
    bytes: int
    sha256: str | None
    rows: tuple[Row, ...]
    killer: str | None = None
    self_test: str | None = None
    times: StageTimes = field(default_factory=StageTimes)

    def entry(self) -> dict[str, Any]:
        """Return the shard's entry in ``dataset.json``."""
        pairs = sum(row["status"] == "ok" for row in self.rows)
        return {
            **({"provisional": True} if self.killer else {}),
            **({"self_test": self.self_test} if self.self_test else {}),
            "file": None if self.path is None else f"shards/{shard_name(self.shard)}",
            "pairs": pairs,
            "failed": len(self.rows) - pairs,
            "bytes": self.bytes,
            "sha256": self.sha256,
            **self._source_noise(),
        }

    def _source_noise(self) -> dict[str, list[Value]]:
        """Return the column ``source_noise_dn`` of each image, from which a lost manifest is restored."""
        pairs = (row for row in self.rows if row["status"] == "ok")
        values = [of_image[0]["source_noise_dn"] for of_image in group_by_image(pairs)]
        return {"source_noise_dn": values} if any(value is not None for value in values) else {}

    def report(self) -> ShardReport:
        """Return what the coordinator needs to know of the shard."""
        of_images = [rows[0] for rows in group_by_image(self.rows)]
        clips = {
            (str(row["clip"]), int(row["width"] or 0), int(row["height"] or 0)): None
            for row in self.rows
            if row["status"] == "ok" and row["clip"] != NO_CLIP and row["patch"] == 0
        }
        failed = sum(row["status"] == "failed" for row in of_images)
        return ShardReport(
            self.shard, len(of_images), failed, len(self.rows), tuple(clips), self.killer, self.self_test, self.times
        )


@dataclass(frozen=True, slots=True)
class ShardReport:
    """Describe a committed shard.

    Attributes
    ----------
    shard : int
        Number of the shard.
    images, failed, rows : int
        Number of its sources, of those that failed, and of its rows.
    frame_sizes : tuple of (str, int, int)
        Name of each clip with each width and height of its frames.
    killer, self_test, times
        As in `ShardResult`.
    """

    shard: int
    images: int
    failed: int
    rows: int
    frame_sizes: tuple[tuple[str, int, int], ...] = ()
    killer: str | None = None
    self_test: str | None = None
    times: StageTimes = field(default_factory=StageTimes)
