"""Build manifest rows, convert them to plans, and read and write ``manifest.csv`` and ``KEY.json``.

A row maps each column of `columns.COLUMNS` to a typed value. If a column does not apply, text is empty and a number is
None. Floats are written in Python's shortest round-trip spelling, so a row read back gives the same plan bit for bit.

A manifest has the columns that its settings can fill (`columns.columns_of`). The shards hold each row as JSON too,
without its empty cells.

Format: ``docs/design/dataset_format.md``.
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

import msgspec

from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.columns import (
    ALWAYS,
    CLIPS,
    COLUMNS,
    COLUMNS_OF,
    LEVELS,
    PATCHES,
    Condition,
    RecordType,
)
from unprocess_gen.dataset.dataset_json import check_format
from unprocess_gen.dataset.keys import key_text
from unprocess_gen.dataset.row import Row, Value
from unprocess_gen.simulation.effects import dark_variance_dn2
from unprocess_gen.simulation.frames import Counts, Pair, Patch
from unprocess_gen.simulation.plan import (
    CameraPlan,
    DarkFramePlan,
    IspPlan,
    NoisePlan,
    OutputPlan,
    Physics,
    Place,
    Plan,
    ScenePlan,
    SensorPlan,
    SourcePlan,
)

RowPart = TypeVar("RowPart")

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
    unused = {condition for condition, is_used in _uses(key, source, patch).items() if not is_used}
    values = {
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
    used = {name: value for name, value in values.items() if _COLUMN[name].needs not in unused}
    return _row(source, sha256, shard, plan.seed, {"key": key, **used})


_COLUMN = {column.name: column for column in COLUMNS}


def _uses(key: str, source: Source, patch: Patch) -> dict[Condition, bool]:
    """Return whether the columns of conditions apply to a pair, as its key and its source show."""
    return {LEVELS: "-l" in key, PATCHES: "-p" in key or any(patch.origin), CLIPS: bool(source.clip)}


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
    """Return the values of a plan by column, with those of a physical profile or a dark frame if it has one."""
    cells = _cells(plan)
    for part in PLAN_PARTS:
        if (record := getattr(plan, part)) is not None:
            cells |= _cells(record)
    return cells


def _cells(record: Any) -> dict[str, Value]:
    """Return the values of all columns that hold a record."""
    cells: dict[str, Value] = {}
    defaults = _DEFAULTS[type(record)]
    for field, columns in COLUMNS_OF[type(record)].items():
        value = getattr(record, field)
        if columns[0].needs.by_default and value == defaults[field]:
            continue
        values = value if len(columns) > 1 else (value,)
        cells |= {column.name: column.from_field(item) for column, item in zip(columns, values, strict=True)}
    return cells


PLAN_PARTS: dict[str, Any] = {
    "place": Place, "camera": CameraPlan, "isp": IspPlan, "source": SourcePlan, "sensor": SensorPlan,
    "scene": ScenePlan, "noise": NoisePlan, "physics": Physics, "dark": DarkFramePlan, "output": OutputPlan,
}  # fmt: skip
_OPTIONAL_PARTS = {"physics": "iso", "dark": "dark_frame"}

_DEFAULTS = {
    record: {field.name: field.default for field in msgspec.structs.fields(record)}
    if issubclass(record, msgspec.Struct)
    else {field.name: field.default for field in dataclasses.fields(record)}
    for record in COLUMNS_OF
}
"""Default of each field; `dataclasses.MISSING` or `msgspec.NODEFAULT` for fields without one."""


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
        absent = {name for name, column in _OPTIONAL_PARTS.items() if row.get(column) in (None, "")}
        parts: dict[str, Any] = {
            name: None if name in absent else _part(row, record) for name, record in PLAN_PARTS.items()
        }
        plan = Plan(**_fields(row, Plan), **parts)
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
        return _part({"patch": 0, "patch_y": 0, "patch_x": 0, **without_empty(row)}, Patch)
    except ValueError as error:
        raise DamageError(f"row {_key_of(row)}: not a patch ({error})") from error


def _part(row: Row, record: type[RowPart]) -> RowPart:
    """Return a record from the columns that hold it."""
    return record(**_fields(row, record))


def _fields(row: Row, record: RecordType) -> dict[str, Any]:
    """Return the fields of a record from the columns that hold it; ValueError names the column.

    Cells of columns that depend on settings may be empty: the field keeps its default.
    """
    fields: dict[str, Any] = {}
    for field, columns in COLUMNS_OF[record].items():
        may_be_empty = columns[0].needs is not ALWAYS and _DEFAULTS[record][field] not in (
            dataclasses.MISSING,
            msgspec.NODEFAULT,
        )
        if may_be_empty and all(row.get(column.name) in (None, "") for column in columns):
            continue
        values = tuple(column.to_field(row) for column in columns)
        fields[field] = values if len(values) > 1 else values[0]
    return fields


def _check_plan(plan: Plan) -> None:
    """Raise ValueError for values that are allowed one by one and contradict each other."""
    sensor, physics = plan.sensor, plan.physics
    if not sensor.black_level_dn < sensor.white_level_dn < 2**sensor.bits:
        raise ValueError(
            f"white_level_dn={sensor.white_level_dn}: expected more than black_level_dn={sensor.black_level_dn} "
            f"and less than 2^{sensor.bits} (bits)"
        )
    if physics is not None and not physics.dn_per_e > 0:
        raise ValueError(f"dn_per_e={physics.dn_per_e}: expected more than 0")


def _key_of(row: Row) -> str:
    return str(row.get("key"))[:40]


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


_NEEDED_TO_PLAN = "width", "height", "shard", "dtype", "layout", "pattern"
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


def write_rows(stream: TextIO, rows: Iterable[Row], names: Sequence[str]) -> None:
    r"""Write rows as CSV: ``\n`` line ends, quotes only if needed, empty cells for None.

    Parameters
    ----------
    stream : text file
        Opened with ``newline=""`` and UTF-8.
    rows : iterable of Row
        Rows in source order.
    names : sequence of str
        Names of the columns (`columns.columns_of`).
    """
    stream.write(header_text(names))
    _write_lines(stream, rows, names)


def _write_lines(stream: TextIO, rows: Iterable[Row], names: Sequence[str]) -> None:
    csv.writer(stream, lineterminator="\n").writerows([_cell(row[name]) for name in names] for row in rows)


def rows_text(rows: Iterable[Row], names: Sequence[str]) -> str:
    """Return the lines that `write_rows` writes for some rows, without the header.

    Parameters
    ----------
    rows : iterable of Row
        Rows in source order.
    names : sequence of str
        Names of the columns.

    Returns
    -------
    str
        One line for each row.
    """
    stream = io.StringIO()
    _write_lines(stream, rows, names)
    return stream.getvalue()


def header_text(names: Sequence[str]) -> str:
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


def _cell(value: Value) -> str:
    return "" if value is None else repr(value) if isinstance(value, float) else str(value)


def read_rows(path: AnyPath) -> Iterator[Row]:
    """Read the typed rows of a manifest, one at a time.

    Parameters
    ----------
    path : Path or ObjectPath
        A ``manifest.csv``. Unknown columns are left out; those that it does not have are empty.

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
    """Columns of a manifest, unknown ones included; DamageError if the file is no manifest."""
    with _opened(path) as manifest:
        return manifest.header


def read_row(path: AnyPath, offset: int, columns: Sequence[str] = ()) -> Row:
    """Read one row.

    Parameters
    ----------
    path : Path or ObjectPath
        A ``manifest.csv``.
    offset : int
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
"""Key of a sample's JSON for its other rows: the cells that differ from the first row."""


def row_json(rows: Sequence[Row]) -> bytes:
    """Return the JSON of a sample.

    Parameters
    ----------
    rows : sequence of Row
        Rows of one clean frame, in order.

    Returns
    -------
    bytes
        ASCII, one line: the cells of the first row that are not empty, and in `OTHERS` the cells of each other row that
        differ from it.
    """
    first, *others = rows
    content: dict[str, Any] = without_empty(first)
    if others:
        content[OTHERS] = [{name: row[name] for name in row if row[name] != first[name]} for row in others]
    return json.dumps(content, separators=(",", ":")).encode("ascii") + b"\n"


def without_empty(row: Row) -> dict[str, Value]:
    """Return the cells of a row that are not empty.

    Parameters
    ----------
    row : Row
        A row with all columns.

    Returns
    -------
    dict
        Values by the names of their columns.
    """
    return {name: value for name, value in row.items() if value not in (None, "")}
