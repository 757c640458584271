"""Measure what reading photographs from an object store costs, and what reading ahead saves.

    python tests/benchmarks/bench_object_store.py PHOTOS [LATENCY_MS]

PHOTOS are copied to an S3 server (moto), which runs behind a delaying proxy, each in a process of its own. Prints the
processor time of the client for each object, compared with the time to decode it, and wall times of one worker that
reads 1, 2, 4, 8 and 16 photographs ahead.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers import object_store as servers
from helpers.configs import composed

from unprocess_gen.core import object_store
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.types import Source
from unprocess_gen.sources import read_ahead
from unprocess_gen.sources.listing import read_bytes
from unprocess_gen.sources.loader import list_photographs, load_source

ROUNDS = 3


def serve(target: str, delay_s: float, pipe: Connection) -> None:
    """Run a proxy until the pipe is closed."""
    with servers.proxy(target) as proxy:
        proxy.delay_s = delay_s
        pipe.send(proxy.endpoint)
        pipe.recv()


def client_seconds(root: str, sources: tuple[Source, ...]) -> float:
    """Return the least processor time, all threads, to read every source once."""
    times = []
    for _ in range(ROUNDS):
        started = time.process_time()
        for source in sources:
            read_bytes(root, source)
        times.append(time.process_time() - started)
    return min(times)


def main() -> None:
    photos, latency_ms = Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 40.0
    with tempfile.TemporaryDirectory() as folder, servers.moto_server(Path(folder) / "log") as endpoint:
        servers.os.environ.update(servers.variables(endpoint))
        bucket = servers.create_bucket(endpoint, "photographs")
        servers.upload(photos, bucket)
        config = composed().source
        config.root = str(bucket)
        sources = list_photographs(config).sources
        size = sum(source.size_bytes or 0 for source in sources)
        client = client_seconds(config.root, sources)
        started = time.process_time()
        for source in sources:
            load_source(config, source)
        decoding = time.process_time() - started - client
        print(f"{len(sources)} photographs, {size / len(sources) / 1e6:.2f} MB on average")
        client_ms, decoding_ms = (1e3 * seconds / len(sources) for seconds in (client, decoding))
        print(f"client {client_ms:.2f} ms of CPU time per object, decoding {decoding_ms:.1f} ms")
        small = [Source(i, f"{i}", f"{i}", 1000) for i in range(100)]
        for source in small:
            (ObjectPath(f"{bucket}/small") / source.path).write_bytes(bytes(1000))
        small_client = client_seconds(f"{bucket}/small", tuple(small))
        print(f"client {1e3 * small_client / len(small):.2f} ms of CPU time per object of 1 kB")

        here, there = multiprocessing.get_context("spawn").Pipe()
        process = multiprocessing.get_context("spawn").Process(target=serve, args=(endpoint, latency_ms / 1e3, there))
        process.start()
        servers.os.environ.update(servers.variables(here.recv()))
        object_store._store.cache_clear()
        for ahead in (1, 2, 4, 8, 16):
            read_ahead.AHEAD = ahead
            walls = []
            for _ in range(ROUNDS):
                started, busy = time.perf_counter(), time.thread_time()
                with read_ahead.reading_ahead(config.root, read_bytes, sources) as read:
                    for source in sources:
                        load_source(config, source, read=read)
                walls.append((time.perf_counter() - started, time.thread_time() - busy))
            wall, busy = min(walls)
            print(
                f"{ahead:2} ahead, {latency_ms:g} ms: {wall:.2f} s, the thread that decodes is busy {busy / wall:.0%}"
            )
        here.send(None)
        process.join()


if __name__ == "__main__":
    main()
