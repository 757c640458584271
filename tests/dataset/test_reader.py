"""`RawPairs` reads datasets and sweeps without copying."""

from __future__ import annotations

import mmap
import os
import pickle
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import Make
from helpers.photographs import fill

from unprocess_gen import RawPairs
from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.source import Source
from unprocess_gen.dataset import reader
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.sources.loader import load_source


def test_pairs_equal_those_made_from_photographs_and_plans(
    dataset: Path, photos: Path, settings: Callable[..., Any]
) -> None:
    config = settings(f"source.root={photos}")
    for sample in RawPairs(dataset):
        name = str(sample.row["source"]).replace("%25", "%").replace("%3D", "=")
        sha256, photograph = load_source(config.source, Source(0, name, name, sample.row["source_bytes"]))
        expected = make_pair(photograph.srgb, plan_image(config, sha256))
        assert np.array_equal(sample.clean, expected.clean)
        assert np.array_equal(sample.noisy, expected.noisy)


def test_a_sample_is_mapped_and_writing_to_it_touches_no_file(dataset: Path) -> None:
    pairs = RawPairs(dataset)
    before = [path.read_bytes() for path in sorted((dataset / "shards").iterdir())]
    clean, noisy, row = pairs[2]
    assert isinstance(clean.base, mmap.mmap) and isinstance(noisy.base, mmap.mmap)
    assert (array_xxh3(clean), array_xxh3(noisy)) == (row["clean_xxh3"], row["noisy_xxh3"])
    clean[:], row["source"] = 7, "mine"
    assert (clean == 7).all()
    assert [path.read_bytes() for path in sorted((dataset / "shards").iterdir())] == before
    assert (array_xxh3(pairs[2].clean), pairs[2].row["source"]) != (array_xxh3(clean), "mine")


@pytest.mark.linux_only("Windows deletes no file that is mapped")
def test_arrays_outlive_the_reader_and_the_file(dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset, tmp_path / "ds")
    sample = RawPairs(tmp_path / "ds")[0]
    shutil.rmtree(tmp_path / "ds")
    assert array_xxh3(sample.clean) == sample.row["clean_xxh3"]


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


@pytest.mark.linux_only("counts open files in /proc")
def test_no_file_stays_open(dataset: Path) -> None:
    before = open_files()
    pairs = RawPairs(dataset)
    for i in range(len(pairs)):
        assert pairs[i].clean.size
    assert open_files() == before


# Shared ---------------------------------------------------------------------------------------------------------------


def digests(dataset: Path) -> list[Any]:
    return [row["noisy_xxh3"] for row in read_rows(dataset / "manifest.csv")]


