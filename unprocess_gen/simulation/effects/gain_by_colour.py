"""Gains by colour: a system gain of its own for red, green and blue."""

from __future__ import annotations

import math

from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent
from unprocess_gen.simulation.plan import Plan


class GainByColour(Effect):
    """Factor on the system gain, by the colour of a site."""

    name = "gain_by_colour"
    meaning = "a system gain of its own for each colour"
    numbers = ("gain_by_colour",)

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict a change of the shot noise: its standard deviation differs by a factor √gain."""
        shot_dn = math.sqrt(frame.physics.dn_per_e * level_dn)
        most_dn = shot_dn * max(abs(math.sqrt(gain) - 1) for gain in frame.physics.gain_by_colour)
        return independent(frame, most_dn * most_dn)

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the gains by plane; a sensor without filters has that of green."""
        gains = dict(zip("RGB", plan.numbers.gain_by_colour, strict=True))
        return {"plane_gains": tuple(gains.get(colour, gains["G"]) for colour in plan.sensor.pattern)}
