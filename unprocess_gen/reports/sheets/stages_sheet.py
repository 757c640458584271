"""Draw a photograph after each step of unprocessing (Figure 1 of the article).

Steps are computed with the reference functions, on the complete image scaled to a panel and on a detail at one pixel
per site. The last two panels are the frames of the dataset.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import Float, Plan, Srgb
from unprocess_gen.dataset.manifest import patch_from_row
from unprocess_gen.reports.sheets import panels
from unprocess_gen.reports.sheets.pairs import SheetPair, sheet_heading
from unprocess_gen.reports.sheets.panels import Picture, SheetPanel, Window
from unprocess_gen.simulation.reference import unprocess
from unprocess_gen.simulation.reference.cfa import mosaic
from unprocess_gen.simulation.reference.isp import to_light


class ProcessingStep(NamedTuple):
    """A step of unprocessing: title, note with its parameters, and its function, ``[H, W, 3]`` to ``[H, W, 3]``."""

    title: str
    note: Callable[[Plan], str]
    apply: Callable[[Float, Plan], Float]


PROCESSING_STEPS = (
    ProcessingStep(
        "tone curve inverted", lambda plan: plan.isp.tone, lambda v, plan: unprocess.TONES[plan.isp.tone](v, 1 - v)
    ),
    ProcessingStep(
        "gamma inverted",
        lambda plan: f"gamma {plan.isp.gamma}",
        lambda v, plan: unprocess.expand_gamma(v, plan.isp.gamma),
    ),
    ProcessingStep(
        "colour matrix inverted",
        lambda plan: f"camera {plan.camera.name}",
        lambda u, plan: unprocess.apply_ccm(u, plan.camera.rgb2cam),
    ),
    ProcessingStep(
        "gains inverted",
        lambda plan: (
            f"times {', '.join(f'{gain:.3g}' for gain in plan.camera.inverse_gains)}; "
            f"highlights {plan.camera.highlight}"
        ),
        lambda i, plan: unprocess.invert_gains(
            i, plan.camera.inverse_gains, plan.camera.highlight, plan.camera.highlight_threshold
        ),
    ),
)
"""The steps of the article's Figure 1 before the mosaic."""


def stages_sheet(pair: SheetPair, source: Srgb) -> Picture:
    """Return a sheet of the source after each step, uint8 ``[H, W, 3]`` RGB; black is 0 and white is 1."""
    plan, window = pair.plan, panels.detail_window(pair.clean.shape)
    white = float(np.iinfo(source.dtype).max)
    overview, detail = panels.fit_image(source, panels.PANEL_PX) / white, source[window] / white
    drawn = [_image_panel("source", "", overview, detail)]
    if plan.source.dequantize != "off" and source.dtype == np.uint8:
        detail = _dithered(pair, source, window)
        drawn.append(_image_panel("codes dithered", "by up to half a code", overview, detail))
    for step in PROCESSING_STEPS:
        overview, detail = step.apply(overview, plan), step.apply(detail, plan)
        drawn.append(_image_panel(step.title, step.note(plan), overview, detail))
    drawn.append(_mosaic_panel("mosaic", plan, overview, mosaic(detail, plan.sensor.pattern)))
    for name, raw in (("clean", pair.clean), ("noisy", pair.noisy)):
        averaged = panels.planes_to_rgb(panels.average_planes(raw, panels.PANEL_PX), plan.sensor.pattern)
        drawn.append(_mosaic_panel(f"{name} raw", plan, to_light(averaged, plan), to_light(raw[window], plan)))
    note = "after each step, black 0, white 1, not stretched; mosaics: square root, each site in its filter's colour"
    if plan.scene.exposure_ratio != 1:
        note += f"; raw frames brightened {plan.scene.exposure_ratio:.4g} times, as the scene is darker"
    return panels.lay_out([*sheet_heading(pair, window), note], drawn)


def _dithered(pair: SheetPair, source: Srgb, window: Window) -> Float:
    """Return the detail with its codes dithered as the frames were, values in [0, 1]."""
    plan, patch = pair.plan, patch_from_row(pair.row)
    origin = patch.y + window[0].start, patch.x + window[1].start
    curve = linear_table(plan.isp.tone, plan.isp.gamma, 256)
    return unprocess.dequantise(source[window], plan, curve, origin) / 65535


def _image_panel(title: str, note: str, overview: Float, detail: Float) -> SheetPanel:
    return SheetPanel(title, note + _clipped_note(overview), overview, detail)


def _mosaic_panel(title: str, plan: Plan, overview: Float, detail: Float) -> SheetPanel:
    """Return the panel of a mosaic, of which the overview has the mean of each colour ``[h, w, 3]``."""
    shares = 0.25, 0.5, 0.25  # of the sites of a tile
    pattern, note = plan.sensor.pattern, plan.sensor.pattern + _clipped_note(overview)
    shown, sites = (np.sqrt(np.clip(light, 0, 1)) for light in (overview, detail))
    return SheetPanel(title, note, shown * shares, panels.colour_sites(sites, pattern))


def _clipped_note(values: Float) -> str:
    fraction = float(((values < 0) | (values > 1)).mean())
    return f"; {fraction:.2%} outside [0, 1], shown clipped" if fraction else ""
