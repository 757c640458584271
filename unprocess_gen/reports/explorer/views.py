"""Compute what the page draws of a pair: pictures of a window of its frames, and curves."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import PACKED, Float
from unprocess_gen.reports.explorer.exploration import Shown
from unprocess_gen.reports.photon_transfer import fit_pair
from unprocess_gen.reports.sheets import panels
from unprocess_gen.reports.sheets.contact_sheet import common_stretch, develop_detail, stretch
from unprocess_gen.reports.sheets.panels import MosaicArray, Window
from unprocess_gen.simulation.reference import unprocess
from unprocess_gen.simulation.reference.isp import process, to_light

PICTURES = {
    "source": "Source",
    "clean": "Clean raw",
    "noisy": "Noisy raw",
    "clean_developed": "Clean, developed",
    "noisy_developed": "Noisy, developed",
    "saturated": "Saturated sites",
}
"""Names and titles of the pictures, in their order on the page."""

VIEW_PX = (360, 480)
"""Most rows and columns of a picture; of a larger window, means of blocks are drawn."""

Columns = dict[str, Any]


def _block_side(window: Window) -> int:
    """Return the side of the blocks of sites that become one pixel: 1, or an even number."""
    side = max(-(-(part.stop - part.start) // length) for part, length in zip(window, VIEW_PX, strict=True))
    return side + side % 2 if side > 1 else 1


def view(shown: Shown, window: Window, common: bool) -> Columns:
    """Return the pictures of a window as RGBA words ``[h, w]``, their place, and the values under the pointer.

    With ``common``, raw frames are drawn from black to white (square root) and developed ones as photographs; else each
    picture is stretched by itself.
    """
    side = _block_side(window)
    white = float(np.iinfo(shown.srgb.dtype).max)
    source = shown.srgb[window] if side == 1 else _block_means(shown.srgb[window].astype(np.float32), side)
    frames = {"clean": shown.clean, "noisy": shown.noisy}
    columns: Columns = {"source": _words(source / white)}
    for name, frame in frames.items():
        raw, developed = _window_pictures(frame, shown, window, side)
        light = common_stretch(raw, shown.plan) if common else stretch(raw)[0]
        columns[name] = _words(light)
        columns[f"{name}_developed"] = _words(developed if common else stretch(developed, least=1e-6)[0])
        columns[f"{name}_dn"] = raw if raw.dtype == np.uint16 else raw.astype(np.float32)
    columns["saturated"] = _words(_saturated(shown.saturated[window], columns["clean"].shape, shown, side))
    for channel, name in enumerate("rgb"):
        columns[name] = np.rint(source[..., channel]).astype(np.uint16)
    height, width = columns["clean"].shape
    note = "of this site" if side == 1 else f"means of {side} × {side} sites; zoom in for single sites"
    place = {"x": window[1].start, "y": window[0].start, "dw": width * side, "dh": height * side}
    return columns | place | {"note": note}


def _block_means(values: NDArray[Any], side: int) -> NDArray[Any]:
    """Average square blocks that fit into an image."""
    height, width = (length // side for length in values.shape[:2])
    return np.asarray(
        cv2.resize(values[: height * side, : width * side], (width, height), interpolation=cv2.INTER_AREA)
    )


def _plane_means(frame: NDArray[Any], side: int) -> Float:
    """Average the four planes of a mosaic over blocks, ``[h, w, 4]``."""
    rows, columns = (length // side * side for length in frame.shape)
    planes = [frame[y:rows:2, x:columns:2].astype(np.float32) for y in (0, 1) for x in (0, 1)]
    return np.stack([_block_means(plane, side // 2) for plane in planes], axis=-1)


def _window_pictures(frame: MosaicArray, shown: Shown, window: Window, side: int) -> tuple[MosaicArray, Float]:
    """Return a window of a frame in DN, and developed."""
    if side == 1:
        raw, developed = frame[window], develop_detail(frame, shown.plan, window)
        return raw, np.zeros((*raw.shape, 3)) if developed is None else developed
    planes = _plane_means(frame[window], side)
    rgb = panels.planes_to_rgb(planes, shown.plan.sensor.pattern)
    return planes.mean(axis=-1), process(to_light(rgb, shown.plan), shown.plan)


def _saturated(mask: NDArray[np.bool_], shape: tuple[int, ...], shown: Shown, side: int) -> Float:
    """Return the share of saturated sites in each channel, ``[h, w, 3]``."""
    if side == 1:
        return panels.colour_sites(mask.astype(float), shown.plan.sensor.pattern)
    return panels.planes_to_rgb(_plane_means(mask, side), shown.plan.sensor.pattern)


def _words(values: Float) -> NDArray[np.uint32]:
    codes = panels.byte_codes(values)
    rgba = np.dstack([codes, np.full(codes.shape[:2], 255, np.uint8)])
    return np.ascontiguousarray(rgba).view(np.uint32)[..., 0]


# ------------------------------------------------------------------------------------------------------------- curves

BINS = 128

Curves = dict[str, tuple[Any, Any]]
"""x and y by name."""


def source_histogram(shown: Shown) -> Curves:
    """Return the shares of the codes of each channel of the source."""
    bins = np.linspace(0, np.iinfo(shown.srgb.dtype).max + 1, BINS + 1)
    curves = {}
    for channel, name in enumerate(("red", "green", "blue")):
        counts = np.bincount(shown.srgb[..., channel].ravel(), minlength=int(bins[-1]))
        curves[name] = bins[:-1], counts.reshape(BINS, -1).sum(axis=1) / shown.srgb[..., 0].size
    return curves


def raw_histogram(shown: Shown) -> Curves:
    """Return the shares of DN in both frames, over the DN of the clean frame and all but 0.2 % of the noisy one.

    DN that do not occur are NaN, because the axis is logarithmic.
    """
    top = 2**shown.plan.sensor.bits
    counts = {}
    for name, frame in (("clean", shown.clean), ("noisy", shown.noisy)):
        dn = frame if frame.dtype == np.uint16 else np.clip(np.rint(frame), 0, top - 1).astype(np.uint16)
        counts[name] = np.bincount(dn.ravel(), minlength=top)
    used, below = np.flatnonzero(counts["clean"]), np.cumsum(counts["noisy"]) / shown.noisy.size
    low, high = min(used[0], np.searchsorted(below, 0.001)), max(used[-1], np.searchsorted(below, 0.999))
    starts = np.arange(low, high + 1, 1 + (high - low) // BINS)
    sums = {name: np.add.reduceat(count[: high + 1], starts) for name, count in counts.items()}
    return {name: (starts, np.where(total, total / shown.clean.size, np.nan)) for name, total in sums.items()}


def highlight_curves(shown: Shown) -> Curves:
    """Return the function that inverts the gains of each channel, of grey light (the article's Figure 4)."""
    light, camera = np.linspace(0, 1, 201), shown.plan.camera
    grey = np.repeat(light[:, None], 3, axis=1)
    inverted = unprocess.invert_gains(grey, camera.inverse_gains, camera.highlight, camera.highlight_threshold)
    named = zip(("red", "green", "blue"), camera.inverse_gains, strict=True)
    return {f"{name}, {gain:.3g}": (light, inverted[:, channel]) for channel, (name, gain) in enumerate(named)}


class TransferPlot(NamedTuple):
    """Points of the photon transfer, the expected line, and the fit in words; the text says why there are none."""

    points: tuple[Any, Any]
    line: tuple[Any, Any]
    text: str


POINTS_DRAWN = 1000
FITTED_PX = 512


def photon_transfer(shown: Shown) -> TransferPlot:
    """Fit the variance of the noise against the signal, in the first sites of a large frame."""
    side = FITTED_PX // 2 if shown.plan.output.layout == PACKED else FITTED_PX
    clean, noisy = (frame[..., :side, :side] for frame in (shown.pair.clean, shown.pair.noisy))
    height, width = (min(length, FITTED_PX) for length in shown.clean.shape)
    fit = fit_pair(clean, noisy, {**shown.row, "height": height, "width": width}, shown.dark_pixels)
    if fit is None:
        return TransferPlot(([], []), ([], []), "too few sites or levels for a fit")
    step = max(1, len(fit.signal_dn) // POINTS_DRAWN)
    ends = np.array([0.0, fit.signal_dn.max(initial=1.0)])
    text = str(fit).partition(": ")[2]
    return TransferPlot(
        (fit.signal_dn[::step], fit.variance_dn2[::step]), (ends, fit.expected[0] * ends + fit.expected[1]), text
    )
