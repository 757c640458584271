"""Prepare the fixed patterns of a sensor unit once for all of its frames: factors, offsets and defects by site."""

from __future__ import annotations

import bisect
import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import BLOCK, purpose
from unprocess_gen.simulation.effects.lens_shading import illumination
from unprocess_gen.simulation.kernels import simd
from unprocess_gen.simulation.kernels.jit import kernel
from unprocess_gen.simulation.kernels.normal import exact_values, fill_rows, normal_quantiles
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_word_blocks, philox_key
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH
from unprocess_gen.simulation.kernels.strips import (
    STRIP,
    Float32,
    Scratch,
    SiteMap,
    buffers_in,
    equal_sites,
    locate,
    padded_width,
    scratch_of_thread,
)
from unprocess_gen.simulation.lookup_tables import exponential_levels
from unprocess_gen.simulation.slots import BrightPixels, DeadSlot, NormalPattern, Patterns, RadialFactor

SMALL_SITES, SMALL_PATTERNS, LARGE_PATTERNS, LIVE_PATTERNS = 2**16, 384, 5, 8
"""So many patterns of crops of up to this many sites (0.3 MB each) are kept, so many of larger crops, and so many of
live crops, whose places are new in each epoch: keeping more would only use memory that no cache holds."""

DEAD, FIRST_STEP = 1, 2
"""Numbers in the map of defects: a dead pixel, and the first step of the means of bright defects."""

Shape = tuple[int, int]


class SitePatterns(NamedTuple):
    """Fixed patterns of a sensor unit for a crop."""

    response: SiteMap  # float32: factor on the electrons of light
    sites_dn: SiteMap  # float32: offsets by site
    defects: SiteMap  # uint16: 0, `DEAD`, or the step of a bright defect from `FIRST_STEP` on
    means_e: Float  # by number in ``defects``: mean excess, electrons; 0 without a defect, negative for a dead pixel


EQUAL_RESPONSE, NO_OFFSETS, NO_DEFECTS = equal_sites(1.0), equal_sites(0.0), equal_sites(0, np.uint16)
WITHOUT_PATTERNS = SitePatterns(EQUAL_RESPONSE, NO_OFFSETS, NO_DEFECTS, np.zeros(1))


def patterns_at(
    slots: Patterns, shape: Shape, origin: Shape, frame: Shape | None = None, is_averaged: bool = False
) -> tuple[SitePatterns, SiteMap | None]:
    """Fixed patterns of a sensor unit for a crop of ``shape`` at ``origin``, and the factor on the light, if any.

    ``frame`` are the height and width of the complete frame from which live crops are cut. With ``is_averaged``, the
    clean frame contains the fixed patterns: the factor on the electrons is one on the light, and the noise has none.
    """
    stored = _caches[shape[0] * shape[1] > SMALL_SITES]
    kept = _live_patterns if frame else stored
    cut_response = functools.partial(_cut_response, frame) if frame and not slots.light else None
    response_of = cut_response or functools.partial(kept, _normal_pattern)
    defects_of = functools.partial(_cut_defects, frame) if frame else functools.partial(kept, _defect_map)
    defects = slots.bright, slots.dead
    response = response_of(slots.electrons, shape, origin) if slots.electrons else EQUAL_RESPONSE
    light = stored(_radial_factor, slots.light, shape, origin) if slots.light else None
    if is_averaged:
        if light is None:
            light = response
        elif slots.electrons:
            values = light.values * response.values.astype(np.float64)
            light = light._replace(values=values.astype(np.float32))
        response = EQUAL_RESPONSE
    patterns = SitePatterns(
        response,
        kept(_normal_pattern, slots.sites_dn, shape, origin) if slots.sites_dn else NO_OFFSETS,
        defects_of(defects, shape, origin) if any(defects) else NO_DEFECTS,
        _means_e(slots.bright.mean_e if slots.bright else 0.0),
    )
    return patterns, light


@functools.lru_cache(maxsize=8)
def _means_e(mean_e: float) -> Float:
    return np.concatenate([[0.0, -1.0], mean_e * exponential_levels()])


# A crop's pattern is computed once for all frames and patches at its place.


def _compute(compute: Any, slot: Any, shape: Shape, origin: Shape) -> Any:
    return compute(slot, shape, origin)


_caches = [functools.lru_cache(maxsize=count)(_compute) for count in (SMALL_PATTERNS, LARGE_PATTERNS, LIVE_PATTERNS)]
_live_patterns = _caches[2]


def forget_patterns() -> None:
    """Drop the cached patterns, so that the next frame computes them, as the first frame of a unit does."""
    for cache in _caches:
        cache.cache_clear()
    _frames.clear()


