"""List the sources of a run: photographs of a folder or bucket, those that a list names, or synthetic pictures.

Listing opens no file, except those that share a size. A folder that cannot be read stops the run, because photographs
that go missing silently change a dataset. Only cyclic links are skipped: a photograph reached through two links is two
sources. Folders that link to each other are walked along every path without a repetition, which grows quickly with
their number: link to files, not between folders.

Objects of a store have the names and the order that files of a folder with these paths have, so that the same
photographs give the same dataset.
"""

from __future__ import annotations

import csv
import fnmatch
import hashlib
import itertools
import os
import posixpath
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import PurePosixPath

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.entries import Entry, EntryKind, hidden_sentence
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.files import leads_outside
from unprocess_gen.core.object_store import StoreAccessError
from unprocess_gen.core.paths import absolute_text, any_path
from unprocess_gen.core.raw_files import RAW_FILES
from unprocess_gen.core.source import Source
from unprocess_gen.core.tables import column_names, delimiter_of
from unprocess_gen.sources import synthetic
from unprocess_gen.sources.names import encode_name
from unprocess_gen.sources.reading import opened, read_bytes

NAMED_SUFFIXES = 5
"""Suffixes of unmatched files that `unmatched_sentence` names; the others are summed."""

ADVICE = {
    "source.kind=srgb and source.include can read {}": {glob.removeprefix("*") for glob in SourceConfig.include},
    "convert {} to JPEG, PNG or TIFF": {".gif", ".jp2", ".jxl", ".ppm", ".psd"},
    "source.kind=raw reads {}": {".pgm", *RAW_FILES},
}
"""Advice of `unmatched_sentence` about files, by their suffixes."""

MAX_LISTED = 4096
"""Characters of the longest path in a list."""

TAIL_BYTES = 4096
"""Bytes at the end of a file that `number_twins` reads first. The ends of photographs of one size nearly always differ;
their beginnings, which hold the metadata of a camera, often do not."""


@dataclass(frozen=True, slots=True)
class Listing:
    """Sources in order, with indices 0 to n-1, and what a user should read about them.

    ``skipped_links`` counts links to a folder that contains them, ``unmatched`` the regular files that no glob matches,
    by suffix in lower case (``""`` for none), most frequent first.
    """

    sources: Sequence[Source]
    skipped_links: int = 0
    unmatched: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def not_matched(self) -> int:
        """Number of regular files that no glob matches."""
        return sum(self.unmatched.values())


def list_photographs(config: SourceConfig, out: str | None = None) -> Listing:
    """List every source of a run in order, with identical files and frames of clips numbered; decode no pixel.

    The files of the dataset ``out`` do not count as unmatched.

    Raises ConfigError for a folder or a list that cannot be used, MachineError if a file changes while it is hashed.
    """
    place = config.place
    if place is None:
        names = synthetic.list_names(config.limit, config.clips)
        pictures = tuple(Source(index, name, name, size_bytes=0) for index, name in enumerate(names))
        return Listing(number_clips(None, pictures) if config.clips else pictures)
    if config.list is None:
        own = "" if out is None else os.path.relpath(os.path.realpath(out), os.path.realpath(place))
        listed = list_folder(place, config.include, config.recursive, config.limit, config.exclude, own)
    else:
        listed = list_file(place, config.list, config.limit)
    listed = replace(listed, sources=number_twins(place, listed.sources))
    if not config.clips:
        return listed
    numbered = number_clips(place, listed.sources)
    warning = (
        f"source.clips=true: all {len(numbered)} photographs are in one folder and become frames of one clip; "
        "expected one folder for each clip; set source.clips=false if they are different photographs"
    )
    is_suspicious = len(numbered) > 1 and len({source.clip for source in numbered}) == 1
    return replace(listed, sources=numbered, warnings=(*listed.warnings, *[warning] * is_suspicious))


