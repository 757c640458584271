"""Count the cores that a process may use."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def own_cores() -> int:
    """Number of cores this process may use, regardless of its container's share of CPU time."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usable_cores(root: Path = Path("/")) -> int:
    """Number of cores this process may keep busy: those of its affinity, at most the quotas of its control groups."""
    return max(1, min([own_cores(), *map(math.ceil, _quotas(root))]))


def _quotas(root: Path) -> Iterator[float]:
    """Yield the quotas of CPU time, in cores, of the control groups of this process and of those above them.

    A container may see its own groups as the root of the hierarchy, while ``/proc`` states the path outside.
    """
    lines = []
    with suppress(OSError):  # no Linux
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    for controllers, path in (line.split(":", 2)[1:] for line in lines if line.count(":") >= 2):
        if controllers and "cpu" not in controllers.split(","):
            continue
        tops = [root / "sys/fs/cgroup" / name for name in (("cpu", controllers) if controllers else ("",))]
        group = Path(path.lstrip("/"))
        for folder in (top / part for top in tops for part in (group, *group.parents)):
            with suppress(OSError, ValueError, ZeroDivisionError):  # "max" is no number
                if controllers:
                    names = "cpu.cfs_quota_us", "cpu.cfs_period_us"
                    quota_us, period_us = (int((folder / name).read_text()) for name in names)
                else:
                    quota_us, period_us = map(int, (folder / "cpu.max").read_text().split())
                if quota_us > 0:  # -1: none
                    yield quota_us / period_us
