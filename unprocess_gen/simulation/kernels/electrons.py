"""Sample noise effect by effect, in electrons and then in DN: the order of `reference.electrons.noisy`.

The way of a strip of a noisy frame. Left, the function; right, the `Buffers` that it fills::

    clean frame of the strip      unrounded_dn, rounded_dn, residual_dn          clean.fill_clean
              |
      count_electrons
        _fill_rates               rates           mean electrons of light
        fill_counts               light_e         counts of light       + light_error_e   0: the count is certain
        _count_dark               dark_e          counts of one rate    + dark_error_e
        _fill_defects             defects_e       counts of bright defects; negative: a dead pixel
              |                   row_dn          the offset of the strip's row
              |
              +--------------------------------------------+
              |  uint16 frames                             |  float32 frames
      approximate_electrons                         exact_electrons
        noise_dn    DN, float32                       exact_dn   DN, float64
        error_dn    bound of its error                  |
              |                                         |
      readout rounds; where the bound                 readout normalises
      reaches a rounding boundary, it asks
      exact_electrons_site

Most sites are rounded alike whatever the last bits of their DN are. So counts and DN are first approximate, in float32,
with a bound of the error, eight sites at a time. Only the sites whose bound reaches a rounding boundary, some 0.2 % in
daylight, are computed exactly, in float64, in the order of the reference. Defects are always among them, so that other
sites pay nothing for them. Float32 frames are not rounded, so all of their sites are exact.

The sum in DN is written once, in `_sum_dn`, for all three. Fixed patterns of the sensor unit are prepared once, by
`site_patterns`, and numbers of frames by `electron_records`. The Poisson form of two-parameter noise is counts and
noise of the site alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Float
from unprocess_gen.simulation.kernels import normal, simd
from unprocess_gen.simulation.kernels.jit import inner
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_word_blocks, first_word
from unprocess_gen.simulation.kernels.poisson import (
    FLOAT32_RATE,
    CountTables,
    exact_count,
    fill_counts,
    fill_counts_of_one_rate,
)
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, Pointer, pointer_to
from unprocess_gen.simulation.kernels.site_patterns import SitePatterns
from unprocess_gen.simulation.kernels.strips import Buffers, Float32, SiteMap, Strip, list_lanes, strip_values

FLOAT32_ERROR_DN = 2.0**-21
"""Error that float32 adds to an approximate DN, relative to the DN and to its summands: eight roundings."""

MAX_STEPS = 64
"""Most thresholds of `poisson.count_thresholds`."""

_8, _ZERO32, _INFINITE32 = np.uint64(8), np.float32(0), np.float32(np.inf)
_RATE_ERROR32 = np.float32(FLOAT32_RATE)


class Electrons(NamedTuple):
    """The slots of N frames of one sensor unit; P is the number of columns of complete blocks."""

    numbers: Float  # [N, len(PLACES)]: see `FrameNumbers`
    site_lines: NDArray[np.uint64]  # [N, 4097]: quantiles of the noise of a site
    site_quadratics: Float  # [N, 4096]
    dn_per_e: Float  # [N, 2, 8]: of eight sites of even and of odd rows
    full_well_e: Float  # [N, 2, 8]
    planes_dn: Float  # [N, 2, 8]: offsets by plane
    rows_dn: Float  # [N, H]: offsets by row that are prepared; else one 0
    rows_step: int  # H; 0 if none is prepared
    columns_dn: Float  # [N, P]: offsets by column
    fixed_columns_dn: Float  # [P]: without those that are new in every frame
    base_dn: Float32  # [N, 2, P]: black level, column and plane
    sites_dn: SiteMap  # offsets by site: of the sensor unit, or [N, H, P] of all frames
    sites_step: int  # elements from frame to frame
    dark_ranks: NDArray[np.uint32]  # [N, MAX_STEPS]: see `poisson.count_thresholds`
    padded_width: int  # P
    black_dn: float
    has_negative: bool  # whether light can be below black
    full_dn: float  # DN of the full well in a clean frame with fixed patterns
    dead_dn: float  # value of dead pixels
    patterns: SitePatterns
    tables: CountTables


class FrameNumbers(NamedTuple):
    """Numbers of one frame; `load_frame` reads them from an array, in this order."""

    counts_light: bool  # otherwise the electrons of light are their mean
    has_dark: bool  # counts of one rate at every site
    has_thresholds: bool  # whether these are found by thresholds
    light_stream: np.uint64  # words of the counters of random words (`random_streams.purpose`)
    dark_stream: np.uint64
    defect_stream: np.uint64
    site_stream: np.uint64
    row_stream: np.uint64
    dark_e: float  # rate
    removed_e: float  # mean that the camera subtracts from them
    fewest_dark: np.float32  # smallest count by thresholds
    dark_steps: np.int64  # number of thresholds
    site_std_dn: float  # noise of a site
    row_std_dn: float  # 0 if rows are correlated: `Electrons.rows_dn` has their offsets
    error_dn: float  # bound of the error of an approximate DN, in addition to FLOAT32_ERROR_DN times the DN


PLACES: Any = FrameNumbers(*range(len(FrameNumbers._fields)))
"""The place of each number in the array of a frame."""


@inner
def load_frame(noise: Electrons, n: int) -> FrameNumbers:
    """Return the numbers of frame ``n`` with their types."""
    v = pointer_to(noise.numbers, np.uint64(n * len(PLACES)))
    return FrameNumbers(
        counts_light=v[PLACES.counts_light] != 0.0,
        has_dark=v[PLACES.has_dark] != 0.0,
        has_thresholds=v[PLACES.has_thresholds] != 0.0,
        light_stream=np.uint64(v[PLACES.light_stream]),
        dark_stream=np.uint64(v[PLACES.dark_stream]),
        defect_stream=np.uint64(v[PLACES.defect_stream]),
        site_stream=np.uint64(v[PLACES.site_stream]),
        row_stream=np.uint64(v[PLACES.row_stream]),
        dark_e=v[PLACES.dark_e],
        removed_e=v[PLACES.removed_e],
        fewest_dark=np.float32(v[PLACES.fewest_dark]),
        dark_steps=np.int64(v[PLACES.dark_steps]),
        site_std_dn=v[PLACES.site_std_dn],
        row_std_dn=v[PLACES.row_std_dn],
        error_dn=v[PLACES.error_dn],
    )


@inner
def _first_site(n: int, strip: Strip) -> int:
    """Return the index of the strip's row in the arrays ``[N, 2, 8]``."""
    return VECTOR_WIDTH * (2 * n + (strip.y & 1))


