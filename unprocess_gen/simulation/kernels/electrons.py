"""Sample noise effect by effect, in electrons and then in DN: the order of `reference.noise.physical`.

Counts of electrons are exact (`poisson`). Their conversion to DN and the read noise are approximate, float32, with an
error bound; the read-out asks for the exact value of sites whose bound reaches a rounding boundary, and of defects. The
fixed patterns of the body are prepared once (`body`). The Poisson form of two-parameter noise is shot and read noise.

Timings and rejected alternatives: ``docs/design/kernels.md``.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.lookup_tables import tukey_table
from unprocess_gen.core.random_streams import BLOCK, LANES, ROUNDS, purpose, words
from unprocess_gen.core.types import Float, Plan
from unprocess_gen.simulation.kernels.body import HOT, Body
from unprocess_gen.simulation.kernels.gaussian import HETEROSCEDASTIC
from unprocess_gen.simulation.kernels.normal import (
    Quantiles,
    build_quantiles,
    exact_value,
    fill_values_by_lines,
    normal_quantiles,
)
from unprocess_gen.simulation.kernels.philox import (
    KEY_STEP0,
    KEY_STEP1,
    LOW32,
    PhiloxKey,
    fill_word_blocks,
    first_word,
    philox_round,
)
from unprocess_gen.simulation.kernels.poisson import (
    MAX_FLOAT32_RATE,
    CountTables,
    Rates,
    count_tables,
    exact_count,
    fill_counts,
)
from unprocess_gen.simulation.kernels.rounding import ROUND
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    Pointer,
    from_bits,
    load,
    minimum,
    pointer_to,
    store,
    to_bits,
)
from unprocess_gen.simulation.kernels.strips import STRIP, Float32, Strip, Workspace, padded_width
from unprocess_gen.simulation.reference import noise as reference_noise
from unprocess_gen.simulation.reference.poisson import gaussian_from

SHOT, DARK, READ, ROW = (np.uint64(purpose(stream)) for stream in ("shot", "dark_current", "read", "row"))

FLOAT32_ERROR_DN = 2.0**-21
"""Error that float32 adds to an approximate DN, relative to the DN and to its summands."""

MIN_READ_STD_E = 0.5
"""Least standard deviation of read noise with which a normal may replace counts.

