"""A run in parts on a real SLURM: an array, a killed part, a requeued part, and a merge that waits with afterany."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.commands import COMMAND, RunMain
from helpers.datasets import Make, TreeHash
from helpers.photographs import fill
from helpers.processes import ONE, imported_first, slow_shards, wait_for
from helpers.promise_report import Figure
from helpers.slurm import Slurm, find_binaries, running_slurm

from unprocess_gen.pipeline.verify import verify

BINARIES = find_binaries()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.linux_only("needs SLURM"),
    pytest.mark.skipif(BINARIES is None, reason="needs SLURM: programs on PATH, or SLURM_ROOT (helpers/slurm.py)"),
]

COUNT = 16

NOTED_SHARDS = f"""
{slow_shards(0.5)}
import os
from pathlib import Path


def noted(*given):
    Path("pids", os.environ.get("SLURM_ARRAY_TASK_ID", "")).write_text(str(os.getpid()))
    return slow(*given)


worker.make_shard = noted
"""
"""Module for `imported_first`: a shard takes half a second longer, and its process is noted in ``pids``."""


@pytest.fixture
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slurm]:
    assert BINARIES is not None
    with running_slurm(tmp_path_factory.mktemp("slurm"), BINARIES) as running:
        yield running


def test_array_with_killed_and_requeued_parts_ends_with_the_same_bytes(
    slurm: Slurm, make: Make, tree_hash: TreeHash, run_main: RunMain, tmp_path: Path, figure: Figure,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    make(fill(tmp_path / "p", COUNT), tmp_path / "undisturbed", ONE)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pids").mkdir()
    assert run_main("prepare", "parts=4", "source.root=p", ONE, "n_jobs=1", "out=ds").code == 0
    env = imported_first(tmp_path, NOTED_SHARDS)
    part, merge = tmp_path / "part.sh", tmp_path / "merge.sh"
    part.write_text(f"#!/bin/bash\nexport PYTHONPATH={env['PYTHONPATH']}\nexec {COMMAND} part ds\n")
    merge.write_text(f"#!/bin/bash\n{COMMAND} merge ds\necho exit $?\n")

    job = slurm.submit(part, "--array=0-3", "--requeue", "--output=part-%a.txt", "--open-mode=append", cwd=tmp_path)
    slurm.submit(merge, f"--dependency=afterany:{job}", "--output=merge-1.txt", cwd=tmp_path)
    wait_for(lambda: (tmp_path / "pids/0").exists() and (tmp_path / "pids/1").exists(), seconds=120)
    os.kill(int((tmp_path / "pids/0").read_text()), signal.SIGKILL)
    slurm("scontrol", "requeue", f"{job}_1")
    slurm.wait()

    left = run_main("status", "ds", "--left").out.strip()
    assert left == "0", [path.read_text() for path in tmp_path.glob("part-*.txt")]
    first = (tmp_path / "merge-1.txt").read_text()
    assert "parts left: 0 (of 4)" in first and first.endswith("exit 5\n")
    job = slurm.submit(part, f"--array={left}", "--output=part-again.txt", cwd=tmp_path)
    slurm.submit(merge, f"--dependency=afterany:{job}", "--output=merge-2.txt", cwd=tmp_path)
    slurm.wait()
    assert (tmp_path / "merge-2.txt").read_text().endswith("exit 0\n")
    assert tree_hash(tmp_path / "ds") == tree_hash(tmp_path / "undisturbed")
    assert verify(tmp_path / "ds") == []
    figure("parts", "same bytes from a SLURM array with a killed and a requeued part")
