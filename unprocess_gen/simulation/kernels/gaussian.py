"""The fast form of a pair whose noise is one normal a site: one pass, one channel a site, no full-resolution RGB.

Must give the DN of `pair.reference_pair` everywhere, on every machine. Hence Numba without fastmath (no reordering, no
fused multiply-add), only + - × ÷ √, comparisons, integers and table look-ups, and each formula in the reference's order
of operations. The clean frame is float64 throughout. The noise is made in float32, eight sites at a time (`lanes`), of
normals that polynomials give to within `FINE_ERROR` (`normals`); beside every value stands what it can be off by, and
the sites that could round otherwise than the reference's, some 1 % at a σ of 100 DN, are made again in float64 of the
exact normal (`_settle`). So the quick form decides only what it decides alike.

How it is fast: a row is worked through in runs of `RUN` pixels whose buffers stay in the first-level cache, and each
stage is a loop of its own: a processor overlaps short chains of operations better than long ones, and half of the
loops would not become vector code together. What is bright (highlights, clipped, saturated) is done anew for its blocks
of 64, so that all else needs neither the division nor its counts; clipped and noiseless sites are counted in runs alone
that have some. Runs of whole blocks are written where they belong, others by way of the room.

Doubles are rounded by adding 1.5·2**52, singles by adding 1.5·2**23: half to even, and the whole number is left in the
low bits, which vectorises where conversions do not exist below AVX-512. Codes of four pixels are had by three loads of
four bytes, as loads are what the look-ups wait for: three and three quarters a pixel, at two a cycle.

Nanoseconds a pixel, AVX2 (Zen 3, 3.15 GHz), one thread: look-ups and matrix 0.7, the clean frame 0.1 (where it is
bright, 0.5 more), Philox 0.65, depths of the draws 0.4, noise and read-out 0.6, sites made again 0.1 to 0.5 by their σ;
in all 3.4 to 4.4. On a Sapphire Rapids sites made again took 2.5 where they are 6 %, and take 1 since a list of them is
made without a branch.

Tried, in nanoseconds a pixel: quadratics from tables for the normals, eight lanes of float64 then, 4.4 to 5.6 in all;
straight lines from a table, 0.8 more than polynomials; one long loop for the noise, or Philox in lanes, no gain;
look-ups in the loop of the depths, no gain; runs of 256 pixels, the same, since kernels hand on bare pointers (with
arrays, which are counted by locked additions at every call, +0.3 in the room and +0.5 in the scene); Philox in a
function of its own that is not inlined, +2.8. Before: one loop for everything (scalar code), chunks in the outer loop
and rows in the inner, 6.9. Room is made in Python: to compile it took half a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner, kernel
from unprocess_gen.core.random_streams import BLOCK, KEY_STEPS, LANES, MULTIPLIERS, ROUNDS, purpose
from unprocess_gen.core.types import Counts, Float, Pair, Plan, Raw, Srgb
from unprocess_gen.simulation.kernels.normal import (
    FINE_ERROR,
    exact_normal,
    fill_depths,
    fine_normal,
    normal_quantiles,
    signed,
)
from unprocess_gen.simulation.kernels.simd import (
    WIDE,
    Numbers,
    Vector,
    bare,
    below,
    bits_of,
    float_of,
    four_bytes,
    greatest,
    least,
    load,
    mask_of,
    nothing,
    root,
    store,
    to_float32,
    to_uint32,
)
from unprocess_gen.simulation.reference.cfa import tile

CHUNK = 1024
"""Pixels worked on at a time at most."""
RUN = 512
"""Pixels worked on at a time where a site has one normal: buffers of 27 kB, few of them in use at once."""

_M0, _M1 = (np.uint64(multiplier) for multiplier in MULTIPLIERS)
STEP0, STEP1 = (np.uint64(step) for step in KEY_STEPS)
LOW32, _32 = np.uint64(0xFFFFFFFF), np.uint64(32)
_0, _1, _2, _3, _4, _8 = (np.uint64(number) for number in (0, 1, 2, 3, 4, 8))
_LOW16 = np.uint64(0xFFFF)
_BYTE, _S8, _S16, _S24 = (np.uint32(number) for number in (0xFF, 8, 16, 24))
_G, _B = np.uint32(256), np.uint32(512)
ROUND = 1.5 * 2.0**52

Single = NDArray[np.float32]
Indices = NDArray[np.uint32]

ROUND32, _UNSIGNED32 = np.float32(1.5 * 2.0**23), np.uint32(0x7FFFFFFF)
ZERO32, _HALF32, _1_32, _ONE_BITS32 = np.float32(0), np.float32(0.5), np.uint32(1), np.uint32(0x3F800000)

NOISE_ERROR, PART_ERROR = np.float32(FINE_ERROR + 2.0**-16), np.float32(2.0**-22)
"""What the noise of `_fill_noise` is off by, at most: of its standard deviation, and DN."""
CANCELS = 2.0**-4
"""Below this share of the offset, float32 knows the variance too little, where one of its terms is below 0."""

_BITS = np.arange(2**WIDE)[:, None] >> np.arange(WIDE) & 1
_LANES = np.argsort(1 - _BITS, axis=1, kind="stable").astype(np.uint32).ravel()
_MANY = _BITS.sum(axis=1).astype(np.uint32)

HETEROSCEDASTIC = np.uint64(purpose("heteroscedastic"))


def make_pairs(
    srgb: Srgb,
    plans: Sequence[Plan],
    curve: Float,
    limits_dn: Sequence[tuple[float, float]],
    origin: tuple[int, int] = (0, 0),
) -> list[Pair]:
    """Make the pairs of two-parameter profiles with normal noise, whose plans differ in that alone: all at once.

    Arguments as for `pair.make_pairs`, with the curve of the source's codes, and for each plan the lowest and highest
    DN of the noisy frame.
    """
    frames = empty_frames(srgb, len(plans))
    scene = scene_of(plans[0], curve, srgb.shape, origin)
    laws = np.array([_law_of(plan, limits) for plan, limits in zip(plans, limits_dn, strict=True)])
    keys, quadratics = keys_of(plans), normal_quantiles().quadratics
    _pairs(np.ascontiguousarray(srgb), scene, laws, keys, origin, quadratics, make_room(), *frames)
    return pairs_of(*frames)


Frames = tuple[Raw, Raw, NDArray[np.int64]]
"""A clean frame ``[H, W]``, noisy ones of it ``[N, H, W]``, and the numbers of `Counts` in their order ``[N, 6]``, as
kernels fill them: those of the clean frame stand in the first row alone."""
OF_CLEAN = [0, 1, 4]


def empty_frames(srgb: Srgb, noisy: int = 1) -> Frames:
    """Return frames for a photograph's pairs that hold nothing yet, and counts of 0."""
    height, width = srgb.shape[:2]
    frames = np.empty((height, width), dtype=np.uint16), np.empty((noisy, height, width), dtype=np.uint16)
    return *frames, np.zeros((noisy, 6), dtype=np.int64)


