"""Divide the shards of a run into chunks for workers that start, slow down and disappear.

`ChunkQueue` knows no cluster: `executors.dask` submits its chunks and reports what became of them.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

Ranges = tuple[tuple[int, int], ...]
"""Shards as ranges of their numbers, from the first to before the last."""

GROWTH = 4
"""Largest ratio of a chunk to the largest one before it, because the first shards also compile and load kernels."""

SMOOTHING = 0.5
"""Weight of the last chunk in the estimated time of a shard."""

PATIENCE = 2.0
"""Shard times after which an idle worker makes a shard that another worker has not finished."""


def ranges_of(shards: Sequence[int]) -> Ranges:
    """Return ascending shard numbers as ranges."""
    found: list[tuple[int, int]] = []
    for shard in shards:
        if found and found[-1][1] == shard:
            found[-1] = (found[-1][0], shard + 1)
        else:
            found.append((shard, shard + 1))
    return tuple(found)


def shards_of(ranges: Ranges) -> Iterator[int]:
    """Yield the shard numbers of ranges."""
    for first, last in ranges:
        yield from range(first, last)


@dataclass(eq=False, slots=True)
class Chunk:
    """Hold shards that one worker makes in order.

    Attributes
    ----------
    shards : tuple of int
        Their numbers, ascending.
    progressed_s : float
        Time of its submission or of its last finished shard, on a monotonic clock.
    """

    shards: tuple[int, ...]
    progressed_s: float


class ChunkQueue:
    """Hand out the shards of a run in chunks.

    Parameters
    ----------
    shards : iterable of int
        Numbers of the shards to make, ascending.
    chunk_s : float
        Work in a chunk, seconds.

    Attributes
    ----------
    left : set of int
        Shards that no worker has reported.
    shard_s : float or None
        Estimated time of a shard, seconds; None before the first chunk has ended.
    """

    def __init__(self, shards: Iterable[int], chunk_s: float) -> None:
        self._waiting = deque(shards)
        self._holders: dict[int, list[Chunk]] = {}
        self._chunk_s, self._largest = chunk_s, 1
        self.left = set(self._waiting)
        self.shard_s: float | None = None

    @property
    def waits(self) -> bool:
        """Return whether a shard is in no chunk."""
        return bool(self._waiting)

    def take(self, workers: int, now_s: float) -> Chunk | None:
        """Return the next chunk, None if every shard is in a chunk.

        Parameters
        ----------
        workers : int
            Number of workers. Chunks become smaller at the end, so that all workers end together.
        now_s : float
            Time on a monotonic clock.

        Returns
        -------
        Chunk or None
            One shard until the time of a shard is known.
        """
        size = 1 if self.shard_s is None else int(self._chunk_s / max(self.shard_s, 1e-6))
        size = max(1, min(size, self._largest * GROWTH, len(self._waiting) // (2 * max(1, workers))))
        shards: list[int] = []
        while self._waiting and len(shards) < size:
            shard = self._waiting.popleft()
            if shard in self.left:
                shards.append(shard)
        if not shards:
            return None
        self._largest = max(self._largest, len(shards)) if self.shard_s is not None else 1
        return self._chunk(sorted(shards), now_s)

    def share(self, running: Iterable[Chunk], count: int, now_s: float) -> Iterator[Chunk]:
        """Yield shards of running chunks for idle workers.

        An idle worker gets the last half of what is left of the chunk with most shards left. The other worker skips
        them once they are committed. A single shard is shared if it takes `PATIENCE` times as long as others.

        Parameters
        ----------
        running : iterable of Chunk
            Chunks that workers have not finished.
        count : int
            Number of idle workers.
        now_s : float
            Time on a monotonic clock.

        Yields
        ------
        Chunk
            At most ``count`` chunks of shards that are in no other chunk except the one that is shared.
        """
        patience = PATIENCE * (self.shard_s or 1.0)
        candidates: list[tuple[int, int, list[int]]] = []
        for number, chunk in enumerate(running):
            shards = [one for one in chunk.shards if one in self.left and len(self._holders[one]) == 1]
            if len(shards) > 1 or (shards and now_s - chunk.progressed_s >= patience):
                candidates.append((-len(shards), number, shards))
        heapq.heapify(candidates)
        for _ in range(min(count, len(self.left))):
            if not candidates:
                return
            _, number, shards = candidates[0]
            kept = shards[: len(shards) // 2]
            if len(kept) > 1:
                heapq.heapreplace(candidates, (-len(kept), number, kept))
            else:
                heapq.heappop(candidates)
            yield self._chunk(shards[len(kept) :], now_s)

    def _chunk(self, shards: Sequence[int], now_s: float) -> Chunk:
        chunk = Chunk(tuple(shards), now_s)
        for shard in shards:
            self._holders.setdefault(shard, []).append(chunk)
        return chunk

    def end(self, chunk: Chunk) -> None:
        """Count a chunk as ended; shards of it that are left, and in no other chunk, wait for a worker again."""
        again = []
        for shard in chunk.shards:
            holders = self._holders[shard]
            holders.remove(chunk)
            if not holders:
                del self._holders[shard]
                again += [shard] if shard in self.left else []
        self._waiting.extendleft(reversed(again))

    def finish(self, shard: int, now_s: float) -> bool:
        """Count a shard as finished at a time; return whether it was left."""
        if shard not in self.left:
            return False
        self.left.remove(shard)
        for chunk in self._holders.get(shard, ()):
            chunk.progressed_s = now_s
        return True

    def measure(self, shards: int, seconds: float) -> None:
        """Update the estimated time of a shard by a chunk's number of made shards and its time."""
        if shards:
            known = self.shard_s if self.shard_s is not None else seconds / shards
            self.shard_s = (1 - SMOOTHING) * known + SMOOTHING * seconds / shards
