"""Keep decoded pixels, 3 bytes each at 8 bits, in files that processes map: reading a patch takes microseconds.

A file is an NPY array, then the XXH3-128 of its pixels as 32 hex digits. Each process compares them when it first maps
the file. A damaged file is replaced.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import uuid
import warnings
import weakref
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import NO_SPACE, array_xxh3, machine_errors
from unprocess_gen.core.sequences import Recent

MAPS = 256
"""Files that a process keeps mapped, each with a file descriptor; mapping takes longer than reading a patch."""

DIGEST_BYTES, HEADER_BYTES = 32, 128
"""Sizes of the digest at the end of a file, and of the header of NPY before the pixels."""

SHARED_MEMORY = Path("/dev/shm")


class PixelCache:
    """Cache of decoded pixels as NPY files, shared by all processes that have the folder.

    The folder is created if necessary; ``"memory"`` means a temporary one in shared memory, which is deleted with the
    cache of the process that created it. Pixels are added up to ``most_bytes``; none are removed. Processes that add at
    once can exceed it by one image each.
    """

    def __init__(self, folder: str | os.PathLike[str], most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._maps: Recent[str, Srgb] = Recent(MAPS)
        self._compared: set[str] = set()
        is_temporary = folder == "memory"
        if is_temporary:
            parent = SHARED_MEMORY if SHARED_MEMORY.is_dir() else Path(tempfile.gettempdir())
            folder = parent / f"unprocess_gen_{uuid.uuid4().hex}"
            weakref.finalize(self, _delete, folder, os.getpid())
        self._folder = Path(folder).absolute()
        try:
            self._folder.mkdir(mode=0o700 if is_temporary else 0o777, parents=True, exist_ok=True)
        except OSError as error:
            if error.errno not in NO_SPACE:
                problem = f"cannot be created ({error.strerror}); expected a folder; choose another one"
                raise ConfigError(f"cache={folder}: {problem}") from None
            self._end()

    def get(self, name: str, decode: Callable[[], Srgb]) -> Srgb:
        """Pixels of a name, decoded if they are not in the cache, and then added if there is space."""
        pixels = self._maps.get(name)
        if pixels is not None:
            return pixels
        path = self._folder / f"{name}.npy"
        with machine_errors(path):
            pixels = self._mapped(path)
        if pixels is not None:
            return self._maps.keep(name, pixels)
        pixels = decode()
        if self._most_bytes and self._bytes() + HEADER_BYTES + pixels.nbytes + DIGEST_BYTES <= self._most_bytes:
            self._add(path, pixels)
        return pixels

    def _mapped(self, path: Path) -> Srgb | None:
        """Map a file; None if there is none or if it is damaged."""
        try:
            pixels = np.asarray(np.load(path, mmap_mode="r"))
            if path.name not in self._compared:
                with path.open("rb") as stream:
                    stream.seek(-DIGEST_BYTES, os.SEEK_END)
                    if stream.read() != array_xxh3(pixels).encode():
                        return None
                self._compared.add(path.name)
            return pixels
        except (FileNotFoundError, ValueError, EOFError):
            return None

    def _bytes(self) -> int:
        """Size of the files in the folder; files that are deleted meanwhile count as empty."""
        total = 0
        for entry in os.scandir(self._folder):
            with suppress(FileNotFoundError):
                total += entry.stat().st_size
        return total

    def _add(self, path: Path, pixels: Srgb) -> None:
        """Write a file and rename it, so that other processes see all of it or nothing; stop at a full disk."""
        try:
            number, unfinished = tempfile.mkstemp(suffix=".part", dir=self._folder)
            try:
                with os.fdopen(number, "wb") as stream:
                    np.save(stream, pixels)
                    stream.write(array_xxh3(pixels).encode())
                Path(unfinished).replace(path)
            except BaseException:
                Path(unfinished).unlink()
                raise
        except OSError as error:
            with machine_errors(self._folder):
                if error.errno not in (*NO_SPACE, None):  # NumPy's error for a short write has no number
                    raise
            self._end()

    def _end(self) -> None:
        """Add no more pixels, because the disk is full."""
        self._most_bytes = 0
        warnings.warn(f"cache={self._folder}: the disk is full; other pixels are decoded each time", stacklevel=2)


def _delete(folder: Path, pid: int) -> None:
    """Delete a temporary folder at the end of the process that created it, not of its forks."""
    if os.getpid() == pid:
        shutil.rmtree(folder, ignore_errors=True)
