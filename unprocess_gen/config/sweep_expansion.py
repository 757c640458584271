"""Expand a sweep into its jobs: values on the command line, ``hydra.sweeper.params`` in option files, or both.

Design: ``docs/design/composition_and_sweeps.md``.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from unprocess_gen.config.composition import OptionFolders, compose_node, is_multirun, quoted_path, resolved_value
from unprocess_gen.config.composition_errors import explain, several_values
from unprocess_gen.config.option_files import check_override, conf_dir, group_options
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import ConfigError

MAX_JOBS = 100_000
"""Most jobs of one sweep: each takes 0.2 s to compose, so a larger number is a mistake."""

BUILT_IN = "hydra._internal.core_plugins.basic_"
"""Start of the ``_target_`` of Hydra's own sweeper and launcher, which the sweep of this package replaces."""

FIXED_KEYS: dict[str, tuple[Any, ...]] = {
    "run.dir": (".", "outputs/${now:%Y-%m-%d}/${now:%H-%M-%S}"),
    "sweep.dir": ("multirun/${now:%Y-%m-%d}/${now:%H-%M-%S}",),
    "sweep.subdir": ("${hydra.job.num}",),
    "job.chdir": (False, None),
    "job.env_set": ({},),
    "job.env_copy": ([],),
    "callbacks": ({}, None),
}
"""Settings of Hydra that have no effect here, with the accepted values: the values in ``conf/`` and in Hydra."""


@dataclass(frozen=True, slots=True)
class SweepJob:
    """One combination of a sweep.

    ``named`` are the overrides that name its folder: without settings of Hydra, and without the option that described
    the sweep. ``swept`` has the value of each swept key.
    """

    overrides: tuple[str, ...]
    named: tuple[str, ...]
    swept: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Expansion:
    """The composed ``node`` of one config, or the jobs of a sweep.

    The ``jobs`` of a sweep are in order; the value written last changes fastest. If the user's launcher and sweeper
    ``plugins`` run it, into the folder ``out``, its jobs are not known. Then ``described_by`` has the overrides whose
    option files contain swept values, and ``fixed`` those that are equal in all jobs.
    """

    node: DictConfig | None
    jobs: tuple[SweepJob, ...] = ()
    plugins: tuple[str, ...] = ()
    described_by: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    out: str = ""


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
    def sets_hydra(self) -> bool:
        return self.name.startswith(("hydra.", "hydra/"))

    @property
    def adds_group(self) -> bool:
        """True if the override chooses option files that can contain settings of Hydra."""
        return self.key.startswith("+") and "." not in self.key and not hasattr(Config(), self.name)

    def overrides(self) -> list[str]:
        return [f"{self.key}={value}" for value in self.values]


@dataclass(frozen=True, slots=True)
class _Base:
    """Swept values of option files, and the overrides that chose these files."""

    params: list[_Choice]
    origin: tuple[str, ...]


def expand(
    overrides: Sequence[str], folders: OptionFolders, multirun: bool = False, use_plugins: bool = False
) -> Expansion:
    """Decide whether overrides describe one run or a sweep, and list the jobs of a sweep.

    A sweep is requested by ``multirun`` or by ``hydra.mode: MULTIRUN`` in an option file. Its values come from the
    overrides and from ``hydra.sweeper.params``; an override of a key wins over a parameter of the same key. With
    ``use_plugins``, the user's Hydra launcher or sweeper plugin expands the sweep, if the config has one.
    """
    choices = _parse(overrides, folders)
    fixed = [choice.text for choice in choices if not choice.swept]
    added = [choice.overrides() for choice in choices if choice.swept and choice.adds_group]
    bases: dict[tuple[str, ...], _Base] = {}
    plugins: tuple[str, ...] = ()
    out = ""
    for combination in itertools.product(*added):
        try:
            node = compose_node([*fixed, *combination], folders)
        except ConfigError:
            if not multirun:
                raise
            bases[combination] = _Base([], ())  # each job reports the error itself
            continue
        _check_hydra_settings(node)
        if not multirun and not is_multirun(node):
            _refuse_values_without_sweep(choices, node)
            return Expansion(node)
        if use_plugins and not plugins and (plugins := _plugins(node)):
            out = str(resolved_value(node, "out", overrides))
        origin = _described_by(_raw_params(node), choices, [*fixed, *combination], folders)
        bases[combination] = _Base(_params(node, choices, folders), origin)
    if plugins:
        described = tuple(dict.fromkeys(override for base in bases.values() for override in base.origin))
        equal = tuple(override for choice in choices if not choice.swept for override in choice.overrides())
        return Expansion(None, plugins=plugins, described_by=described, fixed=equal, out=out)
    jobs = tuple(itertools.islice(_jobs(choices, bases), MAX_JOBS + 1))
    if len(jobs) > MAX_JOBS:
        raise ConfigError(f"a sweep of more than {MAX_JOBS} jobs; expected fewer values")
    return Expansion(None, jobs)


