"""Draw the figure of a benchmark: the time of complete runs, and error against time for tiers and for each stage.

Bars show the processor time of complete runs relative to the exact tier, divided into stages. Bars of slow tiers end at
the edge of the panel, with their length as a number. In the other panels, a line joins the methods that no other method
beats in both error and time. Every point is labelled with its name; points in the grey band have no error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from unprocess_gen.reports.benchmark.complete_runs import RunMeasurement
from unprocess_gen.reports.benchmark.measure import Measurement
from unprocess_gen.reports.benchmark.session import EXACT, FAST, GIVEN, REFERENCE
from unprocess_gen.reports.encoding import figure_png
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.reports.paper.pictures import BLUE, GREEN, GREY, INK, ORANGE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CLEAN_ERROR_LABEL = "clean frame, RMS (DN)"

PANELS = {
    "complete tiers, clean and noisy frame": (("tier_noisy", "tier_electrons"), "noisy frame, RMS (σ of its noise)"),
    "curve": (("curve",), CLEAN_ERROR_LABEL),
    "colour": (("colour",), CLEAN_ERROR_LABEL),
    "mosaic": (("mosaic",), CLEAN_ERROR_LABEL),
    "normal": (("normal",), "normal deviate, RMS (σ)"),
    "shot": (("shot",), "noisy frame, RMS (σ of its noise)"),
    "effects": (("effects",), "noisy frame, RMS (DN)"),
    "quantise": (("quantise",), CLEAN_ERROR_LABEL),
}
"""Stages and label of the error of each panel, by title; the first panel is twice as wide."""

TIER_COLOURS = {REFERENCE: INK, EXACT: BLUE, FAST: ORANGE}
OTHER_COLOUR = GREEN
MARKERS = {"tier_electrons": "s"}

RUN_STAGES = {"decode": GREY, "simulate": BLUE, "hash, write, commit": "#b9b9b9"}
"""Stages of a complete run and their colours, in the order of the shares in `RunMeasurement`."""

LONGEST_BAR = 1.6
"""Longest ratio to exact that a bar shows."""


class Point(NamedTuple):
    """A method in a panel."""

    ns: float
    error: float
    stage: str
    name: str
    tiers: str


def benchmark_figure(rows: Sequence[Measurement], runs: Sequence[RunMeasurement] = ()) -> bytes:
    """The figure as the bytes of a PNG."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: dict[Any, Any] = {"font.size": 9, "axes.labelsize": 9, "axes.titlesize": 10, "axes.titleweight": "bold"}
    with rc_context({**style, "axes.spines.right": False, "axes.spines.top": False}):
        figure = Figure(figsize=(9.6, 10.6), layout="constrained")
        titles = [*PANELS]
        places: Any = [["runs"] * 3, [titles[0], titles[0], titles[1]], titles[2:5], titles[5:]]
        panels = figure.subplot_mosaic(places)
        _draw_runs(panels["runs"], runs)
        for title, (stages, label) in PANELS.items():
            panels[title].set_title(title, loc="left")
            panels[title].set_ylabel(label)
            _draw_points(panels[title], [row for row in rows if row.stage in stages])
        _draw_legend(figure, [row.method for row in rows if row.stage == "tier"])
        figure.supxlabel("time of a pair or stage, ns per pixel (one thread)", fontsize=10)
        return figure_png(figure, dpi=100)


def _draw_runs(axes: Axes, runs: Sequence[RunMeasurement]) -> None:
    """Draw one bar for each tier of each setting, the first on top."""
    shown = [(run, run.ratio_to_exact) for run in runs if run.ratio_to_exact is not None]
    for line, (run, ratio) in enumerate(shown):
        shares = (run.decode_share or 0, run.simulate_share or 0, run.write_share or 0)
        edges = np.minimum(np.cumsum([0, *shares]) * ratio, LONGEST_BAR)
        axes.barh([line] * 3, np.diff(edges), left=edges[:-1], color=[*RUN_STAGES.values()], height=0.72)
        text = f"  {short_number(ratio, 3)}{' (cut off)' if ratio > LONGEST_BAR else ''}"
        axes.text(edges[-1], line, text, va="center", fontsize=8, color=TIER_COLOURS.get(run.tier, OTHER_COLOUR))
    for stage, colour in RUN_STAGES.items():
        axes.bar(0, 0, color=colour, label=stage)
    axes.axvline(1, color=INK, linewidth=0.8, linestyle=":", zorder=0.5)
    names = [f"{run.noise if run.setting == GIVEN else run.setting}: {run.tier}" for run, _ in shown]
    axes.set_yticks(range(len(shown)), names, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(0, LONGEST_BAR * 1.12), xlabel="processor time relative to exact")
    axes.set_title("complete runs, from files to committed shards", loc="left")
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False, fontsize=8, handlelength=1)


