"""Compute the clean frame from sRGB codes: linearise, apply the matrix, invert white balance, convert to DN, round.

Products of each matrix entry and each code are tabulated, so a site's signal is the sum of three look-ups. Only the
channel recorded at each CFA site is computed (all three for ``highlight="gray_mean"``).

The first pass over a strip treats every site as unclipped. The second recomputes vectors that contain a signal above
`Unprocessing.limits`: highlights, clipped or saturated values. Other vectors need neither its division nor its counts.

Two forms: `Unprocessing` is equal to `reference.unprocess` and `reference.sensor.to_dn` to the last bit (float64, in
the reference's order of operations). `Unprocessing32` (float32, of the tier ``fast``) tabulates products that include
gains, exposure and span, so sums of them are DN above the black level; see `FLOAT32_CLEAN_DN`. `LinearLight` and
`LinearLight32` take the light of linear sources in place of codes: products are computed, in float64, and light above
white stays in the unrounded clean frame, from which noise follows.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.sequences import add_in_order
from unprocess_gen.simulation.kernels import simd, strips
from unprocess_gen.simulation.kernels.jit import by_class, inner, kernel
from unprocess_gen.simulation.kernels.rounding import ROUND, ROUND32
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, Pointer, Vector
from unprocess_gen.simulation.kernels.site_patterns import EQUAL_RESPONSE
from unprocess_gen.simulation.kernels.strips import Buffers, SiteMap, Strip, count_outside, strip_values
from unprocess_gen.simulation.plan import MOST_LIGHT, Plan
from unprocess_gen.simulation.profiles import light_tables
from unprocess_gen.simulation.reference.cfa import tile
from unprocess_gen.simulation.reference.colour import Matrix
from unprocess_gen.simulation.reference.primaries import light_colours

_0, _8 = np.uint64(0), np.uint64(8)
_ROW_SITES = VECTOR_WIDTH + 2

FLOAT32_MARGIN = 2.0**-18
"""Largest relative error of white in float32, a quarter DN at 16 bits; light above white by less is not clipped."""

FLOAT32_CLEAN_DN, FLOAT32_CHANGED_SHARE = 1.0, 5e-4
"""Largest error of a clean value in float32, DN, and fraction of the values that differ, at 14 bits."""

MAX_ERROR_GAIN, MAX_HIGHLIGHT_ERROR_GAIN = 8.0, 64.0
"""Largest factors by which the rounding error of a table entry may grow in a clean value for these errors to hold. The
cameras and gains of ``conf/`` reach 3, and 20 in highlights at the default threshold."""


def is_steep(plan: Plan) -> bool:
    """True if the colours and gains of a plan amplify rounding errors too much for float32.

    The light of a channel is i · (gain + headroom · m²) with m = (i - threshold) / (1 - threshold). Here i is the sum
    of table entries times one row of the matrix. The limits are `MAX_ERROR_GAIN` and `MAX_HIGHLIGHT_ERROR_GAIN`.
    """
    camera, isp, exposure = plan.camera, plan.isp, plan.scene.exposure
    if plan.source.is_raw:  # its light has no colours and gains
        return exposure > MAX_ERROR_GAIN
    matrix, inverse_gains = light_colours(plan.source, camera)
    rows = [add_in_order(map(abs, matrix[start : start + 3])) * exposure for start in (0, 3, 6)]
    highlights = 0.0 if isp.highlight == "none" else 1 + 2 / (1 - isp.highlight_threshold)
    return any(
        row * gain > MAX_ERROR_GAIN or row * (gain + max(1 - gain, 0.0) * highlights) > MAX_HIGHLIGHT_ERROR_GAIN
        for row, gain in zip(rows, inverse_gains, strict=True)
    )


# ----------------------------------------------------------------------------------------------------------- parameters


class Unprocessing(NamedTuple):
    """Parameters of a clean frame in float64."""

    # [3, 3, codes]: matrix entry (c, j) times the curve at code k; [4, 3, codes] of raw sources; [3, 4] of linear ones
    products: NDArray[Any]
    code_count: int
    site_channels: NDArray[np.int64]  # [2, VECTOR_WIDTH + 2]: channel of each CFA site; of raw sources its plane
    inverse_gains: NDArray[Any]  # [3]
    gray_mean: bool
    highlight_threshold: float
    divisor: float  # of the highlight term, 1 - threshold; or 1, and ``steepness`` is its reciprocal
    steepness: float
    one: float  # 1 and 3 in the precision of the frame
    three: float
    exposure: float
    darkest: float
    brightest: float
    clipped: float  # light above it counts as clipped
    white: float  # light above it counts as clipped before the exposure; infinity if none is
    clean_dn: float  # highest clean value of linear sources, rounded; in float32 above black
    black_dn: Any  # float, or uint32 in Unprocessing32
    span_dn: float
    dn_per_signal: float  # scale of the signal with gray_mean
    limits: NDArray[Any]  # [2, VECTOR_WIDTH + 2]: signals up to it are neither highlights nor clipped nor saturated
    light_per_signal: NDArray[Any]  # [2, VECTOR_WIDTH + 2]: 1 in float64
    gains: NDArray[Any]  # [2, VECTOR_WIDTH + 2]: of the sites of even and of odd rows; 1 with gray_mean
    headroom: NDArray[Any]  # [2, VECTOR_WIDTH + 2]: factor of the per-channel highlight term, or 0
    response: SiteMap  # relative gain of each pixel; in float64 only


class Unprocessing32(Unprocessing):
    """Parameters of a clean frame in float32; DN count from black, ``darkest`` and ``clipped`` have a margin.

    ``products`` are scaled to DN, except with gray_mean, which compares channels.
    """


class LinearLight(Unprocessing):
    """Parameters of a clean frame of a linear source in float64.

    A row of ``products`` has the entries of the matrix and the largest signal: light above `MOST_LIGHT` by far, which
    keeps the first pass finite. ``white`` is `MOST_LIGHT`.
    """


class LinearLight32(Unprocessing32):
    """Parameters of a clean frame of a linear source in float32, as `LinearLight`."""


KINDS = (Unprocessing, Unprocessing32), (LinearLight, LinearLight32)
"""Records of codes and of light, each in float64 and in float32."""


def unprocessing_of(plan: Plan, codes: int, origin: tuple[int, int], in_float32: bool = False) -> Unprocessing:
    """Numbers of a clean frame from ``codes`` codes, or from light, in float64 or float32."""
    is_raw = plan.source.is_raw
    kind: type[Unprocessing] = KINDS[plan.source.is_linear][in_float32]
    channels = _site_channels(plan.sensor.pattern, origin[0] % 2, origin[1] % 2, is_raw)
    f: Any = np.float32 if in_float32 else float
    exposure, brightest, threshold = plan.scene.exposure, plan.brightest, plan.isp.highlight_threshold
    black_dn, span_dn = plan.sensor.black_level_dn, float(plan.sensor.span_dn)
    matrix, inverse_gains = light_colours(plan.source, plan.camera)
    gray_mean = plan.isp.highlight == "gray_mean" and not is_raw
    # of the channels that remain: `_fill_gray_mean_signal` has inverted the gains already
    gains = (1.0, 1.0, 1.0, 1.0) if is_raw else (1.0, 1.0, 1.0) if gray_mean else inverse_gains
    has_term = plan.isp.highlight == "per_channel"
    limit = _linear_limit(plan, brightest, exposure, max(gains))
    if has_term and min(gains) < 1:
        limit = min(limit, threshold)
    ones = (1.0,) * len(gains)
    scale = tuple([gain * exposure * span_dn for gain in gains]) if in_float32 else ones
    sites = np.empty((4, *channels.shape), dtype=f)
    _fill_sites(gains, scale, limit, has_term, channels, sites)
    limits, light_per_signal, site_gains, headroom = sites
    return kind(
        products=_products(plan, codes, matrix, gains, ones if gray_mean else scale, f),
        code_count=codes,
        site_channels=channels,
        inverse_gains=np.array(inverse_gains, dtype=f),
        gray_mean=gray_mean,
        highlight_threshold=f(threshold),
        divisor=f(1 if in_float32 else 1 - threshold),
        steepness=f(1 / (1 - threshold) if in_float32 else 1),
        one=f(1),
        three=f(3),
        exposure=f(exposure),
        darkest=f(plan.darkest * (1 + FLOAT32_MARGIN) if in_float32 else plan.darkest),
        brightest=f(brightest),
        clipped=f(brightest * (1 + FLOAT32_MARGIN) if in_float32 else brightest),
        white=f(_white_of(plan, in_float32)),
        clean_dn=f(brightest * span_dn if in_float32 else round(plan.brightest_dn)),
        black_dn=np.uint32(black_dn) if in_float32 else float(black_dn),
        span_dn=f(span_dn),
        dn_per_signal=f(exposure * span_dn if in_float32 else 1.0),
        limits=limits,
        light_per_signal=light_per_signal,
        gains=site_gains,
        headroom=headroom,
        response=EQUAL_RESPONSE,
    )


def _white_of(plan: Plan, in_float32: bool) -> float:
    """Return the light that counts as clipped before the exposure, or the most light of a linear source."""
    if plan.source.is_linear:
        return MOST_LIGHT
    return np.inf if plan.scene.exposure == 1 else 1 + FLOAT32_MARGIN if in_float32 else 1.0


def _linear_limit(plan: Plan, brightest: float, exposure: float, gain: float) -> float:
    """Return a signal up to which no site is clipped or saturated, with a margin for rounding errors."""
    light = min(brightest * 0.999, brightest - 1 / plan.sensor.span_dn)
    if light < 0:  # black rounds to the DN of the full well, so all sites count as saturated
        return -np.inf
    most = np.inf if plan.source.is_linear else 1.0
    return min(most, light / exposure) / gain * 0.999


def _products(
    plan: Plan, codes: int, matrix: Matrix, gains: tuple[float, ...], scale: tuple[float, ...], dtype: Any
) -> NDArray[Any]:
    """Return each entry of the matrix times the light of each code, in the scale of its channel."""
    if plan.source.is_raw:
        return np.asarray(_raw_products(plan, codes) * np.array(scale)[:, None, None], dtype)
    if plan.source.is_linear:
        largest = 2 * MOST_LIGHT / (np.array(gains) * plan.scene.exposure)
        return np.asarray(np.column_stack([np.reshape(matrix, (3, 3)), largest]) * np.array(scale)[:, None])
    products = np.empty((3, 3, codes), dtype)
    curves = light_tables(plan.source.profile, plan.isp.tone, plan.isp.gamma, codes)
    _fill_products(matrix, curves, scale, products)
    return products


# Live pairs with new colours prepare these for every crop: in NumPy they would take a tenth of a crop of 128 x 128.


@kernel
def _fill_products(
    matrix: Matrix, curves: tuple[NDArray[np.float64], ...], scale: tuple[float, ...], products: NDArray[Any]
) -> None:
    for channel in range(3):
        for entry in range(3):
            curve = curves[entry]
            for code in range(curve.size):
                products[channel, entry, code] = matrix[3 * channel + entry] * curve[code] * scale[channel]


@kernel
def _fill_sites(
    gains: tuple[float, ...],
    scale: tuple[float, ...],
    limit: float,
    has_term: bool,
    channels: NDArray[np.int64],
    sites: NDArray[Any],
) -> None:
    """Fill ``sites`` with limit, light per signal, gain and headroom of each site, from the numbers of its channel."""
    for row in range(channels.shape[0]):
        for column in range(channels.shape[1]):
            gain, dn_per_light = gains[channels[row, column]], scale[channels[row, column]]
            sites[0, row, column] = limit * dn_per_light
            sites[1, row, column] = 1 / dn_per_light
            sites[2, row, column] = gain
            sites[3, row, column] = max(1 - gain, 0.0) if has_term else 0.0


def _raw_products(plan: Plan, codes: int) -> NDArray[np.float64]:
    """Return the light of each code of a raw source by plane, which depends on the channel of its filter alone."""
    products = np.zeros((4, 3, codes))
    for plane, (black, white) in enumerate(zip(*plan.source.code_levels, strict=True)):
        products[plane, (plane + 1) // 2] = (np.arange(codes) - black) / (white - black)
    return products


def with_response(inverse: Unprocessing, response: SiteMap) -> Unprocessing:
    """Return the numbers of a clean frame whose light is multiplied by a response."""
    # the second pass computes every vector, because only it applies the response
    return inverse._replace(response=response, limits=np.full_like(inverse.limits, -np.inf))


@functools.lru_cache(maxsize=16)
def _site_channels(pattern: str, top: int, left: int, planes: bool) -> NDArray[np.int64]:
    """Return the channel, or the packed plane, of the sites of an even and an odd row, ``[2, VECTOR_WIDTH + 2]``."""
    sites = np.array(tile(pattern, (top, left)))
    if planes:
        sites = np.where(sites == 2, 3, np.where((sites == 1) & ~(sites == 0).any(axis=1, keepdims=True), 2, sites))
    return np.tile(sites, (1, VECTOR_WIDTH // 2 + 1))


@inner
def _load_sites(values: Pointer, strip: Strip) -> Vector:
    """Load the values of eight sites from column ``first`` of the strip's row on (`_site_channels`)."""
    return simd.load(values, np.uint64((strip.y & 1) * _ROW_SITES + (strip.first & 1)))


