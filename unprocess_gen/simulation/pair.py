"""Simulate the clean and noisy raw frame of one image: the module to read first.

`reference_pair` defines a pair with the NumPy reference, in the order of the article. `make_pair` computes the same
frames with compiled kernels, about 50 times as fast; datasets are made with it. Tests compare both on photographs and
on every option.

In both, a pair is computed in three steps: unprocess the image to the clean frame, add the effects of the sensor, then
clip and round both frames (`_read_out`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, fields, replace

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import PACKED, Counts, Float, Frame, Normalised, Pair, Plan, Srgb
from unprocess_gen.simulation.kernels import float_draws, gaussian, gaussian_float32, physical
from unprocess_gen.simulation.kernels.clean import make_clean
from unprocess_gen.simulation.reference import noise
from unprocess_gen.simulation.reference.cfa import pack
from unprocess_gen.simulation.reference.sensor import noisy_limits, normalise, quantise, to_dn
from unprocess_gen.simulation.reference.unprocess import dequantise, unprocess


def make_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Pair:
    """Simulate the clean and noisy raw frame of one image.

    The result depends only on the arguments, not on machine, worker, method or order.

    Parameters
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        Display-referred codes, R, G, B.
    plan : Plan
        All parameters of the pair.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame. The pair of a crop is the crop of the full pair.

    Returns
    -------
    Pair
        Clean and noisy frame: uint16 [H, W] in DN, unless ``plan.dtype`` or ``plan.layout`` differ; counts of clipped,
        saturated and zero-variance sites.

    Raises
    ------
    ValueError
        If ``srgb`` has another dtype or shape, or an odd side with ``layout="packed"``.
    """
    _check_image(srgb, plan)
    srgb = _dequantise(srgb, plan, origin)
    if plan.uses_reference:
        return _arrange_pair(_reference_pair(srgb, plan, origin, _curve(srgb, plan)), plan, origin)
    if plan.normalised:
        return _float_pair(srgb, plan, origin)
    if plan.counts_electrons:
        return _arrange_pair(physical.make_pair(srgb, plan, _curve(srgb, plan), _limits_dn(plan), origin), plan, origin)
    return next(_gaussian_pairs(srgb, [plan], origin))


def make_pairs(srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int] = (0, 0)) -> Iterator[Pair]:
    """Simulate several pairs of one image that share the clean frame.

    Each pair equals that of `make_pair`, but the image is unprocessed once for several pairs.

    Parameters
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        Display-referred codes, R, G, B.
    plans : sequence of Plan
        Plans that differ in noise, level and draw only.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame.

    Returns
    -------
    iterator of Pair
        One pair for each plan, in order; their clean frames can be one array.

    Raises
    ------
    ValueError
        If the clean frames of the plans differ, or as in `make_pair`.
    """
    for plan in plans:
        _check_image(srgb, plan)
    if any(_clean_frame_parameters(plan) != _clean_frame_parameters(plans[0]) for plan in plans):
        raise ValueError(
            "the clean frames of the plans differ; expected plans that differ in noise, level and draw only"
        )
    kinds = {(plan.normalised, plan.counts_electrons) for plan in plans}
    if len(plans) < 2 or not all(map(_needs_only_clean_frame, plans)) or len(kinds) > 1:
        return (make_pair(srgb, plan, origin) for plan in plans)
    simulate = _gaussian_pairs if (False, False) in kinds else _pairs_from_clean_frame
    return simulate(_dequantise(srgb, plans[0], origin), plans, origin)


FRAMES_PER_PASS = 5
"""Noisy frames simulated in one pass over the image: 10 bytes per pixel, and 5 for the image and the clean frame."""


def _gaussian_pairs(srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int]) -> Iterator[Pair]:
    """Simulate pairs whose noise is one normal deviate per site.

    Each pass over `FRAMES_PER_PASS` plans recomputes the clean frame, which costs less than storing it unrounded.
    """
    first = plans[0]
    curve = _curve(srgb, first)
    simulate = gaussian_float32.make_pairs if first.uses_float32 else gaussian.make_pairs
    clean: Frame | None = None
    for start in range(0, len(plans), FRAMES_PER_PASS):
        some = plans[start : start + FRAMES_PER_PASS]
        for plan, pair in zip(some, simulate(srgb, some, curve, [*map(_limits_dn, some)], origin), strict=True):
            clean = _arrange(pair.clean, plan, origin) if clean is None else clean
            yield Pair(clean, _arrange(pair.noisy, plan, origin), pair.counts)


def _pairs_from_clean_frame(srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int]) -> Iterator[Pair]:
    """Compute the unrounded clean frame once, and add the noise of each plan to it."""
    first = plans[0]
    unrounded, rounded, clean_counts = make_clean(srgb, first, _curve(srgb, first), origin)
    if first.normalised:
        del rounded
        clean = _float_frame(unrounded.shape, first)
        for plan in plans:
            noisy = _float_frame(unrounded.shape, plan)
            counts = _fill_floats(unrounded, clean_counts, plan, origin, clean if plan is first else None, noisy)
            yield Pair(clean, noisy, Counts(*counts.tolist()))
        return
    clean_dn = _arrange(rounded, first, origin)
    del rounded
    for plan in plans:
        noisy_dn, noisy_counts = physical.make_noisy(unrounded, plan, _limits_dn(plan), origin)
        all_counts = (int(count) for count in clean_counts + noisy_counts)
        yield Pair(clean_dn, _arrange(noisy_dn, plan, origin), Counts(*all_counts))


def _needs_only_clean_frame(plan: Plan) -> bool:
    """Return whether the noisy frame is a function of the unrounded clean frame after its clipping."""
    return not (plan.uses_reference or plan.averaged or "full_well" in plan.effects)


def _clean_frame_parameters(plan: Plan) -> tuple[object, ...]:
    """Return all parameters of a plan that affect the clean frame."""
    without_noise = replace(
        plan, sensor_clip="", saturated="", noise="", noise_law="", a_dn=0.0, b_dn2=0.0,
        effects=(), skipped=(), physics=None, level=0, draw=0, frame=0,
    )  # fmt: skip
    return without_noise, plan.brightest, plan.averaged and (plan.physics, plan.effects)


def reference_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Pair:
    """Simulate a pair with the NumPy reference: Algorithm 1, exposure of the scene, noise, rounding.

    Parameters
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        Display-referred codes, R, G, B.
    plan : Plan
        All parameters of the pair.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame.

    Returns
    -------
    Pair
        As `make_pair`.

    Raises
    ------
    ValueError
        As `make_pair`.
    """
    _check_image(srgb, plan)
    return _arrange_pair(_reference_pair(_dequantise(srgb, plan, origin), plan, origin), plan, origin)


def _reference_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int], curve: Float | None = None) -> Pair:
    """Return the pair before packing; ``curve`` is the exact table of the tone curve, or None to use its formulas."""
    light = _scene_light(srgb, plan, origin, curve, noise.REFERENCE_DRAWS)
    return _read_out(_clean_dn(light, plan), _count_clipped(light, plan), plan, origin, noise.REFERENCE_DRAWS)


def _scene_light(srgb: Srgb, plan: Plan, origin: tuple[int, int], curve: Float | None, draws: noise.Draws) -> Float:
    """Return the light of the scene at each CFA site, 0 at black and 1 at white, before clipping."""
    light = unprocess(srgb, plan, origin, curve)
    if plan.exposure != 1:  # clip at white first; otherwise light above white would reappear once darkened
        light = np.minimum(light, 1) * plan.exposure
    return noise.respond(light, plan, origin, draws) if plan.averaged else light


def _clean_dn(light: Float, plan: Plan) -> Float:
    """Return the clipped clean frame in DN, unrounded."""
    return to_dn(light, plan.black_level_dn, plan.white_level_dn, plan.brightest)


def _count_clipped(light: Float, plan: Plan) -> tuple[int, int]:
    """Count the sites below black and above the brightest light."""
    return int((light < 0).sum()), int((light > plan.brightest).sum())


def _read_out(
    clean_dn: Float, clipped: tuple[int, int], plan: Plan, origin: tuple[int, int], draws: noise.Draws
) -> Pair:
    """Add noise to an unrounded clean frame, clip both frames, then round or normalise them.

    ``clipped`` is the result of `_count_clipped` for the clean frame.
    """
    noisy_dn = noise.noisy(clean_dn, plan, origin, draws)
    if plan.saturated == "pinned":
        noisy_dn = np.where(clean_dn >= plan.brightest_dn, plan.brightest_dn, noisy_dn)
    averaged_dn = noise.average(clean_dn, plan, origin, draws) if plan.averaged else clean_dn

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
        clean_clipped_low=clipped[0],
        clean_clipped_high=clipped[1],
        noisy_clipped_low=int((read_dn < low).sum()),
        noisy_clipped_high=int((read_dn > high).sum()),
        saturated=int((clean == (1 if plan.normalised else plan.white_level_dn)).sum()),
        zero_variance=int((noise.noise_variance(clean_dn, plan) == 0).sum()),
    )
    return Pair(clean, noisy, counts)


def _float_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int]) -> Pair:
    """Compute the pair of `_reference_pair` in float32, one band of rows after the other."""
    clean, noisy = (_float_frame(srgb.shape, plan) for _ in range(2))
    counts = np.zeros(len(fields(Counts)), dtype=np.int64)
    curve = _curve(srgb, plan)
    for rows in float_draws.row_bands(srgb.shape, float_draws.BAND_SITES):
        at = origin[0] + rows.start, origin[1]
        if plan.averaged:
            light = _scene_light(srgb[rows], plan, at, curve, float_draws.KERNEL_DRAWS)
            clean_dn, clean_counts = _clean_dn(light, plan), np.array(_count_clipped(light, plan))
        else:
            clean_dn, _, clean_counts = make_clean(srgb[rows], plan, curve, at)
        counts += _fill_floats(clean_dn, clean_counts, plan, at, _view_rows(clean, rows), _view_rows(noisy, rows))
    return Pair(clean, noisy, Counts(*counts.tolist()))


def _fill_floats(
    clean_dn: Float,
    clean_counts: NDArray[np.int64],
    plan: Plan,
    origin: tuple[int, int],
    clean: Normalised | None,
    noisy: Normalised,
) -> NDArray[np.int64]:
    """Fill ``noisy``, and ``clean`` unless it is None, from an unrounded clean frame; return the numbers of `Counts`.

    The first two numbers are copied from ``clean_counts``.
    """
    counts = np.zeros(len(fields(Counts)), dtype=np.int64)
    counts[:2] = clean_counts[:2]
    for rows in float_draws.row_bands(clean_dn.shape, float_draws.PIECE_SITES):
        at = origin[0] + rows.start, origin[1]
        piece = _read_out(clean_dn[rows], (0, 0), plan, at, float_draws.KERNEL_DRAWS)
        if clean is not None:
            _view_rows(clean, rows)[:] = _arrange(piece.clean, plan, at)
        _view_rows(noisy, rows)[:] = _arrange(piece.noisy, plan, at)
        counts += astuple(piece.counts)
    return counts


def _float_frame(shape: tuple[int, ...], plan: Plan) -> Normalised:
    """Allocate a float32 frame in the plan's layout for an image ``[H, W, …]``."""
    height, width = shape[:2]
    return np.empty((4, height // 2, width // 2) if plan.layout == PACKED else (height, width), dtype=np.float32)


def _view_rows(frame: Normalised, rows: slice) -> Normalised:
    """Return a view of mosaic rows (even start and stop), or of the corresponding rows of packed planes."""
    return frame[rows] if frame.ndim == 2 else frame[:, rows.start // 2 : rows.stop // 2]


def _arrange_pair(pair: Pair, plan: Plan, origin: tuple[int, int]) -> Pair:
    """Convert both mosaics to the plan's layout."""
    clean, noisy, counts = pair.clean, pair.noisy, pair.counts
    del pair  # so that each mosaic is freed as soon as it is packed
    clean = _arrange(clean, plan, origin)
    return Pair(clean, _arrange(noisy, plan, origin), counts)


def _arrange(mosaic: Frame, plan: Plan, origin: tuple[int, int]) -> Frame:
    """Convert a mosaic to the plan's layout."""
    return pack(mosaic, plan.pattern, origin) if plan.layout == PACKED else mosaic


def _dequantise(srgb: Srgb, plan: Plan, origin: tuple[int, int]) -> Srgb:
    """Dither 8-bit codes to 16 bits if the plan asks for it."""
    if plan.dequantize == "off" or srgb.dtype != np.uint8:
        return srgb
    return dequantise(srgb, plan, linear_table(plan.tone, plan.gamma, 256), origin)


def _curve(srgb: Srgb, plan: Plan) -> Float:
    """Return the exact curve from the image's codes to linear light."""
    return linear_table(plan.tone, plan.gamma, int(np.iinfo(srgb.dtype).max) + 1)


def _limits_dn(plan: Plan) -> tuple[float, float]:
    """Return the lowest and highest DN of the noisy frame."""
    return noisy_limits(plan.bits, plan.black_level_dn, plan.sensor_clip)


def _check_image(srgb: Srgb, plan: Plan) -> None:
    """Raise ValueError if an image has an unusable dtype or shape."""
    if srgb.dtype not in (np.uint8, np.uint16) or srgb.ndim != 3 or srgb.shape[2] != 3:
        raise ValueError(f"srgb={srgb.dtype} {list(srgb.shape)}: unusable array; expected uint8 or uint16 [H, W, 3]")
    if plan.layout == PACKED and (srgb.shape[0] % 2 or srgb.shape[1] % 2):
        raise ValueError(f"srgb={list(srgb.shape)}: odd side; expected even height and width for layout={PACKED}")
