"""The fast form of a pair whose noise is made in electrons, effect by effect: `fused`'s passes with `effects.physical`.

Must give the DN of `pair.reference_pair` everywhere, by the same means as `fused`, of which the clean frame, the words
and the read-out are. Counts and read noise are made of quick normals, and again of exact ones where they could round
otherwise (`normals`). What has shot and read noise and little else, as most frames have, goes by a kernel of its own,
in runs and in single precision as far as that decides. Of a body that is seen again the response pattern is kept.

Measured on a daylight frame, AVX2, one thread of a busy machine: the kernel for shot and read noise takes 1.7 times as
long as `fused` (1.4 where shot noise is normal), the one for every effect 2.5 times. Nanoseconds a
pixel of the former: both words with division and roots 2.0 (the words alone 1.4), normals 0.6 each, short counts 0.9,
the rest 0.5. Nanoseconds a pixel of the latter's noisy frame: electrons 0.5,
words 0.7 for each of shot and read noise, counts 3.1, digitising 1.5, the read-out 0.7. Tried and slower: chunks of 256
and 512 pixels; one function for all counts (0.8 more: it takes as much to hand it the body and the buffers).
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner, kernel
from unprocess_gen.core.lookup_tables import exponential_levels
from unprocess_gen.core.random_streams import BLOCK, LANES, ROUNDS, purpose
from unprocess_gen.core.types import Float, Pair, Physics, Plan, Raw, Srgb
from unprocess_gen.simulation.kernels.gaussian import (
    CHUNK,
    HETEROSCEDASTIC,
    LOW32,
    ROUND,
    STEP0,
    STEP1,
    Key,
    Room,
    Scene,
    bare_room,
    bare_scene,
    blocks_of,
    copy,
    empty_frames,
    fill_clean,
    fill_clean_of_light,
    fill_light,
    fill_signal,
    fill_words,
    key_words,
    make_room,
    pairs_of,
    philox_round,
    read_out,
    scene_of,
)
from unprocess_gen.simulation.kernels.normal import Quantiles, exact_normal, normal_quantiles, quantiles, quick_normals
from unprocess_gen.simulation.kernels.poisson import (
    Counting,
    all_near_normal,
    flag,
    list_open,
    normal_counts,
    room_for,
    settle,
    short_counts,
)
from unprocess_gen.simulation.kernels.poisson import draw as draw_counts
from unprocess_gen.simulation.kernels.simd import bare
from unprocess_gen.simulation.reference import noise as effects
from unprocess_gen.simulation.reference.poisson import Tables as PoissonTables
from unprocess_gen.simulation.reference.poisson import gaussian_from, poisson_tables

PRNU, SHOT, DARK, HOT, DEAD = (
    np.uint64(purpose(stream)) for stream in ("prnu", "shot", "dark_current", "hot_pixels", "dead_pixels")
)
HOT_STEP = np.uint64(purpose("hot_pixels", draw=1))

HALF_SLACK = 2.0**-30
"""DN: more than sums of doubles are off by, as far as a sensor's 16 bits go."""


def make_pair(
    srgb: Srgb,
    plan: Plan,
    curve: Float,
    limits_dn: tuple[float, float],
    origin: tuple[int, int] = (0, 0),
) -> Pair:
    """Make a pair of a physical profile, or of a two-parameter one by counts.

    Arguments as for `fused.make_pairs`, of the one plan.
    """
    clean, noisy, counts = frames = empty_frames(srgb)
    scene = scene_of(plan, curve, srgb.shape, origin)
    key = key_words(plan.stream_key, plan.level, plan.draw, plan.frame)
    body, tables, normal = _body(plan, srgb.shape, origin), poisson_tables(), normal_quantiles()
    pixels = np.ascontiguousarray(srgb)
    if is_plain(plan):
        given, plain, drawn = np.empty((0, 0)), _plain(body, scene), (tables, normal, _make_desk())
        _plain_pair(pixels, given, scene, key, limits_dn, origin, plain, *drawn, clean, noisy[0], counts[0])
    else:
        of_body = body, tables, normal, _make_buffers()
        _physical_pair(pixels, scene, key, limits_dn, origin, *of_body, clean, noisy[0], counts[0])
    return pairs_of(*frames)[0]


