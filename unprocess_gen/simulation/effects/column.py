"""Column offsets of the columns' amplifiers: a fixed pattern of the camera body."""

from __future__ import annotations

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, fixed_in_clip, offsets_of_columns
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import ColumnOffsets, UnitWords


class ColumnNoise(Effect):
    """Offset of each column."""

    name = "column"
    stream = declare_stream("column", 8)
    meaning = "an offset of each column; fixed pattern"
    numbers = ("column_std_dn",)
    is_fixed = is_in_dark_frames = True

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict independent offsets of columns, the same in all frames."""
        return fixed_in_clip(frame, offsets_of_columns(frame, frame.physics.column_std_dn))

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the offsets of columns of the body."""
        physics = plan.numbers
        return {"fixed_columns": ColumnOffsets(UnitWords(physics.body_key, self.stream), physics.column_std_dn)}
