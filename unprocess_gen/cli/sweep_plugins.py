"""Run a sweep with the user's Hydra launcher or sweeper plugin: ``-m hydra/launcher=joblib``.

Hydra composes and starts the jobs, possibly on other machines. Each job writes its row of ``sweep.csv`` to a file of
its own; the process that started the sweep collects them.
"""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from unprocess_gen.cli.hydra_request import Request, Task, run_hydra
from unprocess_gen.cli.messages import checked_streams, print_results, report_error
from unprocess_gen.cli.signals import SIGNALS
from unprocess_gen.cli.sweep import JobRow, folder_name, overrides_text, sweep_out, worst, write_table
from unprocess_gen.config.composition import validated_config
from unprocess_gen.config.sweep_expansion import Expansion
from unprocess_gen.core.errors import MachineError

HYDRA_FOLDER = ".hydra"
"""Folder in the sweep's folder for what Hydra and the plugins write."""


@dataclass(frozen=True, slots=True)
class PluginJob:
    """Run one job in the process where a launcher starts it; Hydra's task function.

    Attributes
    ----------
    task : callable
        What to run on the config.
    described_by, fixed : tuple of str
        See `Expansion`.
    rows : str
        Folder for the rows of this sweep's jobs.
    """

    task: Task
    described_by: tuple[str, ...]
    fixed: tuple[str, ...]
    rows: str

    def __call__(self, node: DictConfig) -> int:
        """Run the job, write its row, print its results and return its exit code."""
        settings = HydraConfig.get()
        overrides = list(settings.overrides.task)
        text = overrides_text([one for one in overrides if one not in self.described_by])
        swept = [one.lstrip("+").partition("=") for one in overrides if one not in self.fixed]
        folder, result = folder_name(text), None
        texts: list[str] = []
        try:
            config = validated_config(node, overrides)
            config.out = str(sweep_out(config.out) / folder)
            code, result, texts = self.task(config, f"{settings.job.num + 1} {folder}")
        except Exception as error:
            if SIGNALS.received is not None:  # libraries may fail in their own way when they are interrupted
                raise
            code = report_error(error, f"{folder}: ")
        row = JobRow.of(folder, text, {key: value for key, _, value in swept}, code, result)
        path = Path(self.rows, f"{settings.job.num:06d}.json")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".part").write_text(json.dumps(asdict(row)), encoding="utf-8")
        path.with_suffix(".part").replace(path)
        with checked_streams():  # a launcher's process has its own stdout
            print_results(texts)
        return code


def run_with_plugins(request: Request, expansion: Expansion, task: Task) -> int:
    """Let Hydra run a sweep with the user's plugins, then write ``sweep.csv``.

    Parameters
    ----------
    request : Request
        The command line.
    expansion : Expansion
        What it describes; its jobs are not used.
    task : callable
        What to run on each config.

    Returns
    -------
    int
        The worst exit code of the jobs.

    Raises
    ------
    ConfigError
        If Hydra or a plugin refuses the config of any job; then none is started.
    MachineError
        If no job returned a result.
    """
    out = Path(os.path.abspath(sweep_out(expansion.out)))
    hydra_folder = out / HYDRA_FOLDER
    rows_folder = hydra_folder / f"rows-{uuid.uuid4().hex}"
    job = PluginJob(task, expansion.described_by, expansion.fixed, str(rows_folder))
    places = [f"hydra.sweep.dir='{_escaped(hydra_folder)}'", "hydra.sweep.subdir=${hydra.job.num}"]
    try:
        run_hydra([*request.flags, "--multirun"], [*request.overrides, *places], job)
    finally:
        rows = list(_read_rows(rows_folder))
        write_table(out, rows)
        shutil.rmtree(rows_folder, ignore_errors=True)
    if not rows:
        raise MachineError(f"out={out}: {', '.join(expansion.plugins)} ended without the result of a job; see its log")
    return worst(row.exit for row in rows)


def _escaped(path: Path) -> str:
    """Escape a path for a quoted value of an override."""
    return str(path).replace("'", "\\'").replace("${", "\\${")


def _read_rows(folder: Path) -> Iterator[JobRow]:
    for path in sorted(folder.glob("*.json")):
        loaded: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        yield JobRow(**loaded)
