"""Write the report of a benchmark: ``accuracy.csv``, ``accuracy_runs.csv``, ``accuracy.png`` and ``accuracy.html``."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import astuple, fields
from functools import partial
from pathlib import Path

from unprocess_gen.reports.benchmark.complete_runs import RunMeasurement
from unprocess_gen.reports.benchmark.figure import benchmark_figure
from unprocess_gen.reports.benchmark.measure import BenchmarkReport, Measurement
from unprocess_gen.reports.benchmark.session import EXACT, FAST, GIVEN, REFERENCE
from unprocess_gen.reports.formatting import percentage, short_number
from unprocess_gen.reports.html_pages import PageTable, data_uri, render_page
from unprocess_gen.reports.report_files import write_files

__all__ = ["REPORT_FILES", "benchmark_page", "report_text", "write_benchmark"]

LINE_LENGTH = 120
"""Width of printed sentences."""

REPORT_FILES = ("accuracy.csv", "accuracy_runs.csv", "accuracy.png", "accuracy.html")

three_digits = partial(short_number, digits=3)


def report_text(report: BenchmarkReport) -> str:
    """Text that the verb prints: methods, complete runs, the conclusion, and the recommended tiers."""
    advice = (f"{use}: {tier}; {reason}" for use, tier, reason in RECOMMENDATIONS.lines)
    return "\n".join(
        [
            text_table(table(METHOD_COLUMNS, report.rows)),
            "",
            "complete runs, from files to committed shards: processor time and its shares; errors of the noisy frames",
            text_table(table(RUN_COLUMNS, report.runs)),
            "",
            textwrap.fill(conclude(report), LINE_LENGTH, break_on_hyphens=False),
            "",
            "recommended tiers",
            *(textwrap.fill(line, LINE_LENGTH, initial_indent="  ", subsequent_indent="    ") for line in advice),
        ]
    )


def write_benchmark(report: BenchmarkReport, out: Path) -> None:
    """Write the files of a report, replacing an earlier report; MachineError if that fails."""
    picture = benchmark_figure(report.rows, report.runs)
    texts = (csv_text(kind, rows) for kind, rows in ((Measurement, report.rows), (RunMeasurement, report.runs)))
    contents = (*(text.encode() for text in texts), picture, benchmark_page(report, picture).encode())
    write_files(out, dict(zip(REPORT_FILES, contents, strict=True)))


def benchmark_page(report: BenchmarkReport, picture: bytes) -> str:
    """``accuracy.html``, one file that contains the figure."""
    return render_page(
        "benchmark.html",
        title="Cost of accuracy",
        figure=data_uri(picture),
        conclusion=conclude(report),
        runs=table(RUN_COLUMNS, report.runs),
        recommendations=RECOMMENDATIONS,
        measurements=table(METHOD_COLUMNS, report.rows),
        conditions=report.conditions,
    )


# ----------------------------------------------------------------------------------------------------------- conclusion


RECOMMENDATIONS = PageTable(
    ("use", "tier", "reason"),
    (
        ("training data", EXACT, "fast shortens only the simulation; the table of runs shows what it saves"),
        ("benchmark whose files are published", EXACT, "every DN is that of the reference"),
        ("proof, or comparison with the article", REFERENCE, "NumPy code to read; the same DN as exact"),
        ("quick look", FAST, "its errors cannot be seen in pictures"),
    ),
    wrapped={2},
)
"""The tier recommended for each use."""


def conclude(report: BenchmarkReport) -> str:
    """One sentence about the given tier in runs with the given settings, or about `FAST` if `EXACT` is given."""
    compared = FAST if report.given_tier == EXACT else report.given_tier
    run = next(run for run in report.runs if (run.setting, run.tier) == (GIVEN, compared))
    what = f"In a complete run of {report.photographs} with noise={run.noise}"
    return f"{what}, the tier {run.tier} {time_clause(run)} and {error_clause(run)}."


def time_clause(run: RunMeasurement) -> str:
    """The time that a tier saves; a difference counts only if both quartiles of the ratios agree with it."""
    if run.ratio_to_exact is None or run.lower_quartile_ratio is None or run.upper_quartile_ratio is None:
        return "was too slow to be timed"
    ratio = three_digits(run.ratio_to_exact)
    ratios = (run.ratio_to_exact, run.lower_quartile_ratio, run.upper_quartile_ratio)
    if min(ratios) <= 1 <= max(ratios) or ratio == "1":
        return f"takes about as long as {EXACT} (ratio {ratio}, no clear difference)"
    return f"takes {ratio} {'of' if run.ratio_to_exact < 1 else 'times'} the processor time of {EXACT}"


def error_clause(run: RunMeasurement) -> str:
    """The errors of a tier."""
    if run.noisy_changed_share == 0:
        return "changes no noisy DN of the reference"
    largest = (
        f"{short_number(run.noisy_max_dn)} DN or {short_number(run.noisy_max_std)} standard deviations of the noise"
    )
    rms = f"RMS {short_number(run.noisy_rms_dn)} DN, {short_number(run.noisy_rms_std)} standard deviations"
    return f"moves {percentage(run.noisy_changed_share)} of the noisy DN, by at most {largest} ({rms})"


# --------------------------------------------------------------------------------------------------------------- tables


def csv_text(kind: type, rows: Sequence[Measurement] | Sequence[RunMeasurement]) -> str:
    """A CSV file with a column for each field of a kind of row; values that were not measured are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(column.name for column in fields(kind))
    for row in rows:
        writer.writerow(f"{value:.6g}" if isinstance(value, float) else value for value in astuple(row))
    return text.getvalue()


ColumnFormats = dict[str, tuple[str, Callable[[float | None], str] | None]]
"""Field and number format of each column by its heading; columns of text have no format."""

METHOD_COLUMNS: ColumnFormats = {
    "stage": ("stage", None),
    "method": ("method", None),
    "tiers": ("tier", None),
    "max error": ("error_max", short_number),
    "RMS error": ("error_rms", short_number),
    "unit": ("error_unit", None),
    "changed": ("changed_share", percentage),
    "ns per pixel": ("ns_per_pixel", three_digits),
    "of reference": ("ratio_to_reference", percentage),
}

RUN_COLUMNS: ColumnFormats = {
    "settings": ("setting", None),
    "noise": ("noise", None),
    "tier": ("tier", None),
    "of exact": ("ratio_to_exact", three_digits),
    "ns per pixel": ("ns_per_pixel", three_digits),
    "decode": ("decode_share", percentage),
    "simulate": ("simulate_share", percentage),
    "write": ("write_share", percentage),
    "changed": ("noisy_changed_share", percentage),
    "max DN": ("noisy_max_dn", short_number),
    "RMS DN": ("noisy_rms_dn", short_number),
    "max σ": ("noisy_max_std", short_number),
    "RMS σ": ("noisy_rms_std", short_number),
}


def table(columns: ColumnFormats, rows: Sequence[Measurement] | Sequence[RunMeasurement]) -> PageTable:
    """A table of methods and tiers, or of complete runs, grouped by its first column."""
    lines = [
        [getattr(row, field) if text is None else text(getattr(row, field)) for field, text in columns.values()]
        for row in rows
    ]
    numeric = {index for index, (_, text) in enumerate(columns.values()) if text}
    groups = {index for index, line in enumerate(lines) if index == 0 or line[0] != lines[index - 1][0]}
    return PageTable(list(columns), lines, numeric, groups)


def text_table(table: PageTable) -> str:
    """A table as aligned lines for a terminal, without a final newline."""
    lines = [table.headings, *table.lines]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if index in table.numeric else cell.ljust(width)
            for index, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
