"""Format benchmark measurements as CSV, as tables for terminals and pages, and as Markdown tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import fields

from unprocess_gen.reports.benchmark.complete_runs import RunMeasurement
from unprocess_gen.reports.benchmark.conclusion import RATIO_DIGITS, RECOMMENDATIONS
from unprocess_gen.reports.benchmark.measure import Measurement
from unprocess_gen.reports.formatting import percentage, short_number
from unprocess_gen.reports.html_pages import PageTable

COLUMNS = tuple(column.name for column in fields(Measurement))
RUN_COLUMNS = tuple(column.name for column in fields(RunMeasurement))


def csv_text(rows: Sequence[Measurement]) -> str:
    """Return the contents of ``accuracy.csv``; values that were not measured are empty."""
    return _csv(COLUMNS, rows)


def runs_csv_text(runs: Sequence[RunMeasurement]) -> str:
    """Return the contents of ``accuracy_runs.csv``; values that were not measured are empty."""
    return _csv(RUN_COLUMNS, runs)


def _csv(columns: Sequence[str], rows: Sequence[Measurement] | Sequence[RunMeasurement]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        values = (getattr(row, name) for name in columns)
        writer.writerow([f"{value:.6g}" if isinstance(value, float) else value for value in values])
    return text.getvalue()


# ------------------------------------------------------------------------------------------------------------- tables


def method_table(rows: Sequence[Measurement]) -> PageTable:
    """Return the table of methods and tiers, grouped by stage."""
    headings = ("stage", "method", "tiers", "max error", "RMS error", "unit", "changed", "ns per pixel", "of reference")
    return PageTable(headings, [_method_cells(row) for row in rows], {3, 4, 6, 7, 8}, _starts([r.stage for r in rows]))


def _method_cells(row: Measurement) -> tuple[str, ...]:
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


def run_table(runs: Sequence[RunMeasurement]) -> PageTable:
    """Return the table of complete runs, grouped by setting: time and its shares, then errors of the noisy frames."""
    headings = (
        *("settings", "noise", "tier", "of exact", "ns per pixel", "decode", "simulate", "write"),
        *("changed", "max DN", "RMS DN", "max σ", "RMS σ"),
    )
    numeric = set(range(3, len(headings)))
    return PageTable(headings, [_run_cells(run) for run in runs], numeric, _starts([run.setting for run in runs]))


def _run_cells(run: RunMeasurement) -> tuple[str, ...]:
    return (
        run.setting,
        run.noise,
        run.tier,
        short_number(run.ratio_to_exact, RATIO_DIGITS),
        short_number(run.ns_per_pixel, 3),
        percentage(run.decode_share),
        percentage(run.simulate_share),
        percentage(run.write_share),
        percentage(run.noisy_changed_share),
        short_number(run.noisy_max_dn),
        short_number(run.noisy_rms_dn),
        short_number(run.noisy_max_std),
        short_number(run.noisy_rms_std),
    )


def recommendation_table() -> PageTable:
    """Return the table of the tiers recommended for each use."""
    return PageTable(("use", "tier", "reason"), RECOMMENDATIONS, wrapped={2})


def _starts(groups: Sequence[str]) -> list[int]:
    """Return the indices at which a new group begins."""
    return [at for at, group in enumerate(groups) if at == 0 or group != groups[at - 1]]


# ------------------------------------------------------------------------------------------------------------- formats


def text_table(table: PageTable) -> str:
    """Return a table as aligned lines for a terminal.

    Parameters
    ----------
    table : PageTable
        The table.

    Returns
    -------
    str
        Headings and one line per row, without a final newline.
    """
    lines = [table.headings, *table.lines]
    widths = [max(len(line[index]) for line in lines) for index in range(len(table.headings))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if index in table.numeric else cell.ljust(width)
            for index, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def markdown_table(table: PageTable) -> str:
    """Return a table in Markdown.

    Parameters
    ----------
    table : PageTable
        The table.

    Returns
    -------
    str
        Headings, rule and one line per row, without a final newline.
    """
    rule = "|".join("--:" if index in table.numeric else "---" for index in range(len(table.headings)))
    lines = [f"| {' | '.join(table.headings)} |", f"|{rule}|"]
    return "\n".join([*lines, *(f"| {' | '.join(line)} |" for line in table.lines)])
