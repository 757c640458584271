"""Hash, sync and rename files; check relative paths; turn operating-system errors into one sentence."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.object_store import ObjectPath

if TYPE_CHECKING:
    from unprocess_gen.core.arrays import Array

NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors for which the free space of the disk is worth reporting."""


def array_xxh3(array: Array) -> str:
    """XXH3-128 of an array's little-endian bytes, 32 hex digits."""
    import xxhash

    return xxhash.xxh3_128_hexdigest(little_endian(array).data)


def little_endian(array: Array) -> Array:
    """Contiguous little-endian numbers of an array, without a copy if it is that already."""
    import numpy as np  # takes longer than the start of a command may

    from unprocess_gen.core.arrays import DESCRIPTIONS

    return np.ascontiguousarray(array, dtype=DESCRIPTIONS[array.dtype.name])


def file_sha256(path: Path | ObjectPath) -> str:
    """SHA-256 of a file, 64 hex digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def machine_error(error: OSError, path: Path | ObjectPath, advice: str = "") -> MachineError:
    """Describe a failed file operation in one sentence: path, reason, free space if it matters, and ``advice``.

    ``path`` is the file or folder in use, for errors that name none.
    """
    reason = error.strerror or str(error)
    if error.errno in NO_SPACE and isinstance(path, Path):
        with suppress(OSError):
            reason += f" ({free_bytes(path)} bytes free)"
    if error.errno == errno.ENOENT and not path.exists():
        reason += f" ({path} was deleted or moved)"
    return MachineError(f"{error.filename or path}: {reason}" + (f"; {advice}" if advice else ""))


@contextmanager
def machine_errors(path: Path | ObjectPath, advice: str = "") -> Iterator[None]:
    """Raise each OSError of the body as MachineError; arguments as in `machine_error`."""
    try:
        yield
    except OSError as error:
        raise machine_error(error, path, advice) from error


def write_file(file: Path, content: bytes | str) -> None:
    """Write a file and its folder, or replace it; MachineError if that fails."""
    with machine_errors(file.parent):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content.encode() if isinstance(content, str) else content)


def free_bytes(path: Path) -> int:
    """Bytes that are free for an unprivileged user on the disk of a path, or of its nearest parent that exists."""
    path = Path(os.path.abspath(path))
    while not path.exists() and path != path.parent:
        path = path.parent
    return shutil.disk_usage(path).free


def sync_folder(folder: Path) -> None:
    """Make the renames in a folder survive a loss of power; Windows, which opens no folders, does so by itself."""
    if sys.platform != "win32":
        sync(folder)


def sync(path: Path) -> None:
    """Make a file's contents, or a folder's renames, survive a loss of power."""
    # Windows syncs only what it may write
    handle = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def leads_outside(path: str) -> bool:
    """True if a relative path with ``/`` between its segments is absolute or contains ``..``.

    On Windows, backslashes separate segments too, and a drive leads outside.
    """
    path = path.replace(os.sep, "/")
    return path.startswith("/") or ".." in path.split("/") or os.path.splitdrive(path)[0] != ""
