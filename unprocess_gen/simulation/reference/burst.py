"""Compute the light of the frames of a burst: unprocess the scene, move it, and average it over the pixels.

`scene_light` is the light at high resolution, `frame_light` that of a frame: each pixel is the mean of s x s bilinear
values. The kernels (`kernels.burst`) give the same values. `scene_box` is the part of a scene that frames read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from unprocess_gen.core.arrays import Float, Normalised, Srgb
from unprocess_gen.simulation.plan import Motion, Plan
from unprocess_gen.simulation.reference.unprocess import camera_light, dequantise

MOST_SCENE_LIGHT = 2.0**64
"""Limit of the light of a scene: far above what frames hold, and sums of 64 x 64 values stay finite in float32."""


def scene_light(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Normalised:
    """Compute the light of a scene in all three channels: gains inverted, highlights preserved, nothing clipped.

    Parameters
    ----------
    srgb : ndarray of uint8, uint16 or float32, [H, W, 3]
        Display-referred codes; float32 is the light of a linear source.
    plan : Plan
        Parameters of the burst.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame.

    Returns
    -------
    ndarray of float32, [H, W, 3]
        Camera RGB, 0 at black and 1 at white, rounded once; within ± `MOST_SCENE_LIGHT`.
    """
    light = camera_light(dequantise(srgb, plan, origin), plan)
    return np.clip(light, -MOST_SCENE_LIGHT, MOST_SCENE_LIGHT).astype(np.float32)


def frame_light(
    light: Normalised, motion: Motion, corner: tuple[int, int], first: tuple[int, int], shape: tuple[int, int]
) -> Normalised:
    """Compute the light of a frame of a burst, or of a crop of it; a crop has the values of the frame.

    Pixel (i, j) is the mean, over m and n from 0 to s - 1, of the bilinear value at A·p + b with the position
    p = (s·i + m + o, s·j + n + o). Positions are float64 and values float32. The values of a row are added first, then
    the rows. So the error of light up to white is at most (2 s + 8) · 2**-24.

    Parameters
    ----------
    light : ndarray of float32, [H, W, 3]
        Light of the scene; finite.
    motion : Motion
        A and b of the frame, the downscale s, and the phase, which decides the offset o (`sample_places`).
    corner : (int, int)
        Row and column of ``light[0, 0]`` in the target.
    first, shape : (int, int)
        First row and column of the crop, and its height and width, in low-resolution pixels.

    Returns
    -------
    ndarray of float32, [h, w, 3]
        Light of the pixels.

    Raises
    ------
    ValueError
        If a position is outside of ``light``.
    """
    check_inside(light, motion, corner, first, shape)
    step, (rows, columns) = motion.burst_downscale, sample_places(motion, first, shape)
    total = np.zeros((2, *shape, 3), np.float32)
    for m in range(step):
        row = np.zeros_like(total)
        for n in range(step):
            y, x = motion.position(rows[m::step, None], columns[n::step])
            row += _weighted_columns(light, y, x, corner)
        total += row
    return np.asarray((total[0] + total[1]) / np.float32(step * step))


def _weighted_columns(light: Normalised, y: Float, x: Float, corner: tuple[int, int]) -> Normalised:
    """Compute the two terms of bilinear values, those of the left and of the right column, [2, h, w, 3].

    The neighbour of the last row or column has the weight 0, so any value may replace it.
    """
    down, right = ((position - np.floor(position)).astype(np.float32)[..., None] for position in (y, x))
    top, left = (np.floor(position).astype(np.int64) - low for position, low in zip((y, x), corner, strict=True))
    bottom, next_left = (np.minimum(low + 1, size - 1) for low, size in zip((top, left), light.shape, strict=False))
    start, end = (light[top, column] * (1 - down) + light[bottom, column] * down for column in (left, next_left))
    return np.stack([start * (1 - right), end * right])


def sample_places(motion: Motion, first: tuple[int, int], shape: tuple[int, int]) -> tuple[Float, Float]:
    """Compute the rows and the columns p of the samples of a crop, before the motion.

    Parameters
    ----------
    motion : Motion
        Downscale s, and the phase: with ``corner``, samples are at -(s - 1) / 2 to (s - 1) / 2 from s·i, else from s·i
        on.
    first, shape : (int, int)
        As in `frame_light`.

    Returns
    -------
    tuple of two ndarrays of float64, [h·s] and [w·s]
        Rows and columns, in high-resolution pixels.
    """
    step = motion.burst_downscale
    starts = (step * start + motion.pixel_offset for start in first)
    rows, columns = (np.arange(step * count, dtype=np.float64) + s for s, count in zip(starts, shape, strict=True))
    return rows, columns


def scene_box(
    motions: Iterable[Motion], shape: tuple[int, int], first: tuple[int, int] = (0, 0)
) -> tuple[int, int, int, int]:
    """Compute the rows and columns of the scene that frames, or crops of them, read.

    Parameters
    ----------
    motions : iterable of Motion
        Motion of each frame.
    shape : (int, int)
        Height and width of the frames, in low-resolution pixels.
    first : (int, int)
        First row and column of the crops.

    Returns
    -------
    tuple of four ints
        First row, first column, end of the rows, end of the columns; in the target, so that they may be negative.
    """
    y, x = zip(*(end for motion in motions for end in _end_positions(motion, first, shape)), strict=True)
    return math.floor(min(y)), math.floor(min(x)), math.ceil(max(y)) + 1, math.ceil(max(x)) + 1


def check_inside(
    light: Normalised, motion: Motion, corner: tuple[int, int], first: tuple[int, int], shape: tuple[int, int]
) -> None:
    """Check that the light of a scene contains all positions of a frame, or of a crop.

    The four corners decide: positions rise or fall along rows and columns, also in floating-point arithmetic.

    Parameters
    ----------
    light : ndarray of float32, [H, W, 3]
        Light of the scene.
    motion, corner, first, shape
        As in `frame_light`.

    Raises
    ------
    ValueError
        If a position is outside.
    """
    (top, left), (height, width) = corner, light.shape[:2]
    for y, x in _end_positions(motion, first, shape):
        if not (top <= y <= top + height - 1 and left <= x <= left + width - 1):
            raise ValueError(
                f"position={[y, x]}: outside of the light, which has rows {top} to {top + height - 1} and columns "
                f"{left} to {left + width - 1}; expected a position inside; take the light of the scene_box"
            )


def _end_positions(motion: Motion, first: tuple[int, int], shape: tuple[int, int]) -> list[tuple[float, float]]:
    """Compute the positions of the four corner samples of a crop."""
    rows, columns = (places[[0, -1]].tolist() for places in sample_places(motion, first, shape))
    return [motion.position(y, x) for y in rows for x in columns]
