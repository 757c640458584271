"""Sum the frames of one measurement, and estimate their noise: by site of the CFA, by row, by column, and fixed.

Frames are added one at a time. T is the temporal variance of a pixel, R of the mean of a row of W sites of a plane,
and V of the mean of a frame. T = σ² + σ_row² + V and R = σ_row² + σ²/W + V. Therefore
σ² = (T - R)·W/(W - 1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.calibration.deviations import Score
from unprocess_gen.calibration.planes import NEIGHBOURS, TILE, planes_of
from unprocess_gen.core.arrays import Bool, Float

ROUNDING_DN2 = 1 / 12
"""Variance of the rounding of values whose noise is not weak."""
WINDOW = 11
"""Side of the squares of sites of a plane whose mean is subtracted before fixed patterns are measured."""
SMOOTH = 1 - 1 / WINDOW**2
"""Part of the variance of independent sites that this leaves."""
INNER = (slice(WINDOW // 2, -(WINDOW // 2)),) * 2
"""Sites of a plane whose squares do not reach beyond the border."""
FAR, LEAST_FAR_DN = 8.0, 0.8 * 1.4826
"""Distance of defects from the other pixels in robust standard deviations, and the least one."""
PASSES = 4
"""Largest number of times that defects are searched; each pass removes what they add to the means of squares."""
FIXED = 3.0
"""Least deviation of defects in standard errors of the mean of their frames."""
STRUCK = 100.0
"""Largest value of one frame in standard deviations; cosmic rays exceed it, heavy tails hardly ever."""
ROBUST = 1.4826
"""Standard deviation of normal values over their median absolute deviation."""
LARGEST_Z = 5.0
"""Bound of the normalised differences whose correlation is measured."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """Noise of the frames of one measurement; arrays are by plane of `TILE`, variances in DN².

    ``shape`` is that of a plane. ``frame_means`` [frames, 4] are means of planes (DN), ``frame_variances`` [frames]
    follow from differences of sites. ``mean_dn`` is without defects. ``variance`` is that of a site in time, without
    offsets of rows. ``row``, ``column`` and ``fixed_column`` are variances of offsets of rows, of columns in one frame,
    and of columns in all frames, each with its standard error; ``row_correlation`` is that of neighbouring rows.
    ``fixed`` is the variance of the fixed pattern without what is smooth over `WINDOW` sites, ``hidden`` that of weak
    hot pixels in it (`Pattern`), ``codes`` [4, 65536] the histogram of the values, ``correlation`` the largest of pairs
    of neighbours in a difference of two frames, ``shading`` [4, 4] the means of sixteenths of the mean frame,
    ``column_offsets`` [4, W] the means of columns over those of their planes (DN).
    """

    count: int
    shape: tuple[int, int]
    frame_means: Float
    frame_variances: Float
    mean_dn: Float
    variance: Float
    error: Float
    row: tuple[float, float]
    column: tuple[float, float]
    fixed_column: tuple[float, float]
    row_correlation: tuple[float, float]
    fixed: Float
    fixed_error: Float
    hidden: Float
    codes: NDArray[np.int64]
    correlation: Score
    shading: Float
    column_offsets: Float

    @property
    def sites(self) -> int:
        """Sites of a plane."""
        return self.shape[0] * self.shape[1]

    @property
    def dsnu(self) -> Float:
        """Variance of the fixed pattern of the sites of each plane, without that of columns and of weak hot pixels."""
        columns = max(self.fixed_column[0], 0.0) * (1 - 1 / WINDOW) / SMOOTH
        return np.asarray(self.fixed - self.hidden - columns)


class Pattern(NamedTuple):
    """The fixed pattern of a plane: deviations of sites from the mean of the square around them, [H, W].

    ``is_far`` are the sites that are farther than ``limit``, and those that are known to be defects. They have no part
    in the means of squares, nor in ``columns`` [W], the means of columns over that of the plane. ``hot`` is the share
    of hot pixels above the limit that are not known, ``hidden`` the variance of those below it, if they are as dense
    there as up to half above it: an assumption.
    """

    deviation: Float
    is_far: Bool
    columns: Float
    limit: float
    hot: float
    hidden: float


NONE_KNOWN = np.zeros((4, 1, 1), bool)
"""No known defects."""


class FrameSums:
    """Sums over frames of equal light: of the values and of their squares, relative to the first frame."""

    def __init__(self) -> None:
        self._first: Any = None
        self._pair: Any = None
        self._rows, self._columns = list[Any](), list[Any]()
        self._variances = list[float]()
        self._codes = np.zeros((4, 2**16), np.int64)

    def add(self, pixels: NDArray[np.uint16]) -> None:
        """Add a frame, uint16 [H, W]."""
        planes = planes_of(pixels)
        self._codes += [np.bincount(plane.reshape(-1), minlength=2**16) for plane in planes]
        self._variances.append(float(np.mean(np.diff(pixels[::4, ::2].astype(np.float32), axis=1) ** 2)) / 2)
        self._rows.append([plane.mean(axis=1) for plane in planes])
        self._columns.append([plane.mean(axis=0) for plane in planes])
        if self._first is None:
            self._first = pixels
            self._sum, self._squares = np.zeros(pixels.shape, np.int32), np.zeros(pixels.shape, np.float32)
            return
        difference = pixels.astype(np.int32) - self._first
        self._pair = difference if self._pair is None else self._pair
        self._sum += difference
        self._squares += difference.astype(np.float32) ** 2

    def mean_frame(self) -> Float:
        """The mean of all frames, [H, W] DN."""
        return np.asarray(self._first + self._sum / np.float64(len(self._rows)))

    def measure(self, known: Bool = NONE_KNOWN) -> Measurement:
        """Estimate the noise of the frames, two or more, without the defects that are ``known`` [4, H, W]."""
        count, rows, columns = len(self._rows), np.array(self._rows), np.array(self._columns)
        height, width = rows.shape[2], columns.shape[2]
        means = rows.mean(axis=2)
        own_rows, own_columns = rows - means[..., None], columns - means[..., None]
        mean_frame = self.mean_frame()
        variances = (self._squares - self._sum.astype(np.float64) ** 2 / count) / (count - 1)
        planes = zip(planes_of(mean_frame), planes_of(variances), known, strict=True)
        self.patterns, defects, *numbers = zip(*(_plane(*plane, count) for plane in planes), strict=True)
        self.defects, (mean_dn, total, total_error, patterns, good) = np.array(defects), map(np.array, numbers)
        row_variance = rows.var(axis=0, ddof=1).mean(axis=1)
        # of all sites, because the means of rows contain defects
        noise = (np.array([plane.mean() for plane in planes_of(variances)]) - row_variance) * width / (width - 1)
        variance = total - (row_variance - noise / width)
        per_column = float(noise.mean()) / height
        row, correlation = _line_offsets(own_rows, 2, float(noise.mean()) / width / 2)
        column, _ = _line_offsets(own_columns, 1, per_column / 2)
        temporal = (variance * SMOOTH + max(row[0], 0.0) * (1 - 1 / WINDOW)) / count
        offsets, fixed = np.array([pattern.columns for pattern in self.patterns]), (patterns - temporal) / SMOOTH
        still = per_column / count + max(float(fixed.mean()), 0.0) / height
        return Measurement(
            count=count,
            shape=(height, width),
            frame_means=means,
            frame_variances=np.array(self._variances),
            mean_dn=mean_dn,
            variance=variance,
            error=np.hypot(total_error, row_variance * math.sqrt(2 / (height * (count - 1)))),
            row=row,
            column=column,
            fixed_column=_fixed_offsets(offsets, still, max(column[0], 0.0) / count),
            row_correlation=correlation,
            fixed=fixed,
            fixed_error=np.sqrt(2 / good) * patterns + total_error / count + _ripple(variance, fixed),
            hidden=np.array([pattern.hidden for pattern in self.patterns]),
            codes=self._codes,
            correlation=_correlation(self._pair),
            shading=_block_means(mean_frame),
            column_offsets=offsets,
        )


def find_pattern(plane: Float, known: Bool, least: float = 0.0) -> Pattern:
    """The fixed pattern of a plane; ``least`` is the least distance of far sites."""
    from scipy.ndimage import uniform_filter

    middle, is_far = np.median(plane), known | np.zeros(plane.shape, bool)
    for _ in range(PASSES):
        weights = np.maximum(uniform_filter(1.0 - is_far, WINDOW), 0.5 / WINDOW**2)
        smooth = middle + uniform_filter((plane - middle) * ~is_far, WINDOW) / weights
        distance, std = robust_std(plane - smooth, ~is_far)
        limit, before = max(FAR * std, least), is_far.sum()
        is_far = known | (distance > limit)
        if is_far.sum() == before:
            break
    deviation = plane - smooth
    new = (deviation * ~known)[INNER]
    hot, strong = (float((new > factor * limit).mean()) for factor in (1.0, 1.5))
    columns = np.where(is_far, smooth, plane).mean(axis=0)
    return Pattern(deviation, is_far, columns - columns.mean(), limit, hot, 2 * (hot - strong) * limit**2 / 3)


def robust_std(values: Any, used: Any = ...) -> tuple[Any, float]:
    """The distances of values from the median of those used, whose standard deviation without outliers follows."""
    distances = np.abs(values - np.median(values[used]))
    return distances, ROBUST * float(np.median(distances[used]))


def _plane(mean: Float, variances: Float, known: Bool, count: int) -> tuple[Any, ...]:
    """Pattern and defects; mean, variance, its error, variance of the fixed pattern, and number, of the other sites.

    A defect is far from its neighbours in all frames. A site with one far value, as heavy tails have it, is none.
    """
    pattern = find_pattern(mean, known, LEAST_FAR_DN)
    is_defect = known | (pattern.is_far & (pattern.deviation**2 >= FIXED**2 / count * variances))
    inner = variances[INNER]
    is_good = ~is_defect[INNER] & (inner <= STRUCK**2 / count * max(np.median(inner), 1 / 12))
    sites, own = float(is_good.sum()), inner[is_good]
    error = float(own.std()) / math.sqrt(sites)
    fixed = float(pattern.deviation[INNER][is_good].var())
    return pattern, is_defect, float(mean[INNER][is_good].mean()), float(own.mean()), error, fixed, sites


def _ripple(variance: Float, fixed: Float) -> Float:
    """The largest error of the variance of a fixed pattern by the rounding of values, whose phase is unknown."""
    pattern = np.maximum(fixed, 0.0)
    return np.asarray(4 * pattern * np.exp(-2 * math.pi**2 * np.clip(variance + pattern - ROUNDING_DN2, 0, 9)))


def _line_offsets(lines: Float, axis: int, noise: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Variance of offsets that are new in every frame, and the correlation of neighbours, each with its error.

    ``lines`` [frames, 4, N] are means of rows (``axis`` 2) or columns (1) of a plane, whose planes share the offset of
    a line of the sensor. ``noise`` is the variance of the mean of both.
    """
    full = lines.reshape(len(lines), 2, 2, -1).mean(axis=axis).transpose(0, 2, 1).reshape(len(lines), -1)
    offsets = full - full.mean(axis=0)
    degrees = (len(lines) - 1) * (offsets.shape[1] - 2)
    variance = float((offsets**2).sum()) / degrees
    lagged = float((offsets[:, 1:] * offsets[:, :-1]).sum()) / degrees
    own = variance - noise
    correlation = (lagged / own, variance / own / math.sqrt(degrees)) if own > 0 else (0.0, math.inf)
    return (own, variance * math.sqrt(2 / degrees)), correlation


