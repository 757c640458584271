"""Measure the times of methods and tiers in ns per pixel of processor time of one thread.

Kernels fuse stages: the curve is part of the colour matrix, and only the channel of each CFA site is computed. So the
time of a clean stage runs from the codes to the end of the stage: ``curve`` is the table look-up; ``colour`` and
``mosaic``, one loop, run up to the clean frame. ``quantise`` starts from DN, ``normal`` from random words, ``shot``
from words and rates. The time of other physical effects is the difference between complete pairs with and without them.

NumPy methods are measured on smaller crops, which are still large enough that their arrays do not fit the CPU caches.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from unprocess_gen.config.accuracy import Method
from unprocess_gen.config.schema import AccuracyConfig
from unprocess_gen.core.random_streams import Words
from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import Float, Plan, Srgb
from unprocess_gen.reports.benchmark.session import (
    EXACT,
    PHYSICAL,
    TWO_PARAMETER,
    BenchmarkImage,
    BenchmarkSession,
    budget_for,
)
from unprocess_gen.reports.benchmark.stage_loops import (
    loop_clean,
    loop_clean32,
    loop_counts,
    loop_normals,
    loop_normals32,
    loop_readout,
    loop_readout32,
    loop_signals,
    loop_signals32,
)
from unprocess_gen.simulation.kernels import gaussian_float32, physical
from unprocess_gen.simulation.kernels.clean import PairParameters, pair_parameters
from unprocess_gen.simulation.kernels.normal import normal_quantile_tables
from unprocess_gen.simulation.kernels.poisson import allocate_count_buffers
from unprocess_gen.simulation.kernels.segments import LONG_SEGMENT, allocate_buffers
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference import noise
from unprocess_gen.simulation.reference.poisson import poisson_tables
from unprocess_gen.simulation.reference.sensor import quantise, to_dn
from unprocess_gen.simulation.reference.unprocess import camera_light, unprocess

LEAST_NS = 0.01
"""Smallest difference of times, ns per pixel, that is reported; smaller differences are noise."""

SEGMENTS = 8
"""Number of segments that loops process in turn: consecutive calls see different data, and all fit the L1 cache."""

LIMITS_DN = (0.0, 16383.0)


def time_call(call: Callable[[], object], pixels: int) -> float:
    """Return the processor time of a call in this thread, ns per pixel, more than 0."""
    started = time.thread_time_ns()
    call()
    return max(time.thread_time_ns() - started, 1) / pixels


def _pixels(srgb: Srgb) -> int:
    return int(srgb.shape[0] * srgb.shape[1])


# ---------------------------------------------------------------------------------------------------- complete pairs


def time_pair(
    session: BenchmarkSession,
    config_name: str,
    accuracy: AccuracyConfig,
    image: BenchmarkImage,
    edit: str = "unchanged",
) -> float:
    """Return the time of a pair whose camera body was not simulated before."""
    srgb = image.readable if accuracy.readable else image.compiled
    plan = session.plan(config_name, accuracy, image, srgb, edit)
    physical.prnu_response.cache_clear()
    return time_call(lambda: make_pair(srgb, plan), _pixels(srgb))


def _time_difference(session: BenchmarkSession, method: Method, image: BenchmarkImage, edits: tuple[str, str]) -> float:
    """Return the time of a pair with some effects minus the time without them."""
    accuracy = budget_for(method, session.tiers)
    longer, shorter = (time_pair(session, PHYSICAL, accuracy, image, edit) for edit in edits)
    return max(longer - shorter, LEAST_NS)


def time_effects(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time that physical effects other than shot noise add to a pair."""
    return _time_difference(session, method, image, ("without_shot", "without_effects"))