def list_folder(
    root: str, include: Sequence[str], recursive: bool, limit: int | None, exclude: Sequence[str] = (), own: str = ""
) -> Listing:
    """List the files below ``root`` that the globs match, ordered by the bytes of their relative paths.

    Files below ``own``, the relative path of a dataset, do not count as unmatched.
    Hidden files and folders are left out, with a warning. A single file is listed whatever the globs are. ConfigError
    if the root does not exist, a sub-folder cannot be read, or no file matches.
    """
    single = single_file(root)
    if single is not None:
        return Listing((_source(0, single),))
    is_included, is_excluded = _matcher(include), _matcher(exclude)
    matched: list[Entry] = []
    hidden: list[str] = []
    suffixes, skipped_links = Counter[str](), 0
    try:
        for entry in any_path(root).walk_entries(recursive, enters_hidden=False):
            if entry.kind is EntryKind.HIDDEN:
                hidden.append(entry.path)
            elif is_excluded(entry.path):
                continue
            elif entry.kind not in (EntryKind.FOLDER, EntryKind.LOOP) and is_included(entry.path):
                matched.append(entry)
            elif entry.kind is EntryKind.FILE and not (own and entry.path.startswith(f"{own}/")):
                suffixes[PurePosixPath(encode_name(entry.path)).suffix.lower()] += 1
            elif entry.kind is EntryKind.UNREADABLE and recursive:  # may be a folder of photographs
                raise OSError(0, entry.problem, os.path.join(root, entry.path))
            skipped_links += recursive and entry.kind is EntryKind.LOOP
    except OSError as error:
        folder = os.path.relpath(error.filename, root)
        name, ways_out = "the folder itself", "change its permissions"
        if folder != os.curdir:
            name, ways_out = encode_name(folder), f"{ways_out}, move it, or set source.recursive=false"
        raise ConfigError(
            f"source.root={root}: {name} cannot be read ({error.strerror or error}); expected readable folders; "
            f"{ways_out}"
        ) from None
    unmatched = dict(sorted(suffixes.items(), key=lambda item: (-item[1], item[0])))
    if not matched:
        facts = (unmatched_sentence(unmatched), hidden_sentence(hidden))
        advice = "; ".join([*filter(None, facts), "choose a folder of photographs or other globs"])
        globs = f"source.include={list(include)}" + (f" and not source.exclude={list(exclude)}" if exclude else "")
        folders = f"{'with' if recursive else 'without'} sub-folders"
        raise ConfigError(f"source.root={root}: no file matches {globs} ({folders}); {advice}")
    matched.sort(key=lambda entry: os.fsencode(entry.path))
    sources = tuple(map(_source, itertools.count(), matched[:limit]))
    warnings = (f"source.root: {hidden_sentence(hidden)}",) if hidden else ()
    return Listing(sources, skipped_links, unmatched, warnings)


def list_file(root: str, file: str, limit: int | None) -> Listing:
    """List the sources that a text or CSV file names, ordered by the bytes of their paths below ``root``.

    A path that is no regular file becomes a source that fails. ConfigError for paths outside of ``root`` and repeated
    ones, and for a file that names none.
    """
    lines: dict[str, int] = {}
    for number, text in _listed_paths(file):
        path = _path_below(root, text)
        problem = f"is repeated from line {lines[path]}; expected each path once" if path in lines else ""
        if leads_outside(path) or "\0" in path or len(path) > MAX_LISTED:
            problem = f"is no path below {root}; expected files in it"
        if problem:
            raise ConfigError(f"source.list={file}: line {number}: {encode_name(text)[:200]} {problem}")
        lines[path] = number
    if not lines:
        raise ConfigError(f"source.list={file}: names no file; expected a path in each line")
    in_order = sorted(lines, key=os.fsencode)[:limit]
    return Listing(tuple(map(_source, itertools.count(), any_path(root).map(partial(_listed_entry, root), in_order))))


def _listed_paths(file: str) -> Iterator[tuple[int, str]]:
    """Yield the paths in a list with the numbers of their lines."""
    try:
        with any_path(file).open("rb") as stream:
            lines = stream.read().decode("utf-8-sig", "surrogateescape").split("\n")
        if not file.lower().endswith((".csv", ".tsv")):
            yield from ((number, line.rstrip("\r")) for number, line in enumerate(lines, start=1) if line.strip())
            return
        delimiter = delimiter_of(lines[0], "file")
        if delimiter is None and (";" in lines[0] or "\t" in lines[0]) and "," not in lines[0]:
            problem = "has a semicolon or a tab and no comma; expected a header with file"
            raise ConfigError(f"source.list={file}: line 1: {problem}")
        table = csv.reader(lines, strict=True, delimiter=delimiter or ",", skipinitialspace=True)
        header = column_names(next(table, []))
        column = header.index("file") if "file" in header else 0
        yield from ((table.line_num, row[column]) for row in table if row)
    except IndexError:
        raise ConfigError(f"source.list={file}: line {table.line_num}: lacks the column file") from None
    except (OSError, csv.Error) as error:
        raise ConfigError(f"source.list={file}: cannot be read ({error}); expected a text or CSV file") from None


def _path_below(root: str, text: str) -> str:
    """Path of a listed file below the root, with ``/`` between its segments; others stay as they are."""
    start = f"{absolute_text(root)}".rstrip("/") + "/"
    if text.startswith(start):
        return posixpath.normpath(text.removeprefix(start))
    return text if text.startswith("/") else posixpath.normpath(text.replace(os.sep, "/"))


def _listed_entry(root: str, path: str) -> Entry:
    try:
        return (any_path(root) / path).entry()._replace(path=path)
    except StoreAccessError as error:
        raise ConfigError(f"source.list={error}") from None
    except OSError:
        return Entry(path, None, EntryKind.BROKEN_LINK)


