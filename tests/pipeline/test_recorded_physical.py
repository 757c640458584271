"""Datasets of physical profiles that versions 0.1 and 0.2 recorded keep their bytes: from their config and rows.

``recorded_0_1`` holds a ``config.yaml`` of each physical profile of 0.1 at ISO 800 and 6400 (``auto``), and with every
effect, another CFA pattern and shared bodies (``all``), with the digests of the dataset; and two manifests.
``recorded_0_2`` holds a dataset of ``accuracy=fast``, in which normals replace counts of electrons.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Settings, TreeHash

import unprocess_gen as ug
from unprocess_gen.config.accuracy import choose_methods
from unprocess_gen.config.schema import replaced
from unprocess_gen.config.serialization import dataset_yaml, parse_dataset_yaml, read_dataset_yaml
from unprocess_gen.core.types import NEAR_NORMAL
from unprocess_gen.dataset.columns import HEADERS
from unprocess_gen.dataset.manifest import read_rows, write_rows
from unprocess_gen.pipeline.generate import generate

RECORDED = Path(__file__).parent / "recorded_0_1"
FAST = Path(__file__).parent / "recorded_0_2/nikon_d850_fast"
DIGESTS = json.loads((RECORDED / "sha256.json").read_text())


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize("name", DIGESTS)
def test_recorded_config_gives_the_bytes_of_0_1(name: str, tmp_path: Path) -> None:
    config, kind = read_dataset_yaml(RECORDED / f"{name}.yaml")
    assert kind == "synthetic"
    assert dataset_yaml(config) == (RECORDED / f"{name}.yaml").read_text()
    config = replaced(config, {"out": str(tmp_path / "ds"), "n_jobs": 1})

    generate(config)

    manifest = io.StringIO(newline="")
    write_rows(manifest, read_rows(tmp_path / "ds/manifest.csv"), HEADERS[0])
    assert sha256(manifest.getvalue().encode()) == DIGESTS[name]["manifest"]
    assert sha256((tmp_path / "ds/shards/shard-00000.tar").read_bytes()) == DIGESTS[name]["shard"]
    assert (tmp_path / "ds/config.yaml").read_bytes() == (RECORDED / f"{name}.yaml").read_bytes()


def test_unfinished_run_of_0_1_is_finished_with_the_command_that_its_refusal_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_main: RunMain
) -> None:
    """The numbers of the profile changed since 0.1, so the same command is refused."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ds/.work").mkdir(parents=True)
    (tmp_path / "ds/config.yaml").write_bytes((RECORDED / "nikon_d850_auto.yaml").read_bytes())

    refused = run_main("noise=nikon_d850", "noise.iso=6400", "source.limit=4", "source.patch=[random,128,1]", "out=ds")
    assert (refused.code, len(refused.err) < 600) == (2, True), refused.err
    command = refused.err.partition("finish it with its own settings: gen-dataset ")[2].split()

    done = run_main(*command, "n_jobs=1")
    assert (done.code, "finished with the settings it was begun with" in done.out) == (0, True), done.err
    shard = tmp_path / "ds/shards/shard-00000.tar"
    assert sha256(shard.read_bytes()) == DIGESTS["nikon_d850_auto"]["shard"]
    assert run_main(*command).code == 2


@pytest.mark.parametrize("name", ["nikon_d850_auto", "sony_a7s2_all"])
def test_rows_of_0_1_are_replayed_without_their_config(name: str) -> None:
    results = ug.replay(RECORDED / f"{name}.csv")
    assert len(results) == 4
    assert [result.complaint for result in results] == [""] * 4


@pytest.fixture
def fast(tmp_path: Path) -> Path:
    """Return a dataset with the files of 0.2 in which normals replace counts."""
    config, _ = read_dataset_yaml(FAST.with_suffix(".yaml"))
    config = replaced(config, {"out": str(tmp_path / "fast"), "n_jobs": 1})
    generate(config)
    return tmp_path / "fast"


def test_recorded_fast_settings_of_0_2_still_replace_counts_by_normals(
    fast: Path, tmp_path: Path, run_main: RunMain, tree_hash: TreeHash
) -> None:
    manifest = io.StringIO(newline="")
    write_rows(manifest, read_rows(fast / "manifest.csv"), HEADERS[1])
    assert manifest.getvalue().encode() == FAST.with_suffix(".csv").read_bytes()
    assert (fast / "config.yaml").read_bytes() == FAST.with_suffix(".yaml").read_bytes()
    assert {row["methods"].count(NEAR_NORMAL) for row in map(dict, read_rows(fast / "manifest.csv"))} == {1}

    assert run_main("again", fast, f"out={tmp_path / 'again'}", "n_jobs=1").code == 0
    assert tree_hash(tmp_path / "again") == tree_hash(fast)


def test_fast_rows_of_0_2_are_replayed_without_their_config() -> None:
    assert [result.complaint for result in ug.replay(FAST.with_suffix(".csv"))] == [""] * 4


def test_new_fast_settings_count_electrons(fast: Path, settings: Settings) -> None:
    text = (fast / "config.yaml").read_text()
    recorded, _ = parse_dataset_yaml(text)
    new = dataclasses.replace(recorded, accuracy=settings("accuracy=fast").accuracy)

    changed = set(dataset_yaml(new).splitlines()) ^ set(text.splitlines())
    assert changed == {"  normal_shot: false"}
    assert NEAR_NORMAL not in choose_methods(new.accuracy, counts_electrons=True)
    with_two_numbers = settings("accuracy=fast")
    assert "normal_shot" not in dataset_yaml(with_two_numbers)  # as 0.2 recorded it


def test_again_and_verify_take_a_0_1_dataset_of_a_physical_profile(
    tmp_path: Path, run_main: RunMain, tree_hash: TreeHash
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    config, _ = read_dataset_yaml(RECORDED / "canon_70d_auto.yaml")
    config = replaced(config, {"out": str(first), "n_jobs": 1})
    ug.generate(config)

    assert run_main("again", first, f"out={second}", "n_jobs=1").code == 0
    assert tree_hash(second) == tree_hash(first)
    assert (second / "config.yaml").read_bytes() == (RECORDED / "canon_70d_auto.yaml").read_bytes()
    assert run_main("verify", second, "--regenerate", "4").code == 0
