"""The article's figures, made again on a photograph: ``fig2.png`` … ``fig7.png``, and a page that says what to see.

What the figures show is computed by the rooms that make datasets; the photograph's own numbers stand in the captions,
and so does where they differ from the article's text. Raw frames are shown as the article shows them: gray, the range
from the lowest to the highest DN stretched to the full one. The article's photographs are not known, so counts are its
claims tried on others: those of Figure 6 on up to `MOST_COUNTED` photographs, one at a time.

The article's Figure 6 can be read in two ways (`INTERPRETATIONS`). Its formula divides by g_rgb, so the greatest
g_rgb gives the darkest raw frame; its caption has the most saturation there, which is what multiplying by it gives.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.schema import Config, GainsConfig, NoiseConfig
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Float, Frame, Plan, Source, Srgb
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.reports.html_pages import PageTable, render_page
from unprocess_gen.reports.report_files import write_files
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference.cfa import CHANNELS, tile
from unprocess_gen.simulation.reference.isp import compress_gamma, smoothstep
from unprocess_gen.simulation.reference.unprocess import (
    expand_gamma,
    inverse_smoothstep,
    invert_gains_per_channel,
    linear_light,
)
from unprocess_gen.sources.loader import list_photographs, load_source

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAGE = "figures.html"
MOST_COUNTED = 40
"""Photographs whose saturated sites are counted, spread over the source."""

GAMMA = 2.2
"""Section 2 of the article, after Brooks et al. 2019."""

HIGHLIGHT = 0.9
"""Share of white from which a site is called a highlight: the article's threshold."""

CROP_PX = 64
"""Side of the crops of Figure 5."""


class GainInterpretation(NamedTuple):
    """One way to read Figure 6: what is said of it, and the gains (options of ``conf/gains``) of its two rows."""

    said: str
    top: str
    bottom: str


INTERPRETATIONS = (
    GainInterpretation("by the formula, divided by g_rgb", "paper_min", "paper_max"),
    GainInterpretation("by the pictures, multiplied by it", "fig6_top", "fig6_bottom"),
)
DEFAULT_GAINS = "fixed"
GAINS = (DEFAULT_GAINS, *(name for reading in INTERPRETATIONS for name in (reading.top, reading.bottom)))
"""The options of ``conf/gains`` that the figures are made with."""

AUTHORS_NOISE = "imx385_iso3200_rvdd"


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """What the article sets: the gains of `GAINS` by name, and its author's own noise profile beside the default."""

    gains: Mapping[str, GainsConfig]
    authors_noise: NoiseConfig


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """A figure: its file, its title, the PNG, and what stands below it: paragraphs, and a table (headings first)."""

    file: str
    title: str
    png: bytes
    caption: tuple[str, ...]
    table: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class FigureSource:
    """The photograph that is shown, and its plan under the gains of each name."""

    name: str
    srgb: Srgb
    plans: Mapping[str, Plan]
    authors: Plan


class ImageSaturation(NamedTuple):
    """Sites of a photograph's clean frame: all, at the highest code in the photograph itself, at white in the frame."""

    sites: int
    before: int
    after: int


@dataclass(frozen=True, slots=True)
class SaturationCounts:
    """The saturations of photographs under the gains of each name, and which could not be read, and why."""

    by_gains: Mapping[str, Sequence[ImageSaturation]]
    failed: tuple[str, ...] = ()

    def fitting(self, reading: GainInterpretation) -> int:
        """Return how many photographs are as Figure 6's caption says: no more saturation on top, more at the bottom."""
        both = zip(self.by_gains[reading.top], self.by_gains[reading.bottom], strict=True)
        return sum(top.after <= top.before and bottom.after > bottom.before for top, bottom in both)


Picture = NDArray[np.float64]


def draw_figures(config: Config, recipes: PaperOptions) -> list[PaperFigure]:
    """Draw all figures on the first photograph of the source that can be read.

    Raises ConfigError where there is none, and where ``source.patch`` asks for patches: figures show photographs.
    """
    if config.source.patch is not None:
        raise ConfigError(f"source.patch={config.source.patch}: the figures show whole photographs; leave it out")
    listed = list_photographs(config.source).sources
    subject = _subject(config, recipes, listed)
    counted = _count(config, recipes, evenly_spaced(listed, MOST_COUNTED))
    return [
        _tone(subject),
        _gamma(subject),
        _highlight_function(subject),
        _default_raw(subject, counted),
        _saturations(subject, counted),
        _highlights(subject),
    ]


