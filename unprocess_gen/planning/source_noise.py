"""Estimate the noise of a source itself, which both frames of a pair contain.

Photographs contain sensor noise, and JPEG adds residue. Both pass through the inverse pipeline into the clean frame, so
a network learns to keep them. The estimate is made in the raw domain, from a fixed sample of tiles. It decides nothing:
rows record it, and `plan` compares it with the simulated noise.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float, Srgb, last_code
from unprocess_gen.simulation.plan import CODE_RANGE, Plan
from unprocess_gen.simulation.reference.cfa import filters
from unprocess_gen.simulation.reference.unprocess import camera_light

TILE_SIDE = 32
"""Side of a tile, pixels; its green plane has half of it."""

MOST_TILES, SPACING = 8, 96
"""Most tiles in each direction, and least distance between them in pixels."""

STEPS_PER_DN = 1024
"""Steps of an integer that holds the light of a site."""

DECIMALS = 3
"""Decimals of the recorded value, DN."""

LAPLACIAN_SCALE = math.sqrt(math.pi / 2) / 6
"""Standard deviation of white noise divided by the mean magnitude of its Laplacian (Immerkær 1996)."""

IntegerArray = NDArray[np.int64]


class TileNoise(NamedTuple):
    """Noise and signal of the quieter half of a source's tiles, in DN of the raw green plane.

    Attributes
    ----------
    std_dn : ndarray of float64, [N]
        Standard deviation in each tile.
    signal_dn : ndarray of float64, [N]
        Mean of each tile, above the black level.
    """

    std_dn: Float
    signal_dn: Float


def tile_noise(srgb: Srgb, plan: Plan) -> TileNoise:
    """Estimate the noise of a source in tiles of its raw green plane.

    The mean magnitude of the Laplacian measures the noise of a tile (Immerkær, "Fast noise variance estimation", CVIU
    1996); edges raise it. Tiles are therefore sorted by its value in the codes of the source, where noise depends
    little on brightness, and only the quieter half is used. Tiles with a code at either end of the range have less
    noise than the others and are left out. Frames of bursts have no tiles, because their means have less noise.
    """
    if plan.motion is not None:
        return TileNoise(np.zeros(0), np.zeros(0))
    codes: Any = _green_sites(srgb, plan.sensor.pattern)
    tiles, last, plane = codes, last_code(srgb), 1 if "R" in plan.sensor.pattern[:2] else 2
    if plan.source.is_linear:
        last = int(CODE_RANGE)
        codes = np.rint(np.clip(tiles * plan.scene.exposure, 0, 1) * last)
    black, white = (levels[plane] for levels in plan.source.code_levels) if plan.source.is_raw else (0, last)
    is_free = ((codes > 0) & (codes < white)).all(axis=(1, 2, 3))
    tiles, codes = tiles[is_free], codes[is_free]
    quiet = np.argsort(_laplacian_sums(codes[..., 1].astype(np.int64)), kind="stable")[: (len(codes) + 1) // 2]
    if not quiet.size:
        return TileNoise(np.zeros(0), np.zeros(0))
    if plan.source.is_raw:
        light = (tiles[quiet][..., 1] - black) / (white - black)
    else:
        light = camera_light(tiles[quiet], plan)[..., 1]
    span = float(plan.sensor.white_level_dn - plan.sensor.black_level_dn)
    white = 1 / plan.scene.exposure if plan.source.is_linear else 1.0  # in light before the exposure
    steps = np.rint(np.clip(light, plan.darkest, white) * (plan.scene.exposure * span * STEPS_PER_DN)).astype(np.int64)
    _, height, width = steps.shape
    sites = (height - 2) * (width - 2)
    std_dn = _laplacian_sums(steps) * (LAPLACIAN_SCALE / (sites * STEPS_PER_DN))
    return TileNoise(std_dn, steps.sum(axis=(1, 2)) / (height * width * STEPS_PER_DN))


def source_noise_dn(srgb: Srgb, plan: Plan) -> float | None:
    """Estimate the standard deviation of the noise of a source in the clean frame."""
    std_dn = np.sort(tile_noise(srgb, plan).std_dn)
    return round(float(std_dn[(std_dn.size - 1) // 2]), DECIMALS) if std_dn.size else None


def noise_ratio(srgb: Srgb, plan: Plan) -> float | None:
    """Return the noise of a source relative to the simulated shot and read noise at the same signal."""
    tiles = tile_noise(srgb, plan)
    slope, intercept = plan.noise.variance_line
    variance = np.maximum(slope * np.maximum(tiles.signal_dn, 0) + intercept, 0)
    ratios = np.sort(tiles.std_dn[variance > 0] / np.sqrt(variance[variance > 0]))
    return float(ratios[(ratios.size - 1) // 2]) if ratios.size else None


def _green_sites(srgb: Srgb, pattern: str) -> Srgb:
    """Return the pixels at the first green site of each 2x2 tile of the CFA, [N, TILE_SIDE / 2, TILE_SIDE / 2, 3]."""
    height, width = srgb.shape[:2]
    top, left = divmod(filters(pattern).index("G"), 2)
    inside = np.arange(0, TILE_SIDE, 2)
    rows, columns = _starts(height)[:, None] + (inside + top), _starts(width)[:, None] + (inside + left)
    tiles: Srgb = srgb[rows[:, None, :, None], columns[None, :, None, :]].reshape(-1, TILE_SIDE // 2, TILE_SIDE // 2, 3)
    return tiles


def _starts(length: int) -> NDArray[np.intp]:
    """Return the even places at which tiles begin, evenly spaced; none if no tile fits."""
    if length < TILE_SIDE:
        return np.zeros(0, dtype=np.intp)
    count = min(MOST_TILES, max(1, length // SPACING))
    return np.arange(count) * (length - TILE_SIDE) // max(count - 1, 1) // 2 * 2


def _laplacian_sums(tiles: IntegerArray) -> IntegerArray:
    """Return the sum of |L| in each tile; L is the product of the second differences of rows and of columns.

    The coefficients of L have the sum of squares 36.
    """
    rows = tiles[:, :-2] - 2 * tiles[:, 1:-1] + tiles[:, 2:]
    return np.asarray(np.abs(rows[..., :-2] - 2 * rows[..., 1:-1] + rows[..., 2:]).sum(axis=(1, 2)))
