"""Read the pairs of a finished dataset, or of all datasets of a sweep, without copying or unpacking."""

from __future__ import annotations

import copy
import csv
import operator
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, Self, SupportsIndex, overload

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import FLOAT32, PACKED, UINT16, Float, Frame
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import AnyPath, any_path, folder_name, open_text
from unprocess_gen.dataset.columns import Row, Value
from unprocess_gen.dataset.keys import sample_key
from unprocess_gen.dataset.manifest import read_columns, read_row, rows_with_offsets
from unprocess_gen.dataset.row import has_frames
from unprocess_gen.dataset.shards import (
    ArrayFormat,
    Member,
    arrays_of,
    map_array,
    read_index,
    shard_name,
)
from unprocess_gen.simulation.reference.cfa import unpack
from unprocess_gen.simulation.reference.sensor import in_dn

MAX_MEMBERS = 2**20
"""Members of a dataset whose places in shards are kept, 0.2 kB each."""

SWEEP_TABLE = "sweep.csv"
FINISHED = ("0", "3")
"""Exit codes of jobs that left a dataset: complete, and complete with failed sources."""


DatasetPath = str | Path | ObjectPath
"""Folder of a dataset or sweep, or its URL."""


class _Frames(NamedTuple):
    clean: Frame
    noisy: Frame
    row: dict[str, Any]


class Sample(_Frames):
    """One pair of a dataset: ``clean, noisy, row = sample``.

    Attributes
    ----------
    clean, noisy : ndarray
        Frames in the ``dtype`` and ``layout`` of the row: uint16 in DN, or float32 with 0 at black and 1 at white. The
        clean frame has the dtype ``clean_dtype`` unless that is empty. Mosaics [H, W], or planes
        [4, H / 2, W / 2]: R, G of the red rows, G of the blue rows, B.
    row : dict
        Manifest row: value by column.
    dataset : str
        Name of the dataset's folder; for a sweep as in ``sweep.csv``. Its path if several datasets have the same name.
    targets : dict of str to ndarray
        Stored targets (``output.targets``) by name.
    """

    dataset: str
    targets: Mapping[str, NDArray[Any]]

    def __new__(
        cls,
        clean: Frame,
        noisy: Frame,
        row: dict[str, Any],
        dataset: str = "",
        targets: Mapping[str, NDArray[Any]] = MappingProxyType({}),
    ) -> Self:
        """Tuple of three items with two more attributes."""
        sample = super().__new__(cls, clean, noisy, row)
        sample.dataset, sample.targets = dataset, dict(targets)
        return sample


def mosaic_dn(frame: Frame, row: Row) -> Frame | Float:
    """Mosaic [H, W] of a frame in DN: uint16 values unchanged, float32 values scaled from 0 at black and 1 at white."""
    mosaic = unpack(frame, str(row["pattern"])) if row["layout"] == PACKED else frame
    is_float_clean = row.get("clean_dtype") == FLOAT32 and mosaic.dtype == np.float32
    if row["dtype"] == UINT16 and not is_float_clean:
        return mosaic
    return in_dn(mosaic, (int(row["black_level_dn"] or 0), int(row["white_level_dn"] or 0)))


