"""Flat fields and gradients: noisy frames have exactly the documented distribution, at every level.

    noisy = clip(rint(x + sqrt(max(0, a·(x - black) + b))·n), low, high)      x: the clean value, not rounded

Every option of ``conf/noise`` is simulated on 64 flat levels, from black over hundredths of a DN to white. Mean and
variance are compared with the exact moments of the rounded, clipped Gaussian (`moments`), within Bernstein's bounds for
the number of pixels. Wrong distributions that others have used are compared with the same frames and must not fit.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.datasets import Settings
from helpers.moments import REACH, SAMPLER_ERROR, Moments, bernstein, moments, shares
from helpers.promise_report import Figure

from unprocess_gen.config.validation import validate_config
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import Plan

Law = Callable[[Plan, float], tuple[float, float]]
"""Mean and standard deviation before rounding and clipping, at the clean value x."""

BELOW_WHITE = (0, 1, 2, 5, 17, 100, 400, 1000)
CODES = sorted({0, *np.geomspace(1, 65535, 62).astype(int).tolist(), *(65535 - code for code in BELOW_WHITE)})
assert len(CODES) >= 64
WIDTH, ROWS = 1024, 128
SITES = WIDTH * ROWS
"""Pixels of one level in one frame."""

NOISE = sorted((Path(__file__).parents[2] / "conf" / "noise").glob("*.yaml"))
OPTIONS = {
    **{path.stem: () for path in NOISE if "branches:" not in path.read_text(encoding="utf-8")},
    "heteroscedastic": ("noise.a=0.05", "noise.b=0.02"),  # standard deviations from 0.14 DN
}
LINEAR = ("camera=identity", "gains=unity", "isp=linear")


def plan_of(settings: Settings, noise: str, *overrides: str, image: int = 0) -> Plan:
    config = settings(*LINEAR, f"noise={noise}", *OPTIONS[noise], *overrides)
    validate_config(config)
    return plan_image(config, hashlib.sha256(b"flat %d" % image).hexdigest())


@functools.lru_cache(maxsize=1)
def flats() -> np.ndarray:
    """Return a frame of all levels, `ROWS` rows each."""
    levels = np.repeat(np.array(CODES, dtype=np.uint16), ROWS)
    return np.ascontiguousarray(np.broadcast_to(levels[:, None, None], (len(levels), WIDTH, 3)))


def with_noise(plan: Plan, a: float, b: float) -> Plan:
    """Return the plan with noise of variance a·(x - black) + b."""
    return plan.replace(a_dn=a, b_dn2=b, effects=("heteroscedastic", "quantise"))


def clean_value(plan: Plan, code: int) -> float:
    return plan.sensor.black_level_dn + code / 65535 * (plan.sensor.white_level_dn - plan.sensor.black_level_dn)


@functools.lru_cache(maxsize=1)
def histograms(plan: Plan, frames: int) -> np.ndarray:
    """Count each DN at each level, ``[levels, 2**bits]``; frames are stacked, so no random word occurs twice."""
    found = np.zeros((len(CODES), 2**plan.sensor.bits), dtype=np.int64)
    for frame in range(frames):
        noisy = make_pair(flats(), plan, origin=(frame * len(CODES) * ROWS, 0)).noisy
        for level, pixels in enumerate(noisy.reshape(len(CODES), SITES)):
            found[level] += np.bincount(pixels, minlength=2**plan.sensor.bits)
    return found


def promised(plan: Plan, x: float) -> tuple[float, float]:
    return x, math.sqrt(max(0.0, plan.noise.a_dn * (x - plan.sensor.black_level_dn) + plan.noise.b_dn2))


def exact_moments(plan: Plan, x: float, law: Law) -> Moments:
    low, high = plan.sensor.limits_dn
    centre, std = law(plan, x)
    return moments(centre, std, int(low), int(high))


def misfits(plan: Plan, found: np.ndarray, law: Law = promised) -> list[str]:
    """Return the levels whose mean, or variance about the exact mean, does not follow the distribution.

    The table of normals has an error of 1.5e-7: it moves each threshold between two DN by that part of a standard
    deviation, the mean by 1.5e-7 of std + 1, and the mean square by twice the distance times that.
    """
    complaints = []
    dn = np.arange(2**plan.sensor.bits)
    for code, histogram in zip(CODES, found, strict=True):
        count = int(histogram.sum())
        x = clean_value(plan, code)
        std = law(plan, x)[1]
        exact = exact_moments(plan, x, law)
        table = SAMPLER_ERROR * (std + 1) if std else 0.0
        off = float(histogram @ (dn - exact.mean)) / count
        if abs(off) > bernstein(exact.variance, exact.reach, count) + table:
            complaints.append(f"mean at {x:.3f}: off by {off:.4g}")
        excess = float(histogram @ (dn - exact.mean) ** 2) / count - exact.variance
        spread = max(exact.fourth - exact.variance**2, 0.0)
        reach = max(exact.reach**2, exact.variance)
        if abs(excess) > bernstein(spread, reach, count) + 2 * (std + 1) * table:
            complaints.append(f"variance at {x:.3f}: {exact.variance:.4g}, off by {excess:.4g}")
    return complaints


# The helper -----------------------------------------------------------------------------------------------------------


def test_exact_moments_of_wide_gaussian_include_rounding() -> None:
    """Sheppard's corrections: variance + 1/12, fourth moment 3s⁴ + s²/2 + 1/80; their error is e^(-2pi²s²)."""
    found = moments(500.3, 2.0, 0, 1000)
    slack = 1e-12 * 500
    assert abs(found.mean - 500.3) <= slack
    assert abs(found.variance - (4 + 1 / 12)) <= slack
    assert abs(found.third) <= slack
    assert abs(found.fourth - (48 + 2 + 1 / 80)) <= slack


