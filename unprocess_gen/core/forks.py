"""Count in memory that a process shares with its forks."""

from __future__ import annotations

import mmap
import multiprocessing


class SharedCount:
    """Count of an object and its forked copies; processes that count at once may lose some.

    A pickled copy has a count of its own, and ``is_copy`` in a worker process.
    """

    def __init__(self, is_pickled: bool = False) -> None:
        self._bytes = mmap.mmap(-1, 8)
        self._is_pickled = is_pickled

    def __reduce__(self) -> tuple[type[SharedCount], tuple[bool]]:
        return SharedCount, (True,)

    @property
    def is_copy(self) -> bool:
        """True for a pickled copy in a process that `multiprocessing` started, which it knows once it runs."""
        return self._is_pickled and multiprocessing.parent_process() is not None

    def next(self) -> int:
        """Count one more; the first is 1."""
        count = int.from_bytes(self._bytes[:8], "little") + 1
        self._bytes[:8] = count.to_bytes(8, "little")
        return count
