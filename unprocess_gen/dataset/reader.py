"""Read the pairs of a finished dataset, or of all datasets of a sweep, without copying or unpacking."""

from __future__ import annotations

import csv
import math
from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Self, SupportsIndex, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import PACKED, Float, Frame
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.fields import number_or_text
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import AnyPath, any_path, folder_name, open_text
from unprocess_gen.core.random_streams import crop_words, frame_word
from unprocess_gen.core.sequences import Recent, first_of
from unprocess_gen.dataset.columns import Row, Value
from unprocess_gen.dataset.development import development_parameters
from unprocess_gen.dataset.inputs import TEXTS, Options, cut, stackable_row
from unprocess_gen.dataset.keys import sample_key
from unprocess_gen.dataset.manifest import read_columns, read_row, rows_with_offsets
from unprocess_gen.dataset.row import has_frames
from unprocess_gen.dataset.shards import (
    Member,
    arrays_of,
    map_array,
    read_index,
    shard_name,
)
from unprocess_gen.dataset.table import PairTable
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

    def __repr__(self) -> str:
        name, frame = type(self).__name__, self.noisy
        return f"{name}({frame.dtype} {list(frame.shape)}, key={self.row.get('key')}, dataset={self.dataset!r})"

    def _repr_html_(self) -> str:
        from unprocess_gen.dataset.notebook import pair_html  # imports OpenCV

        return pair_html(mosaic_dn(self.clean, self.row), mosaic_dn(self.noisy, self.row), self.row)


_FramesAndTargets = namedtuple("_FramesAndTargets", "clean noisy row targets")


def stackable(sample: Sample | dict[str, Any], **cells: Value) -> Any:
    """Item that PyTorch's default ``collate_fn`` stacks: a named tuple for a sample; a dict is unchanged.

    ``cells`` are columns that some rows lack.
    """
    if isinstance(sample, dict):
        return sample
    frames = sample.clean, sample.noisy, stackable_row(sample.row, cells)
    return _FramesAndTargets(*frames, sample.targets) if sample.targets else _Frames(*frames)


def row_of_batch(row: Row) -> Row:
    """Row as it was before `stackable_row`; other rows do not change."""
    cells = {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in row.items()}
    return cells | {name: number_or_text(str(cells[name])) for name in TEXTS & cells.keys() if cells[name] is not None}


def mosaic_dn(frame: Frame, row: Row) -> Frame | Float:
    """Mosaic [H, W] of a frame in DN: uint16 values unchanged, float32 values scaled from 0 at black and 1 at white."""
    mosaic = unpack(frame, str(row["pattern"])) if row["layout"] == PACKED else frame
    if mosaic.dtype == np.uint16:
        return mosaic
    return in_dn(mosaic, (int(row["black_level_dn"] or 0), int(row["white_level_dn"] or 0)))


