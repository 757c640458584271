"""Draw pictures and curves of paper figures with matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import Frame, Srgb
from unprocess_gen.reports.encoding import figure_png
from unprocess_gen.reports.html_pages import PageTable
from unprocess_gen.simulation.reference.cfa import CHANNELS, mosaic, tile

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, BLUE, ORANGE, GREEN, GREY = "#000000", "#0072B2", "#D55E00", "#009E73", "#999999"
"""Colours of Okabe and Ito, which people with colour vision deficiency can distinguish."""

STYLE: dict[Any, Any] = {"font.size": 9, "axes.titlesize": 9.5, "axes.titleweight": "bold"}

MOST_PX = 720
"""Longest side of a picture in a figure."""

FloatImage = NDArray[np.float64]


class PaperFigure(NamedTuple):
    """A figure of the article: file name, PNG, and the numbers of its caption and its table in the template."""

    file: str
    png: bytes
    numbers: dict[str, Any]
    table: PageTable | None = None


def block_means(image: NDArray[Any], most: int = MOST_PX, is_mosaic: bool = False) -> FloatImage:
    """Means over square blocks, so that no side is longer than about ``most`` pixels.

    Blocks of a mosaic have even sides, so that each contains the four CFA sites equally often; a mosaic that is small
    enough is unchanged.
    """
    height, width = image.shape[:2]
    side = min(-(-max(height, width) // most), height, width)
    if is_mosaic and side > 1:
        side = max(side + side % 2 if side < min(height, width) else side - side % 2, 1)
    rows, columns = height // side, width // side
    blocks = image[: rows * side, : columns * side].reshape(rows, side, columns, side, *image.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64))


def small_photograph(srgb: Srgb) -> FloatImage:
    """A photograph at reduced size, ``[h, w, 3]`` in [0, 1]."""
    return block_means(srgb) / float(np.iinfo(srgb.dtype).max)


def green_sites(raw: Frame, pattern: str) -> FloatImage:
    """A green site of every tile, or of every few tiles of a large mosaic: not averaged, so that its noise shows."""
    step = 2 * max(1, -(-max(raw.shape) // (2 * MOST_PX)))
    return np.asarray(raw[::step, tile(pattern)[0].index(1) :: step], dtype=np.float64)


def channel_fractions(mask: NDArray[np.bool_], pattern: str, most: int = MOST_PX) -> FloatImage:
    """The fraction of set sites of each channel at reduced size, ``[h, w, 3]`` in [0, 1]."""
    channels = np.broadcast_to(np.arange(3.0), (*mask.shape, len(CHANNELS)))
    sites = mosaic(channels, pattern)[..., np.newaxis] == channels
    present = block_means(sites, most, is_mosaic=True)
    chosen = block_means(sites & mask[..., np.newaxis], most, is_mosaic=True)
    return np.divide(chosen, present, out=np.zeros_like(chosen), where=present > 0)


def show_picture(axes: Axes, picture: FloatImage, title: str, low: float = 0.0, high: float = 1.0) -> None:
    """Show a grey or RGB picture without ticks; grey values from ``low`` (black) to ``high`` (white)."""
    axes.imshow(picture, cmap="gray", vmin=low, vmax=max(high, low + 1e-9), interpolation="nearest")
    axes.set_title(title, loc="left")
    axes.set(xticks=[], yticks=[])


def show_stretched(axes: Axes, raw: Frame, title: str) -> None:
    """Show a raw frame as the article does: its lowest DN black, its highest DN white."""
    show_picture(axes, block_means(raw, is_mosaic=True), title, float(raw.min()), float(raw.max()))


def finish_curves(axes: Axes, title: str, **settings: Any) -> None:
    """Set title, labels and limits of a panel with curves, and show what they are."""
    axes.set(**settings)
    axes.set_title(title, loc="left")
    axes.legend(frameon=False)


def panel_grid(rows: int, columns: int, width: float, aspect: float) -> tuple[Figure, list[Axes]]:
    """A figure ``width`` inches wide with equal panels whose heights are ``aspect`` times their widths."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, rows * (width / columns * aspect + 0.35)), layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def panel_aspect(srgb: Srgb) -> float:
    """Height over width of a photograph, limited to 0.5 … 1.5."""
    height, width = srgb.shape[:2]
    return float(min(max(height / width, 0.5), 1.5))


def png(figure: Figure) -> bytes:
    """The bytes of a PNG."""
    return figure_png(figure, dpi=110)


def percent(part: int | np.integer[Any], total: int) -> str:
    """A ratio as a percentage with three decimals."""
    return f"{part / total:.3%}"
