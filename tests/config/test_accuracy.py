"""Choice of methods by a budget of errors. The error statements of the methods are tested with their kernels."""

from __future__ import annotations

import math
from dataclasses import replace
from decimal import localcontext

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.datasets import Settings
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.accuracy import (
    IMPLEMENTATIONS,
    METHODS,
    STAGES,
    Budget,
    choose_methods,
    method,
    methods_of_stage,
)
from unprocess_gen.config.interpretation import accuracy_budget
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.exact_distributions import tukey_std
from unprocess_gen.core.types import Facts, Plan
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.kernels.electron_records import count_roots
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.simulation.reference.poisson import core_share, gaussian_distance, gaussian_from
from unprocess_gen.sources.scenes import synthetic

EXACT = Budget("exact", False, 0.0, 0.0, 1e-6, 0.0)
ALL = Budget("anything", False, math.inf, 1.0, math.inf, 1.0)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return np.ascontiguousarray(synthetic.scene("gradients-0")[300:324, 400:431])


# Chosen methods -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tier", ["reference", "exact", "fast"])
def test_each_tier_has_a_method_for_every_stage(settings: Settings, tier: str) -> None:
    chosen = choose_methods(accuracy_budget(settings(f"accuracy={tier}").accuracy), counts_electrons=True)

    assert [one.partition(":")[0] for one in chosen] == list(STAGES)


def test_unlimited_budget_chooses_cheapest_method_of_every_stage() -> None:
    assert choose_methods(ALL, counts_electrons=False) == tuple(
        methods_of_stage(stage)[0].spelled for stage in STAGES if stage not in ("shot", "effects")
    )


def test_normals_replace_counts_if_the_budget_allows() -> None:
    assert "shot:gaussian_where_near" in choose_methods(ALL, counts_electrons=True)
    assert "shot:inversion" in choose_methods(replace(ALL, law_distance=0.0), counts_electrons=True)


@given(
    dn=st.sampled_from([0.0, 0.5, 1.0, 2.0]),
    share=st.sampled_from([0.0, 1e-4, 1e-3, 1.0]),
    normal=st.sampled_from([1.5e-7, 1e-6, 1e-3, 1.0]),
    distance=st.sampled_from([0.0, 5e-3]),
)
def test_chosen_methods_fit_and_nothing_cheaper_does(dn: float, share: float, normal: float, distance: float) -> None:
    some = Budget("some", False, dn, share, normal, distance)
    chosen = [method(*spelled.split(":")) for spelled in choose_methods(some, counts_electrons=False)]
    cheaper = IMPLEMENTATIONS[: IMPLEMENTATIONS.index(chosen[0].implementation)]

    assert len({one.implementation for one in chosen}) == 1
    assert all(one.fits(some) for one in chosen)
    for form in cheaper:
        assert not all(one.fits(some) for one in METHODS if one.implementation == form)


def test_exact_tier_has_no_error_in_dn() -> None:
    chosen = set(choose_methods(EXACT, counts_electrons=True))

    assert all(one.clean_dn == 0 and not one.approximates_law for one in METHODS if one.spelled in chosen)


def test_noise_without_counts_has_no_shot_method() -> None:
    assert not any(one.startswith("shot:") for one in choose_methods(EXACT, counts_electrons=False))


def test_reference_tier_uses_numpy_methods_only(settings: Settings) -> None:
    chosen = choose_methods(accuracy_budget(settings("accuracy=reference").accuracy), counts_electrons=True)

    assert all(one.readable for one in METHODS if one.spelled in set(chosen))


