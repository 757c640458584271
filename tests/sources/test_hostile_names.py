"""File and folder names that could break a list, a shell, a spreadsheet or a path.

One dataset is generated from photographs with hostile names and folders; its files are read with Python's csv, json and
tarfile. Every name must be encoded harmlessly and decoded to the same bytes. Folders with hostile names are used as
``source.root``, as ``out`` and as the dataset of every verb. Hypothesis adds random names (10,000 with ``-m slow``).
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import os
import re
import shutil
import tarfile
import unicodedata
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, text_rows
from helpers.promise_report import Figure
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from unprocess_gen.sources.names import decode_name, encode_name

FORMULA_STARTS = tuple("=+-@\t\r")
UNSEEN = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]")
"""Control and bidirectional characters and line ends: a terminal would execute them, or a reader not see them."""

NAMES: tuple[bytes, ...] = (
    # ends of lines, separators, quotes
    *(b"line\nfeed.jpg", b"both\r\n.jpg", b"tab\t.jpg", b"\x0b\x0c\x1c\x1d\x1e.jpg", b"com,ma.jpg", b'quo"te.jpg'),
    *(b'"".jpg', "next\u0085line.jpg".encode(), "line\u2028and\u2029paragraph.jpg".encode()),
    # formulas, and what a shell, Hydra or a glob would take for its own
    *(b"=1+1.jpg", b"@SUM(1).jpg", b"\t=1.jpg", b"=cmd|' C'!A0.jpg", b"-.jpg", b"--help.jpg", b"${x}.jpg"),
    *(b"[x]*.jpg", b"{a,b}.jpg", b"back\\slash.jpg", b"a&b.jpg", b"#.jpg", b"null.jpg", b"a=b.jpg", b"<a>.jpg"),
    # dots, blanks, percent signs
    *(b"x..jpg", b"x. .jpg", b" lead.jpg", b"trail .jpg", b"%.jpg", b"%25.jpg", b"%2F.jpg", b"x..%2f..%2fb.jpg"),
    *(b"%0A.jpg", b"$(id).jpg"),
    # bytes that are not UTF-8, directions, widths
    *(b"\xff.jpg", b"\xc3(.jpg", b"\xed\xa0\x80.jpg", b"\xc0\xaf.jpg", b"\x80=.jpg", "\u202egpj.jpg".encode()),
    *("\u061c\u200e\u200f.jpg".encode(), "zero\u200bwidth.jpg".encode(), "\ufeffbom.jpg".encode(), b"bom.jpg"),
    # alike: by case, by normal form, by look
    *(b"case.jpg", b"CASE.jpg", b"Case.JPG", "\u0430.jpg".encode(), b"a.jpg"),
    *(unicodedata.normalize(form, "é.jpg").encode() for form in ("NFC", "NFD")),
    # control characters, and the longest there are
    *(b"\x1b[31m.jpg", b"\x1b]0;title\x07.jpg", b"\x7f.jpg", b"x" * 251 + b".jpg", b"\xff" * 251 + b".jpg"),
)
LONGEST = b"\xff" * 255 + b"/" + b"\xfe" * 255
FOLDERS: tuple[bytes, ...] = (b"=dir", b"new\nline", b"\xff", b"x...", b"  ", b"%2e%2e", LONGEST)


def photograph(number: int) -> bytes:
    """Return a PNG of 3 x 4 pixels that depend on ``number``."""
    stream = io.BytesIO()
    rgb = np.frombuffer(hashlib.sha256(b"%d" % number).digest() + bytes(4), np.uint8).reshape(3, 4, 3)
    Image.fromarray(rgb).save(stream, "PNG")
    return stream.getvalue()


class HostileDataset(NamedTuple):
    """Dataset of hostile names: contents of the files by path, and every other path next to the dataset."""

    root: Path
    out: Path
    contents: dict[bytes, bytes]
    others: list[tuple[bytes, int, int]]


def paths_except(top: Path, out: Path) -> list[tuple[bytes, int, int]]:
    """Return every path below ``top`` except those in ``out``, with size and time."""
    found = []
    for folder, folders, files in os.walk(os.fsencode(top)):
        folders[:] = [name for name in folders if os.path.join(folder, name) != os.fsencode(out)]
        for name in files:
            status = os.lstat(os.path.join(folder, name))
            found.append((os.path.join(folder, name), status.st_size, status.st_mtime_ns))
    return sorted(found)


@pytest.fixture(scope="module")
def made(make: Make, tmp_path_factory: pytest.TempPathFactory) -> HostileDataset:
    """A dataset of photographs that bear `NAMES`, and of one in each of `FOLDERS`."""
    top = tmp_path_factory.mktemp("names")
    root, out = top / "photos", top / "ds"
    paths = [*NAMES, *(folder + b"/=x,\n.jpg" for folder in FOLDERS)]
    contents = {path: photograph(number) for number, path in enumerate(paths)}
    for path, content in contents.items():
        full = Path(os.fsdecode(os.path.join(os.fsencode(root), path)))
        full.parent.mkdir(parents=True, exist_ok=True)
        full.write_bytes(content)
    before = paths_except(top, out)
    make(root, out, "output.pairs_per_shard=16")
    return HostileDataset(root, out, contents, before)


# In the manifest ------------------------------------------------------------------------------------------------------


def test_every_name_gives_a_pair_and_is_restored(made: HostileDataset, figure: Figure) -> None:
    rows = text_rows(made.out)
    assert (len(rows), {row["status"] for row in rows}) == (len(made.contents), {"ok"})
    digests = {os.fsencode(decode_name(row["source"])): row["source_sha256"] for row in rows}
    assert digests == {path: hashlib.sha256(content).hexdigest() for path, content in made.contents.items()}
    assert list(digests) == sorted(made.contents)
    figure("hostile-names", f"{len(made.contents)} hostile names, all distinct and readable")


def test_cells_are_harmless(made: HostileDataset) -> None:
    """Each row is one line, only numbers begin like a formula, and no cell has control or bidirectional characters."""
    text = (made.out / "manifest.csv").read_bytes().decode("utf-8")
    assert len(text.splitlines()) == len(made.contents) + 1
    cells = list(itertools.chain.from_iterable(csv.reader(io.StringIO(text, newline=""), strict=True)))
    assert [cell for cell in cells if UNSEEN.search(cell)] == []
    suspicious = [cell for cell in cells if cell.startswith(FORMULA_STARTS)]
    assert suspicious, "some entries of rgb2cam are negative"
    for cell in suspicious:
        float(cell)


# Files ----------------------------------------------------------------------------------------------------------------


def test_nothing_outside_the_dataset_is_written_or_changed(made: HostileDataset) -> None:
    assert paths_except(made.root.parent, made.out) == made.others


def test_members_are_named_by_key_and_have_the_names_of_the_manifest(made: HostileDataset) -> None:
    names: list[str] = []
    sources: list[str] = []
    for shard in sorted((made.out / "shards").iterdir()):
        with tarfile.open(shard) as opened:
            names += opened.getnames()
            rows = [opened.extractfile(name) for name in opened.getnames() if name.endswith(".json")]
            sources += [json.loads(row.read())["source"] for row in rows if row is not None]
    kinds = ("clean.npy", "noisy.npy", "json")
    assert names == [f"{number:08d}.{kind}" for number in range(len(made.contents)) for kind in kinds]
    assert sources == [row["source"] for row in text_rows(made.out)]


# Replay, verify, read -------------------------------------------------------------------------------------------------


def test_verify_regenerates_every_pair(made: HostileDataset, run_main: RunMain) -> None:
    count = len(made.contents)
    done = run_main("verify", made.out, "--regenerate", count)
    assert (done.code, done.out) == (0, f"{made.out} is intact; {count} pairs regenerated, bit for bit\n")


# On the terminal ------------------------------------------------------------------------------------------------------


def test_control_characters_of_names_do_not_reach_the_terminal(run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "broken").mkdir()
    for name in NAMES:
        (tmp_path / "broken" / os.fsdecode(name)).write_bytes(b"no picture")
    done = run_main("source.root=broken", "out=made", "n_jobs=1")
    assert done.code in (0, 3)
    assert UNSEEN.findall((done.out + done.err).replace("\n", "")) == []


# Folders on the command line ------------------------------------------------------------------------------------------

FOLDER_NAMES = (
    *(" a b ", "a'b\"c'", "a,b", "[1,2]", "${oc.env:HOME}", "trail\\", "new\nline", "-x", "1e3", "\udcff\udcfe"),
    "x" * 255,
)


@pytest.mark.parametrize("name", FOLDER_NAMES, ids=ascii)
def test_folder_of_any_name_is_used_or_refused(name: str, run_main: RunMain, tmp_path: Path) -> None:
    root, out = tmp_path / name, tmp_path / f"{name[:254]}2"
    root.mkdir()
    (root / "a.png").write_bytes(photograph(0))
    before = paths_except(tmp_path, tmp_path / "nowhere")
    escaped = [folder.name.replace("${", "\\${") for folder in (root, out)]  # "${" starts an interpolation
    done = run_main(f"source.root={escaped[0]}", f"out={escaped[1]}", "n_jobs=1")
    if done.code == 0:
        assert [(row["source"], row["status"]) for row in text_rows(out)] == [("a.png", "ok")]
        assert paths_except(tmp_path, out) == before
    else:
        assert (done.code, done.out, len(done.err.strip("\n").split("\n"))) == (2, "", 1)
        assert paths_except(tmp_path, tmp_path / "nowhere") == before


@pytest.mark.parametrize("mark", ["'", '"'])
def test_quotes_around_a_folder_name_are_removed(mark: str, run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b" / "a.png").write_bytes(photograph(0))
    done = run_main(f"source.root={mark}a b{mark}", f"out={mark}c d{mark}", "n_jobs=1")
    assert (done.code, len(text_rows(tmp_path / "c d"))) == (0, 1)


VERB_ARGUMENTS = {
    "verify": ["--regenerate", "1", "source.root=SOURCE"],
    "replay": ["--keys", "0", "source.root=SOURCE"],
    "report": ["--to", "page.html", "source.root=SOURCE"],
    "preview": ["--keys", "0", "--to", "sheets", "source.root=SOURCE"],
    "dng": ["--keys", "0", "--clean", "--to", "dngs"],
    "again": ["out=copy", "n_jobs=1", "source.root=SOURCE"],
}
DATASET_NAMES = ("camera=sony_a7r,seed=1", "-x", "verify")


@pytest.mark.parametrize(
    ("verb", "name"), [*itertools.product(VERB_ARGUMENTS, ("--to",)), *itertools.product(("again",), DATASET_NAMES)]
)
def test_every_verb_takes_a_dataset_of_any_name(
    verb: str, name: str, wide: Path, run_main: RunMain, tmp_path: Path
) -> None:
    shutil.copytree(wide, tmp_path / name)
    arguments = [argument.replace("SOURCE", str(wide.parent / "photos")) for argument in VERB_ARGUMENTS[verb]]
    done = run_main(verb, *arguments, "--", name)
    assert done.code == 0, done.err
    if not name.startswith("-"):
        assert run_main("verify", name).out == f"{name} is intact\n"


@pytest.fixture(scope="module")
def wide(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of one photograph that a DNG file can hold."""
    folder = tmp_path_factory.mktemp("wide")
    (folder / "photos").mkdir()
    Image.fromarray(np.arange(32 * 32 * 3, dtype=np.uint8).reshape(32, 32, 3)).save(folder / "photos/a.png")
    make(folder / "photos", folder / "ds")
    return folder / "ds"


