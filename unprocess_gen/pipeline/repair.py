"""Repair a dataset: regenerate its damaged files to the same bytes; nothing of a damaged file is kept.

``dataset.json`` contains the config and the digests of all other files. A shard is regenerated from its rows in the
manifest and their sources, the manifest from the config and all sources. Each file is written to a temporary file, and
replaces the damaged one if its digest is the recorded one. A damaged ``dataset.json`` is rewritten if the other
files agree; its facts about the run (time, host, versions) are lost. Repair uses one process: if most of a dataset is
damaged, ``gen-dataset again`` is faster.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import dataset_yaml, read_dataset_yaml
from unprocess_gen.core.arrays import Array
from unprocess_gen.core.errors import ConfigError, DamageError, MachineError, SourceChangedError, UnprocessGenError
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.paths import absolute_text
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.dataset_json import dataset_facts, dataset_text, fingerprint, read_dataset
from unprocess_gen.dataset.keys import group_by_sample
from unprocess_gen.dataset.manifest import read_rows, write_rows
from unprocess_gen.dataset.row import columns_of, has_frames
from unprocess_gen.dataset.shards import ShardWriter, arrays_of, shard_name
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.replay import ADVICE, PairRegenerator, check_root, source_changes
from unprocess_gen.pipeline.run import resolve
from unprocess_gen.pipeline.tasks import RunContext, ShardResult, Tally, tar_name
from unprocess_gen.pipeline.verify import CONFIG, DATASET, MANIFEST, expected_samples, shard_rows, verify
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
        config, kind = _read_config(folder, root)
        if facts and MANIFEST in damaged:
            check_root(folder, kind, root)
            _restore_manifest(place, replaced(config, {"noise.dark_frames": dark_frames}), facts["manifest_sha256"])
            yield RepairStep(f"{MANIFEST}: regenerated from the settings and the sources")
            damaged = {damage.file for damage in verify(folder)}
        regenerator = PairRegenerator(root, dark_frames)
        for number, rows in shard_rows(folder / MANIFEST):
            if tar_name(number) in damaged:
                yield _regenerate_shard(place, number, [*filter(has_frames, rows)], regenerator)
        if not facts:
            place.write(DATASET, _dataset_json(folder, {"kind": kind, "root": absolute_text(root)}).encode())
            yield RepairStep(f"{DATASET}: rewritten; host, time and versions of the run are lost")


def _read_config(folder: Path, root: str | None) -> tuple[Config, str]:
    """Read the settings with the place of the sources, and the kind of the sources."""
    config, kind = read_dataset_yaml(folder / CONFIG)
    return replaced(config, source_changes(None if kind == "synthetic" else root or "", folder)), kind


def _check_proof(folder: Path, damaged: set[str]) -> None:
    """Raise DamageError unless a damaged ``dataset.json`` still proves the other files, or without it they agree."""
    dataset = folder / DATASET
    left = dataset.read_text(errors="replace") if dataset.is_file() else ""
    try:
        own = file_sha256(folder / CONFIG), file_sha256(folder / MANIFEST)
        agree = fingerprint(*own) in left or all(f'"{digest}"' in left for digest in own)
        if len(left) < LEAST_PROOF:
            text = (folder / CONFIG).read_text(encoding="utf-8")
            agree = damaged == {DATASET} and dataset_yaml(_read_config(folder, None)[0]) == text
    except (OSError, ValueError, ConfigError, DamageError):
        agree = False
    if not agree:
        raise DamageError(f"{folder}: {DATASET} and another file are damaged; {AGAIN}")


def _restore_manifest(place: OutFolder, config: Config, sha256: str) -> None:
    """Regenerate every row, and write them as the manifest if they have its digest."""
    run, part = resolve(config), place.scratch / MANIFEST
    context = RunContext(run.settings, str(place.scratch), os.getpid())

    def rows() -> Iterator[Row]:
        for shard in range(run.shards):
            made = make_shard(context, run.task(shard))
            if made.path is not None:
                Path(made.path).unlink()
            yield from made.rows

    with part.open("w", encoding="utf-8", newline="") as stream:
        write_rows(stream, rows(), columns_of(run.config))
    if file_sha256(part) != sha256:
        raise SourceChangedError(
            f"{place}/{MANIFEST}: the regenerated one has another SHA-256: a source was changed, added or "
            f"deleted; {ADVICE}"
        )
    (place / MANIFEST).commit(part)


def _regenerate_shard(place: OutFolder, number: int, rows: Sequence[Row], regenerator: PairRegenerator) -> RepairStep:
    """Regenerate a shard; an error becomes a step, so that other shards are repaired nevertheless."""
    name, part = tar_name(number), place.scratch / shard_name(number)
    try:
        with ShardWriter(part) as writer:
            for sample, sample_rows in zip(expected_samples(rows), group_by_sample(rows), strict=True):
                frames: dict[str, Array] = {}
                for row in sample_rows:
                    arrays = regenerator.regenerate_exactly(row)
                    frames |= {stored.member: arrays[array] for array, stored in arrays_of(row).items()}
                for frame in sample.frames:
                    writer.add_frame(sample.key, frame.member, frames[frame.member])
                writer.add_rows(sample.key, sample.json)
    except UnprocessGenError as error:
        exit_code = error.exit_code if isinstance(error, MachineError) else DamageError.exit_code
        return RepairStep(f"{name}: cannot be regenerated: {error}", exit_code)
    (place / "shards").mkdir(exist_ok=True)
    (place / name).commit(part)
    return RepairStep(f"{name}: regenerated")


def _dataset_json(folder: Path, source: dict[str, Any]) -> str:
    """Describe the other files of a dataset as ``dataset.json`` does."""
    manifest, entries = folder / MANIFEST, []
    for number, rows in shard_rows(manifest):
        path = folder / tar_name(number)
        result = ShardResult(number, rows=rows)
        if path.is_file():
            result.path, result.bytes, result.sha256 = str(path), path.stat().st_size, file_sha256(path)
        entries.append(result.entry())
    lost = dict.fromkeys(("not_matched", "skipped_links", "run", "versions"))
    facts = Tally.of(read_rows(manifest)).facts() | lost | {"source": source}
    text = (folder / CONFIG).read_bytes().decode()
    return dataset_text(dataset_facts(text, file_sha256(manifest), entries, facts))
