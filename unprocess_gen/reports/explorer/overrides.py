"""Write a config as the overrides from which it is composed again."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any

from unprocess_gen.config.composition import compose_node, load_config, typed_config
from unprocess_gen.config.defaults import default_options
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import GROUPS, Config, all_settings
from unprocess_gen.config.serialization import recorded
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import is_number

NAMED_GROUPS = ("camera", "noise", "scene")
"""Groups whose config contains the name of its option."""


def overrides_of(config: Config) -> dict[str, str]:
    """Overrides by key that compose the config of a dataset again, without the place of its sources, or ConfigError."""
    names = {group: getattr(config, group).name for group in NAMED_GROUPS}
    given = {group: name for group, name in names.items() if (conf_dir() / group / f"{name}.yaml").is_file()}
    options = [f"{key}={text}" for key, text in given.items() if key in GROUPS]
    base = typed_config(compose_node(options), options)
    given |= {key: override_text(wanted) for key, wanted in _differing_settings(config, base)}
    given = {key: text for key, text in given.items() if default_options().get(key) != text}
    composition = load_config([f"{key}={text}" for key, text in given.items()])
    if left := [key for key, _ in _differing_settings(config, composition)]:
        raise ConfigError(f"{', '.join(left)}: recorded settings that overrides cannot express; use gen-dataset again")
    return given


def _differing_settings(config: Config, other: Config) -> list[tuple[str, Any]]:
    """The keys that decide data and differ, with their values in a config."""
    differences = []
    for group, name, setting in all_settings():
        owner, others = (operator.attrgetter(group)(side) if group else side for side in (config, other))
        value = getattr(owner, name)
        if setting.decides_data and group not in ("body", "executor") and value != getattr(others, name):
            differences.append((f"{group}.{name}".lstrip("."), recorded(value)))
    return differences


def override_text(value: Any) -> str:
    """A value in Hydra's grammar of overrides."""
    if isinstance(value, bool) or value is None:
        return {None: "null", True: "true", False: "false"}[value]
    if is_number(value):
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{override_text(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(map(override_text, value)) + "]"
    text = str(value)
    simple = text.replace("_", "").isalnum() and not text[0].isdigit() and text not in ("null", "true", "false")
    return text if simple else "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
