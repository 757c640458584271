"""Compose a validated config from option files and overrides with Hydra's Compose API, or the configs of a sweep.

Importing this module registers the schema in Hydra's ConfigStore, so that Hydra's own ``compose`` works on ``conf/``
too. Composing leaves the state of a running Hydra application unchanged.

Design: ``docs/design/configuration.md``.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.types import RunMode
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from unprocess_gen.config.composition_errors import explain
from unprocess_gen.config.limits import OVERRIDDEN
from unprocess_gen.config.option_files import (
    ADDED_GROUPS,
    OPTIONAL_GROUPS,
    OptionFolders,
    check_override,
    group_options,
)
from unprocess_gen.config.overrides import PATH_KEYS, overrides_of_mapping, quoted
from unprocess_gen.config.schema import CHOSEN, TWO_NUMBERS, Config, NoiseConfig
from unprocess_gen.config.serialization import writable_node
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.source_validation import check_overrides
from unprocess_gen.config.validation import validate_config
from unprocess_gen.config.yaml_files import flat, read_yaml_mapping
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import value_text

SCHEMA_NAME = "gen_dataset_schema"
"""Name of the schema in Hydra's ConfigStore; first entry of the defaults list in ``conf/config.yaml``."""

ConfigStore.instance().store(name=SCHEMA_NAME, node=writable_node(Config))

VERSION_BASE = "1.3"
"""Version of Hydra whose behaviour is requested."""

PLAIN_ERRORS = (ValueError, TypeError, AttributeError, AssertionError, OSError, RecursionError)
"""Other exceptions that Hydra and OmegaConf raise for wrong overrides and files."""

SHORTHANDS = {
    "source.kind=raw": "source=raw", "source.kind=linear": "source=linear", "source.kind=srgb": "source=default",
}  # fmt: skip
"""Overrides that choose an option, because patterns and sensor follow from the kind of the source."""

NO_NUMBERS = ("name", "negative_variance", "assumed", "unsourced", "provenance")
"""Keys of a noise profile that are no numbers, in addition to the keys of the section `CHOSEN`."""

MAX_JOBS = 100_000
"""Most jobs of one sweep: each takes 0.2 s to compose, so a larger number is a mistake."""

NO_EFFECT: dict[str, Any] = {
    "run.dir": "outputs/${now:%Y-%m-%d}/${now:%H-%M-%S}",
    "sweep.dir": "multirun/${now:%Y-%m-%d}/${now:%H-%M-%S}",
    "sweep.subdir": "${hydra.job.num}",
    "job.chdir": None,
    "job.env_set": {},
    "callbacks": {},
}
"""Settings of Hydra that have no effect here, with Hydra's own values; files with others are refused."""


def load_config(
    overrides: Sequence[str] | Mapping[str, Any] = (), config_dir: str | os.PathLike[str] | None = None
) -> Config:
    r"""Compose and validate the config of one dataset.

    Works inside a running Hydra application and without one; the application's own config is left unchanged.

    Parameters
    ----------
    overrides : sequence of str, or mapping
        Hydra overrides, as on the command line: ``["camera=sony_a7r", "noise.draws=2"]``. Values of ``source.root``
        and ``out`` may contain any character; a literal ``${`` is written ``\${``. Or a mapping such as a DictConfig,
        nested or with dotted keys: ``{"camera": "sony_a7r", "noise": {"draws": 2}}``. Text for a group is the name of
        an option; so is ``name`` in a mapping for a group.
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
    if not isinstance(overrides, Mapping | Sequence):
        raise ConfigError(f"overrides={overrides!r:.60}: expected a list of strings, or a mapping")
    folders = OptionFolders(own=None if config_dir is None else Path(config_dir))
    given = overrides_of_mapping(overrides, folders.own) if isinstance(overrides, Mapping) else overrides
    return composed_config(given, folders)[0]


def composed_config(overrides: Sequence[str], folders: OptionFolders) -> tuple[Config, dict[str, str | None]]:
    """Compose the config of one dataset, with the chosen option of each group; ConfigError for a sweep."""
    job = next(compose_jobs(overrides, folders))
    if job.swept is not None:
        raise ConfigError("hydra.sweeper.params: the overrides describe a sweep; expected one config; run gen-dataset")
    choices = dict(job.node.hydra.runtime.choices)
    return job.config(), choices


@dataclass(frozen=True, slots=True)
class Composition:
    """A composed config, whose values are not checked, and the overrides that it is composed from.

    ``files`` are the chosen option files of the user, by group. ``swept`` is the value of each swept key; None without
    a sweep.
    """

    node: DictConfig
    overrides: tuple[str, ...]
    files: Mapping[str, Path]
    swept: Mapping[str, str] | None = None

    def config(self) -> Config:
        """Resolve and validate the config; ConfigError if an interpolation or a value is refused."""
        with _naming(self.swept, self._file):
            config = typed_config(self.node, self.overrides)
            check_overrides(config, self.overrides)
            validate_config(config)
        return config

    def _file(self, message: str) -> str:
        """Name the user's option file that states the refused key, unless an override does."""
        key = message.partition("=")[0].partition(":")[0]
        if not any(text.lstrip("+").startswith(f"{key}=") for text in self.overrides):
            for group, file in self.files.items():
                if flat(read_yaml_mapping(file)).keys() & {key, key.removeprefix(f"{group}.")}:
                    return f"{file}: "
        return ""

    def text(self, shown: str, resolve: bool) -> str:
        """YAML of the settings (``job``), of Hydra's own (``hydra``), or of both (``all``)."""
        keys = {"job": set(self.node) - {"hydra"}, "hydra": {"hydra"}, "all": set(self.node)}[shown]
        try:
            return OmegaConf.to_yaml(OmegaConf.masked_copy(self.node, list(keys)), resolve=resolve).rstrip()
        except OmegaConfBaseException as error:
            raise ConfigError(explain(error, self.overrides)) from error


