"""Draw Figures 1 to 7 of the article from a photograph: ``fig1.png`` … ``fig7.png`` and a page with captions.

The figures are computed with the code that makes datasets. The template of the page has the captions, with differences
from the article's text; the functions give it the numbers of the photograph. Raw frames are grey, from the lowest DN
(black) to the highest (white), as in the article. The article's photographs are not published, so its claims are
checked on other photographs: the claims of Figure 6 on up to `PHOTOGRAPHS_COUNTED`.

Figure 6 of the article has two interpretations (`INTERPRETATIONS`). The formula divides by g_rgb, so the
largest g_rgb gives the darkest raw frame. The caption describes the most saturation for the largest g_rgb, which
multiplication by g_rgb gives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import read_option
from unprocess_gen.config.values import value_text
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Float, Frame, Plan, Srgb
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.reports.html_pages import PageTable, render_page
from unprocess_gen.reports.paper import pictures
from unprocess_gen.reports.paper.pictures import BLUE, GREEN, GREY, INK, ORANGE, PaperFigure, percent, show_picture
from unprocess_gen.reports.report_files import write_files
from unprocess_gen.reports.sheets.contact_sheet import processing_steps
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference import isp, unprocess
from unprocess_gen.simulation.reference.cfa import mosaic, tile
from unprocess_gen.sources.loader import list_photographs, load_source

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE = "figures.html"

PHOTOGRAPHS_COUNTED = 40
"""Largest number of photographs, evenly spaced, whose saturated sites are counted."""

GAMMA = 2.2
"""Section 2 of the article, after Brooks et al. 2019."""

HIGHLIGHT_THRESHOLD = 0.9
"""Fraction of white from which the article's function keeps highlights."""

CODES = np.arange(256, dtype=np.uint8)

CROP_PX = 64
"""Side of the crops in Figure 5."""


# ------------------------------------------------------------------------------------------------------- photographs


class GainInterpretation(NamedTuple):
    """One interpretation of Figure 6: its description, and the gains (options of ``conf/gains``) of its two rows."""

    description: str
    top: str
    bottom: str


INTERPRETATIONS = (
    GainInterpretation("with the formula, which divides by g_rgb", "paper_min", "paper_max"),
    GainInterpretation("with the pictures, which multiply by it", "fig6_top", "fig6_bottom"),
)
DEFAULT_GAINS = "fixed"
GAINS = (DEFAULT_GAINS, *(name for reading in INTERPRETATIONS for name in (reading.top, reading.bottom)))
"""The options of ``conf/gains`` that the figures need."""

SMALL_GAINS, LARGE_GAINS = "paper_max", "fig6_bottom"
"""The options of `GAINS` with the smallest and the largest inverse gains."""

AUTHORS_NOISE = "imx385_iso3200_rvdd"
"""The option of ``conf/noise`` with the noise profile of the article's author."""


@dataclass(slots=True)
class Saturation:
    """Site counts of several photographs, the one in the figures first, and the photographs that cannot be read.

    ``sites`` counts all, ``before`` those at the highest code before unprocessing, ``after`` those at white in the
    clean frame for each option of `GAINS`.
    """

    sites: list[int] = field(default_factory=list)
    before: list[int] = field(default_factory=list)
    after: dict[str, list[int]] = field(default_factory=lambda: {name: [] for name in GAINS})
    failed: list[str] = field(default_factory=list)

    def count_matching(self, interpretation: GainInterpretation) -> int:
        """Count the photographs that match the caption of Figure 6: more saturation in the bottom row only."""
        columns = zip(self.before, self.after[interpretation.top], self.after[interpretation.bottom], strict=True)
        return sum(top <= before < bottom for before, top, bottom in columns)


@dataclass(frozen=True, slots=True)
class FigureSource:
    """The photograph in the figures, its plan for each option of `GAINS`, its plan with the author's noise, counts."""

    name: str
    srgb: Srgb
    plans: Mapping[str, Plan]
    authors: Plan
    saturation: Saturation


