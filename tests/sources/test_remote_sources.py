"""Photographs in an object store: the same listing, pairs and refusals as for a folder."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import object_store as servers
from helpers.configs import composed
from helpers.datasets import Make, TreeHash
from helpers.object_store import Proxy

from unprocess_gen.config.schema import replaced
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core import object_store
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.source import Source
from unprocess_gen.pipeline.generate import generate
from unprocess_gen.sources import reading
from unprocess_gen.sources.listing import Listing, list_folder, list_photographs, number_twins
from unprocess_gen.sources.reading import read_bytes, reading_ahead


@pytest.fixture
def remote(photos: Path, bucket: ObjectPath) -> ObjectPath:
    """Return the URL of a copy of `photos`."""
    servers.upload(photos, bucket / "photos")
    return bucket / "photos"


def listed(root: object, **options: object) -> Listing:
    """List photographs as a run does."""
    config = composed(*(f"source.{key}={value}" for key, value in options.items()))
    return list_photographs(replaced(config, {"source.root": str(root)}).source)


def without_etag(found: Listing) -> Listing:
    return replace(found, sources=tuple(replace(source, etag=None) for source in found.sources))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"recursive": False},
        {"limit": 3},
        {"include": "[*.PNG]"},
        {"include": "[sub/*]"},
        {"exclude": "[sub/*]"},
        {"clips": True},
    ],
    ids=str,
)
def test_bucket_is_listed_like_the_folder(options: dict[str, object], photos: Path, remote: ObjectPath) -> None:
    found = listed(remote, **options)
    assert without_etag(found) == listed(photos, **options)
    assert all(source.etag for source in found.sources)


def test_hostile_names_are_listed_like_files(tmp_path: Path, bucket: ObjectPath) -> None:
    for name in ("%41.png", "=a.png", "a b.png", "é.png", "z/#?.png", "-.png", "b\\c.png", "\u202eb.png", "A.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(name.encode() * 9)
    servers.upload(tmp_path, bucket)
    found = listed(bucket)
    assert without_etag(found) == listed(tmp_path)
    for source in found.sources:
        assert read_bytes(str(bucket), source) == source.path.encode() * 9


def test_single_object_is_a_source(photos: Path, remote: ObjectPath) -> None:
    assert without_etag(listed(remote / "deep.png")) == listed(photos / "deep.png")
    (source,) = listed(remote / "deep.png").sources
    assert read_bytes(str(remote / "deep.png"), source) == (photos / "deep.png").read_bytes()


def test_twins_are_numbered_like_files(tmp_path: Path, bucket: ObjectPath, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_store, "THREADS", 3)
    tail = b"t" * 5000
    contents = {"a": b"1" + tail, "b": b"2" + tail, "c": b"1" + tail, "d": tail, "e": b"3" * 5001, "f": b"1" + tail}
    for name, content in contents.items():
        (tmp_path / f"{name}.png").write_bytes(content)
    servers.upload(tmp_path, bucket)
    numbered = {source.path: source.occurrence for source in listed(bucket).sources}
    assert numbered == {"a.png": 0, "b.png": 0, "c.png": 1, "d.png": 0, "e.png": 0, "f.png": 2}
    assert without_etag(listed(bucket)) == listed(tmp_path)


def test_only_candidates_are_read_completely(tmp_path: Path, bucket: ObjectPath, proxy: Proxy) -> None:
    for number in range(20):
        (tmp_path / f"{number:02d}.png").write_bytes(bytes(9000) + bytes([number % 19]) * 4096)
    servers.upload(tmp_path, bucket)
    found = list_folder(str(bucket), ["*"], True, None).sources
    proxy.requests.clear()
    numbered = number_twins(str(bucket), found)
    assert proxy.count("GET") == 20 + 2
    assert [source.occurrence for source in numbered] == [0] * 19 + [1]


def test_changed_object_ends_the_run_with_its_name(remote: ObjectPath) -> None:
    source = listed(remote).sources[0]
    (remote / source.path).write_bytes(bytes(source.size_bytes or 0))
    with pytest.raises(MachineError, match=r"source 50%25\.png changed since it was listed: its ETag differs"):
        read_bytes(str(remote), source)


def test_objects_that_cannot_be_read_have_a_reason(bucket: ObjectPath, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, content in (("a", b"deleted"), ("b", b""), ("c", bytes(100))):
        (bucket / name).write_bytes(content)
    sources = [*listed(bucket, include="['*']").sources, Source(0, "../x", "../x", 1)]
    (bucket / "a").delete()
    monkeypatch.setattr(reading, "MAX_FILE_BYTES", 99)
    reasons = ("unreadable: a: no such object", "empty", "too_large", r"unreadable: .* leads outside source\.root")
    for source, reason in zip(sources, reasons, strict=True):
        with pytest.raises(SourceError, match=reason):
            read_bytes(str(bucket), source)


@pytest.mark.parametrize(
    ("root", "text"),
    [
        ("s3://none/photos", r"source\.root=s3://none/photos: the bucket none does not exist .*NoSuchBucket"),
        ("{}/none", r"source\.root={}/none: no such folder or file; expected photographs"),
        ("{}/sub/notes", r"source\.root={}/sub/notes: no such folder or file"),
        ("s3://", r"s3://: not the URL of an object store"),
    ],
)
def test_wrong_root_is_refused_in_one_line(root: str, text: str, remote: ObjectPath) -> None:
    with pytest.raises(ConfigError, match=text.format(remote)) as error:
        validate_config(replaced(composed(), {"source.root": root.format(remote)}))
    assert "\n" not in str(error.value)


def test_no_match_names_the_globs(remote: ObjectPath) -> None:
    with pytest.raises(ConfigError, match=r"no file matches source\.include=\['\*\.none'\] \(with sub-folders\)"):
        listed(remote, include="[*.none]")


def test_reads_run_ahead_in_order(bucket: ObjectPath, proxy: Proxy) -> None:
    sources = [Source(index, f"{index:02d}", f"{index:02d}", 2) for index in range(24)]
    for source in sources:
        (bucket / source.path).write_bytes(source.path.encode())
    proxy.requests.clear()
    proxy.delay_s = 0.02
    with reading_ahead(str(bucket), read_bytes, sources) as read:
        assert [read(str(bucket), source) for source in sources] == [source.path.encode() for source in sources]
    assert 2 < proxy.most_at_once <= reading.AHEAD
    assert len(proxy.requests) == len(sources)


def test_reading_ahead_is_bounded_in_bytes(bucket: ObjectPath, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "AHEAD_BYTES", 25)
    sources = [Source(index, str(index), str(index), 10) for index in range(9)]
    started: list[int] = []

    def read(root: str, source: Source) -> bytes:
        started.append(source.index)
        return bytes(10)

    with reading_ahead(str(bucket), read, sources) as ahead:
        ahead(str(bucket), sources[0])
        assert max(started) <= 2
        assert ahead(str(bucket), sources[0]) == bytes(10)  # a second time
        assert ahead(str(bucket), sources[5]) == bytes(10)  # out of order
        for source in sources[6:]:
            ahead(str(bucket), source)
    assert set(range(5, 9)) <= set(started)


def test_failed_read_is_raised_for_its_source(remote: ObjectPath) -> None:
    sources = listed(remote).sources
    (remote / sources[1].path).delete()
    with reading_ahead(str(remote), read_bytes, sources) as read:
        read(str(remote), sources[0])
        with pytest.raises(SourceError):
            read(str(remote), sources[1])
        read(str(remote), sources[2])


def test_local_files_are_not_read_ahead(photos: Path) -> None:
    with reading_ahead(str(photos), read_bytes, ()) as read:
        assert read is read_bytes


def test_bucket_gives_the_dataset_of_the_folder(
    photos: Path, remote: ObjectPath, tmp_path: Path, make: Make, tree_hash: TreeHash
) -> None:
    shutil.copytree(photos, tmp_path / "photos")
    shutil.copy(tmp_path / "photos" / "deep.png", tmp_path / "photos" / "twin.png")
    (remote / "twin.png").write_bytes((photos / "deep.png").read_bytes())
    make(tmp_path / "photos", tmp_path / "local", "output.pairs_per_shard=5")
    config = composed("output.pairs_per_shard=5", "n_jobs=1")
    config = replaced(config, {"source.root": str(remote), "out": str(tmp_path / "remote")})
    validate_config(config)
    generate(config)
    assert tree_hash(tmp_path / "remote") == tree_hash(tmp_path / "local")
