"""Spell paths of sources for the manifest, as one line of harmless UTF-8."""

from __future__ import annotations

import os
import re

# Characters that a spreadsheet would execute, a terminal would obey, a line reader would split, or UTF-8 cannot hold.
# The last range is Python's spelling of bytes that are not UTF-8.
_UNSAFE = re.compile(
    "[%\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069\udc80-\udcff]|\\A[=+\\-@]"
)
_ESCAPED = re.compile(rb"%([0-9A-F]{2})")


def encode_name(path: str) -> str:
    """Spelling of a path in the manifest; `decode_name` reverses it.

    ``%``, control and bidirectional characters, bytes that are not UTF-8 and a leading ``= + - @`` become ``%XX``.
    """
    if path.isascii() and not _UNSAFE.search(path):
        return path  # the same object: a million names need no second copy
    text = os.fsencode(path).decode("utf-8", "surrogateescape")
    return _UNSAFE.sub(lambda match: _percent(match.group()), text)


def decode_name(name: str) -> str:
    """Path of a name in the manifest as the operating system spells it."""
    data = name.encode("utf-8", "surrogateescape")
    return os.fsdecode(_ESCAPED.sub(lambda match: bytes((int(match[1], 16),)), data))


def _percent(text: str) -> str:
    return "".join(f"%{byte:02X}" for byte in text.encode("utf-8", "surrogateescape"))
