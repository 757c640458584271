"""Run the verbs that show settings or a dataset: plan, accuracy, report, preview, dng and explore."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

from unprocess_gen.cli.arguments import (
    ANY_DATASET,
    DATASET,
    INPUTS,
    KEYS,
    ROWS,
    SOURCE,
    Call,
    Operand,
    count,
    flag,
    local,
    switch,
    verb,
)
from unprocess_gen.cli.jobs import Job, composed_jobs, option_folders, run_jobs
from unprocess_gen.cli.messages import LOGGER, print_results
from unprocess_gen.cli.messages import report as report_message
from unprocess_gen.cli.places import dataset_folder, given_places, given_root
from unprocess_gen.cli.sweep import swept_keys
from unprocess_gen.core.errors import ConfigError, SourceChangedError
from unprocess_gen.core.libraries import require
from unprocess_gen.reports.formatting import counted


@verb(
    switch("--all", "read every photograph, and name those that fail"),
    switch("--numbers", "state the source of each number of the noise profile"),
    composes=True,
)
def plan(call: Call) -> int:
    """Estimate pairs, bytes and time, and explain the effects; write nothing."""
    from unprocess_gen.pipeline.executors.local import effective_jobs
    from unprocess_gen.reports.estimate import estimate_run
    from unprocess_gen.reports.plan_text import format_estimate, sweep_lines

    jobs, planned = composed_jobs(call), {}

    def explain(job: Job) -> list[str]:
        if job.sweep is not None:
            LOGGER.info(job.label)
        estimate = estimate_run(job.config, effective_jobs(job.config.n_jobs, 10**6), call.all)
        if job.sweep is None:
            return [f"out       {job.config.out}", format_estimate(estimate, call.numbers)]
        planned[job.row["folder"]] = estimate
        return []

    code = run_jobs(jobs, explain)
    if planned:
        print_results(f"out       {jobs[0].sweep}", *sweep_lines(planned, call.numbers))
    return code


@verb(composes=True)
def accuracy(call: Call) -> int:
    """Measure time and error of each tier; default out: accuracy."""
    from unprocess_gen.config.source_validation import require_kind
    from unprocess_gen.core.paths import local_path
    from unprocess_gen.reports.accuracy_page import REPORT_FILES, report_text, write_accuracy
    from unprocess_gen.reports.pages import check_report_folder
    from unprocess_gen.reports.tier_costs import measure_accuracy

    if not any(override.startswith("out=") for override in call.overrides):
        call.overrides.append("out=accuracy")
        call.words.append("out=accuracy")
    command = shlex.join(["gen-dataset", "accuracy", *call.words])

    def measure(job: Job) -> list[str]:
        config = job.config
        require_kind(config.source, "accuracy", "srgb")
        out = local_path(config.out, f"out={config.out}: a report is written to a local folder; expected a path")
        check_report_folder(out, "accuracy")
        measured = measure_accuracy(config, command)
        write_accuracy(measured, out)
        return [report_text(measured), f"{out}: {', '.join(REPORT_FILES)}"]

    return run_jobs(composed_jobs(call), measure)


@verb(ANY_DATASET, flag("--to", "FILE", "write FILE instead of DIR/report.html", local), keys=INPUTS)
def report(call: Call) -> int:
    """Write an HTML page about a dataset or a sweep."""
    from unprocess_gen.core.paths import any_path
    from unprocess_gen.pipeline.verify import is_sweep
    from unprocess_gen.reports.dataset_page import write_dataset_report
    from unprocess_gen.sources.dark_frames import dark_folder

    folder = dataset_folder(call, sweeps=True)
    if isinstance(folder, Path) and is_sweep(folder):
        return _report_sweep(folder, call)
    root, dark = given_root(call), given_places(folder, call).dark_frames
    if "noise.dark_frames" in call.settings and dark is not None:
        dark_folder(dark)  # refuses a folder that the user names and that does not exist
    print_results(write_dataset_report(folder, call.to, None if root is None else any_path(root), dark))
    return 0


def _report_sweep(folder: Path, call: Call) -> int:
    from unprocess_gen.dataset.reader import SWEEP_TABLE, read_sweep_table
    from unprocess_gen.reports.sweep_page import write_sweep_page

    if others := sorted(call.settings):
        raise ConfigError(f"report: {folder}: is a sweep; {others[0]} is for one of its datasets; leave it out")
    jobs = read_sweep_table(folder / SWEEP_TABLE)
    print_results(write_sweep_page(folder, jobs, swept_keys(jobs), call.to))
    return 0


@verb(
    DATASET,
    KEYS,
    flag("--to", "FOLDER", "write the pictures to FOLDER", local, required=True),
    switch("--stages", "draw each processing step too"),
    keys=SOURCE,
)
def preview(call: Call) -> int:
    """Draw contact sheets of pairs, and of each processing step."""
    from unprocess_gen.core.paths import any_path
    from unprocess_gen.dataset.selection import select_pairs
    from unprocess_gen.reports.sheets import write_sheets

    folder = dataset_folder(call)
    to, given, root, keys = call.to, given_root(call), given_places(folder, call).root, call.keys or ""
    files = code = 0
    failed = select_pairs(folder / "manifest.csv", keys).failed if keys else 0
    _check_not_among_photographs(to, root)
    for sheet in write_sheets(folder, to, keys, None if given is None else any_path(given), call.stages):
        files += len(sheet.files)
        if sheet.missing_source:
            code = SourceChangedError.exit_code if root is not None else code
            omitted = "the source's panel and the stages are" if call.stages else "the source's panel is"
            report_message(f"{sheet.key} ({sheet.source}): {omitted} omitted: {sheet.missing_source}")
    skipped = f"; {counted(failed, 'failed row')} skipped" if failed else ""
    print_results(f"{counted(files, 'picture')} in {to}{skipped}")
    return code


def _check_not_among_photographs(to: Path, root: str | None) -> None:
    """Refuse a folder for pictures inside the folder of the sources, of which the next run would make pairs."""
    place, resolved = os.path.realpath(root or ""), Path(os.path.realpath(to))
    if root is not None and Path(place).is_dir() and Path(place) in (resolved, *resolved.parents):
        expected = "expected a folder outside of it, because runs would read the pictures; choose another folder"
        raise ConfigError(f"--to {to}: is inside the folder of the photographs, {root}; {expected}")


@verb(
    DATASET,
    flag("--keys", "KEYS", ROWS, required=True),
    flag("--to", "FOLDER", "write the files to FOLDER", local, required=True),
    switch("--noisy", "only noisy frames"),
    switch("--clean", "only clean frames"),
)
def dng(call: Call) -> int:
    """Write frames as DNG files, for raw converters."""
    from unprocess_gen.dataset.dng import FRAMES, export

    frames = [frame for frame in FRAMES if getattr(call, frame)] or FRAMES
    exported = export(dataset_folder(call), call.keys, frames, call.to)
    undescribed = counted(exported.without_profile, "noisy frame")
    counts = (
        (exported.written, f"{counted(exported.written, 'DNG file')} written"),
        (exported.present, f"{exported.present} existed with the same bytes"),
        (exported.without_profile, f"{undescribed} without NoiseProfile, which cannot describe the noise"),
        (exported.failed, f"{counted(exported.failed, 'failed row')} skipped"),
    )
    print_results(f"{call.to}: " + "; ".join(text for count, text in counts if count))
    return 0


@verb(
    Operand("PHOTO", "a photograph, a folder of photographs, or a dataset", optional=True),
    KEYS,
    flag("--port", "N", "number of the port on 127.0.0.1; default: a free one", count, default=0),
    switch("--no-browser", "print the address, and open no browser"),
    composes=True,
)
def explore(call: Call) -> int:
    """Try settings on a photograph or a row, in a page of the browser on this machine."""
    for library in ("bokeh", "jinja2"):
        require(library, f"explore: the page needs {library}", "explore")
    if call.multirun or call.cfg or call.resolve:
        name = "--multirun" if call.multirun else "--cfg" if call.cfg else "--resolve"
        raise ConfigError(f"explore: {name}: a page shows one config; expected settings; leave it out")
    from unprocess_gen.reports.explorer import server
    from unprocess_gen.reports.explorer.exploration import open_place

    place = call.place
    if place is not None and not place.is_listed():
        raise ConfigError(f"explore: {place}: no such file or folder; expected a photograph, a folder or a dataset")
    if place is not None and place.is_dir() and (place / "sweep.csv").is_file():
        raise ConfigError(f"explore: {place}: is the folder of a sweep; expected one of its datasets")
    given = {"--config-dir": call.config_dir, "--config-name": call.config_name, "--config-path": call.config_path}
    flags = [word for name, value in given.items() if value is not None for word in (name, str(value))]
    start, choices = open_place(place, call.keys, call.overrides, flags, option_folders(call))
    server.serve(start, choices, call.port, not call.no_browser, _print_address)
    return 0


def _print_address(address: str) -> None:
    print_results(f"{address} shows the page on this machine; stop with Ctrl-C")
