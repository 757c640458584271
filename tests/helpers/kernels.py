"""Call single stages of the compiled kernels on arrays of any length."""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.jit import inner, kernel
from unprocess_gen.core.random_streams import Words
from unprocess_gen.core.types import Float
from unprocess_gen.simulation.kernels.electrons import _store_rate
from unprocess_gen.simulation.kernels.normal import (
    Quantiles,
    apply_signs,
    coarse_normal,
    exact_value,
    fill_coarse_depths,
    fill_depths,
    fill_values_by_lines,
    fine_normal,
)
from unprocess_gen.simulation.kernels.poisson import (
    MAX_FLOAT32_RATE,
    CountTables,
    Rates,
    _count_by_expansion,
    _count_by_thresholds,
    _survey,
    count_tables,
    exact_count,
    fill_counts,
)
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, load, pointer_to, pointers_of, store
from unprocess_gen.simulation.kernels.strips import SIZE, Float32, Scratch, Workspace, scratch_of_thread, workspace_in

_ZERO, _INFINITY = np.float32(0), np.float32(np.inf)
_WIDTH = np.uint64(VECTOR_WIDTH)


# Deviates -------------------------------------------------------------------------------------------------------------


def values_by_lines(words: Words, law: Quantiles) -> Float32:
    """Return the approximate quantiles of words."""
    out = np.empty(words.shape, dtype=np.float32)
    _fill_by_lines(words, law.lines, np.empty(words.shape, dtype=np.uint64), out)
    return out


def exact_values(words: Words, law: Quantiles) -> Float:
    """Return the exact quantiles of words."""
    out = np.empty(words.shape)
    _fill_exact(words, law.quadratics, out)
    return out


def fine_normals(words: Words) -> Float32:
    """Return the normals of words by the fine polynomials."""
    depths, out = np.empty((2, _padded(words).size), dtype=np.float32)
    _fill_fine(_padded(words), depths, out)
    return out[: words.size]


def coarse_normals(words: Words) -> Float32:
    """Return the normals of words by the coarse polynomials."""
    depths, out = np.empty((2, _padded(words).size), dtype=np.float32)
    _fill_coarse(_padded(words), depths, out)
    return out[: words.size]


def _padded(words: Words) -> Words:
    return np.resize(words, -(-words.size // VECTOR_WIDTH) * VECTOR_WIDTH)


@kernel
def _fill_by_lines(words: Words, lines: np.ndarray, buffer: np.ndarray, out: Float32) -> None:
    given, scratch, target = pointer_to(words, 0), pointer_to(buffer, 0), pointer_to(out, 0)
    fill_values_by_lines(words.size, given, pointer_to(lines, 0), scratch, target)


@kernel
def _fill_exact(words: Words, quadratics: Float, out: Float) -> None:
    table = pointer_to(quadratics, 0)
    for n in range(words.size):
        out[n] = exact_value(words[n], table)


@kernel
def _fill_fine(words: Words, depths: Float32, out: Float32) -> None:
    given, depth, target = pointer_to(words, 0), pointer_to(depths, 0), pointer_to(out, 0)
    fill_depths(words.size, given, depth)
    for n in range(words.size // VECTOR_WIDTH):
        x = np.uint64(n) * _WIDTH
        store(target, x, apply_signs(fine_normal(load(depth, x)), load(given, x)))


@kernel
def _fill_coarse(words: Words, depths: Float32, out: Float32) -> None:
    given, depth, target = pointer_to(words, 0), pointer_to(depths, 0), pointer_to(out, 0)
    fill_coarse_depths(words.size, given, depth)
    for n in range(words.size // VECTOR_WIDTH):
        x = np.uint64(n) * _WIDTH
        store(target, x, apply_signs(coarse_normal(load(depth, x)), load(given, x)))


# Counts ---------------------------------------------------------------------------------------------------------------


def counts(words: Words, rates: Float) -> Float:
    """Return the Poisson counts of words, with the arguments of `reference.poisson.poisson`."""
    out = np.full(words.shape, np.nan)
    _fill_counts(words.astype(np.uint32), rates.astype(np.float64), count_tables(), scratch_of_thread(), out)
    return out


def exact_counts(words: Words, rates: Float) -> Float:
    """Return the counts by the computation that uncertain sites get."""
    out = np.full(words.shape, np.nan)
    _fill_exact_counts(words.astype(np.uint32), rates.astype(np.float64), count_tables(), out)
    return out


def approximate_counts(words: Words, rates: Float, tables: CountTables | None = None) -> tuple[Float32, np.ndarray]:
    """Return counts before uncertain ones are replaced, and the mask of uncertain ones."""
    out, is_listed = np.full(words.shape, np.nan, dtype=np.float32), np.zeros(words.shape, dtype=np.bool_)
    _fill_approximate(words.astype(np.uint32), rates, tables or count_tables(), scratch_of_thread(), out, is_listed)
    return out, is_listed


@inner
def _load_rates(words: Words, rates: Float, start: int, length: int, total: int, buffers: Workspace) -> None:
    """Load ``length`` words and rates from index ``start``, and repeat the last ones up to ``total``."""
    for n in range(total):
        at = start + min(n, length - 1)
        buffers.words[n] = words[at]
        _store_rate(n, rates[at], buffers)


@kernel
def _fill_counts(words: Words, rates: Float, tables: CountTables, scratch: Scratch, out: Float) -> None:
    """Draw as `electrons` does: counts of rates beyond float32's integers are computed exactly."""
    buffers, of, every = workspace_in(scratch, 0), pointers_of(tables), (_ZERO, _INFINITY)
    given = Rates(buffers.rates, buffers.rounded_e, buffers.residual_e, buffers.root, buffers.inverse)
    for start in range(0, words.size, SIZE):
        length = min(SIZE, words.size - start)
        total = -(-length // VECTOR_WIDTH) * VECTOR_WIDTH
        _load_rates(words, rates, start, length, total, buffers)
        fill_counts(total, buffers.words, given, every, of, buffers, buffers.electrons)
        for n in range(length):
            out[start + n] = np.float64(buffers.electrons[n])
            if rates[start + n] > MAX_FLOAT32_RATE:
                out[start + n] = exact_count(words[start + n], rates[start + n], of)


@kernel
def _fill_exact_counts(words: Words, rates: Float, tables: CountTables, out: Float) -> None:
    of = pointers_of(tables)
    for n in range(words.size):
        out[n] = exact_count(words[n], rates[n], of)


@kernel
def _fill_approximate(
    words: Words, rates: Float, tables: CountTables, scratch: Scratch, out: Float32, is_listed: np.ndarray
) -> None:
    buffers, of, every = workspace_in(scratch, 0), pointers_of(tables), (_ZERO, _INFINITY)
    given = Rates(buffers.rates, buffers.rounded_e, buffers.residual_e, buffers.root, buffers.inverse)
    for start in range(0, words.size, SIZE):
        length = min(SIZE, words.size - start)
        total = -(-length // VECTOR_WIDTH) * VECTOR_WIDTH
        _load_rates(words, rates, start, length, total, buffers)
        fill_values_by_lines(total, buffers.words, of.lines, buffers.lines, buffers.normals)
        found = 0
        has_low, has_high, _ = _survey(total, buffers.root, every)
        if has_low:
            found = _count_by_thresholds(total, given, every, of, buffers, buffers.electrons)
        if has_high:
            found = _count_by_expansion(total, given, every, found, buffers, buffers.electrons)
        for n in range(length):
            out[start + n] = buffers.electrons[n]
        for n in range(found):
            if buffers.uncertain[n] < length:
                is_listed[start + buffers.uncertain[n]] = True
