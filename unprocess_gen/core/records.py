"""Check JSON that is read back against typed records (msgspec), so that an edited file gives one sentence."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

import msgspec

Record = TypeVar("Record")

Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
"""SHA-256, 64 hexadecimal digits."""
Amount = Annotated[float, msgspec.Meta(ge=0)]


def decode_record(content: bytes | str, kind: type[Record]) -> Record:
    """Decode JSON as a typed record; ValueError names key and expectation."""
    try:
        return msgspec.json.decode(content, type=kind)
    except msgspec.ValidationError as error:
        raise _problem(error) from None
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"not JSON: {error}") from None


def check_record(value: Any, kind: type[Record]) -> Record:
    """Convert a decoded JSON value to a typed record; ValueError names key and expectation."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise _problem(error) from None


def _problem(error: Exception) -> ValueError:
    """Problem in the form ``shards[3].bytes: expected `int` >= 0``."""
    problem, _, place = str(error).partition(" - at `$")
    problem = problem[0].lower() + problem[1:]
    return ValueError(f"{place.strip('.`')}: {problem}" if place else problem)
