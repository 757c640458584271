"""Sample noise effect by effect, in electrons and then in DN: the order of `reference.noise.physical`.

Counts of electrons are exact (`poisson`). Their conversion to DN and the read noise are approximate, float32, with an
error bound; the read-out asks for the exact value of sites whose bound reaches a rounding boundary, and of defects. The
fixed patterns of the body are prepared once (`body`). The Poisson form of two-parameter noise is shot and read noise.

Timings and rejected alternatives: ``docs/design/kernels.md``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.random_streams import purpose
from unprocess_gen.core.types import Float
from unprocess_gen.simulation.kernels.body import HOT, Body
from unprocess_gen.simulation.kernels.normal import (
    exact_value,
    exact_values,
    fill_rows,
    fill_values_by_lines,
)
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_word_blocks, first_word
from unprocess_gen.simulation.kernels.poisson import (
    FLOAT32_RATE,
    LOW_RATE,
    CountTables,
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
    to_float32,
    to_float64,
)
from unprocess_gen.simulation.kernels.strips import STRIP, Float32, Strip, Workspace, list_lanes

SHOT, DARK, ROW = (np.uint64(purpose(stream)) for stream in ("shot", "dark_current", "row"))

FLOAT32_ERROR_DN = 2.0**-21
"""Error that float32 adds to an approximate DN, relative to the DN and to its summands."""

MAX_STEPS = 64
"""Most thresholds of `poisson.count_thresholds`."""

_0, _8, _16, _INFINITE_BITS32 = np.uint64(0), np.uint64(8), np.uint64(16), np.uint32(0x7F800000)
_ZERO32, _INFINITY32, _FLOAT32_ERROR32 = np.float32(0), np.float32(np.inf), np.float32(FLOAT32_ERROR_DN)
_LOW_RATE32, _EVERY_LANE = np.float32(LOW_RATE), np.uint32(2**VECTOR_WIDTH - 1)
_RATE_ERROR32, _NORMAL_ERROR32 = np.float32(FLOAT32_RATE), np.float32(2.0**-19)


class Electrons(NamedTuple):
    """Hold the effects of N frames of one body; P columns are those of complete blocks."""

    numbers: Float  # [N, NUMBERS]: see `FrameNumbers`
    read_lines: NDArray[np.uint64]  # [N, 4097]
    read_quadratics: Float  # [N, 4096]
    sites: Float  # [N, 2, 3, 8]: DN per electron, full well and black-level error of sites of even and odd rows
    rows_dn: Float  # [N, H]: offsets of correlated rows; else one 0
    rows_step: int  # H; 0 if rows are independent
    columns_dn: Float  # [N, P]
    fixed_columns_dn: Float  # [P]: without the part that is new in every frame
    base_dn: Float32  # [N, 2, P]: black level, column and black-level error
    dark_frames_dn: Float32  # [N, H, P]: values of dark frames above black; [P] zeros without them
    dark_frames_steps: tuple[int, int]  # elements from frame to frame and from row to row; 0 without dark frames
    dark_ranks: NDArray[np.uint32]  # [N, MAX_STEPS]: see `poisson.count_thresholds`
    padded_width: int  # P
    black_dn: float
    full_dn: float  # DN of the full well in a clean frame with fixed patterns
    body: Body
    tables: CountTables


class FrameNumbers(NamedTuple):
    """Hold the numbers of one frame; comments and defaults give the values that switch an effect off."""

    shot: float  # 0
    read_purpose: float  # word of the random words of read noise
    read_std_dn: float  # 0
    error_dn: float  # bound of the error of an approximate DN, in addition to FLOAT32_ERROR_DN times the DN
    lowest_root: float  # roots of the mean electrons between which shot noise is counted
    highest_root: float
    dark_e: float = 0.0
    dark_steps: float = 0.0  # thresholds of the dark signal; below 0 if it has too many
    fewest_dark: float = 0.0  # smallest count of the dark signal
    removed_e: float = 0.0  # mean dark signal that the camera subtracts
    kept_dark_e: float = 0.0  # in a clean frame with fixed patterns
    row_std_dn: float = 0.0


NUMBERS = len(FrameNumbers._fields)


@inner
def _load_numbers(noise: Electrons, n: int) -> FrameNumbers:
    v = pointer_to(noise.numbers, np.uint64(n * NUMBERS))
    return FrameNumbers(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10], v[11])


@inner
def _sites_of(noise: Electrons, n: int, strip: Strip) -> Pointer:
    """Return the gains, full wells and black-level errors of eight sites of the strip's row."""
    return pointer_to(noise.sites, 24 * (2 * n + (strip.y & 1)))


