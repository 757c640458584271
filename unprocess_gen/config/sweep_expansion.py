"""Expand a sweep into its jobs: values on the command line, ``hydra.sweeper.params`` in option files, or both.

Design: ``docs/design/composition_and_sweeps.md``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from unprocess_gen.config.composition import OptionFolders, compose_node, is_multirun, quoted_path
from unprocess_gen.config.composition_errors import explain, several_values
from unprocess_gen.config.option_files import check_override, conf_dir, group_options
from unprocess_gen.core.errors import ConfigError

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


@dataclass(frozen=True, slots=True)
class SweepJob:
    """One combination of a sweep.

    ``named`` are the overrides that name its folder: without settings of Hydra, and without the option of the group
    ``sweep`` that describes it. ``swept`` has the value of each swept key.
    """

    overrides: tuple[str, ...]
    named: tuple[str, ...]
    swept: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class _Choice:
    """One override, with the values that a sweep gives it."""

    key: str
    values: tuple[str, ...]
    swept: bool
    text: str

    @property
    def name(self) -> str:
        return self.key.lstrip("+")

    @property
    def overrides(self) -> list[str]:
        return [f"{self.key}={value}" for value in self.values]


def expand(
    overrides: Sequence[str], folders: OptionFolders, multirun: bool = False
) -> tuple[DictConfig | None, list[SweepJob]]:
    """Compose overrides that describe one config, or list the jobs of a sweep; the other item is None or empty.

    A sweep is requested by ``multirun`` or by ``hydra.mode: MULTIRUN`` in an option file. Its values come from the
    overrides and from ``hydra.sweeper.params``; an override of a key wins over a parameter of the same key. The value
    written last changes fastest.
    """
    choices = _parse(overrides, folders)
    node = compose_node([choice.text for choice in choices if not choice.swept], folders)
    _check_hydra_settings(node)
    if not multirun and not is_multirun(node):
        _refuse_values_without_sweep(choices, node)
        return node, []
    given = {choice.name for choice in choices}
    choices += [choice for choice in _params(node, folders) if choice.name not in given]
    if math.prod(len(choice.values) for choice in choices) > MAX_JOBS:
        raise ConfigError(f"a sweep of more than {MAX_JOBS} jobs; expected fewer values")
    return None, [_job(choices, values) for values in itertools.product(*(choice.overrides for choice in choices))]


def _job(choices: Sequence[_Choice], overrides: tuple[str, ...]) -> SweepJob:
    """Return the job that gives each choice one of its overrides."""
    pairs = list(zip(choices, overrides, strict=True))
    named = [override for choice, override in pairs if not choice.name.startswith("hydra") and choice.name != "sweep"]
    swept = {choice.name: override.partition("=")[2] for choice, override in pairs if choice.swept}
    return SweepJob(overrides, tuple(named), swept)


def composed_job(job: SweepJob, folders: OptionFolders) -> DictConfig:
    """Compose a job; ConfigError if its option files contain swept values that the expansion has not seen."""
    node = compose_node(job.overrides, folders)
    given = {override.partition("=")[0].lstrip("+") for override in job.overrides}
    for key in _raw_params(node):
        if key.lstrip("+") not in given:
            problem = "found in an option that the sweep itself selects"
            expected = "expected it in the primary config or in an option added with +group=option"
            raise ConfigError(f"hydra.sweeper.params.{key}: {problem}; {expected}")
    _check_hydra_settings(node)
    return node


def _parse(overrides: Sequence[str], folders: OptionFolders) -> list[_Choice]:
    """Parse overrides with Hydra's grammar; a key that occurs twice has its last value, as in Hydra."""
    parser = OverridesParser.create(config_loader=_GroupOptions(folders))  # type: ignore[arg-type]
    choices: dict[str, _Choice] = {}
    try:
        parsed = parser.parse_overrides([quoted_path(override) for override in overrides])
        for text, override in zip(overrides, parsed, strict=True):
            key = override.get_key_element()
            if not override.is_sweep_override():
                values: tuple[str, ...] = (override.get_value_element_as_str(),)
            elif override.is_discrete_sweep():
                values = tuple(itertools.islice(override.sweep_string_iterator(), MAX_JOBS + 1))
            else:
                raise ConfigError(f"{text}: an interval has no list of values; expected choice or range")
            choice = _Choice(key, values, override.is_sweep_override(), text)
            _refuse_repetition(choice, list(choices.values()))
            choices[key] = choice
    except (HydraException, ValueError, RecursionError) as error:
        raise ConfigError(explain(error, overrides)) from error
    return list(choices.values())


