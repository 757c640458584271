"""Invert `unprocess`: from the sensor's light back to a display-referred image, for display and for tests.

Float64, one function per step, in the order of a camera: black level, gains, demosaicking, matrix, gamma, tone curve.
No byte of a dataset depends on this module, so it may use libm, LAPACK and OpenCV.

Without clipping, every 8-bit colour returns to its own code. A test checks all 2**24 colours, for four cameras and
extreme gains. With rounding to DN in between, codes are exact at 16 bits. At the extremes they differ by at most one
code at 14 bits, two at 12 and seven at 10. Flat colours also survive the mosaic; edges lose what the demosaicking
loses. Comparison of methods: ``docs/design/isp.md``.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import cv2
import numpy as np

from unprocess_gen.core.arrays import Float, Frame
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import MONO, mosaic, tile
from unprocess_gen.simulation.reference.colour import IDENTITY, Matrix, invert
from unprocess_gen.simulation.reference.unprocess import gray_gains

MAX_ITERATIONS = 200
"""Limit of the searches below, which need fewer: bisection ends after at most 64 steps, Newton's method at least halves
the interval, even with gains near 0."""


def process(camera_light: Float, plan: Plan) -> Float:
    """Convert camera RGB to display-referred values: the inverse of `unprocess.camera_light`.

    Parameters
    ----------
    camera_light : ndarray of float64, [H, W, 3]
        Light at the sensor, 0 at black and 1 at white.
    plan : Plan
        Parameters of the pair.

    Returns
    -------
    ndarray of float64, [H, W, 3]
        Values in [0, 1]. Colours outside [0, 1] are clipped before the gamma, as cameras do.
    """
    return render(
        apply_gains(camera_light, plan.camera.inverse_gains, plan.isp.highlight, plan.isp.highlight_threshold),
        plan,
    )


def render(camera_rgb: Float, plan: Plan) -> Float:
    """Apply matrix, gamma and tone curve to white-balanced camera RGB, [H, W, 3]; returns values in [0, 1]."""
    image = camera_rgb @ np.array(cam2rgb(plan)).reshape(3, 3).T
    image = compress_gamma(np.clip(image, 0, 1), plan.isp.gamma)
    return TONES[plan.isp.tone](image)


def cam2rgb(plan: Plan) -> Matrix:
    """Return the matrix from camera RGB to linear sRGB; the identity for a sensor without colour filters."""
    return IDENTITY if plan.sensor.pattern == MONO else _inverse(plan.camera.rgb2cam)


@functools.lru_cache(maxsize=4096)
def _inverse(rgb2cam: Matrix) -> Matrix:
    """Inverse of a camera's matrix, whose fractions take 0.3 ms: longer than a live crop."""
    return invert(rgb2cam)


