"""The error that omitting effects causes, measured with the reference."""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.arrays import Float, Srgb
from unprocess_gen.simulation.effects import order
from unprocess_gen.simulation.effects.heteroscedastic import noise_variance
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.sensor import to_dn
from unprocess_gen.simulation.reference.unprocess import unprocess

SCENES = ("daylight", "indoor", "low_light", "night", "video_night", "long_exposure")


def unrounded(srgb: Srgb, plan: Plan) -> tuple[Float, Float]:
    """Return the clean and the noisy frame in DN, before rounding."""
    light = unprocess(srgb, plan) * plan.scene.exposure
    factor = order.light_factor(plan, light.shape)
    light = light if factor is None else light * factor
    clean_dn = to_dn(light, plan.sensor.black_level_dn, plan.sensor.white_level_dn, plan.brightest)
    return clean_dn, order.noisy(clean_dn, plan)


def omission(srgb: Srgb, everything: Plan, auto: Plan, frames: int = 1) -> dict[str, Float]:
    """Return the squared omission of ``auto`` divided by the masking variance, for each statistic.

    One value per pixel, row, column and colour plane of the mean over the ``frames`` of a still clip. The masking
    variance is that of ``auto`` at the local signal.
    """
    clean_dn = unrounded(srgb, auto)[0]
    clips = ([unrounded(srgb, plan.replace(frame=n))[1] for n in range(frames)] for plan in (everything, auto))
    with_all, with_some = (np.mean(clip, axis=0) for clip in clips)
    omitted = with_all - with_some
    variance = noise_variance(clean_dn, auto) + 1 / 12
    if auto.physics is not None and "dark_current" in auto.noise.effects:
        variance = variance + auto.physics.dn_per_e**2 * auto.physics.dark_e
    variance = variance / frames
    height, width = omitted.shape
    planes = [(omitted[y::2, x::2], variance[y::2, x::2]) for y in range(min(height, 2)) for x in range(min(width, 2))]
    return {
        "pixel": (omitted**2 / variance).ravel(),
        "row mean": omitted.mean(1) ** 2 / (variance.mean(1) / width),
        "column mean": omitted.mean(0) ** 2 / (variance.mean(0) / height),
        "plane mean": np.array([part.mean() ** 2 / (noise.mean() / part.size) for part, noise in planes]),
    }
