"""Draw Figures 2 to 4 of the article: tone curve, gamma, and the function that keeps highlights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from unprocess_gen.core.types import Float, Srgb
from unprocess_gen.reports.paper.pictures import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PaperFigure,
    figure_png,
    panel_grid,
    show_picture,
    small_photograph,
)
from unprocess_gen.reports.paper.sources import DEFAULT_GAINS, FigureSource
from unprocess_gen.simulation.reference.isp import compress_gamma, smoothstep
from unprocess_gen.simulation.reference.unprocess import (
    expand_gamma,
    inverse_smoothstep,
    invert_gains_per_channel,
    linear_light,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GAMMA = 2.2
"""Section 2 of the article, after Brooks et al. 2019."""

HIGHLIGHT_THRESHOLD = 0.9
"""Fraction of white from which the article's function keeps highlights."""

CODES = np.arange(256, dtype=np.uint8)


def draw_tone(source: FigureSource) -> PaperFigure:
    """Draw Figure 2: the tone curve, its inverse, and the photograph before and after the inverse."""
    x = np.linspace(0, 1, 256)
    inverse = linear_light(CODES, "smoothstep", 1.0)
    as_written = 0.5 - np.sin(np.arcsin(1 - 2 * (CODES / 255)) / 3)

    def draw() -> Figure:
        figure, (curves, before, after, histogram) = panel_grid(2, 2, 8.4, 0.85)
        curves.plot(x, x, color=GREY, linewidth=1, linestyle=":", label="identity")
        curves.plot(x, smoothstep(x), color=ORANGE, label="tone curve 3x² − 2x³")
        curves.plot(x, inverse_smoothstep(x, 1 - x), color=BLUE, label="inverse")
        curves.set(xlabel="input", ylabel="output", xlim=(0, 1), ylim=(0, 1), aspect="equal")
        curves.set_title("curves", loc="left")
        curves.legend(frameon=False)
        small = small_photograph(source.srgb)
        show_picture(before, small, "photograph")
        show_picture(after, inverse_smoothstep(small, 1 - small), "after the inverse tone curve")
        _draw_histogram(histogram, source.srgb, {"photograph": np.arange(256) / 255, "after the inverse": inverse})
        return figure

    examples = ", ".join(f"{code} to {inverse[code] * 255:.0f}" for code in (16, 64, 192, 240))
    return PaperFigure(
        "fig2.png",
        "Figure 2: the tone curve and its inverse",
        figure_png(draw),
        (
            f"On {source.name}. The tone curve makes bright values brighter and dark values darker. Its inverse maps "
            f"codes {examples}; the photograph loses contrast and its values move towards the middle.",
            "Against the article: it writes ½ − sin(asin(1 − 2x) / 3), which loses a digit near black. Here the same "
            "function is computed as sin t · (√3 cos t + sin t), t = asin(√x) / 3, without cancellation. On "
            f"the 256 codes the two differ by at most {np.abs(as_written - inverse).max():.1g}, which is invisible.",
        ),
    )


def _draw_histogram(axes: Axes, srgb: Srgb, curves: Mapping[str, Float]) -> None:
    """Draw the histogram of a photograph's values through each curve of 256 codes."""
    codes = srgb if srgb.dtype == np.uint8 else (srgb >> 8).astype(np.uint8)
    counts = np.bincount(codes.ravel(), minlength=256)
    for (name, curve), colour in zip(curves.items(), (ORANGE, BLUE), strict=True):
        axes.hist(
            curve, bins=64, range=(0, 1), weights=counts / counts.sum(), histtype="step", color=colour, label=name
        )
    axes.set(xlabel="value", ylabel="fraction of all values", xlim=(0, 1))
    axes.set_title("histogram", loc="left")
    axes.legend(frameon=False)


