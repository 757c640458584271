"""Pick items of a sequence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

_Item = TypeVar("_Item")


def evenly_spaced(items: Sequence[_Item], count: int) -> list[_Item]:
    """Return at most ``count`` items at even distances, in order.

    Parameters
    ----------
    items : sequence
        Items to pick from, for example a `range` of numbers.
    count : int
        Number of items wanted, 0 or more.

    Returns
    -------
    list
        All items if there are no more than ``count``; otherwise items ``i * len(items) // count``, the first included.
    """
    count = min(count, len(items))
    return [items[i * len(items) // count] for i in range(count)]