def _fixed_offsets(columns: Float, noise: float, temporal: float) -> tuple[float, float]:
    """Variance of offsets of columns in all frames, and its error, from differences of neighbours: free of shading."""
    full = columns.reshape(2, 2, -1).mean(axis=0)  # planes of both rows of the tile
    variance = float(np.mean(np.diff(full, axis=1) ** 2)) / 2
    return variance - noise / 2 - temporal, variance * math.sqrt(3 / full.size)


def _correlation(difference: NDArray[np.int32]) -> Score:
    """Score the largest correlation of neighbours in the difference of two frames, without offsets of lines."""
    height, width = difference.shape
    z = np.zeros((height, width + 2), np.float32)  # the last two columns keep sites of other rows out
    for y, x in TILE:
        plane = difference[y::2, x::2].astype(np.float32)
        plane -= plane.mean(axis=1, keepdims=True)
        plane -= plane.mean(axis=0, keepdims=True)
        _, std = robust_std(plane)
        z[y::2, x:width:2] = np.clip(plane / max(std, 0.5), -LARGEST_Z, LARGEST_Z)
    square, flat = max(float((z * z).sum(dtype=np.float64)), 1.0), z.ravel()
    steps = [y * z.shape[1] + x for distances in NEIGHBOURS.values() for y, x in distances]
    largest = max((float(flat[step:] @ flat[:-step]) for step in steps), key=abs)
    return Score(largest / square, 1.0, 1 / difference.size, step=LARGEST_Z**2 / square)


def _block_means(frame: Float) -> Float:
    """The means of the sixteenths of a frame of even sides."""
    height, width = (length // 8 * 2 for length in frame.shape)
    return np.asarray(frame[: 4 * height, : 4 * width].reshape(4, height, 4, width).mean((1, 3)))
