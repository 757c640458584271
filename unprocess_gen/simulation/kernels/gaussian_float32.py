"""The form in float32 of a pair whose noise is one normal a site: `fused`'s, where a budget allows errors.

Three quarters of its time. The errors are stated in `methods` and proved by the tests; every machine makes the same
ones. Beside the precision three things are given up: the matrix's products are made with the gains and the span of the
sensor in them, so that sums of them are DN at once; the normals' polynomials are shorter; and no site is made again.

Nanoseconds a pixel, AVX2 (Zen 3): look-ups 0.65, the clean frame 0.15, Philox 0.65, depths of the draws 0.4, noise and
read-out 0.65. Tried: straight lines in place of polynomials for the normals, which take one look-up each: 0.8 more.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner, kernel
from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.core.types import Float, Pair, Plan, Raw, Srgb
from unprocess_gen.simulation.kernels.gaussian import (
    HETEROSCEDASTIC,
    ROUND32,
    RUN,
    ZERO32,
    Indices,
    Scene,
    Single,
    blocks_of,
    copy,
    count_below,
    count_still,
    empty_frames,
    fill_blocks,
    key_of,
    keys_of,
    look_up,
    pairs_of,
    pinned_dn,
    products_of,
    scene_of,
)
from unprocess_gen.simulation.kernels.normal import coarse_normal, fill_coarse_depths, signed
from unprocess_gen.simulation.kernels.simd import (
    WIDE,
    Numbers,
    Vector,
    bare,
    below,
    bits_of,
    greatest,
    least,
    load,
    mask_of,
    root,
    store,
)

_0, _8 = np.uint64(0), np.uint64(8)
_1F, _INFINITY = np.float32(1), np.float32(np.inf)

ROUNDINGS = 2.0**-18
"""What white is off by in float32, at most, as a share of it: a quarter DN of 16 bits. Light that is above white by no
more is not counted as clipped."""


def make_pairs(
    srgb: Srgb,
    plans: Sequence[Plan],
    curve: Float,
    limits_dn: Sequence[tuple[float, float]],
    origin: tuple[int, int] = (0, 0),
) -> list[Pair]:
    """Make the pairs of `fused.make_pairs`, of which all is the same but the precision."""
    frames = empty_frames(srgb, len(plans))
    scene = scene_of(plans[0], curve, srgb.shape, origin)
    laws = np.array([law_of(plan, limits) for plan, limits in zip(plans, limits_dn, strict=True)])
    of_scene = products32_of(scene), sites_of(scene), light_of(scene)
    _pairs32(np.ascontiguousarray(srgb), *of_scene, laws, keys_of(plans), origin, make_room(), *frames)
    return pairs_of(*frames)


class Light(NamedTuple):
    """What of a `fused.Scene` the loops need; DN count from black on, which is put on when they are whole."""

    by_gray: bool
    channels: NDArray[np.int64]  # [2, 2]: of each site
    gains: Single  # of the channels
    scale: np.float32  # from light to DN
    threshold: np.float32
    steepness: np.float32  # of the highlight term: 1 / (1 - threshold)
    exposure: np.float32
    limit: np.float32
    brightest: np.float32
    clipped: np.float32  # light above it counts as clipped: that of white is 1 but for the roundings
    span: np.float32
    black: np.uint32


def light_of(scene: Scene) -> Light:
    """Return what the loops need of a scene."""
    black, span, _ = scene.levels_dn
    f = np.float32
    return Light(
        scene.by_gray, scene.sites, scene.gains.astype(f), f(scene.exposure * span),
        f(scene.threshold), f(1 / (1 - scene.threshold)), f(scene.exposure), f(np.inf if scene.exposure == 1 else 1),
        f(scene.brightest), f(scene.brightest * (1 + ROUNDINGS)), f(span), np.uint32(black),
    )  # fmt: skip


class Law32(NamedTuple):
    """The variance line and the limits of a noisy frame; DN count from black on."""

    a: np.float32
    b: np.float32
    pinned_dn: np.float32
    saturated_dn: np.float32  # from which on a site is pinned: white is `pinned_dn` but for the roundings
    low: np.float32
    high: np.float32


def law_of(plan: Plan, limits_dn: tuple[float, float]) -> Law32:
    """Return the law of a plan's noise."""
    black, pinned = plan.black_level_dn, pinned_dn(plan)
    f = np.float32
    with np.errstate(over="ignore"):  # a variance beyond float32 is infinite, and its site clipped
        a, b = (f(one) for one in plan.variance_line)
    pinned_at = f(pinned - black), f((pinned - black) * (1 - ROUNDINGS))
    return Law32(a, b, *pinned_at, f(limits_dn[0] - black), f(limits_dn[1] - black))


