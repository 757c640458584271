"""Fit the noise in a dataset's arrays by photon transfer, as cameras are measured (EMVA 1288), and draw the fits.

A line is fitted to the variance of the noise against the signal; slope and intercept are compared with the numbers of
the row. The variance at each clean DN follows from the mean of cos z (`noise_check.scores`), which is efficient for
normal noise, and not dominated by the tails of others. Alarms are raised by `noise_check.checks`, not by the fits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.object_store import AnyPath
from unprocess_gen.core.output_paths import check_output_file
from unprocess_gen.core.types import DarkPixels, Float, Frame, Row
from unprocess_gen.dataset.reader import RawPairs
from unprocess_gen.reports.noise_check.checks import Checker, NoiseChecks, pair_sums
from unprocess_gen.reports.noise_check.scores import planes_of
from unprocess_gen.reports.noise_check.sums import Sums
from unprocess_gen.reports.report_files import require_libraries

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
    slope, slope_error : float
        Slope of the variance in DN, and its standard error.
    intercept, intercept_error : float
        Intercept of the variance in DN², and its standard error.
    expected : (float, float)
        Slope and intercept according to the row.
    signal_dn, variance_dn2 : ndarray of float64, [N]
        The fitted points: signal above black and variance.
    rounding_dn2 : float
        Part of the variance that is due to rounding.
    """

    key: str
    slope: float
    slope_error: float
    intercept: float
    intercept_error: float
    expected: tuple[float, float]
    signal_dn: Float
    variance_dn2: Float
    rounding_dn2: float = 1 / 6

    @property
    def deviation(self) -> float:
        """Difference from the expected line in standard errors, the larger of slope and intercept."""
        return max(
            abs(self.slope - self.expected[0]) / self.slope_error,
            abs(self.intercept - self.expected[1]) / self.intercept_error,
        )

    def __str__(self) -> str:
        return (
            f"{self.key}: a {self.slope:.6g} ± {1.96 * self.slope_error:.2g} DN (expected {self.expected[0]:.6g}), "
            f"b {self.intercept:.6g} ± {1.96 * self.intercept_error:.2g} DN² (expected {self.expected[1]:.6g}): "
            f"{self.deviation:.1f} standard errors"
        )


@dataclass(frozen=True, slots=True)
class NoiseSummary:
    """The fits and the checks of a dataset.

    Attributes
    ----------
    count : int
        Number of fits.
    worst : NoiseFit or None
        The fit farthest from its row.
    first : list of NoiseFit
        The first `FITS_DRAWN` fits.
    checks : NoiseChecks
        Checks of all pairs, one by one and together.
    """

    count: int
    worst: NoiseFit | None
    first: list[NoiseFit]
    checks: NoiseChecks


def examine_dataset(folder: AnyPath, dark_pixels: DarkPixels | None = None) -> NoiseSummary:
    """Fit and check the noise of every pair of a dataset, one pair at a time.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the dataset.
    dark_pixels : DarkPixels or None
        Access to its dark frames; without it, pairs with dark frames are not checked.

    Returns
    -------
    NoiseSummary
        Fits and alarms; pairs with too few usable sites are counted as unchecked.

    Raises
    ------
    DamageError
        If the dataset is damaged.
    SourceChangedError
        If a dark frame is missing or has changed.
    """
    count, worst = 0, None
    first: list[NoiseFit] = []
    checker = Checker(folder)
    for clean, noisy, row in RawPairs(folder):
        sums = pair_sums(clean, noisy, row, dark_pixels)
        checker.add(row, sums)
        fit = None if sums is None else fit_sums(str(row["key"]), sums)
        if fit is None:
            continue
        count += 1
        worst = fit if worst is None or fit.deviation > worst.deviation else worst
        first += [fit] if len(first) < FITS_DRAWN else []
    return NoiseSummary(count, worst, first, checker.result())


def iterate_fits(folder: AnyPath) -> Iterator[NoiseFit]:
    """Yield the fit of each pair that has enough sites; DamageError if the dataset is damaged."""
    for clean, noisy, row in RawPairs(folder):
        fit = fit_pair(clean, noisy, row)
        if fit is not None:
            yield fit


