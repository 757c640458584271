"""Build the lookup tables of inverse distribution functions: normal, Tukey's lambda, exponential.

Noise is drawn by inverse CDF: a random word selects a row of a table, and a quadratic gives the quantile. A table has
32 octaves of the tail probability with 32 segments each. The error of a normal quantile is below 1.5e-7. The table
takes 24 kB, so it stays in the L1 cache.

Every machine must compute the same tables. The normal table is rounded to a grid that hides the last digits of libm,
and its SHA-256 is checked; the other tables are computed in `decimal`. Alternatives: ``docs/design/lookup_tables.md``.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Sequence
from decimal import Decimal, localcontext
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.exact_distributions import DIGITS, tukey_quantile, tukey_std
from unprocess_gen.core.fixed_point import ROUNDED_BITS, exponential, fixed, times

OCTAVES, SEGMENTS = 32, 32

NORMAL_SHA256 = "1de8806d2534020a52f8f25e981f0bc9f85f65e29bd634c29e7dc0820480ba5a"

COEFFICIENT_GRID = (2.0**-36, 2.0**-28, 2.0**-20)
"""Grids to which the three coefficients of the normal table are rounded.

The rounding costs less than 1e-9. Quantiles that are four units in the last place off give the same table.
"""

CHEBYSHEV_NODES = (0.5 - math.sqrt(3) / 4, 0.5, 0.5 + math.sqrt(3) / 4)
"""Chebyshev nodes of a segment: interpolation at them has nearly the smallest possible maximum error."""


def sha256(table: Float) -> str:
    """SHA-256 of the little-endian values of a table, 64 hex digits."""
    return hashlib.sha256(table.astype("<f8").tobytes()).hexdigest()


def freeze(table: Float, expected_sha256: str | None = None) -> Float:
    """Make a table read-only and return it; raise MachineError if it has another SHA-256 than expected."""
    if expected_sha256 is not None and (actual := sha256(table)) != expected_sha256:
        raise MachineError(
            f"a table has SHA-256 {actual}; expected {expected_sha256}; reinstall unprocess_gen or use another Python"
        )
    table.flags.writeable = False
    return table


@functools.lru_cache(maxsize=1)
def normal_table() -> Float:
    """Table of normal quantiles, float64 [1024, 3], read-only; MachineError if it is not the published one.

    Row ``32 e + s`` has the coefficients (c0, c1, c2) for the words j with 2**e (1 + s/32) ≤ j < 2**e (1 + (s + 1)/32),
    whose tail probability is p = j / 2**33. With t = j / 2**e - 1 - s/32 the quantile -Φ⁻¹(p) is c0 + t (c1 + t c2).
    """
    rows = [_normal_row(octave, segment) for octave in range(OCTAVES) for segment in range(SEGMENTS)]
    grid = np.array(COEFFICIENT_GRID)
    return freeze(np.rint(np.array(rows) / grid) * grid, NORMAL_SHA256)


@functools.lru_cache(maxsize=64)
def tukey_table(shape: float) -> Float:
    """Table as `normal_table` of Tukey's lambda distribution with variance 1; takes 0.2 s.

    ValueError unless the shape λ is in (-½, 10); the variance is infinite up to -½.
    """
    if not -0.5 < shape < 10:
        raise ValueError(f"shape={shape}: Tukey's lambda distribution is not usable; expected a number in (-0.5, 10)")
    with localcontext(prec=DIGITS):
        std = tukey_std(shape)
        divisor = fixed(abs(Decimal(shape)) * std)
        quantiles = [_tukey_node(*node, shape, std, divisor) for node in _tails()]
    return freeze(np.array([_interpolate(quantiles[n : n + 3]) for n in range(0, len(quantiles), 3)]))


@functools.cache
def _tails() -> list[tuple[Decimal, int, int]]:
    """Tail probability p of each node of all segments, with ln(1 - p) and ln p in fixed-point numbers."""
    with localcontext(prec=DIGITS):
        nodes = [1 + (segment + Decimal(node)) / SEGMENTS for segment in range(SEGMENTS) for node in CHEBYSHEV_NODES]
        tails = [node * Decimal(2) ** (octave - 33) for octave in range(OCTAVES) for node in nodes]
        return [(tail, fixed((1 - tail).ln()), fixed(tail.ln())) for tail in tails]


TAIL_ERROR = 1 << 8
"""Units of `fixed_point`: more than roundings to 40 digits, and of the logarithms, move an exponent of a quantile."""


def _tukey_node(tail: Decimal, ln_rest: int, ln_tail: int, shape: float, std: Decimal, divisor: int) -> float:
    """Quantile 1 - ``tail`` of Tukey's lambda distribution with variance 1; ``divisor`` is abs(shape) · std.

    Exponentials in fixed-point numbers take a sixth of the time of decimal ones, which decide what they cannot.
    """
    if abs(shape) > 1e-3:  # otherwise the difference of the powers cancels
        (rest, rest_error), (power, power_error) = (
            (mantissa << doublings, error << doublings) if doublings >= 0 else
            (mantissa >> -doublings, (error >> -doublings) + 2)
            for mantissa, error, doublings in (exponential(times(ln, shape), TAIL_ERROR) for ln in (ln_rest, ln_tail))
        )  # fmt: skip
        value = abs(rest - power)
        error = rest_error + power_error + (value >> ROUNDED_BITS)
        low, high = (value - error) / divisor, (value + error) / divisor
        if low == high:
            return low
    return float(tukey_quantile(tail, shape) / std)


@functools.lru_cache(maxsize=64)
def unit_tukey_table(shape: float) -> Float:
    """`tukey_table` divided by the standard deviation of its draws, so that it has variance 1 for all shapes.

    Random words have 32 bits, so no tail probability is below 2**-33. Quantiles beyond hold 0.02 % of the variance at
    shape -0.3, 1.5 % at -0.4 and 12 % at -0.45.
    """
    table = tukey_table(shape)
    with localcontext(prec=DIGITS):
        std = draw_variance(table).sqrt()
        return freeze(np.array([[float(Decimal(number) / std) for number in row] for row in table.tolist()]))


def draw_variance(table: Float) -> Decimal:
    """Mean square of the draws of a symmetric table from all 2**32 random words, in the current decimal context.

    Rounding of the table's evaluation to float64 is left out.
    """
    total = Decimal(0)
    for row, coefficients in enumerate(table.tolist()):
        octave, segment = divmod(row, SEGMENTS)
        ends = (-(-(2**octave * (SEGMENTS + edge)) // SEGMENTS) for edge in (segment, segment + 1))
        first, end = (word | 1 for word in ends)  # words j are odd
        start = Decimal(first) / 2**octave - 1 - Decimal(segment) / SEGMENTS
        total += _sum_of_squares((end - first) // 2, start, Decimal(2) / 2**octave, *map(Decimal, coefficients))
    return total / 2**31


def _sum_of_squares(count: int, start: Decimal, step: Decimal, c0: Decimal, c1: Decimal, c2: Decimal) -> Decimal:
    """Sum of (c0 + t (c1 + t c2))² over ``count`` values of t, from ``start`` in steps."""
    a, b, c = c0 + start * (c1 + start * c2), step * (c1 + 2 * start * c2), step * step * c2
    n = count
    first, second = n * (n - 1) // 2, n * (n - 1) * (2 * n - 1) // 6  # sums of the first four powers of 0 … n - 1
    third, fourth = first * first, n * (n - 1) * (2 * n - 1) * (3 * n * n - 3 * n - 1) // 30
    return a * a * n + 2 * a * b * first + (b * b + 2 * a * c) * second + 2 * b * c * third + c * c * fourth


def quantile_table(distribution: str, shape: float) -> Float:
    """Table of a distribution of the read noise, ``gaussian`` or ``tukey_lambda``, for standard deviation 1."""
    return normal_table() if distribution == "gaussian" else unit_tukey_table(shape)


@functools.lru_cache(maxsize=1)
def exponential_levels() -> Float:
    """Quantiles of the exponential distribution at the centres of 1024 equal probabilities, divided by their mean."""
    with localcontext(prec=DIGITS):
        levels = [-((1023 - step + Decimal("0.5")) / 1024).ln() for step in range(1024)]
        mean = sum(levels, Decimal(0)) / 1024
        return freeze(np.array([float(level / mean) for level in levels]))


def _normal_row(octave: int, segment: int) -> tuple[float, float, float]:
    """Unrounded coefficients of one row of the normal table."""
    quantile = NormalDist().inv_cdf
    z = [-quantile(math.ldexp(1 + segment / SEGMENTS + node / SEGMENTS, octave - 33)) for node in CHEBYSHEV_NODES]
    return _interpolate(z)


def _interpolate(z: Sequence[float]) -> tuple[float, float, float]:
    """Quadratic in the position within a segment that has the values ``z`` at `CHEBYSHEV_NODES`."""
    t = [node / SEGMENTS for node in CHEBYSHEV_NODES]
    slope01, slope12 = (z[1] - z[0]) / (t[1] - t[0]), (z[2] - z[1]) / (t[2] - t[1])
    c2 = (slope12 - slope01) / (t[2] - t[0])
    c1 = slope01 - c2 * (t[0] + t[1])
    return z[0] - t[0] * (c1 + t[0] * c2), c1, c2


LINES_PER_OCTAVE = 128
LINE_SHIFT, FIRST_LINE = 16, 126 * LINES_PER_OCTAVE
"""A word's line is number (bits of f) >> `LINE_SHIFT` - `FIRST_LINE`, for the float32 f = (its lower 31 bits) + ½."""