class RawPairs:
    """Read the pairs of a dataset by number: a map-style dataset, for example for PyTorch's DataLoader.

    ``pairs[i]`` is a `Sample`; negative numbers count from the end, and a slice is a `RawPairs` of those pairs. Pairs
    are in the order of the manifest, without failed sources. Arrays are mapped from the shard. They can be written to;
    the file does not change.

    No file stays open and only the position of each row is kept (12 bytes), so an instance can be pickled, forked and
    shared between threads. Needs neither Numba nor OpenCV nor Hydra.

    A pair of an object store takes three requests, and more for the first pair of each shard. Such an instance cannot
    be used in a forked process: give a DataLoader ``multiprocessing_context="spawn"`` or ``"forkserver"``.

    Parameters
    ----------
    path : str or Path, or a list of them
        Folder of a finished dataset, or of a sweep; or its URL in an object store, such as ``s3://bucket/ds``. A
        sweep's datasets follow each other as in its ``sweep.csv``; jobs that left no dataset are omitted. The pairs of
        a list follow each other in its order.
    arrays_only : bool
        Items are tuples ``(clean, noisy)`` and stored targets, without the row, which PyTorch's default ``collate_fn``
        stacks if all frames have one size. It cannot stack rows, because cells without a value are None.
    split : str, optional
        Only pairs of this split (key ``split`` of the settings), by default all.

    Attributes
    ----------
    path : Path or ObjectPath, or a tuple of them
        The folder, or the folders of a list.

    Raises
    ------
    ConfigError
        If the list is empty, no pair is in the split, or the datasets of a list differ in dtype, layout or targets
        with ``arrays_only``.
    DamageError
        If a manifest, a shard or ``sweep.csv`` is missing or damaged; for shards when a pair is read.
    IndexError
        If a number is out of range.

    Examples
    --------
    The dataset of the example of `unprocess_gen.generate`:

    >>> import unprocess_gen as ug
    >>> pairs = ug.RawPairs("ds")
    >>> len(pairs)
    2
    >>> clean, noisy, row = pairs[0]
    >>> noisy.dtype, row["key"]
    (dtype('uint16'), '00000000')
    """

    def __init__(
        self, path: DatasetPath | Sequence[DatasetPath], *, arrays_only: bool = False, split: str | None = None
    ) -> None:
        places = [path] if isinstance(path, DatasetPath) else path
        roots, is_list = tuple(map(any_path, places)), not isinstance(path, DatasetPath)
        if not roots:
            raise ConfigError("RawPairs([]): no dataset; expected at least one folder")
        self.path = roots if is_list else roots[0]
        self.arrays_only = arrays_only
        self._datasets = [_Dataset(folder) for root in roots for folder in dataset_folders(root)]
        if is_list:
            name_apart(self._datasets)
        offsets = [dataset.offsets(split) for dataset in self._datasets]
        if is_list and arrays_only:
            _check_formats(self._datasets)
        if split is not None:
            check_split("RawPairs", split, self._datasets)
        self._offsets: NDArray[np.int64] = np.concatenate([np.empty(0, np.int64), *offsets])
        self._dataset_of: NDArray[np.int32] = np.repeat(
            np.arange(len(offsets), dtype=np.int32), [len(rows) for rows in offsets]
        )

    @property
    def dataset(self) -> tuple[str, ...]:
        """Folder name of each pair's dataset."""
        return tuple(self._datasets[number].name for number in self._dataset_of)

    def __len__(self) -> int:
        return len(self._offsets)

    def __repr__(self) -> str:
        path = [*map(str, self.path)] if isinstance(self.path, tuple) else str(self.path)
        return f"RawPairs({path!r}, length={len(self)})"

    def __iter__(self) -> Iterator[Sample]:
        return (self[number] for number in range(len(self)))

    @overload
    def __getitem__(self, number: SupportsIndex) -> Sample: ...

    @overload
    def __getitem__(self, number: slice) -> RawPairs: ...

    def __getitem__(self, number: SupportsIndex | slice) -> Any:  # two arrays instead of a Sample with arrays_only
        if isinstance(number, slice):
            part = copy.copy(self)
            part._offsets, part._dataset_of = self._offsets[number], self._dataset_of[number]
            return part
        place = operator.index(number)
        dataset: _Dataset = self._datasets[int(self._dataset_of[place])]
        sample = dataset.read(int(self._offsets[place]))
        return (*sample[:2], *sample.targets.values()) if self.arrays_only else sample