# Random names -----------------------------------------------------------------------------------------

HARD_TEXT = st.text(st.characters(exclude_characters="\0/", exclude_categories=["Cs"]))
HARD_BYTES = st.binary().map(lambda raw: raw.translate(None, b"\0/"))
TROUBLE = st.lists(
    st.sampled_from(["=", "+", "-", "@", "%", "%2", "%0A", "\n", "\r", "\t", ",", '"', "é", "e\u0301", "."])
)
PARTS = st.one_of(HARD_TEXT.map(str.encode), HARD_BYTES, TROUBLE.map("".join).map(str.encode))
PATHS = st.lists(PARTS, min_size=1, max_size=3).map(b"/".join).map(os.fsdecode)


@given(PATHS)
@settings(max_examples=200, deadline=None)
def test_random_names_are_encoded_harmlessly_and_decoded(path: str) -> None:
    """A name is on one line of a CSV file, and decoded to the same bytes."""
    name = encode_name(path)
    assert decode_name(name) == path
    assert not name.startswith(FORMULA_STARTS) and not UNSEEN.search(name)
    stream = io.StringIO(newline="")
    csv.writer(stream, lineterminator="\n").writerow([name, "x"])
    line = stream.getvalue().encode("utf-8").decode("utf-8")
    assert len(line.splitlines()) == 1
    assert list(csv.reader([line], strict=True)) == [[name, "x"]]
    assert json.loads(json.dumps(name)) == name
