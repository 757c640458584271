"""Address local files and objects of a store by paths with one set of methods: list, open, stat, commit.

`any_path` decides once, from the text that a user wrote, whether a path is local. A `LocalPath` is a `pathlib.Path`. An
`ObjectPath` is the URL of an object, or of all objects below a prefix. Both list with `entries` and `walk`, open with
`open` and `open_listed`, and write a file completely or not at all with `write`, `create` and `commit`.
"""

from __future__ import annotations

import errno
import io
import mmap
import os
import shutil
import stat
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from unprocess_gen.core.entries import Entry, EntryKind, Item, Result, hidden_part
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import sync, sync_folder
from unprocess_gen.core.object_store import ObjectPath, is_url

# A pipe that replaced a listed file must not block the open for ever.
_OPEN_FLAGS = os.O_RDONLY
for _flag in ("O_NONBLOCK", "O_CLOEXEC", "O_NOCTTY", "O_BINARY"):  # the last only on Windows, the others only elsewhere
    _OPEN_FLAGS |= getattr(os, _flag, 0)

_Identity = tuple[int, int]
"""Device and inode of a folder."""

if TYPE_CHECKING:
    _NativePath = Path
else:
    _NativePath = type(Path())  # Python 3.11 cannot derive from Path itself


class NotAFileError(OSError, ValueError):
    """Report that a path names something else than a regular file: neither a readable file nor a valid content."""

    def __str__(self) -> str:
        return self.strerror or ""


class LocalPath(_NativePath):
    """Path of a local file or folder, with the methods of `ObjectPath`."""

    if not TYPE_CHECKING:  # Path has the signature

        def open(self, mode="r", *arguments, **options):
            """Open the file; reading neither waits for a pipe nor opens anything else than a regular file."""
            opener = _open_regular if set(mode) <= set("rbt") else None
            return open(self, mode, *arguments, opener=opener, **options)

    def resolve(self, strict: bool = False) -> LocalPath:
        """Path without links; links that form a circle are kept."""
        return LocalPath(os.path.realpath(self, strict=strict))

    def is_listed(self) -> bool:
        """True if a file or folder has this name, also a link to nothing."""
        return os.path.lexists(self)  # also False for a name that is too long

    def entries(self) -> dict[str, int]:
        """Names in this folder: sizes in bytes of files, -1 for others; empty if the folder does not exist."""
        try:
            with os.scandir(self) as entries:
                return {entry.name: entry.stat().st_size if entry.is_file() else -1 for entry in entries}
        except (FileNotFoundError, NotADirectoryError):
            return {}

    def walk_entries(self, recursive: bool = True, enters_hidden: bool = True) -> Iterator[Entry]:
        """Yield every file and folder below this folder, also through links; open no file.

        A folder that contains itself through a link is not entered, nor a hidden one on request. Raises OSError, whose
        ``filename`` is the folder, for a folder that cannot be read.
        """
        # a stack instead of recursion: folders may be nested deeper than Python's call stack
        waiting = [("", frozenset((_identity(self.stat()),)))]
        while waiting:
            folder, ancestors = waiting.pop()
            for entry, identity in _scan(str(self), folder):
                if not enters_hidden and hidden_part(entry.path):
                    entry, identity = Entry(entry.path, None, EntryKind.HIDDEN), None
                if identity in ancestors:
                    yield entry._replace(kind=EntryKind.LOOP)
                    continue
                if identity is not None and recursive:
                    waiting.append((entry.path, ancestors | {identity}))
                yield entry

    def entry(self) -> Entry:
        """Describe this file or folder; raise OSError if there is none."""
        return _entry(self.name, self.stat())

    def size(self) -> int | None:
        """Size of the file in bytes, None if there is no such file."""
        try:
            return self.entry().size
        except (FileNotFoundError, NotADirectoryError):
            return None

    @contextmanager
    def open_listed(self, size: int, etag: str | None = None, start: int = 0) -> Iterator[tuple[BinaryIO, int]]:
        """Open a file at a byte, without waiting for a pipe; yield the open file and its present size.

        Raises NotAFileError unless it is a regular file, OSError if it cannot be opened. A listed size and ETag are not
        compared.
        """
        descriptor = os.open(self, _OPEN_FLAGS)
        try:
            size = _size_of_regular(descriptor)
            os.lseek(descriptor, start, os.SEEK_SET)
            yield os.fdopen(descriptor, "rb", buffering=0, closefd=False), size
        finally:
            os.close(descriptor)

    @contextmanager
    def local_copy(self) -> Iterator[Path]:
        """Provide the file itself."""
        yield self

    def mapped(self, offset: int, size: int) -> tuple[mmap.mmap | bytearray, int]:
        """Map a part of the file copy-on-write; return the mapping and the offset of the part in it."""
        start = offset - offset % mmap.ALLOCATIONGRANULARITY
        skipped = offset - start
        with self.open("rb") as stream:
            return mmap.mmap(stream.fileno(), skipped + size, access=mmap.ACCESS_COPY, offset=start), skipped

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Apply a function that reads files to items, one at a time."""
        return map(function, items)

    def write(self, content: bytes, unfinished: str) -> None:
        """Write the file durably, or replace it; ``unfinished`` is a folder of the same file system."""
        with self._unfinished(content, unfinished) as temporary:
            self.commit(temporary)

    def create(self, content: bytes, unfinished: str) -> bool:
        """Write the file durably unless it exists; return whether it was written."""
        with self._unfinished(content, unfinished) as temporary:
            sync(temporary)
            try:
                os.link(temporary, self)
            except FileExistsError:
                return False
            except OSError:  # a file system without hard links
                try:
                    os.close(os.open(self, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
                except FileExistsError:
                    return False
                os.replace(temporary, self)
        sync_folder(self.parent)
        return True

    @contextmanager
    def _unfinished(self, content: bytes, folder: str) -> Iterator[Path]:
        """Write a temporary file, and delete it unless the body has renamed it."""
        temporary = Path(folder) / f"{self.name}.{uuid.uuid4().hex}.part"
        for place in (temporary.parent, self.parent):
            place.mkdir(exist_ok=True)
        try:
            temporary.write_bytes(content)
            yield temporary
        finally:
            temporary.unlink(missing_ok=True)

    def commit(self, file: Path) -> None:
        """Move a finished file of the same file system here, durably; replace a file of this name."""
        sync(file)
        os.replace(file, self)
        sync_folder(self.parent)

    def delete(self) -> None:
        """Delete the file; ignore one that does not exist."""
        self.unlink(missing_ok=True)

    def delete_all(self) -> None:
        """Delete a file, or a folder and what it contains, as far as possible: another process may write to it."""
        if self.is_dir():
            shutil.rmtree(self, ignore_errors=True)
        else:
            self.delete()

    def scratch_place(self, unfinished: str) -> tuple[Path, str]:
        """Local folder for unfinished files of this folder, and the first letters of the names of its folders."""
        return self / unfinished, ""


AnyPath = Path | ObjectPath
"""What functions take that only read; `any_path` gives it the methods of `LocalPath`."""


def any_path(text: str | os.PathLike[str] | ObjectPath) -> LocalPath | ObjectPath:
    """Path that a text names: an `ObjectPath` only for ``s3://…``, ``gs://…`` and ``az://…``."""
    if isinstance(text, LocalPath | ObjectPath):
        return text
    return ObjectPath(text) if isinstance(text, str) and is_url(text) else LocalPath(text)


