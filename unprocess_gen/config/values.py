"""Check single configuration values and format them for messages."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

from unprocess_gen.core.errors import ConfigError

LONGEST_VALUE = 80
"""Characters of a value that a message quotes."""


def refusal(key: str, value: Any, problem: str) -> ConfigError:
    """Return the error about the value of a key: ``key=value: problem``."""
    text = value_text(value)
    return ConfigError(f"{key}={text[:LONGEST_VALUE]}{'…' * (len(text) > LONGEST_VALUE)}: {problem}")


def one_of(key: str, value: Any, allowed: Collection[str]) -> None:
    """Check that a value is one of a few words."""
    if value not in allowed:
        raise refusal(key, value, f"expected one of {', '.join(allowed)}")


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


MAX_PRINTED_BITS = 1024


def error_in_one_line(error: BaseException) -> str:
    """Return the message of an exception with each run of white space replaced by one space."""
    return " ".join(str(error).split()) or type(error).__name__


def value_range(values: Sequence[float], digits: int = 6) -> str:
    """Return the smallest and largest of some numbers as text."""
    low, high = f"{min(values):.{digits}g}", f"{max(values):.{digits}g}"
    return low if low == high else f"{low} to {high}"
