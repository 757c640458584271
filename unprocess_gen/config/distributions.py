"""Parse the distributions of parameters; `planning.parameters` draws from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from unprocess_gen.config.values import GroupLimit, refusal
from unprocess_gen.core.fields import Numbers, is_number


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of a parameter: a kind of `DISTRIBUTIONS` and its numbers; ``constant`` has one number."""

    kind: str
    numbers: tuple[float, ...]


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
    """A distribution: names of its numbers, its meaning, and the problem of numbers that are not allowed."""

    numbers: tuple[str, ...]
    meaning: str
    problem: Callable[..., str | None] = lambda *numbers: None


_TRUNCATED = "mean", "standard deviation", "lowest", "highest"

DISTRIBUTIONS = {
    "constant": Kind(("value",), "a number, written without brackets"),
    "uniform": Kind(("lowest", "highest"), "each value in the range with equal probability", _check_increasing),
    "log_uniform": Kind(("lowest", "highest"), "a value whose logarithm is uniform", _check_log_range),
    "truncated_normal": Kind(_TRUNCATED, "a normal distribution limited to a range", _check_truncated),
    "inverse_truncated_normal": Kind(_TRUNCATED, "1 divided by a draw from `truncated_normal`", _check_truncated),
    "log_linear_in_a": Kind(
        ("slope", "intercept", "standard deviation"),
        "b of a noise profile: ln b = slope · ln a + intercept + standard deviation · n, where n is a standard normal "
        "deviate",
        _check_line,
    ),
    "choice": Kind(
        ("value", "…"),
        "one of the values with equal probability",
        lambda *values: None if values else "expected at least one value",
    ),
}
"""Distributions that a parameter can be drawn from."""


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
