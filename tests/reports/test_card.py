"""The card of a dataset: complete, readable by mlcroissant, and no part of the dataset."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.commands import RunMain
from helpers.datasets import Make, TreeHash
from helpers.photographs import fill

import unprocess_gen as ug
from unprocess_gen.core import libraries
from unprocess_gen.dataset.manifest import read_columns
from unprocess_gen.pipeline.verify import verify

STATED = ("--licence", "CC-BY-4.0", "--published", "2026-01-31")
HOSTILE = "<b>&'\"{0} ds: #1"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    """A dataset of five pairs and two shards, with an unreadable photograph."""
    top = tmp_path_factory.mktemp("card")
    photos = fill(top / "photos", 5)
    (photos / "empty.png").touch()
    make(photos, top / "ds", "source.max_failed=1", "output.pairs_per_shard=4", "noise=brooks2019")
    return top / "ds"


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "ds")
    return tmp_path / "ds"


def test_card_is_written_into_the_dataset_and_changes_nothing(
    copy: Path, made: Path, run_main: RunMain, tree_hash: TreeHash
) -> None:
    for _ in range(2):  # the same card is no obstacle
        done = run_main("report", "ds", "--card")
        assert (done.code, done.err) == (0, "")
        assert done.out == "ds: README.md and croissant.json written; left to its author: --licence, --published\n"
    assert tree_hash(copy) == tree_hash(made)
    assert verify(copy) == []
    assert run_main("verify", "ds", "--repair").code == 0
    again = run_main("source.max_failed=1", f"source.root={made.parent / 'photos'}", "out=ds", "n_jobs=1")
    assert "was begun with other settings" in again.err  # and not: contains README.md


def test_readme_states_contents_settings_and_licence(copy: Path, run_main: RunMain) -> None:
    assert run_main("report", "ds", "--card", *STATED).code == 0
    _, front, text = (copy / "README.md").read_text(encoding="utf-8").split("---\n", 2)
    assert yaml.safe_load(front)["license"] == "CC-BY-4.0"
    facts = json.loads((copy / "dataset.json").read_text())
    for part in (
        "| pairs | 5, of 6 sRGB photographs |",
        "| failed sources | 1 |",
        "| noise.name | brooks2019 |",
        "CC-BY-4.0",
    ):
        assert part in text
    assert facts["fingerprint"] in text


def text(value: object) -> object:
    """Return bytes, in which mlcroissant has texts and arrays alike, as text that `str.encode` undoes."""
    return value.decode("latin-1") if isinstance(value, bytes) else value


@pytest.mark.filterwarnings("ignore")  # of rdflib, and of files that mlcroissant leaves open
def test_mlcroissant_reads_rows_and_arrays_without_warnings(
    copy: Path, run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import mlcroissant
    from mlcroissant._src.operation_graph.operations import extract

    monkeypatch.setattr(extract, "EXTRACT_PATH", type(extract.EXTRACT_PATH)(tmp_path / "unpacked"))
    assert run_main("report", "ds", "--card", *STATED).code == 0
    dataset = mlcroissant.Dataset(jsonld=copy / "croissant.json")
    issues = dataset.metadata.ctx.issues
    assert (issues.errors, issues.warnings) == (set(), set())
    rows, arrays = (
        [{key: text(value) for key, value in record.items()} for record in dataset.records(name)]
        for name in ("pairs", "frames")
    )

    pairs = list(ug.RawPairs(copy))
    assert {key.partition("/")[2] for key in rows[0]} == set(read_columns(copy / "manifest.csv"))
    ok = [row for row in rows if row["pairs/status"] == "ok"]
    assert [row["pairs/noisy_xxh3"] for row in ok] == [pair.row["noisy_xxh3"] for pair in pairs]
    assert [row["pairs/a_dn"] for row in ok] == [pair.row["a_dn"] for pair in pairs]
    read = {(one["frames/key"], one["frames/array"]): one["frames/content"].encode("latin-1") for one in arrays}
    assert len(read) == 2 * len(pairs)
    for pair in pairs:
        for name, frame in (("clean", pair.clean), ("noisy", pair.noisy)):
            assert np.array_equal(np.load(io.BytesIO(read[pair.row["key"], name])), frame)


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise.draws=2",),
        ("output.frames=false",),
        ("source.max_pixels=1", "source.max_failed=9"),
    ],
)
def test_every_kind_of_dataset_has_a_valid_card(
    overrides: tuple[str, ...], make: Make, run_main: RunMain, tmp_path: Path
) -> None:
    make(fill(tmp_path / "photos", 1), tmp_path / HOSTILE, *overrides)
    assert run_main("report", HOSTILE, "--card", *STATED).code == 0
    card = json.loads((tmp_path / HOSTILE / "croissant.json").read_text(encoding="utf-8"))
    assert card["name"] == HOSTILE
    assert card["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    front = (tmp_path / HOSTILE / "README.md").read_text(encoding="utf-8").split("---\n")[1]
    assert yaml.safe_load(front)["pretty_name"] == HOSTILE


def test_edited_card_is_not_replaced(copy: Path, run_main: RunMain) -> None:
    assert run_main("report", "ds", "--card").code == 0
    with (copy / "README.md").open("a") as stream:
        stream.write("mine")
    done = run_main("report", "ds", "--card", *STATED)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "README.md: exists with another text, which may be yours" in done.err
    assert (copy / "README.md").read_text().endswith("mine")
    assert run_main("report", "ds", "--card", "--to", "card").code == 0


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--card", "--to", "ds/shards"), "--to ds/shards: is inside the dataset"),
        (("--card", "--source", "."), "report: --source .: is used without --card only"),
        (("--licence", "MIT"), "report: --licence MIT: is used with --card only"),
        (("--card", "--published", "today"), "report: --published today: expected a date, such as 2026-01-31"),
    ],
)
def test_wrong_arguments_give_one_line(
    arguments: tuple[str, ...], sentence: str, copy: Path, run_main: RunMain
) -> None:
    before = sorted(copy.rglob("*"))
    done = run_main("report", "ds", *arguments)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert done.err.startswith(f"gen-dataset: {sentence}")
    assert sorted(copy.rglob("*")) == before


def test_read_only_dataset_and_missing_extra_give_one_line(
    copy: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("os.access", lambda path, mode: Path(path).name != "ds")
        done = run_main("report", "ds", "--card")
        assert (done.code, done.err) == (
            2,
            "gen-dataset: report: ds is read-only; expected a folder that can be written; give --to FOLDER\n",
        )
    monkeypatch.setattr(libraries, "find_spec", lambda name: None)
    done = run_main("report", "ds", "--card")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "report: --card needs mlcroissant; in the source folder, run: pip install '.[card]'" in done.err
    assert not (copy / "README.md").exists()
