"""Compute the clean frame from sRGB codes: linearise, apply the matrix, invert white balance, convert to DN, round.

Equal to `reference.unprocess` and `reference.sensor.to_dn` to the last bit: float64, in the reference's order of
operations.

Products of each matrix entry and each code are tabulated, so a site's signal is the sum of three look-ups. Only the
channel recorded at each CFA site is computed (all three for ``highlight="gray_mean"``).

The first pass (`fill_linear`) treats every site as unclipped. The second (`recompute_bright`) recomputes the blocks of
64 pixels that contain a signal above `PairParameters.linear_limit`: highlights, clipped or saturated values. The other
blocks need neither its division nor its counts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner, kernel
from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.core.types import Float, Plan, Raw, Srgb
from unprocess_gen.simulation.kernels.rounding import ROUND
from unprocess_gen.simulation.kernels.segments import (
    LONG_SEGMENT,
    SEGMENT,
    SegmentBuffers,
    allocate_buffers,
    buffer_pointers,
    copy_values,
)
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    Pointer,
    Vector,
    less_than,
    load,
    load_four_bytes,
    maximum,
    minimum,
    movemask,
    pointer_to,
    store,
    to_float32,
    to_uint32,
)
from unprocess_gen.simulation.reference.cfa import tile

_0, _1, _2, _3, _4, _8 = (np.uint64(number) for number in (0, 1, 2, 3, 4, 8))
_BYTE, _S8, _S16, _S24 = (np.uint32(number) for number in (0xFF, 8, 16, 24))
_G, _B = np.uint32(256), np.uint32(512)


class PairParameters(NamedTuple):
    """Hold the parameters of a plan's clean frame, as kernels take them."""

    products: Float  # [3, 3, codes]: matrix entry (c, j) times the curve at code k
    code_count: int
    site_channels: NDArray[np.int64]  # [2, 2]: channel of each CFA site
    inverse_gains: Float  # [3]
    headroom: Float  # [3]: factor of the per-channel highlight term, or 0
    gray_mean: bool
    highlight_threshold: float
    linear_limit: float  # signals up to it are neither highlights nor clipped nor saturated
    exposure: float
    brightest: float
    levels_dn: tuple[float, float, float]  # black, white - black, white
    pinned_dn: float  # noisy DN of saturated sites; infinity if they keep their noise
    variance_line: tuple[float, float]
    site_gains: Float  # [2, LONG_SEGMENT]: of the sites of even and of odd rows, so that loops over them vectorise
    site_headroom: Float  # [2, LONG_SEGMENT]


def pair_parameters(plan: Plan, curve: Float, shape: tuple[int, ...], origin: tuple[int, int]) -> PairParameters:
    """Return the parameters of a plan; ``curve`` (float64) holds the linear value of each code of the source."""
    gains, channels = np.array(plan.inverse_gains), np.array(tile(plan.pattern, origin))
    ccm = np.array(plan.rgb2cam).reshape(3, 3)
    headroom = np.maximum(1 - gains, 0) if plan.highlight == "per_channel" else np.zeros(3)
    gray_mean = plan.highlight == "gray_mean"
    black_dn, white_dn = float(plan.black_level_dn), float(plan.white_level_dn)
    return PairParameters(
        products=ccm[:, :, None] * curve,
        code_count=len(curve),
        site_channels=channels,
        inverse_gains=gains,
        headroom=headroom,
        gray_mean=gray_mean,
        highlight_threshold=plan.highlight_threshold,
        linear_limit=_linear_limit(plan, 1.0 if gray_mean else float(gains.max()), bool(headroom.any())),
        exposure=plan.exposure,
        brightest=plan.brightest,
        levels_dn=(black_dn, float(plan.white_level_dn - plan.black_level_dn), white_dn),
        pinned_dn=pinned_level_dn(plan),
        variance_line=plan.variance_line,
        # `_fill_gray_mean_signal` has inverted the gains already
        site_gains=_per_site(np.ones(3) if gray_mean else gains, channels),
        site_headroom=_per_site(headroom, channels),
    )


def pinned_level_dn(plan: Plan) -> float:
    """Return the noisy DN of saturated sites; infinity if they keep their noise."""
    return plan.brightest_dn if plan.saturated == "pinned" else np.inf


def _linear_limit(plan: Plan, highest_gain: float, has_highlights: bool) -> float:
    """Return a signal up to which no site is a highlight, clipped or saturated, with a margin for rounding errors."""
    span_dn = plan.white_level_dn - plan.black_level_dn
    light = min(plan.brightest * 0.999, 1 - 1 / span_dn)
    unclipped = min(1.0, light / plan.exposure) / highest_gain * 0.999
    return min(unclipped, plan.highlight_threshold) if has_highlights else unclipped


