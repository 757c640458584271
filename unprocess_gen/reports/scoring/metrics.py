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
from unprocess_gen.simulation.reference import isp

Scores = dict[str, float | None]
"""Scores by name, such as ``raw_psnr``, dB."""
WINDOW, WINDOW_STD = 11, 1.5
"""Side and standard deviation of the Gaussian window of SSIM (Wang et al., 2004)."""
C1, C2 = 0.01**2, 0.03**2
"""Constants of SSIM for a peak of 1."""
BORDER = 40
"""Pixels of a target that are left out at each side, because most frames of a burst do not show them."""


def psnr(squares: Float, peak: float) -> float | None:
    """Peak signal-to-noise ratio of squared errors in dB."""
    mse = float(np.mean(squares)) if squares.size else 0.0
    return 10 * math.log10(peak**2 / mse) if mse else None


def ssim(x: Float, y: Float) -> float:
    """Structural similarity of two planes whose peak is 1: the mean over the windows inside the plane."""
    inside, side = slice(WINDOW // 2, -(WINDOW // 2)), (WINDOW, WINDOW)
    moments = (cv2.GaussianBlur(values, side, WINDOW_STD)[inside, inside] for values in (x, y, x * x, y * y, x * y))
    x_mean, y_mean, xx, yy, xy = moments
    means, squares = x_mean * y_mean, x_mean * x_mean + y_mean * y_mean
    similarity = (2 * means + C1) * (2 * (xy - means) + C2) / ((squares + C1) * (xx + yy - squares + C2))
    return float(np.mean(similarity))


def scores_of(domain: str, clean: Float, output: Float, peak: float, unsaturated: Any = None) -> Scores:
    """PSNR and SSIM of planes or pictures [H, W, C]; with a mask, also the PSNR of the sites below white."""
    squares, channels = np.square(output - clean), range(clean.shape[2])
    similar = [ssim(clean[..., c] / peak, output[..., c] / peak) for c in channels if min(clean.shape[:2]) >= WINDOW]
    scores = {f"{domain}_psnr": psnr(squares, peak), f"{domain}_ssim": float(np.mean(similar)) if similar else None}
    return scores if unsaturated is None else scores | {f"{domain}_psnr_unsaturated": psnr(squares[unsaturated], peak)}


def raw_scores(clean: Any, output: Any, row: Row) -> Scores:
    """Scores of a mosaic in DN, not rounded; the peak is white - black."""
    packed = (pack(mosaic, str(row["pattern"])) for mosaic in (clean, output))
    planes, restored = (np.moveaxis(planes.astype(np.float64), 0, -1) for planes in packed)
    white = int(row["white_level_dn"] or 0)
    return scores_of("raw", planes, restored, white - int(row["black_level_dn"] or 0), planes < white)


def frame_scores(clean: Any, output: Float, row: Row) -> Scores:
    """Scores of a mosaic: raw, and developed by ``ug.develop`` after rounding to what the sensor stores."""
    plan = plan_from_row(row)
    stored = (np.clip(np.rint(np.float64(frame)), 0, 2**plan.sensor.bits - 1) for frame in (clean, output))
    shown, restored = (isp.to_codes(isp.develop(frame, plan)) for frame in stored)
    developed = scores_of("srgb", shown, restored, 255, clean < plan.sensor.white_level_dn)
    return raw_scores(clean, output, row) | developed


def target_scores(target: Any, output: Float) -> Scores:
    """Scores of a scene-linear picture [H, W, 3] without its border; the peak is 1."""
    inside = slice(BORDER, -BORDER)
    return scores_of("linear", target[inside, inside].astype(np.float64), output[inside, inside], 1)
