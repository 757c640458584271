"""Fit the noise of a pair by photon transfer, as cameras are measured (EMVA 1288), and draw the fits.

A line is fitted to the variance of the noise against the signal. Alarms are raised by `noise_check`, not by the fits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unprocess_gen.core.arrays import Float, Frame
from unprocess_gen.dataset.manifest import plan_from_row
from unprocess_gen.dataset.row import Row
from unprocess_gen.reports.encoding import figure_png
from unprocess_gen.reports.noise_check.repeat import measure_noise
from unprocess_gen.reports.noise_check.scores import Bins, residual_of
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.statistics.scores import NORMAL_95, influence

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
        Signal above black, and variance without the offsets of rows and columns.
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


def fit_pair(clean: Frame, noisy: Frame, row: Row, dark_pixels: DarkPixels | None = None) -> NoiseFit | None:
    """Fit the noise of a pair by weighted least squares; None with fewer than three clean values or no dark frame.

    The line of the row is corrected by the difference of the pair from its repetition, which has all recorded effects.
    """
    plan = plan_from_row(row)
    if plan.dark and dark_pixels is None:
        return None
    noise = measure_noise(clean, noisy, row, dark_pixels)
    bins, (own, repeated) = Bins(noise, np.s_[:, :]), residual_of(noise)[0].z
    if len(bins.signal) < 3:
        return None
    variances = np.stack([bins.sums(z**2) / (bins.count * bins.precision) for z in (own, repeated)])
    fourth_moment = float(bins.sums((repeated**2 - 1) ** 2).sum() / bins.count.sum())
    spread = 2 * fourth_moment / (bins.count * bins.precision**2)
    spread += noise.rounding_dn2 * (noise.rounding_dn2 + plan.noise.variance_line[0] ** 2)
    by_point = influence(np.stack([bins.signal, np.ones_like(bins.signal)]), 1 / spread)
    expected, drawn = np.array(plan.noise.variance_line), bins.count >= LEAST_SITES_OF_POINT
    return NoiseFit(
        key=str(row["key"]),
        estimate=expected + by_point @ (variances[0] - variances[1]),
        error=np.sqrt(by_point**2 @ spread),
        expected=expected,
        signal_dn=bins.signal[drawn],
        variance_dn2=variances[0][drawn],
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