def local_path(text: str | AnyPath, refusal: str) -> Path:
    """Local path that a text names; ConfigError with a sentence if it is a URL."""
    path = any_path(text)
    if isinstance(path, ObjectPath):
        raise ConfigError(refusal)
    return path


def absolute_text(text: str | None) -> str | None:
    """Place that does not depend on the current folder; a URL and None stay as they are."""
    return text if text is None or is_url(text) else os.path.abspath(text)


def folder_name(path: AnyPath) -> str:
    """Last part of a folder's path, for ``.`` and ``..`` too."""
    return path.name if isinstance(path, ObjectPath) else path.name or path.resolve().name


def open_text(path: AnyPath) -> io.TextIOWrapper:
    """Open a UTF-8 text file for reading, with its line ends."""
    return io.TextIOWrapper(path.open("rb"), encoding="utf-8", newline="")


def _open_regular(path: str, flags: int) -> int:
    """Open a regular file as `os.open`, without waiting for a pipe."""
    descriptor = os.open(path, flags | _OPEN_FLAGS)
    try:
        _size_of_regular(descriptor)
    except OSError as error:
        os.close(descriptor)
        error.filename = path  # messages name the file, not the folder in use
        raise
    return descriptor


def _size_of_regular(descriptor: int) -> int:
    """Size of an open regular file; NotAFileError for anything else."""
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        raise NotAFileError(errno.EINVAL, f"is {stat.filemode(status.st_mode)}, not a regular file")
    return status.st_size


def _scan(root: str, folder: str) -> Iterator[tuple[Entry, _Identity | None]]:
    """Yield each entry of a folder below the root, with its identity if it is a folder."""
    prefix = folder + "/" if folder else ""
    with os.scandir(os.path.join(root, folder)) as found:
        for item in found:
            try:
                status = item.stat()
                if stat.S_ISDIR(status.st_mode) and not status.st_ino:
                    status = Path(item.path).stat()  # on Windows, DirEntry.stat gives no numbers that identify a folder
            except OSError as error:
                kind = EntryKind.BROKEN_LINK if error.errno in _BROKEN_LINK else EntryKind.UNREADABLE
                yield Entry(prefix + item.name, None, kind, problem=error.strerror or str(error)), None
                continue
            entry = _entry(prefix + item.name, status)
            yield entry, _identity(status) if entry.kind is EntryKind.FOLDER else None


def _identity(status: os.stat_result) -> _Identity:
    return status.st_dev, status.st_ino


_BROKEN_LINK = (errno.ENOENT, errno.ELOOP, errno.ENOTDIR)


def _entry(path: str, status: os.stat_result) -> Entry:
    if stat.S_ISREG(status.st_mode):
        return Entry(path, status.st_size)
    return Entry(path, None, EntryKind.FOLDER if stat.S_ISDIR(status.st_mode) else EntryKind.OTHER)
