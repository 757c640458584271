"""Exponentials, logarithms and normal quantiles in integers: the quick way to correctly rounded draws.

`exact_distributions` defines drawn parameters with 40 decimal digits, rounded once to float64, which takes up to half a
millisecond. This module computes an interval that contains the exact value and the one in `decimal`. If all of it
rounds to one float64, that is the drawn parameter. Otherwise, once in some 100,000 draws, functions return None and the
caller uses `decimal` (Ziv, ACM TOMS 17, 1991). Both ways give the same digits on every machine: integer arithmetic is
exact, and Python rounds the quotient of two integers correctly.

A number x is the integer next to x · 2**128; one unit is 2**-128. An error is a number of units, at least the distance
from the exact value. A product or quotient that is rounded down adds one unit. Docstrings derive the errors.

Without this module, planning an image takes up to 0.8 ms longer. Design: ``docs/design/planning.md``.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext
from statistics import NormalDist

from unprocess_gen.core.exact_distributions import DIGITS, normal_cdf, normal_density

BITS = 128
ONE = 1 << BITS

ROUNDED_BITS = 100
"""The last operations in `decimal` change a result by less than 2**-100 of it: they round to 40 digits."""

DECIMAL_ERROR = 1 << (BITS - 90)
"""Units, 8e-28: more than rounding to 40 digits changes an exponent whose terms are at most 1e11."""

QUANTILE_ERROR = 1 << (BITS - 70)
"""Units, 8e-22: `exact_distributions.normal_quantile` has 23 correct digits and is below 8.3."""


def fixed(value: Decimal) -> int:
    """Fixed-point form of a decimal number, within half a unit."""
    with localcontext(prec=3 * DIGITS):
        return int((value * ONE).to_integral_value())


def times(number: int, factor: float) -> int:
    """Multiply a fixed-point number by a float; the error grows by this factor, and then by one unit."""
    top, bottom = factor.as_integer_ratio()  # the bottom is a power of two
    return number * top >> bottom.bit_length() - 1


def nearest(number: int, error: int) -> float | None:
    """Float64 to which a number and all that are within its error round; None if they round to several.

    The distance to a result in `decimal` may be larger than ``error`` by 2**-100 of the number.
    """
    error += abs(number) >> ROUNDED_BITS
    low, high = (number - error) / ONE, (number + error) / ONE
    return low if low == high else None


def nearest_inverse(number: int, error: int) -> float | None:
    """Float64 next to 1 divided by a fixed-point number, as by `nearest`."""
    error += abs(number) >> ROUNDED_BITS
    if abs(number) <= error:
        return None
    low, high = ONE / (number + error), ONE / (number - error)
    return low if low == high else None


# -------------------------------------------------------------------------------------------- exponential and logarithm

with localcontext(prec=DIGITS + 10):
    LN2 = fixed(Decimal(2).ln())

STEP_BITS = 8
"""Steps of 2**-8: the exponential and the logarithm are tabulated in them, and continued by a series."""

_EXP_SERIES = tuple(itertools.accumulate(range(1, 12), lambda term, n: term // n, initial=ONE))[::-1]
_LN_SERIES = tuple(2 * ONE // n for n in range(15, 0, -2))
"""Coefficients 1/n! of e**x from n = 11, and 2/n of 2·artanh(x) from n = 15 in steps of 2, down to the first."""

MAX_EXPONENT, MAX_EXPONENT_ERROR = 700 * ONE, ONE >> 32
"""Largest magnitude of an exponent, whose exponential is a normal float64, and its largest error."""


@functools.cache
def _exp_of_step(step: int) -> int:
    """e**(step / 256) within one unit."""
    with localcontext(prec=DIGITS + 10):
        return fixed((Decimal(step) / (1 << STEP_BITS)).exp())


@functools.cache
def _ln_of_step(step: int) -> int:
    """ln(step / 256) within one unit."""
    with localcontext(prec=DIGITS + 10):
        return fixed((Decimal(step) / (1 << STEP_BITS)).ln())


def exponential(exponent: int, error: int) -> tuple[int, int, int]:
    """Mantissa of e**exponent from 1 to 2.01, its error, and the power of two q that multiplies both.

    The error of the exponent is at most `MAX_EXPONENT_ERROR`. e**exponent is 2**q · e**(step / 256) · e**x with 0 ≤ x <
    2**-8. The series of e**x lacks less than 1.01 · x**12 / 12!, 10 units; its coefficients, rounded down, and its
    products add 2 units. The product with e**(step / 256) < 2 is the mantissa, within 28 units of that for the computed
    x. The error of x, with one unit of ln 2 for each unit of q, moves it by less than 3 times as much.
    """
    doublings, rest = divmod(exponent, LN2)
    step = rest >> (BITS - STEP_BITS)
    x = rest - (step << (BITS - STEP_BITS))
    series = 0
    for coefficient in _EXP_SERIES:
        series = (series * x >> BITS) + coefficient
    return _exp_of_step(step) * series >> BITS, 3 * (error + abs(doublings)) + 28, doublings


def nearest_exp(exponent: int, error: int) -> float | None:
    """Float64 next to e**exponent; None if it is undecided, or the exponent or its error is too large.

    ``error`` includes `DECIMAL_ERROR`.
    """
    if abs(exponent) > MAX_EXPONENT or error > MAX_EXPONENT_ERROR:
        return None
    mantissa, error, doublings = exponential(exponent, error)
    error += mantissa >> ROUNDED_BITS
    top, bottom = (1 << doublings, ONE) if doublings >= 0 else (1, ONE << -doublings)
    low, high = (mantissa - error) * top / bottom, (mantissa + error) * top / bottom
    return low if low == high else None


@functools.lru_cache(maxsize=256)
def logarithm(x: float) -> tuple[int, int]:
    """Natural logarithm of a positive float, and its error.

    x is 2**q · m with ½ ≤ m < 1, and ln m is ln(step / 256) + 2·artanh(r) with r = (m - step / 256) / (m + step / 256),
    0 ≤ r < 2**-8. The series lacks less than r**17 / 8, one unit. The quotient, the series and the table add less than
    7 units, and each unit of q one of ln 2. Most draws take logarithms of constants, which are kept.
    """
    fraction, doublings = math.frexp(x)
    mantissa = int(fraction * 2.0**53)
    step = mantissa >> (53 - STEP_BITS)
    step_mantissa = step << (53 - STEP_BITS)
    r = (mantissa - step_mantissa) * ONE // (mantissa + step_mantissa)
    square, series = r * r >> BITS, 0
    for coefficient in _LN_SERIES:
        series = (series * square >> BITS) + coefficient
    return doublings * LN2 + _ln_of_step(step) + (series * r >> BITS), abs(doublings) + 8


# -------------------------------------------------------------------------------------------------------------- normal

NODES = 64
"""Nodes for each standard deviation."""

REACH = 1 / 80
"""Distance from a node up to which its series is used: more than half of the distance between nodes."""

MAX_QUANTILE = 8.4
"""Largest magnitude of a quantile. At most 8.3 belongs to a uniform of 53 bits."""

_SERIES_ERROR = 2.0**-80
_NORMAL = NormalDist()


@dataclass(frozen=True, slots=True)
class _Node:
    """Taylor series of the upper normal quantile z(tail) at one quantile; see `normal_quantile`.

    ``tail`` and ``density`` are 1 - Φ(z) and φ(z) within one unit, ``reach`` is the largest difference of tails for
    which the series is used. ``coefficients`` begin with the highest power. ``error_of_unit`` is the error for each
    unit of error of the tail.
    """

    quantile: int
    tail: int
    density: int
    reach: int
    coefficients: tuple[int, ...]
    error: int
    error_of_unit: int


@functools.cache
def _derivative(order: int) -> tuple[int, ...]:
    """Coefficients, constant first, of the polynomial P with d**order z / d(-tail)**order = P(z) / φ(z)**order.

    P is 1 for the first order. As dz / d(-tail) = 1/φ and φ' = -z·φ, the next P is P' + order · z · P, so no
    coefficient is negative.
    """
    if order == 1:
        return (1,)
    before = (*_derivative(order - 1), 0, 0)
    return tuple((n + 1) * before[n + 1] + ((order - 1) * before[n - 1] if n else 0) for n in range(len(before) - 1))


def _scaled_derivative(order: int, number: int) -> int:
    """P(number / `NODES`) · `NODES`**(order - 1), an integer, where P is the polynomial of `_derivative`."""
    total, scale = 0, 1
    for coefficient in reversed(_derivative(order)):
        total, scale = total * number + coefficient * scale, scale * NODES
    return total


@functools.cache
def _node(number: int) -> _Node:
    """Series at the quantile ``number / 64``, with so many terms that they lack at most 2**-80.

    P increases, so its value at the next node, which is beyond `REACH`, limits the first term that is left out. The
    density at the distance `REACH` is φ(z) · e**-x with x = `REACH` · (z + `REACH` / 2); 1 - x is less than e**-x.
    """
    with localcontext(prec=DIGITS + 10):
        z = Decimal(number) / NODES
        tail, density = fixed(normal_cdf(-z)), fixed(normal_density(z))
    coefficients, order, divisor, power = [], 1, 1, REACH
    while _scaled_derivative(order, number + 1) * power > _SERIES_ERROR * divisor:
        coefficients.append(_scaled_derivative(order, number) * ONE // divisor)
        order += 1
        divisor *= order * NODES
        power *= REACH
    return _Node(
        quantile=number * ONE // NODES,
        tail=tail,
        density=density,
        reach=times(density, REACH * (1 - REACH * (number / NODES + REACH / 2))),
        coefficients=tuple(reversed(coefficients)),
        error=times(ONE, _SERIES_ERROR) + 8,
        error_of_unit=2 * ONE // density + 1,
    )


def normal_quantile(p: int, error: int) -> tuple[int, int] | None:
    """Quantile of the standard normal distribution and its error with `QUANTILE_ERROR`; None beyond `MAX_QUANTILE`.

    The quantile z of the tail min(p, 1 - p) is a Taylor series at the nearest of `NODES`, in powers of t = (tail of the
    node - tail) / φ(node). `statistics.NormalDist` chooses the node; its last bits differ between machines, but any
    node within reach gives the bounds below.

    If the tails differ by at most `REACH` · φ(node + `REACH`), the quantiles differ by at most `REACH`: between them no
    density is smaller. By Lagrange, the series then lacks at most P(node + `REACH`) / n! · `REACH`**n, where n is the
    first order left out and P the polynomial of `_derivative`. An error of the tail moves z by 1/φ(z) times as much,
    less than 1.2/φ(node), because `MAX_QUANTILE` · `REACH` is 0.105. Roundings of the node and of t count as less than
    3 units of the tail, roundings of the series as less than 8 units of z.
    """
    tail = min(p, ONE - p)
    probability = tail / ONE
    z = -_NORMAL.inv_cdf(probability) if probability > 0 else MAX_QUANTILE
    if z >= MAX_QUANTILE:
        return None
    node = _node(round(z * NODES))
    difference = node.tail - tail
    if abs(difference) > node.reach:
        return None
    t = difference * ONE // node.density
    series = 0
    for coefficient in node.coefficients:
        series = (series * t >> BITS) + coefficient
    quantile = node.quantile + (series * t >> BITS)
    return quantile if p > tail else -quantile, (error + 3) * node.error_of_unit + node.error + QUANTILE_ERROR


# ------------------------------------------------------------------------------------------------------- distributions


def nearest_log_linear(uniform: float, x: float, slope: float, intercept: float, std: float) -> float | None:
    """Float64 next to e**(slope · ln x + intercept + std · n), where n is the normal quantile of ``uniform``."""
    logarithm_x, error = logarithm(x)
    normal = normal_quantile(times(ONE, uniform), 0) if std else (0, 0)
    if normal is None:
        return None
    line = times(logarithm_x, slope) + times(ONE, intercept) + times(normal[0], std)
    error = times(error, abs(slope)) + times(normal[1], abs(std)) + 8 + DECIMAL_ERROR
    return nearest_exp(line, error)


def nearest_log_between(x: float, low_x: float, high_x: float, low: float, high: float) -> float | None:
    """Interpolate ln y linearly in ln x; all numbers but x are those of two points. None if the error is too large."""
    if low <= 0 or high <= 0:
        return None
    (bottom, bottom_error), (top, top_error) = logarithm(low), logarithm(high)
    share, share_error = _share(x, low_x, high_x)
    error = bottom_error + top_error + (share_error * abs(top - bottom) >> BITS) + 2 + DECIMAL_ERROR
    return nearest_exp(bottom + (share * (top - bottom) >> BITS), error)


def nearest_between(
    x: float, low_x: float, high_x: float, low: Sequence[float], high: Sequence[float]
) -> tuple[float, ...] | None:
    """Interpolate several y linearly in ln x, between two points. None if the error of any is too large."""
    share, share_error = _share(x, low_x, high_x)
    values = []
    for start, end in zip(low, high, strict=True):
        bottom, top = times(ONE, start), times(ONE, end)
        error = (share_error * abs(top - bottom) >> BITS) + 5 + DECIMAL_ERROR
        value = nearest(bottom + (share * (top - bottom) >> BITS), error)
        if value is None:
            return None
        values.append(value)
    return tuple(values)


def _share(x: float, low: float, high: float) -> tuple[int, int]:
    """ln(x / low) / ln(high / low), from 0 to 1, and its error.

    The quotient is within its error times the reciprocal of the divisor, and one unit.
    """
    (bottom, bottom_error), (top, top_error), (middle, middle_error) = map(logarithm, (low, high, x))
    span, error = top - bottom, 2 * bottom_error + top_error + middle_error
    return (middle - bottom) * ONE // span, (error + 1) * ONE // (span - error) + 2
