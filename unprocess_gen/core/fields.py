"""Say once what a value means and which values it may have: for records, columns of manifests and settings."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

LARGEST = 1.7976931348623157e308
"""Largest finite number."""

MAX_PRINTED_BITS = 1024


def is_integer(value: Any) -> bool:
    """True if a value is an integer other than a bool."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """True if a value is a finite float, or an integer other than a bool that a float can hold."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer of more than 1024 bits
        return False


def value_text(value: Any) -> str:
    """Format a value for a message as YAML writes it: ``null``, ``true``, lists in brackets."""
    if isinstance(value, list | tuple):
        return "[" + ", ".join(value_text(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{value_text(name)}: {value_text(item)}" for name, item in value.items()) + "}"
    if is_integer(value) and value.bit_length() > MAX_PRINTED_BITS:
        return f"an integer of {value.bit_length()} bits"  # Python refuses to convert the longest to text
    if isinstance(value, bool):
        return str(value).lower()
    return "null" if value is None else str(value)


def number_or_text(cell: str) -> str | int | float:
    """Number that a cell holds, or its text."""
    for kind in (int, float):
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell


Test = Callable[[Any], bool]
Kind = Callable[[str], str | int | float]


class Limit:
    """Allowed values of a setting, a field or a cell.

    ``str(limit)`` names them, as after "expected" in messages; ``in_cells`` does so in messages about cells. ``allows``
    tests a value by itself, ``shown`` is the value in messages. Without ``allows``, a value is checked together with
    other settings, or by the function that parses it. ``is_float`` limits are for numbers that are written as floats.
    ``kind`` converts the text of a cell; ``write`` turns the value of a field into that of its cell, ``read`` back.
    """

    def __init__(
        self,
        text: str,
        allows: Test = lambda value: True,
        shown: Callable[[Any], str] = value_text,
        kind: Kind = str,
        write: Callable[[Any], Any] = lambda value: value,
        read: Callable[[Any], Any] | None = None,
    ) -> None:
        self.text, self.in_cells, self.allows, self.shown = text, text, allows, shown
        self.kind, self.write, self.is_float = kind, write, False
        self.read: Callable[[Any], Any] = read or kind

    def __str__(self) -> str:
        return self.text


class Choice(Limit):
    """One of a few words."""

    def __init__(self, *words: str) -> None:
        self.words = words
        super().__init__(f"one of {', '.join(words)}", lambda value: value in words)
        self.in_cells = " or ".join(words)


class Text(Limit):
    """Text that a regular expression matches."""

    def __init__(self, pattern: str, description: str, **spelling: Any) -> None:
        match = re.compile(pattern, re.ASCII).fullmatch
        super().__init__(description, lambda value: isinstance(value, str) and match(value) is not None, **spelling)


class Integers(Limit):
    """An integer from ``low`` to ``high``, or the one in ``other``, whose meaning is ``remark``."""

    def __init__(self, low: int, high: int, other: int | None = None, remark: str = "", **spelling: Any) -> None:
        allows: Test = lambda value: is_integer(value) and (low <= value <= high or value == other)  # noqa: E731
        super().__init__(f"{low} to {high}{remark}", allows, kind=int, **spelling)
        self.low, self.high = low, high
        self.in_cells = f"a number from {low:.12g} to {high:.12g}"


class Numbers(Limit):
    """A finite number from ``low`` to ``high``; ``open_low`` and ``open_high`` exclude the ends."""

    def __init__(self, low: float, high: float = math.inf, open_low: bool = False, open_high: bool = False) -> None:
        if open_high:
            text = f"{low:g} up to, but not including, {high:g}"
        elif open_low:
            text = f"more than {low:g}, up to {high:g}"
        else:
            text = f"a number of {low:g} or more" if high == math.inf else f"{low:g} to {high:g}"
        self.low = math.nextafter(low, math.inf) if open_low else low
        self.high = math.nextafter(high, 0) if open_high else min(high, LARGEST)
        super().__init__(text, lambda value: is_number(value) and self.low <= value <= self.high, kind=float)
        self.in_cells = f"a number from {self.low:.12g} to {self.high:.12g}"
        self.is_float = True


class NumberList(Limit):
    """A list of ``count`` numbers, each within ``numbers``."""

    def __init__(self, count: int, numbers: Numbers) -> None:
        super().__init__(
            f"a list of {count} numbers, each {numbers}",
            lambda value: len(value) == count and all(map(numbers.allows, value)),
        )


class NumberOrWord(Limit):
    """A number, or one word; ``text`` contains ``{word}`` and ``{numbers}``."""

    def __init__(self, word: str, numbers: Numbers | Integers, text: str, **spelling: Any) -> None:
        allows: Test = lambda value: bool(value == word) or numbers.allows(value)  # noqa: E731
        super().__init__(text.format(word=word, numbers=numbers), allows, kind=number_or_text, **spelling)
        self.in_cells = f"{numbers.in_cells} or {word}"
        self.is_float = numbers.is_float


@dataclass(frozen=True, eq=False, slots=True)
class Condition:
    """Settings that a record or a field depends on.

    ``unless`` names the settings with which manifests do not have the columns. ``holds`` returns
    whether a config (`config.schema.Config`) fills them.
    """

    unless: str
    holds: Callable[[Any], bool]


ALWAYS = Condition("", lambda config: True)

FAILED = "the source failed"
"""Condition under which the cells of most columns are empty."""


@dataclass(frozen=True, eq=False)
class Field:
    """Statement of a record about a field: ``typing.Annotated[float, Field(…)]``.

    Attributes
    ----------
    meaning : str
        One phrase for users.
    limit : Limit
        Values that a cell may have. It is wider than what a config can lead to: it keeps edited files from causing huge
        allocations, overflow and endless loops.
    unit : str
        Unit of a number; empty for text and pure numbers.
    needs : Condition, optional
        Condition of the field; by default that of its record.
    blank : bool
        Whether the cell is empty at the default of the field.
    empty_if : str
        When the cell is empty; empty if it never is.
    columns : mapping of str to str
        Columns of a tuple, with their meanings; by default one column with the name of the field.
    """

    meaning: str
    limit: Limit
    unit: str = ""
    needs: Condition | None = None
    blank: bool = False
    empty_if: str = FAILED
    columns: Mapping[str, str] = field(default_factory=dict)
