"""Prepare the fixed patterns of a camera body once for all of its frames: PRNU, and hot and dead pixels."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import kernel
from unprocess_gen.core.lookup_tables import exponential_levels
from unprocess_gen.core.random_streams import Words, purpose
from unprocess_gen.core.types import Float, Plan
from unprocess_gen.simulation.kernels.normal import exact_value, normal_quantiles
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_word_blocks, philox_key
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, pointer_to
from unprocess_gen.simulation.kernels.strips import (
    SIZE,
    STRIP,
    Float32,
    Scratch,
    lead_of,
    locate,
    padded_width,
    scratch_of_thread,
    workspace_in,
)

PRNU, HOT, DEAD = (np.uint64(purpose(stream)) for stream in ("prnu", "hot_pixels", "dead_pixels"))
HOT_STEP = np.uint64(purpose("hot_pixels", draw=1))

BAND_SITES = 2**20
"""Sites whose words are compared at a time when defects are located."""


class Body(NamedTuple):
    """Hold the fixed patterns of a body for a crop of H rows in S strips each.

    Attributes
    ----------
    response : ndarray of float32, [H * P]
        Relative gain of each pixel; the columns are those of complete blocks. ``[SIZE]`` ones without PRNU.
    response_steps : (int, int)
        Elements of ``response`` from row to row and from column to column; 0 without PRNU.
    strips : int
        S.
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


def body_of(plan: Plan, shape: tuple[int, int], origin: tuple[int, int]) -> Body:
    """Return the fixed patterns that a plan simulates, for a crop of ``shape`` at ``origin``."""
    return _body(fixed_patterns(plan), shape, origin)


_Patterns = tuple[int, float, float, float, float]


def fixed_patterns(plan: Plan) -> _Patterns:
    """Return the key of the body and the numbers of its patterns, 0 for effects that the plan does not simulate.

    The numbers are the standard deviation of PRNU, the share and mean of hot pixels, and the share of dead ones.
    """
    physics, on = plan.physics, plan.effects
    if physics is None:
        return 0, 0.0, 0.0, 0.0, 0.0
    return (
        physics.body_key,
        physics.prnu_std if "prnu" in on else 0.0,
        physics.hot_pixel_share if "hot_pixels" in on else 0.0,
        physics.hot_pixel_e if "hot_pixels" in on else 0.0,
        physics.dead_pixel_share if "dead_pixels" in on else 0.0,
    )


def forget_bodies() -> None:
    """Drop the cached patterns, so that the next frame computes them, as the first frame of a body does."""
    _body.cache_clear()


@functools.lru_cache(maxsize=2)
def _body(patterns: _Patterns, shape: tuple[int, int], origin: tuple[int, int]) -> Body:
    key, prnu_std, hot_share, hot_e, dead_share = patterns
    response, pitch = np.ones(SIZE, dtype=np.float32), 0
    if prnu_std != 0:
        pitch = padded_width(origin[1], shape[1])
        response = np.zeros((shape[0], pitch), dtype=np.float32)
        _fill_response(
            philox_key(key), prnu_std, origin, shape[1], normal_quantiles().quadratics, scratch_of_thread(), response
        )
    strips = max(-(-shape[1] // STRIP), 1)
    y, x, means_e = _defects(key, hot_share, hot_e, dead_share, shape, origin)
    starts = np.searchsorted(y * strips + x // STRIP, np.arange(shape[0] * strips + 1))
    first = origin[1] % VECTOR_WIDTH
    return Body(
        response.reshape(-1), (pitch, int(pitch > 0)), strips, starts.astype(np.int64), x % STRIP + first, means_e
    )


def _defects(
    key: int, hot_share: float, hot_e: float, dead_share: float, shape: tuple[int, int], origin: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
    """Return the rows, columns and means (`Body.means_e`) of hot and dead pixels, row by row."""
    hot_below, dead_below = word_threshold(hot_share), word_threshold(dead_share)
    empty = np.zeros(0, dtype=np.int64)
    found = [(empty, empty, np.zeros(0))]
    rows = max(1, BAND_SITES // max(shape[1], 1))
    for top in range(0, shape[0] if hot_below or dead_below else 0, rows):
        at, size = (origin[0] + top, origin[1]), (min(rows, shape[0] - top), shape[1])
        dead = _words(key, DEAD, at, size) < dead_below if dead_below else np.zeros(size, dtype=np.bool_)
        hot = _words(key, HOT, at, size) < hot_below if hot_below else np.zeros(size, dtype=np.bool_)
        y, x = np.nonzero(hot | dead)
        steps = (
            _words(key, HOT_STEP, at, size)[y, x] >> np.uint32(22) if hot_below else np.zeros(len(y), dtype=np.uint32)
        )
        found.append((y + top, x, np.where(dead[y, x], -1.0, hot_e * exponential_levels()[steps])))
    y, x, means_e = (np.concatenate(column) for column in zip(*found, strict=True))
    return y, x, means_e


def word_threshold(fraction: float) -> np.uint64:
    """Return the word below which this fraction of all words is, as in `reference.noise.is_among`."""
    return np.uint64(int(fraction * 2**32))


def _words(key: int, purpose_word: np.uint64, origin: tuple[int, int], shape: tuple[int, int]) -> Words:
    out = np.empty(shape, dtype=np.uint32)
    _fill_words(philox_key(key), purpose_word, origin, scratch_of_thread(), out)
    return out


@kernel
def _fill_words(key: PhiloxKey, purpose_word: np.uint64, origin: tuple[int, int], scratch: Scratch, out: Words) -> None:
    """Fill ``out`` with the words of a stream."""
    height, width = out.shape
    buffers, target = workspace_in(scratch, lead_of(origin)), pointer_to(out, 0)
    for y in range(height):
        for x in range(0, width, STRIP):
            strip = locate(origin, y, x, min(STRIP, width - x))
            fill_word_blocks(key, strip, purpose_word, buffers.words)
            for n in range(strip.length):
                target[y * width + x + n] = buffers.words[strip.first + n]


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
    buffers, target, normal = workspace_in(scratch, lead_of(origin)), pointer_to(out, 0), pointer_to(quadratics, 0)
    for y in range(out.shape[0]):
        for x in range(0, width, STRIP):
            strip = locate(origin, y, x, min(STRIP, width - x))
            fill_word_blocks(key, strip, PRNU, buffers.words)
            row = pointer_to(target, y * out.shape[1] + x + strip.lead)
            for n in range(strip.total):
                buffers.exact_dn[n] = exact_value(buffers.words[n], normal)
            for n in range(strip.total):
                row[n] = np.float32(max(1 + prnu_std * buffers.exact_dn[n], 0.0))