def compose_jobs(overrides: Sequence[str], folders: OptionFolders, multirun: bool = False) -> Iterator[Composition]:
    """Compose the config that overrides describe, or each job of a sweep; the value written last changes fastest.

    A sweep is requested by ``multirun``, or by ``hydra.mode: MULTIRUN`` in an option file. An override of a key wins
    over a parameter of the same key.
    """
    choices = _parse(overrides, folders)
    node = compose_node([choice.text for choice in choices if not choice.is_swept], folders)
    is_sweep, params = _sweep_settings(node)
    if not (multirun or is_sweep):
        _refuse_values(choices, params)
        yield Composition(_marked(node, overrides, folders), tuple(overrides), _own_files(node, folders))
        return
    given = {choice.name for choice in choices}
    choices += [choice for choice in _parse(list(params.values()), folders) if choice.name not in given]
    if math.prod(len(choice.overrides) for choice in choices) > MAX_JOBS:
        raise ConfigError(f"a sweep of more than {MAX_JOBS} jobs; expected fewer values")
    for job in itertools.product(*(choice.overrides for choice in choices)):
        texts = zip(choices, job, strict=True)
        swept = {choice.name: text.partition("=")[2] for choice, text in texts if choice.is_swept}
        with _naming(swept):
            node = compose_node(job, folders)
            if hidden := _sweep_settings(node)[1].keys() - params.keys():
                problem = "found in an option that the sweep itself selects; expected it in one that all jobs have"
                raise ConfigError(f"hydra.sweeper.params.{min(hidden)}: {problem}")
            node = _marked(node, job, folders)
        yield Composition(node, job, _own_files(node, folders), swept)


def _own_files(node: DictConfig, folders: OptionFolders) -> dict[str, Path]:
    """File of each group whose option is in the user's folder."""
    choices = node.hydra.runtime.choices.items() if folders.own else ()
    files = {group: Path(folders.own or "", group, f"{option}.yaml") for group, option in choices}
    return {group: file for group, file in files.items() if file.is_file()}


@contextmanager
def _naming(swept: Mapping[str, str] | None, file_of: Callable[[str], str] = lambda message: "") -> Iterator[None]:
    """Begin messages with the values that a sweep gives to the job, and the file that states the refused value."""
    try:
        yield
    except ConfigError as error:
        job = f"{','.join(f'{key}={value}' for key, value in swept.items())}: " if swept else ""
        if not (place := job + file_of(str(error))):
            raise
        raise ConfigError(f"{place}{error}") from error


class _Choice(NamedTuple):
    """An override as the user wrote it, and one override for each of its values."""

    text: str
    name: str
    overrides: tuple[str, ...]
    is_swept: bool