def _jobs(choices: list[_Choice], bases: Mapping[tuple[str, ...], _Base]) -> Iterator[SweepJob]:
    """Yield each combination of the overrides with each combination of its option files' values."""
    for choice in [*choices, *(param for base in bases.values() for param in base.params)]:
        if choice.swept and not choice.values:
            raise ConfigError(f"{choice.text}: an interval has no list of values; expected choice or range")
    added = [choice.key for choice in choices if choice.swept and choice.adds_group]
    for own in _combinations(choices):
        base = bases[tuple(own[key] for key in added)]
        for params in _combinations(base.params):
            job, both = own | params, [*choices, *base.params]
            named = [job[choice.key] for choice in both if not choice.sets_hydra and job[choice.key] not in base.origin]
            swept = {choice.name: job[choice.key].partition("=")[2] for choice in both if choice.swept}
            yield SweepJob(tuple(job.values()), tuple(named), swept)


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
            key, values = override.get_key_element(), tuple[str, ...]()
            if not override.is_sweep_override():
                values = (override.get_value_element_as_str(),)
            elif override.is_discrete_sweep():  # else an interval, for sweeper plugins only
                values = tuple(itertools.islice(override.sweep_string_iterator(), MAX_JOBS + 1))
            choice = _Choice(key, values, override.is_sweep_override(), text)
            _refuse_repetition(choice, choices.values())
            choices[key] = choice
    except (HydraException, ValueError, RecursionError) as error:
        raise ConfigError(explain(error, overrides)) from error
    return list(choices.values())


def _refuse_repetition(choice: _Choice, earlier: Iterable[_Choice]) -> None:
    """Refuse an added group, or the key of a sweep, that an earlier override sets: its values would be lost."""
    for other in earlier:
        if other.name == choice.name and (choice.adds_group or choice.swept or other.swept):
            advice = "remove the other, or separate the values of a sweep by commas"
            raise ConfigError(f"{choice.text}: {other.text} sets {choice.name} too; expected one of them; {advice}")


def _combinations(choices: Sequence[_Choice]) -> Iterator[dict[str, str]]:
    """Yield one override for each key; the last key changes fastest."""
    for values in itertools.product(*(choice.overrides() for choice in choices)):
        yield dict(zip((choice.key for choice in choices), values, strict=True))


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


def _params(node: DictConfig, choices: Sequence[_Choice], folders: OptionFolders) -> list[_Choice]:
    """Return the swept values of option files, without the keys that the command line sets."""
    given = {choice.name for choice in choices}
    overrides = [f"{key}={_spelling(value)}" for key, value in _raw_params(node).items()]
    for override in overrides:
        check_override(override)
        if override.lstrip("+").startswith("hydra"):
            problem = "a sweep over settings of Hydra is not supported; expected keys of a dataset"
            raise ConfigError(f"hydra.sweeper.params.{override}: {problem}")
    return [choice for choice in _parse(overrides, folders) if choice.name not in given]


def _spelling(value: Any) -> str:
    """Return a YAML value as an override spells it."""
    if isinstance(value, bool):
        return str(value).lower()
    return "null" if value is None else str(value)


def _described_by(
    params: Mapping[str, Any], choices: Sequence[_Choice], overrides: Sequence[str], folders: OptionFolders
) -> tuple[str, ...]:
    """Return the added options that contain the sweep's values: without one of them, its values are missing."""
    if not params:
        return ()
    keys = {choice.key for choice in choices if choice.adds_group}
    sweep_overrides = []
    for override in overrides:
        if override.partition("=")[0] in keys:
            try:
                rest = _raw_params(compose_node([other for other in overrides if other != override], folders))
            except ConfigError:
                rest = {}
            if params.keys() - rest.keys():
                sweep_overrides.append(override)
    return tuple(sweep_overrides)


def _plugins(node: DictConfig) -> tuple[str, ...]:
    """Return the classes of a sweeper or launcher that is not Hydra's own."""
    targets = [resolved_value(node, f"hydra.{key}._target_") for key in ("sweeper", "launcher")]
    return tuple(target for target in targets if target is not None and not str(target).startswith(BUILT_IN))


def _check_hydra_settings(node: DictConfig) -> None:
    """Refuse settings of Hydra that would have no effect."""
    settings: Any = OmegaConf.to_container(node.hydra, resolve=False)
    for key, accepted in FIXED_KEYS.items():
        value = settings
        for name in key.split("."):
            value = value.get(name) if isinstance(value, dict) else None
        if value is not None and value not in accepted:
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
