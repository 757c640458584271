"""Compose the configs that a command line describes: one, or those of a sweep, each with what becomes of it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.messages import print_results, report_error
from unprocess_gen.cli.signals import SIGNALS
from unprocess_gen.cli.sweep import job_folder, named_overrides
from unprocess_gen.config.option_files import OptionFolders
from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from unprocess_gen.config.composition import Composition
    from unprocess_gen.config.schema import Config


class Job:
    """A config to run; inside the context, an error of a job of a sweep becomes its exit code.

    ``row`` has the first cells of ``sweep.csv``; ``label`` is shown with the progress: ``3/20 camera=sony_a7r``.
    """

    def __init__(self, config: Config, row: dict[str, str], sweep: Path | None = None) -> None:
        self.config, self.row, self.sweep = config, row, sweep
        self.label, self.code = "", 0
        self.result: Any = None

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        # libraries may fail in their own way when they are interrupted
        if self.sweep is None or not isinstance(error, Exception) or SIGNALS.received is not None:
            return False
        self.code = report_error(error, f"{self.row['folder']}: ")
        return True


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


def checked_jobs(composed: Iterable[Composition], only_swept: bool = False) -> list[Job]:
    """Validate composed configs; with ``only_swept`` the folders of a sweep are named by their swept values alone."""
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
        texts = [f"{key}={value}" for key, value in job.swept.items()] if only_swept else job.overrides
        named = named_overrides(texts, job.swept)
        folder = job_folder(named, job.swept)
        row = {"folder": folder, "overrides": ",".join(named), **job.swept}
        jobs.append(Job(replaced(config, {"out": str(sweep / folder)}), row, sweep))
    for number, checked in enumerate(jobs, start=1):
        checked.label = f"{number}/{len(jobs)} {checked.row['folder']}"
    return jobs