# --------------------------------------------------------------------------------------------------------------- signal


@inner
def _fill_signal_of_codes(inverse: Any, codes: Pointer, strip: Strip, signal: Pointer) -> None:
    """Linearise codes and apply the matrix, for the channel of each site: sum three products."""
    channels, code_count = simd.pointer_to(inverse.site_channels, _ROW_SITES * (strip.y & 1)), inverse.code_count
    even = simd.pointer_to(inverse.products, 3 * code_count * channels[0])
    odd = simd.pointer_to(inverse.products, 3 * code_count * channels[1])
    for x in range(strip.length):
        table = odd if x & 1 else even
        r, g, b = np.int64(codes[3 * x]), np.int64(codes[3 * x + 1]), np.int64(codes[3 * x + 2])
        signal[x] = (table[r] + table[code_count + g]) + table[2 * code_count + b]


@inner
def _fill_signal_of_light(inverse: Any, light: Pointer, strip: Strip, signal: Pointer) -> None:
    """Apply the matrix to light, for the channel of each site."""
    channels = simd.pointer_to(inverse.site_channels, _ROW_SITES * (strip.y & 1))
    even, odd = simd.pointer_to(inverse.products, 4 * channels[0]), simd.pointer_to(inverse.products, 4 * channels[1])
    for x in range(strip.length):
        row = odd if x & 1 else even
        r, g, b = np.float64(light[3 * x]), np.float64(light[3 * x + 1]), np.float64(light[3 * x + 2])
        value = (row[0] * r + row[1] * g) + row[2] * b
        signal[x] = simd.maximum(simd.minimum(value, row[3]), -row[3])


