"""One photograph and its plan in, the clean and the noisy raw frame out. The page to read first.

`reference_pair` says what a pair is, in the article's words. `make_pair` gives the same DN fifty times faster and is
what datasets are made with; the tests hold the two together, on photographs and on every option.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

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
    if plan.readable:
        return _reference_pair(srgb, plan, origin, _curve(srgb, plan))
    maker = electrons.make_pair if plan.counts_electrons else fused.make_pair
    return maker(srgb, plan, _curve(srgb, plan), _limits_dn(plan), origin)


def make_pairs(srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int] = (0, 0)) -> Iterator[Pair]:
    """Make the pairs of plans that share the clean frame: levels and draws of its noise, one after the other.

    Each is what `make_pair` gives, byte for byte, but the photograph is unprocessed once and the clean array is one.
    Raises ValueError where the plans do not share it.
    """
    _check(srgb)
    if any(_of_the_clean_frame(plan) != _of_the_clean_frame(plans[0]) for plan in plans):
        raise ValueError("the plans do not share the clean frame: they may differ in the noise, level and draw alone")
    if len(plans) < 2 or not all(map(_is_made_of_the_clean_frame, plans)):
        return (make_pair(srgb, plan, origin) for plan in plans)
    return _pairs_of_one_clean_frame(srgb, plans, origin)


def _pairs_of_one_clean_frame(srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int]) -> Iterator[Pair]:
    srgb = _dequantised(srgb, plans[0], origin)
    unrounded, clean, of_clean = fused.unprocess(srgb, plans[0], _curve(srgb, plans[0]), origin)
    for plan in plans:
        maker = electrons.make_noisy if plan.counts_electrons else fused.make_noisy
        noisy, of_noisy = maker(unrounded, plan, _limits_dn(plan), origin)
        yield Pair(clean, noisy, Counts(*(int(count) for count in of_clean + of_noisy)))


def _is_made_of_the_clean_frame(plan: Plan) -> bool:
    """Whether the noisy frame can be made of the unrounded clean one alone."""
    return not (plan.readable or plan.in_float32 or plan.averaged or "full_well" in plan.effects)


def _of_the_clean_frame(plan: Plan) -> tuple[object, ...]:
    """Return all of a plan that the clean frame depends on."""
    without_noise = replace(
        plan, sensor_clip="", saturated="", noise="", noise_law="", a_dn=0.0, b_dn2=0.0,
        effects=(), skipped=(), physics=None, level=0, draw=0, frame=0,
    )  # fmt: skip
    return without_noise, plan.brightest, plan.averaged and (plan.physics, plan.effects)


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

    low, high = _limits_dn(plan)
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


def _curve(srgb: Srgb, plan: Plan) -> Float:
    return linear_table(plan.tone, plan.gamma, int(np.iinfo(srgb.dtype).max) + 1)


def _limits_dn(plan: Plan) -> tuple[float, float]:
    return noisy_limits(plan.bits, plan.black_level_dn, plan.sensor_clip)


def _check(srgb: Srgb) -> None:
    if srgb.dtype not in (np.uint8, np.uint16) or srgb.ndim != 3 or srgb.shape[2] != 3:
        raise ValueError(f"srgb is {srgb.dtype} {list(srgb.shape)}, expected uint8 or uint16 [H, W, 3]")