def fit_pair(clean: Frame, noisy: Frame, row: Row) -> NoiseFit | None:
    """Fit the noise of one pair.

    Parameters
    ----------
    clean, noisy : ndarray
        Frames in the dtype and layout of the dataset.
    row : Row
        Row of the pair.

    Returns
    -------
    NoiseFit or None
        None if the pair has too few usable sites, or fewer than three clean DN.
    """
    sums = pair_sums(clean, noisy, row)
    return None if sums is None else fit_sums(str(row["key"]), sums)


def fit_sums(key: str, sums: Sums) -> NoiseFit | None:
    """Fit the noise of one pair.

    Parameters
    ----------
    key : str
        Key of the pair.
    sums : Sums
        Its filled sums.

    Returns
    -------
    NoiseFit or None
        None if fewer than three clean DN are used.
    """
    law, planes = sums.law, planes_of(sums)
    signal = np.concatenate([plane.expected.signal for plane in planes])
    if len(np.unique(signal)) < 3:
        return None
    points = [plane.variance_points() for plane in planes]
    difference, error = (np.concatenate(some) for some in zip(*points, strict=True))
    columns = np.stack([signal, np.ones_like(signal)])
    normal = (columns / error) @ columns.T
    inverse = np.linalg.inv(normal)
    slope, intercept = inverse @ ((columns / error) @ difference)
    expected = law.line
    shared = law.rows.variance * math.sqrt(2 * law.rows.squares / sums.height)
    count = np.concatenate([plane.count for plane in planes])
    drawn = count >= LEAST_SITES_OF_POINT
    predicted = np.concatenate([law.of_site(plane.number).variance(plane.expected.signal) for plane in planes])
    variance = difference + predicted + (0.0 if law.plan.clean_normalised else 1 / 12)
    return NoiseFit(
        key=key,
        slope=expected[0] + float(slope),
        slope_error=math.sqrt(inverse[0, 0]),
        intercept=expected[1] + float(intercept),
        intercept_error=math.sqrt(inverse[1, 1] + shared * shared),
        expected=expected,
        signal_dn=signal[drawn],
        variance_dn2=variance[drawn],
        rounding_dn2=law.rounding_dn2 + (0.0 if law.plan.clean_normalised else 1 / 12),
    )


def check_figure_file(to: Path) -> None:
    """Check, before the pairs are fitted, that a figure can be drawn and written.

    Parameters
    ----------
    to : Path
        The PNG file.

    Raises
    ------
    ConfigError
        If matplotlib is missing, the suffix is not .png, or the file cannot be written or is not an earlier figure.
    """
    if to.suffix.lower() != ".png":
        raise ConfigError(f"--to {to}: is not a PNG file; expected a name that ends with .png")
    check_output_file(to, f"--to {to}", "an earlier figure", b"matplotlib")
    require_libraries(f"--to {to}", ("matplotlib",))


def draw_fits(fits: list[NoiseFit], to: Path | BinaryIO) -> None:
    """Draw variance against signal with the expected lines, as PNG.

    Parameters
    ----------
    fits : list of NoiseFit
        The fits to draw.
    to : Path or binary file
        Where to write the PNG.

    Raises
    ------
    ConfigError
        If matplotlib is not installed.
    """
    require_libraries(f"--to {to}", ("matplotlib",))
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for number, fit in enumerate(fits):
        colour = f"C{number % 10}"
        axes.plot(fit.signal_dn, fit.variance_dn2, ".", color=colour, markersize=2, alpha=0.5)
        ends = np.array([fit.signal_dn.min(initial=0.0), fit.signal_dn.max(initial=0.0)])
        axes.plot(ends, fit.expected[0] * ends + fit.expected[1] + fit.rounding_dn2, color=colour, label=fit.key)
    axes.set(xlabel="signal above black (DN)", ylabel="variance of noisy - clean (DN²)", title="Photon transfer")
    axes.legend(title="line: expected from the manifest")
    figure.savefig(to, dpi=120)