def write_figures(drawn: Sequence[PaperFigure], out: Path, command: str) -> list[str]:
    """Write the figures and their page; return the names of the files. MachineError where that fails."""
    contents = {**{one.file: one.png for one in drawn}, PAGE: figures_page(drawn, command).encode()}
    write_files(out, contents)
    return list(contents)


def figures_page(figures: Sequence[PaperFigure], command: str) -> str:
    """Return the page of all figures with captions; it refers to the PNG files next to it."""
    return render_page(
        "paper_figures.html",
        title="Figures of the article",
        command=command,
        figures=[
            {
                "title": figure.title,
                "file": figure.file,
                "caption": figure.caption,
                "table": PageTable(figure.table[0], figure.table[1:], range(1, len(figure.table[0])))
                if figure.table
                else None,
            }
            for figure in figures
        ],
    )


# --------------------------------------------------------------------------------------------------- the photographs


def _subject(config: Config, recipes: PaperOptions, listed: Sequence[Source]) -> FigureSource:
    for source in listed:
        with suppress(SourceError):
            sha256, photograph = load_source(config.source, source)
            plans = {name: _plan(config, source, sha256, recipes.gains[name]) for name in GAINS}
            by_author = replace(config, noise=recipes.authors_noise)
            authors = _plan(by_author, source, sha256, recipes.gains[DEFAULT_GAINS])
            return FigureSource(source.name, photograph.srgb, plans, authors)
    raise ConfigError(f"source.root={config.source.root}: none of {len(listed)} photographs can be read")


def _plan(config: Config, source: Source, sha256: str, gains: GainsConfig) -> Plan:
    return plan_image(replace(config, gains=gains), *source.stream_identity(sha256))


def _count(config: Config, recipes: PaperOptions, listed: Iterable[Source]) -> SaturationCounts:
    """Count the saturated sites of photographs under the gains of every name."""
    counted: dict[str, list[ImageSaturation]] = {name: [] for name in GAINS}
    failed = []
    for source in listed:
        try:
            sha256, photograph = load_source(config.source, source)
        except SourceError as error:
            failed.append(f"{source.name} ({error.reason})")
            continue
        before = _saturated_before(photograph.srgb, config.sensor.pattern)
        for name in GAINS:
            plan = _plan(config, source, sha256, recipes.gains[name])
            after = make_pair(photograph.srgb, plan).counts.saturated
            counted[name].append(ImageSaturation(before.size, int(before.sum()), after))
    return SaturationCounts(counted, tuple(failed))


def _saturated_before(srgb: Srgb, pattern: str) -> NDArray[np.bool_]:
    """Return which sites have the highest code in the photograph itself, ``[H, W]``."""
    before = np.empty(srgb.shape[:2], dtype=np.bool_)
    for (y, x), channel in np.ndenumerate(np.array(tile(pattern))):
        before[y::2, x::2] = srgb[y::2, x::2, channel] == np.iinfo(srgb.dtype).max
    return before


# ------------------------------------------------------------------------------------------------------ for the eyes


