"""Compute the mean of noisy pictures before JPEG: the expectation of their codes over all draws of the noise.

The noisy light of a site has a mean and a variance, after the clip of the sensor and the gains. Demosaicking and matrix
are linear, so both follow for each channel of a pixel, whose light is taken as normally distributed. A table gives the
mean code of a normal distribution after clip, gamma and tone curve.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any

import cv2
import numpy as np

from unprocess_gen.core.arrays import Float, Frame, Srgb
from unprocess_gen.picture_isp import IspOptions, finish, light_limits, table_of_roots, with_strength
from unprocess_gen.simulation.effects import dark_variance_dn2
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.plan_slots import slots_of
from unprocess_gen.simulation.reference import isp
from unprocess_gen.simulation.reference.cfa import tile

DEVIATES = np.linspace(-5, 5, 96)
"""Nodes of integrals over a standard normal distribution."""

WEIGHTS = np.exp(-DEVIATES * DEVIATES / 2) / np.exp(-DEVIATES * DEVIATES / 2).sum()

LOOK_UP: Any = functools.partial(cv2.remap, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
"""Interpolate a table at columns and rows."""


def mean_picture(clean: Frame, plan: Plan, options: IspOptions, strength: float, codes: int) -> Srgb:
    """Compute the mean of the noisy pictures of a clean frame, float32 [H, W], rounded to codes.

    Offsets of rows and columns are taken as independent from site to site. Fixed patterns are random too, unless the
    clean frame contains them. Hot and dead pixels are left out. Noise reduction is applied to the mean.
    """
    pattern, matrix = plan.sensor.pattern, np.reshape(isp.cam2rgb(plan), (3, 3)).astype(np.float32)
    mean, variance = cv2.split(_balanced_moments(clean, plan, strength))
    light: Any = cv2.transform(isp.demosaic(mean, pattern, method=options.demosaic), matrix)
    std: Any = np.empty_like(light)
    for y, x, channel in itertools.product(range(2), range(2), range(3)):
        weights = np.tensordot(matrix[channel], _site_weights(pattern, options.demosaic)[y, x], 1)
        of_all_sites = cv2.filter2D(variance, -1, weights * weights, borderType=cv2.BORDER_REFLECT_101)
        std[y::2, x::2, channel] = of_all_sites[y::2, x::2]
    np.sqrt(np.maximum(std, 1e-16), out=std)
    table = _mean_codes(plan.isp.tone, plan.isp.gamma)
    picture = LOOK_UP(table, *_places(light.reshape(len(light), -1), std.reshape(len(light), -1)))
    return finish(picture.reshape(light.shape) * np.float32((codes - 1) / 255), options, codes)


LEVELS = 512
"""Levels of light between which the moments of a site are interpolated."""


def _balanced_moments(clean: Any, plan: Plan, strength: float) -> Any:
    """Mean and variance of the white-balanced noisy light of each site, float32 [H, W, 2]."""
    low, high = float(clean.min()), float(clean.max())
    levels, place = np.linspace(low, high, LEVELS), (clean - low) * np.float32((LEVELS - 1) / max(high - low, 1e-9))
    light, noise = levels[:, None] * plan.scene.exposure_ratio, _noise(levels, plan)
    sites_k = np.array(plan.camera.inverse_gains)[np.array(tile(plan.sensor.pattern))]
    highlight = isp.HIGHLIGHTS[plan.isp.highlight]
    result, rows = np.empty((*clean.shape, 2), np.float32), np.zeros_like(place)
    for (y, x), k in np.ndenumerate(sites_k):
        noisy = np.clip(light + noise[2 * y + x], *light_limits(plan))
        values = highlight(with_strength(light, noisy, strength, plan), np.asarray(k), plan.isp.highlight_threshold)
        mean = values @ WEIGHTS
        moments = np.stack((mean, (values - mean[:, None]) ** 2 @ WEIGHTS), axis=1)[None].astype(np.float32)
        result[y::2, x::2] = LOOK_UP(moments, place[y::2, x::2], rows[y::2, x::2])
    return result


def _noise(levels: Float, plan: Plan) -> Float:
    """Noise of each site of the tile at each level, in light before the scene's darkening: [4, LEVELS, DEVIATES]."""
    slots, signal_dn, offsets_dn = slots_of(plan), levels * plan.sensor.span_dn, np.zeros(4)
    variance_dn2 = plan.noise.variance_line[0] * signal_dn + dark_variance_dn2(plan) + 1 / 12
    if not plan.averaged:  # otherwise the clean frame has pattern and offsets
        pattern, counts = slots.patterns.electrons, slots.uniform
        variance_dn2 += (pattern.std * signal_dn) ** 2 if pattern else 0
        offsets_dn += slots.planes_dn
        offsets_dn += (counts.rate_e - counts.removed_e) * slots.dn_per_e if counts else 0
    noise_dn = offsets_dn[:, None, None] + np.sqrt(np.maximum(variance_dn2, 0))[:, None] * DEVIATES
    if plan.pins_saturated:
        noise_dn[:, levels >= plan.saturated_value] = 0
    return np.asarray(noise_dn / plan.sensor.span_dn * plan.scene.exposure_ratio)


SIDE = 5
"""Side of the neighbourhood whose sites decide a pixel."""


@functools.lru_cache(maxsize=8)
def _site_weights(pattern: str, demosaic: str) -> Float:
    """Weights of the sites around a pixel in its channels: [2, 2, channel, SIDE, SIDE] for the pixels of the tile."""
    weights = np.empty((2, 2, 3, SIDE, SIDE))
    for y, x, dy, dx in itertools.product(range(2), range(2), range(SIDE), range(SIDE)):
        impulse = np.zeros((12, 12))
        impulse[4 + y + dy - SIDE // 2, 4 + x + dx - SIDE // 2] = 1
        weights[y, x, :, dy, dx] = isp.demosaic(impulse, pattern, method=demosaic)[4 + y, 4 + x]
    return weights


ROOTS, STDS = 512, 128
"""Columns and rows of the table of means."""


@functools.lru_cache(maxsize=4)
def _mean_codes(tone: str, gamma: float | str) -> Any:
    """Mean 8-bit codes of normal distributions of light, float32 [STDS, ROOTS], at the places of `_places`."""
    curve = table_of_roots(tone, gamma, 256, False)
    share, root = np.arange(STDS)[:, None] / STDS, np.arange(ROOTS) / ROOTS
    std, square = (share / (1 - share)) ** 2, np.maximum((root / (1 - root)) ** 2, 1e-12)
    mean, codes = square - std * std / square, np.zeros((STDS, ROOTS))
    for deviate, weight in zip(DEVIATES, WEIGHTS, strict=True):
        positions = np.sqrt(np.clip(mean + deviate * std, 0, 1)) * (len(curve) - 1)
        codes += weight * curve.take((positions + 0.5).astype(np.int32))
    return codes.astype(np.float32)


def _places(mean: Any, std: Any) -> list[Any]:
    """Columns and rows of normal distributions in the table of means, which is finest around black.

    They are r / (1 + r) of its sides, for r² = (mean + √(mean² + 4 std²)) / 2, near the mean if that is large, and for
    r² = std.
    """
    roots = np.sqrt((mean + np.sqrt(mean * mean + 4 * std * std)) / 2), np.sqrt(std)
    return [root / (1 + root) * np.float32(count) for root, count in zip(roots, (ROOTS, STDS), strict=True)]
