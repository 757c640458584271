"""Build manifest rows, convert them to plans, and read and write ``manifest.csv`` and ``KEY.json``.

A row maps each column of `columns.COLUMNS` to a typed value. If a column does not apply, text is empty and a number is
None. Floats are written in Python's shortest round-trip spelling, so a row read back gives the same plan bit for bit.

The shards hold each row as JSON too. It is padded with blanks to a size that depends only on the name of the source and
the number of pairs. Therefore the size of a shard is known before the shard is written.

Format and compatibility: ``docs/design/dataset_format.md``.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, BinaryIO, NamedTuple, TextIO, TypeVar

from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.types import PLAN_PARTS, Counts, DarkFramePlan, NoisePlan, Pair, Patch, Plan, Row, Source, Value
from unprocess_gen.dataset.columns import COLUMN_NAMES, COLUMNS, COLUMNS_OF, FIRST, HEADERS, Column, RecordType
from unprocess_gen.dataset.keys import key_text
from unprocess_gen.simulation.effects import Physics, dark_variance_dn2

RowPart = TypeVar("RowPart")

JSON_BYTES = 5632
"""Bytes of a row's JSON without the name of its source. The longest row takes 3 less, so the next number in JSON must
shorten another. The size decides the bytes of shards."""

TARGET_JSON_BYTES = 72
"""More bytes for each stored target: its name, dtype and digest."""

RAW_JSON_BYTES = 512
"""More bytes for a pair of a raw source: its levels, the digest of its mosaic, and what the file states."""

MAX_LINE_BYTES = 2**17
"""Longest line of a manifest that is read. Paths have at most 4096 bytes, three characters each if encoded."""

MAX_DETAIL = 300
"""Characters of the column ``detail``."""

FRAME_BYTES = 2**33 - 1024
"""Most bytes of one array: a member of a USTAR archive has less than 8 GiB."""

TARGET_BYTES = 12
"""Most bytes of a pixel of a target: three of float32."""


# ------------------------------------------------------------------------------------------------------------ rows


def pair_row(
    key: str,
    source: Source,
    sha256: str,
    orientation: int,
    shard: int,
    plan: Plan,
    pair: Pair | None,
    digests: tuple[str, str],
    patch: Patch,
    source_noise_dn: float | None = None,
) -> Row:
    """Return the row of a pair.

    Parameters
    ----------
    key : str
        Key of the pair (`keys.pair_key`).
    source : Source
        Photograph or scene.
    sha256 : str
        SHA-256 of the source's bytes, 64 hexadecimal digits.
    orientation : int
        EXIF orientation applied to the source, 1 to 8.
    shard : int
        Number of the shard.
    plan : Plan
        All parameters of the pair.
    pair : Pair or None
        Frames and counts; None in a manifest without frames.
    digests : tuple of str
        XXH3-128 of the clean and of the noisy array, 32 hexadecimal digits each; empty without frames.
    patch : Patch
        Part of the full frame that the pair shows.
    source_noise_dn : float or None
        Noise of the source itself, DN; None if it was not estimated.

    Returns
    -------
    Row
        Value by column, in the order of `columns.COLUMNS`.
    """
    values = {
        "key": key,
        "status": "ok",
        "orientation": orientation,
        "clean_xxh3": digests[0],
        "noisy_xxh3": digests[1],
        "clip": source.clip,
        "source_noise_dn": source_noise_dn,
        "dark_variance_dn2": dark_variance_dn2(plan),
        **_plan_cells(plan),
        **_cells(patch),
        **({} if pair is None else _cells(pair.counts)),
    }
    return _row(source, sha256, shard, plan.seed, values)


def failed_row(
    source: Source, sha256: str | None, shard: int, seed: int, reason: str, detail: str = "", status: str = "failed"
) -> Row:
    """Return the row of a source that could not be used or was left out.

    Parameters
    ----------
    source : Source
        Photograph or scene.
    sha256 : str or None
        SHA-256 of the source's bytes; None if they could not be read.
    shard : int
        Number of the shard.
    seed : int
        Seed of the run.
    reason : str
        One of `errors.REASONS`.
    detail : str
        Explanation (`SourceError.text`); kept as one line of at most `MAX_DETAIL` characters.
    status : str
        ``"failed"`` or ``"filtered"``.

    Returns
    -------
    Row
        Value by column.
    """
    failure = {"status": status, "reason": reason, "detail": detail_text(detail)}
    return _row(source, sha256, shard, seed, failure)


def detail_text(text: str) -> str:
    """Return an explanation as one line for the column ``detail``.

    Parameters
    ----------
    text : str
        Any text.

    Returns
    -------
    str
        At most `MAX_DETAIL` characters, without control and bidirectional characters. A space precedes a leading
        ``= + - @``, so that spreadsheets do not run it.
    """
    line = " ".join(_UNSAFE.sub("?", " ".join(text.split())).split())
    line = f" {line}" if line.startswith(("=", "+", "-", "@")) else line
    return line if len(line) <= MAX_DETAIL else line[: MAX_DETAIL - 1] + "…"


_UNSAFE = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def _plan_cells(plan: Plan) -> dict[str, Value]:
    """Return the values of all columns that hold a plan."""
    physics = plan.noise.physics
    cells: dict[str, Value] = {}
    for record in (plan, plan.noise.dark, *(getattr(plan, part) for part in PLAN_PARTS)):
        cells |= _cells(record)
    if physics is not None:
        return cells | _cells(physics)
    return cells | {column.name: column.not_applicable for column in COLUMNS if column.of is Physics}


def _cells(record: Any) -> dict[str, Value]:
    """Return the values of all columns that hold a record; later columns are empty at the default of their field."""
    cells: dict[str, Value] = {}
    defaults = _DEFAULTS[type(record)]
    for field, columns in COLUMNS_OF[type(record)].items():
        value = getattr(record, field)
        if columns[0].since != FIRST and value == defaults[field]:
            cells |= {column.name: column.empty for column in columns}
            continue
        values = value if len(columns) > 1 else (value,)
        cells |= {column.name: column.from_field(item) for column, item in zip(columns, values, strict=True)}
    return cells


_DEFAULTS = {record: {field.name: field.default for field in dataclasses.fields(record)} for record in COLUMNS_OF}
"""Default of each field; `dataclasses.MISSING` for fields without one."""


def _row(source: Source, sha256: str | None, shard: int, seed: int, values: Mapping[str, Value]) -> Row:
    known: dict[str, Value] = {
        "key": key_text(source.index),
        "source": source.name,
        "source_sha256": sha256 or "",
        "source_bytes": source.size_bytes,
        "shard": shard,
        "seed": seed,
    }
    known |= {name: value for name, value in values.items() if value is not None}
    return {column.name: known.get(column.name, column.empty) for column in COLUMNS}


def row_of_values(values: Sequence[Value]) -> Row:
    """Return the row of a list of values in column order.

    Parameters
    ----------
    values : sequence of str, int, float or None
        One value for each column of any version.

    Returns
    -------
    Row
        The row; columns that were added after that version are empty, or follow from the others.

    Raises
    ------
    ValueError
        If no version has as many columns.
    """
    if len(values) not in map(len, HEADERS):
        raise ValueError(f"a row of {len(values)} values; expected {' or '.join(map(str, map(len, HEADERS)))}")
    known = dict(zip(COLUMN_NAMES, values, strict=False))
    return _completed({column.name: known.get(column.name, column.empty) for column in COLUMNS})


def _completed(row: Row) -> Row:
    """Add the column that follows from others to a row of a version, or of a file, that lacks it."""
    if row["status"] != "ok" or row["dark_variance_dn2"] is not None:
        return row
    return {**row, "dark_variance_dn2": dark_variance_dn2(plan_from_row(row))}


def plan_from_row(row: Row) -> Plan:
    """Return the plan that a row holds.

    Parameters
    ----------
    row : Row
        Row of a pair, from ``manifest.csv`` or ``KEY.json``.

    Returns
    -------
    Plan
        All parameters of the pair. Together with the pixels of its source they give its arrays.

    Raises
    ------
    DamageError
        If a value is missing, of another type or not allowed.
    """
    try:
        physics = None if row.get("read_law") == "none" else _part(row, Physics)
        noise = NoisePlan(**_fields(row, NoisePlan), physics=physics, dark=_part(row, DarkFramePlan))
        parts = {name: _part(row, record) for name, record in PLAN_PARTS.items() if record is not NoisePlan}
        plan = Plan(**_fields(row, Plan), **parts, noise=noise)
        _check_plan(plan)
    except ValueError as error:
        raise DamageError(f"row {_key_of(row)}: not a plan ({error})") from error
    return plan


def patch_from_row(row: Row) -> Patch:
    """Return the part of the full frame that a row's pair shows.

    Parameters
    ----------
    row : Row
        Row of a pair.

    Returns
    -------
    Patch
        Number, corner and size; the complete frame is patch 0 at row 0, column 0.

    Raises
    ------
    DamageError
        If a value is missing, of another type or not allowed.
    """
    try:
        return _part(row, Patch)
    except ValueError as error:
        raise DamageError(f"row {_key_of(row)}: not a patch ({error})") from error


def _part(row: Row, record: type[RowPart]) -> RowPart:
    """Return a record from the columns that hold it."""
    return record(**_fields(row, record))


def _fields(row: Row, record: RecordType) -> dict[str, Any]:
    """Return the fields of a record from the columns that hold it; ValueError names the column.

    A field is omitted, and keeps its default, if its columns are newer than the row and thus empty.
    """
    fields: dict[str, Any] = {}
    for field, columns in COLUMNS_OF[record].items():
        if all(column.since != FIRST and row.get(column.name, column.empty) == column.empty for column in columns):
            continue
        values = tuple(column.to_field(row) for column in columns)
        fields[field] = values if len(values) > 1 else values[0]
    return fields


def _check_plan(plan: Plan) -> None:
    """Raise ValueError for values that are allowed one by one and contradict each other."""
    sensor, physics = plan.sensor, plan.noise.physics
    if not sensor.black_level_dn < sensor.white_level_dn < 2**sensor.bits:
        raise ValueError(
            f"white_level_dn={sensor.white_level_dn}: expected more than black_level_dn={sensor.black_level_dn} "
            f"and less than 2^{sensor.bits} (bits)"
        )
    if physics is not None and not physics.dn_per_e > 0:
        raise ValueError(f"dn_per_e={physics.dn_per_e}: expected more than 0")


def _key_of(row: Row) -> str:
    return str(row.get("key"))[:40]


def check_row(row: Row) -> None:
    """Check every value of a row.

    Parameters
    ----------
    row : Row
        Row from a file.

    Raises
    ------
    ValueError
        If a value is not allowed, or a row with status ``ok`` lacks a number or a word that its arrays depend on. The
        sentence names the column and the value.
    """
    for column in COLUMNS:
        value = row[column.name]
        if value != column.empty:
            column.check(value)
    _check_together(row)


def _check_together(row: Row) -> None:
    if not row["status"]:
        raise ValueError("status is empty")
    if row["status"] != "ok":
        return
    for name in _NEEDED if any(row[name] not in (None, "") for name in _FRAME_COLUMNS) else _NEEDED_TO_PLAN:
        if row[name] is None or row[name] == "":
            raise ValueError(f"{name} is empty")
    largest = TARGET_BYTES if row["targets"] else 4 if "float32" in (row["dtype"], row["clean_dtype"]) else 2
    size = int(row["width"] or 0) * int(row["height"] or 0) * largest
    if size > FRAME_BYTES:
        raise ValueError(
            f"width={row['width']}, height={row['height']}: an array of {size} bytes; expected at most {FRAME_BYTES}"
        )


_NEEDED_TO_PLAN = "width", "height", "shard", "level", "draw", "frame", "dtype", "layout", "pattern"
_NEEDED = *_NEEDED_TO_PLAN, "clean_xxh3", "noisy_xxh3"
"""Columns without which the members of a pair can neither be found nor checked."""

_FRAME_COLUMNS = "clean_xxh3", "noisy_xxh3", "targets", *(column.name for (column,) in COLUMNS_OF[Counts].values())
"""Columns that depend on frames; all of them are empty in a manifest without frames."""


def has_frames(row: Row) -> bool:
    """Check whether the frames of a row are stored.

    Parameters
    ----------
    row : Row
        A row of a manifest.

    Returns
    -------
    bool
        False for failed sources, and in a manifest without frames (``output.frames=false``).
    """
    return row["status"] == "ok" and bool(row["clean_xxh3"])


# ------------------------------------------------------------------------------------------------------------- CSV


class Manifest(NamedTuple):
    """Hold the opened file and the header of a manifest."""

    stream: BinaryIO
    header: tuple[str, ...]


def write_rows(stream: TextIO, rows: Iterable[Row], names: Sequence[str] = COLUMN_NAMES) -> None:
    r"""Write rows as CSV: ``\n`` line ends, quotes only if needed, empty cells for None.

    Parameters
    ----------
    stream : text file
        Opened with ``newline=""`` and UTF-8.
    rows : iterable of Row
        Rows in source order.
    names : sequence of str
        Header. `read_columns` returns the one of an older manifest, whose bytes are thereby restored.
    """
    stream.write(header_text(names))
    _write_lines(stream, rows, names)


def _write_lines(stream: TextIO, rows: Iterable[Row], names: Sequence[str]) -> None:
    csv.writer(stream, lineterminator="\n").writerows([_cell(row[name]) for name in names] for row in rows)


def rows_text(rows: Iterable[Row]) -> str:
    """Return the lines that `write_rows` writes for some rows, without the header.

    Parameters
    ----------
    rows : iterable of Row
        Rows in source order.

    Returns
    -------
    str
        One line for each row.
    """
    stream = io.StringIO()
    _write_lines(stream, rows, COLUMN_NAMES)
    return stream.getvalue()


def header_text(names: Sequence[str] = COLUMN_NAMES) -> str:
    """Return the first line of a manifest.

    Parameters
    ----------
    names : sequence of str
        Names of its columns; none needs quotes.

    Returns
    -------
    str
        The line with its end.
    """
    return ",".join(names) + "\n"


def current_lines(lines: bytes, columns: int) -> bytes:
    """Return lines of a manifest with a cell for each column that was added later.

    Parameters
    ----------
    lines : bytes
        Lines of `rows_text` that any version wrote, in UTF-8.
    columns : int
        Number of columns of that version.

    Returns
    -------
    bytes
        The lines themselves if this version has no other columns.

    Raises
    ------
    ValueError
        If no version has as many columns.
    """
    if columns == len(COLUMN_NAMES):
        return lines
    if columns not in map(len, HEADERS):
        raise ValueError(f"rows of {columns} columns; expected those of a known version")
    rows = (_completed(_typed(COLUMN_NAMES[:columns], line)) for line in lines.splitlines(keepends=True))
    return rows_text(rows).encode()


def _cell(value: Value) -> str:
    return "" if value is None else repr(value) if isinstance(value, float) else str(value)


def read_rows(path: AnyPath) -> Iterator[Row]:
    """Read the typed rows of a manifest, one at a time.

    Parameters
    ----------
    path : Path or ObjectPath
        A ``manifest.csv`` of this or an older version. Unknown columns are left out; missing newer ones are empty.

    Returns
    -------
    iterator of Row
        Rows in file order.

    Raises
    ------
    DamageError
        If the file is not a manifest, or a value is not allowed; the sentence names row, column and value.
    """
    return (row for _, row in rows_with_offsets(path))


def rows_with_offsets(path: AnyPath) -> Iterator[tuple[int, Row]]:
    """Read rows with the position of their lines. A row is one line, since no value contains a line end.

    Parameters
    ----------
    path : Path or ObjectPath
        A ``manifest.csv``.

    Yields
    ------
    int
        Byte offset of the line, for `read_row`.
    Row
        The row.

    Raises
    ------
    DamageError
        If the file is not a manifest, or a value is not allowed.
    """
    with _opened(path) as (stream, header):
        offset = stream.tell()
        while line := stream.readline(MAX_LINE_BYTES + 1):
            yield offset, _typed(header, line)
            offset += len(line)


def read_columns(path: AnyPath) -> tuple[str, ...]:
    """Columns of a manifest, those unknown to this version included; DamageError if the file is no manifest."""
    with _opened(path) as manifest:
        return manifest.header


def read_row(path: AnyPath, offset: int, columns: Sequence[str] = ()) -> Row:
    """Read one row.

    Parameters
    ----------
    path : Path or ObjectPath
        A ``manifest.csv``.
    at : int
        Byte offset from `rows_with_offsets`.
    columns : sequence of str, optional
        The result of `read_columns`, which is read from the file if it is not given.

    Returns
    -------
    Row
        The row whose line begins there.

    Raises
    ------
    DamageError
        If no row begins there.
    """
    try:
        with _opened(path, columns) as (stream, header):
            stream.seek(offset)
            return _typed(header, stream.readline(MAX_LINE_BYTES + 1))
    except DamageError as error:
        raise DamageError(f"{path}: no row at byte {offset} ({error})") from error


@contextlib.contextmanager
def _opened(path: AnyPath, columns: Sequence[str] = ()) -> Iterator[Manifest]:
    """Open a manifest after its header; DamageError for everything that goes wrong until it is closed.

    If ``columns`` are given, the header is not read.
    """
    try:
        with path.open("rb") as stream:
            header = tuple(columns or _cells_of(stream.readline(MAX_LINE_BYTES + 1)))
            missing = [column.name for column in COLUMNS if column.since == FIRST and column.name not in header]
            if missing:
                raise DamageError(f"{path}: not a manifest, column {missing[0]} is missing")
            yield Manifest(stream, header)
    except FileNotFoundError:
        raise DamageError(f"{path}: no such manifest") from None
    except (csv.Error, ValueError) as error:
        raise DamageError(f"{path}: not a readable manifest ({error})") from error
    except OSError as error:
        raise DamageError(f"{path}: cannot be read ({error.strerror})") from error


def _cells_of(line: bytes) -> list[str]:
    return next(csv.reader([line.decode("utf-8")], strict=True), [])


def _typed(header: Sequence[str], line: bytes) -> Row:
    """Return the row of a line; ValueError or csv.Error names what is wrong with it."""
    if not line.endswith(b"\n"):
        long = f"a line has more than {MAX_LINE_BYTES} bytes" if len(line) > MAX_LINE_BYTES else "the last line is cut"
        raise ValueError(long)
    cells = dict(zip(header, _cells_of(line), strict=True))
    key = cells["key"]
    if not key or key not in COLUMNS[0].allowed:
        raise ValueError(f"the key is {key[:40]!r}, expected eight digits")
    try:
        row = {column.name: column.parse(cells.get(column.name, "")) for column in COLUMNS}
        _check_together(row)
    except ValueError as error:
        raise ValueError(f"row {key}: {error}") from None
    return row


# ------------------------------------------------------------------------------------------------------------ JSON


OTHERS = "others"
"""The key under which a sample's JSON holds the rows of all its pairs except the first."""

