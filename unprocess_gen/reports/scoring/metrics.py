"""Compare frames with clean ones by PSNR and SSIM: raw frames in DN, developed frames, and scene-linear pictures.

Definitions for users: ``docs/guides/score.md``. Why scores are rounded (`scoring.DIGITS`): ``docs/design/reports.md``.
A score is None if it is not defined: the PSNR of equal values or of none, and the SSIM of planes that are smaller than
its window.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.dataset.training import pack
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import isp

Scores = dict[str, float | None]
"""Scores by name, such as ``raw_psnr``, dB."""
WINDOW, WINDOW_STD = 11, 1.5
"""Side and standard deviation of the Gaussian window of SSIM (Wang et al., 2004)."""
C1, C2 = 0.01**2, 0.03**2
"""Constants of SSIM for a peak of 1."""
BORDER = 40
"""Pixels of a target that are left out at each side, because most frames of a burst do not show them."""
BAND, OVERLAP = 64, 4
"""Rows that are computed at once, a third of the time of complete pictures, and those around that develop sees."""


def ssim(x: Any, y: Any, peak: float) -> float:
    """Structural similarity of two planes: the mean over the windows inside the plane."""
    inside, side, total = slice(WINDOW // 2, -(WINDOW // 2)), (WINDOW, WINDOW), 0.0
    for top in range(0, len(x) - WINDOW + 1, BAND):
        a, b = (plane[top : top + BAND + WINDOW - 1].astype(np.float64, "C") / peak for plane in (x, y))
        moments = (cv2.GaussianBlur(band, side, WINDOW_STD)[inside, inside] for band in (a, b, a * a, b * b, a * b))
        a_mean, b_mean, aa, bb, ab = moments
        means, squares = a_mean * b_mean, a_mean * a_mean + b_mean * b_mean
        total += np.sum((2 * means + C1) * (2 * (ab - means) + C2) / ((squares + C1) * (aa + bb - squares + C2)))
    return float(total / (x.shape[0] - WINDOW + 1) / (x.shape[1] - WINDOW + 1))


def scores_of(domain: str, clean: Any, output: Any, peak: float, unsaturated: Any = None) -> Scores:
    """PSNR and SSIM of planes or pictures [H, W, C]; with a mask, also the PSNR of the sites below white."""
    sums = np.zeros((2, 2))
    for rows in (slice(top, top + BAND) for top in range(0, len(clean), BAND)):
        squares = np.square(output[rows] - clean[rows].astype(np.float64))
        kept = squares if unsaturated is None else squares[unsaturated[rows]]
        sums += [[squares.sum(), squares.size], [kept.sum(), kept.size]]
    psnr, psnr_unsaturated = (10 * math.log10(peak**2 * size / total) if total else None for total, size in sums)
    has_window, channels = min(clean.shape[:2]) >= WINDOW, range(clean.shape[2])
    similar = float(np.mean([ssim(clean[..., c], output[..., c], peak) for c in channels])) if has_window else None
    scores = {f"{domain}_psnr": psnr, f"{domain}_ssim": similar}
    return scores if unsaturated is None else scores | {f"{domain}_psnr_unsaturated": psnr_unsaturated}


def raw_scores(clean: Any, output: Any, row: Row) -> Scores:
    """Scores of a mosaic in DN, not rounded; the peak is white - black."""
    planes, restored = (np.moveaxis(pack(mosaic, str(row["pattern"])), 0, -1) for mosaic in (clean, output))
    white = int(row["white_level_dn"] or 0)
    return scores_of("raw", planes, restored, white - int(row["black_level_dn"] or 0), planes < white)


def frame_scores(clean: Any, output: Any, row: Row) -> Scores:
    """Scores of a mosaic: raw, and developed by ``ug.develop`` after rounding to what the sensor stores."""
    plan = plan_from_row(row)
    shown, restored = _developed(clean, plan), _developed(output, plan)
    developed = scores_of("srgb", shown, restored, 255, clean < plan.sensor.white_level_dn)
    return raw_scores(clean, output, row) | developed


def _developed(frame: Any, plan: Plan) -> Any:
    """Develop a frame that is not rounded, in float64, to 8-bit sRGB."""
    codes = np.empty((*frame.shape, 3), np.uint8)
    for top in range(0, len(frame), BAND):
        first = max(top - OVERLAP, 0)
        band = np.rint(frame[first : top + BAND + OVERLAP].astype(np.float64))
        picture = isp.develop(np.clip(band, 0, 2**plan.sensor.bits - 1), plan)
        codes[top : top + BAND] = isp.to_codes(picture)[top - first :][:BAND]
    return codes


def target_scores(target: Any, output: Float) -> Scores:
    """Scores of a scene-linear picture [H, W, 3] without its border; the peak is 1."""
    inside = slice(BORDER, -BORDER)
    return scores_of("linear", target[inside, inside], output[inside, inside], 1)
