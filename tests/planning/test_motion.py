"""Motion of the frames of a burst: its limits, its centre, what it depends on, and the margin that it needs."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.interpretation import BurstRule
from unprocess_gen.planning.motion import cosine_and_sine, draw_motion
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.plan import Motion
from unprocess_gen.simulation.reference.burst import scene_box

rules = st.builds(
    BurstRule, st.just(14), st.floats(0, 200), st.sampled_from([0.0, 0.25, 1.0, 10.0, 45.0]) | st.floats(0, 45),
    st.integers(1, 8), phase=st.sampled_from(["centre", "corner"]),
)  # fmt: skip
patches = st.builds(Patch, st.integers(1, 90), st.integers(1, 90), st.integers(0, 9999))
keys = st.integers(0, 2**64 - 1)


def centre(patch: Patch, rule: BurstRule) -> tuple[float, float]:
    y, x = ((rule.downscale * side - 1) / 2 for side in (patch.height, patch.width))
    return y, x


def shift_of(motion: Motion, y: float, x: float) -> tuple[float, float]:
    """Distance by which a position moves."""
    return (
        motion.motion_yy * y + motion.motion_yx * x + motion.motion_y - y,
        motion.motion_xy * y + motion.motion_xx * x + motion.motion_x - x,
    )


@given(st.floats(0, math.pi / 4))
def test_power_series_are_cosine_and_sine(angle: float) -> None:
    cosine, sine = cosine_and_sine(angle)
    assert abs(cosine - math.cos(angle)) < 1e-15 and abs(sine - math.sin(angle)) < 1e-15
    assert cosine_and_sine(-angle) == (cosine, -sine)


@given(rules, patches, keys, st.integers(1, 13))
def test_frames_turn_about_the_centre_and_move_within_the_limits(
    rule: BurstRule, patch: Patch, key: int, frame: int
) -> None:
    motion, zero = draw_motion(rule, key, patch, frame), draw_motion(rule, key, patch, 0)
    assert shift_of(zero, 3.0, 5.0) == (0, 0)
    moved = shift_of(motion, *centre(patch, rule))
    assert max(map(abs, moved)) <= rule.shift + 1e-9
    assert abs(math.degrees(math.atan2(motion.motion_yx, motion.motion_yy))) <= rule.rotation_deg + 1e-9
    assert motion.motion_yy == motion.motion_xx and motion.motion_yx == -motion.motion_xy
    assert abs(math.hypot(motion.motion_yy, motion.motion_yx) - 1) < 1e-15


def test_motion_is_uniform_and_depends_on_seed_image_patch_and_frame_only() -> None:
    rule, places = BurstRule(frames=100, shift=10.0, rotation_deg=4.0), product(range(40), range(1, 100))
    patch = Patch(96, 96)
    drawn = [(draw_motion(rule, key, patch, frame), frame) for key, frame in places]
    turns = [math.degrees(math.asin(motion.motion_yx)) / 4 for motion, _ in drawn]
    shifts = np.array([shift_of(motion, *centre(patch, rule)) for motion, _ in drawn]) / 10
    for values in (np.array(turns), *shifts.T):  # five standard errors of mean and variance of U(-1, 1)
        assert abs(values.mean()) < 5 * math.sqrt(1 / 3 / len(values))
        assert abs(values.var() - 1 / 3) < 5 * math.sqrt(4 / 45 / len(values))
    assert np.abs(np.corrcoef([turns, *shifts.T])[np.triu_indices(3, 1)]).max() < 5 / math.sqrt(len(turns))
    few, same = BurstRule(frames=3, shift=10.0, rotation_deg=4.0), drawn[1][0]
    assert draw_motion(few, 0, patch, 2) == same
    others = [(1, patch, 2), (0, Patch(96, 96, 1), 2), (0, Patch(96, 96, 4096), 2), (0, patch, 3)]
    assert same not in [draw_motion(few, *other) for other in others]
    assert draw_motion(few, 0, Patch(96, 96, 0, 8, 40), 2) == same  # its place does not matter
    assert draw_motion(few, 0, patch, 2, epoch=1) != same


@pytest.mark.parametrize("ends", [*product((-1, 1), repeat=3), (0, 0, 0)])
@given(rule=rules, patch=patches)
def test_no_frame_sees_beyond_the_margin_and_little_of_it_is_spare(
    rule: BurstRule, patch: Patch, ends: tuple[int, int, int]
) -> None:
    """The margin covers the largest motions, and exceeds them by few pixels."""
    (y, x), sides = centre(patch, rule), (patch.height * rule.downscale, patch.width * rule.downscale)
    cosine, sine = cosine_and_sine(math.radians(rule.rotation_deg) * ends[0])
    motion = Motion(
        *(cosine, sine, y - cosine * y - sine * x + rule.shift * ends[1]),
        *(-sine, cosine, x - cosine * x + sine * y + rule.shift * ends[2]),
        *(rule.downscale, rule.phase),
    )
    box, margin = scene_box([motion], (patch.height, patch.width)), rule.margin(*sides)
    assert -margin[0] <= box[0] and -margin[1] <= box[1]
    assert box[2] <= sides[0] + margin[0] and box[3] <= sides[1] + margin[1]
    if rule.rotation_deg <= 1:  # of larger angles, sine and cosine are bounded by their first terms
        assert margin[0] <= rule.shift + 0.0175 * sides[1] / 2 + rule.downscale + 3 + 0.001 * sides[0]
