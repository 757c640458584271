"""Hot pixels: few pixels with a far larger dark current, a fixed pattern of the camera body."""

from __future__ import annotations

import functools
import math
from decimal import Decimal, localcontext

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Crop, Effect, SlotValues
from unprocess_gen.simulation.effects.prediction import Contribution, FrameFacts, rare_pixels
from unprocess_gen.simulation.lookup_tables import exponential_levels
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.noise import is_among
from unprocess_gen.simulation.reference.poisson import poisson
from unprocess_gen.simulation.slots import BrightPixels


class HotPixels(Effect):
    """Excess of hot pixels, whose means are exponentially distributed in 1024 equally likely steps."""

    name = "hot_pixels"
    stream = declare_stream("hot_pixels", 5)
    meaning = "few pixels with a far larger dark current; fixed pattern"
    numbers = ("hot_pixel_share", "hot_pixel_e")
    heat = is_fixed = is_before_well = is_in_dark_frames = has_outliers = True

    def electrons(self, electrons: Float, crop: Crop) -> Float:
        """Add a Poisson count of its mean to each hot pixel."""
        return electrons + poisson(crop.frame_words(self.stream), self.mean_electrons(crop))

    def mean_electrons(self, crop: Crop) -> Float:
        """Return the mean excess of each pixel, [H, W] electrons; 0 except for hot pixels."""
        physics = crop.physics
        hot = is_among(crop.body_words(self.stream), physics.hot_pixel_share)
        step = crop.body_words(self.stream, draw=1) >> np.uint32(22)
        return np.where(hot, physics.hot_pixel_e * exponential_levels()[step], 0.0)

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