@inner
def _first_column(strip: Strip) -> int:
    """Return the column of the strip's first site in arrays of complete blocks."""
    return strip.x + strip.lead


@inner
def _sites_dn(noise: Electrons, n: int, strip: Strip) -> Pointer:
    """Return the offsets by site in a strip."""
    return pointer_to(strip_values(noise.sites_dn, strip), n * noise.sites_step)


# -------------------------------------------------------------------------------------------------- counts of electrons


@inner
def count_electrons(noise: Electrons, n: int, key: PhiloxKey, strip: Strip, buffers: Buffers) -> None:
    """Fill counts of electrons with bounds of their errors, the offset of the row, and the words of all sites."""
    frame = load_frame(noise, n)
    fill_word_blocks(key, strip, frame.light_stream, buffers.words)
    fill_word_blocks(key, strip, frame.site_stream, buffers.site_words)
    _fill_rates(noise, n, strip, buffers)
    _count_light(noise, frame, strip, buffers)
    if frame.has_dark:
        fill_word_blocks(key, strip, frame.dark_stream, buffers.dark_words)
        _count_dark(noise, n, frame, strip, buffers)
    if _fill_defects(noise.patterns, strip, buffers):
        fill_word_blocks(key, strip, frame.defect_stream, buffers.defect_words)
        _count_defects(noise, strip, buffers)
    row_word = first_word(key, strip.row, frame.row_stream)
    row_dn = frame.row_std_dn * normal.exact_value(row_word, noise.tables.quadratics)
    buffers.row_dn[0] = row_dn + noise.rows_dn[n * noise.rows_step + min(strip.y, noise.rows_step)]