_fill_signal = by_class({Unprocessing: _fill_signal_of_codes, LinearLight: _fill_signal_of_light,
                         LinearLight32: _fill_signal_of_light})  # fmt: skip
"""Fill the signal of a strip; arguments: numbers of the clean frame, pixels, strip, signal."""


@inner
def _fill_gray_mean_signal(codes: Pointer, strip: Strip, inverse: Any, out: Pointer) -> None:
    """Linearise, apply the matrix, and invert the gains with highlights preserved by the mean of the channels."""
    products, gains = inverse.products, inverse.inverse_gains
    channel = 3 * inverse.code_count
    for x in range(strip.length):
        r, g, b = np.int64(codes[3 * x]), np.int64(codes[3 * x + 1]), np.int64(codes[3 * x + 2])
        g, b = inverse.code_count + g, 2 * inverse.code_count + b
        red = (products[r] + products[g]) + products[b]
        green = (products[channel + r] + products[channel + g]) + products[channel + b]
        blue = (products[2 * channel + r] + products[2 * channel + g]) + products[2 * channel + b]
        gray = ((red + green) + blue) / inverse.three - inverse.highlight_threshold
        m = simd.maximum(gray, 0.0) / inverse.divisor * inverse.steepness
        mask, rest = m * m, inverse.one - m * m
        c = inverse.site_channels[_ROW_SITES * (strip.y & 1) + (x & 1)]
        i = red if c == 0 else green if c == 1 else blue
        out[x] = i * simd.maximum(mask + rest * gains[c], gains[c]) * inverse.dn_per_signal


