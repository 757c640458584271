"""Find pairs by their keys and columns: what `RawPairs` and `LivePairs` share."""

from __future__ import annotations

import bisect
import copy
import itertools
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, Protocol, Self, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import ConfigError, UnknownKeyError
from unprocess_gen.core.suggestions import did_you_mean
from unprocess_gen.dataset.columns import Row, Value
from unprocess_gen.dataset.row import COLUMN_NAMES, KEY_TEXT

SHOWN = 5
"""Keys and values that an error names, and datasets that a reader's `repr` names."""


class KeyedRows(Protocol):
    """Pairs of one dataset, in the order of their keys; ``name`` is that of the dataset."""

    name: str

    def __len__(self) -> int: ...

    def key(self, number: int) -> str:
        """Key of a pair."""

    def row(self, number: int) -> dict[str, Value]:
        """Row of a pair."""


_Dataset = TypeVar("_Dataset", bound=KeyedRows)


class PairTable(Generic[_Dataset]):
    """Pairs of datasets, one dataset after the other, or some of the pairs."""

    def __init__(self, datasets: Sequence[_Dataset]) -> None:
        self._datasets = datasets
        self._starts = [0, *itertools.accumulate(map(len, datasets))]
        self._numbers: NDArray[np.int64] = np.arange(self._starts[-1])

    @property
    def dataset(self) -> tuple[str, ...]:
        """Folder name of each pair's dataset."""
        return tuple(self._datasets[self._place(number)[0]].name for number in self._numbers)

    @property
    def rows(self) -> Rows:
        """Manifest row of each pair, with its ``dataset``: a sequence of dicts, such as ``pandas.DataFrame`` takes.

        A row is read when it is used, in 0.1 ms.
        """
        return Rows(self)

    def select(self, test: Callable[[Row], object] | None = None, /, **columns: Any) -> Self:
        """Select pairs by the columns of their rows.

        Parameters
        ----------
        test : callable, optional
            Only pairs whose row makes it true.
        **columns : str, int, float, None, or an iterable of them
            Only pairs with this value, or one of these, in a column of `rows`.

        Returns
        -------
        RawPairs or LivePairs
            The selected pairs, in their order and with their noise.

        Raises
        ------
        ConfigError
            If a column does not exist, or no pair is selected.

        Examples
        --------
        The dataset of the example of `unprocess_gen.generate`:

        >>> import unprocess_gen as ug
        >>> pairs = ug.RawPairs("ds")
        >>> pairs.select(key=["00000001", "00000002"], camera="convex")
        RawPairs('ds', length=1)
        >>> pairs.select(lambda row: row["red_gain"] > 1.9)
        RawPairs('ds', length=2)
        """
        known = (*COLUMN_NAMES, "dataset")
        for name in columns:
            if name not in known:
                hint = did_you_mean(name, known)
                raise ConfigError(f"select: {name}: no such column; expected one of the manifest, or dataset{hint}")
        wanted = {name: _values(value) for name, value in columns.items()}
        positions, missed, others = list[int](), Counter[str](), defaultdict[str, set[Value]](set)
        for position, row in enumerate(self.rows):
            misses = [name for name, values in wanted.items() if row[name] not in values]
            for name in misses:
                missed[name] += 1
                if len(others[name]) <= SHOWN:
                    others[name].add(row[name])
            if not misses and (test is None or test(row)):
                positions.append(position)
        if not positions:
            given = ", ".join(f"{name}={value!r:.60}" for name, value in columns.items())
            never = [name for name in columns if missed[name] == len(self._numbers)]
            occur = "; ".join(f"{name}={first_of(sorted(map(repr, others[name]), key=len))}" for name in never)
            expected = occur or "values that occur together" if columns else "a test that is true for a row"
            raise ConfigError(f"select: {given}: no pair of {len(self._numbers)} is selected; expected {expected}")
        return self._part(self._numbers[positions])

    def _part(self, numbers: NDArray[np.int64]) -> Self:
        """Reader of some of the pairs."""
        part = copy.copy(self)
        part._numbers = numbers
        return part

    def _place(self, number: int) -> tuple[int, int]:
        """Number of a pair's dataset, and number of the pair in it."""
        place = bisect.bisect_right(self._starts, number) - 1
        return place, int(number) - self._starts[place]

    def _key(self, number: int) -> str:
        """Key of a pair, with the name of its dataset if there are several."""
        place, number = self._place(number)
        dataset = self._datasets[place]
        return dataset.key(number) + f" of {dataset.name}" * (len(self._datasets) > 1)

    def _position(self, key: str) -> int:
        """Position of the pair with a key; UnknownKeyError if no pair has it, or several have it."""
        starts = zip(self._starts, self._datasets, strict=False)
        numbers = [start + number for start, dataset in starts for number in _numbers_of(dataset, key)]
        positions = np.flatnonzero(np.isin(self._numbers, numbers))
        if len(positions) == 1:
            return int(positions[0])
        shown = self._numbers[positions[: SHOWN + 1]] if len(positions) else self._numbers[[0, -1]]
        keys = [self._key(number) for number in shown]
        if len(positions):
            raise UnknownKeyError(
                f"{key!r}: names {len(positions)} pairs ({first_of(keys)}); expected one; give its complete key, after "
                "select(dataset=…) if several datasets have it"
            )
        raise UnknownKeyError(f"{key[:40]!r}: no pair has this key; expected one from {keys[0]} to {keys[-1]}")


class Rows(Sequence[dict[str, Value]]):
    """Rows of the pairs of a reader, read when they are used."""

    def __init__(self, pairs: PairTable[Any]) -> None:
        self._pairs = pairs

    def __len__(self) -> int:
        return len(self._pairs._numbers)

    @overload
    def __getitem__(self, number: int) -> dict[str, Value]: ...

    @overload
    def __getitem__(self, number: slice) -> list[dict[str, Value]]: ...

    def __getitem__(self, number: int | slice) -> Any:
        if isinstance(number, slice):
            return [self[position] for position in range(len(self))[number]]
        place, number = self._pairs._place(self._pairs._numbers[number])
        dataset = self._pairs._datasets[place]
        return {**dataset.row(number), "dataset": dataset.name}

    def __repr__(self) -> str:
        return f"Rows({self._pairs!r})"


def first_of(items: Sequence[str]) -> str:
    """Text that names the first items of many."""
    return ", ".join(items[:SHOWN]) + ", …" * (len(items) > SHOWN)


def _values(value: Any) -> list[Any]:
    return [*value] if isinstance(value, Iterable) and not isinstance(value, str) else [value]


def _numbers_of(dataset: KeyedRows, key: str) -> Sequence[int]:
    """Numbers of the pairs of a dataset that have a key, or whose keys begin with it, by bisection."""
    if not KEY_TEXT.allows(key):
        return ()
    wanted = _numbers_in(key)

    def beginning(number: int) -> list[int]:
        return _numbers_in(dataset.key(number))[: len(wanted)]

    every = range(len(dataset))
    first, end = (bisect_at(every, wanted, key=beginning) for bisect_at in (bisect.bisect_left, bisect.bisect_right))
    return every[first:end] if first < end and f"{dataset.key(first)}-".startswith(f"{key}-") else ()


def _numbers_in(key: str) -> list[int]:
    """Index of a source, and numbers of patch, level and draw."""
    return [*map(int, re.findall(r"\d+", key))]
