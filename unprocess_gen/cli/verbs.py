"""Define the verbs of ``gen-dataset``: one function each, and `VERBS`, which describes them.

A function takes the parsed command line and returns the exit code. It imports what it needs, because importing the
kernels or Hydra takes longer than ``--help`` may take.
"""

from __future__ import annotations

import logging
import os
import re
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import SOURCE, Argument, Call, Place, Verb
from unprocess_gen.cli.completion import SHELLS, print_completion
from unprocess_gen.cli.exit_codes import DONE, TOO_MANY_FAILED
from unprocess_gen.cli.messages import print_result, print_results, report, report_error
from unprocess_gen.cli.sweep import plan_totals, worst
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.core.errors import ConfigError, DamageError, SourceChangedError, UnprocessGenError
from unprocess_gen.core.object_store import AnyPath, ObjectPath, any_path, is_url
from unprocess_gen.core.output_paths import DATASET_ENTRIES
from unprocess_gen.reports.formatting import counted

if TYPE_CHECKING:
    from unprocess_gen.config.schema import AccuracyConfig, Config, ExecutorConfig
    from unprocess_gen.core.types import Row
    from unprocess_gen.pipeline.generate import Summary
    from unprocess_gen.pipeline.replay import ReplayResult
    from unprocess_gen.pipeline.verify import Damage
    from unprocess_gen.reports.estimate import RunEstimate
    from unprocess_gen.sources.dark_frames import DarkPlaces

# ------------------------------------------------------------------------------------------- verbs that take settings


def run_generate(call: Call) -> int:
    """Generate a dataset, or one for each combination of a sweep."""
    from unprocess_gen.cli.hydra_app import compose

    return compose(call.overrides, generate_dataset, sweep_csv=True)


def generate_dataset(config: Config, label: str = "") -> tuple[int, Summary, list[str]]:
    """Generate one dataset and describe it.

    Parameters
    ----------
    config : Config
        Validated config.
    label : str
        Name of the job and its place in a sweep.

    Returns
    -------
    tuple of int, Summary and list of str
        Exit code: 3 if more sources failed than ``source.max_failed`` allows; what was generated; the lines to print.
    """
    from unprocess_gen.pipeline.generate import generate
    from unprocess_gen.sources.listing import unmatched_sentence

    summary = generate(config, label)
    lines = [_summary_line(summary, config.source.max_failed)]
    if summary.made and summary.sites["all"]:
        lines.append(_clipping_line(summary.sites))
    if summary.unmatched:
        lines.append(unmatched_sentence(summary.unmatched))
    too_many = sum(summary.failed.values()) > config.source.max_failed
    return TOO_MANY_FAILED if too_many else DONE, summary, lines


def _summary_line(summary: Summary, max_failed: int) -> str:
    facts = _counts_text(summary, max_failed)
    if not summary.made:
        return f"{summary.out} is complete: {facts}; nothing to do"
    rows = f"{summary.made} of {counted(summary.rows, 'row')} generated in this run"
    return f"{summary.out}: {facts}; {rows}, {summary.seconds:.1f} s"


def _counts_text(summary: Summary, max_failed: int) -> str:
    """Return the pairs, shards, bytes and failures of a dataset."""
    count, failed = sum(summary.failed.values()), ", ".join(f"{n} {reason}" for reason, n in summary.failed.items())
    facts = (
        f"{counted(summary.pairs, 'pair')} in {counted(summary.shards, 'shard')}, {summary.bytes / 1e6:,.1f} MB, "
        + (f"{count} failed ({failed}; see {summary.out}/manifest.csv)" if failed else "0 failed")
    )
    return facts + (f", more than source.max_failed={max_failed}" if count > max_failed else "")


def _clipping_line(sites: dict[str, int]) -> str:
    """Return the shares of clipped and saturated sites, so that clipping does not go unnoticed in training data."""
    share = {name: _percent(count, sites["all"]) for name, count in sites.items()}
    return (
        f"of {sites['all']:,} sites, clean: {share['clean_clipped_low']} were clipped at black, "
        f"{share['clean_clipped_high']} at white, {share['saturated']} are saturated; "
        f"noisy: {share['noisy_clipped_low']} were clipped low, {share['noisy_clipped_high']} high; "
        f"{share['zero_variance']} have zero noise variance"
    )


def _percent(count: int, total: int) -> str:
    """Return a share with three decimals; a few sites of many are not rounded to none."""
    return f"{count / total:.3%}" if count == 0 or count / total >= 5e-6 else "under 0.001%"


