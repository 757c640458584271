"""Commit shards and keep their records: rows and entry of each shard, until ``manifest.csv`` exists.

A worker puts a shard in place first and its record second, so the record is the commit: a shard with a record is
complete. Any number of writers may commit the same shard, because all of them make the same bytes.

A record is a line of JSON, then the shard's lines of the manifest. The end of a run only joins these lines.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import DamageError
from unprocess_gen.dataset.columns import NAMES
from unprocess_gen.dataset.manifest import current_lines, row_of_values, rows_text
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.storage import Storage
from unprocess_gen.pipeline.tally import Tally
from unprocess_gen.pipeline.tasks import ShardReport, ShardResult

ROWS = ".work/rows"
"""Folder of the records below ``out``."""


def commit_shard(storage: Storage, result: ShardResult) -> ShardReport:
    """Put a finished shard in place, then its record, and describe it; raise OSError if the storage fails."""
    if result.path is not None:
        storage.commit(Path(result.path), f"shards/{shard_name(result.shard)}")
    report = result.report()
    csv = rows_text(result.rows)
    facts = {
        "entry": result.entry(),
        "report": [report.images, report.failed, report.rows, report.frame_sizes],
        "tally": Tally.of(result.rows).facts(),
        "columns": len(NAMES),
        "csv_bytes": len(csv.encode()),
    }
    storage.write(record_name(result.shard), json.dumps(facts, separators=(",", ":")) + "\n" + csv)
    return report


@dataclass(frozen=True, slots=True)
class ShardRecord:
    """Hold the record of a committed shard.

    Attributes
    ----------
    entry : dict
        Entry in ``dataset.json``.
    report : ShardReport
        Without times.
    tally : Tally
        Counts of the rows.
    csv : bytes
        Lines of the manifest.
    """

    entry: dict[str, Any]
    report: ShardReport
    tally: Tally
    csv: bytes


def record_name(shard: int) -> str:
    """Return the name of a shard's record below ``out``."""
    return f"{ROWS}/{_file_name(shard)}"


def _file_name(shard: int) -> str:
    return f"{shard:05d}.json"


class ShardRecords:
    """Read the records of committed shards.

    Parameters
    ----------
    storage : Storage
        Where the dataset is written.
    place : str
        Name of the dataset in messages.
    """

    def __init__(self, storage: Storage, place: str) -> None:
        self._storage, self._place = storage, place

    def committed(self, shards: Iterable[int]) -> set[int]:
        """Find the committed ones among shards: their record is readable, not provisional, and fits the file."""
        sizes = self._storage.names("shards")
        candidates = sorted(self.recorded(shards))
        are_committed = self._storage.each(
            lambda shard: self._is_committed(shard, sizes.get(shard_name(shard))), candidates
        )
        return {shard for shard, is_committed in zip(candidates, are_committed, strict=True) if is_committed}

    def recorded(self, shards: Iterable[int]) -> set[int]:
        """Find the shards that have a record, provisional ones included."""
        names = self._storage.names(ROWS)
        return {shard for shard in shards if _file_name(shard) in names}

    def is_committed(self, shard: int) -> bool:
        """Check whether a shard is committed."""
        return self._is_committed(shard, self._storage.size(f"shards/{shard_name(shard)}"))

    def _is_committed(self, shard: int, size: int | None) -> bool:
        try:
            entry = self._read(shard)[0]["entry"]
            return not entry.get("provisional") and (entry["file"] is None or entry["bytes"] == size)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return False

    def record(self, shard: int) -> ShardRecord:
        """Return the record of a shard; raise DamageError if it cannot be read."""
        try:
            facts, csv = self._read(shard)
            if "rows" in facts:
                return _old_record(shard, facts)
            images, failed, rows, sizes = facts["report"]
            report = ShardReport(shard, images, failed, rows, tuple((clip, int(w), int(h)) for clip, w, h in sizes))
            return ShardRecord(
                dict(facts["entry"]), report, Tally(**facts["tally"]), current_lines(csv, facts["columns"])
            )
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise DamageError(
                f"{self._place}/{record_name(shard)}: cannot be read ({error_in_one_line(error)}); delete the file; "
                "gen-dataset, or gen-dataset part, then generates its shard"
            ) from error

    def _read(self, shard: int) -> tuple[dict[str, Any], bytes]:
        """Return the first line of a record, and its lines of the manifest."""
        line, _, csv = self._storage.read_bytes(record_name(shard)).partition(b"\n")
        facts: dict[str, Any] = json.loads(line)
        if len(csv) != facts.get("csv_bytes", 0):
            raise ValueError(f"{len(csv)} bytes of rows; expected {facts.get('csv_bytes', 0)}")
        return facts, csv


def _old_record(shard: int, facts: dict[str, Any]) -> ShardRecord:
    """Return the record of a shard that version 0.1 committed, with values of rows instead of lines."""
    rows = tuple(row_of_values(values) for values in facts["rows"])
    report = ShardResult(shard, None, 0, None, rows).report()
    return ShardRecord(dict(facts["entry"]), report, Tally.of(rows), rows_text(rows).encode())
