"""Read tables that people write."""

from __future__ import annotations

import csv


def delimiter_of(line: str, column: str) -> str | None:
    """Delimiter with which a line is a header that has a column: comma, semicolon or tab; None if it is no header."""
    headers = ((delimiter, next(csv.reader([line], delimiter=delimiter), [])) for delimiter in ",;\t")
    return next((delimiter for delimiter, names in headers if column in names), None)
