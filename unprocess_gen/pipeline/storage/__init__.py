"""Write the files of a dataset, and the records of its run, to the place that ``out`` names.

`Storage` is what a run needs of a place; `local` writes to a folder, `remote` to an object store.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Protocol

from unprocess_gen.core.errors import RESUME, ConfigError, UnprocessGenError
from unprocess_gen.core.files import machine_error
from unprocess_gen.core.object_store import Item, ObjectPath, Result, any_path

WORK = ".work"
"""Folder below ``out`` for what a run needs until the dataset is finished."""
OWNER = "owner"
"""Lock file in the folder of a writer, by which others see whether the writer still runs."""

TMP = f"{WORK}/tmp"
"""Folder of unfinished files: one folder for each writer."""


class Storage(Protocol):
    """Read and write files by their names below ``out``, joined by ``/``.

    A file appears under its name complete or not at all. Errors of the system are OSError.
    """

    def open(self) -> None:
        """Create the place; raise ConfigError if it is inside a dataset or cannot be written."""

    def hold(self) -> None:
        """Lock the place, if it has locks; raise LockedError if another process holds it."""

    def close(self) -> None:
        """Delete the unfinished files of this process, and release the lock."""

    def names(self, folder: str) -> dict[str, int]:
        """Return the entries of a folder: bytes of files, -1 for others; empty if the folder does not exist."""

    def size(self, name: str) -> int | None:
        """Return the size of a file in bytes, None if there is no such file."""

    def read(self, name: str) -> str:
        """Return the text of a file; raise FileNotFoundError if there is none."""

    def read_bytes(self, name: str) -> bytes:
        """Return the content of a file; raise FileNotFoundError if there is none."""

    def fetch(self, name: str) -> Path:
        """Return a local file with the content of a file, valid until `close`."""

    def write(self, name: str, text: str) -> None:
        """Write a file durably, or replace it."""

    def create(self, name: str, text: str) -> bool:
        """Write a file durably unless it exists; return whether it was written."""

    def commit(self, file: Path, name: str) -> None:
        """Move a finished file of `scratch` to a name, durably; replace a file of that name."""

    def remove(self, name: str) -> None:
        """Remove a file; ignore one that does not exist."""

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Apply a function that reads files to items; yield the results in order.

        A store that takes long to answer calls the function in threads.
        """

    def begin(self) -> None:
        """Create the folder of shards; remove unfinished files of processes of this host that have ended."""

    def remove_work(self, keep_records: bool) -> None:
        """Remove what only an unfinished run needs, except files of processes that still run.

        With ``keep_records``, remove only unfinished files.
        """

    @property
    def scratch(self) -> Path:
        """Local folder for unfinished files of this process and its workers; created when it is first used."""


def cannot_write(error: OSError, out: str) -> UnprocessGenError:
    """Return the error of a place that cannot be begun: MachineError for a full disk, else ConfigError."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return machine_error(error, any_path(out), RESUME)
    if error.errno == errno.EEXIST:
        return ConfigError(f"out={out}: is a file; expected a folder; choose another out")
    return ConfigError(f"out={out}: cannot be written ({error.strerror}); choose another out")


def open_storage(out: str) -> Storage:
    """Return the storage of a value of ``out``.

    Parameters
    ----------
    out : str
        Folder or URL of the dataset.

    Returns
    -------
    Storage
        Nothing is created before it is opened or written to.
    """
    path = any_path(out)
    if isinstance(path, ObjectPath):
        from unprocess_gen.pipeline.storage.remote import RemoteStorage

        return RemoteStorage(path)
    from unprocess_gen.pipeline.storage.local import LocalStorage

    return LocalStorage(path)
