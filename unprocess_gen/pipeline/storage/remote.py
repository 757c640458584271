"""Write a dataset to an object store: unfinished files in local temporary space, then one PUT for each finished file.

Object stores have no rename and no locks, and need neither: an object appears under its key complete or not at all,
``config.yaml`` and the record of the sources are created only if they do not exist, and any number of writers may put
the same shard, because all of them make the same bytes.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.locks import LockFile, has_ended
from unprocess_gen.core.object_store import Item, ObjectPath, Result, StoreAccessError, in_threads, local_copy
from unprocess_gen.pipeline.storage import OWNER, WORK

PREFIX = "unprocess_gen-"
"""Beginning of the names of temporary folders, by which a later run on this host finds those that a kill left."""

MARKS = ("dataset.json", f"{WORK}/listing.json")
"""Objects of a dataset, finished or begun."""


class RemoteStorage:
    """Store a dataset below a URL; the methods are those of `Storage`.

    Parameters
    ----------
    out : ObjectPath
        URL of the dataset.
    """

    def __init__(self, out: ObjectPath) -> None:
        self._out = out
        self._scratch: Path | None = None
        self._owner: LockFile | None = None

    def open(self) -> None:
        """Check that the bucket exists and that no prefix above is a dataset; raise ConfigError otherwise."""
        try:
            self._out.is_dir()
            for folder in self._parents():
                if any((folder / mark).is_file() for mark in MARKS):
                    raise ConfigError(
                        f"out={self._out}: is inside the dataset {folder}; expected a prefix outside of it; choose "
                        "another out"
                    )
        except StoreAccessError as error:
            raise ConfigError(f"out={error}") from None

    def _parents(self) -> Iterator[ObjectPath]:
        folder = self._out
        while folder.key:
            folder = folder.parent
            yield folder

    def hold(self) -> None:
        """Do nothing: object stores have no locks."""

    def close(self) -> None:
        """Delete the unfinished files of this process."""
        if self._scratch is not None and self._owner is not None:
            self._owner.release()
            shutil.rmtree(self._scratch, ignore_errors=True)
            self._scratch = self._owner = None

    def names(self, folder: str) -> dict[str, int]:
        """Return the entries below a prefix: bytes of objects, -1 for prefixes."""
        return self._below(folder).entries()

    def size(self, name: str) -> int | None:
        """Return the size of an object in bytes, None if there is no such object."""
        facts = (self._out / name).facts()
        return None if facts is None else facts.size

    def read(self, name: str) -> str:
        """Return the text of an object."""
        return self.read_bytes(name).decode()

    def read_bytes(self, name: str) -> bytes:
        """Return the content of an object."""
        return (self._out / name).read_bytes()

    def fetch(self, name: str) -> Path:
        """Return a copy of an object in `scratch`."""
        file = self.scratch / Path(name).name
        with local_copy(self._out / name) as copy:
            shutil.move(copy, file)
        return file

    def write(self, name: str, text: str) -> None:
        """Write an object, or replace it."""
        (self._out / name).write_bytes(text.encode())

    def create(self, name: str, text: str) -> bool:
        """Write an object unless it exists; return whether it was written."""
        return (self._out / name).create(text.encode())

    def commit(self, file: Path, name: str) -> None:
        """Put a finished file and delete it; replace an object of that name."""
        (self._out / name).put_file(file)
        file.unlink()

    def remove(self, name: str) -> None:
        """Remove an object; ignore one that does not exist."""
        (self._out / name).delete()

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Apply a function that reads objects to items, several at a time; yield the results in order."""
        return in_threads(function, items)

    @property
    def scratch(self) -> Path:
        """Folder for unfinished files in the local temporary space (``TMPDIR``)."""
        if self._scratch is None:
            folder = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{os.getpid()}-"))
            self._owner = LockFile(folder / OWNER)
            self._owner.acquire(wait=False)
            self._scratch = folder
        return self._scratch

    def begin(self) -> None:
        """Remove unfinished files of processes of this host that have ended; a prefix needs no creation."""
        for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
            if (folder / OWNER).exists() and has_ended(folder / OWNER):
                shutil.rmtree(folder, ignore_errors=True)

    def remove_work(self, keep_records: bool) -> None:
        """Remove the unfinished files of this process and, unless they are kept, the records of the run."""
        self.close()
        if not keep_records:
            self._below(WORK).delete_all()

    def _below(self, folder: str) -> ObjectPath:
        return self._out / folder if folder else self._out
