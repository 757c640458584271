"""Compose the configs that a command line describes, one or those of a sweep, and run them one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.messages import print_results, report_error
from unprocess_gen.cli.signals import SIGNALS
from unprocess_gen.cli.sweep import job_folder, named_overrides, worst, write_row
from unprocess_gen.config.option_files import OptionFolders
from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from unprocess_gen.config.composition import Composition
    from unprocess_gen.config.schema import Config


class Job:
    """A config to run, and its exit code.

    ``row`` has the cells of ``sweep.csv``; ``label`` is shown with the progress: ``3/20 camera=sony_a7r``.
    """

    def __init__(self, config: Config, row: dict[str, str], sweep: Path | None = None) -> None:
        self.config, self.row, self.sweep = config, row, sweep
        self.label, self.code = "", 0


def run_jobs(jobs: Sequence[Job], work: Callable[[Job], Iterable[object]], has_table: bool = False) -> int:
    """Print the lines that ``work`` returns of each job; the worst exit code. In a sweep, an error is the job's own.

    With ``has_table``, the row of a job is written before its lines, so that an error of stdout loses no row.
    """
    for job in jobs:
        lines: Iterable[object] = ()
        try:
            lines = work(job)
        except Exception as error:
            # libraries may fail in their own way when they are interrupted
            if job.sweep is None or SIGNALS.received is not None:
                raise
            job.code = report_error(error, f"{job.row['folder']}: ")
            job.row["seconds"] = ""
        if has_table and job.sweep is not None:
            write_row(job.sweep, {**job.row, "exit": str(job.code)})
        print_results(*lines)
    return worst(job.code for job in jobs)


def composed_jobs(call: Call) -> list[Job]:
    """Compose and validate the config of a command line, or all of a sweep; none if ``--cfg`` prints them instead."""
    from unprocess_gen.config.composition import compose_jobs

    if call.resolve and not call.cfg:
        raise ConfigError("--resolve: --cfg is missing; expected both; add --cfg job")
    composed = compose_jobs(call.overrides, option_folders(call), call.multirun)
    if call.cfg:
        print_results(*(job.text(call.cfg, call.resolve) for job in composed))
        return []
    return checked_jobs(composed)


def option_folders(call: Call) -> OptionFolders:
    """Find the folders and the primary config that flags choose."""
    name = call.config_name and call.config_name.removesuffix(".yaml")
    return OptionFolders(call.config_dir, name, call.config_path)


def checked_jobs(composed: Iterable[Composition]) -> list[Job]:
    """Validate composed configs; folders of a sweep are named by swept values, or by all settings if none is swept."""
    from unprocess_gen.config.schema import replaced
    from unprocess_gen.core.paths import local_path

    jobs = []
    for job in composed:
        config = job.config()
        if job.swept is None:
            return [Job(config, {})]
        advice = "run its jobs one by one, or copy its datasets afterwards"
        refusal = f"out={config.out}: a sweep cannot write to an object store; expected a local folder; {advice}"
        sweep = local_path(config.out, refusal)
        named = named_overrides(job.overrides, job.swept)
        folder = job_folder(sorted(f"{key}={value}" for key, value in job.swept.items()) or named)
        row = {"folder": folder, "overrides": ",".join(named), **job.swept}
        jobs.append(Job(replaced(config, {"out": str(sweep / folder)}), row, sweep))
    for number, checked in enumerate(jobs, start=1):
        checked.label = f"{number}/{len(jobs)} {checked.row['folder']}"
    return jobs