def test_exact_moments_at_a_clip_are_half_normal() -> None:
    """Clipped at its mean, a Gaussian has mean s/√(2pi); rounding in steps of s/1000 changes it by 1e-6."""
    found = moments(0.0, 1000.0, 0, 10**5)
    assert abs(found.mean / 1000 - 1 / math.sqrt(2 * math.pi)) <= 1e-6
    assert abs(found.variance / 1e6 - (1 / 2 - 1 / (2 * math.pi))) <= 1e-6


# Mean and variance ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("repeats", [1, pytest.param(32, marks=pytest.mark.slow)])  # 32: four million sites
@pytest.mark.parametrize("clip", ["sensor", "black"])
@pytest.mark.parametrize("noise", OPTIONS)
def test_mean_and_variance_of_flats_follow_the_distribution(
    settings: Settings, noise: str, clip: str, repeats: int, figure: Figure
) -> None:
    plan = plan_of(settings, noise, f"sensor.clip={clip}")
    found = histograms(plan, repeats)
    assert misfits(plan, found) == []
    figure("noise-moments", f"{len(CODES)} levels of {found[0].sum()} sites: mean and variance within their bounds")


@pytest.mark.parametrize("sensor", slow_except(("generic_10bit",), (f"generic_{bits}bit" for bits in (10, 12, 14, 16))))
def test_mean_and_variance_of_flats_hold_on_every_sensor(settings: Settings, sensor: str) -> None:
    plan = plan_of(settings, "imx385_iso1600", f"sensor={sensor}")
    assert misfits(plan, histograms(plan, 1)) == []


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.01), (0.0, 0.09), (0.0, 0.25), (0.002, 0.0), (1.0, 0.0), (0.0, 1e6)])
def test_mean_and_variance_of_flats_hold_for_extreme_noise(settings: Settings, a: float, b: float) -> None:
    plan = with_noise(plan_of(settings, "none"), a, b)
    assert misfits(plan, histograms(plan, 1)) == []


# Wrong distributions are detected -------------------------------------------------------------------------------------


