"""Temporal column noise: the part of each column's offset that is new in every frame."""

from __future__ import annotations

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues, slot_words
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, new_in_every_frame, offsets_of_columns
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import ColumnOffsets


class ColumnTemporal(Effect):
    """Offset of each column in one frame."""

    name = "column_temporal"
    stream = declare_stream("column_temporal", 13)
    meaning = "an offset of each column, new in every frame"
    numbers = ("column_temporal_std_dn",)
    is_in_dark_frames = True

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict independent offsets of columns, new in every frame."""
        return new_in_every_frame(frame, offsets_of_columns(frame, frame.physics.column_temporal_std_dn))

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the offsets of columns of the frame."""
        std_dn = plan.numbers.column_temporal_std_dn
        return {"columns": ColumnOffsets(slot_words(plan, self.stream), std_dn)}
