"""List the source images of a folder or bucket, write their names for the manifest, and read their bytes.

Listing opens no file, so a pipe, a device or a terabyte file costs one ``stat``. Reading opens without blocking and
checks what was opened before the first byte. A folder that cannot be read stops the run, because photographs that go
missing silently change a dataset; ``os.walk`` ignores such folders.

Only links that lead back to a folder that contains them are skipped. A photograph reached through two links is two
sources; `number_twins` numbers them. Folders that link to each other are walked along every path without a
repetition, which grows quickly with their number: link to files, not between folders.

``source.root`` may be the URL of an object store. Its objects have the names and the order that files of a folder with
these paths have, so that the same photographs give the same dataset.
"""

from __future__ import annotations

import errno
import fnmatch
import hashlib
import itertools
import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import BinaryIO, NamedTuple, TypeVar

import xxhash

from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.files import leads_outside
from unprocess_gen.core.object_store import ObjectChangedError, ObjectPath, StoreAccessError, is_url
from unprocess_gen.core.types import Source
from unprocess_gen.sources.read_ahead import in_order

_Result = TypeVar("_Result")

MAX_FILE_BYTES = 2**30
"""Larger photographs are refused unread. 2^26 pixels of 16-bit RGBA, the largest accepted image, take half of it."""

TAIL_BYTES = 4096
"""Bytes at the end of a file that `number_twins` reads first. The ends of photographs of one size nearly always differ;
their beginnings, which hold the metadata of a camera, often do not."""

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


class _Found(NamedTuple):
    """A file or other entry that a glob matches: path below the root, and size, reason and ETag as in `Source`."""

    path: str
    size_bytes: int | None
    reason: str | None
    etag: str | None = None


def list_folder(
    root: str, include: Sequence[str], recursive: bool, limit: int | None, video: Sequence[str] = ()
) -> Listing:
    """List the files below ``root`` that the globs match, ordered by the bytes of their relative paths.

    Parameters
    ----------
    root : str
        A folder, or a single file, which is listed whatever the globs are; or the URL of a prefix or of an object.
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
    single = _single_file(root)
    if single is not None:
        return Listing((_as_source(0, single),))
    walk = (_BucketWalk if is_url(root) else _Walk)(root, matcher(include), matcher(video))
    matched = sorted(walk.matched(recursive), key=lambda found: os.fsencode(found.path))
    unmatched = dict(sorted(walk.unmatched.items(), key=lambda item: (-item[1], item[0])))
    if not matched:
        advice = "choose a folder of photographs or other globs"
        if walk.has_video:
            advice = "set source.clips=true to read videos as clips"
        elif unmatched:
            advice = f"{unmatched_sentence(unmatched)}; {advice}"
        raise ConfigError(
            f"source.root={root}: no file matches source.include={list(include)} "
            f"({'with' if recursive else 'without'} sub-folders); {advice}"
        )
    sources = tuple(_as_source(index, found) for index, found in enumerate(itertools.islice(matched, limit)))
    return Listing(sources, walk.skipped, unmatched)


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
    if path.isascii() and not _UNSAFE.search(path):
        return path  # the same object: a million names need no second copy
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
        Path to open, or URL to read.

    Raises
    ------
    SourceError
        With reason ``unreadable`` if ``path`` is absolute or contains ``..``; listings contain no such path, only
        manifests that were edited.
    """
    if leads_outside(path):
        raise SourceError("unreadable", f"{encode_name(path)} leads outside source.root")
    if is_url(root):
        prefix = ObjectPath(root)
        return str(prefix if prefix.name == path and not prefix.is_dir() else prefix / path)
    if Path(root).name == path and not Path(root).is_dir():
        return root
    return os.path.join(root, path)


