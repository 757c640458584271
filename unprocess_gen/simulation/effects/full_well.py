"""Full well: the saturation capacity of a pixel, at which the clean and the noisy frame are clipped (EMVA 1288)."""

from __future__ import annotations

import math

from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent
from unprocess_gen.simulation.plan import Plan

FARTHEST_NORMAL, FARTHEST_HOT = 6.4, 7.7
"""Largest normal deviate in standard deviations, and largest hot-pixel current in means, of a 32-bit uniform."""


class FullWell(Effect):
    """Limit of the electrons of a pixel."""

    name = "full_well"
    meaning = "saturation capacity, at which the clean and the noisy frame are clipped"
    numbers = ("full_well_e",)

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict the most that any pixel can lose; nothing if the converter ends below the full well."""
        physics = frame.physics
        lowest_dn = physics.full_well_e * physics.dn_per_e - FARTHEST_NORMAL * physics.read_std_dn
        if physics.full_well_e == 0 or lowest_dn >= frame.converter_dn:
            return independent(frame, 0.0)
        signal_e = level_dn / physics.dn_per_e * (1 + FARTHEST_NORMAL * physics.prnu_std)
        reach_e = _reach(signal_e) + _reach(physics.dark_e) + _reach(FARTHEST_HOT * physics.hot_pixel_e)
        return independent(frame, 0.0, max(reach_e - physics.full_well_e, 0.0) * physics.dn_per_e)

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the limit of the well."""
        return {"full_well_e": plan.numbers.full_well_e}


def _reach(mean_e: float) -> float:
    """Return an upper limit of the Poisson counts of 2**32 uniforms, electrons."""
    return mean_e + 7 * math.sqrt(mean_e) + 12 if mean_e else 0.0
