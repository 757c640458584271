"""Find the photographs of a folder, spell their names for the manifest, and read their bytes.

Nothing is opened while listing, so a pipe, a device or a terabyte file costs one ``stat``; a read opens without
blocking and looks at what it opened before the first byte. ``os.walk`` was tried and dropped: it is silent about
folders it cannot read, and it either follows no links or follows them for ever. Here a folder that cannot be read
stops the run, because photographs that go missing without a word change a dataset.

Only links that lead back to a folder they stand in are skipped. A photograph that two links reach is two sources, and
`number_twins` tells them apart. Folders that link to each other crosswise are walked along every path without a
repeat, which grows quickly with their number: link to files, not among folders.
"""

from __future__ import annotations

import errno
import fnmatch
import hashlib
import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, TypeVar

from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.types import Source

_Result = TypeVar("_Result")

MAX_FILE_BYTES = 2**30
"""Larger photographs are refused unread; 2^26 pixels of 16-bit RGBA, the most we may be asked for, are half of it."""

Stamp = tuple[int, int, int, int]

# A pipe put in the place of a listed file must not block the open for ever.
_OPEN_FLAGS = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY

_LEADS_NOWHERE = (errno.ENOENT, errno.ELOOP, errno.ENOTDIR)

# What a spreadsheet would run, a terminal would obey, a line reader would split, or UTF-8 cannot hold. The last range
# is how Python spells bytes that are not UTF-8.
_UNSAFE = re.compile(
    "[%\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069\udc80-\udcff]|\\A[=+\\-@]"
)
_ESCAPED = re.compile(rb"%([0-9A-F]{2})")


@dataclass(frozen=True, slots=True)
class Listing:
    """What `list_folder` found.

    ``sources`` are in order, index 0 to n-1; ``not_matched`` counts the regular files that no glob matches;
    ``skipped_links`` counts the directory links that lead back to a folder they stand in.
    """

    sources: tuple[Source, ...]
    not_matched: int
    skipped_links: int


@dataclass(frozen=True, slots=True)
class _Found:
    """One directory entry: ``path`` relative to the root; ``status`` is None where ``stat`` failed with ``error``."""

    path: str
    matched: bool
    status: os.stat_result | None
    error: OSError | None = None

    def is_folder(self) -> bool:
        return self.status is not None and stat.S_ISDIR(self.status.st_mode)

    def is_file(self) -> bool:
        return self.status is not None and stat.S_ISREG(self.status.st_mode)


def list_folder(root: str, include: Sequence[str], recursive: bool, limit: int | None) -> Listing:
    """Lists what the globs match below ``root``, ordered by the bytes of the relative path.

    Parameters
    ----------
    root
        The folder.
    include
        Globs, blind to case; one with ``/`` is held against the relative path, one without against the base name.
    recursive
        Whether to look into sub-folders, also through links.
    limit
        Keep the first so many; None keeps all.

    Raises
    ------
    ConfigError
        The root is missing or no folder, a sub-folder cannot be read, or nothing matches.
    """
    _check_root(root)
    found, skipped = _walk(root, matcher(include), recursive)
    matched = sorted((entry for entry in found if entry.matched), key=lambda entry: os.fsencode(entry.path))
    if not matched:
        raise ConfigError(
            f"source.root={root}: no file matches source.include={list(include)} "
            f"({'with' if recursive else 'without'} sub-folders); name a folder of photographs or other globs"
        )
    sources = tuple(_as_source(index, entry) for index, entry in enumerate(matched[:limit]))
    return Listing(sources, sum(entry.is_file() and not entry.matched for entry in found), skipped)


def encode_name(path: str) -> str:
    """Spells a path for the manifest: `%`, control and bidirectional characters, bytes that are not UTF-8 and a
    leading ``= + - @`` become ``%XX``; all else stays."""
    text = os.fsencode(path).decode("utf-8", "surrogateescape")
    return _UNSAFE.sub(lambda match: _percent(match.group()), text)


def decode_name(name: str) -> str:
    """Gives back the path that `encode_name` spelled."""
    data = name.encode("utf-8", "surrogateescape")
    return os.fsdecode(_ESCAPED.sub(lambda match: bytes((int(match[1], 16),)), data))


