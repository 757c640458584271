"""Read out the frames of a strip: round to the sensor's integers or normalise, clip, count, and write.

`Integers` rounds approximate DN and asks the noise for the exact value of sites whose error bound reaches a rounding
boundary. `Normalised` needs the exact value of every site, because float32 frames are not rounded to DN. `FloatClean`
reads the noisy frames as the former and the clean frame as the latter.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import by_class, inner
from unprocess_gen.core.types import PACKED, Float, Plan
from unprocess_gen.simulation.kernels.clean import FLOAT32_MARGIN
from unprocess_gen.simulation.kernels.electrons import (
    Electrons,
    add_electrons,
    average_electrons,
    count_electrons,
    exact_electrons_dn,
    fill_exact_electrons,
)
from unprocess_gen.simulation.kernels.gaussian import (
    Gaussian,
    Gaussian32,
    add_gaussian,
    add_gaussian32,
    draw_gaussian,
    exact_gaussian_dn,
    fill_exact_gaussian,
    variance_lines,
)
from unprocess_gen.simulation.kernels.rounding import ROUND, ROUND32
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    Pointer,
    absolute,
    has_any_bit,
    less_than,
    load,
    maximum,
    minimum,
    pointer_to,
    store,
    to_bits,
    to_float32,
    to_uint32,
    to_uint64,
    uint32_zeros,
)
from unprocess_gen.simulation.kernels.strips import Strip, Workspace, count_outside, list_lanes
from unprocess_gen.simulation.reference.cfa import plane_sites
from unprocess_gen.simulation.reference.sensor import noisy_limits

_8, _HALF32 = np.uint64(8), np.float32(0.5)
_DECREASED, _INCREASED = 1.0 - 2.0**-50, 1.0 + 2.0**-50


class ReadOut(NamedTuple):
    """Hold what the read-out of N frames needs; a subclass selects the compiled code."""

    limits_dn: Float  # [N, 4]: lowest and highest DN, pinned level, and clean value from which sites are pinned
    variance_lines: NDArray[Any]  # [N, 2]: a and b
    averaged: bool  # whether the clean frame contains the fixed patterns
    black_dn: Any  # in the unrounded clean frame
    span_dn: float
    white: float  # clean value of saturated sites
    packed: bool
    planes: NDArray[np.int64]  # [4]: first element of the plane of each site of the tile


class Integers(ReadOut):
    """Read out frames of uint16."""


class Normalised(ReadOut):
    """Read out frames of float32."""


class FloatClean(ReadOut):
    """Read out noisy frames of uint16 and a clean frame of float32."""


class Output(NamedTuple):
    """Locate what a strip of a frame fills."""

    n: int  # number of the noisy frame
    sites: Pointer  # the strip in the frame
    counts: Pointer  # of the frame
    may_saturate: bool  # whether any site of the clean frame can be saturated


def readout_of(
    plans: Sequence[Plan], shape: tuple[int, int], origin: tuple[int, int], counts_from_black: bool
) -> ReadOut:
    """Return the read-out of the plans' frames ``[H, W]``; the unrounded clean frame may count from black."""
    first = plans[0]
    limits_dn = [
        noisy_limits(plan.bits, plan.black_level_dn, plan.sensor_clip) + _pinned_dn(plan, counts_from_black)
        for plan in plans
    ]
    packed = first.layout == PACKED
    planes = _planes(first.pattern, origin[0] % 2, origin[1] % 2)
    kind = Normalised if first.normalised else FloatClean if first.clean_normalised else Integers
    return kind(
        limits_dn=np.array(limits_dn, dtype=np.float64),
        variance_lines=variance_lines(plans, np.float32 if counts_from_black else np.float64),
        averaged=first.averaged,
        black_dn=np.float32(0) if counts_from_black else float(first.black_level_dn),
        span_dn=float(first.white_level_dn - first.black_level_dn),
        white=1.0 if first.clean_normalised else float(first.white_level_dn),
        packed=packed,
        planes=planes * ((shape[0] // 2) * (shape[1] // 2)) if packed else planes,
    )


@functools.lru_cache(maxsize=16)
def _planes(pattern: str, top: int, left: int) -> NDArray[np.int64]:
    """Return the number of the plane of each site of a tile, [4]."""
    sites = [2 * y + x for y, x in plane_sites(pattern, (top, left))]
    return np.argsort(sites)


def _pinned_dn(plan: Plan, counts_from_black: bool) -> tuple[float, float]:
    """Return the noisy DN of saturated sites, and the clean value from which they are; infinity if they keep noise."""
    if plan.saturated != "pinned":
        return np.inf, np.inf
    if counts_from_black:
        above_black = np.float32((plan.brightest_dn - plan.black_level_dn) * (1 - FLOAT32_MARGIN))
        return plan.brightest_dn, float(above_black)
    return plan.brightest_dn, plan.brightest_dn


# ------------------------------------------------------------------------------------------------------- noise by class


@inner
def _do_nothing(noise: Any, strip: Strip, workspace: Workspace) -> None:
    """Do nothing: the noise has no fixed patterns."""


@inner
def _is_approximate(noise: Any) -> bool:
    return True


@inner
def _is_final(noise: Any) -> bool:
    return False


@inner
def _exact_gaussian32_dn(noise: Gaussian32, n: int, x: int, strip: Strip, workspace: Workspace) -> float:
    """Return 0: this noise lists no site as uncertain."""
    return 0.0


draw_noise = by_class({Gaussian: draw_gaussian, Gaussian32: draw_gaussian, Electrons: count_electrons})
"""Fill the random words and counts of a strip of frame n; arguments: noise, n, key, strip, workspace."""
sample_noise = by_class(
    {
        (Integers, Gaussian): add_gaussian,
        (Integers, Gaussian32): add_gaussian32,
        (Integers, Electrons): add_electrons,
        (Normalised, Gaussian): fill_exact_gaussian,
        (Normalised, Electrons): fill_exact_electrons,
        (FloatClean, Gaussian): add_gaussian,
        (FloatClean, Electrons): add_electrons,
    }
)
"""Compute the noise of a strip of frame n in DN, as its read-out needs it: approximately, or with the clean frame.

Arguments: read-out, noise, n, strip, workspace. Return what `read_noisy` takes: values, or the base to which it adds
noise, and how many sites are listed as uncertain.
"""
_needs_exact_sites = by_class({Gaussian: _is_approximate, Gaussian32: _is_final, Electrons: _is_approximate})
_exact_dn = by_class({Gaussian: exact_gaussian_dn, Gaussian32: _exact_gaussian32_dn, Electrons: exact_electrons_dn})
average_patterns = by_class({Gaussian: _do_nothing, Gaussian32: _do_nothing, Electrons: average_electrons})
"""Replace the unrounded clean frame of a strip with the average of many frames; arguments: noise, strip, workspace."""


# ------------------------------------------------------------------------------------------------------------- integers


@inner
def _read_integers(
    readout: Any, noise: Any, base: Pointer, listed: int, output: Output, strip: Strip, workspace: Workspace
) -> None:
    n, limits_dn = output.n, pointer_to(readout.limits_dn, np.uint64(4 * output.n))
    low, high = np.float32(limits_dn[0]), np.float32(limits_dn[1])
    found, has_clipped = _round_and_list(noise, base, listed, low, high, strip, workspace)
    for m in range(found):
        at = np.int64(workspace.uncertain[m])  # as below: Numba compiles a function for each type of index
        dn = np.float32((_exact_dn(noise, n, at, strip, workspace) + ROUND) - ROUND)
        has_clipped = _replace(at, dn, low, high, workspace) or has_clipped
    if output.may_saturate and limits_dn[3] < np.inf:
        dn = np.float32((limits_dn[2] + ROUND) - ROUND)
        for x in range(strip.first, strip.after):
            if workspace.unrounded_dn[x] >= limits_dn[3]:
                has_clipped = _replace(x, dn, low, high, workspace) or has_clipped
    if has_clipped:
        below, above = count_outside(strip, workspace.noisy_dn, low, high)
        output.counts[2] += below
        output.counts[3] += above
    _write(readout, strip, workspace.noisy, output.sites)


@inner
def _round_and_list(
    noise: Any, base: Pointer, listed: int, low: np.float32, high: np.float32, strip: Strip, workspace: Workspace
) -> tuple[int, bool]:
    """Round half to even, clip and cast to uint16; list sites whose error bound reaches a rounding boundary.

    Return how many sites are listed then, and whether any was clipped.
    """
    found = listed
    clipped_bits = uint32_zeros()
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        noise_dn = load(workspace.noise_dn, x)
        rounded = (noise_dn + ROUND32) - ROUND32
        dn = load(base, x) + rounded
        clipped = minimum(maximum(dn, low), high)
        store(workspace.noisy_dn, x, dn)
        store(workspace.noisy, x, to_uint32(clipped))
        clipped_bits = clipped_bits | (to_bits(clipped) ^ to_bits(dn))
        if _needs_exact_sites(noise):
            to_boundary = _HALF32 - absolute(noise_dn - rounded)
            found = list_lanes(less_than(to_boundary, load(workspace.error_dn, x)), x, found, workspace)
    return found, has_any_bit(clipped_bits)


@inner
def _replace(x: int, dn: np.float32, low: np.float32, high: np.float32, workspace: Workspace) -> bool:
    """Replace a noisy value with a rounded DN; return whether it is clipped."""
    workspace.noisy_dn[x] = dn
    workspace.noisy[x] = np.uint16(np.int64(minimum(maximum(dn, low), high)))
    return bool(dn < low or dn > high)


@inner
def _write_integers(readout: Integers, output: Output, strip: Strip, workspace: Workspace) -> None:
    clean = workspace.clean
    if readout.averaged:
        low, high = readout.limits_dn[0], readout.limits_dn[1]
        for x in range(strip.total):
            dn = (workspace.unrounded_dn[x] + ROUND) - ROUND
            clean[x] = np.uint16(np.int32(minimum(maximum(dn, low), high)))
    if output.may_saturate:
        output.counts[4] += _count_equal(strip, clean, np.uint16(readout.white))
    _write(readout, strip, clean, output.sites)


@inner
def _count_equal(strip: Strip, values: Pointer, value: Any) -> int:
    count = 0
    for x in range(strip.first, strip.after):
        count += values[x] == value
    return count


# ----------------------------------------------------------------------------------------------------------- normalised


@inner
def _read_normalised(
    readout: Normalised, noise: Any, noisy_dn: Pointer, listed: int, output: Output, strip: Strip, workspace: Workspace
) -> None:
    limits_dn = pointer_to(readout.limits_dn, np.uint64(4 * output.n))
    noisy = output.sites if _is_direct(readout, strip) else workspace.normalised
    if output.may_saturate and limits_dn[3] < np.inf:
        for x in range(strip.total):
            noisy_dn[x] = limits_dn[2] if workspace.unrounded_dn[x] >= limits_dn[3] else noisy_dn[x]
    if _normalise(readout, noisy_dn, limits_dn[0], limits_dn[1], strip, noisy):
        below, above = count_outside(strip, noisy_dn, limits_dn[0], limits_dn[1])
        output.counts[2] += below
        output.counts[3] += above
    if not _is_direct(readout, strip):
        _write(readout, strip, noisy, output.sites)


@inner
def _is_direct(readout: Any, strip: Strip) -> bool:
    """Return whether a strip of float32 is computed in its frame: complete vectors of a mosaic.

    A copy from a buffer takes 8 to 14 % of a pair in float32.
    """
    return bool(strip.total == strip.length and not readout.packed)


@inner
def _normalise(readout: Any, values_dn: Pointer, low: float, high: float, strip: Strip, out: Pointer) -> bool:
    """Clip DN and map black to 0 and white to 1, as `reference.sensor.normalise`; return whether any DN is clipped.

    The product with 1/span takes a fifth of the time of a quotient. It differs from the quotient by three roundings,
    at most 3·2**-53 of it. Rounding to float32 preserves order, so if the product rounds alike when it is decreased
    and increased by 2**-50 of itself, the quotient rounds alike too. Otherwise, about once in 10**8 sites, the quotient
    is computed.
    """
    per_dn = 1.0 / readout.span_dn
    clipped_bits = to_uint64(uint32_zeros())
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        dn = load(values_dn, x)
        clipped = minimum(maximum(dn, low), high)
        clipped_bits = clipped_bits | (to_bits(clipped) ^ to_bits(dn))
        above_black = clipped - readout.black_dn
        product = above_black * per_dn
        nearer, farther = to_float32(product * _DECREASED), to_float32(product * _INCREASED)
        if has_any_bit(to_bits(nearer) ^ to_bits(farther)):
            farther = to_float32(above_black / readout.span_dn)
        store(out, x, farther)
    return has_any_bit(clipped_bits)


@inner
def _write_normalised(readout: Any, output: Output, strip: Strip, workspace: Workspace) -> None:
    clean = output.sites if _is_direct(readout, strip) else workspace.normalised
    low, high = readout.black_dn, readout.black_dn + readout.span_dn
    if readout.averaged:
        low, high = readout.limits_dn[0], readout.limits_dn[1]
    _normalise(readout, workspace.unrounded_dn, low, high, strip, clean)
    if output.may_saturate:
        output.counts[4] += _count_equal(strip, clean, np.float32(readout.white))
    if not _is_direct(readout, strip):
        _write(readout, strip, clean, output.sites)


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
def count_zero_variance(readout: Any, n: int, strip: Strip, workspace: Workspace, counts: Pointer) -> None:
    """Count sites with a·(clean - black) + b <= 0."""
    a, b = readout.variance_lines[2 * n], readout.variance_lines[2 * n + 1]
    if minimum(a, b) <= 0.0:
        count = 0
        for x in range(strip.first, strip.after):
            count += a * (workspace.unrounded_dn[x] - readout.black_dn) + b <= 0.0
        counts[5] += count


read_noisy = by_class({Integers: _read_integers, Normalised: _read_normalised, FloatClean: _read_integers})
"""Read out a strip of a noisy frame, and count its clipped sites.

Arguments: read-out, noise, the two values of `sample_noise`, output, strip, workspace.
"""
write_clean = by_class({Integers: _write_integers, Normalised: _write_normalised, FloatClean: _write_normalised})
"""Read out the clean frame of a strip; arguments: read-out, output, strip, workspace."""