def _refuse_repetition(choice: _Choice, earlier: Sequence[_Choice]) -> None:
    """Refuse an added group, or the key of a sweep, that an earlier override sets: its values would be lost."""
    for other in earlier:
        if other.name == choice.name and (choice.key.startswith("+") or choice.swept or other.swept):
            advice = "remove the other, or separate the values of a sweep by commas"
            raise ConfigError(f"{choice.text}: {other.text} sets {choice.name} too; expected one of them; {advice}")


def _raw_params(node: DictConfig) -> dict[str, Any]:
    """Return ``hydra.sweeper.params`` with interpolations resolved."""
    try:
        params = OmegaConf.select(node, "hydra.sweeper.params")
        loaded = OmegaConf.to_container(params, resolve=True) if OmegaConf.is_config(params) else params
    except OmegaConfBaseException as error:
        raise ConfigError(f"hydra.sweeper.params: {explain(error, ())}") from error
    if loaded is not None and not isinstance(loaded, dict):
        raise ConfigError(f"hydra.sweeper.params={loaded}: expected a mapping, key: values")
    return {str(key): value for key, value in (loaded or {}).items()}


def _params(node: DictConfig, folders: OptionFolders) -> list[_Choice]:
    """Return the swept values of option files."""
    overrides = [f"{key}={_spelling(value)}" for key, value in _raw_params(node).items()]
    for override in overrides:
        check_override(override)
        if override.lstrip("+").startswith("hydra"):
            problem = "a sweep over settings of Hydra is not supported; expected keys of a dataset"
            raise ConfigError(f"hydra.sweeper.params.{override}: {problem}")
    return _parse(overrides, folders)


def _spelling(value: Any) -> str:
    """Return a YAML value as an override spells it."""
    if isinstance(value, bool):
        return str(value).lower()
    return "null" if value is None else str(value)


def _check_hydra_settings(node: DictConfig) -> None:
    """Refuse settings of Hydra that would have no effect."""
    settings: Any = OmegaConf.to_container(node.hydra, resolve=False)
    for key, accepted in NO_EFFECT.items():
        value = settings
        for name in key.split("."):
            value = value[name]
        if value != accepted:
            raise ConfigError(f"hydra.{key}={_spelling(value)}: has no effect here; remove it and set out instead")


def _refuse_values_without_sweep(choices: Sequence[_Choice], node: DictConfig) -> None:
    for choice in choices:
        if choice.swept:
            raise ConfigError(several_values(choice.text, "; to sweep over them, add --multirun"))
    for key in _raw_params(node):
        problem = "values of a sweep without hydra.mode: MULTIRUN; add it to the file, or -m to the command line"
        raise ConfigError(f"hydra.sweeper.params.{key}: {problem}")


class _GroupOptions:
    """Answer ``glob(…)`` of Hydra's override parser with the options of a group, built-in ones and the user's."""

    def __init__(self, folders: OptionFolders) -> None:
        self._folders = [folders.main or conf_dir(), *([folders.own] if folders.own else [])]

    def get_group_options(self, group_name: str, *_: Any, **__: Any) -> list[str]:
        """Return the names of the group's options."""
        return group_options(group_name, *self._folders)
