"""Check the noise in a dataset's arrays against its manifest by photon transfer, as cameras are measured (EMVA 1288).

For each pair, the variance of noisy minus clean is computed for each clean DN, and a line is fitted: variance against
signal, weighted by the precision of each variance. Slope and intercept are compared with the numbers of the row, in
units of their standard errors. The check uses only arrays and row, not the code that made the noise. Sites near the
limits of the sensor are excluded, because clipping reduces their variance.

Expected variance at signal u (DN above black): shot noise a·u, plus the variances of read noise, row and column
offsets and dark current, plus (prnu·u)² for PRNU, plus 1/6 DN² because both frames are rounded. Frames in float32 are
not rounded; their sites are grouped by the nearest clean DN.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.output_paths import check_output_file
from unprocess_gen.core.types import Float, Frame, Row
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.reports.report_files import require_libraries
from unprocess_gen.simulation.reference.sensor import noisy_limits

ROUNDING_VARIANCE = 1 / 6
"""DN²: variance of the rounding errors of two frames, 1/12 each."""

CLIP_DISTANCE = 5.0
"""Standard deviations of noise that must fit between a signal and the limits of the sensor."""

LEAST_VARIANCE = 0.7**2
"""DN²: below it, rounding errors depend on the noise and their variance is not 1/6."""
LEAST_FLOAT_VARIANCE = 1e-4
"""DN², for frames that are not rounded: a hundred times the rounding to float32 at 16 bits."""

ALARM = 6.0
"""Standard errors from which a fit counts as wrong; by chance, one fit exceeds it with probability 2e-9."""

NORMAL_KURTOSIS = 3.0
"""Smallest kurtosis used for the error of a variance.

With few sites, the estimates of kurtosis and variance are low together; their error would be too small then.
"""

FITS_DRAWN = 8


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
    rounding_dn2: float = ROUNDING_VARIANCE

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
class FitSummary:
    """The fits of a dataset: their number, the one farthest from its row, those above `ALARM`, and the first few."""

    count: int
    worst: NoiseFit | None
    wrong: list[NoiseFit]
    first: list[NoiseFit]


def fit_dataset(folder: Path) -> FitSummary:
    """Fit the noise of every pair of a dataset, one pair at a time.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.

    Returns
    -------
    FitSummary
        Summary of the fits; pairs with too few sites are not counted.

    Raises
    ------
    DamageError
        If the dataset is damaged.
    """
    count, worst = 0, None
    wrong: list[NoiseFit] = []
    first: list[NoiseFit] = []
    for fit in iterate_fits(folder):
        count += 1
        worst = fit if worst is None or fit.deviation > worst.deviation else worst
        wrong += [fit] if fit.deviation > ALARM else []
        first += [fit] if len(first) < FITS_DRAWN else []
    return FitSummary(count, worst, wrong, first)


def iterate_fits(folder: Path) -> Iterator[NoiseFit]:
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
        None if fewer than three clean DN have enough sites.
    """
    expected = _expected_noise(row)
    rounded = noisy.dtype == np.uint16
    rounding = ROUNDING_VARIANCE * (int(rounded) + int(clean.dtype == np.uint16)) / 2
    moments = _moments_by_dn(*(mosaic_dn(frame, row).astype(np.float64) for frame in (clean, noisy)))
    dn = np.arange(moments.shape[1])
    signal = np.maximum(dn - expected.black_dn, 0.0)
    noise = np.maximum(expected.slope * signal + expected.intercept, 0.0) + (expected.prnu * signal) ** 2
    used = _unclipped(dn, noise + rounding, row) & (dn > expected.black_dn)
    used &= (moments[0] >= 16) & (noise >= (LEAST_VARIANCE if rounded else LEAST_FLOAT_VARIANCE))
    if int(used.sum()) < 3:
        return None
    (count, first, second, fourth), signal, total = moments[:, used], signal[used], noise[used] + rounding
    mean = first / count
    variance = (second - count * mean * mean) / (count - 1)
    kurtosis = max(float((fourth / total**2).sum() / count.sum()), NORMAL_KURTOSIS)
    weights = count / ((kurtosis - 1) * total * total)
    points = variance - (expected.prnu * signal) ** 2 - rounding
    normal = np.array(
        [[(weights * signal**2).sum(), (weights * signal).sum()], [(weights * signal).sum(), weights.sum()]]
    )
    inverse = np.linalg.inv(normal)
    slope, intercept = inverse @ np.array([(weights * signal * points).sum(), (weights * points).sum()])
    shared = _shared_error(row)
    return NoiseFit(
        key=str(row["key"]),
        slope=float(slope),
        slope_error=math.sqrt(inverse[0, 0]),
        intercept=float(intercept),
        intercept_error=math.sqrt(inverse[1, 1] + shared * shared),
        expected=(expected.slope, expected.intercept),
        signal_dn=signal,
        variance_dn2=variance,
        rounding_dn2=rounding,
    )


