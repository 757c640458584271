"""Prepare the records of noise in electrons from slots: numbers, gains, offsets and tables of each frame.

`electrons` simulates the slots with them. What patches of an image share is kept: ``docs/design/kernels.md``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import BLOCK, purpose
from unprocess_gen.simulation.effects.dark_frame import dark_frame_offsets
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.kernels.electrons import FLOAT32_ERROR_DN, MAX_STEPS, PLACES, Electrons, FrameNumbers
from unprocess_gen.simulation.kernels.normal import Quantiles, build_quantiles, normal_quantiles
from unprocess_gen.simulation.kernels.poisson import MAX_THRESHOLD_RATE, count_tables, count_thresholds
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH
from unprocess_gen.simulation.kernels.site_patterns import NO_OFFSETS, WITHOUT_PATTERNS, SitePatterns
from unprocess_gen.simulation.kernels.strips import SiteMap, padded_width
from unprocess_gen.simulation.lookup_tables import quantile_table
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.noise import autoregressive, normals
from unprocess_gen.simulation.slots import (
    ColumnOffsets,
    FrameWords,
    RowOffsets,
    SiteNoise,
    Slots,
    UniformCounts,
    UnitWords,
    draw_words,
)

FARTHEST_NORMAL = 6.4
"""Bound of the absolute value of a normal deviate of 32 bits."""


def electron_noise(
    plans: Sequence[Plan],
    frames: tuple[Slots, ...],
    patterns: SitePatterns,
    dark_pixels: DarkPixels | None,
    shape: tuple[int, int],
    origin: tuple[int, int],
    reach: int = 0,
) -> Electrons:
    """Return the noise of frames of one sensor unit; columns are drawn up to ``reach`` at least."""
    columns, left = padded_width(origin[1], shape[1]), origin[1] // BLOCK * BLOCK
    has_columns = any(slots.columns or slots.fixed_columns for slots in frames)
    end = -(-max(left + columns, reach) // _COLUMNS) * _COLUMNS if has_columns else columns
    noise = _electron_noise(frames, end, origin[0] % 2)
    members: dict[str, Any] = {"patterns": patterns, "padded_width": columns, "has_negative": plans[0].darkest < 0}
    if has_columns:
        cut = slice(left, left + columns)
        members["columns_dn"] = np.ascontiguousarray(noise.columns_dn[:, cut])
        members["fixed_columns_dn"] = noise.fixed_columns_dn[cut]
        members["base_dn"] = np.ascontiguousarray(noise.base_dn[..., cut])
    if any(slots.rows and slots.rows.correlation for slots in frames):
        members |= {"rows_dn": _correlated_rows(frames, origin[0], shape[0]), "rows_step": shape[0]}
    noise = noise._replace(**members)
    offsets, step = patterns.sites_dn, 0
    if any(slots.has_site_offsets for slots in frames):
        pitch, first, step = noise.padded_width, origin[1] % BLOCK, noise.padded_width * shape[0]
        sites_dn = np.zeros((len(plans), shape[0], pitch), dtype=np.float32)
        for frame_dn, plan, slots in zip(sites_dn, plans, frames, strict=True):
            if slots.has_site_offsets:
                dark_frame_offsets(plan, dark_pixels, shape, origin, out=frame_dn[:, first : first + shape[1]])
        if offsets.steps[0]:
            sites_dn += offsets.values.reshape(shape[0], pitch)
        offsets = SiteMap(sites_dn.reshape(-1), (pitch, 1))
    if not offsets.steps[0]:
        return noise
    numbers, values = noise.numbers.copy(), offsets.values
    farthest_dn = max(float(values.max(initial=0.0)), -float(values.min(initial=0.0)))
    numbers[:, PLACES.error_dn] += 2 * FLOAT32_ERROR_DN * farthest_dn
    return noise._replace(numbers=numbers, sites_dn=offsets, sites_step=step)


@functools.lru_cache(maxsize=256)
def _electron_noise(frames: tuple[Slots, ...], columns: int, top: int) -> Electrons:
    """Return the noise without the sensor unit, of the first columns of frames whose first row is ``top``.

    Crops cut their columns from it: to compute them would take a tenth of a crop of 128 x 128.
    """
    first, members = frames[0], _members_of_sites(frames, top)
    columns_dn = np.stack([_columns_dn(slots, columns) for slots in frames])
    base_dn = columns_dn.reshape(len(frames), 1, -1, VECTOR_WIDTH) + members["planes_dn"][:, :, None]
    numbers = members["numbers"].copy()
    numbers[:, PLACES.error_dn] += 2 * FLOAT32_ERROR_DN * np.abs(columns_dn).max(axis=1)
    return Electrons(
        **(members | {"numbers": numbers}),
        columns_dn=columns_dn,
        base_dn=(first.black_dn + base_dn).astype(np.float32).reshape(len(frames), 2, columns),
        rows_dn=np.zeros((1, 1)),  # two dimensions as with correlated rows: the same machine code
        rows_step=0,
        fixed_columns_dn=_fixed_columns(first.fixed_columns, columns),
        sites_dn=NO_OFFSETS,
        sites_step=0,
        padded_width=columns,
        black_dn=first.black_dn,
        has_negative=False,
        full_dn=first.full_well_e * first.dn_per_e + first.black_dn,
        dead_dn=first.patterns.dead.value_dn if first.patterns.dead else 0.0,
        patterns=WITHOUT_PATTERNS,
        tables=count_tables(),
    )


def _columns_dn(slots: Slots, columns: int) -> Float:
    """Return the offsets of the first columns of a frame, whose unit can be another one."""
    columns_dn = _fixed_columns(slots.fixed_columns, columns)
    if slots.columns:
        columns_dn = columns_dn + slots.columns.std_dn * _normals(slots.columns.words, 1, columns)
    return columns_dn


@functools.lru_cache(maxsize=256)
def _members_of_sites(frames: tuple[Slots, ...], top: int) -> dict[str, NDArray[Any]]:
    """Return the members of `Electrons` that frames have of their own, wherever a crop is; without columns.

    Preparing them for every crop would take longer than a crop of 128 x 128. One frame shares its tables (98 kB).
    """
    members = [_members(slots, top) for slots in frames]
    if len(members) == 1:
        return {name: own[None] for name, own in members[0].items()}
    return {name: np.stack([own[name] for own in members]) for name in members[0]}


def _members(slots: Slots, top: int) -> dict[str, NDArray[Any]]:
    """Return the members of `Electrons` that a frame whose first row is ``top`` has of its own, without columns."""
    gains, planes_dn = _by_site(slots.plane_gains, top), _by_site(slots.planes_dn, top)
    dn_per_e = slots.dn_per_e * gains
    noise, uniform = slots.noise or SiteNoise(0, 0.0), slots.uniform or UniformCounts(0, 0.0, 0.0)
    quantiles = _quantiles(noise.distribution, noise.shape)
    has_thresholds = uniform.rate_e <= MAX_THRESHOLD_RATE
    fewest, ranks = count_thresholds(uniform.rate_e) if has_thresholds else (0, np.zeros(0, dtype=np.uint32))
    rows, bright = slots.rows or RowOffsets(0, 0.0), slots.patterns.bright
    offset_dn = FARTHEST_NORMAL * rows.std_dn
    offset_dn += slots.black_dn + float(np.abs(planes_dn).max())
    most_dark_e = uniform.rate_e + 8 * math.sqrt(uniform.rate_e) + 40 if uniform.rate_e else 0.0
    summands_dn = 2 * noise.std_dn * quantiles.farthest + 2 * offset_dn + float(dn_per_e.max()) * most_dark_e + 0.5
    numbers = FrameNumbers(
        counts_light=bool(slots.light_stream),
        has_dark=uniform.rate_e > 0,
        has_thresholds=has_thresholds,
        light_stream=_purpose(slots.light_stream),
        dark_stream=_purpose(uniform.stream),
        defect_stream=_purpose(bright.stream if bright else 0),
        site_stream=_purpose(noise.stream),
        row_stream=_purpose(rows.stream),
        dark_e=uniform.rate_e,
        removed_e=uniform.removed_e,
        fewest_dark=np.float32(fewest),
        dark_steps=np.int64(len(ranks)),
        site_std_dn=noise.std_dn,
        row_std_dn=0.0 if rows.correlation else rows.std_dn,
        error_dn=noise.std_dn * quantiles.error + FLOAT32_ERROR_DN * summands_dn,
    )
    return {
        "numbers": np.array(numbers, dtype=np.float64),
        "site_lines": quantiles.lines,
        "site_quadratics": quantiles.quadratics,
        "dn_per_e": dn_per_e,
        "full_well_e": slots.full_well_e / gains,
        "planes_dn": planes_dn,
        "dark_ranks": np.resize(ranks, MAX_STEPS),
    }


def _by_site(tile: Sequence[float], top: int) -> Float:
    """Return the values of eight sites of an even and of an odd row, [2, 8], of a frame whose first row is ``top``."""
    return np.roll(np.tile(np.array(tile).reshape(2, 2), VECTOR_WIDTH // 2), -top, axis=0)


def _purpose(stream: int) -> np.uint64:
    return np.uint64(purpose(stream))


@functools.lru_cache(maxsize=64)
def _quantiles(distribution: str, shape: float) -> Quantiles:
    return normal_quantiles() if distribution == "gaussian" else build_quantiles(quantile_table(distribution, shape))


# ----------------------------------------------------------------------------------------------------- rows and columns


def _correlated_rows(frames: Sequence[Slots], top: int, height: int) -> Float:
    """Return the offsets of correlated rows, [N, H] DN; 0 in frames without them."""
    rows_dn = np.zeros((len(frames), height))
    for frame_dn, slots in zip(rows_dn, frames, strict=True):
        if slots.rows and slots.rows.words:
            independent = _normals(slots.rows.words, top + height, 1)
            frame_dn[:] = slots.rows.std_dn * autoregressive(independent, slots.rows.correlation)[top:]
    return rows_dn


_COLUMNS = 1024
"""Columns whose normals are computed at once: for a crop alone they would take longer than its pixels."""


def _fixed_columns(offsets: ColumnOffsets | None, columns: int) -> Float:
    """Return the offsets of the first columns of a sensor unit."""
    return np.zeros(columns) if offsets is None else np.asarray(offsets.std_dn * _first_normals(offsets.words, columns))


@functools.lru_cache(maxsize=512)
def _first_normals(stream: UnitWords | FrameWords, columns: int) -> Float:
    """Return the normals of the first columns of a sensor unit."""
    return _normals(stream, 1, columns)


def _normals(stream: UnitWords | FrameWords, rows: int, columns: int) -> Float:
    """Return the normals of the first columns of one row, or of the first column of some rows."""
    return normals(draw_words(stream, (rows, columns))).ravel()
