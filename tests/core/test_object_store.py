"""Objects of S3: listing, range reads, create-only writes, retries, and errors in one sentence."""

from __future__ import annotations

import base64
import json
import os
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from helpers import object_store as servers
from helpers.object_store import Proxy

from unprocess_gen.core import object_store
from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.core.object_store import PIECE, ObjectChangedError, ObjectPath, StoreAccessError
from unprocess_gen.core.paths import any_path

QUICK = {"init_backoff": timedelta(milliseconds=1), "max_backoff": timedelta(milliseconds=20), "base": 2}

CONTENT = bytes(range(251)) * 1000


@pytest.fixture
def slow_proxy(proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> Proxy:
    """Return a proxy that this process uses, with retries after a few milliseconds."""
    from obstore import store

    def quick(url: str, client_options: dict[str, Any], retry_config: dict[str, Any]) -> object:
        retry_config = {**retry_config, "backoff": QUICK}
        return actual(url, client_options=client_options, retry_config=retry_config)

    actual = store.from_url
    monkeypatch.setattr(store, "from_url", quick)
    return proxy


def test_url_keeps_its_key_as_written() -> None:
    path = any_path("s3://bucket/a b/50%/é#?.jpg/")
    assert isinstance(path, ObjectPath)
    assert (path.bucket, path.key, path.name) == ("bucket", "a b/50%/é#?.jpg", "é#?.jpg")
    assert str(path.parent / path.name) == str(path) == "s3://bucket/a b/50%/é#?.jpg"
    assert pickle.loads(pickle.dumps(path)) == path


def test_url_without_bucket_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"s3:///key: not the URL of an object store; expected s3://BUCKET"):
        ObjectPath("s3:///key")


def test_hostile_names_keep_their_spelling(bucket: ObjectPath) -> None:
    names = ["a b.jpg", "%41.jpg", "ü#?.jpg", "d/x+y=&.jpg", "-lead", "~z", "back\\slash", "a[1]{2}|^`\"<>*'.jpg"]
    for name in names:
        (bucket / name).write_bytes(name.encode())
    assert sorted(entry.path for entry in bucket.walk_entries()) == sorted(names)
    assert [(bucket / name).read_bytes().decode() for name in names] == names


def test_reader_seeks_like_a_file(bucket: ObjectPath, tmp_path: Path) -> None:
    (bucket / "data").write_bytes(CONTENT)
    (tmp_path / "data").write_bytes(CONTENT)
    with (bucket / "data").open() as remote, (tmp_path / "data").open("rb") as local:
        places = (0,), (70000,), (-5, 2), (-20, 1), (len(CONTENT) + 9,), (1,)
        for seek, size in zip(places, (10, 3, 99, 4, 5, -1), strict=True):
            assert (remote.seek(*seek), remote.read(size)) == (local.seek(*seek), local.read(size))
        assert (remote.seek(250), remote.readline()) == (local.seek(250), local.readline())


def test_pieces_of_large_objects_are_joined(bucket: ObjectPath, tmp_path: Path) -> None:
    large = os.urandom(2 * PIECE + 12345)
    (tmp_path / "large").write_bytes(large)
    (bucket / "large").commit(tmp_path / "large")
    assert (bucket / "large").read_bytes() == large
    with (bucket / "large").local_copy() as copy:
        assert copy.read_bytes() == large
    assert not copy.exists()


def test_missing_object_is_a_missing_file_and_a_missing_bucket_is_named(bucket: ObjectPath) -> None:
    for read in ((bucket / "none").read_bytes, (bucket / "none").open, (bucket / "none").entry):
        with pytest.raises(FileNotFoundError, match=f"s3://{bucket.bucket}/none"):
            read()
    missing = ObjectPath("s3://no-such-bucket/photos")
    for action in (lambda: list(missing.walk_entries()), lambda: missing.write_bytes(b"1"), missing.exists):
        with pytest.raises(
            StoreAccessError,
            match=r"^s3://no-such-bucket/photos: the bucket no-such-bucket does not exist \(404 .*Bucket",
        ) as error:
            action()
        assert "\n" not in str(error.value)