class _Dataset:
    """Read pairs of one dataset by the byte offsets of their rows."""

    def __init__(self, path: AnyPath) -> None:
        self.path = path
        self.name = folder_name(path)
        self._manifest = path / "manifest.csv"
        self._columns: tuple[str, ...] = ()
        self._indexes: dict[int, dict[str, Member]] = {}
        self._members = 0
        self.formats: set[tuple[Value, ...]] = set()
        self.splits: set[str] = set()

    def offsets(self, split: str | None = None) -> NDArray[np.int64]:
        """Offsets of the rows of all pairs, or of those in a split; note all formats and splits."""
        self._columns = read_columns(self._manifest)
        rows = rows_with_offsets(self._manifest)
        return np.fromiter((place for place, row in rows if self._is_pair(row, split)), dtype=np.int64)

    def _is_pair(self, row: Row, split: str | None) -> bool:
        if row["status"] != "ok":
            return False
        if not has_frames(row):
            raise ConfigError(
                f"{self.path}: has a manifest without frames (output.frames=false); expected stored frames; read it "
                f"with ug.LivePairs, or store them: gen-dataset again {self.path} out=FOLDER output.frames=true"
            )
        clean, targets = row["clean_dtype"] or row["dtype"], str(row["targets"]).partition(":")[0] or "no"
        self.formats.add((row["dtype"], clean, row["layout"], targets))
        self.splits.add(str(row["split"]))
        return split in (None, row["split"])

    def read(self, offset: int) -> Sample:
        """Pair whose row begins at a byte."""
        row = dict(read_row(self._manifest, offset, self._columns))
        shard = int(row["shard"] or 0)
        arrays = {
            name: self._array(shard, f"{sample_key(row)}.{stored.member}", stored.array)
            for name, stored in arrays_of(row).items()
        }
        return Sample(arrays.pop("clean"), arrays.pop("noisy"), row, self.name, arrays)

    def _array(self, shard: int, name: str, form: ArrayFormat) -> Frame:
        path = self.path / "shards" / shard_name(shard)
        member = self._index(shard, path).get(name)
        if member is None:
            raise DamageError(f"{path}: member {name} is missing")
        return map_array(path, member, form)

    def _index(self, shard: int, path: AnyPath) -> dict[str, Member]:
        """Members of a shard; keep the members of shards that were read before, up to `MAX_MEMBERS`."""
        index = self._indexes.get(shard)
        if index is None:
            index = read_index(path)
            self._members += len(index)
            if self._members > MAX_MEMBERS:
                self._indexes.clear()  # in one step, because other threads may read
                self._members = len(index)
            self._indexes[shard] = index
        return index


class Folder(Protocol):
    """Folder of a dataset: its path, its name for users, and its splits."""

    path: AnyPath
    name: str
    splits: set[str]


def name_apart(datasets: Sequence[Folder]) -> None:
    """Name datasets by their paths if folders have the same name."""
    if len({dataset.name for dataset in datasets}) < len(datasets):
        for dataset in datasets:
            dataset.name = str(dataset.path)


def _check_formats(datasets: Sequence[_Dataset]) -> None:
    """Raise ConfigError if frames of several datasets cannot be stacked, whatever their sizes."""
    first = {form: dataset.name for dataset in reversed(datasets) for form in dataset.formats}
    if len(first) > 1:
        kinds = "; ".join(
            f"{name}: {noisy}, clean {clean}, {layout}, {targets} targets"
            for (noisy, clean, layout, targets), name in first.items()
        )
        problem = "the frames differ in dtype or layout, or in targets"
        raise ConfigError(f"RawPairs: arrays_only=True: {problem} ({kinds}); expected one; use arrays_only=False")


def check_split(reader: str, split: str, datasets: Sequence[Folder]) -> None:
    """Raise ConfigError if no pair is in a split; the sentence begins with the class that reads."""
    names = sorted(set().union(*(dataset.splits for dataset in datasets)) - {""})
    if split not in names:
        expected = f"expected one of {', '.join(names)}" if names else "there are no splits; generate with split={…}"
        raise ConfigError(f"{reader}: split={split[:40]!r}: no pair is in it; {expected}")


def dataset_folders(path: AnyPath) -> list[AnyPath]:
    """Folder of a dataset, or the folders of the finished datasets of a sweep."""
    table = path / SWEEP_TABLE
    if (path / "manifest.csv").exists() or not table.exists():
        return [path]
    return [path / folder for folder in sweep_folders(table)]


def sweep_folders(table: AnyPath) -> list[str]:
    """Names of the folders of the finished datasets of a sweep; raise as `read_sweep_table`."""
    return [job["folder"] for job in read_sweep_table(table) if job["exit"] in FINISHED]


def read_sweep_table(table: AnyPath) -> list[dict[str, str]]:
    """Row of every job of a ``sweep.csv``.

    Raises DamageError if the file cannot be read, lacks a column, or names a folder elsewhere.
    """
    try:
        with open_text(table) as stream:
            rows = csv.DictReader(stream, strict=True, restval="")
            jobs = [{column: text for column, text in row.items() if column} for row in rows]
        for folder in [job["folder"] for job in jobs if job["exit"] or job["folder"]]:
            if folder in ("", "..") or Path(folder).name != folder or "\0" in folder:
                raise ValueError(f"folder={folder[:60]!r}: expected the name of a folder next to the table")
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise DamageError(f"{table}: not the table of a sweep ({error})") from error
    return jobs
