"""Simulate pairs whose noise is generated in electrons, effect by effect: the kernels of `reference.noise.physical`.

Contract: the same DN as `pair.reference_pair` on every CPU, by the means described in `gaussian`. Counts and read noise
use approximate normals; sites near a rounding boundary are recomputed with exact ones.

Most frames need only shot and read noise with row and black-level errors: `_fill_shot_read_pair`. For all effects,
`_fill_physical_pair` takes about 1.5 times as long. The PRNU of a sensor unit is cached between its frames.

Timings and rejected alternatives: ``docs/design/kernels.md``.
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
from unprocess_gen.simulation.kernels.clean import (
    PairParameters,
    fill_clean,
    fill_clean_from_light,
    fill_scene_light,
    fill_signal,
    pair_parameters,
    parameter_pointers,
)
from unprocess_gen.simulation.kernels.gaussian import HETEROSCEDASTIC
from unprocess_gen.simulation.kernels.normal import (
    QuantileTables,
    build_quantile_tables,
    exact_value,
    fill_approximate_values,
    normal_quantile_tables,
)
from unprocess_gen.simulation.kernels.philox import (
    KEY_STEP0,
    KEY_STEP1,
    LOW32,
    PhiloxKey,
    fill_segment_words,
    philox_key,
    philox_round,
)
from unprocess_gen.simulation.kernels.poisson import (
    CountBuffers,
    allocate_count_buffers,
    approximate_counts,
    compact_indices,
    fill_counts,
    fill_normal_counts,
    flag_uncertain,
    none_within,
    recompute_exact_counts,
)
from unprocess_gen.simulation.kernels.readout import read_out
from unprocess_gen.simulation.kernels.rounding import ROUND, ROUND32
from unprocess_gen.simulation.kernels.segments import (
    LONG_SEGMENT,
    Float32,
    Indices,
    SegmentBuffers,
    allocate_buffers,
    allocate_frames,
    buffer_pointers,
    copy_values,
    frames_to_pairs,
    locate_blocks,
)
from unprocess_gen.simulation.kernels.simd import pointer_to
from unprocess_gen.simulation.reference import noise as reference_noise
from unprocess_gen.simulation.reference.poisson import Tables as PoissonTables
from unprocess_gen.simulation.reference.poisson import gaussian_from, poisson_tables

PRNU, SHOT, DARK, HOT, DEAD = (
    np.uint64(purpose(stream)) for stream in ("prnu", "shot", "dark_current", "hot_pixels", "dead_pixels")
)
HOT_STEP = np.uint64(purpose("hot_pixels", draw=1))

DOUBLE_ERROR_DN = 2.0**-30
"""Bound of the rounding error of sums in float64, for levels of up to 16 bits."""
FLOAT32_ERROR_DN = 2.0**-21
"""Error that float32 adds to an approximate DN, relative to the DN and to its summands."""
MAX_SHOT_READ_E = 2.0**22
"""Most electrons at white for `_fill_shot_read_pair`, which counts in float32 (exact integers up to 2**24)."""

MIN_READ_STD_E = 0.5
"""Least standard deviation of read noise with which a normal may replace counts.

