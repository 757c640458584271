"""Write the configuration of a dataset to ``config.yaml``, read it back and compare two of them.

`dataset_yaml` decides bytes: its text is part of every dataset and of its fingerprint.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union, cast, get_args, get_origin, get_type_hints

import yaml

from unprocess_gen.config.interpretation import (
    canonical_patch,
)
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import (
    GROUPS,
    Config,
    all_settings,
)
from unprocess_gen.config.settings import Setting, settings_of
from unprocess_gen.config.validation import check_values
from unprocess_gen.config.values import error_in_one_line, one_of
from unprocess_gen.config.yaml_files import parse_yaml_mapping, read_yaml_mapping, read_yaml_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import is_number, value_text
from unprocess_gen.core.paths import AnyPath

if TYPE_CHECKING:
    from omegaconf import DictConfig


def _keys(chosen: Callable[[Setting], bool]) -> dict[str, tuple[str, ...]]:
    """Return the keys of each group whose settings a condition chooses; groups without such keys are left out."""
    keys: dict[str, tuple[str, ...]] = {}
    for group, name, setting in all_settings():
        if chosen(setting):
            keys[group] = (*keys.get(group, ()), name)
    return keys


NOT_DATA = _keys(lambda setting: not setting.decides_data)
"""Keys that do not decide the bytes of a dataset, by group; ``config.yaml`` omits them."""

NOT_RECORDED = tuple(
    group
    for group, kind in GROUPS.items()
    if {field.name for field in dataclasses.fields(kind)} == set(NOT_DATA.get(group, ()))
)
"""Groups of which no key decides data; ``config.yaml`` omits them."""

_OMITTED = {kind: NOT_DATA.get(group, ()) for group, kind in GROUPS.items()}
_OMITTED[Config] = (*NOT_DATA[""], *NOT_RECORDED)

NUMBER_KEYS = _keys(lambda setting: setting.limit.is_float and setting.decides_data)
"""Keys whose numbers are written as floats, because users may write 1 or 1.0."""


SOURCE_KINDS = ("folder", "synthetic", "raw")


def source_kind(config: Config) -> str:
    """Return the kind of source that ``config.yaml`` records."""
    if config.source.kind == "raw":
        return "raw"
    return "synthetic" if config.source.place is None else "folder"


def dataset_yaml(config: Config) -> str:
    """Return the text of ``config.yaml``: all keys that decide the bytes of a dataset, in one spelling."""
    settings = _canonical_settings(config)
    return yaml.safe_dump({"seed": settings.pop("seed"), **settings}, sort_keys=False, allow_unicode=True, width=120)


def _canonical_settings(config: Config) -> dict[str, Any]:
    """Return the keys that decide the bytes of a dataset, as mappings."""
    settings: dict[str, Any] = recorded(config)
    settings["source"] |= {"kind": source_kind(config), "patch": canonical_patch(config.source)}
    for group, keys in NUMBER_KEYS.items():
        place = functools.reduce(lambda mapping, name: mapping.get(name, {}), group.split("."), settings)
        place |= {key: _canonical(value) for key, value in place.items() if key in keys}
    return settings


def recorded(group: Any) -> Any:
    """Return a dataclass of the schema as mappings, without keys that ``config.yaml`` omits."""
    if isinstance(group, list | tuple):
        return [recorded(item) for item in group]
    if isinstance(group, dict):
        return {name: recorded(value) for name, value in group.items()}
    if not dataclasses.is_dataclass(group) or isinstance(group, type):
        return group
    settings = settings_of(group)
    mapping: dict[str, Any] = {}
    for field in dataclasses.fields(group):
        setting, value = settings.get(field.name), getattr(group, field.name)
        if field.name not in NOT_RECORDED if setting is None else setting.decides_data:
            mapping[field.name] = recorded(value)
    return mapping


def _canonical(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    return float(value) if is_number(value) else value


def read_dataset_yaml(path: AnyPath) -> tuple[Config, str]:
    """Read the ``config.yaml`` of a dataset: the config, and the kind of its source.

    Keys of `NOT_DATA` have their defaults. ConfigError, with the file, unless `check_values` accepts the config.
    """
    try:
        config, kind = parse_dataset_yaml(read_yaml_text(path))
        check_values(config)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; expected the config.yaml of a dataset") from None
    except (OSError, ValueError, ConfigError) as error:
        raise ConfigError(f"{path}: not the config.yaml of a dataset ({error_in_one_line(error)})") from error
    return config, kind


def parse_dataset_yaml(text: str) -> tuple[Config, str]:
    """Parse the text of a ``config.yaml``; check keys and types, not ranges.

    Strings are taken literally: ``${…}`` is no interpolation here.
    """
    loaded = parse_yaml_mapping(text)
    if not isinstance(loaded.get("source"), dict) or "kind" not in loaded["source"]:
        raise ConfigError("missing key source.kind")
    kind = loaded["source"].pop("kind")
    one_of("source.kind", kind, SOURCE_KINDS)
    loaded["source"]["kind"] = "raw" if kind == "raw" else "srgb"
    config = _build(Config, loaded, "")
    assert isinstance(config, Config)
    return config, str(kind)


def _build(group: type[Any], loaded: Any, prefix: str) -> Any:
    """Return a dataclass of the schema from a mapping; ``prefix`` is its dotted path, with a dot at the end."""
    if not isinstance(loaded, dict):
        raise ConfigError(f"{prefix[:-1]}={value_text(loaded)[:60]}: expected a mapping")
    omitted = _OMITTED.get(group, ())
    fields = {field.name: field for field in dataclasses.fields(group) if field.name not in omitted}
    missing, unknown = fields.keys() - loaded.keys(), loaded.keys() - fields.keys()
    for problem, keys in (("missing", missing), ("unknown", unknown)):
        if keys:
            raise ConfigError(f"{problem} key {', '.join(prefix + key for key in sorted(keys))[:200]}")
    types = get_type_hints(group)
    return group(**{key: _convert(types[key], value, prefix + key) for key, value in loaded.items()})


def _convert(kind: Any, value: Any, key: str) -> Any:
    """Return a value as the type of its field; ConfigError if the type does not fit."""
    if kind is Any:
        return value
    if get_origin(kind) is Union:
        return None if value is None else _convert(get_args(kind)[0], value, key)
    if dataclasses.is_dataclass(kind):
        return _build(cast(type[Any], kind), value, f"{key}.")
    if get_origin(kind) is tuple:
        if isinstance(value, list):
            return tuple(_convert(get_args(kind)[0], item, f"{key}[{index}]") for index, item in enumerate(value))
    elif kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    elif kind is str and isinstance(value, str | bool | int | float):
        return str(value)  # on and off without quotes are booleans in YAML; a name may be a number
    elif type(value) is kind:
        return value
    name = "list" if get_origin(kind) is tuple else kind.__name__
    raise ConfigError(f"{key}={value_text(value)[:60]}: expected a value of type {name}")


def writable_node(group: type[Any]) -> DictConfig:
    """Return OmegaConf's node of a dataclass, which accepts overrides although the dataclass is frozen."""
    from omegaconf import OmegaConf

    def unlock(node: Any) -> None:
        OmegaConf.set_readonly(node, None)
        for key in node:
            if OmegaConf.is_dict(child := node[key]):
                unlock(child)

    node: DictConfig = OmegaConf.structured(group)
    unlock(node)
    return node


