"""`gen-dataset export` writes the same values in the formats that other libraries read."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import lmdb
import numpy as np
import pytest
import tifffile
from helpers.commands import RunMain
from helpers.datasets import Make, text_rows

import unprocess_gen as ug
from unprocess_gen.core import libraries
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.dataset.export import FORMATS, ExportSummary, export
from unprocess_gen.dataset.manifest import without_empty

Arrays = dict[tuple[str, str], Any]
"""Arrays by their name and the key of their pair."""


def files_in(folder: Path, suffix: str, read: Callable[[Path], Any]) -> Arrays:
    return {(path.parent.name, path.stem): read(path) for path in folder.glob(f"*/*.{suffix}")}


def hdf5_in(folder: Path) -> Arrays:
    with h5py.File(folder / "pairs.h5") as file:
        return {(name, key): array[:] for name, group in file.items() for key, array in group.items()}


def lmdb_in(folder: Path) -> Arrays:
    found: Arrays = {}
    for place in folder.glob("*.lmdb"):
        with lmdb.open(str(place), readonly=True, lock=False) as environment, environment.begin() as transaction:
            for key, value in transaction.cursor():
                is_row = place.stem == "row"
                found[place.stem, key.decode()] = json.loads(value) if is_row else np.load(io.BytesIO(value))
    return found


READ: dict[str, Callable[[Path], Arrays]] = {
    "npy": lambda folder: files_in(folder, "npy", np.load),
    "tiff": lambda folder: files_in(folder, "tif", tifffile.imread),
    "hdf5": hdf5_in,
    "lmdb": lmdb_in,
}


def done(folder: Path, form: str, to: Path) -> ExportSummary:
    """Export one dataset."""
    ((place, summary),) = export(folder, form, to)
    assert place == to
    return summary


def assert_exported(folder: Path, form: str, to: Path) -> None:
    """Compare every array of an export with the dataset, and the manifests."""
    assert (to / "manifest.csv").read_bytes() == (folder / "manifest.csv").read_bytes()
    splits = {row["split"] for row in text_rows(to)}
    found = {split: READ[form](to / split) for split in splits}
    for sample in ug.RawPairs(folder):
        arrays = {"clean": sample.clean, "noisy": sample.noisy, **sample.targets}
        for name, array in arrays.items():
            exported = found[sample.row["split"]].pop((name, sample.row["key"]))
            np.testing.assert_array_equal(exported, array, strict=True)
        if form == "lmdb":
            row = found[sample.row["split"]].pop(("row", sample.row["key"]))
            assert row == without_empty(sample.row)
    assert not any(found.values())


@pytest.fixture(scope="module")
def folder(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset with patches, draws, targets and splits, in shards of two sources."""
    out = tmp_path_factory.mktemp("export") / "ds"
    recipe = ("source.patch=[random,32,2]", "noise.draws=2", "output.targets=[srgb,variance]", "source.limit=4")
    make(None, out, *recipe, "split={train: 0.5, val: 0.5}", "output.pairs_per_shard=2")
    return out


@pytest.mark.parametrize("form", FORMATS)
def test_every_value_of_a_dataset_is_exported(form: str, folder: Path, tmp_path: Path) -> None:
    assert done(folder, form, tmp_path / "to") == (16, 0)
    assert_exported(folder, form, tmp_path / "to")
    assert done(folder, form, tmp_path / "to") == (0, 16)


@pytest.mark.parametrize("form", FORMATS)
def test_planes_and_floats_are_exported(form: str, make: Make, tmp_path: Path) -> None:
    formats = ("output.layout=packed", "output.dtype=float32", "output.targets=[linear_rgb]")
    make(None, tmp_path / "ds", *formats, "source.patch=[random,32,1]", "source.limit=1")
    done(tmp_path / "ds", form, tmp_path / "to")
    assert_exported(tmp_path / "ds", form, tmp_path / "to")


class Killed(BaseException):
    """End an export."""


@pytest.mark.parametrize(("owner", "name"), [(ug.RawPairs, "__getitem__"), (os, "replace")], ids=["read", "rename"])
@pytest.mark.parametrize("form", FORMATS)
def test_an_interrupted_export_is_continued_to_the_same_values(
    form: str, owner: Any, name: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    to, function, attempts = tmp_path / "to", getattr(owner, name), 0
    while not (to / "manifest.csv").exists():
        left = iter(range(attempts))

        def killed(*arguments: Any, left: Any = left) -> Any:
            if next(left, None) is None:
                raise Killed
            return function(*arguments)

        attempts += 1
        with monkeypatch.context() as patch, suppress(Killed):
            patch.setattr(owner, name, killed)
            done(folder, form, to)
    assert attempts > 2
    assert_exported(folder, form, to)
    assert not (to / ".unfinished").exists()


def test_rows_travel_with_the_arrays(folder: Path, tmp_path: Path) -> None:
    pair = ug.RawPairs(folder)[3]
    place, key = pair.row["split"], pair.row["key"]
    for form in ("hdf5", "tiff"):
        done(folder, form, tmp_path / form)
    with h5py.File(tmp_path / "hdf5" / place / "pairs.h5") as file:
        in_hdf5 = json.loads(file[f"noisy/{key}"].attrs["row"])
    with tifffile.TiffFile(tmp_path / "tiff" / place / "noisy" / f"{key}.tif") as file:
        in_tiff = json.loads(file.pages[0].description)
    assert in_hdf5 == in_tiff == without_empty(pair.row)


def test_a_sweep_becomes_a_folder_for_each_dataset(run_main: RunMain, tmp_path: Path) -> None:
    run_main("-m", "seed=1,2", "source.limit=1", "out=sweep", "n_jobs=1")
    assert run_main("export", "sweep", "--to", "npy", "--format", "npy").code == 0
    for name in ("seed=1,source.limit=1", "seed=2,source.limit=1"):
        assert_exported(tmp_path / "sweep" / name, "npy", tmp_path / "npy" / name)


def test_wrong_exports_are_refused_and_write_nothing(
    folder: Path, run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/a.txt").touch()
    done(folder, "npy", tmp_path / "npy")
    for to, form, problem in (
        ("mine", "npy", "--to mine: contains a.txt, but no export"),
        ("npy", "tiff", "--to npy: contains an export of another dataset or format"),
        (folder / "x", "npy", "is inside the dataset"),
    ):
        refused = run_main("export", folder, "--to", to, "--format", form)
        assert (refused.code, refused.err.count("\n")) == (2, 1)
        assert problem in refused.err
    monkeypatch.setattr(libraries, "find_spec", lambda name: None)
    refused = run_main("export", folder, "--to", "new", "--format", "hdf5")
    assert (refused.code, "pip install '.[export]'" in refused.err) == (2, True)
    assert not (tmp_path / "new").exists()


def test_a_damaged_frame_is_not_exported(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1", "source.patch=[random,32,1]")
    shard = tmp_path / "ds/shards/shard-00000.tar"
    content = bytearray(shard.read_bytes())
    content[1000] ^= 1
    shard.write_bytes(content)
    with pytest.raises(DamageError, match="differs from the digest in its row"):
        done(tmp_path / "ds", "npy", tmp_path / "to")
    with pytest.raises(ConfigError, match="contains an export of another dataset"):
        (tmp_path / "to/export.json").write_text("{}")
        done(tmp_path / "ds", "npy", tmp_path / "to")
