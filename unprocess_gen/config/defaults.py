"""Read the default option of each group and the default values of settings from ``conf/``."""

from __future__ import annotations

from typing import Any

from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import GROUPS, Config
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.yaml_files import read_yaml_mapping


def default_options() -> dict[str, str | None]:
    """Return the default option of each group that has option files; None if that is no option."""
    entries = read_yaml_mapping(conf_dir() / "config.yaml")["defaults"]
    chosen = {group: option for entry in entries if isinstance(entry, dict) for group, option in entry.items()}
    return {group: option for group, option in chosen.items() if group in GROUPS}


def default_values(group: str) -> dict[str, Any]:
    """Return the default values of a group, or of the top level (``""``), as YAML has them; interpolations are text."""
    schema = GROUPS[group]() if group else Config()
    values = {name: getattr(schema, name) for name in settings_of(schema)}
    written = read_yaml_mapping(conf_dir() / "config.yaml")
    if group:
        written = written.get(group, {})
        option = default_options().get(group)
        if option is not None:
            written = read_yaml_mapping(conf_dir() / group / f"{option}.yaml") | written
    return values | {name: value for name, value in written.items() if name in values}
