"""Modules that a run imports, and memory that a worker keeps."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.datasets import Make
from helpers.promise_report import Figure

RUN = """
import sys
from unprocess_gen.cli.main import main
assert main() == 0
print(*sys.modules)
"""

UNUSED = {"joblib", "asyncio", "matplotlib", "PIL", "jinja2"}
"""Modules that are slow or large to import, and that a run of one job from a folder of photographs does not use."""


def imported(*arguments: str) -> set[str]:
    """Run the command in its own process, and return the modules that are imported at the end."""
    done = subprocess.run([sys.executable, "-c", RUN, *arguments], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_run_imports_no_unused_module(photos: Path, make: Make, tmp_path: Path, figure: Figure) -> None:
    make(photos, tmp_path / "before")  # compiles kernels that are not cached
    no_webp = "source.include=['*.jpg','*.png','*.tif','*.bmp']"  # Pillow reads the headers of WebP
    unused = imported(f"out={tmp_path / 'ds'}", f"source.root={photos}", "n_jobs=1", no_webp) & UNUSED
    assert not unused
    figure("start", f"{len(unused)} of {len(UNUSED)} libraries imported without need")


def test_help_and_version_import_nothing_slow() -> None:
    slow = {"hydra", "omegaconf", "numpy", "numba", "cv2", "joblib", "PIL", "yaml", "tqdm"}
    for argument in ("--help", "--version"):
        assert not imported(argument) & slow
    assert not imported("verify", "--help") & slow


KEEPING = """
import resource
import numpy as np
from unprocess_gen.pipeline.worker import keep_memory
def faults():
    counts = []
    for _ in range(9):
        array = np.ones(40_000_000, dtype=np.uint8)
        del array
        counts.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
    return counts[-1] - counts[0]
given_back = faults()
keep_memory()
print(given_back, faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_worker_reuses_memory_of_the_previous_image() -> None:
    done = subprocess.run([sys.executable, "-c", KEEPING], capture_output=True, text=True, check=True)
    given_back, kept = map(int, done.stdout.split())
    assert kept < 40 <= given_back / 4
