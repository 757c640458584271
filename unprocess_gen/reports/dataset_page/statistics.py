"""Count and summarise the rows of a manifest in one pass, with memory that does not grow with the number of rows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.types import Float, Row
from unprocess_gen.dataset.keys import image_key

FAILURES_LISTED, VALUES_LISTED = 50, 16
"""Failed rows, and values of a text column, that are listed; more are only counted."""

BATCH_ROWS = 512


class Histogram:
    """Count values in at most `BINS` bins whose width doubles as the range grows.

    The bin width is 2**exponent and bin edges are integer multiples of it, so that two adjacent bins merge exactly into
    one of twice the width. No value is stored.
    """

    BINS = 48
    FINEST_EXPONENT = -60

    def __init__(self) -> None:
        self.exponent = self.FINEST_EXPONENT
        self.counts: dict[int, int] = {}
        self.number = 0
        self.total = 0.0
        self.least, self.greatest = math.inf, -math.inf

    def add(self, values: Float) -> None:
        """Count finite values, ``[N]``."""
        if not values.size:
            return
        self.number += values.size
        self.total += float(values.sum())
        self.least = min(self.least, float(values.min()))
        self.greatest = max(self.greatest, float(values.max()))
        while self._bin(self.greatest) - self._bin(self.least) >= self.BINS:
            self.counts = _merge_bins(self.counts)
            self.exponent += 1
        bins, counts = np.unique(np.floor(values * 2.0**-self.exponent), return_counts=True)
        for index, count in zip(map(int, bins), map(int, counts), strict=True):
            self.counts[index] = self.counts.get(index, 0) + count

    def _bin(self, value: float) -> int:
        return math.floor(value * 2.0**-self.exponent)

    @property
    def mean(self) -> float:
        """Mean of all values."""
        return self.total / self.number

    def bars(self) -> list[int]:
        """Return the counts of adjacent bins from the least to the greatest value; fewer values give fewer bars."""
        counts, most = self.counts, max(8, math.ceil(2 * self.number ** (1 / 3)))
        while max(counts) - min(counts) >= most:
            counts = _merge_bins(counts)
        return [counts.get(index, 0) for index in range(min(counts), max(counts) + 1)]


def _merge_bins(counts: Mapping[int, int]) -> dict[int, int]:
    """Return the counts in bins of twice the width."""
    merged: dict[int, int] = {}
    for index, count in counts.items():
        merged[index // 2] = merged.get(index // 2, 0) + count
    return merged


class ValueCounts:
    """Count how often each text value occurs, for up to `MOST` different values."""

    MOST = 64

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.others = 0

    def add(self, value: str) -> None:
        """Count one value."""
        if value in self.counts or len(self.counts) < self.MOST:
            self.counts[value] = self.counts.get(value, 0) + 1
        else:
            self.others += 1

    def summary(self) -> str:
        """Return the values, most frequent first, with their counts; a single value without one."""
        ranked = sorted(self.counts.items(), key=lambda item: (-item[1], item[0]))
        if len(ranked) == 1:
            return ranked[0][0]
        if self.others or (len(ranked) > 3 and ranked[0][1] == 1):
            return f"{'more than ' if self.others else ''}{len(ranked)} different values"
        rest = sum(count for _, count in ranked[VALUES_LISTED:])
        listed = [f"{value} ({count:,})" for value, count in ranked[:VALUES_LISTED]]
        return ", ".join([*listed, *([f"others ({rest:,})"] if rest else [])])


class ParameterColumn(NamedTuple):
    """A numeric column that is drawn or derived from draws, and the `plan.PARAMETERS` that decide it."""

    column: str
    draws: tuple[str, ...] = ()
    physical: bool = False
    empty_is_zero: bool = True


PARAMETER_COLUMNS = (
    *(
        ParameterColumn(f"w_{name}", (f"weight_{index}", "choice"))
        for index, name in enumerate(("nexus_6p", "sony_a7r", "olympus_em10", "sony_rx100"))
    ),
    ParameterColumn("red_gain", ("red",)),
    ParameterColumn("blue_gain", ("blue",)),
    ParameterColumn("inverse_rgb_gain", ("inverse_rgb",)),
    ParameterColumn("exposure_ratio", ("exposure_ratio",)),
    ParameterColumn("a_dn", ("a", "iso")),
    ParameterColumn("b_dn2", ("b", "read_std")),
    ParameterColumn("iso", ("iso",), physical=True),
    ParameterColumn("exposure_s", ("exposure_s",), physical=True),
    ParameterColumn("temperature_c", ("temperature_c",), physical=True),
    ParameterColumn("dn_per_e", physical=True),
    ParameterColumn("dark_e", physical=True),
    ParameterColumn("read_shape", ("read_shape",), physical=True),
    ParameterColumn("read_std_dn", ("read_std",), physical=True),
    ParameterColumn("row_std_dn", ("row_std",), physical=True),
    ParameterColumn("column_std_dn", ("column_std",), physical=True),
    ParameterColumn("column_temporal_std_dn", ("column_temporal_std",), physical=True),
    ParameterColumn("source_noise_dn", empty_is_zero=False),
)
"""Numeric columns that the report shows; ``physical`` ones only for physical noise profiles."""

TEXT_COLUMNS = (
    *("camera", "sensor_unit", "scene", "noise", "noise_law", "tone", "gamma", "highlight", "pattern", "accuracy"),
)
SITE_COLUMNS = (
    *("clean_clipped_low", "clean_clipped_high", "noisy_clipped_low", "noisy_clipped_high"),
    *("saturated", "zero_variance"),
)
"""Columns that count CFA sites; the report shows them as fractions of a frame."""


class ColumnStatistics:
    """Histograms of a numeric column: of the values, and of the base-2 logarithms of the positive ones."""

    LOGARITHMIC_RATIO = 20.0
    """Ratio of greatest to least value from which the logarithmic histogram is shown."""

    def __init__(self) -> None:
        self.linear = Histogram()
        self.log2 = Histogram()

    def add(self, values: Float) -> None:
        """Count values, ``[N]``."""
        self.linear.add(values)
        self.log2.add(np.log2(values[values > 0]))

    @property
    def is_logarithmic(self) -> bool:
        """True if the column is shown on a logarithmic scale."""
        return self.linear.least > 0 and self.linear.greatest >= self.LOGARITHMIC_RATIO * self.linear.least

    @property
    def is_constant(self) -> bool:
        """True if all values are equal."""
        return self.linear.least == self.linear.greatest


@dataclass
class OmittedEffect:
    """An effect that was not simulated: number of pairs, first reason, and whether all pairs have that reason."""

    pairs: int
    reason: str
    same_reason: bool = True


class FailedRow(NamedTuple):
    """A row without a pair; ``detail`` is the explanation, empty in datasets of version 0.1."""

    key: str
    source: str
    reason: str
    detail: str


@dataclass
class ManifestStatistics:
    """Counts and histograms of a manifest's rows.

    ``first_pair`` is the key and the shard number of the first pair, None without any pair.
    """

    rows: int = 0
    images: int = 0
    failed: list[FailedRow] = field(default_factory=list)
    parameters: dict[str, ColumnStatistics] = field(
        default_factory=lambda: {parameter.column: ColumnStatistics() for parameter in PARAMETER_COLUMNS}
    )
    site_fractions: dict[str, ColumnStatistics] = field(
        default_factory=lambda: {name: ColumnStatistics() for name in SITE_COLUMNS}
    )
    texts: dict[str, ValueCounts] = field(default_factory=lambda: {name: ValueCounts() for name in TEXT_COLUMNS})
    sizes: ValueCounts = field(default_factory=ValueCounts)
    effects: ValueCounts = field(default_factory=ValueCounts)
    omitted: dict[str, OmittedEffect] = field(default_factory=dict)
    physical: bool = False
    first_pair: tuple[str, int] | None = None
    _image: str = ""

    @classmethod
    def of_rows(cls, rows: Iterable[Row]) -> ManifestStatistics:
        """Return the statistics of rows in the order of the manifest."""
        statistics = cls()
        for batch in _batches(rows):
            statistics.add(batch)
        return statistics

    def add(self, rows: Sequence[Row]) -> None:
        """Count some rows, in the order of the manifest."""
        self.rows += len(rows)
        pairs = [row for row in rows if row["status"] == "ok"]
        for row in rows:
            self._add_image(row)
            if row["status"] != "ok" and len(self.failed) < FAILURES_LISTED:
                detail = str(row.get("detail") or "")
                self.failed.append(FailedRow(str(row["key"]), str(row["source"]), str(row["reason"]), detail))
        for row in pairs:
            self._add_texts(row)
        sites = np.array([float(row["width"] or 0) * float(row["height"] or 0) for row in pairs])
        for parameter in PARAMETER_COLUMNS:
            self.parameters[parameter.column].add(_numbers(pairs, parameter.column, parameter.empty_is_zero))
        for name, statistics in self.site_fractions.items():
            statistics.add(_numbers(pairs, name) / sites)

    def _add_image(self, row: Row) -> None:
        image = image_key(row)
        self.images += image != self._image
        self._image = image

    def _add_texts(self, row: Row) -> None:
        self.first_pair = self.first_pair or (str(row["key"]), int(row["shard"] or 0))
        self.physical |= row["read_law"] != "none"
        self.sizes.add(f"{row['width']} × {row['height']}")
        for name, counts in self.texts.items():
            counts.add(str(row[name]))
        for effect in str(row["effects"]).split(";"):
            self.effects.add(effect)
        for text in filter(None, str(row["skipped"]).split(";")):
            self._add_omitted(*text.partition(": ")[::2])

    def _add_omitted(self, effect: str, reason: str) -> None:
        known = self.omitted.setdefault(effect, OmittedEffect(0, reason))
        known.pairs += 1
        known.same_reason &= reason == known.reason


def _batches(rows: Iterable[Row]) -> Iterator[list[Row]]:
    rows = iter(rows)
    return iter(lambda: list(itertools.islice(rows, BATCH_ROWS)), [])


def _numbers(rows: Sequence[Row], name: str, empty_is_zero: bool = True) -> Float:
    values = (row[name] for row in rows)
    return np.array([float(value or 0) for value in values if empty_is_zero or value is not None], dtype=np.float64)
