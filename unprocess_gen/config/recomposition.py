"""Compose many configs that differ in a few settings, and write a config as overrides.

Hydra needs a quarter of a second for a config. If only values change, merging them into an earlier node takes a tenth.
"""

from __future__ import annotations

import copy
import operator
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf, open_dict

from unprocess_gen.config.composition import (
    OptionFolders,
    compose_node,
    hydra_override,
    is_multirun,
    load_config,
    typed_config,
    validated_config,
)
from unprocess_gen.config.defaults import default_options
from unprocess_gen.config.option_files import check_override, conf_dir
from unprocess_gen.config.schema import GROUPS, Config, all_settings
from unprocess_gen.config.serialization import recorded
from unprocess_gen.config.values import is_number
from unprocess_gen.core.errors import ConfigError

NODES_KEPT = 16
"""Composed nodes that are kept, 1 MB each."""


class Recomposition:
    """Compose configs one after the other from the same folders of options.

    ``choices`` names the options of the last config by group.
    """

    def __init__(self, folders: OptionFolders | None = None) -> None:
        self._folders = folders or OptionFolders()
        self._nodes: dict[tuple[str, ...], DictConfig] = {}
        self.choices: dict[str, str | None] = {}

    @property
    def own_folders(self) -> list[Path]:
        """The user's folder of options, if there is one."""
        return [folder for folder in (self._folders.own, self._folders.main) if folder is not None]

    def config(self, overrides: Sequence[str]) -> Config:
        """Return the config that `load_config` returns; ConfigError with the sentence of `load_config`."""
        values = [override for override in overrides if _is_value(override)]
        try:
            return self._merged(overrides, values)
        except Exception:  # what is wrong is explained by a complete composition
            return self._merged(overrides, [])

    def _merged(self, overrides: Sequence[str], values: Sequence[str]) -> Config:
        """Compose the other overrides, unless their node is kept, and merge values into it."""
        node = copy.deepcopy(self._node(tuple(override for override in overrides if override not in values)))
        for value in map(OverridesParser.create().parse_override, map(hydra_override, values)):
            OmegaConf.update(node, value.key_or_group, value.value(), merge=True)
        choices = dict(node.hydra.runtime.choices)
        config = validated_config(node, overrides)
        self.choices = choices
        return config

    def _node(self, options: tuple[str, ...]) -> DictConfig:
        if options not in self._nodes:
            for override in options:
                check_override(override)
            node = compose_node(options, self._folders)
            if is_multirun(node) or OmegaConf.select(node, "hydra.sweeper.params"):
                raise ConfigError("hydra.sweeper.params: the settings describe a sweep; expected one config")
            if len(self._nodes) >= NODES_KEPT:
                del self._nodes[next(iter(self._nodes))]
            self._nodes[options] = node
        return self._nodes[options]


def _is_value(override: str) -> bool:
    """True if an override sets one value of a config, and chooses no option."""
    key, equals, _ = override.partition("=")
    group, dot, _ = key.partition(".")
    return bool(equals) and (group in GROUPS if dot else key in Config.__dataclass_fields__ and key not in GROUPS)


NAMED_GROUPS = ("camera", "noise", "scene")
"""Groups whose config contains the name of its option."""


def overrides_of(config: Config) -> dict[str, str]:
    """Return overrides by key from which a config of a dataset is composed again, without the place of its sources.

    ConfigError if there are none.
    """
    names = {group: getattr(config, group).name for group in NAMED_GROUPS}
    given = {group: name for group, name in names.items() if (conf_dir() / group / f"{name}.yaml").is_file()}
    options = [f"{key}={text}" for key, text in given.items() if key in GROUPS]
    node = compose_node(options)
    with open_dict(node):
        node.pop("hydra")
    base = typed_config(node, options)
    given |= {key: override_text(wanted) for key, wanted in _differing_settings(config, base)}
    given = {key: text for key, text in given.items() if default_options().get(key) != text}
    composition = load_config([f"{key}={text}" for key, text in given.items()])
    if left := [key for key, _ in _differing_settings(config, composition)]:
        raise ConfigError(f"{', '.join(left)}: recorded settings that overrides cannot express; run gen-dataset again")
    return given


def _differing_settings(config: Config, other: Config) -> list[tuple[str, Any]]:
    """Return the keys that decide data and differ, with their values in a config."""
    differences = []
    for group, name, setting in all_settings():
        owner, others = (operator.attrgetter(group)(side) if group else side for side in (config, other))
        value = getattr(owner, name)
        if setting.decides_data and group not in ("body", "executor") and value != getattr(others, name):
            differences.append((f"{group}.{name}".lstrip("."), recorded(value)))
    return differences


def override_text(value: Any) -> str:
    """Return a value in Hydra's grammar of overrides."""
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
