"""Parse JSON that is read back as typed records (msgspec), so that an edited file gives one sentence."""

from __future__ import annotations

import json
from typing import Annotated, Any, TypeVar

import msgspec

Record = TypeVar("Record")

Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
"""SHA-256, 64 hexadecimal digits."""
Amount = Annotated[float, msgspec.Meta(ge=0)]

MAX_BYTES = 2**30
"""Largest file that is read back, such as the ``dataset.json`` of three million shards."""


def parse_json(content: bytes | str) -> Any:
    """Parse JSON; ValueError if it is none, or nested too deeply."""
    try:
        return json.loads(content)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def parse_record(content: bytes | str, kind: type[Record]) -> Record:
    """Parse JSON as a typed record; ValueError names key and expectation."""
    return check_record(parse_json(content), kind)


def check_record(value: Any, kind: type[Record], strict: bool = True) -> Record:
    """Convert a parsed JSON value to a typed record; ValueError names key and expectation.

    Without ``strict``, texts are read as numbers.
    """
    try:
        return msgspec.convert(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at `$")
        problem = problem[0].lower() + problem[1:]
        raise ValueError(f"{place.strip('.`')}: {problem}" if place else problem) from None
