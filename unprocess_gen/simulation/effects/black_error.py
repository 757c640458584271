"""Black-level error: difference between black and the black level, by site of the 2x2 CFA tile; a fixed pattern."""

from __future__ import annotations

from unprocess_gen.core.types import Float, Plan
from unprocess_gen.simulation.effects.effect import Crop, Effect, SlotValues
from unprocess_gen.simulation.effects.numbers import LARGEST, SITES, EffectNumbers, number
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, independent


class BlackErrorNumbers(EffectNumbers):
    """Black-level errors of the sites (0, 0), (0, 1), (1, 0), (1, 1) of the 2x2 tile, DN."""

    black_error_dn: tuple[float, float, float, float] = number(
        (0.0, 0.0, 0.0, 0.0),
        "error of the black level",
        unit="DN",
        kind=SITES,
        by_iso=True,
        count=4,
        columns={
            f"black_error_dn_{i}{j}": f"black-level error of the 2x2 CFA pattern, row {i}, column {j}"
            for i in range(2)
            for j in range(2)
        },
        lowest=-LARGEST,
    )


class BlackError(Effect):
    """Offset of each site of the tile."""

    name = "black_error"
    meaning = "difference between black and the black level, by CFA site; fixed pattern"
    numbers = BlackErrorNumbers
    is_fixed = is_in_dark_frames = True

    def plane_offset_dn(self, crop: Crop) -> Float:
        """Return the error of each site, [H, W] DN."""
        return crop.by_site(crop.physics.black_error_dn)

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict the largest error as an offset of all pixels."""
        return independent(frame, 0.0, max(abs(error) for error in frame.physics.black_error_dn))

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the offsets by plane."""
        return {"planes_dn": plan.physics.black_error_dn}
