"""The article's Algorithm 1, step by step: from a display-referred photograph back to what the sensor saw.

This is the reference: NumPy, float64, one short function a step, in the article's order. It defines the clean frame;
`fused` must give the same DN everywhere and is what datasets are made with. The curves below call libm, whose last bit
differs between machines; that never reaches a file, since the fast form reads exact tables (`tables`) instead, and the
nearest any table value comes to a rounding edge is 6.7e-4 DN (8-bit sources, all five sensors). Given such a table as
``curve``, the reference makes datasets too (``accuracy=reference``).

Cost: about 200 ns a pixel, fifty times the fast form.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.random_streams import words
from unprocess_gen.core.types import Float, Plan, Srgb
from unprocess_gen.simulation.reference.cfa import mosaic


def unprocess(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0), curve: Float | None = None) -> Float:
    """Return the clean mosaic before clipping, ``[H, W]`` float64 with 0 at black and 1 at white.

    Arguments as for `camera_light`; ``origin`` places a cut-out in the full frame, for the Bayer phase.
    """
    return mosaic(camera_light(srgb, plan, curve), plan.pattern, origin)


def dequantise(srgb: Srgb, plan: Plan, curve: Float, origin: tuple[int, int] = (0, 0)) -> Srgb:
    """Return 8-bit codes as 16-bit ones, moved by up to half a code at random, ``[H, W, 3]``.

    So that 256 codes do not become 256 levels of raw. Codes 0 and 255, and those whose light (``curve``, 256 entries)
    lies above the highlight threshold, are not moved: there half a code is hundreds of DN. The offset is one of the 257
    whole sixteen-bit codes about the middle, from the stream ``dequantize``, channel by channel.
    """
    size = (srgb.shape[0], srgb.shape[1])
    channels = [words(plan.stream_key, "dequantize", size, origin=origin, draw=channel) for channel in range(3)]
    offsets = (np.stack(channels, axis=-1).astype(np.uint64) * np.uint64(257) >> np.uint64(32)).astype(np.int32) - 128
    kept = (srgb == 0) | (srgb == 255) | (curve[srgb] > plan.highlight_threshold)
    return (srgb.astype(np.int32) * 257 + np.where(kept, 0, offsets)).astype(np.uint16)


def camera_light(srgb: Srgb, plan: Plan, curve: Float | None = None) -> Float:
    """Return what falls on the sensor, before clipping and without the mosaic: ``[H, W, 3]`` float64, 1 at white.

    ``srgb`` is uint8 or uint16 ``[H, W, 3]``, codes k taken as k / 255 or k / 65535. ``curve`` is the linear light of
    every code; None computes it by the formulas.
    """
    image = linear_light(srgb, plan.tone, plan.gamma) if curve is None else curve[srgb]
    image = apply_ccm(image, plan.rgb2cam)
    return invert_gains(image, plan.inverse_gains, plan.highlight, plan.highlight_threshold)


def linear_light(srgb: Srgb, tone: str, gamma: float | str) -> Float:
    """Undo the tone curve and the gamma: codes of any shape to light in [0, 1]."""
    white = np.float64(np.iinfo(srgb.dtype).max)
    return expand_gamma(TONES[tone](srgb / white, (white - srgb) / white), gamma)


def inverse_smoothstep(x: Float, rest: Float) -> Float:
    """Invert the tone curve y ↦ 3y² - 2y³; x, ``rest`` = 1 - x and the result in [0, 1], any shape.

    The article writes ½ - sin(asin(1 - 2x) / 3), which loses every digit near black. The same function without a
    subtraction, for x up to ½, is sin t · (√3 cos t + sin t) with t = asin(√x) / 3; above ½ it is mirrored. White is
    steep, so the distance from it is passed in, computed from the integer codes: (N - k) / N has no rounding of k / N
    in it. Within 5 units in the last place of the true value on the 8- and 16-bit grids.
    """
    t = np.arcsin(np.sqrt(np.minimum(x, rest))) / 3
    y = np.sin(t) * (np.sqrt(3) * np.cos(t) + np.sin(t))
    return np.asarray(np.where(x > 0.5, 1 - y, y))


def no_tone(x: Float, rest: Float) -> Float:
    """Leave the image as it is: no tone curve was applied."""
    return x


TONES = {"smoothstep": inverse_smoothstep, "none": no_tone}


def expand_gamma(v: Float, gamma: float | str) -> Float:
    """Return linear light u = v**gamma, or sRGB's piecewise curve (IEC 61966-2-1) for ``"srgb"``; v in [0, 1]."""
    if gamma == "srgb":
        return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return np.asarray(v ** float(gamma))


def apply_ccm(linear: Float, ccm: tuple[float, ...]) -> Float:
    """Multiply each RGB triplet by the row-major 3x3 matrix; ``[H, W, 3]`` to ``[H, W, 3]``.

    Written out, because libraries' matrix products round differently between machines.
    """
    r, g, b = linear[..., 0], linear[..., 1], linear[..., 2]
    return np.stack([(ccm[i] * r + ccm[i + 1] * g) + ccm[i + 2] * b for i in (0, 3, 6)], axis=-1)


def invert_gains(
    camera_rgb: Float, inverse_gains: tuple[float, float, float], highlight: str, threshold: float
) -> Float:
    """Undo white balance and brightening, ``[H, W, 3]`` to ``[H, W, 3]``, not clipped.

    ``highlight`` says what happens to intensities above ``threshold`` (in [0, 1)) where the gain is below 1; see
    `HIGHLIGHTS`.
    """
    invert = HIGHLIGHTS[highlight]
    return invert(camera_rgb, np.array(inverse_gains), threshold)


def invert_gains_per_channel(i: Float, k: Float, threshold: float) -> Float:
    """Keep highlights channel by channel: k·i + i·m²·max(0, 1 - k), the article's function f.

    m = max(0, i - threshold) / (1 - threshold), so at 0.9 the term is the article's 100·i·(i - 0.9)²·(1 - k). White
    stays exactly 1 for every k below 1, which 100·(1 - 0.9)² does not give.
    """
    return i * k + i * highlight_mask(i, threshold) * np.maximum(1 - k, 0)


def invert_gains_gray_mean(i: Float, k: Float, threshold: float) -> Float:
    """Keep highlights by the mean of the three channels (Brooks et al. 2019, safe_invert_gains())."""
    gray = ((i[..., 0] + i[..., 1]) + i[..., 2]) / 3
    mask = highlight_mask(gray, threshold)[..., None]
    return i * np.maximum(mask + (1 - mask) * k, k)


def invert_gains_none(i: Float, k: Float, threshold: float) -> Float:
    """Multiply by the inverse gains and nothing else: with gains below 1 no highlight reaches white."""
    return i * k


HIGHLIGHTS = {
    "per_channel": invert_gains_per_channel,
    "gray_mean": invert_gains_gray_mean,
    "none": invert_gains_none,
}


def highlight_mask(i: Float, threshold: float) -> Float:
    """Return (max(0, i - threshold) / (1 - threshold))²: 0 up to the threshold, exactly 1 at white."""
    m = np.maximum(i - threshold, 0) / (1 - threshold)
    return np.asarray(m * m)