@inner
def _fill_rates(noise: Electrons, n: int, strip: Strip, buffers: Buffers) -> None:
    """Fill ``rates`` (float32) with the mean electrons of light.

    At most five roundings, as `poisson.FLOAT32_RATE` allows.
    """
    e_per_dn = simd.to_float32(1.0 / simd.load(noise.dn_per_e, np.uint64(_first_site(n, strip))))
    response = strip_values(noise.patterns.response, strip)
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        light_dn = (simd.load(buffers.rounded_dn, x) - noise.black_dn) + simd.load(buffers.residual_dn, x)
        simd.store(buffers.rates, x, light_dn * e_per_dn * simd.load(response, x))


@inner
def _count_light(noise: Electrons, frame: FrameNumbers, strip: Strip, buffers: Buffers) -> None:
    """Fill ``light_e`` with counts of ``rates``; negative light, and all light without shot noise, stays as it is."""
    rates, means_e, light_e, light_error_e = buffers.rates, buffers.noise_dn, buffers.light_e, buffers.light_error_e
    has_means = noise.has_negative or not frame.counts_light
    if has_means:
        for x in range(strip.total):
            means_e[x], rates[x] = rates[x], simd.maximum(rates[x], _ZERO32)
    if frame.counts_light:
        fill_counts(strip.total, buffers.words, rates, noise.tables, buffers, light_e, light_error_e)
    if has_means:
        for x in range(strip.total):
            if means_e[x] < _ZERO32 or not frame.counts_light:
                light_e[x] = means_e[x]
                light_error_e[x] = abs(means_e[x]) * _RATE_ERROR32


@inner
def _count_dark(noise: Electrons, n: int, frame: FrameNumbers, strip: Strip, buffers: Buffers) -> None:
    """Fill ``dark_e`` with the counts of one rate; without thresholds they are counted like light."""
    words, dark_e = buffers.dark_words, buffers.dark_e
    if frame.has_thresholds:
        ranks = pointer_to(noise.dark_ranks, n * MAX_STEPS)
        fill_counts_of_one_rate(strip.total, words, frame.fewest_dark, ranks, frame.dark_steps, dark_e)
        return
    for x in range(strip.total):
        buffers.rates[x] = frame.dark_e
    fill_counts(strip.total, words, buffers.rates, noise.tables, buffers, dark_e, buffers.dark_error_e)


@inner
def _dark_buffers(frame: FrameNumbers, buffers: Buffers) -> tuple[Pointer, Pointer]:
    """Return the counts of one rate and the bounds of their errors; zeros where there are none."""
    dark_e = buffers.dark_e if frame.has_dark else buffers.zeros
    is_certain = frame.has_thresholds or not frame.has_dark
    return dark_e, buffers.zeros if is_certain else buffers.dark_error_e


# -------------------------------------------------------------------------------------------------------------- defects


@inner
def _fill_defects(patterns: SitePatterns, strip: Strip, buffers: Buffers) -> bool:
    """Fill ``defects_e`` with the means of bright defects, less than 0 at dead pixels; return whether there are any."""
    if patterns.defects.steps[1] == 0:  # no strip has filled it
        return False
    numbers, any_number = strip_values(patterns.defects, strip), np.uint16(0)
    for x in range(strip.total):
        buffers.defects_e[x] = 0.0
        any_number |= numbers[x]
    if any_number == 0:
        return False
    for x in range(strip.total):
        buffers.defects_e[x] = patterns.means_e[numbers[x]]
    return True


