"""Sample noise effect by effect, in electrons and then in DN: the order of `reference.noise.physical`.

Counts of electrons are exact (`poisson`). Their conversion to DN and the read noise are approximate, float32, with an
error bound; the read-out asks for the exact value of sites whose bound reaches a rounding boundary, and of defects. The
fixed patterns of the body are prepared once (`body`). The Poisson form of two-parameter noise is shot and read noise.

Timings and rejected alternatives: ``docs/design/kernels.md``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.lookup_tables import quantile_table
from unprocess_gen.core.random_streams import BLOCK, purpose, words
from unprocess_gen.core.types import DarkPixels, Float, Plan
from unprocess_gen.simulation.kernels.body import HOT, WITHOUT_PATTERNS, Body
from unprocess_gen.simulation.kernels.gaussian import HETEROSCEDASTIC
from unprocess_gen.simulation.kernels.normal import (
    Quantiles,
    build_quantiles,
    exact_value,
    exact_values,
    fill_rows,
    fill_values_by_lines,
    normal_quantiles,
    value_by_line,
)
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_word_blocks, first_word
from unprocess_gen.simulation.kernels.poisson import (
    FLOAT32_RATE,
    LOW_RATE,
    MAX_THRESHOLD_RATE,
    CountTables,
    count_tables,
    count_thresholds,
    exact_count,
    fill_counts,
    fill_counts_of_one_rate,
)
from unprocess_gen.simulation.kernels.rounding import ROUND
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    Pointer,
    absolute,
    from_bits,
    less_than,
    load,
    maximum,
    minimum,
    movemask,
    pointer_to,
    select,
    square_root,
    store,
    to_float64,
)
from unprocess_gen.simulation.kernels.strips import STRIP, Float32, Strip, Workspace, list_lanes, padded_width
from unprocess_gen.simulation.reference import noise as reference_noise
from unprocess_gen.simulation.reference.poisson import CORE_MARGIN, core_share, gaussian_from

SHOT, DARK, READ, ROW, DARK_DITHER = (
    np.uint64(purpose(stream)) for stream in ("shot", "dark_current", "read", "row", "dark_dither")
)

FLOAT32_ERROR_DN = 2.0**-21
"""Error that float32 adds to an approximate DN, relative to the DN and to its summands."""

MIN_READ_STD_E = 0.5
"""Least standard deviation of read noise with which a normal may replace counts.

