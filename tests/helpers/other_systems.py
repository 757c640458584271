"""Imitate macOS and Windows in this process, as far as the package could notice.

`imitate` is called in a new process, before the package is imported. It removes what the system lacks from `os` and
`signal`, blocks its missing modules, and lets file operations fail as they do there. Libraries are imported before,
because their binaries are those of Linux.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import shutil
import signal
import sys
import tempfile
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

MISSING_MODULES = {
    "darwin": [],
    "win32": ["fcntl", "resource", "pwd", "grp", "termios", "pty", "posix", "syslog"],
}
MISSING_NAMES = {
    "darwin": ["sched_getaffinity", "sched_setaffinity", "fdatasync", "posix_fadvise", "memfd_create", "sendfile"],
    "win32": [
        *("O_DIRECTORY", "O_CLOEXEC", "O_NONBLOCK", "O_NOCTTY", "O_NOFOLLOW", "fork", "killpg", "setsid", "getuid"),
        *("geteuid", "getpgid", "sched_getaffinity", "sched_setaffinity", "fdatasync", "fchmod", "pread", "mkfifo"),
        *("posix_fadvise", "memfd_create", "sendfile", "uname", "nice"),
    ],
}
MISSING_SIGNALS = ("SIGHUP", "SIGPIPE", "SIGALRM", "SIGUSR1", "SIGKILL", "SIGQUIT")
DENIED = errno.EACCES, "Permission denied"


def imitate(system: str) -> None:
    """Make this process look like one on ``darwin`` or ``win32``."""
    import cv2  # noqa: F401
    import hydra.core.utils  # noqa: F401
    import numba  # noqa: F401
    import tqdm  # noqa: F401
    import xxhash  # noqa: F401
    import yaml  # noqa: F401

    platform.platform()  # caches what it finds
    if system == "win32":
        _imitate_files()
        _without_folder_numbers()
    for name in MISSING_NAMES[system]:
        if hasattr(os, name):
            delattr(os, name)
    for name in MISSING_MODULES[system]:
        sys.modules[name] = None  # type: ignore[assignment]
    if system == "win32":
        for name in MISSING_SIGNALS:
            delattr(signal, name)
    ctypes.CDLL = _LibraryWithoutMallopt if system == "darwin" else _no_library  # type: ignore[assignment,misc]
    sys.platform = system


class _LibraryWithoutMallopt:
    def __init__(self, name: str | None) -> None:
        pass


def _no_library(name: str | None) -> None:
    raise TypeError("argument of type 'NoneType' is not iterable")


def _imitate_files() -> None:
    """Let folders not be opened, read-only files not be synced, and files in use not be replaced or deleted."""
    import fcntl

    opening, syncing, get_flags = os.open, os.fsync, fcntl.F_GETFL
    control, lock = fcntl.fcntl, fcntl.flock

    def open_file(path: Any, *arguments: Any, **named: Any) -> int:
        if Path(path).is_dir():
            raise PermissionError(*DENIED, os.fspath(path))
        return opening(path, *arguments, **named)

    def fsync(handle: int) -> None:
        if control(handle, get_flags) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        syncing(handle)

    def locking(handle: int, mode: int, count: int) -> None:
        try:
            lock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise PermissionError(*DENIED) from None

    msvcrt = types.ModuleType("msvcrt")
    msvcrt.locking, msvcrt.LK_NBLCK = locking, 2  # type: ignore[attr-defined]
    sys.modules["msvcrt"] = msvcrt
    os.open, os.fsync = open_file, fsync
    os.O_BINARY = 0  # type: ignore[attr-defined]
    os.replace = _unless_in_use(os.replace)
    os.rename = _unless_in_use(os.rename)
    os.unlink = os.remove = _unless_in_use(os.unlink)
    shutil._use_fd_functions = False  # type: ignore[attr-defined]
    tempfile.TemporaryFile = tempfile.NamedTemporaryFile  # type: ignore[assignment]


def _unless_in_use(action: Callable[..., None]) -> Callable[..., None]:
    def act(*paths: Any, **named: Any) -> None:
        for path in paths:
            if Path(path).is_file() and os.path.realpath(path) in set(_files_in_use()):
                raise PermissionError(*DENIED, os.fspath(path))
        action(*paths, **named)

    return act


def _files_in_use() -> Iterator[str]:
    """Yield the files that this process has open or mapped."""
    for handle in Path("/proc/self/fd").iterdir():
        try:
            yield str(handle.readlink())
        except OSError:
            continue
    for line in Path("/proc/self/maps").read_text().splitlines():
        yield line.partition("/")[1] + line.partition("/")[2]


class _Entry:
    """One entry of a folder, whose status does not identify the file."""

    def __init__(self, entry: os.DirEntry[str]) -> None:
        self._entry = entry
        self.name, self.path = entry.name, entry.path

    def __getattr__(self, name: str) -> Any:
        return getattr(self._entry, name)

    def stat(self, **named: Any) -> os.stat_result:
        found = list(self._entry.stat(**named))
        found[1] = found[2] = found[3] = 0  # inode, device, links
        return os.stat_result(found)


def _without_folder_numbers() -> None:
    scanning = os.scandir

    class Scan:
        """Iterate over entries, also without a context."""

        def __init__(self, *arguments: Any) -> None:
            with scanning(*arguments) as entries:
                self._entries = iter([_Entry(entry) for entry in entries])

        def __enter__(self) -> Scan:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def __iter__(self) -> Iterator[_Entry]:
            return self._entries

        def __next__(self) -> _Entry:
            return next(self._entries)

        def close(self) -> None:
            pass

    os.scandir = Scan  # type: ignore[assignment,misc]
