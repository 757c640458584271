"""Encode figures and pictures as the bytes of PNG and JPEG files."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figure_png(figure: Figure, dpi: int) -> bytes:
    """Return a figure as PNG."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()


def picture_png(picture: NDArray[Any]) -> bytes:
    """Return a picture, 8-bit RGB ``[H, W, 3]``, as PNG."""
    return _picture_bytes(".png", picture, cv2.IMWRITE_PNG_COMPRESSION, 3)


def picture_jpeg(picture: NDArray[Any], quality: int) -> bytes:
    """Return a picture, 8-bit RGB ``[H, W, 3]``, as JPEG; noise makes a PNG four times as large."""
    return _picture_bytes(".jpg", picture, cv2.IMWRITE_JPEG_QUALITY, quality)


def _picture_bytes(suffix: str, picture: NDArray[Any], option: int, value: int) -> bytes:
    _, content = cv2.imencode(suffix, np.ascontiguousarray(picture[..., ::-1]), (option, value))
    return content.tobytes()
