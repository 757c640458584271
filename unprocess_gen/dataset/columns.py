"""Columns of records: how the fields of records become the cells of a row, and records are rebuilt from cells."""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import msgspec

from unprocess_gen.core.fields import ALWAYS, Condition, Kind, Limit, number_or_text
from unprocess_gen.simulation.plan import PlanRecord, fields_of, part_in

Value = str | int | float | None
Row = Mapping[str, Value]
"""Value by column; where a column does not apply, text is empty and a number is None."""

RecordType = TypeVar("RecordType", bound=PlanRecord)

TYPE_NAMES: Mapping[Any, str] = {int: "integer", float: "number", str: "text", number_or_text: "number or text"}


class Column(NamedTuple):
    """A column of a manifest; what its attributes mean is in `core.fields.Field`."""

    name: str
    meaning: str
    limit: Limit
    unit: str
    empty_if: str
    needs: Condition

    @property
    def type(self) -> Kind:
        """Function that converts the text of a cell: `int`, `float`, `str` or `number_or_text`."""
        return self.limit.kind

    @property
    def empty(self) -> Value:
        """Value of an empty cell, and of a column that a manifest does not have."""
        return "" if self.limit.kind is str else None

    def parse(self, cell: str) -> Value:
        """Value of a cell; ValueError for another type, and for a value that is not allowed."""
        if not cell:
            return self.empty
        try:
            value = self.limit.kind(cell)
        except ValueError:
            raise ValueError(f"{self.name}={cell[:40]!r}: expected {self.limit.in_cells}") from None
        self.check(value)
        return value

    def check(self, value: Value) -> None:
        """Raise ValueError if the column does not allow a value."""
        if not self.limit.allows(value):
            raise ValueError(f"{self.name}={_short(value)}: expected {self.limit.in_cells}")


def _short(value: object) -> str:
    text = value if isinstance(value, str) else repr(value) if isinstance(value, int | float) else type(value).__name__
    return repr(text[:40]) if isinstance(value, str) else text[:40]


class FieldColumns(NamedTuple):
    """A field of a record: its columns, or those of the record in it, whose fields are ``parts``."""

    name: str
    columns: tuple[Column, ...]
    blank: bool = False
    default: Any = msgspec.NODEFAULT
    record: type[PlanRecord] | None = None
    parts: tuple[FieldColumns, ...] = ()

    @property
    def may_be_empty(self) -> bool:
        """True if the default of the field takes the place of empty cells."""
        if self.record is not None:
            return self.default is None
        return self.default is not msgspec.NODEFAULT and (self.blank or self.columns[0].needs is not ALWAYS)


@functools.cache
def places_of(record: type[PlanRecord], needs: Condition = ALWAYS) -> tuple[FieldColumns, ...]:
    """Fields of a record that have columns."""
    given = record.__struct_defaults__  # of the last fields
    defaults: dict[str, Any] = dict.fromkeys(record.__struct_fields__, msgspec.NODEFAULT)
    defaults |= zip(record.__struct_fields__[len(defaults) - len(given) :], given, strict=True)
    places = []
    for name, (kind, declared) in fields_of(record).items():
        part = part_in(kind)
        if part is not None:
            parts = places_of(part, declared or needs)
            columns = tuple(column for place in parts for column in place.columns)
            places.append(FieldColumns(name, columns, default=defaults[name], record=part, parts=parts))
        elif declared is not None:
            names = declared.columns or {name: declared.meaning}
            facts = declared.limit, declared.unit, declared.empty_if, declared.needs or needs
            columns = tuple(Column(column, meaning, *facts) for column, meaning in names.items())
            places.append(FieldColumns(name, columns, declared.blank, defaults[name]))
    return tuple(places)


def flatten(record: PlanRecord, unused: Collection[Condition] = ()) -> dict[str, Value]:
    """Cells of a record and of the records in it that are not empty; ``unused`` conditions have none."""
    return _cells(record, places_of(type(record)), unused)


def _cells(record: PlanRecord, places: Sequence[FieldColumns], unused: Collection[Condition]) -> dict[str, Value]:
    cells: dict[str, Value] = {}
    for place in places:
        value = getattr(record, place.name)
        if value is None or (place.blank and value == place.default):
            continue
        if place.record is not None:
            cells |= _cells(value, place.parts, unused)
        elif place.columns[0].needs not in unused:
            values = value if len(place.columns) > 1 else (value,)
            for column, item in zip(place.columns, values, strict=True):
                cells[column.name] = column.limit.write(item)
    return cells


def rebuild(record: type[RecordType], row: Row) -> RecordType:
    """Record that the cells of a row hold; ValueError names a column that is missing or not allowed."""
    return record(**_fields(places_of(record), row))


def _fields(places: Sequence[FieldColumns], row: Row) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for place in places:
        if place.may_be_empty and all(row.get(column.name) in (None, "") for column in place.columns):
            continue
        if place.record is not None:
            fields[place.name] = place.record(**_fields(place.parts, row))
        else:
            values = tuple(_read(column, row.get(column.name)) for column in place.columns)
            fields[place.name] = values if len(values) > 1 else values[0]
    return fields


def _read(column: Column, value: Value) -> Any:
    if value in (None, ""):
        raise ValueError(f"{column.name} is empty")
    column.check(value)
    return column.limit.read(value)
