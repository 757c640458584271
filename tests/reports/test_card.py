"""`gen-dataset report --card` describes a dataset for people and for mlcroissant, and changes nothing of it."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, text_rows

from unprocess_gen.core import libraries
from unprocess_gen.dataset.columns import NAMES
from unprocess_gen.pipeline.verify import verify


@pytest.fixture(scope="module")
def folder(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("card") / "ds"
    make(None, out, "source.limit=2", "source.patch=[random,32,1]", "split={train: 0.5, val: 0.5}")
    return out


def test_mlcroissant_reads_the_rows_through_the_card(folder: Path, run_main: RunMain) -> None:
    files = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    done = run_main("report", folder, "--card")
    assert (done.code, done.out.split()) == (0, [str(folder / "README.md"), str(folder / "croissant.json")])
    assert all(path.read_bytes() == content for path, content in files.items()) and not verify(folder)
    metadata = json.loads((folder / "croissant.json").read_text())
    assert metadata["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    recorded = json.loads((folder / "dataset.json").read_text())["shards"][0]
    assert {"shards/shard-00000.tar": recorded["sha256"]}.items() <= {
        file["@id"]: file.get("sha256") for file in metadata["distribution"]
    }.items()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of rdflib and pandas
        import mlcroissant

        dataset = mlcroissant.Dataset(jsonld=str(folder / "croissant.json"))
        rows = [*dataset.records("pairs")]
    assert not dataset.metadata.ctx.issues.errors
    assert [*rows[0]] == [f"pairs/{name}" for name in NAMES]
    for row, expected in zip(rows, text_rows(folder), strict=True):
        assert row["pairs/key"].decode() == expected["key"] and row["pairs/split"].decode() == expected["split"]
        assert row["pairs/red_gain"] == float(expected["red_gain"])


def test_the_readme_states_what_was_made(folder: Path, run_main: RunMain) -> None:
    assert run_main("report", folder, "--card").code == 0
    text = (folder / "README.md").read_text()
    assert "2 pairs, 0 failed sources" in text and "| noise | imx385_iso3200 |" in text and "## Licence" in text


def test_a_card_that_cannot_be_written_is_refused(
    folder: Path, run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = run_main("report", folder, "--card", "--to", "x.html")
    assert (refused.code, "leave to out" in refused.err) == (2, True)
    (folder / "README.md").write_text("mine")
    refused = run_main("report", folder, "--card")
    assert (refused.code, "is not a card" in refused.err) == (2, True)
    (folder / "README.md").unlink()
    monkeypatch.setattr(libraries, "find_spec", lambda name: None)
    refused = run_main("report", folder, "--card")
    assert (refused.code, "pip install '.[card]'" in refused.err) == (2, True)
    assert not (folder / "README.md").exists()
