"""Write ``manifest.parquet``: the manifest as typed columns, for programs that query millions of rows.

The file is derived from ``manifest.csv``. Its bytes depend on the version of pyarrow, so they are no part of what a
dataset reproduces; ``dataset.json`` records their SHA-256 to find damage.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.core.errors import DamageError
from unprocess_gen.dataset.columns import COLUMNS, TYPE_NAMES
from unprocess_gen.dataset.manifest import read_columns

if TYPE_CHECKING:
    import pyarrow

PARQUET_NAME = "manifest.parquet"

BLOCK_BYTES = 2**24
"""Bytes of CSV in a row group, which bound the memory: about 18,000 rows."""


def write_parquet(manifest: Path, path: Path) -> None:
    """Convert a manifest to Parquet, a row group at a time.

    Parameters
    ----------
    manifest : Path
        An intact ``manifest.csv`` of this or an older version.
    path : Path
        File to write; a file of that name is replaced.

    Raises
    ------
    DamageError
        If the manifest cannot be read.
    OSError
        If the file cannot be written.
    """
    from pyarrow import ArrowInvalid, csv, parquet

    schema = parquet_schema(read_columns(manifest))
    types = {field.name: field.type for field in schema}
    try:
        batches = csv.open_csv(
            manifest,
            csv.ReadOptions(block_size=BLOCK_BYTES, use_threads=False),
            convert_options=csv.ConvertOptions(column_types=types, null_values=[""], include_columns=schema.names),
        )
        with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
            for batch in batches:
                writer.write_batch(batch)
    except ArrowInvalid as error:
        raise DamageError(f"{manifest}: cannot be converted to Parquet ({error})") from error


def parquet_schema(names: tuple[str, ...]) -> pyarrow.Schema:
    """Return the types of columns: int64, double or string, as `columns.COLUMNS` has them.

    Parameters
    ----------
    names : tuple of str
        Columns of the manifest (`manifest.read_columns`); unknown ones are left out.

    Returns
    -------
    pyarrow.Schema
        Empty cells are null, except in columns of text, where they are empty. ``gamma``, a number or a word, is text.
    """
    import pyarrow

    types = {TYPE_NAMES[int]: pyarrow.int64(), TYPE_NAMES[float]: pyarrow.float64()}
    types_by_name = {column.name: types.get(column.type_name, pyarrow.string()) for column in COLUMNS}
    return pyarrow.schema([pyarrow.field(name, types_by_name[name]) for name in names if name in types_by_name])
