"""Scale raw frames and images to panels, and lay out sheets of titled panels.

All pictures are uint8 ``[H, W, 3]``, RGB.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float, Frame
from unprocess_gen.simulation.reference.cfa import MONO, tile
from unprocess_gen.statistics.mosaics import planes_of

Picture = NDArray[np.uint8]

MosaicArray = Frame | Float
"""A mosaic ``[H, W]`` in DN, integer or not."""

PANEL_PX = (224, 336)
STRIP_PX = (120, 180)
"""Height and width of the box that a picture is scaled into, on a sheet and on a strip of an overview."""

MARGIN_PX, LINE_PX = 10, 17
PAPER_GREY, INK_GREY, EMPTY_GREY = 250, 20, 225
"""Grey levels of the sheet, of text, and of panels without a picture."""

FONT, FONT_SCALE, CHARACTER_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.42, 10
"""Font of OpenCV, its scale, and the width of its widest character."""

Window = tuple[slice, slice]
"""The rows and columns of a detail."""


class SheetPanel(NamedTuple):
    """A titled image, complete and as a detail at one pixel per site: grey or RGB values of which [0, 1] is shown.

    The note says why a picture is None.
    """

    title: str
    note: str
    overview: Float | None
    detail: Float | None = None


def detail_window(shape: tuple[int, ...], panel_px: tuple[int, int] = PANEL_PX) -> Window:
    """Find the centre of a frame that fits into a panel, which begins at an even row and column like the Bayer tile."""
    starts = [max(0, length - most) // 4 * 2 for length, most in zip(shape, panel_px, strict=True)]
    rows, columns = (slice(start, start + most) for start, most in zip(starts, panel_px, strict=True))
    return slice(rows.start, min(rows.stop, shape[0])), slice(columns.start, min(columns.stop, shape[1]))


def average_planes(raw: MosaicArray, panel_px: tuple[int, int]) -> Float:
    """Scale the four planes of a mosaic into a panel, ``[H, W]`` to ``[h, w, 4]``; a lone row or column is doubled.

    Planes are averaged before anything is developed, which keeps sheets of large frames fast.
    """
    even = np.pad(raw, [(0, length % 2) for length in raw.shape], mode="reflect")
    return np.stack([fit_image(plane.astype(np.float32), panel_px) for plane in planes_of(even)], axis=-1)


def planes_to_rgb(planes: Float, pattern: str) -> Float:
    """Average each channel over each tile, ``[h, w, 4]`` to ``[h, w, 3]``.

    Nothing is interpolated: a demosaicking filter would add colour to every edge.
    """
    if pattern == MONO:
        return np.repeat(planes.mean(axis=-1, keepdims=True), 3, axis=-1)
    filters = np.ravel(tile(pattern))
    return np.stack([planes[..., filters == channel].mean(axis=-1) for channel in range(3)], axis=-1)


def colour_sites(values: Float, pattern: str) -> Float:
    """Put each value of a mosaic ``[H, W]`` into the channel of its filter, ``[H, W, 3]``; other channels are 0."""
    if pattern == MONO:
        return np.repeat(values[..., np.newaxis], 3, axis=-1)
    image = np.zeros((*values.shape, 3))
    for (y, x), channel in np.ndenumerate(np.array(tile(pattern))):
        image[y::2, x::2, channel] = values[y::2, x::2]
    return image


def byte_codes(values: Float) -> Picture:
    """Convert to 8-bit codes grey or RGB values, clipped to [0, 1], ``[H, W, 3]``."""
    codes = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
    return np.repeat(codes[..., None], 3, axis=2) if codes.ndim == 2 else codes


def fit_image(values: NDArray[Any], panel_px: tuple[int, int]) -> Float:
    """Scale an image into a panel: average if it is larger, repeat pixels by an integer factor if it is smaller."""
    height, width = values.shape[:2]
    scale = min(panel_px[0] / height, panel_px[1] / width)
    if scale >= 1:
        return np.asarray(values.repeat(int(scale), axis=0).repeat(int(scale), axis=1), dtype=np.float64)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


# ------------------------------------------------------------------------------------------------------------- layout


def lay_out(
    heading: Sequence[str], panels: Sequence[SheetPanel], columns: int, panel_px: tuple[int, int] = PANEL_PX
) -> Picture:
    """Lay out a sheet: a heading, then rows of panels with title and note, overview, and detail if any has one."""
    pictures_drawn = 1 + any(panel.detail is not None for panel in panels)
    texts = [_lines([panel.title, panel.note], panel_px[1]) for panel in panels]
    boxes = []
    for text, (_, _, *pictures) in zip(texts, panels, strict=True):
        drawn = [_box(picture, panel_px) for picture in pictures[:pictures_drawn]]
        boxes.append(np.vstack([_text(text, panel_px[1], max(map(len, texts))), *drawn]))
    boxes += [np.full_like(boxes[0], PAPER_GREY)] * (-len(boxes) % columns)
    rows = [np.hstack(boxes[start : start + columns]) for start in range(0, len(boxes), columns)]
    width_px = rows[0].shape[1] - MARGIN_PX
    lines = _lines(heading, width_px)
    return np.vstack([_text(lines, width_px, len(lines)), *rows])


def _box(values: Float | None, panel_px: tuple[int, int]) -> Picture:
    """Put a picture in the middle of a box, with a margin on the right and below."""
    box = np.full((*panel_px, 3), EMPTY_GREY, dtype=np.uint8)
    if values is not None:
        picture = byte_codes(values)
        top, left = ((most - length) // 2 for most, length in zip(panel_px, picture.shape, strict=False))
        box[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return np.pad(box, ((0, MARGIN_PX), (0, MARGIN_PX), (0, 0)), constant_values=PAPER_GREY)


def _lines(paragraphs: Sequence[str], width_px: int) -> list[str]:
    return [line for text in paragraphs for line in textwrap.wrap(text, width_px // CHARACTER_PX)]


def _text(lines: Sequence[str], width_px: int, count: int) -> Picture:
    """Draw lines in a box for ``count``; characters that OpenCV's font lacks become question marks."""
    box = np.full((LINE_PX * count + MARGIN_PX // 2, width_px + MARGIN_PX, 3), PAPER_GREY, dtype=np.uint8)
    for number, line in enumerate(lines, start=1):
        place, shown = (MARGIN_PX // 2, number * LINE_PX - 4), line.encode("ascii", "replace").decode()
        cv2.putText(box, shown, place, FONT, FONT_SCALE, (INK_GREY, INK_GREY, INK_GREY), 1, cv2.LINE_AA)
    return box