def absolute_root(root: str | None) -> str | None:
    """Return a source root that does not depend on the current folder.

    Parameters
    ----------
    root : str or None
        Value of ``source.root``.

    Returns
    -------
    str or None
        Absolute path; a URL and None are returned as they are.
    """
    return root if root is None or is_url(root) else os.path.abspath(root)


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
        if source.size_bytes == 0 and (is_url(root) or os.fstat(file.fileno()).st_size == 0):
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

    Files of one size are compared by their last `TAIL_BYTES`. Only files that share size and tail are read completely;
    their ``sha256`` is kept. A file that cannot be read keeps number 0, since it has no pixels to distinguish.

    Parameters
    ----------
    root : str
        Value of ``source.root``.
    sources : sequence of Source
        In listing order.

    Returns
    -------
    tuple of Source
        The same sources, numbered.

    Raises
    ------
    MachineError
        If a file has another size than when it was listed.
    """
    sharing = Counter(source.size_bytes for source in sources)
    by_size: dict[int, list[int]] = {}
    for place, source in enumerate(sources):
        if source.size_bytes is not None and sharing[source.size_bytes] > 1:
            by_size.setdefault(source.size_bytes, []).append(place)
    numbered, seen = list(sources), Counter[str]()
    candidates = list(_sharing_tails(root, sources, by_size.values()))
    digests = in_order(root, _complete_digest, (sources[place] for place in candidates))
    for place, digest in zip(candidates, digests, strict=True):
        if digest is not None:
            numbered[place] = replace(sources[place], occurrence=seen[digest], sha256=digest)
            seen[digest] += 1
    return tuple(numbered)


def _sharing_tails(root: str, sources: Sequence[Source], groups: Iterable[Sequence[int]]) -> Iterator[int]:
    """Yield the places of sources whose last bytes equal those of another source of their group, group by group."""
    groups = list(groups)
    tails = in_order(root, _tail_digest, (sources[place] for places in groups for place in places))
    for places in groups:
        of_group = list(itertools.islice(tails, len(places)))
        alike = Counter(of_group)
        yield from (place for place, tail in zip(places, of_group, strict=True) if tail is not None and alike[tail] > 1)


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
        digest = content_sha256(root, frames[0])
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

    def warnings(self, sizes: Iterable[tuple[str, int, int]]) -> tuple[str, ...]:
        """Return a warning for each clip whose frames first differ in size.

        Parameters
        ----------
        sizes : iterable of (str, int, int)
            Name of a clip, width and height of one of its frames.

        Returns
        -------
        tuple of str
            One sentence for each clip; none for a clip that earlier calls reported.
        """
        texts = (self._warning(*size) for size in sizes)
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


def content_sha256(root: str, source: Source) -> str:
    """Return the SHA-256 of a source's file, or that of its name if the file cannot be read.

    Parameters
    ----------
    root : str
        Value of ``source.root``.
    source : Source
        One entry of the listing; a digest that it holds is returned.

    Returns
    -------
    str
        64 hex digits.
    """
    if source.sha256 is not None:
        return source.sha256
    try:
        return hashlib.sha256(read_bytes(root, source)).hexdigest()
    except SourceError:
        return hashlib.sha256(source.name.encode()).hexdigest()


def check_root(root: str) -> None:
    """Check that a source root exists.

    Parameters
    ----------
    root : str
        Value of ``source.root``.

    Raises
    ------
    ConfigError
        If nothing is there, or something else than a folder or a regular file; for a URL also if access is refused.
    """
    _single_file(root)


def _single_file(root: str) -> _Found | None:
    """Return the file or object that a root is, or None if it is a folder or prefix."""
    if not is_url(root):
        status = _root_status(root)
        return _found(Path(root).name, status) if stat.S_ISREG(status.st_mode) else None
    path = ObjectPath(root)
    try:
        if path.is_dir():
            return None
        facts = path.facts()
    except StoreAccessError as error:
        raise ConfigError(f"source.root={error}") from None
    if facts is None:
        raise ConfigError(f"source.root={root}: no such object or prefix; expected existing photographs")
    return _Found(facts.key, facts.size, None, facts.etag)


def _root_status(root: str) -> os.stat_result:
    """Return the status of a folder or regular file; ConfigError if there is none."""
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
    globs = tuple(include)
    of_path, of_name = (_one_of(glob for glob in globs if ("/" in glob) is full) for full in (True, False))
    return lambda path: of_name(path.rpartition("/")[2]) is not None or of_path(path) is not None


def _one_of(globs: Iterable[str]) -> Callable[[str], re.Match[str] | None]:
    """Return the ``match`` of one regular expression for several globs, which matches nothing if there are none."""
    return re.compile("|".join(map(fnmatch.translate, globs)) or r"(?!)", re.IGNORECASE).match


class _Walk:
    """Walk a folder once, keeping only what a listing needs of each entry.

    A ``stat_result`` per entry would take 700 bytes per file; here a matched file takes 64 bytes and its path, and
    others are counted.

    Attributes
    ----------
    skipped : int
        Folders not entered because they contain themselves.
    unmatched : Counter of str
        Regular files that no glob matches, by suffix.
    has_video : bool
        Whether one of them is a video.
    """

    def __init__(self, root: str, matches: Callable[[str], bool], is_video: Callable[[str], bool]) -> None:
        self._root = root
        self._matches = matches
        self._is_video = is_video
        self.skipped = 0
        self.unmatched: Counter[str] = Counter()
        self.has_video = False

    def matched(self, recursive: bool) -> Iterator[_Found]:
        """Yield the entries that a glob matches, in the order of the walk."""
        # a stack instead of recursion: folders may be nested deeper than Python's call stack
        waiting = [("", frozenset((_identity(Path(self._root).stat()),)))]
        while waiting:
            folder, ancestors = waiting.pop()
            for path, status, error in _scan(self._root, folder):
                matched = self._matches(path)
                if matched:
                    yield _found(path, status)
                if status is None:
                    if recursive and not matched:
                        _check_not_lost(self._root, path, error)
                elif stat.S_ISDIR(status.st_mode):
                    if recursive and _identity(status) in ancestors:
                        self.skipped += 1
                    elif recursive:
                        waiting.append((path, ancestors | {_identity(status)}))
                elif stat.S_ISREG(status.st_mode) and not matched:
                    self._count_unmatched(path)

    def _count_unmatched(self, path: str) -> None:
        self.unmatched[PurePosixPath(encode_name(path)).suffix.lower()] += 1
        self.has_video = self.has_video or self._is_video(path)


class _BucketWalk(_Walk):
    """List the objects below a URL once; objects have no links and no folders that cannot be read."""

    def matched(self, recursive: bool) -> Iterator[_Found]:
        """Yield the objects that a glob matches, in the order of the store."""
        for path, size_bytes, etag in ObjectPath(self._root).objects(recursive):
            if self._matches(path):
                yield _Found(path, size_bytes, None, etag)
            else:
                self._count_unmatched(path)


def _scan(root: str, folder: str) -> Iterator[tuple[str, os.stat_result | None, OSError | None]]:
    """Yield path, status and error of each entry of a folder; the status is None if ``stat`` failed with the error."""
    prefix = folder + "/" if folder else ""
    try:
        with os.scandir(os.path.join(root, folder)) as entries:
            for entry in entries:
                yield prefix + entry.name, *_status(entry)
    except OSError as error:
        raise _unreadable_folder(root, folder, error) from None


def _status(entry: os.DirEntry[str]) -> tuple[os.stat_result | None, OSError | None]:
    try:
        status = entry.stat()
        if stat.S_ISDIR(status.st_mode) and not status.st_ino:
            status = Path(entry.path).stat()  # on Windows, DirEntry.stat gives no numbers that identify a folder
    except OSError as error:
        return None, error
    return status, None


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _check_not_lost(root: str, path: str, error: OSError | None) -> None:
    """Raise ConfigError for an unreadable entry that may be a folder of photographs; broken links cannot be one."""
    if error is not None and error.errno not in _BROKEN_LINK:
        raise _unreadable_folder(root, path, error)


def _unreadable_folder(root: str, folder: str, error: OSError) -> ConfigError:
    name = encode_name(folder)
    ways_out = "change its permissions, move it, or set source.recursive=false" if name else "change its permissions"
    return ConfigError(
        f"source.root={root}: {name or 'the folder itself'} cannot be read ({error.strerror}); expected readable "
        f"folders; {ways_out}"
    )


def _found(path: str, status: os.stat_result | None) -> _Found:
    if status is None:
        return _Found(path, None, "unreadable")
    return _Found(path, status.st_size, None) if stat.S_ISREG(status.st_mode) else _Found(path, None, "not_a_file")


def _as_source(index: int, found: _Found) -> Source:
    path, size_bytes, reason, etag = found
    return Source(index, encode_name(path), path, size_bytes, reason, etag=etag)


def _percent(text: str) -> str:
    return "".join(f"%{byte:02X}" for byte in text.encode("utf-8", "surrogateescape"))


@contextmanager
def _opened(root: str, source: Source, max_bytes: int | None = MAX_FILE_BYTES) -> Iterator[BinaryIO]:
    """Open a source, unless it is not, or no longer, the regular file that was listed."""
    if source.reason is not None:
        raise SourceError(source.reason, f"{source.name} was not a readable file when the folder was listed")
    if is_url(root):
        with _opened_object(root, source, max_bytes) as stream:
            yield stream
        return
    path = source_file(root, source.path)
    descriptor = _reading(source, lambda: os.open(path, _OPEN_FLAGS))
    try:
        status = os.fstat(descriptor)
        _check_regular(source, status, max_bytes)
        _check_size(source, status.st_size, "since it was listed")
        yield os.fdopen(descriptor, "rb", buffering=0, closefd=False)
    finally:
        os.close(descriptor)


@contextmanager
def _opened_object(root: str, source: Source, max_bytes: int | None) -> Iterator[BinaryIO]:
    """Open a source of an object store; the first read compares its ETag with the listed one."""
    size = source.size_bytes or 0
    _check_readable_size(source, size, max_bytes)
    try:
        with ObjectPath(source_file(root, source.path)).open("rb", source.etag, max(size, 1)) as stream:
            yield stream
    except ObjectChangedError:
        raise MachineError(
            f"source {source.name} changed since it was listed: its ETag differs; restore it, or choose another out "
            "when nothing writes to source.root"
        ) from None


def _check_regular(source: Source, status: os.stat_result, max_bytes: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise SourceError("not_a_file", f"{source.name} is {stat.filemode(status.st_mode)}, not a regular file")
    _check_readable_size(source, status.st_size, max_bytes)


def _check_readable_size(source: Source, size_bytes: int, max_bytes: int | None) -> None:
    if max_bytes is not None and size_bytes > max_bytes:
        raise SourceError("too_large", f"{source.name} has {size_bytes} bytes, more than {max_bytes}")


def _check_size(source: Source, size_bytes: int, when: str) -> None:
    if size_bytes != source.size_bytes:
        raise MachineError(
            f"source {source.name} changed {when}: {source.size_bytes} bytes then, {size_bytes} now; "
            "restore it, or choose another out when nothing writes to source.root"
        )


def _reading(source: Source, action: Callable[[], _Result]) -> _Result:
    try:
        return action()
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise SourceError("unreadable", f"{source.name}: {why}") from None


def _tail_digest(root: str, source: Source) -> int | None:
    """Return a digest of a file's last `TAIL_BYTES`, None if it cannot be read."""
    try:
        with _opened(root, source) as file:
            start = max(0, (source.size_bytes or 0) - TAIL_BYTES)
            _reading(source, lambda: file.seek(start))
            return xxhash.xxh3_64_intdigest(_reading(source, lambda: file.read(TAIL_BYTES)))
    except SourceError:
        return None


def _complete_digest(root: str, source: Source) -> str | None:
    """Return the SHA-256 of a file, None if it cannot be read."""
    try:
        with _opened(root, source) as file:
            return _reading(source, lambda: hashlib.file_digest(file, "sha256").hexdigest())  # type: ignore[arg-type]
    except SourceError:
        return None
