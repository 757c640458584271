"""The fast form of a pair whose noise is one normal a site: one pass, one channel a site, no full-resolution RGB.

Must give the DN of `pair.reference_pair` everywhere, on every machine. Hence Numba without fastmath (no reordering, no
fused multiply-add), float64, only + - × ÷ √, comparisons, integers and table look-ups, and each formula in the
reference's order of operations.

How it is fast: a row is worked through in chunks of `CHUNK` pixels whose buffers stay in the first-level cache, and
each stage is a loop of its own, so that it becomes vector code. Doubles are taken apart and put together through views
of their bits: 2**52 | j is j as a double, and adding and subtracting 1.5·2**52 rounds half to even; both vectorise
where the conversion instructions do not exist below AVX-512.

Measured on a 2880x2160 photograph, AVX2, one thread, nanoseconds a pixel: table look-ups and matrix 0.9, gains and the
clean frame 0.8, Philox 0.9, normals 1.3, the noisy frame 1.0 (of which the square root 0.7); with the first touch of
the output's memory 5.1. Tried and slower: one loop for everything (scalar code), a [1024, 4] table instead of three
columns for the quadratics (2.3 instead of 1.3), conversions instead of bit views (2.4 instead of 1.3), chunks in the
outer loop and rows in the inner (5.7 in all).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.bayer import tile
from unprocess_gen.compiled import kernel
from unprocess_gen.records import Counts, Float, Pair, Plan, Raw, Srgb
from unprocess_gen.streams import BLOCK, KEY_STEPS, LANES, MULTIPLIERS, ROUNDS, purpose
from unprocess_gen.tables import SEGMENTS, normal_table

CHUNK = 1024
"""Pixels worked on at a time: six buffers of 8 kB."""

SEGMENT_BITS = SEGMENTS.bit_length() - 1

_M0, _M1 = (np.uint64(multiplier) for multiplier in MULTIPLIERS)
_STEP0, _STEP1 = (np.uint64(step) for step in KEY_STEPS)
_LOW32, _32 = np.uint64(0xFFFFFFFF), np.uint64(32)
_LOW31, _SIGN = np.uint64(0x7FFFFFFF), np.uint64(0x80000000)
_1 = np.uint64(1)
_TWO52_BITS, _TWO52 = np.uint64(0x4330000000000000), 2.0**52
_ONE_BITS = np.uint64(0x3FF0000000000000)
_POSITION_BITS = np.uint64(52 - SEGMENT_BITS)
_POSITION_MASK = np.uint64(2 ** (52 - SEGMENT_BITS) - 1)
_FIRST_ROW = np.uint64(1023 << SEGMENT_BITS)
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
    frame.
    """
    clean = np.empty(srgb.shape[:2], dtype=np.uint16)
    noisy = np.empty(srgb.shape[:2], dtype=np.uint16)
    counts = np.zeros(6, dtype=np.int64)
    scene = scene_of(plan, curve, srgb.shape, origin)
    frames = (clean, noisy, counts)
    key = key_words(plan.stream_key, plan.level, plan.draw, plan.frame)
    _pair(np.ascontiguousarray(srgb), scene, key, limits_dn, origin, columns(normal_table()), *frames)
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
    _noisy(unrounded, scene, key, limits_dn, origin, columns(normal_table()), noisy, counts)
    return noisy, counts


class Scene(NamedTuple):
    """What the clean frame is made with: small arrays and numbers, as the kernels take them."""

    products: Float  # [c, j, k]: matrix entry (c, j) times the curve at code k
    sites: NDArray[np.int64]  # [2, 2]: the channel of each site
    gains: Float
    headroom: Float  # the highlight term, where it applies at all; "gray_mean" has a function of its own
    by_gray: bool
    threshold: float
    exposure: float
    brightest: float
    levels_dn: tuple[float, float, float]  # black, white less black, white
    pinned_dn: float  # saturated sites are pinned to it; infinity: they are not
    noise: tuple[float, float]  # variance line


