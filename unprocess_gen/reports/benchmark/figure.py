"""Draw the figure of a benchmark: error against time, one panel for complete tiers and one for each stage.

A line joins the methods that no other method beats in both error and time. An error of 0 cannot be shown on a
logarithmic axis, so it is drawn below a break of the axis. Every point is labelled with its name.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from unprocess_gen.config.accuracy import STAGES
from unprocess_gen.reports.benchmark.measure import Measurement
from unprocess_gen.reports.benchmark.session import REFERENCE
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


def benchmark_figure(rows: Sequence[Measurement]) -> bytes:
    """Return the figure as the bytes of a PNG."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: dict[Any, Any] = {"font.size": 9, "axes.labelsize": 9, "axes.titlesize": 10, "axes.titleweight": "bold"}
    with rc_context({**style, "axes.spines.right": False, "axes.spines.top": False}):
        figure = Figure(figsize=(9.6, 8.2), layout="constrained")
        for panel, axes in zip(PANELS, _grid(figure), strict=True):
            _draw_panel(panel, axes, rows)
        _legend(figure, rows)
        figure.supxlabel("time, ns per pixel (one thread)", fontsize=10)
        content = io.BytesIO()
        figure.savefig(content, format="png", dpi=100)
    return content.getvalue()


def _grid(figure: Figure) -> list[Axes]:
    """Return one axes for each of `PANELS`; the first, of the tiers, is twice as wide."""
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
