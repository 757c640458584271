"""Exposure ratios darken the scene before the sensor; saturated sites are noisy or pinned."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.datasets import Settings
from helpers.flats import BLACK, WHITE, bounds_off, flat, plan_with, planned, poisson_reach, signal_dn
from helpers.moments import REACH

from unprocess_gen.simulation.pair import make_pair

# Exposure -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0, 100.0])
def test_exposure_ratio_darkens_scene_before_sensor(ratio: float) -> None:
    plan = plan_with("shot", "read", read_std_dn=50.0).replace(exposure_ratio=ratio)
    pair = make_pair(flat(24000), plan)
    signal = signal_dn(24000) / ratio
    assert (pair.clean == round(signal + BLACK)).all()
    variance = 8 * signal + 50**2 + 1 / 12
    reach = 8 * poisson_reach(signal / 8) + REACH * 50 + 1
    deviation = pair.noisy.astype(np.float64) - BLACK - signal
    assert bounds_off(deviation, 0, variance, reach) <= 1
    assert bounds_off(deviation**2, variance, 2 * variance**2 + 8**3 * signal, reach**2) <= 1


# Saturation -----------------------------------------------------------------------------------------------------------

WHITES = {
    "gaussian": plan_with().replace(physics=None, effects=("heteroscedastic", "quantise"), a_dn=8.0, b_dn2=900.0),
    "poisson": plan_with().replace(
        physics=None, effects=("heteroscedastic", "quantise"), a_dn=8.0, b_dn2=900.0, noise_law="poisson"
    ),
    "physical": plan_with("shot", "read", "row", read_std_dn=30.0, row_std_dn=5.0),
}


@pytest.mark.parametrize("distribution", WHITES)
def test_noise_of_saturated_sites_is_clipped_at_white(distribution: str) -> None:
    frame = make_pair(flat(65535), WHITES[distribution]).noisy
    assert 0.49 < (frame == WHITE).mean() < 0.52
    assert frame.mean() < WHITE - 200  # (8·61439 + 900)**½ / (2π)**½ is 280


@pytest.mark.parametrize("bits", [12, 14, 16])
def test_physical_noise_keeps_the_mean_of_white_areas(bits: int, settings: Settings) -> None:
    """With saturated=noisy half of the noise is cut off, and the mean is below white."""
    chosen = ("noise=sony_a7s2", "noise.iso=6400", f"sensor=generic_{bits}bit", "gains=unity")
    free, decided = (
        make_pair(flat(65535), planned(settings, flat(65535), *chosen, f"sensor.saturated={saturated}"))
        for saturated in ("noisy", "auto")
    )
    white = 2**bits - 1
    assert (decided.clean == white).all()
    assert float(decided.noisy.mean()) == white
    assert float(free.noisy.mean()) < white - 8 * 2 ** (bits - 12)


@pytest.mark.parametrize("distribution", WHITES)
def test_pinning_changes_saturated_sites_only(distribution: str) -> None:
    srgb = np.where(np.random.Generator(np.random.Philox(key=5)).random((200, 300, 1)) < 0.3, 65535, 65000)
    srgb = np.broadcast_to(srgb, (200, 300, 3)).astype(np.uint16)
    free, pinned = (
        make_pair(srgb, WHITES[distribution].replace(saturated_as=saturated)) for saturated in ("noisy", "white")
    )
    white = free.clean == WHITE
    assert 0 < white.mean() < 1
    np.testing.assert_array_equal(free.clean, pinned.clean)
    assert (pinned.noisy[white] == WHITE).all()
    np.testing.assert_array_equal(pinned.noisy[~white], free.noisy[~white])


def test_noise_behind_a_full_well_remains(settings: Settings) -> None:
    """``canon_70d`` saturates below white at ISO 100: the electrons end, read noise and dead pixels come after it."""
    chosen = ("noise=canon_70d", "noise.iso=100", "scene=daylight", "sensor=generic_14bit", "gains=unity")
    defects = ("effects.dead_pixels=on", "noise.dead_pixel_share=1e-3", "effects.prnu=off")
    plan = planned(settings, flat(65535), *chosen, *defects)
    pair = make_pair(flat(65535), plan)
    physics = plan.physics
    assert physics is not None and "full_well" in plan.noise.effects
    well_dn = plan.sensor.black_level_dn + physics.full_well_e * physics.dn_per_e
    assert (pair.clean == round(well_dn)).all()
    assert pair.counts.saturated == pair.clean.size
    dead = pair.noisy == plan.sensor.black_level_dn
    assert 0.2e-3 < dead.mean() < 5e-3
    difference = pair.noisy[~dead] - well_dn
    shot_dn2 = physics.dn_per_e**2 * physics.full_well_e
    count, behind_dn2 = difference.size, physics.read_std_dn**2 + physics.row_std_dn**2 + 1 / 12
    assert behind_dn2 * (1 - 6 * math.sqrt(2 / count)) < difference.var() < behind_dn2 + 0.341 * shot_dn2 * 1.2
    assert float(difference.mean()) > -math.sqrt(shot_dn2)


@pytest.mark.parametrize("accuracy", ["exact", "fast"])
def test_light_above_white_is_counted_whatever_the_exposure_ratio(accuracy: str, settings: Settings) -> None:
    """It is clipped before the ratio divides it, so the darkened frame has a plateau, whose sites are these."""
    srgb = np.random.Generator(np.random.Philox(key=7)).integers(180, 256, (96, 130, 3), dtype=np.uint8)
    counts = {}
    for ratio in (1, 10):
        chosen = ("noise=none", "gains=fig6_bottom", f"accuracy={accuracy}", f"scene.exposure_ratio={ratio}")
        counts[ratio] = make_pair(srgb, planned(settings, srgb, *chosen)).counts
    assert 0 < counts[1].clean_clipped_high == counts[10].light_clipped_high
    assert counts[1].light_clipped_high is None
    assert counts[10].clean_clipped_high == 0
