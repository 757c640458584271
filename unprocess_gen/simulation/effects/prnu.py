"""Photo response non-uniformity (PRNU, EMVA 1288): unequal response of pixels, a fixed pattern of the camera body."""

from __future__ import annotations

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import MEAN_ABS_NORMAL, Contribution, FrameFacts, independent
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import NormalPattern


class Prnu(Effect):
    """Relative gain of each pixel with mean 1, not negative, on the electrons of light.

    If the clean frame contains the fixed patterns, it is on the light of that frame instead.
    """

    name = "prnu"
    stream = declare_stream("prnu", 2)
    meaning = "unequal response of pixels; fixed pattern"
    numbers = ("prnu_std",)
    is_fixed = is_before_well = True

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict a change of the mean of the shot noise.

        Poisson counts of nearby means differ by √(|Δλ| + Δλ²) even for equal uniforms.
        """
        physics = frame.physics
        change_e = physics.prnu_std * level_dn / physics.dn_per_e
        squared = physics.dn_per_e * physics.dn_per_e
        return independent(frame, squared * MEAN_ABS_NORMAL * change_e, fixed_variance=squared * change_e * change_e)

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the factor on the electrons."""
        physics = plan.numbers
        return {"electrons": NormalPattern(physics.body_key, self.stream, physics.prnu_std, mean=1.0, least=0.0)}
