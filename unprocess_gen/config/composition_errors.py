"""Explain errors of Hydra and OmegaConf in one sentence: key, value and what is allowed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from unprocess_gen.config.schema import Config
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
            if isinstance(link, ConfigAttributeError | ConfigKeyError):
                return unknown_key(key, overrides)
            return f"{assignment(key, overrides)}: {str(link.msg or link).splitlines()[0]}"
    text = error_in_one_line(error)
    ambiguous = next((one for one in overrides if text.startswith(f"Ambiguous value for argument '{one}'")), None)
    if ambiguous:
        return several_values(ambiguous)
    return text


def several_values(override: str) -> str:
    """Return the sentence about an override with several values where one is expected."""
    key, _, values = override.partition("=")
    return (
        f"{override}: several values; expected one; to sweep over them, add --multirun; for a list, write "
        f"{key}=[{values}]"
    )


def unknown_key(key: str, overrides: Sequence[str]) -> str:
    """Return the sentence about a key that the schema lacks, with the keys it has there."""
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
    return f"{group}={name}: no such option; expected one of {', '.join(options)}{did_you_mean(name, options)}"


def assignment(key: str, overrides: Sequence[str]) -> str:
    """Return ``key=value`` as the user wrote it, or the key alone if no override names it."""
    return next((one.lstrip("+~") for one in overrides if one.lstrip("+~").split("=")[0] == key), key)


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
