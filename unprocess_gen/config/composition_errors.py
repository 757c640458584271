"""Explain errors of Hydra and OmegaConf in one sentence: key, value and what is allowed."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, InterpolationResolutionError, OmegaConfBaseException

from unprocess_gen.config.option_files import file_hint
from unprocess_gen.config.schema import BranchConfig, Config, ProvenanceConfig
from unprocess_gen.config.settings import all_settings, settings_of
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.suggestions import did_you_mean

ITEMS = {BranchConfig: "noise.branches", ProvenanceConfig: "noise.provenance"}
"""Dataclasses of list items, whose place in the config OmegaConf does not name, with the key of the list."""


def explain(error: BaseException, overrides: Sequence[str]) -> str:
    """Say in one sentence why Hydra or OmegaConf refuses a config, quoting the user's override."""
    for link in _chain(error):
        if isinstance(link, RecursionError):
            return "an override or option file is nested too deeply; expected lists and mappings of a few levels"
        if isinstance(link, MissingConfigException) and link.missing_cfg_file:
            return _missing_file(str(link.missing_cfg_file), sorted(link.options or ()))
        if isinstance(link, OverrideParseException):
            return f"{link.override}: not a valid override ({error_in_one_line(link)})"
        if isinstance(link, OmegaConfBaseException) and link.full_key:
            if isinstance(link, ConfigAttributeError | ConfigKeyError) and is_dataclass(link.object_type):
                return _unknown_key(link.full_key, link.object_type, overrides)
            return f"{_assignment(link.full_key, link.object_type, overrides)}: {_wrong_value(link, overrides)}"
    for override in overrides:
        if allowed := _allowed(override.partition("=")[0].rpartition(".")[0]):
            return f"{override}: no such key; expected {allowed}"  # OmegaConf takes it for the number of an item
    return error_in_one_line(error)


def _missing_file(file: str, options: Sequence[str]) -> str:
    """Name the options of a group, or the primary config that is missing."""
    group, slash, name = file.rpartition("/")
    if not slash:
        return f"--config-name: no config named '{name}'; expected the name of a YAML file without its suffix"
    hint = file_hint(group, name) or did_you_mean(name, options)
    return f"{group}={name}: no such option; expected one of {', '.join(options)}{hint}"


def _unknown_key(key: str, group: Any, overrides: Sequence[str]) -> str:
    """Name the keys that a group has in place of an unknown one."""
    written = _assignment(key, group, overrides)
    place, _, name = key.rpartition(".")
    names = [field.name for field in fields(group)]
    allowed = "expected one of" if group is Config else f"{ITEMS.get(group, place)} has"
    return f"{written}: no such key; {allowed} {', '.join(names)}{did_you_mean(name, names)}"


def _assignment(key: str, group: Any, overrides: Sequence[str]) -> str:
    """Find ``key=value`` as the user wrote it, or a key below it; the key alone if no override names it."""
    written = [override.lstrip("+") for override in overrides]
    exact = [override for override in written if override.split("=")[0] == key]
    below = [override for override in written if override.startswith(f"{key}.")]
    return f"{ITEMS[group]}: {key}" if group in ITEMS else next(iter(exact + below), key)


def _wrong_value(error: OmegaConfBaseException, overrides: Sequence[str]) -> str:
    """Allowed values of a key, else the message of OmegaConf."""
    key, message = str(error.full_key), str(error.msg or error).splitlines()[0]
    if isinstance(error, InterpolationResolutionError):
        return re.sub(r'^\w+ raised while resolving interpolation: "?(.*?)"?$', r"\1", message)
    if error.object_type in ITEMS:
        return f"expected {settings_of(error.object_type)[key].allowed}"
    written, _, value = _assignment(key, None, overrides).partition("=")
    if written.startswith("source.burst."):  # it is null until a file or another override makes it a mapping
        return f"source.burst is no mapping; write source.burst={{{written.rpartition('.')[2]}: {value}}}"
    if "is not a ListConfig, list or tuple" in message and value and value[0] not in "[{":
        return f"expected a list, such as [{value}]"
    allowed = _allowed(key)
    return f"expected {allowed}" if allowed else message


def _allowed(key: str) -> str:
    """Allowed values of the setting that a key names, or that it is below; empty if there is none."""
    settings = all_settings(Config)
    while key and key not in settings:
        key = re.sub(r"(^|[.\[])[^.\[]*$", "", key)
    return settings[key].allowed if key else ""


def _chain(error: BaseException) -> Iterator[BaseException]:
    """Yield an exception and those that caused it, from the last to the first."""
    link: BaseException | None = error
    while link is not None:
        yield link
        link = link.__cause__ or link.__context__
