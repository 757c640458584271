"""Call single stages of the compiled kernels on arrays of any length."""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import Words
from unprocess_gen.simulation.kernels.jit import inner, kernel
from unprocess_gen.simulation.kernels.normal import (
    Quantiles,
    apply_signs,
    coarse_normal,
    exact_value,
    fill_coarse_depths,
    fill_rows,
    fill_values_by_lines,
)
from unprocess_gen.simulation.kernels.normal import exact_values as kernel_exact_values
from unprocess_gen.simulation.kernels.poisson import (
    CountTables,
    count_tables,
    count_thresholds,
    exact_count,
    fill_counts,
    fill_counts_of_one_rate,
)
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, load, pointer_to, pointers_of, store
from unprocess_gen.simulation.kernels.strips import (
    SIZE,
    Buffers,
    Float32,
    Scratch,
    buffers_in,
    scratch_of_thread,
)

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


def exact_values_by_vectors(words: Words, law: Quantiles) -> Float:
    """Return the exact quantiles of words, computed eight at a time."""
    padded = _padded(words)
    out = np.empty(padded.shape)
    _fill_by_vectors(padded, law.quadratics, np.empty(padded.shape, dtype=np.uint32), out)
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
def _fill_by_vectors(words: Words, quadratics: Float, buffer: np.ndarray, out: Float) -> None:
    given, rows, table = pointer_to(words, 0), pointer_to(buffer, 0), pointer_to(quadratics, 0)
    fill_rows(words.size, given, rows)
    for n in range(words.size // VECTOR_WIDTH):
        x = np.uint64(n) * _WIDTH
        store(pointer_to(out, 0), x, kernel_exact_values(given, rows, x, table))


@kernel
def _fill_coarse(words: Words, depths: Float32, out: Float32) -> None:
    given, depth, target = pointer_to(words, 0), pointer_to(depths, 0), pointer_to(out, 0)
    fill_coarse_depths(words.size, given, depth)
    for n in range(words.size // VECTOR_WIDTH):
        x = np.uint64(n) * _WIDTH
        store(target, x, apply_signs(coarse_normal(load(depth, x)), load(given, x)))


# Counts ---------------------------------------------------------------------------------------------------------------


def counts(words: Words, rates: Float) -> Float:
    """Return the Poisson counts of words, with the arguments of `reference.poisson.poisson`.

    Draw as `electrons` does: counts that are not certain are computed exactly.
    """
    found, error = approximate_counts(words, rates)
    exact = exact_counts(words, rates)
    return np.where(error > 0, exact, found.astype(np.float64))


def exact_counts(words: Words, rates: Float) -> Float:
    """Return the counts by the computation that uncertain sites get."""
    out = np.full(words.shape, np.nan)
    _fill_exact_counts(words.astype(np.uint32), rates.astype(np.float64), count_tables(), out)
    return out


def approximate_counts(
    words: Words, rates: Float, tables: CountTables | None = None, rate_error: float = 0.0
) -> tuple[Float32, Float32]:
    """Return counts before uncertain ones are replaced, and bounds of their errors, 0 where they are certain.

    ``rate_error`` is the relative error of the rates in float32, in addition to rounding.
    """
    out, error = np.full((2, words.size), np.nan, dtype=np.float32)
    with np.errstate(under="ignore"):
        near = (rates.astype(np.float64) * (1 + rate_error)).astype(np.float32)
    _fill_approximate(words.astype(np.uint32), near, tables or count_tables(), scratch_of_thread(), out, error)
    return out, error


def counts_of_one_rate(words: Words, rate: float) -> Float32:
    """Return the Poisson counts of words by the thresholds of one rate."""
    out = np.full(words.shape, np.nan, dtype=np.float32)
    _fill_of_one_rate(words.astype(np.uint32), *count_thresholds(rate), scratch_of_thread(), out)
    return out


@kernel
def _fill_exact_counts(words: Words, rates: Float, tables: CountTables, out: Float) -> None:
    of = pointers_of(tables)
    for n in range(words.size):
        out[n] = exact_count(words[n], rates[n], of)


@inner
def _load_words(words: Words, start: int, length: int, buffers: Buffers) -> None:
    """Load ``length`` words from index ``start``, and repeat the last one to fill complete blocks."""
    for n in range(SIZE):
        buffers.words[n] = words[start + min(n, length - 1)]


@kernel
def _fill_approximate(
    words: Words, rates: Float32, tables: CountTables, scratch: Scratch, out: Float32, error: Float32
) -> None:
    buffers, of = buffers_in(scratch), pointers_of(tables)
    for start in range(0, words.size, SIZE):
        length = min(SIZE, words.size - start)
        _load_words(words, start, length, buffers)
        for n in range(SIZE):
            buffers.rates[n] = rates[start + min(n, length - 1)]
        fill_counts(SIZE, buffers.words, buffers.rates, of, buffers, buffers.light_e, buffers.light_error_e)
        for n in range(length):
            out[start + n], error[start + n] = buffers.light_e[n], buffers.light_error_e[n]


@kernel
def _fill_of_one_rate(words: Words, smallest: int, ranks: np.ndarray, scratch: Scratch, out: Float32) -> None:
    buffers, of = buffers_in(scratch), pointer_to(ranks, 0)
    for start in range(0, words.size, SIZE):
        length = min(SIZE, words.size - start)
        _load_words(words, start, length, buffers)
        fill_counts_of_one_rate(SIZE, buffers.words, np.float32(smallest), of, ranks.size, buffers.dark_e)
        for n in range(length):
            out[start + n] = buffers.dark_e[n]
