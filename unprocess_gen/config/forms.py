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
    "per_iso": Form(("slope", "intercept"), "slope · ISO + intercept (0 if it is left out)", optional=1),
    "root": Form(("c0", "c1", "c2"), "the square root of the variance c0 + c1 · ISO + c2 · ISO²", optional=2),
    "line": Form(
        ("slope", "intercept", "scatter"),
        "the standard deviation σ with ln σ = slope · ln K + intercept + scatter · n, where K is `dn_per_e` and n a "
        "standard normal deviate, drawn for each camera body with `noise.scatter=unit`",
    ),
    "scale_line": Form(
        ("slope", "intercept", "scatter"),
        "the same line for the scale of Tukey's lambda distribution; the scale is multiplied by the standard deviation "
        "at scale 1",
    ),
    "by_iso": Form(
        ("ISO", "value", "…"),
        "values at these ISOs in ascending order; between them, standard deviations are interpolated in ln σ, shapes "
        "linearly, both against ln ISO",
    ),
    "by_stop": Form(
        ("row", "…"),
        "a table with two rows for each full stop from ISO 100: row ⌊2·log₂(ISO / 100)⌋, counted from 0; a row is a "
        "shape, or four black-level errors",
    ),
    "by_log_iso": Form(
        ("[four]", "…"),
        "black-level errors of the four sites, for equal parts of the branch's range of ln ISO, lowest ISO first",
    ),
    "by_colour": Form(
        ("R", "G1", "B", "G2"),
        "black-level errors of the red, the green of the red rows, the blue, and the green of the blue rows, for any "
        "CFA pattern; before `by_stop` or `by_log_iso`, each row of four numbers has this order",
    ),
}
"""Functions of ISO that the number of a branch can be; `planning.noise_profile` evaluates them."""


def spelled(name: str, form: Form) -> str:
    """Return a form as users write it, such as ``[uniform, lowest, highest]``."""
    return f"[{', '.join((name, *form.numbers))}]"
