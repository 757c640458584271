"""One photograph and its plan in, the clean and the noisy raw frame out. The page to read first.

`reference_pair` says what a pair is, in the article's words. `make_pair` gives the same DN fifty times faster and is
what datasets are made with; the tests hold the two together, on photographs and on every option.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen import effects, electrons, fused
from unprocess_gen.records import Counts, Float, Pair, Plan, Srgb
from unprocess_gen.sensor import noisy_limits, quantise, to_dn
from unprocess_gen.tables import linear_table
from unprocess_gen.unprocess import dequantise, unprocess


def make_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Pair:
    """Make the clean and the noisy frame of a photograph, as planned.

    Pure: the same pixels and plan give the same pair on any machine, worker, engine and in any order. ``srgb`` is uint8
    or uint16 ``[H, W, 3]``. A cut-out whose top-left pixel is ``origin`` in the full frame gives the same cut-out of
    the full pair, single pixels included. Raises ValueError for other types and shapes.
    """
    _check(srgb)
    srgb = _dequantised(srgb, plan, origin)
    curve = linear_table(plan.tone, plan.gamma, int(np.iinfo(srgb.dtype).max) + 1)
    if plan.readable:
        return _reference_pair(srgb, plan, origin, curve)
    limits_dn = noisy_limits(plan.bits, plan.black_level_dn, plan.sensor_clip)
    maker = electrons.make_pair if plan.counts_electrons else fused.make_pair
    return maker(srgb, plan, curve, limits_dn, origin)


def reference_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Pair:
    """Make the same pair by the readable forms: Algorithm 1, the scene's exposure, the noise, the sensor's rounding."""
    _check(srgb)
    return _reference_pair(_dequantised(srgb, plan, origin), plan, origin)


def _reference_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int], curve: Float | None = None) -> Pair:
    """Go by the formulas of the curve, or by its exact table, which every machine has alike."""
    light = unprocess(srgb, plan, origin, curve)
    if plan.exposure != 1:  # what the photograph shows as white is white before it is darkened
        light = np.minimum(light, 1) * plan.exposure
    if plan.averaged:
        light = effects.respond(light, plan, origin)
    clean_dn = to_dn(light, plan.black_level_dn, plan.white_level_dn, plan.brightest)
    noisy_dn = effects.noisy(clean_dn, plan, origin)
    if plan.saturated == "pinned":
        noisy_dn = np.where(clean_dn >= plan.brightest_dn, plan.brightest_dn, noisy_dn)
    averaged_dn = effects.average(clean_dn, plan, origin) if plan.averaged else clean_dn

    low, high = noisy_limits(plan.bits, plan.black_level_dn, plan.sensor_clip)
    lowest, highest = (low, high) if plan.averaged else (plan.black_level_dn, plan.white_level_dn)
    clean = quantise(averaged_dn, lowest, highest)
    noisy = quantise(noisy_dn, low, high)

    counts = Counts(
        clean_clipped_low=int((light < 0).sum()),
        clean_clipped_high=int((light > plan.brightest).sum()),
        noisy_clipped_low=int((np.rint(noisy_dn) < low).sum()),
        noisy_clipped_high=int((np.rint(noisy_dn) > high).sum()),
        saturated=int((clean == plan.white_level_dn).sum()),
        zero_variance=int((effects.noise_variance(clean_dn, plan) == 0).sum()),
    )
    return Pair(clean, noisy, counts)


def _dequantised(srgb: Srgb, plan: Plan, origin: tuple[int, int]) -> Srgb:
    if plan.dequantize == "off" or srgb.dtype != np.uint8:
        return srgb
    return dequantise(srgb, plan, linear_table(plan.tone, plan.gamma, 256), origin)


def _check(srgb: Srgb) -> None:
    if srgb.dtype not in (np.uint8, np.uint16) or srgb.ndim != 3 or srgb.shape[2] != 3:
        raise ValueError(f"srgb is {srgb.dtype} {list(srgb.shape)}, expected uint8 or uint16 [H, W, 3]")
