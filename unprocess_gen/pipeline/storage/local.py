"""Write a dataset to a folder: unfinished files below ``.work/tmp``, then sync, then rename."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import platform
import re
import shutil
import sys
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from unprocess_gen.core.errors import ConfigError, LockedError
from unprocess_gen.core.files import commit_file, sync
from unprocess_gen.core.locks import LockFile, has_ended, is_held
from unprocess_gen.core.object_store import Item, Result
from unprocess_gen.core.output_paths import enclosing_dataset
from unprocess_gen.pipeline.storage import OWNER, TMP, WORK, cannot_write

DELETERS = 16
"""Threads that delete files."""

DELETED_AT_ONCE = 64
"""Files that a thread deletes before it takes others."""


class LocalStorage:
    """Store a dataset in a folder; the methods are those of `Storage`.

    Parameters
    ----------
    out : Path
        Folder of the dataset.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._lock = LockFile(out / WORK / "lock")
        self._scratch: Path | None = None
        self._owner: LockFile | None = None

    def open(self) -> None:
        """Create the folder; raise ConfigError if it is inside a dataset or cannot be created."""
        dataset = enclosing_dataset(Path(os.path.realpath(self._out)).parent)
        if dataset is not None:
            raise ConfigError(
                f"out={self._out}: is inside the dataset {dataset}; expected a folder outside of it; choose another out"
            )
        try:
            self._out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(error, str(self._out)) from error

    def hold(self) -> None:
        """Lock the folder; raise LockedError if another process holds it, ConfigError if it cannot be written."""
        try:
            (self._out / WORK).mkdir(exist_ok=True)
            self._lock.acquire(wait=False)
        except BlockingIOError:
            raise LockedError(
                f"out={self._out}: another run is writing to it; wait for that run, or choose another out"
            ) from None
        except OSError as error:
            raise cannot_write(error, str(self._out)) from error

    def close(self) -> None:
        """Delete the unfinished files of this process, and release the lock."""
        self._delete_scratch()
        self._lock.release()
        for folder in (TMP, WORK):
            with contextlib.suppress(OSError):  # contains files of an unfinished run, or was deleted
                (self._out / folder).rmdir()

    def _delete_scratch(self) -> None:
        if self._scratch is not None and self._owner is not None:
            self._owner.release()
            shutil.rmtree(self._scratch, ignore_errors=True)
            self._scratch = self._owner = None

    def names(self, folder: str) -> dict[str, int]:
        """Return the entries of a folder: bytes of files, -1 for others; empty if the folder does not exist."""
        try:
            with os.scandir(self._out / folder) as entries:
                return {entry.name: entry.stat().st_size if entry.is_file() else -1 for entry in entries}
        except (FileNotFoundError, NotADirectoryError):
            return {}

    def size(self, name: str) -> int | None:
        """Return the size of a file in bytes, None if there is no such file."""
        path = self._out / name
        return path.stat().st_size if path.is_file() else None

    def read(self, name: str) -> str:
        """Return the text of a file."""
        return self.read_bytes(name).decode()

    def read_bytes(self, name: str) -> bytes:
        """Return the content of a file."""
        with io.FileIO(f"{self._out}/{name}") as stream:  # a merge reads many small files: half the time of pathlib
            return stream.read()

    def fetch(self, name: str) -> Path:
        """Return the file itself."""
        return self._out / name

    def write(self, name: str, text: str) -> None:
        """Write a file durably, or replace it."""
        commit_file(self._written(name, text), self._out / name)

    def create(self, name: str, text: str) -> bool:
        """Write a file durably unless it exists; return whether it was written."""
        temporary, path = self._written(name, text), self._out / name
        sync(temporary)
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
        except OSError:  # a file system without hard links
            try:
                os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            except FileExistsError:
                return False
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        if sys.platform != "win32":  # Windows opens no folders
            sync(path.parent)
        return True

    def _written(self, name: str, text: str) -> Path:
        """Write a text to a new file on the file system of the dataset."""
        temporary = self._out / WORK / f"{Path(name).name}.{uuid.uuid4().hex}.part"
        for folder in (temporary.parent, (self._out / name).parent):
            folder.mkdir(exist_ok=True)
        with temporary.open("w", encoding="utf-8", newline="") as stream:
            stream.write(text)
        return temporary

    def remove(self, name: str) -> None:
        """Remove a file; ignore one that does not exist."""
        (self._out / name).unlink(missing_ok=True)

    def commit(self, file: Path, name: str) -> None:
        """Move a finished file to a name, durably; replace a file of that name."""
        commit_file(file, self._out / name)

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Apply a function to items, one at a time."""
        return map(function, items)

    @property
    def scratch(self) -> Path:
        """Folder for unfinished files, named after host and process for people who look at a run."""
        if self._scratch is None:
            host = re.sub(r"[^A-Za-z0-9.]", "", platform.node())[:40]
            folder = self._out / TMP / f"{host}-{os.getpid()}-{uuid.uuid4().hex[:12]}"
            for part in (folder.parent.parent, folder.parent, folder):
                part.mkdir(exist_ok=True)
            self._owner = LockFile(folder / OWNER)
            self._owner.acquire(wait=False)
            self._scratch = folder
        return self._scratch

    def begin(self) -> None:
        """Create the folder of shards; remove unfinished files of processes of this host that have ended."""
        (self._out / "shards").mkdir(exist_ok=True)
        for name, size in self.names(TMP).items():
            path = self._out / TMP / name
            if size >= 0:
                path.unlink(missing_ok=True)  # version 0.1 had no folders of writers
            elif has_ended(path / OWNER):
                shutil.rmtree(path, ignore_errors=True)

    def remove_work(self, keep_records: bool) -> None:
        """Remove the unfinished files of writers that have ended and, unless they are kept, the records."""
        self._delete_scratch()
        for name, size in self.names(TMP).items():
            path = self._out / TMP / name
            if size < 0 and not is_held(path / OWNER):
                shutil.rmtree(path, ignore_errors=True)
        kept = {Path(TMP).name, self._lock.path.name}
        for name, size in self.names(WORK).items() if not keep_records else ():
            path = self._out / WORK / name
            if name not in kept:
                _delete_folder(path) if size < 0 else path.unlink(missing_ok=True)


def _delete_folder(folder: Path) -> None:
    """Delete a folder and what it contains, its files in threads.

    On a disk that is mounted with ``discard``, a file that was synced takes 0.3 to 2 ms to delete. Threads wait for
    several at a time: 16 of them delete 12,500 files in 0.7 s, one in 3 to 25 s.

    If locks do not work, another coordinator may delete the same files or write more. The last one deletes the rest.
    """
    try:
        with os.scandir(folder) as entries:
            files = [Path(entry.path) for entry in entries if entry.is_file(follow_symlinks=False)]
        batches = [files[first : first + DELETED_AT_ONCE] for first in range(0, len(files), DELETED_AT_ONCE)]
        if len(batches) > 1:
            with ThreadPoolExecutor(DELETERS) as pool:
                for _ in pool.map(_delete_files, batches):
                    pass
        else:
            _delete_files(files)
        shutil.rmtree(folder)
    except FileNotFoundError:
        pass
    except OSError as error:
        if error.errno != errno.ENOTEMPTY:
            raise


def _delete_files(files: Iterable[Path]) -> None:
    for file in files:
        file.unlink(missing_ok=True)
