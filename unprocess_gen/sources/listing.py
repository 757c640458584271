"""List the source images of a folder, write their names for the manifest, and read their bytes.

Listing opens no file, so a pipe, a device or a terabyte file costs one ``stat``. Reading opens without blocking and
checks what was opened before the first byte. A folder that cannot be read stops the run, because photographs that go
missing silently change a dataset; ``os.walk`` ignores such folders.

Only links that lead back to a folder that contains them are skipped. A photograph reached through two links is two
sources; `number_twins` numbers them. Folders that link to each other are walked along every path without a
repetition, which grows quickly with their number: link to files, not between folders.
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
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import BinaryIO, TypeVar

from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.files import leads_outside
from unprocess_gen.core.types import NO_CLIP, Row, Source

_Result = TypeVar("_Result")

MAX_FILE_BYTES = 2**30
"""Larger photographs are refused unread. 2^26 pixels of 16-bit RGBA, the largest accepted image, take half of it."""

NAMED_SUFFIXES = 5
"""Suffixes of unmatched files that `unmatched_sentence` names; the others are summed."""

READABLE_SUFFIXES = frozenset((".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"))
"""Suffixes of photographs that can be decoded; `unmatched_sentence` advises to extend ``source.include``."""

CONVERTIBLE_SUFFIXES = frozenset(
    (
        *(".avif", ".gif", ".heic", ".heif", ".hif", ".jp2", ".jxl", ".ppm", ".psd"),
        *(".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".pef", ".raf", ".rw2"),
    )
)
"""Suffixes of photographs that cannot be decoded; `unmatched_sentence` advises to convert them."""

Stamp = tuple[int, int, int, int]
"""Device, inode, size in bytes and modification time in nanoseconds of a file."""

# A pipe that replaced a listed file must not block the open for ever.
_OPEN_FLAGS = os.O_RDONLY
for _flag in ("O_NONBLOCK", "O_CLOEXEC", "O_NOCTTY", "O_BINARY"):  # the last only on Windows, the others only elsewhere
    _OPEN_FLAGS |= getattr(os, _flag, 0)

_BROKEN_LINK = (errno.ENOENT, errno.ELOOP, errno.ENOTDIR)

# Characters that a spreadsheet would execute, a terminal would obey, a line reader would split, or UTF-8 cannot hold.
# The last range is Python's spelling of bytes that are not UTF-8.
_UNSAFE = re.compile(
    "[%\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069\udc80-\udcff]|\\A[=+\\-@]"
)
_ESCAPED = re.compile(rb"%([0-9A-F]{2})")


@dataclass(frozen=True, slots=True)
class Listing:
    """Hold the result of listing a source.

    Attributes
    ----------
    sources : tuple of Source
        In order, with indices 0 to n-1.
    skipped_links : int
        Directory links that lead back to a folder that contains them.
    unmatched : dict of str to int
        Number of regular files that no glob matches, by suffix in lower case (``""`` for none), most frequent first.
    warnings : tuple of str
        Sentences about the listing that a user should read.
    """

    sources: tuple[Source, ...]
    skipped_links: int = 0
    unmatched: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def not_matched(self) -> int:
        """Number of regular files that no glob matches."""
        return sum(self.unmatched.values())


@dataclass(frozen=True, slots=True)
class _Entry:
    """One directory entry: ``path`` relative to the root; ``status`` is None if ``stat`` failed with ``error``."""

    path: str
    matched: bool
    status: os.stat_result | None
    error: OSError | None = None

    def is_folder(self) -> bool:
        return self.status is not None and stat.S_ISDIR(self.status.st_mode)

    def is_file(self) -> bool:
        return self.status is not None and stat.S_ISREG(self.status.st_mode)


def list_folder(
    root: str, include: Sequence[str], recursive: bool, limit: int | None, video: Sequence[str] = ()
) -> Listing:
    """List the files below ``root`` that the globs match, ordered by the bytes of their relative paths.

    Parameters
    ----------
    root : str
        A folder, or a single file, which is listed whatever the globs are.
    include : sequence of str
        Globs, case-insensitive. A glob with ``/`` is matched against the relative path, others against the file name.
    recursive : bool
        Whether to list sub-folders too, also through links.
    limit : int or None
        Keep the first ``limit`` files; None keeps all.
    video : sequence of str, optional
        Globs of videos that this listing leaves out. They decide the advice of an error message only.

    Returns
    -------
    Listing
        Sources without twins and clips numbered, and counts of what was left out.

    Raises
    ------
    ConfigError
        If the root does not exist, a sub-folder cannot be read, or no file matches.
    """
    status = root_status(root)
    if stat.S_ISREG(status.st_mode):
        return Listing((_as_source(0, _Entry(Path(root).name, matched=True, status=status)),))
    found, skipped = _walk(root, matcher(include), recursive)
    matched = sorted((entry for entry in found if entry.matched), key=lambda entry: os.fsencode(entry.path))
    unmatched = [entry.path for entry in found if entry.is_file() and not entry.matched]
    if not matched:
        is_video = matcher(video)
        advice = (
            "set source.clips=true to read videos as clips"
            if any(is_video(path) for path in unmatched)
            else "choose a folder of photographs or other globs"
        )
        raise ConfigError(
            f"source.root={root}: no file matches source.include={list(include)} "
            f"({'with' if recursive else 'without'} sub-folders); {advice}"
        )
    sources = tuple(_as_source(index, entry) for index, entry in enumerate(matched[:limit]))
    suffixes = Counter(PurePosixPath(encode_name(path)).suffix.lower() for path in unmatched)
    return Listing(sources, skipped, dict(sorted(suffixes.items(), key=lambda item: (-item[1], item[0]))))


def unmatched_sentence(unmatched: dict[str, int]) -> str:
    """Return one sentence about the files that no glob matches.

    Parameters
    ----------
    unmatched : dict of str to int
        As `Listing.unmatched`.

    Returns
    -------
    str
        How many files, which suffixes, and what to do about those of photographs; empty if every file matches.
    """
    total = sum(unmatched.values())
    if not total:
        return ""
    named = [f"{count} {suffix or 'without suffix'}" for suffix, count in list(unmatched.items())[:NAMED_SUFFIXES]]
    others = sum(list(unmatched.values())[NAMED_SUFFIXES:])
    kinds = ", ".join([*named, *([f"{others} others"] if others else [])])
    files = "1 file is" if total == 1 else f"{total} files are"
    readable, convertible = (
        ", ".join(sorted(unmatched.keys() & suffixes)) for suffixes in (READABLE_SUFFIXES, CONVERTIBLE_SUFFIXES)
    )
    return (
        f"{files} not matched by source.include ({kinds})"
        + (f"; extend source.include to read {readable}" if readable else "")
        + (f"; convert {convertible} to JPEG, PNG or TIFF" if convertible else "")
    )


def encode_name(path: str) -> str:
    """Return a path as the manifest spells it.

    ``%``, control and bidirectional characters, bytes that are not UTF-8 and a leading ``= + - @`` become ``%XX``.

    Parameters
    ----------
    path : str
        Relative path as the operating system spells it; undecodable bytes as surrogate escapes.

    Returns
    -------
    str
        Valid UTF-8 without line ends; `decode_name` reverses it.
    """
    text = os.fsencode(path).decode("utf-8", "surrogateescape")
    return _UNSAFE.sub(lambda match: _percent(match.group()), text)


def decode_name(name: str) -> str:
    """Return the path that `encode_name` spelled.

    Parameters
    ----------
    name : str
        Value of the manifest column ``source``.

    Returns
    -------
    str
        Path as the operating system spells it.
    """
    data = name.encode("utf-8", "surrogateescape")
    return os.fsdecode(_ESCAPED.sub(lambda match: bytes((int(match[1], 16),)), data))


def source_file(root: str, path: str) -> str:
    """Return the file of a source below ``root``.

    Parameters
    ----------
    root : str
        Value of ``source.root``: a folder, or the single picture.
    path : str
        `Source.path`.

    Returns
    -------
    str
        Path to open.

    Raises
    ------
    SourceError
        With reason ``unreadable`` if ``path`` is absolute or contains ``..``; listings contain no such path, only
        manifests that were edited.
    """
    if leads_outside(path):
        raise SourceError("unreadable", f"{encode_name(path)} leads outside source.root")
    if Path(root).name == path and not Path(root).is_dir():
        return root
    return os.path.join(root, path)


def read_bytes(root: str, source: Source) -> bytes:
    """Read one photograph completely.

    Parameters
    ----------
    root : str
        Value of ``source.root``.
    source : Source
        One entry of the listing.

    Returns
    -------
    bytes
        Content of the file.

    Raises
    ------
    SourceError
        With ``source.reason`` if the listing gave one; ``not_a_file``, ``unreadable``, ``too_large`` (more than
        `MAX_FILE_BYTES`) or ``empty``.
    MachineError
        If the size is not the listed one: the file changed during the run.
    """
    with _opened(root, source) as file:
        # files below /proc have size 0 and grow while they are read
        if source.size_bytes == 0 and os.fstat(file.fileno()).st_size == 0:
            raise SourceError("empty", f"{source.name} has 0 bytes")
        data = _reading(source, file.read)
    _check_size(source, len(data), "while it was read")
    if not data:
        raise SourceError("empty", f"{source.name} has 0 bytes")
    return data


def stamp(root: str, source: Source) -> Stamp:
    """Return what distinguishes a file from one that replaces it.

    Raises as `read_bytes` does, except that no file is too large.
    """
    with _opened(root, source, max_bytes=None) as file:
        return _stamp(file)


def keep_open(root: str, source: Source, wanted: Stamp) -> BinaryIO:
    """Open a file that the caller closes; MachineError if its stamp is not ``wanted``."""
    with _opened(root, source, max_bytes=None) as file:
        if _stamp(file) != wanted:
            raise MachineError(
                f"source {source.name} changed while it was opened; expected a file that no process writes to; "
                "rerun when nothing writes to it"
            )
        return os.fdopen(os.dup(file.fileno()), "rb", buffering=0)


def _stamp(file: BinaryIO) -> Stamp:
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def number_twins(root: str, sources: Sequence[Source]) -> tuple[Source, ...]:
    """Assign files of equal content the numbers 0, 1, … in listing order (``occurrence``).

    Only files that share a size are read; their ``sha256`` is kept. A file that cannot be read keeps number 0, since
    it has no pixels to distinguish.
    """
    sharing = Counter(source.size_bytes for source in sources)
    seen: Counter[str] = Counter()
    return tuple(
        source if source.size_bytes is None or sharing[source.size_bytes] == 1 else _number(root, source, seen)
        for source in sources
    )


def number_clips(root: str, sources: Sequence[Source]) -> tuple[Source, ...]:
    """Make each folder a clip whose files are frames 0, 1, … in listing order; videos are clips already.

    The digest of a clip's first file identifies the clip, so that adding or removing other clips changes nothing. If
    that file cannot be read, the digest of its name is used.
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


