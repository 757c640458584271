"""Algorithm 1 of the article, step by step: from a display-referred image to the light at the sensor.

This is the reference (NumPy, float64, one function per step, in the article's order). It defines the clean frame; the
kernels compute the same DN, much faster (``docs/performance.md``).

Codes become linear light by exact tables (`simulation.tone_curves`). The formulas below, `INVERSE_TONES` and
`expand_gamma`, show the steps in pictures; their last bit differs between machines, because they use libm. With 8-bit
sources and all five sensors, table values are at least 6.7e-4 DN from a rounding boundary.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.arrays import Float, Srgb, last_code
from unprocess_gen.core.random_streams import declare_stream, words
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.profiles import UNCONVERTED, Profile, light_tables
from unprocess_gen.simulation.reference.cfa import mosaic, plane_sites
from unprocess_gen.simulation.reference.primaries import light_colours


def unprocess(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Float:
    """Compute the clean mosaic before clipping: normalised light, 0 at black and 1 at white, [H, W].

    Parameters
    ----------
    srgb : ndarray of uint8, uint16 or float32, [H, W, 3]
        Display-referred codes, R, G, B; float32 is the light of a linear source.
    plan : Plan
        Parameters of the pair.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame, for the phase of the CFA pattern.
    """
    if plan.source.is_raw:
        return raw_light(srgb, plan, origin)
    return mosaic(camera_light(srgb, plan), plan.sensor.pattern, origin)


def raw_light(codes: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Float:
    """Compute the clean mosaic of a raw source before clipping: (code - black) / (white - black), plane by plane.

    Of the camera RGB ``codes``, [H, W, 3], each site uses the channel of its filter. The light is 0 at black, 1 at
    white.
    """
    light = mosaic(codes, plan.sensor.pattern, origin)
    for (y, x), black, white in zip(plane_sites(plan.sensor.pattern, origin), *plan.source.code_levels, strict=True):
        light[y::2, x::2] = (light[y::2, x::2] - black) / (white - black)
    return light


DEQUANTIZE = declare_stream("dequantize", 10)


def dequantise(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Srgb:
    """Dither 8-bit codes to 16 bits if the plan asks for it; return other codes as they are, [H, W, 3].

    Without it, 256 codes become 256 levels of raw. Each channel of each pixel gets an offset from the random stream
    ``dequantize``: one of the 257 integers within half an 8-bit code. Codes 0 and 255 get none. For ``dither``,
    highlights get none either, because half a code is hundreds of DN there: codes whose linear light is above the
    threshold of highlights. For ``dither_all`` they do, and code 254 gets one of 385 integers up to white, which it
    does not reach: so the 16-bit codes have no gaps, white stays white, and codes keep their order.
    """
    if plan.source.dequantize == "off" or srgb.dtype != np.uint8:
        return srgb
    size = (srgb.shape[0], srgb.shape[1])
    channels = [words(plan.stream_key, DEQUANTIZE, size, origin=origin, draw=channel) for channel in range(3)]
    kept = (srgb == 0) | (srgb == 255)
    if plan.source.dequantize == "dither_all":
        steps = np.where(srgb == 254, np.uint64(385), np.uint64(257))  # 254 · 257 + 256 is one less than white
    else:
        steps = np.broadcast_to(np.uint64(257), srgb.shape)
        kept |= linear_light(srgb, plan.isp.tone, plan.isp.gamma, plan.source.profile) > plan.isp.highlight_threshold
    offsets = (np.stack(channels, axis=-1).astype(np.uint64) * steps >> np.uint64(32)).astype(np.int32) - 128
    return (srgb.astype(np.int32) * 257 + np.where(kept, 0, offsets)).astype(np.uint16)


def camera_light(srgb: Srgb, plan: Plan) -> Float:
    """Compute the light at the sensor in all three channels, before clipping.

    Parameters
    ----------
    srgb : ndarray of uint8, uint16 or float32, [H, W, 3]
        Codes k, which mean k / 255 or k / 65535; float32 is the light of a linear source.
    plan : Plan
        Parameters of the pair.

    Returns
    -------
    ndarray of float64, [H, W, 3]
        Camera RGB, 0 at black and 1 at white.
    """
    matrix, gains = light_colours(plan.source, plan.camera)
    isp, profile = plan.isp, plan.source.profile
    image = srgb.astype(np.float64) if plan.source.is_linear else linear_light(srgb, isp.tone, isp.gamma, profile)
    return invert_gains(apply_ccm(image, matrix), gains, isp.highlight, isp.highlight_threshold)


def linear_light(srgb: Srgb, tone: str, gamma: float | str, profile: Profile = UNCONVERTED) -> Float:
    """Invert the tone curve (key of `INVERSE_TONES`) and the gamma (exponent, or ``srgb``), by the exact tables."""
    red, green, blue = light_tables(profile, tone, gamma, last_code(srgb) + 1)
    if red is green is blue:
        return red[srgb]
    return np.stack([red[srgb[..., 0]], green[srgb[..., 1]], blue[srgb[..., 2]]], axis=-1)


def inverse_smoothstep(x: Float, rest: Float) -> Float:
    """Invert the tone curve x = 3y² - 2y³ without cancellation; ``rest`` is 1 - x, both in [0, 1].

    The article's formula ½ - sin(asin(1 - 2x) / 3) cancels near black. This function avoids the subtraction: for
    x ≤ ½ it is sin t · (√3 cos t + sin t) with t = asin(√x) / 3, and for larger x it is mirrored. The curve is steep at
    white, so the caller computes ``rest`` from the integer codes, as (N - k) / N. The error is at most 6 units in the
    last place for all 8- and 16-bit codes; NumPy's arcsin, sin and cos differ between processors (5.2 with AVX-512).
    """
    t = np.arcsin(np.sqrt(np.minimum(x, rest))) / 3
    y = np.sin(t) * (np.sqrt(3) * np.cos(t) + np.sin(t))
    return np.asarray(np.where(x > 0.5, 1 - y, y))


def inverse_no_tone(x: Float, rest: Float) -> Float:
    """Return ``x``: no tone curve was applied."""
    return x


INVERSE_TONES = {"smoothstep": inverse_smoothstep, "none": inverse_no_tone}


def expand_gamma(v: Float, gamma: float | str) -> Float:
    """Invert the gamma of values in [0, 1]: v**gamma, or the piecewise curve of sRGB (IEC 61966-2-1)."""
    if gamma == "srgb":
        return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return np.asarray(v ** float(gamma))


def apply_ccm(linear: Float, ccm: tuple[float, ...]) -> Float:
    """Multiply each RGB triplet by the row-major 3x3 matrix; ``[H, W, 3]`` to ``[H, W, 3]``.

    Products are written out, because the matrix products of libraries round differently between machines.
    """
    r, g, b = linear[..., 0], linear[..., 1], linear[..., 2]
    return np.stack([(ccm[i] * r + ccm[i + 1] * g) + ccm[i + 2] * b for i in (0, 3, 6)], axis=-1)


def invert_gains(
    camera_rgb: Float, inverse_gains: tuple[float, float, float], highlight: str, threshold: float
) -> Float:
    """Invert white balance and brightness gains, [..., 3], without clipping.

    ``highlight`` names the method for highlights of channels with an inverse gain below 1 (`INVERSE_HIGHLIGHTS`), and
    ``threshold`` the intensity above which it acts, in [0, 1).
    """
    invert = INVERSE_HIGHLIGHTS[highlight]
    return invert(camera_rgb, np.array(inverse_gains), threshold)


def invert_gains_per_channel(i: Float, k: Float, threshold: float) -> Float:
    """Preserve highlights in each channel: k·i + i·m²·max(0, 1 - k), the article's function f.

    m = max(0, i - threshold) / (1 - threshold). At threshold 0.9 the second term is the article's
    100·i·(i - 0.9)²·(1 - k). Unlike 100·(1 - 0.9)², m² is exactly 1 at white, so white stays exactly 1.
    """
    return i * k + i * highlight_mask(i, threshold) * np.maximum(1 - k, 0)


def invert_gains_gray_mean(i: Float, k: Float, threshold: float) -> Float:
    """Preserve highlights by the mean of the three channels (Brooks et al. 2019, safe_invert_gains())."""
    return i * gray_gains(((i[..., 0] + i[..., 1]) + i[..., 2]) / 3, k, threshold)


def invert_gains_none(i: Float, k: Float, threshold: float) -> Float:
    """Multiply by the inverse gains only; with gains below 1, highlights do not reach white."""
    return i * k


INVERSE_HIGHLIGHTS = {
    "per_channel": invert_gains_per_channel,
    "gray_mean": invert_gains_gray_mean,
    "none": invert_gains_none,
}


def gray_gains(gray: Float, k: Float, threshold: float) -> Float:
    """Return the inverse gains of the highlight method ``gray_mean``, [..., 3], for a mean of the channels."""
    mask = highlight_mask(gray, threshold)[..., None]
    return np.asarray(np.maximum(mask + (1 - mask) * k, k))


def highlight_mask(i: Float, threshold: float) -> Float:
    """Return (max(0, i - threshold) / (1 - threshold))²: 0 up to the threshold, exactly 1 at white."""
    m = np.maximum(i - threshold, 0) / (1 - threshold)
    return np.asarray(m * m)
