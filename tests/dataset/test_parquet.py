"""A manifest is also written as Parquet on request: same rows, typed columns; damage is found and repaired."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow
import pytest
from helpers.datasets import Make, Settings
from helpers.photographs import fill
from pyarrow import parquet as reader

from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.dataset import parquet
from unprocess_gen.dataset.columns import COLUMN_NAMES, COLUMNS
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.verify import verify

PARQUET = "output.parquet=true"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    """Make a dataset of a physical profile with a manifest in Parquet: four pairs and one failed source."""
    folder = tmp_path_factory.mktemp("original")
    (fill(folder / "p", 4) / '002 is, "broken".png').write_bytes(b"not a photograph")
    make(folder / "p", folder / "ds", PARQUET, "output.pairs_per_shard=2", "noise=sony_a7s2", "source.max_failed=1")
    return folder / "ds"


@pytest.fixture
def copy(original: Path, tmp_path: Path) -> Path:
    shutil.copytree(original, tmp_path / "ds")
    return tmp_path / "ds"


def rows_of_parquet(folder: Path) -> Iterator[dict[str, Any]]:
    for batch in reader.ParquetFile(folder / "manifest.parquet").iter_batches():
        yield from batch.to_pylist()


def rows_of_csv(folder: Path) -> Iterator[dict[str, Any]]:
    for row in read_rows(folder / "manifest.csv"):
        yield {**row, "gamma": "" if row["gamma"] is None else str(row["gamma"])}


def test_parquet_has_the_rows_of_the_manifest(original: Path) -> None:
    assert list(rows_of_parquet(original)) == list(rows_of_csv(original))
    assert len(list(rows_of_csv(original))) == 5


def test_columns_have_the_types_of_the_table(original: Path) -> None:
    schema = reader.read_schema(original / "manifest.parquet")
    assert tuple(schema.names) == COLUMN_NAMES
    types = {int: pyarrow.int64(), float: pyarrow.float64()}
    assert schema.types == [types.get(column.type, pyarrow.string()) for column in COLUMNS]


def test_several_row_groups_have_the_rows_too(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet, "BLOCK_BYTES", 2048)
    parquet.write_parquet(copy / "manifest.csv", copy / "manifest.parquet")
    assert reader.ParquetFile(copy / "manifest.parquet").num_row_groups > 1
    assert list(rows_of_parquet(copy)) == list(rows_of_csv(copy))


def test_files_record_that_there_is_a_parquet(original: Path) -> None:
    assert "\n  parquet: true\n" in (original / "config.yaml").read_text()
    assert "parquet_sha256" in json.loads((original / "dataset.json").read_text())
    assert verify(original) == []


def test_default_is_recorded_as_in_version_0_1(dataset: Path) -> None:
    assert not (dataset / "manifest.parquet").exists()
    assert "parquet" not in (dataset / "config.yaml").read_text()
    assert "parquet_sha256" not in json.loads((dataset / "dataset.json").read_text())


def test_rerun_of_a_finished_dataset_keeps_it(copy: Path, original: Path, make: Make) -> None:
    overrides = PARQUET, "output.pairs_per_shard=2", "noise=sony_a7s2", "source.max_failed=1"
    assert make(original.parent / "p", copy, *overrides).made == 0
    assert verify(copy) == []


def test_missing_pyarrow_is_refused(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unprocess_gen.core.libraries.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"^output.parquet=true: needs pyarrow; .* pip install '\.\[parquet\]'"):
        validate_config(settings(PARQUET))
    validate_config(settings())
