"""One photograph and its plan in, the clean and the noisy raw frame out. The page to read first.

`reference_pair` says what a pair is, in the article's words. `make_pair` gives the same DN fifty times faster and is
what datasets are made with; the tests hold the two together, on photographs and on every option.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, fields, replace

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import PACKED, Counts, Float, Frame, Normalised, Pair, Plan, Srgb
from unprocess_gen.simulation.kernels import float_draws as floats
from unprocess_gen.simulation.kernels import gaussian as fused
from unprocess_gen.simulation.kernels import gaussian_float32 as single
from unprocess_gen.simulation.kernels import physical as electrons
from unprocess_gen.simulation.kernels.clean import make_clean
from unprocess_gen.simulation.reference import noise as effects
from unprocess_gen.simulation.reference.cfa import pack
from unprocess_gen.simulation.reference.sensor import noisy_limits, normalise, quantise, to_dn
from unprocess_gen.simulation.reference.unprocess import dequantise, unprocess


def make_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Pair:
    """Make the clean and the noisy frame of a photograph, as planned.

    Pure: the same pixels and plan give the same pair on any machine, worker, engine and in any order. ``srgb`` is uint8
    or uint16 ``[H, W, 3]``. A cut-out whose top-left pixel is ``origin`` in the full frame gives the same cut-out of
    the full pair, single pixels included. Raises ValueError for other types and shapes, and for an odd side where
    planes are packed.
    """
    _check(srgb, plan)
    srgb = _dequantised(srgb, plan, origin)
    if plan.readable:
        return _pair_laid_out(_reference_pair(srgb, plan, origin, _curve(srgb, plan)), plan, origin)
    if plan.normalised:
        return _float_pair(srgb, plan, origin)
    if plan.counts_electrons:
        return _pair_laid_out(
            electrons.make_pair(srgb, plan, _curve(srgb, plan), _limits_dn(plan), origin), plan, origin
        )
    return next(_pairs_of_one_normal(srgb, [plan], origin))


def make_pairs(srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int] = (0, 0)) -> Iterator[Pair]:
    """Make the pairs of plans that share the clean frame: levels and draws of its noise, one after the other.

    Each is what `make_pair` gives, byte for byte, but the photograph is unprocessed once for several of them, and the
    clean array is one. Raises ValueError where the plans do not share it.
    """
    for plan in plans:
        _check(srgb, plan)
    if any(_of_the_clean_frame(plan) != _of_the_clean_frame(plans[0]) for plan in plans):
        raise ValueError("the plans do not share the clean frame: they may differ in the noise, level and draw alone")
    of_kinds = {(plan.normalised, plan.counts_electrons) for plan in plans}
    if len(plans) < 2 or not all(map(_is_made_of_the_clean_frame, plans)) or len(of_kinds) > 1:
        return (make_pair(srgb, plan, origin) for plan in plans)
    of_one_normal = (False, False) in of_kinds
    makers = _pairs_of_one_normal if of_one_normal else _pairs_of_one_clean_frame
    return makers(_dequantised(srgb, plans[0], origin), plans, origin)


AT_ONCE = 5
"""Noisy frames made together, 2 bytes a pixel each: with the photograph and the clean frame 15."""


def _pairs_of_one_normal(srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int]) -> Iterator[Pair]:
    """Make the noisy frames some at a time: to make the clean one anew for each few costs less than to keep it."""
    first = plans[0]
    maker, curve = single.make_pairs if first.in_float32 else fused.make_pairs, _curve(srgb, first)
    clean: Frame | None = None
    for start in range(0, len(plans), AT_ONCE):
        some = plans[start : start + AT_ONCE]
        for plan, pair in zip(some, maker(srgb, some, curve, [*map(_limits_dn, some)], origin), strict=True):
            clean = _laid_out(pair.clean, plan, origin) if clean is None else clean
            yield Pair(clean, _laid_out(pair.noisy, plan, origin), pair.counts)


def _pairs_of_one_clean_frame(srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int]) -> Iterator[Pair]:
    first = plans[0]
    unrounded, rounded, of_clean = make_clean(srgb, first, _curve(srgb, first), origin)
    if first.normalised:
        del rounded
        clean = _float_frame(unrounded.shape, first)
        for plan in plans:
            noisy = _float_frame(unrounded.shape, plan)
            counts = _fill_floats(unrounded, of_clean, plan, origin, clean if plan is first else None, noisy)
            yield Pair(clean, noisy, Counts(*counts.tolist()))
        return
    whole = _laid_out(rounded, first, origin)
    del rounded
    for plan in plans:
        of_dn, of_noisy = electrons.make_noisy(unrounded, plan, _limits_dn(plan), origin)
        yield Pair(whole, _laid_out(of_dn, plan, origin), Counts(*(int(count) for count in of_clean + of_noisy)))


def _is_made_of_the_clean_frame(plan: Plan) -> bool:
    """Whether the noisy frame can be made of the clean one before rounding alone."""
    return not (plan.readable or plan.averaged or "full_well" in plan.effects)


def _of_the_clean_frame(plan: Plan) -> tuple[object, ...]:
    """Return all of a plan that the clean frame depends on."""
    without_noise = replace(
        plan, sensor_clip="", saturated="", noise="", noise_law="", a_dn=0.0, b_dn2=0.0,
        effects=(), skipped=(), physics=None, level=0, draw=0, frame=0,
    )  # fmt: skip
    return without_noise, plan.brightest, plan.averaged and (plan.physics, plan.effects)


def reference_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Pair:
    """Make the same pair by the readable forms: Algorithm 1, the scene's exposure, the noise, the sensor's rounding."""
    _check(srgb, plan)
    return _pair_laid_out(_reference_pair(_dequantised(srgb, plan, origin), plan, origin), plan, origin)


def _reference_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int], curve: Float | None = None) -> Pair:
    """Go by the formulas of the curve, or by its exact table, which every machine has alike."""
    light = _light(srgb, plan, origin, curve, effects.READABLE_DRAWS)
    return _read_out(_clean_dn(light, plan), _beyond(light, plan), plan, origin, effects.READABLE_DRAWS)


def _light(srgb: Srgb, plan: Plan, origin: tuple[int, int], curve: Float | None, draws: effects.Draws) -> Float:
    """Return the light of the scene on each site, 0 at black and 1 at white, before clipping."""
    light = unprocess(srgb, plan, origin, curve)
    if plan.exposure != 1:  # what the photograph shows as white is white before it is darkened
        light = np.minimum(light, 1) * plan.exposure
    return effects.respond(light, plan, origin, draws) if plan.averaged else light


def _clean_dn(light: Float, plan: Plan) -> Float:
    return to_dn(light, plan.black_level_dn, plan.white_level_dn, plan.brightest)


def _beyond(light: Float, plan: Plan) -> tuple[int, int]:
    """Return how many sites lie below black and above the brightest light."""
    return int((light < 0).sum()), int((light > plan.brightest).sum())


def _read_out(
    clean_dn: Float, beyond: tuple[int, int], plan: Plan, origin: tuple[int, int], draws: effects.Draws
) -> Pair:
    """Add the noise to an unrounded clean frame, clip both, and round them or, as floats, normalise them."""
    noisy_dn = effects.noisy(clean_dn, plan, origin, draws)
    if plan.saturated == "pinned":
        noisy_dn = np.where(clean_dn >= plan.brightest_dn, plan.brightest_dn, noisy_dn)
    averaged_dn = effects.average(clean_dn, plan, origin, draws) if plan.averaged else clean_dn

    low, high = _limits_dn(plan)
    levels_dn = plan.black_level_dn, plan.white_level_dn
    lowest, highest = (low, high) if plan.averaged else levels_dn
    read_dn = noisy_dn if plan.normalised else np.rint(noisy_dn)
    clean: Frame
    noisy: Frame
    if plan.normalised:
        clean, noisy = normalise(averaged_dn, lowest, highest, levels_dn), normalise(noisy_dn, low, high, levels_dn)
    else:
        clean, noisy = quantise(averaged_dn, lowest, highest), quantise(noisy_dn, low, high)

    counts = Counts(
        clean_clipped_low=beyond[0],
        clean_clipped_high=beyond[1],
        noisy_clipped_low=int((read_dn < low).sum()),
        noisy_clipped_high=int((read_dn > high).sum()),
        saturated=int((clean == (1 if plan.normalised else plan.white_level_dn)).sum()),
        zero_variance=int((effects.noise_variance(clean_dn, plan) == 0).sum()),
    )
    return Pair(clean, noisy, counts)


def _float_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int]) -> Pair:
    """Make the pair of `_reference_pair` in float32, band by band."""
    clean, noisy = (_float_frame(srgb.shape, plan) for _ in range(2))
    counts = np.zeros(len(fields(Counts)), dtype=np.int64)
    curve = _curve(srgb, plan)
    for rows in floats.row_bands(srgb.shape, floats.BAND_SITES):
        at = origin[0] + rows.start, origin[1]
        if plan.averaged:
            light = _light(srgb[rows], plan, at, curve, floats.KERNEL_DRAWS)
            clean_dn, of_clean = _clean_dn(light, plan), np.array(_beyond(light, plan))
        else:
            clean_dn, _, of_clean = make_clean(srgb[rows], plan, curve, at)
        counts += _fill_floats(clean_dn, of_clean, plan, at, _of_rows(clean, rows), _of_rows(noisy, rows))
    return Pair(clean, noisy, Counts(*counts.tolist()))


def _fill_floats(
    clean_dn: Float,
    of_clean: NDArray[np.int64],
    plan: Plan,
    origin: tuple[int, int],
    clean: Normalised | None,
    noisy: Normalised,
) -> NDArray[np.int64]:
    """Fill the frames, or the noisy one alone, of an unrounded clean frame, and return the numbers of `Counts`.

    ``of_clean`` begins with the sites beyond the ends of the clean one.
    """
    counts = np.zeros(len(fields(Counts)), dtype=np.int64)
    counts[:2] = of_clean[:2]
    for rows in floats.row_bands(clean_dn.shape, floats.PIECE_SITES):
        at = origin[0] + rows.start, origin[1]
        piece = _read_out(clean_dn[rows], (0, 0), plan, at, floats.KERNEL_DRAWS)
        if clean is not None:
            _of_rows(clean, rows)[:] = _laid_out(piece.clean, plan, at)
        _of_rows(noisy, rows)[:] = _laid_out(piece.noisy, plan, at)
        counts += astuple(piece.counts)
    return counts


def _float_frame(shape: tuple[int, ...], plan: Plan) -> Normalised:
    height, width = shape[:2]
    return np.empty((4, height // 2, width // 2) if plan.layout == PACKED else (height, width), dtype=np.float32)


def _of_rows(frame: Normalised, rows: slice) -> Normalised:
    """Return a view of some rows of the mosaic, an even number from an even one on; planes have half as many."""
    return frame[rows] if frame.ndim == 2 else frame[:, rows.start // 2 : rows.stop // 2]


def _pair_laid_out(pair: Pair, plan: Plan, origin: tuple[int, int]) -> Pair:
    clean, noisy, counts = pair.clean, pair.noisy, pair.counts
    del pair  # each mosaic can go as soon as it is packed
    clean = _laid_out(clean, plan, origin)
    return Pair(clean, _laid_out(noisy, plan, origin), counts)


def _laid_out(mosaic: Frame, plan: Plan, origin: tuple[int, int]) -> Frame:
    return pack(mosaic, plan.pattern, origin) if plan.layout == PACKED else mosaic


def _dequantised(srgb: Srgb, plan: Plan, origin: tuple[int, int]) -> Srgb:
    if plan.dequantize == "off" or srgb.dtype != np.uint8:
        return srgb
    return dequantise(srgb, plan, linear_table(plan.tone, plan.gamma, 256), origin)


def _curve(srgb: Srgb, plan: Plan) -> Float:
    return linear_table(plan.tone, plan.gamma, int(np.iinfo(srgb.dtype).max) + 1)


def _limits_dn(plan: Plan) -> tuple[float, float]:
    return noisy_limits(plan.bits, plan.black_level_dn, plan.sensor_clip)


def _check(srgb: Srgb, plan: Plan) -> None:
    if srgb.dtype not in (np.uint8, np.uint16) or srgb.ndim != 3 or srgb.shape[2] != 3:
        raise ValueError(f"srgb is {srgb.dtype} {list(srgb.shape)}, expected uint8 or uint16 [H, W, 3]")
    if plan.layout == PACKED and (srgb.shape[0] % 2 or srgb.shape[1] % 2):
        raise ValueError(f"srgb is {list(srgb.shape)}, expected even height and width for layout={PACKED}")
