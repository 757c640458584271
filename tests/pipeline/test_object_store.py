"""Datasets written to an object store: same bytes, kills, races, failures of the store."""

from __future__ import annotations

import json
import random
import signal
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import object_store as servers
from helpers.commands import RunMain, messages
from helpers.datasets import Make
from helpers.object_store import Proxy, assert_same
from helpers.processes import ONE, kill_group, running, wait_for

import unprocess_gen as ug
from unprocess_gen.core import object_store
from unprocess_gen.core.errors import ConfigError, DamageError, MachineError
from unprocess_gen.core.object_store import TEMPORARY_PREFIX, ObjectPath
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.generate import Summary
from unprocess_gen.pipeline.run import LISTING


@pytest.fixture(autouse=True)
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of temporary files, so that a test sees all of them."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder


@pytest.fixture
def photos(twelve: Path, bucket: ObjectPath) -> ObjectPath:
    """Return a URL with the twelve photographs."""
    servers.upload(twelve / "p", bucket / "photos")
    return bucket / "photos"


def test_url_gets_the_bytes_of_a_folder(twelve: Path, bucket: ObjectPath, scratch: Path, run_main: RunMain) -> None:
    out = bucket / "made" / "ds"
    arguments = (f"source.root={twelve / 'p'}", f"out={out}", ONE, "n_jobs=1")
    done = run_main(*arguments)
    assert (done.code, done.out.startswith(f"{out}: 12 pairs, 0.1 MB, ")) == (0, True)
    assert_same(out, twelve / "ds")
    assert not list(scratch.iterdir())
    again = run_main(*arguments)
    assert (again.code, again.out.partition(":")[0]) == (0, f"{out} is complete".partition(":")[0])
    np.testing.assert_array_equal(ug.RawPairs(str(out))[3].noisy, ug.RawPairs(twelve / "ds")[3].noisy)
    assert ug.verify(str(out)) == []


@pytest.mark.slow
def test_bucket_to_bucket_records_both_urls(
    twelve: Path, photos: ObjectPath, bucket: ObjectPath, run_main: RunMain, make: Make
) -> None:
    make(photos, bucket / "ds", ONE)
    assert_same(bucket / "ds", twelve / "ds")
    assert json.loads((bucket / "ds/dataset.json").read_bytes())["source"]["root"] == str(photos)
    done = run_main("again", str(bucket / "ds"), f"out={bucket}/again", "n_jobs=1")
    assert (done.code, done.out.splitlines()[-1]) == (0, f"the same as {bucket}/ds, bit for bit")
    done = run_main("again", str(bucket / "ds"), f"out={bucket}/ds")
    assert done.code == 2 and "is the dataset itself" in done.err


@pytest.mark.slow
def test_killed_run_ends_as_if_undisturbed(
    twelve: Path, bucket: ObjectPath, scratch: Path, proxy: Proxy, tmp_path: Path
) -> None:
    """Each kill comes a few random milliseconds after the next request that writes; no shard is ever incomplete."""
    moment = random.Random(18)
    out = bucket / "ds"
    arguments = (f"source.root={twelve / 'p'}", f"out={out}", ONE)
    sizes = {path.name: path.stat().st_size for path in (twelve / "ds/shards").iterdir()}
    proxy.delay_s = 0.02
    for kill in range(20):
        wanted = proxy.count("PUT") + kill % 3
        with running(*arguments, f"n_jobs={1 + kill % 2}", cwd=tmp_path) as process:
            wait_for(lambda n=wanted: proxy.count("PUT") > n or process.poll() is not None)
            time.sleep(moment.uniform(0, 0.05))
            kill_group(process)
        assert (out / "shards").entries().items() <= sizes.items()
    proxy.delay_s = 0
    for codes in ((0, 3), (0,)):  # a photograph at which four kills came is retried by the second run
        with running(*arguments, "n_jobs=1", cwd=tmp_path) as process:
            assert process.wait() in codes, process.communicate()
    assert_same(out, twelve / "ds")
    assert not list(scratch.glob(f"{TEMPORARY_PREFIX}*"))


