"""Memory does not grow with the rows of a dataset, and by a bounded amount with each file of a listing."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.commands import run_process
from helpers.datasets import Make
from helpers.photographs import fill

from unprocess_gen import RawPairs
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.dataset_json import dataset_facts, dataset_text
from unprocess_gen.dataset.keys import key_text
from unprocess_gen.dataset.manifest import csv_lines, read_columns, write_manifest
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
    names, rows = read_columns(original / "manifest.csv"), _rows(sample, folder, pairs, per_shard, shards)
    digest = write_manifest(folder / "manifest.csv", names, (csv_lines([row], names) for row in rows))
    facts = {"pairs": pairs, "failed": {}, "sites": {}, "source": {"kind": "folder", "root": None}}
    dataset = dataset_facts(config, digest, shards, facts)
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


VERIFY = """
import sys
from pathlib import Path
from unprocess_gen.pipeline.verify import verify
assert verify(Path(sys.argv[1])) == []
"""

LIST = """
import sys
import unprocess_gen as ug
from unprocess_gen.sources.listing import list_photographs
sources = list_photographs(ug.load_config([f"source.root={sys.argv[1]}"]).source).sources
assert len(sources) == 1_000_000
assert sum(source.occurrence for source in sources) == 99_999
"""

PART = """
import sys
import unprocess_gen as ug
from unprocess_gen.pipeline.generate import make_part
root, out, part, parts, *overrides = sys.argv[1:]
config = ug.load_config([f"source.root={root}", f"out={out}", "n_jobs=1", "check_disk=false", *overrides])
assert make_part(config, int(part), int(parts)).shards > 0
"""

MERGE = """
import os, sys
from pathlib import Path
from unprocess_gen.pipeline.generate import merge
out, shards = Path(sys.argv[1]), int(sys.argv[2])
records = out / ".work" / "rows"
for shard in range(shards):
    if not (records / f"{shard:05d}.json").exists():
        os.link(records / "00001.json", records / f"{shard:05d}.json")
assert merge(str(out))[0].rows == 100 * shards
"""


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    """Make a dataset of one small pair."""
    folder = tmp_path_factory.mktemp("original")
    make(fill(folder / "p", 1), folder / "ds", "source.downscale=6")
    return folder / "ds"


@pytest.mark.slow
def test_verify_of_100_000_rows_takes_less_than_300_megabytes(original: Path, tmp_path: Path) -> None:
    few = peak_megabytes(VERIFY, write_copies(original, tmp_path / "few", 1_000, 8))
    many = peak_megabytes(VERIFY, write_copies(original, tmp_path / "many", 100_000, 8))
    print(f"verify: {few:.0f} MB for 1,000 rows, {many:.0f} MB for 100,000")
    assert many < 300
    assert many < few + 30


@pytest.fixture(scope="module")
def million(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Make a folder of a small photograph and 999,999 files that are empty except for a hole.

    A fifth of the files share size and content with another one.
    """
    root = fill(tmp_path_factory.mktemp("million") / "p", 1)
    for number in range(999_999):
        folder = root / f"{number // 1000:03d}"
        if number % 1000 == 0:
            folder.mkdir()
        with (folder / f"photograph_{number:08d}.jpg").open("wb") as file:
            file.truncate(1 + number % 900_000)
    yield root
    shutil.rmtree(root)


@pytest.mark.slow
def test_parts_of_a_million_files_take_bounded_memory(million: Path, tmp_path: Path) -> None:
    """The first part lists the files; the second one reads the listing."""
    out = tmp_path / "ds"
    first, second = (peak_megabytes(PART, million, out, part, 1000, "output.pairs_per_shard=8") for part in (0, 1))
    print(f"first part: {first:.0f} MB; second part: {second:.0f} MB")
    assert first < 1500
    assert second < 400


@pytest.mark.slow
def test_merge_takes_memory_that_is_flat_in_rows(million: Path, tmp_path: Path) -> None:
    """The records of most shards are copies of one with a hundred failed sources."""
    peaks = []
    for sources in (1_000, 1_000_000):
        out, parts = tmp_path / str(sources), sources // 1000
        overrides = ("output.pairs_per_shard=100", f"source.limit={sources}")
        peak_megabytes(PART, million, out, 1 % parts, parts, *overrides)
        peaks.append(peak_megabytes(MERGE, out, sources // 100))
    print(f"merge: {peaks[0]:.0f} MB for 1,000 rows, {peaks[1]:.0f} MB for a million")
    assert peaks[1] < peaks[0] + 50
