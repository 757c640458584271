"""The flow of a burst leads to the place where another frame shows what the first frame shows."""

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import unprocess_gen as ug
from unprocess_gen.config.interpretation import BurstRule
from unprocess_gen.dataset.columns import flatten
from unprocess_gen.planning.motion import draw_motion
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.reference.burst import frame_light

SIDE = 40


def burst(**settings: Any) -> tuple[list[dict[str, Any]], list[Any]]:
    """Rows and motions of three frames of 40 x 40 pixels."""
    rule = BurstRule(frames=3, **settings)
    motions = [draw_motion(rule, 7, Patch(SIDE, SIDE), frame) for frame in range(3)]
    cells = [flatten(motion) for motion in motions]
    return [{**row, "frame": k, "height": SIDE, "width": SIDE} for k, row in enumerate(cells)], motions


def sampled(picture: NDArray[Any], flow: NDArray[Any]) -> NDArray[Any]:
    """Picture at each pixel plus the flow, by bicubic interpolation."""
    y, x = np.indices(picture.shape[:2], dtype=np.float32) + flow.astype(np.float32)
    return np.asarray(cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT))


@pytest.mark.parametrize("phase", ["centre", "corner"])
@pytest.mark.parametrize("downscale", [1, 3, 4])
def test_flow_aligns_frames_of_a_smooth_scene(downscale: int, phase: str) -> None:
    rows, motions = burst(downscale=downscale, phase=phase, shift=6.0, rotation_deg=5.0)
    margin = 64
    y, x = np.indices((SIDE * downscale + 2 * margin,) * 2) / (4.0 * downscale)
    scene = np.stack([np.sin(y) + np.cos(x)] * 3, axis=-1).astype(np.float32)
    frames = [frame_light(scene, motion, (-margin, -margin), (0, 0), (SIDE, SIDE)) for motion in motions]
    inside = slice(12, -12)  # beyond the largest flow
    # bilinear light errs by w²/8 for each axis, with w = 1/4 for each pixel; OpenCV rounds places to 1/32 of a pixel
    tolerance = 2 / 16 / 8 + 2 / 4 / 64 + 0.005
    for k in (1, 2):
        aligned = sampled(frames[k], ug.flow(rows, k)) - frames[0]
        forth = sampled(frames[0], ug.flow(rows, k, inverse=True)) - frames[k]
        assert np.abs(aligned[inside, inside]).max() < tolerance
        assert np.abs(forth[inside, inside]).max() < tolerance
        assert np.abs(frames[k] - frames[0]).max() > 0.2


@pytest.mark.parametrize("phase", ["centre", "corner"])
def test_both_frames_show_one_position_of_the_target(phase: str) -> None:
    """Flow agrees with A p + b at the centre of pixel i: s i + (s - 1) / 2, with ``corner`` s i."""
    rows, motions = burst(downscale=3, phase=phase, rotation_deg=20.0)
    centre = 1 if phase == "centre" else 0
    at = np.indices((SIDE, SIDE))
    y, x = 3 * (at + ug.flow(rows, 2)) + centre
    moved = motions[2]
    shown = (moved.motion_yy * y + moved.motion_yx * x + moved.motion_y,
             moved.motion_xy * y + moved.motion_xx * x + moved.motion_x)  # fmt: skip
    assert np.abs(np.stack(shown) - (3 * at + centre)).max() < 1e-9


def test_a_point_moves_by_the_flow() -> None:
    """The place of a point in frame k is its place in frame 0 plus the flow."""
    rows, motions = burst(downscale=1, shift=5.0, rotation_deg=3.0)
    margin, point = 32, (21, 15)
    scene = np.zeros((SIDE + 2 * margin,) * 2 + (3,), np.float32)
    scene[point[0] + margin, point[1] + margin] = 1
    places = []
    for motion in motions:
        light = frame_light(scene, motion, (-margin, -margin), (0, 0), (SIDE, SIDE))[..., 0]
        places.append([float((grid * light).sum() / light.sum()) for grid in np.indices(light.shape)])
    near = tuple(round(place) for place in places[0])
    for k in (1, 2):
        moved = np.subtract(places[k], places[0])
        assert np.allclose(moved, ug.flow(rows, k)[(slice(None), *near)], atol=0.06)  # 3 degrees over half a pixel


@pytest.mark.parametrize("phase", ["centre", "corner"])
def test_flow_and_its_inverse_return_to_the_start(phase: str) -> None:
    rows, _ = burst(phase=phase, rotation_deg=30.0)
    there, back = ug.flow(rows, 1), ug.flow(rows, 1, inverse=True)
    # both are affine in the place, so the inverse can be evaluated between pixels
    slope = np.stack([back[:, 1, 0] - back[:, 0, 0], back[:, 0, 1] - back[:, 0, 0]], axis=1)
    places = np.indices((SIDE, SIDE)) + there
    at = back[:, :1, :1] + np.einsum("ij,jyx->iyx", slope, places)
    assert np.abs(there + at).max() < 1e-9
    assert np.array_equal(ug.flow(rows, 0), np.zeros((2, SIDE, SIDE)))


@pytest.mark.parametrize(("rows", "k", "problem"), [
    ([], 1, "no frame of this number"),
    ([{"frame": 0, "motion_y": None}], 0, "its row has no motion"),
    ([{"frame": 0, "motion_y": float("nan")}], 0, "its row has no motion"),
    (burst()[0] * 2, 1, "2 rows have this number"),
    (burst()[0][1:], 1, r"no frame of this number in the frames \[1, 2\]"),
])  # fmt: skip
def test_flow_needs_the_rows_of_a_burst(rows: list[dict[str, Any]], k: int, problem: str) -> None:
    with pytest.raises(ValueError, match=f"flow: frame 0: {problem}.*expected the rows of a burst"):
        ug.flow(rows, k)


def test_flow_takes_columns_and_refuses_rows_of_two_bursts() -> None:
    rows, _ = burst()
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    arrays = {name: cells if isinstance(cells[0], str) else np.array(cells) for name, cells in columns.items()}
    assert np.array_equal(ug.flow(arrays, 2), ug.flow(rows, 2))
    with pytest.raises(ValueError, match="flow: frames 0 and 1 are of different bursts"):
        ug.flow([{**row, "patch": k} for k, row in enumerate(rows)], 1)