def _shrunk(image: NDArray[Any], most: int, of_sites: bool = False) -> Picture:
    """Return means over squares of pixels, so that no side is longer than about ``most``.

    Squares of a mosaic (``of_sites``) have even sides, so that each holds its four sites alike; one that is small
    enough stays as it is.
    """
    height, width = image.shape[:2]
    side = min(-(-max(height, width) // most), height, width)
    if of_sites and side > 1:
        side = max(side + side % 2 if side < min(height, width) else side - side % 2, 1)
    rows, columns = height // side, width // side
    squares = image[: rows * side, : columns * side].reshape(rows, side, columns, side, *image.shape[2:])
    return np.asarray(squares.mean(axis=(1, 3), dtype=np.float64))


def _display(srgb: Srgb, most: int = 720) -> Picture:
    """Return a photograph as it is, ``[h, w, 3]`` in [0, 1], small."""
    return _shrunk(srgb, most) / float(np.iinfo(srgb.dtype).max)


def _channel_shares(of_sites: NDArray[np.bool_], pattern: str, most: int = 720) -> Picture:
    """Return which share of each channel's sites is set, ``[h, w, 3]`` in [0, 1], small."""
    channel = np.tile(np.array(tile(pattern)), tuple(-(-side // 2) for side in of_sites.shape))
    channel = channel[: of_sites.shape[0], : of_sites.shape[1]]
    planes = []
    for number in range(len(CHANNELS)):
        present = _shrunk(channel == number, most, of_sites=True)
        chosen = _shrunk(of_sites & (channel == number), most, of_sites=True)
        planes.append(np.divide(chosen, present, out=np.zeros_like(chosen), where=present > 0))
    return np.stack(planes, axis=-1)


def _typical(clean: Frame) -> tuple[slice, slice]:
    """Return a square of `CROP_PX` sites that varies as much as half of all do, at even corners."""
    side = min(CROP_PX, *(max(length - length % 2, 1) for length in clean.shape))
    rows, columns = (range(0, length - side + 1, side) for length in clean.shape)
    squares = [(slice(y, y + side), slice(x, x + side)) for y in rows for x in columns]
    return sorted(squares, key=lambda square: float(clean[square].std()))[len(squares) // 2]


def _show(axes: Axes, picture: Picture, title: str, low: float = 0.0, high: float = 1.0) -> None:
    axes.imshow(picture, cmap="gray", vmin=low, vmax=max(high, low + 1e-9), interpolation="nearest")
    axes.set_title(title, loc="left")
    axes.set_xticks([])
    axes.set_yticks([])


def _stretched(axes: Axes, raw: Frame, title: str) -> None:
    """Show a frame as the article does: its lowest DN black, its highest white."""
    small = _shrunk(raw, 720, of_sites=True)
    _show(axes, small, title, float(raw.min()), float(raw.max()))


def _figure(rows: int, columns: int, width: float, aspect: float) -> tuple[Figure, list[Axes]]:
    """Return a figure ``width`` inches wide of equal panels, whose heights are ``aspect`` times their widths."""
    from matplotlib.figure import Figure

    height = rows * (width / columns * aspect + 0.35)
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def _aspect(srgb: Srgb) -> float:
    """Return a photograph's height over its width, within what a panel can be."""
    height, width = (float(length) for length in srgb.shape[:2])
    return min(max(height / width, 0.5), 1.5)


def _png(draw_on: Callable[[], Figure]) -> bytes:
    from matplotlib import rc_context

    style: dict[Any, Any] = {"font.size": 9, "axes.titlesize": 9.5, "axes.titleweight": "bold"}
    with rc_context(style):
        content = io.BytesIO()
        draw_on().savefig(content, format="png", dpi=110)
    return content.getvalue()


INK, BLUE, ORANGE, GREEN, GRAY = "#000000", "#0072B2", "#D55E00", "#009E73", "#999999"
"""Colours of Okabe and Ito, which colour-blind readers can tell apart."""

# --------------------------------------------------------------------------------------------- Figures 2 and 3: curves

CODES = np.arange(256, dtype=np.uint8)


def _inverse_tone(codes: Srgb) -> Float:
    return linear_light(codes, "smoothstep", 1.0)


def _tone(subject: FigureSource) -> PaperFigure:
    x = np.linspace(0, 1, 256)
    inverse = _inverse_tone(CODES)
    as_written = 0.5 - np.sin(np.arcsin(1 - 2 * (CODES / 255)) / 3)

    def drawn() -> Figure:
        figure, (curves, before, after, codes) = _figure(2, 2, 8.4, 0.85)
        curves.plot(x, x, color=GRAY, linewidth=1, linestyle=":", label="unchanged")
        curves.plot(x, smoothstep(x), color=ORANGE, label="tone curve 3x² − 2x³")
        curves.plot(x, inverse_smoothstep(x, 1 - x), color=BLUE, label="its inverse")
        curves.set(xlabel="in", ylabel="out", xlim=(0, 1), ylim=(0, 1), aspect="equal")
        curves.set_title("the curves", loc="left")
        curves.legend(frameon=False)
        small = _display(subject.srgb)
        _show(before, small, "the photograph")
        _show(after, inverse_smoothstep(small, 1 - small), "its tone curve undone")
        _code_histogram(codes, subject.srgb, {"the photograph": np.arange(256) / 255, "undone": inverse})
        return figure

    seen = ", ".join(f"{code} to {inverse[code] * 255:.0f}" for code in (16, 64, 192, 240))
    return PaperFigure(
        "fig2.png",
        "Figure 2: the tone curve and its inverse",
        _png(drawn),
        (
            f"On {subject.name}. The tone curve pushes bright values up and dark ones down; its inverse takes codes "
            f"{seen}, so that the photograph turns pale and its values draw together in the middle.",
            "Against the article: it writes ½ − sin(asin(1 − 2x) / 3), a difference that loses digits towards black. "
            "Here the same function is sin t · (√3 cos t + sin t), t = asin(√x) / 3, without one. On the 256 codes the "
            f"two differ by at most {np.abs(as_written - inverse).max():.1g}: nothing to see.",
        ),
    )


def _code_histogram(axes: Axes, srgb: Srgb, curves: Mapping[str, Float]) -> None:
    """Draw how a photograph's values are spread, once through each curve of 256 codes."""
    codes = srgb if srgb.dtype == np.uint8 else (srgb >> 8).astype(np.uint8)
    counts = np.bincount(codes.ravel(), minlength=256)
    for (name, curve), colour in zip(curves.items(), (ORANGE, BLUE), strict=True):
        axes.hist(
            curve, bins=64, range=(0, 1), weights=counts / counts.sum(), histtype="step", color=colour, label=name
        )
    axes.set(xlabel="value", ylabel="share of all values", xlim=(0, 1))
    axes.set_title("how its values are spread", loc="left")
    axes.legend(frameon=False)


def _gamma(subject: FigureSource) -> PaperFigure:
    u = np.arange(256) / 255

    def drawn() -> Figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8.4, 7.0), layout="constrained")
        grid = figure.add_gridspec(4, 2)
        curve = figure.add_subplot(grid[:2, 0])
        curve.plot(u * 255, u * 255, color=GRAY, linewidth=1, linestyle=":", label="unchanged")
        curve.plot(u * 255, compress_gamma(u, GAMMA) * 255, color=ORANGE, label="v = u^(1/2.2)")
        curve.plot(u * 255, expand_gamma(u, GAMMA) * 255, color=BLUE, label="its inverse, u = v^2.2")
        curve.set(xlabel="in", ylabel="out", xlim=(0, 255), ylim=(0, 255), aspect="equal")
        curve.set_title("the curves", loc="left")
        curve.legend(frameon=False, loc="upper left")
        for row, values, title in (
            (0, u, "linear, 0 to 255"),
            (1, compress_gamma(u, GAMMA), "the same, gamma corrected"),
        ):
            _show(figure.add_subplot(grid[row, 1]), np.tile(values, (48, 1)), title)
        small = _display(subject.srgb)
        untoned = inverse_smoothstep(small, 1 - small)
        _show(figure.add_subplot(grid[2:, 0]), untoned, "the photograph, its tone curve undone")
        _show(figure.add_subplot(grid[2:, 1]), expand_gamma(untoned, GAMMA), "linear light: its gamma undone too")
        return figure

    linear = linear_light(CODES, "smoothstep", GAMMA)
    seen = ", ".join(f"{code}: {linear[code]:.2g}" for code in (16, 64, 128, 192, 240))
    return PaperFigure(
        "fig3.png",
        "Figure 3: gamma compression and its inverse",
        _png(drawn),
        (
            "Gamma compression spends more codes on dark light: the gamma corrected gradient is brighter everywhere "
            f"but at its ends. On {subject.name} the inverse darkens all but white. With the tone curve undone before, "
            f"codes become these shares of white: {seen}.",
            "Against the article: it clips to 0 before the power. The inverse tone curve has no value below 0, so "
            "nothing is clipped here.",
        ),
    )


# -------------------------------------------------------------------------------------------- Figure 4: the function f


def _highlight_function(subject: FigureSource) -> PaperFigure:
    i = np.linspace(0, 1, 1001)
    fixed = subject.plans[DEFAULT_GAINS]
    gains = {
        **{f"{k:.3g} ({name})": k for k, name in zip(fixed.inverse_gains, ("red", "green", "blue"), strict=True)},
        "1.18": 1 / 0.85,
        "2.05": 2.05,
    }

    def drawn() -> Figure:
        figure, (whole, near) = _figure(1, 2, 8.4, 0.9)
        for axes, limits, title in ((whole, (0.0, 1.0), "f on [0, 1]"), (near, (0.85, 1.0), "near white")):
            for (name, k), colour in zip(gains.items(), (ORANGE, GREEN, BLUE, GRAY, INK), strict=True):
                axes.plot(i, invert_gains_per_channel(i, np.asarray(k), HIGHLIGHT), color=colour, label=name)
                if k < 1:
                    axes.plot(i, i * k, color=colour, linewidth=0.8, linestyle="--")
            axes.axvline(HIGHLIGHT, color=GRAY, linewidth=0.8, linestyle=":")
            axes.axhline(1, color=GRAY, linewidth=0.8)
            axes.set(xlabel="intensity i", ylabel="f(i)", xlim=limits, ylim=(0, 1.25))
            axes.set_title(title, loc="left")
        whole.legend(title="inverse gain 1/g", frameon=False, fontsize=8)
        return figure

    weakest = min(fixed.inverse_gains)
    slope = weakest + (1 - weakest) * (1 + 2 / (1 - HIGHLIGHT))
    return PaperFigure(
        "fig4.png",
        "Figure 4: the function that keeps highlights",
        _png(drawn),
        (
            "Inverse gains below 1 follow the line i/g (dashed where it is left) up to 0.9, then rise to exactly 1 at "
            "white, whatever the gain; inverse gains above 1 are lines, and cross white (the horizontal rule) before "
            f"i = 1. With {weakest:.3g} the slope at white is {slope:.0f}: the jump toward saturation that the article "
            "finds in Figure 7.",
            "Against the article: its 100·(i − 0.9)² is written ((i − 0.9) / (1 − 0.9))², because in floating point "
            "100·(1 − 0.9)² is not 1 and white would not stay white. Brooks et al. blend by the mean of the three "
            "channels (gains.highlight=gray_mean); the article, and this figure, channel by channel.",
        ),
    )


# ------------------------------------------------------------------------------------------- Figure 5: the default raw


def _default_raw(subject: FigureSource, counted: SaturationCounts) -> PaperFigure:
    plan, authors = subject.plans[DEFAULT_GAINS], subject.authors
    pair, by_author = make_pair(subject.srgb, plan), make_pair(subject.srgb, authors)

    def drawn() -> Figure:
        figure, axes = _figure(2, 3, 9.4, max(_aspect(subject.srgb), 0.8))
        _show(axes[0], _display(subject.srgb), "(a) the photograph")
        _stretched(axes[1], pair.clean, "(b) the clean raw frame")
        _stretched(axes[2], pair.noisy, "(c) the noisy one")
        crop = _typical(pair.clean)
        low, high = float(pair.clean[crop].min()), float(pair.clean[crop].max())
        _show(axes[3], pair.clean[crop].astype(np.float64), "(d) clean, a crop's sites", low, high)
        _show(axes[4], pair.noisy[crop].astype(np.float64), "(d) noisy", low, high)
        _noise_curves(axes[5], plan, authors)
        return figure

    silent_dn = -authors.b_dn2 / authors.a_dn
    before = _saturated_before(subject.srgb, plan.pattern)
    return PaperFigure(
        "fig5.png",
        "Figure 5: the default raw frame, clean and noisy",
        _png(drawn),
        (
            f"On {subject.name}: a gray mosaic, whose checkerboard in the crops shows where the filters see different "
            "light, and noise that grows with the signal. (b) and (c) are stretched from their lowest to their highest "
            "DN, as in the article; the crops (d), typical of how much the frame varies, share one range. "
            f"{_share(pair.counts.saturated, pair.clean.size)} of the sites are saturated, "
            f"{_share(int(before.sum()), before.size)} are so in the photograph.",
            f"Red {plan.red_gain:g}, blue {plan.blue_gain:g} (the centres of Brooks' ranges), camera {plan.camera}, "
            f"black {plan.black_level_dn}, white {plan.white_level_dn}. Against the article: its text divides by a "
            f"global gain of 0.8, Brooks' code multiplies by it; this figure multiplies, by {plan.inverse_rgb_gain:g}.",
            "It names the sensor and the ISO, not a and b, and adds its noise to DN that include the black level. (c) "
            f"has those of the data set it names: variance {plan.a_dn:.4g}·(x − black) + {plan.b_dn2:.4g} DN². Its "
            f"author's own line, {authors.a_dn:.4g}·(x − black) {authors.b_dn2:+.4g}, was fitted with the black level "
            f"in; it is below 0 up to {silent_dn:.4g} DN above black, where there is no "
            f"noise at all: {_share(by_author.counts.zero_variance, pair.clean.size)} of the sites here.",
        ),
    )


def _noise_curves(axes: Axes, plan: Plan, authors: Plan) -> None:
    signal = np.linspace(0, 400, 401)
    for one, name, colour in ((plan, "in (c)", BLUE), (authors, "its author's", ORANGE)):
        axes.plot(signal, np.sqrt(np.maximum(one.a_dn * signal + one.b_dn2, 0)), color=colour, label=name)
    axes.set(xlabel="DN above black", ylabel="deviation, DN", xlim=(0, 400))
    axes.set_ylim(bottom=0)
    axes.set_title("the noise", loc="left")
    axes.legend(frameon=False)


def _share(part: int, whole: int) -> str:
    return f"{part / whole:.3%}"


# ------------------------------------------------------------------------------------------- Figure 6: the saturations

HEADINGS = (
    "gains",
    "inverse gains R, G, B",
    "saturated in the photograph",
    "in its raw frame",
    "in all photographs",
    "in their raw frames",
    "photographs with more than before",
)


def _saturations(subject: FigureSource, counted: SaturationCounts) -> PaperFigure:
    def drawn() -> Figure:
        figure, axes = _figure(2, 4, 11.0, _aspect(subject.srgb))
        for column, reading in enumerate(INTERPRETATIONS):
            for row, name in enumerate((reading.top, reading.bottom)):
                plan = subject.plans[name]
                clean = make_pair(subject.srgb, plan).clean
                at = row * 4 + column * 2
                saturated = clean == plan.white_level_dn
                _stretched(axes[at], clean, f"{'bottom' if row else 'top'}: {name}")
                share = _share(int(saturated.sum()), clean.size)
                _show(axes[at + 1], _channel_shares(saturated, plan.pattern), f"saturated: {share}")
        return figure

    verdicts = "; ".join(
        f"{reading.said} ({reading.top}, {reading.bottom}), on {counted.fitting(reading)}"
        for reading in INTERPRETATIONS
    )
    failed = (f"Photographs that cannot be read: {', '.join(counted.failed)}.",) if counted.failed else ()
    return PaperFigure(
        "fig6.png",
        "Figure 6: saturations at the minimum and maximum gains",
        _png(drawn),
        (
            f"On {subject.name}. Left of each pair the clean raw frame, right of it its saturated sites in the colour "
            "of their filter (white: all of them), and their share. The left half divides by g_rgb, the right half "
            "multiplies by it. The article's caption: on top the gains do not create more saturation, at the bottom "
            "more is created.",
            "Against the article: its formula divides by g_rgb, and then its minimum (0.85) brightens and its maximum "
            "(2.05) darkens, the reverse of its caption; multiplying by the same numbers gives what the caption says. "
            f"Of {len(counted.by_gains[DEFAULT_GAINS])} photographs the caption holds, {verdicts}.",
            *failed,
        ),
        (HEADINGS, *(_saturation_line(name, subject.plans[name], counted.by_gains[name]) for name in GAINS)),
    )


def _saturation_line(name: str, plan: Plan, counted: Sequence[ImageSaturation]) -> tuple[str, ...]:
    """Return a line of the table; of the photographs counted the first that can be read is the one shown."""
    first, sites = counted[0], sum(one.sites for one in counted)
    return (
        name,
        ", ".join(f"{k:.3g}" for k in plan.inverse_gains),
        f"{first.before:,} ({_share(first.before, first.sites)})",
        f"{first.after:,} ({_share(first.after, first.sites)})",
        _share(sum(one.before for one in counted), sites),
        _share(sum(one.after for one in counted), sites),
        f"{sum(one.after > one.before for one in counted)} of {len(counted)}",
    )


# -------------------------------------------------------------------------------------------- Figure 7: the highlights

SMALL_GAINS, LARGE_GAINS = "paper_max", "fig6_bottom"
"""The gains of Figure 7 with the smallest and the largest inverse gains among those of Figure 6."""


def _highlights(subject: FigureSource) -> PaperFigure:
    small, large = subject.plans[SMALL_GAINS], subject.plans[LARGE_GAINS]
    kept = make_pair(subject.srgb, small).clean
    plain = make_pair(subject.srgb, replace(small, highlight="none")).clean
    many = make_pair(subject.srgb, large).clean
    lifted = kept.astype(np.float64) - plain
    span = small.white_level_dn - small.black_level_dn

    def drawn() -> Figure:
        figure, axes = _figure(2, 3, 9.4, _aspect(subject.srgb))
        _show(axes[0], _display(subject.srgb), "(a) the photograph")
        _stretched(axes[1], many, "(b) large inverse gains")
        _stretched(axes[2], kept, "(c) small inverse gains")
        limits = float(plain.min()), float(kept.max())
        _show(axes[3], _shrunk(plain, 720, of_sites=True), "without the function", *limits)
        added = _shrunk(lifted, 720, of_sites=True) / span
        _show(axes[4], added, f"what it adds, up to {added.max():.0%} of white", high=float(added.max()))
        _profile(axes[5], kept, plain, lifted, small)
        axes[5].set_box_aspect(_aspect(subject.srgb))
        return figure

    rows = ((LARGE_GAINS, large, many), (SMALL_GAINS, small, kept), (f"{SMALL_GAINS}, no function", small, plain))
    return PaperFigure(
        "fig7.png",
        "Figure 7: the highlights that the function creates",
        _png(drawn),
        (
            f"On {subject.name}. With small inverse gains ({SMALL_GAINS}) all of the frame is dark but what was nearly "
            "white, which the function lifts towards saturation: so there are edges inside of what looks uniformly "
            f"bright in the photograph. It changes {_share(int((lifted > 0).sum()), lifted.size)} of the sites. The "
            f"profile runs along {'the row where it adds most' if lifted.any() else 'a row: it adds nothing here'}.",
            "Against the article: it says that with small inverse gains more highlights appear. They do, beside the "
            "same gains without the function; but f(i) is 1 at i = 1 alone, so there is no more saturation than with "
            f"large inverse gains ({LARGE_GAINS}), whose lines cross white before. The counts are of this photograph.",
        ),
        (
            ("gains", "saturated", f"highlights, from {HIGHLIGHT:.0%} of white"),
            *(_highlight_line(*row) for row in rows),
        ),
    )


def _highlight_line(name: str, plan: Plan, clean: Frame) -> tuple[str, ...]:
    bright_dn = plan.black_level_dn + HIGHLIGHT * (plan.white_level_dn - plan.black_level_dn)
    return (
        name,
        _share(int((clean == plan.white_level_dn).sum()), clean.size),
        _share(int((clean >= bright_dn).sum()), clean.size),
    )


def _profile(axes: Axes, kept: Frame, plain: Frame, lifted: Float, plan: Plan) -> None:
    """Draw the green sites of one row, with the function and without it."""
    row = int(lifted.sum(axis=1).argmax())
    start = tile(plan.pattern)[row % 2].index(1)
    for frame, name, colour in ((kept, "with it", BLUE), (plain, "without", ORANGE)):
        values = frame[row, start::2].astype(np.float64) - plan.black_level_dn
        axes.plot(
            np.arange(values.size) * 2 + start,
            values / (plan.white_level_dn - plan.black_level_dn),
            color=colour,
            linewidth=0.8,
            label=name,
        )
    axes.set(xlabel="column", ylabel="light of white", ylim=(-0.03, 1.03))
    axes.set_title(f"green sites of row {row}", loc="left")
    axes.legend(frameon=False, loc="upper left")