Below it the steps of single electrons show, which no normal has: the Kolmogorov distance is 0.2/√rate without read
noise and 0.001/√rate at this value, in addition to the 0.07/√rate of `accuracy.gaussian_distance` (skewness).
"""

MAX_STEPS = 64
"""Most thresholds of `poisson.count_thresholds`."""

_0, _8, _16, _INFINITE_BITS32 = np.uint64(0), np.uint64(8), np.uint64(16), np.uint32(0x7F800000)
_ZERO32, _INFINITY32, _FLOAT32_ERROR32 = np.float32(0), np.float32(np.inf), np.float32(FLOAT32_ERROR_DN)
_LOW_RATE32, _EVERY_LANE = np.float32(LOW_RATE), np.uint32(2**VECTOR_WIDTH - 1)
_RATE_ERROR32, _NORMAL_ERROR32 = np.float32(FLOAT32_RATE), np.float32(2.0**-19)


class Electrons(NamedTuple):
    """Hold the effects of N frames of one body; P columns are those of complete blocks."""

    numbers: Float  # [N, NUMBERS]: see `_Numbers`
    read_purposes: NDArray[np.uint64]  # [N]
    read_lines: NDArray[np.uint64]  # [N, 4097]
    read_quadratics: Float  # [N, 4096]
    gains: Float  # [N, 2, 2, 8]: of eight sites of an even and of an odd row, DN per electron and full well
    gains32: Float32  # [N, 2, 3, 8]: of the same sites, DN per electron, electrons per DN and full well
    rows_dn: Float  # [N, H]: offsets of correlated rows; else one 0
    rows_step: int  # H; 0 if rows are independent
    columns_dn: Float  # [N, P]
    fixed_columns_dn: Float  # [P]: without the part that is new in every frame
    errors_dn: Float  # [N, 2, 8]: black-level errors of the same sites
    base_dn: Float32  # [N, 2, P]: black level, column and black-level error
    dark_frames_dn: Float32  # [N, H, P]: values of dark frames above black; [P] zeros without them
    dark_frames_steps: tuple[int, int]  # elements from frame to frame and from row to row; 0 without dark frames
    dark_ranks: NDArray[np.uint32]  # [N, MAX_STEPS]: see `poisson.count_thresholds`
    padded_width: int  # P
    black_dn: float
    full_dn: float  # DN of the full well in a clean frame with fixed patterns
    body: Body
    tables: CountTables


class _Numbers(NamedTuple):
    """Hold the numbers of one frame; comments and defaults give the values that switch an effect off."""

    shot: float  # 0
    read_std_dn: float  # 0
    error_dn: float  # bound of the error of an approximate DN, in addition to FLOAT32_ERROR_DN times the DN
    lowest_root: float  # roots of the mean electrons between which shot noise is counted
    highest_root: float
    a_dn: float  # variance line
    b_dn2: float
    dark_e: float = 0.0
    dark_steps: float = 0.0  # thresholds of the dark signal; below 0 if it has too many
    fewest_dark: float = 0.0  # smallest count of the dark signal
    removed_e: float = 0.0  # mean dark signal that the camera subtracts
    kept_dark_e: float = 0.0  # in a clean frame with fixed patterns
    row_std_dn: float = 0.0


NUMBERS = len(_Numbers._fields)
_ERROR_DN = _Numbers._fields.index("error_dn")


# ----------------------------------------------------------------------------------------------------------- parameters


def electron_noise(
    plans: Sequence[Plan], body: Body, shape: tuple[int, int], origin: tuple[int, int], counts_all: bool
) -> Electrons:
    """Return the noise of frames of one body; ``counts_all`` forbids normals in place of counts."""
    left = origin[1] // BLOCK * BLOCK if any(_COLUMN_EFFECTS.intersection(plan.effects) for plan in plans) else 0
    columns = padded_width(origin[1], shape[1])
    noise = _electron_noise(tuple(plans), columns, (origin[0] % 2, left), counts_all)._replace(body=body)
    if not any(map(_has_correlated_rows, plans)):
        return noise
    return noise._replace(rows_dn=_correlated_rows(plans, origin[0], shape[0]), rows_step=shape[0])


def with_dark_frames(
    noise: Electrons,
    plans: Sequence[Plan],
    dark_pixels: DarkPixels | None,
    shape: tuple[int, int],
    origin: tuple[int, int],
) -> Electrons:
    """Return the noise of frames whose plans name dark frames."""
    first, pitch = origin[1] % BLOCK, noise.padded_width
    dark_dn = np.zeros((len(plans), shape[0], pitch), dtype=np.float32)
    numbers = noise.numbers.copy()
    for of_frame, numbers_of_frame, plan in zip(dark_dn, numbers, plans, strict=True):
        if plan.dark_frame:
            inside = of_frame[:, first : first + shape[1]]
            reference_noise.dark_frame_offsets(plan, dark_pixels, shape, origin, out=inside)
            farthest_dn = max(float(inside.max(initial=0.0)), -float(inside.min(initial=0.0)))
            numbers_of_frame[_ERROR_DN] += 2 * FLOAT32_ERROR_DN * farthest_dn
    steps = shape[0] * pitch, pitch
    return noise._replace(numbers=numbers, dark_frames_dn=dark_dn.reshape(-1), dark_frames_steps=steps)


_COLUMN_EFFECTS = frozenset({"column", "column_temporal"})
_INDEPENDENT_ROWS = np.zeros(1)


def _has_correlated_rows(plan: Plan) -> bool:
    return plan.physics is not None and plan.physics.row_correlation != 0 and "row" in plan.effects


def _correlated_rows(plans: Sequence[Plan], top: int, height: int) -> Float:
    """Return the offsets of correlated rows, [N, H] DN; 0 in frames without them."""
    rows_dn = np.zeros((len(plans), height))
    for of_frame, plan in zip(rows_dn, plans, strict=True):
        if _has_correlated_rows(plan):
            of_frame[:] = reference_noise.row(plan, height, top)
    return rows_dn


@functools.lru_cache(maxsize=8)
def _electron_noise(plans: tuple[Plan, ...], columns: int, origin: tuple[int, int], counts_all: bool) -> Electrons:
    """Return the noise without the body; ``origin`` is that of the first block, as far as the noise depends on it."""
    frames = [_frame(plan, origin, columns, counts_all) for plan in plans]
    numbers, purposes, quantiles, offsets, ranks = ([*members] for members in zip(*frames, strict=True))
    gains, first = [_gains_of(plan, origin[0]) for plan in plans], plans[0]
    fixed = offsets[0].columns_dn
    if "column_temporal" in first.effects:
        fixed = _fixed_offsets(first, columns, origin).columns_dn
    return Electrons(
        numbers=np.array(numbers),
        read_purposes=np.array(purposes),
        read_lines=_stack([each.lines for each in quantiles]),
        read_quadratics=_stack([each.quadratics for each in quantiles]),
        gains=_stack([each.sites for each in gains]),
        gains32=_stack([each.sites32 for each in gains]),
        rows_dn=_INDEPENDENT_ROWS,
        rows_step=0,
        columns_dn=_stack([each.columns_dn for each in offsets]),
        fixed_columns_dn=fixed,
        errors_dn=_stack([each.errors_dn for each in offsets]),
        base_dn=_stack([each.base_dn for each in offsets]),
        dark_frames_dn=np.zeros(columns, dtype=np.float32),
        dark_frames_steps=(0, 0),
        dark_ranks=_stack(ranks),
        padded_width=columns,
        black_dn=float(first.black_level_dn),
        full_dn=_full_well_e(first) * (1.0 if first.physics is None else first.physics.dn_per_e) + first.black_level_dn,
        body=WITHOUT_PATTERNS,
        tables=count_tables(),
    )


def _stack(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """Return arrays along a new first axis; a single one is not copied."""
    return arrays[0][None] if len(arrays) == 1 else np.stack(arrays)


class _Gains(NamedTuple):
    """Hold `Electrons.gains` and `Electrons.gains32` of one frame, and the highest gain, DN per electron."""

    sites: Float
    sites32: Float32
    highest: float


@functools.lru_cache(maxsize=16)
def _gains(dn_per_e: float, relative: tuple[float, ...], full_well_e: float) -> _Gains:
    """Return the gains of the sites (0, 0), (0, 1), (1, 0), (1, 1) with these gains relative to ``dn_per_e``."""
    tile = _sites_of_rows(relative)
    gains, full_wells_e = dn_per_e * tile, full_well_e / tile
    sites32 = np.stack([gains, 1 / gains, full_wells_e], axis=1).astype(np.float32)
    return _Gains(np.stack([gains, full_wells_e], axis=1), sites32, float(gains.max()))


def _sites_of_rows(of_tile: Sequence[float]) -> Float:
    """Return the values of eight sites of an even and of an odd row, ``[2, VECTOR_WIDTH]``, from those of a tile."""
    return np.tile(np.array(of_tile, dtype=np.float64).reshape(2, 2), VECTOR_WIDTH // 2)


def _gains_of(plan: Plan, top: int) -> _Gains:
    """Return the gains of a frame whose first row is ``top``."""
    if plan.physics is None:
        return _gains(plan.a_dn, _EQUAL, math.inf)
    relative: tuple[float, ...] = _EQUAL
    if "gain_by_colour" in plan.effects:
        relative = tuple(reference_noise.relative_gains(plan, (2, 2), (top, 0)).ravel().tolist())
    return _gains(plan.physics.dn_per_e, relative, _full_well_e(plan))


_EQUAL = (1.0, 1.0, 1.0, 1.0)


def _full_well_e(plan: Plan) -> float:
    return plan.physics.full_well_e if plan.physics is not None and "full_well" in plan.effects else math.inf


class _Offsets(NamedTuple):
    """Hold the offsets of a frame: members of `Electrons`, and the largest offset from black, DN."""

    columns_dn: Float
    errors_dn: Float
    base_dn: Float32
    farthest_dn: float


@functools.lru_cache(maxsize=16)
def _offsets(
    black_dn: float,
    columns: int,
    origin: tuple[int, int],
    body_key: int | None,
    column_std_dn: float,
    black_error_dn: tuple[float, ...],
) -> _Offsets:
    """Return the offsets of the columns of a body and of the sites of a tile; no body omits columns.

    ``origin`` is that of the first block.
    """
    columns_dn = np.zeros(columns)
    if body_key is not None:
        first, after = origin[1] // _COLUMNS, (origin[1] + columns - 1) // _COLUMNS + 1
        normals = np.concatenate([_column_normals(body_key, part) for part in range(first, after)])
        columns_dn = column_std_dn * normals[origin[1] - first * _COLUMNS :][:columns]
    errors_dn = np.roll(_sites_of_rows(black_error_dn), -origin[0], axis=0)
    base_dn = black_dn + (columns_dn + np.tile(errors_dn, columns // VECTOR_WIDTH))
    farthest_dn = float(np.abs(columns_dn).max(initial=0.0) + np.abs(errors_dn).max())
    return _Offsets(columns_dn, errors_dn, base_dn.astype(np.float32), farthest_dn)


_COLUMNS = 1024
"""Columns whose normals are computed at once: for a crop alone they would take longer than its pixels."""


@functools.lru_cache(maxsize=64)
def _column_normals(body_key: int, part: int) -> Float:
    """Return the normals of the columns of a body from ``part * _COLUMNS`` on."""
    of_part = words(body_key, "column", (1, _COLUMNS), origin=(0, part * _COLUMNS))
    return np.asarray(reference_noise.normals(of_part)[0])


_Frame = tuple[_Numbers, np.uint64, Quantiles, _Offsets, NDArray[np.uint32]]
_NO_ERRORS = (0.0, 0.0, 0.0, 0.0)
_NO_RANKS = np.zeros(MAX_STEPS, dtype=np.uint32)


def _frame(plan: Plan, origin: tuple[int, int], columns: int, counts_all: bool) -> _Frame:
    """Return the numbers of one frame and its members of `Electrons`; ``origin`` is that of the first block."""
    physics = plan.physics
    if physics is None:
        return _two_parameter_frame(plan, columns, counts_all)
    on = frozenset(plan.effects)
    offsets = _fixed_offsets(plan, columns, origin)
    if "column_temporal" in on:
        offsets = _with_columns(offsets, reference_noise.column_temporal(plan, columns, origin[1]))
    dark_e = physics.dark_e if "dark_current" in on else 0.0
    removed_e = dark_e if physics.dark_offset == "removed" else 0.0
    read_std_dn, purpose_of_read = physics.read_std_dn if "read" in on else 0.0, READ
    row_std_dn = physics.row_std_dn if "row" in on else 0.0
    quantiles = _read_quantiles(physics.read_law, physics.read_shape)
    if plan.dark_frame:  # the dither takes the place of the read noise
        read_std_dn, purpose_of_read = reference_noise.dither_std_dn(plan), DARK_DITHER
        quantiles = _read_quantiles(reference_noise.DITHER_LAW, reference_noise.DITHER_SHAPE)
        counts_all = True
    offset_dn = plan.black_level_dn + 6.4 * row_std_dn + offsets.farthest_dn
    counts_all = counts_all or "gain_by_colour" in on  # the limits between counts and normals hold for one gain
    most_dark_dn = _gains_of(plan, origin[0]).highest * (dark_e + 8 * math.sqrt(dark_e) + 40) if dark_e else 0.0
    lowest_root, highest_root = count_roots(plan, read_std_dn / physics.dn_per_e, counts_all)
    fewest_dark, ranks = count_thresholds(dark_e) if dark_e <= MAX_THRESHOLD_RATE else (0, None)
    a_dn, b_dn2 = plan.variance_line
    numbers = _Numbers(
        shot=float("shot" in on),
        dark_e=dark_e,
        dark_steps=-1.0 if ranks is None else len(ranks),
        fewest_dark=fewest_dark,
        removed_e=removed_e,
        kept_dark_e=0.0 if removed_e else dark_e,
        read_std_dn=read_std_dn,
        error_dn=_error_dn(read_std_dn, quantiles, offset_dn, most_dark_dn),
        row_std_dn=0.0 if _has_correlated_rows(plan) else row_std_dn,
        lowest_root=lowest_root,
        highest_root=highest_root,
        a_dn=a_dn,
        b_dn2=b_dn2,
    )
    dark_ranks = _NO_RANKS if ranks is None else np.resize(ranks, MAX_STEPS)
    return numbers, purpose_of_read, quantiles, offsets, dark_ranks


def _fixed_offsets(plan: Plan, columns: int, origin: tuple[int, int]) -> _Offsets:
    """Return the offsets that all frames of a body have."""
    physics, on = plan.physics, plan.effects
    assert physics is not None
    of_body = (physics.body_key, physics.column_std_dn) if "column" in on else (None, 0.0)
    errors_dn = physics.black_error_dn if "black_error" in on else _NO_ERRORS
    return _offsets(float(plan.black_level_dn), columns, origin, *of_body, errors_dn)


def _with_columns(fixed: _Offsets, more_dn: Float) -> _Offsets:
    """Add offsets of columns."""
    base_dn = (fixed.base_dn + more_dn).astype(np.float32)
    return fixed._replace(
        columns_dn=fixed.columns_dn + more_dn,
        base_dn=base_dn,
        farthest_dn=fixed.farthest_dn + float(np.abs(more_dn).max(initial=0.0)),
    )


def _two_parameter_frame(plan: Plan, columns: int, counts_all: bool) -> _Frame:
    """Return shot and read noise whose variance line is that of the plan."""
    a_dn, b_dn2 = plan.variance_line
    read_std_dn, quantiles = math.sqrt(max(b_dn2, 0.0)), normal_quantiles()
    lowest_root, highest_root = count_roots(plan, read_std_dn / a_dn, counts_all)
    numbers = _Numbers(
        shot=1.0,
        read_std_dn=read_std_dn,
        error_dn=_error_dn(read_std_dn, quantiles, float(plan.black_level_dn), 0.0),
        lowest_root=lowest_root,
        highest_root=highest_root,
        a_dn=a_dn,
        b_dn2=b_dn2,
    )
    offsets = _offsets(float(plan.black_level_dn), columns, (0, 0), None, 0.0, _NO_ERRORS)
    return numbers, HETEROSCEDASTIC, quantiles, offsets, _NO_RANKS


def _error_dn(read_std_dn: float, quantiles: Quantiles, offset_dn: float, most_dark_dn: float) -> float:
    """Return `_Numbers.error_dn`."""
    summands_dn = 2 * read_std_dn * quantiles.farthest + 2 * offset_dn + most_dark_dn + 0.5
    return read_std_dn * quantiles.error + FLOAT32_ERROR_DN * summands_dn


def count_roots(plan: Plan, read_std_e: float, counts_all: bool) -> tuple[float, float]:
    """Return the square roots of the mean electrons between which a normal is too far from the counts."""
    law_distance = plan.law_distance
    if plan.physics is not None and plan.physics.read_law == "tukey_lambda":
        read_std_e = read_std_e * core_share(plan.physics.read_shape)
        law_distance = law_distance / CORE_MARGIN
    if "shot:gaussian_where_near" not in plan.methods or read_std_e < MIN_READ_STD_E or counts_all:
        return 0.0, np.inf  # without light no count is needed
    lowest, highest = gaussian_from(read_std_e, law_distance)
    return math.sqrt(lowest), math.sqrt(highest)


@functools.lru_cache(maxsize=8)
def _read_quantiles(law: str, shape: float) -> Quantiles:
    return normal_quantiles() if law == "gaussian" else build_quantiles(quantile_table(law, shape))


# ------------------------------------------------------------------------------------------------------------- sampling


@inner
def _load_numbers(noise: Electrons, n: int) -> _Numbers:
    v = pointer_to(noise.numbers, np.uint64(n * NUMBERS))
    return _Numbers(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10], v[11], v[12])


@inner
def add_electrons(readout: Any, noise: Electrons, n: int, strip: Strip, workspace: Workspace) -> Pointer:
    """Fill ``noise_dn`` and ``error_dn``, in float32; return the base to which the read-out adds them: zeros."""
    of = _load_numbers(noise, n)
    fill_values_by_lines(
        strip.total, workspace.read_words, pointer_to(noise.read_lines, n * 4097), workspace.lines, workspace.normals
    )
    f, lanes = np.float32, pointer_to(noise.gains32, 24 * (2 * n + (strip.y & 1)))
    per_e, full_well_e, std, margin = load(lanes, _0), load(lanes, _16), f(of.read_std_dn), f(of.error_dn)
    row_dn = f(workspace.row_dn[0])
    base = pointer_to(noise.base_dn, (2 * n + (strip.y & 1)) * noise.padded_width + strip.x + strip.lead)
    dark_dn = _dark_frame_of(noise, n, strip)
    has_dark = of.dark_e > 0.0
    electrons = workspace.total_e if has_dark else workspace.electrons
    error_e = workspace.total_error_e if has_dark else workspace.error_e
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        dn = minimum(load(electrons, x), full_well_e) * per_e + (
            load(workspace.normals, x) * std + (load(base, x) + load(dark_dn, x) + row_dn)
        )
        store(workspace.noise_dn, x, dn)
        store(workspace.error_dn, x, absolute(dn) * _FLOAT32_ERROR32 + (load(error_e, x) * per_e + margin))
    return workspace.zeros


@inner
def _dark_frame_of(noise: Electrons, n: int, strip: Strip) -> Pointer:
    """Return the values of the dark frame of frame ``n`` in a strip."""
    of_frame, of_row = noise.dark_frames_steps
    return pointer_to(noise.dark_frames_dn, n * of_frame + strip.y * of_row + strip.x + strip.lead)


@inner
def count_electrons(noise: Electrons, n: int, key: PhiloxKey, strip: Strip, workspace: Workspace) -> None:
    """Fill ``electrons``, ``dark`` and ``total_e`` with bounds of their errors, ``defects``, and all words."""
    of, tables = _load_numbers(noise, n), noise.tables
    fill_word_blocks(key, strip, SHOT, workspace.words)
    fill_word_blocks(key, strip, noise.read_purposes[n], workspace.read_words)
    row_dn = of.row_std_dn * exact_value(first_word(key, strip.row, ROW), tables.quadratics)
    workspace.row_dn[0] = row_dn + noise.rows_dn[n * noise.rows_step + min(strip.y, noise.rows_step)]
    if of.dark_e > 0.0:
        fill_word_blocks(key, strip, DARK, workspace.dark_words)
    counted = 2 if of.dark_steps < 0.0 else 1
    for stream in range(counted):  # a loop, so that machine code contains `fill_counts` once
        is_shot = stream == 0
        if is_shot:
            has_high = _fill_rates(noise, n, strip, workspace)
        else:
            has_high = True
            for x in range(strip.total):
                workspace.rates[x] = of.dark_e
        words, out, error = workspace.words, workspace.electrons, workspace.error_e
        if not is_shot:
            words, out, error = workspace.dark_words, workspace.dark, workspace.dark_error_e
        limit = _first_not_counted(of) if is_shot else _INFINITY32
        fill_counts(strip.total, words, workspace.rates, has_high, limit, tables, workspace, out, error)
        if is_shot:
            if of.shot == 0.0:
                _keep_means(strip.total, workspace)
            elif of.lowest_root > 0.0 or of.highest_root < np.inf:
                if not has_high:
                    fill_values_by_lines(strip.total, words, tables.lines, workspace.lines, workspace.normals)
                _replace_by_normals(strip.total, of, workspace)
    if of.dark_e > 0.0:
        if of.dark_steps >= 0.0:
            ranks = pointer_to(noise.dark_ranks, n * MAX_STEPS)
            words, steps = workspace.dark_words, int(of.dark_steps)
            fill_counts_of_one_rate(strip.total, words, int(of.fewest_dark), ranks, steps, workspace.dark)
            for x in range(strip.total):
                workspace.dark_error_e[x] = 0.0
        removed_e = np.float32(of.removed_e)
        for x in range(strip.total):
            workspace.total_e[x] = workspace.electrons[x] + (workspace.dark[x] - removed_e)
            workspace.total_error_e[x] = workspace.error_e[x] + workspace.dark_error_e[x]
    first, after = _defects_of(noise.body, strip)
    if first < after:
        _draw_defects(noise, key, first, after, strip, workspace)


@inner
def _fill_rates(noise: Electrons, n: int, strip: Strip, workspace: Workspace) -> bool:
    """Fill ``rates`` (float32) with the mean electrons of shot noise; return whether any is `LOW_RATE` or more.

    At most five roundings, as `poisson.FLOAT32_RATE` allows.
    """
    black, e_per_dn = np.float32(noise.black_dn), load(pointer_to(noise.gains32, 24 * (2 * n + (strip.y & 1))), _8)
    row, column = noise.body.response_steps
    response = pointer_to(noise.body.response, strip.y * row + strip.x * column + strip.lead)
    highest = load(workspace.rounded_dn, _0) - load(workspace.rounded_dn, _0)
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        light_dn = (load(workspace.rounded_dn, x) - black) + load(workspace.residual_dn, x)
        rate = light_dn * e_per_dn * load(response, x)
        highest = maximum(rate, highest)
        store(workspace.rates, x, rate)
    return bool(movemask(less_than(highest, _LOW_RATE32)) != _EVERY_LANE)


@inner
def _keep_means(count: int, workspace: Workspace) -> None:
    """Replace counts by their means."""
    for x in range(count):
        workspace.electrons[x] = workspace.rates[x]
        workspace.error_e[x] = workspace.rates[x] * _RATE_ERROR32


@inner
def _first_not_counted(of: _Numbers) -> np.float32:
    """Return the rate from which a normal replaces every count, in spite of the error of float32."""
    return np.float32(of.highest_root * of.highest_root * (1 + 4 * FLOAT32_RATE))


@inner
def _replace_by_normals(count: int, of: _Numbers, workspace: Workspace) -> None:
    """Replace counts where a normal is near enough; sites at the limits, within the error of float32, are uncertain."""
    low, high = of.lowest_root * of.lowest_root, of.highest_root * of.highest_root
    f, more, less = np.float32, 1 + 4 * FLOAT32_RATE, 1 - 4 * FLOAT32_RATE
    low_less, low_more, high_less, high_more = f(low * less), f(low * more), f(high * less), _first_not_counted(of)
    for v in range(count // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        rate = load(workspace.rates, x)
        root = square_root(rate)
        is_counted = less_than(low_more, rate) & less_than(rate, high_less)
        is_open = (less_than(low_less, rate) & less_than(rate, low_more)) | (
            less_than(high_less, rate) & less_than(rate, high_more)
        )
        normal = rate + root * load(workspace.normals, x)
        error = maximum((rate + root) * _NORMAL_ERROR32 + _NORMAL_ERROR32, from_bits(is_open & _INFINITE_BITS32))
        store(workspace.electrons, x, select(is_counted, load(workspace.electrons, x), normal))
        store(workspace.error_e, x, select(is_counted, load(workspace.error_e, x), error))


@inner
def _defects_of(body: Body, strip: Strip) -> tuple[int, int]:
    """Return the range of a strip's defects in the lists of the body."""
    if body.strips == 0:
        return 0, 0
    at = strip.y * body.strips + strip.x // STRIP
    return body.starts[at], body.starts[at + 1]


