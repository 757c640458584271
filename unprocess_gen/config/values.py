"""Check single configuration values and format them for messages."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import Limit, value_text

LONGEST_VALUE = 80
"""Characters of a value that a message quotes."""


class GroupLimit(Limit):
    """Values of a setting that are parsed, or checked together with other settings of the group."""

    def check(self, key: str, value: Any, group: Any) -> None:
        """Raise ConfigError unless the value is allowed in its group."""
        raise NotImplementedError


def refusal(key: str, value: Any, problem: str) -> ConfigError:
    """Error about the value of a key: ``key=value: problem``."""
    text = value_text(value)
    return ConfigError(f"{key}={text[:LONGEST_VALUE]}{'…' * (len(text) > LONGEST_VALUE)}: {problem}")


def one_of(key: str, value: Any, allowed: Collection[str]) -> None:
    """Check that a value is one of a few words."""
    if value not in [*allowed]:  # a list or mapping from YAML has no hash
        raise refusal(key, value, f"expected one of {', '.join(allowed)}")


def error_in_one_line(error: BaseException) -> str:
    """Message of an exception with each run of white space replaced by one space."""
    return " ".join(str(error).split()) or type(error).__name__


def value_range(values: Sequence[float], digits: int = 6) -> str:
    """Smallest and largest of some numbers as text."""
    low, high = f"{min(values):.{digits}g}", f"{max(values):.{digits}g}"
    return low if low == high else f"{low} to {high}"
