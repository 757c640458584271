"""Steps of Algorithm 1, compared with exact tables, fractions, the article's formula and numbers of Brooks et al."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st

from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import colour, unprocess
from unprocess_gen.simulation.tone_curves import PUBLISHED_SHA256, linear_table

EPS = 2.0**-52


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Draw floats whose products do not underflow: light is a sum of table entries, which are far larger."""
    return st.floats(low, high).filter(lambda value: value == 0 or abs(value) > 1e-100)


GAINS = (1e-300, 1e-12, 0.2, 0.5, 1 - 2.0**-53, 1.0, 1.5)


# Tone and gamma -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("tone", "gamma", "codes"), PUBLISHED_SHA256)
def test_the_formulas_are_within_16_units_of_the_exact_tables(tone: str, gamma: str, codes: int) -> None:
    """6 units for the tone curve, 6 for the power, and 3 because the table is of 2.2, not of the double next to it."""
    k = np.arange(codes)
    v = unprocess.INVERSE_TONES[tone](k / (codes - 1), (codes - 1 - k) / (codes - 1))
    exact = linear_table(tone, gamma, codes)
    assert (np.abs(unprocess.expand_gamma(v, gamma) - exact) <= 16 * EPS * exact).all()


# Colour ---------------------------------------------------------------------------------------------------------------


def test_the_matrix_is_applied_to_each_triplet() -> None:
    ccm = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    image = np.array([[[1.0, 10.0, 100.0], [0.5, 0.25, 0.125]]])
    assert unprocess.apply_ccm(image, ccm).tolist() == [[[321.0, 654.0, 987.0], [1.375, 4.0, 6.625]]]


# Gains ----------------------------------------------------------------------------------------------------------------

BROOKS = (0.8 / 2.15, 0.8, 0.8 / 1.7)
"""Inverse gains at the centres of Brooks' laws: .372, .8, .471."""


@pytest.mark.parametrize(
    ("highlight", "rgb", "expected"),
    [
        # Red: its mean, 0.47, is no highlight for Brooks' code; for the article its red channel is white.
        ("gray_mean", ("1", "1/5", "1/5"), ("16/43", "4/25", "8/85")),
        ("per_channel", ("1", "1/5", "1/5"), ("1", "4/25", "8/85")),
        # Yellow, with a mean of 0.83.
        ("gray_mean", ("1", "1", "1/2"), ("16/43", "4/5", "4/17")),
        ("per_channel", ("1", "1", "1/2"), ("1", "1", "4/17")),
        # A pale orange: mean 0.95, mask ¼: gains ¼ + ¾k. By channel: masks 1, ¼ and 0.
        ("gray_mean", ("1", "19/20", "9/10"), ("91/172", "323/400", "369/680")),
        ("per_channel", ("1", "19/20", "9/10"), ("1", "323/400", "36/85")),
        ("none", ("1", "19/20", "9/10"), ("16/43", "19/25", "36/85")),
        # No light, and white.
        ("gray_mean", ("0", "0", "0"), ("0", "0", "0")),
        ("gray_mean", ("1", "1", "1"), ("1", "1", "1")),
        ("per_channel", ("1", "1", "1"), ("1", "1", "1")),
        ("none", ("1", "1", "1"), ("16/43", "4/5", "8/17")),
    ],
)
def test_highlights_by_hand(highlight: str, rgb: tuple[str, ...], expected: tuple[str, ...]) -> None:
    """Rounding of i, or of the mean's three operations, is ten times as large in a mask of width 0.1, twice in its
    square: 2 · 10 · (3 + 1) half units, and ten more for all that follows.
    """
    image = np.array([[[float(Fraction(value)) for value in rgb]]])
    found = unprocess.invert_gains(image, BROOKS, highlight, 0.9)[0, 0]
    for value, exact in zip(found, expected, strict=True):
        assert abs(value - float(Fraction(exact))) <= (80 + 10) * EPS / 2


GRID = np.linspace(0, 1, 10**6 + 1)


@pytest.mark.parametrize("k", GAINS)
def test_per_channel_is_the_articles_function(k: float) -> None:
    """The float64 nearest to 0.9 is 2.3e-17 larger: an error of 4.6e-16 in the mask, plus eight roundings."""
    article = GRID * k + 100 * GRID * np.maximum(GRID - 0.9, 0) ** 2 * max(1 - k, 0)
    found = unprocess.invert_gains_per_channel(GRID, np.array(k), 0.9)
    assert np.abs(found - article).max() <= 2 * 2.3e-16 * 1.0 + 2 * 8 * EPS / 2


@pytest.mark.parametrize("highlight", ["per_channel", "gray_mean"])
def test_white_stays_exactly_1_for_two_million_gains_below_1(highlight: str) -> None:
    """100·(1 - 0.9)² in place of the quotient would give less than 1 for five in six of them."""
    generator = np.random.Generator(np.random.Philox(key=0))
    k = np.concatenate([generator.random(10**6), np.exp2(-60 * generator.random(10**6))])
    white = np.ones((len(k), 1, 3)) if highlight == "gray_mean" else np.ones(len(k))
    gains = np.repeat(k, 3).reshape(-1, 1, 3) if highlight == "gray_mean" else k
    assert (k < 1).all()
    assert (unprocess.INVERSE_HIGHLIGHTS[highlight](white, gains, 0.9) == 1).all()


def test_inverse_gains_are_the_inverse_brightening_over_the_forward_gains(plan: Plan) -> None:
    assert plan.replace(red_gain=2.0, blue_gain=1.6, inverse_rgb_gain=0.8).camera.inverse_gains == (0.4, 0.8, 0.5)


# All steps together ---------------------------------------------------------------------------------------------------


def test_grays_stay_gray_for_any_camera(plan: Plan) -> None:
    """The three products' sizes add up to below 2, so their roundings to below 3 units."""
    gray = np.repeat(np.arange(256, dtype=np.uint8), 12).reshape(-1, 2, 2, 3)
    expected = linear_table("smoothstep", 2.2, 256)
    for camera in colour.CAMERAS.values():
        made = plan.replace(rgb2cam=colour.rgb2cam(camera), inverse_rgb_gain=1.0)
        for code in range(256):
            light = unprocess.unprocess(gray[code], made)
            assert np.abs(light - expected[code]).max() <= 3 * EPS * expected[code]
