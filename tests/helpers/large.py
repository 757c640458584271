"""Datasets of many tiny pairs, written without simulating them, and the peak memory of processes that read them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from helpers.commands import run_process
from unprocess_gen import RawPairs
from unprocess_gen.core.files import file_sha256
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.dataset_json import dataset_facts, dataset_text
from unprocess_gen.dataset.keys import key_text
from unprocess_gen.dataset.manifest import read_columns, write_rows
from unprocess_gen.dataset.reader import Sample
from unprocess_gen.dataset.row import row_json
from unprocess_gen.dataset.shards import ShardWriter, member_of, shard_name

PEAK = """
{code}
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""
"""Prints the peak of the process; ``ru_maxrss`` would include that of its parent before it started the program."""


def write_copies(original: Path, folder: Path, pairs: int, per_shard: int) -> Path:
    """Write a dataset that contains the first pair of another one many times, under other keys; return its folder."""
    (folder / "shards").mkdir(parents=True)
    sample = RawPairs(original)[0]
    config = (original / "config.yaml").read_text(encoding="utf-8")
    (folder / "config.yaml").write_text(config, encoding="utf-8")
    shards: list[dict[str, Any]] = []
    with (folder / "manifest.csv").open("w", encoding="utf-8", newline="") as manifest:
        write_rows(manifest, _rows(sample, folder, pairs, per_shard, shards), read_columns(original / "manifest.csv"))
    facts = {"pairs": pairs, "failed": {}, "sites": {}, "source": {"kind": "folder", "root": None}}
    dataset = dataset_facts(config, file_sha256(folder / "manifest.csv"), shards, facts)
    (folder / "dataset.json").write_text(dataset_text(dataset), encoding="ascii")
    return folder


def _rows(sample: Sample, folder: Path, pairs: int, per_shard: int, shards: list[dict[str, Any]]) -> Iterator[Row]:
    """Write the shards, append their entries to ``shards``, and yield their rows."""
    for number, first in enumerate(range(0, pairs, per_shard)):
        indices = range(first, min(first + per_shard, pairs))
        rows = [{**sample.row, "key": key_text(index), "shard": number} for index in indices]
        with ShardWriter(folder / "shards" / shard_name(number)) as writer:
            for row in rows:
                writer.add_frame(row["key"], member_of("clean", 0, 0), sample.clean)
                writer.add_frame(row["key"], member_of("noisy", 0, 0), sample.noisy)
                writer.add_rows(row["key"], row_json([row]))
        file = f"shards/{shard_name(number)}"
        entry = {"file": file, "pairs": len(rows), "failed": 0, "bytes": writer.bytes, "sha256": writer.sha256}
        shards.append(entry)
        yield from rows


def peak_megabytes(code: str, *arguments: object) -> float:
    """Run Python code in a process of its own, and return the most memory that it used, in units of 10^6 bytes."""
    done = run_process(sys.executable, "-c", PEAK.format(code=code), *arguments, timeout=3600)
    assert done.returncode == 0, done.stderr
    return int(done.stdout.split()[-2]) * 1024 / 1e6
