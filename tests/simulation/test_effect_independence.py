"""Contributions of effects to a frame are uncorrelated; `test_testing` checks that none changes another."""

from __future__ import annotations

import itertools

import numpy as np
from helpers.flats import bounds_off, noisy_dn, plan_with, signal_dn
from helpers.promise_report import Figure


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
