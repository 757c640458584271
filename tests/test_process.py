"""There and back: what `unprocess` did, `process` undoes; every colour, to its own code.

Every test of colours here walks all 2**24 of them in the slow form, and a lattice of them with all faces of the cube in
the quick one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen import colour, process, unprocess
from unprocess_gen.config import Config, GainsConfig, NoiseConfig
from unprocess_gen.pair import make_pair
from unprocess_gen.plan import plan_image
from unprocess_gen.records import Plan
from unprocess_gen.sensor import quantise, to_dn

EPS = 2.0**-52
GAINS = {
    "least": (2.4, 1.9, 0.5),
    "less": (1.9, 1.5, 0.5),
    "more": (2.4, 1.9, 1.1),
    "most": (1.9, 1.5, 1.1),
    "just below 1": (1.0, 1.0, 1 - EPS / 2),
    "just above 1": (1.0, 1.0, 1 + EPS),
}
"""The extremes of Brooks' laws, red, blue and inverse brightening, and the two doubles beside 1."""

HIGHLIGHTS = ("per_channel", "gray_mean", "none")
STEPS = [pytest.param(15, id="lattice"), pytest.param(1, id="all 2**24", marks=pytest.mark.slow)]


@pytest.fixture(scope="module")
def plan() -> Plan:
    noise = NoiseConfig("none", "dn", "subtracted", 12, 240, 4095, 0.0, 0.0)
    return plan_image(Config(gains=GainsConfig(1.0, 1.0, 1.0), noise=noise), "a" * 64)


def colours(step: int) -> Iterator[np.ndarray]:
    """All 8-bit colours whose codes are multiples of ``step`` (a divisor of 255), in slabs ``[n, n, 3]``."""
    levels = np.arange(0, 256, step, dtype=np.uint8)
    green, blue = np.meshgrid(levels, levels, indexing="ij")
    for red in levels:
        yield np.stack([np.full_like(green, red), green, blue], axis=-1)


def plan_with(plan: Plan, camera: str, gains: str, highlight: str) -> Plan:
    red, blue, inverse_rgb = GAINS[gains]
    matrix = colour.rgb2cam(colour.CAMERAS[camera])
    return replace(
        plan, rgb2cam=matrix, red_gain=red, blue_gain=blue, inverse_rgb_gain=inverse_rgb, highlight=highlight
    )


def unclipped(light: np.ndarray) -> np.ndarray:
    return ((light >= 0) & (light <= 1)).all(axis=-1)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("gains", GAINS)
