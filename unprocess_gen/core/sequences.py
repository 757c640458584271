"""Pick items of a sequence, add them, and keep those that were used last."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

_Item = TypeVar("_Item")
_Key = TypeVar("_Key")


def evenly_spaced(items: Sequence[_Item], count: int) -> list[_Item]:
    """At most ``count`` items at even distances, in order: items ``i * len(items) // count``, the first included."""
    count = min(count, len(items))
    return [items[i * len(items) // count] for i in range(count)]


def first_of(items: Sequence[str], most: int = 5) -> str:
    """Text that names the first items."""
    return ", ".join(items[:most]) + ", …" * (len(items) > most)


def add_in_order(values: Iterable[float]) -> float:
    """Add numbers one after the other: ``sum`` rounds floats differently from Python 3.12 on."""
    return functools.reduce(operator.add, values, 0.0)


class Recent(dict[_Key, _Item]):
    """Keep values by key, up to the sum ``most`` of their sizes; copies and pickles, for other processes, are empty."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self._most, self._size = most, 0

    def keep(self, key: _Key, value: _Item, size: int = 1) -> _Item:
        """Add a value and return it; a full mapping is emptied first, in one step, because other threads may read."""
        self._size += size
        if self._size > self._most:
            self.clear()
            self._size = size
        self[key] = value
        return value

    def __reduce__(self) -> tuple[Any, ...]:
        return Recent, (self._most,)