def _draw_points(axes: Axes, rows: Sequence[Measurement]) -> None:
    """Draw the methods or tiers of a panel, and the line of those that no other of their stage beats."""
    measured = [row for row in rows if row.ns_per_pixel is not None and row.error_rms is not None]
    points = [Point(row.ns_per_pixel or 0, row.error_rms or 0, row.stage, row.method, row.tier) for row in measured]
    if not points:
        axes.set_axis_off()
        return
    _set_axes(axes, [point.ns for point in points], [point.error for point in points])
    in_front = []
    for stage in dict.fromkeys(point.stage for point in points):
        stage_points = [point for point in points if point.stage == stage]
        front = sorted(stage_points[index] for index in pareto_front([point[:2] for point in stage_points]))
        axes.plot(*zip(*(point[:2] for point in front), strict=True), color=GREY, linewidth=1.2, zorder=1)
        in_front += front
    lowest = sorted(point for point in points if point.error == min(point.error for point in points))
    for point in points:
        _draw_point(axes, point, filled=point in in_front, is_below=point in lowest[::2])


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other point dominates; smaller is better in both coordinates."""
    return [
        index
        for index, (x, y) in enumerate(points)
        if not any((a <= x and b <= y) and (a < x or b < y) for a, b in points)
    ]


def _set_axes(axes: Axes, times: Sequence[float], errors: Sequence[float]) -> None:
    """Set logarithmic axes with space for labels; errors of 0 are in a linear band below the others."""
    middle, reach = math.sqrt(min(times) * max(times)), max(math.sqrt(max(times) / min(times)) * 3, 10.0)
    axes.set(xscale="log", xlim=(middle / reach, middle * reach))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: "")
    positive = [error for error in errors if error > 0] or [1.0]
    band = 10.0 ** math.floor(math.log10(min(positive)) - 0.5)
    axes.set_yscale("symlog", linthresh=band)
    axes.axhspan(-band, band / 2, color="#f3f3f3", zorder=0)
    axes.set_ylim(-0.9 * band, max(positive) * 20)
    axes.minorticks_off()
    axes.grid(axis="both", color="#e6e6e6", zorder=0)
    axes.set_axisbelow(True)


def _draw_point(axes: Axes, point: Point, filled: bool, is_below: bool) -> None:
    colour = _colour(point.tiers.split())
    face = colour if filled else "white"
    marker = MARKERS.get(point.stage, "o")
    axes.plot(point.ns, point.error, marker, color=colour, markersize=8, markerfacecolor=face, zorder=3)
    low, high = axes.get_xlim()
    at_right = point.ns > math.sqrt(low * high) * 1.2
    axes.annotate(
        f"{point.name.replace('_', ' ')}\n{short_number(point.ns)} ns",
        (point.ns, point.error),
        xytext=(5, -7 if is_below else 5),
        textcoords="offset points",
        ha="right" if at_right else "left",
        va="top" if is_below else "bottom",
        fontsize=8,
        color=colour,
        linespacing=1.1,
    )


def _colour(tiers: Sequence[str]) -> str:
    """Colour of the first tier that chooses a method, in the order exact, fast, others, reference."""
    others = [OTHER_COLOUR for tier in tiers if tier not in TIER_COLOURS]
    return next((TIER_COLOURS[tier] for tier in (EXACT, FAST) if tier in tiers), *others[:1] or [INK])


def _draw_legend(figure: Figure, tiers: Sequence[str]) -> None:
    """Explain colours and markers above all panels."""
    from matplotlib.lines import Line2D

    def mark(label: str, colour: str = GREY, marker: str = "o", face: str | None = None) -> Line2D:
        return Line2D([], [], linestyle="", marker=marker, color=colour, markerfacecolor=face or colour, label=label)

    marks = [mark(tier, TIER_COLOURS.get(tier, OTHER_COLOUR)) for tier in tiers]
    marks += [mark("tiers, two-parameter noise"), mark("tiers, physical noise", marker="s")]
    marks.append(mark("another method is faster and as accurate", face="white"))
    figure.legend(handles=marks, loc="outside upper left", ncols=len(marks), frameon=False, fontsize=8, handlelength=1)
