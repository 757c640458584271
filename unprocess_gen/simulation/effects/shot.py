"""Shot noise: Poisson counts of the electrons of light (EMVA 1288), times the system gain K."""

from __future__ import annotations

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Crop, Effect, Shape, SlotValues, frame_words
from unprocess_gen.simulation.effects.prediction import FrameFacts
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.poisson import poisson

STREAM = declare_stream("shot", 3)


def counts(plan: Plan, electrons: Float, origin: Shape = (0, 0)) -> Float:
    """Draw the electrons of light, [H, W]: Poisson counts of their means."""
    return poisson(frame_words(plan, STREAM, electrons.shape, origin), electrons)


class Shot(Effect):
    """Poisson counts of the electrons of light."""

    name = "shot"
    meaning = "Poisson counts of electrons"
    numbers = ("dn_per_e",)
    is_before_well = masks = True

    def electrons(self, electrons: Float, crop: Crop) -> Float:
        """Draw a count for each pixel."""
        return counts(crop.plan, electrons, crop.origin)

    def variance(self, frame: FrameFacts, level_dn: float) -> float:
        """Return K times the signal, DN²."""
        return frame.physics.dn_per_e * level_dn

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the counts of light."""
        return {"light_stream": STREAM}
