"""Read sources of an object store in threads, some ahead of their use.

A request takes 10 to 100 ms whatever its size. One at a time, at 40 ms, a worker would wait for 70 % of a run; eight
ahead hide the delay (``docs/design/object_stores.md``). Local files are read when they are used.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import partial

from unprocess_gen.core.entries import started_ahead
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.types import Source

ReadFile = Callable[[str, Source], bytes]
"""Function that returns the bytes of a source below a root: `reading.read_bytes`, or one that has read ahead."""

AHEAD = 8
"""Photographs that a worker reads ahead."""

AHEAD_BYTES = 2**28
"""Bytes of photographs that a worker holds ahead; the next one is always read, whatever its size."""


@contextmanager
def reading_ahead(root: str | None, read: ReadFile, sources: Sequence[Source]) -> Iterator[ReadFile]:
    """Read sources of an object store ahead while the body processes them in order; yield a function like ``read``.

    A source that is read a second time, or out of order, is read when it is asked for.
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
