"""Convert random words to noise (NumPy, float64): shared mathematics of the effects.

Each value is computed from one random word by inverting a distribution function, so values do not depend on the order
or the tiles.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import Words
from unprocess_gen.simulation.lookup_tables import SEGMENTS, normal_table


def by_inverse_cdf(uniforms: Words, table: Float) -> Float:
    """Convert random words to deviates of a symmetric distribution by inverse CDF, with a table of [1024, 3].

    The top bit of a word is the sign, the other 31 bits are an index i; the tail probability is (i + ½) / 2**32. The
    float64 bits of j = 2i + 1 contain octave, segment and position in the segment, which saves a logarithm.
    """
    j = ((uniforms & np.uint32(0x7FFFFFFF)).astype(np.uint64) << np.uint64(1) | np.uint64(1)).astype(np.float64)
    mantissa, exponent = np.frexp(j)
    position = (2 * mantissa - 1) * SEGMENTS
    segment = np.floor(position)
    row = table[((exponent - 1) * SEGMENTS + segment.astype(np.int32))]
    t = (position - segment) / SEGMENTS
    z = row[..., 0] + t * (row[..., 1] + t * row[..., 2])
    return np.asarray(np.where(uniforms >> np.uint32(31), -z, z))


def normals(uniforms: Words) -> Float:
    """Convert random words to standard normal deviates: at most 6.34 in magnitude, with an error below 1.5e-7."""
    return by_inverse_cdf(uniforms, normal_table())


def is_among(uniforms: Words, fraction: float) -> np.ndarray:
    """Return a mask of the random words that select a ``fraction`` of all pixels."""
    return np.asarray(uniforms < np.uint64(int(fraction * 2**32)))


def autoregressive(independent: Float, correlation: float) -> Float:
    """Return a process of order 1 in which neighbours have a correlation, with the variance of independent values."""
    share = math.sqrt(1 - correlation * correlation)
    correlated = itertools.accumulate(independent.tolist(), lambda last, n: correlation * last + share * n)
    return np.array(list(correlated))
