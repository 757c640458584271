"""Export a dataset to other formats: files of NumPy or TIFF, HDF5, LMDB.

    TO/export.json             format, and digest of the exported manifest; written first
    TO/manifest.csv            a copy of the manifest; written last, so its presence means that the export is complete
    TO/noisy/KEY.npy           each array of a pair by the key of the pair, so that folders have the same names; or .tif
    TO/shard-00000.h5          noisy/KEY and other arrays of a shard; TO/pairs.h5 links to the arrays of all shards
    TO/noisy.lmdb              arrays by key, as NPY files; TO/row.lmdb has the rows as JSON

With splits, all but the first two are in TO/SPLIT; of a sweep, TO has a folder for each dataset. Files appear complete
or not at all, and LMDB commits the pairs of a shard at once. A killed export is continued by the same command.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.core.errors import ConfigError, DamageError, MachineError
from unprocess_gen.core.files import array_xxh3, commit_file, file_sha256, machine_errors
from unprocess_gen.core.libraries import require
from unprocess_gen.core.output_paths import check_output_folder
from unprocess_gen.core.paths import AnyPath, LocalPath, folder_name
from unprocess_gen.core.types import Array, Row
from unprocess_gen.dataset.manifest import read_rows, without_empty
from unprocess_gen.dataset.reader import RawPairs, Sample, dataset_folders
from unprocess_gen.dataset.shards import arrays_of

EXPORT_RECORD, MANIFEST = "export.json", "manifest.csv"
UNFINISHED = ".unfinished"
"""Folder below ``TO`` for files that are being written."""

LMDB_MARGIN = 2**27
"""Bytes of a map beyond twice the bytes of the arrays: pages of keys, and of transactions in progress."""


class ExportSummary(NamedTuple):
    """Count the pairs that this call wrote, and those that an earlier one had written."""

    written: int
    present: int


class _Unit(NamedTuple):
    """Hold the pairs of a shard and a split: number of the shard, folder, and the row of each pair by its number."""

    shard: int
    place: Path
    rows: dict[int, Row]


ReadSample = Callable[[int], Sample]
Watch = Callable[[Iterable[_Unit]], Iterable[_Unit]]


def export(folder: AnyPath, form: str, to: Path, watch: Watch = iter) -> Iterator[tuple[Path, ExportSummary]]:
    """Export a dataset, or each dataset of a sweep to a folder of its name.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the dataset or sweep.
    form : str
        One of `FORMATS`.
    to : Path
        Folder that is empty, does not exist, or contains a part of this export.
    watch : callable
        Returns the units of work that it is given, and may show the progress.

    Yields
    ------
    Path, ExportSummary
        Folder of each exported dataset, and its number of pairs.

    Raises
    ------
    ConfigError
        If a library is missing, a manifest has no frames, or ``to`` has other files or cannot be written.
    DamageError
        If the dataset is damaged.
    MachineError
        If writing fails.
    """
    if FORMATS[form].library:
        require(FORMATS[form].library, f"export: {FORMATS[form].library} is missing", "export")
    check_output_folder(to, f"--to {to}")
    folders = dataset_folders(folder)
    for dataset in folders:
        place = to if folders == [folder] else to / folder_name(dataset)
        with machine_errors(place):
            yield place, _export_dataset(dataset, form, place, watch)


def _export_dataset(folder: AnyPath, form: str, to: Path, watch: Watch) -> ExportSummary:
    pairs, manifest = RawPairs(folder), folder / MANIFEST
    _begin(to, {"format": form, "manifest_sha256": file_sha256(manifest)})
    if (to / MANIFEST).exists():
        return ExportSummary(0, len(pairs))

    def read(number: int) -> Sample:
        sample = pairs[number]
        for name, stored in arrays_of(sample.row).items():
            if array_xxh3(_arrays(sample)[name]) != stored.digest:
                raise DamageError(f"{folder}: {name} of {sample.row['key']} differs from the digest in its row")
        return sample

    writer, written, places = FORMATS[form], 0, dict[Path, None]()
    for unit in watch(_units(manifest, to)):
        written += writer.write(unit, read, to / UNFINISHED)
        places[unit.place] = None
    for place in places:
        writer.finish((unit for unit in _units(manifest, to) if unit.place == place), to / UNFINISHED)
    LocalPath(to / MANIFEST).write(manifest.read_bytes(), str(to / UNFINISHED))
    for unfinished in (to / UNFINISHED).iterdir():
        unfinished.unlink()
    (to / UNFINISHED).rmdir()
    return ExportSummary(written, len(pairs) - written)


def _begin(to: Path, record: Mapping[str, str]) -> None:
    """Record what is exported; ConfigError if the folder has other files, or another export."""
    to.mkdir(parents=True, exist_ok=True)
    text, path = json.dumps(record) + "\n", to / EXPORT_RECORD
    foreign = sorted({entry.name for entry in to.iterdir()} - {UNFINISHED})
    if foreign and not path.is_file():
        raise ConfigError(f"--to {to}: contains {foreign[0]}, but no export; expected an empty folder; choose another")
    (to / UNFINISHED).mkdir(exist_ok=True)
    if not LocalPath(path).create(text.encode(), str(to / UNFINISHED)) and path.read_bytes() != text.encode():
        raise ConfigError(
            f"--to {to}: contains an export of another dataset or format ({EXPORT_RECORD}); choose another folder"
        )


def _units(manifest: AnyPath, to: Path) -> Iterator[_Unit]:
    """Yield the pairs of each shard, one unit for each split."""
    pairs = enumerate(row for row in read_rows(manifest) if row["status"] == "ok")
    for shard, numbered in groupby(pairs, key=lambda pair: int(pair[1]["shard"] or 0)):
        splits: dict[str, dict[int, Row]] = {}
        for number, row in numbered:
            splits.setdefault(str(row["split"]), {})[number] = row
        yield from (_Unit(shard, to / split, rows) for split, rows in splits.items())


def _arrays(sample: Sample) -> dict[str, Array]:
    return {"clean": sample.clean, "noisy": sample.noisy, **sample.targets}


def _row_text(row: Row) -> str:
    return json.dumps(without_empty(row), separators=(",", ":"))


# ------------------------------------------------------------------------------------------------------------ formats


class _Files:
    """Write a file for each array of a pair, ``NAME/KEY.SUFFIX``."""

    def __init__(self, suffix: str, encode: Callable[[Array, Row], bytes], library: str = "") -> None:
        self.suffix, self.encode, self.library = suffix, encode, library

    def write(self, unit: _Unit, read: ReadSample, unfinished: Path) -> int:
        """Write the missing files of a unit; return the number of pairs with a new file."""
        return sum(self._write_pair(unit.place, read, number, row, unfinished) for number, row in unit.rows.items())

    def _write_pair(self, place: Path, read: ReadSample, number: int, row: Row, unfinished: Path) -> bool:
        files = {name: place / name / f"{row['key']}.{self.suffix}" for name in arrays_of(row)}
        missing = {name: file for name, file in files.items() if not file.exists()}
        if missing:
            sample = read(number)
            for name, file in missing.items():
                file.parent.mkdir(parents=True, exist_ok=True)
                LocalPath(file).write(self.encode(_arrays(sample)[name], sample.row), str(unfinished))
        return bool(missing)

    def finish(self, units: Iterable[_Unit], unfinished: Path) -> None:
        """Do nothing: the files are complete."""


def _npy(array: Array, row: Row) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _tiff(array: Array, row: Row) -> bytes:
    import tifffile

    stream = io.BytesIO()
    is_rgb = array.ndim == 3 and array.shape[2] == 3
    photometric = "rgb" if is_rgb else "minisblack"
    tifffile.imwrite(stream, array, photometric=photometric, metadata=None, description=_row_text(row))
    return stream.getvalue()


class _Hdf5:
    """Write an HDF5 file for each shard, and one that links to the arrays of all."""

    library = "h5py"

    def write(self, unit: _Unit, read: ReadSample, unfinished: Path) -> int:
        """Write the file of a unit unless it exists."""
        import h5py

        path = unit.place / f"shard-{unit.shard:05d}.h5"
        if path.exists():
            return 0
        temporary = unfinished / path.name
        with h5py.File(temporary, "w") as file:
            for number, row in unit.rows.items():
                sample = read(number)
                for name, array in _arrays(sample).items():
                    file.create_dataset(f"{name}/{row['key']}", data=array).attrs["row"] = _row_text(sample.row)
        path.parent.mkdir(parents=True, exist_ok=True)
        commit_file(temporary, path)
        return len(unit.rows)

    def finish(self, units: Iterable[_Unit], unfinished: Path) -> None:
        """Write ``pairs.h5``."""
        import h5py

        with h5py.File(unfinished / "pairs.h5", "w") as file:
            for unit in units:
                for member in (f"/{name}/{row['key']}" for row in unit.rows.values() for name in arrays_of(row)):
                    file[member] = h5py.ExternalLink(f"shard-{unit.shard:05d}.h5", member)
        commit_file(unfinished / "pairs.h5", unit.place / "pairs.h5")


class _Lmdb:
    """Write an LMDB environment for each array, with NPY files as values, and one for the rows."""

    library = "lmdb"

    def write(self, unit: _Unit, read: ReadSample, unfinished: Path) -> int:
        """Write the missing pairs of a unit; return their number."""
        import lmdb

        try:
            return self._write(unit, read)
        except lmdb.Error as error:
            raise MachineError(f"{unit.place}: LMDB: {error}") from error

    def _write(self, unit: _Unit, read: ReadSample) -> int:
        import lmdb

        names = dict.fromkeys(name for row in unit.rows.values() for name in (*arrays_of(row), "row"))
        with ExitStack() as stack:
            transactions = {}
            for name in names:
                place = unit.place / f"{name}.lmdb"
                place.mkdir(parents=True, exist_ok=True)
                used = sum(entry.stat().st_size for entry in place.iterdir())
                environment = stack.enter_context(
                    lmdb.open(str(place), map_size=2 * (used + _bytes(unit)) + LMDB_MARGIN)
                )
                transactions[name] = stack.enter_context(environment.begin(write=True))
            missing = [
                number
                for number, row in unit.rows.items()
                if any(transactions[name].get(_name(row)) is None for name in (*arrays_of(row), "row"))
            ]
            for number in missing:
                sample = read(number)
                values = {name: _npy(array, sample.row) for name, array in _arrays(sample).items()}
                for name, value in {**values, "row": _row_text(sample.row).encode()}.items():
                    transactions[name].put(_name(sample.row), value)
            return len(missing)

    def finish(self, units: Iterable[_Unit], unfinished: Path) -> None:
        """Write ``meta_info.txt``, in which BasicSR looks for keys: name, shape and level of compression."""
        lines: dict[Path, list[str]] = {}
        for unit in units:
            for row in unit.rows.values():
                for name, stored in arrays_of(row).items():
                    shape = ",".join(map(str, stored.array.shape))
                    lines.setdefault(unit.place / f"{name}.lmdb", []).append(f"{row['key']}.npy ({shape}) 0\n")
        for environment, array_lines in lines.items():
            LocalPath(environment / "meta_info.txt").write("".join(array_lines).encode(), str(unfinished))


def _name(row: Row) -> bytes:
    return str(row["key"]).encode()


def _bytes(unit: _Unit) -> int:
    return sum(stored.array.size + 2**13 for row in unit.rows.values() for stored in arrays_of(row).values())


FORMATS: dict[str, Any] = {
    "npy": _Files("npy", _npy),
    "tiff": _Files("tif", _tiff, "tifffile"),
    "hdf5": _Hdf5(),
    "lmdb": _Lmdb(),
}
"""Writers by the names of ``--format``."""
