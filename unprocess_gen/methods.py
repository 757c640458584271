"""The methods of each stage, and how far each may be from the reference: data that the tests prove.

The reference is `pair.reference_pair`: float64, exact tables, exact laws. Errors are the worst there are, over every
colour or every word of a random stream, not typical ones.
"""

from __future__ import annotations

from dataclasses import dataclass

STAGES = ("curve", "colour", "mosaic", "normal", "shot", "effects", "quantise")


@dataclass(frozen=True, slots=True)
class Method:
    """One way to do a stage.

    ``error_max`` is its distance from the reference at most, in ``error_unit``: ``DN`` of the clean frame of a 14-bit
    sensor, or ``σ``, standard deviations of the noise. ``changed_share`` is the share of those DN, over all 8-bit
    colours, that may differ at all.
    """

    stage: str
    name: str
    error_max: float
    error_unit: str
    changed_share: float
    meaning: str


METHODS = (
    Method("curve", "float64", 0.0, "DN", 0.0, "exact table, correctly rounded"),
    Method("curve", "float32", 1.0, "DN", 5e-4, "the exact table, rounded to float32 with the matrix"),
    Method("colour", "float64", 0.0, "DN", 0.0, "matrix, gains and highlights in the reference's order"),
    Method("colour", "float32", 1.0, "DN", 5e-4, "the same order in float32; error and share with the curve's"),
    Method("mosaic", "one_site", 0.0, "DN", 0.0, "only the channel that a site keeps is computed"),
    Method("normal", "quadratic", 0.0, "σ", 0.0, "inverse CDF by 1024 quadratics in float64, as the reference"),
    Method("normal", "linear", 3e-5, "σ", 0.0, "inverse CDF by 1024 straight lines in float32, of the same word"),
    Method("quantise", "float64", 0.0, "DN", 0.0, "half to even, clipped, cast"),
    Method("quantise", "float32", 1.0, "DN", 5e-4, "half to even above black, clipped, cast; with the colour's"),
)


def method(stage: str, name: str) -> Method:
    """Return a method by stage and name; KeyError where there is none."""
    for one in METHODS:
        if (one.stage, one.name) == (stage, name):
            return one
    raise KeyError(f"{stage} has no method {name}")
