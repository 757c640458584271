"""Find pairs by key and column: the base of `RawPairs` and `LivePairs`."""

from __future__ import annotations

import bisect
import copy
import html
import itertools
import operator
import re
from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import ConfigError, UnknownKeyError
from unprocess_gen.core.random_streams import EPOCHS
from unprocess_gen.core.sequences import evenly_spaced, first_of
from unprocess_gen.core.suggestions import did_you_mean
from unprocess_gen.dataset.columns import Row, Value
from unprocess_gen.dataset.row import COLUMN_NAMES, KEY_TEXT

MANY = 64
"""Largest number of keys that are read for an error message."""


class PairTable:
    """Pairs of datasets, one dataset after the other, or a selection of the pairs.

    A dataset has ``name``, a length, and the methods ``key`` and ``row`` of a pair's number. Its pairs are in the order
    of their keys.
    """

    def __init__(self, datasets: Sequence[Any]) -> None:
        self._datasets = datasets
        self._starts = [0, *itertools.accumulate(map(len, datasets))]
        self._numbers: NDArray[np.int64] = np.arange(self._starts[-1])

    @property
    def dataset(self) -> tuple[str, ...]:
        """Folder name of each pair's dataset."""
        return tuple(self._datasets[self._place(number)[0]].name for number in self._numbers)

    @property
    def rows(self) -> Rows:
        """Manifest row of each pair, with its ``dataset``: a sequence of dicts, for example for ``pandas.DataFrame``.

        A row is read when it is used, in 0.1 ms.
        """
        return Rows(self)

    def select(self, test: Callable[[Row], object] | None = None, /, **columns: Any) -> Self:
        """Select pairs by the columns of their rows.

        Parameters
        ----------
        test : callable, optional
            Function of a row that is true for the pairs to select.
        **columns : str, int, float or None
            Value of a column of `rows`.

        Returns
        -------
        RawPairs or LivePairs
            The selected pairs in their order, with the same noise.

        Raises
        ------
        ConfigError
            If a column does not exist, or no pair is selected.

        Examples
        --------
        The dataset of the example of `unprocess_gen.generate`:

        >>> import unprocess_gen as ug
        >>> pairs = ug.RawPairs("ds")
        >>> pairs.select(key="00000001", camera="convex")
        RawPairs('ds', length=1)
        >>> pairs.select(lambda row: row["red_gain"] > 1.9)
        RawPairs('ds', length=2)
        """
        known = (*COLUMN_NAMES, "dataset")
        for name in sorted(columns.keys() - {*known}):
            hint = did_you_mean(name, known)
            raise ConfigError(f"select: {name}: no such column; expected one of the manifest, or dataset{hint}")
        positions, seen = list[int](), {name: set[str]() for name in columns}
        for position, row in enumerate(self.rows):
            for name, texts in seen.items():
                texts.add(repr(row[name]))
            if all(row[name] == value for name, value in columns.items()) and (test is None or test(row)):
                positions.append(position)
        if not positions:
            given = ", ".join(f"{name}={value!r:.60}" for name, value in columns.items()) or "function"
            found = "; ".join(
                f"{name}={first_of(sorted(sorted(texts), key=len))}" for name, texts in seen.items() if texts
            )
            raise ConfigError(f"select: {given}: no pair is selected; expected {found or 'what a pair has'}")
        return self._part(self._numbers[positions])

    def _repr_html_(self) -> str:
        pairs = [self[0, number] for number in evenly_spaced(range(len(self)), 3)]  # type: ignore[index]
        shown = [pair._repr_html_() for pair in pairs if hasattr(pair, "_repr_html_")]
        return f"<p><code>{html.escape(repr(self))}</code></p>{''.join(shown)}"

    def __len__(self) -> int:
        return len(self._numbers)

    def _item(self, item: Any) -> tuple[int, int]:
        """Epoch, and number from 0, of an item: a number or key, or a tuple of epoch and number or key; IndexError."""
        epoch, number = item if isinstance(item, tuple) else (0, item)
        number = self._position(number) if isinstance(number, str) else operator.index(number)
        if not 0 <= operator.index(epoch) < EPOCHS:
            raise IndexError(f"epoch {epoch} is out of range; expected 0 to {EPOCHS - 1}")
        return operator.index(epoch), range(len(self))[number]

    def _part(self, numbers: NDArray[np.int64]) -> Self:
        """Reader of a selection of the pairs."""
        part = copy.copy(self)
        part._numbers = numbers
        return part

    def _place(self, number: int) -> tuple[int, int]:
        """Number of a pair's dataset, and number of the pair in it."""
        place = bisect.bisect_right(self._starts, number) - 1
        return place, int(number) - self._starts[place]

    def _position(self, key: str) -> int:
        """Position of the pair with a key; UnknownKeyError if no pair has it, or several have it."""
        starts = zip(self._starts, self._datasets, strict=False)
        numbers = [start + number for start, dataset in starts for number in _numbers_of(dataset, key)]
        positions = np.flatnonzero(np.isin(self._numbers, numbers))
        if len(positions) == 1:
            return int(positions[0])
        shown = self._numbers[positions[:MANY]] if len(positions) else [*self._numbers[:1], *self._numbers[-1:]]
        keys = [self._datasets[place].key(number) for place, number in map(self._place, shown)]
        if not len(positions):
            expected = " to ".join(keys) or "a reader that has pairs"
            raise UnknownKeyError(f"{key!r:.40}: no pair has this key; expected {expected}")
        raise UnknownKeyError(
            f"{key!r}: names {len(positions)} pairs ({first_of(keys)}); expected one; give its complete key, after "
            "select(dataset=…) if several datasets have it"
        )


class Rows(Sequence[dict[str, Value]]):
    """Rows of a reader's pairs, read when they are used."""

    def __init__(self, pairs: PairTable) -> None:
        self._pairs = pairs

    def __len__(self) -> int:
        return len(self._pairs._numbers)

    def __getitem__(self, number: Any) -> Any:
        if isinstance(number, slice):
            return [self[position] for position in range(len(self))[number]]
        place, number = self._pairs._place(self._pairs._numbers[number])
        dataset = self._pairs._datasets[place]
        return {**dataset.row(number), "dataset": dataset.name}

    def __repr__(self) -> str:
        return f"Rows({self._pairs!r})"


def _numbers_of(dataset: Any, key: str) -> Sequence[int]:
    """Numbers of a dataset's pairs that have a key, or whose keys begin with it, by bisection."""
    if not KEY_TEXT.allows(key):
        return ()
    wanted, every = _numbers_in(key), range(len(dataset))
    ends = (
        bisect_at(every, wanted, key=lambda number: _numbers_in(dataset.key(number))[: len(wanted)])
        for bisect_at in (bisect.bisect_left, bisect.bisect_right)
    )
    pairs = every[slice(*ends)]
    return pairs if pairs and f"{dataset.key(pairs[0])}-".startswith(f"{key}-") else ()


def _numbers_in(key: str) -> list[int]:
    """Index of a source, and numbers of patch, level and draw."""
    return [*map(int, re.findall(r"\d+", key))]