def read_option(group: str, name: str | Path) -> Any:
    """Read an option of ``conf/``, or a file, into the dataclass of its group; missing keys have their defaults.

    ConfigError in one line, with the file, if it is no option of the group.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    path = name if isinstance(name, Path) else conf_dir() / group / f"{name}.yaml"
    loaded = read_yaml_mapping(path)
    try:
        return OmegaConf.to_object(OmegaConf.merge(writable_node(GROUPS[group]), loaded))
    except (OmegaConfBaseException, ValueError) as error:
        raise ConfigError(f"{path}: is no option of {group} ({error_in_one_line(error)})") from error


def differences(config_yaml: str, other_yaml: str) -> list[str]:
    """List the differences between two ``config.yaml`` texts, ``key=value (there: value)``, sorted by key."""
    here, there = _flat(parse_yaml_mapping(config_yaml)), _flat(parse_yaml_mapping(other_yaml))
    return [
        "{}={} (there: {})".format(key, *_shortened(value_text(here.get(key)), value_text(there.get(key))))
        for key in sorted(here.keys() | there.keys())
        if here.get(key) != there.get(key)
    ]


CHARACTERS_SHOWN = 60
"""Characters of a value in a difference; longer values are cut around the first character that differs."""


def _shortened(*values: str) -> Iterator[str]:
    common = sum(1 for _ in itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*values, strict=False)))
    start = max(0, common - CHARACTERS_SHOWN // 3) if max(map(len, values)) > CHARACTERS_SHOWN else 0
    for value in values:
        part = value[start : start + CHARACTERS_SHOWN]
        yield "…" * (start > 0) + part + "…" * (len(value) > start + len(part))


def _flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(settings, dict):
        return {prefix.rstrip("."): settings}
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        flat |= _flat(value, f"{prefix}{key}.")
    return flat