# --------------------------------------------------------------------------------------------------- a run in parts


PART_VARIABLES = ("SLURM_ARRAY_TASK_ID", "PBS_ARRAY_INDEX", "JOB_COMPLETION_INDEX")
"""Variables in which SLURM, PBS and Kubernetes give a job of an array its number."""


def run_prepare(call: Call) -> int:
    """List the sources of a run and split it into parts."""
    from unprocess_gen.cli.hydra_app import compose

    if "parts" not in call.values:
        raise ConfigError("prepare: parts is missing; expected the number of parts; give parts=…")
    return compose(call.overrides, partial(_prepare, parts=call.values["parts"]))


def _prepare(config: Config, label: str = "", *, parts: int) -> tuple[int, None, list[str]]:
    from unprocess_gen.pipeline.parts import prepare

    prepared = prepare(config, parts)
    for warning in prepared.warnings:
        report(warning, logging.WARNING)
    out = shlex.quote(config.out)
    if prepared.complete:
        return DONE, None, [f"{config.out} is complete; nothing to do"]
    counts = f"{counted(prepared.sources, 'source')}, {counted(prepared.shards, 'shard')}, {counted(parts, 'part')}"
    how = f"run gen-dataset part {out} K for K = 0 to {parts - 1}, then gen-dataset merge {out}"
    return DONE, None, [f"{config.out}: {counts}; {how}"]


def run_part(call: Call) -> int:
    """Generate one part of a prepared run."""
    from unprocess_gen.pipeline.parts import make_part

    out, part = str(call.path), call.values.get("part", _part_of_environment())
    if part is None:
        raise ConfigError(
            f"part: its number is missing; expected it after {out}, or in one of {', '.join(PART_VARIABLES)}"
        )
    made = make_part(out, part, call.values.get("n_jobs"), _root(call))
    if made is None:
        print_result(f"{out} is complete; nothing to do")
        return DONE
    print_result(
        f"{out}: part {part} of {made.parts}: {counted(made.shards, 'shard')} committed, {made.made} of them "
        f"({counted(made.rows, 'row')}) in this run, {made.seconds:.1f} s"
    )
    return DONE


def _part_of_environment() -> int | None:
    """Return the number of the part that a batch system gives, None without one."""
    for variable in PART_VARIABLES:
        if (text := os.environ.get(variable)) is not None:
            try:
                return int(text)
            except ValueError:
                raise ConfigError(f"part: {variable}={text}: expected an integer") from None
    return None


def run_status(call: Call) -> int:
    """Print which parts of a prepared run are left."""
    from unprocess_gen.pipeline.parts import left_text, parts_status

    out = str(call.path)
    status = parts_status(out)
    if "left" in call.values:
        print_result(left_text(status.left))
    elif status.complete:
        print_result(f"{out} is complete")
    else:
        done = f"{status.parts - len(status.left)} of {counted(status.parts, 'part')}"
        shards = f"{status.committed} of {counted(status.shards, 'shard')} committed"
        next_step = f"left: {left_text(status.left)}" if status.left else f"run gen-dataset merge {shlex.quote(out)}"
        print_result(f"{out}: {done} done, {shards}; {next_step}")
    return DONE


def run_merge(call: Call) -> int:
    """Write manifest and ``dataset.json`` of a run whose parts are done."""
    from unprocess_gen.pipeline.parts import merge

    summary, max_failed = merge(str(call.path))
    if not summary.made:
        print_result(_summary_line(summary, max_failed))
        return DONE
    print_result(f"{summary.out}: {_counts_text(summary, max_failed)}; merged in {summary.seconds:.1f} s")
    if summary.sites["all"]:
        print_result(_clipping_line(summary.sites))
    return TOO_MANY_FAILED if sum(summary.failed.values()) > max_failed else DONE


# ---------------------------------------------------------------------------------------------- reports of settings


def run_plan(call: Call) -> int:
    """Estimate pairs, bytes and time of a run, and explain which effects it simulates."""
    from unprocess_gen.cli.hydra_app import compose

    return compose(call.overrides, partial(_plan, read_all="all" in call.values), totals=plan_totals)


def _plan(config: Config, label: str = "", *, read_all: bool) -> tuple[int, RunEstimate, list[str]]:
    from unprocess_gen.pipeline.executors.local import effective_jobs
    from unprocess_gen.reports.estimate import estimate_run, format_estimate

    estimate = estimate_run(config, effective_jobs(config.n_jobs, 10**6), read_all, _tiers())
    blank = [""] if label and not label.startswith("1/") else []
    return 0, estimate, [*blank, f"out       {config.out}", format_estimate(config, estimate)]