def load_figure_source(config: Config) -> FigureSource:
    """Read evenly spaced photographs, one at a time, and count their saturated sites; the first one is in the figures.

    ConfigError if none can be read.
    """
    sources = evenly_spaced(list_photographs(config.source).sources, PHOTOGRAPHS_COUNTED)
    configs = {name: replace(config, gains=read_option("gains", name)) for name in GAINS}
    saturation, subject = Saturation(), None
    for source in sources:
        try:
            sha256, photograph = load_source(config.source, source)
        except SourceError as error:
            saturation.failed.append(f"{source.name} ({error.reason})")
            continue
        srgb, identity = photograph.srgb, source.stream_identity(sha256)
        plans = {name: plan_image(option, *identity) for name, option in configs.items()}
        if subject is None:
            authors = replace(configs[DEFAULT_GAINS], noise=read_option("noise", AUTHORS_NOISE))
            subject = FigureSource(source.name, srgb, plans, plan_image(authors, *identity), saturation)
        before = saturated_sites(srgb, config.sensor.pattern)
        saturation.sites.append(before.size)
        saturation.before.append(int(before.sum()))
        for name, plan in plans.items():
            saturation.after[name].append(make_pair(srgb, plan).counts.saturated)
    if subject is None:
        raise ConfigError(
            f"source.root={config.source.place}: none of {len(sources)} photographs can be read; expected at least one"
        )
    return subject


def saturated_sites(srgb: Srgb, pattern: str) -> NDArray[np.bool_]:
    """The sites whose channel has the highest code in the photograph, ``[H, W]``."""
    return np.asarray(mosaic(srgb.astype(np.float64), pattern) == np.iinfo(srgb.dtype).max)


# ------------------------------------------------------------------------------------------------------------ figures


def draw_figures(config: Config) -> list[PaperFigure]:
    """Draw Figures 1 to 7 for the first readable photograph of the source of a validated config.

    ConfigError if no photograph can be read, or ``source.patch`` is set.
    """
    from matplotlib import rc_context

    if config.source.patch is not None:
        raise ConfigError(
            f"source.patch={value_text(config.source.patch)}: the figures show complete photographs; expected null; "
            "leave it out"
        )
    source = load_figure_source(config)
    draw = (
        *(draw_steps, draw_tone, draw_gamma, draw_highlight_function, draw_default_raw, draw_saturation),
        draw_highlights,
    )
    with rc_context(pictures.STYLE):
        return [function(source) for function in draw]


def write_figures(figures: Sequence[PaperFigure], out: Path, command: str) -> list[str]:
    """Write the figures and their page to a folder, and return the names of the files; MachineError if that fails."""
    contents = {**{figure.file: figure.png for figure in figures}, PAGE: figures_page(figures, command).encode()}
    write_files(out, contents)
    return list(contents)


def figures_page(figures: Sequence[PaperFigure], command: str) -> str:
    """The page of all figures with captions; it refers to the PNG files next to it."""
    return render_page("paper_figures.html", title="Figures of the article", command=command, figures=figures)


def _draw_inverse(axes: Axes, inputs: Float, forward: tuple[Float, str], inverse: tuple[Float, str], most: int) -> None:
    """Draw a curve and its inverse, with the identity."""
    axes.plot(inputs, inputs, color=GREY, linewidth=1, linestyle=":", label="identity")
    for (values, label), colour in ((forward, ORANGE), (inverse, BLUE)):
        axes.plot(inputs, values, color=colour, label=label)
    limits = {"xlabel": "input", "ylabel": "output", "xlim": (0, most), "ylim": (0, most), "aspect": "equal"}
    pictures.finish_curves(axes, "curves", **limits)


def draw_steps(source: FigureSource) -> PaperFigure:
    """Figure 1: the photograph after each step of unprocessing, and the mosaic."""
    plan, small = source.plans[DEFAULT_GAINS], pictures.small_photograph(source.srgb)
    figure, axes = pictures.panel_grid(2, 3, 9.4, pictures.panel_aspect(source.srgb))
    panels = iter(axes)
    show_picture(next(panels), small, "photograph")
    numbers = []
    for number, (title, note, image) in enumerate(processing_steps(small, plan), start=1):
        show_picture(next(panels), np.clip(image, 0, 1), f"{number}. {title}")
        numbers.append(f"{title} ({note})")
    clean = make_pair(source.srgb, plan).clean
    light = (pictures.block_means(clean, is_mosaic=True) - plan.sensor.black_level_dn) / plan.sensor.span_dn
    show_picture(next(panels), light, "5. mosaic")
    return PaperFigure("fig1.png", pictures.png(figure), {"name": source.name, "steps": "; ".join(numbers)})


