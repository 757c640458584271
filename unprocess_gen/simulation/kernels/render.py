"""Render clean and noisy frames strip by strip: the one compiled entry of all pairs.

Per strip: the clean frame (`clean`), then for each noisy frame a sampler and a read-out. Numba chooses the sampler by
the class of ``noise``, the precision by that of ``scene``, and the read-out by that of ``readout``; so compiled code
contains only what a pair needs. Every form gives the same DN as `pair.reference_pair` on every processor, except
`clean.Scene32` with `gaussian.Gaussian32`, whose errors are stated in `config.accuracy`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import kernel
from unprocess_gen.core.types import PACKED, Counts, DarkPixels, Frame, Pair, Plan, Srgb
from unprocess_gen.simulation.kernels.body import body_of, clean_response, fixed_patterns
from unprocess_gen.simulation.kernels.clean import Scene, Scene32, fill_clean, scene_of, with_response
from unprocess_gen.simulation.kernels.electron_records import electron_noise, with_dark_frames
from unprocess_gen.simulation.kernels.electrons import Electrons
from unprocess_gen.simulation.kernels.gaussian import Gaussian, Gaussian32, gaussian_noise, gaussian_noise32
from unprocess_gen.simulation.kernels.philox import load_key, philox_keys
from unprocess_gen.simulation.kernels.readout import (
    Output,
    ReadOut,
    average_patterns,
    count_zero_variance,
    draw_noise,
    read_noisy,
    readout_of,
    sample_noise,
    write_clean,
)
from unprocess_gen.simulation.kernels.simd import pointer_to, pointers_of
from unprocess_gen.simulation.kernels.strips import (
    ONES,
    STRIP,
    Scratch,
    locate,
    scratch_of_thread,
    workspace_in,
)


def render_pairs(
    srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int] = (0, 0), dark_pixels: DarkPixels | None = None
) -> list[Pair]:
    """Simulate pairs that share the clean frame, in one pass.

    Parameters
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        Display-referred codes.
    plans : sequence of Plan
        Plans that differ only in noise, level, draw and frame.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame.
    dark_pixels : DarkPixels, optional
        Access to the dark frames that the plans name.

    Returns
    -------
    list of Pair
        One pair per plan; all share the clean array.
    """
    clean, noisy, counts = _fill_frames(srgb, plans, len(plans), origin, dark_pixels)
    clean_low, clean_high, _, _, saturated, _ = counts[0]
    return [
        Pair(clean, frame, Counts(clean_low, clean_high, noisy_low, noisy_high, saturated, zero_variance))
        for frame, (_, _, noisy_low, noisy_high, _, zero_variance) in zip(noisy, counts, strict=True)
    ]


def render_clean(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Frame:
    """Simulate the clean frame only, with the kernels of `render_pairs`; parameters as there."""
    return _fill_frames(srgb, [replace(plan, dark_frame="")], 0, origin, None)[0]


def _fill_frames(
    srgb: Srgb, plans: Sequence[Plan], count: int, origin: tuple[int, int], dark_pixels: DarkPixels | None
) -> tuple[Frame, Frame, list[list[int]]]:
    """Return the clean frame, the first ``count`` noisy frames, and their numbers of `Counts`.

    Only the first numbers include those of the clean frame.
    """
    first, shape = plans[0], (srgb.shape[0], srgb.shape[1])
    frame_shape = (4, shape[0] // 2, shape[1] // 2) if first.layout == PACKED else shape
    clean = np.empty(frame_shape, dtype=np.float32 if first.clean_normalised else np.uint16)
    noisy = np.empty((count, *frame_shape), dtype=np.float32 if first.normalised else np.uint16)
    counts = np.zeros((max(count, 1), 6), dtype=np.int64)
    scene, noise, readout = _records(tuple(plans), shape, 256 if srgb.itemsize == 1 else 65536, origin)
    if isinstance(noise, Electrons) and any(plan.dark_frame for plan in plans):
        noise = with_dark_frames(noise, plans, dark_pixels, shape, origin)
    scratch = scratch_of_thread(np.float32 if uses_scene32(first) else np.float64)
    # a view, a read-only array or a subclass would be another type, compiled again
    codes = srgb if type(srgb) is np.ndarray and srgb.flags.carray else np.array(srgb, order="C")
    keys, frames = philox_keys(plans)[:count], (clean.reshape(-1), noisy.reshape(count, clean.size))
    _render(codes, scene, noise, keys, origin, readout, scratch, *frames, counts)
    return clean, noisy, counts.tolist()


def _records(
    plans: tuple[Plan, ...], shape: tuple[int, int], codes: int, origin: tuple[int, int]
) -> tuple[Scene, Gaussian | Gaussian32 | Electrons, ReadOut]:
    """Return the scene, the noise and the read-out, whose classes select the compiled code."""
    first = plans[0]
    scene, noise, readout = _records_of_plans(
        plans, shape if first.layout == PACKED else (0, 0), codes, (origin[0] % 2, origin[1] % 2)
    )
    if noise is not None:
        return scene, noise, readout
    body = body_of(first, shape, origin)
    response = clean_response(first, body, shape, origin)
    if response is not None:
        scene = with_response(scene, response)
    if first.averaged:  # the clean frame contains the response, so the noise does not
        body = body._replace(response=ONES, response_steps=(0, 0))
    return scene, electron_noise(plans, body, shape, origin, counts_all=first.normalised), readout


@functools.lru_cache(maxsize=4)
def _records_of_plans(
    plans: tuple[Plan, ...], shape: tuple[int, int], codes: int, corner: tuple[int, int]
) -> tuple[Scene, Gaussian | Gaussian32 | None, ReadOut]:
    """Return what all patches of an image share; the noise is None if it is counted in electrons."""
    if uses_scene32(plans[0]):
        scene = scene_of(plans[0], codes, corner, Scene32)
        return scene, gaussian_noise32(plans), readout_of(plans, shape, corner, True)
    noise = None if plans[0].counts_electrons else gaussian_noise(plans)
    return scene_of(plans[0], codes, corner), noise, readout_of(plans, shape, corner, False)


def pass_key(plan: Plan) -> tuple[object, ...]:
    """Return what the plans of one pass have in common: the kernels, and the fixed patterns of the body."""
    return plan.uses_reference, plan.uses_float32, plan.averaged, plan.counts_electrons, fixed_patterns(plan)


def uses_scene32(plan: Plan) -> bool:
    """Return whether a plan is rendered in float32: only integer frames with one normal per site are."""
    return plan.uses_float32 and not plan.clean_normalised and not plan.counts_electrons


@kernel
def _render(
    srgb: Srgb,
    scene: Any,
    noise: Any,
    keys: NDArray[np.uint64],
    origin: tuple[int, int],
    readout: Any,
    scratch: Scratch,
    clean: Frame,
    noisy: Frame,
    counts: NDArray[np.int64],
) -> None:
    """Fill the frames and counts of all pairs, strip by strip."""
    height, width = srgb.shape[:2]
    light, sampler, frames, buffers = (
        pointers_of(scene),
        pointers_of(noise),
        pointers_of(readout),
        workspace_in(scratch),
    )
    codes, clean_sites, noisy_sites = pointer_to(srgb, 0), pointer_to(clean, 0), pointer_to(noisy, 0)
    key_words, all_counts, sites = pointer_to(keys, 0), pointer_to(counts, 0), clean.size
    for y in range(height):
        for x in range(0, width, STRIP):
            strip = locate(origin, y, x, min(STRIP, width - x))
            at = (y // 2) * (width // 2) + x // 2 if readout.packed else y * width + x
            source, target = pointer_to(codes, 3 * (y * width + x)), pointer_to(clean_sites, at)
            may_saturate = fill_clean(light, source, strip, buffers, all_counts)
            for n in range(noisy.shape[0]):
                draw_noise(sampler, n, load_key(key_words, n), strip, buffers)
                values, listed = sample_noise(frames, sampler, n, strip, buffers)
                of_frame = pointer_to(all_counts, 6 * n)
                output = Output(n, pointer_to(noisy_sites, n * sites + at), of_frame, may_saturate)
                read_noisy(frames, sampler, values, listed, output, strip, buffers)
                count_zero_variance(frames, n, strip, buffers, of_frame)
            if readout.averaged:
                average_patterns(sampler, strip, buffers)
            write_clean(frames, Output(0, target, all_counts, may_saturate or readout.averaged), strip, buffers)
