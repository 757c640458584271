"""Fit the noise of pairs by photon transfer, as cameras are measured (EMVA 1288), and draw the fits; no alarms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unprocess_gen.calibration.deviations import NORMAL_95, influence
from unprocess_gen.core.arrays import Float
from unprocess_gen.reports.noise_check.pair_scores import Bins, residual_of
from unprocess_gen.reports.noise_check.repetition import Noise
from unprocess_gen.reports.pictures import figure_png, new_figure
from unprocess_gen.simulation.plan_slots import slots_of

LEAST_SITES_OF_POINT = 16
"""Fewest sites of a clean DN whose variance is drawn."""
POINTS_OF_LINE = 65
"""Points of the expected variance that are drawn; PRNU bends it."""

BINS_DRAWN = 24


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """The line fitted to the noise of the pair with a key: variance against signal above black.

    ``estimate``, its standard ``error`` and what the row ``expected`` are slope (DN) and intercept (DN²). ``prnu`` is
    the standard deviation of the relative gain of pixels. The points are variances without the offsets of rows and
    columns.
    """

    key: str
    estimate: Float
    error: Float
    expected: Float
    prnu: float
    signal_dn: Float
    variance_dn2: Float

    @property
    def deviation(self) -> float:
        """Difference from the expected line in standard errors, the larger of slope and intercept."""
        return float((np.abs(self.estimate - self.expected) / self.error).max())

    @property
    def line(self) -> tuple[Float, Float]:
        """Points of the expected variance: the line, and the square of the signal that PRNU adds."""
        signal_dn = np.linspace(self.signal_dn.min(initial=0.0), self.signal_dn.max(initial=1.0), POINTS_OF_LINE)
        return signal_dn, self.expected[0] * signal_dn + self.expected[1] + (self.prnu * signal_dn) ** 2

    def __str__(self) -> str:
        numbers = zip("ab", ("DN", "DN²"), self.estimate, NORMAL_95 * self.error, self.expected, strict=True)
        texts = (f"{name} {a:.6g} ± {half:.2g} {unit} (expected {row:.6g})" for name, unit, a, half, row in numbers)
        return f"{', '.join(texts)}: {self.deviation:.1f} standard errors"


def fit_noise(noise: Noise | None) -> NoiseFit | None:
    """Fit the noise of a pair by weighted least squares; None with fewer than three clean values or no noise.

    The line of the row is corrected by the difference of the pair from its repetition, which has all recorded effects.
    """
    if noise is None:
        return None
    bins, (own, repeated) = Bins(noise, np.s_[:, :]), residual_of(noise)[0].z
    if len(bins.signal) < 3:
        return None
    variances = np.stack([bins.sums(z**2) / (bins.count * bins.precision) for z in (own, repeated)])
    fourth_moment = float(bins.sums((repeated**2 - 1) ** 2).sum() / bins.count.sum())
    expected, drawn = np.array(noise.plan.noise.variance_line), bins.count >= LEAST_SITES_OF_POINT
    spread = 2 * fourth_moment / (bins.count * bins.precision**2)
    spread += noise.rounding_dn2 * (noise.rounding_dn2 + expected[0] ** 2)
    by_point = influence(np.stack([bins.signal, np.ones_like(bins.signal)]), 1 / spread)
    estimate, error = expected + by_point @ (variances[0] - variances[1]), np.sqrt(by_point**2 @ spread)
    pattern = None if noise.plan.averaged else slots_of(noise.plan).patterns.electrons
    prnu = 0.0 if pattern is None else pattern.std
    return NoiseFit(noise.key, estimate, error, expected, prnu, bins.signal[drawn], variances[0][drawn])


def draw_fits(fits: list[NoiseFit]) -> bytes:
    """Draw medians of the variance in up to `BINS_DRAWN` bins of the signal, and expected lines; return a PNG."""
    figure, axes = new_figure(8, 5)
    for number, fit in enumerate(fits):
        colour, order = f"C{number % 10}", np.argsort(fit.signal_dn)
        bins = np.array_split(order, min(BINS_DRAWN, max(order.size, 1)))
        medians = [[np.median(values[one]) for one in bins if one.size] for values in (fit.signal_dn, fit.variance_dn2)]
        axes.plot(*medians, "o", color=colour, markersize=4)
        axes.plot(*fit.line, color=colour, label=fit.key, linewidth=1)
    axes.set(xlabel="signal above black (DN)", ylabel="variance of the noise (DN²)", title="Photon transfer")
    axes.legend(title="line: expected from the manifest\npoints: medians of the pair")
    return figure_png(figure, dpi=120)
