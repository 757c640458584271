"""Approximate normal deviates are within their error, and exact ones equal the reference bit for bit.

Quick tests try all words next to the ends of the table's lines and 10^5 random ones; slow tests try up to 2^31.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import pytest
from helpers.kernels import coarse_normals, exact_values, exact_values_by_vectors, values_by_lines
from helpers.promise_report import Figure

from unprocess_gen.simulation.kernels.normal import COARSE_ERROR, build_quantiles, normal_quantiles
from unprocess_gen.simulation.lookup_tables import LINES_PER_OCTAVE, normal_table, tukey_table
from unprocess_gen.simulation.reference import noise as effects

SIGN = 2**31


@functools.cache
def telling_words(random_bits: int) -> np.ndarray:
    """Return the words next to the ends of every line, words that float32 rounds up there, and random words.

    There are ``2**random_bits`` random words of uniform index and half as many of uniform logarithm, of either sign.
    """
    ends = (
        (2.0 ** np.arange(-1, 31)[:, None] * (1 + np.arange(LINES_PER_OCTAVE) / LINES_PER_OCTAVE))
        .ravel()
        .astype(np.int64)
    )
    spread = np.concatenate([ends[:, None] + np.arange(-3, 4), ends[:, None] - 2 ** np.arange(8)], axis=1).ravel()
    random = np.random.default_rng(1).integers(0, SIGN, 2**random_bits)
    tails = (2 ** (31 * np.random.default_rng(2).random(2 ** (random_bits - 1)))).astype(np.int64)
    last = SIGN - 1 - np.arange(300)
    index = np.unique(np.clip(np.concatenate([spread, random, tails, last]), 0, SIGN - 1))
    return np.concatenate([index, index + SIGN]).astype(np.uint32)


LAWS: dict[str, Callable[[], np.ndarray]] = {
    "normal": normal_table,
    **{f"tukey {shape}": functools.partial(tukey_table, shape) for shape in (0.0, 0.1571, 1.0, -0.2429)},
}
RANDOM_BITS = [pytest.param(16, id="few words"), pytest.param(21, id="many words", marks=pytest.mark.slow)]


@functools.cache
def reference(law: str, random_bits: int) -> np.ndarray:
    return effects.by_inverse_cdf(telling_words(random_bits), LAWS[law]())


@pytest.mark.parametrize("random_bits", RANDOM_BITS)
@pytest.mark.parametrize("law", LAWS)
def test_approximate_values_are_within_their_error_bound(law: str, random_bits: int) -> None:
    form = build_quantiles(LAWS[law]())
    off = np.abs(values_by_lines(telling_words(random_bits), form) - reference(law, random_bits))
    assert off.max() <= form.error
    assert off.max() > form.error / 20  # nor is the claim far too wide


@pytest.mark.parametrize("random_bits", RANDOM_BITS)
@pytest.mark.parametrize("law", LAWS)
def test_the_exact_value_of_a_word_equals_the_reference(law: str, random_bits: int) -> None:
    for compiled in (exact_values, exact_values_by_vectors):
        found = compiled(telling_words(random_bits), build_quantiles(LAWS[law]()))
        assert (found == reference(law, random_bits)).all()


def test_approximate_normals_are_within_1e_5() -> None:
    assert normal_quantiles().error < 1e-5


@pytest.mark.slow
def test_approximate_normals_are_within_their_error_for_every_word(figure: Figure) -> None:
    form, worst = normal_quantiles(), 0.0
    for start in range(0, SIGN, 2**24):
        words = np.arange(start, start + 2**24, dtype=np.uint32)
        worst = max(worst, float(np.abs(values_by_lines(words, form) - exact_values(words, form)).max()))
    assert worst <= form.error
    figure("normal", f"lines: at most {worst:.2g} standard deviations off, all words")


# Polynomials ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("random_bits", RANDOM_BITS)
def test_polynomial_normals_are_within_their_error(random_bits: int, figure: Figure) -> None:
    off = np.abs(coarse_normals(telling_words(random_bits)).astype(np.float64) - reference("normal", random_bits))
    assert 0.9 * COARSE_ERROR < off.max() <= COARSE_ERROR
    figure("normal", f"coarse polynomial: at most {off.max():.2g} standard deviations off, {off.size} words")


@pytest.mark.parametrize("random_bits", RANDOM_BITS)
def test_polynomial_normals_have_the_sign_of_their_word(random_bits: int) -> None:
    words = telling_words(random_bits)
    half = words.size // 2
    made = coarse_normals(words)
    assert (made[:half] == -made[half:]).all()


@pytest.mark.slow
def test_polynomial_normals_are_within_their_error_for_every_word(figure: Figure) -> None:
    form, worst = normal_quantiles(), 0.0
    for start in range(0, SIGN, 2**24):
        words = np.arange(start, start + 2**24, dtype=np.uint32)
        worst = max(worst, float(np.abs(coarse_normals(words).astype(np.float64) - exact_values(words, form)).max()))
    assert worst <= COARSE_ERROR
    figure("normal", f"coarse polynomial: at most {worst:.2g} standard deviations off, all words")
