"""Gains by colour: a system gain of its own for red, green and blue."""

from __future__ import annotations

import math

from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import tile

COLOURS = ("red", "green", "blue")


class GainByColour(Effect):
    """Factor on the system gain, by the colour of a site."""

    name = "gain_by_colour"
    meaning = "a system gain of its own for each colour"
    numbers = ("gain_by_colour",)

    def plane_gains(self, plan: Plan) -> tuple[float, ...]:
        """Return the gain of the colour of each site of the tile; the gain of green for a sensor without filters."""
        return tuple(plan.numbers.gain_by_colour[channel] for row in tile(plan.sensor.pattern) for channel in row)

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict a change of the shot noise: its standard deviation differs by a factor √gain."""
        shot_dn = math.sqrt(frame.physics.dn_per_e * level_dn)
        most_dn = shot_dn * max(abs(math.sqrt(gain) - 1) for gain in frame.physics.gain_by_colour)
        return independent(frame, most_dn * most_dn)

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the gains by plane."""
        return {"plane_gains": self.plane_gains(plan)}
