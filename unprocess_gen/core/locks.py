"""Lock a place with a file, so that two processes do not write to it at the same time.

The file is created only if it does not exist, which is one step on local file systems, NFS and Lustre. It names its
owner: host, process and the time at which the process started. Whether the owner still runs is decided

* on the same host by the process table, at once;
* on another host by a heartbeat: the owner renews the file's modification time every `HEARTBEAT_S` seconds, and its
  lock may be taken over after `STALE_S` seconds without one;
* on Windows by an attempt to delete the file, which its owner keeps open.

A process that is stopped for longer than `STALE_S` can lose its lock. Callers must therefore stay correct with two
owners; `pipeline.workspace` does, because every writer makes the same bytes. Design: ``docs/design/platforms.md``.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import threading
import time
import uuid
from contextlib import suppress
from functools import cache
from pathlib import Path

POLL_S = 0.05
"""Delay between two attempts while another process holds the lock."""
HEARTBEAT_S = 10.0
"""Time between two renewals of a lock."""
STALE_S = 60.0
"""Age at which the lock of another host is taken over."""


_HELD: set[str] = set()
"""Marks of the locks that this process holds. A file of this process that is not among them could not be deleted."""


class LockFile:
    """Hold a lock from `acquire` until `release` or the end of the process.

    Parameters
    ----------
    path : Path
        The file, in a folder that exists.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._text = ""
        self._released = threading.Event()
        self._handle: int | None = None

    @property
    def path(self) -> Path:
        """The file."""
        return self._path

    def acquire(self, wait: bool) -> None:
        """Create the file; replace one whose owner has ended.

        Parameters
        ----------
        wait : bool
            Whether to wait while another process holds the lock.

        Raises
        ------
        BlockingIOError
            If another process holds the lock and ``wait`` is False.
        OSError
            If the file cannot be created.
        """
        mark = uuid.uuid4().hex
        owner = {"host": host(), "pid": os.getpid(), "start": process_start(os.getpid()), "mark": mark}
        self._text = json.dumps(owner)
        _HELD.add(mark)  # before the file exists: another thread would take it for one that could not be deleted
        try:
            while not self._create():
                found = self._holder()
                if found is None:
                    continue
                if not self._is_held():
                    self._remove(found)
                elif not wait:
                    raise BlockingIOError("is locked by another process")
                else:
                    time.sleep(POLL_S)
        except BaseException:
            _HELD.discard(mark)
            self._text = ""
            raise
        self._released.clear()
        threading.Thread(target=self._renew, args=(self._released,), daemon=True).start()

    def release(self) -> None:
        """Delete the file, if this process holds the lock."""
        if not self._text:
            return
        self._released.set()
        _HELD.discard(json.loads(self._text)["mark"])
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None
        with suppress(OSError):  # the folder may have been deleted
            if self._path.read_text(encoding="utf-8") == self._text:
                self._path.unlink()
        self._text = ""

    def _create(self) -> bool:
        """Create the file with its text; return False if it exists."""
        try:
            handle = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            return False
        try:
            os.write(handle, self._text.encode())
        except OSError:  # the disk is full
            os.close(handle)
            self._path.unlink()
            raise
        if sys.platform == "win32":
            self._handle = handle
        else:
            os.close(handle)
        return True

    def _holder(self) -> str | None:
        """Return the text of the file, None if it was deleted meanwhile."""
        try:
            return self._path.read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return None

    def _is_held(self) -> bool:
        if sys.platform != "win32":
            return is_held(self._path)
        else:  # noqa: RET505 - mypy understands the platform of a branch only
            try:
                self._path.unlink()
            except PermissionError:
                return True
            return False

    def _remove(self, found: str) -> None:
        """Remove the file of an owner that has ended, unless another process has replaced it meanwhile.

        One process at a time may compare and remove, which a second file decides; otherwise a slow process could remove
        the file of a quicker one.
        """
        guard = self._path.with_name(f"{self._path.name}.takeover")
        try:
            os.close(os.open(guard, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        except FileExistsError:
            if _age_s(guard) > STALE_S:  # its process was killed between the next lines
                guard.unlink(missing_ok=True)
            time.sleep(POLL_S)
            return
        try:
            if self._holder() == found:
                self._path.unlink(missing_ok=True)
        finally:
            guard.unlink(missing_ok=True)

    def _renew(self, released: threading.Event) -> None:
        while not released.wait(HEARTBEAT_S):
            with suppress(OSError):
                os.utime(self._path)


def is_held(path: Path) -> bool:
    """Return whether the owner of a lock file still runs, as far as other processes can see.

    Parameters
    ----------
    path : Path
        The file; one that does not exist is held for as long as its folder is younger than `STALE_S`.

    Returns
    -------
    bool
        False if the owner has ended, or renewed its lock more than `STALE_S` seconds ago.
    """
    ended = has_ended(path)
    return not ended if ended is not None else _age_s(path) < STALE_S


def has_ended(path: Path) -> bool | None:
    """Return whether the owner of a lock file has ended, if this host's process table shows it.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    bool or None
        None if the owner ran on another host or is not named, or if this system reports no processes.
    """
    try:
        owner = json.loads(path.read_text(encoding="utf-8"))
        if owner["host"] == host() and owner["pid"] == os.getpid() and owner["mark"] in _HELD:
            return False
        if owner["host"] == host() and owner["pid"] == os.getpid():
            return True
        start = process_start(int(owner["pid"])) if owner["host"] == host() else None
        if start is not None and owner["start"] is not None:
            return bool(start != owner["start"])
    except (OSError, ValueError, KeyError, TypeError):
        pass  # its owner has created the file and not yet written it, or has deleted it
    return None


def _age_s(path: Path) -> float:
    """Return the time since a file was renewed by the clock of its file system, which may be another machine's."""
    try:
        renewed = path.stat().st_mtime
    except FileNotFoundError:
        renewed = path.parent.stat().st_mtime
    probe = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    try:
        probe.touch()
        return probe.stat().st_mtime - renewed
    finally:
        probe.unlink(missing_ok=True)


@cache
def host() -> str:
    """Return what identifies this host and its process numbers.

    Returns
    -------
    str
        Name of the host; on Linux also its boot and its namespace of process numbers, because containers can share a
        name.
    """
    parts = [platform.node()]
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
        parts.append(str(Path("/proc/self/ns/pid").readlink()))
    return " ".join(parts)


def process_start(pid: int) -> str | None:
    """Return when a process started, which distinguishes it from later processes of its number.

    Parameters
    ----------
    pid : int
        Number of a process of this host.

    Returns
    -------
    str or None
        Empty if no such process runs; None if this system does not report it, or hides the process from this user.
    """
    if platform.system() == "Linux":
        try:
            state, *fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return None if _exists(pid) else ""
        return "" if state in "ZX" else fields[18]  # proc(5): field 22 is the start in clock ticks since boot
    if platform.system() == "Darwin":
        listed = subprocess.run(["ps", "-o", "lstart=", "-p", str(pid)], capture_output=True, text=True, check=False)
        return listed.stdout.strip()
    return None


def _exists(pid: int) -> bool:
    """Return whether a process exists, also one of another user in a ``/proc`` mounted with ``hidepid``."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
