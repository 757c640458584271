"""Dark-signal non-uniformity (DSNU, EMVA 1288): unequal offsets of pixels, a fixed pattern of the camera body."""

from __future__ import annotations

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import NormalPattern


class Dsnu(Effect):
    """Normal offset of each pixel with mean 0, added behind the gain."""

    name = "dsnu"
    stream = declare_stream("dsnu", 16)
    meaning = "unequal offsets of pixels; fixed pattern"
    numbers = ("dsnu_std_e",)
    is_fixed = is_in_dark_frames = True

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict independent offsets of pixels, the same in all frames."""
        std_dn = frame.physics.dsnu_std_e * frame.physics.dn_per_e
        return independent(frame, 0.0, fixed_variance=std_dn * std_dn)

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the offsets by site of the body."""
        physics = plan.numbers
        return {"sites_dn": NormalPattern(physics.body_key, self.stream, physics.dsnu_std_e * physics.dn_per_e)}