def _parse(overrides: Sequence[str], folders: OptionFolders) -> list[_Choice]:
    """Parse overrides with Hydra's grammar; a key that occurs twice has its last value, as in Hydra."""
    for text in overrides:
        check_override(text)
    own = [] if folders.own is None else [folders.own]
    loader: Any = SimpleNamespace(get_group_options=lambda group, *_, **__: group_options(group, *own, folders.main))
    parser = OverridesParser.create(config_loader=loader)  # glob(…) asks for the options of a group
    choices: dict[str, _Choice] = {}
    try:
        for text, override in zip(overrides, parser.parse_overrides(list(map(normalised, overrides))), strict=True):
            key, is_swept = override.get_key_element(), override.is_sweep_override()
            if is_swept and not override.is_discrete_sweep():
                raise ConfigError(f"{text}: an interval has no list of values; expected choice or range")
            values = override.sweep_string_iterator() if is_swept else (override.get_value_element_as_str(),)
            spelled = tuple(f"{key}={value}" for value in itertools.islice(values, MAX_JOBS + 1))
            choice, other = _Choice(text, key.lstrip("+"), spelled, is_swept), choices.get(key.lstrip("+"))
            if other is not None and (key.startswith("+") or is_swept or other.is_swept):
                advice = "remove the other, or separate the values of a sweep by commas"
                problem = f"{other.text} sets {choice.name} too"
                raise ConfigError(f"{text}: {problem}; expected one of them; {advice}")
            choices[choice.name] = choice
    except (HydraException, ValueError, RecursionError) as error:
        raise ConfigError(explain(error, overrides)) from error
    return list(choices.values())


def _sweep_settings(node: DictConfig) -> tuple[bool, dict[str, str]]:
    """Read whether option files request a sweep, and the overrides of ``hydra.sweeper.params`` by key.

    ConfigError for settings of Hydra that would have no effect.
    """
    settings: Any = OmegaConf.to_container(node.hydra)
    for key, own in NO_EFFECT.items():
        if (value := functools.reduce(dict.__getitem__, key.split("."), settings)) != own:
            raise ConfigError(f"hydra.{key}={value_text(value)}: has no effect here; remove it and set out instead")
    try:
        sweeper: Any = OmegaConf.to_container(node.hydra.sweeper, resolve=True)
        mode, params = node.hydra.mode, sweeper["params"] or {}
    except OmegaConfBaseException as error:
        raise ConfigError(f"hydra.sweeper.params: {explain(error, ())}") from error
    return mode == RunMode.MULTIRUN, {str(key): f"{key}={value_text(value)}" for key, value in params.items()}


def _refuse_values(choices: Sequence[_Choice], params: Mapping[str, str]) -> None:
    """Refuse values of a sweep if none is requested."""
    for choice in choices:
        if choice.is_swept:
            key, _, values = choice.text.partition("=")
            as_list = "" if group_options(choice.name) else f"; for a list, write {key}=[{values}]"
            raise ConfigError(
                f"{choice.text}: several values; expected one; to sweep over them, add --multirun{as_list}"
            )
    for key in params:
        problem = "values of a sweep without hydra.mode: MULTIRUN; add it to the file, or -m to the command line"
        raise ConfigError(f"hydra.sweeper.params.{key}: {problem}")


# ---------------------------------------------------------------------------------------------------------------- Hydra


def compose_node(overrides: Sequence[str], folders: OptionFolders | None = None) -> DictConfig:
    """Compose overrides without checking values; ConfigError if Hydra refuses them.

    Interpolations are unresolved, and the key ``hydra`` has Hydra's own settings.
    """
    folders = folders or OptionFolders()
    name, main, second = folders.name or "config", folders.main, folders.own
    if second is not None and not second.is_dir():
        raise ConfigError(f"--config-dir {second}: no such folder; expected a folder of option files")
    if second is not None and folders.name is not None and (second / f"{name}.yaml").is_file():
        main, second = second, main  # Hydra looks for the primary config in the first folder only
    given = [_spelled(normalised(override), overrides) for override in overrides] + _also_in(second)
    _check_own_files(overrides, folders)
    with _hydra_in(main.absolute()):
        try:
            return hydra.compose(name, given, return_hydra_config=True)
        except (HydraException, OmegaConfBaseException, YAMLError, *PLAIN_ERRORS) as error:
            raise ConfigError(explain(error, overrides)) from error


def _also_in(folder: Path | None) -> list[str]:
    """Override with which Hydra looks for option files in another folder too."""
    return [] if folder is None else [f"hydra.searchpath=[{quoted(f'file://{folder.absolute()}')}]"]


