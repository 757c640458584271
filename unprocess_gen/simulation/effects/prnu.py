"""Photo response non-uniformity (PRNU, EMVA 1288): unequal response of pixels, a fixed pattern of the camera body."""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Crop, Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import MEAN_ABS_NORMAL, Contribution, FrameFacts, independent
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.noise import normals
from unprocess_gen.simulation.slots import NormalPattern


class Prnu(Effect):
    """Relative gain of each pixel with mean 1; if the clean frame contains the fixed patterns, on its light instead."""

    name = "prnu"
    stream = declare_stream("prnu", 2)
    meaning = "unequal response of pixels; fixed pattern"
    numbers = ("prnu_std",)
    is_fixed = is_before_well = True

    def response(self, crop: Crop) -> Float:
        """Return the relative gain of each pixel, [H, W]; not negative.

        It is rounded to float32, the dtype in which kernels store the pattern for many frames.
        """
        n = normals(crop.body_words(self.stream))
        return np.maximum(1 + crop.physics.prnu_std * n, 0).astype(np.float32).astype(np.float64)

    def light_factor(self, crop: Crop) -> Float | None:
        """Return the response if the clean frame contains the fixed patterns."""
        return self.response(crop) if crop.physics.fixed_pattern_in_clean else None

    def electrons(self, electrons: Float, crop: Crop) -> Float:
        """Multiply the electrons of light by the response."""
        return electrons if crop.physics.fixed_pattern_in_clean else electrons * self.response(crop)

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
