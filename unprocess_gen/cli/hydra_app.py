"""Compose the config of a command line, or the configs of a sweep, and run a task on each.

Configs are composed by `config.composition`. Hydra itself runs only to print (``--cfg``, ``--info``, completion) and to
run a sweep with a launcher or sweeper plugin of the user. Hydra would print several lines for a mistake and exit with
1; therefore it is set to raise, and tasks return their result instead of raising inside it.

Design: ``docs/design/composition_and_sweeps.md``.
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
from unprocess_gen.cli.messages import print_result, report_error
from unprocess_gen.cli.sweep import JobRow, folder_name, overrides_text, worst, write_table
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.suggestions import did_you_mean

if TYPE_CHECKING:
    from unprocess_gen.config.composition import OptionFolders
    from unprocess_gen.config.schema import Config
    from unprocess_gen.config.sweep_expansion import Expansion, SweepJob

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

Task = Callable[["Config", str], tuple[int, Any]]
"""Run on a config and a label, such as ``3/20 camera=sony_a7r`` (empty outside sweeps); returns exit code and result.

The result of a task that generates a dataset is its `Summary`.
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
        """Whether the composed config is printed instead of used."""
        return any(flag in CFG_FLAGS for flag in self.flags)

    @property
    def prints_without_config(self) -> bool:
        """Whether Hydra prints something that needs no valid config: help, completion, information."""
        return any(flag in PRINT_FLAGS for flag in self.flags)

    def folders(self) -> OptionFolders:
        """Return what to compose from."""
        from unprocess_gen.config.composition import OptionFolders

        chosen = {PATH_FLAGS[flag]: value for flag, value in itertools.pairwise(self.flags) if flag in PATH_FLAGS}
        paths = {name: Path(value) for name, value in chosen.items() if name != "name"}
        return OptionFolders(name=chosen.get("name", "config").removesuffix(".yaml"), **paths)


def compose(
    arguments: list[str],
    task: Task,
    sweep_csv: bool = False,
    totals: Callable[[Sequence[Any]], str] | None = None,
) -> int:
    """Compose the config of a command line and run a task on it; for a sweep, on every combination.

    A job of a sweep that fails does not stop the others.

    Parameters
    ----------
    arguments : list of str
        Overrides and Hydra's flags.
    task : callable
        Takes a config and a label; returns an exit code and a result.
    sweep_csv : bool
        Whether a sweep writes ``sweep.csv`` in ``out``.
    totals : callable, optional
        Takes the results of a sweep's jobs; returns the text to print after them.

    Returns
    -------
    int
        The exit code; of a sweep, the worst of its jobs.

    Raises
    ------
    ConfigError
        If the command line or the config of a single run is refused.
    """
    request = parse_arguments(arguments)
    if request.prints_without_config:
        return _print_with_hydra(request.flags, request.overrides)
    if "--resolve" in request.flags and not request.prints_config:
        raise ConfigError("--resolve: expected together with --cfg")
    from unprocess_gen.config.composition import validated_config
    from unprocess_gen.config.sweep_expansion import expand

    use_plugins = sweep_csv and not request.prints_config
    expansion = expand(request.overrides, request.folders(), request.multirun, use_plugins)
    if expansion.node is not None:
        if request.prints_config:
            return _print_with_hydra(request.flags, request.overrides)
        return task(validated_config(expansion.node, request.overrides), "")[0]
    if request.prints_config:
        return worst([_print_with_hydra(request.flags, list(job.overrides)) for job in expansion.jobs])
    if expansion.plugins and use_plugins:
        from unprocess_gen.cli.sweep_plugins import run_with_plugins

        return run_with_plugins(request, expansion, task)
    return _run_sweep(request, expansion, task, sweep_csv, totals)


# ------------------------------------------------------------------------------------------------------------ sweeps


def _run_sweep(
    request: Request,
    expansion: Expansion,
    task: Task,
    sweep_csv: bool,
    totals: Callable[[Sequence[Any]], str] | None,
) -> int:
    """Run every job of a sweep, one after the other, and return the worst exit code."""
    rows: list[JobRow] = []
    results: list[Any] = []
    for place, job in enumerate(expansion.jobs, start=1):
        row, out, result = _run_job(request.folders(), job, task, f"{place}/{len(expansion.jobs)}")
        rows.append(row)
        results += [] if result is None else [result]
        if sweep_csv and out is not None:
            write_table(out, rows)
    if totals is not None and results:
        print_result(totals(results))
    return worst(row.exit for row in rows)


def _run_job(folders: OptionFolders, job: SweepJob, task: Task, place: str) -> tuple[JobRow, Path | None, Any]:
    """Run one job in its own folder below ``out``; any error becomes its exit code.

    Returns its row of ``sweep.csv``, the sweep's ``out`` (None if the config is refused), and the task's result.
    """
    from unprocess_gen.config.composition import compose_node, validated_config
    from unprocess_gen.config.sweep_expansion import check_job

    text = overrides_text(job.named)
    folder = folder_name(text)
    out, result = None, None
    try:
        node = compose_node(job.overrides, folders)
        check_job(node, job)
        config = validated_config(node, job.overrides)
        out = Path(config.out)
        config.out = str(out / folder)
        code, result = task(config, f"{place} {folder}")
    except Exception as error:
        code = report_error(error, f"{folder}: ")
    return JobRow.of(folder, text, job.swept, code, result), out, result


# ---------------------------------------------------------------------------------------------------- printing by Hydra


def _print_with_hydra(flags: Sequence[str], overrides: Sequence[str]) -> int:
    """Let Hydra print what its flags ask for, and return 0."""
    run_hydra(flags, overrides, lambda node: None)
    return 0


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


# --------------------------------------------------------------------------------------------------------- arguments


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
        raise ConfigError(f"{flag} {value}: expected {'a value' if allowed == ANY_VALUE else ', '.join(allowed)}")
    return [flag, value]
