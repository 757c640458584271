"""Parse overrides and Hydra's flags, and run Hydra itself.

Hydra prints several lines for a mistake and exits with 1; `run_hydra` therefore makes it raise.
"""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unprocess_gen.cli.arguments import ANY_VALUE, HYDRA_FLAGS
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.suggestions import did_you_mean

if TYPE_CHECKING:
    from unprocess_gen.config.composition import OptionFolders
    from unprocess_gen.config.schema import Config

SWEEP_FLAGS = ("-m", "--multirun")
RUN_FLAGS = ("-r", "--run")
CFG_FLAGS = ("-c", "--cfg")
PRINT_FLAGS = ("--hydra-help", "-sc", "--shell-completion", "-i", "--info")
PATH_FLAGS = {"-cp": "main", "--config-path": "main", "-cn": "name", "--config-name": "name"} | {
    "-cd": "own",
    "--config-dir": "own",
}
"""Flags that choose option files, and the attribute of `OptionFolders` that they set."""

HYDRA_SETTINGS = (
    "hydra.searchpath",
    "hydra.mode",
    "hydra.sweeper",
    "hydra.launcher",
    "hydra/sweeper",
    "hydra/launcher",
)
"""Settings of Hydra that an override may set."""

Task = Callable[["Config", str], tuple[int, Any, list[str]]]
"""Run on a config and a label, such as ``3/20 camera=sony_a7r`` (empty outside sweeps).

Returns exit code, result and the texts to print. The result of a task that generates a dataset is its `Summary`. The
caller prints, because a stdout that cannot be written is no failure of the job.
"""


@dataclass(frozen=True, slots=True)
class Request:
    """Hold a parsed command line.

    Attributes
    ----------
    flags : list of str
        Hydra's flags with their values, without those of sweeps and runs.
    overrides : list of str
        The overrides as the user wrote them.
    multirun : bool
        Whether ``-m`` was given.
    """

    flags: list[str]
    overrides: list[str]
    multirun: bool

    @property
    def prints_config(self) -> bool:
        """Return whether the composed config is printed instead of used."""
        return any(flag in CFG_FLAGS for flag in self.flags)

    @property
    def prints_without_config(self) -> bool:
        """Return whether Hydra prints something that needs no valid config: help, completion, information."""
        return any(flag in PRINT_FLAGS for flag in self.flags)

    def folders(self) -> OptionFolders:
        """Return what to compose from; ConfigError if a built-in config hides the user's."""
        from unprocess_gen.config.composition import OptionFolders
        from unprocess_gen.config.option_files import conf_dir

        chosen = {PATH_FLAGS[flag]: value for flag, value in itertools.pairwise(self.flags) if flag in PATH_FLAGS}
        own, name = chosen.get("own"), chosen.get("name")
        if (
            own
            and name
            and all(Path(folder, f"{name}.yaml").is_file() for folder in (own, chosen.get("main", conf_dir())))
        ):
            raise ConfigError(
                f"--config-name {name}: {Path(own, name)}.yaml has the name of a built-in config, which would be used "
                "instead; rename the file"
            )
        paths = {name: Path(value) for name, value in chosen.items() if name != "name"}
        return OptionFolders(name=chosen.get("name", "config").removesuffix(".yaml"), **paths)


def parse_arguments(arguments: Sequence[str]) -> Request:
    """Separate Hydra's flags from overrides, which may be mixed in any order.

    Parameters
    ----------
    arguments : sequence of str
        The command line after the verb.

    Returns
    -------
    Request
        Flags and overrides.

    Raises
    ------
    ConfigError
        If an argument is neither, or a flag has a wrong value.
    """
    flags: list[str] = []
    overrides: list[str] = []
    multirun = False
    remaining = iter(arguments)
    for argument in remaining:
        if argument in SWEEP_FLAGS:
            multirun = True
        elif argument in RUN_FLAGS:
            continue
        elif argument.startswith("-"):
            flags += _read_flag(argument, remaining)
        else:
            _check_argument(argument)
            overrides.append(argument)
    return Request(flags, overrides, multirun)


def _check_argument(argument: str) -> None:
    """Refuse what is not an override, and overrides of Hydra's settings that have no effect."""
    from unprocess_gen.config.option_files import check_override

    check_override(argument)
    key = argument.lstrip("+").partition("=")[0]
    if key.startswith("hydra") and not any(key == known or key.startswith(f"{known}.") for known in HYDRA_SETTINGS):
        raise ConfigError(f"{argument}: Hydra's own settings are fixed; expected one of {', '.join(HYDRA_SETTINGS)}")


def _read_flag(argument: str, remaining: Iterator[str]) -> list[str]:
    """Return one of Hydra's flags and its value, which may be the next argument."""
    flag, equals, value = argument.partition("=")
    allowed = next((values for spellings, (values, _) in HYDRA_FLAGS.items() if flag in spellings), None)
    if allowed is None or (equals and not allowed):
        spellings = [one for known in HYDRA_FLAGS for one in known]
        raise ConfigError(f"{argument}: no such flag; see gen-dataset --help{did_you_mean(flag, spellings)}")
    if not allowed:
        return [flag]
    value = value if equals else next(remaining, "")
    if not value or (allowed != ANY_VALUE and value not in allowed):
        written = f"{flag} {value}".rstrip()
        raise ConfigError(f"{written}: expected {'a value' if allowed == ANY_VALUE else ', '.join(allowed)}")
    return [flag, value]


def run_hydra(flags: Sequence[str], overrides: Sequence[str], job: Callable[[Any], Any]) -> None:
    """Run a Hydra application.

    Parameters
    ----------
    flags : sequence of str
        Hydra's flags with their values.
    overrides : sequence of str
        Overrides as the user wrote them.
    job : callable
        Hydra's task function; takes the composed DictConfig.

    Raises
    ------
    ConfigError
        If Hydra refuses an override or an option file.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # documented switch: Hydra raises instead of printing several lines
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    from unprocess_gen.config.composition import VERSION_BASE, quoted_path
    from unprocess_gen.config.composition_errors import explain
    from unprocess_gen.config.option_files import conf_dir

    sys.argv = ["gen-dataset", *flags, *map(quoted_path, overrides)]
    application = hydra.main(version_base=VERSION_BASE, config_path=str(conf_dir()), config_name="config")
    try:
        application(job)()
    except (HydraException, OmegaConfBaseException, YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(explain(error, overrides)) from error