def make_noisy(
    unrounded: Float, plan: Plan, limits_dn: tuple[float, float], origin: tuple[int, int] = (0, 0)
) -> tuple[Raw, NDArray[np.int64]]:
    """Make the noisy frame alone, for one more noise level or draw of a clean frame.

    ``unrounded`` is that clean frame before rounding, float64 ``[H, W]`` DN; the other arguments are as for
    `make_pair`, whose noisy frame this is, to the byte. Returns it and the numbers of `Counts` in their order, of which
    those of the clean frame are 0. ValueError for a plan whose body or level the clean frame depends on.
    """
    if plan.averaged or "full_well" in plan.effects:
        raise ValueError("a clean frame with fixed patterns or a full well is another at every noise level")
    noisy = np.empty(unrounded.shape, dtype=np.uint16)
    counts = np.zeros(6, dtype=np.int64)
    scene = scene_of(plan, np.zeros(1), unrounded.shape, origin)  # no code is looked up
    key = key_words(plan.stream_key, plan.level, plan.draw, plan.frame)
    body, tables, normal = _body(plan, unrounded.shape, origin), poisson_tables(), normal_quantiles()
    frame = np.ascontiguousarray(unrounded)
    if is_plain(plan):
        pixels, clean, plain = np.empty((0, 0, 3), dtype=np.uint8), np.empty((0, 0), np.uint16), _plain(body, scene)
        desk = _make_desk()
        _plain_pair(pixels, frame, scene, key, limits_dn, origin, plain, tables, normal, desk, clean, noisy, counts)
        return noisy, counts
    _physical_noisy(frame, scene, key, limits_dn, origin, body, tables, normal, _make_buffers(), noisy, counts)
    return noisy, counts


HIDES_STEPS_E = 0.5
"""Read noise of less lets the steps of whole electrons show, and no normal has them: 0.2/√rate of distance without any
read noise, 0.001/√rate with so much, beside the 0.07/√rate of the skewness that `methods.gaussian_distance` is."""


class _Body(NamedTuple):
    """What the noisy frame of a physical profile is made with; a number that leaves its effect out is said."""

    dn_per_e: float
    response: NDArray[np.float32]  # [H, W]; [1, 1] where the effect is off
    responds: bool
    averaged: bool  # whether the clean frame has the fixed patterns too
    shot: bool
    dark: bool
    dark_e: float
    removed_e: float
    hot_below: np.uint64  # a pixel whose word lies below is hot; 0: none is
    hot_e: float
    levels: Float
    full_well_e: float  # infinity: off
    read_std_dn: float  # 0: off
    read: Quantiles
    rows_dn: Float  # [H]
    columns_dn: Float  # [W]
    errors_dn: Float  # [2, CHUNK]
    dead_below: np.uint64
    read_purpose: np.uint64
    key: Key
    reach: tuple[np.float32, np.float32]  # roots of the mean electrons between which shot noise is made of counts


