"""The fast form of a pair whose noise is one normal a site: one pass, one channel a site, no full-resolution RGB.

Must give the DN of `pair.reference_pair` everywhere, on every machine. Hence Numba without fastmath (no reordering, no
fused multiply-add), float64, only + - × ÷ √, comparisons, integers and table look-ups, and each formula in the
reference's order of operations.

How it is fast: a row is worked through in runs of `RUN` pixels whose buffers stay in the first-level cache, and each
stage is a loop of its own, so that it becomes vector code. Doubles are taken apart and put together through views of
their bits: 2**52 | j is j as a double, and adding 1.5·2**52 rounds half to even and leaves a whole number in the low
bits; all of it vectorises where the conversion instructions do not exist below AVX-512. What is bright (highlights,
clipped, saturated) is done anew for its blocks of 64, so that all else needs neither the division nor its counts. The
noise's square roots are taken in the loop of Philox, which leaves the divider idle.

Nanoseconds a pixel, AVX2 (Zen 3), one thread of a busy machine: table look-ups and matrix 0.7, the clean frame 0.45
(where it is bright, 1.2 more), Philox with the roots 1.3 (Philox alone 0.8, the roots alone 0.7), normals 1.05, the
read-out 0.3; in all 4.3, where the first form took 6.9. In float32 with straight lines for the normals: a third
less.

Codes of two pixels are loaded at once, 0.2 less than six loads of a byte: loads are what the look-ups wait for.

Tried, in nanoseconds a pixel: normals in float32 without tables (polynomials in √(32 - log2 f) of ninth degree, in the
mantissa of sixth) and the few DN that lie near a rounding edge made again, 4.15 where this form takes 4.4, in the
float32 form 2.9 instead of 3.2: too little for a second form of the noise; normals and read-out in one loop, 2.5
(scalar code) where two take 1.4; the row and the position of a normal stored by Philox's loop instead of one word,
+0.25; Philox on two vectors at once, no gain; runs of 256 pixels, +0.3, as every array that is handed on between
kernels is counted by an atomic addition: slices are made in the outer kernel alone, and inner ones make none (+1.5
before that was seen); the ten rounds of Philox in a function of its own, which is not inlined, +2.8. Before: one loop
for everything (scalar code), a [1024, 4] table instead of three columns for the quadratics, +1; chunks in the outer
loop and rows in the inner, +0.6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.bayer import tile
from unprocess_gen.compiled import eight_bytes, kernel
from unprocess_gen.normals import (
    FIRST_ROW,
    ONE_BITS,
    POSITION_BITS,
    POSITION_MASK,
    TWO52,
    TWO52_BITS,
    normal_quantiles,
)
from unprocess_gen.records import Counts, Float, Pair, Plan, Raw, Srgb
from unprocess_gen.streams import BLOCK, KEY_STEPS, LANES, MULTIPLIERS, ROUNDS, purpose
from unprocess_gen.tables import SEGMENTS, normal_lines

CHUNK = 1024
"""Pixels worked on at a time at most."""
RUN = 512
"""Pixels worked on at a time where a site has one normal: four buffers of 4 kB, beside the tables."""

SEGMENT_BITS = SEGMENTS.bit_length() - 1

_M0, _M1 = (np.uint64(multiplier) for multiplier in MULTIPLIERS)
STEP0, STEP1 = (np.uint64(step) for step in KEY_STEPS)
LOW32, _32 = np.uint64(0xFFFFFFFF), np.uint64(32)
_LOW31, _SIGN = np.uint64(0x7FFFFFFF), np.uint64(0x80000000)
_1 = np.uint64(1)
_EVEN32, _SIGN64 = np.uint64(0xFFFFFFFE), np.uint64(1 << 63)
_LOW16 = np.uint64(0xFFFF)
_BYTE, _8, _16, _24, _40 = np.uint64(0xFF), np.uint64(8), np.uint64(16), np.uint64(24), np.uint64(40)
_ODD_TWO52_BITS = TWO52_BITS | _1
ROUND = 1.5 * 2.0**52

HETEROSCEDASTIC = np.uint64(purpose("heteroscedastic"))


def make_pair(
    srgb: Srgb,
    plan: Plan,
    curve: Float,
    limits_dn: tuple[float, float],
    origin: tuple[int, int] = (0, 0),
) -> Pair:
    """Make a pair of a two-parameter profile with normal noise.

    Arguments as for `pair.make_pair`, with the curve of the source's codes, and the lowest and highest DN of the noisy
    frame. A plan whose methods are those of float32 gets that form, whose errors `methods` states, and any other the
    reference's DN.
    """
    if plan.in_float32:
        return _make_pair32(srgb, plan, curve, limits_dn, origin)
    clean = np.empty(srgb.shape[:2], dtype=np.uint16)
    noisy = np.empty(srgb.shape[:2], dtype=np.uint16)
    counts = np.zeros(6, dtype=np.int64)
    scene = scene_of(plan, curve, srgb.shape, origin)
    frames = (clean, noisy, counts)
    key = key_words(plan.stream_key, plan.level, plan.draw, plan.frame)
    _pair(np.ascontiguousarray(srgb), scene, key, limits_dn, origin, normal_quantiles().quadratics, *frames)
    return Pair(clean, noisy, Counts(*(int(count) for count in counts)))


def unprocess(
    srgb: Srgb, plan: Plan, curve: Float, origin: tuple[int, int] = (0, 0)
) -> tuple[Float, Raw, NDArray[np.int64]]:
    """Make the clean frame alone, for several noisy ones; arguments as for `make_pair`.

    Returns it before rounding, float64 ``[H, W]`` DN, and rounded; and the numbers of `Counts` in their order, of which
    those of the noisy frame are 0.
    """
    unrounded = np.empty(srgb.shape[:2])
    clean = np.empty(srgb.shape[:2], dtype=np.uint16)
    counts = np.zeros(6, dtype=np.int64)
    _unprocess(np.ascontiguousarray(srgb), scene_of(plan, curve, srgb.shape, origin), unrounded, clean, counts)
    return unrounded, clean, counts


def make_noisy(
    unrounded: Float, plan: Plan, limits_dn: tuple[float, float], origin: tuple[int, int] = (0, 0)
) -> tuple[Raw, NDArray[np.int64]]:
    """Make the noisy frame of a clean one that `unprocess` made, by any plan that shares it.

    Returns it and the numbers of `Counts` in their order, of which those of the clean frame are 0.
    """
    noisy = np.empty(unrounded.shape, dtype=np.uint16)
    counts = np.zeros(6, dtype=np.int64)
    scene = scene_of(plan, np.zeros(1), unrounded.shape, origin)  # no code is looked up
    key = key_words(plan.stream_key, plan.level, plan.draw, plan.frame)
    _noisy(unrounded, scene, key, limits_dn, origin, normal_quantiles().quadratics, noisy, counts)
    return noisy, counts


class Scene(NamedTuple):
    """What the clean frame is made with: small arrays and numbers, as the kernels take them."""

    products: Float  # [c, j, k]: matrix entry (c, j) times the curve at code k
    sites: NDArray[np.int64]  # [2, 2]: the channel of each site
    gains: Float
    headroom: Float  # the highlight term, where it applies at all; "gray_mean" has a function of its own
    by_gray: bool
    threshold: float
    dim: float  # signals up to it are neither highlights nor clipped nor saturated
    exposure: float
    brightest: float
    levels_dn: tuple[float, float, float]  # black, white less black, white
    pinned_dn: float  # saturated sites are pinned to it; infinity: they are not
    noise: tuple[float, float]  # variance line


def scene_of(plan: Plan, curve: Float, shape: tuple[int, ...], origin: tuple[int, int]) -> Scene:
    """Gather what the clean frame of a plan is made with; ``curve`` is that of the source's codes."""
    gains = np.array(plan.inverse_gains)
    ccm = np.array(plan.rgb2cam).reshape(3, 3)
    headroom = np.maximum(1 - gains, 0) if plan.highlight == "per_channel" else np.zeros(3)
    by_gray = plan.highlight == "gray_mean"
    black_dn, white_dn = float(plan.black_level_dn), float(plan.white_level_dn)
    return Scene(
        ccm[:, :, None] * curve,
        np.array(tile(plan.pattern, origin)),
        gains,
        headroom,
        by_gray,
        plan.highlight_threshold,
        _dim(plan, 1.0 if by_gray else float(gains.max()), bool(headroom.any())),
        plan.exposure,
        plan.brightest,
        (black_dn, float(plan.white_level_dn - plan.black_level_dn), white_dn),
        plan.brightest_dn if plan.saturated == "pinned" else np.inf,
        plan.variance_line,
    )


