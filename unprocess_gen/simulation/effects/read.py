"""Read noise of the amplifier and the converter: Gaussian, or Tukey's lambda distribution (ELD, Wei et al. 2020)."""

from __future__ import annotations

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import FrameFacts
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import SiteNoise


class ReadNoise(Effect):
    """Independent noise of each site, behind the gain."""

    name = "read"
    stream = declare_stream("read", 6)
    meaning = "noise of the amplifier and the converter"
    numbers = ("read_law", "read_shape", "read_std_dn")
    masks = True

    def variance(self, frame: FrameFacts, level_dn: float) -> float:
        """Return the square of the standard deviation, DN²."""
        return frame.physics.read_std_dn * frame.physics.read_std_dn

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the noise of a site."""
        physics = plan.numbers
        return {"noise": SiteNoise(self.stream, physics.read_std_dn, physics.read_law, physics.read_shape)}