def _body(plan: Plan, shape: tuple[int, ...], origin: tuple[int, int]) -> _Body:
    """Gather the numbers of the effects that are simulated; of a two-parameter profile's Poisson form as well."""
    physics = plan.physics
    if physics is None:
        a_dn, b_dn2 = plan.variance_line
        return _Body(
            a_dn or 1.0, np.ones((1, 1), np.float32), False, False, a_dn > 0, False, 0.0, 0.0, np.uint64(0), 0.0,
            exponential_levels(), np.inf, float(np.sqrt(max(b_dn2, 0.0))), normal_quantiles(),
            np.zeros(shape[0]), np.zeros(shape[1]), np.zeros((2, CHUNK)), np.uint64(0), HETEROSCEDASTIC, key_words(0),
            _reach(plan, float(np.sqrt(max(b_dn2, 0.0))) / (a_dn or 1.0)),
        )  # fmt: skip
    on = frozenset(plan.effects)
    return _Body(
        dn_per_e=physics.dn_per_e,
        response=(
            body_response(physics.body_key, physics.prnu_std, shape[0], shape[1], origin)
            if "prnu" in on
            else np.ones((1, 1), np.float32)
        ),
        responds="prnu" in on,
        averaged=plan.averaged,
        shot="shot" in on,
        dark="dark_current" in on,
        dark_e=physics.dark_e,
        removed_e=physics.dark_e if physics.dark_offset == "removed" else 0.0,
        hot_below=share_limit(physics.hot_pixel_share) if "hot_pixels" in on else np.uint64(0),
        hot_e=physics.hot_pixel_e,
        levels=exponential_levels(),
        full_well_e=physics.full_well_e if "full_well" in on else np.inf,
        read_std_dn=physics.read_std_dn if "read" in on else 0.0,
        read=_read_quantiles(physics),
        rows_dn=effects.row(plan, shape[0], origin[0]) if "row" in on else np.zeros(shape[0]),
        columns_dn=effects.column(physics, shape[1], origin[1]) if "column" in on else np.zeros(shape[1]),
        errors_dn=effects.black_error(physics, (2, CHUNK), origin) if "black_error" in on else np.zeros((2, CHUNK)),
        dead_below=share_limit(physics.dead_pixel_share) if "dead_pixels" in on else np.uint64(0),
        read_purpose=np.uint64(purpose("read")),
        key=key_words(physics.body_key),
        reach=_reach(plan, physics.read_std_dn / physics.dn_per_e if "read" in on else 0.0),
    )


def _reach(plan: Plan, read_std_e: float) -> tuple[np.float32, np.float32]:
    """Return the roots of the means, in electrons, between which no normal is near enough to counts."""
    lowest, highest = 0.0, np.inf  # without light no count is needed
    if "shot:gaussian_where_near" in plan.methods and read_std_e >= HIDES_STEPS_E:
        lowest, highest = np.sqrt(gaussian_from(read_std_e, plan.law_distance))
    return np.float32(lowest), np.float32(highest)


def _read_quantiles(physics: Physics) -> Quantiles:
    return normal_quantiles() if physics.read_law == "gaussian" else quantiles(effects.read_table(physics))


def share_limit(share: float) -> np.uint64:
    """Return the word below which a share of all words lies (`effects.is_among`)."""
    return np.uint64(int(share * 2**32))


@functools.lru_cache(maxsize=1)
def body_response(
    body_key: int, prnu_std: float, height: int, width: int, origin: tuple[int, int]
) -> NDArray[np.float32]:
    """Return `effects.response`, kept for the next frame of the same body."""
    response = np.empty((height, width), dtype=np.float32)
    _responses(key_words(body_key), prnu_std, origin, normal_quantiles().quadratics, response)
    return response


@kernel
def _responses(
    key: Key,
    prnu_std: float,
    origin: tuple[int, int],
    quantiles: tuple[Float, Float, Float],
    out: NDArray[np.float32],
) -> None:
    words, normals = np.empty(CHUNK + BLOCK, dtype=np.uint32), np.empty(CHUNK)
    for y in range(out.shape[0]):
        for start in range(0, out.shape[1], CHUNK):
            length = min(CHUNK, out.shape[1] - start)
            place = (origin[0] + y, origin[1] + start)
            offset = fill_words(key, place, PRNU, length, words)
            for x in range(length):
                normals[x] = exact_normal(words[offset + x], quantiles)
            for x in range(length):
                out[y, start + x] = np.float32(max(1 + prnu_std * normals[x], 0.0))


# ------------------------------------------------------------------------------ shot and read noise, and little else

_ROUND32, _LOW16 = np.float32(1.5 * 2.0**23), np.uint32(0xFFFF)
_0F, _HALF = np.float32(0), np.float32(0.5)
MOST_E = 2.0**22
"""Up to so many electrons the plain form keeps counts in single precision, which holds whole numbers up to 2**24."""
QUICK_SLACK = 2.0**-21
"""What single precision adds to the error of a quick DN, in units of it and of what it is a sum of."""


class _Plain(NamedTuple):
    """What the noisy frame of shot and read noise is made with, beside offsets that a row's sites share in turn."""

    dn_per_e: float
    read_std_dn: float
    read: Quantiles
    read_purpose: np.uint64
    rows_dn: Float  # [H]
    errors_dn: Float  # [2, CHUNK]
    slack_dn: float  # what a quick DN is off by, beside a share of it
    reach: tuple[np.float32, np.float32]


