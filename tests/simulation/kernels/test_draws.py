"""Draws of parameters, sensor units and patches, and matrices of mixed cameras: equal to the plain definitions."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.core.random_streams import STREAMS, frame_word, philox4x32, purpose
from unprocess_gen.simulation.kernels.draws import (
    dark_frame_words,
    mixed_rgb2cam,
    parameter_uniforms,
    patch_words,
    scatter_uniforms,
)
from unprocess_gen.simulation.reference import colour

keys, epochs = st.integers(0, 2**64 - 1), st.integers(0, 2**14 - 1)
CAMERAS = tuple(colour.CAMERAS.values())


def words_of_counter(key: int, number: int, word_2: int, word_3: int = 0) -> list[int]:
    """Compute the output of the counter (0, number, word_2, word_3) with the reference."""
    counter = tuple(np.array([word], dtype=np.uint64) for word in (0, number, word_2, word_3))
    return [int(word[0]) for word in philox4x32(counter, key)]


@given(keys, st.integers(0, 50), st.integers(0, 4095), epochs)
def test_draw_n_is_the_output_of_counter_n(key: int, number: int, level: int, epoch: int) -> None:
    high, low, _, _ = words_of_counter(key, number, purpose(0, level), frame_word(0, epoch))
    assert parameter_uniforms(key, number + 1, level, epoch)[number] == ((high << 20 | low >> 12) + 0.5) / 2**52
    high, low, _, _ = words_of_counter(key, number, STREAMS["scatter"] << 24)
    assert scatter_uniforms(key, number + 1)[number] == ((high << 20 | low >> 12) + 0.5) / 2**52
    patch = words_of_counter(key, number, STREAMS["patch"] << 24, frame_word(0, epoch))
    assert patch_words(key, number + 1, epoch)[number] == patch
    assert dark_frame_words(key) == words_of_counter(key, 0, STREAMS["dark_frame"] << 24)


@given(st.lists(st.floats(1e-16, 1), min_size=4, max_size=4))
def test_the_matrix_of_a_mix_is_that_of_the_reference(uniforms: list[float]) -> None:
    w0, w1, w2, w3 = (uniform / sum(uniforms) for uniform in uniforms)
    weights = w0, w1, w2, w3
    assert mixed_rgb2cam(weights) == colour.rgb2cam(colour.mix(CAMERAS, weights))


def test_every_mix_of_the_known_cameras_is_invertible() -> None:
    """The compiled form does not check it: determinants of a dense grid of mixes are far from 0."""
    grid = [weights for weights in itertools.product(range(41), repeat=4) if sum(weights) == 40]
    matrices = np.tensordot(np.array(grid) / 40, np.array(CAMERAS), 1).reshape(-1, 3, 3)
    assert (np.linalg.det(matrices) > 0.15 * np.abs(matrices).max(axis=(1, 2)) ** 3).all()
