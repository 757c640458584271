"""Normal deviates follow their distribution including the tails, and the noise is computed from them."""

from __future__ import annotations

from decimal import Decimal
from statistics import NormalDist

import numpy as np
import pytest
from helpers.moments import REACH, SAMPLER_ERROR
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.core import exact_distributions
from unprocess_gen.core.random_streams import words
from unprocess_gen.simulation.effects.heteroscedastic import STREAM
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.electrons import noisy
from unprocess_gen.simulation.reference.noise import normals

LAST = 2**31 - 1
"""Last index, next to the centre of the distribution; index 0 is farthest in the tail."""


def normal(index: int) -> float:
    return float(normals(np.array(index, dtype=np.uint32)))


def exact(index: int) -> float:
    return -float(exact_distributions.normal_quantile(Decimal(2 * index + 1) / 2**33))


# One word -------------------------------------------------------------------------------------------------------------


@given(st.integers(0, LAST))
def test_a_normal_is_the_quantile_of_its_tail_probability(index: int) -> None:
    """The tail probability of index i is (i + ½) / 2**32 in every octave."""
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


@pytest.mark.parametrize("shape", [(), (1,), (3, 5), (2, 3, 4), (0,)])
def test_normals_keep_the_shape(shape: tuple[int, ...]) -> None:
    z = normals(np.zeros(shape, dtype=np.uint32))
    assert z.shape == shape
    assert z.dtype == np.float64


# Many words -----------------------------------------------------------------------------------------------------------


# Noise ----------------------------------------------------------------------------------------------------------------


def test_noise_is_the_standard_deviation_times_the_streams_normals(plan: Plan) -> None:
    clean = np.linspace(240, 4095, 12 * 70).reshape(12, 70)
    n = normals(words(plan.stream_key, STREAM, (12, 70)))
    expected = clean + np.sqrt(plan.noise.a_dn * (clean - 240) + plan.noise.b_dn2) * n
    assert (noisy(clean, plan) == expected).all()
