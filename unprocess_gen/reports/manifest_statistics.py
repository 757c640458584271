"""Summarise the rows of a manifest in one pass, with memory that does not grow with their number."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.keys import group_by_image
from unprocess_gen.dataset.row import COLUMNS

FAILURES_LISTED, VALUES_LISTED = 50, 16
"""Failed rows, and values of a text column, that are listed."""

MEANINGS = {column.name: ", ".join(filter(None, (column.meaning, column.unit))) for column in COLUMNS}
"""Meaning and unit of each column."""

SITE_COLUMNS = (
    *("clean_clipped_low", "clean_clipped_high", "noisy_clipped_low", "noisy_clipped_high"),
    *("saturated", "zero_variance"),
)
"""Columns that count CFA sites."""

NUMBER_COLUMNS = tuple(
    column.name for column in COLUMNS if column.type is float and not column.name.startswith(("rgb2cam", "law_"))
)
TEXT_COLUMNS = (
    *("camera", "sensor_unit", "scene", "noise", "noise_law", "tone", "gamma", "highlight", "pattern", "accuracy"),
    *("split",),
)


@dataclass
class NumberSummary:
    """Range, sum and number of the values of a column."""

    least: float = math.inf
    greatest: float = -math.inf
    total: float = 0.0
    count: int = 0

    def add(self, value: float) -> None:
        """Add a value."""
        self.least, self.greatest = min(self.least, value), max(self.greatest, value)
        self.total += value
        self.count += 1


def add_value(counts: Counter[str], value: str) -> None:
    """Count a text value, unless more than `VALUES_LISTED` others were counted."""
    if value in counts or len(counts) <= VALUES_LISTED:
        counts[value] += 1


def values_text(counts: Counter[str]) -> str:
    """The values, most frequent first, with their counts; a single value without one."""
    if len(counts) > VALUES_LISTED:
        return f"more than {VALUES_LISTED} different values"
    return next(iter(counts)) if len(counts) == 1 else ", ".join(f"{name} ({n:,})" for name, n in counts.most_common())


@dataclass
class ManifestStatistics:
    """Counts and ranges of a manifest's rows: of all, of failed ones, and of pairs by size, number, text and effect."""

    rows: int = 0
    images: int = 0
    first_pair: Row | None = None
    failed: list[Row] = field(default_factory=list)
    sizes: Counter[str] = field(default_factory=Counter)
    effects: Counter[str] = field(default_factory=Counter)
    omitted: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    texts: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    numbers: dict[str, NumberSummary] = field(default_factory=lambda: defaultdict(NumberSummary))

    def add(self, row: Row) -> None:
        """Count a pair."""
        self.first_pair = self.first_pair or row
        add_value(self.sizes, f"{row['width']} × {row['height']}")
        self.effects.update(str(row["effects"]).split(";"))
        for text in filter(None, str(row["skipped"]).split(";")):
            effect, _, reason = text.partition(": ")
            add_value(self.omitted[effect], reason)
        for name in TEXT_COLUMNS:
            if row[name] is not None:
                add_value(self.texts[name], str(row[name]))
        for name in NUMBER_COLUMNS:
            if (value := row[name]) is not None:
                self.numbers[name].add(float(value))


def read_statistics(rows: Iterable[Row]) -> ManifestStatistics:
    """Summarise the rows of a manifest."""
    statistics = ManifestStatistics()
    for image in group_by_image(rows):
        statistics.images += 1
        statistics.rows += len(image)
        for row in image:
            if row["status"] == "ok":
                statistics.add(row)
            elif row["status"] == "failed" and len(statistics.failed) < FAILURES_LISTED:
                statistics.failed.append(row)
    return statistics