def _per_site(channels: Float, site_channels: NDArray[np.int64]) -> Float:
    return np.tile(channels[site_channels], (1, LONG_SEGMENT // 2))


@inner
def parameter_pointers(parameters: PairParameters) -> PairParameters:
    """Return the parameters with raw pointers instead of arrays."""
    return PairParameters(
        pointer_to(parameters.products, _0),
        parameters.code_count,
        pointer_to(parameters.site_channels, _0),
        pointer_to(parameters.inverse_gains, _0),
        pointer_to(parameters.headroom, _0),
        parameters.gray_mean,
        parameters.highlight_threshold,
        parameters.linear_limit,
        parameters.exposure,
        parameters.brightest,
        parameters.levels_dn,
        parameters.pinned_dn,
        parameters.variance_line,
        pointer_to(parameters.site_gains, _0),
        pointer_to(parameters.site_headroom, _0),
    )


def make_clean(
    srgb: Srgb, plan: Plan, curve: Float, origin: tuple[int, int] = (0, 0)
) -> tuple[Float, Raw, NDArray[np.int64]]:
    """Simulate the clean frame alone, to derive several noisy frames from it.

    Parameters
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        Display-referred codes.
    plan : Plan
        All parameters of the pair.
    curve : ndarray of float64, [codes]
        Linear value of each code.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame.

    Returns
    -------
    unrounded_dn : ndarray of float64, [H, W]
        Clean frame before rounding, DN.
    clean : ndarray of uint16, [H, W]
        Clean frame, DN.
    counts : ndarray of int64, [6]
        Numbers of `Counts` in their order; 0 for those of the noisy frame.
    """
    unrounded_dn = np.empty(srgb.shape[:2])
    clean = np.empty(srgb.shape[:2], dtype=np.uint16)
    counts = np.zeros(6, dtype=np.int64)
    parameters = pair_parameters(plan, curve, srgb.shape, origin)
    _fill_clean_frame(np.ascontiguousarray(srgb), parameters, allocate_buffers(), unrounded_dn, clean, counts)
    return unrounded_dn, clean, counts


@kernel
def _fill_clean_frame(
    srgb: Srgb,
    parameters: PairParameters,
    buffers: SegmentBuffers,
    unrounded_dn: Float,
    clean: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill the clean frame, before and after rounding, and its counts."""
    height, width = clean.shape
    segment, pointers = buffer_pointers(buffers), parameter_pointers(parameters)
    for y in range(height):
        for start in range(0, width, SEGMENT):
            length, at = min(SEGMENT, width - start), y * width + start
            codes, target = pointer_to(srgb, 3 * at), pointer_to(clean, at)
            fill_clean(codes, srgb.itemsize == 1, y, 0, length, pointers, segment, target, pointer_to(counts, 0))
            copy_values(length, segment.unrounded_dn, pointer_to(unrounded_dn, at))


@inner
def fill_clean(
    codes: Pointer,
    is_uint8: bool,
    y: int,
    first: int,
    length: int,
    parameters: PairParameters,
    segment: SegmentBuffers,
    clean: Pointer,
    counts: Pointer,
) -> None:
    """Fill one segment of the clean frame's row ``y``, before and after rounding, and update its counts.

    The buffers hold it from index ``first`` on; ``clean`` receives the ``length`` rounded values.
    """
    after, blocks = first + length, (first + length + BLOCK - 1) // BLOCK
    fill_signal(codes, is_uint8, y, length, parameters, pointer_to(segment.signal, first))
    of_row = (y & 1) * LONG_SEGMENT + (first & 1)
    gains = load(pointer_to(parameters.site_gains, of_row), _0)
    fills_blocks = length == blocks * BLOCK
    target = clean if fills_blocks else segment.clean
    has_negative, has_bright = fill_linear(blocks, gains, parameters, segment, target)
    if has_negative:
        counts[0] += count_negative(first, after, segment.signal)
    if has_bright:
        headroom = load(pointer_to(parameters.site_headroom, of_row), _0)
        recompute_bright(blocks, gains, headroom, parameters, segment, target)
        _count_bright((first, after), parameters, segment, counts)
    if not fills_blocks:
        copy_values(length, pointer_to(segment.clean, first), clean)


@inner
def fill_signal(codes: Pointer, is_uint8: bool, y: int, length: int, parameters: PairParameters, out: Pointer) -> None:
    """Linearise codes of row ``y`` and apply the matrix, for the channel of each site.

    With ``gray_mean``, also invert the gains. ``parameters`` come from `parameter_pointers`.
    """
    if parameters.gray_mean:
        _fill_gray_mean_signal(codes, y, length, parameters, out)
    else:
        even, odd = row_products(parameters.products, parameters.code_count, parameters.site_channels, y)
        sum_products(codes, even, odd, parameters.code_count, length, is_uint8, out)


@inner
def row_products(products: Pointer, code_count: int, site_channels: Pointer, y: int) -> tuple[Pointer, Pointer]:
    """Return pointers to the products of the even and of the odd sites of row ``y``, in any precision."""
    even, odd = site_channels[2 * (y & 1)], site_channels[2 * (y & 1) + 1]
    return pointer_to(products, 3 * code_count * even), pointer_to(products, 3 * code_count * odd)


@inner
def sum_products(
    codes: Pointer, even: Pointer, odd: Pointer, code_count: int, length: int, is_uint8: bool, signal: Pointer
) -> None:
    """Sum the three products of each pixel of a row: ``even`` for even columns, ``odd`` for odd ones."""
    done = 0
    if is_uint8:
        done = length // 4 * 4
        _sum_products_uint8(codes, even, odd, done // 4, signal)
    for x in range(done, length):
        of_site = odd if x & 1 else even
        r, g, b = np.int64(codes[3 * x]), np.int64(codes[3 * x + 1]), np.int64(codes[3 * x + 2])
        signal[x] = (of_site[r] + of_site[code_count + g]) + of_site[2 * code_count + b]


@inner
def _sum_products_uint8(codes: Pointer, even: Pointer, odd: Pointer, fours: int, signal: Pointer) -> None:
    """Sum the products of four pixels at a time: three loads give their codes, and loads limit the speed."""
    for four in range(fours):
        x = np.uint64(four) * _4
        at = _3 * x
        first, second = load_four_bytes(codes, at), load_four_bytes(codes, at + _4)
        third = load_four_bytes(codes, at + _8)
        r, g, b = first & _BYTE, (first >> _S8) & _BYTE, (first >> _S16) & _BYTE
        signal[x] = (even[r] + even[_G + g]) + even[_B + b]
        r, g, b = first >> _S24, second & _BYTE, (second >> _S8) & _BYTE
        signal[x + _1] = (odd[r] + odd[_G + g]) + odd[_B + b]
        r, g, b = (second >> _S16) & _BYTE, second >> _S24, third & _BYTE
        signal[x + _2] = (even[r] + even[_G + g]) + even[_B + b]
        r, g, b = (third >> _S8) & _BYTE, (third >> _S16) & _BYTE, third >> _S24
        signal[x + _3] = (odd[r] + odd[_G + g]) + odd[_B + b]


@inner
def _fill_gray_mean_signal(codes: Pointer, y: int, length: int, parameters: PairParameters, out: Pointer) -> None:
    """Linearise, apply the matrix, and invert the gains with highlights preserved by the mean of the channels."""
    products, gains, threshold = parameters.products, parameters.inverse_gains, parameters.highlight_threshold
    channel = 3 * parameters.code_count
    for x in range(length):
        r, g, b = np.int64(codes[3 * x]), np.int64(codes[3 * x + 1]), np.int64(codes[3 * x + 2])
        g, b = parameters.code_count + g, 2 * parameters.code_count + b
        red = (products[r] + products[g]) + products[b]
        green = (products[channel + r] + products[channel + g]) + products[channel + b]
        blue = (products[2 * channel + r] + products[2 * channel + g]) + products[2 * channel + b]
        m = max(((red + green) + blue) / 3.0 - threshold, 0.0) / (1.0 - threshold)
        mask = m * m
        c = parameters.site_channels[2 * (y & 1) + (x & 1)]
        i = red if c == 0 else green if c == 1 else blue
        out[x] = i * max(mask + (1.0 - mask) * gains[c], gains[c])


@inner
def fill_linear(
    blocks: int, gains: Vector, parameters: PairParameters, segment: SegmentBuffers, clean: Pointer
) -> tuple[bool, bool]:
    """Compute the clean frame as if no signal were bright; return whether any is negative, whether any is bright."""
    black, span, _ = parameters.levels_dn
    exposure = parameters.exposure
    lowest = highest = load(segment.signal, _0)
    for n in range(blocks * (BLOCK // VECTOR_WIDTH)):
        x = np.uint64(n) * _8
        i = load(segment.signal, x)
        lowest, highest = minimum(lowest, i), maximum(highest, i)
        _store_clean(maximum(i * gains * exposure, 0.0) * span + black, x, segment, clean)
    return movemask(less_than(lowest, 0.0)) != 0, movemask(less_than(parameters.linear_limit, highest)) != 0


@inner
def recompute_bright(
    blocks: int,
    gains: Vector,
    headroom: Vector,
    parameters: PairParameters,
    segment: SegmentBuffers,
    clean: Pointer,
) -> None:
    """Recompute blocks that contain a bright signal as `fill_scene_light` and `fill_clean_from_light` do.

    ``segment.bright_light`` receives their light, and 0 in other blocks.
    """
    black, span, _ = parameters.levels_dn
    threshold, exposure, brightest = parameters.highlight_threshold, parameters.exposure, parameters.brightest
    limit = np.inf if exposure == 1.0 else 1.0
    for block in range(blocks):
        highest = load(segment.signal, np.uint64(block * BLOCK))
        for n in range(block * (BLOCK // VECTOR_WIDTH), (block + 1) * (BLOCK // VECTOR_WIDTH)):
            highest = maximum(highest, load(segment.signal, np.uint64(n) * _8))
        is_bright = movemask(less_than(parameters.linear_limit, highest)) != 0
        for n in range(block * (BLOCK // VECTOR_WIDTH), (block + 1) * (BLOCK // VECTOR_WIDTH)):
            x = np.uint64(n) * _8
            i = load(segment.signal, x)
            if is_bright:
                m = maximum(i - threshold, 0.0) / (1.0 - threshold)
                light = minimum(i * gains + i * (m * m) * headroom, limit) * exposure
                store(segment.bright_light, x, light)
                _store_clean(minimum(maximum(light, 0.0), brightest) * span + black, x, segment, clean)
            else:
                store(segment.bright_light, x, i * 0.0)


@inner
def _store_clean(dn: Vector, x: np.uint64, segment: SegmentBuffers, clean: Pointer) -> None:
    """Store eight clean values: unrounded, rounded, their difference, and as uint16."""
    rounded = (dn + ROUND) - ROUND
    rounded_dn = to_float32(rounded)
    store(segment.unrounded_dn, x, dn)
    store(segment.rounded_dn, x, rounded_dn)
    store(segment.residual_dn, x, to_float32(dn - rounded))
    store(clean, x, to_uint32(rounded_dn))


@inner
def count_negative(first: int, after: int, signal: Pointer) -> int:
    """Count signals below black at indices ``first`` to ``after - 1``."""
    count = 0
    for x in range(first, after):
        count += signal[x] < 0.0
    return count


@inner
def _count_bright(valid: tuple[int, int], parameters: PairParameters, segment: SegmentBuffers, counts: Pointer) -> None:
    """Count sites above the brightest light, and saturated ones."""
    last, brightest = parameters.levels_dn[2] + ROUND, parameters.brightest
    above = saturated = 0
    for x in range(valid[0], valid[1]):
        above += segment.bright_light[x] > brightest
        saturated += segment.unrounded_dn[x] + ROUND == last
    counts[1] += above
    counts[4] += saturated


@inner
def fill_scene_light(signal: Float, gains: Float, headroom: Float, parameters: PairParameters, out: Float) -> None:
    """Invert the gains with highlights preserved per channel (unless ``headroom`` is 0), and apply the exposure."""
    threshold, exposure = parameters.highlight_threshold, parameters.exposure
    limit = np.inf if exposure == 1.0 else 1.0  # clip at white first; otherwise light above white would reappear
    for x in range(signal.shape[0]):
        i = signal[x]
        m = max(i - threshold, 0.0) / (1.0 - threshold)
        out[x] = min(i * gains[x] + i * (m * m) * headroom[x], limit) * exposure


@inner
def fill_clean_from_light(
    light: Float, parameters: PairParameters, unrounded_dn: Float, clean: Raw, counts: NDArray[np.int64]
) -> None:
    """Clip light to [0, brightest], convert it to DN, round, and count; all arrays ``[n]``."""
    black, span, white = parameters.levels_dn
    brightest = parameters.brightest
    below, above, saturated = 0, 0, 0
    for x in range(light.shape[0]):
        below += light[x] < 0.0
        above += light[x] > brightest
        dn = min(max(light[x], 0.0), brightest) * span + black
        rounded = (dn + ROUND) - ROUND
        saturated += rounded == white
        clean[x] = np.uint16(np.int32(rounded))
        unrounded_dn[x] = dn
    counts[0] += below
    counts[1] += above
    counts[4] += saturated
