"""Omitting an effect changes no value of another effect."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers.flats import SILENT, bounds_off, dead, flat, noisy_dn, plan_with, signal_dn
from helpers.promise_report import Figure

from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS as EFFECTS
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference import electrons

COUNTED = {"dark_e": 3.0, "hot_pixel_share": 0.3, "hot_pixel_e": 20.0, "dn_per_e": 16.0}


@pytest.mark.parametrize("effect", ["shot", "dark_current", "hot_pixels"])
def test_omitted_effect_in_electrons_changes_no_other_effect(effect: str, figure: Figure) -> None:
    """Electrons and DN are integers, so that the contribution of an effect is exact."""
    others = [one for one in ("shot", "dark_current", "hot_pixels") if one != effect]

    def frame(*on: str) -> np.ndarray:
        plan = plan_with(*on, **COUNTED).replace(black_level_dn=0)
        return make_pair(flat(8000, 256, 256), plan).noisy.astype(np.int64)

    alone = frame(effect) - frame()
    assert (alone != 0).any()
    assert (frame(*(one for one in EFFECTS if one in {effect, *others})) - frame(*others) == alone).all()
    figure("effects", f"{effect}: other effects unchanged at {alone.size} of {alone.size} sites")


ALL = {
    **COUNTED, "prnu_std": 0.02, "read_law": "tukey_lambda", "read_std_dn": 7.5, "row_std_dn": 3.3,
    "column_std_dn": 2.2, "black_error_dn": (1.5, 0.25, -3.125, 2.0), "dead_pixel_share": 0.1, "full_well_e": 1e5,
}  # fmt: skip


@pytest.mark.parametrize("effect", ["read", "row", "column", "black_error"])
def test_omitted_effect_in_dn_removes_only_its_values(effect: str) -> None:
    clean_dn = np.full((64, 96), 20000.0)
    on = [one for one in EFFECTS[:-1] if one != "dead_pixels"]
    with_it = electrons.noisy(clean_dn, plan_with(*on, **ALL))
    without = electrons.noisy(clean_dn, plan_with(*(one for one in on if one != effect), **ALL))
    alone = electrons.noisy(clean_dn, plan_with(effect, **ALL)) - clean_dn
    assert np.abs(alone).max() > 1
    np.testing.assert_allclose(with_it - without, alone, rtol=0, atol=1e-10)


def test_omitted_dead_pixels_change_no_other_pixel() -> None:
    with_it, without = (
        make_pair(flat(20000, 64, 96), plan_with(*on, **ALL)).noisy for on in (EFFECTS[:-1], EFFECTS[:-2])
    )
    is_dead = dead(SILENT.replace(dead_pixel_share=0.1), (64, 96))
    assert (with_it[is_dead] == 0).all()
    assert (with_it[~is_dead] == without[~is_dead]).all()


def test_omitted_prnu_changes_nothing_in_the_dark() -> None:
    """With light it changes the mean of the shot noise."""
    with_it, without = (make_pair(flat(0, 64, 96), plan_with(*on, **ALL)).noisy for on in (EFFECTS[:-1], EFFECTS[1:-1]))
    np.testing.assert_array_equal(with_it, without)


def test_full_well_above_signal_changes_nothing() -> None:
    on = [one for one in EFFECTS[:-1] if one != "full_well"]
    with_it, without = (make_pair(flat(20000, 64, 96), plan_with(*one, **ALL)).noisy for one in (EFFECTS[:-1], on))
    np.testing.assert_array_equal(with_it, without)


def test_effects_of_frame_are_uncorrelated(figure: Figure) -> None:
    """Check the correlations between contributions of single effects."""
    added = []
    for effect in ("shot", "dark_current", "read"):
        plan = plan_with(effect, dark_e=500.0, read_std_dn=200.0, dark_offset="removed")
        frame = noisy_dn(plan, 30000) - signal_dn(30000)
        added.append(frame / frame.std())
    for one, other in itertools.combinations(added, 2):
        assert bounds_off(one * other, 0, 1.05, 50) <= 1
    largest = max(abs(float(np.mean(a * b))) for a, b in itertools.combinations(added, 2))
    figure("effects", f"largest correlation of two effects: {largest:.1g}")
