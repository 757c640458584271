"""Restore frames by simple methods, which ``gen-dataset score --method`` has by name; examples for others.

A method is a function of a noisy mosaic in DN, [H, W], and its manifest row. For a clip it gets [T, H, W] and the list
of rows. It returns an array of the same shape in DN.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

import unprocess_gen as ug
from unprocess_gen.simulation.reference.cfa import unpack


def by_frame(restore: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Make a method that restores each frame of a clip by itself."""

    @functools.wraps(restore)
    def method(noisy: Any, row: Any) -> Any:
        if isinstance(row, list):
            return np.stack([*map(restore, noisy, row)])
        if row["pattern"] == "sRGB":
            raise ValueError("takes no sRGB pictures; use noisy, or a function of your own: FILE.py:function")
        return restore(noisy, row)

    return method


def noisy(noisy: Any, row: Any) -> Any:
    """Return the input, to score the noise itself."""
    return noisy


@by_frame
def gaussian(noisy: Any, row: Any) -> Any:
    """Filter each of the four planes with a Gaussian of 1 site, cut off at 3; borders are mirrored."""
    planes = ug.pack(noisy.astype(np.float64), row["pattern"])
    return unpack(np.stack([cv2.GaussianBlur(plane, (7, 7), 1) for plane in planes]), row["pattern"])


@by_frame
def non_local_means(noisy: Any, row: Any) -> Any:
    """Denoise the four planes by non-local means, after the generalised Anscombe transformation.

    The transformation takes gain and variance without light from the row, so that all noise has a standard deviation
    near 1. The inverse is the closed form of Mäkitalo and Foi (IEEE Transactions on Image Processing 22, 2013). The
    result is rounded, and clipped to 0 and white. Nothing is tuned.
    """
    from skimage.restoration import denoise_nl_means  # extra "photos"

    if "dark_variance_dn2" not in row:
        raise ValueError("needs noise parameters, which rows of real pairs lack; use gaussian, or FILE.py:function")
    dark, black, white = (float(row[name] or 0) for name in ("dark_variance_dn2", "black_level_dn", "white_level_dn"))
    dark = max(dark, 0.0)
    gain = max(float(row["a_dn"] or 0), 1e-6 * math.sqrt(dark))  # nearly linear without shot noise
    if not gain:
        return noisy
    variance = dark / gain**2
    light = (ug.pack(noisy.astype(np.float64), row["pattern"]) - black) / gain
    stable = 2 * np.sqrt(np.maximum(light + 3 / 8 + variance, 0))
    settings = {"patch_size": 5, "patch_distance": 6, "h": 0.8, "sigma": 1.0, "fast_mode": True}
    smooth = denoise_nl_means(stable, channel_axis=0, preserve_range=True, **settings)
    smooth = np.maximum(smooth, 2 * math.sqrt(3 / 8 + variance))
    root = math.sqrt(3 / 2)
    unbiased = smooth**2 / 4 + root / 4 / smooth - 11 / 8 / smooth**2 + 5 / 8 * root / smooth**3 - 1 / 8 - variance
    return unpack(np.clip(np.rint(np.maximum(unbiased, 0) * gain + black), 0, white), row["pattern"])
