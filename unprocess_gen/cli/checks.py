"""Run the verbs that compare a dataset with what it records: verify and replay."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import ANY_DATASET, INPUTS, KEYS, Call, Operand, count, flag, local, switch, verb
from unprocess_gen.cli.messages import print_results, report, report_error
from unprocess_gen.cli.places import dataset_folder, given_places, given_root
from unprocess_gen.cli.sweep import worst
from unprocess_gen.core.errors import ConfigError, DamageError, UnprocessGenError
from unprocess_gen.reports.formatting import counted

if TYPE_CHECKING:
    from unprocess_gen.core.paths import AnyPath
    from unprocess_gen.dataset.columns import Row
    from unprocess_gen.pipeline.replay import ReplayResult


@verb(
    ANY_DATASET,
    flag("--regenerate", "N", "regenerate N pairs and compare them", count),
    switch("--repair", "restore damaged files to the same bytes"),
    switch("--noise", "check whether the noise in the arrays is that of the manifest"),
    flag("--against", "FRAMES", "compare raw darks and flats of a camera with the noise profile", local),
    keys=INPUTS,
)
def verify(call: Call) -> int:
    """Check every byte of a dataset or sweep; repair, regenerate, check noise."""
    from unprocess_gen.pipeline.verify import is_sweep, verify, verify_sweep

    folder = dataset_folder(call, sweeps=True)
    given_root(call)
    if call.noise and call.against:
        raise ConfigError("verify: --noise and --against exclude each other; expected one of them")
    if not is_sweep(folder):
        return _finish(folder, verify(folder), call)
    if call.against:
        raise ConfigError(f"verify: --against: {folder} is a sweep; expected one of its datasets")
    codes = []
    for result in verify_sweep(folder):
        try:
            codes.append(_finish(folder / result.folder, result.damages, call))
        except UnprocessGenError as error:  # the other datasets are verified nevertheless
            codes.append(report_error(error))
    print_results(f"{folder}: {codes.count(0)} of {len(codes)} datasets are intact")
    return worst(codes)


def _finish(folder: AnyPath, damages: Iterable[object], call: Call) -> int:
    """Report the damage of a dataset; repair, regenerate and check the noise as the flags ask; return the exit code."""
    from unprocess_gen.pipeline.verify import verify

    texts, codes, done = _reported(folder, damages), [], ""
    is_finished = any((folder / name).exists() for name in ("dataset.json", "manifest.csv"))  # not so in a sweep
    if texts and is_finished and call.repair:
        codes = _repair(folder, call)
        texts = _reported(folder, verify(folder))
    elif texts and is_finished and isinstance(folder, Path):
        report(f"{folder}: to restore damaged files, run gen-dataset verify {shlex.quote(str(folder))} --repair")
    if not texts and call.regenerate:
        results = _regenerated(folder, call)
        codes = [result.exit_code for result in results]
        done = f"; {counted(len(results), 'pair')} regenerated, bit for bit"
        texts = _reported(folder, (_complaint(result) for result in results if result.complaint))
    if not texts and call.noise:
        texts = _check_noise(folder, call)
    if not texts and call.against:
        texts = _compare_frames(folder, call.against)
    if texts:
        return worst(codes) or DamageError.exit_code
    print_results(f"{folder} is intact{done}")
    return 0


def _repair(folder: AnyPath, call: Call) -> list[int]:
    """Restore damaged files and report each step; the exit codes of the steps."""
    from unprocess_gen.core.paths import local_path
    from unprocess_gen.pipeline.repair import repair

    refusal = f"verify: --repair: {folder} is in an object store; expected a local copy of the dataset"
    places, codes = given_places(folder, call), []
    for step in repair(local_path(folder, refusal), places.root, places.dark_frames):
        (report if step.exit_code else print_results)(step.text)
        codes.append(step.exit_code)
    return codes


def _regenerated(folder: AnyPath, call: Call) -> list[ReplayResult]:
    """Regenerate rows that are spread evenly over the dataset, and compare them."""
    from unprocess_gen.core.sequences import evenly_spaced
    from unprocess_gen.dataset.reader import DatasetRows
    from unprocess_gen.pipeline.replay import replay

    pairs, places = DatasetRows(folder), given_places(folder, call)
    rows = map(pairs.row, evenly_spaced(range(len(pairs)), call.regenerate))
    return list(replay(rows, places.root, dark_frames=places.dark_frames))


def _complaint(result: ReplayResult) -> str:
    return f"{result.key} ({result.source}): {result.complaint}"


def _check_noise(folder: AnyPath, call: Call) -> list[str]:
    """Compare the noise in the arrays with the manifest's numbers; what does not fit."""
    from unprocess_gen.dataset.reader import RawPairs
    from unprocess_gen.pipeline.progress import with_bar
    from unprocess_gen.reports.noise_check.alarms import check_pairs
    from unprocess_gen.sources.dark_frames import dark_folder

    dark_frames = given_places(folder, call).dark_frames
    try:
        access = None if dark_frames is None else dark_folder(dark_frames)
    except ConfigError:  # without the recorded files, the pairs are counted as not checked
        if "noise.dark_frames" in call.settings:
            raise
        access = None
    pairs = RawPairs(folder)
    checks = check_pairs(with_bar(pairs, "pair checked", len(pairs)), len(pairs), access)
    reasons = "too few usable sites, or a dark frame that is not available"
    if not checks.count:
        print_results(f"{folder}: no pair can be checked: {reasons}; noise.dark_frames=FOLDER names their folder")
        return []
    unchecked = f"; {checks.unchecked} not checked: {reasons}" if checks.unchecked else ""
    print_results(f"noise of {counted(checks.count, 'pair')} checked, {checks.wrong_pairs} wrong{unchecked}")
    unlisted = checks.wrong_pairs - sum(bool(alarm.key) for alarm in checks.alarms)
    more = [f"noise of {counted(unlisted, 'other pair')}: wrong too"] if unlisted else []
    return _reported(folder, [*checks.alarms, *more])