def draw_tone(source: FigureSource) -> PaperFigure:
    """Figure 2: the tone curve, its inverse, and the photograph before and after the inverse."""
    figure, (curves, before, after, histogram) = pictures.panel_grid(2, 2, 8.4, 0.85)
    x = np.linspace(0, 1, 256)
    forward, backward = isp.smoothstep(x), unprocess.inverse_smoothstep(x, 1 - x)
    _draw_inverse(curves, x, (forward, "tone curve 3x² − 2x³"), (backward, "inverse"), 1)
    small = pictures.small_photograph(source.srgb)
    show_picture(before, small, "photograph")
    show_picture(after, unprocess.inverse_smoothstep(small, 1 - small), "after the inverse tone curve")
    inverse = unprocess.linear_light(CODES, "smoothstep", 1.0)
    codes = source.srgb if source.srgb.dtype == np.uint8 else (source.srgb >> 8).astype(np.uint8)
    shares = np.bincount(codes.ravel(), minlength=256) / codes.size
    for values, label, colour in ((CODES / 255, "photograph", ORANGE), (inverse, "after the inverse", BLUE)):
        histogram.hist(values, bins=64, range=(0, 1), weights=shares, histtype="step", color=colour, label=label)
    pictures.finish_curves(histogram, "histogram", xlabel="value", ylabel="fraction of all values", xlim=(0, 1))
    as_written = 0.5 - np.sin(np.arcsin(1 - 2 * (CODES / 255)) / 3)
    numbers = {
        "name": source.name,
        "examples": ", ".join(f"{code} to {inverse[code] * 255:.0f}" for code in (16, 64, 192, 240)),
        "difference": f"{np.abs(as_written - inverse).max():.1g}",
    }
    return PaperFigure("fig2.png", pictures.png(figure), numbers)


def draw_gamma(source: FigureSource) -> PaperFigure:
    """Figure 3: gamma compression, its inverse, and the photograph in linear light."""
    from matplotlib.figure import Figure

    u = np.arange(256) / 255
    figure = Figure(figsize=(8.4, 7.0), layout="constrained")
    panels = figure.subplot_mosaic(
        [["curve", "gradient"], ["curve", "compressed"], ["untoned", "linear"], ["untoned", "linear"]]
    )
    compressed, expanded = isp.compress_gamma(u, GAMMA), unprocess.expand_gamma(u, GAMMA)
    _draw_inverse(
        panels["curve"], u * 255, (compressed * 255, "v = u^(1/2.2)"), (expanded * 255, "inverse, u = v^2.2"), 255
    )
    show_picture(panels["gradient"], np.tile(u, (48, 1)), "linear gradient, 0 to 255")
    show_picture(panels["compressed"], np.tile(compressed, (48, 1)), "gradient after gamma compression")
    small = pictures.small_photograph(source.srgb)
    untoned = unprocess.inverse_smoothstep(small, 1 - small)
    show_picture(panels["untoned"], untoned, "after the inverse tone curve")
    show_picture(panels["linear"], unprocess.expand_gamma(untoned, GAMMA), "linear light: after the inverse gamma, too")
    linear = unprocess.linear_light(CODES, "smoothstep", GAMMA)
    examples = ", ".join(f"{code}: {linear[code]:.2g}" for code in (16, 64, 128, 192, 240))
    return PaperFigure("fig3.png", pictures.png(figure), {"name": source.name, "examples": examples})


def draw_highlight_function(source: FigureSource) -> PaperFigure:
    """Figure 4: the function f that inverts gains and keeps highlights."""
    figure, panels = pictures.panel_grid(1, 2, 8.4, 0.9)
    i = np.linspace(0, 1, 1001)
    inverse_gains = source.plans[DEFAULT_GAINS].camera.inverse_gains
    named = zip(inverse_gains, ("red", "green", "blue"), strict=True)
    gains = {f"{gain:.3g} ({name})": gain for gain, name in named} | {"1.18": 1 / 0.85, "2.05": 2.05}
    for axes, limits, title in zip(panels, ((0.0, 1.0), (0.85, 1.0)), ("f on [0, 1]", "near white"), strict=True):
        for (name, gain), colour in zip(gains.items(), (ORANGE, GREEN, BLUE, GREY, INK), strict=True):
            function = unprocess.invert_gains_per_channel(i, np.asarray(gain), HIGHLIGHT_THRESHOLD)
            axes.plot(i, function, color=colour, label=name)
            if gain < 1:
                axes.plot(i, i * gain, color=colour, linewidth=0.8, linestyle="--")
        axes.axvline(HIGHLIGHT_THRESHOLD, color=GREY, linewidth=0.8, linestyle=":")
        axes.axhline(1, color=GREY, linewidth=0.8)
        axes.set(xlabel="intensity i", ylabel="f(i)", xlim=limits, ylim=(0, 1.25))
        axes.set_title(title, loc="left")
    lines, labels = panels[0].get_legend_handles_labels()
    options = {"title": "inverse gain 1/g", "ncols": len(lines), "frameon": False, "fontsize": 8}
    figure.legend(lines, labels, loc="outside lower center", **options)
    weakest = min(inverse_gains)
    slope = weakest + (1 - weakest) * (1 + 2 / (1 - HIGHLIGHT_THRESHOLD))
    return PaperFigure("fig4.png", pictures.png(figure), {"weakest": f"{weakest:.3g}", "slope": f"{slope:.0f}"})


