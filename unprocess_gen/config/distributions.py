"""The laws that a parameter can be drawn from, each a function of one uniform.

What needs an exponential, a logarithm or a quantile is computed in `decimal` and rounded once, since no libm gives the
same last bit everywhere; that costs up to a millisecond a draw.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, localcontext

from unprocess_gen.core.lookup_tables import DIGITS, normal_cdf, normal_quantile
from unprocess_gen.core.types import Law


def draw(law: Law, uniform: float, a: float = 0.0) -> float:
    """Return the value of a law at a uniform in (0, 1); ``a`` is what ``log_linear_in_a`` depends on."""
    return LAWS[law.kind](uniform, a, *law.numbers)


def _constant(u: float, a: float, value: float) -> float:
    return value


def _uniform(u: float, a: float, low: float, high: float) -> float:
    return low + u * (high - low)


def _log_uniform(u: float, a: float, low: float, high: float) -> float:
    with localcontext(prec=DIGITS):
        bottom, top = Decimal(low).ln(), Decimal(high).ln()
        return float((bottom + Decimal(u) * (top - bottom)).exp())


def _truncated(u: float, mean: float, std: float, low: float, high: float) -> Decimal:
    """A normal draw that lies in [low, high]: the quantile of a uniform between their probabilities."""
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
    """ln b = slope · ln a + intercept + std · n (Brooks et al. 2019, random_noise_levels(); natural logarithms)."""
    with localcontext(prec=DIGITS):
        line = Decimal(slope) * Decimal(a).ln() + Decimal(intercept)
        return float((line + Decimal(std) * normal_quantile(Decimal(u))).exp())


def _choice(u: float, a: float, *values: float) -> float:
    """One of the values, each as likely."""
    return values[int(u * len(values))]


LAWS: dict[str, Callable[..., float]] = {
    "constant": _constant,
    "choice": _choice,
    "uniform": _uniform,
    "log_uniform": _log_uniform,
    "truncated_normal": _truncated_normal,
    "inverse_truncated_normal": _inverse_truncated_normal,
    "log_linear_in_a": _log_linear_in_a,
}
"""What each law does with a uniform in (0, 1)."""