def develop(raw: Frame | Float, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Float:
    """Develop a raw frame to a display-referred image.

    Parameters
    ----------
    raw : ndarray, [H, W]
        Clean or noisy mosaic in DN, at least 2 x 2 sites.
    plan : Plan
        Parameters of the pair.
    origin : (int, int)
        Row and column of ``raw[0, 0]`` in the full frame.

    Returns
    -------
    ndarray of float64, [H, W, 3]
        Display-referred values in [0, 1]; equal channels with the pattern ``MONO``. Values below black and above white
        are preserved up to the colour matrix and clipped after it. Saturated light, noise and fixed patterns are not
        restored.

    Raises
    ------
    ValueError
        If the pattern is unknown or the frame is smaller than 2 x 2.

    Notes
    -----
    Gains are applied before demosaicking, so that saturated highlights get no coloured rim. With
    ``highlight="gray_mean"`` the gains depend on all three channels, so there demosaicking follows the plain gains.
    """
    return render(white_balanced(to_light(raw, plan), plan, origin), plan)


def white_balanced(light: Float, plan: Plan, origin: tuple[int, int] = (0, 0), method: str = "malvar") -> Float:
    """Apply the gains to a mosaic of light and interpolate it, in its own precision; returns camera RGB, [H, W, 3]."""
    pattern, isp, k = plan.sensor.pattern, plan.isp, np.array(plan.camera.inverse_gains, light.dtype)
    site_k = mosaic(np.broadcast_to(k, (*light.shape, 3)), pattern, origin).astype(light.dtype)
    if isp.highlight == "gray_mean":
        image = demosaic(light / site_k, pattern, origin, method) * k
        return apply_gains_gray_mean(image, k, isp.highlight_threshold)
    balanced = HIGHLIGHTS[isp.highlight](light, site_k, isp.highlight_threshold)
    return demosaic(balanced, pattern, origin, method)


def to_light(dn: Frame | Float, plan: Plan) -> Float:
    """Convert DN to light before the scene's darkening.

    Parameters
    ----------
    dn : ndarray
        DN, any shape.
    plan : Plan
        Parameters of the pair.

    Returns
    -------
    ndarray of float64
        Light, 0 at black and 1 at the white of the source image; same shape.
    """
    span_dn = float(plan.sensor.white_level_dn - plan.sensor.black_level_dn)
    return np.asarray((dn - float(plan.sensor.black_level_dn)) / span_dn * plan.scene.exposure_ratio)


def to_codes(srgb: Float, codes: int = 256) -> Float:
    """Round display-referred values in [0, 1] to integers from 0 to ``codes`` - 1."""
    return np.rint(srgb * (codes - 1))


Filters = dict[str, tuple[tuple[int, ...], ...]]

KERNELS: Filters = {
    "green": ((0, 0, -2, 0, 0), (0, 0, 4, 0, 0), (-2, 4, 8, 4, -2), (0, 0, 4, 0, 0), (0, 0, -2, 0, 0)),
    "row": ((0, 0, 1, 0, 0), (0, -2, 0, -2, 0), (-2, 8, 10, 8, -2), (0, -2, 0, -2, 0), (0, 0, 1, 0, 0)),
    "column": ((0, 0, -2, 0, 0), (0, -2, 8, -2, 0), (1, 0, 10, 0, 1), (0, -2, 8, -2, 0), (0, 0, -2, 0, 0)),
    "diagonal": ((0, 0, -3, 0, 0), (0, 4, 0, 4, 0), (-3, 0, 12, 0, -3), (0, 4, 0, 4, 0), (0, 0, -3, 0, 0)),
}
"""Filters of Malvar, He and Cutler (ICASSP 2004, figure 2), in sixteenths.

A filter averages the neighbours of the wanted channel and corrects the mean by the second difference of the site's own
channel. The neighbours are next to the site (green at red and blue), in its row, in its column, or diagonal (red at
blue, blue at red). Each filter is symmetric and sums to 16, so that flat colours and ramps are exact.
"""

BILINEAR: Filters = {
    "green": ((0, 4, 0), (4, 0, 4), (0, 4, 0)),
    "row": ((0, 0, 0), (8, 0, 8), (0, 0, 0)),
    "column": ((0, 8, 0), (0, 0, 0), (0, 8, 0)),
    "diagonal": ((4, 0, 4), (0, 0, 0), (4, 0, 4)),
}
"""Means of the neighbours of the wanted channel, in sixteenths."""

DEMOSAICS = {"malvar": KERNELS, "bilinear": BILINEAR}
"""Filters of each method."""

GREEN = 1


def demosaic(values: Float, pattern: str, origin: tuple[int, int] = (0, 0), method: str = "malvar") -> Float:
    """Interpolate the missing channels of a mosaic of at least 2 x 2 sites, [H, W] to [H, W, 3], of the same dtype.

    Recorded values are unchanged. Flat colours are exact up to rounding. Linear ramps are too, except in the two
    outermost rows and columns, where the frame is mirrored about its edge sites (which preserves the phase of the
    pattern). With `cfa.MONO` all channels equal the values. Raises ValueError for an unknown pattern or a smaller
    mosaic.
    """
    if min(values.shape) < 2:
        raise ValueError(f"mosaic={list(values.shape)}: channels are missing; expected at least 2 x 2 sites")
    if pattern == MONO:
        return np.repeat(values[..., np.newaxis], 3, axis=2)
    interpolated = {name: _filter(values, kernel) for name, kernel in DEMOSAICS[method].items()}
    image = np.empty((*values.shape, 3), values.dtype)
    sites = tile(pattern, origin)
    for y in (0, 1):
        for x in (0, 1):
            own, right, below = sites[y][x], sites[y][1 - x], sites[1 - y][x]
            missing = {right: "row", below: "column"} if own == GREEN else {GREEN: "green", 2 - own: "diagonal"}
            image[y::2, x::2, own] = values[y::2, x::2]
            for channel, name in missing.items():
                image[y::2, x::2, channel] = interpolated[name][y::2, x::2]
    return image


def _filter(values: Float, sixteenths: tuple[tuple[int, ...], ...]) -> Float:
    """Filter a mosaic with a kernel given in sixteenths."""
    kernel = np.array(sixteenths) / 16
    return np.asarray(cv2.filter2D(values, -1, kernel, borderType=cv2.BORDER_REFLECT_101))


def smoothstep(y: Float) -> Float:
    """Apply the tone curve 3y² - 2y³ to values in [0, 1] (Brooks et al. 2019)."""
    return np.asarray(y * y * (3 - 2 * y))


def no_tone(y: Float) -> Float:
    """Return ``y``: no tone curve."""
    return y


TONES: dict[str, Callable[[Float], Float]] = {"smoothstep": smoothstep, "none": no_tone}


def compress_gamma(u: Float, gamma: float | str) -> Float:
    """Apply the gamma to light in [0, 1]: u**(1 / gamma), or the piecewise curve of sRGB (IEC 61966-2-1)."""
    if gamma == "srgb":
        return np.where(u <= 0.04045 / 12.92, u * 12.92, 1.055 * u ** (1 / 2.4) - 0.055)
    return np.asarray(u ** (1 / float(gamma)))


def apply_gains(y: Float, inverse_gains: tuple[float, float, float], highlight: str, threshold: float) -> Float:
    """Apply white balance and brightness gains, [H, W, 3] to [H, W, 3]: the inverse of `unprocess.invert_gains`.

    For unclipped values the inverse is exact up to rounding, for each method of `HIGHLIGHTS`.
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
    """Solve for the highlights by Newton's method from above; the function is convex, so no step passes the root.

    Cardano's formula loses digits as the gain approaches 1 (``docs/hard_cases.md``).
    """
    i = np.maximum(y, 1)
    width = 1 - threshold
    for _ in range(MAX_ITERATIONS):
        m = (i - threshold) / width
        slope = k + (1 - k) * m * (m + 2 * i / width)
        better = np.maximum(i - (i * (k + (1 - k) * m * m) - y) / slope, threshold)
        if (better >= i).all():
            break
        i = np.minimum(better, i)
    return i


def apply_gains_gray_mean(y: Float, k: Float, threshold: float) -> Float:
    """Find the channel mean s that `unprocess.invert_gains_gray_mean` used, then divide by its gains.

    With i_c = y_c / g_c(s), s = mean(i_c). For light that is not negative, the right side decreases with s, so
    bisection finds the only root.
    """
    i = y / k
    kept = np.mean(i, axis=-1) > threshold
    part = y[kept]
    low = np.full(part.shape[:-1], threshold)
    high = np.mean(part / k, axis=-1)
    for _ in range(MAX_ITERATIONS):
        middle = (low + high) / 2
        if ((middle <= low) | (middle >= high)).all():
            break
        above = middle > np.mean(part / gray_gains(middle, k, threshold), axis=-1)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    i[kept] = part / gray_gains(high, k, threshold)
    return np.asarray(i)


def apply_gains_none(y: Float, k: Float, threshold: float) -> Float:
    """Divide by the inverse gains."""
    return y / k


HIGHLIGHTS: dict[str, Callable[[Float, Float, float], Float]] = {
    "per_channel": apply_gains_per_channel,
    "gray_mean": apply_gains_gray_mean,
    "none": apply_gains_none,
}
