"""Sum the statistics of a pair over its sites: plane by plane, in eight horizontal strips."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import DarkPixels, Float, Patch, Plan
from unprocess_gen.reports.noise_check.expectation import FAR_Z, LARGEST_Z, Expectation, PlaneNoise, bin_width
from unprocess_gen.simulation.effects.expectation import NORMAL_DISTANCE, Site
from unprocess_gen.statistics.mosaics import NEIGHBOURS, TILE, neighbour_products

Single = NDArray[np.float32]

SEGMENTS = 8
"""Parts into which lines are divided."""
SAMPLED = 3
"""Distance of the rows and of the columns that are compared with the pair before."""
LARGEST_SAMPLE = 3.0
"""Bound of z in these rows and columns."""


class Plane:
    """Sites of one plane, and the sums of their statistics by bin of the clean value.

    Attributes
    ----------
    noise : PlaneNoise
        The recorded noise.
    row_sites : int
        Sites of a row.
    bins, count : ndarray, [N]
        Numbers of the bins that are checked, and of their sites.
    expected : Expectation
        Expectations in these bins.
    """

    def __init__(self, noise: PlaneNoise, clean: Any, noisy: Any) -> None:
        self.noise, self._clean, self._noisy = noise, clean, noisy
        self.row_sites = int(clean.shape[1])
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
        self._mean = self._table(self.expected.rounding_mean / self.expected.std)
        self._sums = np.zeros((5, self._unused + 1))

    @property
    def means(self) -> Float:
        """Means of z, of cos z, of the clean value minus the middle of its bin (DN), and shares beyond `FAR_Z`, [5, N].

        The shares are those below -`FAR_Z` and above `FAR_Z`.
        """
        return np.asarray(self._sums[:, self.bins] / self.count)

    def defects(self) -> tuple[int, int]:
        """Numbers of defects that must be outliers, and of those that are none."""
        certain = missing = 0
        (low, high), is_counted = self.noise.limits, np.zeros(self._clean.shape, bool)
        for defects in reversed(self.noise.defects):  # the last effect decides, if a pixel has two defects
            place = defects.y, defects.x
            clean_dn = self._clean[place].astype(np.float64)
            signal = self.noise.signal(clean_dn)
            variance, mean = self.noise.variance(signal), defects.level_dn - signal * defects.replaces
            # Poisson counts, whose variance is at most their mean, must not hide it
            spread = NORMAL_DISTANCE * np.sqrt(variance + self.noise.site.gain_dn * np.abs(mean))
            far = FAR_Z * np.sqrt(variance)
            is_certain = (np.abs(mean) > far + spread) & (clean_dn - far > low) & (clean_dn + far < high)
            is_outlier = (self._noisy[place] - clean_dn) * np.sign(mean) > far
            is_certain &= ~is_counted[place]
            is_counted[place] = True
            certain += int(is_certain.sum())
            missing += int((is_certain & ~is_outlier).sum())
        return certain, missing

    def row_sums(self, values: Float) -> Float:
        """Sum values of the checked bins, [K, N], over the sites of each row, [K, H/2]."""
        bins = self._bins_of_sites(np.s_[:])
        return np.stack([self._table(row).take(bins).sum(axis=1, dtype=np.float64) for row in values])

    def add_strip(self, rows: slice) -> tuple[Single, Single]:
        """Add the sites of some rows to the sums; their z minus its mean, and 1 / std, which is 0 for unused sites."""
        bins, clean = self._bins_of_sites(rows), self._clean[rows]
        weight = self._weight.take(bins)
        noise = np.subtract(self._noisy[rows], clean, dtype=np.float32) - self._offset_dn[rows]
        noise *= weight
        z = np.clip(noise, -LARGEST_Z, LARGEST_Z)
        values = [z, np.cos(z)]
        if self.noise.site.plan.output.clean_normalised:
            values.append(clean - bins * self._bin_dn)
        for total, value in zip(self._sums, values, strict=False):
            total += np.bincount(bins.ravel(), value.ravel(), len(total))
        for total, is_far in zip(self._sums[3:], (noise < -FAR_Z, noise > FAR_Z), strict=True):
            total += np.bincount(bins[is_far], minlength=len(total))
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


class SparseNoise(NamedTuple):
    """Limited z without the means of rows, 1 / std, both in every third row and column; largest share of patterns."""

    z: Single
    inverse: Single
    fixed: float


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
    fixed : float
        Mean fraction of the variance of z that frames of one body share.
    rows : ndarray of float64, [3, 2, H/2, segments]
        For each part of even and odd rows: sums of z / std and of 1 / std², and the variance of the former without the
        offset of the row.
    columns : ndarray of float64, [3, 2, W/2, segments]
        The same for columns, from z without the weighted mean of each row of a plane.
    products : dict of str to float
        Sums of the products of z, without the weighted mean of each row of a plane, for `NEIGHBOURS`.
    bits : ndarray of float64, [2]
        Sites whose noisy value has the last bit, and the last but one; 0 in frames that are not rounded.
    sample : SparseNoise
        Values that are compared with the values of the next pair.
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
        self._noisy = None if plan.output.normalised else noisy

    def fill(self) -> None:
        """Add all sites."""
        row_starts, column_starts = (_segment_starts(length // 2) for length in (self.height, self.width))
        self.rows = np.zeros((3, 2, self.height // 2, len(column_starts)))
        self.columns = np.zeros((3, 2, self.width // 2, len(row_starts)))
        self.products, self.bits, sample = dict.fromkeys(NEIGHBOURS, 0.0), np.zeros(2), []
        for part, (top, bottom) in enumerate(itertools.pairwise([*row_starts, self.height // 2])):
            # columns of zeros keep products of sites in other rows out
            sites = np.zeros((2, 2 * (bottom - top), self.width + 2), np.float32)
            for plane, (y, x) in zip(self.planes, TILE, strict=True):
                z, weight = plane.add_strip(np.s_[top:bottom])
                row_sums, column_sums, residual, removed = _line_sums(
                    z, weight, plane.noise.row_variance, column_starts
                )
                self.rows[:, y, top:bottom] += row_sums
                self.columns[:, x, :, part] += column_sums
                self.products["neighbours"] += removed
                sites[:, y::2, x : self.width : 2] = residual, weight
            for name, products in neighbour_products(sites[0]).items():
                self.products[name] += sum(products)
            sample.append(sites[:, -2 * top % SAMPLED :: SAMPLED, : self.width : SAMPLED])
            if self._noisy is not None:
                codes, is_used = self._noisy[2 * top : 2 * bottom, : self.width], sites[1, :, : self.width] > 0
                self.bits += [np.count_nonzero((codes & bit != 0) & is_used) for bit in (1, 2)]
        fixed = max(float(plane.expected.fixed.max(initial=0.0)) for plane in self.planes)
        z_sample, inverse = np.concatenate(sample, axis=1)
        self.sample = SparseNoise(np.clip(z_sample, -LARGEST_SAMPLE, LARGEST_SAMPLE), inverse, fixed)


def _segment_starts(length: int) -> list[int]:
    """Starts of up to `SEGMENTS` parts of a line."""
    count = max(1, min(SEGMENTS, length // 2))
    return [number * length // count for number in range(count)]


def _line_sums(z: Single, weight: Single, row_variance: float, starts: list[int]) -> tuple[Float, Float, Single, float]:
    """Sums of a strip for `Sums.rows`, [3, H, segments], for `Sums.columns`, [3, W]; z without the means of rows.

    The last value is the sum of the products of horizontal neighbours that removing the means of rows takes away.
    """
    square = weight * weight
    own = square - np.float32(row_variance) * square * square
    rows = np.stack([np.add.reduceat(values, starts, axis=1) for values in (z * weight, square, own)])
    score, information, spread = rows.sum(axis=2, dtype=np.float64)
    information = np.maximum(information, np.finfo(np.float32).tiny)
    residual = z - (score / information).astype(np.float32)[:, None] * weight
    columns = np.stack([values.sum(axis=0) for values in (residual * weight, square, own)])
    across = (weight[:, 1:] * weight[:, :-1]).sum(axis=1)
    return rows, columns, residual, float(spread / information @ (across / information))
