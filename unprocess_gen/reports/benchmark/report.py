"""What `accuracy` measured, for people: a table, ``accuracy.csv``, ``accuracy.png`` and ``accuracy.html``.

The figure has a panel for whole tiers and one for each stage, error against time; what no other method beats in both
is joined by a line. An error of 0 has no place on a logarithmic axis, so it stands below a gap, on a line of its own.
Colours are those of Okabe and Ito, which colour-blind readers can tell apart; every point has its name beside it.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from unprocess_gen.config.accuracy import STAGES
from unprocess_gen.reports.benchmark.measure import REFERENCE, BenchmarkReport, Measurement
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.reports.html_pages import PageTable, data_uri, render_page
from unprocess_gen.reports.report_files import write_files

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = tuple(one.name for one in fields(Measurement))
FILES = ("accuracy.csv", "accuracy.png", "accuracy.html")


def write_benchmark(report: BenchmarkReport, out: Path) -> None:
    """Write the three files, over those of an earlier report; MachineError where that fails."""
    picture = benchmark_figure(report.rows)
    contents = (csv_text(report.rows).encode(), picture, benchmark_page(report, picture).encode())
    write_files(out, dict(zip(FILES, contents, strict=True)))


# -------------------------------------------------------------------------------------------------------- tables


def csv_text(rows: Sequence[Measurement]) -> str:
    """Return ``accuracy.csv``; empty where nothing was measured."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        values = (getattr(row, name) for name in COLUMNS)
        writer.writerow([f"{value:.6g}" if isinstance(value, float) else value for value in values])
    return text.getvalue()


HEADINGS = ("stage", "method", "tiers", "max error", "RMS error", "unit", "changed", "ns a pixel", "of reference")


def cells(row: Measurement) -> tuple[str, ...]:
    """Return a row as people read it, in the order of `HEADINGS`."""
    return (
        row.stage,
        row.method,
        row.tier,
        short_number(row.error_max),
        short_number(row.error_rms),
        row.error_unit,
        "–" if row.changed_share is None else _percent(row.changed_share),
        short_number(row.ns_per_pixel, 3),
        "–" if row.ratio_to_reference is None else _percent(row.ratio_to_reference),
    )


def _percent(share: float) -> str:
    return f"{short_number(share * 100)} %"


RIGHT = frozenset({3, 4, 6, 7, 8})
"""Columns of numbers."""


def text_table(rows: Sequence[Measurement]) -> str:
    """Return the rows as lines for a terminal."""
    lines = [HEADINGS, *(cells(row) for row in rows)]
    widths = [max(len(line[at]) for line in lines) for at in range(len(HEADINGS))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if at in RIGHT else cell.ljust(width)
            for at, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def markdown_table(rows: Sequence[Measurement]) -> str:
    """Return the rows as a Markdown table."""
    rule = "|".join("--:" if at in RIGHT else "---" for at in range(len(HEADINGS)))
    lines = [f"| {' | '.join(HEADINGS)} |", f"|{rule}|"]
    return "\n".join([*lines, *(f"| {' | '.join(cells(row))} |" for row in rows)])


# -------------------------------------------------------------------------------------------------------- figure


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return which points no other beats: none is as good in both numbers and better in one; smaller is better."""
    return [
        at for at, (x, y) in enumerate(points) if not any((a <= x and b <= y) and (a < x or b < y) for a, b in points)
    ]


class FigurePanel(NamedTuple):
    """Hold what a panel shows: title, stages, the error field of `Measurement`, and the label of its axis."""

    title: str
    stages: tuple[str, ...]
    error: str
    axis: str


PANELS = (
    FigurePanel(
        "whole tiers, clean and noisy frame",
        ("tier_noisy", "tier_electrons"),
        "error_rms",
        "noisy frame, RMS (σ of its noise)",
    ),
    *(FigurePanel(stage, (stage,), "error_rms", "clean frame, RMS (DN)") for stage in ("curve", "colour", "mosaic")),
    FigurePanel("normal", ("normal",), "error_max", "largest error (σ)"),
    FigurePanel("shot", ("shot",), "error_max", "distance of the laws"),
    FigurePanel("effects", ("effects",), "error_rms", "noisy frame, RMS (DN)"),
    FigurePanel("quantise", ("quantise",), "error_rms", "clean frame, RMS (DN)"),
)
assert {stage for panel in PANELS for stage in panel.stages} == {*STAGES, "tier_noisy", "tier_electrons"}

COLOURS = {REFERENCE: "#000000", "exact": "#0072B2", "fast": "#D55E00"}
OTHER_COLOUR = "#009E73"
MARKERS = {"tier_noisy": ("o", "two numbers"), "tier_electrons": ("s", "electrons")}
FRONT = "#999999"


def benchmark_figure(rows: Sequence[Measurement]) -> bytes:
    """Draw the figure, as the bytes of a PNG."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: dict[Any, Any] = {"font.size": 9, "axes.labelsize": 9, "axes.titlesize": 10, "axes.titleweight": "bold"}
    with rc_context({**style, "axes.spines.right": False, "axes.spines.top": False}):
        figure = Figure(figsize=(9.6, 8.2), layout="constrained")
        for panel, axes in zip(PANELS, _grid(figure), strict=True):
            _draw_panel(panel, axes, rows)
        _legend(figure, rows)
        figure.supxlabel("time, ns a pixel (one thread)", fontsize=10)
        content = io.BytesIO()
        figure.savefig(content, format="png", dpi=100)
    return content.getvalue()


def _grid(figure: Figure) -> list[Axes]:
    """Return axes for `PANELS`: the tiers' are twice as wide."""
    grid = figure.add_gridspec(3, 3)
    others = [(0, 2), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)]
    return [figure.add_subplot(grid[0, :2]), *(figure.add_subplot(grid[row, column]) for row, column in others)]