Below it the steps of single electrons show, which no normal has: the Kolmogorov distance is 0.2/√rate without read
noise and 0.001/√rate at this value, in addition to the 0.07/√rate of `accuracy.gaussian_distance` (skewness).
"""

SHOT_READ_EFFECTS = frozenset({"heteroscedastic", "shot", "read", "row", "black_error", "quantise"})
"""Effects that `_fill_shot_read_pair` simulates."""


# --------------------------------------------------------------------------------------------------------- entry points


def make_pair(
    srgb: Srgb,
    plan: Plan,
    curve: Float,
    limits_dn: tuple[float, float],
    origin: tuple[int, int] = (0, 0),
) -> Pair:
    """Simulate a pair of a physical profile, or of a two-parameter profile by Poisson counts.

    Parameters
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        Display-referred codes.
    plan : Plan
        All parameters of the pair.
    curve : ndarray of float64, [codes]
        Linear value of each code.
    limits_dn : (float, float)
        Lowest and highest DN of the noisy frame.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame.

    Returns
    -------
    Pair
        Clean and noisy frame, uint16 ``[H, W]``, and their counts.
    """
    clean, noisy, counts = frames = allocate_frames(srgb)
    parameters = pair_parameters(plan, curve, srgb.shape, origin)
    key = philox_key(plan.stream_key, plan.level, plan.draw, plan.frame)
    sensor, tables, normal = _sensor_parameters(plan, srgb.shape, origin), poisson_tables(), normal_quantile_tables()
    codes = np.ascontiguousarray(srgb)
    if has_only_shot_and_read(plan):
        no_frame, effects = np.empty((0, 0)), _shot_read_parameters(sensor, parameters)
        _fill_shot_read_pair(
            codes, no_frame, parameters, key, limits_dn, origin, effects, tables, normal,
            _allocate_shot_read_buffers(), clean, noisy[0], counts[0],
        )  # fmt: skip
    else:
        _fill_physical_pair(
            codes, parameters, key, limits_dn, origin, sensor, tables, normal, _allocate_physical_buffers(), clean,
            noisy[0], counts[0],
        )  # fmt: skip
    return frames_to_pairs(*frames)[0]


def make_noisy(
    unrounded_dn: Float, plan: Plan, limits_dn: tuple[float, float], origin: tuple[int, int] = (0, 0)
) -> tuple[Raw, NDArray[np.int64]]:
    """Simulate only the noisy frame, for a further noise level or draw of a clean frame.

    Parameters
    ----------
    unrounded_dn : ndarray of float64, [H, W]
        Clean frame before rounding, DN.
    plan : Plan
        All parameters of the pair.
    limits_dn : (float, float)
        Lowest and highest DN of the noisy frame.
    origin : (int, int)
        Row and column of ``unrounded_dn[0, 0]`` in the full frame.

    Returns
    -------
    noisy : ndarray of uint16, [H, W]
        Noisy frame of `make_pair`, bit for bit.
    counts : ndarray of int64, [6]
        Numbers of `Counts` in their order; 0 for those of the clean frame.

    Raises
    ------
    ValueError
        If the clean frame depends on the sensor unit or the noise level: fixed patterns in it, or a full well.
    """
    if plan.averaged or "full_well" in plan.effects:
        raise ValueError(
            "clean frame depends on the noise level: it has fixed patterns or a full well; simulate the complete pair"
        )
    noisy = np.empty(unrounded_dn.shape, dtype=np.uint16)
    counts = np.zeros(6, dtype=np.int64)
    parameters = pair_parameters(plan, np.zeros(1), unrounded_dn.shape, origin)  # no code is looked up
    key = philox_key(plan.stream_key, plan.level, plan.draw, plan.frame)
    sensor, tables = _sensor_parameters(plan, unrounded_dn.shape, origin), poisson_tables()
    normal, frame = normal_quantile_tables(), np.ascontiguousarray(unrounded_dn)
    if has_only_shot_and_read(plan):
        no_codes, no_clean = np.empty((0, 0, 3), dtype=np.uint8), np.empty((0, 0), np.uint16)
        _fill_shot_read_pair(
            no_codes, frame, parameters, key, limits_dn, origin, _shot_read_parameters(sensor, parameters), tables,
            normal, _allocate_shot_read_buffers(), no_clean, noisy, counts,
        )  # fmt: skip
    else:
        _fill_physical_noisy(
            frame, parameters, key, limits_dn, origin, sensor, tables, normal, _allocate_physical_buffers(), noisy,
            counts,
        )  # fmt: skip
    return noisy, counts


def has_only_shot_and_read(plan: Plan) -> bool:
    """Return whether `_fill_shot_read_pair` can simulate the noise of a plan; otherwise `_fill_physical_pair` does."""
    (a_dn, b_dn2), physics = plan.variance_line, plan.physics
    dn_per_e, read_std_dn = (a_dn, b_dn2) if physics is None else (physics.dn_per_e, physics.read_std_dn)
    return (
        SHOT_READ_EFFECTS.issuperset(plan.effects)
        and not plan.averaged
        and plan.saturated != "pinned"
        and a_dn > 0
        and b_dn2 > 0
        and read_std_dn > 0
        and plan.white_level_dn - plan.black_level_dn < MAX_SHOT_READ_E * dn_per_e
    )


# ----------------------------------------------------------------------------------------------------------- parameters


class _SensorParameters(NamedTuple):
    """Hold the parameters of the noisy frame; comments give the values that disable an effect."""

    dn_per_e: float
    response: Float32  # [H, W] PRNU; [1, 1]: off
    has_prnu: bool
    averaged: bool  # whether the clean frame also contains the fixed patterns
    shot: bool
    dark: bool
    dark_e: float
    removed_e: float  # mean dark signal that the camera subtracts
    hot_below: np.uint64  # a pixel with a smaller word is hot; 0: off
    hot_e: float
    levels: Float
    full_well_e: float  # infinity: off
    read_std_dn: float  # 0: off
    read: QuantileTables
    rows_dn: Float  # [H]
    columns_dn: Float  # [W]
    errors_dn: Float  # [2, LONG_SEGMENT]: black-level errors of even and of odd rows
    dead_below: np.uint64  # a pixel with a smaller word is dead; 0: off
    read_purpose: np.uint64
    key: PhiloxKey  # of the sensor unit
    count_roots: tuple[np.float32, np.float32]  # roots of the mean electrons between which shot noise is counted


def _sensor_parameters(plan: Plan, shape: tuple[int, ...], origin: tuple[int, int]) -> _SensorParameters:
    """Return the parameters of the effects that a plan simulates, also for the Poisson form of two-parameter noise."""
    physics = plan.physics
    if physics is None:
        return _two_parameter_sensor(plan, shape)
    on = frozenset(plan.effects)
    no_prnu = np.ones((1, 1), np.float32)
    return _SensorParameters(
        dn_per_e=physics.dn_per_e,
        response=prnu_response(physics.body_key, physics.prnu_std, *shape[:2], origin) if "prnu" in on else no_prnu,
        has_prnu="prnu" in on,
        averaged=plan.averaged,
        shot="shot" in on,
        dark="dark_current" in on,
        dark_e=physics.dark_e,
        removed_e=physics.dark_e if physics.dark_offset == "removed" else 0.0,
        hot_below=word_threshold(physics.hot_pixel_share) if "hot_pixels" in on else np.uint64(0),
        hot_e=physics.hot_pixel_e,
        levels=exponential_levels(),
        full_well_e=physics.full_well_e if "full_well" in on else np.inf,
        read_std_dn=physics.read_std_dn if "read" in on else 0.0,
        read=_read_quantile_tables(physics),
        rows_dn=reference_noise.row(plan, shape[0], origin[0]) if "row" in on else np.zeros(shape[0]),
        columns_dn=reference_noise.column(physics, shape[1], origin[1]) if "column" in on else np.zeros(shape[1]),
        errors_dn=(
            reference_noise.black_error(physics, (2, LONG_SEGMENT), origin)
            if "black_error" in on
            else np.zeros((2, LONG_SEGMENT))
        ),
        dead_below=word_threshold(physics.dead_pixel_share) if "dead_pixels" in on else np.uint64(0),
        read_purpose=np.uint64(purpose("read")),
        key=philox_key(physics.body_key),
        count_roots=_count_root_range(plan, physics.read_std_dn / physics.dn_per_e if "read" in on else 0.0),
    )


def _two_parameter_sensor(plan: Plan, shape: tuple[int, ...]) -> _SensorParameters:
    """Return a sensor with shot and read noise only, whose variance line is that of the plan."""
    a_dn, b_dn2 = plan.variance_line
    dn_per_e, read_std_dn = a_dn or 1.0, float(np.sqrt(max(b_dn2, 0.0)))
    return _SensorParameters(
        dn_per_e=dn_per_e,
        response=np.ones((1, 1), np.float32),
        has_prnu=False,
        averaged=False,
        shot=a_dn > 0,
        dark=False,
        dark_e=0.0,
        removed_e=0.0,
        hot_below=np.uint64(0),
        hot_e=0.0,
        levels=exponential_levels(),
        full_well_e=np.inf,
        read_std_dn=read_std_dn,
        read=normal_quantile_tables(),
        rows_dn=np.zeros(shape[0]),
        columns_dn=np.zeros(shape[1]),
        errors_dn=np.zeros((2, LONG_SEGMENT)),
        dead_below=np.uint64(0),
        read_purpose=HETEROSCEDASTIC,
        key=philox_key(0),
        count_roots=_count_root_range(plan, read_std_dn / dn_per_e),
    )


def _count_root_range(plan: Plan, read_std_e: float) -> tuple[np.float32, np.float32]:
    """Return the square roots of the mean electrons between which a normal is too far from the counts."""
    lowest, highest = 0.0, np.inf  # without light no count is needed
    if "shot:gaussian_where_near" in plan.methods and read_std_e >= MIN_READ_STD_E:
        lowest, highest = np.sqrt(gaussian_from(read_std_e, plan.law_distance))
    return np.float32(lowest), np.float32(highest)


def _read_quantile_tables(physics: Physics) -> QuantileTables:
    if physics.read_law == "gaussian":
        return normal_quantile_tables()
    return build_quantile_tables(reference_noise.read_table(physics))


def word_threshold(fraction: float) -> np.uint64:
    """Return the word below which this fraction of all words is, as in `reference.noise.is_among`."""
    return np.uint64(int(fraction * 2**32))


@functools.lru_cache(maxsize=1)
def prnu_response(body_key: int, prnu_std: float, height: int, width: int, origin: tuple[int, int]) -> Float32:
    """Return the PRNU of a sensor unit, float32 ``[H, W]`` of mean 1; cached for its next frame."""
    response = np.empty((height, width), dtype=np.float32)
    _fill_prnu_response(philox_key(body_key), prnu_std, origin, normal_quantile_tables().quadratics, response)
    return response


@kernel
def _fill_prnu_response(
    key: PhiloxKey,
    prnu_std: float,
    origin: tuple[int, int],
    quantiles: tuple[Float, Float, Float],
    out: Float32,
) -> None:
    """Fill ``out`` with 1 plus normal deviates of standard deviation ``prnu_std``, but at least 0."""
    words, normals = np.empty(LONG_SEGMENT + BLOCK, dtype=np.uint32), np.empty(LONG_SEGMENT)
    for y in range(out.shape[0]):
        for start in range(0, out.shape[1], LONG_SEGMENT):
            length = min(LONG_SEGMENT, out.shape[1] - start)
            position = (origin[0] + y, origin[1] + start)
            offset = fill_segment_words(key, position, PRNU, length, words)
            for x in range(length):
                normals[x] = exact_value(words[offset + x], quantiles)
            for x in range(length):
                out[y, start + x] = np.float32(max(1 + prnu_std * normals[x], 0.0))


# -------------------------------------------------------------------------------------------------- shot and read noise


class _ShotReadParameters(NamedTuple):
    """Hold the parameters of shot and read noise with row and black-level errors."""

    dn_per_e: float
    read_std_dn: float
    read: QuantileTables
    read_purpose: np.uint64
    rows_dn: Float  # [H]
    errors_dn: Float  # [2, LONG_SEGMENT]: of even and of odd rows
    error_dn: float  # bound of the error of an approximate DN, in addition to FLOAT32_ERROR_DN times the DN
    count_roots: tuple[np.float32, np.float32]


def _shot_read_parameters(sensor: _SensorParameters, parameters: PairParameters) -> _ShotReadParameters:
    """Return the parameters of `_fill_shot_read_pair`, with the error bound of its approximate DN."""
    farthest_dn = sensor.read_std_dn * float(np.abs(sensor.read.quadratics[0]).max())
    offsets_dn = float(np.abs(sensor.rows_dn).max(initial=0.0) + np.abs(sensor.errors_dn).max())
    offset_dn = offsets_dn + parameters.levels_dn[0]
    error_dn = sensor.read_std_dn * sensor.read.error + FLOAT32_ERROR_DN * (2 * farthest_dn + 2 * offset_dn + 0.5)
    return _ShotReadParameters(
        dn_per_e=sensor.dn_per_e,
        read_std_dn=sensor.read_std_dn,
        read=sensor.read,
        read_purpose=sensor.read_purpose,
        rows_dn=sensor.rows_dn,
        errors_dn=sensor.errors_dn,
        error_dn=error_dn,
        count_roots=sensor.count_roots,
    )


class _ShotReadBuffers(NamedTuple):
    """Hold the scratch arrays for one segment of a row, padded to complete blocks of 64 pixels."""

    clean: SegmentBuffers  # its unrounded_dn is the input of the noise
    rates: Float
    rounded: Float32  # rates rounded, then electrons
    residual: Float32  # rates - rounded
    root: Float32
    inverse: Float32
    excess: Float32  # see `poisson.CountBuffers`
    read: Float32  # normals, then DN
    base_dn: Float32  # black level, row and black-level error
    shot_words: Indices
    read_words: Indices
    counts: CountBuffers


def _allocate_shot_read_buffers() -> _ShotReadBuffers:
    size = LONG_SEGMENT + BLOCK
    rounded, residual, root, inverse, excess, read, base_dn = np.zeros((7, size), dtype=np.float32)
    words, clean, rates = np.zeros((2, size), dtype=np.uint32), allocate_buffers(LONG_SEGMENT), np.zeros(size)
    return _ShotReadBuffers(
        clean, rates, rounded, residual, root, inverse, excess, read, base_dn, words[0], words[1],
        allocate_count_buffers(LONG_SEGMENT),
    )  # fmt: skip


@kernel
def _fill_shot_read_pair(
    srgb: Srgb,
    unrounded_frame: Float,
    parameters: PairParameters,
    key: PhiloxKey,
    limits_dn: tuple[float, float],
    origin: tuple[int, int],
    effects: _ShotReadParameters,
    tables: PoissonTables,
    normal: QuantileTables,
    buffers: _ShotReadBuffers,
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill both frames and the counts; with a non-empty ``unrounded_frame``, only the noisy frame and its counts."""
    height, width = noisy.shape
    segment, pointers, of_clean = buffer_pointers(buffers.clean), parameter_pointers(parameters), pointer_to(counts, 0)
    unrounded_dn, rates, count_buffers = buffers.clean.unrounded_dn, buffers.rates, buffers.counts
    rounded, residual, root, inverse = buffers.rounded, buffers.residual, buffers.root, buffers.inverse
    excess, read, base_dn = buffers.excess, buffers.read, buffers.base_dn
    shot_words, read_words = buffers.shot_words, buffers.read_words
    normals, lines, read_lines = count_buffers.normals, normal.lines, effects.read.lines
    line_buffer, quadratics = count_buffers.line_buffer, effects.read.quadratics
    flags, groups, uncertain = count_buffers.is_uncertain, count_buffers.uncertain_groups, count_buffers.uncertain
    black, purposes = parameters.levels_dn[0], (SHOT | key[2], effects.read_purpose | key[2])
    dn_per_e, read_std_dn, count_roots = effects.dn_per_e, effects.read_std_dn, effects.count_roots
    for y in range(height):
        errors_dn, row_dn = effects.errors_dn[y & 1], effects.rows_dn[y]
        for x in range(LONG_SEGMENT):
            base_dn[x] = np.float32(black + (row_dn + errors_dn[x]))
        for start in range(0, width, LONG_SEGMENT):
            n, at = min(LONG_SEGMENT, width - start), y * width + start
            first, after, block, blocks = locate_blocks(origin[1] + start, n)
            if unrounded_frame.shape[0] > 0:
                copy_values(n, pointer_to(unrounded_frame, at), pointer_to(segment.unrounded_dn, first))
            else:
                codes, target = pointer_to(srgb, 3 * at), pointer_to(clean, at)
                fill_clean(codes, srgb.itemsize == 1, y, first, n, pointers, segment, target, of_clean)
            _fill_words_and_rates(
                key, block, blocks, np.uint64(origin[0] + y), purposes, black, dn_per_e, unrounded_dn,
                rates, rounded, residual, root, inverse, shot_words, read_words,
            )  # fmt: skip
            words, segment_rates, electrons = shot_words[first:after], rates[first:after], rounded[first:after]
            fill_approximate_values(words, lines, line_buffer, normals[:n])
            residuals, roots = residual[first:after], root[first:after]
            if count_roots[1] < np.inf and none_within(roots, count_roots):
                fill_normal_counts(residuals, roots, normals, electrons)
            else:
                approximate_counts(residuals, roots, inverse[first:after], normals, count_roots, electrons, excess)
                flag_uncertain(excess, n, flags)
                found = compact_indices(flags, groups, n, uncertain)
                if found > 0:
                    recompute_exact_counts(words, segment_rates, normal, tables, count_buffers, found, electrons)
            words = read_words[first:after]
            fill_approximate_values(words, read_lines, line_buffer, read[:n])
            _add_read_noise(electrons, read, dn_per_e, read_std_dn, effects.error_dn, base_dn, excess)
            flag_uncertain(excess, n, flags)
            found = compact_indices(flags, groups, n, uncertain)
            if found > 0:
                for m in range(found):
                    x = uncertain[m]
                    dn = np.float64(electrons[x]) * dn_per_e + black
                    dn = dn + read_std_dn * exact_value(words[x], quadratics)
                    read[x] = np.float32(((dn + (row_dn + errors_dn[x])) + ROUND) - ROUND)
            _clip_rounded(read, limits_dn, noisy[y, start : start + n], counts)


