"""Repair a dataset: regenerate only what is damaged, to the same bytes, and prove it.

Each file can be restored from others. ``dataset.json`` contains the text of the config and the digests of all other
files. ``manifest.csv`` contains every row; the shards contain the rows of their pairs. A pair follows from its row and
its source. In a damaged shard only pairs whose arrays differ from their digests are regenerated, so photographs that
are missing cost their own pairs only. Every file is written to a temporary file and checked before it replaces the
damaged one. Files that are not part of the dataset are moved to ``set_aside``.

If ``dataset.json`` itself is damaged, its facts about the run (time, host, versions) may be lost. Repair uses one
process; if most of a dataset is damaged, ``gen-dataset again`` is faster.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import dataset_yaml, read_dataset_yaml, source_kind
from unprocess_gen.config.validation import check_parquet
from unprocess_gen.core.errors import ConfigError, DamageError, MachineError, SourceChangedError, UnprocessGenError
from unprocess_gen.core.files import commit_file, file_sha256, machine_errors
from unprocess_gen.core.records import parse_json
from unprocess_gen.core.roots import Root
from unprocess_gen.core.types import Array, Row
from unprocess_gen.dataset import parquet
from unprocess_gen.dataset.columns import COLUMN_NAMES, HEADERS
from unprocess_gen.dataset.dataset_json import PARQUET_SHA256
from unprocess_gen.dataset.keys import group_by_image, group_by_sample, image_key, key_text
from unprocess_gen.dataset.manifest import (
    has_frames,
    plan_from_row,
    read_rows,
    readable_rows,
    rows_of_json,
    write_rows,
)
from unprocess_gen.dataset.shards import (
    ExpectedSample,
    ShardWriter,
    arrays_of,
    check_members,
    intact_frames,
    json_inside,
    shard_name,
)
from unprocess_gen.pipeline.generate import source_facts
from unprocess_gen.pipeline.replay import ADVICE, PairRegenerator, source_changes
from unprocess_gen.pipeline.run import resolve
from unprocess_gen.pipeline.storage import Storage
from unprocess_gen.pipeline.tasks import RunContext, ShardLog, ShardResult, Tally
from unprocess_gen.pipeline.verify import expected_samples, shard_rows
from unprocess_gen.pipeline.worker import make_image
from unprocess_gen.pipeline.workspace import add_parquet, dataset_facts, dataset_text, fingerprint, read_dataset
from unprocess_gen.planning.plan import drawn_light

RecordedFacts = dict[str, Any]

AGAIN = "regenerate the dataset with the settings and sources it was made from"


@dataclass(frozen=True, slots=True)
class RepairStep:
    """Report what was done about one damaged file.

    Attributes
    ----------
    file : str
        Path below the dataset's folder.
    what : str
        What was done, or why the file could not be repaired.
    exit_code : int
        0 if the file was repaired; otherwise 4, or 5 if a source was changed or deleted.
    """

    file: str
    what: str
    exit_code: int = 0

    @property
    def repaired(self) -> bool:
        """True if the file is intact now."""
        return self.exit_code == 0

    def __str__(self) -> str:
        return f"{self.file}: {self.what}"


def repair(folder: Path, root: Root | None, dark_frames: str | None = None) -> Iterator[RepairStep]:
    """Restore every damaged file of a dataset; yield a step for each damaged or foreign file.

    ``root`` is the folder of the sources, None for built-in scenes or if no source is needed; ``dark_frames`` is that
    of dark frames. Raises LockedError if a run holds the folder, DamageError if config or manifest cannot be restored,
    ConfigError if sources are needed and ``root`` is None, SourceChangedError if the manifest must
    be regenerated and a source was changed or deleted, MachineError if a file cannot be read or written.
    """
    with closing(Storage(folder)) as storage, machine_errors(folder):
        storage.hold()
        yield from _Repair(folder, root, dark_frames, storage).steps()


class _Repair:
    """Hold a dataset under repair: its folder, the intact content of ``dataset.json`` (or {}), and its config."""

    def __init__(self, folder: Path, root: Root | None, dark_frames: str | None, storage: Storage) -> None:
        self._folder, self._root, self._dark_frames = folder, root, dark_frames
        self._storage, self._temporary = storage, storage.scratch
        self._config_file, self._manifest_file = folder / "config.yaml", folder / "manifest.csv"
        self._regenerator = PairRegenerator(root, dark_frames)
        try:
            self._facts = read_dataset(folder / "dataset.json")
        except DamageError:
            self._facts = {}

    def steps(self) -> Iterator[RepairStep]:
        """Restore config, manifest, shards, Parquet and ``dataset.json``, in this order: each needs those before."""
        yield from self._restore_settings()
        config = self._read_config()
        yield from self._restore_manifest(config)
        names = set()
        for number, rows in shard_rows(self._manifest_file):
            if pairs := [*filter(has_frames, rows)]:
                names.add(shard_name(number))
                yield from self._restore_shard(self._folder / "shards" / shard_name(number), pairs)
        for name in sorted((self._storage / "shards").entries().keys() - names):
            yield RepairStep(f"shards/{name}", f"moved to {self._move_aside(self._folder / 'shards' / name)}")
        if config.output.parquet:
            yield from self._restore_parquet(config)
        if not self._facts:
            yield self._restore_dataset_json(config)

    def _place(self, temporary: Path, path: Path) -> None:
        """Rename a finished file to its final name; create its folder if that was deleted."""
        path.parent.mkdir(exist_ok=True)
        commit_file(temporary, path)

    def _fingerprint(self) -> str:
        """Text that proves ``config.yaml`` and ``manifest.csv`` intact, but no other file."""
        return fingerprint(_digest(self._config_file), _digest(self._manifest_file))

    def _is_proved(self, *proofs: str) -> bool:
        """Check whether a damaged ``dataset.json`` still contains one of the texts that prove another file intact.

        Without this check, a repair after damage to two files would certify the damaged one. Config and manifest have
        several such texts, so that a flipped bit in one leaves another. If no digest at all is readable, nothing
        contradicts the file, and it is accepted.
        """
        try:
            left = (self._folder / "dataset.json").read_bytes()
        except OSError:
            return True
        return re.search(rb'"[0-9a-f]{64}"', left) is None or any(proof.encode() in left for proof in proofs)

    # ---------------------------------------------------------------------------------------------------- settings

    def _restore_settings(self) -> Iterator[RepairStep]:
        """Restore ``config.yaml`` from ``dataset.json``; raise DamageError if both are damaged."""
        digest = _digest(self._config_file)
        if self._facts:
            if digest == self._facts["config_sha256"]:
                return
            kept = str(self._facts.get("config", ""))
            if hashlib.sha256(kept.encode()).hexdigest() != self._facts["config_sha256"]:
                raise DamageError(f"{self._config_file}: dataset.json holds no copy of it; {AGAIN}")
            self._storage.write("config.yaml", kept)
            yield RepairStep("config.yaml", "restored from dataset.json")
            return
        proofs = digest, self._fingerprint()
        if not self._is_canonical() or not self._is_proved(*proofs, json.dumps(self._config_text())[1:-1]):
            raise DamageError(f"{self._folder}: both config.yaml and dataset.json are damaged; {AGAIN}")

    def _config_text(self) -> str:
        return self._config_file.read_bytes().decode("utf-8")

    def _is_canonical(self) -> bool:
        """Check whether ``config.yaml`` is exactly as a run writes it."""
        try:
            return dataset_yaml(self._read_config()) == self._config_text()
        except (ConfigError, OSError, ValueError):
            return False

    def _read_config(self) -> Config:
        config, kind = read_dataset_yaml(self._config_file)
        config = replaced(config, source_changes((self._root or "") if kind != "synthetic" else None, self._folder))
        return replaced(config, {"noise.dark_frames": self._dark_frames})

    # ---------------------------------------------------------------------------------------------------- manifest

    def _restore_manifest(self, config: Config) -> Iterator[RepairStep]:
        """Restore ``manifest.csv`` from the shards, or else from the sources, and check its digest."""
        path = self._manifest_file
        if not self._facts:
            if not _is_readable(path) or not self._is_proved(file_sha256(path), self._fingerprint()):
                raise DamageError(f"{self._folder}: both manifest.csv and dataset.json are damaged; {AGAIN}")
        elif _digest(path) == self._facts["manifest_sha256"]:
            return
        elif self._write_manifest(self._recorded_rows()):
            yield RepairStep("manifest.csv", "restored from the rows in the shards")
        elif self._write_manifest(self._regenerated_rows(config)):
            yield RepairStep("manifest.csv", "regenerated from the settings and the sources")
        else:
            raise SourceChangedError(
                f"{path}: the regenerated manifest has another SHA-256 than the lost one: a source was changed, added "
                f"or deleted; {ADVICE}"
            )

    def _write_manifest(self, rows: Iterable[Row]) -> bool:
        """Write rows as the manifest if they give its recorded digest with the header of any version."""
        complete, part = self._temporary / "all.csv", self._temporary / "manifest.csv"
        _write_csv(complete, rows, COLUMN_NAMES)
        for names in HEADERS:
            _write_csv(part, read_rows(complete), names)
            if file_sha256(part) == self._facts["manifest_sha256"]:
                self._place(part, self._manifest_file)
                return True
        return False

    def _recorded_rows(self) -> Iterator[Row]:
        """Yield the rows of pairs in intact shards and of failures in readable lines of the manifest, in order."""
        failures: dict[Any, list[Row]] = defaultdict(list)
        for row in readable_rows(self._manifest_file):
            if row["status"] != "ok":
                failures[row["shard"]].append(row)
        for number, entry in enumerate(self._facts["shards"]):
            yield from sorted([*self._rows_inside(entry), *failures[number]], key=lambda row: int(image_key(row)))

    def _rows_inside(self, entry: RecordedFacts) -> Iterator[Row]:
        """Yield the rows of an intact shard; columns that they lack are in its entry, or follow from the settings."""
        if entry["file"] is None or _digest(self._folder / entry["file"]) != entry["sha256"]:
            return
        contents, config = json_inside(self._folder / entry["file"]), self._read_config()
        clipped = itertools.chain(entry.get("light_clipped_high", ()), itertools.repeat(None))
        pairs = (row for content in contents for row in rows_of_json(content))
        images = group_by_image(
            {**row, "light_clipped_high": count} for row, count in zip(pairs, clipped, strict=False)
        )
        noises = itertools.chain(entry.get("source_noise_dn", ()), itertools.repeat(None))
        for rows, noise in zip(images, noises, strict=False):
            key = plan_from_row(rows[0]).stream_key
            light, cct_k = drawn_light(config, key)
            drawn = {"source_noise_dn": noise, "light": light, "cct_k": cct_k or None}
            yield from ({**row, **drawn} for row in rows)

    def _regenerated_rows(self, config: Config) -> Iterator[Row]:
        """Yield every row: read from intact shards, regenerated for damaged ones and for sources that failed.

        Pictures that are too small had the reason ``unsupported`` up to version 0.2.
        """
        if config.source.root == "":
            raise ConfigError(
                "repair: source.root is missing: rows are regenerated from the photographs; expected their folder; "
                "give source.root=…"
            )
        run, unused = resolve(config), self._temporary / "unused.tar"
        context = RunContext(run.settings, str(self._temporary), os.getpid())
        renamed = () if "too_small" in self._facts["failed"] else ("too_small",)
        for task, entry in zip(run.tasks(), self._facts["shards"], strict=False):
            images = group_by_image(self._rows_inside(entry))
            inside = {image_key(rows[0]): rows for rows in images}
            with ShardWriter(unused) as writer:
                for source in task.sources:
                    rows = inside.get(key_text(source.index))
                    for row in rows or make_image(context, task.shard, source, writer, ShardLog()):
                        was_renamed = row["status"] == "failed" and row["reason"] in renamed
                        yield {**row, "reason": "unsupported"} if was_renamed else row
            unused.unlink()

    # ------------------------------------------------------------------------------------------------------ shards

    def _restore_shard(self, path: Path, rows: Sequence[Row]) -> Iterator[RepairStep]:
        """Repair a shard, pair by pair; an error becomes a step, so that other shards are repaired nevertheless."""
        wanted = expected_samples(rows)
        if path.is_file() and not any(check_members(path, wanted)):
            return
        part, kept = self._temporary / path.name, 0
        try:
            with ShardWriter(part) as writer:
                samples = zip(wanted, group_by_sample(rows), intact_frames(path, wanted), strict=True)
                for sample, sample_rows, frames in samples:
                    kept += self._add_sample(writer, sample, sample_rows, frames)
        except UnprocessGenError as error:
            part.unlink()
            exit_code = error.exit_code if isinstance(error, MachineError) else DamageError.exit_code
            yield RepairStep(f"shards/{path.name}", f"cannot be repaired: {error}", exit_code)
            return
        if path.exists() and not path.is_file():
            self._move_aside(path)
        self._place(part, path)
        others = ", the others kept" if kept else ""
        yield RepairStep(f"shards/{path.name}", f"{len(rows) - kept} of {len(rows)} pairs regenerated{others}")

    def _add_sample(
        self, writer: ShardWriter, sample: ExpectedSample, rows: Sequence[Row], frames: Mapping[str, Array]
    ) -> int:
        """Append a sample with kept or regenerated frames; return how many of its pairs were kept."""
        damaged = [row for row in rows if any(stored.member not in frames for stored in arrays_of(row).values())]
        for row in damaged:
            stored, arrays = arrays_of(row), self._regenerator.regenerate_exactly(row)
            frames = {**{stored[name].member: array for name, array in arrays.items()}, **frames}
        for frame in sample.frames:
            writer.add_frame(sample.key, frame.member, frames[frame.member])
        writer.add_rows(sample.key, sample.json)
        return len(rows) - len(damaged)

    def _move_aside(self, path: Path) -> Path:
        place = self._folder / "set_aside"
        place.mkdir(exist_ok=True)
        names = itertools.chain([path.name], (f"{path.name}.{number}" for number in itertools.count(1)))
        free = next(place / name for name in names if not os.path.lexists(place / name))
        os.replace(path, free)
        return free

    # ------------------------------------------------------------------------------------------------- other files

    def _restore_parquet(self, config: Config) -> Iterator[RepairStep]:
        """Write ``manifest.parquet`` if it is damaged; its digest depends on the version of pyarrow."""
        digest, recorded = _digest(self._folder / parquet.PARQUET_NAME), self._facts.get(PARQUET_SHA256)
        if digest and (digest == recorded or (not self._facts and self._is_proved(digest))):
            return
        check_parquet(config.output)
        new = add_parquet(self._storage, self._manifest_file)
        yield RepairStep(parquet.PARQUET_NAME, "written from manifest.csv")
        if self._facts and new[PARQUET_SHA256] != recorded:
            self._storage.write("dataset.json", dataset_text(self._facts | new))
            yield RepairStep("dataset.json", f"has the SHA-256 of the new {parquet.PARQUET_NAME}")

    def _restore_dataset_json(self, config: Config) -> RepairStep:
        """Restore ``dataset.json`` from the other files: to the same bytes if its facts about the run are readable."""
        try:
            old = dict(parse_json((self._folder / "dataset.json").read_bytes()))
        except (OSError, ValueError, TypeError):
            old = {}
        rows = read_rows(self._manifest_file)
        entries = [self._entry(number, rows, old) for number, rows in shard_rows(self._manifest_file)]
        digests = {PARQUET_SHA256: file_sha256(self._folder / parquet.PARQUET_NAME)} if config.output.parquet else {}
        known = dataset_facts(
            self._config_text(), file_sha256(self._manifest_file), entries, digests | Tally.of(rows).facts()
        )
        digest = old.pop("dataset_sha256", None)
        same = dataset_text(old | known)
        if json.loads(same)["dataset_sha256"] == digest:
            self._storage.write("dataset.json", same)
            return RepairStep("dataset.json", "restored, to the same bytes")
        source = source_facts(config) if config.source.place else {"kind": source_kind(config), "root": None}
        lost = dict.fromkeys(("not_matched", "skipped_links", "run", "versions"))
        self._storage.write("dataset.json", dataset_text(known | lost | {"source": source}))
        return RepairStep("dataset.json", "rebuilt from the other files; host, time and versions of the run are lost")

    def _entry(self, number: int, rows: Sequence[Row], old: RecordedFacts) -> RecordedFacts:
        """Describe a shard for ``dataset.json``; the result of its self-test is only in the old file."""
        path = self._folder / "shards" / shard_name(number)
        killer = "provisional" if all(row["reason"] == "worker_died" for row in rows) else None
        try:
            failures = old["shards"][number].get("self_test")
        except (KeyError, IndexError, TypeError, AttributeError):
            failures = None
        log = ShardLog({failures: None} if failures else {})
        if not path.is_file():
            return ShardResult(number, None, 0, None, tuple(rows), killer, log).entry()
        return ShardResult(number, str(path), path.stat().st_size, file_sha256(path), tuple(rows), killer, log).entry()


def _digest(path: Path) -> str:
    """SHA-256 of a file, empty if it cannot be read."""
    try:
        return file_sha256(path)
    except OSError:
        return ""


def _is_readable(manifest: Path) -> bool:
    try:
        return all(rows for _, rows in shard_rows(manifest))
    except DamageError:
        return False


def _write_csv(path: Path, rows: Iterable[Row], names: Sequence[str]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        write_rows(stream, rows, names)
