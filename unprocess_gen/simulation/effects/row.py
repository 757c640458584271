"""Row noise (banding): an offset of each row, new in every frame."""

from __future__ import annotations

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues, slot_words
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, new_in_every_frame
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import RowOffsets


class RowNoise(Effect):
    """Offset of each row.

    With a correlation r, z(y) = r·z(y - 1) + √(1 - r²)·n(y) for normal deviates n, an autoregressive process of order 1
    (Box and Jenkins 1970) with the standard deviation of n. It begins at row 0 of the full frame, so that a crop has
    the offsets of its rows.
    """

    name = "row"
    stream = declare_stream("row", 7)
    meaning = "an offset of each row, new in every frame"
    numbers = ("row_std_dn", "row_correlation")
    is_in_dark_frames = True

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict row offsets; correlation r divides the number of independent rows by (1 + r) / (1 - r)."""
        physics, height = frame.physics, frame.facts.height
        variance = physics.row_std_dn * physics.row_std_dn
        rows, rows_of_plane = float(height), float(max(height // 2, 1))
        if physics.row_correlation > 0:
            together = (1 + physics.row_correlation) / (1 - physics.row_correlation)
            rows, rows_of_plane = max(rows / together, 1.0), max(rows_of_plane / together, 1.0)
        return new_in_every_frame(frame, (variance, variance, variance / rows, variance / rows_of_plane))

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the offsets of rows."""
        physics = plan.numbers
        words = slot_words(plan, self.stream) if physics.row_correlation else None
        return {"rows": RowOffsets(self.stream, physics.row_std_dn, physics.row_correlation, words)}
