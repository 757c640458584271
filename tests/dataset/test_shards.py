"""Shards: tar files that any tool reads, whose bytes depend on nothing but their members."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import subprocess
import tarfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xxhash

from unprocess_gen import RawPairs
from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.dataset import shards
from unprocess_gen.dataset.row import without_empty
from unprocess_gen.dataset.shards import (
    ArrayFormat,
    Member,
    ShardWriter,
    map_array,
    read_index,
)
from unprocess_gen.simulation.frames import Counts, Pair

COUNTS = Counts(0, 0, 0, 0, 0, 0)


def add(writer: ShardWriter, key: str, one: Pair, row_json: bytes) -> None:
    """Append an image with one noisy frame."""
    writer.add_frame(key, "clean.npy", one.clean)
    writer.add_frame(key, "noisy.npy", one.noisy)
    writer.add_rows(key, row_json)


def pair(height: int, width: int, seed: int = 0) -> Pair:
    clean, noisy = np.random.default_rng(seed).integers(0, 65536, (2, height, width), dtype=np.uint16)
    return Pair(clean, noisy, COUNTS)


def written(path: Path, *pairs: Pair, json_bytes: int = 512) -> ShardWriter:
    with ShardWriter(path) as writer:
        for i, one in enumerate(pairs):
            add(writer, f"{i:08d}", one, json.dumps({"key": i}).encode().ljust(json_bytes))
    return writer


def uint16(height: int, width: int) -> ArrayFormat:
    return ArrayFormat("uint16", (height, width))


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    written(tmp_path / "a.tar", pair(5, 7, 1), pair(8, 4, 2))
    return tmp_path / "a.tar"


NAMES = [f"{i:08d}.{name}" for i in range(2) for name in ("clean.npy", "noisy.npy", "json")]


def test_tar_unpacks_members_in_order_and_numpy_loads_them(shard: Path, tmp_path: Path) -> None:
    done = subprocess.run(["tar", "-xvf", shard, "-C", tmp_path], capture_output=True, text=True, check=True)
    assert (done.stdout.splitlines(), done.stderr) == (NAMES, "")
    np.testing.assert_array_equal(np.load(tmp_path / "00000001.noisy.npy"), pair(8, 4, 2).noisy, strict=True)


def test_arrays_of_any_layout_give_the_same_bytes_and_digest(tmp_path: Path) -> None:
    array = np.array([[1, 256], [65535, 0]], np.uint16)
    expected = xxhash.xxh3_128_hexdigest(bytes([1, 0, 0, 1, 255, 255, 0, 0]))
    assert array_xxh3(array) == array_xxh3(array.astype(">u2")) == array_xxh3(np.asfortranarray(array)) == expected
    one = pair(5, 7)
    other = Pair(np.asfortranarray(one.clean), one.noisy.astype(">u2"), COUNTS)
    written(tmp_path / "a.tar", one)
    written(tmp_path / "b.tar", other)
    assert (tmp_path / "a.tar").read_bytes() == (tmp_path / "b.tar").read_bytes()


# Writing --------------------------------------------------------------------------------------------------------------


def test_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.tar").write_text("mine")
    with pytest.raises(FileExistsError):
        ShardWriter(tmp_path / "a.tar")
    assert (tmp_path / "a.tar").read_text() == "mine"


def test_an_error_leaves_no_end_of_archive(tmp_path: Path) -> None:
    with pytest.raises(KeyError), ShardWriter(tmp_path / "a.tar") as writer:
        add(writer, "00000000", pair(2, 2), b"{}")
        raise KeyError
    with pytest.raises(DamageError, match="not a complete shard"):
        read_index(tmp_path / "a.tar")


class Trickle(io.RawIOBase):
    """A file that takes a few bytes at a time, then none at all."""

    name = "trickle"

    def __init__(self, capacity: int) -> None:
        self.content, self.capacity = b"", capacity

    def write(self, content: Any) -> int:
        taken = bytes(content[: min(37, self.capacity - len(self.content))])
        self.content += taken
        return len(taken)


def test_short_writes_are_continued(tmp_path: Path) -> None:
    complete = written(tmp_path / "a.tar", pair(5, 7))
    with ShardWriter(tmp_path / "b.tar") as writer:
        writer._file.close()
        writer._file = trickle = Trickle(10**6)  # type: ignore[assignment]
        add(writer, "00000000", pair(5, 7), json.dumps({"key": 0}).encode().ljust(512))
    assert writer.sha256 == complete.sha256 == hashlib.sha256(trickle.content).hexdigest()


class Slow(Trickle):
    """A file whose writes take a millisecond."""

    def write(self, content: Any) -> int:
        time.sleep(0.001)
        return super().write(content)

    def fileno(self) -> int:
        return os.open(os.devnull, os.O_RDONLY)


def test_second_thread_writes_the_same_bytes(tmp_path: Path) -> None:
    alone, threaded = tmp_path / "a.tar", tmp_path / "b.tar"
    writers = []
    for path, thread in ((alone, False), (threaded, True)):
        with ShardWriter(path, threaded=thread) as writer:
            for key in ("00000000", "00000001", "00000002"):
                add(writer, key, pair(300, 201), json.dumps({"key": key}).encode().ljust(512))
        writers.append(writer)

    assert alone.read_bytes() == threaded.read_bytes()
    assert writers[0].bytes == writers[1].bytes == threaded.stat().st_size
    assert writers[0].sha256 == writers[1].sha256 == hashlib.sha256(threaded.read_bytes()).hexdigest()


@pytest.mark.parametrize("threaded", [False, True])
def test_write_of_zero_bytes_is_an_error_that_ends_the_thread(threaded: bool, tmp_path: Path) -> None:
    with (
        pytest.raises(OSError, match="takes no more bytes") as error,
        ShardWriter(tmp_path / "b.tar", threaded=threaded) as writer,
    ):
        writer._file.close()
        writer._file = Slow(100)  # type: ignore[assignment]
        add(writer, "00000000", pair(5, 7), b"{}")

    assert error.value.errno == errno.EIO
    assert not any(thread.name.startswith("shard writer") for thread in threading.enumerate())


def test_pending_bytes_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "MAX_PENDING_BYTES", 1000)
    waited = []
    with ShardWriter(tmp_path / "b.tar", threaded=True) as writer:
        writer._file.close()
        writer._file = Slow(10**9)  # type: ignore[assignment]
        for number in range(8):
            writer.add_frame(f"{number:08d}", "clean.npy", np.zeros((10, 20), np.uint16))
            waited.append(writer._pending_bytes)

    assert max(waited) <= 1000 + 1024


# Reading --------------------------------------------------------------------------------------------------------------


def test_headers_name_members_and_no_time_owner_or_other_mode(shard: Path) -> None:
    index, expected = read_index(shard), {}
    with tarfile.open(shard, "r:") as archive:
        for info in archive:
            expected[info.name] = Member(info.offset_data, info.size)
            assert (info.mtime, info.uid, info.gid, info.uname, info.gname, info.mode) == (0, 0, 0, "", "", 0o644)
            assert info.isreg()
    assert index == expected
    for number, one in enumerate((pair(5, 7, 1), pair(8, 4, 2))):
        for name, frame in (("clean", one.clean), ("noisy", one.noisy)):
            assert np.array_equal(map_array(shard, index[f"{number:08d}.{name}.npy"], uint16(*frame.shape)), frame)


@pytest.mark.parametrize("kept", [0, 1, 511, 512, 700, 1024, 3000])
def test_truncated_shard_is_damage(kept: int, shard: Path) -> None:
    member = read_index(shard)["00000001.noisy.npy"]
    os.truncate(shard, kept)
    with pytest.raises(DamageError, match=r"a.tar: not a complete shard"):
        read_index(shard)
    with pytest.raises(DamageError):
        map_array(shard, member, uint16(8, 4))


@pytest.mark.parametrize("at", [0, 6, 7, 20, 52, 60])
def test_member_that_is_not_the_expected_array_is_damage(at: int, shard: Path) -> None:
    member = read_index(shard)["00000000.clean.npy"]
    content = bytearray(shard.read_bytes())
    content[member.offset + at] ^= 0x11
    shard.write_bytes(content)
    with pytest.raises(DamageError, match=r"a.tar: the member at byte 512 is not an array"):
        map_array(shard, member, uint16(5, 7))


# WebDataset -----------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")  # those of another library
def test_the_webdataset_library_loads_a_dataset_as_it_is(dataset: Path) -> None:
    wds = pytest.importorskip("webdataset")
    urls = [str(path) for path in sorted((dataset / "shards").iterdir())]
    samples = list(wds.WebDataset(urls, shardshuffle=False, empty_check=False).decode())
    assert len(samples) == len(RawPairs(dataset)) == 13
    for sample, sample_of_reader in zip(samples, RawPairs(dataset), strict=True):
        assert sample["__key__"] == sample_of_reader.row["key"]
        assert sample["clean.npy"].dtype == sample["noisy.npy"].dtype == np.uint16
        assert np.array_equal(sample["clean.npy"], sample_of_reader.clean)
        assert np.array_equal(sample["noisy.npy"], sample_of_reader.noisy)
        assert sample["json"] == without_empty(sample_of_reader.row)