@inner
def _count_defects(noise: Electrons, strip: Strip, buffers: Buffers) -> None:
    """Replace the means of bright defects with counts; all defects are uncertain, so that they are computed exactly."""
    for x in range(strip.total):
        mean_e = buffers.defects_e[x]
        if mean_e != 0.0:
            buffers.light_error_e[x] = _INFINITE32
            if mean_e > 0.0:
                buffers.defects_e[x] = exact_count(buffers.defect_words[x], mean_e, noise.tables)


# ------------------------------------------------------------------------------------------------------------------ DN


@inner
def _sum_dn(
    electrons: Any, full_well_e: Any, dn_per_e: Any, black_dn: Any, noise_dn: Any, offset_dn: Any, site_dn: Any
) -> Any:
    """Return DN in the order of `reference.electrons.noisy`: of one site, or of eight as vectors."""
    dn = simd.minimum(electrons, full_well_e) * dn_per_e + black_dn
    return ((dn + noise_dn) + offset_dn) + site_dn


@inner
def approximate_electrons(noise: Electrons, n: int, strip: Strip, buffers: Buffers) -> Pointer:
    """Fill ``noise_dn`` with the DN of all sites but defects, in float32, and bounds of the errors; return the base."""
    frame, f = load_frame(noise, n), np.float32
    lines = pointer_to(noise.site_lines, n * 4097)
    normal.fill_values_by_lines(strip.total, buffers.site_words, lines, buffers.lines, buffers.noise_dn)
    first_site = np.uint64(_first_site(n, strip))
    per_e = simd.to_float32(simd.load(noise.dn_per_e, first_site))
    full_e = simd.to_float32(simd.load(noise.full_well_e, first_site))
    std, margin, row_dn, removed_e = f(frame.site_std_dn), f(frame.error_dn), f(buffers.row_dn[0]), f(frame.removed_e)
    base = pointer_to(noise.base_dn, (2 * n + (strip.y & 1)) * noise.padded_width + _first_column(strip))
    site_dn, (dark_e, dark_error_e) = _sites_dn(noise, n, strip), _dark_buffers(frame, buffers)
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        electrons = simd.load(buffers.light_e, x) + (simd.load(dark_e, x) - removed_e)
        # the base is the sum of black level, column and plane
        noise_dn, base_dn = simd.load(buffers.noise_dn, x) * std, simd.load(base, x)
        dn = _sum_dn(electrons, full_e, per_e, base_dn, noise_dn, row_dn, simd.load(site_dn, x))
        error_e = simd.load(buffers.light_error_e, x) + simd.load(dark_error_e, x)
        simd.store(buffers.noise_dn, x, dn)
        simd.store(buffers.error_dn, x, simd.absolute(dn) * FLOAT32_ERROR_DN + (error_e * per_e + margin))
    return buffers.zeros


@inner
def exact_electrons(noise: Electrons, n: int, strip: Strip, buffers: Buffers) -> None:
    """Fill ``exact_dn`` with the DN of all sites: of certain counts in vectors, then of the others one by one."""
    frame, quadratics = load_frame(noise, n), pointer_to(noise.site_quadratics, n * 4096)
    normal.fill_rows(strip.total, buffers.site_words, buffers.scratch)
    first_site, row_dn = np.uint64(_first_site(n, strip)), buffers.row_dn[0]
    per_e, full_e = simd.load(noise.dn_per_e, first_site), simd.load(noise.full_well_e, first_site)
    plane_dn = simd.load(noise.planes_dn, first_site)
    columns_dn = pointer_to(noise.columns_dn, n * noise.padded_width + _first_column(strip))
    sites_dn, (dark_e, dark_error_e) = _sites_dn(noise, n, strip), _dark_buffers(frame, buffers)
    listed = 0
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        dark = simd.to_float64(simd.load(dark_e, x)) - frame.removed_e
        electrons = simd.to_float64(simd.load(buffers.light_e, x)) + dark
        deviate = normal.exact_values(buffers.site_words, buffers.scratch, x, quadratics)
        noise_dn, offset_dn = deviate * frame.site_std_dn, (simd.load(columns_dn, x) + row_dn) + plane_dn
        site_dn = simd.to_float64(simd.load(sites_dn, x))
        dn = _sum_dn(electrons, full_e, per_e, noise.black_dn, noise_dn, offset_dn, site_dn)
        simd.store(buffers.exact_dn, x, dn)
        error_e = simd.load(buffers.light_error_e, x) + simd.load(dark_error_e, x)
        listed = list_lanes(simd.less_than(_ZERO32, error_e), x, listed, buffers)
    for m in range(listed):
        site = np.int64(buffers.uncertain[m])
        buffers.exact_dn[site] = exact_electrons_site(noise, n, site, strip, buffers)


