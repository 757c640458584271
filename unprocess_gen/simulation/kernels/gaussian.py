"""Simulate clean and noisy frames for two-parameter Gaussian noise: one normal per site.

Contract: the same DN as `pair.reference_pair` on every CPU. Kernels use Numba without fastmath and only + - × ÷ √,
comparisons, integers and table look-ups, in the reference's order of operations. Without these kernels a pair takes
about 70 times as long (300 instead of 4 ns per pixel; AVX2, one thread).

1. Clean frame, float64 (`clean`).
2. Noise, float32, eight sites at a time (`simd`). Polynomials approximate normal deviates to `FINE_ERROR`; every value
   has an error bound.
3. Correction, float64. `_recompute_exact` recomputes sites whose error bound reaches a rounding boundary: about 1 % at
   a noise standard deviation of 100 DN.

Each stage is a separate loop, because short loops vectorise and overlap better. Segments that consist of complete
blocks are written to the frames directly, others through the buffers.

Timings and rejected alternatives: ``docs/design/kernels.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner, kernel
from unprocess_gen.core.random_streams import BLOCK, purpose
from unprocess_gen.core.types import Float, Pair, Plan, Raw, Srgb
from unprocess_gen.simulation.kernels.clean import (
    PairParameters,
    fill_clean,
    pair_parameters,
    parameter_pointers,
    pinned_level_dn,
)
from unprocess_gen.simulation.kernels.normal import (
    FINE_ERROR,
    apply_signs,
    exact_value,
    fill_depths,
    fine_normal,
    normal_quantile_tables,
)
from unprocess_gen.simulation.kernels.philox import fill_word_blocks, load_key, philox_keys
from unprocess_gen.simulation.kernels.readout import count_zero_variance
from unprocess_gen.simulation.kernels.rounding import ROUND, ROUND32
from unprocess_gen.simulation.kernels.segments import (
    SEGMENT,
    SegmentBuffers,
    allocate_buffers,
    allocate_frames,
    buffer_pointers,
    copy_values,
    frames_to_pairs,
    locate_blocks,
)
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    Pointer,
    Vector,
    from_bits,
    less_than,
    load,
    maximum,
    minimum,
    movemask,
    pointer_to,
    square_root,
    store,
    to_bits,
    to_float32,
    to_uint32,
    uint32_zeros,
)

HETEROSCEDASTIC = np.uint64(purpose("heteroscedastic"))

RELATIVE_NOISE_ERROR, RESIDUAL_ERROR_DN = np.float32(FINE_ERROR + 2.0**-16), np.float32(2.0**-22)
"""Bound of the error of `_fill_noise`: this fraction of the standard deviation, plus this many DN."""
CANCELLATION_FRACTION = 2.0**-4
"""If a or b is negative, sites with a variance below this fraction of abs(b) are recomputed in float64."""

_0, _8, _1_32 = np.uint64(0), np.uint64(8), np.uint32(1)
_ZERO32, _HALF32 = np.float32(0), np.float32(0.5)
_WITHOUT_SIGN, _ONE_BITS32 = np.uint32(0x7FFFFFFF), np.uint32(0x3F800000)


def make_pairs(
    srgb: Srgb,
    plans: Sequence[Plan],
    curve: Float,
    limits_dn: Sequence[tuple[float, float]],
    origin: tuple[int, int] = (0, 0),
) -> list[Pair]:
    """Simulate pairs that share the clean frame and differ in their Gaussian noise, all in one pass.

    Parameters
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        Display-referred codes.
    plans : sequence of Plan
        Plans of two-parameter profiles that differ only in noise, level, draw and frame.
    curve : ndarray of float64, [codes]
        Linear value of each code.
    limits_dn : sequence of (float, float)
        Lowest and highest DN of each plan's noisy frame.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame.

    Returns
    -------
    list of Pair
        One pair per plan, uint16 ``[H, W]``; all share the clean array.
    """
    frames = allocate_frames(srgb, len(plans))
    parameters = pair_parameters(plans[0], curve, srgb.shape, origin)
    noise = np.array([_noise_numbers(plan, limits) for plan, limits in zip(plans, limits_dn, strict=True)])
    keys, quadratics = philox_keys(plans), normal_quantile_tables().quadratics
    _fill_pairs(np.ascontiguousarray(srgb), parameters, noise, keys, origin, quadratics, allocate_buffers(), *frames)
    return frames_to_pairs(*frames)


def _noise_numbers(plan: Plan, limits_dn: tuple[float, float]) -> tuple[float, ...]:
    """Return a and b of the variance line, the pinned level, and the limits of the noisy frame, for one plan."""
    return *plan.variance_line, pinned_level_dn(plan), *limits_dn


@kernel
def _fill_pairs(
    srgb: Srgb,
    parameters: PairParameters,
    noise: Float,
    keys: NDArray[np.uint64],
    origin: tuple[int, int],
    quantiles: tuple[Float, Float, Float],
    buffers: SegmentBuffers,
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill the frames and counts of all pairs, segment by segment."""
    height, width = clean.shape
    segment, pointers = buffer_pointers(buffers), parameter_pointers(parameters)
    quadratics = _quadratic_pointers(quantiles)
    for y in range(height):
        for start in range(0, width, SEGMENT):
            length = min(SEGMENT, width - start)
            first, after, block, blocks = locate_blocks(origin[1] + start, length)
            at = y * width + start
            fills_blocks = length == blocks * BLOCK
            codes, target = pointer_to(srgb, 3 * at), pointer_to(clean, at)
            fill_clean(codes, srgb.itemsize == 1, y, first, length, pointers, segment, target, pointer_to(counts, 0))
            for plan in range(noisy.shape[0]):
                key, of_plan = load_key(keys, plan), _load_noise_parameters(noise, plan, parameters.levels_dn[0])
                fill_word_blocks(key, block, blocks, np.uint64(origin[0] + y), HETEROSCEDASTIC, segment.words)
                to = plan * height * width + at
                target = pointer_to(noisy, to) if fills_blocks else segment.noisy
                of_counts = pointer_to(counts, 6 * plan)
                _fill_noisy(blocks, (first, after), of_plan, quadratics, segment, target, of_counts)
                if not fills_blocks:
                    copy_values(length, pointer_to(segment.noisy, first), pointer_to(noisy, to))


