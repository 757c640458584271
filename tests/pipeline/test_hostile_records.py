"""Edited files of a dataset, and of a run that is not finished, give one line: no traceback, no hang."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.cases import slow_except
from helpers.commands import Done, RunMain
from helpers.photographs import fill

from unprocess_gen.dataset.dataset_json import dataset_text
from unprocess_gen.pipeline.run import LISTING, RUN

SETTINGS = ("source.root=p", "out=ds", "output.pairs_per_shard=2", "n_jobs=1")
RUN_FILES = (RUN, LISTING, ".work/rows/00000.json", ".work/deaths/00001", "config.yaml")
DATASET_FILES = ("dataset.json", "manifest.csv", "config.yaml", "shards/shard-00000.tar")

CONTENTS = {
    "empty": b"",
    "null": b"null\n",
    "list": b"[1, 2]\n",
    "empty object": b"{}\n",
    "brackets": b"[" * 200_000,
    "nested keys": b'{"a":' * 200_000,
    "not UTF-8": b"\xff\xfe\x00{}",
    "huge integer": b'{"parts": ' + b"9" * 5_000 + b"}\n",
}
"""Complete contents."""

VALUES: tuple[Any, ...] = (None, 1e308, 2**62, "x")
"""Values in place of each number, text or list of a JSON file."""


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def variants(path: Path) -> Iterator[tuple[str, Callable[[Path], None]]]:
    """Yield hostile forms of a file, and functions that write them."""
    yield "pipe", pipe
    yield "missing", Path.unlink
    yield "folder", lambda path: (path.unlink(), path.mkdir())[1]
    for name, content in CONTENTS.items():
        yield name, lambda path, content=content: path.write_bytes(content)
    line, _, rest = path.read_bytes().partition(b"\n" if path.parent.name == "rows" else b"\0")
    if path.suffix != ".json" or not isinstance(facts := json.loads(line), dict):
        return
    for key in facts:
        yield f"without {key}", writer({name: value for name, value in facts.items() if name != key}, rest)
        for value in VALUES:
            yield f"{key}={str(value)[:20]}", writer(facts | {key: value}, rest)


def writer(facts: dict[str, Any], rest: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        if path.name == "dataset.json":  # with a digest that fits
            path.write_text(dataset_text({name: value for name, value in facts.items() if name != "dataset_sha256"}))
        else:
            path.write_bytes(json.dumps(facts).encode() + (b"\n" + rest if path.parent.name == "rows" else b""))

    return write


def problem(done: Done, case: str) -> str:
    """Describe what is wrong with the outcome of a call, empty if it is a known code and short lines."""
    is_short = all(len(line) < 600 for line in done.err.splitlines())
    if done.code in (0, 2, 4, 5) and is_short and "Traceback" not in done.err:
        return ""
    return f"{case}: {done.code}: {done.err[-400:]}"


def restore(copy: Path, original: Path) -> None:
    shutil.rmtree(copy)
    shutil.copytree(original, copy)


@pytest.fixture
def folder(run_main: RunMain, tmp_path: Path) -> Path:
    fill(tmp_path / "p", 4)
    return tmp_path


@pytest.mark.linux_only(reason="makes pipes")
@pytest.mark.parametrize("name", slow_except((".work/rows/00000.json",), RUN_FILES))
def test_edited_record_of_a_run_is_reported_in_one_line(name: str, folder: Path, run_main: RunMain) -> None:
    assert run_main("part", "0/2", *SETTINGS).code == 0
    (folder / "ds/.work/deaths/00001").write_text("[2, 2]")
    shutil.copytree(folder / "ds", folder / "original")
    problems = []
    for variant, write in variants(folder / "original" / name):
        verbs = (("merge", "ds"), ("part", "1/2", *SETTINGS), SETTINGS)
        for verb in verbs[:1] if "=" in variant else verbs:  # merge reads every record
            restore(folder / "ds", folder / "original")
            write(folder / "ds" / name)
            problems.append(problem(run_main(*verb), f"{verb[0]}: {variant}"))
    assert not list(filter(None, problems))


@pytest.mark.linux_only(reason="makes pipes")
@pytest.mark.parametrize("name", slow_except(("manifest.csv", "config.yaml"), DATASET_FILES))
def test_edited_file_of_a_dataset_is_reported_in_one_line(name: str, folder: Path, run_main: RunMain) -> None:
    assert run_main(*SETTINGS).code == 0
    shutil.copytree(folder / "ds", folder / "original")
    verbs = (("verify", "ds"), ("report", "ds"), ("verify", "ds", "--repair"), ("replay", "ds/manifest.csv"))
    others = (("again", "ds", "out=new", "n_jobs=1"), SETTINGS)
    problems = []
    for variant, write in variants(folder / "original" / name):
        for verb in verbs[1:2] if "=" in variant else (*verbs, *others):
            restore(folder / "ds", folder / "original")
            shutil.rmtree(folder / "new", ignore_errors=True)
            write(folder / "ds" / name)
            problems.append(problem(run_main(*verb), f"{verb[0]}: {variant}"))
    assert not list(filter(None, problems))


def test_more_shards_than_sources_end_a_merge_at_once(folder: Path, run_main: RunMain) -> None:
    assert run_main("part", "0/2", *SETTINGS).code == 0
    record = folder / "ds" / RUN
    record.write_text(json.dumps(json.loads(record.read_text()) | {"shards": 2**62}))
    done = run_main("merge", "ds")
    assert (done.code, done.err.count("\n")) == (5, 1)
    assert "more than .work/listing.jsonl has sources); delete ds/.work and run again" in done.err


EDITS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    RUN: (
        lambda content: json.dumps(json.loads(content) | {"parts": 1e308}).encode(),
        "parts: expected `int | null`, got `float`); delete ds/.work and run again\n",
    ),
    LISTING: (lambda content: b'["a",1]\n', "its SHA-256 differs from that in "),
}


@pytest.mark.parametrize("name", EDITS)
def test_edited_record_names_file_problem_and_remedy(name: str, folder: Path, run_main: RunMain) -> None:
    assert run_main("part", "0/2", *SETTINGS).code == 0
    path, (edit, problem) = folder / "ds" / name, EDITS[name]
    path.write_bytes(edit(path.read_bytes()))
    done = run_main("part", "1/2", *SETTINGS)
    assert (done.code, done.err.count("\n")) == (5, 1)
    assert done.err.startswith(f"gen-dataset: ds/{name}: cannot be read ({problem}"), done.err