def _marked(node: DictConfig, overrides: Sequence[str], folders: OptionFolders) -> DictConfig:
    """Append ``*`` to the name of a noise profile if settings replace a number that its option file states."""
    option = node.hydra.runtime.choices.get("noise")
    if option is None or not (folders.name or any(text.startswith(("noise.", "+")) for text in overrides)):
        return node
    with _hydra_in(folders.main.absolute()):
        stated = hydra.compose(None, [f"+noise={option}", *_also_in(folders.own)]).noise
    profile: Any = OmegaConf.to_container(OmegaConf.merge(writable_node(NoiseConfig), stated))
    used: Any = OmegaConf.to_container(node.noise)
    if used["name"] == profile["name"] and any(used[key] != profile[key] for key in _stated_keys(profile)):
        node.noise.name += OVERRIDDEN
    return node


def _stated_keys(profile: Mapping[str, Any]) -> list[str]:
    """Keys of the numbers of a profile, without those that it leaves to the user (a, b) or takes from the sensor."""
    sections = {key: setting.section for key, setting in settings_of(NoiseConfig).items()}
    left = {key for key, value in profile.items() if value is None and sections[key] == TWO_NUMBERS}
    taken = {key for key, value in profile.items() if isinstance(value, str) and value.startswith("${")}
    return [key for key in profile if sections[key] != CHOSEN and key not in {*NO_NUMBERS, *left, *taken}]


def typed_config(node: DictConfig, overrides: Sequence[str]) -> Config:
    """Resolve a composed config, without the settings of Hydra and without checking values."""
    with open_dict(node):
        node.pop("hydra", None)
    try:
        config = OmegaConf.to_object(node)
    except (OmegaConfBaseException, RecursionError) as error:
        raise ConfigError(explain(error, overrides)) from error
    assert isinstance(config, Config)
    return config


def normalised(override: str) -> str:
    """Quote a path for Hydra's grammar, expand its ``~``, and drop the plus of keys that need none."""
    key, _, value = override.lstrip("+").partition("=")
    if key not in ADDED_GROUPS:
        override = override.lstrip("+")
    if key in PATH_KEYS and value not in ("", "null") and value[0] not in "'\"":
        return f"{key}={quoted(os.path.expanduser(value))}"
    return override


def _spelled(override: str, overrides: Sequence[str]) -> str:
    """Spell an override as Hydra takes it: ``body=null`` removes the body, and the kind of the source is an option."""
    if override.removesuffix("=null") in OPTIONAL_GROUPS:
        return f"~{override.removesuffix('=null')}"
    has_option = any(other.startswith("source=") for other in overrides)
    return override if has_option else SHORTHANDS.get(override, override)


def _check_own_files(overrides: Sequence[str], folders: OptionFolders) -> None:
    """Refuse chosen files of the user that Hydra would not use, or could not read safely.

    Hydra uses a built-in option of the same name, and OmegaConf has no limits on nesting and aliases.
    """
    chosen = {override: override.lstrip("+").replace("=", "/", 1) for override in overrides}
    if folders.name is not None:
        chosen[f"--config-name {folders.name}"] = folders.name
    for text, name in chosen.items() if folders.own is not None else ():
        file, group = Path(folders.own or "", f"{name}.yaml"), name.partition("/")[0]
        parent = Path(folders.own or "").parent
        if (found := parent / f"{name}.yaml").is_file() and found.parent == folders.own:
            raise ConfigError(
                f"{text}: no such option; expected the folder of groups; for {found}, write --config-dir {parent}"
            )
        if not file.is_file():
            continue
        if group in ADDED_GROUPS and not re.search(r"^# *@package +_global_", file.read_text(errors="replace"), re.M):
            raise ConfigError(f"{text}: {file}: expected '# @package _global_' as its first line")
        if (folders.main / f"{name}.yaml").is_file():
            problem = "has the name of a built-in file, which would be used instead"
            raise ConfigError(f"{text}: {file} {problem}; rename the file")
        read_yaml_mapping(file)


_LOCK = threading.RLock()


@contextmanager
def _hydra_in(main: Path) -> Iterator[None]:
    """Initialise Hydra's Compose API; afterwards restore the state of the application that runs, if any."""
    with _LOCK:
        application, version = GlobalHydra.instance(), VersionBase.instance()
        state, base, job_name = application.hydra, version.version_base, JobRuntime.instance().get("name")
        application.hydra = None
        try:
            hydra.initialize_config_dir(str(main), job_name=job_name, version_base=VERSION_BASE)
            yield
        finally:
            application.hydra, version.version_base = state, base
