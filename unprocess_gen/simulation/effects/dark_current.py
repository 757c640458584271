"""Dark current: Poisson counts of thermal electrons, whose rate doubles every few degrees (EMVA 1288)."""

from __future__ import annotations

from unprocess_gen.core.fields import Numbers
from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent
from unprocess_gen.simulation.numbers import Number
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import UniformCounts

HEAT = {
    "dark_reference_c": Number(
        "temperature at which the dark currents were measured", Numbers(-273, 200), "degrees Celsius", key_default=25.0
    ),
    "dark_doubling_c": Number(
        "rise of the temperature that doubles the dark currents", Numbers(0.1, 100), "degrees Celsius", key_default=7.0
    ),
}
"""Keys of the profile from which the warmth of the sensor follows."""


class DarkCurrent(Effect):
    """Dark signal; the camera subtracts its mean with optical-black pixels, unless ``dark_offset`` is ``"kept"``."""

    name = "dark_current"
    stream = declare_stream("dark_current", 4)
    meaning = "Poisson counts of thermal electrons"
    numbers = ("dark_e",)
    keys = HEAT
    heat = is_before_well = is_in_dark_frames = masks = True

    def variance(self, frame: FrameFacts, level_dn: float) -> float:
        """Return K² times the mean, DN²."""
        return frame.physics.dn_per_e * frame.physics.dn_per_e * frame.physics.dark_e

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict the variance, and the mean if the camera keeps it."""
        physics = frame.physics
        offset_dn = physics.dn_per_e * physics.dark_e if physics.dark_offset == "kept" else 0.0
        return independent(frame, self.variance(frame, level_dn), offset_dn)

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the counts of one rate."""
        physics = plan.numbers
        removed_e = physics.dark_e if physics.dark_offset == "removed" else 0.0
        return {"uniform": UniformCounts(self.stream, physics.dark_e, removed_e)}
