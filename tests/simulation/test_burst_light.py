"""Light of bursts: kernels equal the reference, which follows its definition within the error that it states."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from unprocess_gen.core.arrays import FLOAT32, Float, Normalised
from unprocess_gen.simulation.kernels import burst
from unprocess_gen.simulation.pair import linear_rgb
from unprocess_gen.simulation.plan import Motion
from unprocess_gen.simulation.profiles import Profile
from unprocess_gen.simulation.reference import burst as reference
from unprocess_gen.simulation.reference.burst import scene_box
from unprocess_gen.simulation.reference.unprocess import INVERSE_HIGHLIGHTS
from unprocess_gen.simulation.self_test import GOLDEN_PLAN, GOLDEN_PLANS, golden_image

STILL = Motion(1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def quarters(low: int, high: int) -> st.SearchStrategy[float]:
    """Draw multiples of 1/4, which meet the last row and column exactly, and of 2**-20."""
    fine = st.integers(low << 20, high << 20).map(lambda number: number / 2**20)
    return fine.map(lambda number: round(4 * number) / 4) | fine


def motions(steps: tuple[int, ...]) -> st.SearchStrategy[Motion]:
    near_0 = st.just(0.0) | quarters(-1, 1).map(lambda number: number / 8)
    near_1 = near_0.map(lambda number: 1 + number)
    return st.builds(
        Motion, near_1, near_0, quarters(-9, 9), near_0, near_1, quarters(-9, 9), st.sampled_from(steps),
        st.sampled_from(["centre", "corner"]),
    )  # fmt: skip


sides = st.tuples(st.integers(1, 6), st.integers(1, 6))
places = st.tuples(st.integers(0, 40), st.integers(0, 40))


def scene(box: tuple[int, int, int, int], low: float = -0.1, high: float = 1.0) -> Normalised:
    """Return light that depends on the position in the target only."""
    y, x, colour = np.mgrid[box[0] : box[2], box[1] : box[3], :3]
    share = (y * 1009 + x * 31 + colour * 577 + y * x) % 1024 / 1023
    return np.asarray((low + (high - low) * share).astype(np.float32))


def by_definition(light: Normalised, motion: Motion, corner: tuple[int, int], shape: tuple[int, int]) -> Float:
    """Compute the light of a frame in float64, with the triangle of linear interpolation at every pixel as a weight."""
    s = motion.burst_downscale
    shift = (s - 1) / 2 if motion.burst_phase == "corner" else 0
    py, px = np.mgrid[: shape[0] * s, : shape[1] * s].reshape(2, -1) - shift
    y = motion.motion_yy * py + motion.motion_yx * px + motion.motion_y - corner[0]
    x = motion.motion_xy * py + motion.motion_xx * px + motion.motion_x - corner[1]
    of_rows, of_columns = (
        np.maximum(1 - np.abs(position[:, None] - np.arange(size)), 0)
        for position, size in ((y, light.shape[0]), (x, light.shape[1]))
    )
    values = np.einsum("pr,pc,rcd->pd", of_rows, of_columns, light.astype(np.float64), optimize=True)
    return np.asarray(values.reshape(shape[0], s, shape[1], s, 3).mean(axis=(1, 3)))


def kernel_frame(motion: Motion, first: tuple[int, int], shape: tuple[int, int]) -> Normalised:
    """Return the light of a crop from the part of the scene that it reads; check that the reference agrees."""
    y0, x0, y1, x1 = scene_box([motion], shape, first)
    light = scene((y0 - 1, x0 - 1, y1 + 1, x1 + 1))[1:-1, 1:-1]
    frame = burst.frame_light(light, motion, (y0, x0), first, shape)
    assert frame.tobytes() == reference.frame_light(light, motion, (y0, x0), first, shape).tobytes()
    return frame


@given(motions((1, 2, 3, 4, 8)), places, sides, st.data())
def test_crops_have_the_bytes_of_the_frame_in_kernel_and_reference(
    motion: Motion, first: tuple[int, int], shape: tuple[int, int], data: st.DataObject
) -> None:
    y, x = (data.draw(st.integers(0, side - 1)) for side in shape)
    height, width = data.draw(st.integers(1, shape[0] - y)), data.draw(st.integers(1, shape[1] - x))
    crop = kernel_frame(motion, (first[0] + y, first[1] + x), (height, width))
    frame = np.ascontiguousarray(kernel_frame(motion, first, shape)[y : y + height, x : x + width])
    assert crop.tobytes() == frame.tobytes()


@given(motions((1, 2, 3, 4, 8)), sides)
@example(Motion(0.99, -0.02, 0.3, 0.02, 0.99, -7.77, 64), (2, 1))
def test_the_error_is_within_its_bound(motion: Motion, shape: tuple[int, int]) -> None:
    box, bound = scene_box([motion], shape), (2 * motion.burst_downscale + 8) * 2.0**-24
    light = scene(box, -1.0)
    frame = burst.frame_light(light, motion, box[:2], (0, 0), shape)
    assert np.abs(frame - by_definition(light, motion, box[:2], shape)).max() <= bound < 2.0**-16
    flat = burst.frame_light(np.full_like(light, 0.7), motion, box[:2], (0, 0), shape)
    assert np.abs(flat - np.float32(0.7)).max() <= bound


@given(st.integers(-9, 9), st.integers(-9, 9), sides)
def test_motion_by_integers_moves_pixels_exactly(y: int, x: int, shape: tuple[int, int]) -> None:
    light = scene((-9, -9, 16, 16))
    frame = burst.frame_light(light, STILL.replace(motion_y=y, motion_x=x), (-9, -9), (0, 0), shape)
    assert np.array_equal(frame, light[9 + y : 9 + y + shape[0], 9 + x : 9 + x + shape[1]])


@given(motions((1, 2, 4)), sides, st.integers(0, 3))
def test_the_box_is_as_small_as_possible(motion: Motion, shape: tuple[int, int], side: int) -> None:
    """Without any row or column of the box, a position or its neighbour is outside."""
    y0, x0, y1, x1 = box = scene_box([motion], shape)
    light = scene(box)[side == 0 : y1 - y0 - (side == 2), side == 1 : x1 - x0 - (side == 3)]
    corner = y0 + (side == 0), x0 + (side == 1)
    assume(light.size)
    for module in (burst, reference):
        with pytest.raises(ValueError, match=r"position=.*outside of the light.*scene_box"):
            module.frame_light(light, motion, corner, (0, 0), shape)


def test_the_box_of_frames_contains_each() -> None:
    near, far = (
        STILL.replace(motion_y=-2.5, burst_downscale=4),
        STILL.replace(motion_x=1.25, burst_downscale=4, burst_phase="corner"),
    )
    assert scene_box([STILL.replace(burst_downscale=4)], (2, 3)) == (0, 0, 8, 12)
    assert scene_box([near], (2, 3)) == (-3, 0, 6, 12)
    assert scene_box([far], (2, 3)) == (-2, -1, 7, 12)
    assert scene_box([near, far], (2, 3)) == (-3, -1, 7, 12)


def test_a_position_that_is_no_number_is_outside() -> None:
    with pytest.raises(ValueError, match=r"position=\[nan, 0.0\]: outside of the light, which has rows 0 to 3"):
        burst.frame_light(scene((0, 0, 4, 4)), STILL.replace(motion_y=float("nan")), (0, 0), (0, 0), (1, 1))


# Light of the scene ---------------------------------------------------------------------------------------------------

WIDE = Profile("wide", (1.25, -0.125, -0.125, 0.0, 1.0, 0.0, 0.0, -0.25, 1.25), (None, (2.0, 1, 0, 0, 0, 0, 0), None))
VIVID = (1.5, -0.375, -0.125, -0.25, 1.5, -0.25, 0.0, -0.5, 1.5)
PHOTOGRAPH = GOLDEN_PLAN.replace(rgb2cam=VIVID, blue_gain=0.7)
LINEAR = GOLDEN_PLANS["linear_per_channel"].replace(rgb2cam=VIVID, ev=0.0)
SCENES = {
    **{name: PHOTOGRAPH.replace(highlight=name) for name in INVERSE_HIGHLIGHTS},
    "profile": PHOTOGRAPH.replace(profile=WIDE),
    "dither": PHOTOGRAPH.replace(dequantize="dither_all"),
    "linear": LINEAR,
    "camera": LINEAR.replace(primaries="camera"),
}


@pytest.mark.parametrize(
    ("name", "has_16_bits"), [*((name, False) for name in SCENES), *((name, True) for name in INVERSE_HIGHLIGHTS)]
)
def test_the_scene_is_that_of_the_reference_and_of_the_clean_frame(name: str, has_16_bits: bool) -> None:
    """Frames are rounded in DN, so the float32 next to the light is possible."""
    plan = SCENES[name].replace(clean_dtype=FLOAT32)
    image = golden_image(plan)
    if has_16_bits:
        image = image.astype(np.uint16) * 257 - 3 * (image > 99).astype(np.uint16)
    light = burst.scene_light(image, plan, (5, 8))
    assert light.tobytes() == reference.scene_light(image, plan, (5, 8)).tobytes()
    assert light.dtype == np.float32 and light.min() < 0
    assert np.abs(light.clip(0, 1) - linear_rgb(image, plan, (5, 8))).max() <= 2.0**-24


def test_the_largest_light_stays_finite() -> None:
    image = np.full((65, 65, 3), np.finfo(np.float32).max)
    light = burst.scene_light(image, LINEAR)
    assert light.tobytes() == reference.scene_light(image, LINEAR).tobytes()
    frame = burst.frame_light(light, STILL.replace(motion_x=0.5, burst_downscale=64), (0, 0), (0, 0), (1, 1))
    assert (frame == 2.0**64).all()
