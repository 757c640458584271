"""Describe settings: `key` declares a field of the schema, `settings_of` and `all_settings` return what it declared.

The field's metadata has the description. Its words are those of the plan's field, or of the docstring of the group
(`documented`). Checks and messages (`validation`), ``--help`` and ``docs/reference/settings.md`` read it.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from unprocess_gen.config.values import GroupLimit
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import Limit
from unprocess_gen.simulation.plan import FIELDS

METADATA = "setting"
"""Key of a field's metadata that holds its `Setting`."""

GroupType = TypeVar("GroupType", bound=type)


@dataclass(slots=True)
class Setting:
    """Describe one key of a config group.

    ``meaning`` is one sentence without a period, from the docstring of the group. ``null`` says what null means, and is
    empty if null is not allowed. ``config.yaml`` omits keys that do not decide data. ``section`` is the part of the
    group that the key belongs to.
    """

    limit: Limit
    meaning: str = ""
    unit: str = ""
    null: str = ""
    decides_data: bool = True
    section: str = ""

    @property
    def allowed(self) -> str:
        """Allowed values in words, as after "expected" in a message."""
        text = str(self.limit)
        return f"{text} or null" if self.null and "null" not in text else text

    @property
    def description(self) -> str:
        """Meaning, unit, allowed values and the meaning of null in one line."""
        unit = f", in {self.unit}" if self.unit else ""
        null = f"; null: {self.null}" if self.null else ""
        return f"{self.meaning}{unit}. Allowed: {self.limit}{null}"

    def check(self, key: str, value: Any, group: Any) -> None:
        """Raise ConfigError unless the setting allows a value, given the other values of its group."""
        if value is None and self.null:
            return
        if isinstance(self.limit, GroupLimit):
            self.limit.check(key, value, group)
        elif not self.limit.allows(value):
            raise ConfigError(f"{key}={self.limit.shown(value)}: expected {self.allowed}")


def key(default: Any, limit: Limit | None = None, section: str = "", of: str = "", **details: Any) -> Any:
    """Field of the schema with its description; ``details`` are other fields of `Setting`.

    A key ``of`` a field of the plan has the field's meaning, unit and allowed values, unless others are given.
    """
    if of:
        field = FIELDS[of]
        limit, details = limit or field.limit, {"meaning": field.meaning, "unit": field.unit, **details}
    assert limit is not None
    return dataclasses.field(default=default, metadata={METADATA: Setting(limit, section=section, **details)})


def settings_of(group: Any) -> Mapping[str, Setting]:
    """Settings of a group by key."""
    return {field.name: field.metadata[METADATA] for field in dataclasses.fields(group) if METADATA in field.metadata}


def groups_in(group: Any) -> dict[str, type[Any]]:
    """Dataclasses of the groups inside of a group, by key."""
    made: Any = ((field.name, field.default_factory) for field in dataclasses.fields(group))
    return {name: kind for name, kind in made if isinstance(kind, type)}


def all_settings(group: Any) -> dict[str, Setting]:
    """Settings of a group and of the groups inside of it, by dotted key: ``raw.pattern``; branches are left out."""
    inner = {name: all_settings(kind) for name, kind in groups_in(group).items()}
    nested = {f"{name}.{key}": setting for name, settings in inner.items() for key, setting in settings.items()}
    return {**settings_of(group), **nested}


def documented(group: GroupType) -> GroupType:
    """Take the meanings of a group's keys from the section Attributes of its docstring.

    Fields that are added to the group have a meaning already. ``python -OO`` removes docstrings.
    """
    section = inspect.cleandoc(group.__doc__ or "").partition("\n\nAttributes\n----------\n")[2]
    meanings = {name: " ".join(text.split()) for name, text in re.findall(r"^(\w+)\n((?: .+\n?)+)", section, re.M)}
    for name, setting in settings_of(group).items():
        setting.meaning = setting.meaning or meanings.get(name, "")
    return group