def unmatched_sentence(unmatched: dict[str, int]) -> str:
    """Sentence on the files that no glob matches, with advice; empty without such files."""
    total = sum(unmatched.values())
    if not total:
        return ""
    kinds = [f"{count} {suffix or 'without suffix'}" for suffix, count in unmatched.items()]
    if others := sum(list(unmatched.values())[NAMED_SUFFIXES:]):
        kinds[NAMED_SUFFIXES:] = [f"{others} others"]
    files = "1 file is" if total == 1 else f"{total} files are"
    sentence = f"{files} not matched by source.include ({', '.join(kinds)})"
    for advice, suffixes in ADVICE.items():
        if found := sorted(unmatched.keys() & suffixes):
            sentence += f"; {advice.format(', '.join(found))}"
    return sentence


def _matcher(include: Sequence[str]) -> Callable[[str], bool]:
    """Compile globs, case-insensitive: those with ``/`` match the relative path, others the name of the file."""
    matches_path, matches_name = (
        re.compile("|".join(map(fnmatch.translate, globs)) or r"(?!)", re.IGNORECASE).match
        for globs in ([glob for glob in include if "/" in glob], [glob for glob in include if "/" not in glob])
    )
    return lambda path: matches_name(path.rpartition("/")[2]) is not None or matches_path(path) is not None


def single_file(root: str) -> Entry | None:
    """Describe the file or object that a root is, None for a folder or prefix; ConfigError for anything else."""
    try:
        entry = any_path(root).entry()
    except StoreAccessError as error:
        raise ConfigError(f"source.root={error}") from None
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        why = "no such folder or file" if isinstance(error, FileNotFoundError) else why
        raise ConfigError(f"source.root={root}: {why}; expected an existing folder of photographs") from None
    if entry.kind is EntryKind.FOLDER:
        return None
    if entry.kind is not EntryKind.FILE:
        raise ConfigError(f"source.root={root}: not a folder; expected a folder of photographs, or one photograph")
    return entry


_REASONS = {EntryKind.BROKEN_LINK: "unreadable", EntryKind.UNREADABLE: "unreadable", EntryKind.FILE: None}


def _source(index: int, entry: Entry) -> Source:
    reason = _REASONS.get(entry.kind, "not_a_file")
    return Source(index, encode_name(entry.path), entry.path, entry.size, reason, etag=entry.etag)


# ------------------------------------------------------------------------------------------- identical files and clips


def number_twins(root: str, sources: Sequence[Source]) -> tuple[Source, ...]:
    """Number files of equal content 0, 1, … in listing order (``occurrence``), so that they get different noise.

    Only files that share their size and their last `TAIL_BYTES` are read completely; their ``sha256`` is kept. A file
    that cannot be read keeps number 0. Raises MachineError if a file has another size than when it was listed.
    """
    sizes = Counter(source.size_bytes for source in sources)
    suspects = [source for source in sources if source.size_bytes is not None and sizes[source.size_bytes] > 1]
    place = any_path(root)
    tails = list(place.map(partial(_digest, root, tail=TAIL_BYTES), suspects))
    counts = Counter(tails)
    alike = [source for source, tail in zip(suspects, tails, strict=True) if tail is not None and counts[tail] > 1]
    numbered, seen = list(sources), Counter[bytes]()
    for source, digest in zip(alike, place.map(partial(_digest, root), alike), strict=True):
        if digest is not None:
            numbered[source.index] = replace(source, occurrence=seen[digest], sha256=digest.hex())
            seen[digest] += 1
    return tuple(numbered)


def _digest(root: str, source: Source, tail: int = 0) -> bytes | None:
    """SHA-256 of a file, or of its last ``tail`` bytes and its size; None if it cannot be read."""
    size_bytes = source.size_bytes or 0
    with suppress(SourceError), opened(root, source, max(0, size_bytes - tail) if tail else 0) as file:
        digest = hashlib.file_digest(file, "sha256")  # type: ignore[arg-type]
        if tail:
            digest.update(b"%d" % size_bytes)
        return digest.digest()
    return None


def number_clips(root: str | None, sources: Sequence[Source]) -> tuple[Source, ...]:
    """Make each folder a clip whose files are frames 0, 1, … in listing order.

    The digest of a clip's first file identifies the clip, so that adding or removing other clips changes nothing. If
    that file cannot be read, or is a synthetic picture (no ``root``), the digest of its name is used.
    """
    clips: dict[str, list[Source]] = {}
    for source in sources:
        clips.setdefault(source.name.rpartition("/")[0] or ".", []).append(source)
    numbered, seen = list(sources), Counter[str]()
    for clip, frames in clips.items():
        digest = _clip_sha256(root, frames[0])
        for frame, source in enumerate(frames):
            numbered[source.index] = replace(
                source, clip=clip, frame=frame, clip_sha256=digest, clip_occurrence=seen[digest], frames=len(frames)
            )
        seen[digest] += 1
    return tuple(numbered)


def _clip_sha256(root: str | None, first: Source) -> str:
    if root is not None:
        if first.sha256 is not None:
            return first.sha256
        with suppress(SourceError):
            return hashlib.sha256(read_bytes(root, first)).hexdigest()
    return hashlib.sha256(first.name.encode()).hexdigest()
