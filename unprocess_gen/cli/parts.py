"""Run the verbs of a run in parts: prepare, part, status and merge."""

from __future__ import annotations

import os
import shlex
from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.exit_codes import DONE, TOO_MANY_FAILED
from unprocess_gen.cli.jobs import composed_jobs
from unprocess_gen.cli.messages import print_results, report
from unprocess_gen.cli.places import given_root
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.reports.formatting import counted

if TYPE_CHECKING:
    from unprocess_gen.config.schema import Config

PART_VARIABLES = ("SLURM_ARRAY_TASK_ID", "PBS_ARRAY_INDEX", "JOB_COMPLETION_INDEX")
"""Variables in which SLURM, PBS and Kubernetes give a job of an array its number."""


def prepare(call: Call) -> int:
    """List the sources of a run and split it into parts."""
    parts = _number("prepare", "parts", call.settings.get("parts", "")) or 0
    for job in composed_jobs(call):
        print_results(*_prepare(job.config, parts))
    return DONE


def _number(verb: str, key: str, text: str | None) -> int | None:
    """Read an integer; None without a text."""
    try:
        return None if text is None else int(text)
    except ValueError:
        raise ConfigError(f"{verb}: {key}={text}: expected an integer") from None


def _prepare(config: Config, parts: int) -> list[str]:
    from unprocess_gen.pipeline.parts import prepare

    run = prepare(config, parts)
    if run is None:
        return [f"{config.out} is complete; nothing to do"]
    for warning in run.warnings():
        report(warning)
    out = shlex.quote(config.out)
    shards = counted(len(run.tasks()), "shard")
    counts = f"{counted(len(run.sources), 'source')}, {shards}, {counted(parts, 'part')}"
    how = f"run gen-dataset part {out} K for K = 0 to {parts - 1}, then gen-dataset merge {out}"
    return [f"{config.out}: {counts}; {how}"]


def part(call: Call) -> int:
    """Generate one part of a prepared run."""
    from unprocess_gen.pipeline.parts import make_part

    out, number = str(call.place), _part_number(call)
    if number is None:
        raise ConfigError(
            f"part: its number is missing; expected it after {out}, or in one of {', '.join(PART_VARIABLES)}"
        )
    made = make_part(out, number, _number("part", "n_jobs", call.settings.get("n_jobs")), given_root(call))
    if made is None:
        print_results(f"{out} is complete; nothing to do")
        return DONE
    print_results(
        f"{out}: part {number} of {made.parts}: {counted(made.shards, 'shard')} committed, {made.made} of them "
        f"({counted(made.rows, 'row')}) in this run, {made.seconds:.1f} s"
    )
    return DONE


def _part_number(call: Call) -> int | None:
    """Number of the part, given or of a batch system; None without one."""
    given = {"part": call.settings.get("part")} | {name: os.environ.get(name) for name in PART_VARIABLES}
    return next((_number("part", name, text) for name, text in given.items() if text is not None), None)


def status(call: Call) -> int:
    """Print which parts of a prepared run are left."""
    from unprocess_gen.pipeline.parts import left_text, parts_status

    out = str(call.place)
    state = parts_status(out)
    if call.left:
        print_results(left_text(state.left))
    elif state.complete:
        print_results(f"{out} is complete")
    else:
        done = f"{state.parts - len(state.left)} of {counted(state.parts, 'part')}"
        shards = f"{state.committed} of {counted(state.shards, 'shard')} committed"
        next_step = f"left: {left_text(state.left)}" if state.left else f"run gen-dataset merge {shlex.quote(out)}"
        print_results(f"{out}: {done} done, {shards}; {next_step}")
    return DONE


def merge(call: Call) -> int:
    """Write manifest and ``dataset.json`` of a run whose parts are done."""
    from unprocess_gen.pipeline.parts import merge

    summary, max_failed = merge(str(call.place))
    print_results(summary.sentence(max_failed))
    return TOO_MANY_FAILED if summary.made and sum(summary.failed.values()) > max_failed else DONE
