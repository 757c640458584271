"""Read tables that people write."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.records import Record, check_record


def column_names(cells: Iterable[str]) -> list[str]:
    """Names of the columns of a header, in small letters."""
    return [cell.strip().lower() for cell in cells]


def delimiter_of(line: str, column: str) -> str | None:
    """Delimiter with which a line is a header that has a column: comma, semicolon or tab; None if it is no header."""
    headers = ((delimiter, next(csv.reader([line], delimiter=delimiter), [])) for delimiter in ",;\t")
    return next((delimiter for delimiter, cells in headers if column in column_names(cells)), None)


def read_table(
    path: Path, required: Collection[str], optional: Collection[str], numbers: Collection[str] = ()
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield for each line of a CSV file its place, for messages, and its cells by column, stripped of blanks.

    ``numbers`` are columns that may have decimal commas between semicolons. ConfigError if the header misses a
    required column, or has a column that is neither required nor optional.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        delimiter = delimiter_of(text.partition("\n")[0], next(iter(required))) or ","
        reader = csv.DictReader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True, strict=True)
        reader.fieldnames = names = column_names(reader.fieldnames or ())
        wrong = [name for name in required if name not in names]
        wrong += [name for name in names if name not in (*required, *optional) or names.count(name) > 1]
        if wrong:
            expected = f"expected {','.join(required)}, any of {','.join(optional)}; or semicolons or tabs for commas"
            raise ConfigError(f"{path}: column {wrong[0]!r} is missing, is unknown, or occurs twice; {expected}")
        rows = [(reader.line_num, row) for row in reader if any(row.values())]
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not text in UTF-8 ({error.reason}); save it as UTF-8") from error
    except csv.Error as error:
        raise ConfigError(f"{path}: cannot be read ({error}); expected a CSV file") from error
    for number, row in rows:
        if any(row.get(None, ())):  # the key of cells beyond the header
            problem = f"has more than {len(names)} cells; expected decimal points, or semicolons between columns"
            raise ConfigError(f"{path}, line {number}: {problem}")
        cells = {name: (value or "").strip() for name, value in row.items() if name}
        if delimiter == ";":  # the spreadsheets that write it also write 0,5 for 0.5
            cells |= {name: text.replace(",", ".") for name, text in cells.items() if name in numbers}
        yield f"{path}, line {number}", cells


def record_of_cells(cells: Mapping[str, Any], kind: type[Record], place: str) -> Record:
    """Convert the cells of a line to a record; empty cells get its defaults. ConfigError names a wrong cell."""
    try:
        return check_record({name: cell for name, cell in cells.items() if cell != ""}, kind, strict=False)
    except ValueError as error:
        name, _, problem = str(error).partition(": ")
        raise ConfigError(f"{place}: {name}={cells.get(name)}: {problem}") from error
