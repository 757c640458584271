"""Add noise to the clean frame: two-parameter noise, or the slots of a physical profile, in the order of light.

NumPy, float64. A physical profile uses electrons up to the system gain K and DN after it; `slots` defines what each
slot is, and effects fill them. An effect that a plan omits does not change the values of any other effect, because each
effect has its own random stream. Values do not depend on the order or the tiles: each is computed from one random word
by inverting a distribution function. Fixed patterns are keyed by the camera body and are constant over frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import Words, words
from unprocess_gen.simulation.effects import heteroscedastic
from unprocess_gen.simulation.effects.dark_frame import dark_frame_offsets
from unprocess_gen.simulation.effects.effect import slot_words
from unprocess_gen.simulation.effects.lens_shading import illumination
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.lookup_tables import exponential_levels, quantile_table
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.plan_slots import slots_of
from unprocess_gen.simulation.reference.noise import autoregressive, by_inverse_cdf, is_among, normals
from unprocess_gen.simulation.reference.poisson import poisson
from unprocess_gen.simulation.slots import (
    BrightPixels,
    ColumnOffsets,
    DeadSlot,
    NormalPattern,
    RowOffsets,
    draw_words,
)

Shape = tuple[int, int]


def noisy(clean_dn: Float, plan: Plan, origin: Shape = (0, 0), dark_pixels: DarkPixels | None = None) -> Float:
    """Add the plan's noise to the unrounded clean frame, [H, W] DN; the result is not clipped.

    ``origin`` is the row and column of ``clean_dn[0, 0]`` in the full frame; ``dark_pixels`` has the plan's dark frame.
    """
    shape = clean_dn.shape[0], clean_dn.shape[1]
    if not plan.counts_electrons:
        if plan.noise.variance_line == (0.0, 0.0):
            return clean_dn
        n = normals(frame_words(plan, heteroscedastic.STREAM, shape, origin))
        return np.asarray(clean_dn + np.sqrt(noise_variance(clean_dn, plan)) * n)
    slots = slots_of(plan)
    patterns, relative_gain = slots.patterns, by_site(slots.plane_gains, shape, origin)
    gain = slots.dn_per_e * relative_gain
    electrons = (clean_dn - slots.black_dn) / gain
    if patterns.electrons and not plan.averaged:  # otherwise the light of the clean frame has the factor
        electrons = electrons * normal_pattern(patterns.electrons, shape, origin)
    if slots.light_stream:
        counts = poisson(frame_words(plan, slots.light_stream, shape, origin), electrons)
        electrons = counts + np.minimum(electrons, 0)  # light of a raw source below black is not counted, but kept
    if uniform := slots.uniform:
        count = poisson(frame_words(plan, uniform.stream, shape, origin), np.full(shape, uniform.rate_e))
        electrons = electrons + (count - uniform.removed_e)
    if bright := patterns.bright:
        count = poisson(frame_words(plan, bright.stream, shape, origin), bright_means_e(bright, shape, origin))
        electrons = electrons + count
    noisy_dn = np.minimum(electrons, slots.full_well_e / relative_gain) * gain + slots.black_dn
    if noise := slots.noise:
        table = quantile_table(noise.distribution, noise.shape)
        noisy_dn = noisy_dn + noise.std_dn * by_inverse_cdf(frame_words(plan, noise.stream, shape, origin), table)
    line_dn = columns_dn(slots.fixed_columns, shape, origin) + columns_dn(slots.columns, shape, origin)
    line_dn = rows_dn(plan, slots.rows, shape, origin) + line_dn
    noisy_dn = noisy_dn + (line_dn + by_site(slots.planes_dn, shape, origin))
    if patterns.sites_dn:
        noisy_dn = noisy_dn + normal_pattern(patterns.sites_dn, shape, origin)
    if slots.has_site_offsets:
        noisy_dn = noisy_dn + dark_frame_offsets(plan, dark_pixels, shape, origin)
    return with_dead_pixels(noisy_dn, patterns.dead, origin)


def noise_variance(clean_dn: Float, plan: Plan) -> Float:
    """Return the variance of shot and read noise, max(0, a·u + b) with u = max(0, x - black).

    Parameters
    ----------
    clean_dn : ndarray of float64, [H, W]
        Unrounded clean frame x, DN.
    plan : Plan
        Parameters of the pair.

    Returns
    -------
    ndarray of float64, [H, W]
        Variance, DN².
    """
    a_dn, b_dn2 = plan.noise.variance_line
    return np.asarray(np.maximum(a_dn * np.maximum(clean_dn - plan.sensor.black_level_dn, 0) + b_dn2, 0))


def light_factor(plan: Plan, shape: Shape, origin: Shape = (0, 0)) -> Float | None:
    """Return the gain of each site in the clean frame: lens shading, and PRNU if the frame has the fixed patterns.

    Values of float32, [H, W]; None if nothing changes the light.
    """
    patterns = slots_of(plan).patterns
    factor = None
    if patterns.light:
        factor = illumination(patterns.light.coefficients, patterns.light.frame_size, shape, origin).astype(np.float64)
    if patterns.electrons and plan.averaged:
        response = normal_pattern(patterns.electrons, shape, origin)
        factor = response if factor is None else (factor * response).astype(np.float32).astype(np.float64)
    return factor


def average(clean_dn: Float, plan: Plan, origin: Shape = (0, 0)) -> Float:
    """Add fixed patterns except PRNU, and a kept dark offset, to the unrounded clean frame, [H, W] DN.

    The sum of light, dark signal and hot pixels is limited by the full well, as in each frame of a real average. The
    frame has its `light_factor` already; the result is not clipped.
    """
    slots, shape = slots_of(plan), (clean_dn.shape[0], clean_dn.shape[1])
    patterns, gain = slots.patterns, slots.dn_per_e * by_site(slots.plane_gains, shape, origin)
    if patterns.bright:  # recorded bytes depend on the order of these sums
        clean_dn = clean_dn + bright_means_e(patterns.bright, shape, origin) * gain
    if slots.uniform:
        clean_dn = clean_dn + (slots.uniform.rate_e - slots.uniform.removed_e) * gain
    clean_dn = np.minimum(clean_dn, slots.full_well_e * slots.dn_per_e + slots.black_dn)
    fixed_dn = columns_dn(slots.fixed_columns, shape, origin) + by_site(slots.planes_dn, shape, origin)
    clean_dn = clean_dn + fixed_dn
    if patterns.sites_dn:
        clean_dn = clean_dn + normal_pattern(patterns.sites_dn, shape, origin)
    return with_dead_pixels(clean_dn, patterns.dead, origin)


# --------------------------------------------------------------------------------------------------------------- slots


def frame_words(plan: Plan, stream: int, shape: Shape, origin: Shape) -> Words:
    """Return the random words of a plan's frame, level and draw, [H, W]."""
    return draw_words(slot_words(plan, stream), shape, origin)


