"""Draw the figure of a benchmark: the time of complete runs, and error against time for tiers and for each stage.

Bars show the processor time of complete runs relative to the exact tier, divided into stages. Bars of slow tiers end at
the edge of the panel, with their length as a number.

In the other panels, a line joins the methods that no other method beats in both error and time. An error of 0 cannot be
shown on a logarithmic axis, so it is drawn below a break of the axis. Every point is labelled with its name.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from unprocess_gen.config.accuracy import STAGES
from unprocess_gen.reports.benchmark.complete_runs import RunMeasurement
from unprocess_gen.reports.benchmark.conclusion import RATIO_DIGITS
from unprocess_gen.reports.benchmark.measure import Measurement
from unprocess_gen.reports.benchmark.session import GIVEN, REFERENCE
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.reports.paper.pictures import BLUE, GREEN, GREY, INK, ORANGE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points that no other point dominates; smaller is better in both coordinates."""
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
        "complete tiers, clean and noisy frame",
        ("tier_noisy", "tier_electrons"),
        "error_rms",
        "noisy frame, RMS (σ of its noise)",
    ),
    *(FigurePanel(stage, (stage,), "error_rms", "clean frame, RMS (DN)") for stage in ("curve", "colour", "mosaic")),
    FigurePanel("normal", ("normal",), "error_max", "largest error (σ)"),
    FigurePanel("shot", ("shot",), "error_max", "largest CDF difference"),
    FigurePanel("effects", ("effects",), "error_rms", "noisy frame, RMS (DN)"),
    FigurePanel("quantise", ("quantise",), "error_rms", "clean frame, RMS (DN)"),
)
assert {stage for panel in PANELS for stage in panel.stages} == {*STAGES, "tier_noisy", "tier_electrons"}

TIER_COLOURS = {REFERENCE: INK, "exact": BLUE, "fast": ORANGE}
OTHER_COLOUR = GREEN
MARKERS = {"tier_noisy": ("o", "two-parameter"), "tier_electrons": ("s", "physical")}


RUN_STAGES = {"decode": GREY, "simulate": BLUE, "hash, write, commit": "#b9b9b9"}
"""Stages of a complete run and their colours, in the order of the shares in `RunMeasurement`."""

LONGEST_BAR = 1.6
"""Longest ratio to exact that a bar shows."""