Below it the steps of single electrons show, which no normal has: the Kolmogorov distance is 0.2/√rate without read
noise and 0.001/√rate at this value, in addition to the 0.07/√rate of `accuracy.gaussian_distance` (skewness).
"""

_8, _WITHOUT_SIGN = np.uint64(8), np.uint32(0x7FFFFFFF)
_ONE32, _FLOAT32_ERROR32 = np.float32(1), np.float32(FLOAT32_ERROR_DN)
_LANES = np.uint64(LANES)


class Electrons(NamedTuple):
    """Hold the effects of N frames of one body; P columns are those of complete blocks."""

    numbers: Float  # [N, NUMBERS]: see `_Numbers`
    read_purposes: NDArray[np.uint64]  # [N]
    read_lines: NDArray[np.uint64]  # [N, 4097]
    read_quadratics: Float  # [N, 4096]
    columns_dn: Float  # [N, P]
    errors_dn: Float  # [N, 2, 2]: black-level errors of the sites of a tile
    base_dn: Float32  # [N, 2, P]: black level, column and black-level error
    padded_width: int  # P
    black_dn: float
    body: Body
    tables: CountTables


class _Numbers(NamedTuple):
    """Hold the numbers of one frame; comments and defaults give the values that switch an effect off."""

    dn_per_e: float
    shot: float  # 0
    read_std_dn: float  # 0
    error_dn: float  # bound of the error of an approximate DN, in addition to FLOAT32_ERROR_DN times the DN
    lowest_root: float  # roots of the mean electrons between which shot noise is counted
    highest_root: float
    a_dn: float  # variance line
    b_dn2: float
    dark_e: float = 0.0
    removed_e: float = 0.0  # mean dark signal that the camera subtracts
    kept_dark_dn: float = 0.0  # in a clean frame with fixed patterns
    full_well_e: float = np.inf
    row_std_dn: float = 0.0


NUMBERS = len(_Numbers._fields)


# ----------------------------------------------------------------------------------------------------------- parameters


def electron_noise(
    plans: Sequence[Plan], body: Body, shape: tuple[int, int], origin: tuple[int, int], counts_all: bool
) -> Electrons:
    """Return the noise of frames of one body; ``counts_all`` forbids normals in place of counts."""
    first, columns = origin[1] % BLOCK, padded_width(origin[1], shape[1])
    frames = [_frame(plan, (origin[0], origin[1] - first), columns, counts_all) for plan in plans]
    numbers, purposes, quantiles, columns_dn, errors_dn = ([*members] for members in zip(*frames, strict=True))
    black_dn, base_dn = float(plans[0].black_level_dn), np.empty((len(plans), 2, columns), dtype=np.float32)
    for base, column_dn, error_dn in zip(base_dn, columns_dn, errors_dn, strict=True):
        for y in range(2):
            for x in range(2):
                base[y, x::2] = black_dn + (column_dn[x::2] + error_dn[y, x])
    return Electrons(
        numbers=np.array(numbers),
        read_purposes=np.array(purposes),
        read_lines=_stack([each.lines for each in quantiles]),
        read_quadratics=_stack([each.quadratics for each in quantiles]),
        columns_dn=_stack(columns_dn),
        errors_dn=_stack(errors_dn),
        base_dn=base_dn,
        padded_width=columns,
        black_dn=black_dn,
        body=body,
        tables=count_tables(),
    )


def _stack(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    """Return arrays along a new first axis; a single one is not copied."""
    return arrays[0][None] if len(arrays) == 1 else np.stack(arrays)


_Frame = tuple[_Numbers, np.uint64, Quantiles, Float, Float]


def _frame(plan: Plan, origin: tuple[int, int], columns: int, counts_all: bool) -> _Frame:
    """Return the numbers of one frame and its members of `Electrons`; ``origin`` is that of the first block."""
    physics = plan.physics
    if physics is None:
        return _two_parameter_frame(plan, columns, counts_all)
    on = frozenset(plan.effects)
    columns_dn, errors_dn = np.zeros(columns), np.zeros((2, 2))
    if "column" in on:
        columns_dn = physics.column_std_dn * _column_normals(physics.body_key, columns, origin[1])
    if "black_error" in on:
        errors_dn = reference_noise.black_error(physics, (2, 2), origin)
    dark_e = physics.dark_e if "dark_current" in on else 0.0
    removed_e = dark_e if physics.dark_offset == "removed" else 0.0
    read_std_dn = physics.read_std_dn if "read" in on else 0.0
    row_std_dn = physics.row_std_dn if "row" in on else 0.0
    quantiles = _read_quantiles(physics.read_law, physics.read_shape)
    offset_dn = (
        plan.black_level_dn + 6.4 * row_std_dn + float(np.abs(columns_dn).max(initial=0.0) + np.abs(errors_dn).max())
    )
    most_dark_dn = physics.dn_per_e * (dark_e + 8 * float(np.sqrt(dark_e)) + 40) if dark_e else 0.0
    lowest_root, highest_root = _count_roots(plan, read_std_dn / physics.dn_per_e, counts_all)
    a_dn, b_dn2 = plan.variance_line
    numbers = _Numbers(
        dn_per_e=physics.dn_per_e,
        shot=float("shot" in on),
        dark_e=dark_e,
        removed_e=removed_e,
        kept_dark_dn=0.0 if removed_e else dark_e * physics.dn_per_e,
        full_well_e=physics.full_well_e if "full_well" in on else np.inf,
        read_std_dn=read_std_dn,
        error_dn=_error_dn(read_std_dn, quantiles, offset_dn, most_dark_dn),
        row_std_dn=row_std_dn,
        lowest_root=lowest_root,
        highest_root=highest_root,
        a_dn=a_dn,
        b_dn2=b_dn2,
    )
    return numbers, READ, quantiles, columns_dn, errors_dn


@functools.lru_cache(maxsize=8)
def _column_normals(body_key: int, columns: int, left: int) -> Float:
    """Return the normal deviates of a body's columns."""
    words_of_columns = words(body_key, "column", (1, columns), origin=(0, left))
    return np.asarray(reference_noise.normals(words_of_columns)[0])