def run_accuracy(call: Call) -> int:
    """Measure error and time of every method and tier, and write a report."""
    from unprocess_gen.cli.hydra_app import compose

    overrides = _with_out(call.overrides, "accuracy")
    return compose(overrides, partial(_accuracy, command=shlex.join(["gen-dataset", "accuracy", *overrides])))


def _accuracy(config: Config, label: str = "", *, command: str) -> tuple[int, None, list[str]]:
    from unprocess_gen.config.interpretation import uses_dark_frames
    from unprocess_gen.config.schema import NoiseConfig, SceneConfig, SensorConfig
    from unprocess_gen.config.serialization import read_option
    from unprocess_gen.reports import report_files
    from unprocess_gen.reports.benchmark import measure
    from unprocess_gen.reports.benchmark import report as benchmark_report

    if uses_dark_frames(config.noise):
        raise ConfigError(
            f"accuracy: noise.dark_frames={config.noise.dark_frames}: tiers are measured with the noise of a profile; "
            "expected null; leave it out"
        )
    out = _local_out(config)
    report_files.check_report_folder(out, "accuracy")
    noise, sensor = conf_dir() / "noise", conf_dir() / "sensor"
    profiles = measure.BenchmarkProfiles(
        _tiers(),
        read_option(noise / "imx385_iso3200.yaml", NoiseConfig),
        read_option(noise / "sony_a7s2.yaml", NoiseConfig),
        read_option(sensor / "generic_14bit.yaml", SensorConfig),
        {name: read_option(conf_dir() / "scene" / f"{name}.yaml", SceneConfig) for name in ("daylight", "night")},
    )
    benchmark = measure.measure_accuracy(config, profiles, command=command)
    benchmark_report.write_benchmark(benchmark, out)
    return 0, None, [benchmark_report.report_text(benchmark), f"{out}: {', '.join(benchmark_report.FILES)}"]


def _tiers() -> dict[str, AccuracyConfig]:
    """Return every tier of ``conf/accuracy``, the reference first."""
    from unprocess_gen.config.schema import AccuracyConfig
    from unprocess_gen.config.serialization import read_option

    files = sorted((conf_dir() / "accuracy").glob("*.yaml"), key=lambda path: (path.stem != "reference", path.stem))
    return {path.stem: read_option(path, AccuracyConfig) for path in files}


FIGURE_KEYS = ("source", "camera", "sensor", "seed", "out")
"""Settings that ``figures`` accepts; the article determines the others."""


def run_figures(call: Call) -> int:
    """Draw the article's figures for one photograph."""
    from unprocess_gen.cli.hydra_app import compose

    for override in call.overrides:
        if "=" in override and not override.startswith("-") and re.split(r"[.=]", override)[0] not in FIGURE_KEYS:
            raise ConfigError(f"figures: {override}: the article sets it; expected {', '.join(FIGURE_KEYS)}")
    overrides = _with_out(call.overrides, "figures")
    return compose(overrides, partial(_figures, command=shlex.join(["gen-dataset", "figures", *overrides])))


def _figures(config: Config, label: str = "", *, command: str) -> tuple[int, None, list[str]]:
    from unprocess_gen.config.schema import GainsConfig, NoiseConfig
    from unprocess_gen.config.serialization import read_option
    from unprocess_gen.reports import report_files
    from unprocess_gen.reports.paper import figures as paper_figures

    out = _local_out(config)
    report_files.check_report_folder(out, "figures")
    gains = {name: read_option(conf_dir() / "gains" / f"{name}.yaml", GainsConfig) for name in paper_figures.GAINS}
    authors = read_option(conf_dir() / "noise" / f"{paper_figures.AUTHORS_NOISE}.yaml", NoiseConfig)
    drawn = paper_figures.draw_figures(config, paper_figures.PaperOptions(gains, authors))
    return 0, None, [f"{out}: {', '.join(paper_figures.write_figures(drawn, out, command))}"]


def _local_out(config: Config) -> Path:
    if is_url(config.out):
        raise ConfigError(f"out={config.out}: a report is written to a local folder; expected a path")
    return Path(config.out)


def _with_out(overrides: list[str], out: str) -> list[str]:
    """Add a verb's own default of ``out``, so that a report never goes into a dataset's folder."""
    return overrides if any(override.startswith("out=") for override in overrides) else [*overrides, f"out={out}"]


# ------------------------------------------------------------------------------------------ verbs that take a dataset


