"""Reading YAML files that may be hostile: bounded time, one line, the problem and its place."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.yaml_files import parse_yaml_mapping, read_yaml_mapping
from unprocess_gen.core.errors import ConfigError

ALIAS_BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)

REFUSED = {
    "100 brackets": ("a: " + "[" * 100, "line 1: nested more than 32 levels"),
    "200,000 brackets": ("a: " + "[" * 200_000, "line 1: (nested more than 32 levels|exceeded maximum nesting depth)"),
    "200,000 dashes": ("- " * 200_000, "line 1: nested more than 32 levels"),
    "deep indentation": ("".join(" " * depth + "a:\n" for depth in range(1000)), "nested more than 32 levels"),
    "alias bomb": (ALIAS_BOMB, "line 5: more than 32 aliases"),
    "alias of itself": ("a: &a [*a]", r"the alias \*a contains itself"),
    "undefined alias": ("a: *b", "line 1: found undefined alias"),
    "repeated key": ("a: 1\nb: {c: 1, c: 2}", "line 2: the key 'c' occurs twice"),
    "empty": ("# nothing\n", "contains no keys"),
    "empty mapping": ("{}", "contains no keys"),
    "list": ("[1, 2]", "expected a YAML mapping, key: value; got a list"),
    "two documents": ("a: 1\n---\nb: 2", "not valid YAML"),
    "unclosed": ("a: [1", "not valid YAML"),
    "control character": ("a: \0", "not valid YAML"),
    "object": ("a: !!python/object/apply:os.system [x]", "not valid YAML"),
    "empty integer": ('a: !!int ""', "does not fit its YAML tag"),
    "longer integer": ("a: " + "9" * 5000, "4300 digits"),
    "long value": ("a: " + "9" * 20_000, "a value of more than 16384 characters"),
    "key that is a switch": ("a: {on: 1}", "the key on is no string"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_hostile_yaml_is_refused_in_one_line_quickly(name: str, tmp_path: Path) -> None:
    text, problem = REFUSED[name]
    path = tmp_path / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    start = time.process_time()
    with pytest.raises(ConfigError, match=problem) as error:
        read_yaml_mapping(path)
    assert time.process_time() - start < 5
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


ACCEPTED: list[tuple[str, dict[str, Any]]] = [
    ("a: 1", {"a": 1}),
    ("# @package _global_\na: {b: [1, 2]}", {"a": {"b": [1, 2]}}),
    ("a: &x {b: 1}\nc: {<<: *x, d: 2}", {"a": {"b": 1}, "c": {"b": 1, "d": 2}}),
    ("a: &x [1]\nb: *x", {"a": [1], "b": [1]}),
    ("a: ${oc.env:HOME}", {"a": "${oc.env:HOME}"}),
]


@pytest.mark.parametrize(("text", "expected"), ACCEPTED)
def test_mappings_with_aliases_and_merge_keys_are_read(text: str, expected: dict[str, Any]) -> None:
    assert parse_yaml_mapping(text) == expected


def test_file_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"a: \xff\xfe")
    with pytest.raises(ConfigError, match=r"mine.yaml: not UTF-8 \(byte 3\)"):
        read_yaml_mapping(path)


def test_huge_file_is_refused_without_reading_all_of_it(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    with path.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(ConfigError, match="larger than 4194304 bytes"):
        read_yaml_mapping(path)


@pytest.mark.linux_only("makes a pipe")
def test_missing_file_folder_and_pipe_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, problem in (("nothing", "cannot be read"), ("", "regular file"), ("pipe", "regular file")):
        with pytest.raises(ConfigError, match=problem):
            read_yaml_mapping(tmp_path / name)


@given(st.text(alphabet="ab:[]{}-,&*!<? \n'\"|>0.9~#%", max_size=60))
def test_any_text_is_read_or_refused_in_one_line(text: str) -> None:
    try:
        loaded = parse_yaml_mapping(text)
    except ValueError as error:
        assert "\n" not in str(error)
    else:
        assert loaded and all(isinstance(key, str) for key in loaded)