@inner
def exact_electrons_site(noise: Electrons, n: int, x: int, strip: Strip, buffers: Buffers) -> float:
    """Return the noisy DN of one site."""
    if buffers.defects_e[x] < 0.0:
        return float(noise.dead_dn)
    frame, site = load_frame(noise, n), _first_site(n, strip) + (x & 1)
    dn_per_e, full_e = noise.dn_per_e[site], noise.full_well_e[site]
    electrons = _exact_light(noise, frame, dn_per_e, x, strip, buffers)
    if frame.has_dark:
        electrons = electrons + (_exact_dark(noise, frame, x, buffers) - frame.removed_e)
    electrons = electrons + buffers.defects_e[x]
    value = normal.exact_value(buffers.site_words[x], pointer_to(noise.site_quadratics, n * 4096))
    column_dn = noise.columns_dn[n * noise.padded_width + _first_column(strip) + x]
    offset_dn = (column_dn + buffers.row_dn[0]) + noise.planes_dn[site]
    site_dn = np.float64(_sites_dn(noise, n, strip)[x])
    return float(_sum_dn(electrons, full_e, dn_per_e, noise.black_dn, frame.site_std_dn * value, offset_dn, site_dn))


@inner
def _exact_light(
    noise: Electrons, frame: FrameNumbers, dn_per_e: float, x: int, strip: Strip, buffers: Buffers
) -> float:
    """Return the electrons of light of one site: a count, or the mean, also if that is negative."""
    if buffers.light_error_e[x] == _ZERO32:
        return float(buffers.light_e[x])
    response = np.float64(strip_values(noise.patterns.response, strip)[x])
    rate = (buffers.unrounded_dn[x] - noise.black_dn) / dn_per_e * response
    return float(exact_count(buffers.words[x], rate, noise.tables) if frame.counts_light and rate > 0.0 else rate)


@inner
def _exact_dark(noise: Electrons, frame: FrameNumbers, x: int, buffers: Buffers) -> float:
    """Return the count of one rate of one site."""
    if frame.has_thresholds or buffers.dark_error_e[x] == _ZERO32:
        return float(buffers.dark_e[x])
    return float(exact_count(buffers.dark_words[x], frame.dark_e, noise.tables))


@inner
def average_electrons(noise: Electrons, strip: Strip, buffers: Buffers) -> None:
    """Add the fixed patterns to the unrounded clean frame, as `reference.electrons.average`."""
    frame, clean_dn, defects_e = load_frame(noise, np.int64(0)), buffers.unrounded_dn, buffers.defects_e
    _fill_defects(noise.patterns, strip, buffers)
    kept_e, sites_dn = frame.dark_e - frame.removed_e, strip_values(noise.patterns.sites_dn, strip)
    for x in range(strip.total):
        site = _first_site(np.int64(0), strip) + (x & 1)
        gain = noise.dn_per_e[site]
        dn = simd.minimum((clean_dn[x] + defects_e[x] * gain) + kept_e * gain, noise.full_dn)
        offset_dn = 0.0 + noise.fixed_columns_dn[_first_column(strip) + x]
        dn = (dn + (offset_dn + noise.planes_dn[site])) + np.float64(sites_dn[x])
        clean_dn[x] = dn if defects_e[x] >= 0.0 else noise.dead_dn