@inner
def _fill_words_and_rates(
    key: PhiloxKey,
    first_block: int,
    blocks: int,
    y: np.uint64,
    purposes: tuple[np.uint64, np.uint64],
    black: float,
    dn_per_e: float,
    unrounded_dn: Float,
    rates: Float,
    rounded: Float32,
    residual: Float32,
    root: Float32,
    inverse: Float32,
    shot_words: Indices,
    read_words: Indices,
) -> None:
    """Fill the words of shot and read noise, and the mean electrons with their roots and reciprocals.

    One loop: divisions and roots keep the divider busy, Philox the other units.
    """
    for block in range(blocks):
        counter = np.uint64((first_block + block) * LANES)
        at = block * BLOCK
        for lane in range(LANES):
            x0 = at + lane
            x1, x2, x3 = x0 + LANES, x0 + 2 * LANES, x0 + 3 * LANES
            rate0, rate1 = (unrounded_dn[x0] - black) / dn_per_e, (unrounded_dn[x1] - black) / dn_per_e
            rate2, rate3 = (unrounded_dn[x2] - black) / dn_per_e, (unrounded_dn[x3] - black) / dn_per_e
            rounded0, rounded1 = (rate0 + ROUND) - ROUND, (rate1 + ROUND) - ROUND
            rounded2, rounded3 = (rate2 + ROUND) - ROUND, (rate3 + ROUND) - ROUND
            rates[x0], rates[x1], rates[x2], rates[x3] = rate0, rate1, rate2, rate3
            rounded[x0], residual[x0] = np.float32(rounded0), np.float32(rate0 - rounded0)
            rounded[x1], residual[x1] = np.float32(rounded1), np.float32(rate1 - rounded1)
            rounded[x2], residual[x2] = np.float32(rounded2), np.float32(rate2 - rounded2)
            rounded[x3], residual[x3] = np.float32(rounded3), np.float32(rate3 - rounded3)
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
                k0, k1 = (k0 + KEY_STEP0) & LOW32, (k1 + KEY_STEP1) & LOW32
            shot_words[x0], shot_words[x1] = np.uint32(c0 & LOW32), np.uint32(c1 & LOW32)
            shot_words[x2], shot_words[x3] = np.uint32(c2 & LOW32), np.uint32(c3 & LOW32)
            read_words[x0], read_words[x1] = np.uint32(d0 & LOW32), np.uint32(d1 & LOW32)
            read_words[x2], read_words[x3] = np.uint32(d2 & LOW32), np.uint32(d3 & LOW32)