@inner
def _draw_defects(noise: Electrons, key: PhiloxKey, first: int, after: int, strip: Strip, workspace: Workspace) -> None:
    """Fill ``defects`` with the counts of hot pixels, and -1 at dead ones."""
    fill_word_blocks(key, strip, HOT, workspace.scratch)
    for d in range(first, after):
        x, mean_e = noise.body.positions[d], noise.body.means_e[d]
        workspace.defects[x] = exact_count(workspace.scratch[x], mean_e, noise.tables) if mean_e >= 0.0 else -1.0


@inner
def list_defects(noise: Electrons, strip: Strip, found: int, workspace: Workspace) -> int:
    """Append the strip's defects to ``uncertain``; return the length."""
    first, after = _defects_of(noise.body, strip)
    for d in range(first, after):
        workspace.uncertain[found + d - first] = np.uint32(noise.body.positions[d])
    return int(found + after - first)


@inner
def clear_defects(noise: Electrons, strip: Strip, workspace: Workspace) -> None:
    """Set ``defects`` to 0 again."""
    first, after = _defects_of(noise.body, strip)
    for d in range(first, after):
        workspace.defects[noise.body.positions[d]] = 0.0


@inner
def exact_electrons_dn(noise: Electrons, n: int, x: int, strip: Strip, workspace: Workspace) -> float:
    """Return the noisy DN of one site, in the reference's order of operations."""
    of = _load_numbers(noise, n)
    electrons = np.float64(workspace.electrons[x])
    if workspace.error_e[x] > _ZERO32:
        electrons = _exact_shot(noise, of, n, x, strip, workspace)
    if of.dark_e > 0.0:
        dark = np.float64(workspace.dark[x])
        if workspace.dark_error_e[x] > _ZERO32:
            dark = exact_count(workspace.dark_words[x], of.dark_e, noise.tables)
        electrons = electrons + (dark - of.removed_e)
    electrons = electrons + workspace.defects[x]
    read = exact_value(workspace.read_words[x], pointer_to(noise.read_quadratics, n * 4096))
    dn = _dn(noise, of, n, x, electrons, read, strip, workspace)
    return dn if workspace.defects[x] >= 0.0 else 0.0


