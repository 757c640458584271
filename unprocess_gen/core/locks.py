"""Lock a place with a file, so that two processes do not write to it at the same time.

The system releases the lock of a process that ends, however it ends. Some network file systems have no locks, and
object stores have none. Callers must therefore stay correct with two owners; `pipeline.folder` does, because every
writer makes the same bytes. Design: ``docs/design/pipeline.md``.
"""

from __future__ import annotations

import errno
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from filelock import FileLock

NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)
"""Errors of file systems that have no locks."""


class LockFile:
    """A lock, held from `acquire` until `release` or the end of the process; ``path`` is in a folder that exists."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock: FileLock | None = None

    def acquire(self, wait: bool) -> bool:
        """Create the file and lock it; return False if its file system has no locks.

        Raises BlockingIOError if another process holds the lock and ``wait`` is False, OSError if the file cannot be
        created.
        """
        from filelock import FileLock, Timeout  # takes 0.05 s

        lock = FileLock(self.path, thread_local=False, fallback_to_soft=False)
        try:
            lock.acquire(blocking=wait)
        except Timeout:
            raise BlockingIOError("is locked by another process") from None
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            return False
        self._lock = lock
        return True

    def release(self) -> None:
        """Delete the file and release the lock, if this process holds it."""
        if self._lock is not None:
            with suppress(OSError):  # the folder may have been deleted
                self.path.unlink()
            self._lock.release()
            self._lock = None
