"""Compose the config of a command line, or the configs of a sweep, and run a task on each.

Configs are composed by `config.composition`. Hydra itself runs only to print (``--cfg``, ``--info``, completion) and to
run a sweep with a launcher or sweeper plugin of the user.

Design: ``docs/design/composition_and_sweeps.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unprocess_gen.cli.hydra_request import Request, Task, parse_arguments, run_hydra
from unprocess_gen.cli.messages import print_result, print_results, report_error
from unprocess_gen.cli.signals import SIGNALS
from unprocess_gen.cli.sweep import JobRow, folder_name, overrides_text, sweep_out, worst, write_table
from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from unprocess_gen.config.composition import OptionFolders
    from unprocess_gen.config.sweep_expansion import Expansion, SweepJob


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
        Takes a config and a label; returns an exit code, a result and the texts to print (`Task`).
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
        raise ConfigError("--resolve: --cfg is missing; expected both; add --cfg job")
    from unprocess_gen.config.composition import validated_config
    from unprocess_gen.config.sweep_expansion import expand

    use_plugins = sweep_csv and not request.prints_config
    expansion = expand(request.overrides, request.folders(), request.multirun, use_plugins)
    if expansion.node is not None:
        if request.prints_config:
            return _print_with_hydra(request.flags, request.overrides)
        code, _, texts = task(validated_config(expansion.node, request.overrides), "")
        print_results(texts)
        return code
    if request.prints_config:
        return worst([_print_with_hydra(request.flags, list(job.overrides)) for job in expansion.jobs])
    if expansion.plugins:
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
    """Run every job of a sweep, one after the other, and return the worst exit code.

    A job's row is written before its results are printed, so that an error of stdout ends the sweep without losing it.
    """
    rows: list[JobRow] = []
    results: list[Any] = []
    sweep_folder: Path | None = None
    for place, job in enumerate(expansion.jobs, start=1):
        row, out, result, texts = _run_job(request.folders(), job, task, f"{place}/{len(expansion.jobs)}")
        rows.append(row)
        results += [] if result is None else [result]
        sweep_folder = out or sweep_folder  # a refused job has no out; its row goes where the others are
        if sweep_csv and sweep_folder is not None:
            write_table(sweep_folder, rows)
        print_results(texts)
    if totals is not None and results:
        print_result(totals(results))
    return worst(row.exit for row in rows)


def _run_job(
    folders: OptionFolders, job: SweepJob, task: Task, place: str
) -> tuple[JobRow, Path | None, Any, list[str]]:
    """Run one job in its own folder below ``out``; any error becomes its exit code, unless a signal arrived.

    Returns its row of ``sweep.csv``, the sweep's ``out`` (None if the config is refused), the task's result, and the
    texts to print.
    """
    from unprocess_gen.config.composition import compose_node, validated_config
    from unprocess_gen.config.sweep_expansion import check_job

    text = overrides_text(job.named)
    folder = folder_name(text)
    out, result = None, None
    texts: list[str] = []
    try:
        node = compose_node(job.overrides, folders)
        check_job(node, job)
        config = validated_config(node, job.overrides)
        out = sweep_out(config.out)
        config.out = str(out / folder)
        code, result, texts = task(config, f"{place} {folder}")
    except Exception as error:
        if SIGNALS.received is not None:  # libraries may fail in their own way when they are interrupted
            raise
        code = report_error(error, f"{folder}: ")
    return JobRow.of(folder, text, job.swept, code, result), out, result, texts


# ---------------------------------------------------------------------------------------------------- printing by Hydra


def _print_with_hydra(flags: Sequence[str], overrides: Sequence[str]) -> int:
    """Let Hydra print what its flags ask for, and return 0."""
    run_hydra(flags, overrides, lambda node: None)
    return 0
