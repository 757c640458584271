"""Choice of methods by a budget of errors. The error statements of the methods are tested with their kernels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.datasets import Settings
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.accuracy import (
    IMPLEMENTATIONS,
    METHODS,
    STAGES,
    choose_methods,
    methods_of_stage,
)
from unprocess_gen.config.schema import AccuracyConfig
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.sources.scenes import synthetic

METHODS_BY_NAME = {method.spelled: method for method in METHODS}
EXACT = AccuracyConfig("exact", False, 0.0, 0.0, 1e-6)
ALL = AccuracyConfig("anything", False, math.inf, 1.0, math.inf)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return np.ascontiguousarray(synthetic.scene("gradients-0")[300:324, 400:431])


# Chosen methods -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tier", ["reference", "exact", "fast"])
def test_each_tier_has_a_method_for_every_stage(settings: Settings, tier: str) -> None:
    chosen = choose_methods(settings(f"accuracy={tier}").accuracy, counts_electrons=True)

    assert [one.partition(":")[0] for one in chosen] == list(STAGES)


def test_unlimited_budget_chooses_cheapest_method_of_every_stage() -> None:
    assert choose_methods(ALL, counts_electrons=False) == tuple(
        methods_of_stage(stage)[0].spelled for stage in STAGES if stage not in ("shot", "effects")
    )


@given(
    dn=st.sampled_from([0.0, 0.5, 1.0, 2.0]),
    share=st.sampled_from([0.0, 1e-4, 1e-3, 1.0]),
    normal=st.sampled_from([1.5e-7, 1e-6, 1e-3, 1.0]),
)
def test_chosen_methods_fit_and_nothing_cheaper_does(dn: float, share: float, normal: float) -> None:
    some = AccuracyConfig("some", False, dn, share, normal)
    chosen = [METHODS_BY_NAME[spelled] for spelled in choose_methods(some, counts_electrons=False)]
    cheaper = IMPLEMENTATIONS[: IMPLEMENTATIONS.index(chosen[0].implementation)]

    assert len({one.implementation for one in chosen}) == 1
    assert all(one.fits(some) for one in chosen)
    for form in cheaper:
        assert not all(one.fits(some) for one in METHODS if one.implementation == form)


def test_exact_tier_has_no_error_in_dn() -> None:
    chosen = set(choose_methods(EXACT, counts_electrons=True))

    assert all(one.clean_dn == 0 for one in METHODS if one.spelled in chosen)


def test_noise_without_counts_has_no_shot_method() -> None:
    assert not any(one.startswith("shot:") for one in choose_methods(EXACT, counts_electrons=False))


def test_reference_tier_uses_numpy_methods_only(settings: Settings) -> None:
    chosen = choose_methods(settings("accuracy=reference").accuracy, counts_electrons=True)

    assert all(one.readable for one in METHODS if one.spelled in set(chosen))


def test_custom_budget_chooses_by_its_limits(settings: Settings) -> None:
    limits = ("accuracy.name=mine", "accuracy.normal_error=6e-4", "accuracy.clean_dn=1")
    own = settings(*limits, "accuracy.clean_changed_share=1e-3").accuracy
    stricter = settings(*limits, "accuracy.clean_changed_share=1e-4").accuracy

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

    assert plan.accuracy.name == "fast"
    assert plan.accuracy.methods == choose_methods(config.accuracy, noise == "noise=nikon_d850")


def test_reference_tier_uses_the_exact_table_of_the_curve(
    settings: Settings, scene: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last bit of the formulas differs between machines."""
    plan = plan_image(settings("accuracy=reference"), "ab" * 32)
    monkeypatch.setattr("unprocess_gen.simulation.reference.unprocess.linear_light", None)

    make_pair(scene[:4, :4], plan)
    with pytest.raises(TypeError):
        reference_pair(scene[:4, :4], plan)


# Order of methods -----------------------------------------------------------------------------------------------------


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
        plan_image(settings("accuracy=fast", "noise=imx385_iso3200", *words), "0" * 64).accuracy.methods
        for words in ([], steep.split())
    ]

    assert "colour:fused_float32" in chosen[0]
    assert "colour:fused_float64" in chosen[1]
