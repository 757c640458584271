"""Sum the frames of one measurement, and estimate their noise: by site of the CFA, by row, by column, and fixed.

Frames are added one at a time. T is the temporal variance of a pixel, R of the mean of a row of W sites of a plane,
and V of the mean of a frame. T = σ² + σ_row² + V and R = σ_row² + σ²/W + V. Therefore
σ² = (T - R)·W/(W - 1).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import Float

TILE = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Places of the CFA tile; a plane is the set of all sites at one of them."""
NEIGHBOURS = {
    "adjacent sites": ((0, 1), (1, 0)),
    "diagonal sites": ((1, 1), (1, -1)),
    "neighbours": ((0, 2), (2, 0)),
    "diagonal neighbours": ((2, 2), (2, -2)),
}
"""Distances of the sites of pairs in rows and columns, by the name of the check of their correlation."""


def plane_names(pattern: str) -> list[str]:
    """Names of the planes in the order of the tile: R, B, and Gr or Gb for green next to red or blue.

    Without filters, row and column in the tile.
    """
    if pattern == "MONO":
        return ["00", "01", "10", "11"]
    rows = pattern[:2], pattern[2:]
    return [colour if colour != "G" else "Gr" if "R" in row else "Gb" for row in rows for colour in row]


WINDOW = 11
"""Side of the squares of sites of a plane whose mean is subtracted before fixed patterns are measured."""
SMOOTH = 1 - 1 / WINDOW**2
"""Part of the variance of independent sites that this leaves."""
FAR = 8.0
"""Distance of defects from the other pixels, in robust standard deviations."""
FIXED = 3.0
"""Least deviation of defects in standard errors of the mean of their frames."""
STRUCK = 100.0
"""Largest value of one frame in standard deviations; cosmic rays exceed it, heavy tails hardly ever."""
ROBUST = 1.4826
"""Standard deviation of normal values over their median absolute deviation."""
LARGEST_Z = 5.0
"""Bound of the normalised differences whose correlation is measured."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Noise of the frames of one measurement; arrays are by plane of `TILE`, variances in DN².

    Attributes
    ----------
    count, shape
        frames, and height and width of a plane
    frame_means, frame_variances
        mean of each plane of each frame, [frames, 4] DN; variance of a frame, from differences of sites, [frames] DN²
    mean_dn
        mean of the planes without defects
    variance, error
        temporal variance of a site without offsets of rows, and its standard error
    total
        temporal variance of a site with them
    row, column, fixed_column
        variance of offsets of rows, of columns in one frame, of columns in all frames; each with its standard error
    row_correlation
        correlation of the offsets of neighbouring rows, and its standard error
    fixed, fixed_error
        variance of the fixed pattern of sites, without its part that is smooth over `WINDOW` sites
    codes
        histogram of the values, [4, 65536]
    correlation
        correlation of pairs of neighbours in a difference of two frames, by `NEIGHBOURS`
    blocks
        least and largest mean of a sixteenth of the frame, DN
    full_share
        share of values at or above white
    row_profile, column_profile
        means of the rows of the first frame and of the columns of all frames, minus the means of the planes
    """

    count: int
    shape: tuple[int, int]
    frame_means: Float
    frame_variances: Float
    mean_dn: Float
    variance: Float
    error: Float
    total: Float
    row: tuple[float, float]
    column: tuple[float, float]
    fixed_column: tuple[float, float]
    row_correlation: tuple[float, float]
    fixed: Float
    fixed_error: Float
    codes: NDArray[np.int64]
    correlation: dict[str, float]
    blocks: tuple[float, float]
    full_share: float
    row_profile: Float
    column_profile: Float

    @property
    def sites(self) -> int:
        """Sites of a plane."""
        return self.shape[0] * self.shape[1]


class FrameSums:
    """Sums over frames of equal light: of the values and of their squares, relative to the first frame."""

    def __init__(self, white_dn: float) -> None:
        self._white_dn = white_dn
        self._first: NDArray[np.uint16] | None = None
        self._pair: NDArray[np.int32] | None = None
        self._sum: Any = None
        self._squares: Any = None
        self._rows, self._columns = list[Any](), list[Any]()
        self._variances = list[float]()
        self._codes = np.zeros((4, 2**16), np.int64)

    def add(self, pixels: NDArray[np.uint16]) -> None:
        """Add a frame, uint16 [H, W]."""
        planes = [pixels[y::2, x::2] for y, x in TILE]
        for codes, plane in zip(self._codes, planes, strict=True):
            codes += np.bincount(plane.reshape(-1), minlength=2**16)
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
        """Return the mean of all frames, [H, W] DN."""
        assert self._first is not None
        return np.asarray(self._first + self._sum / np.float64(len(self._rows)))

    def column_offsets(self) -> Float:
        """Return the mean of each column minus the mean of its plane, [4, W/2]; zeros if frames are too few for it."""
        means = np.mean(self._columns, axis=0)
        return np.asarray(means - means.mean(axis=1, keepdims=True))

    def measure(self) -> Measured:
        """Estimate the noise of the frames; two or more."""
        count, rows, columns = len(self._rows), np.array(self._rows), np.array(self._columns)
        height, width = rows.shape[2], columns.shape[2]
        means = rows.mean(axis=2)
        own = (rows - means[..., None], columns - means[..., None])
        mean_frame = self.mean_frame()
        variances = (self._squares - self._sum.astype(np.float64) ** 2 / count) / (count - 1)
        planes = [_plane(mean_frame[y::2, x::2], variances[y::2, x::2], count) for y, x in TILE]
        mean_dn, total, total_error, patterns, good = (np.array(values) for values in zip(*planes, strict=True))
        drift = means.var(axis=0, ddof=1)
        row_variance = rows.var(axis=0, ddof=1).mean(axis=1)
        variance = (total - row_variance) * width / (width - 1)
        error = np.hypot(total_error, row_variance * math.sqrt(2 / (height * (count - 1))))
        noise = variance / width
        row, correlation = _line_offsets(own[0], 2, float(noise.mean()) / 2)
        column, _ = _line_offsets(own[1], 1, float(variance.mean()) / height / 2)
        temporal = (variance * SMOOTH + max(row[0], 0.0) * (1 - 1 / WINDOW)) / count
        return Measured(
            count=count,
            shape=(height, width),
            frame_means=means,
            frame_variances=np.array(self._variances),
            mean_dn=mean_dn,
            variance=variance,
            error=error,
            total=total - drift,
            row=row,
            column=column,
            fixed_column=_fixed_offsets(
                own[1].mean(axis=0), float(variance.mean()) / height / count, max(column[0], 0.0) / count
            ),
            row_correlation=correlation,
            fixed=(patterns - temporal) / SMOOTH,
            fixed_error=np.sqrt(2 / good) * patterns + total_error / count,
            codes=self._codes,
            correlation=_correlations(self._pair),
            blocks=_blocks(mean_frame),
            full_share=float(self._codes[:, math.floor(self._white_dn) :].sum() / self._codes.sum()),
            row_profile=own[0][0].reshape(2, 2, -1).mean(axis=1).T.ravel(),
            column_profile=own[1].mean(axis=0).reshape(2, 2, -1).mean(axis=0).T.ravel(),
        )


