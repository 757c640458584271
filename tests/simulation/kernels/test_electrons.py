"""Pairs with counts of electrons equal the reference, with every profile, effect and saturation."""

from __future__ import annotations

import itertools
from typing import Any, cast

import pytest
from helpers.cases import slow_except
from helpers.datasets import Settings
from helpers.flats import (
    ISOS,
    assert_same,
    picture,
    planned,
    with_physics,
)

from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS as EFFECTS
from unprocess_gen.simulation.kernels.electrons import Electrons
from unprocess_gen.simulation.kernels.render import _render
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import Plan

TWO_NUMBERS = {
    "imx385_iso1600": (), "imx385_iso3200": (), "imx385_iso25600": (), "brooks2019": (), "none": (),
    "heteroscedastic": ("noise.a=0.7", "noise.b=2.5"),
}  # fmt: skip


# Kernels against the reference ----------------------------------------------------------------------------------------


SCENES = ("daylight", "low_light", "long_exposure")
QUICK = (*(("nikon_d850", scene) for scene in SCENES), ("imx385", "daylight"))


@pytest.mark.parametrize(("noise", "scene"), slow_except(QUICK, itertools.product(ISOS, SCENES)))
def test_kernels_equal_reference_for_every_profile_and_scene(settings: Settings, noise: str, scene: str) -> None:
    group = (f"noise={noise}", f"scene={scene}", f"noise.iso={ISOS[noise]}")
    for forced, fixed in itertools.product([False, True], ["false", "true"]):
        plan = planned(settings, picture(), *group, f"clean.includes_fixed_pattern={fixed}", forced=forced)
        assert set(EFFECTS) == set(plan.noise.effects) or not forced
        for saturated in ("noisy", "white"):
            assert_same(picture(), plan.replace(saturated_as=saturated))


@pytest.mark.parametrize("noise", TWO_NUMBERS)
def test_kernels_equal_reference_for_poisson_form_of_every_profile(settings: Settings, noise: str) -> None:
    plan = planned(settings, picture(), f"noise={noise}", *TWO_NUMBERS[noise], "noise.law=poisson")
    for saturated, clip in itertools.product(["noisy", "white"], ["sensor", "black"]):
        assert_same(picture(), plan.replace(saturated_as=saturated, sensor_clip=clip))


@pytest.fixture(scope="module")
def everything(settings: Settings) -> Plan:
    """Return a plan with every effect on, for images of any size."""
    group = ("noise=nikon_d850", "scene=long_exposure", "noise.iso=1600")
    return with_physics(planned(settings, picture(), *group, forced=True), frame_size=(4096, 4096))


def test_correlated_rows_use_the_machine_code_of_other_noise(everything: Plan) -> None:
    """A signature of its own takes three seconds to compile for each dtype of codes and frames."""
    for correlation in (0.0, 0.5):
        make_pair(picture(), with_physics(everything, row_correlation=correlation))
    electrons = [noise for _, _, noise, *_ in cast(Any, _render).signatures if noise.instance_class is Electrons]
    assert len({str(noise) for noise in electrons}) == 1
