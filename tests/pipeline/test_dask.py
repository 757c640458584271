"""Runs on a Dask cluster: the bytes of a local run, whatever process dies.

The scheduler, the workers and their nannies are real processes.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import pytest
from helpers.commands import Cli, RunMain, messages
from helpers.dask_cluster import DaskCluster, dask_cluster
from helpers.datasets import Make, TreeHash
from helpers.object_store import assert_same
from helpers.photographs import fill
from helpers.processes import (
    ONE,
    free_port,
    imported_first,
    interrupt,
    processes_per_core,
    running,
    session,
    slow_shards,
    wait_for,
    with_signal,
)
from helpers.promise_report import Figure

from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.pipeline import generate as runner
from unprocess_gen.pipeline.verify import verify

pytestmark = [
    pytest.mark.skipif(find_spec("distributed") is None, reason="needs the extra dask"),
    pytest.mark.usefixtures("photographs"),
]

ROOT = "source.root=p"
Check = Callable[[Path], None]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskCluster]:
    with dask_cluster(tmp_path_factory.mktemp("cluster")) as started:
        yield started


def committed(out: Path) -> dict[str, int]:
    """Return the inode of each shard that has a record."""
    return {
        path.name: path.stat().st_ino
        for path in (out / "shards").glob("*.tar")
        if (out / ".work/rows" / f"{path.stem.removeprefix('shard-')}.json").exists()
    }


# Same bytes -----------------------------------------------------------------------------------------------------------


def test_cluster_makes_the_bytes_of_a_local_run(
    cluster: DaskCluster, run_main: RunMain, assert_undisturbed: Check, tmp_path: Path
) -> None:
    done = run_main(ROOT, ONE, "out=ds", *cluster.overrides)
    assert (done.code, done.out.split(",")[0]) == (0, "ds: 12 pairs"), done.err
    assert "12/12 images" in done.err
    assert_undisturbed(tmp_path / "ds")
    run = json.loads((tmp_path / "ds/dataset.json").read_text())["run"]
    assert (run["executor"], run["n_jobs"], run["shards_made"]) == ("dask", 2, 12)
    assert run["decode_s"] > 0
    again = run_main(ROOT, ONE, "out=ds", *cluster.overrides)
    assert (again.code, "nothing to do" in again.out) == (0, True)


@pytest.mark.parametrize("first", ["local", "dask"])
def test_run_begun_one_way_is_finished_the_other(
    first: str, cluster: DaskCluster, run_main: RunMain, assert_undisturbed: Check, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    executors = {"local": ("n_jobs=1",), "dask": cluster.overrides}
    with monkeypatch.context() as patch:
        patch.setattr(runner.Made, "add", interrupt)
        assert run_main(ROOT, ONE, "out=ds", *executors.pop(first)).code == 130
    before = committed(tmp_path / "ds")
    assert before
    ((_, other),) = executors.items()
    assert run_main(ROOT, ONE, "out=ds", *other).code == 0
    assert_undisturbed(tmp_path / "ds")
    assert {path.name: path.stat().st_ino for path in (tmp_path / "ds/shards").iterdir()}.items() >= before.items()


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "code", "problem"),
    [
        (f"tcp://127.0.0.1:{free_port()}", 5, "no Dask scheduler answers; start one with dask scheduler, then rerun\n"),
        ("nowhere", 2, "cannot be used"),
        ("xyz://127.0.0.1:1", 2, "cannot be used"),
    ],
    ids=["no scheduler", "no URL", "no protocol"],
)
def test_unusable_address_is_reported_in_one_line(address: str, code: int, problem: str, run_main: RunMain) -> None:
    done = run_main(ROOT, "executor=dask", f"executor.address={address}", "executor.no_workers_s=1", "out=ds")
    assert (done.code, done.err.count("\n")) == (code, 1)
    assert f"gen-dataset: executor.address={address}: {problem}" in done.err


@pytest.mark.slow
def test_scheduler_without_workers_ends_the_run(run_main: RunMain, tmp_path: Path) -> None:
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
def test_scheduler_that_dies_ends_the_run_with_one_line(
    run_main: RunMain, assert_undisturbed: Check, tmp_path: Path
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
    assert_undisturbed(tmp_path / "ds")


@pytest.mark.slow
def test_cluster_writes_to_an_object_store(twelve: Path, run_main: RunMain, bucket: ObjectPath, tmp_path: Path) -> None:
    with dask_cluster(tmp_path / "cluster") as cluster:
        done = run_main(ROOT, ONE, f"out={bucket}/ds", *cluster.overrides)
    assert done.code == 0, done.err
    assert_same(bucket / "ds", twelve / "ds")
    assert verify(bucket / "ds") == []


@pytest.mark.slow
@pytest.mark.linux_only("sends signals")
@pytest.mark.parametrize("own", [True, False])
def test_interrupt_ends_the_run_in_a_second(
    own: bool,
    cluster: DaskCluster,
    cli: Cli,
    assert_undisturbed: Check,
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
        text = "gen-dataset: interrupted; finished shards are kept; run the same command again to resume"
        assert (code, lines) == (130, [text])
        wait_for(lambda: not session(process.pid), 10)
    assert seconds < 2.5 * processes_per_core()
    done = cli(ROOT, ONE, "out=ds", *executor)
    assert (done.returncode, messages(done.stderr)) == (0, [])
    assert_undisturbed(tmp_path / "ds")


OTHER_VERSION = """
import importlib.metadata

version = importlib.metadata.version
importlib.metadata.version = lambda name: "9.9" if name == "unprocess_gen" else version(name)
"""


@pytest.mark.slow
def test_worker_of_another_version_is_refused(run_main: RunMain, tmp_path: Path) -> None:
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
