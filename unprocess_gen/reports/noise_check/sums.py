"""Sum the statistics of a pair over its sites: plane by plane, in eight horizontal strips."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import DarkPixels, Float, Patch, Plan
from unprocess_gen.reports.noise_check.expectation import LARGEST_Z, PlaneNoise, bin_width, expectation
from unprocess_gen.simulation.effects.expectation import Site

Single = NDArray[np.float32]

TILE = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Places of the CFA tile; a plane is the set of all sites at one of them."""
DIAGONAL = ((0, 3), (1, 2))
"""Planes whose sites are compared."""

SEGMENTS = 8
"""Parts into which lines are divided."""
LEAST_DIFFERENCE_DN = 2.0
"""Least difference of two rounded clean values at which their sites are compared, DN."""
LARGEST_DIFFERENCE = 3.0
"""Bound of the difference in standard deviations of the noise."""


class Strip(NamedTuple):
    """Sites of a plane in some rows: clean value (DN), z minus its mean, and 1 / std, which is 0 for unused sites."""

    clean: Any
    z: Single
    weight: Single


class Plane:
    """Sites of one plane, and the sums of their statistics by bin of the clean value.

    Attributes
    ----------
    noise : PlaneNoise
        The recorded noise.
    bins, count : ndarray, [N]
        Numbers of the bins that are checked, and of their sites.
    expected : Expectation
        Expectations in these bins.
    """

    def __init__(self, noise: PlaneNoise, clean: Any, noisy: Any) -> None:
        self.noise, self._clean, self._noisy = noise, clean, noisy
        self._bin_dn = bin_dn = bin_width(noise)
        self._unused = round(max(float(clean.max(initial=0)), 0.0) / bin_dn) + 1
        counts = np.bincount(self._bins_of_sites(np.s_[:]).ravel(), minlength=self._unused + 1)
        bins = np.flatnonzero(counts[:-1])
        self.bins = bins[noise.is_usable(np.float64(bin_dn) * bins, bin_dn)]
        self.count = counts[self.bins].astype(np.float64)
        self.expected = expectation(noise, np.float64(bin_dn) * self.bins, bin_dn)
        self._weight = self._table(1 / self.expected.std)
        self._mean = self._table(self.expected.rounding_mean / self.expected.std + self.expected.defect_mean)
        self._sums = np.zeros((3, self._unused + 1))

    @property
    def row_sites(self) -> int:
        """Sites of a row."""
        return int(self._clean.shape[1])

    @property
    def means(self) -> Float:
        """Means of z, of cos z, and of the clean value minus the middle of its bin (DN), [3, N]."""
        return np.asarray(self._sums[:, self.bins] / self.count)

    def row_sums(self, values: Float) -> Float:
        """Sum values of the checked bins over the sites of each row, [H/2]."""
        return np.asarray(self._table(values)[self._bins_of_sites(np.s_[:])].sum(axis=1, dtype=np.float64))

    def add_strip(self, rows: slice) -> Strip:
        """Add the sites of some rows to the sums."""
        bins, clean = self._bins_of_sites(rows), self._clean[rows]
        weight, offset_dn = self._weight[bins], self._offset_dn(rows)
        noise = np.subtract(self._noisy[rows], clean, dtype=np.float32) - offset_dn
        z = np.clip(noise * weight, -LARGEST_Z, LARGEST_Z)
        values = [z, np.cos(z)]
        if self.noise.site.plan.output.clean_normalised:
            values.append(clean - bins * self._bin_dn)
        for total, value in zip(self._sums, values, strict=False):
            total += np.bincount(bins.ravel(), value.ravel(), len(total))
        return Strip(clean, z - self._mean[bins], weight)

    def _offset_dn(self, rows: slice) -> Any:
        offset_dn = self.noise.offset_dn
        return np.nan_to_num(offset_dn[rows]) if offset_dn.ndim == 2 else offset_dn

    def _table(self, values: Float) -> Single:
        table = np.zeros(self._unused + 1, np.float32)
        table[self.bins] = values
        return table

    def _bins_of_sites(self, rows: slice) -> NDArray[np.intp]:
        """Bins of the sites of some rows; the last bin for sites that cannot be checked."""
        clean = self._clean[rows]
        if self.noise.site.plan.output.clean_normalised:
            clean = np.rint(np.maximum(clean, 0.0) / self._bin_dn)
        bins = clean.astype(np.intp)
        if self.noise.offset_dn.ndim == 2:
            bins[np.isnan(self.noise.offset_dn[rows])] = self._unused
        return np.asarray(bins)


