"""Read and write ``manifest.csv``.

Floats are written in Python's shortest round-trip spelling, so a row read back gives the same plan bit for bit. A
manifest has the columns that its settings can fill (`row.columns_of`). Format: ``docs/design/dataset_format.md``.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import itertools
import operator
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.fields import ALWAYS
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.dataset.columns import Row, Value
from unprocess_gen.dataset.dataset_json import check_format
from unprocess_gen.dataset.row import COLUMNS, KEY_TEXT, check_row

MAX_LINE_BYTES = 2**17
"""Longest line of a manifest that is read. Paths have at most 4096 bytes, three characters each if encoded."""


def write_manifest(path: Path, names: Sequence[str], texts: Iterable[bytes]) -> str:
    """Write a manifest, given the lines of its rows in pieces (`csv_lines`); its SHA-256."""
    digest = hashlib.sha256()
    with path.open("wb", buffering=2**20) as stream:
        for text in itertools.chain([",".join(names).encode() + b"\n"], texts):  # no name of a column needs quotes
            digest.update(text)
            stream.write(text)
    return digest.hexdigest()


def csv_lines(rows: Iterable[Row], names: Sequence[str]) -> bytes:
    r"""Lines of rows as CSV: ``\n`` line ends, quotes only if needed, empty cells for None."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([_cell(row[name]) for name in names] for row in rows)
    return stream.getvalue().encode()


def _cell(value: Value) -> str:
    return "" if value is None else repr(value) if isinstance(value, float) else str(value)


def read_rows(path: AnyPath) -> Iterator[Row]:
    """Read the typed rows of a manifest, one at a time; unknown columns are left out, missing ones are empty.

    DamageError if the file is not a manifest, or a value is not allowed; the sentence names row, column and value.
    """
    return (row for _, row in rows_with_offsets(path))


ShardRows = tuple[int, list[Row]]
"""Number of a shard, and its rows in the order of the manifest."""


def shard_rows(manifest: AnyPath) -> Iterator[ShardRows]:
    """Read the rows of a manifest shard by shard.

    Raises DamageError if the manifest cannot be read, or its shards are not in ascending order.
    """
    last = -1
    for number, group in itertools.groupby(read_rows(manifest), key=operator.itemgetter("shard")):
        rows = list(group)
        if number is None:
            raise DamageError(f"{manifest}: row {rows[0]['key']} names no shard")
        if number <= last:
            raise DamageError(
                f"{manifest}: row {rows[0]['key']} of shard {number} follows rows of shard {last}; expected shards in "
                "ascending order"
            )
        last = number
        yield number, rows


def rows_with_offsets(path: AnyPath) -> Iterator[tuple[int, Row]]:
    """Read rows with the byte offset of their lines. A row is one line, since no value contains a line end."""
    with _opened(path) as (stream, header):
        offset = stream.tell()
        while line := stream.readline(MAX_LINE_BYTES + 1):
            yield offset, _typed(header, line)
            offset += len(line)


def read_columns(path: AnyPath) -> tuple[str, ...]:
    """Columns of a manifest, unknown ones included; DamageError if the file is no manifest."""
    with _opened(path) as (_, header):
        return header


def read_row(path: AnyPath, offset: int, columns: Sequence[str] = ()) -> Row:
    """Read the row whose line begins at an offset; ``columns`` are those of `read_columns`, if they are known.

    DamageError if no row begins there.
    """
    try:
        with _opened(path, columns) as (stream, header):
            stream.seek(offset)
            return _typed(header, stream.readline(MAX_LINE_BYTES + 1))
    except DamageError as error:
        raise DamageError(f"{path}: no row at byte {offset} ({error})") from error


@contextlib.contextmanager
def _opened(path: AnyPath, columns: Sequence[str] = ()) -> Iterator[tuple[BinaryIO, tuple[str, ...]]]:
    """Open a manifest, and yield file and header; DamageError for everything that goes wrong until it is closed.

    If ``columns`` are given, neither the header nor the format of the dataset is read.
    """
    if not columns:
        check_format(path.parent)
    try:
        with path.open("rb") as stream:
            header = tuple(columns or _cells_of(stream.readline(MAX_LINE_BYTES + 1)))
            missing = [column.name for column in COLUMNS if column.needs is ALWAYS and column.name not in header]
            if missing:
                raise DamageError(f"{path}: not a manifest, column {missing[0]} is missing")
            yield stream, header
    except FileNotFoundError:
        raise DamageError(f"{path}: no such manifest") from None
    except (csv.Error, ValueError) as error:
        raise DamageError(f"{path}: not a readable manifest ({error})") from error
    except OSError as error:
        raise DamageError(f"{path}: cannot be read ({error.strerror})") from error


def _cells_of(line: bytes) -> list[str]:
    return next(csv.reader([line.decode("utf-8")], strict=True), [])


def _typed(header: Sequence[str], line: bytes) -> Row:
    """Row of a line; ValueError or csv.Error names what is wrong with it."""
    if not line.endswith(b"\n"):
        long = f"a line has more than {MAX_LINE_BYTES} bytes" if len(line) > MAX_LINE_BYTES else "the last line is cut"
        raise ValueError(long)
    cells = dict(zip(header, _cells_of(line), strict=True))
    key = cells["key"]
    if not key or not KEY_TEXT.allows(key):
        raise ValueError(f"the key is {key[:40]!r}, expected eight digits")
    try:
        row = {column.name: column.parse(cells.get(column.name, "")) for column in COLUMNS}
        check_row(row)
    except ValueError as error:
        raise ValueError(f"row {key}: {error}") from None
    return row