def _executor(call: Call) -> ExecutorConfig:
    """Return the settings of the executor that a call names, those of ``executor=local`` without one."""
    from unprocess_gen.config.option_files import group_options
    from unprocess_gen.config.schema import ExecutorConfig
    from unprocess_gen.config.serialization import read_option
    from unprocess_gen.config.values import one_of

    name = call.values.get("executor", "local")
    one_of("executor", name, tuple(group_options("executor")))
    executor = read_option(conf_dir() / "executor" / f"{name}.yaml", ExecutorConfig)
    executor.address = call.values.get("address")
    return executor


def run_again(call: Call) -> int:
    """Generate a dataset again from its ``config.yaml``, and compare the manifests."""
    from unprocess_gen.config.serialization import read_dataset_yaml
    from unprocess_gen.config.validation import validate_config
    from unprocess_gen.pipeline.replay import check_source_digests, check_source_sizes, source_root
    from unprocess_gen.pipeline.verify import have_same_rows
    from unprocess_gen.sources.dark_frames import set_dark_places

    folder = _dataset("again", call)
    config, kind = read_dataset_yaml(folder / "config.yaml")
    if "out" not in call.values:
        raise ConfigError("again: out is missing; expected the folder of the new dataset; give out=…")
    if _is_same_folder(any_path(call.values["out"]), folder):
        raise ConfigError(f"again: out={call.values['out']}: is the dataset itself; expected another folder")
    root = _root(call)
    if kind != "folder" and root is not None:
        raise ConfigError(
            f"again: source.root={root}: {folder} was generated from a source of kind {kind}; expected no root; "
            "leave source.root out"
        )
    if kind == "folder":
        root = source_root(folder / "manifest.csv", root)
        if root is None:
            raise ConfigError(
                f"again: source.root is missing: {folder} does not record the folder of its sources; expected "
                "that folder; give source.root=…"
            )
    config.out, config.source.root = call.values["out"], root
    _refuse_unused_places(config, call, folder)
    set_dark_places(config, _dark_places(folder / "manifest.csv", call))
    config.n_jobs = call.values.get("n_jobs", config.n_jobs)
    config.source.max_failed = call.values.get("max_failed", config.source.max_failed)
    config.executor = _executor(call)
    validate_config(config)
    old, new = folder / "manifest.csv", any_path(config.out) / "manifest.csv"
    if root is not None and any_path(root).exists() and old.exists():
        check_source_sizes(old, root)
    code, _, lines = generate_dataset(config)
    print_results(lines)
    if not old.exists():
        print_result(f"{folder} has no manifest.csv to compare with")
    elif not have_same_rows(old, new):
        check_source_digests(old, new)
        raise DamageError(f"{new}: differs from {old}; check that the sources are the same")
    elif old.stat().st_size == new.stat().st_size:
        print_result(f"the same as {folder}, bit for bit")
    else:
        print_result(f"the same rows as {folder}, in its columns; {new} has columns of a later version too")
    return code


def _refuse_unused_places(config: Config, call: Call, folder: AnyPath) -> None:
    """Raise ConfigError if a call of ``again`` names dark frames or a map that the dataset does not have."""
    for name, key in (("dark_frames", "dark_frames_sha256"), ("dark_shading", "dark_shading_sha256")):
        if name in call.values and getattr(config.noise, key) is None:
            what = "dark frames" if name == "dark_frames" else "dark-shading map"
            raise ConfigError(
                f"again: noise.{name}={call.values[name]}: {folder} was generated without {what}; leave it out"
            )


def _dark_places(manifest: AnyPath, call: Call) -> DarkPlaces:
    """Return where the dark frames of a dataset and their map are, by the call or by ``dataset.json``."""
    from unprocess_gen.pipeline.replay import dark_places

    return dark_places(manifest, call.values.get("dark_frames"), call.values.get("dark_shading"))


def _is_same_folder(one: AnyPath, other: AnyPath) -> bool:
    if isinstance(one, Path) and isinstance(other, Path):
        return one.resolve() == other.resolve()
    return one == other


def run_verify(call: Call) -> int:
    """Verify a dataset, or every dataset of a sweep; a sweep's exit code is the worst of its datasets."""
    from unprocess_gen.pipeline.verify import is_sweep, verify, verify_sweep

    folder = _dataset("verify", call, sweeps=True)
    _root(call)
    if "to" in call.values:
        if "noise" not in call.values:
            raise ConfigError(f"verify: --to {call.values['to']}: draws the fits of --noise; add --noise")
        from unprocess_gen.reports.photon_transfer import check_figure_file

        check_figure_file(Path(call.values["to"]))
    if not is_sweep(folder):
        return _finish_verification(folder, verify(folder), call)
    codes = []
    for result in verify_sweep(folder):
        try:
            codes.append(_finish_verification(folder / result.folder, result.damages, call))
        except UnprocessGenError as error:  # the other datasets are verified nevertheless
            codes.append(report_error(error))
    intact = codes.count(0)
    print_result(f"{folder}: {intact} of {len(codes)} datasets are intact")
    return worst(codes)


