"""Parse the distributions of parameters and draw from them.

Each draw is a function of one uniform in (0, 1). Exponentials, logarithms and quantiles are defined in `decimal` and
rounded once, because the last bit of libm's results differs between machines. `core.fixed_point` finds nearly all of
them some fifty times faster.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext
from typing import Any, NamedTuple

from unprocess_gen.config.values import GroupLimit, refusal
from unprocess_gen.core import fixed_point
from unprocess_gen.core.exact_distributions import DIGITS, normal_cdf, normal_quantile
from unprocess_gen.core.fields import Numbers, is_number


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of a parameter: a kind of `DISTRIBUTIONS` and its numbers; ``constant`` has one number."""

    kind: str
    numbers: tuple[float, ...]


def draw_parameter(distribution: Distribution, uniform: float, a: float = 0.0) -> float:
    """Value of a distribution at a uniform in (0, 1), correctly rounded; ``uniform`` within three roundings.

    ``a`` is the slope of the noise variance, for ``log_linear_in_a``.
    """
    kind, numbers = distribution.kind, distribution.numbers
    if kind in FIXED_POINT:
        value = FIXED_POINT[kind](uniform, a, *numbers)
        if value is not None:
            return value
    return DISTRIBUTIONS[kind].value(uniform, a, *numbers)


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
"""The functions of `DISTRIBUTIONS` that need an exponential, logarithm or quantile; None where they are undecided."""


def _check_increasing(low: float, high: float) -> str | None:
    return None if low < high else "expected the lowest value below the highest"


def _check_truncated(mean: float, std: float, low: float, high: float) -> str | None:
    if std <= 0:
        return "expected a standard deviation above 0"
    if abs(low - mean) > 6 * std or abs(high - mean) > 6 * std:
        return "expected limits within six standard deviations of the mean"
    return _check_increasing(low, high)


def _check_log_range(low: float, high: float) -> str | None:
    return _check_increasing(low, high) if low > 0 else "expected a lowest value above 0"


def _check_line(slope: float, intercept: float, std: float) -> str | None:
    if not (abs(slope) <= 10 and abs(intercept) <= 50 and 0 <= std <= 10):
        return "expected a slope of -10 to 10, an intercept of -50 to 50, a standard deviation of 0 to 10"
    return None


class Kind(NamedTuple):
    """A distribution: its form, its value at a uniform in (0, 1), a slope a and its numbers, and their `problem`."""

    numbers: tuple[str, ...]
    meaning: str
    value: Callable[..., float]
    problem: Callable[..., str | None] = lambda *numbers: None


_TRUNCATED = "mean", "standard deviation", "lowest", "highest"

# fmt: off
DISTRIBUTIONS = {
    "constant": Kind(("value",), "a number, written without brackets", _constant),
    "uniform": Kind(
        ("lowest", "highest"), "each value in the range with equal probability", _uniform, _check_increasing),
    "log_uniform": Kind(
        ("lowest", "highest"), "a value whose logarithm is uniform", _log_uniform, _check_log_range),
    "truncated_normal": Kind(
        _TRUNCATED, "a normal distribution limited to a range", _truncated_normal, _check_truncated),
    "inverse_truncated_normal": Kind(
        _TRUNCATED, "1 divided by a draw from `truncated_normal`", _inverse_truncated_normal, _check_truncated),
    "log_linear_in_a": Kind(
        ("slope", "intercept", "standard deviation"),
        "b of a noise profile: ln b = slope · ln a + intercept + standard deviation · n, where n is a standard normal "
        "deviate", _log_linear_in_a, _check_line),
    "choice": Kind(("value", "…"), "one of the values with equal probability", _choice,
                   lambda *values: None if values else "expected at least one value"),
}
"""Distributions that a parameter can be drawn from."""
# fmt: on


def spelled(name: str, numbers: Sequence[str]) -> str:
    """List as users write it, such as ``[uniform, lowest, highest]``."""
    return f"[{', '.join((name, *numbers))}]"


def parse_distribution(key: str, value: Any, allowed: tuple[str, ...]) -> Distribution:
    """Parse a number (kind ``constant``) or a distribution ``[kind, number, …]`` of an allowed kind."""
    forms = "; ".join(spelled(kind, DISTRIBUTIONS[kind].numbers) for kind in allowed)
    if is_number(value):
        return Distribution("constant", (float(value),))
    if not isinstance(value, list | tuple) or not value or value[0] not in allowed:
        raise refusal(key, value, f"expected a finite number or a distribution: {forms}")
    kind, numbers = str(value[0]), value[1:]
    form = DISTRIBUTIONS[kind]
    if (len(numbers) != len(form.numbers) and kind != "choice") or not all(is_number(number) for number in numbers):
        raise refusal(key, value, f"expected finite numbers: {spelled(kind, form.numbers)}")
    problem = form.problem(*numbers)
    if problem:
        raise refusal(key, value, problem)
    return Distribution(kind, tuple(float(number) for number in numbers))


class Drawn(GroupLimit):
    """A number, or a distribution of one of ``kinds``, all of whose draws are within ``numbers``.

    The range of ``log_linear_in_a`` depends on a and is not checked.
    """

    def __init__(self, kinds: tuple[str, ...], numbers: Numbers, range_text: str = "") -> None:
        self.kinds, self.numbers, self.range = kinds, numbers, range_text or str(numbers)
        super().__init__(f"{self.range}; constant, or drawn: {', '.join(kinds)}")
        self.is_float = True

    def parse(self, key: str, value: Any) -> Distribution:
        """Distribution that a value states; ConfigError unless all of its draws are allowed."""
        distribution = parse_distribution(key, value, self.kinds)
        if distribution.kind != "log_linear_in_a" and not (
            self.numbers.low <= lowest(distribution) and highest(distribution) <= self.numbers.high
        ):
            raise refusal(key, value, f"expected {self.range}")
        return distribution

    def check(self, key: str, value: Any, group: Any) -> None:
        """Raise ConfigError unless the value can be parsed."""
        self.parse(key, value)


def lowest(distribution: Distribution) -> float:
    """Lower limit of all draws from a validated distribution; -inf if there is none."""
    return _limits(distribution)[0]


def highest(distribution: Distribution) -> float:
    """Upper limit of all draws from a validated distribution; inf if there is none."""
    return _limits(distribution)[1]


def _limits(distribution: Distribution) -> tuple[float, float]:
    numbers = distribution.numbers
    match distribution.kind:
        case "constant" | "choice":
            return min(numbers), max(numbers)
        case "truncated_normal":
            return numbers[2], numbers[3]
        case "inverse_truncated_normal":
            return (1 / numbers[3], 1 / numbers[2]) if numbers[2] > 0 else (-math.inf, math.inf)
        case "log_linear_in_a":
            return 0.0, math.inf
    return numbers[0], numbers[-1]