def _dim(plan: Plan, highest_gain: float, has_highlights: bool) -> float:
    """Return a signal up to which no site is a highlight, clipped or saturated; a margin is left for the roundings."""
    span_dn = plan.white_level_dn - plan.black_level_dn
    light = min(plan.brightest * 0.999, 1 - 1 / span_dn)
    unclipped = min(1.0, light / plan.exposure) / highest_gain * 0.999
    return min(unclipped, plan.highlight_threshold) if has_highlights else unclipped


Key = tuple[np.uint64, np.uint64, np.uint64, np.uint64]
"""The two words of a Philox key, then what level and draw, and the frame, put into the counter."""


def key_words(key: int, level: int = 0, draw: int = 0, frame: int = 0) -> Key:
    """Return the words of a stream's key and counter, as the kernels take them."""
    return np.uint64(key & 0xFFFFFFFF), np.uint64(key >> 32), np.uint64(level << 12 | draw), np.uint64(frame)


@kernel
def _pair(
    srgb: Srgb,
    scene: Scene,
    key: Key,
    limits_dn: tuple[float, float],
    origin: tuple[int, int],
    quantiles: tuple[Float, Float, Float],
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill ``clean``, ``noisy`` and ``counts`` with the pair of a two-parameter profile."""
    height, width = clean.shape
    signal, unrounded, std = np.empty(RUN), np.zeros(RUN + BLOCK), np.empty(RUN + BLOCK)
    drawn = np.empty(RUN + BLOCK, dtype=np.uint64)
    site_gains, site_headroom = by_site(scene)
    for y in range(height):
        even, odd = _products(scene, y)
        gains, headroom = site_gains[y & 1], site_headroom[y & 1]
        for start in range(0, width, RUN):
            end = min(start + RUN, width)
            first, after, block, blocks = blocks_of(origin[1] + start, end - start)
            row, clean_dn, out = srgb[y, start:end], unrounded[first:after], clean[y, start:end]
            if scene.by_gray:
                fill_signal(row, scene, y, signal)
            else:
                fill_camera(row, even, odd, signal)
            if fill_dim(signal, gains, scene, clean_dn, out, counts):
                fill_bright(signal, gains, headroom, scene, clean_dn, out, counts)
            _fill_draws(key, block, blocks, np.uint64(origin[0] + y), scene, unrounded, std, drawn)
            _add_noise(blocks * BLOCK, unrounded, drawn, quantiles, scene, std)
            digitise(std[first:after], limits_dn, noisy[y, start:end], counts)
            if _may_be_still(scene):
                counts[5] += _still(clean_dn, scene)


@kernel
def _unprocess(srgb: Srgb, scene: Scene, unrounded: Float, clean: Raw, counts: NDArray[np.int64]) -> None:
    """Fill ``unrounded``, ``clean`` and ``counts`` with the clean frame: the first half of `_pair`."""
    height, width = clean.shape
    signal = np.empty(RUN)
    site_gains, site_headroom = by_site(scene)
    for y in range(height):
        even, odd = _products(scene, y)
        gains, headroom = site_gains[y & 1], site_headroom[y & 1]
        for start in range(0, width, RUN):
            end = min(start + RUN, width)
            row, clean_dn, out = srgb[y, start:end], unrounded[y, start:end], clean[y, start:end]
            if scene.by_gray:
                fill_signal(row, scene, y, signal)
            else:
                fill_camera(row, even, odd, signal)
            if fill_dim(signal, gains, scene, clean_dn, out, counts):
                fill_bright(signal, gains, headroom, scene, clean_dn, out, counts)


@kernel
def _noisy(
    clean_dn: Float,
    scene: Scene,
    key: Key,
    limits_dn: tuple[float, float],
    origin: tuple[int, int],
    quantiles: tuple[Float, Float, Float],
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill ``noisy`` and ``counts`` with the noisy frame of an unrounded clean one: the second half of `_pair`."""
    height, width = noisy.shape
    unrounded, std = np.zeros(RUN + BLOCK), np.empty(RUN + BLOCK)
    drawn = np.empty(RUN + BLOCK, dtype=np.uint64)
    for y in range(height):
        for start in range(0, width, RUN):
            end = min(start + RUN, width)
            first, after, block, blocks = blocks_of(origin[1] + start, end - start)
            copy(clean_dn[y, start:end], unrounded[first:after])
            _fill_draws(key, block, blocks, np.uint64(origin[0] + y), scene, unrounded, std, drawn)
            _add_noise(blocks * BLOCK, unrounded, drawn, quantiles, scene, std)
            digitise(std[first:after], limits_dn, noisy[y, start:end], counts)
            if _may_be_still(scene):
                counts[5] += _still(unrounded[first:after], scene)


@kernel
def copy(source: Float, target: Float) -> None:
    """Copy a run; an assignment of slices would be compiled with a logarithm, for its error message."""
    for x in range(target.shape[0]):
        target[x] = source[x]


@kernel
def blocks_of(x: int, length: int) -> tuple[int, int, int, int]:
    """Return where in its blocks a run from pixel ``x`` on begins and ends, and number and count of the blocks."""
    first = x % BLOCK
    after = first + length
    return first, after, x // BLOCK, (after + BLOCK - 1) // BLOCK


@kernel
def _products(scene: Scene, y: int) -> tuple[Float, Float]:
    """Return the products of the even and of the odd sites of a row."""
    return scene.products[scene.sites[y & 1, 0]], scene.products[scene.sites[y & 1, 1]]


@kernel
def by_site(scene: Scene) -> tuple[Float, Float]:
    """Return gains and headroom for each pixel of an even and of an odd row, so that loops over them vectorise."""
    gains = np.empty((2, CHUNK))
    headroom = np.empty((2, CHUNK))
    for y in range(2):
        for x in range(CHUNK):
            gains[y, x] = 1.0 if scene.by_gray else scene.gains[scene.sites[y, x & 1]]  # by gray: inverted already
            headroom[y, x] = scene.headroom[scene.sites[y, x & 1]]
    return gains, headroom


@kernel
def fill_signal(row: Srgb, scene: Scene, y: int, out: Float) -> None:
    """Linearise and apply the matrix; by gray, invert the gains too."""
    if scene.by_gray:
        _fill_light_by_gray(row, scene.products, scene.sites[y & 1], scene.gains, scene.threshold, out)
    else:
        even, odd = _products(scene, y)
        fill_camera(row, even, odd, out)


@kernel
def fill_camera(row: Srgb, even: Float, odd: Float, out: Float) -> None:
    """Linearise and apply the matrix, for the one channel that each site keeps."""
    length = row.shape[0]
    first = 0
    if row.itemsize == 1:
        first = _fill_camera_of_bytes(row, even, odd, out)
    for pair in range(first, length // 2):
        x = 2 * pair
        out[x] = (even[0, row[x, 0]] + even[1, row[x, 1]]) + even[2, row[x, 2]]
        out[x + 1] = (odd[0, row[x + 1, 0]] + odd[1, row[x + 1, 1]]) + odd[2, row[x + 1, 2]]
    if length & 1:
        x = length - 1
        out[x] = (even[0, row[x, 0]] + even[1, row[x, 1]]) + even[2, row[x, 2]]


@kernel
def _fill_camera_of_bytes(row: Srgb, even: Float, odd: Float, out: Float) -> int:
    """Do so for 8-bit codes and all pairs of pixels but the last, whose number is returned: see `eight_bytes`."""
    pairs: int = max(row.shape[0] // 2 - 1, 0)
    for pair in range(pairs):
        x, codes = 2 * pair, eight_bytes(row, 6 * pair)
        r0, g0, b0 = codes & _BYTE, (codes >> _8) & _BYTE, (codes >> _16) & _BYTE
        r1, g1, b1 = (codes >> _24) & _BYTE, (codes >> _32) & _BYTE, (codes >> _40) & _BYTE
        out[x] = (even[0, r0] + even[1, g0]) + even[2, b0]
        out[x + 1] = (odd[0, r1] + odd[1, g1]) + odd[2, b1]
    return pairs


@kernel
def _fill_light_by_gray(
    row: Srgb, products: Float, site: NDArray[np.int64], gains: Float, threshold: float, out: Float
) -> None:
    """Linearise, apply the matrix and invert the gains, highlights kept by the mean of the three channels."""
    for x in range(row.shape[0]):
        r, g, b = row[x, 0], row[x, 1], row[x, 2]
        red = (products[0, 0, r] + products[0, 1, g]) + products[0, 2, b]
        green = (products[1, 0, r] + products[1, 1, g]) + products[1, 2, b]
        blue = (products[2, 0, r] + products[2, 1, g]) + products[2, 2, b]
        m = max(((red + green) + blue) / 3.0 - threshold, 0.0) / (1.0 - threshold)
        mask = m * m
        c = site[x & 1]
        i = red if c == 0 else green if c == 1 else blue
        out[x] = i * max(mask + (1.0 - mask) * gains[c], gains[c])


_Block = tuple[np.uint64, np.uint64, np.uint64, np.uint64]


@kernel
def philox_round(c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64) -> _Block:
    """One round of Philox4x32: four words, each in the low half of what goes in and comes out; the high half is chaff.

    A vector unit multiplies the low halves alone, so that masks before a product are free and all others are not. The
    loop over the rounds stands with the caller: a function that held it would not be inlined, nor made vector code.
    """
    p0 = _M0 * (c0 & LOW32)
    p1 = _M1 * (c2 & LOW32)
    return (p1 >> _32) ^ (c1 ^ k0), p1, (p0 >> _32) ^ (c3 ^ k1), p0


@kernel
def _fill_blocks(
    key: Key,
    first_block: int,
    blocks: int,
    y: np.uint64,
    purpose_word: np.uint64,
    out: NDArray[np.uint64],
) -> None:
    """Philox in the layout of `streams`: one 32-bit word a pixel, whole blocks."""
    for block in range(blocks):
        counter = np.uint64((first_block + block) * LANES)
        at = block * BLOCK
        for lane in range(LANES):
            c0, c1, c2, c3 = counter + np.uint64(lane), y, purpose_word | key[2], key[3]
            k0, k1 = key[0], key[1]
            for _ in range(ROUNDS):
                c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
                k0, k1 = (k0 + STEP0) & LOW32, (k1 + STEP1) & LOW32
            out[at + lane] = c0 & LOW32
            out[at + LANES + lane] = c1 & LOW32
            out[at + 2 * LANES + lane] = c2 & LOW32
            out[at + 3 * LANES + lane] = c3 & LOW32


@kernel
def fill_words(
    key: Key,
    place: tuple[int, int],
    purpose_word: np.uint64,
    length: int,
    words: NDArray[np.uint64],
) -> int:
    """Fill ``words`` with those of a run of pixels from ``place`` on, and return where in it the first one stands."""
    offset = place[1] % BLOCK
    blocks = (offset + length + BLOCK - 1) // BLOCK
    _fill_blocks(key, place[1] // BLOCK, blocks, np.uint64(place[0]), purpose_word, words)
    return int(offset)


@kernel
def fill_normals(
    words: NDArray[np.uint64], quantiles: tuple[Float, Float, Float], bits: NDArray[np.uint64], out: Float
) -> None:
    """Normals by inverse CDF, as `effects.normals`; overwrites the low bits of ``words``."""
    q0, q1, q2 = quantiles
    count = words.shape[0]
    doubles = bits.view(np.float64)
    out_bits = out.view(np.uint64)
    for n in range(count):
        bits[n] = ((words[n] & _LOW31) << _1 | _1) | TWO52_BITS
    for n in range(count):
        doubles[n] = doubles[n] - TWO52
    for n in range(count):
        b = bits[n]
        words[n] = (words[n] & _SIGN) | ((b >> POSITION_BITS) - FIRST_ROW)
        bits[n] = (b & POSITION_MASK) | ONE_BITS
    for n in range(count):
        row = words[n] & _LOW31
        t = doubles[n] - 1.0
        out[n] = q0[row] + t * (q1[row] + t * q2[row])
    for n in range(count):
        out_bits[n] = out_bits[n] ^ ((words[n] & _SIGN) << _32)


@kernel
def fill_dim(signal: Float, gains: Float, scene: Scene, unrounded: Float, clean: Raw, counts: NDArray[np.int64]) -> int:
    """Do `fill_light` and `fill_clean` of signals that are not bright, and return how many are: see `fill_bright`."""
    black, span, _ = scene.levels_dn
    dim, exposure = scene.dim, scene.exposure
    bright, below = 0, 0
    for x in range(clean.shape[0]):
        i = signal[x]
        bright += i > dim
        light = i * gains[x] * exposure
        below += light < 0.0
        dn = max(light, 0.0) * span + black
        clean[x] = _low16(dn + ROUND)
        unrounded[x] = dn
    counts[0] += below
    return bright


@kernel
def fill_bright(
    signal: Float,
    gains: Float,
    headroom: Float,
    scene: Scene,
    unrounded: Float,
    clean: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Do `fill_light` and `fill_clean` anew for the blocks of a run that have something bright in them."""
    black, span, white = scene.levels_dn
    threshold, dim, exposure, brightest = scene.threshold, scene.dim, scene.exposure, scene.brightest
    limit = np.inf if exposure == 1.0 else 1.0
    last = white + ROUND
    above, saturated = 0, 0
    for start in range(0, clean.shape[0], BLOCK):
        end = min(start + BLOCK, clean.shape[0])
        bright = 0
        for x in range(start, end):
            bright += signal[x] > dim
        if bright == 0:
            continue
        for x in range(start, end):
            i = signal[x]
            m = max(i - threshold, 0.0) / (1.0 - threshold)
            light = min(i * gains[x] + i * (m * m) * headroom[x], limit) * exposure
            above += light > brightest
            dn = min(max(light, 0.0), brightest) * span + black
            saturated += dn + ROUND == last
            clean[x] = _low16(dn + ROUND)
            unrounded[x] = dn
    counts[1] += above
    counts[4] += saturated


@kernel
def _low16(rounded: float) -> np.uint16:
    """Return the whole number that `ROUND` was added to."""
    return np.uint16(np.float64(rounded).view(np.uint64) & _LOW16)


@kernel
def fill_light(signal: Float, gains: Float, headroom: Float, scene: Scene, out: Float) -> None:
    """Invert the gains, highlights kept by channel (or not, where ``headroom`` is 0), and darken the scene."""
    threshold, exposure = scene.threshold, scene.exposure
    limit = np.inf if exposure == 1.0 else 1.0  # what the photograph shows as white is white before it is darkened
    for x in range(signal.shape[0]):
        i = signal[x]
        m = max(i - threshold, 0.0) / (1.0 - threshold)
        out[x] = min(i * gains[x] + i * (m * m) * headroom[x], limit) * exposure


@kernel
def fill_clean(light: Float, scene: Scene, unrounded: Float, clean: Raw, counts: NDArray[np.int64]) -> None:
    """Clip, go to DN, round."""
    black, span, white = scene.levels_dn
    brightest = scene.brightest
    below, above, saturated = 0, 0, 0
    for x in range(light.shape[0]):
        below += light[x] < 0.0
        above += light[x] > brightest
        dn = min(max(light[x], 0.0), brightest) * span + black
        rounded = (dn + ROUND) - ROUND
        saturated += rounded == white
        clean[x] = np.uint16(np.int32(rounded))
        unrounded[x] = dn
    counts[0] += below
    counts[1] += above
    counts[4] += saturated


@kernel
def _fill_draws(
    key: Key,
    first_block: int,
    blocks: int,
    y: np.uint64,
    scene: Scene,
    unrounded: Float,
    std: Float,
    drawn: NDArray[np.uint64],
) -> None:
    """Fill ``std`` with the noise's deviation, signed as the draw is, and ``drawn`` with the bits of its 2i + 1.

    Both in one loop: roots keep the divider busy, Philox all the rest.
    """
    a, b = scene.noise
    black = scene.levels_dn[0]
    for block in range(blocks):
        counter = np.uint64((first_block + block) * LANES)
        at = block * BLOCK
        for lane in range(LANES):
            x0 = at + lane
            x1, x2, x3 = x0 + LANES, x0 + 2 * LANES, x0 + 3 * LANES
            std0 = np.sqrt(max(a * (unrounded[x0] - black) + b, 0.0))
            std1 = np.sqrt(max(a * (unrounded[x1] - black) + b, 0.0))
            std2 = np.sqrt(max(a * (unrounded[x2] - black) + b, 0.0))
            std3 = np.sqrt(max(a * (unrounded[x3] - black) + b, 0.0))
            c0, c1, c2, c3 = counter + np.uint64(lane), y, HETEROSCEDASTIC | key[2], key[3]
            k0, k1 = key[0], key[1]
            for _ in range(ROUNDS):
                c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
                k0, k1 = (k0 + STEP0) & LOW32, (k1 + STEP1) & LOW32
            std[x0], drawn[x0] = _signed(std0, c0), _odd_double(c0)
            std[x1], drawn[x1] = _signed(std1, c1), _odd_double(c1)
            std[x2], drawn[x2] = _signed(std2, c2), _odd_double(c2)
            std[x3], drawn[x3] = _signed(std3, c3), _odd_double(c3)


@kernel
def _signed(std: float, word: np.uint64) -> float:
    """Return the number, at least 0, with the sign that a 32-bit word has."""
    return np.uint64(np.float64(std).view(np.uint64) | ((word << _32) & _SIGN64)).view(np.float64)


@kernel
def _odd_double(word: np.uint64) -> np.uint64:
    """Return the bits of 2i + 1 as a double, i being the low 31 bits of a word."""
    shifted = np.uint64(((word << _1) & _EVEN32) | _ODD_TWO52_BITS).view(np.float64)
    return np.float64(shifted - TWO52).view(np.uint64)


@kernel
def _add_noise(
    count: int,
    clean_dn: Float,
    drawn: NDArray[np.uint64],
    quantiles: tuple[Float, Float, Float],
    scene: Scene,
    noisy_dn: Float,
) -> None:
    """Replace signed deviations by the clean frame plus noise; the normal is that of `effects.normals`."""
    q0, q1, q2 = quantiles
    if scene.pinned_dn < np.inf:
        for x in range(count):
            noisy_dn[x] = 0.0 if clean_dn[x] >= scene.pinned_dn else noisy_dn[x]
    for x in range(count):
        row = (drawn[x] >> POSITION_BITS) - FIRST_ROW
        t = np.uint64((drawn[x] & POSITION_MASK) | ONE_BITS).view(np.float64) - 1.0
        noisy_dn[x] = clean_dn[x] + noisy_dn[x] * (q0[row] + t * (q1[row] + t * q2[row]))


@kernel
def digitise(noisy_dn: Float, limits_dn: tuple[float, float], noisy: Raw, counts: NDArray[np.int64]) -> None:
    """Round half to even, clip, cast."""
    low, high = limits_dn[0] + ROUND, limits_dn[1] + ROUND
    below, above = 0, 0
    for x in range(noisy.shape[0]):
        rounded = noisy_dn[x] + ROUND
        below += rounded < low
        above += rounded > high
        noisy[x] = _low16(min(max(rounded, low), high))
    counts[2] += below
    counts[3] += above


@kernel
def _may_be_still(scene: Scene) -> bool:
    return bool(scene.noise[0] < 0.0 or scene.noise[1] <= 0.0)


@kernel
def _still(clean_dn: Float, scene: Scene) -> int:
    """Count sites without variance."""
    a, b = scene.noise
    black = scene.levels_dn[0]
    still = 0
    for x in range(clean_dn.shape[0]):
        still += max(a * (clean_dn[x] - black) + b, 0.0) == 0.0
    return still


@kernel
def read_out(
    unrounded: Float,
    noisy_dn: Float,
    scene: Scene,
    limits_dn: tuple[float, float],
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Pin what is saturated, if so asked; round half to even, clip, cast. Overwrites ``noisy_dn`` where it pins."""
    if scene.pinned_dn < np.inf:
        for x in range(unrounded.shape[0]):
            noisy_dn[x] = scene.pinned_dn if unrounded[x] >= scene.pinned_dn else noisy_dn[x]
    digitise(noisy_dn, limits_dn, noisy, counts)
    if _may_be_still(scene):
        counts[5] += _still(unrounded, scene)


# ----------------------------------------------------------------------------------------------- the form in float32

RUN32 = 1024
"""As `RUN`, of numbers half as long."""

Single = NDArray[np.float32]
Indices = NDArray[np.uint32]

_ROUND32, _SIGN32 = np.float32(1.5 * 2.0**23), np.uint32(1 << 31)
_LOW31_32, _HALF32 = np.uint32(0x7FFFFFFF), np.float32(0.5)
_0F, _1F = np.float32(0), np.float32(1)
_ROW_BITS, _FIRST_LINE = np.uint32(23 - SEGMENT_BITS), np.uint32(126 << SEGMENT_BITS)


class _Scene32(NamedTuple):
    """What of a `Scene` the loops in float32 need; DN count from black on, which is put on when they are whole."""

    threshold: np.float32
    above_threshold: np.float32  # 1 less the threshold
    dim: np.float32
    exposure: np.float32
    limit: np.float32
    brightest: np.float32
    clipped: np.float32  # light above it counts as clipped: that of white is 1 but for the roundings
    span: np.float32
    black: np.uint32
    a: np.float32
    b: np.float32
    pinned_dn: np.float32
    low: np.float32
    high: np.float32


def scene32_of(scene: Scene, limits_dn: tuple[float, float]) -> _Scene32:
    """Return what the loops in float32 need of a scene."""
    black, span, _ = scene.levels_dn
    f = np.float32
    return _Scene32(
        f(scene.threshold), f(1 - scene.threshold), f(scene.dim), f(scene.exposure),
        f(np.inf if scene.exposure == 1 else 1),
        f(scene.brightest), f(scene.brightest * (1 + 2.0**-20)), f(span), np.uint32(black),
        f(scene.noise[0]), f(scene.noise[1]),
        f(scene.pinned_dn - black), f(limits_dn[0] - black), f(limits_dn[1] - black),
    )  # fmt: skip


def _make_pair32(srgb: Srgb, plan: Plan, curve: Float, limits_dn: tuple[float, float], origin: tuple[int, int]) -> Pair:
    clean = np.empty(srgb.shape[:2], dtype=np.uint16)
    noisy = np.empty(srgb.shape[:2], dtype=np.uint16)
    counts = np.zeros(6, dtype=np.int64)
    scene = scene_of(plan, curve, srgb.shape, origin)
    of_site = (np.ones(3) if scene.by_gray else scene.gains)[scene.sites], scene.headroom[scene.sites]
    gains, headroom = (np.tile(one.astype(np.float32), (1, RUN32 // 2)) for one in of_site)
    products = scene.products.astype(np.float32)
    key = key_words(plan.stream_key, plan.level, plan.draw, plan.frame)
    offsets, slopes = normal_lines()
    _pair32(
        np.ascontiguousarray(srgb), products, scene.sites, scene.gains.astype(np.float32), scene.by_gray,
        scene32_of(scene, limits_dn), gains, headroom, key, origin, offsets, slopes, clean, noisy, counts,
    )  # fmt: skip
    return Pair(clean, noisy, Counts(*(int(count) for count in counts)))


@kernel
def _pair32(
    srgb: Srgb,
    products: Single,
    sites: NDArray[np.int64],
    channel_gains: Single,
    by_gray: bool,
    scene: _Scene32,
    site_gains: Single,
    site_headroom: Single,
    key: Key,
    origin: tuple[int, int],
    offsets: Single,
    slopes: Single,
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """`_pair` in float32."""
    height, width = clean.shape
    signal, clean_dn = np.zeros(RUN32, dtype=np.float32), np.zeros(RUN32 + BLOCK, dtype=np.float32)
    std, index = np.empty(RUN32 + BLOCK, dtype=np.float32), np.empty(RUN32 + BLOCK, dtype=np.float32)
    words = np.empty(RUN32 + BLOCK, dtype=np.uint32)
    for y in range(height):
        even, odd = products[sites[y & 1, 0]], products[sites[y & 1, 1]]
        site, gains, headroom = sites[y & 1], site_gains[y & 1], site_headroom[y & 1]
        for start in range(0, width, RUN32):
            end = min(start + RUN32, width)
            first, after, block, blocks = blocks_of(origin[1] + start, end - start)
            if by_gray:
                _fill_light_by_gray32(srgb[y, start:end], products, site, channel_gains, scene, signal)
            else:
                fill_camera(srgb[y, start:end], even, odd, signal)
            unrounded, out = clean_dn[first:after], clean[y, start:end]
            if fill_dim32(signal, gains, scene, unrounded, out, counts):
                fill_bright32(signal, gains, headroom, scene, unrounded, out, counts)
            fill_words32(key, block, blocks, np.uint64(origin[0] + y), words)
            fill_draws32(blocks * BLOCK, words, clean_dn, scene, std, index)
            add_noise32(blocks * BLOCK, clean_dn, index, offsets, slopes, std)
            digitise32(std[first:after], scene, noisy[y, start:end], counts)
            if scene.a < _0F or scene.b <= _0F:
                counts[5] += _still32(unrounded, scene)


@kernel
def _fill_light_by_gray32(
    row: Srgb, products: Single, site: NDArray[np.int64], gains: Single, scene: _Scene32, out: Single
) -> None:
    for x in range(row.shape[0]):
        r, g, b = row[x, 0], row[x, 1], row[x, 2]
        red = (products[0, 0, r] + products[0, 1, g]) + products[0, 2, b]
        green = (products[1, 0, r] + products[1, 1, g]) + products[1, 2, b]
        blue = (products[2, 0, r] + products[2, 1, g]) + products[2, 2, b]
        m = max(((red + green) + blue) / np.float32(3) - scene.threshold, _0F) / scene.above_threshold
        mask = m * m
        c = site[x & 1]
        i = red if c == 0 else green if c == 1 else blue
        out[x] = i * max(mask + (_1F - mask) * gains[c], gains[c])


@kernel
def fill_dim32(
    signal: Single, gains: Single, scene: _Scene32, clean_dn: Single, clean: Raw, counts: NDArray[np.int64]
) -> int:
    """`fill_dim` in float32."""
    dim, exposure, span, black = scene.dim, scene.exposure, scene.span, scene.black
    bright, below = np.int32(0), np.int32(0)
    for x in range(clean.shape[0]):
        i = signal[x]
        bright = np.int32(bright + (i > dim))
        light = i * gains[x] * exposure
        below = np.int32(below + (light < _0F))
        dn = max(light, _0F) * span
        clean[x] = _low16_32(dn + _ROUND32, black)
        clean_dn[x] = dn
    counts[0] += below
    return int(bright)


@kernel
def fill_bright32(
    signal: Single,
    gains: Single,
    headroom: Single,
    scene: _Scene32,
    clean_dn: Single,
    clean: Raw,
    counts: NDArray[np.int64],
) -> None:
    """`fill_bright` in float32, and of all blocks."""
    threshold, above_threshold, exposure, limit = scene.threshold, scene.above_threshold, scene.exposure, scene.limit
    brightest, clipped, span, black = scene.brightest, scene.clipped, scene.span, scene.black
    above, saturated = np.int32(0), np.int32(0)
    last = span + _ROUND32
    for x in range(clean.shape[0]):
        i = signal[x]
        m = max(i - threshold, _0F) / above_threshold
        light = min(i * gains[x] + i * (m * m) * headroom[x], limit) * exposure
        above = np.int32(above + (light > clipped))
        dn = min(max(light, _0F), brightest) * span
        saturated = np.int32(saturated + (dn + _ROUND32 == last))
        clean[x] = _low16_32(dn + _ROUND32, black)
        clean_dn[x] = dn
    counts[1] += above
    counts[4] += saturated


@kernel
def _low16_32(rounded: np.float32, black: np.uint32) -> np.uint16:
    return np.uint16((np.float32(rounded).view(np.uint32) + black) & np.uint32(0xFFFF))


@kernel
def fill_words32(key: Key, first_block: int, blocks: int, y: np.uint64, out: Indices) -> None:
    """`_fill_blocks` for half the memory."""
    for block in range(blocks):
        counter = np.uint64((first_block + block) * LANES)
        at = block * BLOCK
        for lane in range(LANES):
            c0, c1, c2, c3 = counter + np.uint64(lane), y, HETEROSCEDASTIC | key[2], key[3]
            k0, k1 = key[0], key[1]
            for _ in range(ROUNDS):
                c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
                k0, k1 = (k0 + STEP0) & LOW32, (k1 + STEP1) & LOW32
            out[at + lane] = np.uint32(c0 & LOW32)
            out[at + LANES + lane] = np.uint32(c1 & LOW32)
            out[at + 2 * LANES + lane] = np.uint32(c2 & LOW32)
            out[at + 3 * LANES + lane] = np.uint32(c3 & LOW32)


@kernel
def _index32(word: np.uint32) -> np.float32:
    """Return the index of a word's uniform, and a half."""
    return np.float32(np.int32(word & _LOW31_32)) + _HALF32


@kernel
def _line_of(index: np.float32) -> np.uint32:
    """Return the row of `normal_lines`: the octave and segment are the leading bits of a float."""
    return (np.float32(index).view(np.uint32) >> _ROW_BITS) - _FIRST_LINE


@kernel
def fill_line_normals(words: Indices, offsets: Single, slopes: Single, out: Single) -> None:
    """Normals by straight lines, float32, of 32-bit words."""
    for n in range(words.shape[0]):
        index = _index32(words[n])
        line = _line_of(index)
        z = offsets[line] + slopes[line] * index
        out[n] = -z if words[n] >> np.uint32(31) else z


@kernel
def fill_draws32(count: int, words: Indices, clean_dn: Single, scene: _Scene32, std: Single, index: Single) -> None:
    """Fill ``std`` with the noise's deviation, signed as the draw is, and ``index`` with the draw's."""
    a, b, pinned_dn = scene.a, scene.b, scene.pinned_dn
    for x in range(count):
        root = np.sqrt(max(a * clean_dn[x] + b, _0F))
        root = _0F if clean_dn[x] >= pinned_dn else root
        std[x] = np.uint32(np.float32(root).view(np.uint32) | (words[x] & _SIGN32)).view(np.float32)
        index[x] = _index32(words[x])


@kernel
def add_noise32(count: int, clean_dn: Single, index: Single, offsets: Single, slopes: Single, noisy_dn: Single) -> None:
    """Replace signed deviations by the clean frame plus noise."""
    for x in range(count):
        line = _line_of(index[x])
        noisy_dn[x] = clean_dn[x] + noisy_dn[x] * (offsets[line] + slopes[line] * index[x])


@kernel
def digitise32(noisy_dn: Single, scene: _Scene32, noisy: Raw, counts: NDArray[np.int64]) -> None:
    """Round half to even above black, clip, cast."""
    low, high, black = scene.low, scene.high, scene.black
    first, last = low + _ROUND32, high + _ROUND32
    below, above = np.int32(0), np.int32(0)
    for x in range(noisy.shape[0]):
        rounded = min(max(noisy_dn[x], low - _1F), high + _1F) + _ROUND32
        below = np.int32(below + (rounded < first))
        above = np.int32(above + (rounded > last))
        noisy[x] = _low16_32(min(max(rounded, first), last), black)
    counts[2] += below
    counts[3] += above


@kernel
def _still32(clean_dn: Single, scene: _Scene32) -> int:
    a, b = scene.a, scene.b
    still = 0
    for x in range(clean_dn.shape[0]):
        still += max(a * clean_dn[x] + b, _0F) == _0F
    return still
