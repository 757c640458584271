"""Effects of the sensor: a module for each, with everything that the program knows of it.

To add an effect, write its module, name its class in `EFFECTS`, and declare its numbers in `plan.Physics`.
"""

from __future__ import annotations

import math

from unprocess_gen.core.sequences import add_in_order
from unprocess_gen.simulation.effects.black_error import BlackError
from unprocess_gen.simulation.effects.column import ColumnNoise
from unprocess_gen.simulation.effects.column_temporal import ColumnTemporal
from unprocess_gen.simulation.effects.dark_current import DarkCurrent
from unprocess_gen.simulation.effects.dark_frame import DarkFrameNoise
from unprocess_gen.simulation.effects.dead_pixels import DeadPixels
from unprocess_gen.simulation.effects.dsnu import Dsnu
from unprocess_gen.simulation.effects.effect import Effect
from unprocess_gen.simulation.effects.full_well import FullWell
from unprocess_gen.simulation.effects.gain_by_colour import GainByColour
from unprocess_gen.simulation.effects.heteroscedastic import Heteroscedastic
from unprocess_gen.simulation.effects.hot_pixels import HotPixels
from unprocess_gen.simulation.effects.lens_shading import LensShading
from unprocess_gen.simulation.effects.prediction import FrameFacts
from unprocess_gen.simulation.effects.prnu import Prnu
from unprocess_gen.simulation.effects.quantise import Quantise
from unprocess_gen.simulation.effects.read import ReadNoise
from unprocess_gen.simulation.effects.row import RowNoise
from unprocess_gen.simulation.effects.shot import Shot
from unprocess_gen.simulation.facts import Facts
from unprocess_gen.simulation.numbers import Number
from unprocess_gen.simulation.plan import Plan

EFFECTS: tuple[Effect, ...] = (
    *(Heteroscedastic(), LensShading(), Prnu(), Shot(), DarkCurrent(), HotPixels(), FullWell()),  # in electrons
    *(GainByColour(), ReadNoise(), RowNoise(), ColumnNoise(), ColumnTemporal()),  # in DN
    *(BlackError(), Dsnu(), DeadPixels(), DarkFrameNoise(), Quantise()),
)
"""All effects, in the order in which light meets them."""

BY_NAME = {effect.name: effect for effect in EFFECTS}

PHYSICAL_EFFECTS = tuple(effect.name for effect in EFFECTS if effect.name not in ("heteroscedastic", "dark_frame"))
"""Effects that the planner decides about for physical profiles; a dark frame takes the place of ``read``."""

REPLACED = tuple(effect.name for effect in EFFECTS if effect.is_in_dark_frames)
"""Effects whose noise a dark frame contains."""


def profile_keys() -> dict[str, tuple[Effect, Number]]:
    """Return the keys of physical profiles.

    Returns
    -------
    dict of str to (Effect, Number)
        In the order of ``config.yaml``.
    """
    return {
        number.key or name: (effect, number)
        for effect in EFFECTS
        for name, number in (*effect.declared.items(), *effect.keys.items())
    }


def dark_variance_dn2(plan: Plan) -> float:
    """Return the variance of the noise of a site at black, by all simulated effects except outliers and rounding.

    Parameters
    ----------
    plan : Plan
        Parameters of a pair.

    Returns
    -------
    float
        DN²; b of a profile with two numbers. Hot and dead pixels are left out: few sites would decide the variance of
        all. So are fixed patterns that the clean frame contains.
    """
    noise, physics = plan.noise, plan.physics
    if physics is None:
        return noise.b_dn2 if "heteroscedastic" in noise.effects else 0.0
    frame = FrameFacts(physics, Facts(width=1, height=1, codes=1, dark_code=0, bright_code=0), 0.0)
    in_the_dark = {"read", *(name for name, effect in BY_NAME.items() if effect.is_in_dark_frames)}
    variances = (
        BY_NAME[name].contribution(frame, 0.0, math.inf).variances[0]
        for name in ("read" if effect == "dark_frame" else effect for effect in noise.effects)
        if name in in_the_dark and not BY_NAME[name].has_outliers and not (BY_NAME[name].is_fixed and plan.averaged)
    )
    return add_in_order(variances)
