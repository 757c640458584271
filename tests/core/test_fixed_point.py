"""Fixed-point arithmetic: errors are within the stated limits, and draws have the digits of `decimal`."""

from __future__ import annotations

import math
import random

import mpmath
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from unprocess_gen.config.distributions import DISTRIBUTIONS, Distribution
from unprocess_gen.core import fixed_point
from unprocess_gen.core.fixed_point import (
    BITS,
    ONE,
    QUANTILE_ERROR,
    exponential,
    logarithm,
    nearest,
    nearest_exp,
    normal_quantile,
    times,
)
from unprocess_gen.planning.parameters import EXACT, FIXED_POINT, draw_parameter

DIGITS = 100
uniforms = st.one_of(
    st.integers(0, 2**52 - 1).map(lambda k: (k + 0.5) / 2**52),
    st.integers(0, 51).map(lambda power: 1.5 * 2.0**-power / 2),
)


def number(fixed: int) -> mpmath.mpf:
    return mpmath.mpf(fixed) / ONE


# Errors ---------------------------------------------------------------------------------------------------------------


@given(st.floats(5e-324, 1.7e308))
@example(1.0)
@example(math.nextafter(1, 0))
def test_logarithm_is_within_its_error(x: float) -> None:
    with mpmath.workdps(DIGITS):
        found, error = logarithm(x)
        assert error < 2**11
        assert abs(number(found) - mpmath.log(mpmath.mpf(x))) * ONE <= error


@given(st.integers(-700 * ONE, 700 * ONE), st.integers(0, ONE >> 32), st.sampled_from([-1, 1]))
@example(0, 0, 1)
@example(-1, 0, 1)
@example(fixed_point.LN2, 0, 1)
@example(fixed_point.LN2 - 1, 0, 1)
def test_exponential_is_within_its_error_and_that_of_the_exponent(exponent: int, error: int, sign: int) -> None:
    with mpmath.workdps(DIGITS):
        mantissa, most, doublings = exponential(exponent, error)
        assert ONE - most <= mantissa < 2.01 * ONE
        moved = mpmath.exp(number(exponent + sign * error)) / mpmath.mpf(2) ** doublings
        assert abs(number(mantissa) - moved) * ONE <= most


@given(uniforms, st.integers(0, 2**60), st.sampled_from([-1, 0, 1]))
@example(0.5, 0, 0)
@example(2.0**-53, 0, 0)
@example(1 - 2.0**-53, 0, 0)
def test_quantile_is_within_its_error(uniform: float, error: int, sign: int) -> None:
    p = times(ONE, uniform)
    error = min(error, p >> 10, (ONE - p) >> 10)
    with mpmath.workdps(DIGITS):
        found = normal_quantile(p, error)
        assert found is not None
        exact = mpmath.sqrt(2) * mpmath.erfinv(2 * number(p + sign * error) - 1)
        assert abs(number(found[0]) - exact) * ONE <= found[1] - QUANTILE_ERROR


@pytest.mark.parametrize("node_number", [*range(0, 537, 13), 536])
def test_reach_of_a_node_covers_half_the_way_to_its_neighbours(node_number: int) -> None:
    node = fixed_point._node(node_number)
    with mpmath.workdps(DIGITS):
        z = mpmath.mpf(node_number) / fixed_point.NODES
        assert node.quantile == z * ONE
        for side in (-1, 1):
            half, end = z + side * mpmath.mpf(0.5) / fixed_point.NODES, z + side * mpmath.mpf(fixed_point.REACH)
            assert abs(mpmath.ncdf(-half) * ONE - node.tail) < node.reach
            assert node.reach < abs(mpmath.ncdf(-end) * ONE - node.tail) + (ONE >> 60)


