"""Measure the error and the time of methods and tiers.

All methods share their uniform random numbers with the reference, so frames are compared site by site. The error of a
method is the error of pairs made with the budget that chooses it (`session.budget_for`). Errors of normal deviates are
those against the exact quantile of a fixed, dense set of random words.

Times are ns per pixel of processor time of one thread. Kernels fuse stages: the curve is part of the colour matrix, and
only the channel of each CFA site is computed. So ``curve``, ``colour`` and ``mosaic`` of kernels have one time, of a
clean frame; ``normal`` is the time that noise and its read-out add to it. The times of ``shot`` and ``effects`` are
differences between complete pairs with and without them. NumPy methods are measured on smaller crops, which are still
large enough that their arrays do not fit the CPU caches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.accuracy import Method
from unprocess_gen.config.schema import AccuracyConfig
from unprocess_gen.core.jit import kernel
from unprocess_gen.core.random_streams import Words
from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import Float, Pair, Plan
from unprocess_gen.reports.benchmark import session as sessions
from unprocess_gen.reports.benchmark.session import BenchmarkImage, BenchmarkSession
from unprocess_gen.reports.benchmark.timing import thread_ns
from unprocess_gen.simulation.effects.heteroscedastic import noise_variance
from unprocess_gen.simulation.kernels.body import forget_bodies
from unprocess_gen.simulation.kernels.normal import apply_signs, coarse_normal, fill_coarse_depths
from unprocess_gen.simulation.kernels.render import render_clean
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH, load, pointer_to, store
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference import noise
from unprocess_gen.simulation.reference.sensor import quantise, to_dn
from unprocess_gen.simulation.reference.unprocess import camera_light, unprocess

# -------------------------------------------------------------------------------------------------------------- frames


class Deviation(NamedTuple):
    """Largest and RMS difference, and the fraction of values that differ (None if they are not DN)."""

    max: float
    rms: float
    changed_share: float | None


class FrameErrors(NamedTuple):
    """Errors of clean frames in DN, and of noisy frames in DN and in σ of shot, read and rounding noise."""

    clean_dn: Deviation
    noisy_dn: Deviation
    noisy_std: Deviation

    def noisy_columns(self) -> tuple[float | None, float, float, float, float]:
        """The columns of reports from ``noisy_changed_share`` to ``noisy_rms_std``."""
        in_dn, in_std = self.noisy_dn, self.noisy_std
        return in_dn.changed_share, in_dn.max, in_dn.rms, in_std.max, in_std.rms


class StageError(NamedTuple):
    """Measurement of a stage's error: config and edit of the plans, field of `FrameErrors`, and its unit."""

    config: str
    edit: str
    error: str
    unit: str


CLEAN_ERROR = StageError(sessions.TWO_PARAMETER, "unchanged", "clean_dn", "DN")
STAGE_ERRORS = {
    **dict.fromkeys(("curve", "colour", "mosaic", "quantise"), CLEAN_ERROR),
    "shot": StageError(sessions.PHYSICAL, "with_shot", "noisy_std", "σ"),
    "effects": StageError(sessions.PHYSICAL, "without_shot", "noisy_dn", "DN"),
    "tier": CLEAN_ERROR,
    "tier_noisy": CLEAN_ERROR._replace(error="noisy_std", unit="σ"),
    "tier_electrons": StageError(sessions.PHYSICAL, "unchanged", "noisy_std", "σ"),
    "tier_own": CLEAN_ERROR._replace(config=sessions.GIVEN),
}
"""Errors of the stages of methods, and of complete tiers; the error of ``normal`` is `normal_error`, in σ."""


def method_error(session: BenchmarkSession, method: Method) -> Deviation:
    """The error of a method under the budget that chooses it."""
    if method.stage == "normal":
        return normal_error(method.implementation)
    stage = STAGE_ERRORS[method.stage]
    errors = frame_errors(session, stage.config, sessions.budget_for(method, session.tiers), stage.edit)
    deviation: Deviation = getattr(errors, stage.error)
    return deviation


def frame_errors(
    session: BenchmarkSession, config_name: str, accuracy: AccuracyConfig, edit: str = "unchanged"
) -> FrameErrors:
    """Errors of all subsampled photographs under a budget."""
    pairs, reference = (
        session.sampled_pairs(config_name, budget, edit) for budget in (accuracy, session.tiers[sessions.REFERENCE])
    )
    both = [(pair, other) for (pair, _), (other, _) in zip(pairs, reference, strict=True)]
    clean_dn = [pair.clean.astype(np.float64) - other.clean for pair, other in both]
    noisy_dn = [pair.noisy.astype(np.float64) - other.noisy for pair, other in both]
    in_stds = [error / noise_std_dn(*other) for error, other in zip(noisy_dn, reference, strict=True)]
    return FrameErrors(*map(summarise, (clean_dn, noisy_dn, in_stds)))


def noise_std_dn(pair: Pair, plan: Plan) -> Float:
    """Standard deviation of shot, read and rounding noise at each site, ``[H, W]`` DN."""
    return np.asarray(np.sqrt(noise_variance(pair.clean.astype(np.float64), plan) + 1 / 12))