def _finish_verification(folder: AnyPath, found: Iterable[Damage], call: Call) -> int:
    """Report the damage of a dataset; repair, regenerate and check the noise as the flags ask; return the exit code."""
    from unprocess_gen.pipeline.repair import repair
    from unprocess_gen.pipeline.replay import evenly_spaced_rows, replay, source_root
    from unprocess_gen.pipeline.verify import verify

    manifest, root = folder / "manifest.csv", call.values.get("source")
    dark = _dark_places(manifest, call)
    codes: list[int] = []
    damages = _reported(folder, found)
    is_finished = any((folder / name).exists() for name in ("dataset.json", "manifest.csv"))  # not so in a sweep
    if damages and is_finished and "repair" in call.values:
        if not isinstance(folder, Path):
            raise ConfigError(f"verify: --repair: {folder} is in an object store; expected a local copy of the dataset")
        for step in repair(folder, source_root(manifest, root), dark):
            if step.repaired:
                print_result(step)
            else:
                report(str(step), logging.ERROR)
            codes.append(step.exit_code)
        damages = _reported(folder, verify(folder))
    count, regenerated = call.values.get("regenerate", 0), 0
    if count and not damages:
        rows = evenly_spaced_rows(manifest, count)
        replayed = list(replay(rows, source_root(manifest, root), dark=dark))
        regenerated, codes = len(replayed), [result.exit_code for result in replayed]
        damages += _reported(folder, (_complaint(result) for result in replayed if result.complaint))
    if "noise" in call.values and not damages:
        damages += _check_noise(folder, dark, call)
    if damages:
        return worst(codes) or DamageError.exit_code
    print_result(
        f"{folder} is intact" + (f"; {counted(regenerated, 'pair')} regenerated, bit for bit" if regenerated else "")
    )
    return 0


def _complaint(result: ReplayResult) -> str:
    return f"{result.key} ({result.source}): {result.complaint}"


def _check_noise(folder: AnyPath, dark: DarkPlaces, call: Call) -> list[str]:
    """Compare the noise in the arrays with the manifest's numbers; return what does not fit."""
    from unprocess_gen.reports import photon_transfer

    to, access = call.values.get("to"), None
    try:
        access = dark.open()
    except ConfigError:  # without the recorded files, the pairs are counted as not checked
        if {"dark_frames", "dark_shading"} & call.values.keys():
            raise
    found = photon_transfer.examine_dataset(folder, access)
    checks = found.checks
    if not checks.count:
        print_result(
            f"{folder}: no pair can be checked: too few usable sites, or dark frames that are not available; "
            "noise.dark_frames=FOLDER names their folder, noise.dark_shading=PATH their map"
        )
        return []
    if found.worst is not None:
        print_result(
            f"noise of {counted(found.count, 'pair')} fitted (a, b with 95 % intervals); "
            f"the farthest from its row: {found.worst}"
        )
    unchecked = f"; {checks.unchecked} not checked: too few usable sites, or a dark frame that is not available"
    print_result(
        f"noise of {counted(checks.count, 'pair')} checked, {checks.wrong_pairs} wrong"
        + (unchecked if checks.unchecked else "")
    )
    if to is not None:
        photon_transfer.draw_fits(found.first, Path(to))
        print_result(f"drawn in {to}")
    unlisted = checks.wrong_pairs - sum(bool(alarm.key) for alarm in checks.alarms)
    more = [f"noise of {counted(unlisted, 'other pair')}: wrong too"] if unlisted else []
    return _reported(folder, [*map(str, checks.alarms), *more])


def _reported(folder: AnyPath, damages: Iterable[object]) -> list[str]:
    """Report damages on stderr; return them as text."""
    texts = [str(damage) for damage in damages]
    for text in texts:
        report(f"{folder}: {text}", logging.ERROR)
    return texts


