"""A finished dataset, read back: `RawPairs`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.types import PACKED, UINT16, Float, Frame, Row
from unprocess_gen.dataset.keys import sample_key
from unprocess_gen.dataset.manifest import read_row, rows_with_offsets
from unprocess_gen.dataset.shards import CLEAN, Form, Member, form_of, map_array, noisy_member, read_index, shard_name
from unprocess_gen.simulation.reference.cfa import unpack
from unprocess_gen.simulation.reference.sensor import in_dn


class Sample(NamedTuple):
    """One pair of a dataset, and its manifest row (column → value).

    Arrays are of the row's ``dtype`` and ``layout``: uint16 in DN, or float32 with 0 at black and 1 at white; mosaics
    ``[H, W]``, or packed planes ``[4, H / 2, W / 2]`` in the order of `bayer.PLANES`.
    """

    clean: Frame
    noisy: Frame
    row: dict[str, Any]


def mosaic_dn(frame: Frame, row: Row) -> Frame | Float:
    """Return a frame of any dtype and layout as a mosaic ``[H, W]`` in DN: uint16 as it is, float32 as float64."""
    mosaic = unpack(frame, str(row["pattern"])) if row["layout"] == PACKED else frame
    if row["dtype"] == UINT16:
        return mosaic
    return in_dn(mosaic, (int(row["black_level_dn"] or 0), int(row["white_level_dn"] or 0)))


class RawPairs:
    """The pairs of a dataset, by number: a map-style dataset, for PyTorch's DataLoader as it is.

    ``pairs[i]`` is a `Sample` with ``clean``, ``noisy`` and ``row``, in the order of the manifest, failed photographs
    left out. Arrays are mapped from the shard (no copy, no unpacking); they are yours to write to, the file does not
    change. Holds no open file and of each row only its place (8 bytes), so it can be pickled, forked and shared between
    threads, and a million pairs cost 8 MB.

    Raises DamageError where the dataset is not whole, IndexError for a number out of range.

    >>> pairs = RawPairs("ds")                                      # doctest: +SKIP
    >>> clean, noisy, row = pairs[0]                                # doctest: +SKIP
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._manifest = self.path / "manifest.csv"
        places = (at for at, row in rows_with_offsets(self._manifest) if row["status"] == "ok")
        self._places = np.fromiter(places, dtype=np.int64)
        self._indexes: dict[int, dict[str, Member]] = {}

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[Sample]:
        return (self[number] for number in range(len(self)))

    def __getitem__(self, number: int) -> Sample:
        row = dict(read_row(self._manifest, int(self._places[number])))
        shard = int(row["shard"] or 0)
        form = form_of(str(row["dtype"]), str(row["layout"]), int(row["height"] or 0), int(row["width"] or 0))
        path = self.path / "shards" / shard_name(shard)
        if shard not in self._indexes:
            self._indexes[shard] = read_index(path)
        members = CLEAN, noisy_member(int(row["level"] or 0), int(row["draw"] or 0))
        clean, noisy = (self._array(path, shard, f"{sample_key(row)}.{member}", form) for member in members)
        return Sample(clean, noisy, row)

    def _array(self, path: Path, shard: int, name: str, form: Form) -> Frame:
        member = self._indexes[shard].get(name)
        if member is None:
            raise DamageError(f"{path}: member {name} is missing")
        return map_array(path, member, form)
