"""Hash, sync and rename files; check relative paths; turn operating-system errors into one sentence."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import xxhash

from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.object_store import AnyPath
from unprocess_gen.core.types import DESCRIPTIONS, Frame

NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors for which the free space of the disk is worth reporting."""


def array_xxh3(array: Frame) -> str:
    """Return the XXH3-128 of an array's little-endian bytes.

    Parameters
    ----------
    array : ndarray
        Any shape; of a dtype that a dataset can hold.

    Returns
    -------
    str
        32 hex digits.
    """
    return xxhash.xxh3_128_hexdigest(little_endian(array).data)


def little_endian(array: Frame) -> Frame:
    """Return an array as contiguous little-endian numbers.

    Parameters
    ----------
    array : ndarray
        Any shape; of a dtype that a dataset can hold.

    Returns
    -------
    ndarray
        The array itself if it is contiguous and little-endian, a copy otherwise.
    """
    return np.ascontiguousarray(array, dtype=DESCRIPTIONS[array.dtype.name])


def file_sha256(path: AnyPath) -> str:
    """Return the SHA-256 of a file.

    Parameters
    ----------
    path : Path or ObjectPath
        The file.

    Returns
    -------
    str
        64 hex digits.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def machine_error(error: OSError, path: AnyPath, advice: str = "") -> MachineError:
    """Turn a failed file operation into one sentence: which path, why, and how much space is free if it matters.

    Parameters
    ----------
    error : OSError
        What the operating system reported.
    path : Path or ObjectPath
        The file or folder in use, for errors that name none.
    advice : str
        What to do, appended to the sentence.

    Returns
    -------
    MachineError
        For the caller to raise.
    """
    reason = error.strerror or str(error)
    if error.errno in NO_SPACE and isinstance(path, Path):
        with suppress(OSError):
            reason += f" ({free_bytes(path)} bytes free)"
    if error.errno == errno.ENOENT and not path.exists():
        reason += f" ({path} was deleted or moved)"
    return MachineError(f"{error.filename or path}: {reason}" + (f"; {advice}" if advice else ""))


def free_bytes(path: Path) -> int:
    """Return the bytes that are free on the disk of a path.

    Parameters
    ----------
    path : Path
        A file or folder; if it does not exist, its nearest parent that does is used.

    Returns
    -------
    int
        Free bytes for an unprivileged user.
    """
    path = Path(os.path.abspath(path))
    while not path.exists() and path != path.parent:
        path = path.parent
    return shutil.disk_usage(path).free


def commit_file(temporary: Path, path: Path) -> None:
    """Rename a finished file to its final name, durably; a file of that name is replaced.

    Parameters
    ----------
    temporary : Path
        The finished file, on the same file system.
    path : Path
        Its final name.
    """
    sync(temporary)
    os.replace(temporary, path)
    if sys.platform != "win32":  # Windows opens no folders
        sync(path.parent)


def sync(path: Path) -> None:
    """Make a file's contents, or a folder's renames, survive a loss of power.

    Parameters
    ----------
    path : Path
        A file or folder.
    """
    handle = os.open(
        path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY
    )  # Windows syncs only what it may write
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def leads_outside(path: str) -> bool:
    """Return whether a relative path leads out of the folder that it is relative to.

    Parameters
    ----------
    path : str
        A path with ``/`` between its segments. On Windows, backslashes separate segments too.

    Returns
    -------
    bool
        True for an absolute path, a path with a drive, and a path with a ``..`` segment.
    """
    path = path.replace(os.sep, "/")
    return path.startswith("/") or ".." in path.split("/") or os.path.splitdrive(path)[0] != ""