# ------------------------------------------------------------------------------------------------- float64 and float32


@inner
def _store_clean64(inverse: Unprocessing, above_black: Vector, x: np.uint64, buffers: Buffers) -> None:
    """Store eight clean values: unrounded, rounded, their difference, and as uint16."""
    dn = above_black + inverse.black_dn
    rounded = (dn + ROUND) - ROUND
    rounded_dn = simd.to_float32(rounded)
    simd.store(buffers.unrounded_dn, x, dn)
    simd.store(buffers.rounded_dn, x, rounded_dn)
    simd.store(buffers.residual_dn, x, simd.to_float32(dn - rounded))
    simd.store(buffers.clean, x, simd.to_uint32(rounded_dn))


@inner
def _store_clean32(inverse: Unprocessing32, above_black: Vector, x: np.uint64, buffers: Buffers) -> None:
    """Store eight clean values: DN above black, and as uint16."""
    simd.store(buffers.unrounded_dn, x, above_black)
    simd.store(buffers.clean, x, simd.to_bits(above_black + ROUND32) + inverse.black_dn)


@inner
def _store_linear64(inverse: LinearLight, above_black: Vector, x: np.uint64, buffers: Buffers) -> None:
    """Store eight values of light as `_store_clean64` does; only the clean frame is clipped."""
    dn = above_black + inverse.black_dn
    rounded = (dn + ROUND) - ROUND
    simd.store(buffers.unrounded_dn, x, dn)
    simd.store(buffers.rounded_dn, x, simd.to_float32(rounded))
    simd.store(buffers.residual_dn, x, simd.to_float32(dn - rounded))
    simd.store(buffers.clean, x, simd.to_uint32(simd.to_float32(simd.minimum(rounded, inverse.clean_dn))))


