"""Keep decoded pixels in files that processes map into memory, 3 bytes a pixel: reading a patch takes microseconds."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.sequences import Recent
from unprocess_gen.core.types import Srgb

MAPS = 256
"""Files that a process keeps mapped, each with a file descriptor; mapping takes longer than reading a patch."""

SHARED_MEMORY = Path("/dev/shm")


class PixelCache:
    """Cache decoded pixels as NPY files, shared by all processes that have the folder.

    Parameters
    ----------
    folder : str or Path
        Folder, created if necessary; ``"memory"`` for a temporary one in shared memory, which is deleted with the cache
        of the process that created it.
    most_bytes : int
        Size up to which pixels are added; none are removed.
    """

    def __init__(self, folder: str | os.PathLike[str], most_bytes: int) -> None:
        self._most_bytes = most_bytes
        if folder == "memory":
            root = SHARED_MEMORY if SHARED_MEMORY.is_dir() else None
            folder = tempfile.mkdtemp(prefix="unprocess_gen_", dir=root)
            weakref.finalize(self, _delete, folder, os.getpid())
        self._maps: Recent[str, Srgb] = Recent(MAPS)
        self._folder = Path(folder).absolute()
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"cache={folder}: cannot be created ({error.strerror}); expected a folder; choose another one"
            ) from None

    def get(self, name: str, decode: Callable[[], Srgb]) -> Srgb:
        """Return the pixels of a name; decode them if they are not in the cache, and add them if there is space."""
        pixels = self._maps.get(name)
        if pixels is None:
            path = self._folder / f"{name}.npy"
            pixels = self._mapped(path)
            if pixels is None:
                decoded = decode()
                if self._bytes() + decoded.nbytes <= self._most_bytes:
                    self._add(path, decoded)
                return decoded
            self._maps.keep(name, pixels)
        return pixels

    @staticmethod
    def _mapped(path: Path) -> Srgb | None:
        """Map a file; None if there is none."""
        try:
            return np.asarray(np.load(path, mmap_mode="r"))
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise DamageError(f"{path}: not an NPY file ({error}); expected decoded pixels; delete it") from error

    def _bytes(self) -> int:
        """Size of the files in the folder; files that are deleted meanwhile count as empty."""
        total = 0
        for entry in os.scandir(self._folder):
            with suppress(FileNotFoundError):
                total += entry.stat().st_size
        return total

    def _add(self, path: Path, pixels: Srgb) -> None:
        """Write a file and rename it, so that other processes see all of it or nothing."""
        with machine_errors(self._folder):
            number, unfinished = tempfile.mkstemp(suffix=".part", dir=self._folder)
            try:
                with os.fdopen(number, "wb") as stream:
                    np.save(stream, pixels)
                Path(unfinished).replace(path)
            except BaseException:
                Path(unfinished).unlink()
                raise


def _delete(folder: str, pid: int) -> None:
    """Delete a temporary folder at the end of the process that created it, not of its forks."""
    if os.getpid() == pid:
        shutil.rmtree(folder, ignore_errors=True)