def read_bytes(root: str, source: Source) -> bytes:
    """Reads one photograph whole.

    Raises
    ------
    SourceError
        ``source.reason`` if the listing gave one; ``not_a_file``, ``unreadable``, ``too_large`` (over
        `MAX_FILE_BYTES`) or ``empty``.
    MachineError
        The size is not the listed one: the folder changed under us.
    """
    with _opened(root, source) as file:
        if (
            source.size_bytes == 0 and os.fstat(file.fileno()).st_size == 0
        ):  # some grow as they are read: /proc has such
            raise SourceError("empty", f"{source.name} has 0 bytes")
        data = _reading(source, file.read)
    _check_size(source, len(data), "while it was read")
    if not data:
        raise SourceError("empty", f"{source.name} has 0 bytes")
    return data


def stamp(root: str, source: Source) -> Stamp:
    """Tells a file from any that takes its place: device, inode, size, and when it was last changed.

    Raises as `read_bytes` does; no file is too large.
    """
    with _opened(root, source, max_bytes=None) as file:
        return _stamp(file)


def keep_open(root: str, source: Source, wanted: Stamp) -> BinaryIO:
    """Opens a file for the caller to close; MachineError where it is no longer the one that was stamped."""
    with _opened(root, source, max_bytes=None) as file:
        if _stamp(file) != wanted:
            raise MachineError(f"source {source.name} changed while it was opened; run again when nothing writes to it")
        return os.fdopen(os.dup(file.fileno()), "rb", buffering=0)


def _stamp(file: BinaryIO) -> Stamp:
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def number_twins(root: str, sources: Sequence[Source]) -> tuple[Source, ...]:
    """Numbers the files of the same content 0, 1, … in listing order (``occurrence``).

    Only files that share a size are read, in pieces, and keep their ``sha256``. One that cannot be read keeps 0: it has
    no pixels to tell apart.
    """
    sharing = Counter(source.size_bytes for source in sources)
    seen: Counter[str] = Counter()
    return tuple(
        source if source.size_bytes is None or sharing[source.size_bytes] == 1 else _number(root, source, seen)
        for source in sources
    )


def number_clips(root: str, sources: Sequence[Source]) -> tuple[Source, ...]:
    """Takes each folder for a clip, and its files for frames 0, 1, … in listing order; videos are clips already.

    Of each clip the first file is read: its digest stands for the clip, so that other clips that come or go
    move nothing. One that cannot be read is stood for by the digest of its name.
    """
    clips: dict[str, list[Source]] = {}
    for source in sources:
        clips.setdefault(source.name if source.is_video else source.name.rpartition("/")[0] or ".", []).append(source)
    seen: Counter[str] = Counter()
    placed: dict[int, Source] = {}
    for clip, frames in clips.items():
        digest = _digest(root, frames[0])
        for frame, source in enumerate(frames):
            placed[source.index] = replace(
                source, clip=clip, frame=frame, clip_sha256=digest, clip_occurrence=seen[digest], frames=len(frames)
            )
        seen[digest] += 1
    return tuple(placed[source.index] for source in sources)


def _digest(root: str, source: Source) -> str:
    if source.sha256 is not None:
        return source.sha256
    try:
        return hashlib.sha256(read_bytes(root, source)).hexdigest()
    except SourceError:
        return hashlib.sha256(source.name.encode()).hexdigest()


def _check_root(root: str) -> None:
    try:
        mode = Path(root).stat().st_mode
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(f"source.root={root}: {why}; name an existing folder of photographs") from None
    if not stat.S_ISDIR(mode):
        raise ConfigError(f"source.root={root}: not a folder; name the folder that holds the photographs")


def matcher(include: Iterable[str]) -> Callable[[str], bool]:
    """Returns what tells whether a relative path matches one of the globs of `list_folder`."""
    globs = [("/" in glob, re.compile(fnmatch.translate(glob), re.IGNORECASE)) for glob in include]
    return lambda path: any(rule.match(path if whole else path.rpartition("/")[2]) for whole, rule in globs)