def scene_of(plan: Plan, curve: Float, shape: tuple[int, ...], origin: tuple[int, int]) -> Scene:
    """Gather what the clean frame of a plan is made with; ``curve`` is that of the source's codes."""
    gains = np.array(plan.inverse_gains)
    ccm = np.array(plan.rgb2cam).reshape(3, 3)
    black_dn, white_dn = float(plan.black_level_dn), float(plan.white_level_dn)
    return Scene(
        ccm[:, :, None] * curve,
        np.array(tile(plan.pattern, origin)),
        gains,
        np.maximum(1 - gains, 0) if plan.highlight == "per_channel" else np.zeros(3),
        plan.highlight == "gray_mean",
        plan.highlight_threshold,
        plan.exposure,
        plan.brightest,
        (black_dn, float(plan.white_level_dn - plan.black_level_dn), white_dn),
        plan.brightest_dn if plan.saturated == "pinned" else np.inf,
        plan.variance_line,
    )


Key = tuple[np.uint64, np.uint64, np.uint64, np.uint64]
"""The two words of a Philox key, then what level and draw, and the frame, put into the counter."""


def key_words(key: int, level: int = 0, draw: int = 0, frame: int = 0) -> Key:
    """Return the words of a stream's key and counter, as the kernels take them."""
    return np.uint64(key & 0xFFFFFFFF), np.uint64(key >> 32), np.uint64(level << 12 | draw), np.uint64(frame)


def columns(table: Float) -> tuple[Float, Float, Float]:
    """Return the three columns of a table of quadratics, each in one piece."""
    return table[:, 0].copy(), table[:, 1].copy(), table[:, 2].copy()


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
    signal = np.empty(CHUNK)
    unrounded = np.empty(CHUNK)
    words = np.empty(CHUNK + BLOCK, dtype=np.uint64)
    normals = np.empty(CHUNK + BLOCK)
    bits = np.empty(CHUNK + BLOCK, dtype=np.uint64)
    site_gains, site_headroom = by_site(scene)
    for y in range(height):
        for start in range(0, width, CHUNK):
            length = min(CHUNK, width - start)
            fill_signal(srgb[y, start : start + length], scene, y, signal)
            fill_light(signal[:length], site_gains[y & 1], site_headroom[y & 1], scene, signal)
            fill_clean(signal[:length], scene, unrounded, clean[y, start : start + length], counts)
            offset = fill_words(key, (origin[0] + y, origin[1] + start), HETEROSCEDASTIC, length, words)
            fill_normals(words[: offset + length], quantiles, bits, normals)
            _fill_noisy(
                unrounded[:length],
                normals[offset : offset + length],
                scene,
                limits_dn,
                noisy[y, start : start + length],
                counts,
            )


@kernel
def _unprocess(srgb: Srgb, scene: Scene, unrounded: Float, clean: Raw, counts: NDArray[np.int64]) -> None:
    """Fill ``unrounded``, ``clean`` and ``counts`` with the clean frame."""
    height, width = clean.shape
    signal = np.empty(CHUNK)
    site_gains, site_headroom = by_site(scene)
    for y in range(height):
        for start in range(0, width, CHUNK):
            end = min(start + CHUNK, width)
            fill_signal(srgb[y, start:end], scene, y, signal)
            fill_light(signal[: end - start], site_gains[y & 1], site_headroom[y & 1], scene, signal)
            fill_clean(signal[: end - start], scene, unrounded[y, start:end], clean[y, start:end], counts)


