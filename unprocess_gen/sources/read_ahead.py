"""Read sources of an object store in threads, some ahead of their use.

A request takes 10 to 100 ms whatever its size. One at a time, at 40 ms, a worker would wait for 70 % of a run; eight
ahead hide the delay (``docs/design/object_stores.md``). Local files are read when they are used.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial

from unprocess_gen.core.object_store import Result, in_threads, is_url
from unprocess_gen.core.types import Source

Read = Callable[[str, Source], bytes]
"""Function that returns the bytes of a source below a root: `listing.read_bytes`, or one that has read ahead."""

AHEAD = 8
"""Photographs that a worker reads ahead."""

AHEAD_BYTES = 2**28
"""Bytes of photographs that a worker holds ahead; the next one is always read, whatever its size."""


def in_order(root: str, function: Callable[[str, Source], Result], sources: Iterable[Source]) -> Iterator[Result]:
    """Apply a function to sources: in threads if they are in an object store.

    Parameters
    ----------
    root : str
        Value of ``source.root``.
    function : callable
        Takes the root and a source.
    sources : iterable of Source
        Any number.

    Yields
    ------
    object
        Results in the order of the sources.
    """
    if not is_url(root):
        yield from (function(root, source) for source in sources)
        return
    yield from in_threads(partial(function, root), sources)


@contextmanager
def reading_ahead(root: str | None, read: Read, sources: Sequence[Source]) -> Iterator[Read]:
    """Read sources ahead while the body processes them in order.

    Parameters
    ----------
    root : str or None
        Value of ``source.root``.
    read : callable
        Reads one source.
    sources : sequence of Source
        Photographs in the order of their use.

    Yields
    ------
    callable
        Use it like ``read``. For local files it is ``read`` itself. A source that is read a second time, or out of
        order, is read when it is asked for.
    """
    if not is_url(root):
        yield read
        return
    assert root is not None
    with ThreadPoolExecutor(AHEAD, "read ahead") as pool:
        ahead = _Ahead(root, read, sources, pool)
        try:
            yield ahead.read
        finally:
            ahead.cancel()


class _Ahead:
    """Hold the reads that were started before their use."""

    def __init__(self, root: str, read: Read, sources: Sequence[Source], pool: ThreadPoolExecutor) -> None:
        self._root, self._read, self._pool = root, read, pool
        self._later = deque(sources)
        self._started: deque[tuple[Source, Future[bytes]]] = deque()
        self._bytes = 0

    def read(self, root: str, source: Source) -> bytes:
        """Return the bytes of a source, and start to read the next ones."""
        while self._started and self._started[0][0].index < source.index:
            self._take()[1].cancel()  # a source that was not needed after all
        while self._later and self._later[0].index < source.index:
            self._later.popleft()
        self._start()
        if not self._started or self._started[0][0] != source:
            return self._read(root, source)
        _, future = self._take()
        content = future.result()
        self._start()
        return content

    def cancel(self) -> None:
        """Drop the reads that have not begun."""
        for _, future in self._started:
            future.cancel()

    def _start(self) -> None:
        while self._later and len(self._started) < AHEAD:
            size = self._later[0].size_bytes or 0
            if self._started and self._bytes + size > AHEAD_BYTES:
                return
            source = self._later.popleft()
            self._started.append((source, self._pool.submit(self._read, self._root, source)))
            self._bytes += size

    def _take(self) -> tuple[Source, Future[bytes]]:
        source, future = self._started.popleft()
        self._bytes -= source.size_bytes or 0
        return source, future