def run_replay(call: Call) -> int:
    """Regenerate rows of a manifest, and compare or write their arrays."""
    from unprocess_gen.dataset.selection import select_rows
    from unprocess_gen.pipeline.replay import replay, source_root

    if {"rows", "keys"} <= call.values.keys():
        raise ConfigError("replay: --rows and --keys exclude each other; expected one of them")
    manifest = _dataset("replay", call, files=True)
    manifest = manifest / "manifest.csv" if manifest.is_dir() else manifest
    to = Path(call.values["to"]) if "to" in call.values else None
    skipped: list[Row] = []
    rows = _ok_rows(select_rows(manifest, call.values.get("rows"), call.values.get("keys"), skipped), skipped)
    codes, written = [], False
    for result in replay(rows, source_root(manifest, _root(call)), to, _dark_places(manifest, call)):
        codes.append(result.exit_code)
        written |= result.written
        if result.complaint:
            report(_complaint(result), logging.ERROR)
    same = codes.count(0)
    others = len(codes) - same
    print_result(
        f"{counted(same, 'pair')} {_are(same)} the same, bit for bit; {others} {_are(others)} not"
        + (f"; arrays in {to}" if written else "")
        + _skipped(len(skipped))
    )
    return worst(codes)


def _ok_rows(rows: Iterable[Row], failed: list[Row]) -> Iterator[Row]:
    """Yield the rows of pairs; append failed rows to a list."""
    for row in rows:
        if row["status"] == "ok":
            yield row
        else:
            failed.append(row)


def _are(count: int) -> str:
    return "is" if count == 1 else "are"


def _skipped(failed: int) -> str:
    """Return the end of a verb's result that counts failed rows."""
    return f"; {counted(failed, 'failed row')} skipped" if failed else ""


def run_report(call: Call) -> int:
    """Write the HTML page of a dataset."""
    from unprocess_gen.reports.dataset_page.page import write_dataset_report

    folder = _dataset("report", call)
    to, root = call.values.get("to"), _root(call)
    dark = _dark_places(folder / "manifest.csv", call)
    if {"dark_frames", "dark_shading"} & call.values.keys():
        dark.open()  # refuses places that the user names and that do not exist
    print_result(
        write_dataset_report(folder, None if to is None else Path(to), None if root is None else any_path(root), dark)
    )
    return 0


def run_preview(call: Call) -> int:
    """Draw contact sheets of pairs."""
    from unprocess_gen.dataset.selection import select_pairs
    from unprocess_gen.pipeline.replay import source_root
    from unprocess_gen.reports.sheets.contact_sheet import write_sheets

    folder = _dataset("preview", call)
    to, root, with_stages = _folder_to("preview", call), _root(call), "stages" in call.values
    keys: list[str] = []
    failed = files = 0
    if "keys" in call.values:
        selected = select_pairs(folder / "manifest.csv", call.values["keys"])
        keys, failed = [str(row["key"]) for row in selected.rows.values()], selected.failed
    photographs = source_root(folder / "manifest.csv", root)
    _check_not_among_photographs(to, photographs)
    code = 0
    for sheet in write_sheets(folder, to, keys, None if root is None else any_path(root), with_stages):
        files += len(sheet.files)
        if sheet.missing_source:
            code = SourceChangedError.exit_code if photographs is not None else code
            omitted = "the source's panel and the stages are" if with_stages else "the source's panel is"
            report(f"{sheet.key} ({sheet.source}): {omitted} omitted: {sheet.missing_source}")
    print_result(f"{counted(files, 'picture')} in {to}{_skipped(failed)}")
    return code


def _check_not_among_photographs(to: Path, root: str | None) -> None:
    """Refuse a folder for pictures inside the folder of the sources, of which the next run would make pairs."""
    if root is None or is_url(root) or not Path(root).is_dir():
        return
    place = Path(os.path.realpath(root))
    if place in (resolved := Path(os.path.realpath(to)), *resolved.parents):
        raise ConfigError(
            f"--to {to}: is inside the folder of the photographs, {root}; expected a folder outside of it, because "
            "runs would read the pictures; choose another folder"
        )


def run_dng(call: Call) -> int:
    """Write frames as DNG files."""
    from unprocess_gen.dataset.dng import FRAMES, export
    from unprocess_gen.dataset.selection import select_pairs

    folder = _dataset("dng", call)
    if "keys" not in call.values:
        raise ConfigError("dng: --keys is missing; expected the keys of the rows to write; give --keys K,…")
    to = _folder_to("dng", call)
    frames = [frame for frame in FRAMES if frame in call.values] or FRAMES
    exported = export(folder, call.values["keys"], frames, to)
    failed = select_pairs(folder / "manifest.csv", call.values["keys"]).failed
    counts = (
        (exported.written, f"{counted(exported.written, 'DNG file')} written"),
        (exported.present, f"{exported.present} existed with the same bytes"),
        (
            exported.without_profile,
            f"{counted(exported.without_profile, 'noisy frame')} without NoiseProfile, which cannot describe the noise",
        ),
        (failed, f"{counted(failed, 'failed row')} skipped"),
    )
    print_result(f"{to}: " + "; ".join(text for count, text in counts if count))
    return 0


