"""Compute what the page draws of a pair: pictures of a window of its frames, and curves."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import PACKED, Float
from unprocess_gen.reports.explorer.exploration import Shown
from unprocess_gen.reports.photon_transfer import fit_pair
from unprocess_gen.reports.sheets import panels
from unprocess_gen.reports.sheets.contact_sheet import common_stretch, develop_detail, stretch
from unprocess_gen.reports.sheets.panels import Window
from unprocess_gen.simulation.reference import unprocess
from unprocess_gen.simulation.reference.isp import process, to_light
from unprocess_gen.statistics.mosaics import planes_of

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


def view(shown: Shown, window: Window, common: bool) -> dict[str, Any]:
    """Return the pictures of a window as RGBA words ``[h, w]``, their place, and the values under the pointer.

    With ``common``, raw frames are drawn from black to white (square root) and developed ones as photographs; else each
    picture is stretched by itself.
    """
    side = max(-(-(part.stop - part.start) // length) for part, length in zip(window, VIEW_PX, strict=True))
    side += side % 2 if side > 1 else 0
    pattern, srgb = shown.plan.sensor.pattern, shown.srgb[window]
    source = srgb if side == 1 else _block_means(srgb.astype(np.float32), side)
    columns: dict[str, Any] = {"source": _words(source / np.iinfo(srgb.dtype).max)}
    for name, frame in {"clean": shown.clean, "noisy": shown.noisy}.items():
        raw: Any = frame[window]
        if side == 1:
            developed = develop_detail(frame, shown.plan, window)
            developed = np.zeros((*raw.shape, 3)) if developed is None else developed
        else:
            planes = _plane_means(raw, side)
            raw = planes.mean(axis=-1)
            developed = process(to_light(panels.planes_to_rgb(planes, pattern), shown.plan), shown.plan)
        columns[name] = _words(common_stretch(raw, shown.plan) if common else stretch(raw)[0])
        columns[f"{name}_developed"] = _words(developed if common else stretch(developed, least=1e-6)[0])
        columns[f"{name}_dn"] = raw if raw.dtype == np.uint16 else raw.astype(np.float32)
    sites = shown.saturated[window].astype(np.float64)
    means = None if side == 1 else panels.planes_to_rgb(_plane_means(sites, side), pattern)
    columns["saturated"] = _words(panels.colour_sites(sites, pattern) if means is None else means)
    columns |= {name: np.rint(source[..., channel]).astype(np.uint16) for channel, name in enumerate("rgb")}
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
    """Average the four planes of a mosaic over blocks of an even side, ``[h, w, 4]``."""
    rows, columns = (length // side * side for length in frame.shape)
    planes = [plane.astype(np.float32) for plane in planes_of(frame[:rows, :columns])]
    return np.stack([_block_means(plane, side // 2) for plane in planes], axis=-1)


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
    limits, curves = (0.0, np.iinfo(shown.srgb.dtype).max + 1.0), {}
    for channel, name in enumerate(("red", "green", "blue")):
        counts, edges = np.histogram(shown.srgb[..., channel], BINS, limits)
        curves[name] = edges[:-1], counts / counts.sum()
    return curves


def raw_histogram(shown: Shown) -> Curves:
    """Return the shares of DN in both frames, over the DN of the clean frame and all but 0.2 % of the noisy one.

    DN that do not occur are NaN, because the axis is logarithmic.
    """
    low, high = np.percentile(shown.noisy, (0.1, 99.9)).round()
    low, high = min(low, float(shown.clean.min())), max(high, float(shown.clean.max()))
    edges = np.arange(low, high + 2, 1 + (high - low) // BINS) - 0.5
    curves = {}
    for name, frame in (("clean", shown.clean), ("noisy", shown.noisy)):
        counts = np.histogram(frame, edges)[0]
        curves[name] = edges[:-1] + 0.5, np.where(counts, counts / frame.size, np.nan)
    return curves


def highlight_curves(shown: Shown) -> Curves:
    """Return the function that inverts the gains of each channel, of grey light (the article's Figure 4)."""
    light, camera, isp = np.linspace(0, 1, 201), shown.plan.camera, shown.plan.isp
    grey = np.repeat(light[:, None], 3, axis=1)
    inverted = unprocess.invert_gains(grey, camera.inverse_gains, isp.highlight, isp.highlight_threshold)
    named = zip(("red", "green", "blue"), camera.inverse_gains, strict=True)
    return {f"{name}, {gain:.3g}": (light, inverted[:, channel]) for channel, (name, gain) in enumerate(named)}


POINTS_DRAWN = 1000
FITTED_PX = 512


def photon_transfer(shown: Shown) -> tuple[tuple[Any, Any], tuple[Any, Any], str]:
    """Fit the variance of the noise against the signal, in the first sites of a large frame.

    Return points, the expected line, and the fit in words, or why there are none.
    """
    side = FITTED_PX // 2 if shown.plan.output.layout == PACKED else FITTED_PX
    clean, noisy = (frame[..., :side, :side] for frame in (shown.pair.clean, shown.pair.noisy))
    height, width = (min(length, FITTED_PX) for length in shown.clean.shape)
    fit = fit_pair(clean, noisy, {**shown.row, "height": height, "width": width}, shown.dark_pixels)
    if fit is None:
        return ([], []), ([], []), "too few sites or levels for a fit"
    step, ends = max(1, len(fit.signal_dn) // POINTS_DRAWN), np.array([0.0, fit.signal_dn.max(initial=1.0)])
    points, line = (fit.signal_dn[::step], fit.variance_dn2[::step]), (ends, fit.expected[0] * ends + fit.expected[1])
    return points, line, str(fit).partition(": ")[2]
