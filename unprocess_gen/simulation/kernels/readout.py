"""Read out the frames of a strip: round to the sensor's integers or normalise, clip, count, and write.

The way of a strip through the read-out, once its noise is drawn (`draw_noise`)::

    Rounded, FloatClean: noisy frames of uint16         Unrounded: noisy frames of float32
      _approximate    noise_dn, error_dn (float32)        _fill_exact    exact_dn (float64)
      _round_and_list                                     pinned sites get the level of white
          rounded = rint(noise_dn)                        _normalise
          noisy_dn = base + rounded                           clip, then (dn - black) / span
          noisy = clip(noisy_dn) as uint16                _write
          sites with |noise_dn - rounded| + error_dn > 1/2
          are uncertain
      _exact_site and _replace, for uncertain sites
      pinned sites get the level of white
      _write: to a mosaic, or to four planes

The base is what the noise is added to, integers in DN: the rounded clean frame for one normal per site, black for its
float32 form, and 0 for counts of electrons, whose ``noise_dn`` is the DN itself.

The clean frame is read out once, after all noisy frames (`write_clean`): its values are rounded already, or normalised
for `Unrounded` and `FloatClean`; with fixed patterns they are rounded here, after `average_patterns`.

Two records select the compiled code by their class (`jit.by_class`): the read-out, one of the three above, and the
noise: `Gaussian`, `Gaussian32` or `Electrons`. Each function below that is made by `by_class` states its arguments.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import PACKED, Float
from unprocess_gen.core.sequences import Recent
from unprocess_gen.simulation.kernels import electrons, gaussian, simd, strips
from unprocess_gen.simulation.kernels.clean import FLOAT32_MARGIN
from unprocess_gen.simulation.kernels.electrons import Electrons
from unprocess_gen.simulation.kernels.gaussian import Gaussian, Gaussian32
from unprocess_gen.simulation.kernels.jit import by_class, inner
from unprocess_gen.simulation.kernels.rounding import ROUND, ROUND32
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, Pointer, pointer_to
from unprocess_gen.simulation.kernels.strips import Buffers, Strip, count_outside, list_lanes
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import plane_sites

FAR_DN = 2.0**22
"""Light of linear sources in DN from which float32 does not bound the error of a noisy value."""

_8 = np.uint64(8)


class ReadOut(NamedTuple):
    """Levels and limits for the read-out of N frames; a subclass selects the compiled code."""

    limits_dn: Float  # [N, 4]: lowest and highest DN, pinned level, and clean value from which sites are pinned
    variance_lines: NDArray[Any]  # [N, 2]: a and b
    averaged: bool  # whether the clean frame contains the fixed patterns
    black_dn: Any  # in the unrounded clean frame
    span_dn: float
    white: float  # clean value of saturated sites
    clean_high_dn: float  # highest clean value
    far_dn: float  # unrounded clean value from which sites are computed exactly; infinity if they have none
    packed: bool
    planes: NDArray[np.int64]  # [4]: first element of the plane of each site of the tile


class Rounded(ReadOut):
    """Read out frames of uint16."""


class Unrounded(ReadOut):
    """Read out frames of float32."""


class FloatClean(ReadOut):
    """Read out noisy frames of uint16 and a clean frame of float32."""


class Limits(NamedTuple):
    """Limits of a noisy frame, DN."""

    low: float
    high: float
    pinned_dn: float  # noisy value of saturated sites
    pinned_from: float  # unrounded clean value from which they are pinned; infinity if they keep their noise


class Output(NamedTuple):
    """Locate what a strip of a frame fills."""

    sites: Pointer  # the strip in the frame
    counts: Pointer  # of the frame, see `strips.CLEAN_LOW`
    may_saturate: bool  # whether any site of the clean frame can be saturated


def readout_of(
    plans: tuple[Plan, ...], shape: tuple[int, int], origin: tuple[int, int], counts_from_black: bool
) -> ReadOut:
    """Return the read-out of the plans' frames ``[H, W]``; the unrounded clean frame may count from black.

    Redrawn plans of a config share it: to prepare it takes 5 µs, as long as the dispatch of a kernel.
    """
    first, frames = plans[0], [(plan.sensor, plan.noise.variance_line) for plan in plans]
    key = *frames, first.output, first.brightest, first.most_light, first.averaged, shape, origin, counts_from_black
    return _kept.get(key) or _kept.keep(key, _readout_of(plans, shape, origin, counts_from_black))


_kept: Recent[Any, ReadOut] = Recent(256)


def _readout_of(
    plans: tuple[Plan, ...], shape: tuple[int, int], origin: tuple[int, int], counts_from_black: bool
) -> ReadOut:
    first = plans[0]
    limits_dn = [plan.sensor.limits_dn + _pinned_dn(plan, counts_from_black) for plan in plans]
    packed = first.output.layout == PACKED
    planes = _plane_order(first.sensor.pattern, origin)
    kind = Unrounded if first.output.normalised else FloatClean if first.output.clean_normalised else Rounded
    return kind(
        limits_dn=np.array(limits_dn, dtype=np.float64),
        variance_lines=gaussian.variance_lines(
            tuple(plan.noise.variance_line for plan in plans), np.float32 if counts_from_black else np.float64
        ),
        averaged=first.averaged,
        black_dn=np.float32(0) if counts_from_black else float(first.sensor.black_level_dn),
        span_dn=float(first.sensor.span_dn),
        white=first.saturated_value,
        clean_high_dn=first.sensor.limits_dn[1] if first.averaged else first.brightest_dn,
        far_dn=FAR_DN if first.source.is_linear and not counts_from_black else np.inf,
        packed=packed,
        planes=planes * ((shape[0] // 2) * (shape[1] // 2)) if packed else planes,
    )


@functools.lru_cache(maxsize=32)
def _plane_order(pattern: str, origin: tuple[int, int]) -> NDArray[np.int64]:
    """Return the number of the packed plane of each site of the tile."""
    return np.argsort([2 * y + x for y, x in plane_sites(pattern, origin)])


def _pinned_dn(plan: Plan, counts_from_black: bool) -> tuple[float, float]:
    """Return the noisy DN of saturated sites, and the clean value from which they are; infinity if they keep noise."""
    if not plan.pins_saturated:
        return np.inf, np.inf
    if counts_from_black:
        above_black = np.float32((plan.brightest_dn - plan.sensor.black_level_dn) * (1 - FLOAT32_MARGIN))
        return plan.brightest_dn, float(above_black)
    return plan.brightest_dn, plan.brightest_dn


@inner
def load_limits(readout: Any, n: int) -> Limits:
    """Return the limits of noisy frame ``n``."""
    limits_dn = pointer_to(readout.limits_dn, np.uint64(4 * n))
    return Limits(low=limits_dn[0], high=limits_dn[1], pinned_dn=limits_dn[2], pinned_from=limits_dn[3])


# ------------------------------------------------------------------------------------------------------- noise by class


draw_noise = by_class(
    {Gaussian: gaussian.draw_gaussian, Gaussian32: gaussian.draw_gaussian, Electrons: electrons.count_electrons}
)
"""Fill the random words and counts of a strip of frame n; arguments: noise, n, key, strip, buffers."""
_approximate = by_class(
    {
        Gaussian: gaussian.approximate_gaussian,
        Gaussian32: gaussian.approximate_gaussian32,
        Electrons: electrons.approximate_electrons,
    }
)
"""Fill ``noise_dn`` and ``error_dn``; return the base, integers in DN; arguments: noise, n, strip, buffers."""
_exact_site = by_class(
    {
        Gaussian: gaussian.exact_gaussian_site,
        Gaussian32: lambda noise, n, x, strip, buffers: 0.0,  # it lists no site
        Electrons: electrons.exact_electrons_site,
    }
)
"""Return the exact DN of a site; arguments: noise, n, x, strip, buffers."""
_has_errors = by_class({Gaussian: lambda noise: True, Gaussian32: lambda noise: False, Electrons: lambda noise: True})
"""True if ``error_dn`` has bounds, so that sites can be uncertain; argument: noise."""
_fill_exact = by_class({Gaussian: gaussian.exact_gaussian, Electrons: electrons.exact_electrons})
"""Fill ``exact_dn`` with the DN of all sites; arguments: noise, n, strip, buffers."""
average_patterns = by_class(
    {
        Gaussian: lambda noise, strip, buffers: None,
        Gaussian32: lambda noise, strip, buffers: None,
        Electrons: electrons.average_electrons,
    }
)
"""Replace the unrounded clean frame of a strip with the average of many frames; arguments: noise, strip, buffers."""


# ------------------------------------------------------------------------------------------------------------- integers


@inner
def _read_integers(readout: Any, noise: Any, n: int, output: Output, strip: Strip, buffers: Buffers) -> None:
    limits = load_limits(readout, n)
    low, high = np.float32(limits.low), np.float32(limits.high)
    base = _approximate(noise, n, strip, buffers)
    listed, has_clipped = _round_and_list(noise, base, low, high, strip, buffers)
    for m in range(listed):
        site = np.int64(buffers.uncertain[m])  # as below: Numba compiles a function for each type of index
        if buffers.unrounded_dn[site] >= limits.pinned_from:  # replaced below
            continue
        dn = np.float32((_exact_site(noise, n, site, strip, buffers) + ROUND) - ROUND)
        has_clipped = _replace(site, dn, low, high, buffers) or has_clipped
    if output.may_saturate and readout.far_dn < np.inf:
        for x in range(strip.first, strip.after):
            if readout.far_dn <= buffers.unrounded_dn[x] < limits.pinned_from:
                far_dn = np.float32((_exact_site(noise, n, x, strip, buffers) + ROUND) - ROUND)
                has_clipped = _replace(x, far_dn, low, high, buffers) or has_clipped
    if output.may_saturate and limits.pinned_from < np.inf:
        dn = np.float32((limits.pinned_dn + ROUND) - ROUND)
        for x in range(strip.first, strip.after):
            if buffers.unrounded_dn[x] >= limits.pinned_from:
                has_clipped = _replace(x, dn, low, high, buffers) or has_clipped
    if has_clipped:
        _count_clipped(output, strip, buffers.noisy_dn, low, high)
    _write(readout, strip, buffers.noisy, output.sites)


@inner
def _count_clipped(output: Output, strip: Strip, values_dn: Pointer, low: Any, high: Any) -> None:
    below, above = count_outside(strip, values_dn, low, high)
    output.counts[strips.NOISY_LOW] += below
    output.counts[strips.NOISY_HIGH] += above


@inner
def _round_and_list(
    noise: Any, base: Pointer, low: np.float32, high: np.float32, strip: Strip, buffers: Buffers
) -> tuple[int, bool]:
    """Round half to even, clip and cast to uint16; list sites whose error bound reaches a rounding boundary.

    Return how many sites are listed, and whether any was clipped.
    """
    listed, clipped_bits = 0, simd.uint32_zeros()
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        noise_dn = simd.load(buffers.noise_dn, x)
        rounded = (noise_dn + ROUND32) - ROUND32
        dn = simd.load(base, x) + rounded
        clipped = simd.minimum(simd.maximum(dn, low), high)
        simd.store(buffers.noisy_dn, x, dn)
        simd.store(buffers.noisy, x, simd.to_uint32(clipped))
        clipped_bits = clipped_bits | (simd.to_bits(clipped) ^ simd.to_bits(dn))
        if _has_errors(noise):
            to_boundary = 0.5 - simd.absolute(noise_dn - rounded)
            uncertain = simd.less_than(to_boundary, simd.load(buffers.error_dn, x))
            listed = list_lanes(uncertain, x, listed, buffers)
    return listed, simd.has_any_bit(clipped_bits)


@inner
def _replace(x: int, dn: np.float32, low: np.float32, high: np.float32, buffers: Buffers) -> bool:
    """Replace a noisy value with a rounded DN; return whether it is clipped."""
    buffers.noisy_dn[x] = dn
    buffers.noisy[x] = np.uint16(np.int64(simd.minimum(simd.maximum(dn, low), high)))
    return bool(dn < low or dn > high)


@inner
def _write_integers(readout: Rounded, output: Output, strip: Strip, buffers: Buffers) -> None:
    clean = buffers.clean
    if readout.averaged:
        limits = load_limits(readout, np.int64(0))
        for x in range(strip.total):
            dn = (buffers.unrounded_dn[x] + ROUND) - ROUND
            clean[x] = np.uint16(np.int32(simd.minimum(simd.maximum(dn, limits.low), limits.high)))
    if output.may_saturate:
        output.counts[strips.SATURATED] += _count_equal(strip, clean, np.uint16(readout.white))
    _write(readout, strip, clean, output.sites)


@inner
def _count_equal(strip: Strip, values: Pointer, value: Any) -> int:
    count = 0
    for x in range(strip.first, strip.after):
        count += values[x] == value
    return count


# ----------------------------------------------------------------------------------------------------------- normalised


@inner
def _read_normalised(readout: Unrounded, noise: Any, n: int, output: Output, strip: Strip, buffers: Buffers) -> None:
    limits, noisy_dn = load_limits(readout, n), buffers.exact_dn
    _fill_exact(noise, n, strip, buffers)
    if output.may_saturate and limits.pinned_from < np.inf:
        for x in range(strip.total):
            noisy_dn[x] = limits.pinned_dn if buffers.unrounded_dn[x] >= limits.pinned_from else noisy_dn[x]
    if _normalise(readout, noisy_dn, limits.low, limits.high, strip, buffers.normalised):
        _count_clipped(output, strip, noisy_dn, limits.low, limits.high)
    _write(readout, strip, buffers.normalised, output.sites)


@inner
def _normalise(readout: Any, values_dn: Pointer, low: float, high: float, strip: Strip, out: Pointer) -> bool:
    """Clip DN and map black to 0 and white to 1, as `reference.sensor.normalise`; return whether any DN is clipped."""
    clipped_bits = simd.to_uint64(simd.uint32_zeros())
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        dn = simd.load(values_dn, x)
        clipped = simd.minimum(simd.maximum(dn, low), high)
        clipped_bits = clipped_bits | (simd.to_bits(clipped) ^ simd.to_bits(dn))
        simd.store(out, x, simd.to_float32((clipped - readout.black_dn) / readout.span_dn))
    return simd.has_any_bit(clipped_bits)


@inner
def _write_normalised(readout: Any, output: Output, strip: Strip, buffers: Buffers) -> None:
    limits = load_limits(readout, np.int64(0))
    _normalise(readout, buffers.unrounded_dn, limits.low, readout.clean_high_dn, strip, buffers.normalised)
    if output.may_saturate:
        output.counts[strips.SATURATED] += _count_equal(strip, buffers.normalised, np.float32(readout.white))
    _write(readout, strip, buffers.normalised, output.sites)


# --------------------------------------------------------------------------------------------------------------- frames


@inner
def _write(readout: Any, strip: Strip, values: Pointer, out: Pointer) -> None:
    """Write a strip to a frame: in place in a mosaic, or to the planes of its sites."""
    source = pointer_to(values, strip.first)
    if not readout.packed:
        for x in range(strip.length):
            out[x] = source[x]
        return
    for site in range(2):
        target = pointer_to(out, readout.planes[2 * (strip.y & 1) + site])
        for x in range(strip.length // 2):
            target[x] = source[2 * x + site]


@inner
def count_zero_variance(readout: Any, n: int, output: Output, strip: Strip, buffers: Buffers) -> None:
    """Count sites with a·max(0, clean - black) + b <= 0."""
    a, b = readout.variance_lines[2 * n], readout.variance_lines[2 * n + 1]
    if simd.minimum(a, b) <= 0.0:
        count = 0
        for x in range(strip.first, strip.after):
            count += a * simd.maximum(buffers.unrounded_dn[x] - readout.black_dn, 0.0) + b <= 0.0
        output.counts[strips.ZERO_VARIANCE] += count


read_noisy = by_class({Rounded: _read_integers, Unrounded: _read_normalised, FloatClean: _read_integers})
"""Read out a strip of noisy frame n, and count its clipped sites.

Arguments: read-out, noise, n, output, strip, buffers.
"""
write_clean = by_class({Rounded: _write_integers, Unrounded: _write_normalised, FloatClean: _write_normalised})
"""Read out the clean frame of a strip; arguments: read-out, output, strip, buffers."""
