"""Listing, spelling and reading of source files: what is found, in which order, and what is refused without a hang."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.source import Source
from unprocess_gen.sources.listing import TAIL_BYTES, Listing, list_folder, number_twins, unmatched_sentence
from unprocess_gen.sources.names import decode_name
from unprocess_gen.sources.reading import read_bytes


def listed(root: Path, *include: str, recursive: bool = True, limit: int | None = None, exclude: str = "") -> Listing:
    return list_folder(str(root), include or ("*.jpg",), recursive, limit, exclude.split())


def paths(listing: Listing) -> list[str]:
    return [source.path for source in listing.sources]


def only(root: Path, *include: str) -> Source:
    (source,) = listed(root, *include).sources
    return source


def fill(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(name.encode())


# Listing --------------------------------------------------------------------------------------------------------------


def test_order_is_by_the_bytes_of_the_relative_path(tmp_path: Path) -> None:
    fill(tmp_path, "b.jpg", "a/z.jpg", "a.jpg", "B.jpg", "é.jpg", "a-b.jpg")
    in_order = ["B.jpg", "a-b.jpg", "a.jpg", "a/z.jpg", "b.jpg", "é.jpg"]
    assert [(source.index, source.path) for source in listed(tmp_path).sources] == list(enumerate(in_order))
    assert paths(listed(tmp_path, limit=2)) == in_order[:2]
    assert paths(listed(tmp_path, "A/*.JPG")) == ["a/z.jpg"]  # with a slash: of the path


HIDDEN = ("._a.jpg", "sub/._b.jpg", ".x.jpg", ".thumbnails/a.jpg", "sub/@eaDir/a.jpg/t.jpg", "__MACOSX/sub/._a.jpg")
SYSTEM = ("$Recycle.Bin/a.jpg", "lost+found/a.jpg", "#snapshot/a.jpg", ".\x1b[2J\n.jpg", "@eaDir/a.jpg", "@tmp/a.jpg")


def test_hidden_files_and_folders_are_left_out_and_counted(tmp_path: Path) -> None:
    fill(tmp_path, "a.jpg", "sub/b.jpg", *HIDDEN)
    found = listed(tmp_path)
    assert (paths(found), found.unmatched) == (["a.jpg", "sub/b.jpg"], {})
    counts = {"2 ._*", "1 .x.jpg", "1 .thumbnails", "1 @eaDir", "1 __MACOSX"}
    (warning,) = found.warnings
    assert set(warning.removeprefix("source.root: hidden files and folders are left out: ").split(", ")) == counts
    assert paths(listed(tmp_path / ".thumbnails")) == ["a.jpg"]  # a root is named
    assert paths(listed(tmp_path / "._a.jpg")) == ["._a.jpg"]


def test_folders_of_systems_are_left_out_and_counted_in_one_line(tmp_path: Path) -> None:
    fill(tmp_path, "a.jpg", *SYSTEM)
    (warning,) = listed(tmp_path).warnings
    assert paths(listed(tmp_path)) == ["a.jpg"] and warning.isprintable() and warning.endswith("1 others")
    fill(tmp_path / "only", ".a.jpg")
    with pytest.raises(
        ConfigError, match=r"no file matches .* hidden files and folders are left out: 1 \.a\.jpg; choose"
    ):
        listed(tmp_path / "only")


def test_excluded_files_are_no_sources_nor_unmatched(tmp_path: Path) -> None:
    fill(tmp_path, "a.jpg", "a_thumb.jpg", "small/b.jpg", "small/deep/c.jpg", "d.txt")
    found = listed(tmp_path, exclude="*_THUMB.jpg small/* *.txt")
    assert (paths(found), found.unmatched) == (["a.jpg"], {})
    with pytest.raises(ConfigError, match=r"and not source\.exclude=\['\*\.jpg'\]"):
        listed(tmp_path, exclude="*.jpg")


def test_folder_with_the_name_of_a_photograph_is_no_source(tmp_path: Path) -> None:
    fill(tmp_path, "x.jpg/a.jpg", "b.jpg")
    (tmp_path / "b.jpg").unlink()
    (tmp_path / "y.jpg").symlink_to("x.jpg")
    assert paths(listed(tmp_path)) == ["x.jpg/a.jpg", "y.jpg/a.jpg"]


def test_unmatched_files_are_counted_by_suffix_with_advice(tmp_path: Path) -> None:
    fill(tmp_path, "a.jpg", "notes.txt", "sub/more.TXT", "b.JXL", "LICENSE", "c.png")
    unmatched = listed(tmp_path).unmatched
    assert unmatched == {".txt": 2, "": 1, ".jxl": 1, ".png": 1}
    sentence = unmatched_sentence(unmatched)
    assert sentence.startswith("5 files are not matched by source.include (2 .txt, 1 without suffix, ")
    assert sentence.endswith("; source.kind=srgb and source.include can read .png; convert .jxl to JPEG, PNG or TIFF")
    assert unmatched_sentence({}) == ""
    assert "9 .e, 19 others" in unmatched_sentence({f".{letter}": 9 for letter in "abcdefg"} | {"": 1})
    fill(tmp_path / "raw", "a.cr2", "b.dng", "c.dng")
    with pytest.raises(ConfigError, match=r"\(2 \.dng, 1 \.cr2\); source\.kind=raw reads \.cr2, \.dng; choose"):
        listed(tmp_path / "raw")


def test_single_picture_is_a_root_whatever_the_globs(tmp_path: Path) -> None:
    fill(tmp_path, "=a.png", "b.png")
    (source,) = listed(tmp_path / "=a.png", "*.jpg").sources
    assert (source.index, source.name, source.path, source.size_bytes) == (0, "%3Da.png", "=a.png", 6)
    assert read_bytes(str(tmp_path / "=a.png"), source) == b"=a.png"


@pytest.mark.parametrize("path", ["/etc/passwd", "../secret.jpg", "sub/../../secret.jpg"])
def test_path_outside_the_root_is_never_opened(tmp_path: Path, path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, "secret.jpg", "root/a.jpg")
    monkeypatch.setattr(os, "open", lambda *_, **__: pytest.fail("opened"))
    with pytest.raises(SourceError, match=r"^unreadable: .* leads outside source\.root"):
        read_bytes(f"{tmp_path}/root", Source(0, path, path, 10))


def test_folders_and_links_to_folders_are_listed_unless_recursive_is_false(tmp_path: Path) -> None:
    fill(tmp_path, "elsewhere/a.jpg", "root/b.jpg", "root/sub/c.jpg")
    (tmp_path / "root" / "linked").symlink_to("../elsewhere")
    assert paths(listed(tmp_path / "root")) == ["b.jpg", "linked/a.jpg", "sub/c.jpg"]
    assert paths(listed(tmp_path / "root", recursive=False)) == ["b.jpg"]


@pytest.mark.parametrize("target", ["..", "sub"], ids=["above the root", "below"])
def test_links_back_to_an_ancestor_end(tmp_path: Path, target: str) -> None:
    fill(tmp_path, "root/a.jpg", "root/sub/b.jpg")
    (tmp_path / "root" / "sub" / "loop").symlink_to(tmp_path / "root" / target)
    listing = listed(tmp_path / "root")
    assert listing.skipped_links >= 1
    assert {"a.jpg", "sub/b.jpg"} <= set(paths(listing))


def test_folders_that_link_to_each_other_are_both_listed(tmp_path: Path) -> None:
    fill(tmp_path, "one/a.jpg", "two/b.jpg")
    (tmp_path / "one" / "to").symlink_to("../two")
    (tmp_path / "two" / "to").symlink_to("../one")
    listing = listed(tmp_path)
    assert paths(listing) == ["one/a.jpg", "one/to/b.jpg", "two/b.jpg", "two/to/a.jpg"]
    assert listing.skipped_links == 2


def test_listing_opens_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, "a.jpg")
    os.mkfifo(tmp_path / "b.jpg")
    monkeypatch.setattr(os, "open", lambda *_, **__: pytest.fail("opened"))
    assert len(listed(tmp_path).sources) == 2


def test_an_unreadable_sub_folder_stops_the_run_and_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, "a.jpg", "locked/b.jpg")
    scandir = os.scandir

    def locked(path: str) -> object:  # permissions do not bind root, so the refusal is played
        if str(path).endswith("locked"):
            raise PermissionError(13, "Permission denied", path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", locked)
    with pytest.raises(ConfigError, match=r"locked cannot be read \(Permission denied\)"):
        listed(tmp_path)


@pytest.mark.parametrize("name", ["missing", "pipe", "nul\0"])
def test_root_of_other_kind_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match=r"^source\.root=") as caught:
        list_folder(f"{tmp_path}/{name}", ["*.jpg"], True, None)
    assert "\n" not in str(caught.value)


# Names ----------------------------------------------------------------------------------------------------------------

HARD_NAMES = {
    b"new\nline.jpg": "new%0Aline.jpg",
    b'comma, quote".jpg': 'comma, quote".jpg',
    b"=1+1.jpg": "%3D1+1.jpg",
    b"a=b-c+d@e.jpg": "a=b-c+d@e.jpg",
    b"100%.jpg": "100%25.jpg",
    b"\xff\xfe.jpg": "%FF%FE.jpg",
    "\u202egnp.jpg".encode(): "%E2%80%AEgnp.jpg",
    "\u2066a\u061c\u200f.jpg".encode(): "%E2%81%A6a%D8%9C%E2%80%8F.jpg",
    "e\u0301 é 日本 😀 {}$.jpg".encode(): "e\u0301 é 日本 😀 {}$.jpg",
    b"x" * 251 + b".jpg": "x" * 251 + ".jpg",
}


@pytest.mark.parametrize("raw", HARD_NAMES, ids=HARD_NAMES.values())
def test_hard_name_is_listed_encoded_and_read(tmp_path: Path, raw: bytes) -> None:
    (tmp_path / os.fsdecode(raw)).write_bytes(b"pixels")
    source = only(tmp_path)
    assert source.name == HARD_NAMES[raw]
    assert os.fsencode(decode_name(source.name)) == raw
    assert read_bytes(str(tmp_path), source) == b"pixels"


# Reading --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda path: None, SourceError, r"^unreadable: a\.jpg: No such file"),
        (os.mkfifo, SourceError, "^not_a_file"),
        (os.mkdir, SourceError, "^not_a_file"),
        (
            lambda path: path.write_bytes(b"longer"),
            MachineError,
            r"^source a\.jpg changed since .*: 5 bytes then, 6 now",
        ),
    ],
    ids=["deleted", "pipe", "folder", "another size"],
)
def test_a_listed_file_that_was_replaced_is_not_read(
    make: Callable[[Path], object], error: type[Exception], text: str, tmp_path: Path
) -> None:
    fill(tmp_path, "a.jpg")
    source = only(tmp_path)
    (tmp_path / "a.jpg").unlink()
    make(tmp_path / "a.jpg")
    with pytest.raises(error, match=text):
        read_bytes(str(tmp_path), source)


def test_file_that_grows_while_read_stops_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, "a.jpg")
    source = only(tmp_path)
    fstat = os.fstat

    def grow_after(descriptor: int) -> os.stat_result:
        status = fstat(descriptor)
        (tmp_path / "a.jpg").write_bytes(b"longer than before")
        return status

    monkeypatch.setattr(os, "fstat", grow_after)
    with pytest.raises(MachineError, match="changed while it was read: 5 bytes then, 18 now"):
        read_bytes(str(tmp_path), source)


def test_a_huge_sparse_file_is_refused_unread(tmp_path: Path) -> None:
    with (tmp_path / "a.jpg").open("wb") as file:
        file.truncate(10 * 2**30)
    with pytest.raises(SourceError, match=r"^too_large"):
        read_bytes(str(tmp_path), only(tmp_path))


def test_a_file_without_permission_to_read_is_unreadable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, "a.jpg")
    source = only(tmp_path)

    def refuse(path: str, *_: object, **__: object) -> None:  # permissions do not bind root
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(SourceError, match=r"^unreadable: a\.jpg: Permission denied"):
        read_bytes(str(tmp_path), source)


# Twins ----------------------------------------------------------------------------------------------------------------


def test_only_files_of_equal_size_and_end_are_read_completely(tmp_path: Path) -> None:
    body = bytes(3 * TAIL_BYTES)
    for name, content in {"a": b"1" + body, "b": body + b"2", "c": b"3" + body, "d": body + b"4"}.items():
        (tmp_path / f"{name}.jpg").write_bytes(content)
    numbered = number_twins(str(tmp_path), listed(tmp_path).sources)
    assert [(source.sha256 is not None, source.occurrence) for source in numbered] == [(True, 0), (False, 0)] * 2


def numbers_of_complete_digests(root: Path, found: tuple[Source, ...]) -> list[int]:
    """Return the occurrence of each file by the simple rule: hash every file, count those before it."""
    digests = [hashlib.sha256((root / source.path).read_bytes()).digest() for source in found]
    return [digests[:place].count(digest) for place, digest in enumerate(digests)]


@given(files=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3), st.integers(0, 2), st.booleans()), max_size=12))
@settings(max_examples=50)
def test_numbers_equal_those_of_complete_digests(
    files: list[tuple[int, int, int, bool]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    root = tmp_path_factory.mktemp("twins")
    for place, (first, middle, last, small) in enumerate(files):
        length = 3 if small else TAIL_BYTES + middle
        content = bytes([first]) + bytes(length) + bytes([last])
        (root / f"{place:02d}.jpg").write_bytes(content)
    found = listed(root).sources if files else ()
    assert [source.occurrence for source in number_twins(str(root), found)] == numbers_of_complete_digests(root, found)


def test_unreadable_identical_files_keep_number_zero(tmp_path: Path) -> None:
    fill(tmp_path, "a.jpg", "b.jpg", "c.jpg")
    found = listed(tmp_path).sources
    (tmp_path / "b.jpg").unlink()
    os.mkfifo(tmp_path / "d.jpg")
    assert [source.occurrence for source in number_twins(str(tmp_path), found)] == [0, 0, 0]
