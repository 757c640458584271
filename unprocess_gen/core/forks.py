"""Count in memory that a process shares with its forks."""

from __future__ import annotations

import mmap


class SharedCount:
    """Count of an object and its forked copies; processes that count at once may lose some.

    A pickled copy has a count of its own, and ``is_copy``.
    """

    def __init__(self, is_copy: bool = False) -> None:
        self._bytes = mmap.mmap(-1, 8)
        self.is_copy = is_copy

    def __reduce__(self) -> tuple[type[SharedCount], tuple[bool]]:
        return SharedCount, (True,)

    def next(self) -> int:
        """Count one more; the first is 1."""
        count = int.from_bytes(self._bytes[:8], "little") + 1
        self._bytes[:8] = count.to_bytes(8, "little")
        return count
