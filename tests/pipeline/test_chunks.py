"""Chunks of shards for the workers of a cluster: sizes, losses and sharing."""

from __future__ import annotations

import itertools
import random

import pytest

from unprocess_gen.pipeline.executors.chunks import GROWTH, PATIENCE, Chunk, ChunkQueue, ranges_of, shards_of


@pytest.mark.parametrize(
    ("shards", "ranges"),
    [((), ()), ((3,), ((3, 4),)), ((0, 1, 2, 7, 9, 10), ((0, 3), (7, 8), (9, 11)))],
)
def test_ranges_hold_the_shards(shards: tuple[int, ...], ranges: tuple[tuple[int, int], ...]) -> None:
    assert ranges_of(shards) == ranges
    assert tuple(shards_of(ranges)) == shards


def test_chunks_grow_to_the_wanted_time() -> None:
    chunks = ChunkQueue(range(10_000), chunk_s=30)
    sizes = []
    for _ in range(8):
        chunk = chunks.take(2, 0)
        assert chunk is not None
        sizes.append(len(chunk.shards))
        for shard in chunk.shards:
            chunks.finish(shard, 0)
        chunks.measure(len(chunk.shards), 0.5 * len(chunk.shards))
        chunks.end(chunk)
    assert sizes[0] == 1
    assert all(later <= GROWTH * earlier for earlier, later in itertools.pairwise(sizes))
    assert sizes[-1] == 60


def test_last_chunks_are_small_so_that_workers_end_together() -> None:
    chunks = ChunkQueue(range(40), chunk_s=1000)
    chunks.measure(1, 0.1)
    sizes = []
    while (chunk := chunks.take(2, 0)) is not None:
        sizes.append(len(chunk.shards))
    assert sum(sizes) == 40
    assert max(sizes) <= 10
    assert sizes[-1] == 1


def test_lost_chunk_waits_for_the_next_worker() -> None:
    chunks = ChunkQueue(range(3), chunk_s=30)
    first, second = chunks.take(1, 0), chunks.take(1, 0)
    assert first is not None
    assert second is not None
    assert (first.shards, second.shards) == ((0,), (1,))
    chunks.finish(1, 0)
    chunks.end(second)
    chunks.end(first)
    again = chunks.take(1, 0)
    assert again is not None
    assert again.shards == (0,)
    assert chunks.left == {0, 2}


def test_idle_worker_gets_the_last_half_of_the_longest_chunk() -> None:
    chunks = ChunkQueue(range(20), chunk_s=30)
    chunk = chunks._chunk(range(10), 0)
    other = chunks._chunk(range(10, 13), 0)
    chunks._waiting.clear()
    for shard in (0, 1):
        chunks.finish(shard, 0)
    (shared,) = chunks.share([chunk, other], 1, 0)
    assert shared.shards == (6, 7, 8, 9)
    more = chunks.share([chunk, other, shared], 3, 0)
    assert [one.shards for one in more] == [(4, 5), (11, 12), (3,)]


def test_single_shard_is_shared_only_if_it_is_late() -> None:
    chunks = ChunkQueue([7], chunk_s=30)
    chunk = chunks.take(1, 100.0)
    assert chunk is not None
    chunks.measure(1, 3.0)
    assert not list(chunks.share([chunk], 1, 100.0 + 0.9 * PATIENCE * 3))
    (late,) = chunks.share([chunk], 2, 100.0 + 1.1 * PATIENCE * 3)
    assert late.shards == (7,)
    assert not list(chunks.share([chunk, late], 1, 1000.0))


def test_every_shard_is_finished_whatever_is_lost_and_shared() -> None:
    draw = random.Random(4)
    for _ in range(50):
        chunks, running, made = ChunkQueue(range(60), chunk_s=5), list[Chunk](), 0
        for now in range(10_000):
            if not chunks.left:
                break
            chunk = chunks.take(3, now) if len(running) < 6 else None
            running += [chunk] if chunk else []
            running += list(chunks.share(running, draw.choice((0, 0, 1, 2)), now))
            one = draw.choice(running)
            for shard in one.shards[: draw.randint(0, len(one.shards))]:
                made += chunks.finish(shard, now)
            if draw.random() < 0.5:
                chunks.measure(len(one.shards), draw.uniform(0.1, 5))
                running.remove(one)
                chunks.end(one)
        assert (made, chunks.left) == (60, set())
