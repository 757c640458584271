"""Draw parameters from their distributions.

Each draw is a function of one uniform in (0, 1). Exponentials, logarithms and quantiles are defined in `decimal` and
rounded once, because the last bit of libm's results differs between machines. `core.fixed_point` finds nearly all of
them some fifty times faster.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from decimal import Decimal, localcontext
from typing import NamedTuple

from unprocess_gen.config.distributions import Distribution
from unprocess_gen.core import fixed_point
from unprocess_gen.core.exact_distributions import DIGITS, normal_cdf, normal_quantile


def draw_parameter(distribution: Distribution, uniform: float, a: float = 0.0) -> float:
    """Value of a distribution at a uniform in (0, 1), correctly rounded; ``uniform`` within three roundings.

    ``a`` is the slope of the noise variance, for ``log_linear_in_a``.
    """
    kind, numbers = distribution.kind, distribution.numbers
    if kind in FIXED_POINT:
        value = FIXED_POINT[kind](uniform, a, *numbers)
        if value is not None:
            return value
    return EXACT[kind](uniform, a, *numbers)


def _constant(u: float, a: float, value: float) -> float:
    return value


def _uniform(u: float, a: float, low: float, high: float) -> float:
    return low + u * (high - low)


def _log_uniform(u: float, a: float, low: float, high: float) -> float:
    with localcontext(prec=DIGITS):
        bottom, top = Decimal(low).ln(), Decimal(high).ln()
        return float((bottom + Decimal(u) * (top - bottom)).exp())


def _truncated(u: float, mean: float, std: float, low: float, high: float) -> Decimal:
    """Draw from a normal distribution truncated to [low, high], by its inverse CDF."""
    bottom, top = (normal_cdf((Decimal(limit) - Decimal(mean)) / Decimal(std)) for limit in (low, high))
    value = Decimal(mean) + Decimal(std) * normal_quantile(bottom + Decimal(u) * (top - bottom))
    return min(max(value, Decimal(low)), Decimal(high))


def _truncated_normal(u: float, a: float, mean: float, std: float, low: float, high: float) -> float:
    with localcontext(prec=DIGITS):
        return float(_truncated(u, mean, std, low, high))


def _inverse_truncated_normal(u: float, a: float, mean: float, std: float, low: float, high: float) -> float:
    with localcontext(prec=DIGITS):
        return float(1 / _truncated(u, mean, std, low, high))


def _log_linear_in_a(u: float, a: float, slope: float, intercept: float, std: float) -> float:
    """Compute b from ln b = slope · ln a + intercept + std · n, where n is a standard normal deviate.

    Source: Brooks et al. 2019, random_noise_levels(); natural logarithms.
    """
    with localcontext(prec=DIGITS):
        line = Decimal(slope) * Decimal(a).ln() + Decimal(intercept)
        return float((line + Decimal(std) * normal_quantile(Decimal(u))).exp())


def _choice(u: float, a: float, *values: float) -> float:
    """Choose one of the values with equal probability."""
    return values[int(u * len(values))]


EXACT: dict[str, Callable[..., float]] = {
    "constant": _constant,
    "uniform": _uniform,
    "log_uniform": _log_uniform,
    "truncated_normal": _truncated_normal,
    "inverse_truncated_normal": _inverse_truncated_normal,
    "log_linear_in_a": _log_linear_in_a,
    "choice": _choice,
}
"""Value of each distribution at a uniform in (0, 1), a slope a and its numbers."""


def _nearest_log_uniform(u: float, a: float, low: float, high: float) -> float | None:
    (bottom, bottom_error), (top, top_error) = fixed_point.logarithm(low), fixed_point.logarithm(high)
    exponent = bottom + fixed_point.times(top - bottom, u)
    return fixed_point.nearest_exp(exponent, bottom_error + top_error + 1 + fixed_point.DECIMAL_ERROR)


class _Truncated(NamedTuple):
    """Truncated normal distribution, fixed-point: CDF at the lower limit and its increase to the upper one, numbers."""

    bottom: int
    increase: int
    mean: int
    low: int
    high: int


@functools.lru_cache(maxsize=256)
def _fixed_truncated(mean: float, std: float, low: float, high: float) -> _Truncated:
    with localcontext(prec=DIGITS):
        bottom, top = (normal_cdf((Decimal(limit) - Decimal(mean)) / Decimal(std)) for limit in (low, high))
        numbers = (fixed_point.times(fixed_point.ONE, number) for number in (mean, low, high))
        return _Truncated(fixed_point.fixed(bottom), fixed_point.fixed(top - bottom), *numbers)


def _nearest_truncated(
    finish: Callable[[int, int], float | None], u: float, a: float, mean: float, std: float, low: float, high: float
) -> float | None:
    """Draw from a truncated normal distribution, fixed-point; ``finish`` rounds the value, given its error.

    Roundings to 40 digits, to units, and of the product with ``u`` move the probability by less than 4 units. Returns
    None next to a limit, where `_truncated` clips.
    """
    known = _fixed_truncated(mean, std, low, high)
    normal = fixed_point.normal_quantile(known.bottom + fixed_point.times(known.increase, u), 4)
    if normal is None:
        return None
    value = known.mean + fixed_point.times(normal[0], std)
    error = fixed_point.times(normal[1], std) + 3
    within = known.low < value - 2 * error and value + 2 * error < known.high
    return finish(value, error) if within else None


FIXED_POINT: dict[str, Callable[..., float | None]] = {
    "log_uniform": _nearest_log_uniform,
    "truncated_normal": functools.partial(_nearest_truncated, fixed_point.nearest),
    "inverse_truncated_normal": functools.partial(_nearest_truncated, fixed_point.nearest_inverse),
    "log_linear_in_a": fixed_point.nearest_log_linear,
}
"""The functions of `EXACT` that need an exponential, logarithm or quantile; None where they are undecided."""
