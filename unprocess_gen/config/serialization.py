"""Write the configuration of a dataset to ``config.yaml``, read it back and compare two of them.

`dataset_yaml` decides bytes: its text is part of every dataset and of its fingerprint.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import yaml

from unprocess_gen.config.interpretation import canonical_burst, canonical_patch
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import GROUPS, Config
from unprocess_gen.config.settings import groups_in, settings_of
from unprocess_gen.config.validation import check_values
from unprocess_gen.config.values import error_in_one_line, one_of, refusal
from unprocess_gen.config.yaml_files import flat, parse_yaml_mapping, read_yaml_mapping, read_yaml_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import is_number, value_text
from unprocess_gen.core.paths import AnyPath

if TYPE_CHECKING:
    from omegaconf import DictConfig


def data_keys(group: Any) -> tuple[str, ...]:
    """Keys of a dataclass of the schema that decide the bytes of a dataset; ``config.yaml`` omits the others."""
    settings, inner = settings_of(group), groups_in(group)
    names = (field.name for field in dataclasses.fields(group))
    return tuple(name for name in names if (data_keys(inner[name]) if name in inner else settings[name].decides_data))


TYPE_NAMES = {"array": "list", "object": "mapping", "Number out of range": "float"}
"""Names of types in messages, by those of msgspec."""

ADDED: dict[str, Any] = {"source.exclude": [], "source.primaries": None, "source.burst": None, "scene.ev": 0.0}
"""Keys that format 1 had not from its start, with the value that is meant where one is missing."""
WRITTEN_IF_SET = (("source", "primaries"), ("source", "burst"), ("scene", "ev"))
"""Keys of `ADDED` that ``config.yaml`` has only with another value, so that the bytes of other datasets stay."""

SOURCE_KINDS = {"folder": "srgb", "synthetic": "srgb", "raw": "raw", "linear": "linear", "synthetic_linear": "linear"}
"""Kinds of sources that ``config.yaml`` records, with the value of ``source.kind``."""


def source_kind(config: Config) -> str:
    """Kind of source that ``config.yaml`` records."""
    names = {"raw": ("raw", "raw"), "linear": ("linear", "synthetic_linear"), "srgb": ("folder", "synthetic")}
    return names[config.source.kind][config.source.place is None]


def dataset_yaml(config: Config) -> str:
    """Text of ``config.yaml``: all keys that decide the bytes of a dataset, in one spelling."""
    settings = recorded(config)
    source = config.source
    settings["source"] |= {
        "kind": source_kind(config), "patch": canonical_patch(source), "burst": canonical_burst(source),
    }  # fmt: skip
    for group, name in WRITTEN_IF_SET:
        if settings[group][name] == ADDED[f"{group}.{name}"]:
            del settings[group][name]
    return yaml.safe_dump({"seed": settings.pop("seed"), **settings}, sort_keys=False, allow_unicode=True, width=120)


def recorded(value: Any, is_float: bool = False) -> Any:
    """Value of a config as ``config.yaml`` has it: mappings, lists, and numbers of one type.

    Floats are written as floats (``is_float``), because users may write 1 or 1.0.
    """
    if isinstance(value, list | tuple):
        return [recorded(item, is_float) for item in value]
    if isinstance(value, dict):
        return {name: recorded(item) for name, item in value.items()}
    if dataclasses.is_dataclass(value):
        numbers = {name for name, setting in settings_of(value).items() if setting.limit.is_float}
        return {name: recorded(getattr(value, name), name in numbers) for name in data_keys(value)}
    return float(value) if is_float and is_number(value) else value


def read_dataset_yaml(path: AnyPath) -> tuple[Config, str]:
    """Read the ``config.yaml`` of a dataset: the config, and the kind of its source.

    Keys that do not decide data have their defaults. ConfigError, with the file, unless `check_values` accepts it.
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
    loaded["source"]["kind"] = SOURCE_KINDS[kind]
    try:
        config = msgspec.convert(loaded, Config)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).rstrip("`").partition(" - at `$.")
        steps = (int(step) if step.isdigit() else step for step in re.findall(r"\w+", place))
        value: Any = loaded
        for step in steps:
            value = value[step]
        wanted = problem.removeprefix("Expected `").partition("`")[0].partition(" | ")[0]
        raise refusal(place, value, f"expected a value of type {TYPE_NAMES.get(wanted, wanted)}") from None
    given, known = flat(loaded).keys(), flat(recorded(config)).keys()
    for problem, keys in (("missing", known - given - ADDED.keys()), ("unknown", given - known)):
        if keys:
            raise ConfigError(f"{problem} key {', '.join(sorted(keys))[:200]}")
    return config, str(kind)


def writable_node(group: type[Any]) -> DictConfig:
    """OmegaConf's node of a dataclass, which accepts overrides although the dataclass is frozen."""
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
    here, there = (ADDED | flat(parse_yaml_mapping(text)) for text in (config_yaml, other_yaml))
    return [
        f"{key}={value_text(here.get(key))} (there: {value_text(there.get(key))})"
        for key in sorted(here.keys() | there.keys())
        if here.get(key) != there.get(key)
    ]
