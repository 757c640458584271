"""Keep the records of a run below ``.work`` until the dataset is finished: its sources, its shards, and deaths.

    .work/listing.json          number of sources, and digests of the files of sources; written after them
    .work/sources/00000.json    sources 0 to 4095, one list of values for each
    .work/rows/00000.json       record of a committed shard: a line of JSON, then the shard's lines of the manifest
    .work/deaths/00000-NAME     an attempt to make a shard in a run without a coordinator

A process that generates some of the shards reads only the files of their sources. A resumed run compares its own
listing with the record.

A worker puts a shard in place first and its record second, so the record is the commit: a shard with a record is
complete. Any number of writers may commit the same shard, because all of them make the same bytes.

A worker creates a file of deaths before it generates a shard and removes it afterwards. A file that remains is a death,
whatever ended the process: a signal, a lack of memory, the end of a batch job. From the second attempt on, the file
contains the index of the source in progress.
"""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.records import Count, Digest, check_record, parse_record
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.dataset_json import ShardFacts, check_shard
from unprocess_gen.dataset.manifest import rows_text
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.storage import WORK, Storage
from unprocess_gen.pipeline.tasks import ShardReport, ShardResult, Tally

# ------------------------------------------------------------------------------------------------------------- sources

PER_FILE = 4096
"""Sources in a file of the record."""

INDEX = f"{WORK}/listing.json"

_FIELDS = tuple(field.name for field in fields(Source))


