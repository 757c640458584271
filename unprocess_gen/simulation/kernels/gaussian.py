"""Sample noise that is one normal deviate per site, with a variance linear in the signal.

`Gaussian` decides every DN as `reference.noise.heteroscedastic` does. Noise is computed in float32, eight sites at a
time, with an error bound; the read-out asks for the exact value of sites whose bound reaches a rounding boundary, about
1 % at a standard deviation of 100 DN. `Gaussian32`, for accuracy budgets that allow errors, has shorter polynomials and
asks for none; its DN count from the black level.

Design: ``docs/design/kernels.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.jit import inner
from unprocess_gen.core.random_streams import purpose
from unprocess_gen.core.types import Float, Plan
from unprocess_gen.simulation.kernels.normal import (
    FINE_ERROR,
    apply_signs,
    coarse_normal,
    exact_value,
    exact_values,
    fill_coarse_depths,
    fill_depths,
    fill_rows,
    fine_normal,
    normal_quantiles,
)
from unprocess_gen.simulation.kernels.philox import PhiloxKey, fill_word_blocks
from unprocess_gen.simulation.kernels.simd import (
    VECTOR_WIDTH,
    from_bits,
    less_than,
    load,
    maximum,
    minimum,
    square_root,
    store,
    to_bits,
)
from unprocess_gen.simulation.kernels.strips import SIZE, Float32, Strip, Workspace
from unprocess_gen.simulation.plan_slots import NORMAL_STREAM

NORMAL_PURPOSE = np.uint64(purpose(NORMAL_STREAM))

RELATIVE_NOISE_ERROR, RESIDUAL_ERROR_DN = np.float32(FINE_ERROR + 2.0**-16), np.float32(2.0**-22)
"""Bound of the error of the noise: this fraction of the standard deviation, plus this many DN."""
CANCELLATION_FRACTION = 2.0**-4
"""If a or b is negative, sites with a variance below this fraction of abs(b) are recomputed in float64."""

_8, _ZERO32 = np.uint64(8), np.float32(0)
_WITHOUT_SIGN, _ONE_BITS32 = np.uint32(0x7FFFFFFF), np.uint32(0x3F800000)


class Gaussian(NamedTuple):
    """Hold the variance lines of N frames."""

    line: Float  # [N, 2]: a and b
    black_dn: float
    quadratics: Float  # of the normal distribution


class Gaussian32(NamedTuple):
    """Hold the variance lines of N frames in float32."""

    line: Float32  # [N, 2]
    black_dn: NDArray[np.float32]  # [SIZE] equal values


def variance_lines(plans: Sequence[Plan], dtype: Any = np.float64) -> NDArray[Any]:
    """Return the variance lines of the plans' frames, [N, 2]."""
    with np.errstate(over="ignore"):  # a variance beyond float32 becomes infinite, and the site is clipped
        return np.array([plan.noise.variance_line for plan in plans]).astype(dtype)


def gaussian_noise(plans: Sequence[Plan]) -> Gaussian:
    """Return the noise of the plans' frames."""
    return Gaussian(variance_lines(plans), float(plans[0].sensor.black_level_dn), normal_quantiles().quadratics)


def gaussian_noise32(plans: Sequence[Plan]) -> Gaussian32:
    """Return the noise of the plans' frames in float32."""
    return Gaussian32(
        variance_lines(plans, np.float32), np.full(SIZE, plans[0].sensor.black_level_dn, dtype=np.float32)
    )


@inner
def draw_gaussian(noise: Gaussian | Gaussian32, n: int, key: PhiloxKey, strip: Strip, workspace: Workspace) -> None:
    """Fill ``words``."""
    fill_word_blocks(key, strip, NORMAL_PURPOSE, workspace.words)


@inner
def approximate_gaussian(noise: Gaussian, n: int, strip: Strip, workspace: Workspace) -> None:
    """Fill ``noise_dn`` with the noise on the rounded clean frame, in float32, and ``error_dn`` with its bounds."""
    fill_depths(strip.total, workspace.words, workspace.depths)
    a, b = noise.line[2 * n], noise.line[2 * n + 1]
    cancellation = np.float32(abs(b) * CANCELLATION_FRACTION if minimum(a, b) < 0.0 else 0.0)
    a32, b32, black = np.float32(a), np.float32(b), np.float32(noise.black_dn)
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        residual = load(workspace.residual_dn, x)
        variance = ((load(workspace.rounded_dn, x) - black) + residual) * a32 + b32
        std = square_root(maximum(variance, _ZERO32))
        normal = fine_normal(load(workspace.depths, x))
        store(workspace.noise_dn, x, residual + apply_signs(std * normal, load(workspace.words, x)))
        cancelled = less_than(from_bits(to_bits(variance) & _WITHOUT_SIGN), cancellation) & _ONE_BITS32
        store(workspace.error_dn, x, maximum(std * RELATIVE_NOISE_ERROR + RESIDUAL_ERROR_DN, from_bits(cancelled)))


@inner
def exact_gaussian_site(noise: Gaussian, n: int, x: int, strip: Strip, workspace: Workspace) -> float:
    """Return the noisy DN of one site, in the reference's order of operations."""
    a, b, clean_dn = noise.line[2 * n], noise.line[2 * n + 1], workspace.unrounded_dn[x]
    std = np.sqrt(maximum(a * (clean_dn - noise.black_dn) + b, 0.0))
    return float(clean_dn + std * exact_value(workspace.words[x], noise.quadratics))


@inner
def exact_gaussian(noise: Gaussian, n: int, strip: Strip, workspace: Workspace) -> None:
    """Fill ``exact_dn`` with the noisy DN of all sites."""
    fill_rows(strip.total, workspace.words, workspace.scratch)
    a, b = noise.line[2 * n], noise.line[2 * n + 1]
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        clean_dn = load(workspace.unrounded_dn, x)
        std = square_root(maximum((clean_dn - noise.black_dn) * a + b, 0.0))
        normal = exact_values(workspace.words, workspace.scratch, x, noise.quadratics)
        store(workspace.exact_dn, x, clean_dn + std * normal)


@inner
def approximate_gaussian32(noise: Gaussian32, n: int, strip: Strip, workspace: Workspace) -> None:
    """Fill ``noise_dn`` with clean and noise above black, in float32; no site needs more."""
    fill_coarse_depths(strip.total, workspace.words, workspace.depths)
    a, b = noise.line[2 * n], noise.line[2 * n + 1]
    for v in range(strip.total // VECTOR_WIDTH):
        x = np.uint64(v) * _8
        clean_dn = load(workspace.unrounded_dn, x)
        std = square_root(maximum(clean_dn * a + b, _ZERO32))
        normal = coarse_normal(load(workspace.depths, x))
        store(workspace.noise_dn, x, clean_dn + apply_signs(std * normal, load(workspace.words, x)))
