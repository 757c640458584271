"""Read the bytes of listed sources, ahead in an object store, and check that they are the files that were listed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import partial
from typing import BinaryIO

from unprocess_gen.core.entries import started_ahead
from unprocess_gen.core.errors import MachineError, SourceError
from unprocess_gen.core.files import leads_outside
from unprocess_gen.core.object_store import ObjectChangedError, ObjectPath
from unprocess_gen.core.paths import LocalPath, NotAFileError, any_path
from unprocess_gen.core.source import Source
from unprocess_gen.sources.names import encode_name

ReadFile = Callable[[str, Source], bytes]
"""Function that returns the bytes of a source below a root: `read_bytes`, or one that has read ahead."""

MAX_FILE_BYTES = 2**30
"""Larger photographs are refused unread. 2^26 pixels of 16-bit RGBA, the largest accepted image, take half of it."""

AHEAD = 8
"""Photographs that a worker reads ahead."""

AHEAD_BYTES = 2**28
"""Bytes of photographs that a worker holds ahead; the next one is always read, whatever its size."""

_RESTORE = "restore it, or choose another out when nothing writes to source.root"


def source_file(root: str, path: str) -> LocalPath | ObjectPath:
    """File of a source, whose root is a folder or the single picture.

    Raises SourceError ``unreadable`` for a ``path`` that leads outside; only edited manifests contain such paths.
    """
    if leads_outside(path):
        raise SourceError("unreadable", f"{encode_name(path)} leads outside source.root")
    folder = any_path(root)
    return folder if folder.name == path and not folder.is_dir() else folder / path


@contextmanager
def opened(root: str, source: Source, start: int = 0) -> Iterator[BinaryIO]:
    """Open a source at byte ``start``, unless it is not, or no longer, the regular file that was listed.

    Raises SourceError: the reason that the listing gave, ``not_a_file``, ``unreadable``, or ``too_large`` for more than
    `MAX_FILE_BYTES`; MachineError if size or ETag is not the listed one.
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
    """Read a photograph; raise as `opened`, or SourceError ``empty``."""
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


@contextmanager
def reading_ahead(root: str | None, read: ReadFile, sources: Sequence[Source]) -> Iterator[ReadFile]:
    """Read sources of an object store ahead while the body processes them in order; yield a function like ``read``.

    A request takes 10 to 100 ms whatever its size. One at a time, at 40 ms, a worker would wait for 70 % of a run
    (``docs/design/object_stores.md``). A source that is read a second time, or out of order, is read when it is asked
    for; so are local files.
    """
    if root is None or not isinstance(any_path(root), ObjectPath):
        yield read
        return
    later = deque(sources)
    with (
        ThreadPoolExecutor(AHEAD, "read ahead") as pool,
        closing(started_ahead(pool, partial(read, root), sources, AHEAD, _size_bytes, AHEAD_BYTES)) as started,
    ):

        def read_next(root: str, source: Source) -> bytes:
            while later and later[0].index < source.index:  # sources that were not needed after all
                later.popleft()
                next(started).cancel()
            if not later or later[0] != source:
                return read(root, source)
            later.popleft()
            return next(started).result()

        yield read_next


def _size_bytes(source: Source) -> int:
    return source.size_bytes or 0