class ListingIndex(msgspec.Struct, frozen=True):
    """Hold the number of sources, and the SHA-256 of each file of sources."""

    sources: Count
    sha256: list[Digest]

    def __post_init__(self) -> None:
        if len(self.sha256) != -(-self.sources // PER_FILE):
            raise ValueError(f"{len(self.sha256)} files for {self.sources} sources")


def text_sha256(text: str) -> str:
    """SHA-256 of a text, 64 hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()


def _sources_file(number: int) -> str:
    return f"{WORK}/sources/{number:05d}.json"


def write_listing(storage: Storage, sources: Sequence[Source]) -> None:
    """Record the sources of a run.

    Raises ConfigError if another process has begun to record other sources: files of the record are never replaced.
    """
    digests: list[str] = []
    for first in range(0, len(sources), PER_FILE):
        rows = [[getattr(source, name) for name in _FIELDS] for source in sources[first : first + PER_FILE]]
        text = json.dumps(rows, separators=(",", ":"))
        _create(storage, _sources_file(len(digests)), text)
        digests.append(text_sha256(text))
    _create(storage, INDEX, json.dumps({"sources": len(sources), "sha256": digests}))


def _create(storage: Storage, name: str, text: str) -> None:
    if not storage.create(name, text) and storage.read_bytes(name) != text.encode():
        raise ConfigError(
            f"out={storage.out}: was begun with other sources ({name} differs); choose another out, or remove it"
        )


class RecordedListing:
    """Read the recorded sources of a run; the file that was read last is kept.

    Raises MachineError if it cannot be read.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._index = storage.record(INDEX, lambda content: parse_record(content, ListingIndex))
        self._last: tuple[int, list[Source]] = (-1, [])

    @property
    def count(self) -> int:
        """Number of sources."""
        return self._index.sources

    def sources(self, first: int, last: int) -> Iterator[Source]:
        """Yield the sources from index ``first`` to before ``last``."""
        for number in range(first // PER_FILE, -(-last // PER_FILE)):
            if self._last[0] != number:
                self._last = number, self._storage.record(_sources_file(number), partial(self._parse, number))
            yield from (source for source in self._last[1] if first <= source.index < last)

    def _parse(self, number: int, content: bytes) -> list[Source]:
        if hashlib.sha256(content).hexdigest() != self._index.sha256[number]:
            raise ValueError(f"its SHA-256 differs from that in {INDEX}")
        rows = parse_record(content, list[list[Any]])
        return check_record([dict(zip(_FIELDS, row, strict=False)) for row in rows], list[Source])


def recorded_sources(storage: Storage) -> Iterator[Source]:
    """Yield every recorded source; nothing without a record."""
    if (storage / INDEX).is_listed():
        listing = RecordedListing(storage)
        yield from listing.sources(0, listing.count)


# -------------------------------------------------------------------------------------------------------------- shards

ROWS = f"{WORK}/rows"
"""Folder of the records of shards."""


def commit_shard(storage: Storage, result: ShardResult, columns: Sequence[str]) -> ShardReport:
    """Put a finished shard in place, then its record, and describe it; raise OSError if the storage fails.

    ``columns`` are those of the manifest.
    """
    if result.path is not None:
        (storage / f"shards/{shard_name(result.shard)}").commit(Path(result.path))
    report = result.report()
    csv = rows_text(result.rows, columns)
    facts = {
        "entry": result.entry(),
        "tally": Tally.of(result.rows).facts(),
        "csv_bytes": len(csv.encode()),
    }
    storage.write(record_name(result.shard), json.dumps(facts, separators=(",", ":")) + "\n" + csv)
    return report


class _ShardFacts(msgspec.Struct, frozen=True):
    """Hold the first line of a record."""

    entry: dict[str, Any]
    tally: Tally
    csv_bytes: Count


class ShardRecord(NamedTuple):
    """Hold the record of a committed shard.

    Attributes
    ----------
    entry : dict
        Entry in ``dataset.json``.
    tally : Tally
        Counts of the rows.
    csv : bytes
        Lines of the manifest.
    """

    entry: dict[str, Any]
    tally: Tally
    csv: bytes


def _parse_shard(shard: int, content: bytes) -> ShardRecord:
    """Parse a record; ValueError if it is none, or the lines of the manifest are incomplete."""
    line, _, csv = content.partition(b"\n")
    facts = parse_record(line, _ShardFacts)
    check_shard(shard, check_record(facts.entry, ShardFacts))
    if len(csv) != facts.csv_bytes:
        raise ValueError(f"{len(csv)} bytes of rows; expected {facts.csv_bytes}")
    return ShardRecord(facts.entry, facts.tally, csv)


def record_name(shard: int) -> str:
    """Name of a shard's record below ``out``."""
    return f"{ROWS}/{shard:05d}.json"


class ShardRecords:
    """Read the records of committed shards of a storage."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage

    def committed(self, shards: Iterable[int]) -> set[int]:
        """Find the committed ones among shards: their record is readable, not provisional, and fits the file."""
        sizes = (self._storage / "shards").entries()
        candidates = sorted(self.recorded(shards))
        are_committed = self._storage.path.map(
            lambda shard: self._is_committed(shard, sizes.get(shard_name(shard))), candidates
        )
        return {shard for shard, is_committed in zip(candidates, are_committed, strict=True) if is_committed}

    def recorded(self, shards: Iterable[int]) -> set[int]:
        """Find the shards that have a record, provisional ones included."""
        names = (self._storage / ROWS).entries()
        return {shard for shard in shards if Path(record_name(shard)).name in names}

    def _is_committed(self, shard: int, size: int | None) -> bool:
        try:
            entry = _parse_shard(shard, self._storage.read_bytes(record_name(shard))).entry
            return not entry.get("provisional") and (entry["file"] is None or entry["bytes"] == size)
        except (OSError, ValueError):
            return False

    def record(self, shard: int) -> ShardRecord:
        """Read the record of a shard; raise MachineError if it cannot be read."""
        return self._storage.record(record_name(shard), lambda content: _parse_shard(shard, content))


# -------------------------------------------------------------------------------------------------------------- deaths

DEATHS_FOLDER = f"{WORK}/deaths"

MAX_DEATHS = 4
"""Deaths at a shard after which it gets provisional rows: as many as Dask allows a task by default."""


class Deaths:
    """Hold the deaths at a shard before this attempt."""

    def __init__(self, storage: Storage, shard: int) -> None:
        self._storage, self._prefix = storage, f"{DEATHS_FOLDER}/{shard:05d}-"
        names = (f"{DEATHS_FOLDER}/{name}" for name in (storage / DEATHS_FOLDER).entries())
        self._names = [name for name in names if name.startswith(self._prefix)]

    @property
    def count(self) -> int:
        """Number of workers that died at the shard."""
        return len(self._names)

    def source(self, sources: Sequence[Source]) -> Source:
        """Source at which a worker died, as far as it is known; else the first of the shard."""
        indices = set[str]()
        for name in self._names:
            with suppress(OSError, ValueError):
                indices.add(self._storage.read(name))
        return next((source for source in sources if str(source.index) in indices), sources[0])

    @contextmanager
    def marked(self) -> Iterator[Callable[[Source], None]]:
        """Keep a file until this attempt ends or its process dies; yield a function that records the source."""
        name = f"{self._prefix}{uuid.uuid4().hex}"
        self._storage.write(name, "")

        def mark(source: Source) -> None:
            if self._names:
                self._storage.write(name, str(source.index))

        try:
            yield mark
        finally:
            (self._storage / name).delete()

    def forget(self) -> None:
        """Remove the files of earlier attempts."""
        for name in self._names:
            (self._storage / name).delete()
