"""The pinned builds of manifests/ come out the same: recipe in, every byte out."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.validation import validate_config
from unprocess_gen.pipeline.generate import generate

PINNED = Path(__file__).parents[1] / "manifests"
NAMES = sorted(path.stem for path in PINNED.glob("*.yaml"))


def test_there_are_pinned_builds() -> None:
    assert len(NAMES) >= 2


@pytest.mark.parametrize("name", NAMES)
def test_a_pinned_build_comes_out_the_same(name: str, tmp_path: Path) -> None:
    config, kind = read_dataset_yaml(PINNED / f"{name}.yaml")
    assert kind == "synthetic"
    config.out, config.n_jobs = str(tmp_path / "ds"), 1
    validate_config(config)

    generate(config)

    lines = (PINNED / f"{name}.sha256").read_text().splitlines()
    expected = {file: digest for digest, file in (line.split("  ") for line in lines)}
    assert {file: hashlib.sha256((tmp_path / "ds" / file).read_bytes()).hexdigest() for file in expected} == expected
    assert (tmp_path / "ds/manifest.csv").read_bytes() == (PINNED / f"{name}.csv").read_bytes()
    assert sorted(path.name for path in (tmp_path / "ds/shards").iterdir()) == sorted(
        file.removeprefix("shards/") for file in expected if file.startswith("shards/")
    )
