"""Compute the light of a scene and of the frames of a burst; equal to `reference.burst` to the last bit.

A frame has s x s bilinear values for each pixel. One vector holds two neighbours, as they are in memory::

    load(light, 3 * (row * width + column))     [ R  G  B  R' G' B'  -  - ]
    weights                                     [ 1-f 1-f 1-f  f  f  f  0  0 ]

Products are summed in such vectors; at the end, the halves are added. Positions are computed for a row of samples at a
time, in a loop that LLVM vectorises.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float, Normalised, Srgb, last_code
from unprocess_gen.simulation.kernels import simd
from unprocess_gen.simulation.kernels.jit import by_class, inner, kernel
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, Pointer, Vector, pointer_to
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.profiles import light_tables
from unprocess_gen.simulation.reference.burst import MOST_SCENE_LIGHT, Motion, check_inside, phase_offset
from unprocess_gen.simulation.reference.primaries import light_colours
from unprocess_gen.simulation.reference.unprocess import dequantise

# ---------------------------------------------------------------------------------------------------------------- scene


class CodeCurves(NamedTuple):
    """Light of each code of red, green and blue."""

    red: Float
    green: Float
    blue: Float


class NoCurves(NamedTuple):
    """Mark pixels that are light."""

    codes: int = 0


class SceneColours(NamedTuple):
    """Numbers that convert linear RGB to the light of the camera."""

    matrix: tuple[float, ...]
    gains: tuple[float, ...]  # inverse gains of the channels
    headroom: tuple[float, ...]  # factors of the highlight term of each channel, or 0
    gray_mean: bool
    threshold: float
    divisor: float


def scene_light(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Normalised:
    """Light of a scene in all three channels, as `reference.burst.scene_light`."""
    isp, (matrix, gains) = plan.isp, light_colours(plan.source, plan.camera)
    has_term = isp.highlight == "per_channel"
    headroom = tuple([max(1 - gain, 0.0) * has_term for gain in gains])
    threshold = float(isp.highlight_threshold)
    colours = SceneColours(matrix, gains, headroom, isp.highlight == "gray_mean", threshold, 1 - threshold)
    pixels = _contiguous(dequantise(srgb, plan, origin))
    curves: CodeCurves | NoCurves = NoCurves()
    if not plan.source.is_linear:
        curves = CodeCurves(*light_tables(plan.source.profile, isp.tone, isp.gamma, last_code(pixels) + 1))
    light = np.empty(pixels.shape, np.float32)
    _fill_scene(curves, pixels.reshape(-1), colours, light.reshape(-1))
    return light


def _contiguous(pixels: Any) -> Any:
    """Return an array of the one kind for which kernels are compiled: a view would be another type."""
    return pixels if type(pixels) is np.ndarray and pixels.flags.carray else np.array(pixels, order="C")


_linear = by_class(
    {
        CodeCurves: lambda curves, codes, n: (
            curves.red[codes[n]], curves.green[codes[n + 1]], curves.blue[codes[n + 2]],
        ),
        NoCurves: lambda curves, light, n: (np.float64(light[n]), np.float64(light[n + 1]), np.float64(light[n + 2])),
    }
)  # fmt: skip
"""Linear RGB of the pixel that begins at element n; arguments: curves, pixels, n."""


@kernel
def _fill_scene(curves: Any, pixels: NDArray[Any], colours: SceneColours, light: Normalised) -> None:
    """Fill ``light`` from ``pixels``; both are flat."""
    matrix, gains, threshold, divisor = colours.matrix, colours.gains, colours.threshold, colours.divisor
    for n in range(0, pixels.size, 3):
        r, g, b = _linear(curves, pixels, n)
        rgb = (
            (matrix[0] * r + matrix[1] * g) + matrix[2] * b,
            (matrix[3] * r + matrix[4] * g) + matrix[5] * b,
            (matrix[6] * r + matrix[7] * g) + matrix[8] * b,
        )
        gray = (((rgb[0] + rgb[1]) + rgb[2]) / 3.0) if colours.gray_mean else 0.0
        for channel in range(3):
            i, gain, headroom = rgb[channel], gains[channel], colours.headroom[channel]
            value = i * gain
            if gray > threshold:
                m = (gray - threshold) / divisor
                value = i * max(m * m + (1.0 - m * m) * gain, gain)
            if i > threshold:
                m = (i - threshold) / divisor
                value += i * (m * m) * headroom
            light[n + channel] = max(min(value, MOST_SCENE_LIGHT), -MOST_SCENE_LIGHT)


# --------------------------------------------------------------------------------------------------------------- frames


class SampleGrid(NamedTuple):
    """Places of the samples of a crop, before the motion."""

    step: int
    offset: float
    first: tuple[int, int]
    corner: tuple[int, int]  # of the light


class SampleRow(NamedTuple):
    """Buffers of one row of samples: where each begins in the light, and its distance from the top left neighbour."""

    start: NDArray[np.int64]
    down: NDArray[np.float32]
    right: NDArray[np.float32]


_WEIGHTS = np.array([[1, 1, 1, 0, 0, 0, 0, 0], [-1, -1, -1, 1, 1, 1, 0, 0]], np.float32)
"""Weights of a vector for f = 0, and their slope in f."""


def frame_light(
    light: Normalised, motion: Motion, corner: tuple[int, int], first: tuple[int, int], shape: tuple[int, int]
) -> Normalised:
    """Light of a frame of a burst or of a crop of it, as `reference.burst.frame_light`."""
    check_inside(light, motion, corner, first, shape)
    light, step = _contiguous(light), motion.burst_downscale
    affine = (
        *(float(motion.motion_yy), float(motion.motion_yx), float(motion.motion_y)),
        *(float(motion.motion_xy), float(motion.motion_xx), float(motion.motion_x)),
    )
    count = shape[1] * step
    samples = SampleRow(np.empty(count, np.int64), np.empty(count, np.float32), np.empty(count, np.float32))
    tail = np.zeros(2 * VECTOR_WIDTH, np.float32)  # the last elements of the light: vectors may begin in any
    end = light.reshape(-1)[-VECTOR_WIDTH:]
    tail[VECTOR_WIDTH - end.size : VECTOR_WIDTH] = end
    totals, out = np.empty(VECTOR_WIDTH * shape[1], np.float32), np.empty((*shape, 3), np.float32)
    grid = SampleGrid(step, phase_offset(motion), (int(first[0]), int(first[1])), (int(corner[0]), int(corner[1])))
    _fill_frame(light, tail, affine, grid, samples, totals, out)
    return out


@kernel
def _fill_frame(
    light: Normalised,
    tail: Normalised,
    affine: tuple[float, ...],
    grid: SampleGrid,
    samples: SampleRow,
    totals: Normalised,
    out: Normalised,
) -> None:
    """Fill ``out``, row by row; ``tail`` continues the light by zeros from its last eight elements on."""
    step, safe = grid.step, light.size - VECTOR_WIDTH
    area = np.float32(step * step)
    pixels, end, sums = pointer_to(light, 0), pointer_to(tail, 0), pointer_to(totals, 0)
    for i in range(out.shape[0]):
        totals[:] = np.float32(0)
        for m in range(step):
            _locate(light.shape, affine, grid, step * (grid.first[0] + i) + m, samples)
            _add_row(pixels, end, safe, 3 * light.shape[1] if light.shape[0] > 1 else 0, samples, step, sums)
        for j in range(out.shape[1]):
            for channel in range(3):
                left, right = totals[VECTOR_WIDTH * j + channel], totals[VECTOR_WIDTH * j + 3 + channel]
                out[i, j, channel] = (left + right) / area


@inner
def _locate(shape: tuple[int, ...], affine: tuple[float, ...], grid: SampleGrid, row: int, samples: SampleRow) -> None:
    """Fill the buffers for one row of samples."""
    yy, yx, y0, xy, xx, x0 = affine
    py, first = row + grid.offset, grid.step * grid.first[1]
    # the last row is the bottom neighbour of the one above it; the right neighbour of the last column has the weight 0
    top, left, last = float(grid.corner[0]), float(grid.corner[1]), float(grid.corner[0] + max(shape[0] - 2, 0))
    for k in range(samples.start.size):
        px = (first + k) + grid.offset
        y, x = yy * py + yx * px + y0, xy * py + xx * px + x0
        row_above, column = min(np.floor(y), last), np.floor(x)
        samples.start[k] = np.int64(((row_above - top) * shape[1] + (column - left)) * 3.0)
        samples.down[k], samples.right[k] = y - row_above, x - column


@inner
def _add_row(
    pixels: Pointer, end: Pointer, safe: int, below: int, samples: SampleRow, step: int, sums: Pointer
) -> None:
    """Add one row of samples to the sums of the pixels; neighbours in the next row are ``below`` elements away."""
    flat, slope = simd.load(pointer_to(_WEIGHTS, 0), 0), simd.load(pointer_to(_WEIGHTS, 0), VECTOR_WIDTH)
    one = np.float32(1)
    for j in range(samples.start.size // step):
        row = flat * np.float32(0)
        for k in range(j * step, (j + 1) * step):
            start, down = samples.start[k], samples.down[k]
            top, bottom = _pair(pixels, end, safe, start), _pair(pixels, end, safe, start + below)
            row = row + (top * (one - down) + bottom * down) * (flat + slope * samples.right[k])
        simd.store(sums, VECTOR_WIDTH * j, simd.load(sums, VECTOR_WIDTH * j) + row)


@inner
def _pair(pixels: Pointer, end: Pointer, safe: int, start: int) -> Vector:
    """Load two neighbours."""
    return simd.load(end, start - safe) if start > safe else simd.load(pixels, start)