def benchmark_figure(rows: Sequence[Measurement], runs: Sequence[RunMeasurement] = ()) -> bytes:
    """Return the figure as the bytes of a PNG."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: dict[Any, Any] = {"font.size": 9, "axes.labelsize": 9, "axes.titlesize": 10, "axes.titleweight": "bold"}
    with rc_context({**style, "axes.spines.right": False, "axes.spines.top": False}):
        figure = Figure(figsize=(9.6, 10.6), layout="constrained")
        grid = figure.add_gridspec(4, 3)
        _draw_runs(figure.add_subplot(grid[0, :]), runs)
        for panel, (row, columns) in zip(PANELS, PLACES, strict=True):
            _draw_panel(panel, figure.add_subplot(grid[row, columns]), rows)
        _legend(figure, rows)
        figure.supxlabel("time of a pair or stage, ns per pixel (one thread)", fontsize=10)
        content = io.BytesIO()
        figure.savefig(content, format="png", dpi=100)
    return content.getvalue()


PLACES = (
    *((1, slice(0, 2)), (1, slice(2, 3))),
    *((row, slice(column, column + 1)) for row in (2, 3) for column in range(3)),
)
"""Row and columns of each of `PANELS`; that of the tiers is twice as wide."""


def _draw_runs(axes: Axes, runs: Sequence[RunMeasurement]) -> None:
    """Draw one bar for each tier of each setting, the first on top."""
    from matplotlib.patches import Patch

    shown = [run for run in runs if run.ratio_to_exact is not None]
    axes.set_title("complete runs, from files to committed shards", loc="left")
    if not shown:
        axes.set_axis_off()
        return
    for at, run in enumerate(shown):
        left, ratio = 0.0, run.ratio_to_exact or 0.0
        shares = (run.decode_share, run.simulate_share, run.write_share)
        for share, colour in zip(shares, RUN_STAGES.values(), strict=True):
            end = min(left + (share or 0.0) * ratio, LONGEST_BAR)
            axes.barh(at, end - min(left, LONGEST_BAR), left=min(left, LONGEST_BAR), color=colour, height=0.72)
            left += (share or 0.0) * ratio
        text = f"{short_number(ratio, RATIO_DIGITS)}{' (cut off)' if ratio > LONGEST_BAR else ''}"
        axes.annotate(
            text,
            (min(ratio, LONGEST_BAR), at),
            xytext=(5, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=TIER_COLOURS.get(run.tier, OTHER_COLOUR),
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1},
        )
    axes.axvline(1, color=INK, linewidth=0.8, linestyle=":", zorder=0.5)
    axes.set_yticks(
        range(len(shown)), [f"{run.noise if run.setting == GIVEN else run.setting}: {run.tier}" for run in shown]
    )
    axes.tick_params(axis="y", labelsize=8, length=0)
    axes.invert_yaxis()
    axes.set(xlim=(0, LONGEST_BAR * 1.12), xticks=(0, 0.25, 0.5, 0.75, 1, 1.25, 1.5))
    axes.set_xlabel("processor time relative to exact")
    marks = [Patch(color=colour, label=stage) for stage, colour in RUN_STAGES.items()]
    axes.legend(
        handles=marks, loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False, fontsize=8, handlelength=1
    )


def _draw_panel(panel: FigurePanel, axes: Axes, rows: Sequence[Measurement]) -> None:
    shown = [row for row in rows if row.stage in panel.stages and None not in (row.ns_per_pixel, _error(panel, row))]
    axes.set_title(panel.title, loc="left")
    axes.set_ylabel(panel.axis)
    if not shown:
        axes.set_axis_off()
        return
    floor = _set_axes(axes, [row.ns_per_pixel or 0.0 for row in shown], [_error(panel, row) or 0.0 for row in shown])
    points = [(row.ns_per_pixel or 0.0, max(_error(panel, row) or 0.0, floor)) for row in shown]
    in_front: set[int] = set()
    for stage in panel.stages:
        stage_points = [at for at, row in enumerate(shown) if row.stage == stage]
        front = [stage_points[at] for at in pareto_front([points[at] for at in stage_points])]
        axes.plot(*zip(*sorted(points[at] for at in front), strict=True), color=GREY, linewidth=1.2, zorder=1)
        in_front |= set(front)
    below = labels_below(points)
    for at, (row, point) in enumerate(zip(shown, points, strict=True)):
        _draw_point(axes, row, point, filled=at in in_front, below=below[at])


def labels_below(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return which points have their label below, so that labels avoid the line from the upper left and each other.

    Among points of similar error, every second one, beginning with the first; a single point only if its error is the
    smallest.
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
    """Set logarithmic axes with space for labels; return the y coordinate at which an error of 0 is drawn."""
    positive = [math.log10(error) for error in errors if error > 0]
    lowest = math.floor(min(positive, default=0))
    highest = math.ceil(max(positive, default=0))
    zero = [10.0 ** (lowest - 1)] if 0.0 in errors else []
    bottom, top = (lowest - 1 if zero else lowest), max(positive, default=lowest - 1)
    margin = max(0.3 * (top - bottom), 0.6)
    axes.set(xscale="log", yscale="log", xlim=_decades(ns), ylim=(10.0 ** (bottom - margin), 10.0 ** (top + margin)))
    decades = range(lowest, highest + 1, max(1, -(-(highest - lowest) // 4))) if positive else range(0)
    axes.set_yticks(zero + [10.0**n for n in decades], ["0"] * len(zero) + [f"$10^{{{n}}}$" for n in decades])
    axes.set_ylim(10.0 ** (bottom - margin), 10.0 ** (top + margin))
    axes.set_yticks([], minor=True)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: "")
    axes.grid(axis="both", color="#e6e6e6", zorder=0)
    axes.set_axisbelow(True)
    if zero and positive:
        axes.axhspan(10.0 ** (bottom - margin), 10.0 ** (bottom + 0.5), color="#f3f3f3", zorder=0)
    return 10.0 ** (lowest - 1)


def _decades(ns: Sequence[float]) -> tuple[float, float]:
    """Return limits of the time axis: at least two decades, with space for labels at the sides."""
    middle = math.sqrt(min(ns) * max(ns))
    reach = max(math.sqrt(max(ns) / min(ns)) * 3, 10.0)
    return middle / reach, middle * reach


def _colour(row: Measurement) -> str:
    """Return the colour of the first tier that chooses a method, in the order exact, fast, others, reference."""
    tiers = row.tier.split()
    others = [tier for tier in tiers if tier not in TIER_COLOURS]
    return next((TIER_COLOURS[tier] for tier in ("exact", "fast") if tier in tiers), OTHER_COLOUR if others else INK)


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
    """Explain colours and markers above all panels."""
    from matplotlib.lines import Line2D

    def mark(label: str, colour: str, marker: str = "o", filled: bool = True) -> Line2D:
        face = colour if filled else "white"
        return Line2D([], [], linestyle="", marker=marker, color=colour, markerfacecolor=face, label=label)

    tiers = [row.method for row in rows if row.stage == "tier"]
    marks = [mark(tier, TIER_COLOURS.get(tier, OTHER_COLOUR)) for tier in tiers]
    marks += [mark(f"tiers, {kind} noise", GREY, marker) for marker, kind in MARKERS.values()]
    marks.append(mark("another method is faster and as accurate", GREY, filled=False))
    figure.legend(handles=marks, loc="outside upper left", ncols=len(marks), frameon=False, fontsize=8, handlelength=1)
