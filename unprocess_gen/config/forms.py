"""Name the lists that users write instead of a number: distributions, and functions of ISO in noise profiles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Form:
    """A list ``[name, number, …]``: names of its numbers, its meaning, and how many at the end are ``optional``."""

    numbers: tuple[str, ...]
    meaning: str
    optional: int = 0


DISTRIBUTION_FORMS: Mapping[str, Form] = {
    "constant": Form(("value",), "a number, written without brackets"),
    "uniform": Form(("lowest", "highest"), "each value in the range with equal probability"),
    "log_uniform": Form(("lowest", "highest"), "a value whose logarithm is uniform"),
    "truncated_normal": Form(
        ("mean", "standard deviation", "lowest", "highest"), "a normal distribution limited to a range"
    ),
    "inverse_truncated_normal": Form(
        ("mean", "standard deviation", "lowest", "highest"), "1 divided by a draw from `truncated_normal`"
    ),
    "log_linear_in_a": Form(
        ("slope", "intercept", "standard deviation"),
        "b of a noise profile: ln b = slope · ln a + intercept + standard deviation · n, where n is a standard normal "
        "deviate",
    ),
    "choice": Form(("value", "…"), "one of the values with equal probability"),
}
"""Distributions that a parameter can be drawn from, by kind."""

ISO_FORMS: Mapping[str, Form] = {
    "line": Form(
        ("slope", "intercept", "scatter"),
        "a gain or standard deviation x with ln x = slope · ln ISO + intercept + scatter · n (0 if it is left out), "
        "where n is a standard normal deviate, drawn for each camera body with `noise.scatter=unit`",
        optional=1,
    ),
    "by_iso": Form(
        ("ISO", "value", "…"),
        "values at these ISOs in ascending order; between them, gains and standard deviations are interpolated in "
        "their logarithms, shapes and black-level errors linearly, both against ln ISO; a value of `black_error_dn` is "
        "one number, or four: R, G of the red rows, B, G of the blue rows",
    ),
}
"""Functions of ISO that the number of a branch can be; `planning.noise_profile` evaluates them."""


def spelled(name: str, form: Form) -> str:
    """Return a form as users write it, such as ``[uniform, lowest, highest]``."""
    return f"[{', '.join((name, *form.numbers))}]"
