"""Normal deviates and their distribution including the tails, and the noise computed from them."""

from __future__ import annotations

import itertools
import math
from decimal import Decimal
from statistics import NormalDist

import numpy as np
import pytest
from helpers.moments import REACH, SAMPLER_ERROR, bernstein
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.schema import Config, GainsConfig, NoiseConfig
from unprocess_gen.core import exact_distributions
from unprocess_gen.core.random_streams import words
from unprocess_gen.core.types import Plan
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.effects.heteroscedastic import heteroscedastic, noise_variance
from unprocess_gen.simulation.reference.noise import normals

SIGN = np.uint32(1 << 31)
LAST = 2**31 - 1
"""Last index, next to the centre of the distribution; index 0 is farthest in the tail."""


@pytest.fixture(scope="module")
def plan() -> Plan:
    noise = NoiseConfig("imx385_iso3200", "dn", "subtracted", 12, 240, 4095, 6.955588, 38.117816)
    return plan_image(Config(gains=GainsConfig(1.0, 1.0, 1.0), noise=noise), "e" * 64)


def normal(index: int) -> float:
    return float(normals(np.array(index, dtype=np.uint32)))


def exact(index: int) -> float:
    return -float(exact_distributions.normal_quantile(Decimal(2 * index + 1) / 2**33))


# One word -------------------------------------------------------------------------------------------------------------


@given(st.integers(0, LAST))
def test_a_normal_is_the_quantile_of_its_tail_probability(index: int) -> None:
    """The tail probability of index i is (i + ½) / 2**32 in every octave."""
    assert abs(normal(index) - exact(index)) <= SAMPLER_ERROR