def clip_warnings(sources: Sequence[Source]) -> tuple[str, ...]:
    """Return a warning if one folder of several photographs is the only clip."""
    clips = {source.clip for source in sources}
    if len(sources) < 2 or len(clips) != 1 or sources[0].is_video:
        return ()
    return (
        f"source.clips=true: all {len(sources)} photographs are in one folder and become frames of one clip; "
        "expected one folder for each clip; set source.clips=false if they are different photographs",
    )


class ClipSizes:
    """Compare the frame sizes of each clip as frames become known."""

    def __init__(self) -> None:
        self._sizes: dict[str, tuple[int, int] | None] = {}

    def warnings(self, rows: Iterable[Row]) -> tuple[str, ...]:
        """Return a warning for each clip whose frames first differ in size within these manifest rows.

        Rows of failed sources, of photographs outside clips and of patches are ignored.
        """
        frames = [row for row in rows if row["status"] == "ok" and row["clip"] != NO_CLIP and row["patch"] == 0]
        texts = (self._warning(str(row["clip"]), int(row["width"] or 0), int(row["height"] or 0)) for row in frames)
        return tuple(text for text in texts if text)

    def _warning(self, clip: str, width: int, height: int) -> str:
        known = self._sizes.setdefault(clip, (width, height))
        if known is None or known == (width, height):
            return ""
        self._sizes[clip] = None  # one warning for each clip
        return (
            f"source.clips=true: clip {clip} has frames of {known[0]} x {known[1]} and of {width} x {height} pixels; "
            "expected frames of one scene; set source.clips=false if they are different photographs"
        )


