"""Datasets of physical profiles that version 0.1 recorded keep their bytes: from their config, and from their rows.

``recorded_0_1`` holds a ``config.yaml`` of each physical profile of 0.1 at ISO 800 and 6400 (``auto``), and with every
effect, another CFA pattern and shared bodies (``all``), with the digests of the dataset; and two manifests.
"""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import TreeHash

import unprocess_gen as ug
from unprocess_gen.config.serialization import dataset_yaml, read_dataset_yaml
from unprocess_gen.dataset.columns import HEADERS
from unprocess_gen.dataset.manifest import read_rows, write_rows
from unprocess_gen.pipeline.generate import generate

RECORDED = Path(__file__).parent / "recorded_0_1"
DIGESTS = json.loads((RECORDED / "sha256.json").read_text())


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize("name", DIGESTS)
def test_recorded_config_gives_the_bytes_of_0_1(name: str, tmp_path: Path) -> None:
    config, kind = read_dataset_yaml(RECORDED / f"{name}.yaml")
    assert kind == "synthetic"
    assert dataset_yaml(config) == (RECORDED / f"{name}.yaml").read_text()
    config.out, config.n_jobs = str(tmp_path / "ds"), 1

    generate(config)

    manifest = io.StringIO(newline="")
    write_rows(manifest, read_rows(tmp_path / "ds/manifest.csv"), HEADERS[0])
    assert sha256(manifest.getvalue().encode()) == DIGESTS[name]["manifest"]
    assert sha256((tmp_path / "ds/shards/shard-00000.tar").read_bytes()) == DIGESTS[name]["shard"]
    assert (tmp_path / "ds/config.yaml").read_bytes() == (RECORDED / f"{name}.yaml").read_bytes()


@pytest.mark.parametrize("name", ["nikon_d850_auto", "sony_a7s2_all"])
def test_rows_of_0_1_are_replayed_without_their_config(name: str) -> None:
    results = ug.replay(RECORDED / f"{name}.csv")
    assert len(results) == 4
    assert [result.complaint for result in results] == [""] * 4


def test_again_and_verify_take_a_0_1_dataset_of_a_physical_profile(
    tmp_path: Path, run_main: RunMain, tree_hash: TreeHash
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    config, _ = read_dataset_yaml(RECORDED / "canon_70d_auto.yaml")
    config.out, config.n_jobs = str(first), 1
    ug.generate(config)

    assert run_main("again", first, f"out={second}", "n_jobs=1").code == 0
    assert tree_hash(second) == tree_hash(first)
    assert (second / "config.yaml").read_bytes() == (RECORDED / "canon_70d_auto.yaml").read_bytes()
    assert run_main("verify", second, "--regenerate", "4").code == 0
