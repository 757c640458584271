"""Record listed sources as lines of JSON, and read them back one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import msgspec
import numpy as np

from unprocess_gen.core.records import check_record, parse_record
from unprocess_gen.core.source import Source
from unprocess_gen.sources.names import decode_name

_FIELDS = tuple(field.name for field in fields(Source) if field.name not in ("index", "path"))
_DEFAULTS = tuple(field.default for field in fields(Source) if field.name not in ("index", "path"))


class RecordedSources(Sequence[Source]):
    """Sources of a recorded listing, each parsed when it is taken: a part of a million takes only its own."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        letters, size = np.frombuffer(content, np.uint8), 2**24
        starts = range(0, len(content), size)
        self._ends = np.concatenate([np.flatnonzero(letters[i : i + size] == ord("\n")) + i for i in starts])

    def __len__(self) -> int:
        return len(self._ends)

    def __getitem__(self, item: Any) -> Any:
        if isinstance(item, slice):
            return tuple(self[index] for index in range(*item.indices(len(self))))
        start = self._ends[item - 1] + 1 if item else 0
        values = parse_record(self.content[start : self._ends[item]], list[Any])
        source = dict(zip(_FIELDS, values, strict=False))
        return check_record({"index": item, "path": decode_name(str(source["name"])), **source}, Source)


def recorded_text(sources: Sequence[Source]) -> bytes:
    """Lines of sources; those that were read are returned unchanged."""
    if isinstance(sources, RecordedSources):
        return sources.content
    return b"".join(msgspec.json.encode(_values(source)) + b"\n" for source in sources)


def _values(source: Source) -> list[Any]:
    """Values of a source, without those at the end that are defaults."""
    values = [getattr(source, name) for name in _FIELDS]
    while values[-1] == _DEFAULTS[len(values) - 1]:
        values.pop()
    return values
