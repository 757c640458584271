"""Quantisation: rounding and clipping of the converter, on for integer frames."""

from __future__ import annotations

from unprocess_gen.simulation.effects.effect import Effect
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent

VARIANCE_DN2 = 1 / 12
"""Variance of rounding to integers, DN²."""


class Quantise(Effect):
    """Rounding and clipping; `reference.sensor.quantise` computes it."""

    name = "quantise"
    meaning = "rounding and clipping; on for uint16, off for float32"

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict the variance of rounding."""
        return independent(frame, VARIANCE_DN2)
