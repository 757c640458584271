"""Draw random values in kernels for frames in float32, bit for bit as `reference.noise` does in NumPy.

Approximate normals suffice where a value is rounded to the same DN (`gaussian`, `physical`). Frames in float32 are not
rounded, so they use the formulas of `reference.noise` in float64. Only what NumPy is slow at is compiled: Philox, the
inverse distribution function, Poisson counts. All accuracy tiers therefore give the same bytes.

NumPy passes over an array once per operation. So frames are processed in pieces that stay in a core's cache, and the
unrounded clean frame exists only one band at a time.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from unprocess_gen.core.jit import kernel
from unprocess_gen.core.random_streams import BLOCK, Words, purpose
from unprocess_gen.core.types import Float
from unprocess_gen.simulation.kernels.normal import QuantileTables, exact_value, normal_quantile_tables
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_segment_words, philox_key
from unprocess_gen.simulation.kernels.poisson import CountBuffers, allocate_count_buffers, fill_counts
from unprocess_gen.simulation.kernels.segments import LONG_SEGMENT
from unprocess_gen.simulation.reference.noise import Draws
from unprocess_gen.simulation.reference.poisson import Tables, poisson_tables

BAND_SITES, PIECE_SITES = 2**20, 2**16
"""Sites whose clean frame is computed at a time (8 MB of float64), and sites that noise is added to at a time."""


def row_bands(shape: tuple[int, ...], sites: int) -> Iterator[slice]:
    """Yield the rows of a frame ``[H, W]`` or ``[H, W, 3]`` from top to bottom, in bands of about ``sites`` sites.

    Each band begins at an even row and has at least two rows, except the last one of an odd height.
    """
    height, width = shape[:2]
    rows = 2 * max(1, sites // (2 * max(width, 1)))
    return (slice(top, min(top + rows, height)) for top in range(0, height, rows))


def words(
    key: int,
    stream: str,
    shape: tuple[int, int],
    *,
    origin: tuple[int, int] = (0, 0),
    frame: int = 0,
    level: int = 0,
    draw: int = 0,
) -> Words:
    """Return the random words of a stream, uint32 ``[H, W]``: equal to `random_streams.words`."""
    out = np.empty(shape, dtype=np.uint32)
    _fill_words(philox_key(key, frame=frame), np.uint64(purpose(stream, level, draw)), origin, out)
    return out


def by_inverse_cdf(uniforms: Words, table: Float) -> Float:
    """Return the quantiles of words ``[H, W]`` in a table of quadratics: equal to `noise.by_inverse_cdf`."""
    out = np.empty(uniforms.shape)
    _fill_by_inverse_cdf(uniforms, tuple(np.ascontiguousarray(column) for column in table.T), out)
    return out


def poisson(uniforms: Words, rate: Float) -> Float:
    """Return Poisson counts of mean ``rate``, both ``[H, W]``: equal to `reference.poisson.poisson`."""
    out = np.empty(uniforms.shape)
    tables, buffers = poisson_tables(), allocate_count_buffers(LONG_SEGMENT)
    _fill_poisson(uniforms, np.ascontiguousarray(rate), normal_quantile_tables(), tables, buffers, out)
    return out


KERNEL_DRAWS = Draws(words, by_inverse_cdf, poisson)


@kernel
def _fill_words(key: PhiloxKey, purpose_word: np.uint64, origin: tuple[int, int], out: Words) -> None:
    """Fill ``out`` with the words of a stream."""
    height, width = out.shape
    buffer = np.empty(LONG_SEGMENT + BLOCK, dtype=np.uint32)
    for y in range(height):
        for start in range(0, width, LONG_SEGMENT):
            n = min(LONG_SEGMENT, width - start)
            offset = fill_segment_words(key, (origin[0] + y, origin[1] + start), purpose_word, n, buffer)
            for x in range(n):
                out[y, start + x] = buffer[offset + x]


@kernel
def _fill_by_inverse_cdf(uniforms: Words, quadratics: tuple[Float, Float, Float], out: Float) -> None:
    """Fill ``out`` with the exact quantiles of words."""
    height, width = out.shape
    for y in range(height):
        for x in range(width):
            out[y, x] = exact_value(uniforms[y, x], quadratics)


@kernel
def _fill_poisson(
    uniforms: Words, rates: Float, normal: QuantileTables, tables: Tables, buffers: CountBuffers, out: Float
) -> None:
    """Fill ``out`` with Poisson counts, in segments of `LONG_SEGMENT` sites."""
    height, width = out.shape
    for y in range(height):
        for start in range(0, width, LONG_SEGMENT):
            end = min(start + LONG_SEGMENT, width)
            fill_counts(uniforms[y, start:end], rates[y, start:end], normal, tables, buffers, out[y, start:end])


NORMAL_KERNELS, COUNT_KERNELS = (_fill_words, _fill_by_inverse_cdf), (_fill_poisson,)
"""Kernels that every frame in float32 needs, and those that noise made of counts needs in addition."""
