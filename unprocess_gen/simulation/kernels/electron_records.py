"""Prepare the records of noise in electrons from plans: numbers, gains, offsets and tables of each frame.

`electrons` simulates the effects with them. What patches of an image share is kept: ``docs/design/kernels.md``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.lookup_tables import quantile_table
from unprocess_gen.core.random_streams import BLOCK, purpose, words
from unprocess_gen.core.types import DarkPixels, Float, Plan
from unprocess_gen.simulation.kernels.body import WITHOUT_PATTERNS, Body
from unprocess_gen.simulation.kernels.electrons import FLOAT32_ERROR_DN, MAX_STEPS, Electrons, FrameNumbers
from unprocess_gen.simulation.kernels.gaussian import HETEROSCEDASTIC
from unprocess_gen.simulation.kernels.normal import Quantiles, build_quantiles, normal_quantiles
from unprocess_gen.simulation.kernels.poisson import MAX_THRESHOLD_RATE, count_tables, count_thresholds
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH
from unprocess_gen.simulation.kernels.strips import Float32, padded_width
from unprocess_gen.simulation.reference import noise as reference_noise
from unprocess_gen.simulation.reference.poisson import CORE_MARGIN, core_share, gaussian_from

READ, DARK_DITHER = (np.uint64(purpose(stream)) for stream in ("read", "dark_dither"))

MIN_READ_STD_E = 0.5
"""Least standard deviation of read noise with which a normal may replace counts.

Below it the steps of single electrons show, which no normal has: the Kolmogorov distance is 0.2/√rate without read
noise and 0.001/√rate at this value, in addition to the 0.07/√rate of `accuracy.gaussian_distance` (skewness).
"""

_ERROR_DN = FrameNumbers._fields.index("error_dn")


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
    frames, first = [_frame(plan, origin, columns, counts_all) for plan in plans], plans[0]
    numbers, quantiles, offsets, ranks = ([*members] for members in zip(*frames, strict=True))
    sites = [
        np.stack([*_gains_of(plan, origin[0]), each.errors_dn], axis=1)
        for plan, each in zip(plans, offsets, strict=True)
    ]
    fixed = offsets[0].columns_dn
    if "column_temporal" in first.effects:
        fixed = _fixed_offsets(first, columns, origin).columns_dn
    return Electrons(
        numbers=np.array(numbers),
        read_lines=_stack([each.lines for each in quantiles]),
        read_quadratics=_stack([each.quadratics for each in quantiles]),
        sites=_stack(sites),
        rows_dn=_INDEPENDENT_ROWS,
        rows_step=0,
        columns_dn=_stack([each.columns_dn for each in offsets]),
        fixed_columns_dn=fixed,
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


@functools.lru_cache(maxsize=16)
def _gains(dn_per_e: float, relative: tuple[float, ...], full_well_e: float) -> tuple[Float, Float]:
    """Return DN per electron and full wells of the sites of a tile with these gains relative to ``dn_per_e``."""
    tile = _sites_of_rows(relative)
    return dn_per_e * tile, full_well_e / tile


def _sites_of_rows(of_tile: Sequence[float]) -> Float:
    """Return the values of eight sites of an even and of an odd row, ``[2, VECTOR_WIDTH]``, from those of a tile."""
    return np.tile(np.array(of_tile, dtype=np.float64).reshape(2, 2), VECTOR_WIDTH // 2)


def _gains_of(plan: Plan, top: int) -> tuple[Float, Float]:
    """Return DN per electron and full wells of a frame whose first row is ``top``."""
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
    """Hold the offsets of the columns and the sites of a frame, and the largest offset from black, DN."""

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


_Frame = tuple[FrameNumbers, Quantiles, _Offsets, NDArray[np.uint32]]
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
    most_dark_dn = float(_gains_of(plan, origin[0])[0].max()) * (dark_e + 8 * math.sqrt(dark_e) + 40) if dark_e else 0.0
    lowest_root, highest_root = count_roots(plan, read_std_dn / physics.dn_per_e, counts_all)
    fewest_dark, ranks = count_thresholds(dark_e) if dark_e <= MAX_THRESHOLD_RATE else (0, None)
    numbers = FrameNumbers(
        shot=float("shot" in on),
        read_purpose=float(purpose_of_read),
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
    )
    dark_ranks = _NO_RANKS if ranks is None else np.resize(ranks, MAX_STEPS)
    return numbers, quantiles, offsets, dark_ranks


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
    numbers = FrameNumbers(
        shot=1.0,
        read_purpose=float(HETEROSCEDASTIC),
        read_std_dn=read_std_dn,
        error_dn=_error_dn(read_std_dn, quantiles, float(plan.black_level_dn), 0.0),
        lowest_root=lowest_root,
        highest_root=highest_root,
    )
    offsets = _offsets(float(plan.black_level_dn), columns, (0, 0), None, 0.0, _NO_ERRORS)
    return numbers, quantiles, offsets, _NO_RANKS


def _error_dn(read_std_dn: float, quantiles: Quantiles, offset_dn: float, most_dark_dn: float) -> float:
    """Return `FrameNumbers.error_dn`."""
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
