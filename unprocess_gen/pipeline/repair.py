"""Repair a dataset: regenerate its damaged files to the same bytes; nothing of a damaged file is kept.

``dataset.json`` contains the config and the digests of all other files. A shard is regenerated from its rows in the
manifest and their sources. The manifest is collected from the rows in intact shards; rows that are in none are
regenerated from the config and their sources. Each file is written to a temporary file, and replaces the damaged one
if its digest is the recorded one. A damaged ``dataset.json`` is rewritten if the other files agree; its facts about the
run (time, host, versions) are lost. Repair uses one process: if most of a dataset is damaged, ``gen-dataset again`` is
faster.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import dataset_yaml, read_dataset_yaml
from unprocess_gen.core.errors import (
    RESTORE,
    ConfigError,
    DamageError,
    MachineError,
    SourceChangedError,
    UnprocessGenError,
)
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.paths import absolute_text
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.dataset_json import dataset_facts, dataset_text, fingerprint, read_dataset, recorded_places
from unprocess_gen.dataset.keys import group_by_sample, image_key, key_text, sample_key
from unprocess_gen.dataset.manifest import csv_lines, shard_rows, write_manifest
from unprocess_gen.dataset.row import columns_of, has_frames, row_json
from unprocess_gen.dataset.shards import ShardWriter, shard_name, stored_rows
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.replay import PairRegenerator, check_root
from unprocess_gen.pipeline.run import Run, resolve
from unprocess_gen.pipeline.tasks import (
    ROWS,
    RunContext,
    ShardReport,
    ShardResult,
    ShardTask,
    count_facts,
    count_rows,
    read_records,
    tar_name,
)
from unprocess_gen.pipeline.verify import CONFIG, DATASET, MANIFEST, verify
from unprocess_gen.pipeline.worker import make_shard

LEAST_PROOF = 100
"""Characters of a ``dataset.json`` that may contain a digest of another file."""

AGAIN = "regenerate the dataset with the settings and sources it was made from"


class RepairStep(NamedTuple):
    """Report what was done about a damaged file; the exit code is 0, 4, or 5 if a source was changed or deleted."""

    text: str
    exit_code: int = 0


def repair(folder: Path, root: str | None, dark_frames: str | None = None) -> Iterator[RepairStep]:
    """Regenerate every damaged file of a dataset; yield a step for each.

    ``root`` is the folder of the sources, None for synthetic pictures or if no source is needed; ``dark_frames`` is
    that of dark frames. Raises LockedError if a run holds the folder, DamageError if several files are damaged and
    nothing proves what they were, ConfigError if sources are needed and ``root`` is None, SourceChangedError if the
    manifest is damaged and a source was changed or deleted, MachineError if a file cannot be read or written.
    """
    with OutFolder(folder) as place, machine_errors(folder):
        place.lock()
        damaged = {damage.file for damage in verify(folder)}
        facts: dict[str, Any] = {} if DATASET in damaged else read_dataset(folder / DATASET)
        if not facts:
            _check_proof(folder, damaged)
        elif CONFIG in damaged:
            place.write(CONFIG, facts["config"].encode())
            yield RepairStep(f"{CONFIG}: restored from {DATASET}")
        config, kind = _read_config(folder, root, dark_frames)
        if facts and MANIFEST in damaged:
            yield _restore_manifest(place, folder, facts, config, kind)
            damaged = {damage.file for damage in verify(folder)}
        regenerator = PairRegenerator(root, dark_frames)
        for number, rows in shard_rows(folder / MANIFEST):
            if tar_name(number) in damaged:
                sha256 = facts["shards"][number]["sha256"] if facts else None
                yield _regenerate_shard(place, number, [*filter(has_frames, rows)], regenerator, sha256)
        if not facts:
            place.write(DATASET, _dataset_json(folder, {"kind": kind, "root": absolute_text(root)}).encode())
            yield RepairStep(f"{DATASET}: rewritten; host, time and versions of the run are lost")


def _read_config(folder: Path, root: str | None = None, dark_frames: str | None = None) -> tuple[Config, str]:
    """Read the settings with the place of the sources, empty if it is unknown, and the kind of the sources."""
    config, kind = read_dataset_yaml(folder / CONFIG)
    places = recorded_places(folder, root, dark_frames)
    root = None if kind == "synthetic" else places.root or ""
    return replaced(config, {**places.settings, "source.root": root}), kind


def _check_proof(folder: Path, damaged: set[str]) -> None:
    """Raise DamageError unless a damaged ``dataset.json`` still proves the other files, or without it they agree."""
    dataset = folder / DATASET
    left = dataset.read_text(errors="replace") if dataset.is_file() else ""
    try:
        own = file_sha256(folder / CONFIG), file_sha256(folder / MANIFEST)
        agree = fingerprint(*own) in left or all(f'"{digest}"' in left for digest in own)
        if len(left) < LEAST_PROOF:
            text = (folder / CONFIG).read_text(encoding="utf-8")
            agree = damaged == {DATASET} and dataset_yaml(_read_config(folder)[0]) == text
    except (OSError, ValueError, ConfigError, DamageError):
        agree = False
    if not agree:
        raise DamageError(f"{folder}: {DATASET} and another file are damaged; {AGAIN}")


def _restore_manifest(place: OutFolder, folder: Path, facts: dict[str, Any], config: Config, kind: str) -> RepairStep:
    """Collect the rows of all sources, and write them as the manifest if they have its digest.

    Rows of pairs are in the shards. The records of a run with provisional rows have all rows. What is in neither, such
    as rows of failed sources, is regenerated.
    """
    columns, entries = columns_of(config), facts["shards"]
    stored = (csv_lines(_stored_rows(folder, entry), columns) for entry in entries)
    recorded = (read[1] for read in read_records(place, range(len(entries))) if read is not None)
    for name, texts in (("the shards", stored), (ROWS, recorded)):
        if _is_manifest(place, columns, texts, facts):
            return RepairStep(f"{MANIFEST}: restored from the rows in {name}")
    check_root(folder, kind, config.source.root or None)
    run = resolve(config)
    made = (
        csv_lines(_made_rows(place, run, number, _stored_rows(folder, entry)), columns)
        for number, entry in enumerate(entries)
    )
    if run.shards != len(entries) or not _is_manifest(place, columns, made, facts):
        raise SourceChangedError(
            f"{place}/{MANIFEST}: the regenerated one has another SHA-256: a source was changed, added or "
            f"deleted; {RESTORE}"
        )
    return RepairStep(f"{MANIFEST}: regenerated from the settings and the sources")


def _is_manifest(place: OutFolder, columns: Sequence[str], texts: Iterable[bytes], facts: dict[str, Any]) -> bool:
    """Write a manifest, given the lines of each shard, and put it in place if it has the recorded digest."""
    part = place.scratch / MANIFEST
    if write_manifest(part, columns, texts) != facts["manifest_sha256"]:
        return False
    (place / MANIFEST).commit(part)
    return True


def _stored_rows(folder: Path, entry: dict[str, Any]) -> list[Row]:
    """Rows in a shard, none unless it has its digest."""
    path = folder / str(entry["file"])
    return [*stored_rows(path)] if path.is_file() and file_sha256(path) == entry["sha256"] else []


def _made_rows(place: OutFolder, run: Run, number: int, stored: Sequence[Row]) -> list[Row]:
    """Rows of a shard: those that are stored in it, and those of its other sources, which are regenerated."""
    known = {image_key(row) for row in stored}
    sources = tuple(source for source in run.task(number).sources if key_text(source.index) not in known)
    if not sources:
        return [*stored]
    made = make_shard(RunContext(run.settings, str(place.scratch), os.getpid()), ShardTask(number, sources))
    if made.path is not None:
        Path(made.path).unlink()
    return sorted([*stored, *made.rows], key=lambda row: int(image_key(row)))


def _regenerate_shard(
    place: OutFolder, number: int, rows: Sequence[Row], regenerator: PairRegenerator, sha256: str | None
) -> RepairStep:
    """Regenerate a shard with a known digest; an error becomes a step, so that others are repaired nevertheless."""
    name, part = tar_name(number), place.scratch / shard_name(number)
    try:
        with ShardWriter(part) as writer:
            for sample in group_by_sample(rows):
                for row in sample:
                    writer.add_pair(row, regenerator.regenerate_exactly(row), is_first=row is sample[0])
                writer.add_rows(sample_key(sample[0]), row_json(sample))
        if sha256 not in (None, writer.sha256):
            raise DamageError(f"its SHA-256 is {writer.sha256}, {DATASET} records {sha256}")
    except UnprocessGenError as error:
        exit_code = error.exit_code if isinstance(error, MachineError) else DamageError.exit_code
        return RepairStep(f"{name}: cannot be regenerated: {error}", exit_code)
    (place / "shards").mkdir(exist_ok=True)
    (place / name).commit(part)
    return RepairStep(f"{name}: regenerated")


def _dataset_json(folder: Path, source: dict[str, Any]) -> str:
    """Describe the other files of a dataset as ``dataset.json`` does."""
    manifest, entries, counts = folder / MANIFEST, [], Counter[str]()
    for number, rows in shard_rows(manifest):
        counts.update(count_rows(rows))
        path = folder / tar_name(number)
        result = ShardResult(ShardReport(number), rows=rows)
        if path.is_file():
            result.path, result.bytes, result.sha256 = str(path), path.stat().st_size, file_sha256(path)
        entries.append(result.entry())
    lost = dict.fromkeys(("not_matched", "skipped_links", "run", "versions"))
    facts = count_facts(counts) | lost | {"source": source}
    text = (folder / CONFIG).read_bytes().decode()
    return dataset_text(dataset_facts(text, file_sha256(manifest), entries, facts))
