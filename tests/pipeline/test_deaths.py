"""A photograph that kills its workers four times gets a provisional row, whichever way the run is made."""

from __future__ import annotations

import shutil
import signal
from contextlib import ExitStack
from pathlib import Path

import pytest
from helpers.commands import Cli, messages
from helpers.dask_cluster import dask_cluster
from helpers.datasets import Make, TreeHash
from helpers.processes import imported_first

from unprocess_gen import RawPairs
from unprocess_gen.dataset.dataset_json import read_dataset
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.deaths import MAX_DEATHS
from unprocess_gen.pipeline.verify import verify

POISON = """
import hashlib, os, pathlib, signal

killer, sha256 = pathlib.Path(os.environ["KILLER"]), hashlib.sha256


def deadly(data=b"", **options):
    if isinstance(data, bytes) and killer.exists() and data == killer.read_bytes():
        os.kill(os.getpid(), signal.SIGKILL)
    return sha256(data, **options)


hashlib.sha256 = deadly
"""
"""Module for `imported_first`: hashing the photograph that KILLER names kills the process."""

FOUR = "output.pairs_per_shard=4"
SETTINGS = ("source.root=p", FOUR, "out=ds")


@pytest.mark.slow
@pytest.mark.linux_only("kills processes by a signal")
@pytest.mark.parametrize("way", ["pool", "parts", "dask"])
def test_photograph_that_kills_its_workers_is_retried_by_reruns(
    way: str, photographs: Path, cli: Cli, make: Make, tree_hash: TreeHash, tmp_path: Path
) -> None:
    """The tenth photograph, in the third shard, whose other photographs are kept."""
    killer = Path(shutil.copy(photographs / "009.png", tmp_path / "killer.png"))
    env = imported_first(tmp_path, POISON) | {"KILLER": str(killer)}
    calls: list[tuple[str, ...]] = [(*SETTINGS, "n_jobs=2")]
    with ExitStack() as stack:
        if way == "parts":
            calls = [*(("part", f"{number}/2", *SETTINGS, "n_jobs=1") for number in range(2)), ("merge", "ds")]
            for _ in range(MAX_DEATHS):
                assert cli(*calls[0], **env).returncode == -signal.SIGKILL
        elif way == "dask":
            pytest.importorskip("distributed")
            cluster = stack.enter_context(dask_cluster(tmp_path / "cluster", env=env))
            calls = [(*SETTINGS, *cluster.overrides)]
        done = [cli(*call, **env) for call in calls]
        assert done[-1].returncode == 3, done
        (line,) = (line for one in done for line in messages(one.stderr))
        assert line.endswith("009.png: its worker died four times; run the same command again to retry it")
        rows = list(read_rows(tmp_path / "ds/manifest.csv"))
        assert [(row["source"], row["reason"]) for row in rows if row["reason"]] == [("009.png", "worker_died")]
        entries = read_dataset(tmp_path / "ds/dataset.json")["shards"]
        assert [entry.get("provisional", False) for entry in entries] == [False, False, True]
        assert (len(RawPairs(tmp_path / "ds")), verify(tmp_path / "ds")) == (11, [])
        killer.unlink()
        assert [cli(*call, **env).returncode for call in calls] == [0] * len(calls)
    make(photographs, tmp_path / "undisturbed", FOUR)
    assert tree_hash(tmp_path / "ds") == tree_hash(tmp_path / "undisturbed")
    assert not (tmp_path / "ds/.work").exists()