def _folder_to(verb: str, call: Call) -> Path:
    if "to" not in call.values:
        raise ConfigError(f"{verb}: --to is missing; expected the folder to write to; give --to FOLDER")
    return Path(call.values["to"])


def _root(call: Call) -> str | None:
    """Return the root that the user gives; ConfigError if it is no folder or photograph, None if none is given."""
    from unprocess_gen.sources.listing import check_root

    root: str | None = call.values.get("source")
    if root is not None:
        check_root(root)
    return root


def _place(verb: str) -> str:
    place = VERBS[verb].place
    assert place is not None
    return place.expected


def _dataset(verb: str, call: Call, *, files: bool = False, sweeps: bool = False) -> AnyPath:
    """Return the verb's dataset; refuse anything else, and for a sweep name one of its datasets.

    ``files`` accepts the file of a manifest too, ``sweeps`` the folder of a sweep.
    """
    path = call.path
    assert path is not None
    # a dataset that was deleted is damage, as in version 0.1; only again, which reads settings, calls it wrong usage
    missing: type[UnprocessGenError] = ConfigError if verb == "again" else DamageError
    # lexists is False for names that are too long, too
    if not (path.exists() if isinstance(path, ObjectPath) else os.path.lexists(path)):
        kind = "file or folder" if files else "folder"
        raise missing(f"{verb}: {path}: no such {kind}; expected {_place(verb)}")
    if not path.is_dir():
        if files:
            return path
        raise ConfigError(f"{verb}: {path}: is a file; expected {_place(verb)}")
    is_sweep = (path / "sweep.csv").is_file()
    if not is_sweep and not any((path / name).exists() for name in DATASET_ENTRIES):
        raise missing(f"{verb}: {path}: not a dataset; expected {_place(verb)}")
    if sweeps:
        return path
    if is_sweep and not (path / "dataset.json").exists():
        datasets = sorted(str(folder) for folder in path.iterdir() if (folder / "dataset.json").is_file())
        example = f", such as {datasets[0]}" if datasets else ""
        raise ConfigError(f"{verb}: {path}: is the folder of a sweep; expected one of its datasets{example}")
    return path


# ------------------------------------------------------------------------------------------------------- the table

DARK_FRAMES = Argument(
    ("--dark-frames", "noise.dark_frames"),
    "folder of the dark frames, if it is not the recorded one",
    "FOLDER",
    completes="folders",
)
DARK_SHADING = Argument(
    ("--dark-shading", "noise.dark_shading"),
    "dark-shading map, or folder of maps, if it is not the recorded one",
    "PATH",
    completes="files",
)
DATASET = Place("DIR", "the folder of a dataset")
KEYS = Argument(
    ("--keys",), "rows by source index, range or key, such as 3,7-9,00000012-p0007", "KEYS", expected="keys"
)


def _count(text: str) -> int:
    if (number := int(text)) < 0:
        raise ValueError
    return number


def _positive(text: str) -> int:
    if (number := int(text)) < 1:
        raise ValueError
    return number


def _whole_number(names: tuple[str, ...], text: str, metavar: str = "N") -> Argument:
    return Argument(names, text, metavar, int, "an integer")


def _local_path(text: str) -> str:
    if "://" in text:  # it would become a folder named after the scheme
        raise ValueError
    return text


def _to(text: str, metavar: str, *, required: bool = False) -> Argument:
    kind = metavar.lower()
    return Argument(("--to",), text, metavar, _local_path, f"a local {kind}", f"{kind}s", required)


PREPARED = Place("OUT", "the folder of a prepared run")
PART = Argument(("part",), "number of the part, from 0", "K", _count, "an integer of 0 or more")

SETTINGS_SOURCE = Argument(
    ("--source",), "folder of the photographs, or one photograph: source.root=ROOT", "ROOT", completes="files"
)

