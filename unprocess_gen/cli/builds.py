"""Run the verb that makes a benchmark build and compares it with its recorded digests."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.jobs import checked_jobs
from unprocess_gen.cli.messages import print_results, report
from unprocess_gen.cli.runs import finish
from unprocess_gen.cli.sweep import worst
from unprocess_gen.config.option_files import OptionFolders, build_names
from unprocess_gen.core.errors import ConfigError, DamageError

if TYPE_CHECKING:
    from unprocess_gen.pipeline.builds import Build

DIFFERENCES_LISTED = 20
"""Differences that are listed; the others are counted."""


def build(call: Call) -> int:
    """Make a benchmark build, or compare an existing one; list all builds."""
    from unprocess_gen.pipeline.builds import read_build

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
    from unprocess_gen.pipeline.generate import generate

    settings = [*build.overrides(folder, build.photographs_folder()), f"n_jobs={n_jobs}"]
    composed = compose_jobs(settings, OptionFolders(), multirun=bool(build.recipe.sweep))
    jobs = checked_jobs(composed, only_swept=True)
    for job in jobs:
        with job:
            job.result = generate(job.config, job.label)
        finish(job, has_advice=False)
    return worst(job.code for job in jobs)
