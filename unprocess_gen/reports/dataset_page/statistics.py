"""Summarise the rows of a manifest in one pass, with memory that does not grow with their number."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.types import Float, Row
from unprocess_gen.dataset.columns import COLUMNS
from unprocess_gen.dataset.keys import image_key

FAILURES_LISTED, VALUES_LISTED = 50, 16
"""Failed rows, and values of a text column, that are listed."""

PAIRS_DRAWN = 20_000
"""Pairs whose numbers are kept for histograms; of more, evenly spaced ones are kept."""

BATCH_ROWS = 512

MEANINGS = {column.name: ", ".join(filter(None, (column.meaning, column.unit))) for column in COLUMNS}
"""Meaning and unit of each column."""

NUMBER_COLUMNS = tuple(
    column.name for column in COLUMNS if column.type is float and not column.name.startswith(("rgb2cam", "law_"))
)
TEXT_COLUMNS = (
    *("camera", "sensor_unit", "scene", "noise", "noise_law", "tone", "gamma", "highlight", "pattern", "accuracy"),
    "split",
)
SITE_COLUMNS = (
    *("clean_clipped_low", "clean_clipped_high", "noisy_clipped_low", "noisy_clipped_high"),
    *("saturated", "zero_variance"),
)
"""Columns that count CFA sites, summarised in percent of a frame."""

ALL_NUMBERS = (*NUMBER_COLUMNS, *SITE_COLUMNS)


class NumberSummary(NamedTuple):
    """Range and mean of a column, and its values in the pairs that are drawn, ``[N]``."""

    column: str
    least: float
    mean: float
    greatest: float
    values: Float


def add_value(counts: Counter[str], value: str) -> None:
    """Count a text value, unless more than `VALUES_LISTED` others were counted."""
    if value in counts or len(counts) <= VALUES_LISTED:
        counts[value] += 1


def values_text(counts: Counter[str]) -> str:
    """Return the values, most frequent first, with their counts; a single value without one."""
    ranked = counts.most_common()
    if len(ranked) == 1:
        return ranked[0][0]
    if len(ranked) > VALUES_LISTED:
        return f"more than {VALUES_LISTED} different values"
    if len(ranked) > 3 and ranked[0][1] == 1:
        return f"{len(ranked)} different values"
    return ", ".join(f"{value} ({count:,})" for value, count in ranked)


class ManifestStatistics:
    """Counts and ranges of a manifest's rows.

    Attributes
    ----------
    rows, images : int
        Number of rows, and of their images.
    first_pair : Row or None
        Row of the first pair.
    failed : list of Row
        The first failed rows.
    sizes, effects, omitted : Counter of str
        Pairs by size, and by effects that are simulated and omitted.
    texts, reasons : dict of str to Counter of str
        Values of text columns, and reasons of omitted effects.
    """

    def __init__(self, pairs: int) -> None:
        self.rows = self.images = 0
        self.first_pair: Row | None = None
        self.failed: list[Row] = []
        self.sizes, self.effects, self.omitted = Counter[str](), Counter[str](), Counter[str]()
        self.texts = {name: Counter[str]() for name in TEXT_COLUMNS}
        self.reasons: dict[str, Counter[str]] = defaultdict(Counter)
        self._step, self._image, columns = max(1, -(-pairs // PAIRS_DRAWN)), "", len(ALL_NUMBERS)
        self._range, self._total = np.full((2, columns), np.nan), np.zeros((2, columns))
        self._drawn, self._added = [np.empty((0, columns))], 0

    @property
    def numbers(self) -> dict[str, NumberSummary]:
        """The columns that are not empty."""
        (total, count), drawn, (least, greatest) = self._total, np.concatenate(self._drawn).T, self._range.tolist()
        mean = (total / np.maximum(count, 1)).tolist()
        return {
            name: NumberSummary(name, least[i], mean[i], greatest[i], drawn[i][~np.isnan(drawn[i])])
            for i, name in enumerate(ALL_NUMBERS)
            if count[i]
        }

    def add(self, rows: Sequence[Row]) -> None:
        """Count the next rows of the manifest."""
        self.rows += len(rows)
        for row in rows:
            self.images += image_key(row) != self._image
            self._image = image_key(row)
        failed = [row for row in rows if row["status"] == "failed"]
        self.failed += failed[: FAILURES_LISTED - len(self.failed)]
        if pairs := [row for row in rows if row["status"] == "ok"]:
            self.first_pair = self.first_pair or pairs[0]
            self._add_numbers(pairs)
            for row in pairs:
                self._add_texts(row)

    def _add_numbers(self, rows: Sequence[Row]) -> None:
        values = np.array([[row[name] for name in ALL_NUMBERS] for row in rows], dtype=np.float64)  # NaN: empty
        sites = np.array([[float(row["width"] or 0) * float(row["height"] or 0)] for row in rows])
        values[:, len(NUMBER_COLUMNS) :] *= 100 / sites
        least, greatest = self._range
        self._range = np.stack([np.fmin.reduce([least, *values]), np.fmax.reduce([greatest, *values])])
        self._total += np.nansum(values, axis=0), (~np.isnan(values)).sum(axis=0)
        self._drawn.append(values[-self._added % self._step :: self._step])
        self._added += len(rows)

    def _add_texts(self, row: Row) -> None:
        add_value(self.sizes, f"{row['width']} × {row['height']}")
        for name, counts in self.texts.items():
            add_value(counts, "" if row[name] is None else str(row[name]))
        self.effects.update(str(row["effects"]).split(";"))
        for text in filter(None, str(row["skipped"]).split(";")):
            effect, _, reason = text.partition(": ")
            self.omitted[effect] += 1
            add_value(self.reasons[effect], reason)


def read_statistics(rows: Iterable[Row], pairs: int) -> ManifestStatistics:
    """Summarise the rows of a manifest, of which ``pairs`` have frames."""
    statistics, rows = ManifestStatistics(pairs), iter(rows)
    while batch := list(itertools.islice(rows, BATCH_ROWS)):
        statistics.add(batch)
    return statistics
