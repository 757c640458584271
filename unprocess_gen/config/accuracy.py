"""How each stage can be computed, what each way is off by, and the first that a budget of accuracy can afford.

A method states its worst error against the reference; the tests prove the statements, exhaustively where the domain is
finite. Within a stage the methods stand in a fixed order, cheapest first, as measured once: a choice by what a machine
measures would make the data depend on the machine. `gen-dataset accuracy` measures what the order is worth.

Errors of the clean frame are those of the whole frame with every stage in that precision, since one kernel serves them
all; those of normals are against the true quantile of their word, in standard deviations, so that the reference has one
too (the quadratics of `tables.normal_table`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import Plan


@dataclass(frozen=True, slots=True)
class Budget:
    """What may be given up for speed.

    ``readable``: only forms that one can read will do. ``clean_dn``: largest error of a DN of the clean frame, and
    ``clean_changed_share`` the share of them that may be off at all, at 14 bits. ``normal_error``: of a normal, in
    standard deviations. ``law_distance``: of the law of shot and read noise together, in total variation.
    """

    name: str
    readable: bool
    clean_dn: float
    clean_changed_share: float
    normal_error: float
    law_distance: float


@dataclass(frozen=True, slots=True)
class Method:
    """One way to compute a stage; its errors are zero where they are not stated.

    ``form``: which of `FORMS` it belongs to.
    """

    stage: str
    name: str
    form: str
    meaning: str
    clean_dn: float = 0.0
    clean_changed_share: float = 0.0
    normal_error: float = 0.0
    approximates_law: bool = False

    @property
    def spelled(self) -> str:
        """How a row names it."""
        return f"{self.stage}:{self.name}"

    @property
    def readable(self) -> bool:
        """Whether it is a form that one can read."""
        return self.form == "numpy"

    def fits(self, budget: Budget) -> bool:
        """Whether a budget can afford it."""
        return (
            (self.readable or not budget.readable)
            and self.clean_dn <= budget.clean_dn
            and self.clean_changed_share <= budget.clean_changed_share
            and self.normal_error <= budget.normal_error
            and (budget.law_distance > 0 or not self.approximates_law)
        )


FORMS = ("float32", "float64", "numpy")
"""Forms of a whole pair, cheapest first: the stages of one kernel are computed in its precision, all or none."""

FLOAT32_CLEAN_DN, FLOAT32_CHANGED_SHARE = 1.0, 5e-4
QUADRATIC_NORMAL, POLYNOMIAL_NORMAL = 1.5e-7, 5.8e-4


def _clean32(stage: str, name: str, meaning: str) -> Method:
    return Method(stage, name, "float32", meaning, FLOAT32_CLEAN_DN, FLOAT32_CHANGED_SHARE)


METHODS = (
    _clean32("curve", "float32_table", "the exact table, rounded to float32 with the matrix"),
    Method("curve", "exact_table", "float64", "tone and gamma of every code, correctly rounded to float64"),
    Method("curve", "numpy_table", "numpy", "the same table, NumPy"),
    _clean32("colour", "fused_float32", "matrix and gains of the one channel of a site, float32"),
    Method("colour", "fused_float64", "float64", "the same in float64, in the reference's order of operations"),
    Method("colour", "numpy_float64", "numpy", "matrix and gains of all three channels, NumPy"),
    Method("mosaic", "at_site_float32", "float32", "no other channel than the site's is computed"),
    Method("mosaic", "at_site", "float64", "the same"),
    Method("mosaic", "after_colour", "numpy", "the site's channel is taken from the three"),
    Method(
        "normal",
        "polynomial_float32",
        "float32",
        "inverse CDF by a polynomial in √(-log p)",
        normal_error=POLYNOMIAL_NORMAL,
    ),
    Method(
        "normal",
        "quadratic_float64",
        "float64",
        "inverse CDF by 1024 quadratics, or whatever gives the same DN",
        normal_error=QUADRATIC_NORMAL,
    ),
    Method("normal", "numpy_float64", "numpy", "the same, NumPy", normal_error=QUADRATIC_NORMAL),
    Method(
        "shot", "gaussian_where_near", "float64", "a normal where that law is near, else counts", approximates_law=True
    ),
    Method("shot", "inversion", "float64", "Poisson counts by inversion, right to 2^-32"),
    Method("shot", "numpy_inversion", "numpy", "the same, NumPy"),
    Method("effects", "fused_float64", "float64", "effects in order, row by row"),
    Method("effects", "numpy_float64", "numpy", "effects in order, NumPy"),
    _clean32("quantise", "fused_float32", "half to even above black, clipped, float32"),
    Method("quantise", "fused_float64", "float64", "half to even, clipped"),
    Method("quantise", "numpy_float64", "numpy", "the same, NumPy"),
)
"""Every method, by stage, cheapest first."""

STAGES = tuple(dict.fromkeys(method.stage for method in METHODS))

OF_COUNTS = frozenset({"shot", "effects"})
"""Stages that only noise made of counts has."""
OF_INTEGERS = frozenset({"quantise"})
"""Stages that only frames of whole DN have."""


MOST_GROWTH, MOST_GROWTH_OF_HIGHLIGHTS = 8.0, 64.0
"""What rounding takes of a look-up may grow to on its way to the clean frame, for the errors of float32 to hold: 3 and
20 with known cameras, the gains of `conf/` and the default threshold."""


def is_steep(plan: Plan) -> bool:
    """Whether a plan's matrix, gains, darkening or highlight term make more than that of it.

    The light of a channel is i · (gain + headroom · m²), where m = (i - threshold) / (1 - threshold), and i a sum of
    look-ups times the row of the matrix.
    """
    rows = [sum(abs(entry) for entry in plan.rgb2cam[at : at + 3]) * plan.exposure for at in (0, 3, 6)]
    highlights = 0.0 if plan.highlight == "none" else 1 + 2 / (1 - plan.highlight_threshold)
    return any(
        row * gain > MOST_GROWTH or row * (gain + max(1 - gain, 0.0) * highlights) > MOST_GROWTH_OF_HIGHLIGHTS
        for row, gain in zip(rows, plan.inverse_gains, strict=True)
    )


def choose_methods(
    budget: Budget, counts_electrons: bool, normalised: bool = False, steep: bool = False
) -> tuple[str, ...]:
    """Return the methods of the first form that fits, as a row names them; ConfigError where none does.

    Noise made of counts has no form in float32, nor has what is ``steep`` (`is_steep`). Frames that are ``normalised``,
    and so not rounded, are exact under any budget: beside the readable form they have one alone (`floats`), whose
    effects are the readable ones.
    """
    stages = [stage for stage in STAGES if counts_electrons or stage not in OF_COUNTS]
    forms: Sequence[str] = FORMS
    if normalised:
        stages = [stage for stage in stages if stage not in OF_INTEGERS]
        forms, budget = FORMS[1:], replace(budget, law_distance=0.0)
    for form in FORMS[1:] if steep else forms:
        chosen = [_first(stage, "numpy" if normalised and stage == "effects" else form, budget) for stage in stages]
        if None not in chosen:
            return tuple(method.spelled for method in chosen if method is not None)
    raise ConfigError(_best(stages, budget))


def methods_of_stage(stage: str) -> tuple[Method, ...]:
    """Return the methods of a stage, cheapest first."""
    return tuple(method for method in METHODS if method.stage == stage)


def method(stage: str, name: str) -> Method:
    """Return a method by stage and name; KeyError where there is none."""
    for one in methods_of_stage(stage):
        if one.name == name:
            return one
    raise KeyError(f"{stage} has no method {name}")


def _first(stage: str, form: str, budget: Budget) -> Method | None:
    fitting = (one for one in methods_of_stage(stage) if one.form == form and one.fits(budget))
    return next(fitting, None)


def _best(stages: Sequence[str], budget: Budget) -> str:
    """Say what is the best that can be had, of the first number that is asked too much of."""
    for key in ("clean_dn", "clean_changed_share", "normal_error"):
        for stage in stages:
            best = min(methods_of_stage(stage), key=lambda one: float(getattr(one, key)))
            if getattr(best, key) > getattr(budget, key):
                return (
                    f"accuracy.{key}={getattr(budget, key):g}: the best that can be had is {getattr(best, key):g} "
                    f"({best.spelled})"
                )
    raise AssertionError(f"no form fits {budget}")


# ---------------------------------------------------------------------------------------------- Gauss for Poisson
