"""Count the workers that died at a shard by files below ``.work/deaths``, for runs without a coordinator.

A worker creates a file before it generates a shard and removes it afterwards. A file that remains is a death, whatever
ended the process: a signal, a lack of memory, the end of a batch job. From the second attempt on, the file contains the
index of the source in progress.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from unprocess_gen.core.types import Source
from unprocess_gen.pipeline.storage import WORK, Storage

FOLDER = f"{WORK}/deaths"

LIMIT = 4
"""Deaths at a shard after which it gets provisional rows: as many as Dask allows a task by default."""


class Deaths:
    """Hold the deaths at a shard before this attempt."""

    def __init__(self, storage: Storage, shard: int) -> None:
        self._storage, self._prefix = storage, f"{shard:05d}-"
        self._names = [f"{FOLDER}/{name}" for name in storage.names(FOLDER) if name.startswith(self._prefix)]

    @property
    def count(self) -> int:
        """Number of workers that died at the shard."""
        return len(self._names)

    def source(self, sources: Sequence[Source]) -> Source:
        """Return the source at which a worker died, as far as it is known; else the first of the shard."""
        for name in self._names:
            with suppress(OSError, ValueError):
                index = int(self._storage.read(name))
                return next(source for source in sources if source.index == index)
        return sources[0]

    @contextmanager
    def marked(self) -> Iterator[Callable[[Source], None]]:
        """Keep a file until this attempt ends or its process dies; yield a function that records the source."""
        name = f"{FOLDER}/{self._prefix}{uuid.uuid4().hex}"
        self._storage.write(name, "")

        def mark(source: Source) -> None:
            if self._names:
                self._storage.write(name, str(source.index))

        try:
            yield mark
        finally:
            self._storage.remove(name)

    def forget(self) -> None:
        """Remove the files of earlier attempts."""
        for name in self._names:
            self._storage.remove(name)


def forget_deaths(storage: Storage) -> None:
    """Remove the files of all shards."""
    for name in storage.names(FOLDER):
        storage.remove(f"{FOLDER}/{name}")