def _digest(root: str, source: Source) -> str:
    if source.sha256 is not None:
        return source.sha256
    try:
        return hashlib.sha256(read_bytes(root, source)).hexdigest()
    except SourceError:
        return hashlib.sha256(source.name.encode()).hexdigest()


def root_status(root: str) -> os.stat_result:
    """Return the status of a source root.

    Parameters
    ----------
    root : str
        Value of ``source.root``.

    Returns
    -------
    os.stat_result
        Status of the folder or regular file.

    Raises
    ------
    ConfigError
        If nothing is there, or something else than a folder or a regular file.
    """
    try:
        status = Path(root).stat()
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        why = "no such folder or file" if isinstance(error, FileNotFoundError) else why
        raise ConfigError(f"source.root={root}: {why}; expected an existing folder of photographs") from None
    if not stat.S_ISDIR(status.st_mode) and not stat.S_ISREG(status.st_mode):
        raise ConfigError(f"source.root={root}: not a folder; expected a folder of photographs, or one photograph")
    return status


def matcher(include: Iterable[str]) -> Callable[[str], bool]:
    """Return a function that says whether a relative path matches one of the globs of `list_folder`."""
    globs = [("/" in glob, re.compile(fnmatch.translate(glob), re.IGNORECASE)) for glob in include]
    return lambda path: any(rule.match(path if full else path.rpartition("/")[2]) for full, rule in globs)


