"""Show pairs in a notebook: HTML with pictures and tables, in the colours of the page around it."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image

from unprocess_gen.core.arrays import Float, Frame
from unprocess_gen.dataset.columns import Row, Value
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.simulation.reference import cfa, isp

SIDE_PX = 256
"""Longest side of a picture of a pair."""

NOISE = "camera", "noise", "iso", "scene", "exposure_ratio", "a_dn", "dark_variance_dn2", "effects"
"""Columns that are shown of each pair, after its key and source."""


def pair_html(clean: Frame | Float, noisy: Frame | Float, row: Row) -> str:
    """Show two mosaics in DN, their sites white-balanced, the noisy one also developed, and columns of the row."""
    plan = plan_from_row(row)
    frames = {"clean": _thumbnail(clean), "noisy": _thumbnail(noisy)}
    gains = cfa.mosaic(np.broadcast_to(plan.camera.inverse_gains, (*frames["noisy"].shape, 3)), plan.sensor.pattern)
    light = {name: isp.to_light(raw, plan) / gains for name, raw in frames.items()}
    pictures = {name: np.sqrt(np.clip(sites, 0, 1)) for name, sites in light.items()}
    pictures["developed"] = isp.develop(frames["noisy"], plan)
    figures = "".join(_figure(name, values) for name, values in pictures.items())
    table = _table({name: row.get(name) for name in ("key", "source", *NOISE)})
    return f'<div style="display:flex;flex-wrap:wrap;gap:12px;align-items:flex-start">{figures}{table}</div>'


def _thumbnail(raw: Frame | Float) -> Any:
    """Every n-th tile of a mosaic, which keeps the colour and the noise of sites; an odd last line is completed."""
    even = np.pad(raw, [(0, length % 2) for length in raw.shape], mode="reflect")
    step = -(-max(even.shape) // SIDE_PX)
    rows, columns = (np.flatnonzero(np.arange(length) // 2 % step == 0) for length in even.shape)
    return even[rows][:, columns]


def _figure(name: str, values: Float) -> str:
    """Picture of values in [0, 1] as PNG; small ones are enlarged by an integer factor."""
    content, codes = io.BytesIO(), isp.to_codes(values).astype(np.uint8)
    Image.fromarray(codes).save(content, "PNG")
    style = (
        f"width:{codes.shape[1] * max(1, SIDE_PX // max(codes.shape[:2]))}px;max-width:none;image-rendering:pixelated"
    )
    source = f"data:image/png;base64,{base64.b64encode(content.getvalue()).decode()}"
    return f'<figure style="margin:0"><img style="{style}" src="{source}"><figcaption>{name}</figcaption></figure>'


def _table(cells: Mapping[str, Value]) -> str:
    style = 'style="text-align:left"'
    texts = {name: html.escape(_text(value)) for name, value in cells.items()}
    lines = (f"<tr><th {style}>{name}</th><td {style}>{text}</td></tr>" for name, text in texts.items() if text)
    return f"<table>{''.join(lines)}</table>"


def _text(value: Value) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
