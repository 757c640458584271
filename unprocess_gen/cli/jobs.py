"""Run one job of a sweep, and Hydra itself."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.messages import report_error
from unprocess_gen.cli.signals import SIGNALS
from unprocess_gen.cli.sweep import JobRow, job_folder, named_overrides, sweep_out
from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from unprocess_gen.config.schema import Config
    from unprocess_gen.config.sweep_expansion import SweepJob

Task = Callable[["Config", str], tuple[int, Any, list[str]]]
"""Run on a config and a label, such as ``3/20 camera=sony_a7r`` (empty outside sweeps).

Returns exit code, result and the texts to print. The result of a task that generates a dataset is its `Summary`. The
caller prints, because a stdout that cannot be written is no failure of the job.
"""


class JobResult(NamedTuple):
    """The row of a sweep's job, the sweep's ``out`` (None if the config is refused), its result, the texts to print."""

    row: JobRow
    out: Path | None
    result: Any
    texts: list[str]


def run_job(job: SweepJob, task: Task, place: str, composed: Callable[[], DictConfig]) -> JobResult:
    """Run a job of a sweep in its own folder below ``out``; an error becomes its exit code, unless a signal arrived."""
    from unprocess_gen.config.composition import validated_config
    from unprocess_gen.config.schema import replaced

    named = named_overrides(job.named)
    folder = job_folder(named, job.swept)
    out, result = None, None
    texts: list[str] = []
    try:
        config = validated_config(composed(), job.overrides)
        out = sweep_out(config.out)
        if (out / (earlier := job_folder(named))).is_dir():  # version 0.2 shortened names without regard to swept keys
            folder = earlier
        code, result, texts = task(replaced(config, {"out": str(out / folder)}), f"{place} {folder}")
    except Exception as error:
        if SIGNALS.received is not None:  # libraries may fail in their own way when they are interrupted
            raise
        code = report_error(error, f"{folder}: ")
    return JobResult(JobRow.from_summary(folder, ",".join(named), job.swept, code, result), out, result, texts)


def run_hydra(
    call: Call, overrides: Sequence[str], job: Callable[[Any], Any] = lambda node: None, multirun: bool = False
) -> int:
    """Run a Hydra application, whose task function is ``job``, and return 0.

    ConfigError if Hydra refuses overrides or files.
    """
    flags = [word for word in call.hydra_arguments if word not in ("--multirun", "--run")]
    flags += ["--multirun"] if multirun else []
    os.environ["HYDRA_FULL_ERROR"] = "1"  # documented switch: Hydra raises instead of printing several lines
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    from unprocess_gen.config.composition import VERSION_BASE, hydra_override
    from unprocess_gen.config.composition_errors import explain
    from unprocess_gen.config.option_files import conf_dir

    sys.argv = ["gen-dataset", *flags, *map(hydra_override, overrides)]
    application = hydra.main(version_base=VERSION_BASE, config_path=str(conf_dir()), config_name="config")
    try:
        application(job)()
    except (HydraException, OmegaConfBaseException, YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(explain(error, overrides)) from error
    return 0
