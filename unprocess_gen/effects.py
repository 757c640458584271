"""What a sensor adds to the clean frame, as reference forms: NumPy, float64, in the order light meets them.

A profile that has only two numbers offers one effect, ``heteroscedastic``: shot and read noise as one Gaussian whose
variance is a line in the signal (Foi et al. 2008; the article, section 2). Its normals come by inversion of the normal
distribution function from counted uniforms: one uniform, one normal, in any order and by any tile.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.records import Float, Plan
from unprocess_gen.streams import Words, words
from unprocess_gen.tables import SEGMENTS, normal_table


def normals(uniforms: Words) -> Float:
    """Map uint32 words to standard normals by inverse CDF, same shape, float64, |z| up to 6.34.

    The top bit is the sign, the other 31 an index i; the tail probability is (i + ½) / 2**32. Error below 1.5e-7.
    The bits of j = 2i + 1 as a double are octave, segment and position in the segment, which spares a logarithm.
    """
    j = ((uniforms & np.uint32(0x7FFFFFFF)).astype(np.uint64) << np.uint64(1) | np.uint64(1)).astype(np.float64)
    mantissa, exponent = np.frexp(j)
    position = (2 * mantissa - 1) * SEGMENTS
    segment = np.floor(position)
    row = normal_table()[((exponent - 1) * SEGMENTS + segment.astype(np.int32))]
    t = (position - segment) / SEGMENTS
    z = row[..., 0] + t * (row[..., 1] + t * row[..., 2])
    return np.asarray(np.where(uniforms >> np.uint32(31), -z, z))


def noise_variance(clean_dn: Float, plan: Plan) -> Float:
    """Return max(0, a·(x - black) + b) in DN², ``[H, W]``, of the unrounded clean frame x."""
    return np.asarray(np.maximum(plan.a_dn * (clean_dn - plan.black_level_dn) + plan.b_dn2, 0))


def heteroscedastic(clean_dn: Float, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Float:
    """Add Gaussian noise of `noise_variance` to the unrounded clean frame, ``[H, W]`` DN, not clipped."""
    shape = (clean_dn.shape[0], clean_dn.shape[1])
    n = normals(words(plan.stream_key, "heteroscedastic", shape, origin=origin))
    return clean_dn + np.sqrt(noise_variance(clean_dn, plan)) * n