def _draw_panel(panel: FigurePanel, axes: Axes, rows: Sequence[Measurement]) -> None:
    shown = [row for row in rows if row.stage in panel.stages and None not in (row.ns_per_pixel, _error(panel, row))]
    axes.set_title(panel.title, loc="left")
    axes.set_ylabel(panel.axis)
    if not shown:
        axes.set_axis_off()
        return
    floor = _set_axes(axes, [row.ns_per_pixel or 0.0 for row in shown], [_error(panel, row) or 0.0 for row in shown])
    points = [(row.ns_per_pixel or 0.0, max(_error(panel, row) or 0.0, floor)) for row in shown]
    at_front: set[int] = set()
    for stage in panel.stages:
        of_stage = [at for at, row in enumerate(shown) if row.stage == stage]
        front = [of_stage[at] for at in pareto_front([points[at] for at in of_stage])]
        axes.plot(*zip(*sorted(points[at] for at in front), strict=True), color=FRONT, linewidth=1.2, zorder=1)
        at_front |= set(front)
    below = labels_below(points)
    for at, (row, point) in enumerate(zip(shown, points, strict=True)):
        _draw_point(axes, row, point, filled=at in at_front, below=below[at])


def labels_below(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return which points have their name below, clear of the front's line, which comes from the upper left.

    Of points of about the same error each second one, from the first on; one alone where its error is the least.
    """
    below = [False] * len(points)
    for at, (x, y) in enumerate(points):
        level = sorted((a, n) for n, (a, b) in enumerate(points) if max(b, y) < 2 * min(b, y))
        below[at] = level.index((x, at)) % 2 == 0 and (
            len(level) > 1 or y == min(b for _, b in points) < max(b for _, b in points)
        )
    return below


def _error(panel: FigurePanel, row: Measurement) -> float | None:
    value: float | None = getattr(row, panel.error)
    return value


def _set_axes(axes: Axes, ns: Sequence[float], errors: Sequence[float]) -> float:
    """Set logarithmic axes with room for the names; return where an error of 0 stands."""
    positive = [math.log10(error) for error in errors if error > 0]
    lowest = math.floor(min(positive, default=0))
    highest = math.ceil(max(positive, default=0))
    zero = [10.0 ** (lowest - 1)] if 0.0 in errors else []
    bottom, top = (lowest - 1 if zero else lowest), max(positive, default=lowest - 1)
    room = max(0.3 * (top - bottom), 0.6)
    axes.set(xscale="log", yscale="log", xlim=_decades(ns), ylim=(10.0 ** (bottom - room), 10.0 ** (top + room)))
    decades = range(lowest, highest + 1, max(1, -(-(highest - lowest) // 4))) if positive else range(0)
    axes.set_yticks(zero + [10.0**n for n in decades], ["0"] * len(zero) + [f"$10^{{{n}}}$" for n in decades])
    axes.set_ylim(10.0 ** (bottom - room), 10.0 ** (top + room))
    axes.set_yticks([], minor=True)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: "")
    axes.grid(axis="both", color="#e6e6e6", zorder=0)
    axes.set_axisbelow(True)
    if zero and positive:
        axes.axhspan(10.0 ** (bottom - room), 10.0 ** (bottom + 0.5), color="#f3f3f3", zorder=0)
    return 10.0 ** (lowest - 1)


def _decades(ns: Sequence[float]) -> tuple[float, float]:
    """Return limits about times: two decades at least, and room for names at the sides."""
    middle = math.sqrt(min(ns) * max(ns))
    reach = max(math.sqrt(max(ns) / min(ns)) * 3, 10.0)
    return middle / reach, middle * reach


def _colour(row: Measurement) -> str:
    """Return the colour of the nearest tier that takes a method, the reference last."""
    tiers = row.tier.split()
    others = [tier for tier in tiers if tier not in COLOURS]
    return next((COLOURS[tier] for tier in ("exact", "fast") if tier in tiers), OTHER_COLOUR if others else "#000000")


def _draw_point(axes: Axes, row: Measurement, point: tuple[float, float], filled: bool, below: bool) -> None:
    marker, kind = MARKERS.get(row.stage, ("o", ""))
    colour = _colour(row)
    axes.plot(*point, marker, color=colour, markersize=8, markerfacecolor=colour if filled else "white", zorder=3)
    name = row.method if kind else row.method.replace("_", " ")
    low, high = (math.log(limit) for limit in axes.get_xlim())
    at_right = (math.log(point[0]) - low) / (high - low) > 0.55
    axes.annotate(
        f"{name}\n{short_number(row.ns_per_pixel, 2)} ns",
        point,
        xytext=(5 if at_right else -3 if below else 5, -7 if below else 5),
        textcoords="offset points",
        ha="right" if at_right else "left",
        va="top" if below else "bottom",
        fontsize=8,
        color=colour,
        linespacing=1.1,
    )


def _legend(figure: Figure, rows: Sequence[Measurement]) -> None:
    """Say above all panels what colours and markers mean."""
    from matplotlib.lines import Line2D

    def mark(label: str, colour: str, marker: str = "o", filled: bool = True) -> Line2D:
        face = colour if filled else "white"
        return Line2D([], [], linestyle="", marker=marker, color=colour, markerfacecolor=face, label=label)

    tiers = [row.method for row in rows if row.stage == "tier"]
    marks = [mark(tier, COLOURS.get(tier, OTHER_COLOUR)) for tier in tiers]
    marks += [mark(f"tiers, noise of {kind}", FRONT, marker) for marker, kind in MARKERS.values()]
    marks.append(mark("something faster is as near", FRONT, filled=False))
    figure.legend(handles=marks, loc="outside upper left", ncols=len(marks), frameon=False, fontsize=8, handlelength=1)


# ---------------------------------------------------------------------------------------------------------- page

NOTES = (
    "Errors of the stages curve, colour, mosaic and quantise: clean frame at 14 bits, in DN, with all other stages "
    "exact. Error of normal: in σ, against the exact quantile. Error of shot: the maximum is the largest difference of "
    "the distribution functions of shot plus read noise; the RMS is measured on photographs, in σ of shot and read "
    "noise. Error of effects: noisy frame at 14 bits without shot noise, in DN.",
    "End-to-end rows of the tiers: tier is the clean frame at 14 bits with two-parameter noise, tier_noisy its noisy "
    "frame in σ, tier_electrons the noisy frame of the physical profile in σ, and tier_own the clean frame of the "
    "given settings.",
    "Times of curve, colour and mosaic run from the codes to the end of the stage, because the kernels fuse these "
    "stages. Times of effects are the differences they make to a pair. The last column is the median of the ratios "
    "within a round. A dash means that the value was not measured separately.",
)


def benchmark_page(report: BenchmarkReport, picture: bytes) -> str:
    """Return ``accuracy.html``, one file that contains the figure."""
    stages = [None, *(row.stage for row in report.rows)]
    groups = [index for index, row in enumerate(report.rows) if row.stage != stages[index]]
    return render_page(
        "benchmark.html",
        title="Cost of accuracy",
        figure=data_uri(picture),
        measurements=PageTable(HEADINGS, list(map(cells, report.rows)), RIGHT, groups),
        notes=NOTES,
        conditions=report.facts,
    )
