"""Draw Figures 5 to 7 of the article: the default raw frame, saturation, and highlights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from unprocess_gen.core.types import Float, Frame, Plan
from unprocess_gen.reports.paper.curves import HIGHLIGHT_THRESHOLD
from unprocess_gen.reports.paper.pictures import (
    BLUE,
    ORANGE,
    PaperFigure,
    block_means,
    channel_fractions,
    figure_png,
    panel_aspect,
    panel_grid,
    percent,
    show_picture,
    show_stretched,
    small_photograph,
)
from unprocess_gen.reports.paper.sources import (
    DEFAULT_GAINS,
    GAINS,
    INTERPRETATIONS,
    FigureSource,
    ImageSaturation,
    SaturationCounts,
    saturated_sites,
)
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference.cfa import tile

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# --------------------------------------------------------------------------------------- Figure 5: default raw frame

CROP_PX = 64
"""Side of the crops in Figure 5."""


def draw_default_raw(source: FigureSource) -> PaperFigure:
    """Draw Figure 5: the clean and noisy raw frame with the default gains, crops, and the noise curves."""
    plan, authors = source.plans[DEFAULT_GAINS], source.authors
    pair, authors_pair = make_pair(source.srgb, plan), make_pair(source.srgb, authors)

    def draw() -> Figure:
        figure, axes = panel_grid(2, 3, 9.4, max(panel_aspect(source.srgb), 0.8))
        show_picture(axes[0], small_photograph(source.srgb), "(a) photograph")
        show_stretched(axes[1], pair.clean, "(b) clean raw frame")
        show_stretched(axes[2], pair.noisy, "(c) noisy raw frame")
        crop = _typical_crop(pair.clean)
        low, high = float(pair.clean[crop].min()), float(pair.clean[crop].max())
        show_picture(axes[3], pair.clean[crop].astype(np.float64), "(d) crop of the clean frame", low, high)
        show_picture(axes[4], pair.noisy[crop].astype(np.float64), "(d) same crop, noisy", low, high)
        _draw_noise_curves(axes[5], plan, authors)
        return figure

    noiseless_dn = -authors.b_dn2 / authors.a_dn
    before = saturated_sites(source.srgb, plan.pattern)
    return PaperFigure(
        "fig5.png",
        "Figure 5: the default raw frame, clean and noisy",
        figure_png(draw),
        (
            f"On {source.name}: a grey mosaic. The checkerboard in the crops is the CFA; the noise grows with the "
            "signal. (b) and (c) are stretched from their lowest to their highest DN, as in the article. The crops (d) "
            "share one range; their standard deviation is the median of all such crops. "
            f"{percent(pair.counts.saturated, pair.clean.size)} of the sites are saturated, and "
            f"{percent(int(before.sum()), before.size)} are in the photograph.",
            f"Red gain {plan.red_gain:g}, blue gain {plan.blue_gain:g} (the centres of the ranges of Brooks et al.), "
            f"camera {plan.camera}, black {plan.black_level_dn}, white {plan.white_level_dn}. Against the article: its "
            "text divides by a global gain of 0.8, the code of Brooks et al. multiplies by it; this figure multiplies, "
            f"by {plan.inverse_rgb_gain:g}.",
            "The article gives sensor and ISO, not a and b, and adds its noise to DN that include the black level. (c) "
            f"uses the numbers of the data set that it cites: variance {plan.a_dn:.4g}·(x − black) + {plan.b_dn2:.4g} "
            f"DN². The author's own line, {authors.a_dn:.4g}·(x − black) {authors.b_dn2:+.4g}, was fitted without "
            f"subtracting the black level. It is negative up to {noiseless_dn:.4g} DN above black, which gives no "
            f"noise at {percent(authors_pair.counts.zero_variance, pair.clean.size)} of the sites here.",
        ),
    )


def _typical_crop(clean: Frame) -> tuple[slice, slice]:
    """Return the square of `CROP_PX` sites with the median standard deviation; its corner has even coordinates."""
    side = min(CROP_PX, *(max(length - length % 2, 1) for length in clean.shape))
    rows, columns = (range(0, length - side + 1, side) for length in clean.shape)
    squares = [(slice(y, y + side), slice(x, x + side)) for y in rows for x in columns]
    return sorted(squares, key=lambda square: float(clean[square].std()))[len(squares) // 2]


def _draw_noise_curves(axes: Axes, plan: Plan, authors: Plan) -> None:
    signal = np.linspace(0, 400, 401)
    for one, name, colour in ((plan, "in (c)", BLUE), (authors, "author's line", ORANGE)):
        axes.plot(signal, np.sqrt(np.maximum(one.a_dn * signal + one.b_dn2, 0)), color=colour, label=name)
    axes.set(xlabel="DN above black", ylabel="standard deviation, DN", xlim=(0, 400))
    axes.set_ylim(bottom=0)
    axes.set_title("noise", loc="left")
    axes.legend(frameon=False)


# ---------------------------------------------------------------------------------------------- Figure 6: saturation

HEADINGS = (
    "gains",
    "inverse gains R, G, B",
    "saturated in the photograph",
    "in its raw frame",
    "in all photographs",
    "in all raw frames",
    "photographs with more than before",
)


def draw_saturation(source: FigureSource, counts: SaturationCounts) -> PaperFigure:
    """Draw Figure 6: clean frames and their saturated sites at the extreme gains, in both interpretations."""

    def draw() -> Figure:
        figure, axes = panel_grid(2, 4, 11.0, panel_aspect(source.srgb))
        for column, interpretation in enumerate(INTERPRETATIONS):
            for row, name in enumerate((interpretation.top, interpretation.bottom)):
                plan = source.plans[name]
                clean = make_pair(source.srgb, plan).clean
                panel = row * 4 + column * 2
                saturated = clean == plan.white_level_dn
                show_stretched(axes[panel], clean, f"{'bottom' if row else 'top'}: {name}")
                fraction = percent(int(saturated.sum()), clean.size)
                show_picture(axes[panel + 1], channel_fractions(saturated, plan.pattern), f"saturated: {fraction}")
        return figure

    matches = "; ".join(
        f"{one.description} ({one.top}, {one.bottom}), {counts.count_matching(one)}" for one in INTERPRETATIONS
    )
    failed = (f"Photographs that cannot be read: {', '.join(counts.failed)}.",) if counts.failed else ()
    return PaperFigure(
        "fig6.png",
        "Figure 6: saturation at the minimum and maximum gains",
        figure_png(draw),
        (
            f"On {source.name}. Each pair of pictures shows the clean raw frame and its saturated sites in the colour "
            "of their filter (white: all colours), with their percentage. The left half divides by g_rgb, the right "
            "half multiplies by it. Caption of the article: the gains of the top row do not create more saturation, "
            "those of the bottom row do.",
            "Against the article: its formula divides by g_rgb, so its minimum (0.85) brightens and its maximum (2.05) "
            "darkens, contrary to its caption; multiplication agrees with the caption. Photographs that match the "
            f"caption, of {len(counts.by_gains[DEFAULT_GAINS])}: {matches}.",
            *failed,
        ),
        (HEADINGS, *(_saturation_line(name, source.plans[name], counts.by_gains[name]) for name in GAINS)),
    )


def _saturation_line(name: str, plan: Plan, counts: Sequence[ImageSaturation]) -> tuple[str, ...]:
    """Return a line of the table; the first readable photograph counted is the one in the figure."""
    first, sites = counts[0], sum(one.sites for one in counts)
    return (
        name,
        ", ".join(f"{k:.3g}" for k in plan.inverse_gains),
        f"{first.before:,} ({percent(first.before, first.sites)})",
        f"{first.after:,} ({percent(first.after, first.sites)})",
        percent(sum(one.before for one in counts), sites),
        percent(sum(one.after for one in counts), sites),
        f"{sum(one.after > one.before for one in counts)} of {len(counts)}",
    )


# ---------------------------------------------------------------------------------------------- Figure 7: highlights

SMALL_GAINS, LARGE_GAINS = "paper_max", "fig6_bottom"
"""The options of `GAINS` with the smallest and the largest inverse gains."""


def draw_highlights(source: FigureSource) -> PaperFigure:
    """Draw Figure 7: the highlights that the function creates with small inverse gains."""
    small, large = source.plans[SMALL_GAINS], source.plans[LARGE_GAINS]
    with_function = make_pair(source.srgb, small).clean
    without = make_pair(source.srgb, replace(small, highlight="none")).clean
    large_frame = make_pair(source.srgb, large).clean
    added = with_function.astype(np.float64) - without
    span = small.white_level_dn - small.black_level_dn

    def draw() -> Figure:
        figure, axes = panel_grid(2, 3, 9.4, panel_aspect(source.srgb))
        show_picture(axes[0], small_photograph(source.srgb), "(a) photograph")
        show_stretched(axes[1], large_frame, "(b) large inverse gains")
        show_stretched(axes[2], with_function, "(c) small inverse gains")
        limits = float(without.min()), float(with_function.max())
        show_picture(axes[3], block_means(without, is_mosaic=True), "without the function", *limits)
        fraction = block_means(added, is_mosaic=True) / span
        title = f"added light, up to {fraction.max():.0%} of white"
        show_picture(axes[4], fraction, title, high=float(fraction.max()))
        _draw_profile(axes[5], with_function, without, added, small)
        axes[5].set_box_aspect(panel_aspect(source.srgb))
        return figure

    profile = "the row where it adds most" if added.any() else "a row; it adds nothing here"
    rows = (
        (LARGE_GAINS, large, large_frame),
        (SMALL_GAINS, small, with_function),
        (f"{SMALL_GAINS}, no function", small, without),
    )
    return PaperFigure(
        "fig7.png",
        "Figure 7: the highlights that the function creates",
        figure_png(draw),
        (
            f"On {source.name}. With small inverse gains ({SMALL_GAINS}) the frame is dark except for values that were "
            "almost white, which the function raises towards saturation. This creates edges inside areas that look "
            f"uniformly bright in the photograph. It changes {percent(int((added > 0).sum()), added.size)} of the "
            f"sites. The profile shows {profile}.",
            "Against the article: it states that small inverse gains give more highlights. They do, compared with the "
            "same gains without the function. But f(i) is 1 only at i = 1, so there is no more saturation than with "
            f"large inverse gains ({LARGE_GAINS}), whose lines cross white earlier. Counts: this photograph.",
        ),
        (
            ("gains", "saturated", f"highlights, from {HIGHLIGHT_THRESHOLD:.0%} of white"),
            *(_highlight_line(*row) for row in rows),
        ),
    )


def _highlight_line(name: str, plan: Plan, clean: Frame) -> tuple[str, ...]:
    bright_dn = plan.black_level_dn + HIGHLIGHT_THRESHOLD * (plan.white_level_dn - plan.black_level_dn)
    return (
        name,
        percent(int((clean == plan.white_level_dn).sum()), clean.size),
        percent(int((clean >= bright_dn).sum()), clean.size),
    )


def _draw_profile(axes: Axes, with_function: Frame, without: Frame, added: Float, plan: Plan) -> None:
    """Draw the green sites of the row where the function adds most, with and without it."""
    row = int(added.sum(axis=1).argmax())
    start = tile(plan.pattern)[row % 2].index(1)
    for frame, name, colour in ((with_function, "with the function", BLUE), (without, "without", ORANGE)):
        values = frame[row, start::2].astype(np.float64) - plan.black_level_dn
        axes.plot(
            np.arange(values.size) * 2 + start,
            values / (plan.white_level_dn - plan.black_level_dn),
            color=colour,
            linewidth=0.8,
            label=name,
        )
    axes.set(xlabel="column", ylabel="fraction of white", ylim=(-0.03, 1.03))
    axes.set_title(f"green sites of row {row}", loc="left")
    axes.legend(frameon=False, loc="upper left")
