"""Measure `merge` against copying and hashing the manifest that it writes.

    python tests/benchmarks/bench_merge.py FOLDER [SHARDS]

A run of one shard with eight tiny photographs is prepared in FOLDER, and its record is copied to SHARDS shards. Prints
processor and wall times of `merge`, and of ``cat``, ``sync`` and ``sha256sum`` of the manifest, in turn: records in the
page cache first, then records that were synced, whose deletion takes longer on some disks.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers.photographs import fill

import unprocess_gen as ug
from unprocess_gen.pipeline import parts
from unprocess_gen.pipeline.shard_records import record_name

ROUNDS = 5
IMAGES = 8


def prepared(folder: Path, shards: int) -> Path:
    """Return a dataset of which every shard has a record; the shards themselves do not exist."""
    root, ds = fill(folder / "photographs", IMAGES), folder / "prepared"
    config = ug.load_config([f"source.root={root}", f"out={ds}", "n_jobs=1", f"output.pairs_per_shard={IMAGES}"])
    parts.prepare(config, 1)
    parts.make_part(str(ds), 0)
    for name in ("plan.json", "listing.json"):
        path = ds / ".work" / name
        path.write_text(json.dumps(json.loads(path.read_text()) | {"sources": IMAGES * shards}))
    for shard in range(1, shards):
        shutil.copy(ds / record_name(0), ds / record_name(shard))
    return ds


def times(command: list[str] | None, ds: Path) -> tuple[float, float]:
    """Return processor and wall seconds of a command, or of a merge in this process."""
    started, before = time.monotonic(), os.times()
    if command is None:
        parts.merge(str(ds))
    else:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return sum(os.times()[:4]) - sum(before[:4]), time.monotonic() - started


def main() -> None:
    folder, shards = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 12_500
    source, ds = prepared(folder, shards), folder / "ds"
    copy = ["sh", "-c", f"cat {ds}/manifest.csv > {folder}/copy; sync {folder}/copy; sha256sum {folder}/copy"]
    for synced in (False, True):
        found: list[tuple[float, ...]] = []
        for _ in range(ROUNDS):
            shutil.copytree(source, ds)
            if synced:
                subprocess.run(["sync", "-f", str(ds)], check=True)
            found.append(times(None, ds) + times(copy, ds))
            shutil.rmtree(ds)
        merge_cpu, merge_wall, copy_cpu, copy_wall = (
            sorted(column)[ROUNDS // 2] for column in zip(*found, strict=True)
        )
        print(
            f"{'synced' if synced else 'cached'}: merge {merge_cpu:.2f} s of processor, {merge_wall:.2f} s of wall; "
            f"{merge_cpu / copy_cpu:.2f} and {merge_wall / copy_wall:.2f} times cat, sync and sha256sum (medians)"
        )


if __name__ == "__main__":
    main()
