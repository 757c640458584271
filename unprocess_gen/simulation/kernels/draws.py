"""Draw the parameters of images, sensor units and patches, and compute the matrix of a mix of cameras.

Live pairs draw parameters for every crop. In Python, random words and the matrix would take a fifth of a crop of
128 x 128.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import DARK_FRAME, PARAMETERS, PATCH, ROUNDS, SCATTER, frame_word, purpose
from unprocess_gen.simulation.kernels.jit import inner, kernel
from unprocess_gen.simulation.kernels.philox import KEY_STEP0, KEY_STEP1, LOW32, PhiloxKey, philox_round
from unprocess_gen.simulation.reference import colour

_12, _20, _32 = (np.uint64(number) for number in (12, 20, 32))


def parameter_uniforms(key: int, count: int, level: int = 0, epoch: int = 0) -> list[float]:
    """Draw uniform deviates (k + ½)·2**-52 with a 52-bit integer k, for the first ``count`` parameters of an image.

    Parameter n uses counter (0, n) of the stream ``parameters``: add new parameters at the end, never renumber.
    """
    return _uniforms(key, count, purpose(PARAMETERS, level), frame_word(0, epoch))


def scatter_uniforms(key: int, count: int) -> list[float]:
    """Draw uniform deviates as `parameter_uniforms`, for the numbers of a sensor unit with `body_key` ``key``.

    Number n uses counter n of the stream ``scatter``: add new numbers at the end, never renumber.
    """
    return _uniforms(key, count, purpose(SCATTER), 0)


def patch_words(key: int, count: int, epoch: int = 0) -> list[list[int]]:
    """Draw four 32-bit words for each of the first ``count`` patches of an image, of which two are used.

    Patch n uses counter (0, n) of the stream ``patch``, so that a larger ``count`` does not move the first patches.
    """
    return _words(key, count, purpose(PATCH), frame_word(0, epoch))


def dark_frame_words(key: int) -> list[int]:
    """Draw four 32-bit words, of which three choose a dark frame, its row and its column."""
    return _words(key, 1, purpose(DARK_FRAME), 0)[0]


def _words(key: int, count: int, word_2: int, word_3: int) -> list[list[int]]:
    """Return the four output words of each counter (0, n, word_2, word_3)."""
    words = np.empty((count, 4), dtype=np.uint64)
    _fill_words(np.uint64(key), word_2, word_3, words)
    outputs: list[list[int]] = words.tolist()
    return outputs


def _uniforms(key: int, count: int, word_2: int, word_3: int) -> list[float]:
    """Return the uniform deviate of the first two output words of each counter (0, n, word_2, word_3)."""
    uniforms = np.empty(count)
    _fill_uniforms(np.uint64(key), word_2, word_3, uniforms)
    deviates: list[float] = uniforms.tolist()
    return deviates


@inner
def _outputs(key: np.uint64, number: int, word_2: int, word_3: int) -> PhiloxKey:
    c0, c1, c2, c3 = np.uint64(0), np.uint64(number), np.uint64(word_2), np.uint64(word_3)
    k0, k1 = key & LOW32, key >> _32
    for _ in range(ROUNDS):
        c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
        k0, k1 = (k0 + KEY_STEP0) & LOW32, (k1 + KEY_STEP1) & LOW32
    return c0 & LOW32, c1 & LOW32, c2 & LOW32, c3 & LOW32


@kernel
def _fill_words(key: np.uint64, word_2: int, word_3: int, out: NDArray[np.uint64]) -> None:
    for n in range(out.shape[0]):
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = _outputs(key, n, word_2, word_3)


@kernel
def _fill_uniforms(key: np.uint64, word_2: int, word_3: int, out: Float) -> None:
    for n in range(out.size):
        first, second, _, _ = _outputs(key, n, word_2, word_3)
        out[n] = (np.float64(first << _20 | second >> _12) + 0.5) * 2.0**-52


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
