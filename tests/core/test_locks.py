"""Locks: one owner at a time, on one host and across hosts; a lock whose owner has ended is taken over."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from unprocess_gen.core import locks
from unprocess_gen.core.locks import STALE_S, LockFile, has_ended, is_held, process_start

HOLDS = """
import sys, time
from pathlib import Path
from unprocess_gen.core.locks import LockFile

lock = LockFile(Path(sys.argv[1]))
lock.acquire(wait=False)
print("held", flush=True)
time.sleep(600)
"""

COUNTS = """
import sys
from pathlib import Path
from unprocess_gen.core.locks import LockFile

counter = Path(sys.argv[2])
for _ in range(20):
    lock = LockFile(Path(sys.argv[1]))
    lock.acquire(wait=True)
    counter.write_text(str(int(counter.read_text()) + 1))
    lock.release()
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "lock"


def of_another_host(path: Path, age_s: float) -> None:
    path.write_text(json.dumps({"host": "elsewhere", "pid": os.getpid(), "start": "1", "mark": "0"}))
    os.utime(path, (time.time() - age_s, time.time() - age_s))


def test_lock_has_one_owner_and_is_free_after_release(path: Path) -> None:
    first, second = LockFile(path), LockFile(path)
    first.acquire(wait=False)
    with pytest.raises(BlockingIOError):
        second.acquire(wait=False)
    first.release()
    second.acquire(wait=True)
    second.release()
    first.release()
    assert not path.exists()


@pytest.mark.linux_only("reads the process table")
def test_lock_of_a_killed_process_is_taken_over_at_once(path: Path) -> None:
    owner = subprocess.Popen([sys.executable, "-c", HOLDS, str(path)], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None and owner.stdout.readline() == "held\n"
    with pytest.raises(BlockingIOError):
        LockFile(path).acquire(wait=False)
    owner.send_signal(signal.SIGKILL)
    owner.wait()
    owner.stdout.close()
    lock = LockFile(path)
    lock.acquire(wait=False)
    lock.release()
    assert os.listdir(path.parent) == []


@pytest.mark.linux_only("reads the process table")
def test_later_process_of_the_same_number_is_no_owner(path: Path) -> None:
    path.write_text(json.dumps({"host": locks.host(), "pid": os.getpid(), "start": "1", "mark": "0"}))
    assert has_ended(path)


def test_lock_that_could_not_be_deleted_does_not_block_its_process(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock = LockFile(path)
    lock.acquire(wait=False)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            lock.release()
    lock.acquire(wait=False)
    lock.release()


@pytest.mark.linux_only("reads the process table")
def test_process_that_was_not_waited_for_has_ended() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    while process_start(process.pid):
        time.sleep(0.01)
    assert process_start(process.pid) == ""
    process.wait()


@pytest.mark.linux_only("reads the process table")
def test_process_of_an_unknown_start_is_judged_by_its_heartbeat(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "process_start", lambda pid: None)
    path.write_text(json.dumps({"host": locks.host(), "pid": 1, "start": "1", "mark": "0"}))
    assert has_ended(path) is None
    assert is_held(path)


def test_lock_of_another_host_is_held_while_it_is_renewed(path: Path) -> None:
    of_another_host(path, age_s=STALE_S - 30)
    assert has_ended(path) is None
    assert is_held(path)
    with pytest.raises(BlockingIOError):
        LockFile(path).acquire(wait=False)


def test_lock_of_another_host_is_taken_over_without_a_heartbeat(path: Path) -> None:
    of_another_host(path, age_s=STALE_S + 1)
    lock = LockFile(path)
    lock.acquire(wait=False)
    lock.release()


def test_owner_renews_its_lock(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "HEARTBEAT_S", 0.01)
    lock = LockFile(path)
    lock.acquire(wait=False)
    os.utime(path, (0, 0))
    while path.stat().st_mtime == 0:
        time.sleep(0.01)
    lock.release()


def test_release_keeps_the_lock_of_another_owner(path: Path) -> None:
    lock = LockFile(path)
    lock.acquire(wait=False)
    of_another_host(path, age_s=0)
    lock.release()
    assert "elsewhere" in path.read_text()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"host": 1}'])
def test_unreadable_lock_is_held_until_it_is_old(text: str, path: Path) -> None:
    path.write_text(text)
    assert is_held(path)
    os.utime(path, (0, 0))
    assert not is_held(path)


def test_several_processes_take_turns(path: Path, tmp_path: Path) -> None:
    counter = tmp_path / "counter"
    counter.write_text("0")
    command = [sys.executable, "-c", COUNTS, str(path), str(counter)]
    processes = [subprocess.Popen(command) for _ in range(3)]
    assert [process.wait() for process in processes] == [0, 0, 0]
    assert counter.read_text() == "60"


def test_several_threads_take_over_one_lock_in_turn(path: Path) -> None:
    of_another_host(path, age_s=STALE_S + 1)
    owners: list[LockFile] = []

    def take() -> None:
        lock = LockFile(path)
        try:
            lock.acquire(wait=False)
        except BlockingIOError:
            return
        owners.append(lock)

    threads = [threading.Thread(target=take) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(owners) == 1
    owners[0].release()
