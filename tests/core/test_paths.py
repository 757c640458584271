"""Paths: local files and objects of a store have the same methods, with the same results."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from unprocess_gen.core.entries import EntryKind
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import LocalPath, any_path, local_path, open_text
from unprocess_gen.dataset.manifest import read_rows

Folder = LocalPath | ObjectPath


@pytest.fixture(params=["local", "remote"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Folder:
    """Return an empty folder of each kind."""
    return any_path(request.getfixturevalue("bucket") if request.param == "remote" else tmp_path)


def write(folder: Folder, *names: str, content: bytes = b"12") -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)


def test_only_known_schemes_are_urls() -> None:
    for text in ("s3://bucket", "gs://bucket/a", "az://container/a b"):
        assert isinstance(any_path(text), ObjectPath)
        with pytest.raises(ConfigError, match="only local"):
            local_path(text, "only local")
    for text in ("bucket", "s3:", "s3:/bucket", "/s3://bucket", "./s3://bucket", "http://a/b"):
        assert any_path(text) == local_path(text, "") == Path(text)


def test_entries_are_sizes_and_folders(folder: Folder) -> None:
    write(folder, "photos/a", "photos/sub/b", "photos2/c", "d")
    assert folder.entries() == {"photos": -1, "photos2": -1, "d": 2}
    photos = folder / "photos"
    files = [entry.path for entry in photos.walk_entries() if entry.kind is EntryKind.FILE]
    assert sorted(files) == ["a", "sub/b"]
    assert [entry.path for entry in photos.walk_entries(recursive=False) if entry.size] == ["a"]
    assert (folder / "none").entries() == {}


def test_kinds_and_sizes_of_entries_are_known(folder: Folder) -> None:
    write(folder, "photos/a", content=b"123")
    file, photos, none = folder / "photos/a", folder / "photos", folder / "none"
    assert [path.is_dir() for path in (file, photos, none)] == [False, True, False]
    assert [path.is_file() for path in (file, photos, none)] == [True, False, False]
    assert [path.is_listed() for path in (file, photos, none)] == [True, True, False]
    assert [path.size() for path in (file, photos, none)] == [3, None, None]
    assert (file.entry()[:3], photos.entry().kind) == (("a", 3, EntryKind.FILE), EntryKind.FOLDER)
    with pytest.raises(FileNotFoundError):
        none.entry()


def test_files_are_written_completely_and_created_once(folder: Folder, tmp_path: Path) -> None:
    unfinished = str(folder / "work")
    path = folder / "file"
    assert path.create(b"first", unfinished)
    assert not path.create(b"second", unfinished)
    assert path.read_bytes() == b"first"
    path.write(b"third", unfinished)
    (tmp_path / "finished").write_bytes(b"")
    (folder / "empty").commit(tmp_path / "finished")
    assert [path.read_bytes(), (folder / "empty").read_bytes()] == [b"third", b""]
    assert not (tmp_path / "finished").exists() and (folder / "work").entries() == {}


def test_deleting_twice_is_no_error(folder: Folder) -> None:
    write(folder, "a", "b/c", "b/d/e")
    for _ in range(2):
        (folder / "a").delete()
        (folder / "b").delete_all()
        assert folder.entries() == {}


def test_part_of_a_file_is_read(folder: Folder) -> None:
    content = bytes(range(251)) * 1000
    write(folder, "data", content=content)
    for offset, size in ((0, 10), (70_001, 3), (len(content) - 2, 2)):
        part, skipped = (folder / "data").mapped(offset, size)
        assert bytes(part[skipped : skipped + size]) == content[offset : offset + size]
    with pytest.raises(ValueError):
        (folder / "data").mapped(len(content) - 2, 9)


def test_functions_are_applied_in_order(folder: Folder) -> None:
    assert list(folder.map(lambda number: number * 2, range(99))) == list(range(0, 198, 2))


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir], ids=["pipe", "folder"])
def test_only_regular_files_are_read(make: Callable[[Path], None], tmp_path: Path) -> None:
    make(tmp_path / "manifest.csv")
    path = any_path(tmp_path / "manifest.csv")
    for read in (path.read_bytes, path.read_text, lambda: open_text(path), lambda: list(read_rows(path))):
        with pytest.raises((OSError, DamageError), match="not a regular file"):
            read()
    assert path.size() is None