class Sums:
    """Sums over the sites of a pair, from which all scores follow.

    Parameters
    ----------
    plan, patch : Plan, Patch
        Plan of the pair, and its part of the full frame.
    clean, noisy : ndarray of uint16 or float64, [H, W]
        Mosaics in DN; an odd last row or column is not used.
    dark_pixels : DarkPixels or None
        Access to the dark frames of the dataset.

    Attributes
    ----------
    planes : list of Plane
        The four planes.
    sites : int
        Sites that are checked.
    variance, fixed : float
        Largest variance of z, and mean fraction of it that frames of one body share.
    rows : ndarray of float64, [3, 2, H/2, segments]
        For each part of even and odd rows: sums of z / std and of 1 / std², and the variance of the former without the
        offset of the row.
    columns : ndarray of float64, [3, 2, W/2, segments]
        The same for columns, from z without the weighted mean of each row of a plane.
    neighbours : ndarray of float64, [3]
        For horizontal and vertical neighbours of a plane: sum of the products of z, without the weighted mean of each
        row, number of products, and sum of the products of 1 / std.
    diagonal : ndarray of float64, [5]
        With n the difference of the noise of diagonal sites, s its standard deviation, and d the difference of their
        clean values over s, limited: sums of d·n/s, d², |d|/s, 2d times the difference over s without limit, (d/s)².
    """

    def __init__(self, plan: Plan, patch: Patch, clean: Any, noisy: Any, dark_pixels: DarkPixels | None) -> None:
        self.plan = plan
        self.height, self.width = clean.shape[0] // 2 * 2, clean.shape[1] // 2 * 2
        self.planes = [
            Plane(
                PlaneNoise(Site(plan, patch, (y, x), dark_pixels)),
                clean[y : self.height : 2, x : self.width : 2],
                noisy[y : self.height : 2, x : self.width : 2],
            )
            for y, x in TILE
        ]
        sites, fixed = zip(
            *((plane.count.sum(), plane.count @ plane.expected.fixed) for plane in self.planes), strict=True
        )
        self.sites = int(sum(sites))
        self.fixed = float(sum(fixed)) / max(self.sites, 1)
        self.variance = max(float(plane.expected.variance.max(initial=1.0)) for plane in self.planes)

    def fill(self) -> None:
        """Add all sites."""
        row_starts, column_starts = (_segment_starts(length // 2) for length in (self.height, self.width))
        self.rows = np.zeros((3, 2, self.height // 2, len(column_starts)))
        self.columns = np.zeros((3, 2, self.width // 2, len(row_starts)))
        self.neighbours, self.diagonal = np.zeros(3), np.zeros(5)
        for part, (top, bottom) in enumerate(itertools.pairwise([*row_starts, self.height // 2])):
            strips = [plane.add_strip(np.s_[top:bottom]) for plane in self.planes]
            for strip, plane, (y, x) in zip(strips, self.planes, TILE, strict=True):
                row_sums, column_sums, products = _line_sums(strip, plane.noise.row_variance, column_starts)
                self.rows[:, y, top:bottom] += row_sums
                self.columns[:, x, :, part] += column_sums
                self.neighbours += products
            for first, second in DIAGONAL:
                self.diagonal += _agreement(
                    strips[first], strips[second], is_rounded=not self.plan.output.clean_normalised
                )


def _segment_starts(length: int) -> list[int]:
    """Starts of up to `SEGMENTS` parts of a line."""
    count = max(1, min(SEGMENTS, length // 2))
    return [number * length // count for number in range(count)]


def _line_sums(strip: Strip, row_variance: float, starts: list[int]) -> tuple[Float, Float, Float]:
    """Sums of a strip for `Sums.rows`, [3, H, segments], for `Sums.columns`, [3, W], and for `Sums.neighbours`, [3]."""
    square = strip.weight * strip.weight
    own = square - np.float32(row_variance) * square * square
    rows = np.stack([np.add.reduceat(values, starts, axis=1) for values in (strip.z * strip.weight, square, own)])
    score, information, spread = rows.sum(axis=2, dtype=np.float64)
    information = np.maximum(information, np.finfo(np.float32).tiny)
    residual = strip.z - (score / information).astype(np.float32)[:, None] * strip.weight
    columns = np.stack([values.sum(axis=0) for values in (residual * strip.weight, square, own)])
    across, down = (weight[:, 1:] * weight[:, :-1] for weight in (strip.weight, strip.weight.T))
    products = [(z[:, 1:] * z[:, :-1]).sum(dtype=np.float64) for z in (residual, residual.T)]
    # removing the mean of a row makes its sites correlated
    removed = spread / information @ (across.sum(axis=1) / information)
    pairs = np.count_nonzero(across) + np.count_nonzero(down)
    return rows, columns, np.array([sum(products) + removed, pairs, across.sum() + down.sum()])


def _agreement(first: Strip, second: Strip, is_rounded: bool) -> Float:
    """Sums of two strips for `Sums.diagonal`; sites that are not used get an infinite standard deviation."""
    difference = np.subtract(second.clean, first.clean, dtype=np.float32)
    if is_rounded:
        difference[np.abs(difference) < LEAST_DIFFERENCE_DN] = 0
    std, other_std = (1 / np.maximum(strip.weight, np.float32(1e-30)) for strip in (first, second))
    scale = 1 / np.hypot(std, other_std)
    step = difference * scale
    limited = np.clip(step, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
    scaled = limited * scale
    noise = first.z * std - second.z * other_std
    products = scaled * noise, limited * limited, np.abs(scaled) * is_rounded, 2 * limited * step, scaled * scaled
    return np.array([values.sum(dtype=np.float64) for values in products])
