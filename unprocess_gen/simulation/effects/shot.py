"""Shot noise: Poisson counts of the electrons of light (EMVA 1288), times the system gain K."""

from __future__ import annotations

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import FrameFacts
from unprocess_gen.simulation.plan import Plan

STREAM = declare_stream("shot", 3)


class Shot(Effect):
    """Poisson counts of the electrons of light."""

    name = "shot"
    meaning = "Poisson counts of electrons"
    numbers = ("dn_per_e",)
    is_before_well = masks = True

    def variance(self, frame: FrameFacts, level_dn: float) -> float:
        """Return K times the signal, DN²."""
        return frame.physics.dn_per_e * level_dn

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the counts of light."""
        return {"light_stream": STREAM}
