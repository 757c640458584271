"""Lock a folder, so that two processes do not write to it at the same time.

Linux and macOS lock the folder itself (flock). Windows cannot lock folders; there, a file named after the folder is
locked in the user's folder for temporary files. Both locks end with the process. What differs:
``docs/design/platforms.md``.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
import time
from pathlib import Path

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

POLL_S = 0.05
"""Delay between two attempts to lock a file on Windows, which has no call that waits without limit."""


class NoLocksError(OSError):
    """Report that a file system has no locks."""


class FolderLock:
    """Hold the lock of a folder, from `acquire` until `release` or the end of the process.

    Parameters
    ----------
    folder : Path
        An existing folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._handle: int | None = None

    def acquire(self, wait: bool) -> None:
        """Lock the folder.

        Parameters
        ----------
        wait : bool
            Whether to wait while another process holds the lock.

        Raises
        ------
        BlockingIOError
            If another process holds the lock and ``wait`` is False.
        NoLocksError
            If the file system has no locks.
        OSError
            If the folder cannot be opened.
        """
        handle = self._open()
        try:
            _lock(handle, wait)
        except BaseException as error:
            os.close(handle)
            if isinstance(error, OSError) and not isinstance(error, BlockingIOError):
                raise NoLocksError(error.errno, error.strerror) from error
            raise
        self._handle = handle

    def release(self) -> None:
        """Unlock the folder, if it is locked."""
        if self._handle is None:
            return
        os.close(self._handle)
        self._handle = None
        if sys.platform == "win32":
            with contextlib.suppress(OSError):  # another process has opened the file by now and keeps it
                lock_file(self._folder).unlink()

    def _open(self) -> int:
        if sys.platform == "win32":
            path, flags = lock_file(self._folder), os.O_RDWR | os.O_CREAT
        else:
            path, flags = self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
        return os.open(path, flags)


def lock_file(folder: Path) -> Path:
    """Return the file that is locked in place of a folder on Windows; equal for all spellings of the folder."""
    path = os.path.normcase(os.path.realpath(folder))
    digest = hashlib.sha256(path.encode("utf-8", "surrogatepass")).hexdigest()[:32]
    return Path(tempfile.gettempdir(), f"unprocess_gen-{digest}.lock")


def _lock(handle: int, wait: bool) -> None:
    """Lock an open folder or, on Windows, the first byte of an open file."""
    if sys.platform == "win32":
        while not _try_lock(handle):
            if not wait:
                raise BlockingIOError("is locked by another process")
            time.sleep(POLL_S)
    else:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


if sys.platform == "win32":

    def _try_lock(handle: int) -> bool:
        """Lock the first byte of an open file; return False if another process holds it."""
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except PermissionError:
            return False
        return True
