"""Compose the config of a command line, or the configs of a sweep, and run a task on each.

Configs are composed by `config.composition`. Hydra itself runs only to print (``--cfg``, ``--info``, completion) and to
run a sweep with a launcher or sweeper plugin of the user.

Design: ``docs/design/composition_and_sweeps.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.jobs import JobResult, Task, run_hydra, run_job
from unprocess_gen.cli.messages import print_result, print_results
from unprocess_gen.cli.sweep import worst, write_table
from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from unprocess_gen.config.composition import OptionFolders
    from unprocess_gen.config.sweep_expansion import SweepJob

PRINTING = {"--hydra-help", "--shell-completion", "--info"}
"""Flags with which Hydra prints something that is independent of the config."""

HYDRA_SETTINGS = (
    *("hydra.searchpath", "hydra.mode", "hydra.sweeper", "hydra.launcher"),
    *("hydra/sweeper", "hydra/launcher"),
)
"""Settings of Hydra that an override may set."""


def compose(
    call: Call, task: Task, sweep_csv: bool = False, totals: Callable[[Sequence[Any]], str] | None = None
) -> int:
    """Run a task on the config of a command line, or on each config of a sweep; return the worst exit code.

    A job of a sweep that fails does not stop the others. With ``sweep_csv``, a sweep writes ``sweep.csv`` in ``out``.
    ``totals`` returns the text to print after a sweep, from the results of its jobs.
    """
    check_overrides(call.overrides)
    if PRINTING & call.hydra.keys():
        return run_hydra(call, call.overrides)
    prints_config = "--cfg" in call.hydra
    if "--resolve" in call.hydra and not prints_config:
        raise ConfigError("--resolve: --cfg is missing; expected both; add --cfg job")
    from unprocess_gen.config.composition import validated_config
    from unprocess_gen.config.sweep_expansion import expand

    folders = option_folders(call.hydra)
    expansion = expand(call.overrides, folders, "--multirun" in call.hydra, sweep_csv and not prints_config)
    if prints_config:
        jobs = [call.overrides] if expansion.node is not None else [job.overrides for job in expansion.jobs]
        return worst(run_hydra(call, overrides) for overrides in jobs)
    if expansion.node is not None:
        code, _, texts = task(validated_config(expansion.node, call.overrides), "")
        print_results(texts)
        return code
    if expansion.plugins:
        from unprocess_gen.cli.sweep_plugins import run_with_plugins

        return run_with_plugins(call, expansion, task)
    return run_sweep(folders, expansion.jobs, task, sweep_csv, totals)


def check_overrides(overrides: Sequence[str]) -> None:
    """Refuse what is not an override, and overrides of Hydra's settings that have no effect."""
    from unprocess_gen.config.option_files import check_override

    for override in overrides:
        check_override(override)
        key = override.lstrip("+").partition("=")[0]
        if key.startswith("hydra") and not any(key == known or key.startswith(f"{known}.") for known in HYDRA_SETTINGS):
            raise ConfigError(
                f"{override}: Hydra's own settings are fixed; expected one of {', '.join(HYDRA_SETTINGS)}"
            )


def option_folders(hydra: Mapping[str, Any]) -> OptionFolders:
    """Return the folders and the primary config that flags choose."""
    from unprocess_gen.config.composition import OptionFolders

    own, main = (Path(hydra[flag]) if flag in hydra else None for flag in ("--config-dir", "--config-path"))
    name = hydra.get("--config-name")
    return OptionFolders(main, None if name is None else name.removesuffix(".yaml"), own)


# ------------------------------------------------------------------------------------------------------------ sweeps


def run_sweep(
    folders: OptionFolders,
    jobs: Sequence[SweepJob],
    task: Task,
    sweep_csv: bool,
    totals: Callable[[Sequence[Any]], str] | None = None,
) -> int:
    """Run every job of a sweep, one after the other, and return the worst exit code.

    A job's row is written before its results are printed, so that an error of stdout ends the sweep without losing it.
    """
    from unprocess_gen.config.sweep_expansion import composed_job

    done: list[JobResult] = []
    for number, job in enumerate(jobs, start=1):
        done.append(run_job(job, task, f"{number}/{len(jobs)}", partial(composed_job, job, folders)))
        # a refused job has no out; its row goes where the others are
        sweep_folder = next((result.out for result in reversed(done) if result.out is not None), None)
        if sweep_csv and sweep_folder is not None:
            write_table(sweep_folder, [result.row for result in done])
        print_results(done[-1].texts)
    results = [job.result for job in done if job.result is not None]
    if totals is not None and results:
        print_result(totals(results))
    return worst(job.row.exit for job in done)
