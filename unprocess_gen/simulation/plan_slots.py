"""Fill the slots of a frame from the effects of its plan, in the order of their roundings."""

from __future__ import annotations

import math
from typing import Any

from unprocess_gen.core.sequences import Recent
from unprocess_gen.simulation.effects import EFFECTS, heteroscedastic, shot
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.slots import Patterns, SiteNoise, Slots


def slots_of(plan: Plan) -> Slots:
    """Return the slots of a plan; frames that share their patterns can be simulated in one pass.

    They depend neither on the light nor on the camera's colours, so plans that differ in these share them.
    """
    numbers = plan.physics, plan.noise.effects, plan.noise.variance_line
    key = *numbers, plan.sensor, plan.stream_key, plan.place, plan.dark
    return _kept.get(key) or _kept.keep(key, _slots_of(plan))


_kept: Recent[tuple[Any, ...], Slots] = Recent(1024)


def _slots_of(plan: Plan) -> Slots:
    black_dn, physics = float(plan.sensor.black_level_dn), plan.physics
    if physics is None:
        return _two_numbers(plan, black_dn)
    filled, names = dict[str, Any](), dict[str, str]()
    for effect in (effect for effect in EFFECTS if effect.name in plan.noise.effects):
        for slot, value in effect.slots(plan).items():
            assert slot not in filled, f"the effects {names[slot]} and {effect.name} both fill the slot {slot}"
            filled[slot], names[slot] = value, effect.name
    patterns = Patterns(**{name: filled.pop(name) for name in Patterns._fields if name in filled})
    return Slots(black_dn, physics.dn_per_e, patterns, **filled)


def _two_numbers(plan: Plan, black_dn: float) -> Slots:
    """Return counts of light and normal noise that have the variance line of the plan."""
    a_dn, b_dn2 = plan.noise.variance_line
    noise = SiteNoise(heteroscedastic.STREAM, math.sqrt(max(b_dn2, 0.0)))
    return Slots(black_dn, a_dn, light_stream=shot.STREAM, noise=noise)
