"""A dataset checks itself: is the noise in its arrays the one its manifest names? Photon transfer, as with cameras.

For each pair the variance of noisy less clean is measured at every DN of the clean frame and a line is fitted through
it, variance against signal, weighted by what each DN's sites are worth. Slope and intercept are compared with what the
row's numbers say, in units of their standard errors. Nothing is taken from the code that made the noise: only the
arrays and the row. Sites near the sensor's ends are left out, where clipping would narrow the noise.

What a row's numbers say: shot noise a·u, read noise b, row and column offsets and dark current their variances, unequal
responses (prnu·u)², and 1/6 DN², where both frames are rounded. Frames in float32 are not: there DN are a scale again,
the sites of a clean DN are those that lie nearest to it, and noise below 0.7 DN shows too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import FLOAT32, Float, Frame, Row
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.simulation.reference.sensor import noisy_limits

ROUNDING_VARIANCE = 1 / 6
REACH = 5.0
"""Sites are taken where the sensor's ends lie this many deviations away."""

LEAST_VARIANCE = 0.7**2
"""DN²: below it rounding is no noise of its own, and what rounding adds is no longer 1/6."""
LEAST_FLOAT_VARIANCE = 1e-4
"""DN²: of frames that are not rounded; a hundred times what casts to float32 add at 16 bits."""

ALARM = 6.0
"""Standard errors at which a fit is called wrong: 2e-9 by chance, for any one of them."""


NORMAL_EXCESS = 3.0
"""Fourth moment of a normal over the square of its variance, the least that is believed: of few sites it is measured
low where the variance is, and an error taken from it would be too small just where it counts."""


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """What the arrays of one pair say: slope (DN) and intercept (DN²) of the variance, each with its standard error.

    ``expected`` are the two the row's numbers come to; ``signal_dn`` and ``variance_dn2`` the points that were fitted.
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
        """How many standard errors the fit lies from what is expected, the worse of the two numbers."""
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
    """What is kept of a dataset's fits: how many, the farthest from its row, the wrong ones, and the first few."""

    count: int
    worst: NoiseFit | None
    wrong: list[NoiseFit]
    first: list[NoiseFit]


def fit_dataset(folder: Path) -> FitSummary:
    """Fit every pair of a dataset, one at a time; raises as `iterate_fits`."""
    count, worst = 0, None
    wrong: list[NoiseFit] = []
    first: list[NoiseFit] = []
    for one in iterate_fits(folder):
        count += 1
        worst = one if worst is None or one.deviation > worst.deviation else worst
        wrong += [one] if one.deviation > ALARM else []
        first += [one] if len(first) < MOST_DRAWN else []
    return FitSummary(count, worst, wrong, first)


def iterate_fits(folder: Path) -> Iterator[NoiseFit]:
    """Yield a fit for every pair of a dataset that has sites enough; DamageError where it is not whole."""
    for clean, noisy, row in RawPairs(folder):
        found = fit_pair(clean, noisy, row)
        if found is not None:
            yield found


def fit_pair(clean: Frame, noisy: Frame, row: Row) -> NoiseFit | None:
    """Fit the variance of one pair; None where fewer than three DN of the clean frame have sites enough."""
    black, slope, intercept, prnu = _law(row)
    clean_dn, noisy_dn = (mosaic_dn(frame, row).astype(np.float64) for frame in (clean, noisy))
    rounded = row["dtype"] != FLOAT32
    rounding, least = (ROUNDING_VARIANCE, LEAST_VARIANCE) if rounded else (0.0, LEAST_FLOAT_VARIANCE)
    difference = noisy_dn - clean_dn
    nearest = np.rint(np.maximum(clean_dn, 0)).astype(np.int64)
    for y in range(2):
        for x in range(2):  # an error of the black level differs from plane to plane
            difference[y::2, x::2] -= difference[y::2, x::2].mean() if difference[y::2, x::2].size else 0.0
    codes = int(nearest.max()) + 1
    count, first, second, fourth = (
        np.bincount(nearest.ravel(), weights=(difference**power).ravel(), minlength=codes) for power in (0, 1, 2, 4)
    )
    dn = np.arange(codes)
    signal = np.maximum(dn - black, 0.0)
    noise = np.maximum(slope * signal + intercept, 0.0) + (prnu * signal) ** 2
    law = noise + rounding
    reach = REACH * np.sqrt(law)
    low, high = noisy_limits(int(row["bits"] or 0), int(black), str(row["sensor_clip"]))
    inside = (dn - reach > low) & (dn + reach < high) & (dn < _number(row, "white_level_dn")) & (dn > black)
    used = inside & (count >= 16) & (noise >= least)
    if int(used.sum()) < 3:
        return None
    count, signal, law = count[used], signal[used], law[used]
    mean = first[used] / count
    variance = (second[used] - count * mean * mean) / (count - 1)
    excess = max(float((fourth[used] / law**2).sum() / count.sum()), NORMAL_EXCESS)
    weights = count / ((excess - 1) * law * law)
    points = variance - (prnu * signal) ** 2 - rounding
    normal = np.array(
        [[(weights * signal**2).sum(), (weights * signal).sum()], [(weights * signal).sum(), weights.sum()]]
    )
    inverse = np.linalg.inv(normal)
    a, b = inverse @ np.array([(weights * signal * points).sum(), (weights * points).sum()])
    shared = _shared_error(row)
    errors = math.sqrt(inverse[0, 0]), math.sqrt(inverse[1, 1] + shared * shared)
    expected = slope, intercept
    return NoiseFit(str(row["key"]), float(a), errors[0], float(b), errors[1], expected, signal, variance, rounding)


def _number(row: Row, name: str) -> float:
    return float(row[name] or 0)


def _law(row: Row) -> tuple[float, float, float, float]:
    """Return the black level, slope and intercept of the variance, and the relative deviation of the responses."""
    effects = str(row["effects"]).split(";")
    both = "heteroscedastic" in effects
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
    return (
        _number(row, "black_level_dn"),
        _number(row, "a_dn") if both or "shot" in effects else 0.0,
        _number(row, "b_dn2") if both else intercept,
        _number(row, "prnu_std") if "prnu" in effects else 0.0,
    )


def _shared_error(row: Row) -> float:
    """Return the standard error of the intercept from offsets that whole rows and columns share."""
    effects = str(row["effects"]).split(";")
    parts = (("row", "row_std_dn", "height"), ("column", "column_std_dn", "width"))
    return math.hypot(
        *(_number(row, std) ** 2 * math.sqrt(2 / _number(row, size)) for name, std, size in parts if name in effects)
    )


def draw_fits(found: list[NoiseFit], to: Path | BinaryIO) -> None:
    """Draw variance against signal of the pairs, and the lines expected, as PNG; ConfigError without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigError(f"--to {to}: drawing needs matplotlib; pip install 'unprocess_gen[figures]'") from None
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for number, one in enumerate(found):
        colour = f"C{number % 10}"
        axes.plot(one.signal_dn, one.variance_dn2, ".", color=colour, markersize=2, alpha=0.5)
        ends = np.array([one.signal_dn.min(), one.signal_dn.max()])
        axes.plot(ends, one.expected[0] * ends + one.expected[1] + one.rounding_dn2, color=colour, label=one.key)
    axes.set(xlabel="signal above black (DN)", ylabel="variance of noisy - clean (DN²)", title="Photon transfer")
    axes.legend(title="line: the manifest's numbers")
    figure.savefig(to, dpi=120)


MOST_DRAWN = 8
