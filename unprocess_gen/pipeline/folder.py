"""Write below ``out``, a folder or a prefix of an object store: lock it, keep unfinished files, finish a dataset.

    out/config.yaml              the resolved config (`run`)
    out/.work/run.json           what all processes of a run agree on (`run`), and the listing next to it
    out/.work/rows/00000.json    record of a shard that is done (`tasks`)
    out/.work/deaths/00000       deaths of workers at a shard (`deaths`)
    out/.work/tmp/WRITER/        unfinished files of one writer, which it deletes when it ends; if killed, a later run
    out/.work/*.part             small files that are being written
    out/.work/lock               the process that runs (local or Dask; not a part), merges or repairs
    out/shards/                  complete shards
    out/manifest.csv             written once every shard has a record
    out/dataset.json             written last; then .work is deleted, unless a row is provisional

Object stores have no rename and no locks, and need neither: an object appears complete or not at all, and any number of
writers may put the same shard, because all of them make the same bytes. Unfinished files for an object store are in the
local temporary folder. Design: ``docs/design/pipeline.md``.
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
from typing import Any

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.entries import Result
from unprocess_gen.core.errors import RESUME, ConfigError, DamageError, LockedError, MachineError, UnprocessGenError
from unprocess_gen.core.files import machine_error
from unprocess_gen.core.locks import LockFile
from unprocess_gen.core.object_store import ObjectPath, StoreAccessError
from unprocess_gen.core.output_paths import is_dataset
from unprocess_gen.core.paths import LocalPath, any_path
from unprocess_gen.core.records import MAX_BYTES
from unprocess_gen.dataset.dataset_json import check_format, read_dataset

WORK = ".work"
"""Folder below ``out`` for what a run needs until the dataset is finished."""

TMP = f"{WORK}/tmp"
"""Folder of unfinished files: for each writer a folder, and a lock file that shows whether it still runs."""

LOCK = "lock"

REPORT = "report.html"
"""The page of a dataset, a file in its folder that is not part of the dataset."""


class OutFolder:
    """The place of a dataset; ``folder / name`` is the path of a file. Nothing is created before `open` or a write.

    A file appears under its name complete or not at all, except deaths. Errors of the system are OSError.
    """

    def __init__(self, out: str | os.PathLike[str] | ObjectPath) -> None:
        self.path = any_path(out)
        self._lock = None if isinstance(self.path, ObjectPath) else LockFile(self.path / WORK / LOCK)
        self._writer: LockFile | None = None

    def __str__(self) -> str:
        return str(self.path)

    def __truediv__(self, name: str) -> LocalPath | ObjectPath:
        return self.path / name

    def __enter__(self) -> OutFolder:
        return self

    def __exit__(self, *_: object) -> None:
        """Delete the unfinished files of this process, and release the lock."""
        self._delete_scratch()
        if self._lock is not None:
            self._lock.release()
            for folder in (self._lock.path.parent / "tmp", self._lock.path.parent):
                with contextlib.suppress(OSError):  # contains files of an unfinished run, or was deleted
                    folder.rmdir()

    def open(self) -> None:
        """Create the place; ConfigError if it is inside a dataset, contains foreign files or cannot be created."""
        try:
            dataset = next((folder for folder in self.path.resolve().parents if is_dataset(folder)), None)
            if dataset is not None:
                raise ConfigError(
                    f"out={self}: is inside the dataset {dataset}; expected a folder outside of it; choose another out"
                )
            self.path.mkdir(parents=True, exist_ok=True)
        except StoreAccessError as error:
            raise ConfigError(f"out={error}") from None
        except OSError as error:
            raise self.cannot_write(error) from error
        check_format(self.path)
        entries = self.path.entries()
        foreign = sorted(entries.keys() - {WORK})
        if foreign and "config.yaml" not in entries:
            raise ConfigError(
                f"out={self}: contains {foreign[0]}, but no config.yaml; expected an empty folder or a dataset; "
                "choose another out"
            )

    def lock(self) -> None:
        """Lock a folder; LockedError if another process holds it, ConfigError if it cannot be written."""
        if self._lock is None:
            return
        try:
            self._lock.path.parent.mkdir(exist_ok=True)
            self._lock.acquire(wait=False)
        except BlockingIOError:
            raise LockedError(
                f"out={self}: another run is writing to it; wait for that run, or choose another out"
            ) from None
        except OSError as error:
            raise self.cannot_write(error) from error

    def finished(self) -> dict[str, Any] | None:
        """Contents of ``dataset.json``; None without one, or if a row is provisional. DamageError if it is damaged."""
        if (self / "dataset.json").size() is None:
            return None
        check_format(self.path)
        try:
            facts = read_dataset(self / "dataset.json")
        except DamageError as error:
            raise DamageError(f"{error}; gen-dataset verify {self} --repair restores it") from error
        return None if any(entry.get("provisional") for entry in facts["shards"]) else facts

    def cannot_write(self, error: OSError) -> UnprocessGenError:
        """Error of a place that cannot be begun: MachineError for a full disk, else ConfigError."""
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return machine_error(error, self.path, RESUME)
        if error.errno == errno.EEXIST:
            return ConfigError(f"out={self}: is a file; expected a folder; choose another out")
        return ConfigError(f"out={self}: cannot be written ({error.strerror}); choose another out")

    # ------------------------------------------------------------------------------------------------ files of a run

    def read(self, name: str, most: int = MAX_BYTES) -> bytes:
        """Content of a regular file of at most ``most`` bytes; FileNotFoundError if there is none."""
        path = self / name
        if isinstance(path, LocalPath) and (path.size() or 0) > most:
            raise ValueError(f"more than {most} bytes")
        return path.read_bytes()

    def record(self, name: str, parse: Callable[[bytes], Result], most: int = MAX_BYTES) -> Result | None:
        """Parse a file of the run, None without one; MachineError if it, or ``parse`` with a ValueError, fails."""
        try:
            return parse(self.read(name, most))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise MachineError(
                f"{self}/{name}: cannot be read ({error_in_one_line(error)}); delete {self}/{WORK} and run again"
            ) from error

    def write(self, name: str, content: bytes) -> None:
        """Write a file durably, or replace it."""
        (self / name).write(content, f"{self}/{WORK}")

    def create(self, name: str, content: bytes) -> bool:
        """Write a file durably unless it exists; True if it was written."""
        return (self / name).create(content, f"{self}/{WORK}")

    @property
    def scratch(self) -> Path:
        """Local folder for unfinished files of this process and its workers, named after host and process."""
        if self._writer is None:
            place, prefix = self.path.scratch_place(TMP)
            place.mkdir(parents=True, exist_ok=True)
            host = re.sub(r"[^A-Za-z0-9.]", "", platform.node())[:40]
            writer = LockFile(place / f"{prefix}{host}-{os.getpid()}-{uuid.uuid4().hex[:12]}.lock")
            writer.acquire(wait=True)  # another process may look at the new file
            writer.path.with_suffix("").mkdir(mode=0o700)
            self._writer = writer
        return self._writer.path.with_suffix("")

    def _delete_scratch(self) -> None:
        if self._writer is not None:
            shutil.rmtree(self._writer.path.with_suffix(""), ignore_errors=True)
            self._writer.release()
            self._writer = None

    def delete_unfinished(self) -> None:
        """Delete the unfinished files of writers that have ended; where there are no locks, a user deletes them."""
        place, prefix = self.path.scratch_place(TMP)
        for path in place.glob(f"{prefix}*.lock"):
            writer = LockFile(path)
            with contextlib.suppress(OSError):  # it still runs
                if writer.acquire(wait=False):
                    shutil.rmtree(path.with_suffix(""), ignore_errors=True)
            writer.release()

    def remove_work(self) -> None:
        """Remove the records of a finished run, and the unfinished files of writers that have ended."""
        self._delete_scratch()
        self.delete_unfinished()
        for name in (self / WORK).entries():
            if name == LOCK and self._lock is not None:
                with contextlib.suppress(OSError):  # held; a lock that was left is deleted when this one is released
                    self._lock.acquire(wait=False)
            elif name != Path(TMP).name:
                (self / f"{WORK}/{name}").delete_all()
