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

import msgspec
from msgspec.structs import asdict

from unprocess_gen.core.records import parse_record

POLL_S = 0.05
"""Delay between two attempts while another process holds the lock."""
HEARTBEAT_S = 10.0
"""Time between two renewals of a lock."""
STALE_S = 60.0
"""Age at which the lock of another host is taken over."""


_HELD: set[str] = set()
"""Marks of the locks that this process holds. A file of this process that is not among them could not be deleted."""


class _Owner(msgspec.Struct, frozen=True):
    """Hold the content of a lock file: host and process, when the process started, and the mark of the lock."""

    host: str
    pid: int
    start: str | None
    mark: str


class LockFile:
    """Hold a lock from `acquire` until `release` or the end of the process; ``path`` is in a folder that exists."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._text = self._mark = ""
        self._released = threading.Event()
        self._handle: int | None = None

    def acquire(self, wait: bool) -> None:
        """Create the file; replace one whose owner has ended.

        Raises BlockingIOError if another process holds the lock and ``wait`` is False, OSError if the file cannot be
        created.
        """
        mark = uuid.uuid4().hex
        text = json.dumps(asdict(_Owner(host(), os.getpid(), process_start(os.getpid()), mark)))
        _HELD.add(mark)  # before the file exists: another thread would take it for one that could not be deleted
        try:
            while not self._create(text):
                if self._delete_ended():
                    continue
                if not wait:
                    raise BlockingIOError("is locked by another process")
                time.sleep(POLL_S)
        except BaseException:
            _HELD.discard(mark)
            raise
        self._text, self._mark = text, mark
        self._released.clear()
        threading.Thread(target=self._renew, args=(self._released,), daemon=True).start()

    def release(self) -> None:
        """Delete the file, if this process holds the lock."""
        if not self._text:
            return
        self._released.set()
        _HELD.discard(self._mark)
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None
        with suppress(OSError):  # the folder may have been deleted
            if self.path.read_text(encoding="utf-8") == self._text:
                self.path.unlink()
        self._text = ""

    def _create(self, text: str) -> bool:
        """Create the file with its text; return False if it exists."""
        try:
            handle = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            return False
        try:
            os.write(handle, text.encode())
        except OSError:  # the disk is full
            os.close(handle)
            self.path.unlink()
            raise
        if sys.platform == "win32":
            self._handle = handle
        else:
            os.close(handle)
        return True

    def _delete_ended(self) -> bool:
        """Delete the file if its owner has ended; return False if the owner still runs.

        One process at a time may judge and delete, which a second file decides; otherwise a slow process could delete
        the file of a quicker one.
        """
        if sys.platform == "win32":
            with suppress(PermissionError):
                self.path.unlink(missing_ok=True)
            return not self.path.exists()
        guard = LockFile(self.path.with_name(f"{self.path.name}.takeover"))
        if self.path.exists() and is_held(self.path):
            return False
        if guard._create(""):
            try:
                if self.path.exists() and not is_held(self.path):
                    self.path.unlink(missing_ok=True)
            finally:
                guard.path.unlink(missing_ok=True)
        elif _age_s(guard.path) > STALE_S:  # its process was killed between the lines above
            guard.path.unlink(missing_ok=True)
        else:
            time.sleep(POLL_S)
        return True

    def _renew(self, released: threading.Event) -> None:
        while not released.wait(HEARTBEAT_S):
            with suppress(OSError):
                os.utime(self.path)


def is_held(path: Path) -> bool:
    """True if the owner of a lock file still runs, as far as other processes can see.

    A file that does not exist is held for as long as its folder is younger than `STALE_S`.
    """
    ended = has_ended(path)
    return not ended if ended is not None else _age_s(path) < STALE_S


def has_ended(path: Path) -> bool | None:
    """True if the owner of a lock file has ended, if this host's process table shows it.

    None if the owner ran on another host or is not named, or if this system reports no processes.
    """
    try:
        owner = parse_record(path.read_bytes(), _Owner)
    except (OSError, ValueError):
        return None  # its owner has created the file and not yet written it, or has deleted it
    if owner.host != host():
        return None
    if owner.pid == os.getpid():
        return owner.mark not in _HELD
    start = process_start(owner.pid)
    return None if start is None or owner.start is None else start != owner.start


def _age_s(path: Path) -> float:
    """Time since a file was renewed by the clock of its file system, which may be another machine's."""
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
    """Name of this host; on Linux also its boot and its namespace of processes, because containers can share a name."""
    parts = [platform.node()]
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
        parts.append(str(Path("/proc/self/ns/pid").readlink()))
    return " ".join(parts)


def process_start(pid: int) -> str | None:
    """Time at which a process of this host started, which distinguishes it from later processes of its number.

    Empty if no such process runs, or if the system hides it from this user; None if this system does not report it.
    """
    if platform.system() == "Linux":
        try:
            state, *fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except FileNotFoundError:
            return ""
        return "" if state in "ZX" else fields[18]  # proc(5): field 22 is the start in clock ticks since boot
    if platform.system() == "Darwin":
        listed = subprocess.run(["ps", "-o", "lstart=", "-p", str(pid)], capture_output=True, text=True, check=False)
        return listed.stdout.strip()
    return None
