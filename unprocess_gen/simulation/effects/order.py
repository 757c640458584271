"""Add the effects of a plan to the clean frame, in the order in which light meets them (NumPy, float64).

A physical profile uses electrons up to the system gain K and DN after it. An effect that a plan omits does not change
the values of any other effect, because each effect has its own random stream. Values do not depend on the order or the
tiles: each is computed from one random word by inverting a distribution function. Fixed patterns are keyed by the
camera body and are constant over frames.
"""

from __future__ import annotations

import functools
from operator import mul

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.simulation.effects import EFFECTS
from unprocess_gen.simulation.effects.effect import Crop, Effect, Shape
from unprocess_gen.simulation.effects.heteroscedastic import heteroscedastic
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.plan import Plan


def noisy(clean_dn: Float, plan: Plan, origin: Shape = (0, 0), dark_pixels: DarkPixels | None = None) -> Float:
    """Add the plan's effects to the unrounded clean frame, [H, W] DN; the result is not clipped.

    ``origin`` is the row and column of ``clean_dn[0, 0]`` in the full frame; ``dark_pixels`` has the plan's dark frame.
    """
    if plan.physics is None:
        return heteroscedastic(clean_dn, plan, origin) if "heteroscedastic" in plan.noise.effects else clean_dn
    crop = crop_of(plan, clean_dn.shape, origin, dark_pixels)
    effects, black_dn, gain = effects_of(plan), plan.sensor.black_level_dn, crop.physics.dn_per_e * crop.relative_gain
    electrons = (clean_dn - black_dn) / gain
    for effect in effects:
        electrons = effect.electrons(electrons, crop)
    noisy_dn = electrons * gain + black_dn
    for effect in effects:
        if (noise_dn := effect.noise_dn(crop)) is not None:
            noisy_dn = noisy_dn + noise_dn
    noisy_dn = noisy_dn + offsets(crop, effects)
    for effect in effects:
        if (offset_dn := effect.site_offset_dn(crop)) is not None:
            noisy_dn = noisy_dn + offset_dn
    for effect in effects:
        noisy_dn = effect.output_dn(noisy_dn, crop)
    return noisy_dn


def effects_of(plan: Plan) -> list[Effect]:
    """Return the effects that a plan simulates, in order."""
    return [effect for effect in EFFECTS if effect.name in plan.noise.effects]


def crop_of(plan: Plan, shape: tuple[int, ...], origin: Shape = (0, 0), dark_pixels: DarkPixels | None = None) -> Crop:
    """Return a crop of a frame with a physical profile, with the gains of its sites; arguments as for `noisy`."""
    physics = plan.numbers
    crop = Crop(plan, physics, (shape[0], shape[1]), origin, dark_pixels)
    for effect in effects_of(plan):
        if (gains := effect.plane_gains(plan)) is not None:
            return Crop(plan, physics, crop.shape, origin, dark_pixels, crop.by_site(gains))
    return crop


def offsets(crop: Crop, effects: list[Effect], fixed_only: bool = False) -> Float:
    """Return the sum of the offsets of rows, columns and planes, [H, W] DN; bytes depend on the order of the sums.

    ``fixed_only`` omits offsets that are new in every frame.
    """
    height, width = crop.shape
    rows, columns, planes = np.zeros((height, 1)), np.zeros((1, width)), np.zeros((1, 1))
    for effect in effects:
        if effect.is_fixed or not fixed_only:
            rows = rows + effect.row_offset_dn(crop)
            columns = columns + effect.column_offset_dn(crop)
            planes = planes + effect.plane_offset_dn(crop)
    return np.asarray((rows + columns) + planes)


def light_factor(plan: Plan, shape: tuple[int, ...], origin: Shape = (0, 0)) -> Float | None:
    """Return the gain of each site in the clean frame: lens shading, and PRNU if the frame has the fixed patterns.

    Values of float32, [H, W]; None if nothing changes the light.
    """
    if plan.physics is None:
        return None
    crop = crop_of(plan, shape, origin)
    factors = [factor for effect in effects_of(plan) if (factor := effect.light_factor(crop)) is not None]
    return functools.reduce(mul, factors).astype(np.float32).astype(np.float64) if factors else None


def average(clean_dn: Float, plan: Plan, origin: Shape = (0, 0)) -> Float:
    """Add fixed patterns except PRNU, and a kept dark offset, to the unrounded clean frame, [H, W] DN.

    The sum of light, dark signal and hot pixels is limited by the full well, as in each frame of a real average. The
    frame has its `light_factor` already; the result is not clipped.
    """
    crop, effects = crop_of(plan, clean_dn.shape, origin), effects_of(plan)
    gain = crop.physics.dn_per_e * crop.relative_gain
    for effect in reversed(effects):  # recorded bytes depend on the order of these sums
        if (mean_e := effect.mean_electrons(crop)) is not None:
            clean_dn = clean_dn + mean_e * gain
    if "full_well" in plan.noise.effects:
        clean_dn = np.minimum(clean_dn, crop.physics.full_well_e * crop.physics.dn_per_e + plan.sensor.black_level_dn)
    clean_dn = clean_dn + offsets(crop, effects, fixed_only=True)
    fixed = [effect for effect in effects if effect.is_fixed]
    for effect in fixed:
        if (offset_dn := effect.site_offset_dn(crop)) is not None:
            clean_dn = clean_dn + offset_dn
    for effect in fixed:
        clean_dn = effect.output_dn(clean_dn, crop)
    return clean_dn