def make_seven(make: Make, proxy: Proxy, root: object, out: ObjectPath) -> None:
    """Begin a run whose eighth shard cannot be written."""
    proxy.answer = lambda method, path: 403 if method == "PUT" and path.endswith("00007.tar") else 0
    with pytest.raises(MachineError, match=r"shard-00007\.tar: access was refused"):
        make(root, out, ONE)
    proxy.answer = lambda *_: 0
    assert len((out / ".work/rows").entries()) == len((out / "shards").entries()) == 7


def test_committed_shards_are_not_made_twice(twelve: Path, bucket: ObjectPath, proxy: Proxy, make: Make) -> None:
    make_seven(make, proxy, twelve / "p", bucket / "ds")
    proxy.requests.clear()
    assert make(twelve / "p", bucket / "ds", ONE).made == 5
    written = [path for method, path in proxy.requests if method == "PUT" and "/shards/" in path]
    assert len(written) == 5
    assert_same(bucket / "ds", twelve / "ds")


def test_two_runs_at_once_write_one_dataset(twelve: Path, bucket: ObjectPath, make: Make) -> None:
    outcomes: list[Summary | Exception] = []

    def run() -> None:
        try:
            outcomes.append(make(twelve / "p", bucket / "ds", ONE))
        except Exception as error:
            outcomes.append(error)

    threads = [threading.Thread(target=run) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert any(isinstance(outcome, Summary) for outcome in outcomes), outcomes
    assert all(isinstance(outcome, Summary | MachineError | DamageError) for outcome in outcomes), outcomes
    assert make(twelve / "p", bucket / "ds", ONE).made == 0
    assert_same(bucket / "ds", twelve / "ds")


@pytest.mark.slow
def test_run_with_other_settings_loses_the_race(
    twelve: Path, bucket: ObjectPath, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    create = OutFolder.create

    def begun_by_another(*arguments: Any) -> bool:
        monkeypatch.setattr(OutFolder, "create", create)
        make(twelve / "p", bucket / "ds", ONE)
        return create(*arguments)

    monkeypatch.setattr(OutFolder, "create", begun_by_another)
    with pytest.raises(ConfigError, match=r"was begun with other settings: seed=4 \(there: 0\)"):
        make(twelve / "p", bucket / "ds", ONE, "seed=4")
    assert_same(bucket / "ds", twelve / "ds")


def test_run_with_other_sources_loses_the_race(twelve: Path, bucket: ObjectPath, make: Make) -> None:
    """The listing is never replaced."""
    OutFolder(bucket / "ds").create(LISTING, b'["000.png",1]\n')
    with pytest.raises(ConfigError, match=r"ds: was begun with other sources"):
        make(twelve / "p", bucket / "ds", ONE)


def test_interrupted_upload_leaves_no_object(bucket: ObjectPath, proxy: Proxy, tmp_path: Path) -> None:
    (tmp_path / "shard").write_bytes(bytes(3 * object_store.PIECE))
    proxy.answer = lambda method, path: 403 if "partNumber=2" in path else 0
    with pytest.raises(MachineError):
        (bucket / "shard").commit(tmp_path / "shard")
    proxy.answer = lambda *_: 0
    assert not (bucket / "shard").exists()


def last_of(photos: ObjectPath) -> str:
    return sorted(entry.path for entry in photos.walk_entries())[-1]


def changed(path: ObjectPath) -> bytes:
    """Return the content of an object with one bit changed."""
    content = path.read_bytes()
    return content[:-1] + bytes([content[-1] ^ 1])


def test_object_changed_between_runs_is_refused(
    photos: ObjectPath, bucket: ObjectPath, proxy: Proxy, make: Make
) -> None:
    make_seven(make, proxy, photos, bucket / "ds")
    last = last_of(photos)
    (photos / last).write_bytes(changed(photos / last))
    with pytest.raises(ConfigError, match=f"was begun with other sources: {last} has other bytes than it had"):
        make(photos, bucket / "ds", ONE)


@pytest.mark.parametrize("fault", ["changed since it was listed", "was deleted or moved after listing"])
def test_object_changed_or_deleted_during_a_run_ends_with_5(
    fault: str, photos: ObjectPath, bucket: ObjectPath, proxy: Proxy, run_main: RunMain
) -> None:
    last = last_of(photos)
    content = changed(photos / last)

    def answer(method: str, path: str) -> int:
        if fault.startswith("changed") and method == "PUT" and path.endswith("00000.tar"):
            proxy.answer = lambda *_: 0
            servers.put(proxy.target, photos / last, content)
        return 404 if "deleted" in fault and method in ("GET", "HEAD") and path.endswith(last) else 0

    proxy.answer = answer
    done = run_main(f"source.root={photos}", f"out={bucket}/ds", ONE, "n_jobs=1", "check_disk=false")
    assert (done.code, f"{last} {fault}" in done.err, len(messages(done.err))) == (5, True, 1), done.err


def test_run_in_parts_writes_the_same_bytes(
    twelve: Path, photos: ObjectPath, bucket: ObjectPath, scratch: Path, run_main: RunMain
) -> None:
    out = bucket / "ds"
    settings = (f"source.root={photos}", f"out={out}", ONE, "n_jobs=1", "-q")
    for number in (2, 0, 2):
        assert run_main("part", f"{number}/3", *settings).code == 0
    early = run_main("merge", str(out))
    assert (early.code, "parts 1 of 3 are not done" in early.err) == (5, True)
    assert not (out / "dataset.json").exists()
    assert run_main("part", "1/3", *settings).code == 0
    assert run_main("merge", str(out)).code == 0
    assert_same(out, twelve / "ds")
    assert not list(scratch.iterdir())


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (("out=s3://none/ds",), "out=s3://none/ds: the bucket none does not exist (404 Not Found, NoSuchBucket"),
        (("out={}/ds/inner",), "out={}/ds/inner: is inside the dataset {}/ds"),
        (("out={}/foreign",), "out={}/foreign: contains notes.txt, but no config.yaml"),
        (("out={}/ds", "seed=1"), "out={}/ds: was begun with other settings: seed=1 (there: 0)"),
        (("-m", "out={}/sweep", "seed=1,2"), "out={}/sweep: a sweep cannot write to an object store"),
        (("accuracy", "out={}/report"), "out={}/report: a report is written to a local folder"),
    ],
    ids=["bucket", "inner", "foreign", "settings", "sweep", "report"],
)
def test_wrong_out_is_refused_before_anything_is_written(
    arguments: tuple[str, ...], error: str, twelve: Path, bucket: ObjectPath, run_main: RunMain, make: Make
) -> None:
    make(twelve / "p", bucket / "ds", ONE, "source.limit=1")
    (bucket / "foreign/notes.txt").write_bytes(b"mine")
    before = sorted(bucket.walk_entries())
    done = run_main(*(word.format(bucket) for word in arguments), f"source.root={twelve / 'p'}", "source.limit=1", ONE)
    assert done.code == 2
    assert error.format(bucket, bucket) in done.err and "Traceback" not in done.err
    assert sorted(bucket.walk_entries()) == before


@pytest.mark.slow
def test_signal_ends_a_run_without_leftovers(
    twelve: Path, bucket: ObjectPath, proxy: Proxy, scratch: Path, tmp_path: Path
) -> None:
    proxy.delay_s = 0.05
    with running(f"source.root={twelve / 'p'}", f"out={bucket}/ds", ONE, "n_jobs=1", cwd=tmp_path) as process:
        wait_for(lambda: any("shard-00001.tar" in path for _, path in proxy.requests))
        process.send_signal(signal.SIGTERM)
        assert process.wait() == 143
    assert not list(scratch.glob(f"{TEMPORARY_PREFIX}*"))