def _two_parameter_frame(plan: Plan, columns: int, counts_all: bool) -> _Frame:
    """Return shot and read noise whose variance line is that of the plan."""
    a_dn, b_dn2 = plan.variance_line
    read_std_dn, quantiles = float(np.sqrt(max(b_dn2, 0.0))), normal_quantiles()
    lowest_root, highest_root = _count_roots(plan, read_std_dn / a_dn, counts_all)
    numbers = _Numbers(
        dn_per_e=a_dn,
        shot=1.0,
        read_std_dn=read_std_dn,
        error_dn=_error_dn(read_std_dn, quantiles, float(plan.black_level_dn), 0.0),
        lowest_root=lowest_root,
        highest_root=highest_root,
        a_dn=a_dn,
        b_dn2=b_dn2,
    )
    return numbers, HETEROSCEDASTIC, quantiles, np.zeros(columns), np.zeros((2, 2))


def _error_dn(read_std_dn: float, quantiles: Quantiles, offset_dn: float, most_dark_dn: float) -> float:
    """Return `_Numbers.error_dn`."""
    farthest_dn = read_std_dn * float(np.abs(quantiles.quadratics[::4]).max())
    summands_dn = 2 * farthest_dn + 2 * offset_dn + most_dark_dn + 0.5
    return read_std_dn * quantiles.error + FLOAT32_ERROR_DN * summands_dn


def _count_roots(plan: Plan, read_std_e: float, counts_all: bool) -> tuple[float, float]:
    """Return the square roots of the mean electrons between which a normal is too far from the counts."""
    if "shot:gaussian_where_near" not in plan.methods or read_std_e < MIN_READ_STD_E or counts_all:
        return 0.0, np.inf  # without light no count is needed
    lowest, highest = np.sqrt(gaussian_from(read_std_e, plan.law_distance))
    return float(lowest), float(highest)


@functools.lru_cache(maxsize=8)
def _read_quantiles(law: str, shape: float) -> Quantiles:
    if law == "gaussian":
        return normal_quantiles()
    return build_quantiles(tukey_table(shape))


# ------------------------------------------------------------------------------------------------------------- sampling


@inner
def _load_numbers(noise: Electrons, n: int) -> _Numbers:
    v = pointer_to(noise.numbers, np.uint64(n * NUMBERS))
    return _Numbers(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10], v[11], v[12])


@inner
def add_electrons(noise: Electrons, n: int, key: PhiloxKey, strip: Strip, workspace: Workspace) -> Pointer:
    """Fill ``noise_dn`` and ``error_dn``, in float32; return the base to which the read-out adds them: zeros."""
    _count_electrons(noise, n, key, strip, workspace)
    of = _load_numbers(noise, n)
    fill_values_by_lines(
        strip.total, workspace.read_words, pointer_to(noise.read_lines, n * 4097), workspace.lines, workspace.normals
    )
    f = np.float32
    per_e, std, full_well_e, margin = f(of.dn_per_e), f(of.read_std_dn), f(of.full_well_e), f(of.error_dn)
    row_dn = f(workspace.row_dn[0])
    base = pointer_to(noise.base_dn, (2 * n + (strip.y & 1)) * noise.padded_width + strip.x + strip.lead)
    electrons = workspace.total_e if of.dark_e > 0.0 else workspace.electrons
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        dn = minimum(load(electrons, x), full_well_e) * per_e + (
            load(workspace.normals, x) * std + (load(base, x) + row_dn)
        )
        store(workspace.noise_dn, x, dn)
        store(workspace.error_dn, x, from_bits(to_bits(dn) & _WITHOUT_SIGN) * _FLOAT32_ERROR32 + margin)
    return workspace.zeros


