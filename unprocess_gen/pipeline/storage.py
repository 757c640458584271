"""Hold the place that ``out`` names for a run: check and lock it, and write its files and the records of the run.

Unfinished files for a folder are below ``.work/tmp``, for an object store in the local temporary folder. Object stores
have no rename and no locks, and need neither. An object appears under its key complete or not at all,
``config.yaml`` and the record of the sources are created only if they do not exist, and any number of writers may put
the same shard, because all of them make the same bytes.
"""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import re
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.entries import Result
from unprocess_gen.core.errors import RESUME, ConfigError, LockedError, MachineError, UnprocessGenError
from unprocess_gen.core.files import machine_error
from unprocess_gen.core.locks import LockFile
from unprocess_gen.core.object_store import ObjectPath, StoreAccessError
from unprocess_gen.core.output_paths import is_dataset
from unprocess_gen.core.paths import LocalPath, any_path
from unprocess_gen.core.records import MAX_BYTES

WORK = ".work"
"""Folder below ``out`` for what a run needs until the dataset is finished."""

TMP = f"{WORK}/tmp"
"""Folder of unfinished files: for each writer a folder, and a lock file that shows whether it still runs."""

LOCK = "lock"


class Storage:
    """Read and write files by their names below ``out``, joined by ``/``.

    A file appears under its name complete or not at all. Errors of the system are OSError. Nothing is created before
    the storage is opened or written to.

    Parameters
    ----------
    out : str or path
        Folder or URL of the dataset.

    Attributes
    ----------
    path : LocalPath or ObjectPath
        The place; ``storage / name`` is the path of a file below it.
    """

    def __init__(self, out: str | os.PathLike[str] | ObjectPath) -> None:
        self.out = str(out)
        self.path = any_path(out)
        self._lock = None if isinstance(self.path, ObjectPath) else LockFile(self.path / WORK / LOCK)
        self._owner: LockFile | None = None

    def open(self) -> None:
        """Create the place; raise ConfigError if it is inside a dataset or cannot be created."""
        try:
            dataset = next((folder for folder in self.path.resolve().parents if is_dataset(folder)), None)
            if dataset is not None:
                raise ConfigError(
                    f"out={self.path}: is inside the dataset {dataset}; expected a folder outside of it; choose "
                    "another out"
                )
            self.path.mkdir(parents=True, exist_ok=True)
        except StoreAccessError as error:
            raise ConfigError(f"out={error}") from None
        except OSError as error:
            raise cannot_write(error, str(self.path)) from error

    def hold(self) -> None:
        """Lock a folder; raise LockedError if another process holds it, ConfigError if it cannot be written."""
        if self._lock is None:
            return
        try:
            self._lock.path.parent.mkdir(exist_ok=True)
            self._lock.acquire(wait=False)
        except BlockingIOError:
            raise LockedError(
                f"out={self.path}: another run is writing to it; wait for that run, or choose another out"
            ) from None
        except OSError as error:
            raise cannot_write(error, str(self.path)) from error

    def close(self) -> None:
        """Delete the unfinished files of this process, and release the lock."""
        self.delete_scratch()
        if self._lock is not None:
            self._lock.release()
            for folder in (self._lock.path.parent / "tmp", self._lock.path.parent):
                with contextlib.suppress(OSError):  # contains files of an unfinished run, or was deleted
                    folder.rmdir()

    def __truediv__(self, name: str) -> LocalPath | ObjectPath:
        return self.path / name

    def read(self, name: str) -> str:
        """Return the text of a file; raise FileNotFoundError if there is none."""
        return self.read_bytes(name).decode()

    def read_bytes(self, name: str) -> bytes:
        """Return the content of a regular file of at most `MAX_BYTES`; raise FileNotFoundError if there is none."""
        path = self / name
        if isinstance(path, LocalPath) and (path.size() or 0) > MAX_BYTES:
            raise ValueError(f"more than {MAX_BYTES} bytes")
        return path.read_bytes()

    def record(self, name: str, parse: Callable[[bytes], Result]) -> Result:
        """Read a file of the run; MachineError if that, or ``parse`` with a ValueError, fails."""
        try:
            return parse(self.read_bytes(name))
        except (OSError, ValueError) as error:
            if isinstance(error, FileNotFoundError) and not self.path.exists():
                raise  # out was deleted, which the caller reports
            raise self.unusable(name, error_in_one_line(error)) from error

    def unusable(self, name: str, problem: str) -> MachineError:
        """Error of a file of the run that was edited or damaged."""
        return MachineError(f"{self.out}/{name}: cannot be read ({problem}); delete {self.out}/{WORK} and run again")

    def write(self, name: str, text: str) -> None:
        """Write a file durably, or replace it."""
        (self / name).write(text.encode(), f"{self.path}/{WORK}")

    def create(self, name: str, text: str) -> bool:
        """Write a file durably unless it exists; return whether it was written."""
        return (self / name).create(text.encode(), f"{self.path}/{WORK}")

    @property
    def scratch(self) -> Path:
        """Local folder for unfinished files of this process and its workers, named after host and process."""
        if self._owner is None:
            place, prefix = self.path.scratch_place(TMP)
            place.mkdir(parents=True, exist_ok=True)
            host = re.sub(r"[^A-Za-z0-9.]", "", platform.node())[:40]
            owner = LockFile(place / f"{prefix}{host}-{os.getpid()}-{uuid.uuid4().hex[:12]}.lock")
            owner.acquire(wait=True)  # another process may look at the new file
            owner.path.with_suffix("").mkdir(mode=0o700)
            self._owner = owner
        return self._owner.path.with_suffix("")

    def delete_scratch(self) -> None:
        """Delete the unfinished files of this process and its workers."""
        if self._owner is not None:
            shutil.rmtree(self._owner.path.with_suffix(""), ignore_errors=True)
            self._owner.release()
            self._owner = None

    def begin(self) -> None:
        """Create the folder of shards; remove unfinished files of writers that have ended."""
        (self / "shards").mkdir(exist_ok=True)
        self._delete_ended()

    def remove_work(self, keep_records: bool) -> None:
        """Remove the unfinished files of writers that have ended and, unless they are kept, the records of the run."""
        self.delete_scratch()
        self._delete_ended()
        for name in (self / WORK).entries() if not keep_records else ():
            if name not in (Path(TMP).name, LOCK):
                (self / f"{WORK}/{name}").delete_all()

    def _delete_ended(self) -> None:
        """Delete the unfinished files of writers that have ended; where there are no locks, a user deletes them."""
        place, prefix = self.path.scratch_place(TMP)
        for path in place.glob(f"{prefix}*.lock"):
            owner = LockFile(path)
            with contextlib.suppress(OSError):  # it still runs
                if owner.acquire(wait=False):
                    shutil.rmtree(path.with_suffix(""), ignore_errors=True)
            owner.release()


def cannot_write(error: OSError, out: str) -> UnprocessGenError:
    """Return the error of a place that cannot be begun: MachineError for a full disk, else ConfigError."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return machine_error(error, any_path(out), RESUME)
    if error.errno == errno.EEXIST:
        return ConfigError(f"out={out}: is a file; expected a folder; choose another out")
    return ConfigError(f"out={out}: cannot be written ({error.strerror}); choose another out")
