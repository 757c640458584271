"""Black-level error: difference between black and the black level, by site of the 2x2 CFA tile; a fixed pattern."""

from __future__ import annotations

from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent
from unprocess_gen.simulation.plan import Plan


class BlackError(Effect):
    """Offset of each site of the tile."""

    name = "black_error"
    meaning = "difference between black and the black level, by CFA site; fixed pattern"
    numbers = ("black_error_dn",)
    is_fixed = is_in_dark_frames = True

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict the largest error as an offset of all pixels."""
        return independent(frame, 0.0, max(abs(error) for error in frame.physics.black_error_dn))

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the offsets by plane."""
        return {"planes_dn": plan.numbers.black_error_dn}