@inner
def _store_linear32(inverse: LinearLight32, above_black: Vector, x: np.uint64, buffers: Buffers) -> None:
    """Store eight values of light as `_store_clean32` does; only the clean frame is clipped."""
    simd.store(buffers.unrounded_dn, x, above_black)
    clipped = simd.minimum(above_black, inverse.clean_dn)
    simd.store(buffers.clean, x, simd.to_bits(clipped + ROUND32) + inverse.black_dn)


_store_clean = by_class(
    {
        Unprocessing: _store_clean64,
        Unprocessing32: _store_clean32,
        LinearLight: _store_linear64,
        LinearLight32: _store_linear32,
    }
)
"""Store eight clean values, given as DN above black."""
_linear_dn = by_class(
    {
        Unprocessing: lambda inverse, signal, gains: (
            simd.maximum(signal * gains * inverse.exposure, inverse.darkest) * inverse.span_dn
        ),
        Unprocessing32: lambda inverse, signal, gains: simd.maximum(signal, inverse.darkest * inverse.span_dn),
    }
)
"""Return DN above black of signals that are not bright."""
_with_response = by_class(
    {
        Unprocessing: lambda inverse, light, x, strip: (
            light * simd.to_float64(simd.load(strip_values(inverse.response, strip), x))
        ),
        Unprocessing32: lambda inverse, light, x, strip: light,
    }
)
"""Return eight values of light times the response."""


# ---------------------------------------------------------------------------------------------------------- clean frame


@inner
def fill_clean(inverse: Any, codes: Pointer, strip: Strip, buffers: Buffers, counts: Pointer) -> bool:
    """Fill one strip of the clean frame, before and after rounding, and update the counts of clipped sites.

    Return whether any site can be saturated.
    """
    signal = simd.pointer_to(buffers.signal, strip.first)
    if inverse.gray_mean:
        _fill_gray_mean_signal(codes, strip, inverse, signal)
    else:
        _fill_signal(inverse, codes, strip, signal)
    has_negative, has_bright = _fill_linear(inverse, strip, buffers)
    if has_bright:
        counts[strips.LIGHT_HIGH] += _recompute_bright(inverse, strip, buffers)
        counts[strips.CLEAN_HIGH] += count_outside(strip, buffers.bright_light, 0.0, inverse.clipped)[1]
    if has_negative:
        exposure = inverse.light_per_signal[0] * inverse.exposure  # of raw sources; of others the sign is enough
        if inverse.response.steps[1]:
            counts[strips.CLEAN_LOW] += _count_below(strip, buffers.bright_light, inverse.one, inverse.darkest)
        else:
            counts[strips.CLEAN_LOW] += _count_below(strip, buffers.signal, exposure, inverse.darkest)
    return bool(has_bright)


@inner
def _count_below(strip: Strip, values: Pointer, factor: float, low: float) -> int:
    """Return the number of values of a strip that are below a limit once multiplied."""
    below = 0
    for x in range(strip.first, strip.after):
        below += values[x] * factor < low
    return below


