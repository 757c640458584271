"""Developing inverts unprocessing: every colour returns to its own code.

Slow tests check all 2**24 colours, fast ones a lattice with all faces of the cube. Through the mosaic, flat colours and
ramps are exact up to rounding, and images are within the stated errors.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from helpers.photographs import pixels
from helpers.promise_report import Figure
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import colour, unprocess
from unprocess_gen.simulation.reference import isp as process
from unprocess_gen.simulation.reference.cfa import PATTERNS, mosaic
from unprocess_gen.simulation.reference.sensor import quantise, to_dn

EPS = 2.0**-52
GAINS = {
    "least": (2.4, 1.9, 0.5),
    "less": (1.9, 1.5, 0.5),
    "more": (2.4, 1.9, 1.1),
    "most": (1.9, 1.5, 1.1),
    "just below 1": (1.0, 1.0, 1 - EPS / 2),
    "just above 1": (1.0, 1.0, 1 + EPS),
}
"""Extreme red, blue and inverse brightness gains of Brooks et al., and the two floats next to 1."""

HIGHLIGHTS = ("per_channel", "gray_mean", "none")
STEPS = [pytest.param(15, id="lattice"), pytest.param(1, id="all 2**24", marks=pytest.mark.slow)]


def colours(step: int) -> Iterator[np.ndarray]:
    """Yield all 8-bit colours whose codes are multiples of ``step`` (a divisor of 255), in slabs ``[n, n, 3]``."""
    levels = np.arange(0, 256, step, dtype=np.uint8)
    green, blue = np.meshgrid(levels, levels, indexing="ij")
    for red in levels:
        yield np.stack([np.full_like(green, red), green, blue], axis=-1)


def plan_with(plan: Plan, camera: str, gains: str, highlight: str) -> Plan:
    red, blue, inverse_rgb = GAINS[gains]
    matrix = colour.rgb2cam(colour.CAMERAS[camera])
    return plan.replace(rgb2cam=matrix, red_gain=red, blue_gain=blue, inverse_rgb_gain=inverse_rgb, highlight=highlight)


def unclipped(light: np.ndarray) -> np.ndarray:
    return ((light >= 0) & (light <= 1)).all(axis=-1)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("gains", GAINS)
@pytest.mark.parametrize("camera", colour.CAMERAS)
def test_unclipped_colours_return_to_their_codes(
    plan: Plan, camera: str, gains: str, step: int, figure: Figure
) -> None:
    """At least a fifth of all colours is not clipped, so that the test checks enough of them."""
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
    figure("colours", f"{checked - returned} of {checked} unclipped colours change")


@pytest.mark.parametrize("highlight", ["gray_mean", "none"])
def test_colours_return_for_every_highlight_method(plan: Plan, highlight: str) -> None:
    for gains, srgb in itertools.product(GAINS, colours(15)):
        planned = plan_with(plan, "sony_a7r", gains, highlight)
        light = unprocess.camera_light(srgb, planned)
        inside = unclipped(light)
        codes = process.to_codes(process.process(light[inside], planned))
        np.testing.assert_array_equal(codes, srgb[inside], err_msg=gains)


@pytest.mark.parametrize(("tone", "gamma"), [("smoothstep", 2.2), ("none", 2.2), ("none", "srgb"), ("none", 1.0)])
def test_every_16_bit_gray_returns_through_every_curve(plan: Plan, tone: str, gamma: float | str) -> None:
    planned = plan.replace(tone=tone, gamma=gamma)
    grays = np.arange(65536, dtype=np.uint16).reshape(256, 256, 1).repeat(3, axis=2)

    light = np.clip(unprocess.camera_light(grays, planned), 0, 1)

    np.testing.assert_array_equal(process.to_codes(process.process(light, planned), 65536), grays)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("gains", GAINS)
@pytest.mark.parametrize("camera", colour.CAMERAS)
def test_kernels_give_the_references_dn_for_every_colour(plan: Plan, camera: str, gains: str, step: int) -> None:
    """Four origins put each of the four sites on every pixel, so that every filter records every colour."""
    planned = plan_with(plan, camera, gains, "per_channel")
    black, white = planned.sensor.black_level_dn, planned.sensor.white_level_dn
    for srgb in colours(step):
        light = unprocess.camera_light(srgb, planned)
        dn = quantise(to_dn(light, black, white), black, white)
        for y, x in itertools.product(range(2), range(2)):
            clean = make_pair(srgb, planned, (y, x)).clean
            for dy, dx in itertools.product(range(2), range(2)):
                channel = ((0, 1), (1, 2))[(y + dy) % 2][(x + dx) % 2]
                np.testing.assert_array_equal(clean[dy::2, dx::2], dn[dy::2, dx::2, channel])


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Draw floats whose products do not underflow."""
    return st.floats(low, high).filter(lambda value: value == 0 or abs(value) > 1e-100)


@given(
    i=st.lists(numbers(-0.5, 3), min_size=3, max_size=3),
    k=st.lists(st.floats(0.01, 3), min_size=3, max_size=3),
    threshold=numbers(0, 0.99),
)
def test_gains_are_inverted_for_any_value_gain_and_threshold(i: list[float], k: list[float], threshold: float) -> None:
    """Applying the gains and inverting them again must give the value, to the rounding of a dozen operations."""
    gains = (k[0], k[1], k[2])
    y = unprocess.invert_gains(np.array([[i]]), gains, "per_channel", threshold)

    again = unprocess.invert_gains(
        process.apply_gains(y, gains, "per_channel", threshold), gains, "per_channel", threshold
    )

    # m's own rounding is threshold-sized and is divided by 1 - threshold; y grows with m².
    scale = np.maximum(np.abs(y), 1) / (1 - threshold)
    assert (np.abs(again - y) <= 64 * EPS * scale).all()


