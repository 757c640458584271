"""Sum the statistics of a pair over its sites, block by block.

``z`` is noisy minus expected DN over the expected standard deviation, and bounded (`expectation.LARGEST_Z`). Sites that
cannot be checked have weight 0.
"""

from __future__ import annotations

import bisect
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.types import Float
from unprocess_gen.reports.noise_check.expectation import (
    LARGEST_Z,
    Expectation,
    Mask,
    expectations,
    spread,
    usable_values,
)
from unprocess_gen.reports.noise_check.law import NoiseLaw

TILE = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Sites of the tile of the CFA; a plane is the set of all sites at one of these places."""

PARTNERS = (((0, 3), (1, 2)), ((0, 1), (2, 3)), ((0, 2), (1, 3)))
"""Planes whose sites are compared: diagonal, horizontal and vertical partners."""

SEGMENTS = 8
"""Parts into which lines are divided."""

LEAST_DIFFERENCE_DN = 2.0
"""Least difference of two rounded clean values at which their sites are compared, DN."""
LARGEST_DIFFERENCE = 3.0
"""Bound of the difference in standard deviations of the noise."""

BLOCK_SITES = 2**18
"""Sites of a block of rows: 20 MB of scratch memory."""


class Sums:
    """Sums over the sites of a pair, from which all scores follow.

    Parameters
    ----------
    law : NoiseLaw
        The predicted noise.
    clean, noisy : ndarray of uint16 or float64, [H, W]
        Mosaics in DN; an odd last row or column is not used.

    Attributes
    ----------
    counts : ndarray of float64, [4, N]
        Sites by plane and clean DN.
    usable : list of ndarray of bool, [N]
        Clean DN that are checked, by plane.
    tables : list of Expectation
        Expectations for every clean DN, by plane.
    z, cosine, double : ndarray of float64, [4, N]
        Sums of z, cos z and cos 2z by plane and clean DN.
    rows : ndarray of float64, [2, H, segments]
        Sums of z / std and of 1 / std² in each part of each row.
    columns : ndarray of float64, [2, W, segments]
        The same for columns.
    neighbours : ndarray of float64, [2, 3]
        For horizontal and vertical neighbours of one plane: sum of products of z, number of pairs, and sum of the
        products of 1 / std.
    partners : ndarray of float64, [3, 5]
        For each kind of `PARTNERS`, with n the difference of the noise of both sites, s its standard deviation, and d
        the difference of their clean values over s, limited: sums of d·n/s, d², |d|/s, 2d times the difference over s
        without limit, and (d/s)².
    """

    def __init__(self, law: NoiseLaw, clean: Any, noisy: Any) -> None:
        self.law = law
        self.height, self.width = int(clean.shape[0]) // 2 * 2, int(clean.shape[1]) // 2 * 2
        self._clean, self._noisy = clean[: self.height, : self.width], noisy[: self.height, : self.width]
        self._size = int(self._clean.max(initial=0)) + 2
        self.counts = np.stack([self._histogram(site) for site in TILE])
        # without fixed patterns in the clean frame, the expectations are equal in all planes
        tables = [self._table(site) for site in (TILE if law.plan.averaged else TILE[:1])]
        self.usable, self.tables = ([*some] * (4 // len(tables)) for some in zip(*tables, strict=True))
        self.sites = int(sum(count[usable].sum() for count, usable in zip(self.counts, self.usable, strict=True)))

    def _histogram(self, site: tuple[int, int]) -> Float:
        counts = np.zeros(self._size)
        for top in range(0, self.height, self._block_rows):
            block = self._clean[top : top + self._block_rows]
            counts += np.bincount(_nearest(block[site[0] :: 2, site[1] :: 2]).ravel(), minlength=self._size)
        return counts

    @property
    def _block_rows(self) -> int:
        return max(2, BLOCK_SITES // max(self.width, 1) // 2 * 2)

    def _table(self, site: tuple[int, int]) -> tuple[Mask, Expectation]:
        at = np.flatnonzero(self.counts.any(axis=0))
        at = at[usable_values(self.law, at.astype(np.float64), site)]
        usable = np.zeros(self._size, dtype=np.bool_)
        usable[at] = True
        return usable, spread(expectations(self.law, at.astype(np.float64), site), at, self._size)

    def fill(self) -> None:
        """Compute all sums."""
        self.z, self.cosine, self.double = (np.zeros((4, self._size)) for _ in range(3))
        self._row_parts, self._column_parts = _segment_starts(self.width), _segment_starts(self.height)
        self.rows = np.zeros((2, self.height, len(self._row_parts)))
        self.columns = np.zeros((2, self.width, len(self._column_parts)))
        self.neighbours, self.partners = np.zeros((2, 3)), np.zeros((3, 5))
        for top in range(0, self.height, self._block_rows):
            self._add_block(top, min(top + self._block_rows, self.height))

    def _add_block(self, top: int, bottom: int) -> None:
        z, weight = (np.empty((bottom - top, self.width), np.float32) for _ in range(2))
        clean, noisy = self._clean[top:bottom], self._noisy[top:bottom]
        for plane, (y, x) in enumerate(TILE):
            at = slice(y, None, 2), slice(x, None, 2)
            z[at], weight[at] = self._add_plane(plane, clean[at], noisy[at])
        self._add_lines(top, bottom, z, weight)
        self._add_neighbours(z, weight)
        for kind, planes in enumerate(PARTNERS):
            for first, second in planes:
                self._add_partners(kind, clean, z, weight, TILE[first], TILE[second])

    def _add_plane(self, plane: int, clean: Any, noisy: Any) -> tuple[Any, Any]:
        """Add the sites of a plane to the sums by clean DN; return z without its mean, and 1 / std."""
        table, usable, (y, x) = self.tables[plane], self.usable[plane], TILE[plane]
        inverse = np.divide(1.0, table.std, out=np.zeros(self._size), where=usable).astype(np.float32)
        dn = _nearest(clean)
        weight = inverse[dn]
        if self.law.plan.clean_normalised:
            variance = self.law.variance(self.law.signal(clean, (y, x)))
            weight = np.divide(1.0, np.sqrt(variance), out=np.zeros(clean.shape), where=weight > 0).astype(np.float32)
        offset = self.law.offset_dn[y, x : self.width : 2].astype(np.float32)
        z = np.clip((np.subtract(noisy, clean, dtype=np.float32) - offset) * weight, -LARGEST_Z, LARGEST_Z)
        cosine = np.cos(z)
        double = 2 * cosine * cosine - 1
        if self.law.plan.clean_normalised and usable.any():
            known = np.flatnonzero(usable)
            for values, of in ((cosine, table.cosine), (double, table.double)):
                values -= np.interp(clean, known, of.mean[known]) - of.mean[dn]
        flat = dn.ravel()
        for sums, values in ((self.z, z), (self.cosine, cosine), (self.double, double)):
            sums[plane] += np.bincount(flat, weights=values.ravel(), minlength=self._size)
        mean = (table.rounding_mean * inverse + table.outlier_mean).astype(np.float32)
        return z - mean[dn], weight

    def _add_lines(self, top: int, bottom: int, z: Any, weight: Any) -> None:
        first = bisect.bisect_right(self._column_parts, top) - 1
        last = bisect.bisect_left(self._column_parts, bottom)
        starts = [max(start - top, 0) for start in self._column_parts[first:last]]
        for number, values in enumerate((z * weight, weight * weight)):
            self.rows[number, top:bottom] = np.add.reduceat(values, self._row_parts, axis=1, dtype=np.float64)
            self.columns[number, :, first:last] += np.add.reduceat(values, starts, axis=0, dtype=np.float64).T

    def _add_neighbours(self, z: Any, weight: Any) -> None:
        used = (weight > 0).astype(np.float32)
        everything = slice(None)
        for direction, (before, after) in enumerate(
            (((everything, slice(None, -2)), (everything, slice(2, None))), ((slice(None, -2),), (slice(2, None),)))
        ):
            self.neighbours[direction] += [_dot(values[before], values[after]) for values in (z, used, weight)]

    def _add_partners(
        self, kind: int, clean: Any, z: Any, weight: Any, first: tuple[int, int], second: tuple[int, int]
    ) -> None:
        y, x = ([slice(place[axis], None, 2) for place in (first, second)] for axis in (0, 1))
        w, v = (weight[y[place], x[place]] for place in (0, 1))
        difference = np.subtract(clean[y[1], x[1]], clean[y[0], x[0]], dtype=np.float32)
        is_rounded = not self.law.plan.clean_normalised
        chosen = (np.abs(difference) >= (LEAST_DIFFERENCE_DN if is_rounded else 0.0)) & (w > 0) & (v > 0)
        at = np.flatnonzero(chosen.ravel())
        first_std, second_std = 1 / w.ravel()[at], 1 / v.ravel()[at]
        scale = 1 / np.sqrt(first_std * first_std + second_std * second_std)
        # a common offset of both sites cancels
        noise = z[y[0], x[0]].ravel()[at] * first_std - z[y[1], x[1]].ravel()[at] * second_std
        step = difference.ravel()[at] * scale
        limited = np.clip(step, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
        scaled = limited * scale
        self.partners[kind] += (
            _dot(scaled, noise),
            _dot(limited, limited),
            float(np.abs(scaled).sum(dtype=np.float64)) if is_rounded else 0.0,
            2 * _dot(limited, step),
            _dot(scaled, scaled),
        )


def _nearest(clean: Any) -> NDArray[np.intp]:
    if clean.dtype == np.uint16:
        return np.asarray(clean, dtype=np.intp)
    return np.asarray(np.rint(np.maximum(clean, 0.0)), dtype=np.intp)


def _dot(a: Any, b: Any) -> float:
    return float(np.einsum("i,i->" if a.ndim == 1 else "ij,ij->", a, b, dtype=np.float64))


def _segment_starts(length: int) -> list[int]:
    """Return the even starts of up to `SEGMENTS` parts of a line."""
    count = max(1, min(SEGMENTS, length // 4))
    return sorted({number * length // count // 2 * 2 for number in range(count)})
