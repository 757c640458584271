"""Read noise of the amplifier and the converter: Gaussian, or Tukey's lambda distribution (ELD, Wei et al. 2020)."""

from __future__ import annotations

from unprocess_gen.core.types import Float, Plan
from unprocess_gen.simulation.effects.effect import Crop, Effect, SlotValues
from unprocess_gen.simulation.effects.numbers import SHAPE, EffectNumbers, number, number_in_dn
from unprocess_gen.simulation.effects.prediction import FrameFacts
from unprocess_gen.simulation.lookup_tables import quantile_table
from unprocess_gen.simulation.reference.noise import by_inverse_cdf
from unprocess_gen.simulation.slots import SiteNoise


class ReadNumbers(EffectNumbers):
    """Distribution of the read noise, shape of Tukey's lambda, and standard deviation, DN."""

    read_law: str = number(
        "gaussian",
        "distribution of the read noise: gaussian, or tukey_lambda for Tukey's lambda with a shape from -0.45",
        words=("gaussian", "tukey_lambda"),
        key_default="gaussian",
    )
    read_shape: float = number(
        0.0,
        "shape of Tukey's lambda distribution",
        kind=SHAPE,
        by_iso=True,
        key_default=0.0,
        lowest=-0.5,
        highest=10.0,
    )
    read_std_dn: float = number_in_dn(
        "standard deviation of the read noise",
        by_iso=True,
        required=True,
        counter=1,
    )


class ReadNoise(Effect):
    """Independent noise of each site, behind the gain."""

    name = "read"
    meaning = "noise of the amplifier and the converter"
    numbers = ReadNumbers
    masks = True

    def noise_dn(self, crop: Crop) -> Float:
        """Draw the noise by the inverse distribution function."""
        physics = crop.physics
        table = quantile_table(physics.read_law, physics.read_shape)
        return physics.read_std_dn * by_inverse_cdf(crop.frame_words("read"), table)

    def variance(self, frame: FrameFacts, level_dn: float) -> float:
        """Return the square of the standard deviation, DN²."""
        return frame.physics.read_std_dn * frame.physics.read_std_dn

    def slots(self, plan: Plan) -> SlotValues:
        """Fill the noise of a site."""
        physics = plan.physics
        return {"noise": SiteNoise("read", physics.read_std_dn, physics.read_law, physics.read_shape)}
