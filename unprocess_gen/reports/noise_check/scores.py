"""Turn the sums of a pair into scores: statistics whose distribution is known if the noise is as recorded.

Derivations: ``docs/design/noise_check.md``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.types import Float
from unprocess_gen.reports.noise_check.expectation import LARGEST_Z, Cosine, chosen
from unprocess_gen.reports.noise_check.law import LineOffsets
from unprocess_gen.reports.noise_check.sums import LARGEST_DIFFERENCE, Sums

LEAST_SITES = 64
"""Fewest sites of a pair that is checked."""


class Score(NamedTuple):
    """Sum of a statistic over the sites of a pair, minus its expectation.

    Attributes
    ----------
    total : float
        The sum.
    variance : float
        Its variance due to noise.
    rounding : float
        Standard deviation due to the rounding of the clean frame, which pairs with the same curve and gains may share.
    fixed : float
        Standard deviation due to patterns that the frames of one body share.
    step : float
        Largest contribution of one site or line.
    above, below : float
        Largest expectation that the rounding of the clean frame can cause, and the negative of the smallest.
    information : float
        ``total / information`` estimates the difference of a quantity from its expected value.
    """

    total: float
    variance: float
    rounding: float = 0.0
    fixed: float = 0.0
    step: float = 0.0
    above: float = 0.0
    below: float = 0.0
    information: float = 1.0

    @property
    def excess(self) -> float:
        """Distance of the sum from the expectations that are possible."""
        return max(self.total - self.above, 0.0) + min(self.total + self.below, 0.0)

    @property
    def std(self) -> float:
        """Standard deviation of the sum."""
        return math.sqrt(self.variance + self.rounding**2 + self.fixed**2)

    @property
    def errors(self) -> float:
        """Excess in standard errors, with its sign."""
        return self.excess / self.std if self.std else 0.0

    @property
    def surprise(self) -> float:
        """Negative logarithm of a bound on the probability of an excess as large in one direction.

        Bernstein's inequality: P(excess > √(2·std²·x) + step·x/3) ≤ exp(-x). The bound holds for few sites too, where
        sums are not normally distributed.
        """
        root, step, excess = math.sqrt(2) * self.std, self.step / 3, abs(self.excess)
        if not excess or not root:
            return 0.0
        return (2 * excess / (root + math.sqrt(root * root + 4 * step * excess))) ** 2


Scores = dict[tuple[str, str], Score]
"""Scores by the names of check and plane; the plane is empty if all planes are summed."""


def scores_of(sums: Sums) -> Scores:
    """Return the scores of a pair.

    Parameters
    ----------
    sums : Sums
        Filled sums of a pair with at least `LEAST_SITES` usable sites.

    Returns
    -------
    Scores
        Scores of all checks for which the pair has sites.
    """
    planes = planes_of(sums)
    spread = _spread_of(sums, planes)
    scores: Scores = {("mean", plane.name): plane.location(np.ones_like(plane.count), 1) for plane in planes}
    scores["mean", ""] = _added(plane.location(np.ones_like(plane.count)) for plane in planes)
    scores["mean against signal", ""] = _added(plane.location(plane.expected.signal) for plane in planes)
    scores["variance", ""] = _added(plane.scale(np.ones_like(plane.count)) for plane in planes)
    gains = {plane.name: plane.scale(plane.expected.signal) for plane in planes}
    scores |= {("variance against signal", name): score for name, score in gains.items()}
    scores["variance against signal", ""] = _added(gains.values())
    scores["kurtosis", ""] = _added(plane.shape() for plane in planes)
    scores |= _line_scores(sums, spread) | _neighbour_scores(sums, planes, spread) | _partner_scores(sums, spread)
    return scores


# ---------------------------------------------------------------------------------------- mean, variance and kurtosis


class Plane:
    """Mean statistics of one plane by clean DN.

    Parameters
    ----------
    sums : Sums
        Filled sums of a pair.
    number : int
        Number of the plane in the tile.
    name : str
        Name of the plane.

    Attributes
    ----------
    number, name : int, str
        Number of the plane in the tile, and its name.
    dn, count : ndarray, [N]
        Clean DN that are used, and their numbers of sites.
    expected : Expectation
        Expectations at these DN.
    shift : ndarray of float64, [N]
        Mean of noisy minus clean and known offsets, DN.
    """

    def __init__(self, sums: Sums, number: int, name: str) -> None:
        self.number, self.name = number, name
        self.dn = np.flatnonzero(sums.usable[number] & (sums.counts[number] > 0))
        self.count = sums.counts[number][self.dn]
        self.expected = chosen(sums.tables[number], self.dn)
        z, cosine, double = (values[number][self.dn] / self.count for values in (sums.z, sums.cosine, sums.double))
        self.shift = self.expected.std * (z - self.expected.outlier_mean)
        self._cosine, self._double = cosine, double
        self._rounding_mean = self._mean_of_rounding(sums.counts[number])
        self._rows, self._sites_of_row = sums.law.rows, sums.width / 2
        self._is_linear = sums.law.plan.tone == "none" and sums.law.plan.gamma == 1

    def _mean_of_rounding(self, counts: Float) -> Float:
        """Return the mean of x minus the rounded value, with the density of x a line through the adjacent counts."""
        padded = np.concatenate([counts, [0.0]])
        slope = (padded[self.dn + 1] - padded[np.maximum(self.dn - 1, 0)]) / (24 * self.count)
        of = self.expected
        applies = (of.rounding_mean == 0) & (of.rounding_std > 0)
        return of.rounding_mean + np.where(applies, np.clip(slope, -1 / 12, 1 / 12), 0.0)

    def location(self, direction: Float, planes_in_row: int = 2) -> Score:
        """Return the score of a shift of the mean.

        Parameters
        ----------
        direction : ndarray of float64, [N]
            Shift for each clean DN, in units of the estimated quantity.
        planes_in_row : int
            Planes with common rows whose scores are added: 2 for the sum of all planes.

        Returns
        -------
        Score
            Sum weighted for the least variance.
        """
        of = self.expected
        noise = of.std**2 * of.variance / self.count
        weight = direction / (noise + of.rounding_std**2)
        rounding = np.abs(weight) * of.rounding_std
        # by Cauchy's inequality: the sites of a row have a common offset, whatever their clean DN
        row = self._rows.variance * self._rows.magnitudes * planes_in_row * self._sites_of_row
        return Score(
            total=float((weight * (self.shift - self._rounding_mean)).sum()),
            variance=float((weight**2 * (noise + row / self.count)).sum()),
            # codes of a linear curve are equidistant, so rounding errors of different values can be equal
            rounding=math.sqrt(3) * float(rounding.sum()) if self._is_linear else _root(rounding),
            fixed=_root(weight * of.std * np.sqrt(of.fixed_variance / self.count)),
            step=float((np.abs(weight) * of.std / self.count).max()) * LARGEST_Z,
            information=float((weight * direction).sum()),
        )

    def scale(self, direction: Float) -> Score:
        """Return the score of an increase of the variance by ``direction`` (array, one for each clean DN) in DN²."""
        of = self.expected.cosine
        noise = (of.variance + (of.slope * self.expected.std) ** 2) / self.count
        residual, gain = self._residual(of, self._cosine), of.by_variance * direction
        return self._cosine_score(residual, noise, of.unknown, of.fixed_variance, gain)

    def shape(self) -> Score:
        """Return the score of cos 2z, without what a change of the variance contributes."""
        of, one, two = self.expected, self.expected.cosine, self.expected.double
        ratio = two.by_variance / one.by_variance
        residual = self._residual(two, self._double) - ratio * self._residual(one, self._cosine)
        slope = two.slope - ratio * one.slope
        noise = two.variance + ratio**2 * one.variance - 2 * ratio * of.covariance + (slope * of.std) ** 2
        fixed = (np.sqrt(two.fixed_variance) + np.abs(ratio) * np.sqrt(one.fixed_variance)) ** 2
        unknown = two.unknown + np.abs(ratio) * one.unknown
        return self._cosine_score(residual, noise / self.count, unknown, fixed, np.ones_like(self.count))

    def variance_points(self) -> tuple[Float, Float]:
        """Return, for each clean DN, how much the variance differs from the expected one (DN²), and its variance."""
        of = self.expected.cosine
        noise = (of.variance + (of.slope * self.expected.std) ** 2) / self.count + of.unknown**2
        return self._residual(of, self._cosine) / of.by_variance, noise / of.by_variance**2

    def _residual(self, of: Cosine, mean: Float) -> Float:
        return np.asarray(mean - of.mean - of.slope * self.shift)

    def _cosine_score(self, residual: Float, noise: Float, unknown: Float, fixed: Float, gain: Float) -> Score:
        weight = gain / (noise + unknown**2)
        # the cosines of two sites of one row have a covariance of at most 4 (τ² · variance of row noise)²
        row = 8 * self._sites_of_row * self._rows.squares * (self._rows.variance / self.expected.std**2) ** 2
        return Score(
            total=float((weight * residual).sum()),
            variance=float((weight**2 * (noise + row / self.count)).sum()),
            rounding=_root(weight * unknown),
            fixed=_root(weight * np.sqrt(fixed / self.count)),
            step=float((np.abs(weight) / self.count).max()) * LARGEST_Z,
            information=float((weight * gain).sum()),
        )


def planes_of(sums: Sums) -> list[Plane]:
    """Return the statistics of the planes that have usable sites."""
    used = [bool((count * usable).any()) for count, usable in zip(sums.counts, sums.usable, strict=True)]
    return [Plane(sums, number, name) for number, name in enumerate(plane_names(sums.law.plan.pattern)) if used[number]]


def plane_names(pattern: str) -> list[str]:
    """Return the names of the planes in the order of the tile: R, B, and Gr or Gb for green next to red or blue."""
    rows = pattern[:2], pattern[2:]
    return [colour if colour != "G" else "Gr" if "R" in row else "Gb" for row in rows for colour in row]


def _root(values: Float) -> float:
    return math.sqrt(float((values * values).sum()))


def _added(scores: Iterable[Score]) -> Score:
    """Add scores of different sites of one pair, whose rounding errors are independent."""
    some = list(scores)
    return Score(
        total=sum(one.total for one in some),
        variance=sum(one.variance for one in some),
        rounding=math.hypot(*(one.rounding for one in some)),
        fixed=math.hypot(*(one.fixed for one in some)),
        step=max(one.step for one in some),
        information=sum(one.information for one in some),
    )


# -------------------------------------------------------------------------------------------------- rows and columns


class _Spread(NamedTuple):
    """Variance of z, the part of it that frames of one body share, and variance of the rounding errors, DN²."""

    variance: float
    fixed: float
    rounding_dn2: float


def _spread_of(sums: Sums, planes: Sequence[Plane]) -> _Spread:
    fixed = sum(float((plane.expected.fixed_variance * plane.count).sum()) for plane in planes)
    return _Spread(
        max(float(plane.expected.variance.max()) for plane in planes),
        fixed / sum(float(plane.count.sum()) for plane in planes),
        0.0 if sums.law.plan.clean_normalised else 1 / 12,
    )


def _line_scores(sums: Sums, spread: _Spread) -> Scores:
    """Return the scores of the variances of row and column offsets.

    The rounding of a smooth clean frame can move complete lines by up to half a DN. Differences of lines n and n + 2,
    and products of distant parts of a line, are almost free of it, with a third of the information.
    """
    scores, law = Scores(), sums.law
    of_rows, of_columns = (law.rows, law.row_differences), (LineOffsets(0.0), LineOffsets(0.0))
    for name, lines, (offsets, differences) in (
        ("row", sums.rows, of_rows),
        ("column", sums.columns, of_columns),
    ):
        count, parts = lines.shape[1:]
        scores[f"{name} means", ""] = _quadratic_score(lines, np.ones((parts, parts)), offsets, spread)
        if parts >= 3 and count >= 4:
            scores[f"{name} differences", ""] = _difference_score(lines, differences, spread)
    return scores


def _difference_score(lines: Float, differences: LineOffsets, spread: _Spread) -> Score:
    """Return the score of the variance of line offsets, from differences of lines.

    Parameters
    ----------
    lines : ndarray of float64, [3, lines, parts]
        `Sums.rows` or `Sums.columns`.
    differences : LineOffsets
        Differences of the offsets of lines n and n + 2.
    spread : _Spread
        Variances of z and of the rounding errors.

    Returns
    -------
    Score
        Sum over products of parts that are not adjacent.
    """
    parts = lines.shape[2]
    groups = lines[:, : lines.shape[1] // 4 * 4].reshape(3, -1, 2, 2, parts)
    (a, b, u), (c, d, v) = (groups[:, :, number].reshape(3, -1, parts) for number in (0, 1))
    total = np.where(b + d > 0, b + d, 1.0)
    place = np.arange(parts)
    distant = (np.abs(place[:, None] - place) >= 2).astype(np.float64)
    differing = np.stack([(a * d - c * b) / total, b * d / total, (u * d * d + v * b * b) / (total * total)])
    found = _quadratic_score(differing, distant, differences, spread._replace(rounding_dn2=0.0))
    return found._replace(information=2 * found.information)


def _quadratic_score(lines: Float, mask: Float, offsets: LineOffsets, spread: _Spread) -> Score:
    """Return the score of sums of products of the parts of lines.

    Parameters
    ----------
    lines : ndarray of float64, [3, lines, parts]
        Sums ``a`` of the parts, their information ``j``, and variances ``u``. In each line, ``a`` has the covariance
        ``spread.variance · diag(u) + offsets.variance · j jᵀ``.
    mask : ndarray of float64, [parts, parts]
        1 for the products that are added.
    offsets : LineOffsets
        Offsets of the lines.
    spread : _Spread
        Variances of z and of the rounding errors.

    Returns
    -------
    Score
        Sum over all lines.
    """
    (a, j, u), variance = lines, offsets.variance
    products = ((a @ mask) * a).sum(axis=1)
    masked = j @ mask
    pairs = (masked * j).sum(axis=1)
    excess = products - variance * pairs - spread.variance * (u @ np.diag(mask))
    own = spread.variance**2 * ((u @ mask) * u).sum(axis=1)
    cross = 2 * variance * spread.variance * (masked**2 * u).sum(axis=1)
    predicted = 2 * float((own + cross + offsets.squares * (variance * pairs) ** 2).sum())
    # rounding errors of neighbouring sites can be equal in a smooth frame, which increases the variance
    total_variance = max(predicted, float((excess**2).sum()))
    norm = float(mask.sum(axis=1).max())  # at least the largest eigenvalue
    return Score(
        total=float(excess.sum()),
        variance=total_variance,
        rounding=spread.rounding_dn2 * _root(pairs),
        fixed=spread.fixed * math.sqrt(total_variance),
        # a quadratic form of normal values exceeds √(2·variance·x) + 2·norm·x with probability exp(-x)
        step=6 * float((offsets.magnitudes * variance * pairs + norm * spread.variance * u.max(axis=1)).max()),
        above=spread.rounding_dn2 * float(pairs.sum()),
        information=float(pairs.sum()),
    )


# ---------------------------------------------------------------------------------------------- neighbours and sites


def _neighbour_scores(sums: Sums, planes: Sequence[Plane], spread: _Spread) -> Scores:
    """Return the scores of the correlation of horizontal and vertical neighbours of one plane."""
    scores, rows = Scores(), sums.law.rows
    squares = np.concatenate([plane.count / plane.expected.std**2 for plane in planes])
    for name, (product, pairs, inverse, inverse_squares), offset_dn2 in (
        ("horizontal neighbours", sums.neighbours[0], rows.variance),
        ("vertical neighbours", sums.neighbours[1], 0.0),  # the mean of each row is removed
    ):
        if pairs:
            scores[name, ""] = Score(
                total=product - offset_dn2 * inverse,
                variance=pairs * spread.variance**2
                + 4 * offset_dn2 * inverse
                + 2 * rows.squares * offset_dn2**2 * inverse_squares,
                rounding=spread.rounding_dn2 * _root(squares),
                fixed=spread.fixed * math.sqrt(pairs),
                step=LARGEST_Z**2,
                # rounding errors of neighbours are equal in a smooth frame
                above=spread.rounding_dn2 * inverse,
                information=pairs,
            )
    return scores


def _partner_scores(sums: Sums, spread: _Spread) -> Scores:
    """Return the scores of the agreement of noisy sites with the clean values of other sites of their tile."""
    scores = Scores()
    names = "diagonal sites", "horizontal sites", "vertical sites"
    row_dn2 = sums.law.rows.variance * sums.law.rows.magnitudes
    for name, (total, squares, rounding, information, scaled) in zip(names, sums.partners, strict=True):
        if information:
            scores[name, ""] = Score(
                total=total,
                variance=squares * spread.variance + row_dn2 * scaled * sums.width,
                fixed=math.sqrt(spread.fixed * squares),
                step=LARGEST_DIFFERENCE * LARGEST_Z,
                above=rounding,
                below=math.inf,  # a noisy site cannot be farther from its partner than from its own clean value
                information=information,
            )
    return scores