def _compare_frames(folder: AnyPath, frames: Path) -> list[str]:
    """Compare raw frames of a camera with the profile of a dataset; what differs."""
    from unprocess_gen.config.serialization import read_dataset_yaml
    from unprocess_gen.pipeline.progress import with_bar
    from unprocess_gen.reports.against import compare_frames

    config, _ = read_dataset_yaml(folder / "config.yaml")
    comparisons = compare_frames(config, frames, partial(with_bar, unit="frame"))
    for note in comparisons.notes:
        report(note)
    numbers = f"{counted(len(comparisons.numbers), 'number')} compared with the profile {config.noise.name}"
    print_results(f"{frames}: {numbers}, {len(comparisons.differences)} wrong")
    return _reported(folder, comparisons.differences)


def _reported(folder: AnyPath, damages: Iterable[object]) -> list[str]:
    """Report damages on stderr; return them as text."""
    texts = [str(damage) for damage in damages]
    for text in texts:
        report(f"{folder}: {text}")
    return texts


@verb(
    Operand("MANIFEST", "a manifest.csv, or the folder of a dataset"),
    KEYS,
    flag("--to", "FOLDER", "write the arrays to FOLDER", local),
    keys=INPUTS,
)
def replay(call: Call) -> int:
    """Regenerate rows and compare them, or write their arrays."""
    from unprocess_gen.dataset.selection import select_rows
    from unprocess_gen.pipeline.replay import replay

    manifest = dataset_folder(call, files=True)
    manifest = manifest / "manifest.csv" if manifest.is_dir() else manifest
    failed: list[Row] = []
    rows = _ok_rows(select_rows(manifest, call.keys, failed), failed)
    codes, written, unknown = [], False, 0
    places = given_places(manifest.parent, call)
    for result in replay(rows, places.root, call.to, places.dark_frames):
        codes.append(result.exit_code)
        written |= result.written
        unknown += not result.compared
        if result.complaint:
            report(_complaint(result))
    same = codes.count(0) - unknown
    others = len(codes) - codes.count(0)
    print_results(
        f"{counted(same, 'pair')} {_are(same)} the same, bit for bit; {others} {_are(others)} not"
        + (f"; {counted(unknown, 'row')} without digests" if unknown else "")
        + (f"; arrays in {call.to}" if written else "")
        + (f"; {counted(len(failed), 'failed row')} skipped" if failed else "")
    )
    return worst(codes)


def _ok_rows(rows: Iterable[Row], failed: list[Row]) -> Iterator[Row]:
    """Yield the rows of pairs; append failed rows to a list."""
    for row in rows:
        if row["status"] == "ok":
            yield row
        elif row["status"] == "failed":
            failed.append(row)


def _are(count: int) -> str:
    return "is" if count == 1 else "are"
