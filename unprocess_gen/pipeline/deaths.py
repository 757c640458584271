"""Count the deaths of workers: a source with four counted deaths gets the row ``worker_died``.

    .work/deaths/00012    sources of shard 12 at which workers died, as a list of indices

A worker adds an entry when it begins a shard and removes it when it ends, so an entry that remains is a death, whatever
ended the process: a signal, a lack of memory, the end of a batch job. A pool does not count a death at which several
shards were in progress (`executors.local`). The first entry of a shard is `UNKNOWN`, so that a healthy shard costs one
write and one deletion; later ones name the source in progress. A shard that is done has no file.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.records import parse_record
from unprocess_gen.core.source import Source
from unprocess_gen.pipeline.folder import WORK, OutFolder
from unprocess_gen.pipeline.tasks import ShardTask

DEATHS = f"{WORK}/deaths"

MAX_DEATHS = 4
"""Deaths, in all runs until the shard is done, after which its source is not read: as many as Dask allows a task."""

UNKNOWN = -1
"""Entry of a death that may have been at any source of the shard."""


def shards_with_deaths(folder: OutFolder) -> set[int]:
    """Shards at which a worker died, or that are being made."""
    return {int(name) for name in (folder / DEATHS).entries() if name.isdecimal()}


def read_deaths(folder: OutFolder, shard: int) -> list[int]:
    """Sources at which workers of a shard died, in order."""
    try:
        return parse_record(folder.read(_file(shard)), list[int])
    except FileNotFoundError:
        return []
    except (OSError, ValueError):  # its worker died while it wrote
        return [UNKNOWN]


def write_deaths(folder: OutFolder, shard: int, deaths: Sequence[int]) -> None:
    """Replace the deaths of a shard; without any, delete the file."""
    file = folder / _file(shard)
    with suppress(FileNotFoundError):  # another run has finished the dataset
        if deaths:
            file.write_bytes(json.dumps(deaths).encode())
        else:
            file.delete()


def deadly_sources(task: ShardTask, deaths: Sequence[int]) -> list[Source]:
    """Sources of a shard that are not read any more."""
    unknown = deaths.count(UNKNOWN)
    deadly = [source for source in task.sources if unknown + deaths.count(source.index) >= MAX_DEATHS]
    known = [source for source in deadly if source.index in deaths]
    return known or deadly


@contextmanager
def counted_attempt(folder: OutFolder, task: ShardTask) -> Iterator[tuple[list[Source], Callable[[Source], None]]]:
    """Count a death at a shard unless the body ends; yield deadly sources, and what to call with each other one."""
    deaths = read_deaths(folder, task.shard)

    def mark(source: Source) -> None:
        if deaths:
            write_deaths(folder, task.shard, [*deaths, source.index])

    write_deaths(folder, task.shard, [*deaths, UNKNOWN])
    try:
        yield deadly_sources(task, deaths), mark
    except BaseException:
        with suppress(OSError, MachineError):  # the error of the body matters
            write_deaths(folder, task.shard, deaths)
        raise
    write_deaths(folder, task.shard, [])


def count_death(folder: OutFolder, task: ShardTask, before: Sequence[int]) -> None:
    """Count the death of a worker that had not begun its shard; one that had, has counted its own."""
    if len(read_deaths(folder, task.shard)) <= len(before):
        write_deaths(folder, task.shard, [*before, UNKNOWN])


def _file(shard: int) -> str:
    return f"{DEATHS}/{shard:05d}"
