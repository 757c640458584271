"""The mirror of `unprocess`: from the sensor's light back to a display-referred photograph, for eyes and for proofs.

NumPy, float64, one short function a step, in the camera's order: gains, matrix, gamma, tone. No byte of a dataset
depends on this room, so it may call libm and LAPACK. It is the inverse of the settings in a manifest row: where nothing
was clipped, every 8-bit colour returns to its own code (the test walks all 2**24, for four cameras and the gains'
extremes).

Tried for the highlights: Cardano's formula for the cubic, which loses half its digits where the mask begins; Newton's
method from above keeps them and needs 4 to 9 rounds at the gains of the article.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from unprocess_gen.colour import invert
from unprocess_gen.records import Float, Plan

ROUNDS = 200
"""More than any search below needs: a bisection halves an interval of doubles at most 64 times until it is two
neighbours, Newton's method halves at its slowest, at gains near 0."""


def process(camera_light: Float, plan: Plan) -> Float:
    """Return display-referred values in [0, 1], ``[H, W, 3]`` float64, of camera RGB with 0 at black and 1 at white.

    The inverse of `unprocess.camera_light`: colours that left [0, 1] on the way are clipped before the gamma, as
    cameras do.
    """
    image = apply_gains(camera_light, plan.inverse_gains, plan.highlight, plan.highlight_threshold)
    image = image @ np.array(invert(plan.rgb2cam)).reshape(3, 3).T
    image = compress_gamma(np.clip(image, 0, 1), plan.gamma)
    return TONES[plan.tone](image)


def to_codes(srgb: Float, codes: int = 256) -> Float:
    """Return the nearest of ``codes`` evenly spaced codes, still float64; ``srgb`` in [0, 1], any shape."""
    return np.rint(srgb * (codes - 1))


def smoothstep(y: Float) -> Float:
    """Apply the tone curve 3y² - 2y³ (Brooks et al. 2019); y in [0, 1], any shape."""
    return np.asarray(y * y * (3 - 2 * y))


def no_tone(y: Float) -> Float:
    """Leave the image as it is: no tone curve."""
    return y


TONES: dict[str, Callable[[Float], Float]] = {"smoothstep": smoothstep, "none": no_tone}


def compress_gamma(u: Float, gamma: float | str) -> Float:
    """Return v = u**(1 / gamma), or sRGB's piecewise curve (IEC 61966-2-1) for ``"srgb"``; u in [0, 1]."""
    if gamma == "srgb":
        return np.where(u <= 0.04045 / 12.92, u * 12.92, 1.055 * u ** (1 / 2.4) - 0.055)
    return np.asarray(u ** (1 / float(gamma)))


def apply_gains(y: Float, inverse_gains: tuple[float, float, float], highlight: str, threshold: float) -> Float:
    """Apply white balance and brightening, ``[H, W, 3]`` to ``[H, W, 3]``: the inverse of `unprocess.invert_gains`.

    Exact up to rounding for unclipped values, whichever way the highlights were kept.
    """
    return HIGHLIGHTS[highlight](y, np.array(inverse_gains), threshold)


def apply_gains_per_channel(y: Float, k: Float, threshold: float) -> Float:
    """Solve k·i + i·m²·max(0, 1 - k) = y for each value (`unprocess.invert_gains_per_channel`)."""
    y, k = np.broadcast_arrays(y, k)
    i = np.array(y / k)
    kept = (k < 1) & (i > threshold)
    i[kept] = _solve_highlight(y[kept], k[kept], threshold)
    return i


def _solve_highlight(y: Float, k: Float, threshold: float) -> Float:
    """Newton's method from above: the function rises and is convex there, so no step goes past the root."""
    i = np.maximum(y, 1)
    width = 1 - threshold
    for _ in range(ROUNDS):
        m = (i - threshold) / width
        slope = k + (1 - k) * m * (m + 2 * i / width)
        better = np.maximum(i - (i * (k + (1 - k) * m * m) - y) / slope, threshold)
        if (better >= i).all():
            break
        i = np.minimum(better, i)
    return i


def apply_gains_gray_mean(y: Float, k: Float, threshold: float) -> Float:
    """Find the mean of the channels that `unprocess.invert_gains_gray_mean` must have seen, then divide by its gains.

    With s the mean, i_c = y_c / g_c(s) and s = mean(i_c): the right side falls as s rises (where light is not
    negative), so bisection finds the only root.
    """
    i = y / k
    kept = np.mean(i, axis=-1) > threshold
    part = y[kept]
    low = np.full(part.shape[:-1], threshold)
    high = np.mean(part / k, axis=-1)
    for _ in range(ROUNDS):
        middle = (low + high) / 2
        if ((middle <= low) | (middle >= high)).all():
            break
        above = middle > np.mean(part / _gray_gains(middle, k, threshold), axis=-1)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    i[kept] = part / _gray_gains(high, k, threshold)
    return np.asarray(i)


def _gray_gains(gray: Float, k: Float, threshold: float) -> Float:
    m = np.maximum(gray - threshold, 0)[..., None] / (1 - threshold)
    mask = m * m
    return np.maximum(mask + (1 - mask) * k, k)


def apply_gains_none(y: Float, k: Float, threshold: float) -> Float:
    """Divide by the inverse gains."""
    return y / k


HIGHLIGHTS: dict[str, Callable[[Float, Float, float], Float]] = {
    "per_channel": apply_gains_per_channel,
    "gray_mean": apply_gains_gray_mean,
    "none": apply_gains_none,
}