def test_custom_budget_chooses_by_its_limits(settings: Settings) -> None:
    limits = ("accuracy.name=mine", "accuracy.normal_error=6e-4", "accuracy.clean_dn=1")
    own = accuracy_budget(settings(*limits, "accuracy.clean_changed_share=1e-3").accuracy)
    stricter = accuracy_budget(settings(*limits, "accuracy.clean_changed_share=1e-4").accuracy)

    assert "normal:polynomial_float32" in choose_methods(own, counts_electrons=False)
    assert "normal:quadratic_float64" in choose_methods(stricter, counts_electrons=False)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "accuracy.normal_error=1e-9",
            "accuracy.normal_error=1e-09: no method is that accurate; expected at least 1.5e-07",
        ),
        ("accuracy.clean_dn=-1", "accuracy.clean_dn=-1.0: expected a number of 0 or more"),
        ("accuracy.law_distance=nan", "accuracy.law_distance=nan: expected a number of 0 or more"),
        ("accuracy.name='a b'", "accuracy.name='a b': expected up to 100 letters"),
    ],
)
def test_impossible_budget_is_refused_with_smallest_error_possible(
    settings: Settings, override: str, message: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        validate_config(settings(override))

    assert str(refused.value).startswith(message)


@pytest.mark.parametrize("noise", ["noise=imx385_iso3200", "noise=nikon_d850"])
def test_plan_contains_the_methods_of_its_tier(settings: Settings, noise: str, scene: np.ndarray) -> None:
    config = settings(noise, "accuracy=fast")
    plan = plan_image(config, "ab" * 32, 0, facts_for(config, scene))

    assert (plan.accuracy, plan.law_distance) == ("fast", 5e-3)
    assert plan.methods == choose_methods(accuracy_budget(config.accuracy), noise == "noise=nikon_d850")


@pytest.mark.parametrize("noise", ["noise=imx385_iso3200", "noise=sony_a7s2"])
def test_reference_and_exact_give_equal_pairs(settings: Settings, noise: str, scene: np.ndarray) -> None:
    plans = {}
    for tier in ("reference", "exact"):
        config = settings(noise, f"accuracy={tier}")
        plans[tier] = plan_image(config, "ab" * 32, 0, facts_for(config, scene))
    readable, fused = (make_pair(scene[:24, :31], plan) for plan in plans.values())

    assert np.array_equal(readable.clean, fused.clean)
    assert np.array_equal(readable.noisy, fused.noisy)
    assert readable.counts == fused.counts


def test_reference_tier_uses_the_exact_table_of_the_curve(
    settings: Settings, scene: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last bit of the formulas differs between machines."""
    plan = plan_image(settings("accuracy=reference"), "ab" * 32)
    monkeypatch.setattr("unprocess_gen.simulation.reference.unprocess.linear_light", None)

    make_pair(scene[:4, :4], plan)
    with pytest.raises(TypeError):
        reference_pair(scene[:4, :4], plan)


# Normal instead of Poisson distribution -------------------------------------------------------------------------------


@given(read_std_e=st.floats(0.0, 30.0), law_distance=st.floats(1e-4, 0.05), rate_e=st.floats(0.0, 1e6))
def test_normals_are_used_exactly_where_distance_allows(read_std_e: float, law_distance: float, rate_e: float) -> None:
    below, above = gaussian_from(read_std_e, law_distance)
    within = gaussian_distance(rate_e, read_std_e) <= law_distance
    near = any(math.isclose(rate_e, edge, rel_tol=1e-9, abs_tol=1e-9) for edge in (below, above))

    assert near or within == (rate_e <= below or rate_e >= above)


def test_budget_of_zero_uses_counts_everywhere() -> None:
    assert gaussian_from(3.0, 0.0) == (0.0, math.inf)


def test_strong_read_noise_allows_normals_everywhere() -> None:
    below, above = gaussian_from(6.0, 5e-3)

    assert below == above


@pytest.mark.parametrize(("rate_e", "read_std_e"), [(20.0, 1.0), (50.0, 3.0), (200.0, 2.0), (30.0, 6.0)])
def test_distance_is_largest_difference_of_the_two_cdfs(rate_e: float, read_std_e: float) -> None:
    """Compare with numerical integration: a normal density for each count, and one normal density of equal variance."""
    grid = np.linspace(rate_e - 12 * math.sqrt(rate_e + 36), rate_e + 14 * math.sqrt(rate_e + 36), 40001)
    counts = np.arange(0, int(rate_e + 20 * math.sqrt(rate_e) + 20))
    log_shares = counts * math.log(rate_e) - rate_e - np.array([math.lgamma(k + 1) for k in counts])

    def normal(x: np.ndarray, variance: float) -> np.ndarray:
        return np.asarray(np.exp(-x * x / (2 * variance)) / math.sqrt(2 * math.pi * variance))

    with np.errstate(under="ignore"):  # far from the mean a normal comes to nothing
        mixture = np.zeros_like(grid)
        for k, log_share in zip(counts, log_shares, strict=True):
            mixture += math.exp(log_share) * normal(grid - k, read_std_e**2)
        alone = normal(grid - rate_e, rate_e + read_std_e**2)
        distance = float(np.abs(np.cumsum(mixture - alone)).max() * (grid[1] - grid[0]))

    assert gaussian_distance(rate_e, read_std_e) == pytest.approx(distance, rel=0.12)


def tukey_cdf(x: np.ndarray, shape: float, std: float) -> np.ndarray:
    """Return the distribution function of Tukey's lambda distribution by inverting its quantiles on a grid."""
    tails = np.logspace(-14, -3, 2000)
    p = np.concatenate([tails, np.linspace(1e-3, 1 - 1e-3, 8001)[1:-1], 1 - tails[::-1]])
    quantiles = np.log(p / (1 - p)) if shape == 0 else (p**shape - (1 - p) ** shape) / shape
    with localcontext(prec=40):
        return np.asarray(np.interp(x, quantiles * (std / float(tukey_std(shape))), p))


def distance_with_tukey(rate_e: float, shape: float, read_std_e: float) -> float:
    """Return the largest CDF difference between counts and a normal with their mean and variance, both with read noise.

    The difference of the distribution functions of the counts and the normal is convolved with the read noise.
    """
    steps, reach = 32, int(10 * math.sqrt(rate_e) + 12)
    counts = np.arange(max(math.floor(rate_e) - reach, 0), math.floor(rate_e) + reach + 1)
    log_shares = counts * math.log(rate_e) - rate_e - np.array([math.lgamma(k + 1) for k in counts])
    low = math.floor(rate_e) - reach
    x = low + (np.arange(2 * reach * steps) + 0.5) / steps
    with np.errstate(under="ignore"):
        cumulated = np.concatenate([[0.0], np.cumsum(np.exp(log_shares))])
        normal = np.array([0.5 * math.erfc(-(one - rate_e) / math.sqrt(2 * rate_e)) for one in x])
    of_counts = cumulated[np.clip(np.floor(x).astype(int) - counts[0] + 1, 0, counts.size)]
    edges = (np.arange(int(-(12 * read_std_e + 10) * steps), int((12 * read_std_e + 10) * steps) + 2) - 0.5) / steps
    weights = np.diff(tukey_cdf(edges, shape, read_std_e))
    size = 2 ** math.ceil(math.log2(x.size + weights.size))
    with np.errstate(under="ignore"):
        spectrum = np.fft.rfft(of_counts - normal, size) * np.fft.rfft(weights, size)
        return float(np.abs(np.fft.irfft(spectrum, size)).max())


def law_plan(settings: Settings, law: str, shape: float, read_std_e: float, law_distance: float) -> Plan:
    plan = plan_image(settings("noise=nikon_d850", "accuracy=fast"), "0" * 64, facts=Facts(64, 48, 256, 0, 255))
    assert plan.physics is not None
    physics = replace(plan.physics, read_law=law, read_shape=shape, read_std_dn=read_std_e * plan.physics.dn_per_e)
    return replace(plan, physics=physics, effects=("shot", "read"), law_distance=law_distance)


def limits_of(plan: Plan) -> tuple[float, float]:
    """Return the means up to which, and from which, the kernel draws normals."""
    assert plan.physics is not None
    low, high = count_roots(plan, plan.physics.read_std_dn / plan.physics.dn_per_e, counts_all=False)
    return low**2, high**2


@pytest.mark.parametrize("law_distance", slow_except((5e-3,), (1e-3, 5e-3, 0.02)))
@pytest.mark.parametrize("shape", [0.3, 0.1571, 0.0, -0.1, -0.2143, -0.2429, -0.3, -0.4, -0.45])
def test_law_distance_holds_for_tukey_read_noise(settings: Settings, shape: float, law_distance: float) -> None:
    """Test means next to the limits, from the least read noise with which normals are drawn."""
    for core_std_e in (0.501, 0.6, 1.0, 3.0, 8.0):
        read_std_e = core_std_e / core_share(shape)
        below, above = limits_of(law_plan(settings, "tukey_lambda", shape, read_std_e, law_distance))
        assert above < math.inf
        rates = (below, 0.5 * below, above, 1.3 * above) if below < above else (0.1, 1.0, 10.0, 100.0)
        for rate_e in rates:
            if 1e-2 < rate_e < 5000:
                assert distance_with_tukey(rate_e, shape, read_std_e) <= law_distance, (read_std_e, rate_e)


def test_law_of_0_1_exceeds_the_law_distance_near_half_an_electron(settings: Settings) -> None:
    """Its limits are those of normal read noise, on which the bytes of recorded datasets depend."""
    below, above = limits_of(law_plan(settings, "tukey", -0.2429, 0.5, 5e-3))
    assert (below, above) == pytest.approx(gaussian_from(0.5, 5e-3), rel=1e-12)
    assert distance_with_tukey(above, -0.2429, 0.5) == pytest.approx(0.0068, rel=0.03)


@pytest.mark.parametrize(("shape", "read_std_e"), [(0.31, 5.0), (1.0, 5.0), (0.0, 0.6), (-0.2429, 0.9)])
def test_counts_are_drawn_where_no_normal_is_near(settings: Settings, shape: float, read_std_e: float) -> None:
    assert limits_of(law_plan(settings, "tukey_lambda", shape, read_std_e, 5e-3)) == (0.0, math.inf)


def test_methods_of_each_stage_are_in_order_of_cost() -> None:
    """Cheapest first; the NumPy reference is last and always exists."""
    for stage in STAGES:
        forms = [IMPLEMENTATIONS.index(one.implementation) for one in methods_of_stage(stage)]
        assert forms == sorted(forms)
        assert forms[-1] == IMPLEMENTATIONS.index("numpy")


def test_names_of_methods_are_unique() -> None:
    assert len({one.spelled for one in METHODS}) == len(METHODS)
    assert all(replace(one, meaning="") != one for one in METHODS)


@pytest.mark.parametrize(
    "steep",
    ["gains.threshold=0.999", "gains.red=0.05", "camera=custom camera.xyz2cam=[1,0,0,0,0,1,1,-0.94,0]"],
)
def test_plans_that_amplify_rounding_errors_use_float64(settings: Settings, steep: str) -> None:
    chosen = [
        plan_image(settings("accuracy=fast", "noise=imx385_iso3200", *words), "0" * 64).methods
        for words in ([], steep.split())
    ]

    assert "colour:fused_float32" in chosen[0]
    assert "colour:fused_float64" in chosen[1]
