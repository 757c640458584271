"""Runs on a Dask cluster: the bytes of a local run, whatever process dies.

The scheduler, the workers and their nannies are real processes.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import pytest
from helpers.commands import Cli, RunMain, messages
from helpers.dask_cluster import DaskCluster, dask_cluster
from helpers.datasets import Make, TreeHash
from helpers.photographs import fill
from helpers.processes import (
    ONE,
    POISON,
    assert_complete,
    imported_first,
    processes_per_core,
    running,
    session,
    slow_shards,
    wait_for,
    with_signal,
)
from helpers.promise_report import Figure

from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline import generate as runner
from unprocess_gen.pipeline.verify import verify

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="needs the extra dask")

COUNT = 12
ROOT = "source.root=p"


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskCluster]:
    with dask_cluster(tmp_path_factory.mktemp("cluster")) as started:
        yield started


@pytest.fixture(scope="module")
def undisturbed(make: Make, tree_hash: TreeHash, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Make the dataset of twelve photographs locally, and return its hash."""
    folder = tmp_path_factory.mktemp("undisturbed")
    make(fill(folder / "p", COUNT), folder / "ds", ONE)
    return tree_hash(folder / "ds")


@pytest.fixture
def photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return fill(tmp_path / "p", COUNT)


def committed(out: Path) -> dict[str, tuple[int, int]]:
    """Return inode and time of each shard that has a record."""
    return {
        path.name: (path.stat().st_ino, path.stat().st_mtime_ns)
        for path in (out / "shards").glob("*.tar")
        if (out / ".work/rows" / f"{path.stem.removeprefix('shard-')}.json").exists()
    }


# Same bytes -----------------------------------------------------------------------------------------------------------


def test_cluster_makes_the_bytes_of_a_local_run(
    cluster: DaskCluster, photographs: Path, run_main: RunMain, undisturbed: str, tree_hash: TreeHash, tmp_path: Path
) -> None:
    done = run_main(ROOT, ONE, "out=ds", *cluster.overrides)
    assert (done.code, done.out.split(",")[0]) == (0, "ds: 12 pairs"), done.err
    assert "12/12 images" in done.err
    assert tree_hash(tmp_path / "ds") == undisturbed
    assert verify(tmp_path / "ds") == []
    assert_complete(tmp_path / "ds")
    run = json.loads((tmp_path / "ds/dataset.json").read_text())["run"]
    assert (run["executor"], run["n_jobs"], run["shards_made"]) == ("dask", 2, 12)
    assert run["decode_s"] > 0
    again = run_main(ROOT, ONE, "out=ds", *cluster.overrides)
    assert (again.code, "nothing to do" in again.out) == (0, True)


def test_run_that_a_local_one_began_is_finished_by_dask(
    cluster: DaskCluster, photographs: Path, run_main: RunMain, undisturbed: str, tree_hash: TreeHash, tmp_path: Path
) -> None:
    assert run_main("part", "0/2", ROOT, ONE, "n_jobs=1", "out=ds", "-q").code == 0
    before = committed(tmp_path / "ds")
    done = run_main(ROOT, ONE, "out=ds", *cluster.overrides)
    assert (done.code, len(before)) == (0, 6), done.err
    assert tree_hash(tmp_path / "ds") == undisturbed
    assert {path.name: path.stat().st_ino for path in (tmp_path / "ds/shards").iterdir()}.items() >= {
        name: inode for name, (inode, _) in before.items()
    }.items()