FLOAT32_LINE_ERROR = 2.0**-21
"""Error that float32 adds to a line, relative to the farthest quantile and to the line's rise over its octave."""


class QuantileLines(NamedTuple):
    """Approximation of a symmetric distribution in float32 by lines start + slope·f; the last one is the median."""

    start: NDArray[np.float32]
    slope: NDArray[np.float32]
    error: float  # largest difference from the quadratics


def quantile_lines(table: Float) -> QuantileLines:
    """Lines for a table of quadratics ``[1024, 3]``: 128 for each octave, which halve the errors of chords."""
    per_segment = LINES_PER_OCTAVE // SEGMENTS
    rows = np.repeat(table, per_segment, axis=0)
    t = np.arange(per_segment + 1) / LINES_PER_OCTAVE
    part = np.tile(np.arange(per_segment), len(table))
    low, high = t[part], t[part + 1]
    z_low, z_high, z_middle = (rows[:, 0] + x * (rows[:, 1] + x * rows[:, 2]) for x in (low, high, (low + high) / 2))
    octave = np.repeat(2.0 ** (np.arange(OCTAVES) - 1), LINES_PER_OCTAVE)
    f_low = octave * (1 + np.tile(np.arange(LINES_PER_OCTAVE) / LINES_PER_OCTAVE, OCTAVES))
    f_high = f_low + octave / LINES_PER_OCTAVE
    slope = (z_high - z_low) / (f_high - f_low)
    start = z_low - slope * f_low + (z_middle - (z_low + z_high) / 2) / 2
    lines = [np.append(values, 0.0).astype(np.float32) for values in (start, slope)]
    start64, slope64 = (values[:-1].astype(np.float64) for values in lines)
    error = max(
        float(np.abs(z - (start64 + slope64 * f)).max())
        for z, f in ((z_low, f_low), (z_middle, (f_low + f_high) / 2), (z_high, f_high))
    )
    error += FLOAT32_LINE_ERROR * (float(np.abs(table[:, 0]).max()) + float(np.abs(slope * f_high).max()))
    return QuantileLines(lines[0], lines[1], error)
