"""Read YAML files that the program did not write itself, within limits on size, nesting and aliases."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

import yaml

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.object_store import AnyPath

MAX_BYTES = 4 * 2**20
"""Largest file that is read. A dataset's ``config.yaml`` has 3 kB, plus the names in ``source.include``."""

MAX_DEPTH = 32
"""Deepest nesting of mappings and lists. The schema needs 6 levels; PyYAML recurses once per level."""

MAX_NODES = 200_000
"""Most values after all aliases are expanded. Nine nested lists of nine aliases would expand to 9**9 values."""

MAX_SCALAR_CHARACTERS = 16_384
"""Longest single value. PyYAML converts ``1:1:1:…`` to an integer in quadratic time."""

MAX_INTEGER_BITS = 64
"""Longest integer. Longer ones have no use here, and Python refuses to print or convert the longest of them."""

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""libyaml where PyYAML was built with it: 100,000 list items take 0.3 s instead of 4 s."""


def read_yaml_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML file that contains one mapping.

    Parameters
    ----------
    path : Path
        A regular file: UTF-8, at most `MAX_BYTES`.

    Returns
    -------
    dict
        The mapping, as PyYAML's safe loader constructs it; not empty, all keys are strings.

    Raises
    ------
    ConfigError
        If the file does not exist, cannot be read or breaks a rule of `parse_yaml_mapping`: one line that names the
        file and the problem.
    """
    try:
        return parse_yaml_mapping(read_yaml_text(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error_in_one_line(error)})") from error
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error


def read_yaml_text(path: AnyPath) -> str:
    """Read a text file without blocking on pipes or reading more than `MAX_BYTES`.

    Parameters
    ----------
    path : Path or ObjectPath
        The file.

    Returns
    -------
    str
        Its text.

    Raises
    ------
    ValueError
        If the file is no regular file, is too large or is not UTF-8.
    OSError
        If the file does not exist or cannot be read.
    """
    if isinstance(path, Path) and not stat.S_ISREG(path.stat().st_mode):
        raise ValueError("expected a regular file")
    with path.open("rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"larger than {MAX_BYTES} bytes; expected a YAML file of settings")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 (byte {error.start}); save the file as UTF-8") from error


def parse_yaml_mapping(text: str) -> dict[str, Any]:
    """Parse a YAML text that contains one mapping.

    Time and memory are bounded: the events of the parser are checked before any value is constructed.

    Parameters
    ----------
    text : str
        One YAML document. Anchors, aliases and merge keys are allowed within the limits of this module.

    Returns
    -------
    dict
        The mapping; not empty, all keys at all levels are strings.

    Raises
    ------
    ValueError
        If the text is not valid YAML, is empty, is not a mapping, repeats a key, has several documents, exceeds a
        limit of this module, or contains a key that is not a string. The message is one line.
    """
    try:
        _check_events(text)
        loaded = yaml.load(text, Loader=_LOADER)
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML ({_problem(error)})") from error
    except (LookupError, AttributeError, TypeError, ArithmeticError) as error:
        # PyYAML converts without checks what an explicit tag names, such as !!int ""
        raise ValueError(f"a value does not fit its YAML tag ({error_in_one_line(error)})") from error
    _check_values(loaded)
    if not loaded:
        raise ValueError("the file contains no keys; expected a YAML mapping, key: value")
    assert isinstance(loaded, dict)
    return loaded


def _problem(error: yaml.YAMLError) -> str:
    if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
        return f"line {error.problem_mark.line + 1}: {error.problem}"
    return error_in_one_line(error)


def _check_events(document: str) -> None:
    """Raise ValueError if the text exceeds a limit, has several documents or repeats a key.

    PyYAML's parser yields events without recursion and without expanding aliases, so hostile input costs no more here
    than its length.
    """
    parents: list[_OpenNode] = []
    sizes: dict[str | None, int | None] = {}  # of each anchor; None until its node ends
    documents = 0
    for event in yaml.parse(document, Loader=_LOADER):
        line = event.start_mark.line + 1 if event.start_mark else 0
        key: str | None = None
        match event:
            case yaml.DocumentStartEvent():
                documents += 1
                if documents > 1:
                    raise ValueError(f"line {line}: a second YAML document starts; expected one")
                continue
            case yaml.CollectionStartEvent(anchor=anchor):
                if len(parents) == MAX_DEPTH:
                    raise ValueError(f"line {line}: nested more than {MAX_DEPTH} levels deep")
                sizes[anchor] = None
                parents.append(_OpenNode(anchor, isinstance(event, yaml.MappingStartEvent)))
                continue
            case yaml.CollectionEndEvent():
                closed = parents.pop()
                size = sizes[closed.anchor] = closed.size
            case yaml.AliasEvent(anchor=anchor):
                expanded = sizes.get(anchor, 0)
                if expanded is None:
                    raise ValueError(f"line {line}: the alias *{anchor} contains itself")
                size = expanded
            case yaml.ScalarEvent(anchor=anchor, value=str(text)):
                key = text
                if len(key) > MAX_SCALAR_CHARACTERS:
                    raise ValueError(f"line {line}: a value of more than {MAX_SCALAR_CHARACTERS} characters")
                size = sizes[anchor] = 1
            case _:
                continue
        if parents and parents[-1].add(size, key, line) > MAX_NODES:
            raise ValueError(f"line {line}: more than {MAX_NODES} values after aliases are expanded")


class _OpenNode:
    """A mapping or list whose end has not been parsed yet."""

    def __init__(self, anchor: str | None, is_mapping: bool) -> None:
        self.anchor = anchor
        self.size = 1
        self._keys: set[str] | None = set() if is_mapping else None
        self._expects_key = is_mapping

    def add(self, size: int, key: str | None, line: int) -> int:
        """Count a child of ``size`` values, and return the size so far; ``key`` is its text if it is a scalar."""
        if self._keys is not None:
            if self._expects_key and key is not None and key != "<<":
                if key in self._keys:
                    raise ValueError(f"line {line}: the key {key[:60]!r} occurs twice")
                self._keys.add(key)
            self._expects_key = not self._expects_key
        self.size += size
        return self.size


def _check_values(loaded: Any) -> None:
    """Raise ValueError if a value is too long an integer, a key is no string, or the document is no mapping."""
    if loaded is not None and not isinstance(loaded, dict):
        raise ValueError(f"expected a YAML mapping, key: value; got a {type(loaded).__name__}")
    pending: list[Any] = [loaded]
    seen: set[int] = set()
    while pending:
        value = pending.pop()
        if isinstance(value, int) and value.bit_length() > MAX_INTEGER_BITS:
            raise ValueError(f"an integer of {value.bit_length()} bits; expected at most {MAX_INTEGER_BITS}")
        if isinstance(value, dict | list | tuple | set) and id(value) not in seen:
            seen.add(id(value))
            pending += value.values() if isinstance(value, dict) else value
        if isinstance(value, dict):
            for key in value:
                if not isinstance(key, str):
                    raise ValueError(f"the key {str(key)[:60]} is no string; write it in quotes")
