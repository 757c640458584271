"""Compare statistics of the noise of a pair with those of its repetition, by row, column or clean value.

If the noise is as recorded, both noisy frames can be exchanged, so the differences of independent rows, columns or
clean values are distributed symmetrically around 0. Derivations: ``docs/design/noise_check.md``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.calibration.deviations import Score
from unprocess_gen.calibration.planes import NEIGHBOURS, TILE, plane_names
from unprocess_gen.core.arrays import Float
from unprocess_gen.reports.noise_check.repetition import Noise, Single

SHARED_ROUNDING = 0.15
"""Fraction of the rounding error that all clean values of a frame share."""
LARGEST_DETAIL = 8.0
"""Bound of the detail of the clean frame, in standard deviations of the noise."""

MISSED_BY_CHANCE = 1e-4
"""Largest probability that the noise hides a hot pixel of `Noise.is_hot`."""

Scores = dict[tuple[str, str], Score]
"""Scores by the names of check and plane; the plane is empty if all planes are summed."""


class Residual(NamedTuple):
    """1 / std [H, W], and z of both frames without the offsets of rows and columns, [2, H, W]."""

    weight: Single
    z: Single

    def part(self, rows: slice, columns: slice) -> Residual:
        """Residual of some rows and columns."""
        return Residual(self.weight[rows, columns], self.z[:, rows, columns])


def scores_of(noise: Noise, before: Residual | None = None) -> tuple[Scores, Residual]:
    """Compute the scores of a pair; ``before`` is the residual of another pair, whose noise must be independent."""
    used, sites = noise.weight > 0, int(np.count_nonzero(noise.weight))
    here, scores = residual_of(noise)
    scores |= _mean_scores(noise) | _clean_value_scores(noise, here)
    for name, distances in NEIGHBOURS.items():
        products = []
        for y, x in distances:
            rounding_dn2 = noise.rounding_dn2 / (2 if (y + x) % 2 and _differs_by_colour(noise) else 1)
            products.append(_product_score(*_neighbours(here, y, x), rounding_dn2))
        scores[name, ""] = _sum(products)
    detail = _detail(noise)
    bound = noise.rounding_dn2 * float((noise.weight**2).sum(dtype=np.float64))
    scores["order of sites", ""] = _score(_by_row(here.z * detail), float((detail**2).sum()), bound)
    scores["outliers", ""] = _score(_by_row(noise.is_far & used), sites * 1e-6)
    seen = noise.is_far & (noise.is_hot & noise.is_far[1])  # dead and clipped pixels are not in the repetition
    if hot := int(seen[1].sum()):
        scores["hot pixels", ""] = Score(float(seen[0].sum()) - hot, hot, hot * MISSED_BY_CHANCE, step=1.0)
    if not noise.plan.output.normalised:
        signs = (2 * (noise.noisy_dn.astype(np.int64) & 1) - 1) * used
        scores["odd codes", ""] = _score(_by_row(signs), sites)
    if before is not None:
        common = [slice(min(lengths)) for lengths in zip(here.weight.shape, before.weight.shape, strict=True)]
        there = before.part(*common)._replace(z=before.z[:1, *common])  # in both frames of the pair before
        scores["repetition", ""] = _product_score(here.part(*common), there, 3 * noise.rounding_dn2)
    return scores, here


def residual_of(noise: Noise) -> tuple[Residual, Scores]:
    """Subtract the weighted means of rows, then those of columns; score their variances."""
    scores, z = Scores(), noise.z
    for name, axis, correlation in (("rows", 1, _row_correlation(noise)), ("columns", 0, 0.0)):
        information = (noise.weight**2).sum(axis=axis, dtype=np.float64)
        offsets = (z * noise.weight).sum(axis=axis + 1, dtype=np.float64) / np.maximum(information, 1e-30)
        scores[name, ""] = _line_score(offsets, information, 1 + correlation**2 / (2 + 2 * correlation**4))
        z = z - np.expand_dims(offsets, axis + 1).astype(np.float32) * noise.weight
    return Residual(noise.weight, z), scores


def _score(differences: Float, information: float, bound: float = 0.0, together: float = 1.0) -> Score:
    """Score of a sum of differences, correlated in groups of ``together``; rounding explains up to ``bound``."""
    square = float(differences @ differences) * together
    return Score(float(differences.sum()), information, square, low=-bound, high=bound)


def _sum(scores: list[Score]) -> Score:
    """Score of several sums together."""
    return Score(*map(sum, zip(*scores, strict=True)))


def _by_row(values: Any) -> Float:
    """Sum of each row of the noisy frame, minus that of the repetition."""
    own, repeated = values.sum(axis=2, dtype=np.float64)
    return np.asarray(own - repeated)


def _row_correlation(noise: Noise) -> float:
    """Size of the correlation of the offsets of neighbouring rows."""
    physics = noise.plan.physics
    return 0.0 if physics is None else abs(physics.row_correlation)


# --------------------------------------------------------------------------------------------- means, rows and columns


def _mean_scores(noise: Noise) -> Scores:
    """Scores of the mean of each plane and of all; rounding changes it by at most half a DN."""
    scores, names, r = Scores(), plane_names(noise.plan.sensor.pattern), _row_correlation(noise)
    parts = {name: np.s_[y::2, x::2] for name, (y, x) in zip(names, TILE, strict=True)} | {"": np.s_[:, :]}
    for name, part in parts.items():
        information = float((noise.weight[part] ** 2).sum(dtype=np.float64))
        rows = _by_row(noise.z[:, *part] * noise.weight[part])
        bound = information / 2 if noise.rounding_dn2 else 0.0
        scores["mean", name] = _score(rows, information, bound, (1 + r) / (1 - r))
    return scores


def _line_score(offsets: Float, information: Float, together: float) -> Score:
    """Score of the variance of offsets of lines, [2, N] DN, from differences of the lines n and n + 2.

    The rounding of a smooth clean frame can move complete lines, but hardly changes their differences. Lines are
    compared within groups of four. ``information`` is the inverse of the variance of each offset, [N].
    """
    groups = np.s_[..., : len(information) // 4 * 4]
    first, second = offsets[groups].reshape(2, -1, 2, 2).transpose(2, 0, 1, 3)
    a, b = information[groups].reshape(-1, 2, 2).transpose(1, 0, 2)
    weight = a * b / np.maximum(a + b, 1e-30)
    own, repeated = weight * (first - second) ** 2
    return _score((own - repeated).ravel(), 2 * float(weight.sum()), together=together)


# -------------------------------------------------------------------------------------------------------- clean values


class Bins:
    """Used sites of a part of a frame by clean value.

    ``signal`` is in DN above black, ``count`` the number of sites, ``precision`` the mean of 1 / std² (DN⁻²), all [N].
    """

    def __init__(self, noise: Noise, part: Any) -> None:
        weight = noise.weight[part]
        self._used = weight > 0
        values, self._number = np.unique(np.rint(noise.clean_dn[part][self._used]), return_inverse=True)
        self.signal = values - noise.plan.sensor.black_level_dn
        self.count = self.sums(np.ones_like(weight))
        self.precision = self.sums(weight**2) / self.count

    def by_site(self, values: Float) -> Float:
        """Give each used site the value of its clean value, [H, W]; 0 elsewhere."""
        sites = np.zeros(self._used.shape)
        sites[self._used] = values[self._number]
        return sites

    def sums(self, sites: Any) -> Float:
        """Sum values of the sites, [H, W], by clean value, [N]."""
        return np.bincount(self._number, sites[self._used]).astype(np.float64)


def _clean_value_scores(noise: Noise, residual: Residual) -> Scores:
    """Scores of signal, variance and shape of each plane, and of all planes together."""
    scores = Scores()
    for name, (y, x) in zip(plane_names(noise.plan.sensor.pattern), TILE, strict=True):
        bins = Bins(noise, np.s_[y::2, x::2])
        if not len(bins.signal):
            continue
        signal, count, precision, sums = bins.signal, bins.count, bins.precision, bins.sums
        own, repeated = residual.z[:, y::2, x::2]
        variance_dn2 = sums(own**2 - repeated**2) / (count * precision)
        cosine = sums(np.cos(own) - np.cos(repeated)) / count
        by_variance = 1 / (4 / (count * precision**2) + noise.rounding_dn2**2)
        gain = by_variance * (signal - by_variance @ signal / by_variance.sum())
        bound = noise.rounding_dn2 * by_variance
        by_cosine = by_variance / precision
        scores["signal", name] = _signal_score(noise, bins, np.s_[y::2, x::2])
        scores["variance", name] = _score(by_variance * variance_dn2, float(by_variance.sum()), float(bound.sum()))
        scores["gain", name] = _score(
            gain * variance_dn2, float(gain @ signal), noise.rounding_dn2 * float(np.abs(gain).sum())
        )
        scores["shape", name] = _score(by_cosine * cosine, float(by_cosine.sum()), float(bound.sum()) / 3)
    together = {check: [score for (name, _), score in scores.items() if name == check] for check, _ in scores}
    return scores | {(check, ""): _sum(of_planes) for check, of_planes in together.items()}


def _signal_score(noise: Noise, bins: Bins, part: Any) -> Score:
    """Score of the mean noise against the signal.

    Sites of a clean value share their rounding error, and those of a row its offset, so the spread is the larger one of
    both. Histograms of light decrease, so all rounding errors can have a common part.
    """
    precision = bins.count * bins.precision
    slope = bins.signal / (2 / precision + noise.rounding_dn2)
    noise_dn = (noise.z[0][part] - noise.z[1][part]) * noise.weight[part]
    bound = SHARED_ROUNDING * math.sqrt(noise.rounding_dn2) * float(slope.sum())
    by_value = _score(slope / precision * bins.sums(noise_dn), float(slope @ bins.signal), bound)
    by_row, r = (noise_dn * bins.by_site(slope / precision)).sum(axis=1), _row_correlation(noise)
    return by_value._replace(variance=max(by_value.variance, float(by_row @ by_row) * (1 + r) / (1 - r)))


# ------------------------------------------------------------------------------------------------------ pairs of sites


def _neighbours(residual: Residual, y: int, x: int) -> tuple[Residual, Residual]:
    """Residual at the first and at the second sites of all pairs at a distance."""
    height, width = residual.weight.shape
    first = residual.part(slice(height - y), slice(max(0, -x), width - max(0, x)))
    return first, residual.part(slice(y, None), slice(max(0, x), width - max(0, -x)))


def _product_score(first: Residual, second: Residual, rounding_dn2: float) -> Score:
    """Score of the correlation of z at pairs of sites, whose rounding errors have at most this covariance."""
    weight = first.weight * second.weight
    bound = rounding_dn2 * float(weight.sum(dtype=np.float64))
    return _score(_by_row(first.z * second.z), int(np.count_nonzero(weight)), bound)


def _differs_by_colour(noise: Noise) -> bool:
    """True if gains differ by colour: rounding errors of values with another ratio have a correlation of at most ½."""
    camera = noise.plan.camera
    return min(abs(gain - 1) for gain in (camera.red_gain, camera.blue_gain)) > 0.1


def _detail(noise: Noise) -> Single:
    """Difference of the diagonal neighbours of a clean site from it, over std: what swapped or moved sites show."""
    height, width = noise.clean_dn.shape
    around = np.pad(noise.clean_dn, 1, mode="reflect")
    mean = sum(around[y : y + height, x : x + width] for y in (0, 2) for x in (0, 2)) / 4
    detail = (mean - noise.clean_dn) * noise.weight
    return np.clip(detail, -LARGEST_DETAIL, LARGEST_DETAIL).astype(np.float32)
