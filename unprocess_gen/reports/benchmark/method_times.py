"""Measure the times of methods and tiers in ns per pixel of processor time of one thread.

Kernels fuse stages: the curve is part of the colour matrix, and only the channel of each CFA site is computed. So
``curve``, ``colour`` and ``mosaic`` of kernels have one time, that of a clean frame; ``normal`` is the time that noise
and its read-out add to it. The times of ``shot`` and of other physical effects are differences between complete pairs
with and without them.

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
from unprocess_gen.simulation.kernels.body import forget_bodies
from unprocess_gen.simulation.kernels.render import render_clean
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference import noise
from unprocess_gen.simulation.reference.sensor import quantise, to_dn
from unprocess_gen.simulation.reference.unprocess import camera_light, unprocess

LEAST_NS = 0.01
"""Smallest difference of times, ns per pixel, that is reported; smaller differences are noise."""


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
    forget_bodies()
    return time_call(lambda: make_pair(srgb, plan), _pixels(srgb))


def _time_difference(session: BenchmarkSession, method: Method, image: BenchmarkImage, edits: tuple[str, str]) -> float:
    """Return the time of a pair with some effects minus the time without them."""
    accuracy = budget_for(method, session.tiers)
    longer, shorter = (time_pair(session, PHYSICAL, accuracy, image, edit) for edit in edits)
    return max(longer - shorter, LEAST_NS)


def time_effects(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time that physical effects other than shot noise add to a pair."""
    return _time_difference(session, method, image, ("without_shot", "without_effects"))


def time_shot(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time that shot noise adds to a pair."""
    return _time_difference(session, method, image, ("with_shot", "without_shot"))


# ------------------------------------------------------------------------------------------------------ clean stages


def _plan_and_curve(session: BenchmarkSession, srgb: Srgb, image: BenchmarkImage) -> tuple[Plan, Float]:
    plan = session.plan(TWO_PARAMETER, session.tiers[EXACT], image, srgb)
    return plan, linear_table(plan.tone, plan.gamma, int(np.iinfo(srgb.dtype).max) + 1)


def _clean_light(session: BenchmarkSession, image: BenchmarkImage) -> tuple[Plan, Float]:
    plan, curve = _plan_and_curve(session, image.readable, image)
    return plan, unprocess(image.readable, plan, curve=curve)


def time_clean(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of a clean frame by the kernels of a method."""
    plan = session.plan(TWO_PARAMETER, budget_for(method, session.tiers), image, image.compiled)
    return time_call(lambda: render_clean(image.compiled, plan), _pixels(image.compiled))


def time_noise(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time that noise of one normal deviate per site, and its read-out, add to a clean frame."""
    pair = time_pair(session, TWO_PARAMETER, budget_for(method, session.tiers), image)
    return max(pair - time_clean(session, method, image), LEAST_NS)


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


def time_numpy_readout(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of rounding and clipping in NumPy."""
    plan, light = _clean_light(session, image)
    black_dn, white_dn = plan.black_level_dn, plan.white_level_dn
    return time_call(lambda: quantise(to_dn(light, black_dn, white_dn, plan.brightest), black_dn, white_dn), light.size)


def _scrambled_words(count: int) -> Words:
    """Return words evenly spaced over all 2**32 values, in scrambled order."""
    return (np.arange(count, dtype=np.uint64) * np.uint64(2654435769)).astype(np.uint32)


def time_numpy_normals(session: BenchmarkSession, method: Method, image: BenchmarkImage) -> float:
    """Return the time of normal deviates in NumPy."""
    words = _scrambled_words(_pixels(image.readable))
    return time_call(lambda: noise.normals(words), words.size)
