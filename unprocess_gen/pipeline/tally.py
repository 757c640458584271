"""Count the rows of a dataset: pairs, failures by reason, and clipped or saturated sites."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any

from unprocess_gen.core.types import Counts, Row

COUNTS = tuple(one.name for one in fields(Counts))
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
    """

    pairs: int = 0
    failed: dict[str, int] = field(default_factory=dict)
    sites: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("all", *COUNTS), 0))

    @classmethod
    def of(cls, rows: Iterable[Row]) -> Tally:
        """Return the counts of some rows."""
        tally = cls()
        for row in rows:
            tally.add_row(row)
        return tally

    def add_row(self, row: Row) -> None:
        """Count one row."""
        if row["status"] != "ok":
            self.failed[str(row["reason"])] = self.failed.get(str(row["reason"]), 0) + 1
            return
        self.pairs += 1
        self.sites["all"] += int(row["width"] or 0) * int(row["height"] or 0)
        for name in COUNTS:
            self.sites[name] += int(row[name] or 0)

    def add(self, other: Tally) -> None:
        """Add the counts of other rows."""
        self.pairs += other.pairs
        for mine, others in ((self.failed, other.failed), (self.sites, other.sites)):
            for name, count in others.items():
                mine[name] = mine.get(name, 0) + count

    def facts(self) -> dict[str, Any]:
        """Return the counts as ``dataset.json`` holds them."""
        return {"pairs": self.pairs, "failed": dict(sorted(self.failed.items())), "sites": dict(self.sites)}
