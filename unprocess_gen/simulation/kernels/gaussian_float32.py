"""Simulate pairs with two-parameter Gaussian noise in float32, for accuracy budgets that allow errors.

A pair takes three quarters of the time of `gaussian`. `config.accuracy` states the errors, tests prove them, and they
are equal on every CPU. Apart from precision, three things differ from `gaussian`:

* The tabulated products include gains, exposure and span, so sums of them are DN above the black level.
* The polynomials of the normal deviates have lower degrees (`normal.coarse_normal`).
* No site is recomputed exactly.

All DN in this module count from the black level, which is added after rounding. Timings: ``docs/design/kernels.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner, kernel
from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.core.types import Float, Pair, Plan, Raw, Srgb
from unprocess_gen.simulation.kernels.clean import (
    PairParameters,
    count_negative,
    pair_parameters,
    pinned_level_dn,
    row_products,
    sum_products,
)
from unprocess_gen.simulation.kernels.gaussian import HETEROSCEDASTIC
from unprocess_gen.simulation.kernels.normal import apply_signs, coarse_normal, fill_coarse_depths
from unprocess_gen.simulation.kernels.philox import fill_word_blocks, load_key, philox_keys
from unprocess_gen.simulation.kernels.readout import count_zero_variance
from unprocess_gen.simulation.kernels.rounding import ROUND32
from unprocess_gen.simulation.kernels.segments import (
    SEGMENT,
    Float32,
    Indices,
    allocate_frames,
    copy_values,
    frames_to_pairs,
    locate_blocks,
)
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    Pointer,
    Vector,
    less_than,
    load,
    maximum,
    minimum,
    movemask,
    pointer_to,
    square_root,
    store,
    to_bits,
)

_0, _8 = np.uint64(0), np.uint64(8)
_ZERO32, _ONE32, _INFINITY = np.float32(0), np.float32(1), np.float32(np.inf)

FLOAT32_MARGIN = 2.0**-18
"""Largest relative error of white in float32, a quarter DN at 16 bits; light above white by less is not clipped."""


def make_pairs(
    srgb: Srgb,
    plans: Sequence[Plan],
    curve: Float,
    limits_dn: Sequence[tuple[float, float]],
    origin: tuple[int, int] = (0, 0),
) -> list[Pair]:
    """Simulate pairs that share the clean frame and differ in their Gaussian noise, in float32.

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
    noise = np.array([noise_parameters32(plan, limits) for plan, limits in zip(plans, limits_dn, strict=True)])
    of_clean = dn_products32(parameters), site_parameters32(parameters), clean_parameters32(parameters)
    _fill_pairs32(
        np.ascontiguousarray(srgb), *of_clean, noise, philox_keys(plans), origin, allocate_buffers32(), *frames
    )
    return frames_to_pairs(*frames)


class CleanParameters32(NamedTuple):
    """Hold the parameters of the clean frame in float32."""

    gray_mean: bool
    site_channels: NDArray[np.int64]  # [2, 2]
    inverse_gains: Float32  # [3]
    dn_per_signal: np.float32  # without gains
    threshold: np.float32
    steepness: np.float32  # of the highlight term: 1 / (1 - threshold)
    exposure: np.float32
    limit: np.float32  # of light before the exposure is applied
    brightest: np.float32
    clipped: np.float32  # light above it counts as clipped; includes FLOAT32_MARGIN
    span_dn: np.float32
    black: np.uint32


def clean_parameters32(parameters: PairParameters) -> CleanParameters32:
    """Convert the parameters of a clean frame to float32."""
    black, span, _ = parameters.levels_dn
    f = np.float32
    return CleanParameters32(
        gray_mean=parameters.gray_mean,
        site_channels=parameters.site_channels,
        inverse_gains=parameters.inverse_gains.astype(f),
        dn_per_signal=f(parameters.exposure * span),
        threshold=f(parameters.highlight_threshold),
        steepness=f(1 / (1 - parameters.highlight_threshold)),
        exposure=f(parameters.exposure),
        limit=f(np.inf if parameters.exposure == 1 else 1),
        brightest=f(parameters.brightest),
        clipped=f(parameters.brightest * (1 + FLOAT32_MARGIN)),
        span_dn=f(span),
        black=np.uint32(black),
    )


def dn_products32(parameters: PairParameters) -> Float32:
    """Return the products ``[3, 3, codes]`` scaled to DN; unscaled with ``gray_mean``, which compares channels."""
    scale = np.ones(3) if parameters.gray_mean else _dn_per_signal(parameters)
    return (parameters.products * scale[:, None, None]).astype(np.float32)