def time_numpy_shot(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time that shot noise adds to a pair."""
    return _time_difference(session, method, image, ("with_shot", "without_shot"))


def time_approximate_shot(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of counts, plus the difference that the Gaussian approximation makes to a pair.

    The approximation has no loop of its own.
    """
    approximate, exact = (
        time_pair(session, PHYSICAL, accuracy, image, "with_shot")
        for accuracy in (budget_for(method, session.tiers), session.tiers[EXACT])
    )
    return max(time_counts(session, method, image) + approximate - exact, LEAST_NS)


# ------------------------------------------------------------------------------------------------------ clean stages


def _plan_and_curve(session: BenchmarkSession, srgb: Srgb, image: BenchmarkImage) -> tuple[Plan, Float]:
    plan = session.plan(TWO_PARAMETER, session.tiers[EXACT], image, srgb)
    return plan, linear_table(plan.tone, plan.gamma, int(np.iinfo(srgb.dtype).max) + 1)


def _parameters(session: BenchmarkSession, image: BenchmarkImage) -> tuple[Srgb, PairParameters]:
    srgb = image.compiled
    plan, curve = _plan_and_curve(session, srgb, image)
    return srgb, pair_parameters(plan, curve, srgb.shape, (0, 0))


def _clean_light(session: BenchmarkSession, image: BenchmarkImage) -> tuple[Plan, Float]:
    plan, curve = _plan_and_curve(session, image.readable, image)
    return plan, unprocess(image.readable, plan, curve=curve)


def time_curve(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of the table look-up in float64."""
    srgb, parameters = _parameters(session, image)
    out = np.empty(LONG_SEGMENT)
    return time_call(lambda: loop_signals(srgb, parameters, out), _pixels(srgb))


def time_curve32(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of the table look-up in float32."""
    srgb, parameters = _parameters(session, image)
    products, out = parameters.products.astype(np.float32), np.empty(LONG_SEGMENT, dtype=np.float32)
    return time_call(lambda: loop_signals32(srgb, products, parameters.site_channels, out), _pixels(srgb))


def time_clean(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of the clean frame in float64."""
    srgb, parameters = _parameters(session, image)
    counts = np.zeros(6, dtype=np.int64)
    return time_call(lambda: loop_clean(srgb, parameters, allocate_buffers(), counts), _pixels(srgb))


def time_clean32(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of the clean frame in float32."""
    srgb, parameters = _parameters(session, image)
    parameters32 = (
        gaussian_float32.dn_products32(parameters),
        gaussian_float32.site_parameters32(parameters),
        gaussian_float32.clean_parameters32(parameters),
    )
    return time_call(lambda: loop_clean32(srgb, *parameters32, gaussian_float32.allocate_buffers32()), _pixels(srgb))


def time_numpy_curve(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of the curve in NumPy."""
    _, curve = _plan_and_curve(session, image.readable, image)
    return time_call(lambda: curve[image.readable], _pixels(image.readable))


def time_numpy_colour(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time up to the colour matrix and gains in NumPy."""
    plan, curve = _plan_and_curve(session, image.readable, image)
    return time_call(lambda: camera_light(image.readable, plan, curve), _pixels(image.readable))


def time_numpy_mosaic(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time up to the mosaic in NumPy."""
    plan, curve = _plan_and_curve(session, image.readable, image)
    return time_call(lambda: unprocess(image.readable, plan, curve=curve), _pixels(image.readable))


# ----------------------------------------------------------------------------------------------- readout and numbers


def _repeats(image: BenchmarkImage, values: int) -> int:
    """Return how often a loop over some values must run to process as many as the image has pixels."""
    return -(-_pixels(image.compiled) // values)


def _dn_segments(session: BenchmarkSession, image: BenchmarkImage) -> Float:
    """Return segments of a photograph's DN before rounding."""
    plan, light = _clean_light(session, image)
    dn = to_dn(light, plan.black_level_dn, plan.white_level_dn, plan.brightest)
    return np.resize(dn, (SEGMENTS, LONG_SEGMENT))


def time_readout(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of rounding and clipping in float64."""
    segments = _dn_segments(session, image)
    repeats = _repeats(image, segments.size)
    buffers = np.empty(LONG_SEGMENT, dtype=np.uint16), np.zeros(6, dtype=np.int64)
    return time_call(lambda: loop_readout(segments, repeats, LIMITS_DN, *buffers), repeats * segments.size)


def time_readout32(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of rounding and clipping in float32."""
    plan, _ = _plan_and_curve(session, image.compiled, image)
    segments = _dn_segments(session, image).astype(np.float32)
    repeats, parameters = _repeats(image, segments.size), gaussian_float32.noise_parameters32(plan, LIMITS_DN)
    black, noisy = np.uint32(plan.black_level_dn), np.empty(LONG_SEGMENT, dtype=np.uint16)
    return time_call(lambda: loop_readout32(segments, repeats, parameters, black, noisy), repeats * segments.size)


def time_numpy_readout(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of rounding and clipping in NumPy."""
    plan, light = _clean_light(session, image)
    black_dn, white_dn = plan.black_level_dn, plan.white_level_dn
    return time_call(lambda: quantise(to_dn(light, black_dn, white_dn, plan.brightest), black_dn, white_dn), light.size)


def _scrambled_words(count: int) -> Words:
    """Return words evenly spaced over all 2**32 values, in scrambled order."""
    return (np.arange(count, dtype=np.uint64) * np.uint64(2654435769)).astype(np.uint32)


def time_normals(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of the approximate normal deviates, which kernels use unless the exact ones change the DN."""
    return _time_normals(loop_normals, image)


def time_normals32(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of the normal deviates of the float32 kernels."""
    return _time_normals(loop_normals32, image)


def _time_normals(loop: Callable[..., None], image: BenchmarkImage) -> float:
    segments = _scrambled_words(SEGMENTS * LONG_SEGMENT).reshape(SEGMENTS, LONG_SEGMENT)
    repeats = _repeats(image, segments.size)
    depths, out = np.empty((2, LONG_SEGMENT), dtype=np.float32)
    return time_call(lambda: loop(segments, repeats, depths, out), repeats * segments.size)


def time_numpy_normals(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of normal deviates in NumPy."""
    words = _scrambled_words(_pixels(image.readable))
    return time_call(lambda: noise.normals(words), words.size)


def time_counts(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of Poisson counts at the rates of a photograph."""
    plan, light = _clean_light(session, image)
    physics = session.plan(PHYSICAL, session.tiers[EXACT], image, image.readable).physics
    assert physics is not None
    span_dn = plan.white_level_dn - plan.black_level_dn
    rates_e = np.clip(light, 0, 1) * plan.exposure * span_dn / physics.dn_per_e
    rates = np.resize(rates_e, (SEGMENTS, LONG_SEGMENT))
    words = _scrambled_words(rates.size).reshape(rates.shape)
    repeats = _repeats(image, rates.size)
    tables = normal_quantile_tables(), poisson_tables()
    buffers = allocate_count_buffers(LONG_SEGMENT), np.empty(LONG_SEGMENT)
    return time_call(lambda: loop_counts(rates, repeats, words, *tables, *buffers), repeats * rates.size)
