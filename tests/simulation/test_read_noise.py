"""Read noise has the standard deviation and the distribution of its profile."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import mpmath
import numpy as np
import pytest
from helpers.configs import with_branch
from helpers.datasets import Settings
from helpers.flats import bounds_off, noisy_dn, picture, plan_with, planned, signal_dn
from helpers.moments import REACH
from helpers.published import CRVD

from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.exact_distributions import tukey_std
from unprocess_gen.planning.effect_selection import facts_of
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation import lookup_tables
from unprocess_gen.simulation.lookup_tables import (
    OCTAVES,
    SEGMENTS,
    draw_variance,
    quantile_table,
    tukey_table,
    unit_tukey_table,
)
from unprocess_gen.simulation.reference import noise as effects

SHAPES = (0.0, 1e-13, 0.015, 0.1571, 1.0, -0.1, -0.2429)


def tukey(tail: mpmath.mpf, shape: float) -> mpmath.mpf:
    """Return the quantile of a tail probability in the Tukey lambda distribution of scale 1."""
    if abs(shape) < 1e-12:
        return mpmath.log((1 - tail) / tail)
    return ((1 - tail) ** mpmath.mpf(shape) - tail ** mpmath.mpf(shape)) / mpmath.mpf(shape)


@pytest.mark.parametrize("shape", SHAPES)
def test_tukey_quantiles_match_closed_form(shape: float) -> None:
    rng = np.random.Generator(np.random.Philox(key=3))
    spread = np.concatenate([2 ** np.arange(31), rng.integers(0, 2 ** np.arange(2, 32).repeat(5))])
    found = effects.by_inverse_cdf(spread.astype(np.uint32), tukey_table(shape))
    std = float(tukey_std(shape))
    for index, z in zip(spread.tolist(), found.tolist(), strict=True):
        exact = float(tukey((mpmath.mpf(index) + 0.5) / 2**32, shape)) / std
        assert abs(z - exact) <= 2e-7 * (1 + exact)


def table_moment(table: np.ndarray, order: int) -> float:
    """Return the exact moment of draws from a table, of both signs; each segment is a fraction of all words."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    t = (nodes + 1) / 2 / SEGMENTS
    values = table[:, :1] + t * (table[:, 1:2] + t * table[:, 2:3])
    share = np.repeat(2.0 ** (np.arange(OCTAVES) - 33.0), SEGMENTS) / SEGMENTS
    return float(2 * (share * ((values**order) @ (weights / 2))).sum())


HEAVY_TAILS = (-0.3, -0.35, -0.4, -0.45)


@pytest.mark.parametrize("shape", [*SHAPES, *HEAVY_TAILS, -0.49])
def test_unit_tukey_table_has_variance_1(shape: float) -> None:
    """The sum over all draws is exact: for shapes whose tails `tukey_table` lacks too."""
    with localcontext(prec=40):
        assert abs(draw_variance(unit_tukey_table(shape)) - 1) < Decimal("1e-15")


def test_draw_variance_is_that_of_every_word_of_an_octave() -> None:
    """Compare with the values of all words j below 2**18, in a table that is 0 above."""
    table = unit_tukey_table(-0.4).copy()
    table[18 * SEGMENTS :] = 0
    j = np.arange(1, 2**18, 2, dtype=np.uint32)
    values = effects.by_inverse_cdf((j - 1) // 2, table)
    with localcontext(prec=40):
        assert float(draw_variance(table)) == pytest.approx(float(values @ values) / 2**31, rel=1e-12)


@pytest.mark.parametrize("shape", HEAVY_TAILS)
def test_quantiles_of_heavy_tails_keep_their_shape(shape: float) -> None:
    index = np.arange(2**30, 2**31 - 1, 2**22, dtype=np.uint32)
    table, unit = tukey_table(shape), unit_tukey_table(shape)
    ratio = effects.by_inverse_cdf(index, unit) / effects.by_inverse_cdf(index, table)
    assert float(np.ptp(ratio)) < 1e-12
    with localcontext(prec=40):
        assert ratio[0] == pytest.approx(1 / math.sqrt(draw_variance(table)), rel=1e-12)


@pytest.mark.parametrize(
    ("distribution", "shape"),
    [
        ("gaussian", 0.0),
        *(("tukey_lambda", shape) for shape in (*SHAPES, -0.3)),
    ],
)
def test_read_noise_has_given_standard_deviation_for_every_distribution(distribution: str, shape: float) -> None:
    std = 300.0
    plan = plan_with("read", read_law=distribution, read_shape=shape, read_std_dn=std)
    deviation = noisy_dn(plan, 32000) - signal_dn(32000)
    table = quantile_table(plan.numbers.read_law, plan.numbers.read_shape)
    with localcontext(prec=40):
        second = float(draw_variance(table))
    fourth, reach = table_moment(table, 4), float(np.abs(table[0]).sum()) * std + 1
    variance = std**2 * second + 1 / 12
    assert abs(second - 1) <= 1e-9
    assert bounds_off(deviation, 0, variance, reach) <= 1
    spread = std**4 * fourth + std**2 / 2 + 1 / 80 - variance**2
    assert bounds_off(deviation**2, variance, spread, reach**2) <= 1


@pytest.mark.parametrize("iso", CRVD)
def test_imx385_read_noise_has_variance_of_crvd(settings: Settings, iso: int) -> None:
    plan = planned(settings, picture(), "noise=imx385", f"noise.iso={iso}")
    assert plan.physics is not None
    assert plan.physics.dn_per_e == CRVD[iso][0]
    assert plan.physics.read_std_dn**2 == pytest.approx(CRVD[iso][1], rel=1e-12)
    assert plan.noise.b_dn2 == plan.physics.read_std_dn**2


def test_scatter_about_line_is_normal_in_logarithm(settings: Settings) -> None:
    config = settings("noise=oppo_reno10x", "noise.iso=800", "noise.scatter=unit")
    config = with_branch(config, read_std_dn=["line", 0.5, -2.5, 0.25])
    validate_config(config)
    facts = facts_of(picture())
    plans = [plan_image(config, f"{n:064x}", facts=facts) for n in range(150)]
    scale = (4095 - 240) / (1023 - 64)
    centre = 0.5 * math.log(800) - 2.5
    normals = np.array([(math.log(math.sqrt(plan.noise.b_dn2) / scale) - centre) / 0.25 for plan in plans])
    assert bounds_off(normals, 0, 1, REACH) <= 1
    assert bounds_off(normals**2, 1, 2, REACH**2) <= 1
    assert 0.11 < float((normals > 0.5).mean()) < 0.5  # 0.309, five standard deviations


@pytest.mark.parametrize("shape", [-0.3, 0.0026, 0.14])
def test_tables_have_the_digits_of_decimal(shape: float, monkeypatch: pytest.MonkeyPatch) -> None:
    table = lookup_tables.tukey_table.__wrapped__(shape)
    monkeypatch.setattr(lookup_tables, "ROUNDED_BITS", 0)  # fixed-point numbers decide nothing
    np.testing.assert_array_equal(lookup_tables.tukey_table.__wrapped__(shape), table)