def pairs_of(clean: Raw, noisy: Raw, counts: NDArray[np.int64]) -> list[Pair]:
    """Return the pairs that a kernel filled `Frames` with."""
    counts[1:, OF_CLEAN] = counts[0, OF_CLEAN]
    return [Pair(clean, one, Counts(*of_one)) for one, of_one in zip(noisy, counts.tolist(), strict=True)]


def unprocess(
    srgb: Srgb, plan: Plan, curve: Float, origin: tuple[int, int] = (0, 0)
) -> tuple[Float, Raw, NDArray[np.int64]]:
    """Make the clean frame alone, for several noisy ones; arguments as for `make_pairs`.

    Returns it before rounding, float64 ``[H, W]`` DN, and rounded; and the numbers of `Counts` in their order, of which
    those of the noisy frame are 0.
    """
    unrounded = np.empty(srgb.shape[:2])
    clean = np.empty(srgb.shape[:2], dtype=np.uint16)
    counts = np.zeros(6, dtype=np.int64)
    scene = scene_of(plan, curve, srgb.shape, origin)
    _unprocess(np.ascontiguousarray(srgb), scene, make_room(), unrounded, clean, counts)
    return unrounded, clean, counts


class Scene(NamedTuple):
    """What the clean frame is made with: small arrays and numbers, as the kernels take them."""

    products: Float  # [c, j, k]: matrix entry (c, j) times the curve at code k
    codes: int
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
    site_gains: Float  # [2, CHUNK]: of the pixels of an even and of an odd row, so that loops over them vectorise
    site_headroom: Float


