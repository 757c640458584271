"""The pinned builds of manifests/ give the same bytes on every machine, except for columns added to the manifest."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import pytest
from helpers.promise_report import Figure

from unprocess_gen.config.schema import replaced
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.validation import validate_config
from unprocess_gen.dataset.columns import COLUMN_NAMES, HEADERS
from unprocess_gen.dataset.manifest import read_columns, read_rows, write_rows
from unprocess_gen.pipeline.generate import generate

PINNED = Path(__file__).parents[2] / "manifests"
BUILDS = sorted(path.stem for path in PINNED.glob("*.yaml"))

MANIFEST_OF_0_1 = {
    "scenes_brooks2019_14bit": "c3c7aa7b015b69af2a571ea4c3d60c710c1805ac977c8298c8c936970cce794d",
    "scenes_imx385_iso3200": "521bafa9a862935dce839aa54c6581c08d7240af0f06319412b3330e14923042",
}
"""SHA-256 of each ``manifest.csv`` that version 0.1 wrote."""


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def test_every_build_has_a_manifest_of_version_0_1() -> None:
    assert sorted(MANIFEST_OF_0_1) == BUILDS


@pytest.mark.parametrize("name", BUILDS)
def test_pinned_manifest_without_new_columns_is_that_of_0_1(name: str) -> None:
    stream = io.StringIO(newline="")
    write_rows(stream, read_rows(PINNED / f"{name}.csv"), HEADERS[0])
    assert read_columns(PINNED / f"{name}.csv") == COLUMN_NAMES
    assert sha256(stream.getvalue().encode()) == MANIFEST_OF_0_1[name]


@pytest.mark.parametrize("name", BUILDS)
def test_pinned_build_gives_the_recorded_bytes(name: str, tmp_path: Path, figure: Figure) -> None:
    config, kind = read_dataset_yaml(PINNED / f"{name}.yaml")
    assert kind == "synthetic"
    config = replaced(config, {"out": str(tmp_path / "ds"), "n_jobs": 1})
    validate_config(config)

    generate(config)

    lines = (PINNED / f"{name}.sha256").read_text().splitlines()
    expected = {file: digest for digest, file in (line.split("  ") for line in lines)}
    assert {file: sha256((tmp_path / "ds" / file).read_bytes()) for file in expected} == expected
    assert (tmp_path / "ds/manifest.csv").read_bytes() == (PINNED / f"{name}.csv").read_bytes()
    assert sorted(path.name for path in (tmp_path / "ds/shards").iterdir()) == sorted(
        file.removeprefix("shards/") for file in expected if file.startswith("shards/")
    )
    figure("pinned-builds", f"{name}: {len(expected)} of {len(expected)} files have the recorded SHA-256")