def draw_default_raw(source: FigureSource) -> PaperFigure:
    """Figure 5: the clean and noisy raw frame with the default gains, crops, and the noise curves."""
    plan, authors = source.plans[DEFAULT_GAINS], source.authors
    pair, authors_pair = make_pair(source.srgb, plan), make_pair(source.srgb, authors)
    figure, axes = pictures.panel_grid(2, 3, 9.4, max(pictures.panel_aspect(source.srgb), 0.8))
    show_picture(axes[0], pictures.small_photograph(source.srgb), "(a) photograph")
    for panel, frame, title in ((axes[1], pair.clean, "(b) clean raw"), (axes[2], pair.noisy, "(c) noisy raw")):
        limits = float(frame.min()), float(frame.max())
        show_picture(panel, pictures.green_sites(frame, plan.sensor.pattern), f"{title}, green sites", *limits)
    crop = _detailed_crop(source.srgb)
    limits = float(pair.clean[crop].min()), float(pair.clean[crop].max())
    show_picture(axes[3], pair.clean[crop].astype(np.float64), "(d) crop of the clean frame", *limits)
    show_picture(axes[4], pair.noisy[crop].astype(np.float64), "(d) same crop, noisy", *limits)
    signal = np.linspace(0, 400, 401)
    for noise, label, colour in ((plan.noise, "in (c)", BLUE), (authors.noise, "author's line", ORANGE)):
        axes[5].plot(signal, np.sqrt(np.maximum(noise.a_dn * signal + noise.b_dn2, 0)), color=colour, label=label)
    pictures.finish_curves(axes[5], "noise", xlabel="DN above black", ylabel="standard deviation, DN", xlim=(0, 400))
    axes[5].set_ylim(bottom=0)
    numbers = {
        "name": source.name,
        "plan": plan,
        "authors": authors.noise,
        "saturated": percent(pair.counts.saturated, pair.clean.size),
        "before": percent(saturated_sites(source.srgb, plan.sensor.pattern).sum(), pair.clean.size),
        "zero_variance": percent(authors_pair.counts.zero_variance, pair.clean.size),
    }
    return PaperFigure("fig5.png", pictures.png(figure), numbers)


DETAILED = 0.9
"""Share of the crops with less contrast than the one shown: of the median, many photographs show nothing but sky."""


def _detailed_crop(srgb: Srgb) -> tuple[slice, slice]:
    """The square of `CROP_PX` sites at the quantile `DETAILED` of the contrast, from even coordinates."""
    side = min(CROP_PX, *(max(length - length % 2, 1) for length in srgb.shape[:2]))
    rows, columns = (range(0, length - side + 1, side) for length in srgb.shape[:2])
    squares = [(slice(y, y + side), slice(x, x + side)) for y in rows for x in columns]
    squares.sort(key=lambda square: float(srgb[square].mean(axis=-1).std()))
    return squares[int(DETAILED * (len(squares) - 1))]


