"""Draw Figures 1 to 7 of the article: ``python docs/figures/draw.py source.root=photos out=figs``.

The figures show the first photograph that can be read, by default a synthetic picture, computed with the code that
makes datasets: ``fig1.png`` … ``fig7.png`` in ``out``. Other overrides, such as ``camera=sony_a7r``, work too. The
article's photographs are not published. So the claims of its Figure 6 are counted on up to `PHOTOGRAPHS_COUNTED`
photographs, and the counts are printed. ``docs/differences.md`` compares the article with this package.

Figure 6 has two readings (`READINGS`). The formula divides by g_rgb, so the largest g_rgb gives the darkest raw frame.
The caption describes the most saturation for the largest g_rgb, which multiplication by g_rgb gives.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

import unprocess_gen as ug
from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import read_option
from unprocess_gen.core.arrays import Float, Frame, Srgb
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import isp, unprocess
from unprocess_gen.simulation.reference.cfa import CHANNELS, mosaic, tile
from unprocess_gen.sources.listing import list_photographs
from unprocess_gen.sources.loader import load_source

READINGS = {"divided by g_rgb": ("paper_min", "paper_max"), "multiplied by g_rgb": ("fig6_top", "fig6_bottom")}
"""Readings of Figure 6, with the options of ``conf/gains`` of its top and bottom row."""

DEFAULT, SMALL, LARGE = "fixed", "paper_max", "fig6_bottom"
"""The options of ``conf/gains`` of the other figures: default, smallest and largest inverse gains."""

AUTHORS_NOISE = "imx385_iso3200_rvdd"
"""The noise profile of the article's author."""

GAMMA, THRESHOLD = 2.2, 0.9
"""Gamma of the article, and fraction of white from which its function keeps highlights."""

PHOTOGRAPHS_COUNTED, MOST_PX, CROP_PX, DETAILED = 40, 720, 64, 0.9
"""Most photographs counted, longest side of a picture, side of the crops of Figure 5, their quantile of contrast."""

INK, BLUE, ORANGE, GREEN, GREY = "#000000", "#0072B2", "#D55E00", "#009E73", "#999999"
STYLE: dict[Any, Any] = {"font.size": 9, "axes.titlesize": 9.5, "axes.titleweight": "bold"}


class Photograph(NamedTuple):
    """Pixels, the plan for each option of gains, and the plan with the author's noise."""

    srgb: Srgb
    plans: Mapping[str, Plan]
    authors: Plan


def photographs(config: Config) -> Iterator[Photograph]:
    """Yield evenly spaced photographs; those that cannot be read are left out."""
    names = {DEFAULT, SMALL, LARGE, *(name for reading in READINGS.values() for name in reading)}
    configs = {name: replace(config, gains=read_option("gains", name)) for name in names}
    authors = replace(configs[DEFAULT], noise=read_option("noise", AUTHORS_NOISE))
    for source in evenly_spaced(list_photographs(config.source).sources, PHOTOGRAPHS_COUNTED):
        try:
            sha256, photograph = load_source(config.source, source)
        except SourceError as error:
            print(f"{source.name}: {error}")
            continue
        identity = source.stream_identity(sha256)
        plans = {name: plan_image(option, *identity) for name, option in configs.items()}
        yield Photograph(photograph.srgb, plans, plan_image(authors, *identity))


def saturated_sites(srgb: Srgb, pattern: str) -> NDArray[np.bool_]:
    """Sites whose channel has the highest code in the photograph, ``[H, W]``."""
    return np.asarray(mosaic(srgb.astype(np.float64), pattern) == np.iinfo(srgb.dtype).max)


# ----------------------------------------------------------------------------------------------------------- pictures


