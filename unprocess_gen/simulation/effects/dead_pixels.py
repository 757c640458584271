"""Dead pixels: few pixels that do not respond to light, a fixed pattern of the camera body."""

from __future__ import annotations

from typing import TYPE_CHECKING

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, rare_pixels
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import DeadSlot

if TYPE_CHECKING:
    from unprocess_gen.simulation.plan import Physics


class DeadPixels(Effect):
    """Pixels that read the black level, or a lower value.

    A pixel without light and without noise reads the black level, which the readout adds.
    """

    name = "dead_pixels"
    stream = declare_stream("dead_pixels", 9)
    meaning = "few pixels that record no light; fixed pattern"
    numbers = ("dead_pixel_share", "dead_pixel_level")
    is_fixed = has_outliers = True

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict pixels that lose their signal."""
        depth_dn = frame.black_level_dn + level_dn - dead_pixel_dn(frame.physics, frame.black_level_dn)
        return rare_pixels(frame, frame.physics.dead_pixel_share, depth_dn, depth_dn * depth_dn, masking)

    def outliers(self, frame: FrameFacts, level_dn: float, masking: float) -> float:
        """Predict all dead pixels if their value is farther from the signal than one standard deviation."""
        depth_dn = frame.black_level_dn + level_dn - dead_pixel_dn(frame.physics, frame.black_level_dn)
        return frame.physics.dead_pixel_share if depth_dn * depth_dn > masking else 0.0

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the dead pixels."""
        physics = plan.numbers
        dead_dn = dead_pixel_dn(physics, plan.sensor.black_level_dn)
        return {"dead": DeadSlot(physics.body_key, self.stream, physics.dead_pixel_share, dead_dn)}


def dead_pixel_dn(physics: Physics, black_dn: float) -> float:
    """Return the value of dead pixels for a black level, DN."""
    return float(physics.dead_pixel_level * black_dn)