def _radial_factor(slot: RadialFactor, shape: Shape, origin: Shape) -> SiteMap:
    first, width = origin[1] % BLOCK, padded_width(origin[1], shape[1])
    factors = np.ones((shape[0], width), dtype=np.float32)
    factors[:, first : first + shape[1]] = illumination(slot.coefficients, slot.frame_size, shape, origin)
    return SiteMap(factors.reshape(-1), (width, 1))


def _normal_pattern(slot: NormalPattern, shape: Shape, origin: Shape) -> SiteMap:
    width = padded_width(origin[1], shape[1])
    values, quadratics = np.zeros((shape[0], width), dtype=np.float32), normal_quantiles().quadratics
    key, stream = philox_key(slot.body_key), np.uint64(purpose(slot.stream))
    numbers = slot.std, slot.mean, slot.least
    _fill_normals(key, stream, numbers, origin, shape[1], quadratics, scratch_of_thread(), values)
    return SiteMap(values.reshape(-1), (width, 1))


@kernel
def _fill_normals(
    key: PhiloxKey,
    stream: np.uint64,
    numbers: tuple[float, float, float],
    origin: Shape,
    width: int,
    quadratics: Float,
    scratch: Scratch,
    out: Float32,
) -> None:
    """Fill ``out`` with max(mean + std·n, least) for normal deviates n and ``numbers`` std, mean, least."""
    buffers, target, normal = buffers_in(scratch), simd.pointer_to(out, 0), simd.pointer_to(quadratics, 0)
    std, mean, least = numbers
    for y in range(out.shape[0]):
        for x in range(0, width, STRIP):
            strip = locate(origin, y, x, min(STRIP, width - x))
            fill_word_blocks(key, strip, stream, buffers.words)
            row = simd.pointer_to(target, y * out.shape[1] + x + strip.lead)
            fill_rows(strip.total, buffers.words, buffers.scratch)
            for v in range(strip.total // VECTOR_WIDTH):
                n = np.uint64(v * VECTOR_WIDTH)
                deviate = exact_values(buffers.words, buffers.scratch, n, normal)
                simd.store(row, n, simd.to_float32(simd.maximum(deviate * std + mean, least)))


# -------------------------------------------------------------------------------------------------------------- defects


def word_threshold(fraction: float) -> np.uint64:
    """Return the word below which this fraction of all words is, as in `reference.noise.is_among`."""
    return np.uint64(int(fraction * 2**32))


DefectSlots = tuple[BrightPixels | None, DeadSlot | None]


def _defect_map(slots: DefectSlots, shape: Shape, origin: Shape) -> SiteMap:
    """Return the map of bright defects and of dead pixels; a missing slot has none."""
    either = slots[0] or slots[1]
    assert either is not None
    bright, dead = (slot or DeadSlot(either.body_key, either.stream, 0.0) for slot in slots)
    if not bright.share and not dead.share:
        return NO_DEFECTS
    streams = purpose(bright.stream), purpose(bright.stream, draw=1), purpose(dead.stream)
    width = padded_width(origin[1], shape[1])
    values = np.zeros((shape[0], width), dtype=np.uint16)
    _fill_defects(
        philox_key(either.body_key),
        (np.uint64(streams[0]), np.uint64(streams[1]), np.uint64(streams[2])),
        (word_threshold(bright.share), word_threshold(dead.share)),
        origin,
        shape[1],
        scratch_of_thread(),
        values,
    )
    return SiteMap(values.reshape(-1), (width, 1)) if values.any() else NO_DEFECTS


@kernel
def _fill_defects(
    key: PhiloxKey,
    streams: tuple[np.uint64, np.uint64, np.uint64],
    below: tuple[np.uint64, np.uint64],
    origin: Shape,
    width: int,
    scratch: Scratch,
    out: NDArray[np.uint16],
) -> None:
    """Fill ``out`` with the numbers of defects: pixels whose words of two streams are below a threshold."""
    buffers, target = buffers_in(scratch), simd.pointer_to(out, 0)
    bright, dead, steps = buffers.words, buffers.site_words, buffers.dark_words
    for y in range(out.shape[0]):
        for x in range(0, width, STRIP):
            strip = locate(origin, y, x, min(STRIP, width - x))
            fill_word_blocks(key, strip, streams[0], bright)
            row = simd.pointer_to(target, y * out.shape[1] + x + strip.lead)
            bright_count = np.int64(0)
            for n in range(strip.first, strip.after):
                bright_count += np.uint64(bright[n]) < below[0]
            if below[1] > 0:  # without dead pixels, their words would double the time
                fill_word_blocks(key, strip, streams[2], dead)
                for n in range(strip.first, strip.after):
                    row[n] = np.uint16(np.uint64(dead[n]) < below[1]) * np.uint16(DEAD)
            if bright_count > 0:
                fill_word_blocks(key, strip, streams[1], steps)
                for n in range(strip.first, strip.after):
                    if row[n] == 0 and np.uint64(bright[n]) < below[0]:
                        row[n] = np.uint16(FIRST_STEP + (steps[n] >> np.uint32(22)))


# ------------------------------------------------------------------------------------------------- frames of live crops

FRAME_BYTES, MOST_DEFECTS, MOST_FRAMES, FRAME_STEP = 2**28, 2**14, 64, 1024
"""Memory for the responses of frames in a process, most defects of a frame, and most frames, beyond which patterns are
computed for each crop; and the multiple to which sides of frames are rounded up."""


class _Frame(NamedTuple):
    """A pattern of the complete frame, from which live crops cut theirs.

    Live crops are at new places in each epoch. To compute their patterns would take a quarter of a crop of 128 x 128.
    """

    sides: Shape
    values: Any  # response [H, W]; or rows, columns and numbers of defects as lists; None beyond a limit


_frames: dict[Any, _Frame] = {}
"""Frames by slot. They grow where a picture is larger than those before it."""


def _frame_of(compute: Any, slot: Any, sides: Shape) -> _Frame:
    """Return the frame of a slot, which contains one of some ``sides``."""
    frame = _frames.get(slot)
    if frame is None and len(_frames) >= MOST_FRAMES:
        return _Frame(sides, None)
    if frame is None or sides[0] > frame.sides[0] or sides[1] > frame.sides[1]:
        known = frame.sides if frame else (0, 0)
        height, width = (max(-(-new // FRAME_STEP) * FRAME_STEP, old) for new, old in zip(sides, known, strict=True))
        frame = _frames[slot] = _Frame((height, width), compute(slot, (height, width)))
    return frame


def _cut_response(sides: Shape, slot: NormalPattern, shape: Shape, origin: Shape) -> SiteMap:
    """Return the response of a live crop as a view of that of the frame."""
    (_, width), values = _frame_of(_frame_response, slot, sides)
    if values is None:
        crop: SiteMap = _live_patterns(_normal_pattern, slot, shape, origin)
        return crop
    return SiteMap(values.reshape(-1)[origin[0] * width + origin[1] // BLOCK * BLOCK :], (width, 1))


def _frame_response(slot: NormalPattern, sides: Shape) -> NDArray[np.float32] | None:
    others = (frame.values for key, frame in _frames.items() if key != slot)
    kept_bytes = sum(values.nbytes for values in others if isinstance(values, np.ndarray))
    if 4 * sides[0] * sides[1] + kept_bytes > FRAME_BYTES:
        return None
    return _normal_pattern(slot, sides, (0, 0)).values.reshape(sides)


def _cut_defects(sides: Shape, slots: DefectSlots, shape: Shape, origin: Shape) -> SiteMap:
    """Return the defects of a live crop; most crops have none."""
    defects = _frame_of(_frame_defects, slots, sides).values
    if defects is None:
        crop: SiteMap = _live_patterns(_defect_map, slots, shape, origin)
        return crop
    rows, columns, numbers = defects
    near = range(bisect.bisect_left(rows, origin[0]), bisect.bisect_left(rows, origin[0] + shape[0]))
    inside = [n for n in near if 0 <= columns[n] - origin[1] < shape[1]]
    if not inside:
        return NO_DEFECTS
    left, width = origin[1] // BLOCK * BLOCK, padded_width(origin[1], shape[1])
    values = np.zeros((shape[0], width), dtype=np.uint16)
    for n in inside:
        values[rows[n] - origin[0], columns[n] - left] = numbers[n]
    return SiteMap(values.reshape(-1), (width, 1))


def _frame_defects(slots: DefectSlots, sides: Shape) -> list[list[int]] | None:
    """Return the defects of a frame, row by row; computed in parts, because the map of a frame is large."""
    if sum(slot.share for slot in slots if slot) * sides[0] * sides[1] > MOST_DEFECTS:
        return None
    rows: list[int] = []
    columns: list[int] = []
    numbers: list[int] = []
    for top in range(0, sides[0], FRAME_STEP):
        values = _defect_map(slots, (FRAME_STEP, sides[1]), (top, 0)).values
        for four in np.flatnonzero(values.view(np.uint64)).tolist():  # a quarter of the time of all sites
            for site in range(4 * four, 4 * four + 4):
                if values[site]:
                    rows.append(top + site // sides[1])
                    columns.append(site % sides[1])
                    numbers.append(int(values[site]))
    return [rows, columns, numbers]