OF_PLAIN = frozenset({"heteroscedastic", "shot", "read", "row", "black_error", "quantise"})


def is_plain(plan: Plan) -> bool:
    """Whether the noise is that of `_plain_pair`; else it is `_physical_pair`'s."""
    (a_dn, b_dn2), physics = plan.variance_line, plan.physics
    dn_per_e, read_std_dn = (a_dn, b_dn2) if physics is None else (physics.dn_per_e, physics.read_std_dn)
    return (
        OF_PLAIN.issuperset(plan.effects)
        and not plan.averaged
        and plan.saturated != "pinned"
        and a_dn > 0
        and b_dn2 > 0
        and read_std_dn > 0
        and plan.white_level_dn - plan.black_level_dn < MOST_E * dn_per_e
    )


def _plain(body: _Body, scene: Scene) -> _Plain:
    farthest_dn = body.read_std_dn * float(np.abs(body.read.quadratics[0]).max())
    offset_dn = float(np.abs(body.rows_dn).max(initial=0.0) + np.abs(body.errors_dn).max()) + scene.levels_dn[0]
    slack_dn = body.read_std_dn * body.read.error + QUICK_SLACK * (2 * farthest_dn + 2 * offset_dn + 0.5)
    return _Plain(
        body.dn_per_e,
        body.read_std_dn,
        body.read,
        body.read_purpose,
        body.rows_dn,
        body.errors_dn,
        slack_dn,
        body.reach,
    )


class _Desk(NamedTuple):
    """What a run of pixels is worked on in, by whole blocks; see `poisson.Counting`."""

    clean: Room  # of which ``unrounded`` is what noise is made of
    rates: Float
    whole: NDArray[np.float32]
    part: NDArray[np.float32]
    root: NDArray[np.float32]
    inverse: NDArray[np.float32]
    near: NDArray[np.float32]
    read: NDArray[np.float32]
    base: NDArray[np.float32]
    shot_words: NDArray[np.uint32]
    read_words: NDArray[np.uint32]
    counting: Counting


def _make_desk() -> _Desk:
    size = CHUNK + BLOCK
    whole, part, root, inverse, near, read, base = np.zeros((7, size), dtype=np.float32)
    words, clean, rates = np.zeros((2, size), dtype=np.uint32), make_room(CHUNK), np.zeros(size)
    return _Desk(clean, rates, whole, part, root, inverse, near, read, base, words[0], words[1], room_for(CHUNK))


