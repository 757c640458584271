"""The benchmark of goals runs, and its yardsticks sample the noise that the package simulates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from benchmarks import bench_goals as goals

from unprocess_gen.core.types import Plan, Srgb
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference.cfa import pack


@pytest.fixture(scope="module")
def frame() -> Srgb:
    """Return a crop of each synthetic scene of the frame."""
    return np.ascontiguousarray(goals.synthetic_frame()[::8, ::8])


def test_every_goal_is_measured(frame: Srgb) -> None:
    rows = goals.measured_rows(goals.Bench(frame, patch_side=16), rounds=2, least_ns=0)
    lines = goals.table(rows).splitlines()
    assert len(lines) == 2 + len(rows)
    assert all(len(row.ratios) == 2 for row in rows)
    assert {line.count("|") for line in lines} == {8}


@pytest.mark.parametrize(
    ("settings", "sample"),
    [
        *((settings, goals.sample_eld) for settings in goals.ELD_LAW.values()),
        *((settings, goals.sample_pmn) for settings in goals.PMN_LAW.values()),
    ],
)
def test_yardsticks_sample_the_simulated_noise(settings: str, sample: Callable[[np.ndarray, Plan], np.ndarray]) -> None:
    """Compare mean and variance of a flat in each CFA plane; tolerances exceed five standard errors."""
    flat = np.full((512, 512, 3), 200, dtype=np.uint8)
    (plan,) = goals.Bench(flat).plans(settings)
    np.random.seed(1)
    span_dn = plan.white_level_dn - plan.black_level_dn
    yardstick_dn = sample(goals.packed_light(flat, plan), plan) * span_dn + plan.black_level_dn
    noisy_dn = pack(make_pair(flat, plan).noisy, plan.pattern)
    for ours, theirs in zip(noisy_dn, yardstick_dn, strict=True):
        assert abs(ours.mean() - theirs.mean()) < 0.05 * theirs.std()
        assert ours.var() == pytest.approx(theirs.var(), rel=0.1)
