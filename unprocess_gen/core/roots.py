"""Address several folders of sources as one, whose sub-folders ``0``, ``1``, … are the folders."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable, Iterator, Sequence

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.object_store import Entry, EntryKind, Item, ObjectPath, Result
from unprocess_gen.core.paths import LocalPath, absolute_text, any_path

Root = str | tuple[str, ...]
"""Place of the sources of a run: a folder, a file or a URL, or several folders and URLs (`SourceRoots`)."""


class SourceRoots:
    """Several roots, with the methods of `LocalPath` and `ObjectPath` that read sources.

    Parameters
    ----------
    roots : sequence of str
        Folders, or URLs of prefixes.
    """

    name = ""

    def __init__(self, roots: Sequence[str]) -> None:
        self._roots = tuple(map(any_path, roots))

    def __truediv__(self, path: str) -> LocalPath | ObjectPath:
        number, _, below = path.partition("/")
        if number not in map(str, range(len(self._roots))):
            raise FileNotFoundError(errno.ENOENT, "no such number of source.roots", path)
        return self._roots[int(number)] / below

    @property
    def is_remote(self) -> bool:
        """True if a root is in an object store."""
        return any(isinstance(root, ObjectPath) for root in self._roots)

    def is_dir(self) -> bool:
        """True if all roots are folders or prefixes."""
        return all(root.is_dir() for root in self._roots)

    exists = is_dir

    def entry(self) -> Entry:
        """Describe the roots as one folder; raise ConfigError unless all are folders."""
        for number, root in enumerate(self._roots):
            if not root.is_dir():
                problem = "no such folder, or a file; expected folders of photographs"
                raise ConfigError(f"source.roots[{number}]={root}: {problem}")
        return Entry(self.name, None, EntryKind.FOLDER)

    def walk_entries(self, recursive: bool = True) -> Iterator[Entry]:
        """Yield the entries of all roots, whose paths begin with the number of the root."""
        for number, root in enumerate(self._roots):
            try:
                for entry in root.walk_entries(recursive):
                    yield entry._replace(path=f"{number}/{entry.path}")
            except OSError as error:
                problem = f"{error.filename} cannot be read ({error.strerror}); expected readable folders"
                raise ConfigError(f"source.roots[{number}]={root}: {problem}; change its permissions") from None

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Apply a function that reads files to items: in threads if a root is in an object store."""
        remote = (root for root in self._roots if isinstance(root, ObjectPath))
        return next(remote, self._roots[0]).map(function, items)


def root_path(root: Root) -> LocalPath | ObjectPath | SourceRoots:
    """Return the path of a root."""
    return SourceRoots(root) if isinstance(root, tuple) else any_path(root)


def is_remote(root: Root) -> bool:
    """True if sources are in an object store."""
    path = root_path(root)
    return path.is_remote if isinstance(path, SourceRoots) else isinstance(path, ObjectPath)


def absolute_root(root: Root | None) -> Root | None:
    """Return a place that does not depend on the current folder."""
    return tuple(absolute_text(entry) or "" for entry in root) if isinstance(root, tuple) else absolute_text(root)
