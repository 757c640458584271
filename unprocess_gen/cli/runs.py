"""Run the verbs that generate datasets: generate, manifest, part, merge, again and build."""

from __future__ import annotations

import itertools
import os
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from unprocess_gen.cli.arguments import BEGUN, DATASET, INPUTS, N_JOBS, Call, Operand, flag, local, switch, verb
from unprocess_gen.cli.exit_codes import DONE, TOO_MANY_FAILED
from unprocess_gen.cli.jobs import Job, checked_jobs, composed_jobs, run_jobs
from unprocess_gen.cli.messages import print_results, report
from unprocess_gen.cli.places import dataset_folder, given_root
from unprocess_gen.cli.sweep import result_cells
from unprocess_gen.config.option_files import OptionFolders
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.reports.formatting import counted

if TYPE_CHECKING:
    from pathlib import Path

    from unprocess_gen.pipeline.generate import Summary
    from unprocess_gen.reports.builds import Build


PART_VARIABLES = ("SLURM_ARRAY_TASK_ID", "PBS_ARRAY_INDEX", "JOB_COMPLETION_INDEX")
"""Variables in which SLURM, PBS and Kubernetes give a job of an array its number."""

DIFFERENCES_LISTED = 20
"""Differences from a build that are listed; the others are counted."""


@verb(composes=True)
def generate(call: Call) -> int:
    """Generate a dataset; the default verb."""
    return _generate_all(composed_jobs(call), _generate)


def _generate_all(jobs: Sequence[Job], work: Callable[[Job], list[str]]) -> int:
    """Generate the dataset of each job, and end a sweep with what to do next; the worst exit code."""
    code = run_jobs(jobs, work, has_table=True)
    if jobs and (sweep := jobs[0].sweep) is not None:
        done = sum(job.code == DONE for job in jobs)
        after = f"; next: gen-dataset verify {shlex.quote(str(sweep))}" if code == DONE else ""
        print_results(f"{sweep}: {done} of {len(jobs)}{after}")
    return code


def _generate(job: Job, changes: Mapping[str, Any] = MappingProxyType({})) -> list[str]:
    """Generate the dataset of a job; the lines to print about it."""
    from unprocess_gen.config.schema import replaced
    from unprocess_gen.pipeline.generate import generate

    summary = generate(replaced(job.config, changes), job.label)
    job.row |= result_cells(summary)
    job.code, lines = outcome(summary, job.config.source.max_failed, job.sweep is None)
    return lines


@verb(composes=True)
def manifest(call: Call) -> int:
    """Write the manifest of a dataset without frames, for ug.LivePairs."""
    return _generate_all(composed_jobs(call), partial(_generate, changes={"output.frames": False}))


def outcome(summary: Summary, max_failed: int, has_next: bool = True) -> tuple[int, list[str]]:
    """Exit code of a generated dataset, and the lines to print about it, with the next step on request."""
    from unprocess_gen.planning.advice import clipped_low_warning
    from unprocess_gen.sources.listing import unmatched_sentence

    lines, sites = [summary.sentence(max_failed, has_next), unmatched_sentence(summary.unmatched)], summary.sites
    if summary.is_raw and (warning := clipped_low_warning(sites["clean_clipped_low"], sites["all"])):
        lines.append(f"{summary.out} {warning}")
    return TOO_MANY_FAILED if sum(summary.failed.values()) > max_failed else DONE, list(filter(None, lines))


@verb(Operand("K/N", "part K (from 0) of N; or /N in a job of an array"), composes=True)
def part(call: Call) -> int:
    """Generate part K (from 0) of N of a dataset, for separate jobs; merge finishes it."""
    from unprocess_gen.pipeline.generate import make_part

    number, parts = _part(str(call.place or ""))

    def make(job: Job) -> list[str]:
        out = job.config.out
        if (made := make_part(job.config, number, parts, job.label)) is None:
            return [f"{out} is complete; nothing to do"]
        shards = counted(made.done + made.shards, "shard")
        made_now = f"{made.shards} of them ({counted(made.rows, 'row')}) in this run"
        return [f"{out}: part {number} of {parts}: {shards} committed, {made_now}"]

    return run_jobs(composed_jobs(call), make)