@inner
def _count_above(strip: Strip, values: Pointer, n: int, high: float) -> int:
    """Return the number of values of a strip, in its n-th vector, that are above a limit."""
    above = 0
    for site in range(n * VECTOR_WIDTH, (n + 1) * VECTOR_WIDTH):
        if strip.first <= site < strip.after:
            above += values[site] > high
    return above


@inner
def _fill_linear(inverse: Any, strip: Strip, buffers: Buffers) -> tuple[bool, bool]:
    """Compute the clean frame as if no signal were bright; return whether any is negative, whether any is bright."""
    gains, limits = _load_sites(inverse.gains, strip), _load_sites(inverse.limits, strip)
    lowest = highest = simd.load(buffers.signal, _0)
    for n in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        signal = simd.load(buffers.signal, x)
        lowest, highest = simd.minimum(lowest, signal), simd.maximum(highest, signal)
        _store_clean(inverse, _linear_dn(inverse, signal, gains), x, buffers)
    return simd.has_any_bit(simd.less_than(lowest, 0.0)), simd.has_any_bit(simd.less_than(limits, highest))


@inner
def _recompute_highlights(inverse: Any, strip: Strip, buffers: Buffers) -> int:
    """Recompute vectors that contain a bright signal: highlights per channel, exposure, fixed pattern, clipping.

    ``bright_light`` receives their light, and 0 elsewhere. Return how many sites are above ``inverse.white``.
    """
    above_white = 0
    limits, light_per_signal = _load_sites(inverse.limits, strip), _load_sites(inverse.light_per_signal, strip)
    gains, headroom = _load_sites(inverse.gains, strip), _load_sites(inverse.headroom, strip)
    most = np.inf if inverse.exposure == 1.0 else 1.0  # otherwise light above white would reappear
    for n in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        signal = simd.load(buffers.signal, x)
        if not simd.has_any_bit(simd.less_than(limits, signal)):
            simd.store(buffers.bright_light, x, signal * 0.0)
            continue
        i = signal * light_per_signal
        m = simd.maximum(i - inverse.highlight_threshold, 0.0) / inverse.divisor * inverse.steepness
        light = i * gains + i * (m * m) * headroom
        if inverse.white < np.inf:
            simd.store(buffers.bright_light, x, light)
            above_white += _count_above(strip, buffers.bright_light, n, inverse.white)
        light = _with_response(inverse, simd.minimum(light, most) * inverse.exposure, x, strip)
        simd.store(buffers.bright_light, x, light)
        clipped = simd.minimum(simd.maximum(light, inverse.darkest), inverse.brightest)
        _store_clean(inverse, clipped * inverse.span_dn, x, buffers)
    return above_white


@inner
def _recompute_light(inverse: Any, strip: Strip, buffers: Buffers) -> int:
    """Recompute vectors of a linear source that contain a bright signal: limit of the light, and fixed pattern.

    ``bright_light`` receives their light, and 0 elsewhere. Return how many sites are above ``inverse.white``.
    """
    above_limit = 0
    limits, light_per_signal = _load_sites(inverse.limits, strip), _load_sites(inverse.light_per_signal, strip)
    gains = _load_sites(inverse.gains, strip)
    for n in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(n) * _8
        signal = simd.load(buffers.signal, x)
        if not simd.has_any_bit(simd.less_than(limits, signal)):
            simd.store(buffers.bright_light, x, signal * 0.0)
            continue
        light = signal * light_per_signal * gains * inverse.exposure
        simd.store(buffers.bright_light, x, light)
        above_limit += _count_above(strip, buffers.bright_light, n, inverse.white)
        light = _with_response(inverse, simd.minimum(light, inverse.white), x, strip)
        simd.store(buffers.bright_light, x, light)
        limited = simd.minimum(simd.maximum(light, inverse.darkest), inverse.white)
        _store_clean(inverse, limited * inverse.span_dn, x, buffers)
    return above_limit


_recompute_bright = by_class({Unprocessing: _recompute_highlights, LinearLight: _recompute_light,
                              LinearLight32: _recompute_light})  # fmt: skip
"""Recompute vectors that contain a bright signal; arguments: numbers of the clean frame, strip, buffers."""
