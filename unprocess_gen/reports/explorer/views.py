"""Compute what the page draws of a pair: pictures of a window of its frames, and curves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import PACKED, Float, last_code
from unprocess_gen.reports import panels
from unprocess_gen.reports.explorer.exploration import Shown
from unprocess_gen.reports.noise_check.repetition import measure_noise
from unprocess_gen.reports.photon_transfer import NoiseFit, fit_noise
from unprocess_gen.simulation.reference import unprocess

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
"""Most rows and columns of a picture; of a larger window, means of sites are drawn."""
SMALLEST_PX = 8
"""Fewest sites of a side of the window."""
DETAIL_PX = 160
"""Columns of the window that shows the finest detail: a site is about two pixels of the screen."""
WINDOWS = "Detail", "Everything"
"""Buttons that show a part of the pictures."""


def window_of(label: str, shown: Shown) -> Float:
    """First and last row and column, [2, 2], of the finest detail, or of the frame."""
    shape = np.array(shown.clean.shape, float)
    site = np.array(panels.finest_detail(shown.srgb, (DETAIL_PX, DETAIL_PX)))
    share = max(DETAIL_PX / shape[1], SMALLEST_PX / shape.min()) if label == "Detail" else 1
    size = shape * min(share, 1)
    start = np.clip(site - size / 2, 0, shape - size)
    return np.stack([start, start + size], axis=1)


def view(shown: Shown, window: panels.Window, common: bool) -> dict[str, Any]:
    """The pictures of a window as RGBA words ``[h, w]``, their place, and the values under the pointer.

    ``common``: raw frames from black to white (square root), developed ones as photographs; else each stretched by
    itself.
    """
    plan, pattern = shown.plan, shown.plan.sensor.pattern
    is_single = all(part.stop - part.start <= length for part, length in zip(window, VIEW_PX, strict=True))
    columns: dict[str, Any] = {}
    for name, frame in {"clean": shown.clean, "noisy": shown.noisy}.items():
        raw: Any = frame[window]
        if is_single:
            developed = panels.develop_detail(frame, plan, window)
            developed = np.zeros((*raw.shape, 3)) if developed is None else developed
        else:
            planes = panels.average_planes(raw, VIEW_PX)
            raw, developed = planes.mean(axis=-1), panels.develop_planes(planes, plan)
        columns[name] = _words(panels.common_stretch(raw, plan) if common else panels.stretch(raw))
        columns[f"{name}_developed"] = _words(developed if common else panels.stretch(developed, least=1e-6))
        columns[f"{name}_dn"] = raw if raw.dtype == np.uint16 else raw.astype(np.float32)
    height, width = columns["clean"].shape
    srgb, sites = shown.srgb[window], shown.saturated[window].astype(np.float64)
    source = srgb if is_single else cv2.resize(srgb, (width, height), interpolation=cv2.INTER_AREA)
    columns["source"] = _words(source / last_code(srgb))
    columns |= {name: source[..., channel].astype(np.uint16) for channel, name in enumerate("rgb")}
    coloured = (
        panels.colour_sites(sites, pattern)
        if is_single
        else panels.planes_to_rgb(panels.average_planes(sites, VIEW_PX), pattern)
    )
    dw, dh = (part.stop - part.start for part in (window[1], window[0]))
    means = f"means of {dh / height:.2g} × {dw / width:.2g} sites; zoom in for single sites"
    place = {"x": window[1].start, "y": window[0].start, "dw": dw, "dh": dh}
    return columns | place | {"saturated": _words(coloured), "note": "of this site" if is_single else means}


def _words(values: Float) -> NDArray[np.uint32]:
    codes = panels.byte_codes(values)
    rgba = np.dstack([codes, np.full(codes.shape[:2], 255, np.uint8)])
    return np.ascontiguousarray(rgba).view(np.uint32)[..., 0]


# ------------------------------------------------------------------------------------------------------------- curves

PLOTS = {
    "source_histogram": ("Histogram of the source", "code", "share of the pixels"),
    "raw_histogram": ("Histogram of the raw frames", "DN", "share of the sites"),
    "highlight": ("Highlight function (Figure 4)", "intensity i of grey light", "f(i)"),
    "transfer": ("Photon transfer", "signal above black, DN", "variance of the noise, DN²"),
}
"""Titles and axes."""
COLOURS = {"red": "#d1495b", "green": "#2e8b57", "blue": "#2f6db5", "clean": "#0072b2", "noisy": "#d55e00"}
BINS = 128
FITTED_PX = 512


class Curve(NamedTuple):
    """A line of a plot."""

    label: str
    colour: str
    xs: Any
    ys: Any


def curves(shown: Shown, fit: NoiseFit | None) -> dict[str, list[Curve]]:
    """The curves of `PLOTS`; the photon transfer has the expected variance."""
    camera, isp, light = shown.plan.camera, shown.plan.isp, np.linspace(0, 1, 201)
    grey = np.repeat(light[:, None], 3, axis=1)
    inverted = unprocess.invert_gains(grey, camera.inverse_gains, isp.highlight, isp.highlight_threshold)
    highlight = [
        Curve(f"{name}, {gain:.3g}", COLOURS[name], light, inverted[:, channel])
        for channel, (name, gain) in enumerate(zip(("red", "green", "blue"), camera.inverse_gains, strict=True))
    ]
    return {
        "source_histogram": list(_source_histogram(shown)),
        "raw_histogram": list(_raw_histogram(shown)),
        "highlight": highlight,
        "transfer": [] if fit is None else [Curve("expected", COLOURS["noisy"], *fit.line)],
    }


def _source_histogram(shown: Shown) -> Iterator[Curve]:
    for channel, name in enumerate(("red", "green", "blue")):
        counts, edges = np.histogram(shown.srgb[..., channel], BINS, (0.0, last_code(shown.srgb) + 1.0))
        yield Curve(name, COLOURS[name], edges[:-1], counts / counts.sum())


def _raw_histogram(shown: Shown) -> Iterator[Curve]:
    """Yield shares of DN, NaN for 0, over those of the clean frame and all but 0.2 % of the noisy one."""
    low, high = np.percentile(shown.noisy, (0.1, 99.9)).round()
    low, high = min(low, float(shown.clean.min())), max(high, float(shown.clean.max()))
    edges = np.arange(low, high + 2, 1 + (high - low) // BINS) - 0.5
    for name, frame in (("clean", shown.clean), ("noisy", shown.noisy)):
        counts = np.histogram(frame, edges)[0]
        yield Curve(name, COLOURS[name], edges[:-1] + 0.5, np.where(counts, counts / frame.size, np.nan))


def noise_fit(shown: Shown) -> NoiseFit | None:
    """Fit the variance of the noise against the signal, in the first sites of a large frame."""
    side = FITTED_PX // 2 if shown.plan.output.layout == PACKED else FITTED_PX
    clean, noisy = (frame[..., :side, :side] for frame in (shown.pair.clean, shown.pair.noisy))
    height, width = (min(length, FITTED_PX) for length in shown.clean.shape)
    return fit_noise(measure_noise(clean, noisy, {**shown.row, "height": height, "width": width}, shown.dark_pixels))