@inner
def _exact_shot(noise: Electrons, of: _Numbers, n: int, x: int, strip: Strip, workspace: Workspace) -> float:
    """Return the electrons of light: a count, a normal in its place, or the mean."""
    row, column = noise.body.response_steps
    response = np.float64(noise.body.response[strip.y * row + (strip.x + strip.lead + x) * column])
    rate = (workspace.unrounded_dn[x] - noise.black_dn) / noise.gains[16 * (2 * n + (strip.y & 1)) + (x & 1)] * response
    if of.shot == 0.0:
        return float(rate)
    root, word = np.sqrt(np.float32(rate)), workspace.words[x]
    if root > np.float32(of.lowest_root) and root < np.float32(of.highest_root):
        return float(exact_count(word, rate, noise.tables))
    rounded = (rate + ROUND) - ROUND
    return float(np.float32(rounded) + (np.float32(rate - rounded) + root * value_by_line(word, noise.tables.lines)))


@inner
def _dn(
    noise: Electrons, of: _Numbers, n: int, x: int, electrons: float, read: float, strip: Strip, workspace: Workspace
) -> float:
    """Return the DN of ``electrons`` and read noise of ``read`` standard deviations, with the offsets of the site."""
    row = 2 * n + (strip.y & 1)
    site = 16 * row + (x & 1)
    dn = min(electrons, noise.gains[site + 8]) * noise.gains[site] + noise.black_dn
    dn = dn + of.read_std_dn * read
    offset_dn = workspace.row_dn[0] + noise.columns_dn[n * noise.padded_width + strip.x + strip.lead + x]
    dn = dn + (offset_dn + noise.errors_dn[8 * row + (x & 1)])
    return float(dn + np.float64(_dark_frame_of(noise, n, strip)[x]))


