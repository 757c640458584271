"""Format benchmark measurements as CSV, as a table for terminals, and as a Markdown table."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import fields

from unprocess_gen.reports.benchmark.measure import Measurement
from unprocess_gen.reports.formatting import percentage, short_number

COLUMNS = tuple(column.name for column in fields(Measurement))

HEADINGS = ("stage", "method", "tiers", "max error", "RMS error", "unit", "changed", "ns per pixel", "of reference")

NUMERIC = frozenset({3, 4, 6, 7, 8})
"""Indices of the columns with numbers."""


def csv_text(rows: Sequence[Measurement]) -> str:
    """Return the contents of ``accuracy.csv``; values that were not measured are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        values = (getattr(row, name) for name in COLUMNS)
        writer.writerow([f"{value:.6g}" if isinstance(value, float) else value for value in values])
    return text.getvalue()


def table_cells(row: Measurement) -> tuple[str, ...]:
    """Return the cells of a measurement in the order of `HEADINGS`."""
    return (
        row.stage,
        row.method,
        row.tier,
        short_number(row.error_max),
        short_number(row.error_rms),
        row.error_unit,
        percentage(row.changed_share),
        short_number(row.ns_per_pixel, 3),
        percentage(row.ratio_to_reference),
    )


def text_table(rows: Sequence[Measurement]) -> str:
    """Return measurements as aligned lines for a terminal.

    Parameters
    ----------
    rows : sequence of Measurement
        The measurements.

    Returns
    -------
    str
        Headings and one line per measurement, without a final newline.
    """
    lines = [HEADINGS, *(table_cells(row) for row in rows)]
    widths = [max(len(line[index]) for line in lines) for index in range(len(HEADINGS))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if index in NUMERIC else cell.ljust(width)
            for index, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def markdown_table(rows: Sequence[Measurement]) -> str:
    """Return measurements as a Markdown table."""
    rule = "|".join("--:" if index in NUMERIC else "---" for index in range(len(HEADINGS)))
    lines = [f"| {' | '.join(HEADINGS)} |", f"|{rule}|"]
    return "\n".join([*lines, *(f"| {' | '.join(table_cells(row))} |" for row in rows)])
