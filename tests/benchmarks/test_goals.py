"""The benchmark of goals runs."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import bench_goals as goals


@pytest.mark.slow
def test_every_ratio_is_measured() -> None:
    frame = np.ascontiguousarray(goals.synthetic_frame()[::8, ::8])
    bench = goals.Bench(frame, patch_side=16)
    lines = goals.table([bench], rounds=2, least_ns=0).splitlines()

    assert len(lines) == 2 + len(list(bench.rows()))
    assert {line.count("|") for line in lines} == {6}