def _walk(root: str, matches: Callable[[str], bool], recursive: bool) -> tuple[list[_Entry], int]:
    """Return all entries below ``root``, and the number of folders skipped because they contain themselves."""
    found: list[_Entry] = []
    skipped = 0
    # a stack instead of recursion: folders may be nested deeper than Python's call stack
    waiting = [("", frozenset((_identity(Path(root).stat()),)))]
    while waiting:
        folder, ancestors = waiting.pop()
        entries = _scan(root, folder, matches)
        found += entries
        for entry in entries if recursive else ():
            _check_not_lost(root, entry)
            if entry.status is None or not entry.is_folder():
                continue
            if _identity(entry.status) in ancestors:
                skipped += 1
            else:
                waiting.append((entry.path, ancestors | {_identity(entry.status)}))
    return found, skipped


def _scan(root: str, folder: str, matches: Callable[[str], bool]) -> list[_Entry]:
    prefix = folder + "/" if folder else ""
    try:
        with os.scandir(os.path.join(root, folder)) as entries:
            return [_entry(entry, prefix + entry.name, matches(prefix + entry.name)) for entry in entries]
    except OSError as error:
        raise _unreadable_folder(root, folder, error) from None


def _entry(entry: os.DirEntry[str], path: str, matched: bool) -> _Entry:
    try:
        status = entry.stat()
        if stat.S_ISDIR(status.st_mode) and not status.st_ino:
            status = Path(entry.path).stat()  # on Windows, DirEntry.stat gives no numbers that identify a folder
        return _Entry(path, matched, status)
    except OSError as error:
        return _Entry(path, matched, None, error)


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _check_not_lost(root: str, entry: _Entry) -> None:
    """Raise ConfigError for an unreadable entry that may be a folder of photographs; broken links cannot be one."""
    if entry.error is not None and not entry.matched and entry.error.errno not in _BROKEN_LINK:
        raise _unreadable_folder(root, entry.path, entry.error)


def _unreadable_folder(root: str, folder: str, error: OSError) -> ConfigError:
    where = encode_name(folder) or "the folder itself"
    return ConfigError(
        f"source.root={root}: {where} cannot be read ({error.strerror}); expected readable folders; "
        "change its permissions, move it, or set source.recursive=false"
    )


def _as_source(index: int, entry: _Entry) -> Source:
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
    """Open a source, unless it is not, or no longer, the regular file that was listed."""
    if source.reason is not None:
        raise SourceError(source.reason, f"{source.name} was not a readable file when the folder was listed")
    path = source_file(root, source.path)
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
            "rerun when nothing writes to source.root"
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
