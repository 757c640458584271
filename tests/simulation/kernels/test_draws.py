"""Draws of parameters, sensor units and patches, and matrices of mixed cameras: equal to the plain definitions."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.core.random_streams import DARK_FRAME, PARAMETERS, PATCH, SCATTER, frame_word, philox4x32, purpose
from unprocess_gen.simulation.kernels.draws import draws, mixed_rgb2cam
from unprocess_gen.simulation.reference import colour

keys, epochs = st.integers(0, 2**64 - 1), st.integers(0, 2**14 - 1)
CAMERAS = tuple(colour.CAMERAS.values())


@given(keys, st.integers(0, 50), st.integers(0, 4095), epochs)
def test_draw_n_is_the_output_of_counter_n(key: int, number: int, level: int, epoch: int) -> None:
    for stream in (PARAMETERS, PATCH, SCATTER, DARK_FRAME):
        counter = 0, number, purpose(stream, level), frame_word(0, epoch)
        expected = [int(word[0]) for word in philox4x32(tuple(np.array([word], np.uint64) for word in counter), key)]
        words, uniforms = draws(key, number + 1, *counter[2:])
        assert words[number].tolist() == expected
        assert uniforms[number] == ((expected[0] << 20 | expected[1] >> 12) + 0.5) / 2**52


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