def test_places_of_members_are_bounded(make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six shards of two images with three members each; the places of one and a half shards may be kept."""
    make(fill(tmp_path / "p", 12), tmp_path / "ds", "output.pairs_per_shard=2")
    monkeypatch.setattr(reader, "MAX_MEMBERS", 9)
    pairs = RawPairs(tmp_path / "ds")
    for number in (0, 1, 11, 2, 0, 11):
        assert pairs[number].row["key"] == f"{number:08d}"
        assert sum(map(len, pairs._datasets[0]._indexes.values())) <= 9


def digest(pairs: RawPairs, number: int) -> str:
    return array_xxh3(pairs[number].noisy)


def test_a_reader_can_be_pickled_and_shared_between_threads(dataset: Path) -> None:
    pairs = RawPairs(dataset)
    for _ in range(2):  # before and after use
        copy = pickle.loads(pickle.dumps(pairs))
        assert [digest(copy, i) for i in range(13)] == digests(dataset)
        with ThreadPoolExecutor(4) as pool:
            assert list(pool.map(lambda i: digest(pairs, i % 13), range(52))) == digests(dataset) * 4


# Damage ---------------------------------------------------------------------------------------------------------------


def copy_first_shard(folder: Path) -> None:
    shutil.copy(folder / "shards/shard-00000.tar", folder / "shards/shard-00001.tar")


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda folder: (folder / "manifest.csv").unlink(), r"manifest.csv: no row at byte"),
        (lambda folder: (folder / "shards/shard-00001.tar").unlink(), r"shard-00001.tar: not a complete shard"),
        (copy_first_shard, r"shard-00001.tar: member 00000005.clean.npy is missing"),
    ],
    ids=["no manifest", "no shard", "shard of other images"],
)
def test_damage_is_reported_when_a_pair_is_read(
    damage: Callable[[Path], None], sentence: str, dataset: Path, tmp_path: Path
) -> None:
    pairs = RawPairs(shutil.copytree(dataset, tmp_path / "ds"))
    damage(tmp_path / "ds")
    with pytest.raises(DamageError, match=sentence):
        pairs[5]
    with pytest.raises(DamageError, match=r"manifest.csv: no such manifest"):
        RawPairs(tmp_path)


# Slices and sweeps ----------------------------------------------------------------------------------------------------


def test_slice_is_a_reader_of_its_pairs(dataset: Path) -> None:
    part = RawPairs(dataset)[2:9:3]
    assert isinstance(part, RawPairs)
    assert [sample.row["key"] for sample in part] == ["00000002", "00000005", "00000008"]
    assert [sample.row["key"] for sample in part[::-1]] == ["00000008", "00000005", "00000002"]
    assert part[-1].row["key"] == "00000008"
    assert len(RawPairs(dataset)[13:]) == 0
    assert part[np.int64(-3)].row["key"] == "00000002"  # type: ignore[call-overload]
    for number in (3, -4, 10**9):
        with pytest.raises(IndexError):
            part[number]
    assert digest(pickle.loads(pickle.dumps(part)), 1) == digests(dataset)[5]


@pytest.mark.parametrize(("epoch", "error"), [(-1, IndexError), (2**14, IndexError), ("00000001", TypeError)])
def test_epochs_are_checked_without_a_patch(dataset: Path, epoch: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        RawPairs(dataset)[epoch, 0]


@pytest.fixture(scope="module")
def sweep(make: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two datasets and a job that left none, in another order than their names."""
    folder = tmp_path_factory.mktemp("sweep")
    photos = fill(folder / "p", 3)
    for name, count in (("seed=2", 2), ("seed=1", 3)):
        make(photos, folder / "sweep" / name, name, f"source.limit={count}")
    (folder / "sweep" / "sweep.csv").write_text(
        "folder,overrides,seed,rows,failed,seconds,exit\nseed=2,seed=2,2,2,0,0.1,0\nseed=x,seed=x,x,,,,2\n"
        "seed=1,seed=1,1,3,0,0.1,0\n"
    )
    return folder / "sweep"


def test_sweep_is_read_in_the_order_of_its_table(sweep: Path) -> None:
    pairs = RawPairs(sweep)
    assert [(sample.dataset, sample.row["key"], sample.row["seed"]) for sample in pairs] == [
        ("seed=2", "00000000", 2),
        ("seed=2", "00000001", 2),
        ("seed=1", "00000000", 1),
        ("seed=1", "00000001", 1),
        ("seed=1", "00000002", 1),
    ]
    assert pairs.dataset == ("seed=2", "seed=2", "seed=1", "seed=1", "seed=1")
    assert pairs[3:].dataset == ("seed=1", "seed=1")
    assert digest(pickle.loads(pickle.dumps(pairs)), 4) == RawPairs(sweep / "seed=1")[2].row["noisy_xxh3"]
    copy = pickle.loads(pickle.dumps(pairs[0]))
    assert (copy.dataset, copy.row, len(copy)) == ("seed=2", pairs[0].row, 3)


def test_sweep_whose_dataset_was_deleted_is_damage(sweep: Path, tmp_path: Path) -> None:
    shutil.copytree(sweep, tmp_path / "sweep")
    shutil.rmtree(tmp_path / "sweep" / "seed=1")
    with pytest.raises(DamageError, match=r"seed=1/manifest\.csv: no such manifest"):
        RawPairs(tmp_path / "sweep")
