"""Compose a validated `Config` from option files and overrides, with Hydra's Compose API.

Importing this module registers the schema in Hydra's ConfigStore, so that Hydra's own ``compose`` works on ``conf/``
too. Composing leaves the state of a running Hydra application unchanged.

Design: ``docs/design/composition_and_sweeps.md``.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from unprocess_gen.config.composition_errors import explain, unknown_key
from unprocess_gen.config.option_files import OPTIONAL_GROUPS, check_override, conf_dir
from unprocess_gen.config.raw_composition import source_overrides
from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import writable_node
from unprocess_gen.config.validation import validate_config
from unprocess_gen.config.yaml_files import read_yaml_mapping
from unprocess_gen.core.errors import ConfigError

SCHEMA_NAME = "gen_dataset_schema"
"""Name of the schema in Hydra's ConfigStore; first entry of the defaults list in ``conf/config.yaml``."""

ConfigStore.instance().store(name=SCHEMA_NAME, node=writable_node(Config))

VERSION_BASE = "1.3"
"""Version of Hydra whose behaviour is requested."""

PLAIN_ERRORS = (ValueError, TypeError, AttributeError, AssertionError, OSError, RecursionError)
"""Other exceptions that Hydra and OmegaConf raise for wrong overrides and files."""

PATH_KEYS = ("source.root", "source.list", "out")
"""Keys whose values are paths, which are quoted for Hydra's grammar."""


@dataclass(frozen=True, slots=True)
class OptionFolders:
    """The folder with the primary config, its name, and the user's folder, which is searched after it.

    None: `conf_dir`, ``config``, and no folder of the user.
    """

    main: Path | None = None
    name: str | None = None
    own: Path | None = None


def load_config(overrides: Sequence[str] = (), config_dir: str | os.PathLike[str] | None = None) -> Config:
    r"""Compose and validate the config of one dataset.

    Works inside a running Hydra application and without one; the application's own config is left unchanged.

    Parameters
    ----------
    overrides : sequence of str
        Hydra overrides, as on the command line: ``["camera=sony_a7r", "noise.draws=2"]``. Values of ``source.root``
        and ``out`` may contain any character; a literal ``${`` is written ``\${``.
    config_dir : path-like, optional
        Folder of additional option files, as with ``--config-dir``.

    Returns
    -------
    Config
        The resolved config.

    Raises
    ------
    ConfigError
        If an override, an option file or a value is not allowed. The message names key, value and what is allowed.

    Examples
    --------
    >>> import unprocess_gen as ug
    >>> config = ug.load_config(["camera=sony_a7r", "sensor=generic_14bit", "seed=7"])
    >>> config.sensor.bits, config.sensor.white_level_dn
    (14, 16383)
    """
    if isinstance(overrides, str):
        raise ConfigError(f"overrides={overrides!r}: one string; expected a list of strings; write [{overrides!r}]")
    config, _ = composed_config(overrides, OptionFolders(own=None if config_dir is None else Path(config_dir)))
    return config


def composed_config(overrides: Sequence[str], folders: OptionFolders) -> tuple[Config, dict[str, str | None]]:
    """Compose and validate the config of one dataset; return it with the chosen option of each group.

    ConfigError if the overrides or option files describe a sweep.
    """
    for override in overrides:
        check_override(override)
        if override.lstrip("+").startswith(("hydra.", "hydra/")):
            raise ConfigError(f"{override}: settings of Hydra belong to the command line; expected keys of a dataset")
    node = compose_node(overrides, folders)
    if is_multirun(node) or OmegaConf.select(node, "hydra.sweeper.params"):
        raise ConfigError("hydra.sweeper.params: the overrides describe a sweep; expected one config; run gen-dataset")
    choices = dict(node.hydra.runtime.choices)
    return validated_config(node, overrides), choices


def compose_node(overrides: Sequence[str], folders: OptionFolders | None = None) -> DictConfig:
    """Compose overrides, whose paths need no quotes, without validating values; ConfigError if Hydra refuses them.

    The node is unresolved, and has Hydra's own settings in its key ``hydra``.
    """
    folders = folders or OptionFolders()
    if folders.own is not None and not folders.own.is_dir():
        raise ConfigError(f"--config-dir {folders.own}: no such folder; expected a folder of option files")
    name, main, second = folders.name or "config", folders.main or conf_dir(), folders.own
    if folders.name is not None and second is not None and (second / f"{name}.yaml").is_file():
        main, second = second, main  # Hydra looks for the primary config in the first folder only
    given = [*map(hydra_override, overrides)]
    if second is not None:
        given.append(quoted("hydra.searchpath", f"file://{second.absolute()}", "[{}]"))
    _check_own_options(overrides, folders)
    try:
        node = _compose(main, name, given)
        added = source_overrides(node, overrides)
        return _compose(main, name, [*given, *added]) if added else node
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(explain(error, overrides)) from error