def draw_saturation(source: FigureSource) -> PaperFigure:
    """Figure 6: clean frames and their saturated sites at the extreme gains, in both interpretations."""
    figure, axes = pictures.panel_grid(2, 4, 11.0, pictures.panel_aspect(source.srgb))
    panels, counts = iter(axes), source.saturation
    for row in ("top", "bottom"):
        for reading in INTERPRETATIONS:
            name = getattr(reading, row)
            plan = source.plans[name]
            clean = make_pair(source.srgb, plan).clean
            saturated = clean == plan.sensor.white_level_dn
            pictures.show_stretched(next(panels), clean, f"{row}: {name}")
            fractions = pictures.channel_fractions(saturated, plan.sensor.pattern)
            show_picture(next(panels), fractions, f"saturated: {percent(saturated.sum(), clean.size)}")
    lines = []
    for name, after in counts.after.items():
        inverse_gains = ", ".join(f"{gain:.3g}" for gain in source.plans[name].camera.inverse_gains)
        own = [f"{count:,} ({percent(count, counts.sites[0])})" for count in (counts.before[0], after[0])]
        total = [percent(sum(images), sum(counts.sites)) for images in (counts.before, after)]
        more = sum(image > before for before, image in zip(counts.before, after, strict=True))
        lines.append((name, inverse_gains, *own, *total, f"{more} of {len(after)}"))
    headings = (
        *("gains", "inverse gains R, G, B", "saturated in the photograph", "in its raw frame"),
        *("in all photographs", "in all raw frames", "photographs with more than before"),
    )
    numbers = {
        "name": source.name,
        "readings": [(reading, counts.count_matching(reading)) for reading in INTERPRETATIONS],
        "counted": len(counts.sites),
        "failed": counts.failed,
    }
    return PaperFigure("fig6.png", pictures.png(figure), numbers, PageTable(headings, lines, range(1, len(headings))))


def draw_highlights(source: FigureSource) -> PaperFigure:
    """Figure 7: the highlights that the function creates with small inverse gains."""
    small, large = source.plans[SMALL_GAINS], source.plans[LARGE_GAINS]
    frames = {
        LARGE_GAINS: make_pair(source.srgb, large).clean,
        SMALL_GAINS: make_pair(source.srgb, small).clean,
        f"{SMALL_GAINS}, no function": make_pair(source.srgb, small.replace(highlight="none")).clean,
    }
    large_frame, with_function, without = frames.values()
    added = with_function.astype(np.float64) - without
    black_dn, white_dn = small.sensor.black_level_dn, small.sensor.white_level_dn
    figure, axes = pictures.panel_grid(2, 3, 9.4, pictures.panel_aspect(source.srgb))
    show_picture(axes[0], pictures.small_photograph(source.srgb), "(a) photograph")
    pictures.show_stretched(axes[1], large_frame, "(b) large inverse gains")
    pictures.show_stretched(axes[2], with_function, "(c) small inverse gains")
    limits = float(without.min()), float(with_function.max())
    show_picture(axes[3], pictures.block_means(without, is_mosaic=True), "without the function", *limits)
    fraction = pictures.block_means(added, is_mosaic=True) / (white_dn - black_dn)
    most = float(fraction.max())
    show_picture(axes[4], fraction, f"added light, up to {most:.0%} of white", high=most)
    _draw_profile(axes[5], with_function, without, added, small)
    axes[5].set_box_aspect(pictures.panel_aspect(source.srgb))
    bright_dn = black_dn + HIGHLIGHT_THRESHOLD * (white_dn - black_dn)
    lines = [
        (name, percent((clean == white_dn).sum(), clean.size), percent((clean >= bright_dn).sum(), clean.size))
        for name, clean in frames.items()
    ]
    headings = ("gains", "saturated", f"highlights, from {HIGHLIGHT_THRESHOLD:.0%} of white")
    numbers = {"name": source.name, "changed": percent((added > 0).sum(), added.size), "adds": bool(added.any())}
    return PaperFigure("fig7.png", pictures.png(figure), numbers, PageTable(headings, lines, (1, 2)))


def _draw_profile(axes: Axes, with_function: Frame, without: Frame, added: Float, plan: Plan) -> None:
    """Draw the green sites of the row where the function adds most, with and without it."""
    black_dn, white_dn = plan.sensor.black_level_dn, plan.sensor.white_level_dn
    row = int(added.sum(axis=1).argmax())
    start = tile(plan.sensor.pattern)[row % 2].index(1)
    columns = np.arange(added.shape[1])[start::2]
    for frame, label, colour in ((with_function, "with the function", BLUE), (without, "without", ORANGE)):
        values = (frame[row, start::2].astype(np.float64) - black_dn) / (white_dn - black_dn)
        axes.plot(columns, values, color=colour, linewidth=0.8, label=label)
    labels = {"xlabel": "column", "ylabel": "fraction of white", "ylim": (-0.03, 1.03)}
    pictures.finish_curves(axes, f"green sites of row {row}", **labels)