def _part(text: str) -> tuple[int, int]:
    """Read ``K/N``, or ``/N`` with K from the batch system."""
    written = re.fullmatch(r"(\d*)/(\d+)", text)
    given = written and (written[1] or next(filter(None, map(os.environ.get, PART_VARIABLES)), ""))
    if written is None or not given or not given.isdecimal() or int(given) >= int(written[2]):
        found = "" if written is None or written[1] else f" (K is {given or 'missing'})"
        expected = f"expected K/N, part K (from 0 to N - 1) of N, or /N with K in {', '.join(PART_VARIABLES)}"
        raise ConfigError(f"part: {text}{found}: {expected}")
    return int(given), int(written[2])


@verb(BEGUN)
def merge(call: Call) -> int:
    """Write manifest.csv and dataset.json when all parts are finished."""
    from unprocess_gen.pipeline.generate import merge

    code, lines = outcome(*merge(str(call.place)))
    print_results(*lines)
    return code


@verb(
    DATASET,
    keys={
        "out=FOLDER": "folder of the new dataset (required)",
        **INPUTS,
        **N_JOBS,
        "executor=NAME": "what runs the workers: local or dask",
        "executor.address=ADDRESS": "address of a Dask scheduler",
        "executor.no_workers_s=SECONDS": "time without any worker after which the run ends",
        "output.frames=true": "make the frames of a manifest without frames",
        "source.max_failed=N": "largest number of failed sources with exit code 0",
    },
)
def again(call: Call) -> int:
    """Regenerate a dataset from its config.yaml in another folder, and compare."""
    from unprocess_gen.config.composition import load_config
    from unprocess_gen.core.paths import any_path
    from unprocess_gen.pipeline.again import compare, recorded_config
    from unprocess_gen.pipeline.generate import generate

    folder = dataset_folder(call)
    if "out" not in call.settings:
        raise ConfigError("again: out is missing; expected the folder of the new dataset; give out=FOLDER")
    if (frames := call.settings.get("output.frames", "true")) != "true":
        raise ConfigError(f"again: output.frames={frames}: expected true")
    places = {"source.root", "noise.dark_frames"}
    given = load_config([f"{key}={value}" for key, value in call.settings.items() if key not in places])
    changes = {key: attrgetter(key)(given) for key in {"executor", *call.settings} - places}
    changes["noise.dark_frames"] = call.settings.get("noise.dark_frames")
    config = recorded_config(folder, given_root(call), changes)
    code, lines = outcome(generate(config), config.source.max_failed)
    print_results(*lines)
    print_results(compare(folder, any_path(config.out)))
    return code


@verb(
    Operand("NAME", "the name of a build", optional=True),
    flag("--to", "DIR", "write the build to DIR", local),
    switch("--list", "list all builds"),
    keys=N_JOBS,
)
def build(call: Call) -> int:
    """Make a benchmark build and compare every byte with its recorded digests."""
    from unprocess_gen.reports.builds import build_names, read_build

    if call.list:
        if call.place or call.to:
            raise ConfigError("build: --list: lists all builds; expected neither NAME nor --to; leave them out")
        for entry in map(read_build, build_names()):
            print_results(f"{entry.name:<28} {len(entry.rows()):>3} pairs  {entry.recipe.title}")
        return 0
    if call.place is None or call.to is None:
        missing = "NAME" if call.place is None else "--to"
        raise ConfigError(f"build: {missing} is missing; expected gen-dataset build NAME --to DIR, or --list")
    made, folder = read_build(str(call.place)), call.to
    made.check_folder(folder, f"--to {folder}")
    if code := make_build(made, folder, call.settings.get("n_jobs", "-1")):
        return code
    differences = made.differences(folder)
    shown = [str(damage) for damage in itertools.islice(differences, DIFFERENCES_LISTED)]
    more = sum(1 for _ in differences)
    for text in [*shown, *([f"and {more} more differences"] if more else [])]:
        report(f"{folder}: {text}")
    if shown:
        return DamageError.exit_code
    print_results(f"{folder} is the build {made.name}, bit for bit")
    return 0


def make_build(build: Build, folder: Path, n_jobs: str = "-1") -> int:
    """Generate a build; the worst exit code. Folders of a sweep have the names of their swept settings."""
    from unprocess_gen.config.composition import compose_jobs

    settings = [*build.overrides(folder, build.photographs_folder()), f"n_jobs={n_jobs}"]
    composed = compose_jobs(settings, OptionFolders(), multirun=bool(build.recipe.sweep))
    return run_jobs(checked_jobs(composed), lambda job: _generate(job)[:1], has_table=True)