def site_parameters32(parameters: PairParameters) -> Float32:
    """Return linear limit in DN, signal per DN, gain and headroom by site, ``[4, 2, VECTOR_WIDTH + 2]``.

    The second axis is for even and odd rows.
    """
    gains = np.ones(3) if parameters.gray_mean else parameters.inverse_gains
    dn_per_signal = _dn_per_signal(parameters)
    of_channels = parameters.linear_limit * dn_per_signal, 1 / dn_per_signal, gains, parameters.headroom
    rows = np.stack([values[parameters.site_channels] for values in of_channels]).astype(np.float32)
    return np.ascontiguousarray(np.tile(rows, (1, 1, VECTOR_WIDTH // 2 + 1)))


def _dn_per_signal(parameters: PairParameters) -> Float:
    """Return the DN per unit of linear signal of each channel; with ``gray_mean`` gains are inverted earlier."""
    gains = np.ones(3) if parameters.gray_mean else parameters.inverse_gains
    return gains * parameters.exposure * parameters.levels_dn[1]


class NoiseParameters32(NamedTuple):
    """Hold the variance line and the limits of one noisy frame in float32."""

    a: np.float32
    b: np.float32
    pinned_dn: np.float32
    saturated_dn: np.float32  # clean values from here on are pinned; FLOAT32_MARGIN below pinned_dn
    low: np.float32
    high: np.float32


def noise_parameters32(plan: Plan, limits_dn: tuple[float, float]) -> NoiseParameters32:
    """Return the noise parameters of a plan; ``limits_dn`` are the lowest and highest DN of its noisy frame."""
    black, pinned_dn = plan.black_level_dn, pinned_level_dn(plan)
    f = np.float32
    with np.errstate(over="ignore"):  # a variance beyond float32 becomes infinite, and the site is clipped
        a, b = (f(coefficient) for coefficient in plan.variance_line)
    pinned = f(pinned_dn - black), f((pinned_dn - black) * (1 - FLOAT32_MARGIN))
    return NoiseParameters32(a, b, *pinned, f(limits_dn[0] - black), f(limits_dn[1] - black))


@inner
def _load_noise_parameters32(noise: Float32, plan: int) -> NoiseParameters32:
    """Return row ``plan`` of an array of noise parameters."""
    return NoiseParameters32(
        noise[plan, 0], noise[plan, 1], noise[plan, 2], noise[plan, 3], noise[plan, 4], noise[plan, 5]
    )


class SegmentBuffers32(NamedTuple):
    """Hold the scratch arrays for one segment of a row, padded to complete blocks of 64 pixels.

    Its name differs from `segments.SegmentBuffers` because Numba dispatches by class name, and slowly if two share one.
    """

    signal: Float32  # linear signal times gains, exposure and span: DN
    clean_dn: Float32
    bright_light: Float32  # normalised light of bright vectors, 0 elsewhere
    words: Indices
    depths: Float32  # see `normal.fill_coarse_depths`
    noisy_dn: Float32  # neither rounded nor clipped
    clean: Raw
    noisy: Raw


def allocate_buffers32() -> SegmentBuffers32:
    """Allocate zeroed buffers for a segment."""
    size = SEGMENT + BLOCK
    singles, raw = np.zeros((5, size), dtype=np.float32), np.zeros((2, size), dtype=np.uint16)
    signal, clean_dn, bright_light, depths, noisy_dn = singles
    words = np.zeros(size, dtype=np.uint32)
    return SegmentBuffers32(signal, clean_dn, bright_light, words, depths, noisy_dn, raw[0], raw[1])


@inner
def buffer_pointers32(buffers: SegmentBuffers32) -> SegmentBuffers32:
    """Return the buffers as raw pointers."""
    return SegmentBuffers32(
        pointer_to(buffers.signal, _0),
        pointer_to(buffers.clean_dn, _0),
        pointer_to(buffers.bright_light, _0),
        pointer_to(buffers.words, _0),
        pointer_to(buffers.depths, _0),
        pointer_to(buffers.noisy_dn, _0),
        pointer_to(buffers.clean, _0),
        pointer_to(buffers.noisy, _0),
    )


@kernel
def _fill_pairs32(
    srgb: Srgb,
    products: Float32,
    sites: Float32,
    clean_parameters: CleanParameters32,
    noise: Float32,
    keys: NDArray[np.uint64],
    origin: tuple[int, int],
    buffers: SegmentBuffers32,
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill the frames and counts of all pairs, segment by segment."""
    height, width = clean.shape
    code_count, is_uint8 = products.shape[2], srgb.itemsize == 1
    segment, of_clean = buffer_pointers32(buffers), pointer_to(counts, _0)
    channels = pointer_to(clean_parameters.site_channels, _0)
    for y in range(height):
        even, odd = row_products(pointer_to(products, _0), code_count, channels, y)
        for start in range(0, width, SEGMENT):
            length = min(SEGMENT, width - start)
            first, after, block, blocks = locate_blocks(origin[1] + start, length)
            at, fills_blocks = y * width + start, length == blocks * BLOCK
            if clean_parameters.gray_mean:
                row, signal = srgb[y, start : start + length], buffers.signal[first:after]
                _fill_gray_mean_dn(row, products, y, clean_parameters, signal)
            else:
                signals = pointer_to(segment.signal, first)
                sum_products(pointer_to(srgb, 3 * at), even, odd, code_count, length, is_uint8, signals)
            of_sites = load_site_parameters(sites, y & 1, first)
            target = pointer_to(clean, at) if fills_blocks else segment.clean
            has_negative, has_bright = fill_linear32(blocks, of_sites[0], clean_parameters, segment, target)
            if has_negative:
                of_clean[0] += count_negative(first, after, segment.signal)
            if has_bright:
                recompute_bright32(blocks, of_sites, clean_parameters, segment, target)
                _count_bright32((first, after), clean_parameters, segment, of_clean)
            if not fills_blocks:
                copy_values(length, pointer_to(segment.clean, first), pointer_to(clean, at))
            for plan in range(noisy.shape[0]):
                key, of_plan = load_key(keys, plan), _load_noise_parameters32(noise, plan)
                fill_word_blocks(key, block, blocks, np.uint64(origin[0] + y), HETEROSCEDASTIC, segment.words)
                to = plan * height * width + at
                target = pointer_to(noisy, to) if fills_blocks else segment.noisy
                count, black, of_noisy = blocks * BLOCK, clean_parameters.black, pointer_to(counts, 6 * plan)
                _fill_noisy32(count, (first, after), of_plan, black, segment, target, of_noisy)
                if not fills_blocks:
                    copy_values(length, pointer_to(segment.noisy, first), pointer_to(noisy, to))


@inner
def _fill_gray_mean_dn(row: Srgb, products: Float32, y: int, parameters: CleanParameters32, out: Float32) -> None:
    """Linearise, apply the matrix, invert the gains with highlights preserved by the mean of the channels; to DN."""
    gains = parameters.inverse_gains
    for x in range(row.shape[0]):
        r, g, b = row[x, 0], row[x, 1], row[x, 2]
        red = (products[0, 0, r] + products[0, 1, g]) + products[0, 2, b]
        green = (products[1, 0, r] + products[1, 1, g]) + products[1, 2, b]
        blue = (products[2, 0, r] + products[2, 1, g]) + products[2, 2, b]
        m = max(((red + green) + blue) / np.float32(3) - parameters.threshold, _ZERO32) * parameters.steepness
        mask = m * m
        c = parameters.site_channels[y & 1, x & 1]
        i = red if c == 0 else green if c == 1 else blue
        out[x] = i * max(mask + (_ONE32 - mask) * gains[c], gains[c]) * parameters.dn_per_signal


@inner
def load_site_parameters(sites: Float32, row: int, first: int) -> tuple[Vector, Vector, Vector, Vector]:
    """Load a vector of each parameter of `site_parameters32` for an even or odd row (0, 1), from column ``first``."""
    width = sites.shape[2]
    at = row * width + (first & 1)
    return (
        load(pointer_to(sites, at), _0),
        load(pointer_to(sites, 2 * width + at), _0),
        load(pointer_to(sites, 4 * width + at), _0),
        load(pointer_to(sites, 6 * width + at), _0),
    )


@inner
def fill_linear32(
    blocks: int, limits_dn: Vector, parameters: CleanParameters32, segment: SegmentBuffers32, clean: Pointer
) -> tuple[bool, bool]:
    """Compute the clean frame as if no signal were bright; return whether any is negative, whether any is bright."""
    lowest = highest = load(segment.signal, _0)
    for n in range(blocks * (BLOCK // VECTOR_WIDTH)):
        x = np.uint64(n) * _8
        signal = load(segment.signal, x)
        lowest, highest = minimum(lowest, signal), maximum(highest, signal)
        dn = maximum(signal, _ZERO32)
        store(segment.clean_dn, x, dn)
        store(clean, x, to_bits(dn + ROUND32) + parameters.black)
    return movemask(less_than(lowest, _ZERO32)) != 0, movemask(less_than(limits_dn, highest)) != 0


@inner
def recompute_bright32(
    blocks: int,
    sites: tuple[Vector, Vector, Vector, Vector],
    parameters: CleanParameters32,
    segment: SegmentBuffers32,
    clean: Pointer,
) -> None:
    """Recompute vectors that contain a bright signal; their light goes to ``segment.bright_light``, elsewhere 0."""
    limits_dn, signal_per_dn, gains, headroom = sites
    for n in range(blocks * (BLOCK // VECTOR_WIDTH)):
        x = np.uint64(n) * _8
        signal = load(segment.signal, x)
        if movemask(less_than(limits_dn, signal)) == 0:
            store(segment.bright_light, x, signal * _ZERO32)
            continue
        i = signal * signal_per_dn
        m = maximum(i - parameters.threshold, _ZERO32) * parameters.steepness
        light = minimum(i * gains + i * (m * m) * headroom, parameters.limit) * parameters.exposure
        dn = minimum(maximum(light, _ZERO32), parameters.brightest) * parameters.span_dn
        store(segment.bright_light, x, light)
        store(segment.clean_dn, x, dn)
        store(clean, x, to_bits(dn + ROUND32) + parameters.black)


@inner
def _count_bright32(
    valid: tuple[int, int], parameters: CleanParameters32, segment: SegmentBuffers32, counts: Pointer
) -> None:
    """Count sites above the brightest light, and saturated ones."""
    above = saturated = 0
    last = parameters.span_dn + ROUND32
    for x in range(valid[0], valid[1]):
        above += segment.bright_light[x] > parameters.clipped
        saturated += segment.clean_dn[x] + ROUND32 == last
    counts[1] += above
    counts[4] += saturated


@inner
def _fill_noisy32(
    count: int,
    valid: tuple[int, int],
    noise: NoiseParameters32,
    black: np.uint32,
    segment: SegmentBuffers32,
    noisy: Pointer,
    counts: Pointer,
) -> None:
    """Fill one segment of a noisy frame and update its counts."""
    fill_coarse_depths(count, segment.words, segment.depths)
    _fill_noise32(count, noise, segment)
    has_clipped = round_and_clip32(count, noise, black, segment.noisy_dn, noisy)
    if noise.pinned_dn < _INFINITY:
        _pin_saturated32(valid, noise, black, segment, noisy)
    if has_clipped:
        _count_clipped32(valid, noise, segment, counts)
    counts[5] += count_zero_variance(valid, (noise.a, noise.b, _ZERO32), segment.clean_dn)


@inner
def _fill_noise32(count: int, noise: NoiseParameters32, segment: SegmentBuffers32) -> None:
    """Add noise to the clean DN."""
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        clean_dn = load(segment.clean_dn, x)
        std = square_root(maximum(clean_dn * noise.a + noise.b, _ZERO32))
        normal = coarse_normal(load(segment.depths, x))
        store(segment.noisy_dn, x, clean_dn + apply_signs(std * normal, load(segment.words, x)))


@inner
def round_and_clip32(count: int, noise: NoiseParameters32, black: np.uint32, noisy_dn: Pointer, noisy: Pointer) -> bool:
    """Clip, round half to even, cast to uint16; return whether any of the ``count`` sites was clipped."""
    lowest = highest = load(noisy_dn, _0)
    for n in range(count // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        dn = load(noisy_dn, x)
        lowest, highest = minimum(lowest, dn), maximum(highest, dn)
        store(noisy, x, to_bits(minimum(maximum(dn, noise.low), noise.high) + ROUND32) + black)
    return bool(movemask(less_than(lowest, noise.low) | less_than(noise.high, highest)) != 0)


@inner
def _pin_saturated32(
    valid: tuple[int, int], noise: NoiseParameters32, black: np.uint32, segment: SegmentBuffers32, noisy: Pointer
) -> None:
    """Replace the noisy values of saturated sites with the pinned level."""
    for x in range(valid[0], valid[1]):
        if segment.clean_dn[x] >= noise.saturated_dn:
            segment.noisy_dn[x] = noise.pinned_dn
            noisy[x] = _low_16_bits32(min(max(noise.pinned_dn, noise.low), noise.high) + ROUND32, black)


@inner
def _low_16_bits32(shifted: np.float32, black: np.uint32) -> np.uint16:
    """Return ``black`` plus the integer that a float32 holds after the addition of `ROUND32`."""
    return np.uint16((np.float32(shifted).view(np.uint32) + black) & np.uint32(0xFFFF))


@inner
def _count_clipped32(
    valid: tuple[int, int], noise: NoiseParameters32, segment: SegmentBuffers32, counts: Pointer
) -> None:
    """Count noisy values that round to below and above the limits."""
    low, high = noise.low, noise.high
    below, above = 0, 0
    for x in range(valid[0], valid[1]):
        rounded = (min(max(segment.noisy_dn[x], low - _ONE32), high + _ONE32) + ROUND32) - ROUND32
        below += rounded < low
        above += rounded > high
    counts[2] += below
    counts[3] += above
