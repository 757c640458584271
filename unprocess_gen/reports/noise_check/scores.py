"""Turn the sums of a pair into scores: statistics whose distribution is known if the noise is as recorded.

Derivations: ``docs/design/noise_check.md``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.types import Float
from unprocess_gen.reports.noise_check.expectation import LARGEST_Z, PlaneNoise
from unprocess_gen.reports.noise_check.sums import LARGEST_SAMPLE, Plane, SparseNoise, Sums
from unprocess_gen.statistics.mosaics import NEIGHBOURS, plane_names
from unprocess_gen.statistics.scores import UNFORESEEN, Score

LEAST_SITES = 64
"""Fewest sites of a pair that is checked."""
TAIL_ERROR = 0.05
"""Relative error of expected numbers of outliers, because tails add to other noise."""


Scores = dict[tuple[str, str], Score]
"""Scores by the names of check and plane; the plane is empty if all planes are summed."""


@np.errstate(under="ignore")
def scores_of(sums: Sums) -> Scores:
    """Compute the scores of all checks for which a pair with filled sums has sites."""
    names = plane_names(sums.plan.sensor.pattern)
    planes = {name: plane for name, plane in zip(names, sums.planes, strict=True) if len(plane.bins)}
    means = {name: mean_points(plane) for name, plane in planes.items()}
    variances = {name: variance_points(plane) for name, plane in planes.items()}
    mean, variance = joined_points(means.values()), joined_points(variances.values())
    scores = {("mean", name): points.score() for name, points in means.items()}
    scores |= {("variance against signal", name): points.score(points.signal) for name, points in variances.items()}
    scores["mean", ""], scores["mean against signal", ""] = mean.score(), mean.score(mean.signal)
    scores["variance", ""], scores["variance against signal", ""] = variance.score(), variance.score(variance.signal)
    has_rounding = not sums.plan.output.clean_normalised
    rounding_dn2 = has_rounding * rounding_variance(mean, 1 / 12)
    scores |= {(name, ""): _neighbour_score(sums, name, rounding_dn2) for name in NEIGHBOURS}
    if min(abs(gain - 1) for gain in (sums.plan.camera.red_gain, sums.plan.camera.blue_gain)) > 0.1:
        # rounding errors of values whose ratio is not 1 have a correlation of at most ½, that of the ratio 2
        half_dn2 = has_rounding * rounding_variance(mean, 1 / 24)
        scores["adjacent sites", ""] = _neighbour_score(sums, "adjacent sites", half_dn2)
    scores["odd codes", ""], scores["pairs of codes", ""] = (_code_score(sums, bit) for bit in range(2))
    scores["outliers", ""], scores["defects", ""] = _outlier_score(sums), _defect_score(sums)
    return scores | _line_scores(sums, rounding_dn2)


# ------------------------------------------------------------------------------------------------ mean and variance


class Points(NamedTuple):
    """Differences of a quantity from its expectation in each bin of the clean value.

    Attributes
    ----------
    signal, difference : ndarray of float64, [N]
        Signals in DN above black, and the differences.
    noise, rows : ndarray of float64, [N]
        Variance of the differences: due to noise that is independent at each site, and due to the offsets of rows.
    fixed : ndarray of float64, [N]
        Fraction of ``noise`` that frames of one body share.
    rounding : ndarray of float64, [N]
        Standard deviation of the differences due to the rounding of the clean frame.
    unknown : ndarray of float64, [N]
        Largest size of differences due to rounding where it has no known distribution.
    step : ndarray of float64, [N]
        Largest contribution of one site.
    """

    signal: Float
    difference: Float
    noise: Float
    rows: Float
    fixed: Float
    rounding: Float
    unknown: Float
    step: Float

    @property
    def weight(self) -> Float:
        """Weight of each bin: the inverse of its variance."""
        return 1 / (self.noise + self.rounding**2 + self.unknown**2 / 3)

    def score(self, direction: Float | float = 1.0) -> Score:
        """Score of a quantity that changes the bins by ``direction``, with the weights of the least variance."""
        weight = direction * self.weight
        unknown = float(weight @ self.unknown)
        return Score(
            total=float(weight @ self.difference),
            information=float((weight * direction).sum()),
            variance=float(weight**2 @ (self.noise + self.rows)),
            rounding=float(np.linalg.norm(weight * self.rounding)),
            fixed=math.sqrt(float(weight**2 @ (self.noise * self.fixed))),
            step=float(np.abs(weight * self.step).max()),
            low=-unknown,
            high=unknown,
        )


def joined_points(points: Iterable[Points]) -> Points:
    """Points of all planes."""
    return Points(*map(np.concatenate, zip(*points, strict=True)))


def mean_points(plane: Plane) -> Points:
    """Mean of noisy minus clean and known offsets, DN."""
    expected, count, offsets = plane.expected, plane.count, row_offsets(plane.noise)
    return Points(
        signal=expected.signal,
        difference=_mean_noise(plane) - expected.rounding_mean,
        noise=expected.std**2 / count,
        # Cauchy's inequality: the sites of a row have a common offset, whatever their clean value
        rows=2 * plane.row_sites * offsets.variance * offsets.magnitudes / count,
        fixed=expected.fixed,
        rounding=expected.rounding_std * (expected.unknown_dn == 0),
        unknown=expected.unknown_dn,
        step=LARGEST_Z * expected.std / count,
    )


def variance_points(plane: Plane) -> Points:
    """Variance of the noise, DN²: (mean of cos z - expectation at the mean x) / derivative by the variance.

    In rounded frames the mean noise is the mean of x - c. Its own noise is independent of cos z, which is symmetric.
    """
    expected, count, offsets = plane.expected, plane.count, row_offsets(plane.noise)
    is_rounded, scale = not plane.noise.site.plan.output.clean_normalised, np.abs(expected.by_variance)
    position = _mean_noise(plane) if is_rounded else plane.means[2]
    noise = expected.cosine_variance + is_rounded * (expected.slope * expected.std) ** 2
    bend = np.abs(expected.bend) / scale
    return Points(
        signal=expected.signal,
        difference=(expected.cosine + expected.slope * position - plane.means[1]) / scale,
        noise=noise / count / scale**2,
        # two cosines have a covariance of at most 4 (row variance / std²)²
        rows=8 * plane.row_sites * offsets.squares * (offsets.variance / expected.std**2 / scale) ** 2 / count,
        fixed=expected.fixed,
        rounding=bend / 3 * (expected.unknown_dn == 0),
        unknown=bend * 2 / 3 * (expected.unknown_dn > 0),
        step=LARGEST_Z / count / scale,
    )


def _mean_noise(plane: Plane) -> Float:
    """Mean of noisy minus clean and known offsets in each bin, without defects, DN."""
    return np.asarray(plane.expected.std * plane.means[0])


def rounding_variance(mean: Points, least: float) -> float:
    """Largest covariance of rounding errors of the clean frame, DN²: ``least``, or more in flat frames."""
    sites = 1 / np.maximum(mean.noise, 1e-30)
    square = float(sites @ (mean.difference**2 - mean.noise - mean.rows)) / float(sites.sum())
    return min(max(square, least), 1 / 4)


# -------------------------------------------------------------------------------------------------- rows and columns


class LineCorrelations(NamedTuple):
    """Offsets of rows or columns, or differences of them, with their correlations.

    Attributes
    ----------
    variance : float
        Variance of an offset, DN².
    magnitudes, squares : float
        Sums over all lines of the magnitudes and of the squares of their correlations with one line. The former bounds
        the eigenvalues of the correlation matrix.
    """

    variance: float
    magnitudes: float = 1.0
    squares: float = 1.0


def row_offsets(noise: PlaneNoise) -> LineCorrelations:
    """Offsets of rows, an autoregressive process of order 1."""
    r = abs(noise.row_correlation)
    return LineCorrelations(noise.row_variance, (1 + r) / (1 - r), (1 + r * r) / (1 - r * r))


def row_differences(noise: PlaneNoise) -> LineCorrelations:
    """Differences of rows n and n + 2 of such a process over √2, for the first two rows of groups of four.

    At a distance of k rows, the covariance is variance · (rᵏ - (rᵏ⁺² + r^|k-2|) / 2); the sums are geometric series.
    """
    r = abs(noise.row_correlation)
    magnitudes = 1 + r / 2 + r * (1 + r) ** 2 / (2 * (1 + r * r))
    return LineCorrelations(noise.row_variance * (1 - r * r), magnitudes, 1 + r * r / (2 * (1 + r**4)))


def _line_scores(sums: Sums, rounding_dn2: float) -> Scores:
    """Scores of the variances of row and column offsets.

    The rounding of a smooth clean frame can move complete lines by up to half a DN. Differences of lines n and n + 2,
    and products of distant parts of a line, are almost free of it, with a third of the information.
    """
    noise, columns = sums.planes[0].noise, LineCorrelations(0.0)
    lines = {
        "row means": (sums.rows, 0, row_offsets(noise), rounding_dn2),
        "column means": (sums.columns, 1, columns, rounding_dn2),
        "row differences": (_differences(sums.rows), 2, row_differences(noise), 0.0),
        "column differences": (_differences(sums.columns), 2, columns, 0.0),
    }
    return {(name, ""): _quadratic_score(*values, sums) for name, values in lines.items()}


def _differences(lines: Float) -> Float:
    """Differences of lines n and n + 2, over √2: for the first and the second two lines of groups of four.

    Two sums a, c with the weights b, d and the variances u, v differ by a/b - c/d, with the weight bd / (b + d).
    """
    count, segments = lines.shape[2] // 2 * 2, lines.shape[3]
    (a, b, u), (c, d, v) = (lines[:, :, start:count:2] for start in (0, 1))
    total = np.maximum(b + d, 1e-30)
    parts = (a * d - c * b) / total, math.sqrt(2) * b * d / total, (u * d * d + v * b * b) / (total * total)
    return np.stack(parts).reshape(3, 2, -1, segments)


def _quadratic_score(lines: Float, apart: int, offsets: LineCorrelations, rounding_dn2: float, sums: Sums) -> Score:
    """Score of the variance of line offsets: Σ aᵀMa - E[aᵀMa] for the sums a of the parts of each line.

    ``lines`` [3, 2, lines, parts] are the sums a, their weights j, and their variances u. The covariance of a line is
    C = diag(u) + σ²·jjᵀ with the variance σ² of the offset. Then E[aᵀMa] = tr(MC), and its variance for
    normal values is 2·tr(MCMC). The mask M is 1 for parts that are at least ``apart``.
    """
    a, j, u = lines.reshape(3, -1, lines.shape[3])
    part, offset = np.arange(lines.shape[3]), offsets.variance
    mask = (np.abs(np.subtract.outer(part, part)) >= apart).astype(np.float64)
    weighted = j @ mask
    pairs = (weighted * j).sum(axis=1)
    excess = ((a @ mask) * a).sum(axis=1) - u @ np.diag(mask) - offset * pairs
    own = ((u @ mask) * u).sum(axis=1)
    cross = 2 * offset * (weighted**2 * u).sum(axis=1)
    predicted = 2 * float((own + cross + offsets.squares * (offset * pairs) ** 2).sum())
    # rounding errors of neighbouring sites can be equal in a smooth frame, which increases the variance
    variance = max(predicted, float(excess @ excess))
    norm = float(mask.sum(axis=1).max())  # at least the largest eigenvalue
    largest = offsets.magnitudes * offset * pairs + norm * u.max(axis=1)
    return Score(
        total=float(excess.sum()),
        information=float(pairs.sum()),
        variance=variance,
        rounding=rounding_dn2 * float(np.linalg.norm(pairs)),
        fixed=sums.fixed * math.sqrt(variance),
        # a quadratic form of normal values exceeds √(2·variance·x) + 2·norm·x with probability exp(-x)
        step=6 * float(largest.max(initial=0.0)),
        high=rounding_dn2 * float(pairs.sum()),
    )


# ------------------------------------------------------------------------------------------------------ pairs of sites


def _neighbour_score(sums: Sums, name: str, rounding_dn2: float) -> Score:
    """Score of the correlation of z at pairs of neighbours.

    Their rounding errors are equal in a smooth frame, or opposite if their colours differ. The numbers of pairs and the
    sums of products of 1 / std are bounded by those of the sites (Cauchy's inequality).
    """
    pairs = len(NEIGHBOURS[name]) * sums.sites
    inverse = sum(float((plane.count / plane.expected.std**2).sum()) for plane in sums.planes)
    bound = rounding_dn2 * len(NEIGHBOURS[name]) * inverse
    fixed = sums.fixed * math.sqrt(pairs)
    return Score(sums.products[name], pairs, pairs, fixed=fixed, step=LARGEST_Z**2, low=-bound, high=bound)


def repetition_score(here: SparseNoise, there: SparseNoise) -> Score:
    """Score of the correlation of z at the same sites of two pairs; patterns of the body and rounding may cause it."""
    common = np.s_[: min(len(here.z), len(there.z)), : min(here.z.shape[1], there.z.shape[1])]
    product, inverse = here.z[common] * there.z[common], here.inverse[common] * there.inverse[common]
    pairs, bound = int(np.count_nonzero(inverse)), float(inverse.sum(dtype=np.float64)) / 4
    high = bound + pairs * math.sqrt(here.fixed * there.fixed)
    # equal deviates have squares of variance 2
    total, step = float(product.sum(dtype=np.float64)), LARGEST_SAMPLE**2
    return Score(total, pairs, 2 * pairs, step=step, low=-bound, high=high)


# -------------------------------------------------------------------------------------------------- codes and outliers


def _code_score(sums: Sums, bit: int) -> Score:
    """Score of the difference of the numbers of noisy values with and without a bit."""
    sites = 0 if sums.plan.output.normalised else sums.sites
    bound = min(sum(float(plane.count @ plane.expected.codes[bit]) for plane in sums.planes), sites)
    return Score(2 * float(sums.bits[bit]) - sites, sites, sites, step=1.0, low=-bound, high=bound)


def _outlier_score(sums: Sums) -> Score:
    """Score of the number of sites beyond `FAR_Z`, in the directions in which the sensor does not limit them."""
    total = expected = possible = 0.0
    for plane in sums.planes:
        sites = np.isfinite(plane.expected.far) * plane.count
        total += float((plane.means[3:] * sites).sum())
        expected += float((np.nan_to_num(plane.expected.far) * sites).sum())
        possible += float(sites.sum()) / 2
    bound, variance = TAIL_ERROR * expected, expected + UNFORESEEN * possible
    return Score(total - expected, possible * 1e-6, variance, step=1.0, low=-bound, high=bound)


def _defect_score(sums: Sums) -> Score:
    """Score of the number of known defects that are no outliers.

    None of N is expected: with the probability p of one, the probability of k is below (N·p)ᵏ, which is e⁻¹⁰ᵏ for
    N = 4540 and p = `UNFORESEEN`.
    """
    certain, missing = (sum(numbers) for numbers in zip(*(plane.defects() for plane in sums.planes), strict=True))
    return Score(-missing, certain, UNFORESEEN * certain, step=0.3)