def test_run_that_dask_began_is_finished_locally(
    cluster: DaskCluster,
    photographs: Path,
    run_main: RunMain,
    undisturbed: str,
    tree_hash: TreeHash,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(runner, "_count", interrupted)
        done = run_main(ROOT, ONE, "out=ds", *cluster.overrides)
    assert (done.code, len(committed(tmp_path / "ds")) > 0) == (130, True)
    assert run_main(ROOT, ONE, "n_jobs=1", "out=ds").code == 0
    assert tree_hash(tmp_path / "ds") == undisturbed


# Refusals -------------------------------------------------------------------------------------------------------------


def test_no_scheduler_at_the_address_ends_with_one_line(photographs: Path, run_main: RunMain) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{unused.getsockname()[1]}"
        done = run_main(ROOT, "executor=dask", f"executor.address={address}", "executor.no_workers_s=1", "out=ds")
    expected = f"gen-dataset: executor.address={address}: no Dask scheduler answers; start one with dask scheduler, "
    assert (done.code, done.err) == (5, f"{expected}then rerun\n")


@pytest.mark.parametrize("address", ["nowhere", "xyz://127.0.0.1:1"])
def test_unusable_address_is_refused(address: str, photographs: Path, run_main: RunMain) -> None:
    done = run_main(ROOT, "executor=dask", f"executor.address={address}", "executor.no_workers_s=1", "out=ds")
    assert done.code == 2
    assert f"executor.address={address}: cannot be used" in done.err
    assert len(done.err.splitlines()) == 1


@pytest.mark.slow
def test_scheduler_without_workers_ends_the_run(photographs: Path, run_main: RunMain, tmp_path: Path) -> None:
    with dask_cluster(tmp_path / "cluster", workers=0) as empty:
        started = time.monotonic()
        done = run_main(ROOT, ONE, "out=ds", *empty.overrides, "executor.no_workers_s=2")
        seconds = time.monotonic() - started
    expected = "gen-dataset: executor.no_workers_s=2: no Dask worker for this time; start workers, then rerun; "
    assert (done.code, messages(done.err)) == (5, [f"{expected}finished shards are kept"])
    assert 2 <= seconds <= 7


# Faults ---------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.linux_only("kills a process by a signal")
def test_photograph_that_kills_its_workers_gets_provisional_rows(
    photographs: Path, run_main: RunMain, undisturbed: str, tree_hash: TreeHash, figure: Figure, tmp_path: Path
) -> None:
    killer = shutil.copy(photographs / "004.png", tmp_path / "killer.png")
    env = imported_first(tmp_path, POISON) | {"KILLER": str(killer)}
    with dask_cluster(tmp_path / "cluster", env=env) as cluster:
        started = time.monotonic()
        done = run_main(ROOT, ONE, "out=ds", *cluster.overrides)
        seconds = time.monotonic() - started
        assert done.code == 3, done.err
        warnings = messages(done.err)
        assert warnings == ["gen-dataset: 004.png: its worker died four times; run the same command again to retry it"]
        reasons = [(row["source"], row["reason"]) for row in read_rows(tmp_path / "ds/manifest.csv") if row["reason"]]
        assert reasons == [("004.png", "worker_died")]
        assert seconds < 60 * processes_per_core()
        Path(killer).unlink()
        assert run_main(ROOT, ONE, "out=ds", *cluster.overrides).code == 0
    assert tree_hash(tmp_path / "ds") == undisturbed
    figure("dask", f"photograph that kills its worker: {seconds:.0f} s")


@pytest.mark.slow
@pytest.mark.linux_only("kills a process by a signal")
def test_scheduler_that_dies_ends_the_run_with_one_line(
    photographs: Path, run_main: RunMain, undisturbed: str, tree_hash: TreeHash, tmp_path: Path
) -> None:
    env = imported_first(tmp_path, slow_shards(0.5))
    with (
        dask_cluster(tmp_path / "cluster", env=env) as cluster,
        running(ROOT, ONE, "executor.no_workers_s=60", "out=ds", *cluster.overrides, cwd=tmp_path) as process,
    ):
        wait_for(lambda: len(committed(tmp_path / "ds")) >= 2)
        cluster.scheduler.kill()
        assert process.wait(60) == 5
        assert process.stderr is not None
        lines = messages(process.stderr.read())
    assert lines == [
        f"gen-dataset: executor.address={cluster.address}: the Dask scheduler ended or cannot be reached; finished "
        "shards are kept; run the same command again to resume"
    ]
    assert run_main(ROOT, ONE, "n_jobs=1", "out=ds").code == 0
    assert tree_hash(tmp_path / "ds") == undisturbed


@pytest.mark.slow
def test_cluster_writes_to_an_object_store(
    photographs: Path, run_main: RunMain, bucket: ObjectPath, tmp_path: Path
) -> None:
    assert run_main(ROOT, ONE, "n_jobs=1", "out=local").code == 0
    local = json.loads((tmp_path / "local/dataset.json").read_text())
    with dask_cluster(tmp_path / "cluster") as cluster:
        done = run_main(ROOT, ONE, f"out={bucket}/ds", *cluster.overrides)
    assert done.code == 0, done.err
    remote = json.loads((bucket / "ds/dataset.json").read_text())
    assert (remote["fingerprint"], remote["shards"]) == (local["fingerprint"], local["shards"])
    assert verify(bucket / "ds") == []
    assert sorted(path.name for path in (bucket / "ds").iterdir()) == sorted(os.listdir(tmp_path / "local"))


@pytest.mark.slow
@pytest.mark.linux_only("sends signals")
@pytest.mark.parametrize("own", [True, False])
def test_interrupt_ends_the_run_in_a_second(
    own: bool,
    photographs: Path,
    cluster: DaskCluster,
    cli: Cli,
    undisturbed: str,
    tree_hash: TreeHash,
    tmp_path: Path,
) -> None:
    executor = ("executor=dask", "n_jobs=2") if own else cluster.overrides
    env = imported_first(tmp_path, slow_shards(0.5))
    with running(ROOT, ONE, "out=ds", *executor, cwd=tmp_path, **env) as process:
        wait_for(lambda: len(committed(tmp_path / "ds")) >= 1)
        os.killpg(process.pid, signal.SIGINT)
        started = time.monotonic()
        code = process.wait(20)
        seconds = time.monotonic() - started
        assert process.stderr is not None
        lines = messages(process.stderr.read())
        assert (code, lines) == (
            130,
            ["gen-dataset: interrupted; finished shards are kept; run the same command again to resume"],
        )
        wait_for(lambda: not session(process.pid), 10)
    assert seconds < 2.5 * processes_per_core()
    done = cli(ROOT, ONE, "out=ds", *executor)
    assert (done.returncode, messages(done.stderr)) == (0, [])
    assert tree_hash(tmp_path / "ds") == undisturbed
    assert_complete(tmp_path / "ds")


OTHER_VERSION = """
import importlib.metadata

version = importlib.metadata.version
importlib.metadata.version = lambda name: "9.9" if name == "unprocess_gen" else version(name)
"""


@pytest.mark.slow
def test_worker_of_another_version_is_refused(photographs: Path, run_main: RunMain, tmp_path: Path) -> None:
    with dask_cluster(tmp_path / "cluster", workers=0) as cluster:
        cluster.add_worker(**imported_first(tmp_path, OTHER_VERSION))
        done = run_main(ROOT, ONE, "out=ds", *cluster.overrides)
    assert (done.code, len(messages(done.err))) == (2, 1)
    assert "a worker has unprocess_gen 9.9, this host" in done.err


@pytest.mark.slow
@pytest.mark.linux_only("kills processes by a signal")
def test_random_kills_end_with_the_same_bytes(tmp_path: Path, make: Make, tree_hash: TreeHash, figure: Figure) -> None:
    draw, out, kills = random.Random(18), tmp_path / "ds", 0
    make(fill(tmp_path / "p", 80), tmp_path / "local", ONE)
    env = imported_first(tmp_path, slow_shards(0.4))
    with ExitStack() as stack:
        cluster = stack.enter_context(dask_cluster(tmp_path / "cluster", env=env))
        for attempt in range(60):
            if cluster.scheduler.poll() is not None:
                cluster = stack.enter_context(dask_cluster(tmp_path / f"cluster{attempt}", env=env))
            arguments = (f"source.root={tmp_path / 'p'}", ONE, f"out={out}", *cluster.overrides)
            with running(*arguments, "executor.no_workers_s=60", cwd=tmp_path) as process:
                while process.poll() is None:
                    count = len(committed(out)) + 1 if kills < 20 else 1000
                    wait_for(lambda n=count: process.poll() is not None or len(committed(out)) >= n)
                    time.sleep(draw.uniform(0, 1.5))
                    if process.poll() is None:
                        kind = draw.choice(("worker", "worker", "nanny", "client", "scheduler"))
                        kill_one(kind, cluster, process, draw)
                        kills += 1
                code = process.wait()
            assert code in (0, 3, 5, -signal.SIGKILL)
            if code == 0:
                break
    assert (code, kills) == (0, 20)
    assert tree_hash(out) == tree_hash(tmp_path / "local")
    assert verify(out) == []
    figure("dask", f"same bytes after {kills} kills")


def kill_one(kind: str, cluster: DaskCluster, process: subprocess.Popen[str], draw: random.Random) -> None:
    """Kill the client, the scheduler, a worker that its nanny then replaces, or a nanny, which is replaced here."""
    if kind in ("client", "scheduler"):
        (process if kind == "client" else cluster.scheduler).kill()
        process.wait(60)
    elif kind == "worker":
        with_signal(draw.choice(cluster.makers() or cluster.processes()), signal.SIGKILL)
    else:
        with_signal(draw.choice([worker.pid for worker in cluster.workers if worker.poll() is None]), signal.SIGKILL)
        cluster.add_worker()