@inner
def _count_electrons(noise: Electrons, n: int, key: PhiloxKey, strip: Strip, workspace: Workspace) -> None:
    """Fill ``electrons``, ``dark`` and ``defects``, and the words of the read noise."""
    of, tables = _load_numbers(noise, n), noise.tables
    rates = Rates(workspace.rates, workspace.rounded_e, workspace.residual_e, workspace.root, workspace.inverse)
    _fill_words_and_rates(noise, key, noise.read_purposes[n] | key[2], of.dn_per_e, strip, workspace)
    roots = np.float32(of.lowest_root), np.float32(of.highest_root)
    workspace.row_dn[0] = of.row_std_dn * exact_value(first_word(key, strip.row, ROW), tables.quadratics)
    if of.shot > 0.0:
        fill_counts(strip.total, workspace.words, rates, roots, tables, workspace, workspace.electrons)
    else:
        for x in range(strip.total):
            workspace.electrons[x] = np.float32(workspace.rates[x])
    if of.dark_e > 0.0:
        fill_word_blocks(key, strip, DARK, workspace.dark_words)
        dark = Rates(workspace.dark_rates, workspace.rounded_e, workspace.residual_e, workspace.root, workspace.inverse)
        _fill_equal_rates(of.dark_e, strip.total, dark)
        every = np.float32(0), np.float32(np.inf)
        fill_counts(strip.total, workspace.dark_words, dark, every, tables, workspace, workspace.dark)
        removed_e = np.float32(of.removed_e)
        for x in range(strip.total):
            workspace.total_e[x] = workspace.electrons[x] + (workspace.dark[x] - removed_e)
    first, after = _defects_of(noise.body, strip)
    if first < after:
        _draw_defects(noise, key, first, after, strip, workspace)


@inner
def _fill_words_and_rates(
    noise: Electrons, key: PhiloxKey, read_purpose: np.uint64, dn_per_e: float, strip: Strip, workspace: Workspace
) -> None:
    """Fill the words of shot and read noise, and the mean electrons with their roots and reciprocals.

    One loop: divisions and roots keep the divider busy, Philox the other units. It is written out for the four words of
    a counter, as in `philox.fill_word_blocks`.
    """
    black, clean_dn = noise.black_dn, workspace.unrounded_dn
    shot, read = workspace.words, workspace.read_words
    row, column = noise.body.response_steps
    response = pointer_to(noise.body.response, strip.y * row + strip.x * column + strip.lead)
    for block in range(strip.blocks):
        counter = (strip.block + np.uint64(block)) * _LANES
        for lane in range(LANES):
            x0 = block * BLOCK - strip.lead + lane
            x1, x2, x3 = x0 + LANES, x0 + 2 * LANES, x0 + 3 * LANES
            rate0 = (clean_dn[x0] - black) / dn_per_e * np.float64(response[x0])
            rate1 = (clean_dn[x1] - black) / dn_per_e * np.float64(response[x1])
            rate2 = (clean_dn[x2] - black) / dn_per_e * np.float64(response[x2])
            rate3 = (clean_dn[x3] - black) / dn_per_e * np.float64(response[x3])
            _store_rate(x0, rate0, workspace)
            _store_rate(x1, rate1, workspace)
            _store_rate(x2, rate2, workspace)
            _store_rate(x3, rate3, workspace)
            c0, c1, c2, c3 = counter + np.uint64(lane), strip.row, SHOT | key[2], key[3]
            d0, d1, d2, d3 = counter + np.uint64(lane), strip.row, read_purpose, key[3]
            k0, k1 = key[0], key[1]
            for _ in range(ROUNDS):
                c0, c1, c2, c3 = philox_round(c0, c1, c2, c3, k0, k1)
                d0, d1, d2, d3 = philox_round(d0, d1, d2, d3, k0, k1)
                k0, k1 = (k0 + KEY_STEP0) & LOW32, (k1 + KEY_STEP1) & LOW32
            shot[x0], shot[x1] = np.uint32(c0 & LOW32), np.uint32(c1 & LOW32)
            shot[x2], shot[x3] = np.uint32(c2 & LOW32), np.uint32(c3 & LOW32)
            read[x0], read[x1] = np.uint32(d0 & LOW32), np.uint32(d1 & LOW32)
            read[x2], read[x3] = np.uint32(d2 & LOW32), np.uint32(d3 & LOW32)