class RawPairs(PairTable):
    """Read the pairs of a dataset by number: a map-style dataset, for example for PyTorch's DataLoader.

    ``pairs[i]`` is a `Sample`; negative numbers count from the end, and a slice is a `RawPairs` of those pairs.
    ``pairs["00000003"]`` is the pair with this key. Pairs are in the order of the manifest, without failed sources.
    Arrays are mapped from the shard; writing to them does not change the file.

    No file stays open and only the position of each row is kept (16 bytes), so an instance can be pickled, forked and
    shared between threads. Needs neither Numba nor OpenCV nor Hydra.

    A DataLoader receives rows with NaN instead of None. Its default ``collate_fn`` stacks frames of one size.

    A pair of an object store takes four requests, and more for the first pair of each shard. Such an instance cannot
    be used in a forked process: give a DataLoader ``multiprocessing_context="spawn"`` or ``"forkserver"``.

    Parameters
    ----------
    path : str or Path, or a list of them
        Folder of a finished dataset, or of a sweep; or its URL in an object store, such as ``s3://bucket/ds``. A
        sweep's datasets follow each other as in its ``sweep.csv``; jobs that left no dataset are omitted. The pairs of
        a list follow each other in its order.
    split : str, optional
        Only pairs of this split (key ``split`` of the settings), by default all.
    patch : int, optional
        Side of a random square that is cut from each pair at an even row and column, so that pairs of different sizes
        stack. `LivePairs` with the same ``patch`` cuts the same square. The row does not change.
    flip : bool
        Mirror and transpose each square at random, in eight ways, with `flip`. Needs ``patch``.
    inputs : str, optional
        Items are dicts of float32 arrays with 0 at black and 1 at white, which PyTorch's default ``collate_fn``
        stacks: ``noisy``, ``clean`` and targets. ``"mosaic"``: [H, W]. ``"packed"``: [4, H / 2, W / 2], without an odd
        last row or column; pictures stay [H, W, 3]. ``development`` is what `unprocess_gen.torch.develop` needs.
    noise_map : bool
        Dicts have ``noise_std``: `noise_std` of the noisy frame, in the unit and shape of the frames.
    rows : bool
        Dicts have ``row``, with NaN for empty cells.
    clip_black : bool
        Dicts have no values below 0 in ``noisy`` and ``clean``.

    Attributes
    ----------
    path : Path or ObjectPath, or a tuple of them
        The folder, or the folders of a list.

    Raises
    ------
    ConfigError
        If the list is empty, no pair is in the split, an argument is not allowed, or the datasets of a list differ in
        targets with ``inputs``.
    DamageError
        If a manifest, a shard or ``sweep.csv`` is missing or damaged; for shards when a pair is read.
    IndexError
        If an epoch or a number is out of range.
    KeyError
        If no pair has a key, or several have it; also a ConfigError.

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
        self,
        path: DatasetPath | Sequence[DatasetPath],
        *,
        split: str | None = None,
        patch: int | None = None,
        flip: bool = False,
        inputs: str | None = None,
        noise_map: bool = False,
        rows: bool = False,
        clip_black: bool = False,
    ) -> None:
        self._options = Options("RawPairs", patch, flip, inputs, noise_map, rows, clip_black)
        super().__init__(open_datasets("RawPairs", path, split, _Dataset))
        self.path = any_path(path) if isinstance(path, DatasetPath) else tuple(map(any_path, path))
        targets = sorted(set().union(*(dataset.targets for dataset in self._datasets)))
        if inputs is not None and len(targets) > 1:
            problem = f"pairs differ in targets ({' and '.join(targets)})"
            expected = "expected the same in all; use inputs=None, or ug.RawClips for bursts"
            raise ConfigError(f"RawPairs: inputs={inputs!r}: {problem}; {expected}")

    def __repr__(self) -> str:
        paths = self.path if isinstance(self.path, tuple) else (self.path,)
        names = first_of([repr(str(path)) for path in paths])
        return f"RawPairs({f'[{names}]' if isinstance(self.path, tuple) else names}, length={len(self)})"

    def __iter__(self) -> Iterator[Any]:
        return (self[number] for number in range(len(self)))

    @overload
    def __getitem__(self, number: slice) -> RawPairs: ...

    @overload
    def __getitem__(self, number: SupportsIndex | str | tuple[int, int | str]) -> Any: ...

    def __getitem__(self, number: Any) -> Any:  # a Sample, or a dict with inputs
        if isinstance(number, slice):
            return self._part(self._numbers[number])
        epoch, position = self._item(number)
        dataset, place = self._place(self._numbers[position])
        sample, options, words = self._datasets[dataset].read(place), self._options, (0, 0)
        if options.side is not None:
            words = _crop_words(sample.row, epoch)
            corner = options.place(words, int(sample.row["height"]), int(sample.row["width"]))
            sample = cut(sample, sample.row, corner, options.side)
        return options.item(sample, sample.row, words, partial(development_parameters, sample.row))

    def __getitems__(self, numbers: Sequence[Any]) -> list[Any]:
        """Read a batch for PyTorch's DataLoader, in items that its default ``collate_fn`` stacks.

        With ``inputs``, items are dicts. Otherwise they are named tuples of the clean frame, the noisy frame, the row
        as a dict with NaN for None, and targets if there are any.
        """
        return [stackable(self[number]) for number in numbers]


def _crop_words(row: Row, epoch: int) -> tuple[int, int]:
    """Random words of the crop of a pair in an epoch, as `LivePairs` draws them."""
    patch, level, draw, frame = (int(row[name] or 0) for name in ("patch", "level", "draw", "frame"))
    return crop_words(int(str(row["stream_key"]), 16), patch, level, draw, frame_word(frame, epoch))


class DatasetRows:
    """Rows of a dataset's pairs, or of the pairs in a split, by number; keeps only their offsets in the manifest.

    ``name`` is the name of the dataset for users; ``splits`` are all splits in the manifest.
    """

    def __init__(self, path: AnyPath, split: str | None = None) -> None:
        self.path, self.name = path, folder_name(path)
        self._manifest = path / "manifest.csv"
        self._columns = read_columns(self._manifest)
        self.splits: set[str] = set()
        self._offsets = np.fromiter((offset for offset, _ in self.pair_rows(split)), dtype=np.int64)

    def __len__(self) -> int:
        return len(self._offsets)

    def key(self, number: int) -> str:
        """Key of a pair."""
        return str(self.row(number)["key"])

    def row(self, number: int) -> dict[str, Value]:
        """Row of a pair."""
        return dict(read_row(self._manifest, int(self._offsets[number]), self._columns))

    def pair_rows(self, split: str | None) -> Iterator[tuple[int, Row]]:
        """Read the rows of pairs in order, with their offsets in the manifest."""
        for offset, row in rows_with_offsets(self._manifest):
            if row["status"] == "ok":
                self._note(row)
                if split in (None, row["split"]):
                    yield offset, row

    def _note(self, row: Row) -> None:
        """Collect facts from the row of a pair, in any split."""
        self.splits.add(str(row["split"]))


class _Dataset(DatasetRows):
    """Pairs of one dataset: their rows, and their arrays in the shards."""

    def __init__(self, path: AnyPath, split: str | None) -> None:
        self.targets: set[str] = set()
        self._indexes: Recent[int, dict[str, Member]] = Recent(MAX_MEMBERS)
        super().__init__(path, split)

    def _note(self, row: Row) -> None:
        if not has_frames(row):
            raise ConfigError(
                f"{self.path}: has a manifest without frames (output.frames=false); expected stored frames; read it "
                f"with ug.LivePairs, or store them: gen-dataset again {self.path} out=FOLDER output.frames=true"
            )
        self.targets.add(str(row["targets"]).partition(":")[0] or "no")
        super()._note(row)

    def read(self, number: int) -> Sample:
        """Read a pair."""
        row = self.row(number)
        shard, arrays = int(row["shard"] or 0), dict[str, Frame]()
        path, index = self.path / "shards" / shard_name(shard), self._indexes.get(shard)
        if index is None:
            index = read_index(path)
            self._indexes.keep(shard, index, len(index))
        for name, stored in arrays_of(row).items():
            member = f"{sample_key(row)}.{stored.member}"
            if member not in index:
                raise DamageError(f"{path}: member {member} is missing")
            arrays[name] = map_array(path, index[member], stored.array)
        return Sample(arrays.pop("clean"), arrays.pop("noisy"), row, self.name, arrays)


_Rows = TypeVar("_Rows", bound=DatasetRows)


def open_datasets(
    reader: str,
    places: DatasetPath | Sequence[DatasetPath],
    split: str | None,
    open_folder: Callable[[AnyPath, str | None], _Rows],
) -> list[_Rows]:
    """Open a dataset, the datasets of a sweep, or those of a list, named by their paths if names occur twice.

    Raises ConfigError, which begins with the name of the reader, if the list is empty or no pair is in the split.
    """
    roots = [places] if isinstance(places, DatasetPath) else places
    if not roots:
        raise ConfigError(f"{reader}([]): no dataset; expected at least one folder")
    datasets = [open_folder(folder, split) for root in roots for folder in dataset_folders(any_path(root))]
    if not isinstance(places, DatasetPath) and len({dataset.name for dataset in datasets}) < len(datasets):
        for dataset in datasets:
            dataset.name = str(dataset.path)
    check_split(reader, split, set().union(*(dataset.splits for dataset in datasets)))
    return datasets


def check_split(reader: str, split: str | None, splits: set[str]) -> None:
    """Raise ConfigError if a split is not in ``splits``, in which ``""`` means no split."""
    names = sorted(splits - {""})
    if split is not None and split not in names:
        expected = f"expected one of {', '.join(names)}" if names else "there are no splits; set split={…}"
        raise ConfigError(f"{reader}: split={split[:40]!r}: no pair is in it; {expected}")


def dataset_folders(path: AnyPath) -> list[AnyPath]:
    """Folder of a dataset, or the folders of the finished datasets of a sweep."""
    table = path / SWEEP_TABLE
    if (path / "manifest.csv").exists() or not table.exists():
        return [path]
    return [path / job["folder"] for job in read_sweep_table(table) if job["exit"] in FINISHED]


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