class _NoiseParameters(NamedTuple):
    """Hold the variance line and the limits of one noisy frame."""

    exact: tuple[float, float, float]  # a, b, black
    a: np.float32
    b: np.float32
    black: np.float32
    cancellation: np.float32  # below this variance, float32 may have lost most digits
    pinned_dn: float
    low: np.float32
    high: np.float32


@inner
def _load_noise_parameters(noise: Float, plan: int, black: float) -> _NoiseParameters:
    """Return the noise parameters of row ``plan`` of what `_noise_numbers` gives."""
    a, b, pinned_dn, low, high = noise[plan, 0], noise[plan, 1], noise[plan, 2], noise[plan, 3], noise[plan, 4]
    cancellation = abs(b) * CANCELLATION_FRACTION if min(a, b) < 0.0 else 0.0
    f = np.float32
    return _NoiseParameters((a, b, black), f(a), f(b), f(black), f(cancellation), pinned_dn, f(low), f(high))


@inner
def _quadratic_pointers(quantiles: tuple[Float, Float, Float]) -> tuple[Pointer, Pointer, Pointer]:
    return pointer_to(quantiles[0], _0), pointer_to(quantiles[1], _0), pointer_to(quantiles[2], _0)


@inner
def _fill_noisy(
    blocks: int,
    valid: tuple[int, int],
    noise: _NoiseParameters,
    quadratics: tuple[Pointer, Pointer, Pointer],
    segment: SegmentBuffers,
    noisy: Pointer,
    counts: Pointer,
) -> None:
    """Fill one segment of a noisy frame and update its counts: in float32, uncertain sites in float64."""
    count = blocks * BLOCK
    fill_depths(count, segment.words, segment.depths)
    _fill_noise(count, noise, segment)
    uncertain, has_clipped = _round_and_list(count, noise, segment, noisy)
    if uncertain:
        has_clipped = _recompute_exact(uncertain, noise, quadratics, segment, noisy) or has_clipped
    if noise.pinned_dn < np.inf:
        _pin_saturated(valid, noise, segment, noisy)
    if has_clipped:
        _count_clipped(valid, noise, segment, counts)
    counts[5] += count_zero_variance(valid, noise.exact, segment.unrounded_dn)