def _compose(main: Path, name: str, overrides: list[str]) -> DictConfig:
    """Compose overrides that Hydra can parse; HydraException for whatever Hydra raises about them."""
    with _hydra_in(main.absolute()):
        try:
            return hydra.compose(name, overrides, return_hydra_config=True)
        except PLAIN_ERRORS as error:
            raise HydraException(str(error)) from error


def validated_config(node: DictConfig, overrides: Sequence[str]) -> Config:
    """Resolve and validate a composed config; messages quote the ``overrides`` that it was composed from.

    ConfigError if a key is not in the schema, an interpolation fails or a value is out of range.
    """
    with open_dict(node):
        node.pop("hydra", None)
    config = typed_config(node, overrides)
    validate_config(config)
    return config


def typed_config(node: DictConfig, overrides: Sequence[str]) -> Config:
    """Resolve a composed config without checking its values."""
    for key in _unknown_keys(node, Config()):
        raise ConfigError(unknown_key(key, overrides))
    try:
        config = OmegaConf.to_object(node)
    except (OmegaConfBaseException, RecursionError) as error:
        raise ConfigError(explain(error, overrides)) from error
    assert isinstance(config, Config)
    return config


def is_multirun(node: DictConfig) -> bool:
    """True if option files request a sweep."""
    mode = resolved_value(node, "hydra.mode")
    return str(getattr(mode, "name", mode)) == "MULTIRUN"


def resolved_value(node: DictConfig, key: str, overrides: Sequence[str] = ()) -> Any:
    """Return one value of a composed config, with its interpolations resolved; None if the key does not exist."""
    try:
        return OmegaConf.select(node, key)
    except OmegaConfBaseException as error:
        raise ConfigError(explain(error, overrides)) from error


def hydra_override(override: str) -> str:
    """Return an override as Hydra takes it: with a quoted path, and without ``null`` as the option of a group."""
    group, _, option = override.partition("=")
    return f"~{group}" if group in OPTIONAL_GROUPS and option == "null" else quoted_path(override)


def quoted_path(override: str) -> str:
    """Quote the value of a path, and expand ``~``, unless it is empty, null or quoted."""
    key, _, path = override.partition("=")
    if key not in PATH_KEYS or path in ("", "null") or path[0] in "'\"":
        return override
    return quoted(key, os.path.expanduser(path))


def quoted(key: str, path: str, form: str = "{}") -> str:
    r"""Return an override whose value is quoted for Hydra's grammar.

    An unquoted path with an umlaut, an apostrophe or a bracket is not a word of that grammar. Interpolations stay
    active; ``\${`` is a literal ``${``.
    """
    path = re.sub(r"(\\*)'", r"\1\1\\'", path)
    path = re.sub(r"(\\+)$", r"\1\1", path)
    value = form.format(f"'{path}'")
    return f"{key}={value}"


def _check_own_options(overrides: Sequence[str], folders: OptionFolders) -> None:
    """Refuse chosen option files of the user that Hydra would not use, or could not read safely.

    Hydra uses a built-in option of the same name, and OmegaConf has no limits on nesting and aliases.
    """
    chosen = {override: override.lstrip("+").replace("=", "/", 1) for override in overrides}
    if folders.name is not None:
        chosen[f"--config-name {folders.name}"] = folders.name
    for text, name in chosen.items() if folders.own is not None else ():
        file = Path(folders.own or "", f"{name}.yaml")
        if not file.is_file():
            continue
        if (folders.main or conf_dir()).joinpath(f"{name}.yaml").is_file():
            problem = "has the name of a built-in file, which would be used instead"
            raise ConfigError(f"{text}: {file} {problem}; rename the file")
        read_yaml_mapping(file)


def _unknown_keys(node: Any, schema: Any, prefix: str = "") -> Iterator[str]:
    """Yield the keys that a ``+`` override added to the config and the schema lacks."""
    for key in map(str, node):
        value = getattr(schema, key, None)
        if not hasattr(schema, key):
            yield prefix + key
        elif is_dataclass(value):
            yield from _unknown_keys(node[key], value, f"{prefix}{key}.")


_LOCK = threading.RLock()


@contextmanager
def _hydra_in(main: Path) -> Iterator[None]:
    """Initialise Hydra's Compose API; afterwards restore the state of the application that runs, if any."""
    with _LOCK:
        application, version = GlobalHydra.instance(), VersionBase.instance()
        state, base = application.hydra, version.version_base
        job_name = JobRuntime.instance().get("name")
        application.clear()
        try:
            with hydra.initialize_config_dir(str(main), job_name=job_name, version_base=VERSION_BASE):
                yield
        finally:
            application.hydra, version.version_base = state, base
            GlobalHydra.set_instance(application)