def test_colours_outside_the_cube_are_clipped(plan: Plan) -> None:
    found = process.process(np.array([[[-0.5, 0.0, 2.0]]]), plan.replace(rgb2cam=(1, 0, 0, 0, 1, 0, 0, 0, 1)))

    assert found.tolist() == [[[0.0, 0.0, 1.0]]]


# --------------------------------------------------------------------------------------------- through integer DN

LOST = {16: 0, 14: 1, 12: 2, 10: 7}
"""Largest change of an 8-bit colour by rounding to a sensor's DN, in codes, for any camera and gains."""

LEVELS_DN = {16: (4096, 65535), 14: (1024, 16383), 12: (240, 4095), 10: (64, 1023)}
"""Black and white level of the sensors in ``conf/sensor``, by their bits."""


def on_sensor(plan: Plan, bits: int) -> Plan:
    black, white = LEVELS_DN[bits]
    return plan.replace(bits=bits, black_level_dn=black, white_level_dn=white)


def test_developing_restores_the_brightness_of_a_darkened_scene(plan: Plan) -> None:
    planned = on_sensor(plan_with(plan, "sony_a7r", "less", "per_channel"), 16).replace(exposure_ratio=8.0)
    grays = np.arange(0, 256, 5, dtype=np.uint8).reshape(1, -1, 1).repeat(3, axis=2)
    light = np.minimum(unprocess.camera_light(grays, planned), 1) * planned.scene.exposure

    dn = quantise(to_dn(light, planned.sensor.black_level_dn, planned.sensor.white_level_dn), 0, 65535)

    found = process.to_codes(process.process(process.to_light(dn, planned), planned))
    assert np.abs(found - grays).max() <= LOST[14]  # 16 bits less the three that the scene takes


# ------------------------------------------------------------------------------------------------ through the mosaic


def ramp(height: int, width: int) -> np.ndarray:
    """Return an image whose channels increase or decrease along both axes, each at its own rate."""
    y, x = np.mgrid[:height, :width][..., None].astype(float)
    return y * [0.5, -1.0, 0.25] + x * [-0.75, 0.5, 1.0] + [10, 20, 30]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_colour_ramps_survive_except_at_the_edges(pattern: str) -> None:
    """A mirrored row differs from the ramp by twice its distance from the edge, at most 4 steps."""
    whole = ramp(11, 14)

    error = np.abs(process.demosaic(mosaic(whole, pattern), pattern) - whole)

    assert error[2:-2, 2:-2].max() <= 64 * EPS * 50
    assert 0.1 < error.max() <= 4 * 1.75


@pytest.mark.parametrize("size", [(1, 1), (1, 8), (8, 1)])
def test_a_mosaic_without_all_channels_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=rf"mosaic=\[{size[0]}, {size[1]}\]: .*expected at least 2 x 2 sites"):
        process.demosaic(np.zeros(size), "RGGB")


@pytest.mark.parametrize("highlight", HIGHLIGHTS)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_flat_colours_return_from_a_raw_frame(plan: Plan, pattern: str, highlight: str, figure: Figure) -> None:
    """A frame has 64 flat squares; the inner sites of each depend only on their own square."""
    side = 8
    levels = np.array(list(itertools.product((0, 100, 250, 255), repeat=3)), dtype=np.uint8).reshape(8, 8, 3)
    source = levels.repeat(side, axis=0).repeat(side, axis=1)
    planned = on_sensor(plan_with(plan, "nexus_6p", "less", highlight).replace(pattern=pattern), 16)

    found = process.to_codes(process.develop(make_pair(source, planned).clean, planned))

    inner = np.zeros(side, dtype=bool)
    inner[2:-2] = True
    inner = np.outer(np.tile(inner, 8), np.tile(inner, 8)) & unclipped(unprocess.camera_light(source, planned))
    assert inner.sum() >= 16 * 30
    np.testing.assert_array_equal(found[inner], source[inner])
    figure("developing", f"{(found == source)[inner].all(axis=-1).sum()} of {inner.sum()} sites return to their codes")


def test_a_crop_is_developed_in_its_own_phase(plan: Plan) -> None:
    source = pixels(1, 64, 96)
    planned = plan_with(plan, "nexus_6p", "less", "per_channel")
    raw = make_pair(source, planned).clean
    whole = process.develop(raw, planned)
    y, x = 21, 34

    cut = process.develop(raw[y:50, x:80], planned, origin=(y, x))

    np.testing.assert_allclose(cut[2:-2, 2:-2], whole[y:50, x:80][2:-2, 2:-2], rtol=0, atol=1e-9)


def developed_codes(source: np.ndarray, plan: Plan) -> np.ndarray:
    return process.to_codes(process.develop(make_pair(source, plan).clean, plan))


def test_a_saturated_highlight_on_gray_has_no_coloured_rim(plan: Plan) -> None:
    """With gains applied after demosaicking, the channels of the rim would differ by 125 codes."""
    y, x = np.mgrid[:60, :60]
    gray = np.clip(255 - (np.hypot(y - 30, x - 30) - 9) * 8, 90, 255).astype(np.uint8)
    planned = on_sensor(plan_with(plan, "nexus_6p", "less", "per_channel"), 14)

    found = developed_codes(gray[..., None].repeat(3, axis=2), planned)

    assert (found.max(axis=-1) - found.min(axis=-1)).max() <= 4
