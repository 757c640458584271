"""Build configs from overrides, much faster than Hydra composes them."""

from __future__ import annotations

import copy
import functools
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import Container, DictConfig, OmegaConf, open_dict

from unprocess_gen.config.composition import compose_node
from unprocess_gen.config.option_files import ADDED_GROUPS, conf_dir
from unprocess_gen.config.schema import Config


def composed(*overrides: str) -> Config:
    """Return the config of overrides, without validating it.

    Hydra takes 0.15 s per config, this function 1 ms: it reads each option once and then sets single values.
    `test_fixture_settings_builds_what_hydra_composes` compares every option with Hydra's result.
    """
    return copy.deepcopy(_composed(*overrides))  # callers change their config


@functools.cache
def _composed(*overrides: str) -> Config:
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    options = [one for one in parsed if (conf_dir() / one.key_or_group).is_dir()]
    values = [one for one in parsed if one not in options]
    added = any(one.key_or_group in ADDED_GROUPS for one in options)
    groups = {} if added else {one.key_or_group: _option(one.key_or_group, str(one.value())) for one in options}
    if added or None in groups.values() or not overrides or any("." not in one.key_or_group for one in values):
        node = copy.deepcopy(_choices(*(str(one.input_line) for one in options)))
        for one in values:
            OmegaConf.update(node, one.key_or_group, one.value())
        return _object(OmegaConf.merge(OmegaConf.structured(Config), OmegaConf.to_container(node, resolve=True)))
    config = composed()
    for group, option in groups.items():
        setattr(config, group, copy.copy(option))
    for one in values:
        group, _, key = one.key_or_group.partition(".")
        _set(config, group, key, one.value())
    return config


def _set(config: Config, group: str, key: str, value: Any) -> None:
    """Set one value of a group, with the type that the schema states."""
    before = getattr(config, group)
    holds_mapping = isinstance(value, dict) or (isinstance(value, list) and any(isinstance(one, dict) for one in value))
    if "." in key or holds_mapping or "${" in str(value):
        node = OmegaConf.structured(before)
        OmegaConf.update(node, key, value)
        setattr(config, group, _object(node))
    else:  # a node of the complete group would take 50 ms for profiles with long tables
        node = copy.deepcopy(_schema(type(before)))
        OmegaConf.update(node, key, value)
        setattr(before, key, OmegaConf.to_container(node)[key])


@functools.cache
def _schema(group: type) -> DictConfig:
    return OmegaConf.structured(group)


@functools.cache
def _choices(*options: str) -> DictConfig:
    """Return what Hydra composes from choices of options; its interpolations are not resolved."""
    node = compose_node(options)
    with open_dict(node):
        del node["hydra"]
    return node


@functools.cache
def _option(group: str, name: str) -> Any:
    """Return a group of the config with one of its options; None if the option refers to values of other groups."""
    file = conf_dir() / group / f"{name}.yaml"
    if "${" in file.read_text(encoding="utf-8"):
        return None
    return _object(OmegaConf.merge(OmegaConf.structured(getattr(Config(), group)), OmegaConf.load(file)))


def _object(node: Container) -> Any:
    return OmegaConf.to_object(node)
