"""Show raw frames and images: scale, stretch and develop them, and lay out sheets of titled panels (8-bit RGB)."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from unprocess_gen.calibration.planes import planes_of
from unprocess_gen.core.arrays import Float, Frame
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import MONO, tile
from unprocess_gen.simulation.reference.isp import develop, process, to_light

Picture = NDArray[np.uint8]

MosaicArray = Frame | Float
"""A mosaic ``[H, W]`` in DN, integer or not."""

PANEL_PX, CELL_PX = (224, 336), (120, 180)
"""Height and width of the box that a picture of a sheet is scaled into, and of a detail in a cell of a sweep."""

MARGIN_PX, LINE_PX = 10, 17
PAPER_GREY, INK_GREY, EMPTY_GREY = 250, 20, 225
"""Grey levels of the sheet, of text, and of panels without a picture."""

FONT, FONT_SCALE, CHARACTER_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.42, 10
"""Font of OpenCV, its scale, and the width of its widest character."""

DEMOSAIC_REACH_PX = 2
"""Distance from which sites influence a demosaicked pixel (`isp.KERNELS`)."""

Window = tuple[slice, slice]
"""The rows and columns of a detail."""


class SheetPanel(NamedTuple):
    """A titled image, complete and as a detail at one pixel per site: values of which [0, 1] is shown, or None."""

    title: str
    note: str
    overview: Float | None
    detail: Float | None = None


# ------------------------------------------------------------------------------------------------------------- scaling


def detail_window(
    shape: tuple[int, ...], panel_px: tuple[int, int] = PANEL_PX, centre: Sequence[float] | None = None
) -> Window:
    """Part of a frame that fits into a panel, about a place or the centre, from an even row and column."""
    middle = centre or [length / 2 for length in shape]
    firsts = (min(place - most / 2, length - most) for place, most, length in zip(middle, panel_px, shape, strict=True))
    starts = [int(max(0.0, first) / 2) * 2 for first in firsts]
    ends = (min(start + most, length) for start, most, length in zip(starts, panel_px, shape, strict=True))
    rows, columns = map(slice, starts, ends)
    return rows, columns


def fit_image(values: NDArray[Any], panel_px: tuple[int, int]) -> Float:
    """Scale an image into a panel: average if it is larger, repeat pixels by an integer factor if it is smaller."""
    height, width = values.shape[:2]
    scale = min(panel_px[0] / height, panel_px[1] / width)
    if scale >= 1:
        return np.asarray(values.repeat(int(scale), axis=0).repeat(int(scale), axis=1), dtype=np.float64)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


def average_planes(raw: MosaicArray, panel_px: tuple[int, int]) -> Float:
    """Scale the four planes of a mosaic into a panel, ``[H, W]`` to ``[h, w, 4]``; a lone row or column is doubled."""
    even = np.pad(raw, [(0, length % 2) for length in raw.shape], mode="reflect")
    return np.stack([fit_image(plane.astype(np.float32), panel_px) for plane in planes_of(even)], axis=-1)


def grey_tiles(raw: NDArray[Any]) -> NDArray[np.float32]:
    """Mean of each 2 x 2 tile of a mosaic, without a last odd row or column."""
    height, width = (side // 2 * 2 for side in raw.shape)
    planes = [np.asarray(plane, dtype=np.float32) for plane in planes_of(raw[:height, :width])]
    return np.asarray(np.mean(planes, axis=0))


def moved(picture: NDArray[np.float32], by: Float) -> NDArray[Any]:
    """Sample a picture at each pixel plus a flow [2, H, W]; NaN outside the picture."""
    y, x = np.indices(picture.shape, dtype=np.float32) + by
    return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderValue=float("nan")))


def finest_detail(values: NDArray[Any], box_px: tuple[int, int]) -> tuple[float, float]:
    """Centre of the box in which the mean square of the Laplacian of an image ``[H, W, C]`` is largest."""
    squares: Any = cv2.Laplacian(values.mean(axis=2, dtype=np.float32), cv2.CV_32F) ** 2
    sums: Any = cv2.boxFilter(squares, -1, box_px[::-1], borderType=cv2.BORDER_CONSTANT)
    row, column = np.unravel_index(int(sums.argmax()), sums.shape)
    return float(row), float(column)


# --------------------------------------------------------------------------------------------------------------- light


def common_stretch(dn: MosaicArray, plan: Plan) -> Float:
    """Stretch a frame from black to white of the darkened scene, square root, the same for every frame of a scene."""
    return np.sqrt(np.clip(to_light(dn, plan), 0, 1))


def stretch(dn: MosaicArray, least: float = 1.0) -> Float:
    """Stretch a frame to [0, 1] between its percentiles 0.1 and 99.9, if they are ``least`` apart."""
    low, high = np.percentile(dn, (0.1, 99.9))
    return np.asarray(np.clip((dn - low) / max(high - low, least), 0, 1))


# -------------------------------------------------------------------------------------------------------------- colour


def planes_to_rgb(planes: Float, pattern: str) -> Float:
    """Average each channel over each tile, ``[h, w, 4]`` to ``[h, w, 3]``; interpolation would colour every edge."""
    if pattern == MONO:
        return np.repeat(planes.mean(axis=-1, keepdims=True), 3, axis=-1)
    filters = np.ravel(tile(pattern))
    return np.stack([planes[..., filters == channel].mean(axis=-1) for channel in range(3)], axis=-1)


def develop_planes(planes: Float, plan: Plan) -> Float:
    """Develop the averages of the planes of a frame, ``[h, w, 4]`` to ``[h, w, 3]``."""
    return process(to_light(planes_to_rgb(planes, plan.sensor.pattern), plan), plan)


def develop_detail(raw: MosaicArray, plan: Plan, window: Window) -> Float | None:
    """Develop the detail with a border as wide as the demosaicking filter; None for a frame of one row or column."""
    if min(raw.shape) == 1:
        return None
    y, x = (max(0, part.start - DEMOSAIC_REACH_PX) for part in window)  # even, as the reach is
    rows, columns = window
    bordered = develop(raw[y : rows.stop + DEMOSAIC_REACH_PX, x : columns.stop + DEMOSAIC_REACH_PX], plan)
    return bordered[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x]


def colour_sites(values: Float, pattern: str) -> Float:
    """Put each value of a mosaic ``[H, W]`` into the channel of its filter, ``[H, W, 3]``; other channels are 0."""
    if pattern == MONO:
        return np.repeat(values[..., np.newaxis], 3, axis=-1)
    image = np.zeros((*values.shape, 3))
    for (y, x), channel in np.ndenumerate(np.array(tile(pattern))):
        image[y::2, x::2, channel] = values[y::2, x::2]
    return image


def byte_codes(values: Float) -> Picture:
    """Convert grey or RGB values, clipped to [0, 1], to 8-bit codes, ``[H, W, 3]``."""
    codes = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
    return np.repeat(codes[..., None], 3, axis=2) if codes.ndim == 2 else codes


# ------------------------------------------------------------------------------------------------------------- layout


def lay_out(heading: Sequence[str], panels: Sequence[SheetPanel], columns: int) -> Picture:
    """Lay out a sheet: a heading, then rows of panels with title and note, overview, and detail if any has one."""
    height, width = (length + MARGIN_PX for length in PANEL_PX)
    texts = [_wrapped([panel.title, panel.note], PANEL_PX[1]) for panel in panels]
    pictures = [panel[2:] if any(other.detail is not None for other in panels) else panel[2:3] for panel in panels]
    lines = _wrapped(heading, columns * width - MARGIN_PX)
    head_px, text_px = (LINE_PX * count + MARGIN_PX // 2 for count in (len(lines), max(map(len, texts))))
    panel_height, rows = text_px + len(pictures[0]) * height, -(-len(panels) // columns)
    sheet = np.full((head_px + rows * panel_height, columns * width, 3), PAPER_GREY, dtype=np.uint8)
    _write(sheet, lines)
    for number, (text, drawn) in enumerate(zip(texts, pictures, strict=True)):
        row, column = divmod(number, columns)
        panel = sheet[head_px + row * panel_height :, column * width :]
        _write(panel, text)
        for place, values in enumerate(drawn):
            box = panel[text_px + place * height :][: PANEL_PX[0], : PANEL_PX[1]]
            box[:] = EMPTY_GREY
            if values is not None:
                top, left = ((most - length) // 2 for most, length in zip(PANEL_PX, values.shape, strict=False))
                box[top : top + values.shape[0], left : left + values.shape[1]] = byte_codes(values)
    return sheet


def _wrapped(paragraphs: Sequence[str], width_px: int) -> list[str]:
    return [line for text in paragraphs for line in textwrap.wrap(text, width_px // CHARACTER_PX)]


def _write(part: Picture, lines: Sequence[str]) -> None:
    """Write lines at the upper left of a part of a sheet; characters that the font lacks become question marks."""
    for number, line in enumerate(lines, start=1):
        place, shown = (MARGIN_PX // 2, number * LINE_PX - 4), line.encode("ascii", "replace").decode()
        cv2.putText(part, shown, place, FONT, FONT_SCALE, (INK_GREY, INK_GREY, INK_GREY), 1, cv2.LINE_AA)
