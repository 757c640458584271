"""Count in memory that a process shares with its forks."""

from __future__ import annotations

import mmap
import multiprocessing
from collections.abc import Callable


class SharedCount:
    """Count of an object and its forked copies; processes that count at once may lose some.

    A pickled copy has a count of its own, and ``is_copy`` in a process that `multiprocessing` started.
    """

    def __init__(self, is_copy: bool = False) -> None:
        self._bytes = mmap.mmap(-1, 8)
        self.is_copy = is_copy

    def __reduce__(self) -> tuple[Callable[[], SharedCount], tuple[()]]:
        return _copied, ()

    def next(self) -> int:
        """Count one more; the first is 1."""
        count = int.from_bytes(self._bytes[:8], "little") + 1
        self._bytes[:8] = count.to_bytes(8, "little")
        return count


def _copied() -> SharedCount:
    return SharedCount(is_copy=multiprocessing.parent_process() is not None)