@inner
def _add_read_noise(
    electrons: Float32,
    read: Float32,
    dn_per_e: float,
    read_std_dn: float,
    error_dn: float,
    base_dn: Float32,
    excess: Float32,
) -> None:
    """Replace normals in ``read`` by approximate rounded DN; a site is uncertain if its ``excess`` is not negative."""
    per_e, std, margin = np.float32(dn_per_e), np.float32(read_std_dn), np.float32(error_dn - 0.5)
    for x in range(electrons.shape[0]):
        dn = electrons[x] * per_e + (std * read[x] + base_dn[x])
        rounded = (dn + ROUND32) - ROUND32
        excess[x] = abs(dn - rounded) + (abs(dn) * np.float32(FLOAT32_ERROR_DN) + margin)
        read[x] = rounded


@inner
def _clip_rounded(rounded_dn: Float32, limits_dn: tuple[float, float], noisy: Raw, counts: NDArray[np.int64]) -> None:
    """Clip rounded DN to ``limits_dn``, cast them to uint16, and count the clipped sites."""
    low, high = np.float32(limits_dn[0]), np.float32(limits_dn[1])
    below, above = np.int32(0), np.int32(0)
    for x in range(noisy.shape[0]):
        below = np.int32(below + (rounded_dn[x] < low))
        above = np.int32(above + (rounded_dn[x] > high))
        noisy[x] = np.uint16(np.int32(min(max(rounded_dn[x], low), high)))
    counts[2] += below
    counts[3] += above


