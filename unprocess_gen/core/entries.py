"""Describe the entries of folders and prefixes, and call functions ahead of the use of their results."""

from __future__ import annotations

import enum
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


KINDS_SHOWN = 5
"""Names of hidden files that `hidden_sentence` counts."""

SYSTEM_NAMES = {
    *("@eadir", "@recycle", "@tmp", "#recycle", "#snapshot", "$recycle.bin", "system volume information"),
    *("lost+found", "__macosx"),
}
"""Names, in small letters, of folders in which systems keep thumbnails, companions of files, and old versions."""


def hidden_part(path: str) -> str:
    """Path of the first hidden file or folder in a path, such as ``.thumbnails`` or ``@eaDir``; empty without any."""
    parts = path.split("/")
    for number, name in enumerate(parts, start=1):
        if name.startswith(".") or name.lower() in SYSTEM_NAMES:
            return "/".join(parts[:number])
    return ""


class EntryKind(enum.Enum):
    """Kind of an entry of a folder."""

    FILE = "regular file or object"
    FOLDER = "folder or prefix"
    HIDDEN = "hidden file or folder, which is not entered"
    LOOP = "link to a folder that contains the link"
    OTHER = "pipe or device"
    BROKEN_LINK = "link to nothing"
    UNREADABLE = "entry whose status cannot be read"


class Entry(NamedTuple):
    """Entry of a folder.

    Attributes
    ----------
    path : str
        Path below the listed folder or prefix.
    size : int or None
        Size of a file in bytes.
    kind : EntryKind
        What the entry is.
    etag : str or None
        ETag of an object, if the store has ETags.
    problem : str
        Why the status of the entry cannot be read.
    """

    path: str
    size: int | None
    kind: EntryKind = EntryKind.FILE
    etag: str | None = None
    problem: str = ""


def hidden_sentence(paths: Iterable[str]) -> str:
    """Sentence that counts hidden files and folders by name; empty without any."""
    names = (path.rpartition("/")[2] for path in paths)
    kinds = Counter("._*" if name.startswith("._") else _printable(name) for name in names).most_common()
    shown = [f"{count} {name}" for name, count in kinds[:KINDS_SHOWN]]
    if others := sum(count for _, count in kinds[KINDS_SHOWN:]):
        shown.append(f"{others} others")
    return f"hidden files and folders are left out: {', '.join(shown)}" if kinds else ""


def _printable(name: str) -> str:
    """Name without characters that a terminal would obey."""
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in name)


def started_ahead(
    pool: ThreadPoolExecutor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    most: int,
    size: Callable[[Item], int] = lambda item: 0,
    most_bytes: int = 0,
) -> Generator[Future[Result], None, None]:
    """Yield the calls of a function in the order of the items.

    Up to ``most`` calls have begun, of items whose sizes sum to at most ``most_bytes``; one call is always allowed.
    """
    started: deque[tuple[Future[Result], int]] = deque()
    try:
        for item in items:
            while started and (len(started) == most or sum(begun for _, begun in started) + size(item) > most_bytes):
                yield started.popleft()[0]
            started.append((pool.submit(function, item), size(item)))
        while started:
            yield started.popleft()[0]
    finally:
        for future, _ in started:
            future.cancel()
