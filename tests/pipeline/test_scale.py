"""Memory does not grow with the rows of a dataset, and by a bounded amount with each file of a listing."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.datasets import Make
from helpers.large import peak_megabytes, write_copies
from helpers.photographs import fill

from unprocess_gen.core.files import file_sha256
from unprocess_gen.pipeline.verify import verify

VERIFY = """
import sys
from pathlib import Path
from unprocess_gen.pipeline.verify import verify
assert verify(Path(sys.argv[1])) == []
"""

LIST = """
import sys
import unprocess_gen as ug
from unprocess_gen.sources.loader import list_photographs
sources = list_photographs(ug.load_config([f"source.root={sys.argv[1]}"]).source).sources
assert len(sources) == 1_000_000
assert sum(source.occurrence for source in sources) == 100_000
"""


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    """Make a dataset of one small pair."""
    folder = tmp_path_factory.mktemp("original")
    make(fill(folder / "p", 1), folder / "ds", "source.downscale=6")
    return folder / "ds"


@pytest.fixture
def copies(original: Path, tmp_path: Path) -> Path:
    """Write a dataset of twelve copies of it, in three shards."""
    return write_copies(original, tmp_path / "copies", 12, 4)


def edit(folder: Path, change: Callable[[list[str]], None]) -> list[str]:
    """Change the lines of a manifest, and return the damage that is found apart from its digest."""
    manifest = folder / "manifest.csv"
    lines = manifest.read_text(encoding="utf-8").splitlines(keepends=True)
    change(lines)
    manifest.write_text("".join(lines), encoding="utf-8")
    digest, *others = map(str, verify(folder))
    assert digest.startswith(f"manifest.csv: its SHA-256 is {file_sha256(manifest)}")
    return others


def test_copies_are_an_intact_dataset(copies: Path) -> None:
    assert verify(copies) == []


def test_shards_out_of_order_in_the_manifest_are_named(copies: Path) -> None:
    def move_last_shard_first(lines: list[str]) -> None:
        lines[1:] = lines[9:] + lines[1:9]

    assert edit(copies, move_last_shard_first) == [
        "manifest.csv: row 00000000 of shard 0 follows rows of shard 2; expected shards in ascending order"
    ]


def test_unreadable_last_row_leaves_the_digests_of_shards(copies: Path) -> None:
    shard = copies / "shards" / "shard-00000.tar"
    with shard.open("r+b") as stream:
        stream.seek(3000)
        stream.write(b"?")

    def cut_last_row(lines: list[str]) -> None:
        lines[-1] = lines[-1][:100]

    unreadable, digest = edit(copies, cut_last_row)
    assert unreadable.startswith("manifest.csv: not a readable manifest (the last line is cut")
    assert digest.startswith("shards/shard-00000.tar: its SHA-256 is ")


def test_manifest_without_rows_leaves_the_digests_of_shards(copies: Path) -> None:
    assert edit(copies, lambda lines: lines.__delitem__(slice(1, None))) == []


def test_shard_without_rows_and_shard_without_entry_are_named(copies: Path) -> None:
    (copies / "shards" / "shard-00007.tar").touch()
    (copies / "shards" / "shard-00001.tar").rename(copies / "shards" / "shard-00009.tar")

    def drop_shard_2_and_add_shard_5(lines: list[str]) -> None:
        lines[9:] = [line.replace(",2,0,", ",5,0,", 1) for line in lines[9:]]

    assert edit(copies, drop_shard_2_and_add_shard_5) == [
        "shards/shard-00007.tar: is not part of this dataset",
        "shards/shard-00009.tar: is not part of this dataset",
        "shards/shard-00001.tar: is missing",
        "shards/shard-00002.tar: something follows the end",
        "shards/shard-00005.tar: is missing",
    ]


@pytest.mark.slow
def test_verify_of_100_000_rows_takes_less_than_300_megabytes(original: Path, tmp_path: Path) -> None:
    few = peak_megabytes(VERIFY, write_copies(original, tmp_path / "few", 1_000, 8))
    many = peak_megabytes(VERIFY, write_copies(original, tmp_path / "many", 100_000, 8))
    print(f"verify: {few:.0f} MB for 1,000 rows, {many:.0f} MB for 100,000")
    assert many < 300
    assert many < few + 30


@pytest.mark.slow
def test_listing_of_a_million_files_takes_less_than_1500_megabytes(tmp_path: Path) -> None:
    """The files are empty except for a hole; a fifth of them share size and content with another one."""
    for number in range(1_000_000):
        folder = tmp_path / f"{number // 1000:03d}"
        if number % 1000 == 0:
            folder.mkdir()
        with (folder / f"photograph_{number:08d}.jpg").open("wb") as file:
            file.truncate(1 + number % 900_000)
    peak = peak_megabytes(LIST, tmp_path)
    shutil.rmtree(tmp_path)
    print(f"listing: {peak:.0f} MB for a million files")
    assert peak < 1500
