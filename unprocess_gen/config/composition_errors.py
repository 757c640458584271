"""Explain errors of Hydra and OmegaConf in one sentence: key, value and what is allowed."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, InterpolationResolutionError, OmegaConfBaseException

from unprocess_gen.config.option_files import ADDED_GROUPS, file_hint, group_options
from unprocess_gen.config.schema import BranchConfig, Config, ProvenanceConfig, all_settings
from unprocess_gen.config.settings import Setting, settings_of
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.suggestions import did_you_mean


def explain(error: BaseException, overrides: Sequence[str]) -> str:
    """Return one sentence about why a config could not be composed.

    Parameters
    ----------
    error : BaseException
        What Hydra or OmegaConf raised.
    overrides : sequence of str
        Overrides as the user wrote them, to quote the one at fault.

    Returns
    -------
    str
        ``key=value: problem; expected …``, or the message of ``error`` on one line.
    """
    for link in _chain(error):
        if isinstance(link, RecursionError):
            return "an override or option file is nested too deeply; expected lists and mappings of a few levels"
        if isinstance(link, MissingConfigException) and link.missing_cfg_file:
            return _missing_file(link)
        if isinstance(link, OverrideParseException):
            return f"{link.override}: not a valid override ({error_in_one_line(link)})"
        key = getattr(link, "full_key", None)
        if isinstance(link, OmegaConfBaseException) and key:
            if link.object_type in ITEMS:
                return _in_item(link.object_type, key)
            if isinstance(link, ConfigAttributeError | ConfigKeyError):
                return unknown_key(key, overrides)
            return f"{assignment(key, overrides)}: {_wrong_value(link, key, overrides)}"
    text = error_in_one_line(error)
    for override in overrides:
        if text.startswith(f"Ambiguous value for argument '{override}'"):
            return several_values(override)
        parent, _, name = override.lstrip("+").partition("=")[0].rpartition(".")
        if (setting := _setting(parent)) is not None:  # OmegaConf takes the name for the number of an item
            return f"{override}: {parent} has no key {name}; expected {parent}=…: {setting.allowed}"
    return text


def several_values(override: str, advice: str = "") -> str:
    """Return the sentence about an override with several values where one is expected.

    Parameters
    ----------
    override : str
        The override as the user wrote it.
    advice : str, optional
        What else to do, where a sweep is possible.

    Returns
    -------
    str
        One sentence; for a key that is no group of options it explains how to write a list.
    """
    key, _, values = override.partition("=")
    as_list = "" if group_options(key.lstrip("+")) else f"; for a list, write {key}=[{values}]"
    return f"{override}: several values; expected one{advice}{as_list}"


def unknown_key(key: str, overrides: Sequence[str]) -> str:
    """Return the sentence about a key that the schema lacks, with the keys it has there."""
    if key in ADDED_GROUPS and assignment(key, overrides) != key:
        return (
            f"{assignment(key, overrides)}: the keys of the file are below '{key}'; expected '# @package _global_' "
            "as its first line"
        )
    path, name = key.split(".")[:-1], key.split(".")[-1]
    node: Any = Config()
    for part in path:
        node = getattr(node, part, None)
    if not is_dataclass(node):
        node, path, name = Config(), [], key.split(".")[0]
    keys = [field.name for field in fields(node)]
    allowed = f"{'.'.join(path)} has {', '.join(keys)}" if path else f"expected one of {', '.join(keys)}"
    return f"{assignment(key, overrides)}: no such key; {allowed}{did_you_mean(name, keys)}"


def unknown_option(group: str, name: str, options: Sequence[str]) -> str:
    """Return the sentence about an option that a group lacks."""
    hint = file_hint(group, name) or did_you_mean(name, options)
    return f"{group}={name}: no such option; expected one of {', '.join(options)}{hint}"


def assignment(key: str, overrides: Sequence[str]) -> str:
    """Return ``key=value`` as the user wrote it, or the key alone if no override names it or a key below it."""
    written = [override.lstrip("+~") for override in overrides]
    exact = (override for override in written if override.split("=")[0] == key)
    below = (override for override in written if override.split("=")[0].startswith(f"{key}."))
    return next((override for matches in (exact, below) for override in matches), key)


def _wrong_value(error: OmegaConfBaseException, key: str, overrides: Sequence[str]) -> str:
    """Expected type of a value that OmegaConf refuses, else its message."""
    message = str(error.msg or error).splitlines()[0]
    if isinstance(error, InterpolationResolutionError):
        return re.sub(r'^\w+ raised while resolving interpolation: "?(.*?)"?$', r"\1", message)
    if "is not a ListConfig, list or tuple" in message:
        value = assignment(key, overrides).partition("=")[2]
        return f"expected a list{f', such as [{value}]' if value and value[0] not in '[{' else ''}"
    setting = _setting(key) or _setting(key.partition("[")[0])
    return message if setting is None else f"expected {setting.allowed}"


def _setting(key: str) -> Setting | None:
    """Return the declaration of a key, such as ``noise.a``; None if it is no setting."""
    return next((setting for group, name, setting in all_settings() if key == f"{group}.{name}".lstrip(".")), None)


ITEMS = {BranchConfig: ("noise.branches", "a branch"), ProvenanceConfig: ("noise.provenance", "an item")}
"""Dataclasses of list items: the key of the list, and what an item is called."""


def _in_item(kind: type, key: str) -> str:
    """Return the sentence about a key of a list's item, whose place in the config OmegaConf does not name."""
    settings, (place, item) = settings_of(kind), ITEMS[kind]
    if key in settings:
        return f"{place}: {key}: expected {settings[key].allowed}"
    return f"{place}: {key}: no such key; {item} has {', '.join(settings)}{did_you_mean(key, list(settings))}"


def _missing_file(error: MissingConfigException) -> str:
    group, slash, name = str(error.missing_cfg_file).rpartition("/")
    if not slash:
        return f"--config-name: no config named '{name}'; expected the name of a YAML file without its suffix"
    return unknown_option(group, name, sorted(error.options or ()))


def _chain(error: BaseException) -> Iterator[BaseException]:
    """Yield an exception and those that caused it, from the last to the first."""
    seen: list[BaseException] = []
    link: BaseException | None = error
    while link is not None and link not in seen:
        seen.append(link)
        yield link
        link = link.__cause__ or link.__context__