def draw_gamma(source: FigureSource) -> PaperFigure:
    """Draw Figure 3: gamma compression, its inverse, and the photograph in linear light."""
    u = np.arange(256) / 255

    def draw() -> Figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8.4, 7.0), layout="constrained")
        grid = figure.add_gridspec(4, 2)
        curve = figure.add_subplot(grid[:2, 0])
        curve.plot(u * 255, u * 255, color=GREY, linewidth=1, linestyle=":", label="identity")
        curve.plot(u * 255, compress_gamma(u, GAMMA) * 255, color=ORANGE, label="v = u^(1/2.2)")
        curve.plot(u * 255, expand_gamma(u, GAMMA) * 255, color=BLUE, label="inverse, u = v^2.2")
        curve.set(xlabel="input", ylabel="output", xlim=(0, 255), ylim=(0, 255), aspect="equal")
        curve.set_title("curves", loc="left")
        curve.legend(frameon=False, loc="upper left")
        gradients = ((u, "linear gradient, 0 to 255"), (compress_gamma(u, GAMMA), "gradient after gamma compression"))
        for row, (values, title) in enumerate(gradients):
            show_picture(figure.add_subplot(grid[row, 1]), np.tile(values, (48, 1)), title)
        small = small_photograph(source.srgb)
        untoned = inverse_smoothstep(small, 1 - small)
        show_picture(figure.add_subplot(grid[2:, 0]), untoned, "after the inverse tone curve")
        linear_title = "linear light: after the inverse gamma, too"
        show_picture(figure.add_subplot(grid[2:, 1]), expand_gamma(untoned, GAMMA), linear_title)
        return figure

    linear = linear_light(CODES, "smoothstep", GAMMA)
    examples = ", ".join(f"{code}: {linear[code]:.2g}" for code in (16, 64, 128, 192, 240))
    return PaperFigure(
        "fig3.png",
        "Figure 3: gamma compression and its inverse",
        figure_png(draw),
        (
            "Gamma compression uses more codes for dark light: the compressed gradient is brighter everywhere except "
            f"at its ends. On {source.name} the inverse darkens all values except white. After the inverse tone curve "
            f"and the inverse gamma, codes become these fractions of white: {examples}.",
            "Against the article: it clips to 0 before the power. The inverse tone curve has no value below 0, so "
            "nothing is clipped here.",
        ),
    )


def draw_highlight_function(source: FigureSource) -> PaperFigure:
    """Draw Figure 4: the function f that inverts gains and keeps highlights."""
    i = np.linspace(0, 1, 1001)
    fixed = source.plans[DEFAULT_GAINS]
    gains = {
        **{f"{k:.3g} ({name})": k for k, name in zip(fixed.inverse_gains, ("red", "green", "blue"), strict=True)},
        "1.18": 1 / 0.85,
        "2.05": 2.05,
    }

    def draw() -> Figure:
        figure, (complete, near_white) = panel_grid(1, 2, 8.4, 0.9)
        for axes, limits, title in ((complete, (0.0, 1.0), "f on [0, 1]"), (near_white, (0.85, 1.0), "near white")):
            for (name, k), colour in zip(gains.items(), (ORANGE, GREEN, BLUE, GREY, INK), strict=True):
                function = invert_gains_per_channel(i, np.asarray(k), HIGHLIGHT_THRESHOLD)
                axes.plot(i, function, color=colour, label=name)
                if k < 1:
                    axes.plot(i, i * k, color=colour, linewidth=0.8, linestyle="--")
            axes.axvline(HIGHLIGHT_THRESHOLD, color=GREY, linewidth=0.8, linestyle=":")
            axes.axhline(1, color=GREY, linewidth=0.8)
            axes.set(xlabel="intensity i", ylabel="f(i)", xlim=limits, ylim=(0, 1.25))
            axes.set_title(title, loc="left")
        complete.legend(title="inverse gain 1/g", frameon=False, fontsize=8)
        return figure

    weakest = min(fixed.inverse_gains)
    slope = weakest + (1 - weakest) * (1 + 2 / (1 - HIGHLIGHT_THRESHOLD))
    return PaperFigure(
        "fig4.png",
        "Figure 4: the function that keeps highlights",
        figure_png(draw),
        (
            "Inverse gains below 1 follow the line i/g (continued as a dashed line) up to 0.9, then rise to exactly 1 "
            "at white. Inverse gains above 1 give straight lines that cross white (the horizontal line) before i = 1. "
            f"For the inverse gain {weakest:.3g} the slope at white is {slope:.0f}; it causes the jump to saturation "
            "that the article describes in Figure 7.",
            "Against the article: its 100·(i − 0.9)² is computed as ((i − 0.9) / (1 − 0.9))², because in floating "
            "point 100·(1 − 0.9)² is not 1 and white would change. Brooks et al. blend by the mean of the "
            "three channels (gains.highlight=gray_mean); the article and this figure treat each channel separately.",
        ),
    )