def scene_of(plan: Plan, curve: Float, shape: tuple[int, ...], origin: tuple[int, int]) -> Scene:
    """Gather what the clean frame of a plan is made with; ``curve`` is that of the source's codes."""
    gains, sites = np.array(plan.inverse_gains), np.array(tile(plan.pattern, origin))
    ccm = np.array(plan.rgb2cam).reshape(3, 3)
    headroom = np.maximum(1 - gains, 0) if plan.highlight == "per_channel" else np.zeros(3)
    by_gray = plan.highlight == "gray_mean"
    black_dn, white_dn = float(plan.black_level_dn), float(plan.white_level_dn)
    return Scene(
        ccm[:, :, None] * curve,
        len(curve),
        sites,
        gains,
        headroom,
        by_gray,
        plan.highlight_threshold,
        _dim(plan, 1.0 if by_gray else float(gains.max()), bool(headroom.any())),
        plan.exposure,
        plan.brightest,
        (black_dn, float(plan.white_level_dn - plan.black_level_dn), white_dn),
        pinned_dn(plan),
        plan.variance_line,
        _by_site(np.ones(3) if by_gray else gains, sites),  # by gray they are inverted already
        _by_site(headroom, sites),
    )


@inner
def bare_scene(scene: Scene) -> Scene:
    """Return the same, its arrays bare."""
    return Scene(
        bare(scene.products, _0), scene.codes, bare(scene.sites, _0), bare(scene.gains, _0), bare(scene.headroom, _0),
        scene.by_gray, scene.threshold, scene.dim, scene.exposure, scene.brightest, scene.levels_dn, scene.pinned_dn,
        scene.noise, bare(scene.site_gains, _0), bare(scene.site_headroom, _0),
    )  # fmt: skip


