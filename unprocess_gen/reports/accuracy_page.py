"""Write what accuracy costs: ``accuracy.csv``, ``accuracy.png`` and ``accuracy.html``, and the text of the verb."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from unprocess_gen.core.files import write_file
from unprocess_gen.reports.formatting import percentage, short_number
from unprocess_gen.reports.pages import PageTable, data_uri, render_page
from unprocess_gen.reports.pictures import figure_png, new_figure
from unprocess_gen.reports.tier_costs import STAGES, AccuracyReport, Measurement
from unprocess_gen.simulation.plan import EXACT, FAST, REFERENCE

REPORT_FILES = ("accuracy.csv", "accuracy.png", "accuracy.html")

three_digits = partial(short_number, digits=3)

COLUMNS: dict[str, tuple[str, Callable[[float | None], str]]] = {
    "ns per pixel": ("ns_per_pixel", three_digits),
    "of exact": ("ratio_to_exact", three_digits),
    "changed": ("changed_share", percentage),
    "max DN": ("max_dn", short_number),
    "RMS DN": ("rms_dn", short_number),
    "max σ": ("max_std", short_number),
    "RMS σ": ("rms_std", short_number),
}
"""Field and number format of each column of numbers by its heading."""


def report_text(report: AccuracyReport) -> str:
    """Text that the verb prints: the table and the conclusion."""
    table = accuracy_table(report.rows)
    lines = [table.headings, *table.lines]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    aligned = (
        "  ".join(
            cell.rjust(width) if index in table.numeric else cell.ljust(width)
            for index, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
    return "\n".join([*aligned, "", textwrap.fill(conclude(report), 120, break_on_hyphens=False)])


def write_accuracy(report: AccuracyReport, out: Path) -> None:
    """Write the files of a report, replacing an earlier report; MachineError if that fails."""
    picture = accuracy_figure(report.rows)
    page = render_page(
        "accuracy.html",
        title="Cost of accuracy",
        figure=data_uri(picture),
        conclusion=conclude(report),
        table=accuracy_table(report.rows),
        conditions=report.conditions,
    )
    contents: tuple[bytes | str, ...] = csv_text(report.rows), picture, page
    for name, content in zip(REPORT_FILES, contents, strict=True):
        write_file(out / name, content)


def accuracy_table(rows: Sequence[Measurement]) -> PageTable:
    """The table of a report, grouped by tier."""
    lines = [[row.tier, row.stage, *(text(getattr(row, name)) for name, text in COLUMNS.values())] for row in rows]
    numeric = range(2, 2 + len(COLUMNS))
    return PageTable(["tier", "stage", *COLUMNS], lines, numeric, groups=range(0, len(lines), len(STAGES)))


def csv_text(rows: Sequence[Measurement]) -> str:
    """The rows as CSV with six digits; times that were not measured are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Measurement._fields)
    for row in rows:
        writer.writerow(f"{value:.6g}" if isinstance(value, float) else value for value in row)
    return text.getvalue()


# ---------------------------------------------------------------------------------------------------------- conclusion


NOISE_OF_TIMES = 0.05
"""Difference of a ratio from 1 that is within the error of the measurement."""


def conclude(report: AccuracyReport) -> str:
    """One sentence: what the other tiers cost or save in a run, and what they change."""
    runs = {row.tier: row for row in report.rows if row.stage == STAGES[-1]}
    clauses = (f"{tier} {_time_clause(runs[tier])} and {_error_clause(runs[tier])}" for tier in (FAST, REFERENCE))
    return f"In a complete run of {report.photographs} with noise={report.noise}, {'; '.join(clauses)}."


def _time_clause(run: Measurement) -> str:
    ratio = run.ratio_to_exact
    if ratio is None:
        return "was too slow to be timed"
    if abs(ratio - 1) < NOISE_OF_TIMES:
        return f"takes about as long as {EXACT} (ratio {three_digits(ratio)})"
    return f"takes {three_digits(ratio)} {'of' if ratio < 1 else 'times'} the processor time of {EXACT}"


def _error_clause(run: Measurement) -> str:
    if not run.changed_share:
        return "changes no DN"
    return (
        f"moves {percentage(run.changed_share)} of the noisy DN by at most {short_number(run.max_dn)} DN or "
        f"{short_number(run.max_std)} standard deviations of the noise"
    )


# -------------------------------------------------------------------------------------------------------------- figure

STAGE_COLOURS = {"decode": "#8a8a8a", "clean": "#1f6fb2", "noise": "#d9822b", "write": "#c4c4c4"}

LONGEST_BAR = 1.6
"""Longest ratio to exact that a bar shows; longer bars end there, with their length as a number."""


def accuracy_figure(rows: Sequence[Measurement]) -> bytes:
    """The figure as the bytes of a PNG: one bar of processor time for each tier, divided into stages, and its error."""
    from matplotlib import rc_context

    ns = {(row.tier, row.stage): row.ns_per_pixel or 0 for row in rows}
    runs = [row for row in rows if row.stage == STAGES[-1]]
    scales = np.array([(run.ratio_to_exact or 0) / (run.ns_per_pixel or 1) for run in runs])
    places, ends = range(len(runs)), np.zeros(len(runs))
    with rc_context({"font.size": 9}):
        figure, axes = new_figure(8.4, 2.6)
        for stage, colour in STAGE_COLOURS.items():
            lengths = np.minimum([ns[run.tier, stage] for run in runs] * scales, LONGEST_BAR - ends)
            axes.barh(places, lengths, left=ends, color=colour, height=0.7, label=stage)
            ends += lengths
        for place, end, run in zip(places, ends, runs, strict=True):
            cut = ", bar cut" if (run.ratio_to_exact or 0) > LONGEST_BAR else ""
            text = f"  {three_digits(run.ratio_to_exact)}{cut}; RMS {short_number(run.rms_std)} σ"
            axes.text(end, place, text, va="center", fontsize=8)
        axes.set_yticks(places, [run.tier for run in runs])
        axes.invert_yaxis()
        axes.set(xlim=(0, LONGEST_BAR * 1.25), xlabel="processor time of a complete run, relative to exact")
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(STAGE_COLOURS), frameon=False, fontsize=8)
        return figure_png(figure, dpi=100)
