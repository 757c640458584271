"""Build configs from overrides, much faster than Hydra composes them."""

from __future__ import annotations

import copy
import functools
import re
from dataclasses import replace
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import Container, DictConfig, OmegaConf, open_dict

from unprocess_gen.config.composition import compose_node
from unprocess_gen.config.option_files import ADDED_GROUPS, OPTIONAL_GROUPS, conf_dir
from unprocess_gen.config.schema import GROUPS, Config, replaced
from unprocess_gen.config.serialization import writable_node


@functools.cache
def composed(*overrides: str) -> Config:
    """Return the config of overrides, without validating it.

    Hydra takes 0.15 s per config, this function 1 ms: it reads each option once and then sets single values.
    `test_fixture_settings_builds_what_hydra_composes` compares every option with Hydra's result.
    """
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    options = [one for one in parsed if (conf_dir() / one.key_or_group).is_dir()]
    values = [one for one in parsed if one not in options]
    added = any(one.key_or_group in (*ADDED_GROUPS, *OPTIONAL_GROUPS) for one in options)
    groups = {} if added else {one.key_or_group: _option(one.key_or_group, str(one.value())) for one in options}
    if added or None in groups.values() or not overrides or any(map(_needs_hydra, values)):
        node = copy.deepcopy(_choices(*(str(one.input_line) for one in options)))
        for one in values:
            OmegaConf.update(node, one.key_or_group, one.value())
        return _object(OmegaConf.merge(writable_node(Config), OmegaConf.to_container(node, resolve=True)))
    config = replace(composed(), **groups)
    for one in values:
        config = replaced(config, {one.key_or_group: _typed(one.key_or_group, one.value())})
    return config


def _needs_hydra(override: Override) -> bool:
    has_records = override.key_or_group in ("noise.branches", "noise.provenance")
    return has_records or override.key_or_group.count(".") != 1 or "${" in str(override.value())


def with_branch(config: Config, **numbers: Any) -> Config:
    """Return a config with other numbers in the first branch of its noise profile."""
    first, *others = config.noise.branches
    return replaced(config, {"noise.branches": (replace(first, **numbers), *others)})


def _typed(setting: str, value: Any) -> Any:
    """Return a value with the type that the schema states."""
    group, _, key = setting.partition(".")
    node = copy.deepcopy(_schema(group))
    OmegaConf.update(node, key, value)
    return OmegaConf.to_container(node)[key]


@functools.cache
def _schema(group: str) -> DictConfig:
    return writable_node(GROUPS[group])


@functools.cache
def _choices(*options: str) -> DictConfig:
    """Return what Hydra composes from choices of options; its interpolations are not resolved."""
    node = compose_node(options)
    with open_dict(node):
        del node["hydra"]
    return node


@functools.cache
def _option(group: str, name: str) -> Any:
    """Return a group of the config with one of its options; None if the option refers to other groups."""
    file = conf_dir() / group / f"{name}.yaml"
    if re.search(r"^defaults:|\$\{", file.read_text(encoding="utf-8"), re.MULTILINE):
        return None
    top = OmegaConf.load(conf_dir() / "config.yaml").get(group, {})
    return _object(OmegaConf.merge(writable_node(type(getattr(Config(), group))), OmegaConf.load(file), top))


def _object(node: Container) -> Any:
    return OmegaConf.to_object(node)