# ---------------------------------------------------------------------------------------------------------- all effects


class _PhysicalBuffers(NamedTuple):
    """Hold the scratch arrays for one segment of a row; ``words`` covers the complete blocks around it."""

    light: Float
    unrounded_dn: Float
    signal_e: Float
    rates: Float
    drawn_e: Float
    electrons: Float
    noisy_dn: Float
    hot_e: Float
    dead: NDArray[np.bool_]
    words: Indices
    counts: CountBuffers


def _allocate_physical_buffers() -> _PhysicalBuffers:
    light, unrounded_dn, signal_e, rates, drawn_e, electrons, noisy_dn, hot_e = np.zeros((8, LONG_SEGMENT))
    words, dead = np.zeros(LONG_SEGMENT + BLOCK, dtype=np.uint32), np.zeros(LONG_SEGMENT, dtype=np.bool_)
    return _PhysicalBuffers(
        light, unrounded_dn, signal_e, rates, drawn_e, electrons, noisy_dn, hot_e, dead, words,
        allocate_count_buffers(LONG_SEGMENT),
    )  # fmt: skip


@kernel
def _fill_physical_pair(
    srgb: Srgb,
    parameters: PairParameters,
    key: PhiloxKey,
    limits_dn: tuple[float, float],
    origin: tuple[int, int],
    sensor: _SensorParameters,
    tables: PoissonTables,
    normal: QuantileTables,
    buffers: _PhysicalBuffers,
    clean: Raw,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill both frames and the counts of a pair with any effects."""
    height, width = clean.shape
    light, unrounded_dn, pointers = buffers.light, buffers.unrounded_dn, parameter_pointers(parameters)
    for y in range(height):
        gains, headroom = parameters.site_gains[y & 1], parameters.site_headroom[y & 1]
        for start in range(0, width, LONG_SEGMENT):
            n = min(LONG_SEGMENT, width - start)
            codes, target = pointer_to(srgb, 3 * (y * width + start)), clean[y, start : start + n]
            fill_signal(codes, srgb.itemsize == 1, y, n, pointers, pointer_to(light, 0))
            fill_scene_light(light[:n], gains, headroom, parameters, light)
            if sensor.has_prnu and sensor.averaged:
                for x in range(n):
                    light[x] = light[x] * sensor.response[y, start + x]
            saturated = counts[4]
            fill_clean_from_light(light[:n], parameters, unrounded_dn, target, counts)
            _fill_noisy_segment(
                unrounded_dn[:n], (y, start), origin, parameters, key, limits_dn, sensor, tables, normal, buffers,
                noisy[y, start : start + n], counts,
            )  # fmt: skip
            if sensor.averaged:
                black, white = parameters.levels_dn[0], parameters.levels_dn[2]
                _fill_averaged_clean(unrounded_dn[:n], (y, start), sensor, black, limits_dn, buffers, target)
                counts[4] = saturated + _count_saturated(target, white)


@kernel
def _fill_physical_noisy(
    unrounded_frame: Float,
    parameters: PairParameters,
    key: PhiloxKey,
    limits_dn: tuple[float, float],
    origin: tuple[int, int],
    sensor: _SensorParameters,
    tables: PoissonTables,
    normal: QuantileTables,
    buffers: _PhysicalBuffers,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill the noisy frame of an unrounded clean frame, and its counts."""
    height, width = noisy.shape
    for y in range(height):
        for start in range(0, width, LONG_SEGMENT):
            end = min(start + LONG_SEGMENT, width)
            _fill_noisy_segment(
                unrounded_frame[y, start:end], (y, start), origin, parameters, key, limits_dn, sensor, tables, normal,
                buffers, noisy[y, start:end], counts,
            )  # fmt: skip


@inner
def _fill_noisy_segment(
    unrounded_dn: Float,
    at: tuple[int, int],
    origin: tuple[int, int],
    parameters: PairParameters,
    key: PhiloxKey,
    limits_dn: tuple[float, float],
    sensor: _SensorParameters,
    tables: PoissonTables,
    normal: QuantileTables,
    buffers: _PhysicalBuffers,
    noisy: Raw,
    counts: NDArray[np.int64],
) -> None:
    """Fill one segment of the noisy frame from pixel ``at`` of the crop, in the order of `reference.noise.physical`."""
    n, (y, start), black = unrounded_dn.shape[0], at, parameters.levels_dn[0]
    position = (origin[0] + y, origin[1] + start)
    signal_e, words, noisy_dn = buffers.signal_e, buffers.words, buffers.noisy_dn
    for x in range(n):
        signal_e[x] = (unrounded_dn[x] - black) / sensor.dn_per_e
    if sensor.has_prnu and not sensor.averaged:
        for x in range(n):
            signal_e[x] = signal_e[x] * sensor.response[y, start + x]
    hot = _fill_defects(sensor, position, n, buffers) if sensor.hot_below or sensor.dead_below else 0
    electrons, drawn_e, rates = buffers.signal_e, buffers.drawn_e, buffers.rates
    for purpose_word in (SHOT, DARK, HOT):
        if purpose_word == SHOT:
            if not sensor.shot:
                continue
            means = buffers.signal_e
        elif purpose_word == DARK:
            if not sensor.dark:
                continue
            rates[:n] = sensor.dark_e
            means = rates
        else:
            if hot == 0:
                continue
            means = buffers.hot_e
        offset = fill_segment_words(key, position, purpose_word, n, words)
        fill_counts(words[offset : offset + n], means[:n], normal, tables, buffers.counts, drawn_e[:n])
        if purpose_word == SHOT:
            if sensor.count_roots[1] < np.inf:
                _replace_with_normals(means, sensor.count_roots, buffers.counts.normals, drawn_e, n)
            electrons, drawn_e = drawn_e, buffers.electrons
        else:
            removed_e = sensor.removed_e if purpose_word == DARK else 0.0
            for x in range(n):
                electrons[x] = electrons[x] + (drawn_e[x] - removed_e)
    offset = 0
    if sensor.read_std_dn > 0.0:
        offset = fill_segment_words(key, position, sensor.read_purpose, n, words)
    _convert_to_dn(electrons[:n], words[offset : offset + n], sensor, at, black, buffers.counts, noisy_dn)
    if sensor.dead_below:
        for x in range(n):
            noisy_dn[x] = 0.0 if buffers.dead[x] else noisy_dn[x]
    read_out(unrounded_dn, noisy_dn, parameters, limits_dn, noisy, counts)


@inner
def _replace_with_normals(
    rates: Float, count_roots: tuple[np.float32, np.float32], normals: Float32, drawn_e: Float, count: int
) -> None:
    """Replace counts whose rate has a root outside ``count_roots``, in the order of `poisson.fill_normal_counts`."""
    for x in range(count):
        rounded = (rates[x] + ROUND) - ROUND
        root = np.sqrt(np.float32(rates[x]))
        electrons = np.float32(rounded) + (np.float32(rates[x] - rounded) + root * normals[x])
        drawn_e[x] = drawn_e[x] if root > count_roots[0] and root < count_roots[1] else np.float64(electrons)


@inner
def _fill_defects(sensor: _SensorParameters, position: tuple[int, int], n: int, buffers: _PhysicalBuffers) -> int:
    """Mark dead pixels, and fill the mean excess of hot ones (`reference.noise.hot_pixel_means`).

    Return how many pixels are hot.
    """
    hot_e, words, hot = buffers.hot_e, buffers.words, 0
    for purpose_word in (DEAD, HOT, HOT_STEP):
        if (purpose_word == DEAD and not sensor.dead_below) or (purpose_word == HOT and not sensor.hot_below):
            continue
        if purpose_word == HOT_STEP and hot == 0:
            continue
        offset = fill_segment_words(sensor.key, position, purpose_word, n, words)
        if purpose_word == DEAD:
            for x in range(n):
                buffers.dead[x] = words[offset + x] < sensor.dead_below
        elif purpose_word == HOT:
            for x in range(n):
                hot_e[x] = 1.0 if words[offset + x] < sensor.hot_below else 0.0
                hot += words[offset + x] < sensor.hot_below
        else:
            for x in range(n):
                if hot_e[x] > 0.0:
                    hot_e[x] = sensor.hot_e * sensor.levels[words[offset + x] >> np.uint32(22)]
    return hot


@inner
def _convert_to_dn(
    electrons: Float,
    words: Indices,
    sensor: _SensorParameters,
    at: tuple[int, int],
    black: float,
    buffers: CountBuffers,
    out: Float,
) -> None:
    """Convert electrons to DN, and add read noise, row and column offsets and black-level errors.

    Read noise is approximate, and exact at sites that could round to another DN.
    """
    full_well_e, dn_per_e, read_std_dn = sensor.full_well_e, sensor.dn_per_e, sensor.read_std_dn
    row_dn, columns_dn, errors_dn = sensor.rows_dn[at[0]], sensor.columns_dn[at[1] :], sensor.errors_dn[at[0] & 1]
    count, read, normals = electrons.shape[0], sensor.read, buffers.normals
    if read_std_dn > 0.0:
        fill_approximate_values(words, read.lines, buffers.line_buffer, normals[:count])
    else:
        normals[:count] = np.float32(0.0)
    limit = 0.5 - (read_std_dn * read.error + DOUBLE_ERROR_DN)
    uncertain = 0
    for x in range(count):
        dn = min(electrons[x], full_well_e) * dn_per_e + black
        out[x] = (dn + read_std_dn * np.float64(normals[x])) + ((row_dn + columns_dn[x]) + errors_dn[x])
        uncertain += abs(out[x] - ((out[x] + ROUND) - ROUND)) > limit
    if uncertain > 0 and read_std_dn > 0.0:
        for x in range(count):
            if abs(out[x] - ((out[x] + ROUND) - ROUND)) > limit:
                dn = min(electrons[x], full_well_e) * dn_per_e + black
                exact_dn = dn + read_std_dn * exact_value(words[x], read.quadratics)
                out[x] = exact_dn + ((row_dn + columns_dn[x]) + errors_dn[x])


@inner
def _fill_averaged_clean(
    unrounded_dn: Float,
    at: tuple[int, int],
    sensor: _SensorParameters,
    black: float,
    limits_dn: tuple[float, float],
    buffers: _PhysicalBuffers,
    clean: Raw,
) -> None:
    """Fill the clean frame with fixed patterns: the mean of many noisy frames, as `reference.noise.average`.

    ``buffers`` must still hold the hot and dead pixels of the segment.
    """
    (y, start), (low, high) = at, limits_dn
    full_dn = sensor.full_well_e * sensor.dn_per_e + black
    dark_dn = sensor.dark_e * sensor.dn_per_e if sensor.dark and sensor.removed_e == 0.0 else 0.0
    for x in range(unrounded_dn.shape[0]):
        hot_dn = buffers.hot_e[x] * sensor.dn_per_e if sensor.hot_below else 0.0
        dn = min((unrounded_dn[x] + hot_dn) + dark_dn, full_dn)
        dn = dn + ((0.0 + sensor.columns_dn[start + x]) + sensor.errors_dn[y & 1, x])
        dn = 0.0 if sensor.dead_below and buffers.dead[x] else dn
        clean[x] = np.uint16(np.int32(min(max((dn + ROUND) - ROUND, low), high)))


@inner
def _count_saturated(clean: Raw, white: float) -> int:
    """Count clean values at white."""
    count = 0
    for x in range(clean.shape[0]):
        count += clean[x] == white
    return count
