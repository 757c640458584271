"""Run the verbs that report on settings or on a dataset: plan, accuracy, report, preview and dng."""

from __future__ import annotations

import os
import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.hydra_app import compose
from unprocess_gen.cli.messages import print_results
from unprocess_gen.cli.messages import report as report_message
from unprocess_gen.cli.places import dark_frames_of, dataset_folder, given_root
from unprocess_gen.cli.sweep import plan_totals, swept_keys
from unprocess_gen.config.raw_validation import require_photographs
from unprocess_gen.core.errors import ConfigError, SourceChangedError
from unprocess_gen.core.paths import any_path, local_path
from unprocess_gen.reports.formatting import counted

if TYPE_CHECKING:
    from unprocess_gen.config.schema import Config
    from unprocess_gen.reports.estimate import RunEstimate


def plan(call: Call) -> int:
    """Estimate pairs, bytes and time of a run, and explain which effects it simulates."""
    task = partial(_plan, read_all="all" in call.values, with_numbers="numbers" in call.values)
    return compose(call, task, totals=plan_totals)


def _plan(config: Config, label: str = "", *, read_all: bool, with_numbers: bool) -> tuple[int, RunEstimate, list[str]]:
    from unprocess_gen.pipeline.executors.local import effective_jobs
    from unprocess_gen.reports.estimate import estimate_run
    from unprocess_gen.reports.plan_text import format_estimate

    estimate = estimate_run(config, effective_jobs(config.n_jobs, 10**6), read_all)
    blank = [""] if label and not label.startswith("1/") else []
    return 0, estimate, [*blank, f"out       {config.out}", format_estimate(estimate, with_numbers)]


def accuracy(call: Call) -> int:
    """Measure error and time of every tier, stage by stage, and write a report, never into a dataset."""
    if not any(override.startswith("out=") for override in call.overrides):
        call = replace(call, overrides=[*call.overrides, "out=accuracy"])
    command = shlex.join(["gen-dataset", "accuracy", *call.hydra_arguments, *call.overrides])
    return compose(call, partial(_accuracy, command=command))


def _accuracy(config: Config, label: str = "", *, command: str) -> tuple[int, None, list[str]]:
    from unprocess_gen.reports.accuracy.measure import measure_accuracy
    from unprocess_gen.reports.accuracy.report import REPORT_FILES, report_text, write_accuracy
    from unprocess_gen.reports.report_files import check_report_folder

    require_photographs(config.source, "accuracy")
    out = local_path(config.out, f"out={config.out}: a report is written to a local folder; expected a path")
    check_report_folder(out, "accuracy")
    report = measure_accuracy(config, command)
    write_accuracy(report, out)
    return 0, None, [report_text(report), f"{out}: {', '.join(REPORT_FILES)}"]


def report(call: Call) -> int:
    """Write the HTML page of a dataset or a sweep."""
    from unprocess_gen.pipeline.verify import is_sweep
    from unprocess_gen.reports.dataset_page.page import write_dataset_report
    from unprocess_gen.sources.dark_frames import dark_folder

    folder, to = dataset_folder(call, sweeps=True), Path(call.values["to"]) if "to" in call.values else None
    if isinstance(folder, Path) and is_sweep(folder):
        return _report_sweep(folder, to, call)
    root = given_root(call)
    dark = dark_frames_of(folder / "manifest.csv", call)
    if "noise.dark_frames" in call.values and dark is not None:
        dark_folder(dark)  # refuses a folder that the user names and that does not exist
    print_results(write_dataset_report(folder, to, None if root is None else any_path(root), dark))
    return 0


def _report_sweep(folder: Path, to: Path | None, call: Call) -> int:
    from unprocess_gen.dataset.reader import SWEEP_TABLE, read_sweep_table
    from unprocess_gen.reports.sweep_page import write_sweep_page

    if others := sorted(call.values.keys() & {"source.root", "noise.dark_frames"}):
        raise ConfigError(f"report: {folder}: is a sweep; {others[0]} is for one of its datasets; leave it out")
    jobs = read_sweep_table(folder / SWEEP_TABLE)
    print_results(write_sweep_page(folder, jobs, swept_keys(jobs), to))
    return 0


def preview(call: Call) -> int:
    """Draw contact sheets of pairs."""
    from unprocess_gen.dataset.selection import select_pairs
    from unprocess_gen.pipeline.replay import source_root
    from unprocess_gen.reports.sheets.contact_sheet import write_sheets

    folder = dataset_folder(call)
    to, root, with_stages = Path(call.values["to"]), given_root(call), "stages" in call.values
    keys, files, code = call.values.get("keys", ""), 0, 0
    failed = select_pairs(folder / "manifest.csv", keys).failed if keys else 0
    photographs = source_root(folder / "manifest.csv", root)
    _check_not_among_photographs(to, photographs)
    for sheet in write_sheets(folder, to, keys, None if root is None else any_path(root), with_stages):
        files += len(sheet.files)
        if sheet.missing_source:
            code = SourceChangedError.exit_code if photographs is not None else code
            omitted = "the source's panel and the stages are" if with_stages else "the source's panel is"
            report_message(f"{sheet.key} ({sheet.source}): {omitted} omitted: {sheet.missing_source}")
    skipped = f"; {counted(failed, 'failed row')} skipped" if failed else ""
    print_results(f"{counted(files, 'picture')} in {to}{skipped}")
    return code


def _check_not_among_photographs(to: Path, root: str | None) -> None:
    """Refuse a folder for pictures inside the folder of the sources, of which the next run would make pairs."""
    place = None if root is None else any_path(root).resolve()
    if not isinstance(place, Path) or not place.is_dir():
        return
    if place in (resolved := Path(os.path.realpath(to)), *resolved.parents):
        raise ConfigError(
            f"--to {to}: is inside the folder of the photographs, {root}; expected a folder outside of it, "
            "because runs would read the pictures; choose another folder"
        )


def dng(call: Call) -> int:
    """Write frames as DNG files."""
    from unprocess_gen.dataset.dng import FRAMES, export
    from unprocess_gen.dataset.selection import select_pairs

    folder = dataset_folder(call)
    to = Path(call.values["to"])
    frames = [frame for frame in FRAMES if frame in call.values] or FRAMES
    exported = export(folder, call.values["keys"], frames, to)
    failed = select_pairs(folder / "manifest.csv", call.values["keys"]).failed
    undescribed = counted(exported.without_profile, "noisy frame")
    counts = (
        (exported.written, f"{counted(exported.written, 'DNG file')} written"),
        (exported.present, f"{exported.present} existed with the same bytes"),
        (exported.without_profile, f"{undescribed} without NoiseProfile, which cannot describe the noise"),
        (failed, f"{counted(failed, 'failed row')} skipped"),
    )
    print_results(f"{to}: " + "; ".join(text for count, text in counts if count))
    return 0
