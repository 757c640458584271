"""Quotas of control groups limit the cores, of whichever group they are."""

from __future__ import annotations

from pathlib import Path

import pytest

from unprocess_gen.pipeline.executors import cores

GROUPS = {
    "none": ("0::/", {"cpu.max": "max 100000"}, 8),
    "of the container": ("0::/", {"cpu.max": "150000 100000"}, 2),
    "of a slice": ("0::/a.slice/b.scope", {"a.slice/cpu.max": "300000 100000", "a.slice/b.scope/cpu.max": "max 9"}, 3),
    "of the step of a job": ("0::/a/b", {"a/cpu.max": "400000 100000", "a/b/cpu.max": "50000 100000"}, 1),
    "larger than the affinity": ("0::/", {"cpu.max": "9900000 100000"}, 8),
    "first version": ("2:cpu,cpuacct:/d", {"cpu/d/cpu.cfs_quota_us": "250000", "cpu/d/cpu.cfs_period_us": "100000"}, 3),
    "first version, path outside": ("1:cpu:/docker/x", {"cpu/cpu.cfs_quota_us": "9", "cpu/cpu.cfs_period_us": "9"}, 1),
    "first version, no link": ("4:cpu,x:/d", {"cpu,x/cpu.cfs_quota_us": "20", "cpu,x/cpu.cfs_period_us": "10"}, 2),
    "first version, none": ("1:cpu:/", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 8),
    "of another controller": ("1:cpuset:/", {"cpu.max": "100000 100000"}, 8),
    "unreadable": ("nothing", {"cpu.max": "100000 100000"}, 8),
}


@pytest.mark.parametrize("case", GROUPS)
def test_quota_limits_cores(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "own_cores", lambda: 8)
    groups, quotas, expected = GROUPS[case]
    files = {"proc/self/cgroup": groups} | {f"sys/fs/cgroup/{name}": text for name, text in quotas.items()}
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"{text}\n")
    assert cores.usable_cores(tmp_path) == expected