# -------------------------------------------------------------------------------------------------- counts of electrons


@inner
def count_electrons(noise: Electrons, n: int, key: PhiloxKey, strip: Strip, workspace: Workspace) -> None:
    """Fill ``electrons``, ``dark`` and ``total_e`` with bounds of their errors, ``defects``, all words, and normals."""
    of, tables = _load_numbers(noise, n), noise.tables
    first, after = _mark_defects(noise.body, strip, workspace)
    for stream in range(4):  # loops, so that machine code contains each function once
        purpose_word, words, is_needed = SHOT, workspace.words, True
        if stream == 1:
            purpose_word, words = np.uint64(of.read_purpose), workspace.read_words
        elif stream == 2:
            purpose_word, words, is_needed = DARK, workspace.dark_words, of.dark_e > 0.0
        elif stream == 3:
            purpose_word, words, is_needed = HOT, workspace.hot_words, first < after
        if is_needed:
            fill_word_blocks(key, strip, purpose_word, words)
    row_dn = of.row_std_dn * exact_value(first_word(key, strip.row, ROW), tables.quadratics)
    workspace.row_dn[0] = row_dn + noise.rows_dn[n * noise.rows_step + min(strip.y, noise.rows_step)]
    limit = np.float32(of.highest_root * of.highest_root * (1 + 4 * FLOAT32_RATE))
    for stream in range(0 if of.dark_steps < 0.0 else 1, 2):  # light last: its normals are kept
        if stream == 0:
            has_high, limit_of_stream = True, _INFINITY32
            words, out, error = workspace.dark_words, workspace.dark, workspace.dark_error_e
            for x in range(strip.total):
                workspace.rates[x] = of.dark_e
        else:
            has_high, limit_of_stream = _fill_rates(noise, n, strip, workspace), limit
            words, out, error = workspace.words, workspace.electrons, workspace.error_e
        fill_counts(strip.total, words, workspace.rates, has_high, limit_of_stream, tables, workspace, out, error)
    if of.shot == 0.0:
        for x in range(strip.total):
            workspace.electrons[x] = workspace.rates[x]
            workspace.error_e[x] = workspace.rates[x] * _RATE_ERROR32
    elif of.lowest_root > 0.0 or of.highest_root < np.inf:
        if not has_high:
            fill_values_by_lines(strip.total, workspace.words, tables.lines, workspace.lines, workspace.normals)
        _replace_by_normals(strip.total, of, limit, workspace)
    if of.dark_e > 0.0:
        _add_dark_signal(noise, n, of, strip, workspace)
    _draw_defects(noise, first, after, workspace)


@inner
def _fill_rates(noise: Electrons, n: int, strip: Strip, workspace: Workspace) -> bool:
    """Fill ``rates`` (float32) with the mean electrons of shot noise; return whether any is `LOW_RATE` or more.

    At most five roundings, as `poisson.FLOAT32_RATE` allows.
    """
    black, e_per_dn = np.float32(noise.black_dn), to_float32(1.0 / load(_sites_of(noise, n, strip), _0))
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
def _replace_by_normals(count: int, of: FrameNumbers, limit: np.float32, workspace: Workspace) -> None:
    """Replace counts where a normal is near enough; sites at the limits, within the error of float32, are uncertain.

    ``limit`` is the rate from which a normal replaces every count, in spite of the error of float32.
    """
    low, high = of.lowest_root * of.lowest_root, of.highest_root * of.highest_root
    f, more, less = np.float32, 1 + 4 * FLOAT32_RATE, 1 - 4 * FLOAT32_RATE
    low_less, low_more, high_less, high_more = f(low * less), f(low * more), f(high * less), limit
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
def _add_dark_signal(noise: Electrons, n: int, of: FrameNumbers, strip: Strip, workspace: Workspace) -> None:
    """Fill ``total_e`` with the counts of light and of the dark signal, less its mean if the camera subtracts it."""
    if of.dark_steps >= 0.0:
        ranks, steps = pointer_to(noise.dark_ranks, n * MAX_STEPS), np.int64(of.dark_steps)
        fewest = np.float32(of.fewest_dark)
        fill_counts_of_one_rate(strip.total, workspace.dark_words, fewest, ranks, steps, workspace.dark)
        for x in range(strip.total):
            workspace.dark_error_e[x] = 0.0
    removed_e = np.float32(of.removed_e)
    for x in range(strip.total):
        workspace.total_e[x] = workspace.electrons[x] + (workspace.dark[x] - removed_e)
        workspace.total_error_e[x] = workspace.error_e[x] + workspace.dark_error_e[x]