@kernel
def _plain_pair(
    srgb: Srgb,
    given: Float,
    scene: Scene,
    key: Key,
    limits_dn: tuple[float, float],
    origin: tuple[int, int],
    plain: _Plain,
    tables: PoissonTables,
    normal: Quantiles,
    desk: _Desk,
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill ``clean``, ``noisy`` and ``counts``; only the last two where an unrounded clean frame is ``given``."""
    height, width = noisy.shape
    run, bared, tally, room = bare_room(desk.clean), bare_scene(scene), bare(counts, 0), desk.counting
    unrounded, rates = desk.clean.unrounded, desk.rates
    whole, part, root, inverse, near = desk.whole, desk.part, desk.root, desk.inverse, desk.near
    read, base, shot_words, read_words = desk.read, desk.base, desk.shot_words, desk.read_words
    normals, lines, read_lines = room.normals, normal.lines, plain.read.lines
    pairs, flags, eights, listed, quadratics = room.pairs, room.open, room.eights, room.listed, plain.read.quadratics
    black, purposes = scene.levels_dn[0], (SHOT | key[2], plain.read_purpose | key[2])
    dn_per_e, read_std_dn, reach = plain.dn_per_e, plain.read_std_dn, plain.reach
    for y in range(height):
        errors_dn, row_dn = plain.errors_dn[y & 1], plain.rows_dn[y]
        for x in range(CHUNK):
            base[x] = np.float32(black + (row_dn + errors_dn[x]))
        for start in range(0, width, CHUNK):
            n, at = min(CHUNK, width - start), y * width + start
            first, after, block, blocks = blocks_of(origin[1] + start, n)
            if given.shape[0] > 0:
                copy(n, bare(given, at), bare(run.unrounded, first))
            else:
                fill_clean(bare(srgb, 3 * at), srgb.itemsize == 1, y, first, n, bared, run, bare(clean, at), tally)
            _fill_draws(
                key, block, blocks, np.uint64(origin[0] + y), purposes, black, dn_per_e, unrounded,
                rates, whole, part, root, inverse, shot_words, read_words,
            )  # fmt: skip
            words, run_rates, electrons = shot_words[first:after], rates[first:after], whole[first:after]
            quick_normals(words, lines, pairs, normals[:n])
            parts, roots = part[first:after], root[first:after]
            if reach[1] < np.inf and all_near_normal(roots, reach):
                normal_counts(parts, roots, normals, electrons)
            else:
                short_counts(parts, roots, inverse[first:after], normals, reach, electrons, near)
                flag(near, n, flags)
                left = list_open(flags, eights, n, listed)
                if left > 0:
                    settle(words, run_rates, normal, tables, room, left, electrons)
            words = read_words[first:after]
            quick_normals(words, read_lines, pairs, read[:n])
            _add_read(electrons, read, dn_per_e, read_std_dn, plain.slack_dn, base, near)
            flag(near, n, flags)
            left = list_open(flags, eights, n, listed)
            if left > 0:
                for m in range(left):
                    x = listed[m]
                    dn = np.float64(electrons[x]) * dn_per_e + black
                    dn = dn + read_std_dn * exact_normal(words[x], quadratics)
                    read[x] = np.float32(((dn + (row_dn + errors_dn[x])) + ROUND) - ROUND)
            _digitise_whole(read, limits_dn, noisy[y, start : start + n], counts)


@inner
def _fill_draws(
    key: Key,
    first_block: int,
    blocks: int,
    y: np.uint64,
    purposes: tuple[np.uint64, np.uint64],
    black: float,
    dn_per_e: float,
    unrounded: Float,
    rates: Float,
    whole: NDArray[np.float32],
    part: NDArray[np.float32],
    root: NDArray[np.float32],
    inverse: NDArray[np.float32],
    shot_words: NDArray[np.uint32],
    read_words: NDArray[np.uint32],
) -> None:
    """Fill the words of shot and read noise; and the rates, what the short form of counts wants of them.

    All in one loop: divisions and roots keep the divider busy, Philox all the rest.
    """
    for block in range(blocks):
        counter = np.uint64((first_block + block) * LANES)
        at = block * BLOCK
        for lane in range(LANES):
            x0 = at + lane
            x1, x2, x3 = x0 + LANES, x0 + 2 * LANES, x0 + 3 * LANES
            rate0, rate1 = (unrounded[x0] - black) / dn_per_e, (unrounded[x1] - black) / dn_per_e
            rate2, rate3 = (unrounded[x2] - black) / dn_per_e, (unrounded[x3] - black) / dn_per_e
            whole0, whole1 = (rate0 + ROUND) - ROUND, (rate1 + ROUND) - ROUND
            whole2, whole3 = (rate2 + ROUND) - ROUND, (rate3 + ROUND) - ROUND
            rates[x0], rates[x1], rates[x2], rates[x3] = rate0, rate1, rate2, rate3
            whole[x0], part[x0] = np.float32(whole0), np.float32(rate0 - whole0)
            whole[x1], part[x1] = np.float32(whole1), np.float32(rate1 - whole1)
            whole[x2], part[x2] = np.float32(whole2), np.float32(rate2 - whole2)
            whole[x3], part[x3] = np.float32(whole3), np.float32(rate3 - whole3)
            root0, root1 = np.sqrt(np.float32(rate0)), np.sqrt(np.float32(rate1))
            root2, root3 = np.sqrt(np.float32(rate2)), np.sqrt(np.float32(rate3))
            root[x0], root[x1], root[x2], root[x3] = root0, root1, root2, root3
            inverse[x0], inverse[x1] = np.float32(1) / root0, np.float32(1) / root1
            inverse[x2], inverse[x3] = np.float32(1) / root2, np.float32(1) / root3
            c0, c1, c2, c3 = counter + np.uint64(lane), y, purposes[0], key[3]
            d0, d1, d2, d3 = counter + np.uint64(lane), y, purposes[1], key[3]
            k0, k1 = key[0], key[1]
            for _ in range(ROUNDS):
                c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
                d0, d1, d2, d3 = philox_round(d0, d1, d2, d3, k0, k1)
                k0, k1 = (k0 + STEP0) & LOW32, (k1 + STEP1) & LOW32
            shot_words[x0], shot_words[x1] = np.uint32(c0 & LOW32), np.uint32(c1 & LOW32)
            shot_words[x2], shot_words[x3] = np.uint32(c2 & LOW32), np.uint32(c3 & LOW32)
            read_words[x0], read_words[x1] = np.uint32(d0 & LOW32), np.uint32(d1 & LOW32)
            read_words[x2], read_words[x3] = np.uint32(d2 & LOW32), np.uint32(d3 & LOW32)


@inner
def _add_read(
    electrons: NDArray[np.float32],
    read: NDArray[np.float32],
    dn_per_e: float,
    read_std_dn: float,
    slack_dn: float,
    base: NDArray[np.float32],
    near: NDArray[np.float32],
) -> None:
    """Replace normals by quick DN; ``near`` is not negative where they could round otherwise than exact ones."""
    per_e, std, slack = np.float32(dn_per_e), np.float32(read_std_dn), np.float32(slack_dn - 0.5)
    for x in range(electrons.shape[0]):
        dn = electrons[x] * per_e + (std * read[x] + base[x])
        rounded = (dn + _ROUND32) - _ROUND32
        near[x] = abs(dn - rounded) + (abs(dn) * np.float32(QUICK_SLACK) + slack)
        read[x] = rounded


@inner
def _digitise_whole(
    whole_dn: NDArray[np.float32], limits_dn: tuple[float, float], noisy: Raw, counts: NDArray[np.int64]
) -> None:
    """Clip and cast whole numbers."""
    low, high = np.float32(limits_dn[0]), np.float32(limits_dn[1])
    below, above = np.int32(0), np.int32(0)
    for x in range(noisy.shape[0]):
        below = np.int32(below + (whole_dn[x] < low))
        above = np.int32(above + (whole_dn[x] > high))
        noisy[x] = np.uint16(np.int32(min(max(whole_dn[x], low), high)))
    counts[2] += below
    counts[3] += above


# ------------------------------------------------------------------------------------------------------- every effect


@kernel
def _physical_pair(
    srgb: Srgb,
    scene: Scene,
    key: Key,
    limits_dn: tuple[float, float],
    origin: tuple[int, int],
    body: _Body,
    tables: PoissonTables,
    normal: Quantiles,
    buffers: _Buffers,
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill ``clean``, ``noisy`` and ``counts`` with the pair of a physical profile, row by row."""
    height, width = clean.shape
    light, unrounded, bared = buffers.light, buffers.unrounded, bare_scene(scene)
    for y in range(height):
        for start in range(0, width, CHUNK):
            n = min(CHUNK, width - start)
            fill_signal(bare(srgb, 3 * (y * width + start)), srgb.itemsize == 1, y, n, bared, bare(light, 0))
            fill_light(light[:n], scene.site_gains[y & 1], scene.site_headroom[y & 1], scene, light)
            if body.responds and body.averaged:
                for x in range(n):
                    light[x] = light[x] * body.response[y, start + x]
            saturated = counts[4]
            fill_clean_of_light(light[:n], scene, unrounded, clean[y, start : start + n], counts)
            _fill_noisy(
                unrounded[:n], (y, start), origin, scene, key, limits_dn, body, tables, normal, buffers,
                noisy[y, start : start + n], counts,
            )  # fmt: skip
            if body.averaged:
                _average(
                    unrounded[:n], (y, start), body, scene.levels_dn[0], limits_dn, buffers, clean[y, start : start + n]
                )
                counts[4] = saturated + _saturated(clean[y, start : start + n], scene.levels_dn[2])


@kernel
def _physical_noisy(
    unrounded: Float,
    scene: Scene,
    key: Key,
    limits_dn: tuple[float, float],
    origin: tuple[int, int],
    body: _Body,
    tables: PoissonTables,
    normal: Quantiles,
    buffers: _Buffers,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill ``noisy`` and ``counts`` with the noisy frame of a clean one."""
    height, width = noisy.shape
    for y in range(height):
        for start in range(0, width, CHUNK):
            end = min(start + CHUNK, width)
            _fill_noisy(
                unrounded[y, start:end], (y, start), origin, scene, key, limits_dn, body, tables, normal, buffers,
                noisy[y, start:end], counts,
            )  # fmt: skip


class _Buffers(NamedTuple):
    """What a run of pixels is worked on in; words have room for whole blocks around it."""

    light: Float
    unrounded: Float
    signal: Float
    rates: Float
    drawn: Float
    electrons: Float
    noisy_dn: Float
    hot_e: Float
    dead: NDArray[np.bool_]
    words: NDArray[np.uint32]
    room: Counting


def _make_buffers() -> _Buffers:
    light, unrounded, signal, rates, drawn, electrons, noisy_dn, hot_e = np.zeros((8, CHUNK))
    words, dead = np.zeros(CHUNK + BLOCK, dtype=np.uint32), np.zeros(CHUNK, dtype=np.bool_)
    of_counts = words, room_for(CHUNK)
    return _Buffers(light, unrounded, signal, rates, drawn, electrons, noisy_dn, hot_e, dead, *of_counts)


@inner
def _fill_noisy(
    unrounded: Float,
    at: tuple[int, int],
    origin: tuple[int, int],
    scene: Scene,
    key: Key,
    limits_dn: tuple[float, float],
    body: _Body,
    tables: PoissonTables,
    normal: Quantiles,
    buffers: _Buffers,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Make a run of pixels of the noisy frame, from ``at`` in the cut-out on: `effects.physical`."""
    n, (y, start), black = unrounded.shape[0], at, scene.levels_dn[0]
    place = (origin[0] + y, origin[1] + start)
    signal, words, noisy_dn = buffers.signal, buffers.words, buffers.noisy_dn
    for x in range(n):
        signal[x] = (unrounded[x] - black) / body.dn_per_e
    if body.responds and not body.averaged:
        for x in range(n):
            signal[x] = signal[x] * body.response[y, start + x]
    hot = _fill_stuck(body, place, n, buffers) if body.hot_below or body.dead_below else 0
    electrons, drawn, rates = buffers.signal, buffers.drawn, buffers.rates
    for purpose_word in (SHOT, DARK, HOT):
        if purpose_word == SHOT:
            if not body.shot:
                continue
            means = buffers.signal
        elif purpose_word == DARK:
            if not body.dark:
                continue
            rates[:n] = body.dark_e
            means = rates
        else:
            if hot == 0:
                continue
            means = buffers.hot_e
        offset = fill_words(key, place, purpose_word, n, words)
        draw_counts(words[offset : offset + n], means[:n], normal, tables, buffers.room, drawn[:n])
        if purpose_word == SHOT:
            if body.reach[1] < np.inf:
                _draw_normals(means, body.reach, buffers.room.normals, drawn, n)
            electrons, drawn = drawn, buffers.electrons
        else:
            removed_e = body.removed_e if purpose_word == DARK else 0.0
            for x in range(n):
                electrons[x] = electrons[x] + (drawn[x] - removed_e)
    offset = 0
    if body.read_std_dn > 0.0:
        offset = fill_words(key, place, body.read_purpose, n, words)
    _digitise(electrons[:n], words[offset : offset + n], body, at, black, buffers.room, noisy_dn)
    if body.dead_below:
        for x in range(n):
            noisy_dn[x] = 0.0 if buffers.dead[x] else noisy_dn[x]
    read_out(unrounded, noisy_dn, scene, limits_dn, noisy, counts)


@inner
def _draw_normals(
    rates: Float, reach: tuple[np.float32, np.float32], normals: NDArray[np.float32], drawn: Float, count: int
) -> None:
    """Replace counts by `poisson.normal_counts`, in the order of that."""
    for x in range(count):
        whole = (rates[x] + ROUND) - ROUND
        root = np.sqrt(np.float32(rates[x]))
        electrons = np.float32(whole) + (np.float32(rates[x] - whole) + root * normals[x])
        drawn[x] = drawn[x] if root > reach[0] and root < reach[1] else np.float64(electrons)


@inner
def _fill_stuck(body: _Body, place: tuple[int, int], n: int, buffers: _Buffers) -> int:
    """Find the hot pixels with their mean excess (`effects.hot_pixel_means`) and the dead; return how many are hot."""
    hot_e, words, hot = buffers.hot_e, buffers.words, 0
    for purpose_word in (DEAD, HOT, HOT_STEP):
        if (purpose_word == DEAD and not body.dead_below) or (purpose_word == HOT and not body.hot_below):
            continue
        if purpose_word == HOT_STEP and hot == 0:
            continue
        offset = fill_words(body.key, place, purpose_word, n, words)
        if purpose_word == DEAD:
            for x in range(n):
                buffers.dead[x] = words[offset + x] < body.dead_below
        elif purpose_word == HOT:
            for x in range(n):
                hot_e[x] = 1.0 if words[offset + x] < body.hot_below else 0.0
                hot += words[offset + x] < body.hot_below
        else:
            for x in range(n):
                if hot_e[x] > 0.0:
                    hot_e[x] = body.hot_e * body.levels[words[offset + x] >> np.uint32(22)]
    return hot


@inner
def _digitise(
    electrons: Float,
    words: NDArray[np.uint32],
    body: _Body,
    at: tuple[int, int],
    black: float,
    room: Counting,
    out: Float,
) -> None:
    """Go from electrons to DN, and add what is added there: read noise, rows, columns, black errors.

    The read noise is a quick one; where that could round to another DN, it is the exact one.
    """
    full_well_e, dn_per_e, read_std_dn, row_dn = body.full_well_e, body.dn_per_e, body.read_std_dn, body.rows_dn[at[0]]
    columns_dn, errors_dn, normals = body.columns_dn[at[1] :], body.errors_dn[at[0] & 1], room.normals
    count, read = electrons.shape[0], body.read
    if read_std_dn > 0.0:
        quick_normals(words, read.lines, room.pairs, normals[:count])
    else:
        normals[:count] = np.float32(0.0)
    near = 0.5 - (read_std_dn * read.error + HALF_SLACK)
    unsure = 0
    for x in range(count):
        dn = min(electrons[x], full_well_e) * dn_per_e + black
        out[x] = (dn + read_std_dn * np.float64(normals[x])) + ((row_dn + columns_dn[x]) + errors_dn[x])
        unsure += abs(out[x] - ((out[x] + ROUND) - ROUND)) > near
    if unsure > 0 and read_std_dn > 0.0:
        for x in range(count):
            if abs(out[x] - ((out[x] + ROUND) - ROUND)) > near:
                dn = min(electrons[x], full_well_e) * dn_per_e + black
                exact_dn = dn + read_std_dn * exact_normal(words[x], read.quadratics)
                out[x] = exact_dn + ((row_dn + columns_dn[x]) + errors_dn[x])


@inner
def _average(
    unrounded: Float,
    at: tuple[int, int],
    body: _Body,
    black: float,
    limits_dn: tuple[float, float],
    buffers: _Buffers,
    clean: Raw,
) -> None:
    """Round the clean frame anew, with what an average of many frames keeps of the body: `effects.average`.

    ``buffers`` still hold which pixels are hot and dead.
    """
    (y, start), (low, high) = at, limits_dn
    full_dn = body.full_well_e * body.dn_per_e + black
    dark_dn = body.dark_e * body.dn_per_e if body.dark and body.removed_e == 0.0 else 0.0
    for x in range(unrounded.shape[0]):
        hot_dn = buffers.hot_e[x] * body.dn_per_e if body.hot_below else 0.0
        dn = min((unrounded[x] + hot_dn) + dark_dn, full_dn)
        dn = dn + ((0.0 + body.columns_dn[start + x]) + body.errors_dn[y & 1, x])
        dn = 0.0 if body.dead_below and buffers.dead[x] else dn
        clean[x] = np.uint16(np.int32(min(max((dn + ROUND) - ROUND, low), high)))


@inner
def _saturated(clean: Raw, white: float) -> int:
    count = 0
    for x in range(clean.shape[0]):
        count += clean[x] == white
    return count