def summarise(differences: Sequence[Float]) -> Deviation:
    """The deviation over all frames."""
    values = np.concatenate([frame.ravel() for frame in differences])
    changed_share = int(np.count_nonzero(values)) / values.size
    return Deviation(float(np.abs(values).max()), math.sqrt(float(np.mean(values * values))), changed_share)


# ------------------------------------------------------------------------------------------------- normal deviates


def normal_error(implementation: str) -> Deviation:
    """Error of an implementation's normal deviates against the exact quantiles, in σ."""
    words, weights = normal_words()
    normals = polynomial_normals(words) if implementation == "float32" else noise.normals(words)
    error = np.abs(normals - exact_normals(words))
    rms = math.sqrt(float(np.sum(weights * error * error) / np.sum(weights)))
    return Deviation(float(error.max()), rms, None)


def normal_words() -> tuple[Words, Float]:
    """uint32 words, dense in every octave of the tail, and how many words each represents; signs alternate."""
    index = np.unique(np.geomspace(1, 2**31, NORMAL_WORDS).astype(np.int64)) - 1
    signs = (np.arange(index.size) % 2) << 31
    return (index | signs).astype(np.uint32), np.diff(index, append=2**31).astype(np.float64)


def exact_normals(words: Words) -> Float:
    """The normal quantile of each word's probability, with a relative error of 1e-15."""
    quantile = NormalDist().inv_cdf
    tails = ((words & np.uint32(0x7FFFFFFF)).astype(np.float64) + 0.5) * 2.0**-32
    upper = np.array([-quantile(tail) for tail in tails.tolist()])
    return np.where(words >> np.uint32(31), -upper, upper)


def polynomial_normals(words: Words) -> Float:
    """The normal deviates of the float32 kernels for uint32 words ``[n]``."""
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


# --------------------------------------------------------------------------------------------------------------- times

NORMAL_WORDS = 2**16
"""Number of random words whose normal deviates are compared."""

LEAST_NS = 0.01
"""Smallest difference of times, ns per pixel, that is reported; smaller differences are noise."""

STAGE_DIFFERENCES = {"shot": ("with_shot", "without_shot"), "effects": ("without_shot", "without_effects")}
"""Pairs of `session.EDITS` whose difference is the time of a stage."""


def has_time(method: Method) -> bool:
    """False for methods that cannot be timed: kernels quantise in the loop that makes the frame."""
    return method.readable or method.stage != "quantise"


def method_ns(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """The time of a method on an image."""
    accuracy = sessions.budget_for(method, session.tiers)
    if method.stage in STAGE_DIFFERENCES:
        longer, shorter = (
            pair_ns(session, sessions.PHYSICAL, accuracy, image, edit) for edit in STAGE_DIFFERENCES[method.stage]
        )
        return max(longer - shorter, LEAST_NS)
    if method.readable:
        return numpy_ns(session, method.stage, image)
    plan = session.plan(sessions.TWO_PARAMETER, accuracy, image, image.compiled)
    clean_ns = thread_ns(lambda: render_clean(image.compiled, plan), image.compiled[..., 0].size)
    if method.stage != "normal":
        return clean_ns
    return max(pair_ns(session, sessions.TWO_PARAMETER, accuracy, image) - clean_ns, LEAST_NS)


def pair_ns(
    session: BenchmarkSession, name: str, accuracy: AccuracyConfig, image: BenchmarkImage, edit: str = "unchanged"
) -> float:
    """The time of a pair whose camera body was not simulated before."""
    srgb = image.readable if accuracy.readable else image.compiled
    plan = session.plan(name, accuracy, image, srgb, edit)
    forget_bodies()
    return thread_ns(lambda: make_pair(srgb, plan), srgb[..., 0].size)


def numpy_ns(session: BenchmarkSession, stage: str, image: BenchmarkImage) -> float:
    """The time of NumPy from the codes to the end of a stage; ``normal`` and ``quantise`` alone."""
    srgb = image.readable
    plan = session.plan(sessions.TWO_PARAMETER, session.tiers[sessions.EXACT], image, srgb)
    curve = linear_table(plan.isp.tone, plan.isp.gamma, int(np.iinfo(srgb.dtype).max) + 1)
    light = unprocess(srgb, plan, curve=curve)
    black_dn, white_dn = plan.sensor.black_level_dn, plan.sensor.white_level_dn
    words = (np.arange(light.size, dtype=np.uint64) * np.uint64(2654435769)).astype(np.uint32)  # in scrambled order
    calls = {
        "curve": lambda: curve[srgb],
        "colour": lambda: camera_light(srgb, plan, curve),
        "mosaic": lambda: unprocess(srgb, plan, curve=curve),
        "normal": lambda: noise.normals(words),
        "quantise": lambda: quantise(to_dn(light, black_dn, white_dn, plan.brightest), black_dn, white_dn),
    }
    return thread_ns(calls[stage], light.size)
