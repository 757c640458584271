"""What frames in float32 are made with: draws of compiled code, the same to the last bit as the readable ones.

Whole DN forgive: a normal need not be known to the last bit where it rounds to the same DN, and the kernels of `fused`
and `electrons` live on that. A frame that is not rounded forgives nothing. So it is made by the formulas of `effects`
as they stand, in float64, and only what they are slow at is compiled: Philox, the inverse of a distribution function,
Poisson counts. Then all tiers give the same bytes, cast once at the end.

NumPy goes over an array once for each operation, so frames are worked through in pieces that stay in the cache of a
core, and the unrounded clean frame is made in bands, so that it never stands in memory as a whole.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from unprocess_gen.core.jit import kernel
from unprocess_gen.core.random_streams import BLOCK, Words, purpose
from unprocess_gen.core.types import Float
from unprocess_gen.simulation.kernels.gaussian import CHUNK, Key, fill_words, key_words
from unprocess_gen.simulation.kernels.normal import Quantiles, exact_normal, normal_quantiles
from unprocess_gen.simulation.kernels.poisson import Counting, room_for
from unprocess_gen.simulation.kernels.poisson import draw as draw_counts
from unprocess_gen.simulation.reference.noise import Draws
from unprocess_gen.simulation.reference.poisson import Tables, poisson_tables

BAND, PIECE = 2**20, 2**16
"""Sites unprocessed at once: 8 MB of float64; and those that noise is added to: half a megabyte."""


def bands(shape: tuple[int, ...], sites: int) -> Iterator[slice]:
    """Yield the rows of a frame ``[H, W]`` or ``[H, W, 3]``, top to bottom, in bands of about so many sites.

    Each begins at an even row: two rows at least, but for the last one of an odd height.
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
    """Return what `streams.words` does."""
    out = np.empty(shape, dtype=np.uint32)
    _words(key_words(key, frame=frame), np.uint64(purpose(stream, level, draw)), origin, out)
    return out


def by_inverse_cdf(uniforms: Words, table: Float) -> Float:
    """Return what `effects.by_inverse_cdf` does."""
    out = np.empty(uniforms.shape)
    _by_inverse_cdf(uniforms, tuple(np.ascontiguousarray(column) for column in table.T), out)
    return out


def poisson(uniforms: Words, rate: Float) -> Float:
    """Return what `poisson.poisson` does."""
    out = np.empty(uniforms.shape)
    _poisson(uniforms, np.ascontiguousarray(rate), normal_quantiles(), poisson_tables(), room_for(CHUNK), out)
    return out


COMPILED_DRAWS = Draws(words, by_inverse_cdf, poisson)


@kernel
def _words(key: Key, purpose_word: np.uint64, origin: tuple[int, int], out: Words) -> None:
    height, width = out.shape
    run = np.empty(CHUNK + BLOCK, dtype=np.uint32)
    for y in range(height):
        for start in range(0, width, CHUNK):
            n = min(CHUNK, width - start)
            offset = fill_words(key, (origin[0] + y, origin[1] + start), purpose_word, n, run)
            for x in range(n):
                out[y, start + x] = run[offset + x]


@kernel
def _by_inverse_cdf(uniforms: Words, quadratics: tuple[Float, Float, Float], out: Float) -> None:
    height, width = out.shape
    for y in range(height):
        for x in range(width):
            out[y, x] = exact_normal(uniforms[y, x], quadratics)


@kernel
def _poisson(uniforms: Words, rates: Float, normal: Quantiles, tables: Tables, room: Counting, out: Float) -> None:
    height, width = out.shape
    for y in range(height):
        for start in range(0, width, CHUNK):
            end = min(start + CHUNK, width)
            draw_counts(uniforms[y, start:end], rates[y, start:end], normal, tables, room, out[y, start:end])


OF_NORMALS, OF_COUNTS = (_words, _by_inverse_cdf), (_poisson,)
"""The kernels that every frame in float32 takes, and those that noise made of counts takes beside them."""
