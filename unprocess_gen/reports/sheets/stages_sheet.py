"""Draw one picture of a photograph after each step of unprocessing (Figure 1 of the article).

Steps are computed with the reference functions, on an averaged copy of the complete image and on a detail at one pixel
per site. The last two panels are the frames of the dataset.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import Float, Plan, Srgb
from unprocess_gen.dataset.manifest import patch_from_row
from unprocess_gen.reports.sheets.pairs import SheetPair, sheet_heading
from unprocess_gen.reports.sheets.panels import (
    PANEL_PX,
    DetailWindow,
    Picture,
    SheetPanel,
    average_mosaic,
    colour_sites,
    detail_window,
    fit_image,
    lay_out,
    to_codes,
)
from unprocess_gen.simulation.reference import unprocess
from unprocess_gen.simulation.reference.cfa import mosaic
from unprocess_gen.simulation.reference.isp import to_light


class ProcessingStep(NamedTuple):
    """A step of unprocessing: title, note with its parameters, and its function, ``[H, W, 3]`` to ``[H, W, 3]``."""

    title: str
    note: Callable[[Plan], str]
    apply: Callable[[Float, Plan], Float]


PROCESSING_STEPS = (
    ProcessingStep("tone curve inverted", lambda plan: plan.tone, lambda v, plan: unprocess.TONES[plan.tone](v, 1 - v)),
    ProcessingStep(
        "gamma inverted", lambda plan: f"gamma {plan.gamma}", lambda v, plan: unprocess.expand_gamma(v, plan.gamma)
    ),
    ProcessingStep(
        "colour matrix inverted",
        lambda plan: f"camera {plan.camera}",
        lambda u, plan: unprocess.apply_ccm(u, plan.rgb2cam),
    ),
    ProcessingStep(
        "gains inverted",
        lambda plan: f"times {', '.join(f'{gain:.3g}' for gain in plan.inverse_gains)}; highlights {plan.highlight}",
        lambda i, plan: unprocess.invert_gains(i, plan.inverse_gains, plan.highlight, plan.highlight_threshold),
    ),
)
"""The steps of the article's Figure 1 before the mosaic."""


def stages_sheet(pair: SheetPair) -> Picture:
    """Return a sheet of the source after each step, uint8 ``[H, W, 3]`` RGB; black is 0 and white is 1.

    Mosaics show each site in the colour of its filter. ValueError if the source is not available.
    """
    if pair.source is None:
        raise ValueError(f"{pair.key}: the source is not available ({pair.missing_source})")
    plan, window = pair.plan, detail_window(pair.clean.shape)
    overview = _averaged(pair.source, window.side)
    detail = pair.source[window.rows, window.columns] / float(np.iinfo(pair.source.dtype).max)
    panels = [_image_panel("source", "", overview, detail)]
    if plan.dequantize != "off" and pair.source.dtype == np.uint8:
        detail = _dithered(pair, pair.source, window)
        panels.append(_image_panel("codes dithered", "by up to half a code", overview, detail))
    for step in PROCESSING_STEPS:
        overview, detail = step.apply(overview, plan), step.apply(detail, plan)
        panels.append(_image_panel(step.title, step.note(plan), overview, detail))
    panels.append(_mosaic_panel("mosaic", plan, mosaic(overview, plan.pattern), mosaic(detail, plan.pattern)))
    for name, raw in (("clean", pair.clean), ("noisy", pair.noisy)):
        lights = (to_light(dn, plan) for dn in (average_mosaic(raw, window.side), raw[window.rows, window.columns]))
        panels.append(_mosaic_panel(f"{name} raw", plan, *lights))
    note = "after each step, black 0, white 1, not stretched; mosaics: square root"
    if plan.exposure_ratio != 1:
        note += f"; raw frames brightened {plan.exposure_ratio:g} times, the exposure ratio of the scene"
    return lay_out([*sheet_heading(pair, window)[:2], note], panels)


def _averaged(srgb: Srgb, side: int) -> Float:
    """Average squares of pixels: codes ``[H, W, 3]`` to values in [0, 1]."""
    height, width = srgb.shape[:2]
    size = max(1, width // side), max(1, height // side)
    codes = np.asarray(cv2.resize(srgb, size, interpolation=cv2.INTER_AREA), dtype=np.float64)
    return codes / float(np.iinfo(srgb.dtype).max)


def _dithered(pair: SheetPair, source: Srgb, window: DetailWindow) -> Float:
    """Return the detail with its codes dithered as the frames were, values in [0, 1]."""
    plan, patch = pair.plan, patch_from_row(pair.row)
    origin = patch.y + window.rows.start, patch.x + window.columns.start
    curve = linear_table(plan.tone, plan.gamma, 256)
    return unprocess.dequantise(source[window.rows, window.columns], plan, curve, origin) / 65535


def _image_panel(title: str, note: str, overview: Float, detail: Float) -> SheetPanel:
    return SheetPanel(title, note + _clipped_note(overview), to_codes(fit_image(overview, PANEL_PX)), to_codes(detail))


def _mosaic_panel(title: str, plan: Plan, overview: Float, detail: Float) -> SheetPanel:
    pictures = [colour_sites(np.sqrt(np.clip(light, 0, 1)), plan.pattern) for light in (overview, detail)]
    codes = to_codes(fit_image(pictures[0], PANEL_PX)), to_codes(pictures[1])
    return SheetPanel(title, plan.pattern + _clipped_note(overview), *codes)


def _clipped_note(values: Float) -> str:
    fraction = float(((values < 0) | (values > 1)).mean())
    return f"; {fraction:.2%} outside [0, 1], shown clipped" if fraction else ""
