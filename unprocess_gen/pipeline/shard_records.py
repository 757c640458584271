"""Commit shards and keep their records: rows and entry of each shard, until ``manifest.csv`` exists.

A worker puts a shard in place first and its record second, so the record is the commit: a shard with a record is
complete. Any number of writers may commit the same shard, because all of them make the same bytes.
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
from unprocess_gen.dataset.manifest import current_text, row_of_values, rows_text
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.storage import Storage
from unprocess_gen.pipeline.tally import Tally
from unprocess_gen.pipeline.tasks import ShardReport, ShardResult

ROWS = ".work/rows"
"""Folder of the records below ``out``."""


def commit_shard(storage: Storage, result: ShardResult) -> None:
    """Put a finished shard in place, then its record; raise OSError if the storage fails.

    The record holds the lines of the manifest, so that the end of a run only joins them.
    """
    if result.path is not None:
        storage.commit(Path(result.path), f"shards/{shard_name(result.shard)}")
    report = result.report()
    record = {
        "entry": result.entry(),
        "report": [report.images, report.failed, report.rows, report.frame_sizes],
        "tally": Tally.of(result.rows).facts(),
        "columns": len(NAMES),
        "csv": rows_text(result.rows),
    }
    storage.write(record_name(result.shard), json.dumps(record, separators=(",", ":")))


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
    csv : str
        Lines of the manifest.
    """

    entry: dict[str, Any]
    report: ShardReport
    tally: Tally
    csv: str


def record_name(shard: int) -> str:
    """Return the name of a shard's record below ``out``."""
    return f"{ROWS}/{shard:05d}.json"


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
        """Return which of some shards are committed: their record is readable, not provisional, and fits the file."""
        sizes = self._storage.names("shards")
        candidates = sorted(self.recorded(shards))
        are_committed = self._storage.each(
            lambda shard: self._is_committed(shard, sizes.get(shard_name(shard))), candidates
        )
        return {shard for shard, is_committed in zip(candidates, are_committed, strict=True) if is_committed}

    def recorded(self, shards: Iterable[int]) -> set[int]:
        """Return which of some shards have a record, provisional ones included."""
        names = self._storage.names(ROWS)
        return {shard for shard in shards if Path(record_name(shard)).name in names}

    def is_committed(self, shard: int) -> bool:
        """Return whether one shard is committed."""
        return self._is_committed(shard, self._storage.size(f"shards/{shard_name(shard)}"))

    def _is_committed(self, shard: int, size: int | None) -> bool:
        try:
            entry = self._read(shard)["entry"]
            return not entry.get("provisional") and (entry["file"] is None or entry["bytes"] == size)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return False

    def record(self, shard: int) -> ShardRecord:
        """Return the record of a shard; raise DamageError if it cannot be read."""
        try:
            found = self._read(shard)
            if "rows" in found:
                return _old_record(shard, found)
            images, failed, rows, sizes = found["report"]
            report = ShardReport(shard, images, failed, rows, tuple((clip, int(w), int(h)) for clip, w, h in sizes))
            text = current_text(found["csv"], found["columns"])
            return ShardRecord(dict(found["entry"]), report, Tally(**found["tally"]), text)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise DamageError(
                f"{self._place}/{record_name(shard)}: cannot be read ({error_in_one_line(error)}); delete the file and "
                "rerun to make its shard"
            ) from error

    def _read(self, shard: int) -> dict[str, Any]:
        record: dict[str, Any] = json.loads(self._storage.read(record_name(shard)))
        return record


def _old_record(shard: int, found: dict[str, Any]) -> ShardRecord:
    """Return the record of a shard that version 0.1 committed, with values of rows instead of lines."""
    rows = tuple(row_of_values(values) for values in found["rows"])
    report = ShardResult(shard, None, 0, None, rows).report()
    return ShardRecord(dict(found["entry"]), report, Tally.of(rows), rows_text(rows))