@kernel
def _noisy(
    unrounded: Float,
    scene: Scene,
    key: Key,
    limits_dn: tuple[float, float],
    origin: tuple[int, int],
    quantiles: tuple[Float, Float, Float],
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill ``noisy`` and ``counts`` with the noisy frame of a two-parameter profile."""
    height, width = noisy.shape
    words = np.empty(CHUNK + BLOCK, dtype=np.uint64)
    normals = np.empty(CHUNK + BLOCK)
    bits = np.empty(CHUNK + BLOCK, dtype=np.uint64)
    for y in range(height):
        for start in range(0, width, CHUNK):
            end = min(start + CHUNK, width)
            length = end - start
            offset = fill_words(key, (origin[0] + y, origin[1] + start), HETEROSCEDASTIC, length, words)
            fill_normals(words[: offset + length], quantiles, bits, normals)
            drawn = normals[offset : offset + length]
            _fill_noisy(unrounded[y, start:end], drawn, scene, limits_dn, noisy[y, start:end], counts)


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
    site = scene.sites[y & 1]
    if scene.by_gray:
        _fill_light_by_gray(row, scene.products, site, scene.gains, scene.threshold, out)
    else:
        _fill_camera(row, scene.products[site[0]], scene.products[site[1]], out)


@kernel
def _fill_camera(row: Srgb, even: Float, odd: Float, out: Float) -> None:
    """Linearise and apply the matrix, for the one channel that each site keeps."""
    e0, e1, e2 = even[0], even[1], even[2]
    o0, o1, o2 = odd[0], odd[1], odd[2]
    length = row.shape[0]
    for pair in range(length // 2):
        x = 2 * pair
        out[x] = (e0[row[x, 0]] + e1[row[x, 1]]) + e2[row[x, 2]]
        out[x + 1] = (o0[row[x + 1, 0]] + o1[row[x + 1, 1]]) + o2[row[x + 1, 2]]
    if length & 1:
        x = length - 1
        out[x] = (e0[row[x, 0]] + e1[row[x, 1]]) + e2[row[x, 2]]


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


@kernel
def _fill_blocks(
    key: Key,
    first_block: int,
    blocks: int,
    y: np.uint64,
    purpose_word: np.uint64,
    out: NDArray[np.uint64],
) -> None:
    """Philox4x32-10 in the layout of `streams`: one 32-bit word a pixel, whole blocks."""
    for block in range(blocks):
        counter = np.uint64((first_block + block) * LANES)
        at = block * BLOCK
        for lane in range(LANES):
            c0, c1, c2, c3 = counter + np.uint64(lane), y, purpose_word | key[2], key[3]
            k0, k1 = key[0], key[1]
            for _ in range(ROUNDS):
                p0 = _M0 * c0
                p1 = _M1 * c2
                c0 = (p1 >> _32) ^ c1 ^ k0
                c1 = p1 & _LOW32
                c2 = (p0 >> _32) ^ c3 ^ k1
                c3 = p0 & _LOW32
                k0 = (k0 + _STEP0) & _LOW32
                k1 = (k1 + _STEP1) & _LOW32
            out[at + lane] = c0
            out[at + LANES + lane] = c1
            out[at + 2 * LANES + lane] = c2
            out[at + 3 * LANES + lane] = c3


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
        bits[n] = ((words[n] & _LOW31) << _1 | _1) | _TWO52_BITS
    for n in range(count):
        doubles[n] = doubles[n] - _TWO52
    for n in range(count):
        b = bits[n]
        words[n] = (words[n] & _SIGN) | ((b >> _POSITION_BITS) - _FIRST_ROW)
        bits[n] = (b & _POSITION_MASK) | _ONE_BITS
    for n in range(count):
        row = words[n] & _LOW31
        t = doubles[n] - 1.0
        out[n] = q0[row] + t * (q1[row] + t * q2[row])
    for n in range(count):
        out_bits[n] = out_bits[n] ^ ((words[n] & _SIGN) << _32)


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
def _fill_noisy(
    unrounded: Float,
    normals: Float,
    scene: Scene,
    limits_dn: tuple[float, float],
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Add the noise to the clean frame before rounding, and read it out; overwrites the normals with the sum."""
    a, b = scene.noise
    black = scene.levels_dn[0]
    for x in range(unrounded.shape[0]):
        dn = unrounded[x]
        normals[x] = dn + np.sqrt(max(a * (dn - black) + b, 0.0)) * normals[x]
    read_out(unrounded, normals, scene, limits_dn, noisy, counts)


@kernel
def read_out(
    unrounded: Float,
    noisy_dn: Float,
    scene: Scene,
    limits_dn: tuple[float, float],
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Pin what is saturated, if so asked; round half to even, clip, cast."""
    a, b = scene.noise
    black, pinned = scene.levels_dn[0], scene.pinned_dn
    low, high = limits_dn
    below, above, still = 0, 0, 0
    for x in range(unrounded.shape[0]):
        still += max(a * (unrounded[x] - black) + b, 0.0) == 0.0
        dn = pinned if unrounded[x] >= pinned else noisy_dn[x]
        rounded = (dn + ROUND) - ROUND
        below += rounded < low
        above += rounded > high
        noisy[x] = np.uint16(np.int32(min(max(rounded, low), high)))
    counts[2] += below
    counts[3] += above
    counts[5] += still