def by_site(sites: Sequence[float], shape: Shape, origin: Shape) -> Float:
    """Repeat the values of the sites (0, 0), (0, 1), (1, 0), (1, 1) of the 2x2 tile, [H, W]."""
    y, x = (np.arange(start, start + count) % 2 for start, count in zip(origin, shape, strict=True))
    return np.asarray(np.array(sites).reshape(2, 2)[y[:, None], x[None, :]])


def normal_pattern(slot: NormalPattern, shape: Shape, origin: Shape = (0, 0)) -> Float:
    """Return the value of each pixel, [H, W]; values of float32, in which kernels store it for many frames."""
    n = normals(words(slot.body_key, slot.stream, shape, origin=origin))
    return np.maximum(slot.mean + slot.std * n, slot.least).astype(np.float32).astype(np.float64)


def bright_means_e(slot: BrightPixels, shape: Shape, origin: Shape = (0, 0)) -> Float:
    """Return the mean excess of each pixel, [H, W] electrons; 0 except for bright pixels."""
    is_bright = is_among(words(slot.body_key, slot.stream, shape, origin=origin), slot.share)
    step = words(slot.body_key, slot.stream, shape, origin=origin, draw=1) >> np.uint32(22)
    return np.where(is_bright, slot.mean_e * exponential_levels()[step], 0.0)


def rows_dn(plan: Plan, slot: RowOffsets | None, shape: Shape, origin: Shape) -> Float:
    """Return the offset of each row, [H, 1] DN."""
    (height, _), (top, _) = shape, origin
    if slot is None:
        return np.zeros((height, 1))
    if slot.correlation == 0:
        return np.asarray(slot.std_dn * normals(frame_words(plan, slot.stream, (height, 1), (top, 0))))
    independent = normals(frame_words(plan, slot.stream, (top + height, 1), (0, 0)))[:, 0]
    return (slot.std_dn * autoregressive(independent, slot.correlation)[top:])[:, None]


def columns_dn(slot: ColumnOffsets | None, shape: Shape, origin: Shape) -> Float:
    """Return the offset of each column, [1, W] DN."""
    if slot is None:
        return np.zeros((1, shape[1]))
    return np.asarray(slot.std_dn * normals(draw_words(slot.words, (1, shape[1]), (0, origin[1]))))


def with_dead_pixels(frame_dn: Float, slot: DeadSlot | None, origin: Shape = (0, 0)) -> Float:
    """Set the dead pixels of a frame to their value, [H, W] DN."""
    if slot is None:
        return frame_dn
    shape = frame_dn.shape[0], frame_dn.shape[1]
    is_dead = is_among(words(slot.body_key, slot.stream, shape, origin=origin), slot.share)
    return np.where(is_dead, slot.value_dn, frame_dn)
