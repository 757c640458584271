"""Prepare the fixed patterns of a camera body once for all of its frames: PRNU, and hot and dead pixels."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import kernel
from unprocess_gen.core.lookup_tables import exponential_levels
from unprocess_gen.core.random_streams import BLOCK, purpose
from unprocess_gen.core.types import Float, Plan
from unprocess_gen.simulation.kernels.normal import exact_values, fill_rows, normal_quantiles
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_word_blocks, philox_key
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, maximum, pointer_to, store, to_float32
from unprocess_gen.simulation.kernels.strips import (
    ONES,
    STRIP,
    Float32,
    Scratch,
    locate,
    padded_width,
    scratch_of_thread,
    workspace_in,
)
from unprocess_gen.simulation.reference.noise import illumination_of_lens

PRNU, HOT, DEAD = (np.uint64(purpose(stream)) for stream in ("prnu", "hot_pixels", "dead_pixels"))
HOT_STEP = np.uint64(purpose("hot_pixels", draw=1))

SMALL_SITES, SMALL_CROPS, LARGE_CROPS = 2**16, 128, 2
"""Patterns are kept for the last crops of up to this many sites (0.4 MB each), and for the last larger ones.

Lens shading is kept for as many crops (0.3 MB each), and for the last larger one.
"""


class Body(NamedTuple):
    """Hold the fixed patterns of a body for a crop of H rows in S strips each.

    Attributes
    ----------
    response : ndarray of float32, [H * P]
        Relative gain of each pixel; the columns are those of complete blocks. ``[SIZE]`` ones without PRNU.
    response_steps : (int, int)
        Elements of ``response`` from row to row and from column to column; 0 without PRNU.
    strips : int
        S; 0 without defects.
    starts : ndarray of int64, [H * S + 1]
        First defect of each strip.
    positions : ndarray of int64
        Index of each defect in the buffers of its strip.
    means_e : ndarray of float64
        Mean excess of a hot pixel, electrons; negative for a dead pixel.
    """

    response: Float32
    response_steps: tuple[int, int]
    strips: int
    starts: NDArray[np.int64]
    positions: NDArray[np.int64]
    means_e: Float


class FixedPatterns(NamedTuple):
    """Hold the key of a body and the numbers of its patterns, 0 for effects that a plan does not simulate."""

    key: int
    prnu_std: float
    hot_share: float
    hot_e: float
    dead_share: float


WITHOUT_PATTERNS = Body(ONES, (0, 0), 0, np.zeros(2, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))


def body_of(plan: Plan, shape: tuple[int, int], origin: tuple[int, int]) -> Body:
    """Return the fixed patterns that a plan simulates, for a crop of ``shape`` at ``origin``."""
    patterns = fixed_patterns(plan)
    if not any(patterns[1:]):
        return WITHOUT_PATTERNS
    body = _small_body if shape[0] * shape[1] <= SMALL_SITES else _large_body
    return body(patterns, shape, origin)


def fixed_patterns(plan: Plan) -> FixedPatterns:
    """Return the fixed patterns that a plan simulates."""
    physics, on = plan.physics, plan.effects
    if physics is None:
        return FixedPatterns(0, 0.0, 0.0, 0.0, 0.0)
    return FixedPatterns(
        physics.body_key,
        physics.prnu_std if "prnu" in on else 0.0,
        physics.hot_pixel_share if "hot_pixels" in on else 0.0,
        physics.hot_pixel_e if "hot_pixels" in on else 0.0,
        physics.dead_pixel_share if "dead_pixels" in on else 0.0,
    )


class Response(NamedTuple):
    """Hold factors of the light of each pixel, as `Body.response` and `Body.response_steps`."""

    factors: Float32
    steps: tuple[int, int]


def clean_response(plan: Plan, body: Body, shape: tuple[int, int], origin: tuple[int, int]) -> Response | None:
    """Return by what the light of the clean frame is multiplied, as `reference.noise.light_factor`."""
    physics = plan.physics
    if physics is None or "lens_shading" not in plan.effects:
        return Response(body.response, body.response_steps) if plan.averaged else None
    shading = _small_shading if shape[0] * shape[1] <= SMALL_SITES else _large_shading
    factors = shading(physics.lens_shading, physics.frame_size, shape, origin)
    if plan.averaged and body.response_steps[0]:
        factors = (factors * body.response.astype(np.float64)).astype(np.float32)
    return Response(factors, (padded_width(origin[1], shape[1]), 1))


def _shading(
    coefficients: tuple[float, float, float],
    frame_size: tuple[int, int],
    shape: tuple[int, int],
    origin: tuple[int, int],
) -> Float32:
    """Return the relative illumination of each pixel, as `Body.response`."""
    first = origin[1] % BLOCK
    factors = np.ones((shape[0], padded_width(origin[1], shape[1])), dtype=np.float32)
    factors[:, first : first + shape[1]] = illumination_of_lens(coefficients, frame_size, shape, origin)
    return factors.reshape(-1)


_small_shading = functools.lru_cache(maxsize=SMALL_CROPS)(_shading)
_large_shading = functools.lru_cache(maxsize=1)(_shading)


def forget_bodies() -> None:
    """Drop the cached patterns, so that the next frame computes them, as the first frame of a body does."""
    for cached in (_small_body, _large_body, _small_shading, _large_shading):
        cached.cache_clear()


def _body(patterns: FixedPatterns, shape: tuple[int, int], origin: tuple[int, int]) -> Body:
    key, scratch, (height, width) = philox_key(patterns.key), scratch_of_thread(), shape
    response, pitch = ONES, 0
    if patterns.prnu_std:
        pitch = padded_width(origin[1], width)
        response = np.zeros((height, pitch), dtype=np.float32)
        _fill_response(key, patterns.prnu_std, origin, width, normal_quantiles().quadratics, scratch, response)
    body = WITHOUT_PATTERNS._replace(response=response.reshape(-1), response_steps=(pitch, int(pitch > 0)))
    below = word_threshold(patterns.hot_share), word_threshold(patterns.dead_share)
    if not any(below):
        return body
    strips = max(-(-width // STRIP), 1)
    starts = np.zeros(height * strips + 1, dtype=np.int64)
    size, found = 0, _expected_defects(patterns, height * width)
    while size < found:
        size, levels = found, exponential_levels()
        positions, means_e = np.empty(size, dtype=np.int64), np.empty(size)
        _list_defects(key, below, patterns.hot_e, levels, origin, width, scratch, starts, positions, means_e)
        found = int(starts[-1])
    return body._replace(strips=strips, starts=starts, positions=positions[:found], means_e=means_e[:found])


_small_body = functools.lru_cache(maxsize=SMALL_CROPS)(_body)
_large_body = functools.lru_cache(maxsize=LARGE_CROPS)(_body)


def _expected_defects(patterns: FixedPatterns, sites: int) -> int:
    """Return a number of defects that is rarely exceeded: six standard deviations above the mean."""
    mean = (patterns.hot_share + patterns.dead_share) * sites
    return int(mean + 6 * math.sqrt(mean)) + 8


def word_threshold(fraction: float) -> np.uint64:
    """Return the word below which this fraction of all words is, as in `reference.noise.is_among`."""
    return np.uint64(int(fraction * 2**32))


@kernel
def _list_defects(
    key: PhiloxKey,
    below: tuple[np.uint64, np.uint64],
    hot_e: float,
    levels: Float,
    origin: tuple[int, int],
    width: int,
    scratch: Scratch,
    starts: NDArray[np.int64],
    positions: NDArray[np.int64],
    means_e: Float,
) -> None:
    """List hot and dead pixels, strip by strip: those whose words are below two thresholds.

    ``starts`` counts all of them, also those for which the lists have no space.
    """
    workspace, found, strips = workspace_in(scratch), 0, max(-(-width // STRIP), 1)
    hot, dead, steps = workspace.words, workspace.read_words, workspace.dark_words
    for n in range(starts.size - 1):
        y, x = n // strips, n % strips * STRIP
        strip, before = locate(origin, y, x, min(STRIP, width - x)), found
        if below[0] > 0:  # otherwise any word will do
            fill_word_blocks(key, strip, HOT, hot)
        if below[1] > 0:
            fill_word_blocks(key, strip, DEAD, dead)
        for at in range(strip.first, strip.after):
            if np.uint64(hot[at]) < below[0] or np.uint64(dead[at]) < below[1]:
                if found < positions.size:
                    positions[found] = at
                found += 1
        if found > before:
            fill_word_blocks(key, strip, HOT_STEP, steps)
            for d in range(before, min(found, positions.size)):
                at = positions[d]
                is_dead = np.uint64(dead[at]) < below[1]
                means_e[d] = -1.0 if is_dead else hot_e * levels[steps[at] >> np.uint32(22)]
        starts[n + 1] = found


@kernel
def _fill_response(
    key: PhiloxKey,
    prnu_std: float,
    origin: tuple[int, int],
    width: int,
    quadratics: Float,
    scratch: Scratch,
    out: Float32,
) -> None:
    """Fill ``out`` with 1 plus normal deviates of standard deviation ``prnu_std``, but at least 0."""
    workspace, target, normal = workspace_in(scratch), pointer_to(out, 0), pointer_to(quadratics, 0)
    for y in range(out.shape[0]):
        for x in range(0, width, STRIP):
            strip = locate(origin, y, x, min(STRIP, width - x))
            fill_word_blocks(key, strip, PRNU, workspace.words)
            row = pointer_to(target, y * out.shape[1] + x + strip.lead)
            fill_rows(strip.total, workspace.words, workspace.scratch)
            for v in range(strip.total // VECTOR_WIDTH):
                at = np.uint64(v * VECTOR_WIDTH)
                deviate = exact_values(workspace.words, workspace.scratch, at, normal)
                store(row, at, to_float32(maximum(deviate * prnu_std + 1.0, 0.0)))