@inner
def _store_rate(x: int, rate: float, workspace: Workspace) -> None:
    """Store a mean and what `poisson.fill_counts` needs of it."""
    rounded = (rate + ROUND) - ROUND
    root = np.sqrt(np.float32(rate))
    workspace.rates[x], workspace.rounded_e[x] = rate, np.float32(rounded)
    workspace.residual_e[x], workspace.root[x], workspace.inverse[x] = np.float32(rate - rounded), root, _ONE32 / root


@inner
def _fill_equal_rates(rate: float, count: int, rates: Rates) -> None:
    """Fill the buffers of `poisson.fill_counts` for one mean."""
    rounded, root = (rate + ROUND) - ROUND, np.sqrt(np.float32(rate))
    for x in range(count):
        rates.rates[x], rates.rounded[x] = rate, np.float32(rounded)
        rates.residual[x], rates.root[x], rates.inverse[x] = np.float32(rate - rounded), root, np.float32(1) / root


@inner
def _defects_of(body: Body, strip: Strip) -> tuple[int, int]:
    """Return the range of a strip's defects in the lists of the body."""
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
    word, quadratics = workspace.read_words[x], pointer_to(noise.read_quadratics, n * 4096)
    return float(_dn(noise, of, n, x, exact_value(word, quadratics), strip, workspace))


@inner
def _dn(noise: Electrons, of: _Numbers, n: int, x: int, read: float, strip: Strip, workspace: Workspace) -> float:
    """Return the noisy DN of a site whose read noise is ``read`` standard deviations."""
    electrons = np.float64(workspace.electrons[x])
    if of.shot == 0.0:
        electrons = workspace.rates[x]
    elif workspace.rates[x] > MAX_FLOAT32_RATE:
        root = np.sqrt(np.float32(workspace.rates[x]))  # as `fill_counts` compares it
        if root > np.float32(of.lowest_root) and root < np.float32(of.highest_root):
            electrons = exact_count(workspace.words[x], workspace.rates[x], noise.tables)
    if of.dark_e > 0.0:
        dark = np.float64(workspace.dark[x])
        if of.dark_e > MAX_FLOAT32_RATE:
            dark = exact_count(workspace.dark_words[x], of.dark_e, noise.tables)
        electrons = electrons + (dark - of.removed_e)
    electrons = electrons + workspace.defects[x]
    dn = min(electrons, of.full_well_e) * of.dn_per_e + noise.black_dn
    dn = dn + of.read_std_dn * read
    offset_dn = workspace.row_dn[0] + noise.columns_dn[n * noise.padded_width + strip.x + strip.lead + x]
    dn = dn + (offset_dn + noise.errors_dn[4 * n + 2 * (strip.y & 1) + (x & 1)])
    return dn if workspace.defects[x] >= 0.0 else 0.0


@inner
def fill_exact_electrons(noise: Electrons, n: int, key: PhiloxKey, strip: Strip, workspace: Workspace) -> None:
    """Fill ``exact_dn`` with the noisy DN of all sites."""
    _count_electrons(noise, n, key, strip, workspace)
    of, quadratics, out = _load_numbers(noise, n), pointer_to(noise.read_quadratics, n * 4096), workspace.exact_dn
    for x in range(strip.total):
        out[x] = exact_value(workspace.read_words[x], quadratics)
    for x in range(strip.total):
        out[x] = _dn(noise, of, n, x, out[x], strip, workspace)


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
        dn = (clean_dn[x] + workspace.defects[x] * of.dn_per_e) + of.kept_dark_dn
        dn = min(dn, of.full_well_e * of.dn_per_e + noise.black_dn)
        offset_dn = 0.0 + noise.columns_dn[strip.x + strip.lead + x]
        dn = dn + (offset_dn + noise.errors_dn[2 * (strip.y & 1) + (x & 1)])
        clean_dn[x] = dn if workspace.defects[x] >= 0.0 else 0.0
