"""Lay pictures out as sheets of titled panels, and scale raw frames and images to panels.

All pictures are uint8 ``[H, W, 3]``, RGB.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import Float, Frame, Srgb
from unprocess_gen.simulation.reference.cfa import tile

Picture = NDArray[np.uint8]

Mosaic = Frame | Float
"""A mosaic ``[H, W]`` in DN, integer or not."""

PANEL_PX = (224, 336)
STRIP_PX = (120, 180)
"""Height and width of the box that a picture is scaled into, on a sheet and on a strip of an overview."""

COLUMNS = 4


class SheetPanel(NamedTuple):
    """Two pictures of one image, the complete image and a detail at one pixel per site, with title and note.

    A picture that does not exist is None; the note gives the reason.
    """

    title: str
    note: str
    overview: Picture | None
    detail: Picture | None = None


class DetailWindow(NamedTuple):
    """The rows and columns shown as detail, and the side of the squares averaged for the overview."""

    rows: slice
    columns: slice
    side: int


def detail_window(shape: tuple[int, ...], panel_px: tuple[int, int] = PANEL_PX) -> DetailWindow:
    """Return the centre of a frame of shape [H, W], beginning at an even row and column like the Bayer tile.

    The averaged frame remains at least twice as large as the panel: a mosaic of that size holds the panel's detail.
    """
    height, width = shape
    rows, columns = _centre(height, panel_px[0]), _centre(width, panel_px[1])
    reduction = max(height / panel_px[0], width / panel_px[1])
    return DetailWindow(rows, columns, max(1, min(int(reduction / 2), height // 2, width // 2)))


def _centre(length: int, most: int) -> slice:
    start = max(0, length - most) // 4 * 2
    return slice(start, start + min(length, most))


# --------------------------------------------------------------------------------------------------- pictures of data


def average_mosaic(raw: Mosaic, side: int) -> Float:
    """Average ``side`` x ``side`` sites of one colour each, which gives a smaller mosaic of the same pattern.

    Rows and columns that do not fill a square are omitted. Averaging the mosaic before developing it keeps sheets of
    large frames fast.
    """
    if side == 1:
        return raw.astype(np.float64)
    height, width = (length // (2 * side) for length in raw.shape)
    row_dtype, dtype = (np.uint32, np.uint64) if raw.dtype == np.uint16 else (np.float64, np.float64)
    rows = raw[: height * 2 * side, : width * 2 * side].reshape(height, side, 2, -1).sum(axis=1, dtype=row_dtype)
    sites = rows.reshape(height, 2, width, side, 2).sum(axis=3, dtype=dtype)  # rows first: ten times as fast
    return np.asarray(sites.reshape(2 * height, 2 * width) / float(side * side))


def tile_channels(averaged_dn: Float, pattern: str) -> Float:
    """Return the mean of each channel over each 2x2 tile of an averaged mosaic, ``[2 H, 2 W]`` to ``[H, W, 3]``.

    The averaged squares of one tile cover the same pixels up to an offset of one site, so nothing needs to be
    interpolated; a demosaicking filter would add colour to every edge.
    """
    planes = [averaged_dn[y::2, x::2] for y in (0, 1) for x in (0, 1)]
    filters = [channel for row in tile(pattern) for channel in row]
    return np.stack(
        [np.mean([p for p, c in zip(planes, filters, strict=True) if c == k], axis=0) for k in range(3)], -1
    )


def colour_sites(values: Float, pattern: str) -> Float:
    """Return each value of a mosaic ``[H, W]`` in the channel of its filter, ``[H, W, 3]``; other channels are 0."""
    image = np.zeros((*values.shape, 3))
    for (y, x), channel in np.ndenumerate(np.array(tile(pattern))):
        image[y::2, x::2, channel] = values[y::2, x::2]
    return image


def to_codes(values: Float) -> Picture:
    """Return 8-bit codes of grey or RGB values, clipped to [0, 1], ``[H, W, 3]``."""
    codes = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
    return np.repeat(codes[..., None], 3, axis=2) if codes.ndim == 2 else codes


def fit_image(values: Float | Srgb, panel_px: tuple[int, int]) -> Float:
    """Scale an image into a panel: average if it is larger, repeat pixels by an integer factor if it is smaller."""
    height, width = values.shape[:2]
    scale = min(panel_px[0] / height, panel_px[1] / width)
    if scale >= 1:
        return np.asarray(values.repeat(int(scale), axis=0).repeat(int(scale), axis=1), dtype=np.float64)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


def fit_mosaic(mosaic_dn: Float, panel_px: tuple[int, int]) -> Float:
    """Scale a mosaic into a panel as grey; if it shrinks, average 2x2 sites first to avoid moiré from the tile."""
    shrinks = mosaic_dn.shape[0] > panel_px[0] or mosaic_dn.shape[1] > panel_px[1]
    if shrinks and min(mosaic_dn.shape) > 1:
        rows = mosaic_dn[:-1] + mosaic_dn[1:]
        mosaic_dn = (rows[:, :-1] + rows[:, 1:]) / 4
    return fit_image(mosaic_dn, panel_px)


# ------------------------------------------------------------------------------------------------------------- layout

PAPER, INK, EMPTY = 250, 20, 225
"""Grey levels of the sheet, of text, and of panels without a picture."""

MARGIN_PX = 10
LINE_PX = 17
FONT, FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.42


def lay_out(
    heading: Sequence[str], panels: Sequence[SheetPanel], panel_px: tuple[int, int] = PANEL_PX, columns: int = COLUMNS
) -> Picture:
    """Return a sheet: a heading, then rows of panels with title and note, overview, and detail if any has one."""
    width = columns * (panel_px[1] + MARGIN_PX) + MARGIN_PX
    bands = [_text(heading, width, MARGIN_PX)]
    for start in range(0, len(panels), columns):
        row = panels[start : start + columns]
        bands.append(_join([_text([panel.title, panel.note], panel_px[1]) for panel in row], panel_px[1], width))
        bands.append(_join([_centred(panel.overview, panel_px) for panel in row], panel_px[1], width))
        if any(panel.detail is not None for panel in row):
            bands.append(_join([_centred(panel.detail, panel_px) for panel in row], panel_px[1], width))
    return np.vstack([*bands, _blank(MARGIN_PX, width)])


def _blank(height: int, width: int, grey: int = PAPER) -> Picture:
    return np.full((height, width, 3), grey, dtype=np.uint8)


def _join(boxes: Sequence[Picture], box_width: int, width: int) -> Picture:
    """Return boxes of equal width in one row, the lower ones padded."""
    band = _blank(max(len(box) for box in boxes) + MARGIN_PX // 2, width)
    for number, box in enumerate(boxes):
        left = MARGIN_PX + number * (box_width + MARGIN_PX)
        band[: len(box), left : left + box_width] = box
    return band


def _centred(picture: Picture | None, panel_px: tuple[int, int]) -> Picture:
    """Return a picture in the centre of its panel."""
    box = _blank(*panel_px, grey=EMPTY)
    if picture is not None:
        top, left = ((most - length) // 2 for most, length in zip(panel_px, picture.shape, strict=False))
        box[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return box


def _text(paragraphs: Sequence[str], width: int, left: int = 0) -> Picture:
    """Return paragraphs as a picture; characters that OpenCV's font lacks become question marks."""
    lines = [
        line for text in paragraphs for line in wrap_text(text.encode("ascii", "replace").decode(), width - 2 * left)
    ]
    box = _blank(LINE_PX * len(lines) + MARGIN_PX // 2, width)
    for number, line in enumerate(lines, start=1):
        cv2.putText(box, line, (left, number * LINE_PX - 4), FONT, FONT_SCALE, (INK, INK, INK), 1, cv2.LINE_AA)
    return box


def wrap_text(text: str, width_px: int) -> list[str]:
    """Break text into lines that fit, at spaces if possible; no character is lost except spaces at line ends."""
    lines: list[str] = []
    line = ""
    for word in text.split(" "):
        if line and _width_px(f"{line} {word}") <= width_px:
            line = f"{line} {word}"
            continue
        lines += [line] if line else []
        line = word
        while _width_px(line) > width_px:
            fits = max(1, next(n for n in range(len(line), 0, -1) if n == 1 or _width_px(line[:n]) <= width_px))
            lines, line = [*lines, line[:fits]], line[fits:]
    return [*lines, line] if line else lines


def _width_px(text: str) -> int:
    return int(cv2.getTextSize(text, FONT, FONT_SCALE, 1)[0][0])
