"""Sum the statistics of a pair over its sites: plane by plane, in eight horizontal strips."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import DarkPixels, Float, Patch, Plan
from unprocess_gen.reports.noise_check.expectation import LARGEST_Z, Expectation, PlaneNoise, bin_width
from unprocess_gen.simulation.effects.expectation import Site

Single = NDArray[np.float32]

TILE = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Places of the CFA tile; a plane is the set of all sites at one of them."""

SEGMENTS = 8
"""Parts into which lines are divided."""


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
        self._offset_dn = np.broadcast_to(np.nan_to_num(noise.offset_dn), clean.shape)
        self._gaps = np.isnan(noise.offset_dn) if np.isnan(noise.offset_dn).any() else None
        self._unused = round(max(float(clean.max(initial=0)), 0.0) / bin_dn) + 1
        counts = np.bincount(self._bins_of_sites(np.s_[:]).ravel(), minlength=self._unused + 1)
        bins = np.flatnonzero(counts[:-1])
        self.bins = bins[noise.is_usable(np.float64(bin_dn) * bins, bin_dn)]
        self.count = counts[self.bins].astype(np.float64)
        self.expected = Expectation(noise, np.float64(bin_dn) * self.bins, bin_dn)
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
        """Sum values of the checked bins, [K, N], over the sites of each row, [K, H/2]."""
        bins = self._bins_of_sites(np.s_[:])
        return np.stack([self._table(row).take(bins).sum(axis=1, dtype=np.float64) for row in values])

    def add_strip(self, rows: slice) -> tuple[Single, Single]:
        """Add the sites of some rows to the sums; their z minus its mean, and 1 / std, which is 0 for unused sites."""
        bins, clean = self._bins_of_sites(rows), self._clean[rows]
        weight = self._weight.take(bins)
        noise = np.subtract(self._noisy[rows], clean, dtype=np.float32) - self._offset_dn[rows]
        z = np.clip(noise * weight, -LARGEST_Z, LARGEST_Z)
        values = [z, np.cos(z)]
        if self.noise.site.plan.output.clean_normalised:
            values.append(clean - bins * self._bin_dn)
        for total, value in zip(self._sums, values, strict=False):
            total += np.bincount(bins.ravel(), value.ravel(), len(total))
        return z - self._mean.take(bins), weight

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
        if self._gaps is not None:
            bins[self._gaps[rows]] = self._unused
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
        self.sites = int(sum(plane.count.sum() for plane in self.planes))
        self.fixed = sum(float(plane.count @ plane.expected.fixed) for plane in self.planes) / max(self.sites, 1)
        self.variance = max(float(plane.expected.variance.max(initial=1.0)) for plane in self.planes)

    def fill(self) -> None:
        """Add all sites."""
        row_starts, column_starts = (_segment_starts(length // 2) for length in (self.height, self.width))
        self.rows = np.zeros((3, 2, self.height // 2, len(column_starts)))
        self.columns = np.zeros((3, 2, self.width // 2, len(row_starts)))
        self.neighbours = np.zeros(3)
        for part, (top, bottom) in enumerate(itertools.pairwise([*row_starts, self.height // 2])):
            for plane, (y, x) in zip(self.planes, TILE, strict=True):
                z, weight = plane.add_strip(np.s_[top:bottom])
                row_sums, column_sums, products = _line_sums(z, weight, plane.noise.row_variance, column_starts)
                self.rows[:, y, top:bottom] += row_sums
                self.columns[:, x, :, part] += column_sums
                self.neighbours += products


def _segment_starts(length: int) -> list[int]:
    """Starts of up to `SEGMENTS` parts of a line."""
    count = max(1, min(SEGMENTS, length // 2))
    return [number * length // count for number in range(count)]


def _line_sums(z: Single, weight: Single, row_variance: float, starts: list[int]) -> tuple[Float, Float, Float]:
    """Sums of a strip for `Sums.rows`, [3, H, segments], for `Sums.columns`, [3, W], and for `Sums.neighbours`, [3]."""
    square = weight * weight
    own = square - np.float32(row_variance) * square * square
    rows = np.stack([np.add.reduceat(values, starts, axis=1) for values in (z * weight, square, own)])
    score, information, spread = rows.sum(axis=2, dtype=np.float64)
    information = np.maximum(information, np.finfo(np.float32).tiny)
    residual = z - (score / information).astype(np.float32)[:, None] * weight
    columns = np.stack([values.sum(axis=0) for values in (residual * weight, square, own)])
    across, down = (side[:, 1:] * side[:, :-1] for side in (weight, weight.T))
    products = [(side[:, 1:] * side[:, :-1]).sum(dtype=np.float64) for side in (residual, residual.T)]
    # removing the mean of a row makes its sites correlated
    removed = spread / information @ (across.sum(axis=1) / information)
    pairs = np.count_nonzero(across) + np.count_nonzero(down)
    return rows, columns, np.array([sum(products) + removed, pairs, across.sum() + down.sum()])
