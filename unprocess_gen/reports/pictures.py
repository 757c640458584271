"""Make figures, and encode figures and pictures (8-bit RGB, ``[H, W, 3]``) as the bytes of files."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from PIL import Image
from PIL.PngImagePlugin import PngInfo

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def new_figure(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure, inches, and its axes."""
    from matplotlib.figure import Figure  # optional library, extra "figures"

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def figure_png(figure: Figure, dpi: int) -> bytes:
    """A figure as PNG."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()


def picture_png(picture: Any, **texts: str) -> bytes:
    """A picture as PNG, with texts by their names."""
    info, content = PngInfo(), io.BytesIO()
    for name, text in texts.items():
        info.add_text(name, text)
    Image.fromarray(picture).save(content, "PNG", compress_level=3, pnginfo=info)
    return content.getvalue()


def picture_jpeg(picture: Any, quality: int) -> bytes:
    """A picture as JPEG; noise makes a PNG four times as large."""
    content = io.BytesIO()
    Image.fromarray(picture).save(content, "JPEG", quality=quality)
    return content.getvalue()
