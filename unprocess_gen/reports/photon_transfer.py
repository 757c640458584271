"""Fit the noise in a dataset's arrays by photon transfer, as cameras are measured (EMVA 1288), and draw the fits.

A line is fitted to the variance of the noise against the signal; slope and intercept are compared with the numbers of
the row. Alarms are raised by `noise_check.checks`, not by the fits.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.types import DarkPixels, Float
from unprocess_gen.dataset.reader import RawPairs, Sample
from unprocess_gen.reports.encoding import figure_png
from unprocess_gen.reports.noise_check.checks import Checker, overlaps, pair_sums
from unprocess_gen.reports.noise_check.scores import joined_points, row_offsets, variance_points
from unprocess_gen.reports.noise_check.sums import Plane, Sums
from unprocess_gen.statistics.scores import NORMAL_95, influence

FITS_DRAWN = 8

LEAST_SITES_OF_POINT = 16
"""Fewest sites of a clean DN whose variance is drawn."""


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """The line fitted to the noise of one pair.

    Attributes
    ----------
    key : str
        Key of the pair.
    estimate, error, expected : ndarray of float64, [2]
        Slope (DN) and intercept (DN²) of the variance, their standard errors, and their values according to the row.
    signal_dn, variance_dn2 : ndarray of float64, [N]
        The fitted points: signal above black, and variance without the variance of rounding.
    """

    key: str
    estimate: Float
    error: Float
    expected: Float
    signal_dn: Float
    variance_dn2: Float

    @property
    def deviation(self) -> float:
        """Difference from the expected line in standard errors, the larger of slope and intercept."""
        return float((np.abs(self.estimate - self.expected) / self.error).max())

    def __str__(self) -> str:
        numbers = (
            f"{name} {estimate:.6g} ± {NORMAL_95 * error:.2g} {unit} (expected {expected:.6g})"
            for name, unit, estimate, error, expected in zip(
                "ab", ("DN", "DN²"), self.estimate, self.error, self.expected, strict=True
            )
        )
        return f"{self.key}: {', '.join(numbers)}: {self.deviation:.1f} standard errors"


@dataclass(frozen=True, slots=True)
class NoiseSummary:
    """Number of fits of a dataset, the fit farthest from its row, the first `FITS_DRAWN` fits, and the checks."""

    count: int
    worst: NoiseFit | None
    first: list[NoiseFit]
    checks: Checker


def examine_dataset(folder: AnyPath, dark_pixels: DarkPixels | None = None) -> NoiseSummary:
    """Fit and check the noise of every pair of a dataset, one pair at a time.

    Pairs with too few usable sites are counted as unchecked; those with dark frames too if there is no access to them.
    """
    return examine_pairs(RawPairs(folder), Checker(np.array(list(overlaps(folder))).reshape(-1, 2)), dark_pixels)


def examine_pairs(pairs: Iterable[Sample], checker: Checker, dark_pixels: DarkPixels | None = None) -> NoiseSummary:
    """Fit and check the noise of pairs, one at a time."""
    count, worst = 0, None
    first: list[NoiseFit] = []
    for clean, noisy, row in pairs:
        sums = pair_sums(clean, noisy, row, dark_pixels)
        checker.add(row, sums)
        fit = None if sums is None else fit_sums(str(row["key"]), sums)
        if fit is None:
            continue
        count += 1
        worst = fit if worst is None or fit.deviation > worst.deviation else worst
        first += [fit] if len(first) < FITS_DRAWN else []
    return NoiseSummary(count, worst, first, checker)


def fit_sums(key: str, sums: Sums) -> NoiseFit | None:
    """Fit the noise of a pair by weighted least squares; None if fewer than three clean values are used.

    The covariance of slope and intercept is (XᵀWX)⁻¹ for independent sites, plus the covariance of the offsets of rows.
    """
    planes = [plane for plane in sums.planes if len(plane.bins)]
    points = joined_points(map(variance_points, planes))
    if len(np.unique(points.signal)) < 3:
        return None
    design = np.stack([points.signal, np.ones_like(points.signal)])
    by_point = influence(design, points.weight)
    count, std = (np.concatenate(values) for values in zip(*((p.count, p.expected.std) for p in planes), strict=True))
    temporal = np.concatenate([plane.noise.temporal_variance(plane.expected.signal) for plane in planes])
    rounding_dn2 = 0.0 if sums.plan.output.normalised else 1 / 12
    expected = by_point @ (temporal - rounding_dn2)
    drawn = count >= LEAST_SITES_OF_POINT
    return NoiseFit(
        key=key,
        estimate=expected + by_point @ points.difference,
        error=np.sqrt(by_point**2 @ (points.noise + points.unknown**2) + _row_variances(sums, planes, by_point)),
        expected=expected,
        signal_dn=points.signal[drawn],
        variance_dn2=(points.difference + std**2 - rounding_dn2)[drawn],
    )


def _row_variances(sums: Sums, planes: list[Plane], influence: Float) -> Float:
    """Variances of slope and intercept due to the offsets of rows, which all sites of a row have in common.

    An offset r changes the variance that a row shows by r² - σ², and the mean noise, which estimates x, by r. With l
    and m the sums of the influences of a row's sites, the changes add to Σ l·(r² - σ²) + m·r over the rows.
    """
    offsets, ends = row_offsets(planes[0].noise), np.cumsum([len(plane.bins) for plane in planes])
    if not offsets.variance:
        return np.zeros(2)
    by_square, by_offset = np.zeros((2, 2, 2, sums.height // 2))  # slope and intercept, even and odd rows
    for plane, plane_influence in zip(planes, np.split(influence, ends[:-1], axis=1), strict=True):
        y, expected = plane.noise.site.place[0], plane.expected
        by_site = plane_influence / plane.count
        by_square[:, y] += plane.row_sums(by_site)
        by_offset[:, y] += plane.row_sums(by_site * expected.slope / expected.by_variance)
    squares, linear = ((values**2).sum(axis=(1, 2)) for values in (by_square, by_offset))
    return np.asarray(
        2 * offsets.variance**2 * offsets.squares * squares + offsets.variance * offsets.magnitudes * linear
    )


def draw_fits(fits: list[NoiseFit]) -> bytes:
    """Draw variance against signal with the expected lines; return a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for number, fit in enumerate(fits):
        colour = f"C{number % 10}"
        axes.plot(fit.signal_dn, fit.variance_dn2, ".", color=colour, markersize=2, alpha=0.5)
        ends = np.array([fit.signal_dn.min(initial=0.0), fit.signal_dn.max(initial=0.0)])
        axes.plot(ends, fit.expected[0] * ends + fit.expected[1], color=colour, label=fit.key)
    axes.set(xlabel="signal above black (DN)", ylabel="variance of the noise (DN²)", title="Photon transfer")
    axes.legend(title="line: expected from the manifest")
    return figure_png(figure, dpi=120)
