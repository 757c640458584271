"""Leave out tests that need Linux on other systems: modules by a table, single tests by the marker ``linux_only``."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]

MODULES = {
    "cli/test_messages.py": "writes to /dev/full, sends SIGHUP",
    "pipeline/test_faults.py": "stops and kills processes found in /proc, mounts small disks",
    "pipeline/test_refusals.py": "limits the address space",
    "pipeline/test_resume.py": "kills processes found in /proc",
    "project/test_everywhere.py": "replaces libraries of the Linux loader, reads /proc",
    "sources/test_hostile_files.py": "limits the address space",
    "sources/test_listing.py": "makes pipes, devices and links",
}
"""Test files, and why they are left out elsewhere. Some cannot be imported there."""


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out the files of `MODULES`; None lets pytest decide."""
    if sys.platform == "linux" or not collection_path.is_relative_to(TESTS):
        return None
    return True if collection_path.relative_to(TESTS).as_posix() in MODULES else None


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a marked test."""
    marker = item.get_closest_marker("linux_only")
    if marker is not None and sys.platform != "linux":
        pytest.skip(f"needs Linux: {marker.args[0]}")
