"""A manifest row as a mapping from column to value."""

from __future__ import annotations

from collections.abc import Mapping

Value = str | int | float | None
Row = Mapping[str, Value]
