"""Read the bytes of listed sources, and check that they are the files that were listed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from unprocess_gen.core.errors import MachineError, SourceError
from unprocess_gen.core.files import leads_outside
from unprocess_gen.core.object_store import ObjectChangedError, ObjectPath
from unprocess_gen.core.paths import LocalPath, NotAFileError, any_path
from unprocess_gen.core.types import Source
from unprocess_gen.sources.names import encode_name

MAX_FILE_BYTES = 2**30
"""Larger photographs are refused unread. 2^26 pixels of 16-bit RGBA, the largest accepted image, take half of it."""

_RESTORE = "restore it, or choose another out when nothing writes to source.root"


def source_file(root: str, path: str) -> LocalPath | ObjectPath:
    """Return the file of a source.

    Parameters
    ----------
    root : str
        Place of the sources: a folder, or the single picture.
    path : str
        `Source.path`.

    Raises
    ------
    SourceError
        With reason ``unreadable`` if ``path`` is absolute or contains ``..``; listings contain no such path, only
        manifests that were edited.
    """
    if leads_outside(path):
        raise SourceError("unreadable", f"{encode_name(path)} leads outside source.root")
    folder = any_path(root)
    return folder if folder.name == path and not folder.is_dir() else folder / path


@contextmanager
def opened(root: str, source: Source, start: int = 0) -> Iterator[BinaryIO]:
    """Open a source at byte ``start``, unless it is not, or no longer, the regular file that was listed.

    Raises
    ------
    SourceError
        With ``source.reason`` if the listing gave one; ``not_a_file``, ``unreadable``, or ``too_large``: more than
        `MAX_FILE_BYTES`.
    MachineError
        If size or ETag is not the listed one: the file changed during the run.
    """
    if source.reason is not None:
        raise SourceError(source.reason, f"{source.name} was not a readable file when the folder was listed")
    listed_bytes = source.size_bytes or 0
    if listed_bytes > MAX_FILE_BYTES:
        raise SourceError("too_large", f"{source.name} has {listed_bytes} bytes, more than {MAX_FILE_BYTES}")
    try:
        with source_file(root, source.path).open_listed(listed_bytes, source.etag, start) as (file, size_bytes):
            _check_size(source, size_bytes, "since it was listed")
            yield file
    except ObjectChangedError:
        raise MachineError(f"source {source.name} changed since it was listed: its ETag differs; {_RESTORE}") from None
    except NotAFileError as error:
        raise SourceError("not_a_file", f"{source.name} {error.strerror}") from None
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise SourceError("unreadable", f"{source.name}: {why}") from None


def read_bytes(root: str, source: Source) -> bytes:
    """Return the content of a photograph; raise as `opened`, or SourceError ``empty``."""
    with opened(root, source) as file:
        if source.size_bytes == 0:  # files below /proc grow while they are read
            raise SourceError("empty", f"{source.name} has 0 bytes")
        data = file.read()
    _check_size(source, len(data), "while it was read")
    return data


def _check_size(source: Source, size_bytes: int, when: str) -> None:
    if size_bytes != source.size_bytes:
        raise MachineError(
            f"source {source.name} changed {when}: {source.size_bytes} bytes then, {size_bytes} now; {_RESTORE}"
        )


def content_sha256(root: str, source: Source) -> str:
    """SHA-256 of a source's file, known or computed; of its name if the file cannot be read."""
    if source.sha256 is not None:
        return source.sha256
    try:
        return hashlib.sha256(read_bytes(root, source)).hexdigest()
    except SourceError:
        return name_sha256(source)


def name_sha256(source: Source) -> str:
    """SHA-256 of a source's name."""
    return hashlib.sha256(source.name.encode()).hexdigest()