@inner
def fill_exact_electrons(readout: Any, noise: Electrons, n: int, strip: Strip, workspace: Workspace) -> Pointer:
    """Return ``exact_dn``, filled with the noisy DN of all sites: of certain counts in loops, then of the others."""
    of, quadratics, out = _load_numbers(noise, n), pointer_to(noise.read_quadratics, n * 4096), workspace.exact_dn
    fill_rows(strip.total, workspace.read_words, workspace.scratch)
    has_dark, row = of.dark_e > 0.0, 2 * n + (strip.y & 1)
    dark, error_e = workspace.dark, workspace.error_e
    if has_dark:
        error_e = workspace.total_error_e
    else:
        dark = workspace.zeros  # adding 0 - 0 changes no bit
    gains, errors_dn = pointer_to(noise.gains, 16 * row), load(pointer_to(noise.errors_dn, 8 * row), _0)
    dn_per_e, full_well_e, row_dn = load(gains, _0), load(gains, _8), workspace.row_dn[0]
    columns_dn = pointer_to(noise.columns_dn, n * noise.padded_width + strip.x + strip.lead)
    dark_frame_dn = _dark_frame_of(noise, n, strip)
    found = 0
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        read = exact_values(workspace.read_words, workspace.scratch, x, quadratics)
        electrons = to_float64(load(workspace.electrons, x)) + (to_float64(load(dark, x)) - of.removed_e)
        dn = minimum(electrons, full_well_e) * dn_per_e + noise.black_dn + read * of.read_std_dn
        dn = dn + ((load(columns_dn, x) + row_dn) + errors_dn)
        store(out, x, dn + to_float64(load(dark_frame_dn, x)))
        found = list_lanes(less_than(_ZERO32, load(error_e, x)), x, found, workspace)
    found = list_defects(noise, strip, found, workspace)
    for m in range(found):
        x = workspace.uncertain[m]
        out[x] = exact_electrons_dn(noise, n, x, strip, workspace)
    return out


@inner
def electrons_line(noise: Electrons, n: int) -> tuple[float, float, float]:
    """Return a, b and black of frame ``n``."""
    of = _load_numbers(noise, n)
    return of.a_dn, of.b_dn2, noise.black_dn


@inner
def average_electrons(noise: Electrons, strip: Strip, workspace: Workspace) -> None:
    """Add the fixed patterns to the unrounded clean frame, as `reference.noise.average`."""
    of, clean_dn, body = _load_numbers(noise, 0), workspace.unrounded_dn, noise.body
    first, after = _defects_of(body, strip)
    for d in range(first, after):
        workspace.defects[body.positions[d]] = body.means_e[d]
    for x in range(strip.total):
        gain = noise.gains[16 * (strip.y & 1) + (x & 1)]
        dn = (clean_dn[x] + workspace.defects[x] * gain) + of.kept_dark_e * gain
        dn = min(dn, noise.full_dn)
        offset_dn = 0.0 + noise.fixed_columns_dn[strip.x + strip.lead + x]
        dn = dn + (offset_dn + noise.errors_dn[8 * (strip.y & 1) + (x & 1)])
        clean_dn[x] = dn if workspace.defects[x] >= 0.0 else 0.0
