"""Dead pixels: few pixels that read 0, a fixed pattern of the camera body."""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.types import Float, Plan
from unprocess_gen.simulation.effects.effect import Effect, Part, SlotValues
from unprocess_gen.simulation.effects.expectation import Defects, EffectNoise, Site
from unprocess_gen.simulation.effects.numbers import Numbers, number
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, rare_pixels
from unprocess_gen.simulation.reference.noise import is_among
from unprocess_gen.simulation.reference.sensor import noisy_limits
from unprocess_gen.simulation.slots import DeadPixels as DeadSlot


class DeadPixelNumbers(Numbers):
    """Fraction of pixels that read 0."""

    dead_pixel_share: float = number(0.0, "fraction of dead pixels, which read 0", high=1.0, highest=1.0)


class DeadPixels(Effect):
    """Pixels that read 0 DN, which is below black."""

    name = "dead_pixels"
    meaning = "few pixels that read 0; fixed pattern"
    cost_ns = 1.1
    numbers = DeadPixelNumbers
    is_fixed = has_outliers = True

    def output_dn(self, noisy_dn: Float, part: Part) -> Float:
        """Set dead pixels to 0."""
        return np.where(is_among(part.body_words("dead_pixels"), part.physics.dead_pixel_share), 0.0, noisy_dn)

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict pixels that lose their signal."""
        depth_dn = frame.black_level_dn + level_dn
        return rare_pixels(frame, frame.physics.dead_pixel_share, depth_dn, depth_dn * depth_dn, masking)

    def outliers(self, frame: FrameFacts, level_dn: float, masking: float) -> float:
        """Predict all dead pixels if 0 is farther from the signal than one standard deviation."""
        depth_dn = frame.black_level_dn + level_dn
        return frame.physics.dead_pixel_share if depth_dn * depth_dn > masking else 0.0

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the pixels that read 0."""
        physics = plan.physics
        return {"dead": DeadSlot(physics.body_key, "dead_pixels", physics.dead_pixel_share)}

    def expected(self, site: Site) -> EffectNoise:
        """Sites of the body that read 0."""
        plan = site.plan
        if plan.noise.averaged:
            return EffectNoise()
        y, x = site.defects("dead_pixels", site.physics.dead_pixel_share)
        black_dn = plan.sensor.black_level_dn
        value_dn = max(noisy_limits(plan.sensor.bits, black_dn, plan.noise.sensor_clip)[0], 0.0) - black_dn
        return EffectNoise(defects=Defects(y, x, np.full(len(y), value_dn), replaces=True))
