"""Edited and hostile datasets give one DamageError: no traceback, endless loop or huge allocation."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import shutil
import tarfile
import time
from pathlib import Path
from typing import Any

import pytest
from helpers.datasets import Make
from helpers.photographs import fill

from unprocess_gen import DamageError, RawPairs
from unprocess_gen.dataset.dataset_json import check_dataset_json, dataset_text, fingerprint, read_dataset
from unprocess_gen.dataset.manifest import MAX_LINE_BYTES, read_row, read_rows
from unprocess_gen.dataset.row import MAX_DETAIL, detail_text, plan_from_row
from unprocess_gen.dataset.selection import select_rows
from unprocess_gen.dataset.shards import read_index
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.pipeline.verify import verify, verify_sweep

KEY = "00000001"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    """A dataset of three pairs and a failed source, next to its photographs."""
    folder = tmp_path_factory.mktemp("hostile")
    (fill(folder / "p", 4) / "003.png").write_bytes(b"no picture")
    make(folder / "p", folder / "ds", "output.pairs_per_shard=2")
    return folder / "ds"


@pytest.fixture
def copy(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "ds"))


def edit(folder: Path, **values: str) -> Path:
    """Change cells of the row `KEY`, and the hashes that cover the manifest."""
    path = folder / "manifest.csv"
    header, *lines = csv.reader(io.StringIO(path.read_text(encoding="utf-8"), newline=""))
    for cells in lines:
        if cells[0] == KEY:
            for name, value in values.items():
                cells[header.index(name)] = value
    stream = io.StringIO(newline="")
    csv.writer(stream, lineterminator="\n").writerows([header, *lines])
    path.write_bytes(stream.getvalue().encode())
    rehash(folder)
    return path


def rehash(folder: Path, **facts: Any) -> None:
    known = json.loads((folder / "dataset.json").read_text()) | facts
    known.pop("dataset_sha256")
    known["manifest_sha256"] = hashlib.sha256((folder / "manifest.csv").read_bytes()).hexdigest()
    known["fingerprint"] = fingerprint(known["config_sha256"], known["manifest_sha256"])
    (folder / "dataset.json").write_text(dataset_text(known))


# Values of a manifest -------------------------------------------------------------------------------------------------

HOSTILE = [
    ("width", "-5"), ("height", "9" * 5000), ("width", "1.5"), ("bits", "64"), ("white_level_dn", "240"),
    ("red_gain", "nan"), ("blue_gain", "inf"), ("a_dn", "nan"), ("b_dn2", "-inf"), ("gamma", "steep"),
    ("rgb2cam_00", "1e300"), ("w_sony_a7r", "2"), ("stream_key", "0x1f"), ("seed", "9223372036854775808"),
    ("shard", "1e9"), ("shard", ""), ("orientation", "9"), ("downscale", "100000"), ("pattern", "RGBG"),
    ("pattern", ""), ("dtype", "object"), ("layout", "tiled"), ("status", "fine"), ("status", ""),
    ("exposure_ratio", "0"), ("source", "../../etc/passwd"), ("source", "/etc/passwd"), ("source", "a/../../b.png"),
    ("source", "%2E%2E/x.png"), ("source", "%2Fetc/passwd"), ("source", "a%00.png"), ("clean_xxh3", "0"),
    ("source_bytes", "-1"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), HOSTILE)
def test_value_outside_its_range_names_row_column_and_value(name: str, value: str, copy: Path) -> None:
    manifest = edit(copy, **{name: value})
    with pytest.raises(DamageError) as error:
        for row in read_rows(manifest):
            if row["status"] == "ok":
                plan_from_row(row)
    sentence = str(error.value)
    assert KEY in sentence
    assert name in sentence
    assert len(sentence) < 500
    assert "\n" not in sentence


def test_every_reader_of_a_hostile_manifest_reports_damage(copy: Path) -> None:
    edit(copy, gamma="-7")
    assert [damage.file for damage in verify(copy)] == ["manifest.csv"]
    for read in (RawPairs, lambda folder: list(select_rows(folder / "manifest.csv", "1"))):
        with pytest.raises(DamageError, match=f"row {KEY}: gamma="):
            read(copy)


def test_source_outside_the_root_is_never_looked_up(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (copy.parent / "secret.png").write_bytes(b"secret")
    manifest = edit(copy, source="../secret.png")

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a file outside the root was looked up")

    rows = list(csv.DictReader(io.StringIO(manifest.read_text(encoding="utf-8"))))
    assert rows[1]["source"] == "../secret.png"
    monkeypatch.setattr("os.open", refuse)
    monkeypatch.setattr("os.stat", refuse)
    with pytest.raises(DamageError, match=r"source='\.\./secret\.png': expected a path below the source folder"):
        list(replay(select_rows(manifest, "1"), str(copy.parent / "p")))


def test_line_of_megabytes_is_damage(copy: Path) -> None:
    manifest = edit(copy, noise="x" * 3 * 10**6)
    started = time.process_time()
    with pytest.raises(DamageError, match=f"a line has more than {MAX_LINE_BYTES} bytes"):
        list(read_rows(manifest))
    assert time.process_time() - started < 2
    for offset in (3, 10**12):
        with pytest.raises(DamageError, match="no row at byte"):
            read_row(manifest, offset)


# Shards ---------------------------------------------------------------------------------------------------------------


def test_member_of_negative_size_does_not_loop(tmp_path: Path) -> None:
    info = tarfile.TarInfo("a.json")
    header = bytearray(info.tobuf(tarfile.USTAR_FORMAT))
    header[124:136] = b"\xff" * 10 + (-1024 & 0xFFFF).to_bytes(2, "big")
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    (tmp_path / "a.tar").write_bytes(bytes(header) * 4)
    with pytest.raises(DamageError, match="not a complete shard"):
        read_index(tmp_path / "a.tar")


# dataset.json ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"format": 2}, "format: "),
        ({"pairs": -1}, "pairs: expected `int` >= 0"), ({"pairs": "3"}, "pairs: expected `int`, got `str`"),
        ({"shards": {}}, "shards: expected `array`"), ({"shards": [7]}, r"shards\[0\]: expected `object`"),
        ({"shards": [{}]}, r"shards\[0\]: object missing required field `file`"), ({"failed": []}, "failed: expected"),
        ({"source": {"kind": "folder", "root": 5}}, "source.root: expected `str | null`"),
        ({"source": None}, "source: expected `object`"), ({"sites": {"all": 1.5}}, "sites.*: expected `int`"),
        ({"config_sha256": "x"}, "config_sha256: expected `str` matching regex"),
        ({"versions": 3}, "versions: expected `object"),
        ({"run": {"host": "x"}}, "run: object missing required field"),
        ({"self_test": []}, "self_test: expected `str`"), ({"config": None}, "config: expected `str`"),
    ],
)  # fmt: skip
def test_value_of_dataset_json_is_checked(changes: dict[str, Any], problem: str, original: Path) -> None:
    facts = json.loads((original / "dataset.json").read_text())
    check_dataset_json(facts)
    with pytest.raises(ValueError, match=problem):
        check_dataset_json(facts | changes)


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "shards/shard-00001.tar", "", 7])
def test_shard_elsewhere_is_damage(name: Any, copy: Path) -> None:
    entries = json.loads((copy / "dataset.json").read_text())["shards"]
    entries[0]["file"] = name
    rehash(copy, shards=entries)
    with pytest.raises(DamageError, match=r"shards\[0\]\.file"):
        read_dataset(copy / "dataset.json")
    assert "dataset.json" in {damage.file for damage in verify(copy)}


# Sweeps ---------------------------------------------------------------------------------------------------------------


HEAD = "folder,overrides,rows,failed,exit\n"
ELSEWHERE = [f"{HEAD}{folder},a=1,3,0,0\n".encode() for folder in ("..", ".", "", "../other", "/etc")]


@pytest.mark.parametrize("content", [b"a,b\n1,2\n", b"\xff\xfe", b'folder,exit\n"a,0\n', *ELSEWHERE])
def test_malformed_table_of_a_sweep_is_damage(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "sweep.csv").write_bytes(content)
    folder = "expected the name of a folder next to the table" if content in ELSEWHERE else ""
    for read in (RawPairs, lambda folder: list(verify_sweep(folder))):
        with pytest.raises(DamageError, match=f"sweep.csv: not the table of a sweep.*{folder}"):
            read(tmp_path)


# Explanations of failures ---------------------------------------------------------------------------------------------


def test_failed_row_carries_its_explanation(original: Path) -> None:
    (row,) = (row for row in read_rows(original / "manifest.csv") if row["status"] == "failed")
    assert row["reason"] == "unsupported"
    assert row["detail"]
    assert str(original.parent) not in str(row["detail"])


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", ""),
        ("two\n lines\tand  blanks ", "two lines and blanks"),
        ("a\x00b\x1bc\u202ed\ud800e", "a?b?c?d?e"),
        ("=HYPERLINK(1)", " =HYPERLINK(1)"),
        ("-1 bytes", " -1 bytes"),
        ("x" * 1000, "x" * (MAX_DETAIL - 1) + "…"),
    ],
)
def test_explanation_is_one_bounded_harmless_line(text: str, line: str) -> None:
    assert detail_text(text) == line
    assert len(line) <= MAX_DETAIL