def _moments_by_dn(clean_dn: Float, noisy_dn: Float) -> Float:
    """Return count and sums of the powers 1, 2 and 4 of noisy minus clean, for each clean DN, ``[4, DN]``.

    The mean of each colour plane is subtracted, because the black-level error differs between planes.
    """
    difference = noisy_dn - clean_dn
    for y in range(2):
        for x in range(2):
            plane = difference[y::2, x::2]
            plane -= plane.mean() if plane.size else 0.0
    nearest = np.rint(np.maximum(clean_dn, 0)).astype(np.int64).ravel()
    powers = (difference**power for power in (0, 1, 2, 4))
    return np.stack([np.bincount(nearest, weights=power.ravel(), minlength=int(nearest.max()) + 1) for power in powers])


def _unclipped(dn: NDArray[np.int64], variance: Float, row: Row) -> NDArray[np.bool_]:
    """Return which DN are at least `CLIP_DISTANCE` standard deviations from the limits of the sensor."""
    distance = CLIP_DISTANCE * np.sqrt(variance)
    low, high = noisy_limits(int(row["bits"] or 0), int(_number(row, "black_level_dn")), str(row["sensor_clip"]))
    return np.asarray((dn - distance > low) & (dn + distance < high) & (dn < _number(row, "white_level_dn")))


class ExpectedNoise(NamedTuple):
    """The black level, slope (DN) and intercept (DN²) of the variance, and the relative PRNU, according to a row."""

    black_dn: float
    slope: float
    intercept: float
    prnu: float


def _number(row: Row, name: str) -> float:
    return float(row[name] or 0)


def _expected_noise(row: Row) -> ExpectedNoise:
    effects = str(row["effects"]).split(";")
    is_heteroscedastic = "heteroscedastic" in effects
    gain = _number(row, "dn_per_e")
    intercept = sum(
        value
        for effect, value in (
            ("read", _number(row, "b_dn2")),
            ("row", _number(row, "row_std_dn") ** 2),
            ("column", _number(row, "column_std_dn") ** 2),
            ("dark_current", gain * gain * _number(row, "dark_e")),
        )
        if effect in effects
    )
    return ExpectedNoise(
        _number(row, "black_level_dn"),
        _number(row, "a_dn") if is_heteroscedastic or "shot" in effects else 0.0,
        _number(row, "b_dn2") if is_heteroscedastic else intercept,
        _number(row, "prnu_std") if "prnu" in effects else 0.0,
    )


def _shared_error(row: Row) -> float:
    """Return the standard error of the intercept due to offsets that all sites of a row or column share."""
    effects = str(row["effects"]).split(";")
    parts = (("row", "row_std_dn", "height"), ("column", "column_std_dn", "width"))
    return math.hypot(
        *(_number(row, std) ** 2 * math.sqrt(2 / _number(row, size)) for name, std, size in parts if name in effects)
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
        ends = np.array([fit.signal_dn.min(), fit.signal_dn.max()])
        axes.plot(ends, fit.expected[0] * ends + fit.expected[1] + fit.rounding_dn2, color=colour, label=fit.key)
    axes.set(xlabel="signal above black (DN)", ylabel="variance of noisy - clean (DN²)", title="Photon transfer")
    axes.legend(title="line: expected from the manifest")
    figure.savefig(to, dpi=120)