def _walk(root: str, matches: Callable[[str], bool], recursive: bool) -> tuple[list[_Found], int]:
    """All entries below ``root``, and how many folders were left out because they are their own ancestor."""
    found: list[_Found] = []
    skipped = 0
    # A stack instead of recursion: folders may be nested deeper than Python's call stack.
    waiting = [("", frozenset((_identity(Path(root).stat()),)))]
    while waiting:
        folder, chain = waiting.pop()
        entries = _scan(root, folder, matches)
        found += entries
        for entry in entries if recursive else ():
            _check_not_lost(root, entry)
            if entry.status is None or not entry.is_folder():
                continue
            if _identity(entry.status) in chain:
                skipped += 1
            else:
                waiting.append((entry.path, chain | {_identity(entry.status)}))
    return found, skipped


def _scan(root: str, folder: str, matches: Callable[[str], bool]) -> list[_Found]:
    prefix = folder + "/" if folder else ""
    try:
        with os.scandir(os.path.join(root, folder)) as entries:
            return [_look(entry, prefix + entry.name, matches(prefix + entry.name)) for entry in entries]
    except OSError as error:
        raise _unreadable_folder(root, folder, error) from None


def _look(entry: os.DirEntry[str], path: str, matched: bool) -> _Found:
    try:
        return _Found(path, matched, entry.stat())
    except OSError as error:
        return _Found(path, matched, None, error)


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _check_not_lost(root: str, entry: _Found) -> None:
    """An entry that no glob matches may be a folder full of photographs, unless it is a link to nothing."""
    if entry.error is not None and not entry.matched and entry.error.errno not in _LEADS_NOWHERE:
        raise _unreadable_folder(root, entry.path, entry.error)


def _unreadable_folder(root: str, folder: str, error: OSError) -> ConfigError:
    where = encode_name(folder) or "the folder itself"
    return ConfigError(
        f"source.root={root}: {where} cannot be read ({error.strerror}); "
        "make it readable, move it away, or set source.recursive=false"
    )


def _as_source(index: int, entry: _Found) -> Source:
    name = encode_name(entry.path)
    if entry.status is None:
        return Source(index, name, entry.path, None, "unreadable")
    if not entry.is_file():
        return Source(index, name, entry.path, None, "not_a_file")
    return Source(index, name, entry.path, entry.status.st_size)


def _percent(text: str) -> str:
    return "".join(f"%{byte:02X}" for byte in text.encode("utf-8", "surrogateescape"))


@contextmanager
def _opened(root: str, source: Source, max_bytes: int | None = MAX_FILE_BYTES) -> Iterator[BinaryIO]:
    """Opens a source, unless it is not, or no longer, the regular file that was listed."""
    if source.reason is not None:
        raise SourceError(source.reason, f"{source.name} was no readable file when the folder was listed")
    path = os.path.join(root, source.path)
    descriptor = _reading(source, lambda: os.open(path, _OPEN_FLAGS))
    try:
        status = os.fstat(descriptor)
        _check_regular(source, status, max_bytes)
        _check_size(source, status.st_size, "since it was listed")
        yield os.fdopen(descriptor, "rb", buffering=0, closefd=False)
    finally:
        os.close(descriptor)


def _check_regular(source: Source, status: os.stat_result, max_bytes: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise SourceError("not_a_file", f"{source.name} is {stat.filemode(status.st_mode)}, not a regular file")
    if max_bytes is not None and status.st_size > max_bytes:
        raise SourceError("too_large", f"{source.name} has {status.st_size} bytes, more than {max_bytes}")


def _check_size(source: Source, size_bytes: int, when: str) -> None:
    if size_bytes != source.size_bytes:
        raise MachineError(
            f"source {source.name} changed {when}: {source.size_bytes} bytes then, {size_bytes} now; "
            "run again when nothing writes to source.root"
        )


def _reading(source: Source, action: Callable[[], _Result]) -> _Result:
    try:
        return action()
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise SourceError("unreadable", f"{source.name}: {why}") from None


def _number(root: str, source: Source, seen: Counter[str]) -> Source:
    try:
        with _opened(root, source) as file:
            digest = _reading(source, lambda: hashlib.file_digest(file, "sha256").hexdigest())  # type: ignore[arg-type]
    except SourceError:
        return source
    seen[digest] += 1
    return replace(source, occurrence=seen[digest] - 1, sha256=digest)
