"""Records of shards: a shard is done when its record exists.

``.work/rows/00000.json`` is a line of JSON, then the shard's lines of the manifest. A worker puts the tar in place
first and the record second, so the record is the commit. Any number of writers may commit a shard, to the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from unprocess_gen.core.records import Count, check_record, parse_record
from unprocess_gen.dataset.dataset_json import ShardFacts, check_shard
from unprocess_gen.dataset.manifest import rows_text
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.folder import WORK, OutFolder
from unprocess_gen.pipeline.tasks import ShardReport, ShardResult, Tally

ROWS = f"{WORK}/rows"


class _RecordFacts(msgspec.Struct, frozen=True):
    entry: dict[str, Any]
    tally: Tally
    csv_bytes: Count


class ShardRecord(NamedTuple):
    """Record of a shard: its entry in ``dataset.json``, counts of its rows, and its lines of the manifest."""

    entry: dict[str, Any]
    tally: Tally
    csv: bytes


def commit_shard(folder: OutFolder, result: ShardResult, columns: Sequence[str]) -> ShardReport:
    """Put a finished shard in place, then its record; raise OSError if the storage fails."""
    if result.path is not None:
        (folder / tar_name(result.shard)).commit(Path(result.path))
    csv = rows_text(result.rows, columns).encode()
    facts = {"entry": result.entry(), "tally": Tally.of(result.rows).facts(), "csv_bytes": len(csv)}
    folder.write(_file(result.shard), json.dumps(facts, separators=(",", ":")).encode() + b"\n" + csv)
    return result.report()


def done_shards(folder: OutFolder, shards: range) -> set[int]:
    """Find the shards that are done: their record has no provisional row."""
    records = zip(shards, read_records(folder, shards), strict=True)
    return {shard for shard, record in records if record is not None and not record.entry.get("provisional")}


def read_records(folder: OutFolder, shards: range) -> Iterator[ShardRecord | None]:
    """Read the records of shards in order; None if there is none, it cannot be read, or the tar has another size.

    Consecutive shards are looked up in listings, those of a part one by one.
    """
    if shards.step > 1:
        return folder.path.map(lambda shard: _read(folder, shard, (folder / tar_name(shard)).size), shards)
    recorded, sizes = (folder / ROWS).entries(), (folder / "shards").entries()

    def read(shard: int) -> ShardRecord | None:
        is_recorded = Path(_file(shard)).name in recorded
        return _read(folder, shard, lambda: sizes.get(shard_name(shard))) if is_recorded else None

    return folder.path.map(read, shards)


def tar_name(shard: int) -> str:
    """Name of a shard's file below ``out``."""
    return f"shards/{shard_name(shard)}"


def _read(folder: OutFolder, shard: int, tar_bytes: Callable[[], int | None]) -> ShardRecord | None:
    try:
        line, _, csv = folder.read(_file(shard)).partition(b"\n")
        facts = parse_record(line, _RecordFacts)
        check_shard(shard, check_record(facts.entry, ShardFacts))
    except (OSError, ValueError):
        return None
    fits = facts.entry["file"] is None or facts.entry["bytes"] == tar_bytes()
    return ShardRecord(facts.entry, facts.tally, csv) if fits and len(csv) == facts.csv_bytes else None


def _file(shard: int) -> str:
    return f"{ROWS}/{shard:05d}.json"
