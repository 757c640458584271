"""``source.list``: the dataset of the listed files."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import TreeHash, text_rows
from helpers.photographs import fill

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.sources.listing import list_photographs

MAKE = ("n_jobs=1", "output.pairs_per_shard=2")


@pytest.fixture
def places(tmp_path: Path) -> Path:
    """Return a folder with three photographs and a list."""
    second = fill(tmp_path / "second" / "sub", 2, first=1).parent
    shutil.copy(second / "sub" / "001.png", second / "=a,ö.png")
    (second / "list.txt").write_text("sub/002.png\r\n\n./=a,ö.png\nnot there.png\n", encoding="utf-8")
    return second


def listed(*overrides: str) -> list[str]:
    return [source.name for source in list_photographs(ug.load_config(overrides).source).sources]


def test_listed_files_have_a_row_each(places: Path, run_main: RunMain, tree_hash: TreeHash) -> None:
    assert run_main("source.list=second/list.txt", *MAKE, "out=ds").code == 3
    rows = [(row["source"], row["status"], row["reason"]) for row in text_rows(Path("ds"))]
    missing = ("not there.png", "failed", "unreadable")
    assert rows == [("%3Da,ö.png", "ok", ""), missing, ("sub/002.png", "ok", "")]
    assert run_main("source.list=second/list.txt", *MAKE, "out=ds").code == 3  # complete
    assert "the same as ds" in run_main("again", "ds", "out=again", "n_jobs=1").out
    assert tree_hash(Path("again")) == tree_hash(Path("ds"))
    Path("again/manifest.csv").unlink()
    Path("again/shards/shard-00000.tar").unlink()
    assert "regenerated from the settings" in run_main("verify", "again", "--repair").out
    assert tree_hash(Path("again")) == tree_hash(Path("ds"))
    Path("second/list.txt").unlink()
    refused = run_main("again", "ds", "out=other")
    assert (refused.code, Path("other").exists()) == (2, False)
    assert "list.txt: no such file" in refused.err


def test_lists_name_files_below_root(places: Path, tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_text(f'id,file\n1,"=a,ö.png"\n2,{places}/sub/001.png\n', encoding="utf-8-sig")
    assert listed(f"source.root={places}", f"source.list={table}") == ["%3Da,ö.png", "sub/001.png"]
    table.write_text("path\nsub/../sub/002.png\nsub/001.png\n", encoding="utf-8")
    assert listed(f"source.root={places}", f"source.list={table}", "source.limit=1") == ["sub/001.png"]


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_spreadsheets_may_write_other_delimiters(places: Path, tmp_path: Path, delimiter: str) -> None:
    table = tmp_path / ("table.tsv" if delimiter == "\t" else "table.csv")
    table.write_text('"id"; File;note\n1;"=a,ö.png";0,5\n'.replace(";", delimiter), encoding="utf-8-sig")
    assert listed(f"source.root={places}", f"source.list={table}") == ["%3Da,ö.png"]
    table.write_text("sub/001.png;0,5\nsub/002.png;1\n".replace(",", ""), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"line 1: has a semicolon"):
        listed(f"source.root={places}", f"source.list={table}")


@pytest.mark.parametrize(
    ("overrides", "problem"),
    [
        (("source.list=none.txt",), "source.list=none.txt: no such file"),
        (("source.list=s3://b/list.txt",), "a list is a local text or CSV file"),
    ],
)
def test_wrong_places_are_refused(
    overrides: tuple[str, ...], problem: str, places: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as refused:
        listed(*overrides)
    assert problem in str(refused.value)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("a.txt", "b.png\n\n./b.png\n", "line 3: ./b.png is repeated from line 1"),
        ("a.txt", "../second/list.txt\n", "line 1: ../second/list.txt is no path below"),
        ("a.txt", "b.png\n/etc/hosts\n", "line 2: /etc/hosts is no path below"),
        ("a.txt", "b\0.png", "is no path below"),
        ("a.txt", "\n", "names no file"),
        ("a.csv", "id,file\n3\n", "line 2: lacks the column file"),
        ("a.csv", 'file\n"b\n', "cannot be read (unexpected end of data)"),
    ],
)
def test_wrong_lists_are_refused_by_line(name: str, text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as refused:
        listed(f"source.list={tmp_path / name}")
    assert problem in str(refused.value)
    assert "\n" not in str(refused.value)
