"""Datasets of format 1: rows in shards are those of the manifest, and other formats are refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.commands import RunMain, messages
from helpers.datasets import samples_json
from helpers.photographs import fill

import unprocess_gen as ug
from unprocess_gen.dataset.keys import group_by_sample
from unprocess_gen.dataset.manifest import read_columns
from unprocess_gen.dataset.row import COLUMN_NAMES, columns_of


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill(tmp_path_factory.mktemp("format") / "photographs", 2)


SETTINGS = [
    ["noise=imx385_iso3200"],
    ["body=nikon_d850", "scene=long_exposure"],
    ["source.patch=[random,16,2]", "noise.draws=2", "split={a: 0.5, b: 0.5}"],
    ["noise=nikon_d850", "noise.levels=[400,1600]", "noise.lens_shading=[-0.1,0,0]", "scene=night"],
    ["source.clips=true", "gains=by_light", "output.targets=[linear_rgb]", "output.clean_dtype=float32"],
]


@pytest.mark.parametrize("overrides", SETTINGS, ids=lambda overrides: overrides[0])
def test_json_in_a_shard_is_the_row_of_the_pair(overrides: list[str], photographs: Path, tmp_path: Path) -> None:
    """Numbers have their types, and no column that the manifest leaves out has a value."""
    config = ug.load_config([*overrides, f"source.root={photographs}", f"out={tmp_path / 'ds'}", "n_jobs=1"])
    ug.generate(config)
    pairs, inside = list(ug.RawPairs(tmp_path / "ds")), samples_json(tmp_path / "ds")
    assert read_columns(tmp_path / "ds/manifest.csv") == columns_of(config)
    for rows in group_by_sample(pair.row for pair in pairs):
        first, *others = rows
        loaded = inside.pop(first["key"].partition("-l")[0])
        differing = loaded.pop("others", [])
        assert loaded == {name: value for name, value in first.items() if value not in (None, "")}
        assert [{**first, **cells} for cells in differing] == others
        assert {type(value) for value in loaded.values()} <= {str, int, float}
        assert set(loaded) <= set(columns_of(config)) <= set(COLUMN_NAMES)
    assert not inside
    assert ug.verify(tmp_path / "ds") == []


# Other formats --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "ds"
    ug.generate(ug.load_config(["source.limit=1", f"out={folder}", "n_jobs=1"]))
    return folder


@pytest.fixture(params=[2, None])
def other(request: pytest.FixtureRequest, made: Path, tmp_path: Path) -> Path:
    """A dataset of another format, or of none."""
    folder = Path(shutil.copytree(made, tmp_path / "ds"))
    text = (folder / "dataset.json").read_text()
    stated = f' "format": {request.param},\n' if request.param else ""
    (folder / "dataset.json").write_text(text.replace(' "format": 1,\n', stated))
    return folder


VERBS = ("verify ds", "verify ds --repair", "replay ds/manifest.csv", "again ds out=new", "out=ds", "merge ds")


@pytest.mark.parametrize("arguments", [*VERBS, "part 0/1 out=ds"])
def test_another_format_is_refused_in_one_line(
    arguments: str, other: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(other.parent)
    done = run_main(*arguments.split())
    assert done.code == 4
    (line,) = messages(done.err)
    assert "expected a dataset of format 1" in line
    assert "--repair" not in line


@pytest.mark.parametrize("read", [ug.RawPairs, ug.LivePairs])
def test_another_format_is_refused_by_every_reader(read: Callable[[Path], object], other: Path) -> None:
    with pytest.raises(ug.DamageError, match=r"dataset.json: (format=2|has no format); expected a dataset of format 1"):
        read(other)