@pytest.mark.parametrize("octave", range(32))
def test_normals_are_right_at_every_octave_edge(octave: int) -> None:
    for index in {max(2**octave // 2 - 1, 0), 2**octave // 2}:
        assert abs(normal(index) - exact(index)) <= SAMPLER_ERROR


@given(st.integers(0, LAST))
def test_the_top_bit_is_the_sign_only(index: int) -> None:
    assert normal(index | 1 << 31) == -normal(index)
    assert normal(index) > 0


def test_the_first_index_gives_the_largest_normal() -> None:
    """The smallest tail probability, 2**-33, has the quantile -6.3379…."""
    farthest = -NormalDist().inv_cdf(2.0**-33)
    assert 6.33 < farthest < 6.34 < REACH
    assert abs(normal(0) - farthest) <= SAMPLER_ERROR
    edges = np.unique(np.concatenate([[0], 2 ** np.arange(31), np.linspace(0, LAST, 10**6).astype(np.int64)]))
    assert normals(edges.astype(np.uint32)).max() == normal(0)


def test_normals_decrease_with_the_index_within_the_table_error() -> None:
    """Indices of every octave are tested, including its edges."""
    starts = [2**octave // 2 * (32 + segment) // 32 for octave in range(32) for segment in range(32)]
    for start in sorted(set(starts)):
        run = np.arange(max(start - 50, 0), min(start + 50, LAST)).astype(np.uint32)
        assert np.diff(normals(run)).max() <= 2 * SAMPLER_ERROR


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 6.3])
def test_tail_fractions_are_exact_within_the_table_error(z: float) -> None:
    """2**31 · 2·(1 - Phi(z)) indices lie beyond z; an error e of the table moves the last by 2**32·phi(z)·e."""
    beyond = math.erfc(z / math.sqrt(2)) / 2 * 2**32  # i + ½ below this
    slack = 2**32 * math.exp(-z * z / 2) / math.sqrt(2 * math.pi) * SAMPLER_ERROR * 1.001 + 1
    assert normal(max(math.floor(beyond - 0.5 - slack), 0)) >= z
    assert normal(math.ceil(beyond - 0.5 + slack)) <= z


@pytest.mark.parametrize("shape", [(), (1,), (3, 5), (2, 3, 4), (0,)])
def test_normals_keep_the_shape(shape: tuple[int, ...]) -> None:
    z = normals(np.zeros(shape, dtype=np.uint32))
    assert z.shape == shape
    assert z.dtype == np.float64


# Many words -----------------------------------------------------------------------------------------------------------


def test_all_words_together_have_variance_1() -> None:
    """Every 1024th index from the middle of its interval: the sum of a falling function approximates its integral.

    The error is at most the value of the first interval, and the tail within that interval.
    """
    step = 1024
    z = normals(np.arange(step // 2, 2**31, step).astype(np.uint32))
    first = NormalDist().inv_cdf(1 - step / 2**32)
    within_first = first * math.exp(-first * first / 2) * math.sqrt(2 / math.pi) + step / 2**31
    assert abs(float((z * z).mean()) - 1) <= z[0] ** 2 / len(z) + within_first + 2 * SAMPLER_ERROR


@pytest.fixture(scope="module", params=[1024, pytest.param(2048, marks=pytest.mark.slow)])
def z(request: pytest.FixtureRequest) -> np.ndarray:
    """Return the normal deviates of a square frame.

    With 2**20 values and one false alarm in 10**12, the bounds are 0.0074 for the mean and 1.1 % for the variance.
    Errors of twice these bounds are detected.
    """
    side = request.param
    return normals(words(2**63 + 12345, "heteroscedastic", (side, side))).ravel()


def test_moments_are_those_of_a_standard_normal(z: np.ndarray) -> None:
    """E zⁿ is 0 for odd n and (n - 1)!! for even ones; a power is within 6.34ⁿ of it, its variance from E z²ⁿ."""

    def moment(n: int) -> int:
        return 0 if n % 2 else math.prod(range(1, n, 2))

    power = np.ones_like(z)
    for order in range(1, 7):
        power *= z
        variance = moment(2 * order) - moment(order) ** 2
        systematic = order * math.sqrt(moment(2 * order - 2)) * SAMPLER_ERROR
        bound = bernstein(variance, REACH**order + moment(order), z.size) + systematic
        assert abs(float(power.mean()) - moment(order)) <= bound, order


def test_tail_counts_follow_the_normal_distribution(z: np.ndarray) -> None:
    for side, limit in itertools.product([-1, 1], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]):
        share = math.erfc(limit / math.sqrt(2)) / 2
        bound = bernstein(share * (1 - share), 1, z.size) + SAMPLER_ERROR
        assert abs(float((side * z > limit).mean()) - share) <= bound, (side, limit)


def test_the_distribution_is_normal(z: np.ndarray) -> None:
    """The Kolmogorov distance is bounded by the inequality of Dvoretzky, Kiefer, Wolfowitz and Massart."""
    ordered = np.sort(z)
    at = np.linspace(0, z.size - 1, 10_001).astype(np.int64)
    cdf = np.array([NormalDist().cdf(value) for value in ordered[at]])
    distance = np.maximum((at + 1) / z.size - cdf, cdf - at / z.size).max()
    assert distance <= math.sqrt(math.log(2 / 1e-12) / (2 * z.size)) + SAMPLER_ERROR


# Noise ----------------------------------------------------------------------------------------------------------------


def test_variance_is_linear_above_black(plan: Plan) -> None:
    made = plan.replace(a_dn=2.0, b_dn2=3.0, black_level_dn=240)
    assert noise_variance(np.array([[240.0, 240.5, 241.0, 4095.0]]), made).tolist() == [[3, 4, 5, 7713]]


def test_negative_variance_becomes_zero(plan: Plan) -> None:
    made = plan.replace(a_dn=8.0, b_dn2=-120.0, black_level_dn=240)
    assert noise_variance(np.array([[240.0, 254.0, 255.0, 256.0]]), made).tolist() == [[0, 0, 0, 8]]


def test_noise_is_the_standard_deviation_times_the_streams_normals(plan: Plan) -> None:
    clean = np.linspace(240, 4095, 12 * 70).reshape(12, 70)
    n = normals(words(plan.stream_key, "heteroscedastic", (12, 70)))
    expected = clean + np.sqrt(plan.noise.a_dn * (clean - 240) + plan.noise.b_dn2) * n
    assert (heteroscedastic(clean, plan) == expected).all()


@given(top=st.integers(0, 11), left=st.integers(0, 69))
def test_noise_of_a_crop_is_the_crop_of_the_noise(plan: Plan, top: int, left: int) -> None:
    clean = np.linspace(240, 4095, 12 * 70).reshape(12, 70)
    cut = heteroscedastic(clean[top:, left:], plan, (top, left))
    assert (cut == heteroscedastic(clean, plan)[top:, left:]).all()


def test_noise_is_neither_rounded_nor_clipped(plan: Plan) -> None:
    made = plan.replace(a_dn=0.0, b_dn2=1e8)
    noisy = heteroscedastic(np.full((64, 64), 240.0), made)
    assert noisy.min() < 0
    assert noisy.max() > 4095
    assert (noisy != np.rint(noisy)).any()
