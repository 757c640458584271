"""Cached pixels are those that were decoded, whatever happens to the files."""

from __future__ import annotations

import errno
import functools
import multiprocessing
import os
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unprocess_gen.sources.pixel_cache import PixelCache

Pixels = np.ndarray[Any, np.dtype[np.uint8]]
MOST_BYTES = 2**30


def photograph(number: int) -> Pixels:
    return np.random.default_rng(number).integers(0, 256, (64, 48 + number, 3), dtype=np.uint8)


def fill(folder: Path, numbers: list[int]) -> list[Pixels]:
    cache = PixelCache(folder, MOST_BYTES)
    return [np.array(cache.get(f"{number}", functools.partial(photograph, number))) for number in numbers]


def refuse() -> Pixels:
    raise AssertionError("decoded twice")


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:-1],
        lambda data: data[:1000],
        lambda data: b"",
        lambda data: b"no array",
        lambda data: data[:500] + bytes([data[500] ^ 1]) + data[501:],
        lambda data: data[:-32] + b"0" * 32,
        lambda data: data[:128] + bytes(len(data) - 128),
    ],
    ids=["last byte", "half", "empty", "text", "one bit", "digest", "zeros after a loss of power"],
)
def test_a_damaged_file_is_replaced(damage: Any, tmp_path: Path) -> None:
    fill(tmp_path, [3])
    file = tmp_path / "3.npy"
    file.write_bytes(damage(intact := file.read_bytes()))
    (pixels,) = fill(tmp_path, [3])
    np.testing.assert_array_equal(pixels, photograph(3))
    assert file.read_bytes() == intact
    np.testing.assert_array_equal(PixelCache(tmp_path, MOST_BYTES).get("3", refuse), photograph(3))


def test_a_full_disk_ends_the_caching(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, [0])
    monkeypatch.setattr(np, "save", _fail)
    with pytest.warns(UserWarning, match="the disk is full; other pixels are decoded each time") as warned:
        made = fill(tmp_path, [1, 0, 2])
    assert len(warned) == 1
    for number, pixels in zip((1, 0, 2), made, strict=True):
        np.testing.assert_array_equal(pixels, photograph(number))
    assert [path.name for path in tmp_path.iterdir()] == ["0.npy"]


def _fail(stream: Any, _: Pixels) -> None:
    stream.write(b"some bytes")
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_write_that_numpy_cuts_short_ends_the_caching(tmp_path: Path) -> None:
    """NumPy raises an OSError without a number, as in the 64 MB of a container's shared memory."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.warns(UserWarning, match="the disk is full") as warned:
            made = fill(tmp_path, [0, 1])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert len(warned) == 1 and not list(tmp_path.iterdir())
    np.testing.assert_array_equal(made[1], photograph(1))


def test_a_folder_that_a_full_disk_refuses_ends_the_caching(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse_folder(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "mkdir", refuse_folder)
    with pytest.warns(UserWarning, match="the disk is full") as warned:
        cache = PixelCache("memory", MOST_BYTES)
        np.testing.assert_array_equal(cache.get("1", functools.partial(photograph, 1)), photograph(1))
    assert len(warned) == 1


def test_processes_that_fill_a_cache_at_once_see_complete_files(tmp_path: Path) -> None:
    orders = [np.random.default_rng(n).permutation(12).tolist() for n in range(6)]
    with multiprocessing.get_context("fork").Pool(3) as pool:
        made = pool.map(functools.partial(fill, tmp_path), orders, chunksize=1)
    for order, images in zip(orders, made, strict=True):
        for number, pixels in zip(order, images, strict=True):
            np.testing.assert_array_equal(pixels, photograph(number))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f"{n}.npy" for n in range(12))
