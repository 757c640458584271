"""Write what accuracy costs: ``accuracy.csv``, ``accuracy.png`` and ``accuracy.html``, and the text of the verb."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from unprocess_gen.reports.accuracy.measure import STAGES, AccuracyReport, Measurement
from unprocess_gen.reports.formatting import percentage, short_number
from unprocess_gen.reports.html_pages import PageTable, data_uri, render_page
from unprocess_gen.reports.pictures import figure_png
from unprocess_gen.reports.report_files import write_files
from unprocess_gen.simulation.plan import EXACT, FAST, REFERENCE

LINE_LENGTH = 120
"""Width of the printed sentence."""

REPORT_FILES = ("accuracy.csv", "accuracy.png", "accuracy.html")

three_digits = partial(short_number, digits=3)

COLUMNS: dict[str, tuple[str, Callable[[float | None], str] | None]] = {
    "tier": ("tier", None),
    "stage": ("stage", None),
    "ns per pixel": ("ns_per_pixel", three_digits),
    "of exact": ("ratio_to_exact", three_digits),
    "changed": ("changed_share", percentage),
    "max DN": ("max_dn", short_number),
    "RMS DN": ("rms_dn", short_number),
    "max σ": ("max_std", short_number),
    "RMS σ": ("rms_std", short_number),
}
"""Field and number format of each column of the table by its heading; columns of text have no format."""


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
    return "\n".join([*aligned, "", textwrap.fill(conclude(report), LINE_LENGTH, break_on_hyphens=False)])


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
    contents = csv_text(report.rows).encode(), picture, page.encode()
    write_files(out, dict(zip(REPORT_FILES, contents, strict=True)))


def accuracy_table(rows: Sequence[Measurement]) -> PageTable:
    """The table of a report, grouped by tier."""
    lines = [
        [getattr(row, field) if text is None else text(getattr(row, field)) for field, text in COLUMNS.values()]
        for row in rows
    ]
    numeric = {index for index, (_, text) in enumerate(COLUMNS.values()) if text}
    return PageTable(list(COLUMNS), lines, numeric, groups=range(0, len(lines), len(STAGES)))


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
    clauses = (f"{tier} {_time_clause(report, tier)} and {_error_clause(report, tier)}" for tier in (FAST, REFERENCE))
    return f"In a complete run of {report.photographs} with noise={report.noise}, {'; '.join(clauses)}."


def _time_clause(report: AccuracyReport, tier: str) -> str:
    ratio = _run(report, tier).ratio_to_exact
    if ratio is None:
        return "was too slow to be timed"
    if abs(ratio - 1) < NOISE_OF_TIMES:
        return f"takes about as long as {EXACT} (ratio {three_digits(ratio)})"
    return f"takes {three_digits(ratio)} {'of' if ratio < 1 else 'times'} the processor time of {EXACT}"


def _error_clause(report: AccuracyReport, tier: str) -> str:
    run = _run(report, tier)
    if not run.changed_share:
        return "changes no DN"
    return (
        f"moves {percentage(run.changed_share)} of the noisy DN by at most {short_number(run.max_dn)} DN or "
        f"{short_number(run.max_std)} standard deviations of the noise"
    )


def _run(report: AccuracyReport, tier: str) -> Measurement:
    return next(row for row in report.rows if (row.tier, row.stage) == (tier, STAGES[-1]))


# -------------------------------------------------------------------------------------------------------------- figure

STAGE_COLOURS = {"decode": "#8a8a8a", "clean": "#1f6fb2", "noise": "#d9822b", "write": "#c4c4c4"}

LONGEST_BAR = 1.6
"""Longest ratio to exact that a bar shows; longer bars end there, with their length as a number."""


def accuracy_figure(rows: Sequence[Measurement]) -> bytes:
    """The figure as the bytes of a PNG: one bar of processor time for each tier, divided into stages, and its error."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    tiers = list(dict.fromkeys(row.tier for row in rows))
    stages = {(row.tier, row.stage): row for row in rows}
    style: dict[Any, Any] = {"font.size": 9, "axes.spines.right": False, "axes.spines.top": False}
    with rc_context(style):
        figure = Figure(figsize=(8.4, 2.6), layout="constrained")
        axes = figure.subplots()
        for line, tier in enumerate(tiers):
            run = stages[tier, STAGES[-1]]
            edges = [0.0]
            for stage in STAGE_COLOURS:
                share = (stages[tier, stage].ns_per_pixel or 0) / (run.ns_per_pixel or 1)
                edges.append(min(edges[-1] + share * (run.ratio_to_exact or 0), LONGEST_BAR))
            lengths = [right - left for left, right in pairwise(edges)]
            axes.barh([line] * len(lengths), lengths, left=edges[:-1], color=[*STAGE_COLOURS.values()], height=0.7)
            cut = ", bar cut" if edges[-1] == LONGEST_BAR else ""
            text = f"  {three_digits(run.ratio_to_exact)}{cut}; RMS {short_number(run.rms_std)} σ"
            axes.text(edges[-1], line, text, va="center", fontsize=8)
        for stage, colour in STAGE_COLOURS.items():
            axes.barh(0, 0, color=colour, label=stage)
        axes.set_yticks(range(len(tiers)), tiers)
        axes.invert_yaxis()
        axes.set(xlim=(0, LONGEST_BAR * 1.25), xlabel="processor time of a complete run, relative to exact")
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(STAGE_COLOURS), frameon=False, fontsize=8)
        return figure_png(figure, dpi=100)