def block_means(image: NDArray[Any], is_mosaic: bool = False) -> Float:
    """Means over square blocks, so that no side is much longer than `MOST_PX`; those of a mosaic have even sides."""
    height, width = image.shape[:2]
    side = min(-(-max(height, width) // MOST_PX), height, width)
    side += side % 2 if is_mosaic and side > 1 else 0
    rows, columns = height // side, width // side
    blocks = image[: rows * side, : columns * side].reshape(rows, side, columns, side, *image.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64))


def small_picture(srgb: Srgb) -> Float:
    """A photograph at reduced size, values in [0, 1]."""
    return np.asarray(block_means(srgb) / np.iinfo(srgb.dtype).max)


def filter_colours(mask: NDArray[np.bool_], pattern: str) -> Float:
    """The fraction of set sites of each channel at reduced size, ``[h, w, 3]``."""
    channels = np.broadcast_to(np.arange(3.0), (*mask.shape, len(CHANNELS)))
    sites = mosaic(channels, pattern)[..., np.newaxis] == channels
    present, chosen = (block_means(each, is_mosaic=True) for each in (sites, sites & mask[..., np.newaxis]))
    return np.divide(chosen, present, out=np.zeros_like(chosen), where=present > 0)


def show(axes: Axes, picture: Float, title: str, low: float = 0.0, high: float = 1.0) -> None:
    """Show a grey or RGB picture without ticks; grey values from ``low`` (black) to ``high`` (white)."""
    axes.imshow(picture, cmap="gray", vmin=low, vmax=max(high, low + 1e-9), interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, loc="left")


def show_raw(axes: Axes, raw: Frame, title: str) -> None:
    """Show a raw frame as the article does: its lowest DN black, its highest DN white."""
    show(axes, block_means(raw, is_mosaic=True), title, float(raw.min()), float(raw.max()))


def finish(axes: Axes, title: str, **settings: Any) -> None:
    """Set title, labels and limits of a panel with curves."""
    axes.set(**settings)
    axes.set_title(title, loc="left")
    axes.legend(frameon=False)


def grid(rows: int, columns: int, width: float, srgb: Srgb) -> tuple[Figure, list[Axes]]:
    """A figure ``width`` inches wide, whose panels have the shape of a photograph."""
    aspect = min(max(srgb.shape[0] / srgb.shape[1], 0.7), 1.5)
    figure = Figure(figsize=(width, rows * (width / columns * aspect + 0.35)), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def show_inverse(axes: Axes, x: Float, forward: tuple[str, Float], inverse: tuple[str, Float]) -> None:
    """Draw a curve and its inverse, with the identity."""
    axes.plot(x, x, color=GREY, linewidth=1, linestyle=":", label="identity")
    for (label, values), colour in ((forward, ORANGE), (inverse, BLUE)):
        axes.plot(x, values, color=colour, label=label)
    finish(axes, "curves", xlabel="input", ylabel="output", xlim=(0, 1), ylim=(0, 1), aspect="equal")


# ------------------------------------------------------------------------------------------------------------ figures


def steps(photo: Photograph) -> Figure:
    """Figure 1: the photograph after each step of unprocessing, and the mosaic."""
    plan, values = photo.plans[DEFAULT], small_picture(photo.srgb)
    figure, axes = grid(2, 3, 9.4, photo.srgb)
    show(axes[0], values, "photograph")
    camera = plan.camera
    for number, (title, step) in enumerate(
        {
            "tone curve inverted": lambda light: unprocess.INVERSE_TONES[plan.isp.tone](light, 1 - light),
            "gamma inverted": lambda light: unprocess.expand_gamma(light, plan.isp.gamma),
            "colour matrix inverted": lambda light: unprocess.apply_ccm(light, camera.rgb2cam),
            "gains inverted": lambda light: unprocess.invert_gains(
                light, camera.inverse_gains, plan.isp.highlight, plan.isp.highlight_threshold
            ),
        }.items(),
        start=1,
    ):
        values = step(values)
        show(axes[number], np.clip(values, 0, 1), f"{number}. {title}")
    clean = block_means(make_pair(photo.srgb, plan).clean, is_mosaic=True)
    show(axes[5], (clean - plan.sensor.black_level_dn) / plan.sensor.span_dn, "5. mosaic")
    return figure


def tone(photo: Photograph) -> Figure:
    """Figure 2: the tone curve, its inverse, and the photograph before and after the inverse."""
    figure, axes = grid(2, 2, 8.4, photo.srgb)
    x, small = np.linspace(0, 1, 256), small_picture(photo.srgb)
    inverse = unprocess.inverse_smoothstep(small, 1 - small)
    curves = ("tone curve 3x² − 2x³", isp.smoothstep(x)), ("inverse", unprocess.inverse_smoothstep(x, 1 - x))
    show_inverse(axes[0], x, *curves)
    show(axes[1], small, "photograph")
    show(axes[2], inverse, "after the inverse tone curve")
    for label, values, colour in (("photograph", small, ORANGE), ("after the inverse", inverse, BLUE)):
        axes[3].hist(values.ravel(), bins=64, range=(0, 1), density=True, histtype="step", color=colour, label=label)
    finish(axes[3], "histogram", xlabel="value", ylabel="density", xlim=(0, 1))
    return figure


def gamma(photo: Photograph) -> Figure:
    """Figure 3: gamma compression, its inverse, and the photograph in linear light."""
    u, small = np.linspace(0, 1, 256), small_picture(photo.srgb)
    figure = Figure(figsize=(8.4, 7.0), layout="constrained")
    panels = figure.subplot_mosaic([["curve", "gradient"], ["curve", "compressed"], ["untoned", "linear"]])
    compressed = isp.compress_gamma(u, GAMMA)
    show_inverse(panels["curve"], u, ("u^(1/2.2)", compressed), ("u^2.2", unprocess.expand_gamma(u, GAMMA)))
    show(panels["gradient"], np.tile(u, (48, 1)), "linear gradient")
    show(panels["compressed"], np.tile(compressed, (48, 1)), "gradient after gamma compression")
    untoned = unprocess.inverse_smoothstep(small, 1 - small)
    show(panels["untoned"], untoned, "after the inverse tone curve")
    show(panels["linear"], unprocess.expand_gamma(untoned, GAMMA), "linear light: after the inverse gamma, too")
    return figure


def highlight_function(photo: Photograph) -> Figure:
    """Figure 4: the function f that inverts gains and keeps highlights."""
    figure, axes = grid(1, 2, 8.4, photo.srgb)
    i = np.linspace(0, 1, 1001)
    gains = [*photo.plans[DEFAULT].camera.inverse_gains, 1 / 0.85, 2.05]
    for panel, start, title in ((axes[0], 0.0, "f on [0, 1]"), (axes[1], 0.85, "near white")):
        for gain, colour in zip(gains, (ORANGE, GREEN, BLUE, GREY, INK), strict=True):
            function = unprocess.invert_gains_per_channel(i, np.asarray(gain), THRESHOLD)
            panel.plot(i, function, color=colour, label=f"1/g = {gain:.3g}")
        panel.axvline(THRESHOLD, color=GREY, linewidth=0.8, linestyle=":")
        finish(panel, title, xlabel="intensity i", ylabel="f(i)", xlim=(start, 1), ylim=(0, 1.25))
    return figure


def default_raw(photo: Photograph) -> Figure:
    """Figure 5: the clean and noisy raw frame with the default gains, crops, and the noise curves."""
    plan = photo.plans[DEFAULT]
    pair = make_pair(photo.srgb, plan)
    figure, axes = grid(2, 3, 9.4, photo.srgb)
    show(axes[0], small_picture(photo.srgb), "(a) photograph")
    first, step = tile(plan.sensor.pattern)[0].index(1), 2 * max(1, -(-max(pair.clean.shape) // (2 * MOST_PX)))
    for panel, frame, title in ((axes[1], pair.clean, "(b) clean raw"), (axes[2], pair.noisy, "(c) noisy raw")):
        sites = frame[::step, first::step].astype(np.float64)  # averages would hide the noise
        show(panel, sites, f"{title}, green sites", float(frame.min()), float(frame.max()))
    crop = detailed_crop(photo.srgb)
    limits = float(pair.clean[crop].min()), float(pair.clean[crop].max())
    show(axes[3], pair.clean[crop].astype(np.float64), "(d) crop of the clean frame", *limits)
    show(axes[4], pair.noisy[crop].astype(np.float64), "(d) same crop, noisy", *limits)
    signal = np.linspace(0, 400, 401)
    for noise, label, colour in ((plan.noise, "in (c)", BLUE), (photo.authors.noise, "author's line", ORANGE)):
        axes[5].plot(signal, np.sqrt(np.maximum(noise.a_dn * signal + noise.b_dn2, 0)), color=colour, label=label)
    finish(axes[5], "noise", xlabel="DN above black", ylabel="standard deviation, DN", xlim=(0, 400))
    return figure


def detailed_crop(srgb: Srgb) -> tuple[slice, slice]:
    """The square of `CROP_PX` sites at the quantile `DETAILED` of the contrast, from even coordinates."""
    side = min(CROP_PX, *(max(length - length % 2, 1) for length in srgb.shape[:2]))
    rows, columns = (range(0, length - side + 1, side) for length in srgb.shape[:2])
    squares = [(slice(y, y + side), slice(x, x + side)) for y in rows for x in columns]
    squares.sort(key=lambda square: float(srgb[square].mean(axis=-1).std()))
    return squares[int(DETAILED * (len(squares) - 1))]


def saturation(photo: Photograph) -> Figure:
    """Figure 6: clean frames and their saturated sites at the extreme gains, in both readings."""
    figure, axes = grid(2, 4, 11.0, photo.srgb)
    options = [reading[row] for row in (0, 1) for reading in READINGS.values()]
    for number, name in enumerate(options):
        plan = photo.plans[name]
        clean = make_pair(photo.srgb, plan).clean
        saturated = clean == plan.sensor.white_level_dn
        show_raw(axes[2 * number], clean, f"{'bottom' if number > 1 else 'top'}: {name}")
        colours = filter_colours(saturated, plan.sensor.pattern)
        show(axes[2 * number + 1], colours, f"saturated: {saturated.mean():.3%}")
    return figure


def highlights(photo: Photograph) -> Figure:
    """Figure 7: the highlights that the function creates with small inverse gains."""
    small, black_dn = photo.plans[SMALL], photo.plans[SMALL].sensor.black_level_dn
    large = make_pair(photo.srgb, photo.plans[LARGE]).clean
    kept, plain = (make_pair(photo.srgb, plan).clean for plan in (small, small.replace(highlight="none")))
    light, plain_light = ((frame.astype(np.float64) - black_dn) / small.sensor.span_dn for frame in (kept, plain))
    added = light - plain_light
    figure, axes = grid(2, 3, 9.4, photo.srgb)
    show(axes[0], small_picture(photo.srgb), "(a) photograph")
    show_raw(axes[1], large, "(b) large inverse gains")
    show_raw(axes[2], kept, "(c) small inverse gains")
    show(axes[3], block_means(plain_light, is_mosaic=True), "without the function", 0, float(light.max()))
    fraction = block_means(added, is_mosaic=True)
    show(axes[4], fraction, f"added light, up to {fraction.max():.0%} of white", high=float(fraction.max()))
    row = int(added.sum(axis=1).argmax())
    first = tile(small.sensor.pattern)[row % 2].index(1)
    for values, label, colour in ((light, "with the function", BLUE), (plain_light, "without", ORANGE)):
        axes[5].plot(values[row, first::2], color=colour, linewidth=0.8, label=label)
    labels = {"xlabel": "green site", "ylabel": "fraction of white", "ylim": (-0.03, 1.03)}
    finish(axes[5], f"row {row}, where the function adds most", **labels)
    return figure


FIGURES = (steps, tone, gamma, highlight_function, default_raw, saturation, highlights)


def matches_caption(photo: Photograph, top: str, bottom: str) -> bool:
    """Whether only the gains of the bottom row of Figure 6 create saturation."""
    before = int(saturated_sites(photo.srgb, photo.plans[top].sensor.pattern).sum())
    counts = [make_pair(photo.srgb, photo.plans[name]).counts.saturated for name in (top, bottom)]
    return counts[0] <= before < counts[1]


def main(overrides: list[str]) -> None:
    """Draw the figures of the first photograph, and count the photographs that match the caption of Figure 6."""
    config = ug.load_config(["out=figures", *overrides])
    out, matching, count = Path(config.out), dict.fromkeys(READINGS, 0), 0
    out.mkdir(parents=True, exist_ok=True)
    for count, photo in enumerate(photographs(config), start=1):
        with rc_context(STYLE):
            for number, draw in enumerate(FIGURES if count == 1 else (), start=1):
                draw(photo).savefig(out / f"fig{number}.png", dpi=110, metadata={"Software": None})
        for reading, options in READINGS.items():
            matching[reading] += matches_caption(photo, *options)
    for reading, matches in matching.items():
        print(f"Figure 6, {reading}: {matches} of {count} photographs match the caption")


if __name__ == "__main__":
    main(sys.argv[1:])
