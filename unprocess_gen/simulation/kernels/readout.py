"""Convert noisy DN in float64 to the sensor's integers, and count clipped sites and sites without variance."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.types import Float, Raw
from unprocess_gen.simulation.kernels.clean import PairParameters
from unprocess_gen.simulation.kernels.rounding import ROUND, low_16_bits
from unprocess_gen.simulation.kernels.simd import Pointer


@inner
def read_out(
    unrounded_dn: Float,
    noisy_dn: Float,
    parameters: PairParameters,
    limits_dn: tuple[float, float],
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Pin saturated sites if the plan asks for it, then round, clip and count; all arrays ``[n]``.

    Overwrites pinned values of ``noisy_dn``.
    """
    if parameters.pinned_dn < np.inf:
        for x in range(unrounded_dn.shape[0]):
            noisy_dn[x] = parameters.pinned_dn if unrounded_dn[x] >= parameters.pinned_dn else noisy_dn[x]
    round_and_clip(noisy_dn, limits_dn, noisy, counts)
    line = parameters.variance_line[0], parameters.variance_line[1], parameters.levels_dn[0]
    counts[5] += count_zero_variance((0, unrounded_dn.shape[0]), line, unrounded_dn)


@inner
def round_and_clip(noisy_dn: Float, limits_dn: tuple[float, float], noisy: Raw, counts: NDArray[np.int64]) -> None:
    """Round half to even, clip to ``limits_dn``, cast to uint16, and count the clipped sites."""
    low, high = limits_dn[0] + ROUND, limits_dn[1] + ROUND
    below, above = 0, 0
    for x in range(noisy.shape[0]):
        rounded = noisy_dn[x] + ROUND
        below += rounded < low
        above += rounded > high
        noisy[x] = low_16_bits(min(max(rounded, low), high))
    counts[2] += below
    counts[3] += above


@inner
def count_zero_variance(valid: tuple[int, int], line: tuple[Any, Any, Any], clean_dn: Pointer) -> int:
    """Count sites ``valid[0]`` to ``valid[1]`` with a·(clean - black) + b <= 0; ``line`` is a, b and black."""
    a, b, black = line
    count = 0
    if min(a, b) <= 0.0:
        for x in range(valid[0], valid[1]):
            count += a * (clean_dn[x] - black) + b <= 0.0
    return count
