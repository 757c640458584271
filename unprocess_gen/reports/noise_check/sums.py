"""Sum the statistics of a pair over its sites.

``z`` is noisy minus expected DN over the expected standard deviation, and bounded (`expectation.LARGEST_Z`). Sites that
cannot be checked have weight 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.reports.noise_check.expectation import (
    LARGEST_Z,
    Expectation,
    Mask,
    expectations,
    spread,
    usable_values,
)
from unprocess_gen.reports.noise_check.law import NoiseLaw

if TYPE_CHECKING:
    from unprocess_gen.reports.noise_check.site_sums import PlaneTables

TILE = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Sites of the tile of the CFA; a plane is the set of all sites at one of these places."""

SEGMENTS = 8
"""Parts into which lines are divided."""

LEAST_DIFFERENCE_DN = 2.0
"""Least difference of two rounded clean values at which their sites are compared, DN."""
LARGEST_DIFFERENCE = 3.0
"""Bound of the difference in standard deviations of the noise."""

BLOCK_SITES = 2**18
"""Sites whose variance is computed at once in frames without rounding: 10 MB of scratch memory."""


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
    rows : ndarray of float64, [3, H, segments]
        Sums of z / std and of 1 / std² in each part of each row, and the variance of the former without the offset of
        the row.
    columns : ndarray of float64, [3, W, segments]
        The same for columns, from z without the mean of each row.
    neighbours : ndarray of float64, [2, 4]
        For horizontal and vertical neighbours of one plane: sum of products of z, number of pairs, sum of the products
        of 1 / std, and sum over rows of the square of the latter. The vertical ones are without the mean of each row.
    partners : ndarray of float64, [3, 5]
        For each kind of `site_sums.PARTNERS`, with n the difference of the noise of both sites, s its standard
        deviation, and d the difference of their clean values over s, limited: sums of d·n/s, d², |d|/s, 2d times the
        difference over s without limit, and (d/s)².
    """

    def __init__(self, law: NoiseLaw, clean: Any, noisy: Any) -> None:
        from unprocess_gen.reports.noise_check.site_sums import count_sites  # imports Numba

        self.law = law
        self.height, self.width = int(clean.shape[0]) // 2 * 2, int(clean.shape[1]) // 2 * 2
        # kernels are compiled for contiguous arrays
        self._clean, self._noisy = (np.ascontiguousarray(one[: self.height, : self.width]) for one in (clean, noisy))
        self._offsets = law.offsets(self.height, self.width)
        self._size = int(self._clean.max(initial=0)) + 2
        self.counts = np.zeros((4, self._size))
        count_sites(self._clean, self._offsets, self.counts)
        tables = [self._table(number) for number in range(4 if law.differs_by_site else 1)]
        self.usable, self.tables = ([*some] * (4 // len(tables)) for some in zip(*tables, strict=True))
        self.sites = int(sum(count[usable].sum() for count, usable in zip(self.counts, self.usable, strict=True)))

    def _table(self, plane: int) -> tuple[Mask, Expectation]:
        law, site = self.law.of_site(plane), TILE[plane]
        at = np.flatnonzero(self.counts.any(axis=0))
        at = at[usable_values(law, at.astype(np.float64), site)]
        usable = np.zeros(self._size, dtype=np.bool_)
        usable[at] = True
        return usable, spread(expectations(law, at.astype(np.float64), site), at, self._size)

    def fill(self) -> None:
        """Compute all sums."""
        from unprocess_gen.reports.noise_check.site_sums import SiteSums, add_sites  # imports Numba

        row_starts, column_starts = (np.array(_segment_starts(length)) for length in (self.width, self.height))
        sums = SiteSums(
            z=np.zeros((4, self._size)),
            cosine=np.zeros((4, self._size)),
            double=np.zeros((4, self._size)),
            rows=np.zeros((3, self.height, len(row_starts))),
            columns=np.zeros((3, len(column_starts), self.width)),
            neighbours=np.zeros((2, 4)),
            partners=np.zeros((3, 5)),
        )
        is_rounded = not self.law.plan.clean_normalised
        weights = np.zeros((0, 0), np.float32) if is_rounded else self._weights()
        frames = self._clean, self._noisy, self._offsets
        add_sites(*frames, weights, row_starts, column_starts, self._plane_tables(is_rounded), sums)
        self.z, self.cosine, self.double = sums.z, sums.cosine, sums.double
        self.rows, self.columns = sums.rows, sums.columns.transpose(0, 2, 1)
        self.neighbours, self.partners = sums.neighbours, sums.partners

    def _plane_tables(self, is_rounded: bool) -> PlaneTables:
        from unprocess_gen.reports.noise_check.site_sums import PlaneTables

        inverse, mean = (np.zeros((4, self._size)) for _ in range(2))
        cosine, double = (np.zeros((4, self._size, 2)) for _ in range(2))
        for plane, (usable, of) in enumerate(zip(self.usable, self.tables, strict=True)):
            inverse[plane, usable] = 1 / of.std[usable]
            mean[plane] = of.rounding_mean * inverse[plane] + of.outlier_mean
            for values, expected in ((cosine, of.cosine), (double, of.double)):
                values[plane, :, 0], values[plane, :, 1] = expected.by_clean, expected.by_square
        least = LEAST_DIFFERENCE_DN if is_rounded else 0.0
        row_dn2 = self.law.rows.variance
        return PlaneTables(inverse, mean, cosine, double, row_dn2, LARGEST_Z, least, LARGEST_DIFFERENCE)

    def _weights(self) -> NDArray[np.float32]:
        """Return 1 / std of each site of a clean frame that is not rounded, [H, W]."""
        weights = np.empty((self.height, self.width), np.float32)
        rows = max(1, BLOCK_SITES // max(self.width, 1))
        for number, site in enumerate(TILE):
            law, of_site = self.law.of_site(number), np.s_[site[0] :: 2, site[1] :: 2]
            for top in range(0, self.height // 2, rows):
                clean = self._clean[of_site][top : top + rows]
                std = np.sqrt(law.variance(law.signal(clean, site)))
                weights[of_site][top : top + rows] = np.divide(1.0, std, out=np.zeros_like(std), where=std > 0)
        return weights


def _segment_starts(length: int) -> list[int]:
    """Return the even starts of up to `SEGMENTS` parts of a line."""
    count = max(1, min(SEGMENTS, length // 4))
    return sorted({number * length // count // 2 * 2 for number in range(count)})
