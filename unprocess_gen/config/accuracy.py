"""Declare the methods of each stage with their errors, and choose the first that a budget of errors allows.

Each `Method` states its largest error against the reference. Tests prove the statements, exhaustively if the domain is
finite. Methods are tried in a fixed order of cost, never in a measured one: the data must not depend on the machine.
``gen-dataset accuracy`` measures the time and the error of each method.

A method's error of the clean frame is the error of a frame whose stages all have its precision, because one kernel
computes all stages. Errors of normal deviates are against the true quantile, in standard deviations; so the reference
has one too (the quadratics of `core.lookup_tables.normal_table`).

How the error statements were obtained: ``docs/design/accuracy.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from unprocess_gen.config.schema import AccuracyConfig
from unprocess_gen.config.values import refusal
from unprocess_gen.core.types import CameraPlan


@dataclass(frozen=True, slots=True)
class Method:
    """Describe one way to compute a stage. Errors that are not stated are zero.

    Attributes
    ----------
    stage, name : str
        Identify the method in rows, as ``stage:name``.
    implementation : str
        One of `IMPLEMENTATIONS`.
    meaning : str
        Description for the accuracy report.
    clean_dn, clean_changed_share, normal_error : float
        Largest errors; units as in `AccuracyConfig`.
    """

    stage: str
    name: str
    implementation: str
    meaning: str
    clean_dn: float = 0.0
    clean_changed_share: float = 0.0
    normal_error: float = 0.0

    @property
    def spelled(self) -> str:
        """Return ``stage:name``, the name in rows."""
        return f"{self.stage}:{self.name}"

    @property
    def readable(self) -> bool:
        """True if the method belongs to the NumPy reference."""
        return self.implementation == "numpy"

    def fits(self, budget: AccuracyConfig) -> bool:
        """True if all errors of the method are within a budget."""
        return (
            (self.readable or not budget.readable)
            and self.clean_dn <= budget.clean_dn
            and self.clean_changed_share <= budget.clean_changed_share
            and self.normal_error <= budget.normal_error
        )


IMPLEMENTATIONS = ("float32", "float64", "numpy")
"""Implementations of a pair, cheapest first. One kernel computes several stages, so all stages use the same one."""

FLOAT32_CLEAN_DN, FLOAT32_CHANGED_SHARE = 1.0, 5e-4
"""Errors of the clean frame in float32: largest, DN, and fraction of values that differ, at 14 bits."""

QUADRATIC_NORMAL, POLYNOMIAL_NORMAL = 1.5e-7, 5.8e-4
"""Errors of normal deviates by 1024 quadratics and by a polynomial, in standard deviations."""


_CLEAN32: dict[str, Any] = {"clean_dn": FLOAT32_CLEAN_DN, "clean_changed_share": FLOAT32_CHANGED_SHARE}

METHODS = (
    Method("curve", "float32_table", "float32", "the exact table and the matrix, rounded to float32", **_CLEAN32),
    Method("curve", "exact_table", "float64", "tone and gamma of every code, correctly rounded to float64"),
    Method("curve", "numpy_table", "numpy", "tone and gamma of every code, with NumPy"),
    Method("colour", "fused_float32", "float32", "matrix and gains of the channel of each site, float32", **_CLEAN32),
    Method("colour", "fused_float64", "float64", "matrix and gains of the channel of each site, as the reference"),
    Method("colour", "numpy_float64", "numpy", "matrix and gains of all three channels, NumPy"),
    Method("mosaic", "at_site_float32", "float32", "only the channel of each site is computed, float32", **_CLEAN32),
    Method("mosaic", "at_site", "float64", "only the channel of each site is computed"),
    Method("mosaic", "after_colour", "numpy", "all three channels are computed, one is selected"),
    Method("normal", "polynomial_float32", "float32", "polynomial in √(-log p)", normal_error=POLYNOMIAL_NORMAL),
    Method("normal", "quadratic_float64", "float64", "1024 quadratics, or the same DN", normal_error=QUADRATIC_NORMAL),
    Method("normal", "numpy_float64", "numpy", "1024 quadratics, with NumPy", normal_error=QUADRATIC_NORMAL),
    Method("shot", "inversion", "float64", "Poisson counts by inversion of the CDF, correct to 2^-32"),
    Method("shot", "numpy_inversion", "numpy", "Poisson counts by inversion of the CDF, with NumPy"),
    Method("effects", "fused_float64", "float64", "effects in order, row by row"),
    Method("effects", "numpy_float64", "numpy", "effects in order, NumPy"),
    Method("quantise", "fused_float32", "float32", "rounded half to even, clipped, float32", **_CLEAN32),
    Method("quantise", "fused_float64", "float64", "rounded half to even, clipped"),
    Method("quantise", "numpy_float64", "numpy", "rounded half to even, clipped, with NumPy"),
)
"""Every method, by stage, cheapest first."""

STAGES = tuple(dict.fromkeys(method.stage for method in METHODS))

COUNT_STAGES = frozenset({"shot", "effects"})
"""Stages that exist only for noise with Poisson counts."""

INTEGER_STAGES = frozenset({"quantise"})
"""Stages that exist only for integer frames."""

MAX_ERROR_GAIN, MAX_HIGHLIGHT_ERROR_GAIN = 8.0, 64.0
"""Largest factors by which the rounding error of a table entry may grow in a clean value for the errors of float32 to
hold. The cameras and gains of ``conf/`` reach 3, and 20 in highlights at the default threshold."""


def is_steep(camera: CameraPlan, exposure: float) -> bool:
    """True if colours and gains at an exposure amplify rounding errors too much for float32.

    The light of a channel is i · (gain + headroom · m²) with m = (i - threshold) / (1 - threshold). Here i is the sum
    of table entries times one row of the matrix. The limits are `MAX_ERROR_GAIN` and `MAX_HIGHLIGHT_ERROR_GAIN`.
    """
    rows = [sum(abs(entry) for entry in camera.rgb2cam[start : start + 3]) * exposure for start in (0, 3, 6)]
    highlights = 0.0 if camera.highlight == "none" else 1 + 2 / (1 - camera.highlight_threshold)
    return any(
        row * gain > MAX_ERROR_GAIN or row * (gain + max(1 - gain, 0.0) * highlights) > MAX_HIGHLIGHT_ERROR_GAIN
        for row, gain in zip(rows, camera.inverse_gains, strict=True)
    )


def choose_methods(
    budget: AccuracyConfig, counts_electrons: bool, normalised: bool = False, steep: bool = False
) -> tuple[str, ...]:
    """Choose a method for each stage: the cheapest implementation whose errors are within the budget.

    Parameters
    ----------
    budget : AccuracyConfig
        Limits on the errors.
    counts_electrons : bool
        Whether the noise has Poisson counts, which have no float32 implementation.
    normalised : bool
        Whether frames are normalised floats. They are not rounded and are exact under every budget.
    steep : bool
        Whether float32 is excluded: by `is_steep`, or because the unrounded clean frame is part of the dataset.

    Returns
    -------
    tuple of str
        ``stage:name`` of each method, in the order of `STAGES`.

    Raises
    ------
    ConfigError
        If no implementation is within the budget; the message has the smallest error possible.
    """
    stages = [stage for stage in STAGES if counts_electrons or stage not in COUNT_STAGES]
    if normalised:
        stages = [stage for stage in stages if stage not in INTEGER_STAGES]
    for implementation in IMPLEMENTATIONS[1:] if steep or normalised else IMPLEMENTATIONS:
        chosen = [_first(stage, implementation, budget) for stage in stages]
        if None not in chosen:
            return tuple(method.spelled for method in chosen if method is not None)
    best = min(method.normal_error for method in methods_of_stage("normal"))  # the others have an exact method
    problem = f"no method is that accurate; expected at least {best:g}"
    raise refusal("accuracy.normal_error", budget.normal_error, problem)


def methods_of_stage(stage: str) -> tuple[Method, ...]:
    """Return the methods of a stage, cheapest first."""
    return tuple(method for method in METHODS if method.stage == stage)


def _first(stage: str, implementation: str, budget: AccuracyConfig) -> Method | None:
    """Return the cheapest method of a stage and implementation within a budget."""
    candidates = (method for method in methods_of_stage(stage) if method.implementation == implementation)
    return next((method for method in candidates if method.fits(budget)), None)