@inner
def _law(laws: Single, plan: int) -> Law32:
    """Return one of several plans'."""
    return Law32(laws[plan, 0], laws[plan, 1], laws[plan, 2], laws[plan, 3], laws[plan, 4], laws[plan, 5])


def _dn_of_signal(scene: Scene) -> Float:
    """Return what makes DN of the channels' signals, where they are dim; by gray the gains are inverted already."""
    gains = np.ones(3) if scene.by_gray else scene.gains
    return gains * scene.exposure * scene.levels_dn[1]


def products32_of(scene: Scene) -> Single:
    """Return the products as DN above black; by gray, where the three channels are compared, as they are."""
    scale = np.ones(3) if scene.by_gray else _dn_of_signal(scene)
    return (scene.products * scale[:, None, None]).astype(np.float32)


def sites_of(scene: Scene) -> Single:
    """Return ``[4, 2, WIDE + 2]``: for pixels of an even and of an odd row dim DN, signal per DN, gain, headroom."""
    gains = np.ones(3) if scene.by_gray else scene.gains
    of_channels = scene.dim * _dn_of_signal(scene), 1 / _dn_of_signal(scene), gains, scene.headroom
    rows = np.stack([one[scene.sites] for one in of_channels]).astype(np.float32)
    return np.ascontiguousarray(np.tile(rows, (1, 1, WIDE // 2 + 1)))


class Room32(NamedTuple):
    """As `fused.Room`; DN count from black on.

    Not of that name: Numba tells tuples apart by it when it is called, and is slow where two share one.
    """

    signal: Single  # DN already
    clean_dn: Single
    lit: Single  # light of what is bright
    words: Indices
    depths: Single
    noisy_dn: Single  # neither rounded nor clipped
    clean: Raw
    noisy: Raw


def make_room() -> Room32:
    """Return room for a run."""
    size = RUN + BLOCK
    singles, raw = np.zeros((5, size), dtype=np.float32), np.zeros((2, size), dtype=np.uint16)
    signal, clean_dn, lit, depths, noisy_dn = singles
    words = np.zeros(size, dtype=np.uint32)
    return Room32(signal, clean_dn, lit, words, depths, noisy_dn, raw[0], raw[1])


@inner
def bare_room(room: Room32) -> Room32:
    """Return the same, bare."""
    return Room32(
        bare(room.signal, _0), bare(room.clean_dn, _0), bare(room.lit, _0), bare(room.words, _0),
        bare(room.depths, _0), bare(room.noisy_dn, _0), bare(room.clean, _0), bare(room.noisy, _0),
    )  # fmt: skip


@kernel
def _pairs32(
    srgb: Srgb,
    products: Single,
    sites: Single,
    light: Light,
    laws: Single,
    keys: NDArray[np.uint64],
    origin: tuple[int, int],
    room: Room32,
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """`fused._pairs` in float32."""
    height, width = clean.shape
    codes, of_bytes = products.shape[2], srgb.itemsize == 1
    run, tally = bare_room(room), bare(counts, _0)
    for y in range(height):
        even, odd = products_of(bare(products, _0), codes, bare(light.channels, _0), y)
        for start in range(0, width, RUN):
            length = min(RUN, width - start)
            first, after, block, blocks = blocks_of(origin[1] + start, length)
            at, is_whole = y * width + start, length == blocks * BLOCK
            if light.by_gray:
                _fill_light_by_gray(srgb[y, start : start + length], products, y, light, room.signal[first:after])
            else:
                look_up(bare(srgb, 3 * at), even, odd, codes, length, of_bytes, bare(run.signal, first))
            of_sites = bright_sites(sites, y & 1, first)
            frame = bare(clean, at) if is_whole else run.clean
            some_below, some_bright = fill_clean(blocks, of_sites[0], light, run, frame)
            if some_below:
                tally[0] += count_below(first, after, run.signal)
            if some_bright:
                fill_bright(blocks, of_sites, light, run, frame)
                _count_bright((first, after), light, run, tally)
            if not is_whole:
                copy(length, bare(run.clean, first), bare(clean, at))
            for plan in range(noisy.shape[0]):
                key, law = key_of(keys, plan), _law(laws, plan)
                fill_blocks(key, block, blocks, np.uint64(origin[0] + y), HETEROSCEDASTIC, run.words)
                to = plan * height * width + at
                frame = bare(noisy, to) if is_whole else run.noisy
                _fill_noisy(blocks * BLOCK, (first, after), law, light.black, run, frame, bare(counts, 6 * plan))
                if not is_whole:
                    copy(length, bare(run.noisy, first), bare(noisy, to))


@inner
def _fill_light_by_gray(row: Srgb, products: Single, y: int, light: Light, out: Single) -> None:
    """`fused._fill_light_by_gray`, to DN."""
    for x in range(row.shape[0]):
        r, g, b = row[x, 0], row[x, 1], row[x, 2]
        red = (products[0, 0, r] + products[0, 1, g]) + products[0, 2, b]
        green = (products[1, 0, r] + products[1, 1, g]) + products[1, 2, b]
        blue = (products[2, 0, r] + products[2, 1, g]) + products[2, 2, b]
        m = max(((red + green) + blue) / np.float32(3) - light.threshold, ZERO32) * light.steepness
        mask = m * m
        c = light.channels[y & 1, x & 1]
        i = red if c == 0 else green if c == 1 else blue
        out[x] = i * max(mask + (_1F - mask) * light.gains[c], light.gains[c]) * light.scale


@inner
def fill_clean(blocks: int, dims: Vector, light: Light, run: Room32, clean: Numbers) -> tuple[bool, bool]:
    """`fused.fill_dim` of signals that are DN; return whether one is below black, and whether one is bright."""
    lowest = highest = load(run.signal, _0)
    for n in range(blocks * (BLOCK // WIDE)):
        x = np.uint64(n) * _8
        signal = load(run.signal, x)
        lowest, highest = least(lowest, signal), greatest(highest, signal)
        dn = greatest(signal, ZERO32)
        store(run.clean_dn, x, dn)
        store(clean, x, bits_of(dn + ROUND32) + light.black)
    return mask_of(below(lowest, ZERO32)) != 0, mask_of(below(dims, highest)) != 0


@inner
def bright_sites(sites: Single, row: int, first: int) -> tuple[Vector, Vector, Vector, Vector]:
    """Return what `fill_bright` takes of `sites_of`: dim DN, signal per DN, gain and headroom of eights of a row."""
    width = sites.shape[2]
    at = row * width + (first & 1)
    return (
        load(bare(sites, at), _0),
        load(bare(sites, 2 * width + at), _0),
        load(bare(sites, 4 * width + at), _0),
        load(bare(sites, 6 * width + at), _0),
    )


@inner
def fill_bright(
    blocks: int,
    sites: tuple[Vector, Vector, Vector, Vector],
    light: Light,
    run: Room32,
    clean: Numbers,
) -> None:
    """`fused.fill_bright` of a run's eights that have something bright in them; light goes to ``run.lit``, else 0."""
    dims, per_dn, gains, headroom = sites
    for n in range(blocks * (BLOCK // WIDE)):
        x = np.uint64(n) * _8
        signal = load(run.signal, x)
        if mask_of(below(dims, signal)) == 0:
            store(run.lit, x, signal * ZERO32)
            continue
        i = signal * per_dn
        m = greatest(i - light.threshold, ZERO32) * light.steepness
        lit = least(i * gains + i * (m * m) * headroom, light.limit) * light.exposure
        dn = least(greatest(lit, ZERO32), light.brightest) * light.span
        store(run.lit, x, lit)
        store(run.clean_dn, x, dn)
        store(clean, x, bits_of(dn + ROUND32) + light.black)


@inner
def _count_bright(valid: tuple[int, int], light: Light, run: Room32, tally: Numbers) -> None:
    above = saturated = 0
    last = light.span + ROUND32
    for x in range(valid[0], valid[1]):
        above += run.lit[x] > light.clipped
        saturated += run.clean_dn[x] + ROUND32 == last
    tally[1] += above
    tally[4] += saturated


@inner
def _low16(rounded: np.float32, black: np.uint32) -> np.uint16:
    return np.uint16((np.float32(rounded).view(np.uint32) + black) & np.uint32(0xFFFF))


@inner
def _fill_noisy(
    count: int, valid: tuple[int, int], law: Law32, black: np.uint32, run: Room32, noisy: Numbers, tally: Numbers
) -> None:
    """`fused._fill_noisy` in float32."""
    fill_coarse_depths(count, run.words, run.depths)
    _fill_noise(count, law, run)
    some_clipped = digitise(count, law, black, run.noisy_dn, noisy)
    if law.pinned_dn < _INFINITY:
        _pin(valid, law, black, run, noisy)
    if some_clipped:
        _count_clipped(valid, law, run, tally)
    tally[5] += count_still(valid, (law.a, law.b, ZERO32), run.clean_dn)


@inner
def _fill_noise(count: int, law: Law32, run: Room32) -> None:
    for n in range(count // WIDE):
        x = np.uint64(n) * _8
        clean_dn = load(run.clean_dn, x)
        std = root(greatest(clean_dn * law.a + law.b, ZERO32))
        store(run.noisy_dn, x, clean_dn + signed(std * coarse_normal(load(run.depths, x)), load(run.words, x)))


@inner
def digitise(count: int, law: Law32, black: np.uint32, noisy_dn: Numbers, noisy: Numbers) -> bool:
    """Clip, round half to even, cast; return whether anything was clipped."""
    lowest = highest = load(noisy_dn, _0)
    for n in range(count // WIDE):
        x = np.uint64(n) * _8
        dn = load(noisy_dn, x)
        lowest, highest = least(lowest, dn), greatest(highest, dn)
        store(noisy, x, bits_of(least(greatest(dn, law.low), law.high) + ROUND32) + black)
    return bool(mask_of(below(lowest, law.low) | below(law.high, highest)) != 0)


@inner
def _pin(valid: tuple[int, int], law: Law32, black: np.uint32, run: Room32, noisy: Numbers) -> None:
    for x in range(valid[0], valid[1]):
        if run.clean_dn[x] >= law.saturated_dn:
            run.noisy_dn[x] = law.pinned_dn
            noisy[x] = _low16(min(max(law.pinned_dn, law.low), law.high) + ROUND32, black)


@inner
def _count_clipped(valid: tuple[int, int], law: Law32, run: Room32, tally: Numbers) -> None:
    low, high = law.low, law.high
    below_low, above_high = 0, 0
    for x in range(valid[0], valid[1]):
        rounded = (min(max(run.noisy_dn[x], low - _1F), high + _1F) + ROUND32) - ROUND32
        below_low += rounded < low
        above_high += rounded > high
    tally[2] += below_low
    tally[3] += above_high
