"""Draw the parameters of images, sensor units and patches, and compute the matrix of a mix of cameras.

Live pairs draw parameters for every crop. In Python, random words and the matrix would take a fifth of a crop of
128 x 128.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import ROUNDS
from unprocess_gen.simulation.kernels.jit import inner, kernel
from unprocess_gen.simulation.kernels.philox import KEY_STEP0, KEY_STEP1, LOW32, philox_round
from unprocess_gen.simulation.reference import colour

_12, _20, _32 = (np.uint64(number) for number in (12, 20, 32))


def draws(key: int, count: int, word_2: int, word_3: int = 0) -> tuple[NDArray[np.uint64], Float]:
    """Draw four 32-bit words [N, 4] from each counter (0, n, word_2, word_3), and a uniform deviate [N] from two.

    It is (k + ½)·2**-52 with a 52-bit integer k. Draw n does not depend on ``count``: add new ones at the end, never
    renumber. Words 2 and 3 are a `purpose` and a `frame_word`.
    """
    words, uniforms = np.empty((count, 4), dtype=np.uint64), np.empty(count)
    _fill_draws(np.uint64(key), word_2, word_3, words, uniforms)
    return words, uniforms


@kernel
def _fill_draws(key: np.uint64, word_2: int, word_3: int, words: NDArray[np.uint64], uniforms: Float) -> None:
    for n in range(uniforms.size):
        c0, c1, c2, c3 = np.uint64(0), np.uint64(n), np.uint64(word_2), np.uint64(word_3)
        k0, k1 = key & LOW32, key >> _32
        for _ in range(ROUNDS):
            c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
            k0, k1 = (k0 + KEY_STEP0) & LOW32, (k1 + KEY_STEP1) & LOW32
        first, second = c0 & LOW32, c1 & LOW32
        words[n, 0], words[n, 1], words[n, 2], words[n, 3] = first, second, c2 & LOW32, c3 & LOW32
        uniforms[n] = (np.float64(first << _20 | second >> _12) + 0.5) * 2.0**-52


_multiply, _unit_row = inner(colour.multiply), inner(colour.unit_row)
_CAMERAS, _RGB2XYZ = tuple(colour.CAMERAS.values()), colour.RGB2XYZ


@kernel
def mixed_rgb2cam(weights: tuple[float, float, float, float]) -> colour.Matrix:
    """Return `reference.colour.rgb2cam` of the `colour.mix` of the known cameras, all of whose mixes are invertible."""
    a = b = c = d = e = f = g = h = i = 0.0
    for n in range(4):
        weight, matrix = weights[n], _CAMERAS[n]
        a, b, c = a + weight * matrix[0], b + weight * matrix[1], c + weight * matrix[2]
        d, e, f = d + weight * matrix[3], e + weight * matrix[4], f + weight * matrix[5]
        g, h, i = g + weight * matrix[6], h + weight * matrix[7], i + weight * matrix[8]
    a, b, c, d, e, f, g, h, i = _multiply((a, b, c, d, e, f, g, h, i), _RGB2XYZ)
    rows: colour.Matrix = _unit_row(a, b, c) + _unit_row(d, e, f) + _unit_row(g, h, i)
    return rows
