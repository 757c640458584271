"""Run the verbs of a run in parts: part and merge."""

from __future__ import annotations

import os
import re

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.exit_codes import DONE, TOO_MANY_FAILED
from unprocess_gen.cli.jobs import composed_jobs
from unprocess_gen.cli.messages import print_results
from unprocess_gen.cli.sweep import worst
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.reports.formatting import counted

PART_VARIABLES = ("SLURM_ARRAY_TASK_ID", "PBS_ARRAY_INDEX", "JOB_COMPLETION_INDEX")
"""Variables in which SLURM, PBS and Kubernetes give a job of an array its number."""


def part(call: Call) -> int:
    """Generate one part of a dataset, or of each dataset of a sweep."""
    from unprocess_gen.pipeline.generate import make_part

    number, parts = _part(call.settings.get("part", ""))
    jobs = composed_jobs(call)
    for job in jobs:
        out = job.config.out
        with job:
            made = make_part(job.config, number, parts, job.label)
            if made is None:
                print_results(f"{out} is complete; nothing to do")
            else:
                shards = counted(made.done + made.shards, "shard")
                made_now = f"{made.shards} of them ({counted(made.rows, 'row')}) in this run"
                print_results(f"{out}: part {number} of {parts}: {shards} committed, {made_now}")
    return worst(job.code for job in jobs)


def _part(text: str) -> tuple[int, int]:
    """Read ``K/N``, or ``/N`` with K from the batch system."""
    written = re.fullmatch(r"(\d*)/(\d+)", text)
    if written is None:
        raise ConfigError(
            f"part: {text or 'K/N is missing'}: expected K/N, part K (from 0) of N, or /N with K in one of "
            f"{', '.join(PART_VARIABLES)}"
        )
    number, parts = int(written[1] or _number_of_environment()), int(written[2])
    if number >= parts:
        raise ConfigError(f"part: {number}/{parts}: out of range; expected K from 0 to N - 1")
    return number, parts


def _number_of_environment() -> str:
    """Number of the part that a batch system gives."""
    for variable in PART_VARIABLES:
        if (text := os.environ.get(variable)) is not None:
            if not text.isdecimal():
                raise ConfigError(f"part: {variable}={text}: expected an integer from 0")
            return text
    raise ConfigError(f"part: its number is missing; expected K/N, or one of {', '.join(PART_VARIABLES)}")


def merge(call: Call) -> int:
    """Write manifest and ``dataset.json`` of a run whose parts are done."""
    from unprocess_gen.pipeline.generate import merge

    summary, max_failed = merge(str(call.place))
    print_results(summary.sentence(max_failed))
    return TOO_MANY_FAILED if sum(summary.failed.values()) > max_failed else DONE