@pytest.mark.parametrize("shift", [-1, 1])
def test_any_node_within_reach_gives_the_quantile(shift: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last bits of libm may select another node, so the selection must not matter."""
    drawn = [(k + 0.5) / 97 for k in range(97)]
    expected = [normal_quantile(times(ONE, uniform), 0) for uniform in drawn]
    moved = fixed_point._NORMAL.__class__(0.001 * shift, 1.0)
    monkeypatch.setattr(fixed_point, "_NORMAL", moved)
    for uniform, one in zip(drawn, expected, strict=True):
        other = normal_quantile(times(ONE, uniform), 0)
        assert one is not None
        assert other is not None
        assert abs(one[0] - other[0]) <= one[1] + other[1] - 2 * QUANTILE_ERROR


def test_results_out_of_range_are_undecided() -> None:
    assert [normal_quantile(p, 0) for p in (0, 1, ONE - 1, ONE)] == [None] * 4
    assert [nearest_exp(*exponent) for exponent in ((701 * ONE, 0), (-701 * ONE, 0), (0, ONE >> 31))] == [None] * 3


# Rounding -------------------------------------------------------------------------------------------------------------


@given(st.floats(1e-6, 1e6), st.sampled_from([-1, 1]))
def test_number_at_a_rounding_boundary_is_undecided(value: float, sign: int) -> None:
    """Half a unit in the last place above a float, larger numbers round up and smaller ones down."""
    middle = times(ONE, value) + times(ONE, math.ulp(value) / 2)
    away = 2 * (middle >> fixed_point.ROUNDED_BITS) + 2
    assert nearest(sign * middle, 1) is None
    assert nearest(sign * (middle - away), 1) == sign * value
    assert nearest(sign * (middle + away), 1) == sign * math.nextafter(value, math.inf)


# Draws ----------------------------------------------------------------------------------------------------------------

LAWS = [
    Distribution("truncated_normal", (0.8, 0.1, 0.5, 1.1)),
    Distribution("truncated_normal", (1.0, 0.25, 0.9, 2.5)),
    Distribution("truncated_normal", (1.0, 0.1, 1.5, 1.6)),
    Distribution("truncated_normal", (-1e6, 1e5, -1.5e6, 2e4)),
    Distribution("inverse_truncated_normal", (0.8, 0.1, 0.5, 1.1)),
    Distribution("inverse_truncated_normal", (0.0, 1.0, -6.0, 6.0)),
    Distribution("log_uniform", (0.0001, 0.012)),
    Distribution("log_uniform", (1e-300, 1e300)),
    Distribution("log_uniform", (100.0, 6400.0)),
    Distribution("log_linear_in_a", (2.18, 1.2, 0.26)),
    Distribution("log_linear_in_a", (-1.5, 0.0, 2.0)),
    Distribution("log_linear_in_a", (2.18, 1.2, 0.0)),
]


def test_every_slow_distribution_has_a_quick_form() -> None:
    assert set(EXACT) == set(DISTRIBUTIONS)
    assert {law.kind for law in LAWS} == set(FIXED_POINT) == set(EXACT) - {"constant", "choice", "uniform"}


@pytest.mark.parametrize("count", [300, pytest.param(20_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.kind} {law.numbers}")
def test_quick_draws_have_the_digits_of_decimal(law: Distribution, count: int) -> None:
    """One draw in ten is from a tail. Nearly all are decided; at most one in a thousand, and one more, are not."""
    rng, undecided = random.Random(5), 0
    for n in range(count):
        uniform = (rng.getrandbits(52) + 0.5) / 2**52
        if n % 10 == 0:
            tail = (1 + rng.random()) * 2.0 ** -rng.randint(2, 52)
            uniform = tail if n % 20 else 1 - tail
        a = math.exp(rng.uniform(-12, 3))
        found = FIXED_POINT[law.kind](uniform, a, *law.numbers)
        undecided += found is None
        assert found in (None, EXACT[law.kind](uniform, a, *law.numbers)), (uniform, a)
    assert undecided <= 1 + count / 1000


@pytest.mark.parametrize("law", LAWS, ids=lambda law: f"{law.kind} {law.numbers}")
def test_undecided_draws_come_from_decimal(law: Distribution, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fixed_point, "QUANTILE_ERROR", 1 << (BITS - 40))
    monkeypatch.setattr(fixed_point, "DECIMAL_ERROR", 1 << (BITS - 40))
    for uniform in (0.3, 0.9):
        assert FIXED_POINT[law.kind](uniform, 0.01, *law.numbers) is None
        assert draw_parameter(law, uniform, 0.01) == EXACT[law.kind](uniform, 0.01, *law.numbers)