WRONG: dict[str, Law] = {
    "black level in the signal": lambda plan, x: (x, math.sqrt(plan.noise.a_dn * x + plan.noise.b_dn2)),
    "truncated": lambda plan, x: (x - 0.5, promised(plan, x)[1]),
    "noise on the rounded clean frame": lambda plan, x: (round(x), promised(plan, x)[1]),
    "deviation 2 % too great": lambda plan, x: (x, promised(plan, x)[1] * 1.02),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_noise_parameters_are_detected(settings: Settings, wrong: str) -> None:
    plan = with_noise(plan_of(settings, "none"), 3.0, 0.5)
    assert misfits(plan, histograms(plan, 1), WRONG[wrong]) != []


# Tails and frequencies ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("noise", "code"), [("imx385_iso3200", 65535 // 2), ("imx385_iso1600", 100), ("imx385_iso25600", 65000)]
)
def test_every_dn_has_its_expected_frequency(settings: Settings, noise: str, code: int) -> None:
    """Near black and near white too, including the DN at which values are clipped."""
    plan = plan_of(settings, noise)
    x, std = promised(plan, clean_value(plan, code))
    noisy = make_pair(np.full((1024, 1024, 3), code, dtype=np.uint16), plan).noisy
    found = np.bincount(noisy.ravel(), minlength=4096) / noisy.size
    levels, probability = shares(x, std, 0, 4095)
    expected = np.zeros(4096)
    expected[levels] = probability
    bounds = np.array([bernstein(p * (1 - p), 1, noisy.size) for p in expected])
    assert (np.abs(found - expected) <= bounds + SAMPLER_ERROR).all()


# No variance ----------------------------------------------------------------------------------------------------------


def test_negative_variance_leaves_shadows_without_noise(settings: Settings) -> None:
    """RVDD: no noise up to 122.69544 / 8.0034 = 15.33 DN above black, noise above it."""
    plan = plan_of(settings, "imx385_iso3200_rvdd")
    for code in CODES:
        pair = make_pair(np.full((64, 64, 3), code, dtype=np.uint16), plan)
        above_black = clean_value(plan, code) - 240
        still = above_black < 122.69544 / 8.0034
        assert (pair.counts.zero_variance == 64 * 64) is still
        assert bool((pair.noisy == pair.clean).all()) is still


def test_noise_none_gives_the_clean_frame(settings: Settings) -> None:
    plan = plan_of(settings, "none")
    pair = make_pair(flats(), plan)
    assert (pair.noisy == pair.clean).all()


# Photon transfer ------------------------------------------------------------------------------------------------------


SPAN, STRIP = 255, 15
"""65535 = 255 · 257: each DN of a gradient over all codes has 257 evenly spaced fractions; strips have 15 DN."""


def transfer(settings: Settings, a: float, b: float) -> list[float]:
    """Return the error of var(noisy - clean) = a·u + b + 1/6 in strips of a gradient, in units of its limit.

    The difference consists of noise and two roundings. Both roundings have negative excess, so its fourth moment is
    below that of a Gaussian of equal variance, and the variance of its square is below 2·variance². The roundings are
    uniform and independent up to e^(-2pi²s²)·(2/pi² + 4s²), with s the smallest standard deviation, and 1/12/257².
    """
    plan = plan_of(settings, "none").replace(black_level_dn=256, white_level_dn=256 + SPAN)
    plan = with_noise(plan, a, b)
    codes = np.arange(65535, dtype=np.uint16)
    rows = 64
    pair = make_pair(np.ascontiguousarray(np.broadcast_to(codes[None, :, None], (rows, 65535, 3))), plan)
    assert pair.counts.noisy_clipped_low == pair.counts.noisy_clipped_high == 0
    difference = pair.noisy.astype(np.float64) - pair.clean
    square = (difference**2).reshape(rows, SPAN // STRIP, STRIP * 257).mean(axis=(0, 2))
    u = (codes / 257).reshape(SPAN // STRIP, STRIP * 257)
    misses = []
    for strip, found in zip(u, square, strict=True):
        variance = a * strip + b + 1 / 6
        least = a * float(strip.min()) + b
        leftover = math.exp(-2 * math.pi**2 * least) * (2 / math.pi**2 + 4 * least) + 1 / 12 / 257**2
        reach = (REACH * math.sqrt(float(variance.max())) + 1) ** 2
        bound = bernstein(float((2 * variance**2).mean()), reach, rows * strip.size)
        bound += leftover + 2 * SAMPLER_ERROR * float(variance.max())
        misses.append(abs(found - float((a * strip + b).mean()) - 1 / 6) / bound)
    return misses


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.49), (0.02, 0.49), (0.5, 0.49), (3.513262, 11.917691)])
def test_photon_transfer_is_linear_plus_a_sixth_for_two_roundings(settings: Settings, a: float, b: float) -> None:
    assert max(transfer(settings, a, b)) <= 1
