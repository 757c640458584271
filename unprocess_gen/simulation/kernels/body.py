"""Prepare the fixed patterns of a camera body once for all of its frames: factors, offsets by site, and defects."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import kernel
from unprocess_gen.core.lookup_tables import exponential_levels
from unprocess_gen.core.random_streams import BLOCK, purpose
from unprocess_gen.core.types import Float
from unprocess_gen.simulation.effects.lens_shading import illumination
from unprocess_gen.simulation.kernels.normal import exact_values, fill_rows, normal_quantiles
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_word_blocks, philox_key
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, maximum, pointer_to, store, to_float32
from unprocess_gen.simulation.kernels.strips import (
    ONES,
    STRIP,
    ZEROS,
    Float32,
    Scratch,
    locate,
    padded_width,
    scratch_of_thread,
    workspace_in,
)
from unprocess_gen.simulation.slots import BrightPixels, DeadPixels, NormalPattern, Patterns, RadialFactor

SMALL_SITES, SMALL_PATTERNS, LARGE_PATTERNS = 2**16, 384, 5
"""So many patterns of crops of up to this many sites (0.3 MB each) are kept, and so many of larger crops."""

RARE_STDS = 6.0
"""Defects above their expected number, in standard deviations, for which lists rarely have no space."""

Shape = tuple[int, int]


class SiteMap(NamedTuple):
    """A value for each pixel: float32, whose columns are those of complete blocks; else `SIZE` equal numbers.

    ``steps`` are the elements from row to row and from column to column, 0 if all are equal.
    """

    values: Float32
    steps: tuple[int, int]


class DefectLists(NamedTuple):
    """List the defects of a crop of H rows in S strips each."""

    strips: int  # S; 0 without defects
    starts: NDArray[np.int64]  # [H * S + 1]: first defect of each strip
    positions: NDArray[np.int64]  # index of each defect in the buffers of its strip
    means_e: Float  # mean excess of a bright defect, electrons; negative for a pixel that reads 0


class Body(NamedTuple):
    """Hold the fixed patterns of a body for a crop: members of `SiteMap` and of `DefectLists`."""

    response: Float32  # factor on the electrons of light
    response_steps: tuple[int, int]
    sites_dn: Float32  # offsets by site
    sites_steps: tuple[int, int]
    strips: int
    starts: NDArray[np.int64]
    positions: NDArray[np.int64]
    means_e: Float


WITHOUT_FACTOR, WITHOUT_OFFSETS = SiteMap(ONES, (0, 0)), SiteMap(ZEROS, (0, 0))
WITHOUT_DEFECTS = DefectLists(0, np.zeros(2, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))


def body_of(patterns: Patterns, shape: Shape, origin: Shape) -> Body:
    """Return the fixed patterns of a body for a crop of ``shape`` at ``origin``, without the factor on the light."""
    electrons, sites, defects = patterns.electrons, patterns.sites_dn, (patterns.bright, patterns.dead)
    return Body(
        *(_kept(_normal_pattern, electrons, shape, origin) if electrons else WITHOUT_FACTOR),
        *(_kept(_normal_pattern, sites, shape, origin) if sites else WITHOUT_OFFSETS),
        *(_kept(_defect_lists, defects, shape, origin) if any(defects) else WITHOUT_DEFECTS),
    )


def light_factor(patterns: Patterns, body: Body, shape: Shape, origin: Shape, is_averaged: bool) -> SiteMap | None:
    """Return the factor on the light of the clean frame, as `effects.order.light_factor`; None without one.

    ``is_averaged``: the clean frame contains the fixed patterns.
    """
    if patterns.light is None:
        return SiteMap(body.response, body.response_steps) if is_averaged else None
    light: SiteMap = _kept(_radial_factor, patterns.light, shape, origin)
    if not is_averaged or not body.response_steps[0]:
        return light
    return light._replace(values=(light.values * body.response.astype(np.float64)).astype(np.float32))


# A crop's pattern is computed once for all frames and patches at its place.


def _kept(compute: Any, slot: Any, shape: Shape, origin: Shape) -> Any:
    """Return a pattern of a crop from the cache for crops of its size."""
    cached = _small if shape[0] * shape[1] <= SMALL_SITES else _large
    return cached(compute, slot, shape, origin)


def _compute(compute: Any, slot: Any, shape: Shape, origin: Shape) -> Any:
    return compute(slot, shape, origin)


_small = functools.lru_cache(maxsize=SMALL_PATTERNS)(_compute)
_large = functools.lru_cache(maxsize=LARGE_PATTERNS)(_compute)


def forget_bodies() -> None:
    """Drop the cached patterns, so that the next frame computes them, as the first frame of a body does."""
    _small.cache_clear()
    _large.cache_clear()


def _radial_factor(slot: RadialFactor, shape: Shape, origin: Shape) -> SiteMap:
    first, width = origin[1] % BLOCK, padded_width(origin[1], shape[1])
    factors = np.ones((shape[0], width), dtype=np.float32)
    factors[:, first : first + shape[1]] = illumination(slot.coefficients, slot.frame_size, shape, origin)
    return SiteMap(factors.reshape(-1), (width, 1))


def _normal_pattern(slot: NormalPattern, shape: Shape, origin: Shape) -> SiteMap:
    width = padded_width(origin[1], shape[1])
    values, quadratics = np.zeros((shape[0], width), dtype=np.float32), normal_quantiles().quadratics
    key, stream = philox_key(slot.body_key), np.uint64(purpose(slot.stream))
    numbers = slot.std, slot.mean, slot.least
    _fill_normals(key, stream, numbers, origin, shape[1], quadratics, scratch_of_thread(), values)
    return SiteMap(values.reshape(-1), (width, 1))


@kernel
def _fill_normals(
    key: PhiloxKey,
    stream: np.uint64,
    numbers: tuple[float, float, float],
    origin: Shape,
    width: int,
    quadratics: Float,
    scratch: Scratch,
    out: Float32,
) -> None:
    """Fill ``out`` with max(mean + std·n, least) for normal deviates n and ``numbers`` std, mean, least."""
    workspace, target, normal = workspace_in(scratch), pointer_to(out, 0), pointer_to(quadratics, 0)
    std, mean, least = numbers
    for y in range(out.shape[0]):
        for x in range(0, width, STRIP):
            strip = locate(origin, y, x, min(STRIP, width - x))
            fill_word_blocks(key, strip, stream, workspace.words)
            row = pointer_to(target, y * out.shape[1] + x + strip.lead)
            fill_rows(strip.total, workspace.words, workspace.scratch)
            for v in range(strip.total // VECTOR_WIDTH):
                n = np.uint64(v * VECTOR_WIDTH)
                deviate = exact_values(workspace.words, workspace.scratch, n, normal)
                store(row, n, to_float32(maximum(deviate * std + mean, least)))


# -------------------------------------------------------------------------------------------------------------- defects


def word_threshold(fraction: float) -> np.uint64:
    """Return the word below which this fraction of all words is, as in `reference.noise.is_among`."""
    return np.uint64(int(fraction * 2**32))


def _defect_lists(slots: tuple[BrightPixels | None, DeadPixels | None], shape: Shape, origin: Shape) -> DefectLists:
    bright, dead = slots
    if bright is None:
        assert dead is not None
        bright = BrightPixels(dead.body_key, dead.stream, 0.0, 0.0)
    if dead is None:
        dead = DeadPixels(bright.body_key, bright.stream, 0.0)
    key, (height, width), scratch = philox_key(bright.body_key), shape, scratch_of_thread()
    below, levels_e = (word_threshold(bright.share), word_threshold(dead.share)), bright.mean_e * exponential_levels()
    if not any(below):
        return WITHOUT_DEFECTS
    purposes = purpose(bright.stream), purpose(bright.stream, draw=1), purpose(dead.stream)
    streams = np.uint64(purposes[0]), np.uint64(purposes[1]), np.uint64(purposes[2])
    strips = max(-(-width // STRIP), 1)
    starts = np.zeros(height * strips + 1, dtype=np.int64)
    mean = (bright.share + dead.share) * height * width
    size, count = 0, max(int(mean + RARE_STDS * math.sqrt(mean)) + 8, 1)
    while size < count:
        size = count
        positions, means_e = np.empty(size, dtype=np.int64), np.empty(size)
        _list_defects(key, streams, below, levels_e, origin, width, scratch, starts, positions, means_e)
        count = int(starts[-1])
    return DefectLists(strips, starts, positions[:count], means_e[:count])


@kernel
def _list_defects(
    key: PhiloxKey,
    streams: tuple[np.uint64, np.uint64, np.uint64],
    below: tuple[np.uint64, np.uint64],
    levels_e: Float,
    origin: Shape,
    width: int,
    scratch: Scratch,
    starts: NDArray[np.int64],
    positions: NDArray[np.int64],
    means_e: Float,
) -> None:
    """List bright defects and dead pixels, strip by strip: those whose words are below two thresholds.

    ``starts`` counts all of them, also those for which the lists have no space.
    """
    workspace, count, strips = workspace_in(scratch), 0, max(-(-width // STRIP), 1)
    bright, dead, steps = workspace.words, workspace.site_words, workspace.dark_words
    for n in range(starts.size - 1):
        y, x = n // strips, n % strips * STRIP
        strip, before = locate(origin, y, x, min(STRIP, width - x)), count
        fill_word_blocks(key, strip, streams[0], bright)
        fill_word_blocks(key, strip, streams[2], dead)
        for site in range(strip.first, strip.after):
            if np.uint64(bright[site]) < below[0] or np.uint64(dead[site]) < below[1]:
                if count < positions.size:
                    positions[count] = site
                count += 1
        if count > before:
            fill_word_blocks(key, strip, streams[1], steps)
            for d in range(before, min(count, positions.size)):
                site = positions[d]
                is_dead = np.uint64(dead[site]) < below[1]
                means_e[d] = -1.0 if is_dead else levels_e[steps[site] >> np.uint32(22)]
        starts[n + 1] = count
