"""Locks: one owner at a time; the lock of a process that has ended is free."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import filelock
import pytest

from unprocess_gen.core.locks import LockFile

HOLDS = """
import sys
from pathlib import Path
from unprocess_gen.core.locks import LockFile

lock = LockFile(Path(sys.argv[1]))
lock.acquire(wait=False)
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "lock"


def test_lock_has_one_owner_and_is_free_after_release(path: Path) -> None:
    first, second = LockFile(path), LockFile(path)
    assert first.acquire(wait=False)
    with pytest.raises(BlockingIOError):
        second.acquire(wait=False)
    second.release()
    assert path.exists()
    first.release()
    assert second.acquire(wait=True)
    second.release()
    assert not path.exists()


@pytest.mark.linux_only("kills a process by a signal")
def test_lock_of_a_killed_process_is_free_at_once(path: Path) -> None:
    pipe, lock = subprocess.PIPE, LockFile(path)
    with subprocess.Popen([sys.executable, "-c", HOLDS, str(path)], stdin=pipe, stdout=pipe) as owner:
        assert owner.stdout is not None and owner.stdout.readline() == b"held\n"
        with pytest.raises(BlockingIOError):
            lock.acquire(wait=False)
        owner.kill()
    assert lock.acquire(wait=False)
    lock.release()
    assert os.listdir(path.parent) == []


def test_file_system_without_locks_is_no_error(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(filelock.FileLock, "acquire", refuse)
    lock = LockFile(path)
    assert not lock.acquire(wait=False)
    lock.release()