VERBS: dict[str, Verb] = {
    verb.name: verb
    for verb in (
        Verb(
            "generate",
            "generate a dataset; the default verb",
            run_generate,
            (SETTINGS_SOURCE,),
            composes=True,
            resumes=True,
        ),
        Verb(
            "prepare",
            "list the sources of a run and split it into parts, for separate jobs",
            run_prepare,
            (
                Argument(("parts",), "number of parts", "N", _positive, "an integer of 1 or more", required=True),
                SETTINGS_SOURCE,
            ),
            composes=True,
        ),
        Verb(
            "part",
            "generate part K (from 0) of a prepared run; default: that of the array job",
            run_part,
            (
                _whole_number(("n_jobs",), "number of worker processes; -1: all cores; default: as prepared"),
                Argument(
                    ("--source", "source.root"), "folder of the photographs on this host", "ROOT", completes="folders"
                ),
            ),
            PREPARED,
            extra=PART,
            resumes=True,
        ),
        Verb(
            "status",
            "show which parts of a prepared run are left",
            run_status,
            (Argument(("--left",), "print only the numbers of the parts that are left: 3,7-9"),),
            PREPARED,
        ),
        Verb(
            "merge",
            "write manifest.csv and dataset.json when all parts are finished",
            run_merge,
            place=PREPARED,
        ),
        Verb(
            "plan",
            "estimate pairs, bytes and time, and explain the effects; write nothing",
            run_plan,
            (Argument(("--all",), "read every photograph, for exact sizes"), SETTINGS_SOURCE),
            composes=True,
        ),
        Verb(
            "accuracy",
            "measure error and time of each tier; write a report; default out: accuracy",
            run_accuracy,
            (SETTINGS_SOURCE,),
            composes=True,
        ),
        Verb(
            "figures",
            "draw the article's figures for the first photograph; default out: figures",
            run_figures,
            (SETTINGS_SOURCE,),
            composes=True,
        ),
        Verb(
            "verify",
            "check every byte of a dataset or sweep; repair, regenerate, check noise",
            run_verify,
            (
                SOURCE,
                DARK_FRAMES,
                DARK_SHADING,
                Argument(
                    ("--regenerate",), "regenerate N pairs and compare them", "N", _count, "an integer of 0 or more"
                ),
                _to("with --noise: draw the fits in FILE (PNG)", "FILE"),
                Argument(("--repair",), "restore damaged files to the same bytes"),
                Argument(("--noise",), "check whether the noise in the arrays is that of the manifest"),
            ),
            Place("DIR", "the folder of a dataset or of a sweep"),
        ),
        Verb(
            "replay",
            "regenerate rows and compare them, or write their arrays",
            run_replay,
            (
                SOURCE,
                DARK_FRAMES,
                DARK_SHADING,
                Argument(("--rows",), "rows A to B by position, from 0, B not included", "A:B"),
                KEYS,
                _to("write the arrays to FOLDER", "FOLDER"),
            ),
            Place("MANIFEST", "a manifest.csv, or the folder of a dataset", "files"),
        ),
        Verb(
            "report",
            "write an HTML page about a dataset",
            run_report,
            (
                _to("write FILE instead of DIR/report.html", "FILE"),
                SOURCE,
                DARK_FRAMES,
                DARK_SHADING,
            ),
            DATASET,
        ),
        Verb(
            "preview",
            "draw contact sheets of pairs, and of each processing step",
            run_preview,
            (
                KEYS,
                _to("write the pictures to FOLDER", "FOLDER", required=True),
                SOURCE,
                Argument(("--stages",), "draw each processing step too"),
            ),
            DATASET,
        ),
        Verb(
            "dng",
            "write frames as DNG files, for raw converters",
            run_dng,
            (
                replace(KEYS, required=True),
                _to("write the files to FOLDER", "FOLDER", required=True),
                Argument(("--noisy",), "only noisy frames"),
                Argument(("--clean",), "only clean frames"),
            ),
            DATASET,
        ),
        Verb(
            "again",
            "regenerate a dataset from its config.yaml in another folder, and compare",
            run_again,
            (
                SOURCE,
                DARK_FRAMES,
                DARK_SHADING,
                Argument(("out",), "folder of the new dataset", "FOLDER", completes="folders", required=True),
                _whole_number(("n_jobs",), "number of worker processes; -1: all cores"),
                Argument(("executor",), "what runs the workers: local or dask", "NAME"),
                Argument(("executor.address",), "address of a Dask scheduler", "ADDRESS"),
                _whole_number(("source.max_failed",), "largest number of failed sources with exit code 0"),
            ),
            DATASET,
            resumes=True,
        ),
        Verb(
            "completion",
            'print a completion script: eval "$(gen-dataset completion bash)"',
            lambda call: print_completion(call, VERBS),
            words=SHELLS,
        ),
    )
}
"""The verbs by name, in the order of the help."""
