"""Run a sweep with the user's Hydra launcher or sweeper plugin: ``-m hydra/launcher=joblib``.

Hydra composes and starts the jobs, possibly on other machines. Each job writes its row of ``sweep.csv`` to a file of
its own; the process that started the sweep collects them.
"""

from __future__ import annotations

import json
import os
import shutil
import uuid
from dataclasses import asdict, dataclass
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.jobs import Task, run_hydra, run_job
from unprocess_gen.cli.messages import checked_streams, print_results
from unprocess_gen.cli.sweep import JobRow, sweep_out, worst, write_table
from unprocess_gen.config.sweep_expansion import Expansion, SweepJob
from unprocess_gen.core.errors import MachineError

HYDRA_FOLDER = ".hydra"
"""Folder in the sweep's folder for what Hydra and the plugins write."""


@dataclass(frozen=True, slots=True)
class PluginJob:
    """Hydra's task function: run one job in the process where a launcher starts it, and write its row to ``rows``."""

    task: Task
    expansion: Expansion
    rows: Path

    def __call__(self, node: DictConfig) -> int:
        """Run the job, write its row, print its results and return its exit code."""
        settings = HydraConfig.get()
        overrides, number = tuple(settings.overrides.task), settings.job.num
        named = tuple(override for override in overrides if override not in self.expansion.described_by)
        swept = [override.lstrip("+").partition("=") for override in overrides if override not in self.expansion.fixed]
        job = SweepJob(overrides, named, {key: value for key, _, value in swept})
        done = run_job(job, self.task, str(number + 1), lambda: node)
        self.rows.mkdir(parents=True, exist_ok=True)
        path = self.rows / f"{number:06d}.json"
        path.with_suffix(".part").write_text(json.dumps(asdict(done.row)), encoding="utf-8")
        path.with_suffix(".part").replace(path)
        with checked_streams():  # a launcher's process has its own stdout
            print_results(done.texts)
        return done.row.exit


def run_with_plugins(call: Call, expansion: Expansion, task: Task) -> int:
    """Let Hydra run a sweep with the user's plugins, write ``sweep.csv``, and return the worst exit code.

    No job is started if Hydra or a plugin refuses the config of any job.
    """
    out = Path(os.path.abspath(sweep_out(expansion.out)))
    rows_folder = out / HYDRA_FOLDER / f"rows-{uuid.uuid4().hex}"
    place = str(out / HYDRA_FOLDER).replace("'", "\\'").replace("${", "\\${")
    places = [f"hydra.sweep.dir='{place}'", "hydra.sweep.subdir=${hydra.job.num}"]
    job = PluginJob(task, expansion, rows_folder)
    try:
        run_hydra(call, [*call.overrides, *places], job, multirun=True)
    finally:
        files = sorted(rows_folder.glob("*.json"))
        rows = [JobRow(**json.loads(file.read_text(encoding="utf-8"))) for file in files]
        write_table(out, rows)
        shutil.rmtree(rows_folder, ignore_errors=True)
    if not rows:
        raise MachineError(f"out={out}: {', '.join(expansion.plugins)} ended without the result of a job; see its log")
    return worst(row.exit for row in rows)