@pytest.mark.parametrize("camera", colour.CAMERAS)
def test_every_colour_that_is_not_clipped_returns_to_its_own_code(
    plan: Plan, camera: str, gains: str, step: int
) -> None:
    """As many colours as are not clipped is asserted too: between a fifth of the cube and all of it."""
    planned = plan_with(plan, camera, gains, "per_channel")
    returned = checked = 0
    for srgb in colours(step):
        light = unprocess.camera_light(srgb, planned)
        assert np.isfinite(light).all()
        inside = unclipped(light)
        codes = process.to_codes(process.process(light[inside], planned))
        returned += int((codes == srgb[inside]).all(axis=-1).sum())
        checked += len(codes)

    assert returned == checked
    assert checked >= (255 // step + 1) ** 3 / 5


@pytest.mark.parametrize("highlight", ["gray_mean", "none"])
@pytest.mark.parametrize("gains", GAINS)
def test_every_colour_returns_however_the_highlights_were_kept(plan: Plan, gains: str, highlight: str) -> None:
    planned = plan_with(plan, "sony_a7r", gains, highlight)
    for srgb in colours(15):
        light = unprocess.camera_light(srgb, planned)
        inside = unclipped(light)
        np.testing.assert_array_equal(process.to_codes(process.process(light[inside], planned)), srgb[inside])


@pytest.mark.parametrize(("tone", "gamma"), [("smoothstep", 2.2), ("none", 2.2), ("none", "srgb"), ("none", 1.0)])
def test_every_16_bit_gray_returns_through_every_curve(plan: Plan, tone: str, gamma: float | str) -> None:
    planned = replace(plan, tone=tone, gamma=gamma)
    grays = np.arange(65536, dtype=np.uint16).reshape(256, 256, 1).repeat(3, axis=2)

    light = np.clip(unprocess.camera_light(grays, planned), 0, 1)

    np.testing.assert_array_equal(process.to_codes(process.process(light, planned), 65536), grays)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("gains", GAINS)
@pytest.mark.parametrize("camera", colour.CAMERAS)
def test_the_fast_form_gives_every_colour_the_references_dn_in_every_channel(
    plan: Plan, camera: str, gains: str, step: int
) -> None:
    """Four origins put each of the four sites on every pixel, so that every colour is seen through every filter."""
    planned = plan_with(plan, camera, gains, "per_channel")
    black, white = planned.black_level_dn, planned.white_level_dn
    for srgb in colours(step):
        light = unprocess.camera_light(srgb, planned)
        dn = quantise(to_dn(light, black, white), black, white)
        for y, x in itertools.product(range(2), range(2)):
            clean = make_pair(srgb, planned, (y, x)).clean
            for dy, dx in itertools.product(range(2), range(2)):
                channel = ((0, 1), (1, 2))[(y + dy) % 2][(x + dx) % 2]
                np.testing.assert_array_equal(clean[dy::2, dx::2], dn[dy::2, dx::2, channel])


@pytest.mark.parametrize("highlight", HIGHLIGHTS)
@pytest.mark.parametrize("gains", GAINS)
@pytest.mark.parametrize("camera", colour.CAMERAS)
def test_white_is_white_and_black_black_whatever_the_camera_and_the_gains(
    plan: Plan, camera: str, gains: str, highlight: str
) -> None:
    planned = plan_with(plan, camera, gains, highlight)
    ends = np.array([[[0, 0, 0], [255, 255, 255]]], dtype=np.uint8)
    black, white = unprocess.camera_light(ends, planned)[0]

    assert black.tolist() == [0, 0, 0]
    gained = np.array(planned.inverse_gains)
    assert white.tolist() == (gained if highlight == "none" else np.maximum(gained, 1)).tolist()


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Floats whose products do not underflow."""
    return st.floats(low, high).filter(lambda value: value == 0 or abs(value) > 1e-100)


@given(
    i=st.lists(numbers(-0.5, 3), min_size=3, max_size=3),
    k=st.lists(st.floats(0.01, 3), min_size=3, max_size=3),
    threshold=numbers(0, 0.99),
)
def test_gains_are_inverted_for_any_value_gain_and_threshold(i: list[float], k: list[float], threshold: float) -> None:
    """The inverse is worth what it gives: put back, it must give the value, to the rounding of a dozen operations."""
    gains = (k[0], k[1], k[2])
    y = unprocess.invert_gains(np.array([[i]]), gains, "per_channel", threshold)

    again = unprocess.invert_gains(
        process.apply_gains(y, gains, "per_channel", threshold), gains, "per_channel", threshold
    )

    # m's own rounding is threshold-sized and is divided by 1 - threshold; y grows with m².
    scale = np.maximum(np.abs(y), 1) / (1 - threshold)
    assert (np.abs(again - y) <= 64 * EPS * scale).all()


@given(
    i=st.lists(numbers(0, 1), min_size=3, max_size=3),
    k=st.lists(st.floats(0.05, 1.5), min_size=3, max_size=3),
)
def test_gains_are_inverted_where_highlights_were_kept_by_their_mean(i: list[float], k: list[float]) -> None:
    gains = (k[0], k[1], k[2])
    light = np.array([[i]])

    again = process.apply_gains(unprocess.invert_gains(light, gains, "gray_mean", 0.9), gains, "gray_mean", 0.9)

    np.testing.assert_allclose(again, light, rtol=1e-9, atol=1e-12)


def test_smoothstep_by_hand() -> None:
    assert process.smoothstep(np.array([0, 0.25, 0.5, 1])).tolist() == [0, 0.15625, 0.5, 1]


def test_srgb_by_hand() -> None:
    """The standard's own figures: 0.0031308 is where the line ends, 0.5 becomes 0.735357."""
    found = process.compress_gamma(np.array([0, 0.001, 0.5, 1]), "srgb")

    np.testing.assert_allclose(found, [0, 0.01292, 0.7353569830524495, 1], rtol=1e-12)


def test_what_lies_outside_the_cube_is_clipped(plan: Plan) -> None:
    found = process.process(np.array([[[-0.5, 0.0, 2.0]]]), replace(plan, rgb2cam=(1, 0, 0, 0, 1, 0, 0, 0, 1)))

    assert found.tolist() == [[[0.0, 0.0, 1.0]]]
