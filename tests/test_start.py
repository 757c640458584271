"""Modules that a run loads before its first pair."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

RUN = """
import sys
from unprocess_gen.cli import main as cli
assert cli.main() == 0
print(*sys.modules)
"""

NEVER = {"joblib", "asyncio", "matplotlib", "PIL", "av"}
"""Libraries that are slow to load and that a run of one job from a folder of photographs does not need."""


def run(*arguments: str) -> set[str]:
    """Run the tool in a process of its own; return the modules that it loaded."""
    command = [sys.executable, "-c", RUN, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_a_run_of_one_job_loads_no_optional_libraries(photos: Path, tmp_path: Path) -> None:
    assert not run(f"out={tmp_path / 'ds'}", f"source.root={photos}", "n_jobs=1") & NEVER