@inner
def _defects_of(body: Body, strip: Strip) -> tuple[int, int]:
    """Return the range of a strip's defects in the lists of the body."""
    if body.strips == 0:
        return 0, 0
    at = strip.y * body.strips + strip.x // STRIP
    return body.starts[at], body.starts[at + 1]


@inner
def _mark_defects(body: Body, strip: Strip, workspace: Workspace) -> tuple[int, int]:
    """Fill ``defects`` with the means of hot pixels, less than 0 at dead ones, and list them as uncertain.

    Return their range in the lists of the body.
    """
    if body.strips > 0:  # otherwise no strip has filled it
        for x in range(strip.total):
            workspace.defects[x] = 0.0
    first, after = _defects_of(body, strip)
    for d in range(first, after):
        workspace.defects[body.positions[d]] = body.means_e[d]
        workspace.uncertain[d - first] = np.uint32(body.positions[d])
    return first, after


@inner
def _draw_defects(noise: Electrons, first: int, after: int, workspace: Workspace) -> None:
    """Replace the means of hot pixels in ``defects`` with counts."""
    for d in range(first, after):
        x, mean_e = noise.body.positions[d], noise.body.means_e[d]
        if mean_e >= 0.0:
            workspace.defects[x] = exact_count(workspace.hot_words[x], mean_e, noise.tables)


# ------------------------------------------------------------------------------------------------------------------ DN


@inner
def add_electrons(readout: Any, noise: Electrons, n: int, strip: Strip, workspace: Workspace) -> tuple[Pointer, int]:
    """Fill ``noise_dn`` and ``error_dn``, in float32.

    Return the base to which the read-out adds the noise, zeros, and the number of defects, which are listed already.
    """
    of, lines = _load_numbers(noise, n), pointer_to(noise.read_lines, n * 4097)
    fill_values_by_lines(strip.total, workspace.read_words, lines, workspace.lines, workspace.noise_dn)
    sites, f = _sites_of(noise, n, strip), np.float32
    per_e, full_well_e = to_float32(load(sites, _0)), to_float32(load(sites, _8))
    std, margin, row_dn = f(of.read_std_dn), f(of.error_dn), f(workspace.row_dn[0])
    base = pointer_to(noise.base_dn, (2 * n + (strip.y & 1)) * noise.padded_width + strip.x + strip.lead)
    dark_dn = _dark_frame_of(noise, n, strip)
    has_dark = of.dark_e > 0.0
    electrons = workspace.total_e if has_dark else workspace.electrons
    error_e = workspace.total_error_e if has_dark else workspace.error_e
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        dn = minimum(load(electrons, x), full_well_e) * per_e + (
            load(workspace.noise_dn, x) * std + (load(base, x) + load(dark_dn, x) + row_dn)
        )
        store(workspace.noise_dn, x, dn)
        store(workspace.error_dn, x, absolute(dn) * _FLOAT32_ERROR32 + (load(error_e, x) * per_e + margin))
    first, after = _defects_of(noise.body, strip)
    return workspace.zeros, after - first


@inner
def _dark_frame_of(noise: Electrons, n: int, strip: Strip) -> Pointer:
    """Return the values of the dark frame of frame ``n`` in a strip."""
    of_frame, of_row = noise.dark_frames_steps
    return pointer_to(noise.dark_frames_dn, n * of_frame + strip.y * of_row + strip.x + strip.lead)


