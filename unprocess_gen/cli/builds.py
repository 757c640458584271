"""Run the verb that makes a benchmark build and compares it with its recorded digests."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.hydra_app import compose, run_sweep
from unprocess_gen.cli.messages import print_results, report
from unprocess_gen.cli.runs import generate_dataset
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.config.option_files import build_names
from unprocess_gen.core.errors import ConfigError, DamageError

if TYPE_CHECKING:
    from unprocess_gen.config.schema import Config
    from unprocess_gen.pipeline.builds import Build
    from unprocess_gen.pipeline.generate import Summary

DIFFERENCES_LISTED = 20
"""Differences that are listed; the others are counted."""


def build(call: Call) -> int:
    """Make a benchmark build, or compare an existing one; list all builds."""
    from unprocess_gen.pipeline.builds import read_build

    name = call.values.get("name")
    if "list" in call.values:
        if name or "to" in call.values:
            raise ConfigError("build: --list: lists all builds; expected neither NAME nor --to; leave them out")
        for entry in map(read_build, build_names()):
            print_results(f"{entry.name:<28} {len(entry.rows()):>3} pairs  {entry.recipe.title}")
        return 0
    if name is None or "to" not in call.values:
        missing = "NAME" if name is None else "--to"
        raise ConfigError(f"build: {missing} is missing; expected gen-dataset build NAME --to DIR, or --list")
    made = read_build(name)
    folder = Path(call.values["to"])
    made.check_folder(folder, f"--to {folder}")
    if code := make_build(made, folder, call.values.get("n_jobs", -1)):
        return code
    differences = made.differences(folder)
    shown = [str(damage) for damage in itertools.islice(differences, DIFFERENCES_LISTED)]
    more = sum(1 for _ in differences)
    for text in [*shown, *([f"and {more} more differences"] if more else [])]:
        report(f"{folder}: {text}")
    if shown:
        return DamageError.exit_code
    print_results(f"{folder} is the build {name}, bit for bit")
    return 0


def make_build(build: Build, folder: Path, n_jobs: int = -1) -> int:
    """Generate a build; return the worst exit code. Folders of a sweep have the names of their swept settings."""
    from unprocess_gen.config.composition import OptionFolders
    from unprocess_gen.config.sweep_expansion import expand

    settings = [*build.overrides(folder, build.photographs_folder()), f"n_jobs={n_jobs}"]
    if not build.recipe.sweep:
        return compose(Call(VERBS["generate"], overrides=settings), _generate)
    folders = OptionFolders()
    _, jobs = expand(settings, folders, multirun=True)
    short = [replace(job, named=tuple(f"{key}={value}" for key, value in job.swept.items())) for job in jobs]
    return run_sweep(folders, short, _generate, sweep_csv=True)


def _generate(config: Config, label: str) -> tuple[int, Summary, list[str]]:
    """Generate a dataset of a build; the advice about files that no pattern matches is left out."""
    code, summary, lines = generate_dataset(config, label)
    return code, summary, lines[:1]
