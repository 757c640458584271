"""The mirror of `unprocess`: from the sensor's light back to a display-referred photograph, for eyes and for proofs.

Float64, one short function a step, in the camera's order: black level, gains, demosaic, matrix, gamma, tone. No byte of
a dataset depends on this room, so it may call libm, LAPACK and OpenCV. It is the inverse of the settings in a manifest
row. Where nothing was clipped, every 8-bit colour returns to its own code (the test walks all 2**24, for four cameras
and the gains' extremes); through whole DN of 16 bits still, of 14 bits to one code at the extremes, of 12 to two, of 10
to seven. Through the mosaic too, flat colours return so; what edges lose there is the demosaic's.

Tried for the highlights: Cardano's formula for the cubic, which loses half its digits where the mask begins; Newton's
method from above keeps them and needs 4 to 9 rounds at the gains of the article.

Tried for the demosaic, source to raw of 14 bits to sRGB, the middle megapixel of 37 photographs, median PSNR: OpenCV's
bilinear one 37.2 dB, its edge-aware one 37.0 dB (both take whole numbers only, and its third but 8 bits); the filters
of Malvar, He and Cutler, run by OpenCV, 41.0 dB where gains are applied before them, as cameras do, and 36.3 dB after
them. They are better than the bilinear one on 34 of the 37, worse on three whose flowers and leaves have a single
strong colour: channels that do not rise and fall together break their assumption.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from unprocess_gen.core.types import Float, Frame, Plan
from unprocess_gen.simulation.reference.cfa import mosaic, tile
from unprocess_gen.simulation.reference.colour import invert

ROUNDS = 200
"""More than any search below needs: a bisection halves an interval of doubles at most 64 times until it is two
neighbours, Newton's method halves at its slowest, at gains near 0."""


def process(camera_light: Float, plan: Plan) -> Float:
    """Return display-referred values in [0, 1], ``[H, W, 3]`` float64, of camera RGB with 0 at black and 1 at white.

    The inverse of `unprocess.camera_light`: colours that left [0, 1] on the way are clipped before the gamma, as
    cameras do.
    """
    return render(apply_gains(camera_light, plan.inverse_gains, plan.highlight, plan.highlight_threshold), plan)


def render(camera_rgb: Float, plan: Plan) -> Float:
    """Return display-referred values in [0, 1] of white-balanced camera RGB, ``[H, W, 3]``: matrix, gamma, tone."""
    image = camera_rgb @ np.array(invert(plan.rgb2cam)).reshape(3, 3).T
    image = compress_gamma(np.clip(image, 0, 1), plan.gamma)
    return TONES[plan.tone](image)


def develop(raw: Frame | Float, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Float:
    """Return the photograph that a raw frame shows, display-referred in [0, 1], ``[H, W, 3]`` float64.

    ``raw`` is a mosaic ``[H, W]`` in DN, clean or noisy, of at least 2 x 2 sites; ``origin`` is the row and column of
    its top-left site in the full frame. Noise below black and what a sensor reads above white are kept up to the colour
    matrix; what then lies outside [0, 1] is clipped, as in `process`. Light that the clip at white or a full well took
    does not come back; noise and fixed patterns are not undone. Raises ValueError as `demosaic` does.

    The gains are applied site by site, before the demosaic, so that a saturated highlight has no coloured rim. Where
    highlights were kept by the mean of three channels, no site has them: there the demosaic sees the plain gains.
    """
    light = to_light(raw, plan)
    k = np.broadcast_to(plan.inverse_gains, (*light.shape, 3))
    site_k = mosaic(k, plan.pattern, origin)
    if plan.highlight == "gray_mean":
        return process(demosaic(light / site_k, plan.pattern, origin) * k, plan)
    balanced = HIGHLIGHTS[plan.highlight](light, site_k, plan.highlight_threshold)
    return render(demosaic(balanced, plan.pattern, origin), plan)


def to_light(dn: Frame | Float, plan: Plan) -> Float:
    """Return the light of DN before the scene darkened it, any shape: 0 at black, 1 at the photograph's white."""
    span_dn = float(plan.white_level_dn - plan.black_level_dn)
    return np.asarray((dn - float(plan.black_level_dn)) / span_dn * plan.exposure_ratio)


def to_codes(srgb: Float, codes: int = 256) -> Float:
    """Return the nearest of ``codes`` evenly spaced codes, still float64; ``srgb`` in [0, 1], any shape."""
    return np.rint(srgb * (codes - 1))


KERNELS = {
    "green": ((0, 0, -2, 0, 0), (0, 0, 4, 0, 0), (-2, 4, 8, 4, -2), (0, 0, 4, 0, 0), (0, 0, -2, 0, 0)),
    "row": ((0, 0, 1, 0, 0), (0, -2, 0, -2, 0), (-2, 8, 10, 8, -2), (0, -2, 0, -2, 0), (0, 0, 1, 0, 0)),
    "column": ((0, 0, -2, 0, 0), (0, -2, 8, -2, 0), (1, 0, 10, 0, 1), (0, -2, 8, -2, 0), (0, 0, -2, 0, 0)),
    "diagonal": ((0, 0, -3, 0, 0), (0, 4, 0, 4, 0), (-3, 0, 12, 0, -3), (0, 4, 0, 4, 0), (0, 0, -3, 0, 0)),
}
"""Sixteenths (Malvar, He and Cutler, ICASSP 2004, figure 2): the mean of a site's neighbours of the channel wanted,
which stand in a cross (green at red and blue), in its row, in its column or across (red at blue, blue at red), and a
correction by the second difference of the channel it has. Each sums to 16 and is symmetric: flat colours and ramps are
exact."""

GREEN = 1


def demosaic(values: Float, pattern: str, origin: tuple[int, int] = (0, 0)) -> Float:
    """Return the three channels of every site of a mosaic, ``[H, W]`` to ``[H, W, 3]``; what was measured stays.

    Linear in its input. A flat colour comes out exactly but for rounding, and so does a ramp of any slope in each
    channel, save in the two outermost rows and columns: there the frame is mirrored about its edge sites, which keeps
    the Bayer phase. Raises ValueError for an unknown pattern and for less than 2 x 2 sites, which do not show all
    channels.
    """
    if min(values.shape) < 2:
        raise ValueError(f"the mosaic is {list(values.shape)}: less than 2 x 2 sites do not show all three colours")
    guesses = {name: _filtered(values, kernel) for name, kernel in KERNELS.items()}
    image = np.empty((*values.shape, 3))
    sites = tile(pattern, origin)
    for y in (0, 1):
        for x in (0, 1):
            own, beside, below = sites[y][x], sites[y][1 - x], sites[1 - y][x]
            missing = {beside: "row", below: "column"} if own == GREEN else {GREEN: "green", 2 - own: "diagonal"}
            image[y::2, x::2, own] = values[y::2, x::2]
            for channel, name in missing.items():
                image[y::2, x::2, channel] = guesses[name][y::2, x::2]
    return image


def _filtered(values: Float, sixteenths: tuple[tuple[int, ...], ...]) -> Float:
    kernel = np.array(sixteenths) / 16
    return np.asarray(cv2.filter2D(values, cv2.CV_64F, kernel, borderType=cv2.BORDER_REFLECT_101))


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
