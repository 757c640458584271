"""Check single configuration values."""

from __future__ import annotations

import math
import re
from typing import Any

from unprocess_gen.core.errors import ConfigError

NAME = re.compile(r"[\w.+-]{1,100}", re.ASCII)
"""What a camera or a noise profile may be called: it stands in every row."""


def check_name(key: str, name: str) -> None:
    """Raise ConfigError unless a name may be written to every row of a manifest."""
    if not NAME.fullmatch(name):
        raise ConfigError(f"{key}={name[:40]!r}: expected up to 100 letters, digits, and . _ + -")


def one_of(key: str, value: Any, allowed: tuple[str, ...]) -> None:
    """Raise ConfigError unless the value is one of those allowed."""
    if value not in allowed:
        raise ConfigError(f"{key}={value_text(value)}: expected one of {', '.join(allowed)}")


def in_range(key: str, value: int, low: int, high: int, remark: str = "") -> None:
    """Raise ConfigError unless ``low <= value <= high``."""
    if not low <= value <= high:
        raise ConfigError(f"{key}={value}: expected {low} to {high}{remark}")


def is_integer(value: Any) -> bool:
    """Return whether a value is an integer; a bool is not."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number; a bool is not."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def value_text(value: Any) -> str:
    """Return a value as messages and ``config.yaml`` write it."""
    if isinstance(value, list):
        return "[" + ", ".join(value_text(item) for item in value) + "]"
    return "null" if value is None else str(value)


def error_in_one_line(error: BaseException) -> str:
    """Return the message of an exception with each run of white space replaced by one space.

    Parameters
    ----------
    error : BaseException
        Any exception.

    Returns
    -------
    str
        The message, or the name of the exception's class if the message is empty.
    """
    return " ".join(str(error).split()) or type(error).__name__
