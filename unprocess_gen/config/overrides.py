"""Write settings as Hydra overrides: single values, and mappings such as a part of an application's config."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from unprocess_gen.config.composition_errors import explain
from unprocess_gen.config.option_files import ADDED_GROUPS, conf_dir, group_options
from unprocess_gen.config.schema import GROUPS, Config
from unprocess_gen.config.settings import groups_in
from unprocess_gen.config.yaml_files import read_yaml_mapping
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import is_number

PATH_KEYS = ("source.root", "source.list", "noise.dark_frames", "out")
"""Keys whose values are paths, which are quoted for Hydra's grammar."""

WORDS_OF_HYDRA = ("null", "true", "false", "nan", "inf")
"""Words that Hydra's grammar does not read as text."""


def overrides_of_mapping(settings: Mapping[Any, Any], own: Path | None = None) -> list[str]:
    """Overrides for the keys of a mapping or DictConfig, whose interpolations are resolved in its own tree."""
    source = settings.get("source")
    if isinstance(source, Mapping) and source.get("kind") in ("folder", "synthetic"):
        raise ConfigError(
            f"source.kind={source['kind']}: is of the config.yaml of a dataset; expected settings; regenerate it by "
            "gen-dataset again, or give the folder to LivePairs"
        )
    try:
        tree = settings if isinstance(settings, DictConfig) else OmegaConf.create(dict(settings))
        return [*_overrides(tree, Config, "", {}, (conf_dir(), *([] if own is None else [own])))]
    except MissingMandatoryValue as error:
        raise ConfigError(f"{error.full_key}=???: has no value; expected one; set it in the application") from error
    except OmegaConfBaseException as error:
        raise ConfigError(explain(error, ())) from error


def _overrides(
    node: DictConfig, kind: Any, prefix: str, option: Mapping[str, Any], folders: Sequence[Path]
) -> Iterator[str]:
    """Yield an override for each value of a group that differs from those of its option."""
    written: Any = OmegaConf.to_container(node)
    for key in node:
        if not isinstance(key, str):
            raise ConfigError(f"{prefix}{key!r}: the key is no text; expected the name of a setting")
        if key in option and repr(option[key]) == repr(written[key]):
            continue  # an interpolation of an option is resolved in the composed config
        value, name = node[key], f"{prefix}{key}"
        if not isinstance(value, DictConfig) or key not in groups_in(kind):
            yield f"{'+' * (name in ADDED_GROUPS)}{name}={_text(name, value)}"
            continue
        chosen, base = _option_of(key, value, folders) if kind is Config else ((), {})
        yield from chosen
        yield from _overrides(value, groups_in(kind)[key], f"{name}.", base, folders)


def _option_of(group: str, node: DictConfig, folders: Sequence[Path]) -> tuple[list[str], Mapping[str, Any]]:
    """Overrides that choose the option named in a group, and the values of the option.

    A group with another name is an option of the application: its missing keys have the defaults of the schema.
    """
    name = "source" if node.get("levels") == "source" else node.get("name")  # sensor=source has no name
    if name is None:
        return [], {}
    for folder in folders:
        if name in group_options(group, folder):
            values = read_yaml_mapping(folder / group / f"{name}.yaml")
            return [f"{group}={name}"], values.get(group, values)
    schema: Any = OmegaConf.to_container(OmegaConf.structured(GROUPS[group]))
    return [f"{group}.{key}={override_text(value)}" for key, value in schema.items() if key not in node], {}


def _text(key: str, value: Any) -> str:
    """Value of a mapping in Hydra's grammar."""
    if isinstance(value, DictConfig | ListConfig):
        value = OmegaConf.to_container(value, resolve=True, throw_on_missing=True)
    if key in PATH_KEYS and value is not None:
        return str(value).replace("${", r"\${")  # quoted like the path of an override
    return override_text(value)


def override_text(value: Any) -> str:
    """Value in Hydra's grammar of overrides."""
    if isinstance(value, bool) or value is None:
        return {None: "null", True: "true", False: "false"}[value]
    if is_number(value):
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{override_text(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(map(override_text, value)) + "]"
    text = str(value).replace("${", r"\${")
    is_word = re.fullmatch(r"[A-Za-z_]\w*", text, re.ASCII) and text.lower() not in WORDS_OF_HYDRA
    return text if is_word else quoted(text)


def quoted(path: str) -> str:
    r"""Quote a path for Hydra's grammar, in which an umlaut, an apostrophe or a bracket is not part of a word.

    Interpolations stay active; ``\${`` is a literal ``${``.
    """
    path = re.sub(r"(\\*)'", r"\1\1\\'", path)
    path = re.sub(r"(\\+)$", r"\1\1", path)
    return f"'{path}'"
