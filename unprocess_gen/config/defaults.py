"""Read the default option of each group and the default values of settings from ``conf/``."""

from __future__ import annotations

import operator
from functools import cache
from typing import Any

from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import GROUPS, Config
from unprocess_gen.config.settings import all_settings, settings_of
from unprocess_gen.config.yaml_files import flat, read_yaml_mapping


def default_options() -> dict[str, str | None]:
    """Default option of each group that has option files; None if that is no option."""
    entries = _read("config")["defaults"]
    chosen = {group: option for entry in entries if isinstance(entry, dict) for group, option in entry.items()}
    return {group: option for group, option in chosen.items() if group in GROUPS}


def default_values(group: str) -> dict[str, Any]:
    """Default values of a group, or of the top level (``""``), by key as YAML has them; interpolations are text."""
    schema = GROUPS[group]() if group else Config()
    written, settings = flat(_written(group)), all_settings(schema) if group else settings_of(schema)
    return {key: written.get(key, operator.attrgetter(key)(schema)) for key in settings}


def _written(group: str) -> dict[str, Any]:
    """Read what the primary config and the default option of a group set."""
    written = _read("config")
    option = default_options().get(group)
    if group:
        written = written.get(group, {})
    return written if option is None else _read(f"{group}/{option}") | written


@cache
def _read(option: str) -> dict[str, Any]:
    """Read a file of ``conf/`` once; callers leave the mapping as it is."""
    return read_yaml_mapping(conf_dir() / f"{option}.yaml")
