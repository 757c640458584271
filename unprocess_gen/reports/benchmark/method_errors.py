"""Measure the errors of methods and tiers against the reference.

All methods share their uniform random numbers with the reference, so frames are compared site by site. The error of a
method is the error of pairs made with the budget that chooses it (`session.budget_for`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.schema import AccuracyConfig
from unprocess_gen.core.jit import kernel
from unprocess_gen.core.random_streams import Words
from unprocess_gen.core.types import Float, Frame, Pair, Plan
from unprocess_gen.reports.benchmark.session import PHYSICAL, REFERENCE, BenchmarkSession
from unprocess_gen.simulation.kernels.normal import apply_signs, coarse_normal, fill_coarse_depths
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, load, pointer_to, store
from unprocess_gen.simulation.reference import noise


class MethodError(NamedTuple):
    """An error and its unit; ``changed_share`` is the fraction of DN that differ, None if no DN are compared."""

    max: float
    rms: float
    unit: str
    changed_share: float | None = None


class NoisyError(NamedTuple):
    """The error of noisy frames: fraction of DN that differ, largest and RMS error in DN and in σ of the noise."""

    changed_share: float
    max_dn: float
    rms_dn: float
    max_std: float
    rms_std: float


def noisy_errors(session: BenchmarkSession, config_name: str, accuracy: AccuracyConfig) -> NoisyError:
    """Return the error of the noisy frames under a budget, both in DN and in σ of shot, read and rounding noise."""
    in_dn, in_stds = (noisy_error(session, config_name, accuracy, unit=unit) for unit in ("DN", "σ"))
    assert in_dn.changed_share is not None
    return NoisyError(in_dn.changed_share, in_dn.max, in_dn.rms, in_stds.max, in_stds.rms)


def clean_error(session: BenchmarkSession, config_name: str, accuracy: AccuracyConfig) -> MethodError:
    """Return the error of the clean frames under a budget, in DN."""
    frames, reference = (
        [pair.clean for pair, _ in session.sampled_pairs(config_name, one)]
        for one in (accuracy, session.tiers[REFERENCE])
    )
    return compare_frames(frames, reference, "DN")


def noisy_error(
    session: BenchmarkSession, config_name: str, accuracy: AccuracyConfig, edit: str = "unchanged", unit: str = "σ"
) -> MethodError:
    """Return the error of the noisy frames under a budget, in DN or in σ of shot, read and rounding noise."""
    pairs, reference = (session.sampled_pairs(config_name, one, edit) for one in (accuracy, session.tiers[REFERENCE]))
    stds_dn = [noise_std_dn(pair, plan) for pair, plan in reference] if unit == "σ" else None
    return compare_frames([pair.noisy for pair, _ in pairs], [pair.noisy for pair, _ in reference], unit, stds_dn)


def noise_std_dn(pair: Pair, plan: Plan) -> Float:
    """Return the standard deviation of shot, read and rounding noise at each site, ``[H, W]`` DN."""
    return np.asarray(np.sqrt(noise.noise_variance(pair.clean.astype(np.float64), plan) + 1 / 12))


def compare_frames(
    frames: Sequence[Frame], reference: Sequence[Frame], unit: str, scales_dn: Sequence[Float] | None = None
) -> MethodError:
    """Return the error over all frames, in DN or in units of ``scales_dn``."""
    differences = [one.astype(np.float64) - other for one, other in zip(frames, reference, strict=True)]
    changed = sum(int(np.count_nonzero(one)) for one in differences) / sum(one.size for one in differences)
    if scales_dn is not None:
        differences = [one / scale for one, scale in zip(differences, scales_dn, strict=True)]
    every = np.concatenate([one.ravel() for one in differences])
    return MethodError(float(np.abs(every).max()), math.sqrt(float(np.mean(every * every))), unit, changed)


def shot_error(session: BenchmarkSession, accuracy: AccuracyConfig) -> MethodError:
    """Return the CDF difference on flat fields as maximum, and the difference on photographs in σ as RMS."""
    on_photographs = noisy_error(session, PHYSICAL, accuracy, "with_shot")
    distance = cdf_difference(session.flat_frames(accuracy), session.flat_frames(session.tiers[REFERENCE]))
    return MethodError(distance, on_photographs.rms, "distribution (max), σ (rms)", on_photographs.changed_share)


def cdf_difference(frames: Sequence[Frame], reference: Sequence[Frame]) -> float:
    """Return the largest difference of the empirical distribution functions of frames and their references.

    Both use the same uniform random numbers, so most of the random difference cancels; 5e-4 remains at 512² sites.
    """
    return max(_cdf_difference(one, other) for one, other in zip(frames, reference, strict=True))


def _cdf_difference(one: Frame, other: Frame) -> float:
    codes = int(max(one.max(), other.max())) + 1
    differences = np.bincount(one.ravel(), minlength=codes) - np.bincount(other.ravel(), minlength=codes)
    return float(np.abs(np.cumsum(differences)).max() / one.size)


# ------------------------------------------------------------------------------------------------- normal deviates


def normal_error(sampler: Callable[[Words], Float], positions: int) -> MethodError:
    """Return the error of a sampler's normal deviates against the exact quantiles, in σ."""
    words, weights = normal_words(positions)
    error = np.abs(sampler(words) - exact_normals(words))
    rms = math.sqrt(float(np.sum(weights * error * error) / np.sum(weights)))
    return MethodError(float(error.max()), rms, "σ")


