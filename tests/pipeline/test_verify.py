"""Verify finds and names any damage; replay regenerates any pair from its row and its source."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, flip
from helpers.photographs import fill
from helpers.promise_report import Figure

from unprocess_gen import RawPairs
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.selection import select_rows
from unprocess_gen.dataset.shards import read_index
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.pipeline.verify import verify

FILES = ("config.yaml", "manifest.csv", "dataset.json", "shards/shard-00000.tar", "shards/shard-00001.tar")


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    """Make a dataset of three pairs in two shards, next to its photographs."""
    folder = tmp_path_factory.mktemp("intact")
    make(fill(folder / "p", 3), folder / "ds", "output.pairs_per_shard=2")
    return folder / "ds"


@pytest.fixture
def copy(intact: Path, tmp_path: Path) -> Path:
    shutil.copytree(intact, tmp_path / "ds")
    return tmp_path / "ds"


def damage_texts(folder: Path) -> list[str]:
    return [str(damage) for damage in verify(folder)]


@pytest.mark.parametrize("count", [150, pytest.param(1000, marks=pytest.mark.slow)])
def test_every_flipped_bit_is_found(count: int, copy: Path, figure: Figure) -> None:
    """The files of half of the bits are drawn by size."""
    rng, found = random.Random(count), 0
    sizes = {name: (copy / name).stat().st_size for name in FILES}
    for _ in range(count):
        (name,) = rng.choices(FILES, [*sizes.values()] if rng.random() < 0.5 else None)
        place = rng.randrange(sizes[name]), rng.randrange(8)
        flip(copy / name, *place)
        found += bool(verify(copy))
        flip(copy / name, *place)
    assert (found, verify(copy)) == (count, [])
    figure("verify", f"{found} of {count} flipped bits found")


@pytest.mark.parametrize("name", FILES)
def test_every_truncation_is_found(name: str, copy: Path) -> None:
    """At random places, and where members of a shard and their data begin and end."""
    content = (copy / name).read_bytes()
    rng = random.Random(name)
    cuts = {0, 1, len(content) - 1, *(rng.randrange(len(content)) for _ in range(40))}
    for member in read_index(copy / name).values() if name.endswith(".tar") else ():
        cuts |= {member.offset - 512, member.offset, member.offset + member.size}
    for cut in sorted(cuts - {len(content)}):
        (copy / name).write_bytes(content[:cut])
        assert damage_texts(copy), f"{name} cut to {cut} of {len(content)} bytes"


@pytest.mark.parametrize(
    ("member", "at", "what"),
    [
        ("noisy.npy", 300, "the XXH3-128 of its data is "),
        ("clean.npy", -512, "its tar header differs from what the manifest records, from byte 0 on"),
        ("clean.npy", 60, "its npy header differs from what the manifest records, from byte 60 on"),
        ("json", 5, "its member differs from what the manifest records, from byte 517 on"),
    ],
)
def test_damage_is_named_by_shard_key_and_member(member: str, at: int, what: str, copy: Path) -> None:
    shard = copy / "shards/shard-00000.tar"
    flip(shard, read_index(shard)[f"00000001.{member}"].offset + at, 3)
    (damage,) = damage_texts(copy)
    assert damage.startswith(f"shards/shard-00000.tar: 00000001.{member}: {what}")


def test_missing_and_foreign_shards_are_named(copy: Path) -> None:
    (copy / "shards/shard-00001.tar").rename(copy / "shards/shard-00007.tar")
    assert damage_texts(copy) == [
        "shards/shard-00007.tar: is not part of this dataset",
        "shards/shard-00001.tar: is missing",
    ]


def test_swapped_shards_are_named(copy: Path) -> None:
    for old, new in ((FILES[3], "aside"), (FILES[4], FILES[3]), ("aside", FILES[4])):
        (copy / old).rename(copy / new)
    assert {line.split(":")[0] for line in damage_texts(copy)} == {*FILES[3:]}


def test_a_shard_of_a_dataset_with_another_seed_is_found(copy: Path, intact: Path, make: Make, tmp_path: Path) -> None:
    make(intact.parent / "p", tmp_path / "other", "output.pairs_per_shard=2", "seed=1")
    shutil.copy(tmp_path / "other/shards/shard-00000.tar", copy / "shards/shard-00000.tar")
    assert "00000000.noisy.npy: the XXH3-128 of its data is" in "\n".join(damage_texts(copy))


def edit(folder: Path, change: Callable[[list[str]], None]) -> list[str]:
    """Change the lines of a manifest, and return the damage that is found apart from its digest."""
    manifest = folder / "manifest.csv"
    lines = manifest.read_text(encoding="utf-8").splitlines(keepends=True)
    change(lines)
    manifest.write_text("".join(lines), encoding="utf-8")
    digest, *others = damage_texts(folder)
    assert digest.startswith(f"manifest.csv: its SHA-256 is {file_sha256(manifest)}")
    return others


def test_shards_out_of_order_in_the_manifest_are_named(copy: Path) -> None:
    def move_last_row_first(lines: list[str]) -> None:
        lines.insert(1, lines.pop())

    assert edit(copy, move_last_row_first) == [
        "manifest.csv: row 00000000 of shard 0 follows rows of shard 1; expected shards in ascending order"
    ]


def test_unreadable_last_row_leaves_the_digests_of_shards(copy: Path) -> None:
    flip(copy / "shards/shard-00000.tar", 3000)

    def cut_last_row(lines: list[str]) -> None:
        lines[-1] = lines[-1][:100]

    unreadable, digest = edit(copy, cut_last_row)
    assert unreadable.startswith("manifest.csv: not a readable manifest (the last line is cut")
    assert digest.startswith("shards/shard-00000.tar: its SHA-256 is ")


def test_shard_without_rows_and_shard_without_entry_are_named(copy: Path) -> None:
    (copy / "shards/shard-00007.tar").touch()

    def give_the_last_row_to_shard_5(lines: list[str]) -> None:
        lines[-1] = lines[-1].replace(",1,0,", ",5,0,", 1)

    assert edit(copy, give_the_last_row_to_shard_5) == [
        "shards/shard-00007.tar: is not part of this dataset",
        "shards/shard-00001.tar: something follows the end",
        "shards/shard-00005.tar: is missing",
    ]


@pytest.mark.parametrize("name", ["config.yaml", "manifest.csv", "dataset.json"])
def test_a_missing_file_is_named(name: str, copy: Path) -> None:
    (copy / name).unlink()
    assert damage_texts(copy) == [f"{name}: is missing"]


def test_a_folder_without_a_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DamageError, match=r"contains neither dataset.json nor manifest.csv"):
        verify(tmp_path)


def test_command_ends_with_4_and_a_line_for_each_damage(copy: Path, run_main: RunMain) -> None:
    (copy / "shards/shard-00001.tar").unlink()
    done = run_main("verify", copy)
    assert (done.code, done.out) == (4, "")
    assert done.err.splitlines()[0] == f"gen-dataset: {copy}: shards/shard-00001.tar: is missing"


# Replay ---------------------------------------------------------------------------------------------------------------


def test_replay_regenerates_the_pair_of_every_row(intact: Path, figure: Figure) -> None:
    root = str(intact.parent / "p")
    replayed = list(replay(read_rows(intact / "manifest.csv"), root))
    assert [(one.key, one.complaint) for one in replayed] == [(f"{i:08d}", "") for i in range(3)]
    figure("replay", f"{sum(not one.complaint for one in replayed)} of {len(replayed)} pairs regenerated")


def test_replay_needs_only_the_row_and_the_source(intact: Path, run_main: RunMain, tmp_path: Path) -> None:
    shutil.copy(intact / "manifest.csv", tmp_path / "rows.csv")
    shutil.copytree(intact.parent / "p", tmp_path / "moved")
    done = run_main("replay", "rows.csv", "source.root=moved", "--to", "arrays")
    assert (done.code, done.out) == (0, "3 pairs are the same, bit for bit; 0 are not; arrays in arrays\n")
    for sample in RawPairs(intact):
        assert np.array_equal(np.load(tmp_path / f"arrays/{sample.row['key']}.clean.npy"), sample.clean)
        assert np.array_equal(np.load(tmp_path / f"arrays/{sample.row['key']}.noisy.npy"), sample.noisy)


def test_replay_counts_failed_rows(make: Make, run_main: RunMain, tmp_path: Path) -> None:
    folder = fill(tmp_path / "p", 3)
    for name in ("000.png", "001.png"):
        (folder / name).write_bytes(b"no picture")
    make(folder, tmp_path / "ds", "source.max_failed=2")
    for words, counts in (((), ("1 pair is", "2 failed rows")), (("--keys", "0"), ("0 pairs are", "1 failed row"))):
        done = run_main("replay", "ds", *words)
        assert done == (0, "{} the same, bit for bit; 0 are not; {} skipped\n".format(*counts), "")


def test_a_row_of_a_file_needs_a_folder(intact: Path) -> None:
    with pytest.raises(ConfigError, match=r"row 00000000 was generated from the file .*; give source.root="):
        list(replay(read_rows(intact / "manifest.csv"), root=None))


@pytest.mark.parametrize("keys", ["7", ""])
def test_selection_of_missing_rows_is_refused(keys: str, intact: Path) -> None:
    with pytest.raises(ConfigError, match="--keys"):
        list(select_rows(intact / "manifest.csv", keys))


@pytest.mark.parametrize(("asked", "made"), [(2, 2), (99, 3)])
def test_verify_regenerates_at_most_all_pairs(asked: int, made: int, intact: Path, run_main: RunMain) -> None:
    assert f"; {made} pairs regenerated, bit for bit" in run_main("verify", intact, "--regenerate", asked).out


def test_dataset_json_ends_with_its_own_digest(intact: Path) -> None:
    assert list(json.loads((intact / "dataset.json").read_text()))[-1] == "dataset_sha256"
