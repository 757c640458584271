"""Local workers run in a pool of joblib, whose own warnings about its processes do not concern users."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import joblib
import pytest

import unprocess_gen as ug
from unprocess_gen.pipeline.executors import local

LOKY = "joblib.externals.loky.process_executor"


@pytest.mark.parametrize(
    "message", ["A worker stopped while some jobs were given to the executor.", "3 tasks which were still running"]
)
def test_warnings_of_the_pool_are_hidden(message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Pool:
        def __init__(self, **_: object) -> None:
            pass

        def __call__(self, calls: Any) -> Iterator[object]:
            warnings.warn_explicit(message, UserWarning, "process_executor.py", 1, module=LOKY)
            yield "report"

    monkeypatch.setattr(joblib, "Parallel", Pool)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        context: Any = None
        assert [*local._run_pool(context, [], 2)] == ["report"]


def test_workers_of_an_earlier_run_follow_to_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        ug.generate(ug.load_config(["source.limit=2", "output.pairs_per_shard=1", "n_jobs=2", "out=ds"]))
    first, second = (sorted((tmp_path / name / "ds" / "shards").iterdir()) for name in ("first", "second"))
    assert [path.name for path in first] == [path.name for path in second]
    assert len(second) == 2


TRACKER = """
from joblib.externals.loky.backend import resource_tracker
from unprocess_gen.pipeline.executors import local

local.start_tracker()
resource_tracker.unregister("/unknown", "semlock")
"""


def test_tracker_of_the_pool_prints_no_traceback() -> None:
    """The deaths of workers leave resources that loky's tracker no longer knows."""
    done = subprocess.run([sys.executable, "-c", TRACKER], capture_output=True, text=True, check=True)
    assert done.stderr == ""
