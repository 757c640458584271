"""Hash, sync and rename files; turn operating-system errors into one sentence."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

import numpy as np
import xxhash

from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.types import DESCRIPTIONS, Frame


def array_xxh3(array: Frame) -> str:
    """Return the XXH3-128 of an array's little-endian bytes, 32 hex digits."""
    return xxhash.xxh3_128_hexdigest(little_endian(array).data)


def little_endian(array: Frame) -> Frame:
    """Return an array as contiguous little-endian numbers; a copy only where it is not already."""
    return np.ascontiguousarray(array, dtype=DESCRIPTIONS[array.dtype.name])


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def machine_error(error: OSError, path: Path) -> MachineError:
    """Return the one sentence for a failed write: what failed, where, and how many bytes are free there."""
    try:
        free = f"{shutil.disk_usage(path).free} bytes free"
    except OSError:
        free = "the folder is gone"
    what = error.strerror or str(error)
    return MachineError(f"{error.filename or path}: {what} ({free}); what is committed is kept, run again to go on")


def commit_file(aside: Path, path: Path) -> None:
    """Put a finished file where it belongs, durably; another of its name is replaced."""
    sync(aside)
    os.replace(aside, path)
    sync(path.parent)


def sync(path: Path) -> None:
    """Have what was written to a file, or renamed into a folder, survive a loss of power."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
