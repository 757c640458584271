"""Compose the config of a command line, or the configs of a sweep, and run a task on each.

Design: ``docs/design/composition_and_sweeps.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.messages import print_results, report_error
from unprocess_gen.cli.signals import SIGNALS
from unprocess_gen.cli.sweep import job_folder, job_row, named_overrides, sweep_out, worst, write_row
from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from unprocess_gen.config.composition import OptionFolders
    from unprocess_gen.config.schema import Config
    from unprocess_gen.config.sweep_expansion import SweepJob

Task = Callable[["Config", str], tuple[int, Any, list[str]]]
"""Run on a config and a label, such as ``3/20 camera=sony_a7r`` (empty outside sweeps).

Returns exit code, result and the texts to print. The result of a task that generates a dataset is its `Summary`. The
caller prints, because a stdout that cannot be written is no failure of the job.
"""


def compose(
    call: Call, task: Task, sweep_csv: bool = False, totals: Callable[[Sequence[Any]], str] | None = None
) -> int:
    """Run a task on the config of a command line, or on each config of a sweep; return the worst exit code.

    With ``sweep_csv``, a sweep writes ``sweep.csv`` in ``out``. ``totals`` returns the text to print after a sweep,
    from the results of its jobs.
    """
    check_overrides(call.overrides)
    if "--resolve" in call.hydra and "--cfg" not in call.hydra:
        raise ConfigError("--resolve: --cfg is missing; expected both; add --cfg job")
    from unprocess_gen.config.composition import compose_node, validated_config
    from unprocess_gen.config.sweep_expansion import expand

    folders = option_folders(call.hydra)
    node, jobs = expand(call.overrides, folders, "--multirun" in call.hydra)
    if "--cfg" in call.hydra:
        for each in [node] if node is not None else (compose_node(job.overrides, folders) for job in jobs):
            print_results(_config_text(each, call))
        return 0
    if node is None:
        return run_sweep(folders, jobs, task, sweep_csv, totals)
    code, _, texts = task(validated_config(node, call.overrides), "")
    print_results(*texts)
    return code


def check_overrides(overrides: Sequence[str]) -> None:
    """Refuse what is not an override, and overrides of Hydra's settings that have no effect."""
    from unprocess_gen.config.option_files import check_override

    for override in overrides:
        check_override(override)
        key = override.lstrip("+").partition("=")[0]
        if key.startswith("hydra") and key != "hydra.mode":
            raise ConfigError(f"{override}: Hydra's own settings are fixed; expected only hydra.mode")


def option_folders(hydra: Mapping[str, Any]) -> OptionFolders:
    """Return the folders and the primary config that flags choose."""
    from unprocess_gen.config.composition import OptionFolders

    own, main = (Path(hydra[flag]) if flag in hydra else None for flag in ("--config-dir", "--config-path"))
    name = hydra.get("--config-name")
    return OptionFolders(main, None if name is None else name.removesuffix(".yaml"), own)


def _config_text(node: DictConfig, call: Call) -> str:
    """Return the YAML text that ``--cfg`` prints: the settings, those of Hydra, or both."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from unprocess_gen.config.composition_errors import explain

    shown = {"job": set(node) - {"hydra"}, "hydra": {"hydra"}, "all": set(node)}[call.hydra["--cfg"]]
    try:
        return OmegaConf.to_yaml(OmegaConf.masked_copy(node, list(shown)), resolve="--resolve" in call.hydra).rstrip()
    except OmegaConfBaseException as error:
        raise ConfigError(explain(error, call.overrides)) from error


# ------------------------------------------------------------------------------------------------------------ sweeps


def run_sweep(
    folders: OptionFolders,
    jobs: Sequence[SweepJob],
    task: Task,
    sweep_csv: bool,
    totals: Callable[[Sequence[Any]], str] | None = None,
) -> int:
    """Run every job of a sweep, one after the other, and return the worst exit code.

    All jobs are composed first: a refused config refuses the sweep. A job that fails while it runs does not stop the
    others. Its row is written before its results are printed, so that an error of stdout loses no row.
    """
    from unprocess_gen.config.schema import replaced

    named = [named_overrides(job.named) for job in jobs]
    names = [job_folder(overrides, job.swept) for overrides, job in zip(named, jobs, strict=True)]
    configs = [_composed(job, folders, name) for job, name in zip(jobs, names, strict=True)]
    codes, results = [], []
    for number, (job, name, config) in enumerate(zip(jobs, names, configs, strict=True), start=1):
        out = sweep_out(config.out)
        done = replaced(config, {"out": str(out / name)})
        code, result, texts = _run(task, done, name, f"{number}/{len(jobs)} {name}")
        codes.append(code)
        if result is not None:
            results.append(result)
        if sweep_csv:
            write_row(out, job_row(name, ",".join(named[number - 1]), job.swept, code, result))
        print_results(*texts)
    if totals is not None and results:
        print_results(totals(results))
    return worst(codes)


def _composed(job: SweepJob, folders: OptionFolders, name: str) -> Config:
    """Return the config of a job; ConfigError with the name of its folder."""
    from unprocess_gen.config.composition import validated_config
    from unprocess_gen.config.sweep_expansion import composed_job

    try:
        config = validated_config(composed_job(job, folders), job.overrides)
        sweep_out(config.out)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from error
    return config


def _run(task: Task, config: Config, name: str, label: str) -> tuple[int, Any, list[str]]:
    """Run a task as a job of a sweep: an error becomes its exit code, unless a signal arrived."""
    try:
        return task(config, label)
    except Exception as error:
        if SIGNALS.received is not None:  # libraries may fail in their own way when they are interrupted
            raise
        return report_error(error, f"{name}: "), None, []