def normal_words(positions: int) -> tuple[Words, Float]:
    """Return uint32 words from every segment of every octave of the tail, and how many words each represents.

    Each segment gives up to ``positions`` evenly spaced words, both ends included; signs alternate.
    """
    parts = [np.arange(32)]
    weights = [np.ones(32)]
    for octave in range(6, 32):  # of 32 segments; the first 32 words contain all earlier octaves
        words_per_segment = 2 ** (octave - 6)
        count = min(positions, words_per_segment)
        offsets = np.arange(count) * (words_per_segment - 1) // max(count - 1, 1)
        starts = 2 ** (octave - 1) + np.arange(32) * words_per_segment
        parts.append((starts[:, None] + offsets).ravel())
        weights.append(np.full(32 * count, words_per_segment / count))
    index = np.concatenate(parts)
    signs = (np.arange(index.size) % 2) << 31
    return (index | signs).astype(np.uint32), np.concatenate(weights)


def exact_normals(words: Words) -> Float:
    """Return the normal quantile of each word's probability, with a relative error of 1e-15."""
    quantile = NormalDist().inv_cdf
    tails = ((words & np.uint32(0x7FFFFFFF)).astype(np.float64) + 0.5) * 2.0**-32
    upper = np.array([-quantile(tail) for tail in tails.tolist()])
    return np.where(words >> np.uint32(31), -upper, upper)


def polynomial_normals(words: Words) -> Float:
    """Return the normal deviates of the float32 kernels for uint32 words ``[n]``."""
    padded = np.resize(words, -(-words.size // VECTOR_WIDTH) * VECTOR_WIDTH)
    depths, out = np.empty((2, padded.size), dtype=np.float32)
    _fill_coarse_normals(padded, depths, out)
    return out[: words.size].astype(np.float64)


@kernel
def _fill_coarse_normals(words: Words, depths: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Fill ``out`` with the normal deviates of ``words``; ``depths`` is scratch space."""
    source, buffer, target = pointer_to(words, 0), pointer_to(depths, 0), pointer_to(out, 0)
    fill_coarse_depths(words.size, source, buffer)
    for n in range(words.size // VECTOR_WIDTH):
        x = np.uint64(n * VECTOR_WIDTH)
        store(target, x, apply_signs(coarse_normal(load(buffer, x)), load(source, x)))