def summed(frames: Iterable[NDArray[np.uint16]], white_dn: float) -> FrameSums:
    """Return the sums of frames."""
    sums = FrameSums(white_dn)
    for pixels in frames:
        sums.add(pixels)
    return sums


def high_passed(plane: Float) -> Float:
    """Return a plane without the mean of the square around each site; sites near the border are omitted."""
    from scipy.ndimage import uniform_filter

    edge = WINDOW // 2
    return np.asarray((plane - uniform_filter(plane, WINDOW))[edge:-edge, edge:-edge])


def _plane(mean: Float, variances: Float, count: int) -> tuple[float, float, float, float, float]:
    """Return mean, variance, its error, variance of the fixed pattern, and number, of sites that are no defects.

    A defect is far from its neighbours in all frames. A site with one far value, as heavy tails have it, is none.
    """
    edge = WINDOW // 2
    pattern = high_passed(mean)
    deviation = np.abs(pattern - np.median(pattern))
    inner = variances[edge:-edge, edge:-edge]
    is_far = deviation > FAR * ROBUST * max(float(np.median(deviation)), 0.1)
    is_good = (~is_far | (deviation**2 < FIXED**2 / count * inner)) & (
        inner <= STRUCK**2 / count * max(np.median(inner), 1 / 12)
    )
    sites = float(is_good.sum())
    return (
        float(mean[edge:-edge, edge:-edge][is_good].mean()),
        float(inner[is_good].mean()),
        float(inner[is_good].std()) / math.sqrt(sites),
        float(pattern[is_good].var()),
        sites,
    )


def _line_offsets(lines: Float, axis: int, noise: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return variance of offsets that are new in every frame, and the correlation of neighbours, each with its error.

    ``lines`` [frames, 4, N] are means of rows or columns of a plane. The planes of a row or column of the sensor share
    its offset: ``axis`` 2 for rows, 1 for columns. ``noise`` is the variance of the mean of both.
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
    """Return the variance of offsets of columns in all frames, from differences of neighbours, and its error.

    Differences are free of shading, which is smooth. ``noise`` is the variance of the mean of a column of a plane.
    """
    full = columns.reshape(2, 2, -1).mean(axis=0)  # planes of both rows of the tile
    variance = float(np.mean(np.diff(full, axis=1) ** 2)) / 2
    return variance - noise / 2 - temporal, variance * math.sqrt(3 / full.size)


def _correlations(difference: NDArray[np.int32] | None) -> dict[str, float]:
    """Return the correlations of pairs of neighbours in the difference of two frames, without offsets of lines."""
    assert difference is not None
    z = difference.astype(np.float32)
    for y, x in TILE:
        plane = z[y::2, x::2]
        plane -= plane.mean(axis=1, keepdims=True)
        plane -= plane.mean(axis=0, keepdims=True)
        plane /= max(float(np.median(np.abs(plane))) * ROBUST, 0.5)
    z = np.clip(z, -LARGEST_Z, LARGEST_Z)
    square = float((z * z).mean(dtype=np.float64)) or 1.0
    result = {}
    for name, distances in NEIGHBOURS.items():
        products = [
            float((z[dy:, max(dx, 0) : z.shape[1] + min(dx, 0)] * _shifted(z, dy, dx)).mean(dtype=np.float64))
            for dy, dx in distances
        ]
        result[name] = max(products, key=abs) / square
    return result


def _shifted(z: Any, dy: int, dx: int) -> Any:
    return z[: z.shape[0] - dy, max(-dx, 0) : z.shape[1] - max(dx, 0)]


def _blocks(frame: Float) -> tuple[float, float]:
    """Return the least and the largest mean of a sixteenth of a frame."""
    height, width = (length // 8 * 2 for length in frame.shape)
    blocks = frame[: height * 4, : width * 4].reshape(4, height, 4, width).mean(axis=(1, 3))
    return float(blocks.min()), float(blocks.max())
