"""Hot pixels: few pixels with a far larger dark current, a fixed pattern of the camera body."""

from __future__ import annotations

import functools
import math
from decimal import Decimal, localcontext

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, rare_pixels
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import BrightPixels


class HotPixels(Effect):
    """Excess of hot pixels, whose means are exponentially distributed in 1024 equally likely steps."""

    name = "hot_pixels"
    stream = declare_stream("hot_pixels", 5)
    meaning = "few pixels with a far larger dark current; fixed pattern"
    numbers = ("hot_pixel_share", "hot_pixel_e")
    heat = is_fixed = is_before_well = is_in_dark_frames = has_outliers = True

    def contribution(self, frame: FrameFacts, level_dn: float, masking: float) -> Contribution:
        """Predict Poisson counts with exponentially distributed mean m, whose mean square is m + 2m²."""
        physics = frame.physics
        mean_dn = physics.dn_per_e * physics.hot_pixel_e
        mean_square = (physics.dn_per_e + 2 * mean_dn) * mean_dn
        return rare_pixels(frame, physics.hot_pixel_share, mean_dn, mean_square, masking)

    def outliers(self, frame: FrameFacts, level_dn: float, masking: float) -> float:
        """Predict the fraction of pixels that are hot and exceed one standard deviation."""
        physics = frame.physics
        least = math.floor(math.sqrt(masking) / physics.dn_per_e) + 1
        return _share_of_counts(physics.hot_pixel_share, physics.hot_pixel_e, least)

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the bright defects."""
        physics = plan.numbers
        return {"bright": BrightPixels(physics.body_key, self.stream, physics.hot_pixel_share, physics.hot_pixel_e)}


@functools.lru_cache(maxsize=256)
def _share_of_counts(share: float, mean_e: float, least: int) -> float:
    """Return the fraction of pixels that are hot and have at least so many electrons.

    Counts with exponentially distributed mean m are geometrically distributed: P(N >= k) = (m / (1 + m))**k.
    """
    with localcontext(prec=20):
        mean = Decimal(mean_e)
        if not mean:
            return 0.0
        return float(Decimal(share) * (least * (mean / (1 + mean)).ln()).exp())