@inner
def _fill_noise(count: int, noise: _NoiseParameters, segment: SegmentBuffers) -> None:
    """Compute the noise and its error bound in float32."""
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        residual = load(segment.residual_dn, x)
        variance = ((load(segment.rounded_dn, x) - noise.black) + residual) * noise.a + noise.b
        std = square_root(maximum(variance, _ZERO32))
        normal = fine_normal(load(segment.depths, x))
        store(segment.noise_dn, x, residual + apply_signs(std * normal, load(segment.words, x)))
        cancelled = less_than(from_bits(to_bits(variance) & _WITHOUT_SIGN), noise.cancellation) & _ONE_BITS32
        store(segment.error_dn, x, maximum(std * RELATIVE_NOISE_ERROR + RESIDUAL_ERROR_DN, from_bits(cancelled)))


@inner
def _round_and_list(count: int, noise: _NoiseParameters, segment: SegmentBuffers, noisy: Pointer) -> tuple[int, bool]:
    """Round half to even, clip and cast; list sites whose error bound reaches a rounding boundary.

    Return how many sites are uncertain, and whether any was clipped. Every vector writes all its lanes to the list, and
    the next one overwrites the certain ones: a branch would be mispredicted about every second time.
    """
    uncertain, changed = 0, uint32_zeros()
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        noise_dn = load(segment.noise_dn, x)
        rounded = (noise_dn + ROUND32) - ROUND32
        dn = load(segment.rounded_dn, x) + rounded
        clipped = minimum(maximum(dn, noise.low), noise.high)
        store(segment.noisy_dn, x, dn)
        store(noisy, x, to_uint32(clipped))
        changed = changed | (to_bits(clipped) ^ to_bits(dn))
        to_boundary = _HALF32 - from_bits(to_bits(noise_dn - rounded) & _WITHOUT_SIGN)
        mask = movemask(less_than(to_boundary, load(segment.error_dn, x)))
        lanes = load(segment.lanes_by_mask, np.uint64(mask) * _8)
        store(segment.uncertain, uncertain, lanes + np.uint32(x))
        uncertain += int(segment.count_by_mask[mask])
    return uncertain, _any_set(changed)


@inner
def _any_set(bits: Vector) -> bool:
    """Return whether any bit of a uint32 vector is set."""
    return bool(movemask(less_than(_ZERO32, to_float32(bits >> _1_32))) != 0)


@inner
def _recompute_exact(
    uncertain: int,
    noise: _NoiseParameters,
    quadratics: tuple[Pointer, Pointer, Pointer],
    segment: SegmentBuffers,
    noisy: Pointer,
) -> bool:
    """Recompute the listed sites by the reference's formulas in float64; return whether any was clipped."""
    clips = 0
    a, b, black = noise.exact
    for n in range(uncertain):
        x = segment.uncertain[n]
        clean_dn = segment.unrounded_dn[x]
        std = np.sqrt(max(a * (clean_dn - black) + b, 0.0))
        dn = (clean_dn + std * exact_value(segment.words[x], quadratics) + ROUND) - ROUND
        segment.noisy_dn[x] = dn
        noisy[x] = _clip_to_uint16(dn, noise)
        clips |= (dn < noise.low) | (dn > noise.high)
    return bool(clips != 0)


@inner
def _pin_saturated(valid: tuple[int, int], noise: _NoiseParameters, segment: SegmentBuffers, noisy: Pointer) -> None:
    """Replace the noisy values of saturated sites with the pinned level."""
    for x in range(valid[0], valid[1]):
        if segment.unrounded_dn[x] >= noise.pinned_dn:
            dn = (noise.pinned_dn + ROUND) - ROUND
            segment.noisy_dn[x] = dn
            noisy[x] = _clip_to_uint16(dn, noise)


@inner
def _clip_to_uint16(dn: float, noise: _NoiseParameters) -> np.uint16:
    return np.uint16(np.int64(min(max(dn, float(noise.low)), float(noise.high))))


@inner
def _count_clipped(valid: tuple[int, int], noise: _NoiseParameters, segment: SegmentBuffers, counts: Pointer) -> None:
    """Count noisy values below and above the limits."""
    low = high = 0
    for x in range(valid[0], valid[1]):
        low += segment.noisy_dn[x] < noise.low
        high += segment.noisy_dn[x] > noise.high
    counts[2] += low
    counts[3] += high
