"""Read YAML files that the program did not write itself, within limits on size, nesting and aliases."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from unprocess_gen.core.paths import AnyPath

MAX_YAML_BYTES = 4 * 2**20
"""Largest file that is read. A dataset's ``config.yaml`` has 3 kB, plus the names in ``source.include``."""

MAX_DEPTH = 32
"""Deepest nesting of mappings and lists. The schema needs 6 levels; libyaml recurses once per level."""

MAX_ALIASES = 32
"""Most aliases. Eighty of them, nine in each of nine nested lists, would become 9**9 values."""

MAX_SCALAR_CHARACTERS = 16_384
"""Longest single value. PyYAML converts ``1:1:1:…`` to an integer in quadratic time."""

_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""libyaml where PyYAML was built with it: 100,000 list items take 0.3 s instead of 4 s."""


class _Loader(_Base):  # type: ignore[misc]
    """A safe loader that refuses keys that occur twice or are no text; PyYAML uses the last of them silently."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[str, Any]:
        """Check the keys of a mapping, and construct it."""
        keys: set[str] = set()
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if key.tag not in ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"):
                raise ValueError(f"line {line}: the key {str(key.value)[:60]} is no string; write it in quotes")
            if key.value in keys:
                raise ValueError(f"line {line}: the key {key.value[:60]!r} occurs twice")
            keys.add(key.value)
        mapping: dict[str, Any] = super().construct_mapping(node, deep)
        return mapping


def read_yaml_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML file that contains one mapping; ConfigError in one line, with the file and the problem."""
    try:
        return parse_yaml_mapping(read_yaml_text(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error_in_one_line(error)})") from error
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error


def read_yaml_text(path: AnyPath) -> str:
    """Read a regular file of at most `MAX_YAML_BYTES` in UTF-8; OSError or ValueError if it is none."""
    if isinstance(path, Path) and not stat.S_ISREG(path.stat().st_mode):
        raise ValueError("expected a regular file")
    with path.open("rb") as file:
        content = file.read(MAX_YAML_BYTES + 1)
    if len(content) > MAX_YAML_BYTES:
        raise ValueError(f"larger than {MAX_YAML_BYTES} bytes; expected a YAML file of settings")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 (byte {error.start}); save the file as UTF-8") from error


def parse_yaml_mapping(text: str) -> dict[str, Any]:
    """Parse a YAML text that contains one mapping, whose keys at all levels are strings.

    ValueError, in one line, if the text is anything else or exceeds a limit of this module.
    """
    try:
        _check_events(text)
        loaded = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        place = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ValueError(f"not valid YAML ({place}{error.problem})") from error
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML ({error_in_one_line(error)})") from error
    except (LookupError, AttributeError, TypeError, ArithmeticError, RecursionError) as error:
        # PyYAML converts without checks what an explicit tag names, such as !!int ""
        raise ValueError(f"a value does not fit its YAML tag ({error_in_one_line(error)})") from error
    if loaded is not None and not isinstance(loaded, dict):
        raise ValueError(f"expected a YAML mapping, key: value; got a {type(loaded).__name__}")
    if not loaded:
        raise ValueError("the file contains no keys; expected a YAML mapping, key: value")
    return loaded


def flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Values of mappings in mappings and in lists, by dotted key: ``noise.branches[0].iso``; empty ones are values."""
    if isinstance(value, dict) and value:
        items = [(f"{prefix}.{key}".lstrip("."), item) for key, item in value.items()]
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        items = [(f"{prefix}[{index}]", item) for index, item in enumerate(value)]
    else:
        return {prefix: value}
    return {key: leaf for name, item in items for key, leaf in flat(item, name).items()}


def _check_events(text: str) -> None:
    """Raise ValueError if a text exceeds a limit; PyYAML yields events without recursion."""
    open_anchors: list[str | None] = []  # of the mappings and lists around an event
    aliases = 0
    for event in yaml.parse(text, Loader=_Base):
        line = event.start_mark.line + 1 if event.start_mark else 0
        match event:
            case yaml.CollectionStartEvent(anchor=anchor):
                open_anchors.append(anchor)
            case yaml.CollectionEndEvent():
                open_anchors.pop()
            case yaml.AliasEvent(anchor=anchor):
                aliases += 1
                if anchor in open_anchors:
                    raise ValueError(f"line {line}: the alias *{anchor} contains itself")
            case yaml.ScalarEvent(value=str(value)) if len(value) > MAX_SCALAR_CHARACTERS:
                raise ValueError(f"line {line}: a value of more than {MAX_SCALAR_CHARACTERS} characters")
        if len(open_anchors) > MAX_DEPTH:
            raise ValueError(f"line {line}: nested more than {MAX_DEPTH} levels deep")
        if aliases > MAX_ALIASES:
            raise ValueError(f"line {line}: more than {MAX_ALIASES} aliases")