def use_google(endpoint: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    account = {"gcs_base_url": endpoint, "disable_oauth": True}
    account |= dict.fromkeys(("client_email", "private_key", "private_key_id"), "")
    (folder / "account.json").write_text(json.dumps(account))
    monkeypatch.setenv("GOOGLE_SERVICE_ACCOUNT", str(folder / "account.json"))


def use_azure(endpoint: str, _: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "lab")
    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_KEY", base64.b64encode(bytes(32)).decode())
    monkeypatch.setenv("AZURE_STORAGE_ENDPOINT", endpoint)


STORES: dict[str, tuple[Callable[[str, Path, pytest.MonkeyPatch], None], tuple[str, str]]] = {
    "gs": (use_google, ("HTTP_X_GOOG_IF_GENERATION_MATCH", "0")), "az": (use_azure, ("HTTP_IF_NONE_MATCH", "*")),
}  # fmt: skip


@pytest.mark.parametrize("scheme", STORES)
def test_google_and_azure_get_the_conditions_of_requests(
    scheme: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The variables are those of the guide; servers of these stores are simulated by one that accepts everything."""
    use, create_only = STORES[scheme]
    object_store._store.cache_clear()
    with servers.one_object_server(CONTENT) as (endpoint, requests):
        use(endpoint, tmp_path, monkeypatch)
        path = ObjectPath(f"{scheme}://bucket/a/b c.jpg")
        with path.open_listed(len(CONTENT), '"listed"') as (file, _):
            assert file.read() == CONTENT
        assert path.create(b"1")
        path.write_bytes(b"2")
    object_store._store.cache_clear()
    path = "/bucket/a/b c.jpg"
    assert [servers.line_of(request) for request in requests] == [("GET", path), ("PUT", path), ("PUT", path)]
    read, create, overwrite = requests
    assert read["HTTP_IF_MATCH"] == '"listed"'
    assert create_only in create.items()
    assert create_only not in overwrite.items()


def test_refused_credentials_are_named_in_one_line(slow_proxy: Proxy, bucket: ObjectPath) -> None:
    for slow_proxy.answer in (lambda *_: 401, lambda *_: 403):
        with pytest.raises(StoreAccessError, match=rf"^{bucket}/a: access was refused \(40[13] .*AWS_ACCESS_KEY_ID$"):
            (bucket / "a").read_bytes()


def test_one_of_many_creators_wins(bucket: ObjectPath) -> None:
    start = threading.Barrier(8)

    def create(number: int) -> bool:
        start.wait()
        return (bucket / "raced").create(str(number).encode())

    with ThreadPoolExecutor(8) as pool:
        outcomes = list(pool.map(create, range(8)))
    assert sum(outcomes) == 1
    assert (bucket / "raced").read_bytes() == str(outcomes.index(True)).encode()


def test_changed_etag_is_reported(bucket: ObjectPath) -> None:
    path = bucket / "changing"
    path.write_bytes(b"before")
    etag = path.entry().etag
    with path.open_listed(6, etag, start=2) as (file, _):
        assert file.read() == b"fore"
    path.write_bytes(b"after!")
    with pytest.raises(ObjectChangedError, match=rf"^{path}: "), path.open_listed(6, etag):
        pass


def test_failing_answers_are_repeated(slow_proxy: Proxy, bucket: ObjectPath) -> None:
    answers = iter([503, 500, 0, 503, 0, 503, 503, 0])
    slow_proxy.answer = lambda *_: next(answers)
    (bucket / "a").write_bytes(b"1")
    assert (bucket / "a").read_bytes() == b"1"
    assert [entry.path for entry in bucket.walk_entries()] == ["a"]


def test_lasting_failure_ends_in_one_line(slow_proxy: Proxy, bucket: ObjectPath) -> None:
    slow_proxy.answer = lambda *_: 503
    with pytest.raises(MachineError, match=rf"^{bucket}/a: the object store failed \(503 .*; rerun when it answers$"):
        (bucket / "a").read_bytes()
    assert len(slow_proxy.requests) == object_store.MAX_RETRIES + 1


def test_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unprocess_gen.core.libraries.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"^s3://bucket/a: object stores need obstore; .*'unprocess_gen\[remote\]'"):
        ObjectPath("s3://bucket/a").read_bytes()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_forked_process_is_refused_instead_of_hanging(bucket: ObjectPath) -> None:
    (bucket / "a").write_bytes(b"1")
    pid = os.fork()
    if pid == 0:
        try:
            (bucket / "a").read_bytes()
        except MachineError as error:
            os._exit(0 if "spawn" in str(error) else 1)
        finally:
            os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
