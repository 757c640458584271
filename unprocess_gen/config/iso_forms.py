"""Numbers of a noise profile that may depend on the ISO: how settings state them, and what is refused."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.config.values import GroupLimit, refusal
from unprocess_gen.core.fields import is_number

MAX_BRANCH_NUMBER = 1e9
"""Largest number in a branch of a physical profile, and largest standard deviation in DN that a line gives."""

HEAVIEST_TAILS = -0.45
"""Least shape of ``tukey_lambda``, whose table is 7 % wider than the distribution, so that its variance is 1."""

FARTHEST_NORMAL = 6.4
"""No normal deviate of a 32-bit uniform is farther from 0."""


class Form(NamedTuple):
    """A list ``[name, number, …]``: names of its numbers, and its meaning."""

    numbers: tuple[str, ...]
    meaning: str


ISO_FORMS = {
    "line": Form(
        ("slope", "intercept", "scatter"),
        "a gain or standard deviation x with ln x = slope · ln ISO + intercept + scatter · n (0 if it is left out), "
        "where n is a standard normal deviate, drawn for each camera body with `noise.scatter=unit`",
    ),
    "by_iso": Form(
        ("ISO", "value", "…"),
        "values at these ISOs in ascending order; between them, gains and standard deviations are interpolated in "
        "their logarithms, shapes and black-level errors linearly, both against ln ISO; a value of `black_error_dn` is "
        "one number, or four: R, G of the red rows, B, G of the blue rows",
    ),
}
"""Functions of ISO that the number of a branch can be; `planning.noise_profile` evaluates them."""


class IsoNumber(GroupLimit):
    """A gain or standard deviation of a branch: a number, or one of `ISO_FORMS`."""

    def __init__(self) -> None:
        super().__init__(
            f"a number of 0 or more, up to {MAX_BRANCH_NUMBER:g}, or a form: {', '.join(ISO_FORMS)}",
            lambda value: is_number(value) and 0 <= value <= MAX_BRANCH_NUMBER,
        )

    def check(self, key: str, value: Any, group: Any) -> None:
        """Raise ConfigError unless a value is a number or an allowed form in the ISO range of the branch."""
        match value:
            case ["line", *numbers]:
                if len(numbers) not in (2, 3) or not all(map(_is_branch_number, numbers)):
                    problem = f"line takes 2 or 3 finite numbers of at most {MAX_BRANCH_NUMBER:g}"
                    raise refusal(key, value, problem)
                slope, intercept, scatter = (*numbers, 0.0)[:3]
                largest = max(slope * math.log(iso) for iso in group.iso) + intercept + FARTHEST_NORMAL * abs(scatter)
                if largest > math.log(MAX_BRANCH_NUMBER):
                    line = "slope, intercept and scatter of ln(value) against ln(ISO)"
                    raise refusal(key, value, f"exceeds {MAX_BRANCH_NUMBER:g} within the ISO range; expected {line}")
            case ["by_iso", *pairs]:
                if not all(is_number(number) and 0 < number <= MAX_BRANCH_NUMBER for number in pairs):
                    raise refusal(key, value, f"expected numbers above 0, up to {MAX_BRANCH_NUMBER:g}")
                _table_values(key, value, group)
            case _ if not self.allows(value):
                raise refusal(key, value, f"expected {self}")


class IsoValue(GroupLimit):
    """A value, or a table ``by_iso`` of such values; ``allows`` tests a single one."""

    def check(self, key: str, value: Any, group: Any) -> None:
        """Raise ConfigError unless all values are allowed, and a table has the ISO range of the branch."""
        if not all(map(self.allows, _values(key, value, group))):
            raise refusal(key, value, f"expected {self}")


class IsoShape(IsoValue):
    """A shape of Tukey's lambda, or a table of them."""

    def check(self, key: str, value: Any, group: Any) -> None:
        """Refuse heavy tails too: their variance is mostly in values that are never drawn."""
        super().check(key, value, group)
        if group.read_law == "tukey_lambda" and min(_values(key, value, group)) < HEAVIEST_TAILS:
            lacking = "draws of 32 bits lack more than 12 % of the variance"
            raise refusal(key, value, f"{lacking}; expected shapes of {HEAVIEST_TAILS:g} or more")


def _is_branch_number(value: Any) -> bool:
    return is_number(value) and abs(value) <= MAX_BRANCH_NUMBER


def _is_black_error(value: Any) -> bool:
    four = value if isinstance(value, list | tuple) else [value] * 4
    return len(four) == 4 and all(map(_is_branch_number, four))


def _values(key: str, value: Any, branch: Any) -> Sequence[Any]:
    """Values of a table ``by_iso``, or the value itself."""
    is_table = isinstance(value, list | tuple) and list(value[:1]) == ["by_iso"]
    return _table_values(key, value, branch) if is_table else [value]


def _table_values(key: str, value: Sequence[Any], branch: Any) -> Sequence[Any]:
    """Values of a table whose ISOs ascend and contain the range of the branch; ConfigError for others."""
    isos = value[1::2]
    ascend = all(map(is_number, isos)) and all(low < high for low, high in itertools.pairwise(isos))
    if len(value) % 2 == 0 or not isos or not ascend:
        raise refusal(key, value, "expected pairs of ISO and value, ISOs in ascending order")
    first, last = branch.iso
    if not isos[0] <= first <= last <= isos[-1]:
        expected = f"expected values for the ISOs of the branch, {first:g} to {last:g}"
        raise refusal(key, value, f"has ISO {isos[0]:g} to {isos[-1]:g}; {expected}")
    return value[2::2]


READ_SHAPE = IsoShape(
    "a shape of more than -0.5, where the Tukey-lambda distribution has a variance, and less than 10, or a table, "
    "[by_iso, ISO, shape, …]",
    lambda value: is_number(value) and -0.5 < value < 10,
)
BLACK_ERROR = IsoValue(
    "a number, four (R, G of the red rows, B, G of the blue rows), or a table of such values, [by_iso, ISO, value, …]",
    _is_black_error,
)


def value_at(form: Any, iso: float) -> float:
    """Gain or standard deviation at an ISO without scatter, to the precision of the C library."""
    match form:
        case ["line", slope, intercept, *_]:
            return math.exp(slope * math.log(iso) + intercept)
        case ["by_iso", *pairs]:
            return math.exp(np.interp(math.log(iso), np.log(pairs[::2]), np.log(pairs[1::2])))
    return float(form)
