"""Every code that the stated noise expects often does occur: counts of electrons leave no comb."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.captures import Camera, load_profile
from helpers.cases import slow_except

import unprocess_gen as ug
from unprocess_gen.simulation.effects.read import WIDEST_STEP_DN

PROFILES = ("imx385", "sony_a7s2", "nikon_d850", "canon_5d4", "canon_70d", "canon_700d", "oppo_reno10x")
LIGHTS = (0.03, 0.15, 0.5, 0.85)
SIDE, LEAST_SITES = 512, 150
"""Side of a flat, and mean sites of a code from which it is expected; a share of 0.45 has a probability of 1e-12."""


def isos(profile: str) -> list[float]:
    """Return the lowest, the base and the highest ISO of each gain mode."""
    branches = load_profile(profile).branches
    return sorted({float(iso) for branch in branches for iso in (*branch.iso, *[800] * (branch.iso[0] < 800))})


CASES = [(profile, iso, light) for profile in PROFILES for iso in isos(profile) for light in LIGHTS]
QUICK = {(profile, iso, light) for profile, iso, light in CASES if light == 0.15 and iso == isos(profile)[1]}
QUICK |= {("nikon_d850", 800.0, light) for light in LIGHTS} | {("sony_a7s2", 100.0, 0.15), ("sony_a7s2", 2000.0, 0.15)}


@pytest.mark.parametrize(("profile", "iso", "light"), slow_except(QUICK, CASES))
def test_every_expected_code_occurs(profile: str, iso: float, light: float) -> None:
    pair = Camera(profile, iso, SIDE, effects="auto").pair(light, 0.001, 0)
    has_read_noise = "read" in pair.plan.noise.effects
    assert has_read_noise or pair.plan.numbers.dn_per_e <= WIDEST_STEP_DN
    planes = [pair.noisy[y::2, x::2] for y in (0, 1) for x in (0, 1)]  # with a black error each
    counts, codes = np.bincount(pair.noisy.ravel()), np.arange(pair.noisy.max() + 1)
    std_dn = float(ug.noise_std(pair.clean[0, 0], pair.row))
    z = np.minimum(abs(codes - np.array([[plane.mean()] for plane in planes])) / std_dn, 9)
    expected = np.exp(-(z**2) / 2).sum(axis=0) * planes[0].size / std_dn / math.sqrt(2 * math.pi)
    is_expected = (expected >= LEAST_SITES) & (z.min(axis=0) < 1.5)  # the tails are skewed
    assert is_expected.sum() > std_dn
    assert (counts[is_expected] >= 0.45 * expected[is_expected]).all()
