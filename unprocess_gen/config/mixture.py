"""Read the entries of ``mixture`` as a user writes them: a weight, options by group, and values by key."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from unprocess_gen.config.option_files import check_override
from unprocess_gen.config.schema import ENTRY_GROUPS, Config, MixtureEntry
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.validation import entry_errors
from unprocess_gen.config.values import value_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.suggestions import did_you_mean


class EntrySettings(NamedTuple):
    """Hold an entry: ``{weight: 3, camera: sony_a7r, noise.iso: 3200}``."""

    weight: float
    options: dict[str, str]
    values: dict[str, Any]


def read_entries(mixture: Any) -> Iterator[EntrySettings]:
    """Yield the entries of a mixture; ConfigError names an entry that is no mapping or has other keys."""
    settings_of(Config)["mixture"].check("mixture", mixture)
    for number, entry in enumerate(mixture):
        with entry_errors(number):
            yield _read_entry(entry)


def _read_entry(entry: Any) -> EntrySettings:
    if not isinstance(entry, dict):
        problem = "expected a mapping such as {weight: 3, camera: sony_a7r, noise.iso: 3200}"
        raise ConfigError(f"{value_text(entry)[:80]}: {problem}")
    settings_of(MixtureEntry)["weight"].check("weight", entry.get("weight"))
    options: dict[str, str] = {}
    values: dict[str, Any] = {}
    for key, value in entry.items():
        group, dot, _ = str(key).partition(".")
        if key == "weight":
            continue
        if group not in ENTRY_GROUPS:
            known = ("weight", *ENTRY_GROUPS)
            expected = f"an entry has {', '.join(known)}, and keys of these such as noise.iso"
            raise ConfigError(f"{value_text(key)[:80]}: no such key; {expected}{did_you_mean(group, known)}")
        if not dot and not isinstance(value, dict):
            check_override(f"{group}={value_text(value)}")
            options[group] = value_text(value)
            continue
        written = {key: value} if dot else {f"{group}.{name}": item for name, item in value.items()}
        if twice := written.keys() & values.keys():
            raise ConfigError(f"{min(twice)}: is set twice; expected one value; remove one")
        values |= written
    return EntrySettings(float(entry["weight"]), options, values)
