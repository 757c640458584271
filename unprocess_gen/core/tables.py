"""Read tables that people write."""

from __future__ import annotations

import csv
from collections.abc import Iterable


def column_names(cells: Iterable[str]) -> list[str]:
    """Names of the columns of a header, in small letters."""
    return [cell.strip().lower() for cell in cells]


def delimiter_of(line: str, column: str) -> str | None:
    """Delimiter with which a line is a header that has a column: comma, semicolon or tab; None if it is no header."""
    headers = ((delimiter, next(csv.reader([line], delimiter=delimiter), [])) for delimiter in ",;\t")
    return next((delimiter for delimiter, cells in headers if column in column_names(cells)), None)