@inner
def exact_electrons_dn(noise: Electrons, n: int, x: int, strip: Strip, workspace: Workspace) -> float:
    """Return the noisy DN of one site, in the reference's order of operations."""
    of, sites = _load_numbers(noise, n), pointer_to(_sites_of(noise, n, strip), x & 1)
    electrons = np.float64(workspace.electrons[x])
    if workspace.error_e[x] > _ZERO32:
        electrons = _exact_shot(noise, of, n, x, strip, workspace)
    if of.dark_e > 0.0:
        dark = np.float64(workspace.dark[x])
        if workspace.dark_error_e[x] > _ZERO32:
            dark = exact_count(workspace.dark_words[x], of.dark_e, noise.tables)
        electrons = electrons + (dark - of.removed_e)
    electrons = electrons + workspace.defects[x]
    dn = minimum(electrons, sites[8]) * sites[0] + noise.black_dn
    dn = dn + of.read_std_dn * exact_value(workspace.read_words[x], pointer_to(noise.read_quadratics, n * 4096))
    offset_dn = workspace.row_dn[0] + noise.columns_dn[n * noise.padded_width + strip.x + strip.lead + x]
    dn = dn + (offset_dn + sites[16])
    dn = dn + np.float64(_dark_frame_of(noise, n, strip)[x])
    return float(dn) if workspace.defects[x] >= 0.0 else 0.0


@inner
def _exact_shot(noise: Electrons, of: FrameNumbers, n: int, x: int, strip: Strip, workspace: Workspace) -> float:
    """Return the electrons of light: a count, a normal in its place, or the mean."""
    row, column = noise.body.response_steps
    response = np.float64(noise.body.response[strip.y * row + (strip.x + strip.lead + x) * column])
    rate = (workspace.unrounded_dn[x] - noise.black_dn) / _sites_of(noise, n, strip)[x & 1] * response
    if of.shot == 0.0:
        return float(rate)
    root = np.sqrt(np.float32(rate))
    if root > np.float32(of.lowest_root) and root < np.float32(of.highest_root):
        return float(exact_count(workspace.words[x], rate, noise.tables))
    rounded = (rate + ROUND) - ROUND
    return float(np.float32(rounded) + (np.float32(rate - rounded) + root * workspace.normals[x]))


@inner
def fill_exact_electrons(
    readout: Any, noise: Electrons, n: int, strip: Strip, workspace: Workspace
) -> tuple[Pointer, int]:
    """Return ``exact_dn``, filled with the noisy DN of all sites: of certain counts in loops, then of the others."""
    of, quadratics, out = _load_numbers(noise, n), pointer_to(noise.read_quadratics, n * 4096), workspace.exact_dn
    fill_rows(strip.total, workspace.read_words, workspace.scratch)
    has_dark, sites = of.dark_e > 0.0, _sites_of(noise, n, strip)
    dark, error_e = workspace.dark, workspace.error_e
    if has_dark:
        error_e = workspace.total_error_e
    else:
        dark = workspace.zeros  # adding 0 - 0 changes no bit
    dn_per_e, full_well_e, errors_dn = load(sites, _0), load(sites, _8), load(sites, _16)
    row_dn = workspace.row_dn[0]
    columns_dn = pointer_to(noise.columns_dn, n * noise.padded_width + strip.x + strip.lead)
    dark_frame_dn = _dark_frame_of(noise, n, strip)
    first, after = _defects_of(noise.body, strip)
    found = after - first
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        read = exact_values(workspace.read_words, workspace.scratch, x, quadratics)
        electrons = to_float64(load(workspace.electrons, x)) + (to_float64(load(dark, x)) - of.removed_e)
        dn = minimum(electrons, full_well_e) * dn_per_e + noise.black_dn + read * of.read_std_dn
        dn = dn + ((load(columns_dn, x) + row_dn) + errors_dn)
        store(out, x, dn + to_float64(load(dark_frame_dn, x)))
        found = list_lanes(less_than(_ZERO32, load(error_e, x)), x, found, workspace)
    for m in range(found):
        at = np.int64(workspace.uncertain[m])
        out[at] = exact_electrons_dn(noise, n, at, strip, workspace)
    return out, found


@inner
def average_electrons(noise: Electrons, strip: Strip, workspace: Workspace) -> None:
    """Add the fixed patterns to the unrounded clean frame, as `reference.noise.average`."""
    of, clean_dn, body = _load_numbers(noise, np.int64(0)), workspace.unrounded_dn, noise.body
    _mark_defects(body, strip, workspace)
    sites = _sites_of(noise, np.int64(0), strip)
    for x in range(strip.total):
        gain = sites[x & 1]
        dn = (clean_dn[x] + workspace.defects[x] * gain) + of.kept_dark_e * gain
        dn = minimum(dn, noise.full_dn)
        offset_dn = 0.0 + noise.fixed_columns_dn[strip.x + strip.lead + x]
        dn = dn + (offset_dn + sites[16 + (x & 1)])
        clean_dn[x] = dn if workspace.defects[x] >= 0.0 else 0.0