def _by_site(channels: Float, sites: NDArray[np.int64]) -> Float:
    return np.tile(channels[sites], (1, CHUNK // 2))


def pinned_dn(plan: Plan) -> float:
    """Return the DN that saturated sites are pinned to; infinity where they are not."""
    return plan.brightest_dn if plan.saturated == "pinned" else np.inf


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


def keys_of(plans: Sequence[Plan]) -> NDArray[np.uint64]:
    """Return ``[N, 4]``: the key words of the plans' streams, for `key_of`."""
    return np.array([key_words(plan.stream_key, plan.level, plan.draw, plan.frame) for plan in plans])


@inner
def key_of(keys: NDArray[np.uint64], plan: int) -> Key:
    """Return the key words of one of several plans."""
    return keys[plan, 0], keys[plan, 1], keys[plan, 2], keys[plan, 3]


class Room(NamedTuple):
    """Where runs of pixels are worked on, by whole blocks. Python makes it; kernels hand it on bare (`lanes.bare`)."""

    signal: Float
    lit: Float  # light of what is bright
    unrounded: Float
    whole: Single  # DN of the clean frame, rounded
    part: Single  # what rounding took
    words: Indices
    depths: Single  # of the draws
    noise: Single  # and `part`: DN from `whole` on
    margin: Single  # what the noise is off by, at most
    noisy_dn: Single  # rounded, not clipped
    clean: Raw
    noisy: Raw
    listed: Indices  # sites to settle
    lanes: Indices  # of each mask of eight: its lanes, first of eight
    many: Indices  # and how many they are


def make_room(run: int = RUN) -> Room:
    """Return room for a run; what a part of a block leaves over is computed with as well, and so must be numbers."""
    size = run + BLOCK
    doubles, singles = np.zeros((3, size)), np.zeros((6, size), dtype=np.float32)
    raw, words = np.zeros((2, size), dtype=np.uint16), np.zeros(size, dtype=np.uint32)
    listed = np.zeros(size + WIDE, dtype=np.uint32)
    signal, lit, unrounded = doubles
    whole, part, depths, noise, margin, noisy_dn = singles
    frames = raw[0], raw[1]
    of_masks = _LANES, _MANY
    return Room(signal, lit, unrounded, whole, part, words, depths, noise, margin, noisy_dn, *frames, listed, *of_masks)


@inner
def bare_room(room: Room) -> Room:
    """Return the same, bare."""
    return Room(
        bare(room.signal, _0), bare(room.lit, _0), bare(room.unrounded, _0), bare(room.whole, _0), bare(room.part, _0),
        bare(room.words, _0), bare(room.depths, _0), bare(room.noise, _0), bare(room.margin, _0),
        bare(room.noisy_dn, _0), bare(room.clean, _0), bare(room.noisy, _0), bare(room.listed, _0),
        bare(room.lanes, _0), bare(room.many, _0),
    )  # fmt: skip


@kernel
def _pairs(
    srgb: Srgb,
    scene: Scene,
    laws: Float,
    keys: NDArray[np.uint64],
    origin: tuple[int, int],
    quantiles: tuple[Float, Float, Float],
    room: Room,
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill ``clean``, ``noisy`` and ``counts`` with the pairs of a two-parameter profile."""
    height, width = clean.shape
    run, quadratics, bared = bare_room(room), _bare_quadratics(quantiles), bare_scene(scene)
    for y in range(height):
        for start in range(0, width, RUN):
            length = min(RUN, width - start)
            first, after, block, blocks = blocks_of(origin[1] + start, length)
            at = y * width + start
            is_whole = length == blocks * BLOCK
            codes, frame = bare(srgb, 3 * at), bare(clean, at)
            fill_clean(codes, srgb.itemsize == 1, y, first, length, bared, run, frame, bare(counts, 0))
            for plan in range(noisy.shape[0]):
                key, law = key_of(keys, plan), _law(laws, plan, scene.levels_dn[0])
                fill_blocks(key, block, blocks, np.uint64(origin[0] + y), HETEROSCEDASTIC, run.words)
                to = plan * height * width + at
                frame = bare(noisy, to) if is_whole else run.noisy
                _fill_noisy(blocks, (first, after), law, quadratics, run, frame, bare(counts, 6 * plan))
                if not is_whole:
                    copy(length, bare(run.noisy, first), bare(noisy, to))


@kernel
def _unprocess(srgb: Srgb, scene: Scene, room: Room, unrounded: Float, clean: Raw, counts: NDArray[np.int64]) -> None:
    """Fill ``unrounded``, ``clean`` and ``counts`` with the clean frame: the first half of `_pairs`."""
    height, width = clean.shape
    run, bared = bare_room(room), bare_scene(scene)
    for y in range(height):
        for start in range(0, width, RUN):
            length, at = min(RUN, width - start), y * width + start
            codes, frame = bare(srgb, 3 * at), bare(clean, at)
            fill_clean(codes, srgb.itemsize == 1, y, 0, length, bared, run, frame, bare(counts, 0))
            copy(length, run.unrounded, bare(unrounded, at))


@inner
def copy(length: int, source: Numbers, target: Numbers) -> None:
    """Copy some numbers."""
    for x in range(length):
        target[x] = source[x]


@inner
def blocks_of(x: int, length: int) -> tuple[int, int, int, int]:
    """Return where in its blocks a run from pixel ``x`` on begins and ends, and number and count of the blocks."""
    first = x % BLOCK
    after = first + length
    return first, after, x // BLOCK, (after + BLOCK - 1) // BLOCK


@inner
def products_of(products: Numbers, codes: int, sites: Numbers, y: int) -> tuple[Numbers, Numbers]:
    """Return the products of the even and of the odd sites of a row, in any precision."""
    return bare(products, 3 * codes * sites[2 * (y & 1)]), bare(products, 3 * codes * sites[2 * (y & 1) + 1])


@inner
def fill_signal(codes: Numbers, of_bytes: bool, y: int, length: int, scene: Scene, out: Numbers) -> None:
    """Linearise and apply the matrix, for the one channel that each site keeps; by gray, invert the gains too.

    As everything that takes runs of a photograph, with a `bare_scene`.
    """
    if scene.by_gray:
        _fill_light_by_gray(codes, y, length, scene, out)
    else:
        even, odd = products_of(scene.products, scene.codes, scene.sites, y)
        look_up(codes, even, odd, scene.codes, length, of_bytes, out)


@inner
def look_up(
    row: Numbers, even: Numbers, odd: Numbers, codes: int, length: int, of_bytes: bool, signal: Numbers
) -> None:
    """Sum a row's products, ``codes`` of each channel, of its even and of its odd sites."""
    done = 0
    if of_bytes:
        done = length // 4 * 4
        _look_up_bytes(row, even, odd, done // 4, signal)
    for x in range(done, length):
        of_site = odd if x & 1 else even
        r, g, b = np.int64(row[3 * x]), np.int64(row[3 * x + 1]), np.int64(row[3 * x + 2])
        signal[x] = (of_site[r] + of_site[codes + g]) + of_site[2 * codes + b]


@inner
def _look_up_bytes(row: Numbers, even: Numbers, odd: Numbers, fours: int, signal: Numbers) -> None:
    """Do so for four pixels at a time, whose codes take three loads."""
    for four in range(fours):
        x = np.uint64(four) * _4
        first, second, third = four_bytes(row, _3 * x), four_bytes(row, _3 * x + _4), four_bytes(row, _3 * x + _8)
        r, g, b = first & _BYTE, (first >> _S8) & _BYTE, (first >> _S16) & _BYTE
        signal[x] = (even[r] + even[_G + g]) + even[_B + b]
        r, g, b = first >> _S24, second & _BYTE, (second >> _S8) & _BYTE
        signal[x + _1] = (odd[r] + odd[_G + g]) + odd[_B + b]
        r, g, b = (second >> _S16) & _BYTE, second >> _S24, third & _BYTE
        signal[x + _2] = (even[r] + even[_G + g]) + even[_B + b]
        r, g, b = (third >> _S8) & _BYTE, (third >> _S16) & _BYTE, third >> _S24
        signal[x + _3] = (odd[r] + odd[_G + g]) + odd[_B + b]


@inner
def _fill_light_by_gray(codes: Numbers, y: int, length: int, scene: Scene, out: Numbers) -> None:
    """Linearise, apply the matrix and invert the gains, highlights kept by the mean of the three channels."""
    products, gains, threshold, channel = scene.products, scene.gains, scene.threshold, 3 * scene.codes
    for x in range(length):
        r, g, b = np.int64(codes[3 * x]), np.int64(codes[3 * x + 1]), np.int64(codes[3 * x + 2])
        g, b = scene.codes + g, 2 * scene.codes + b
        red = (products[r] + products[g]) + products[b]
        green = (products[channel + r] + products[channel + g]) + products[channel + b]
        blue = (products[2 * channel + r] + products[2 * channel + g]) + products[2 * channel + b]
        m = max(((red + green) + blue) / 3.0 - threshold, 0.0) / (1.0 - threshold)
        mask = m * m
        c = scene.sites[2 * (y & 1) + (x & 1)]
        i = red if c == 0 else green if c == 1 else blue
        out[x] = i * max(mask + (1.0 - mask) * gains[c], gains[c])


_Block = tuple[np.uint64, np.uint64, np.uint64, np.uint64]


@inner
def philox_round(c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64) -> _Block:
    """One round of Philox4x32: four words, each in the low half of what goes in and comes out; the high half is chaff.

    A vector unit multiplies the low halves alone, so that masks before a product are free and all others are not. The
    loop over the rounds stands with the caller: a function that held it would not be inlined, nor made vector code.
    """
    p0 = _M0 * (c0 & LOW32)
    p1 = _M1 * (c2 & LOW32)
    return (p1 >> _32) ^ (c1 ^ k0), p1, (p0 >> _32) ^ (c3 ^ k1), p0


@inner
def fill_blocks(key: Key, first_block: int, blocks: int, y: np.uint64, purpose_word: np.uint64, out: Numbers) -> None:
    """Philox in the layout of `streams`: one 32-bit word a pixel, whole blocks; ``out`` is of uint32."""
    for block in range(blocks):
        counter = np.uint64((first_block + block) * LANES)
        at = block * BLOCK
        for lane in range(LANES):
            c0, c1, c2, c3 = counter + np.uint64(lane), y, purpose_word | key[2], key[3]
            k0, k1 = key[0], key[1]
            for _ in range(ROUNDS):
                c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
                k0, k1 = (k0 + STEP0) & LOW32, (k1 + STEP1) & LOW32
            out[at + lane] = np.uint32(c0 & LOW32)
            out[at + LANES + lane] = np.uint32(c1 & LOW32)
            out[at + 2 * LANES + lane] = np.uint32(c2 & LOW32)
            out[at + 3 * LANES + lane] = np.uint32(c3 & LOW32)


@inner
def fill_words(
    key: Key,
    place: tuple[int, int],
    purpose_word: np.uint64,
    length: int,
    words: Indices,
) -> int:
    """Fill ``words`` with those of a run of pixels from ``place`` on, and return where in it the first one stands."""
    offset = place[1] % BLOCK
    blocks = (offset + length + BLOCK - 1) // BLOCK
    fill_blocks(key, place[1] // BLOCK, blocks, np.uint64(place[0]), purpose_word, words)
    return int(offset)


@inner
def fill_clean(
    codes: Numbers, of_bytes: bool, y: int, first: int, length: int, scene: Scene, run: Room, clean: Numbers,
    tally: Numbers,
) -> None:  # fmt: skip
    """Make a run of the clean frame of row ``y``, before rounding and rounded, and count its sites.

    It stands in the room from ``first`` on, of whole blocks, and rounded in ``clean`` as well.
    """
    after, blocks = first + length, (first + length + BLOCK - 1) // BLOCK
    fill_signal(codes, of_bytes, y, length, scene, bare(run.signal, first))
    of_row = (y & 1) * CHUNK + (first & 1)
    gains = load(bare(scene.site_gains, of_row), _0)
    is_whole = length == blocks * BLOCK
    frame = clean if is_whole else run.clean
    some_below, some_bright = fill_dim(blocks, gains, scene, run, frame)
    if some_below:
        tally[0] += count_below(first, after, run.signal)
    if some_bright:
        fill_bright(blocks, gains, load(bare(scene.site_headroom, of_row), _0), scene, run, frame)
        _count_bright((first, after), scene, run, tally)
    if not is_whole:
        copy(length, bare(run.clean, first), clean)


@inner
def fill_dim(blocks: int, gains: Vector, scene: Scene, run: Room, clean: Numbers) -> tuple[bool, bool]:
    """Go from signals that are not bright to the clean frame; return whether one is below black, and one is bright."""
    black, span, _ = scene.levels_dn
    exposure = scene.exposure
    lowest = highest = load(run.signal, _0)
    for n in range(blocks * (BLOCK // WIDE)):
        x = np.uint64(n) * _8
        i = load(run.signal, x)
        lowest, highest = least(lowest, i), greatest(highest, i)
        _store_clean(greatest(i * gains * exposure, 0.0) * span + black, x, run, clean)
    return mask_of(below(lowest, 0.0)) != 0, mask_of(below(scene.dim, highest)) != 0


@inner
def fill_bright(blocks: int, gains: Vector, headroom: Vector, scene: Scene, run: Room, clean: Numbers) -> None:
    """Do `fill_light` and `fill_clean_of_light` of a run's eights that have something bright in them.

    Their light goes to ``run.lit``, which is 0 elsewhere.
    """
    black, span, _ = scene.levels_dn
    threshold, exposure, brightest = scene.threshold, scene.exposure, scene.brightest
    limit = np.inf if exposure == 1.0 else 1.0
    for block in range(blocks):
        highest = load(run.signal, np.uint64(block * BLOCK))
        for n in range(block * (BLOCK // WIDE), (block + 1) * (BLOCK // WIDE)):
            highest = greatest(highest, load(run.signal, np.uint64(n) * _8))
        is_bright = mask_of(below(scene.dim, highest)) != 0
        for n in range(block * (BLOCK // WIDE), (block + 1) * (BLOCK // WIDE)):
            x = np.uint64(n) * _8
            i = load(run.signal, x)
            if is_bright:
                m = greatest(i - threshold, 0.0) / (1.0 - threshold)
                light = least(i * gains + i * (m * m) * headroom, limit) * exposure
                store(run.lit, x, light)
                _store_clean(least(greatest(light, 0.0), brightest) * span + black, x, run, clean)
            else:
                store(run.lit, x, i * 0.0)


@inner
def _count_bright(valid: tuple[int, int], scene: Scene, run: Room, tally: Numbers) -> None:
    last, brightest = scene.levels_dn[2] + ROUND, scene.brightest
    above = saturated = 0
    for x in range(valid[0], valid[1]):
        above += run.lit[x] > brightest
        saturated += run.unrounded[x] + ROUND == last
    tally[1] += above
    tally[4] += saturated


@inner
def _store_clean(dn: Vector, x: np.uint64, run: Room, clean: Numbers) -> None:
    """Store eight sites: as they are, taken apart, and rounded."""
    rounded = (dn + ROUND) - ROUND
    whole = to_float32(rounded)
    store(run.unrounded, x, dn)
    store(run.whole, x, whole)
    store(run.part, x, to_float32(dn - rounded))
    store(clean, x, to_uint32(whole))


@inner
def count_below(first: int, after: int, signal: Numbers) -> int:
    """Count signals below black."""
    count = 0
    for x in range(first, after):
        count += signal[x] < 0.0
    return count


@inner
def _low16(rounded: float) -> np.uint16:
    """Return the whole number that `ROUND` was added to."""
    return np.uint16(np.float64(rounded).view(np.uint64) & _LOW16)


@inner
def fill_light(signal: Float, gains: Float, headroom: Float, scene: Scene, out: Float) -> None:
    """Invert the gains, highlights kept by channel (or not, where ``headroom`` is 0), and darken the scene."""
    threshold, exposure = scene.threshold, scene.exposure
    limit = np.inf if exposure == 1.0 else 1.0  # what the photograph shows as white is white before it is darkened
    for x in range(signal.shape[0]):
        i = signal[x]
        m = max(i - threshold, 0.0) / (1.0 - threshold)
        out[x] = min(i * gains[x] + i * (m * m) * headroom[x], limit) * exposure


@inner
def fill_clean_of_light(light: Float, scene: Scene, unrounded: Float, clean: Raw, counts: NDArray[np.int64]) -> None:
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


class _Law(NamedTuple):
    """The variance line and the limits of the noisy frame, for `_fill_noisy`."""

    exact: tuple[float, float, float]  # a, b, black
    a: np.float32
    b: np.float32
    black: np.float32
    uncertain: np.float32  # variance below which rounding could have taken much of it
    pinned_dn: float
    low: np.float32
    high: np.float32


def _law_of(plan: Plan, limits_dn: tuple[float, float]) -> tuple[float, ...]:
    """Return slope and intercept of the variance, the DN saturated sites are pinned to, and the lowest and highest."""
    return *plan.variance_line, pinned_dn(plan), *limits_dn


@inner
def _law(laws: Float, plan: int, black: float) -> _Law:
    a, b, pinned_dn, low, high = laws[plan, 0], laws[plan, 1], laws[plan, 2], laws[plan, 3], laws[plan, 4]
    uncertain = abs(b) * CANCELS if min(a, b) < 0.0 else 0.0
    f = np.float32
    return _Law((a, b, black), f(a), f(b), f(black), f(uncertain), pinned_dn, f(low), f(high))


@inner
def _bare_quadratics(quantiles: tuple[Float, Float, Float]) -> tuple[Numbers, Numbers, Numbers]:
    return bare(quantiles[0], _0), bare(quantiles[1], _0), bare(quantiles[2], _0)


@inner
def _fill_noisy(
    blocks: int,
    valid: tuple[int, int],
    law: _Law,
    quadratics: tuple[Numbers, Numbers, Numbers],
    run: Room,
    noisy: Numbers,
    tally: Numbers,
) -> None:
    """Fill a run's noisy frame, and count its sites: in float32, but those that could round otherwise exactly."""
    count = blocks * BLOCK
    fill_depths(count, run.words, run.depths)
    _fill_noise(count, law, run)
    listed, clips = _digitise(count, law, run, noisy)
    if listed:
        clips = _settle(listed, law, quadratics, run, noisy) or clips
    if law.pinned_dn < np.inf:
        _pin(valid, law, run, noisy)
    if clips:
        _count_clipped(valid, law, run, tally)
    tally[5] += count_still(valid, law.exact, run.unrounded)


@inner
def _fill_noise(count: int, law: _Law, run: Room) -> None:
    for n in range(count // WIDE):
        x = np.uint64(n) * _8
        part = load(run.part, x)
        variance = ((load(run.whole, x) - law.black) + part) * law.a + law.b
        std = root(greatest(variance, ZERO32))
        store(run.noise, x, part + signed(std * fine_normal(load(run.depths, x)), load(run.words, x)))
        cancelled = below(float_of(bits_of(variance) & _UNSIGNED32), law.uncertain) & _ONE_BITS32
        store(run.margin, x, greatest(std * NOISE_ERROR + PART_ERROR, float_of(cancelled)))


@inner
def _digitise(count: int, law: _Law, run: Room, noisy: Numbers) -> tuple[int, bool]:
    """Round half to even, clip, cast; return how many sites are listed, and whether anything was clipped.

    Every eight writes its lanes, and the next one over those that are not to be listed: a branch would be guessed wrong
    every other time.
    """
    listed, clips = 0, nothing()
    for n in range(count // WIDE):
        x = np.uint64(n) * _8
        noise = load(run.noise, x)
        rounded = (noise + ROUND32) - ROUND32
        dn = load(run.whole, x) + rounded
        clipped = least(greatest(dn, law.low), law.high)
        store(run.noisy_dn, x, dn)
        store(noisy, x, to_uint32(clipped))
        clips = clips | (bits_of(clipped) ^ bits_of(dn))
        from_edge = _HALF32 - float_of(bits_of(noise - rounded) & _UNSIGNED32)
        near = mask_of(below(from_edge, load(run.margin, x)))
        store(run.listed, listed, load(run.lanes, np.uint64(near) * _8) + np.uint32(x))
        listed += int(run.many[near])
    return listed, _is_any(clips)


@inner
def _is_any(bits: Vector) -> bool:
    return bool(mask_of(below(ZERO32, to_float32(bits >> _1_32))) != 0)


@inner
def _settle(listed: int, law: _Law, quadratics: tuple[Numbers, Numbers, Numbers], run: Room, noisy: Numbers) -> bool:
    """Digitise listed sites anew, by the reference's formulas; return whether any was clipped."""
    clips = 0
    a, b, black = law.exact
    for n in range(listed):
        x = run.listed[n]
        clean_dn = run.unrounded[x]
        std = np.sqrt(max(a * (clean_dn - black) + b, 0.0))
        dn = (clean_dn + std * exact_normal(run.words[x], quadratics) + ROUND) - ROUND
        run.noisy_dn[x] = dn
        noisy[x] = _clipped(dn, law)
        clips |= (dn < law.low) | (dn > law.high)
    return bool(clips != 0)


@inner
def _clipped(dn: float, law: _Law) -> np.uint16:
    return np.uint16(np.int64(min(max(dn, float(law.low)), float(law.high))))


@inner
def _pin(valid: tuple[int, int], law: _Law, run: Room, noisy: Numbers) -> None:
    for x in range(valid[0], valid[1]):
        if run.unrounded[x] >= law.pinned_dn:
            dn = (law.pinned_dn + ROUND) - ROUND
            run.noisy_dn[x] = dn
            noisy[x] = _clipped(dn, law)


@inner
def _count_clipped(valid: tuple[int, int], law: _Law, run: Room, tally: Numbers) -> None:
    low = high = 0
    for x in range(valid[0], valid[1]):
        low += run.noisy_dn[x] < law.low
        high += run.noisy_dn[x] > law.high
    tally[2] += low
    tally[3] += high


@inner
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


@inner
def count_still(valid: tuple[int, int], line: tuple[Any, Any, Any], clean_dn: Numbers) -> int:
    """Count sites without variance; ``line`` is a, b and the black level."""
    a, b, black = line
    still = 0
    if min(a, b) <= 0.0:
        for x in range(valid[0], valid[1]):
            still += a * (clean_dn[x] - black) + b <= 0.0
    return still


@inner
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
    line = scene.noise[0], scene.noise[1], scene.levels_dn[0]
    counts[5] += count_still((0, unrounded.shape[0]), line, unrounded)