_JSON_COLUMNS = tuple(column for column in COLUMNS if column.in_json)


def json_size(source_name: str, pairs: int = 1, targets: int = 0, is_raw: bool = False) -> int:
    """Return the size of a sample's JSON in the shard.

    Parameters
    ----------
    source_name : str
        The column ``source``.
    pairs : int
        Noisy frames of the sample.
    targets : int
        Stored targets of a pair.
    is_raw : bool
        Whether the source is raw.

    Returns
    -------
    int
        Bytes, padding included; a multiple of 512.
    """
    named = 2 * len(json.dumps(source_name))  # the name of its clip is a part of it, or equal to it
    more = TARGET_JSON_BYTES * targets + RAW_JSON_BYTES * is_raw
    return -(-(JSON_BYTES + named + more) * pairs // 512) * 512


def row_json(rows: Sequence[Row]) -> bytes:
    """Return the JSON of a sample.

    Parameters
    ----------
    rows : sequence of Row
        Rows of one clean frame, in order. Columns that are not in JSON are left out, and so are empty ones that later
        versions added: such rows have the JSON that version 0.1 wrote.

    Returns
    -------
    bytes
        ASCII, one line: the first row, with the others as a list; padded to `json_size`.

    Raises
    ------
    ValueError
        If the text is longer than that.
    """
    first, *others = (without_empty(row, _JSON_COLUMNS) for row in rows)
    content = {**first, OTHERS: others} if others else first
    text = json.dumps(content, separators=(",", ":")).encode("ascii")
    is_raw, stored = bool(rows[0]["raw_pattern"]), int(bool(rows[0]["targets"]))
    size = json_size(str(first["source"]), len(rows), stored, is_raw)
    if len(text) >= size:
        raise ValueError(f"row {first['key']} takes {len(text)} bytes as JSON, more than the {size} set aside")
    return text.ljust(size - 1) + b"\n"


def without_empty(row: Row, columns: Sequence[Column] = COLUMNS) -> dict[str, Value]:
    """Return the cells of a row that a file of version 0.1 would have, and those of later columns that apply.

    Parameters
    ----------
    row : Row
        A row with all columns.
    columns : sequence of Column
        Columns to return.

    Returns
    -------
    dict
        Values by the names of their columns.
    """
    return {
        column.name: row[column.name] for column in columns if column.since == FIRST or row[column.name] != column.empty
    }


def rows_of_json(content: bytes) -> list[Row]:
    """Return the rows of a sample.

    Parameters
    ----------
    content : bytes
        Member ``KEY.json`` of a shard.

    Returns
    -------
    list of Row
        One row for each pair, with all columns.

    Raises
    ------
    DamageError
        If the JSON is malformed, or a value is missing, of another type or not allowed.
    """
    try:
        loaded = json.loads(content)
        if not isinstance(loaded, dict) or not isinstance(others := loaded.pop(OTHERS, []), list):
            raise ValueError("expected an object")
        return [_row_of_json(entry) for entry in (loaded, *others)]
    except (ValueError, RecursionError) as error:
        raise DamageError(f"the JSON of a sample cannot be read ({str(error)[:200]})") from error


def _row_of_json(content: Any) -> Row:
    if not isinstance(content, dict):
        raise ValueError("expected an object")
    missing = [column.name for column in _JSON_COLUMNS if column.since == FIRST and column.name not in content]
    if missing:
        raise ValueError(f"row {_key_of(content)}: {missing[0]} is missing")
    row = {
        column.name: content.get(column.name, column.empty) if column.in_json else column.empty for column in COLUMNS
    }
    try:
        check_row(row)
    except ValueError as error:
        raise ValueError(f"row {_key_of(content)}: {error}") from None
    return _completed(row)
