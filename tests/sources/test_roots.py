"""``source.roots`` and ``source.list``: the dataset of one folder with numbered sub-folders, or of the listed files."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers import object_store as servers
from helpers.commands import RunMain
from helpers.datasets import TreeHash, text_rows
from helpers.photographs import fill

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.sources.loader import list_photographs

MAKE = ("n_jobs=1", "output.pairs_per_shard=2")


@pytest.fixture
def places(tmp_path: Path) -> tuple[Path, Path]:
    """Two folders with two and three photographs, one of which is in both, and a list in the second."""
    first, second = fill(tmp_path / "the first", 2), fill(tmp_path / "second" / "sub", 2, first=1).parent
    shutil.copy(first / "000.png", second / "=a,ö.png")
    (second / "list.txt").write_text("sub/002.png\r\n\n./=a,ö.png\nnot there.png\n", encoding="utf-8")
    return first, second


def listed(*overrides: str) -> list[str]:
    return [source.name for source in list_photographs(ug.load_config(overrides).source).sources]


def test_roots_give_the_dataset_of_numbered_folders(
    places: tuple[Path, Path], run_main: RunMain, tree_hash: TreeHash, tmp_path: Path
) -> None:
    shutil.copytree(places[0], tmp_path / "both" / "0")
    shutil.copytree(places[1], tmp_path / "both" / "1")
    roots = f"source.roots=['{places[0]}',second]"
    assert run_main(roots, *MAKE, "out=ds").code == 0
    assert run_main("source.root=both", *MAKE, "out=one").code == 0
    assert tree_hash(Path("ds")) == tree_hash(Path("one"))
    names = [row["source"] for row in text_rows(Path("ds"))]
    assert names == ["0/000.png", "0/001.png", "1/=a,ö.png", "1/sub/001.png", "1/sub/002.png"]
    text = Path("ds/config.yaml").read_text(encoding="utf-8") + Path("ds/manifest.csv").read_text(encoding="utf-8")
    assert "second" not in text
    assert "roots" not in text
    run_main("prepare", "parts=2", roots, *MAKE, "out=parts")
    (tmp_path / "elsewhere").mkdir()
    with pytest.MonkeyPatch.context() as moved:
        moved.chdir(tmp_path / "elsewhere")  # the recorded places are absolute
        for part in ("0", "1"):
            assert run_main("part", "../parts", part).code == 0
        assert run_main("again", "../ds", "out=../again", "n_jobs=1").code == 0
        assert run_main("replay", "../ds").code == 0
        live, stored = ug.LivePairs("../ds"), ug.RawPairs("../ds")
        assert all((live[number].noisy == pair.noisy).all() for number, pair in enumerate(stored))
    assert run_main("merge", "parts").code == 0
    assert tree_hash(Path("parts")) == tree_hash(Path("again")) == tree_hash(Path("ds"))
    (places[1] / "sub" / "002.png").unlink()
    assert run_main("replay", "ds").code == 5
    assert run_main("replay", "ds", "--source", "both").code == 0


def test_listed_files_have_a_row_each(places: tuple[Path, Path], run_main: RunMain, tree_hash: TreeHash) -> None:
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


def test_lists_name_files_below_root_or_roots(places: tuple[Path, Path], tmp_path: Path) -> None:
    first, second = places
    table = tmp_path / "table.csv"
    table.write_text(f'id,file\n1,"=a,ö.png"\n2,{second}/sub/001.png\n', encoding="utf-8-sig")
    assert listed(f"source.root={second}", f"source.list={table}") == ["%3Da,ö.png", "sub/001.png"]
    table.write_text(f"path\n1/sub/../sub/001.png\n0/001.png\n{first}/000.png\n", encoding="utf-8")
    roots = f"source.roots=['{first}','{second}']"
    assert listed(roots, f"source.list={table}") == ["0/000.png", "0/001.png", "1/sub/001.png"]
    assert listed(roots, f"source.list={table}", "source.limit=1") == ["0/000.png"]


def test_roots_may_be_in_an_object_store(
    places: tuple[Path, Path], bucket: ObjectPath, run_main: RunMain, tree_hash: TreeHash, tmp_path: Path
) -> None:
    servers.upload(places[1], bucket / "photos")
    roots = f"source.roots=['{places[0]}','{bucket / 'photos'}']"
    assert run_main(roots, *MAKE, "out=ds").code == 0
    assert run_main("source.roots=['the first',second]", *MAKE, "out=local").code == 0
    assert tree_hash(Path("ds")) == tree_hash(Path("local"))
    assert run_main("replay", "ds").code == 0
    found = listed(roots)
    assert found == listed(f"source.roots=['{places[0]}','{places[1]}']")
    (tmp_path / "list.txt").write_text(f"{bucket}/photos/sub/001.png\n0/001.png\n1/none.png\n", encoding="utf-8")
    sources = list_photographs(ug.load_config([roots, f"source.list={tmp_path}/list.txt"]).source).sources
    assert [(one.name, one.reason) for one in sources] == [
        ("0/001.png", None),
        ("1/none.png", "unreadable"),
        ("1/sub/001.png", None),
    ]
    assert sources[0].sha256 == sources[2].sha256  # copies are compared across roots
    assert [sources[0].occurrence, sources[2].occurrence] == [0, 1]


@pytest.mark.parametrize(
    ("overrides", "problem"),
    [
        (("source.roots=[second,./second]",), "source.roots[1]=./second: is empty or repeated"),
        (("source.roots=[second,none]",), "source.roots[1]=none: no such folder, or a file"),
        (("source.roots=[second/list.txt]",), "source.roots[0]=second/list.txt: no such folder, or a file"),
        (("source.roots=[second]", "source.root=second"), "source.root=second is set too"),
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
