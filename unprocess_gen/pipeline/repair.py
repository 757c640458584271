"""Repair a dataset: regenerate only what is damaged, to the same bytes, and prove it.

Each file can be restored from others. ``dataset.json`` contains the text of the config and the digests of all other
files. ``manifest.csv`` contains every row; the shards contain the rows of their pairs. A pair follows from its row and
its source. Intact data are kept: in a damaged shard only pairs whose arrays differ from their digests are regenerated.
Every file is written to a temporary file and checked before it replaces the damaged one. Files that are not part of the
dataset are moved to ``set_aside``.

If ``dataset.json`` itself is damaged, its facts about the run (time, host, versions) may be lost. It is then written
without them, and the repair reports this. Repair uses one process; if most of a dataset is damaged, ``gen-dataset
again`` is faster.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml, read_dataset_yaml, source_kind
from unprocess_gen.config.validation import check_parquet
from unprocess_gen.core.errors import (
    ConfigError,
    DamageError,
    MachineError,
    SourceChangedError,
    SourceError,
    UnprocessGenError,
)
from unprocess_gen.core.files import commit_file, file_sha256, machine_error
from unprocess_gen.core.types import Frame, Row, Source
from unprocess_gen.dataset import parquet
from unprocess_gen.dataset.columns import HEADERS, NAMES
from unprocess_gen.dataset.dataset_json import PARQUET_SHA256
from unprocess_gen.dataset.keys import group_by_image, group_by_sample, image_key, key_text
from unprocess_gen.dataset.manifest import failed_row, read_rows, readable_rows, rows_of_json, write_rows
from unprocess_gen.dataset.shards import (
    CLEAN,
    ExpectedSample,
    ShardWriter,
    check_members,
    intact_frames,
    json_inside,
    shard_name,
)
from unprocess_gen.pipeline.generate import shard_tasks
from unprocess_gen.pipeline.replay import ADVICE, PairRegenerator
from unprocess_gen.pipeline.storage.local import LocalStorage
from unprocess_gen.pipeline.tally import Tally
from unprocess_gen.pipeline.tasks import RunContext, ShardResult, ShardTask
from unprocess_gen.pipeline.verify import expected_samples, noisy_member_of, shard_rows
from unprocess_gen.pipeline.worker import make_shard
from unprocess_gen.pipeline.workspace import (
    dataset_facts,
    dataset_text,
    fingerprint,
    read_dataset,
)
from unprocess_gen.sources.dark_frames import NO_DARK_FRAMES, DarkPlaces, open_dark_frames, set_dark_places
from unprocess_gen.sources.loader import list_photographs, load_source

Facts = dict[str, Any]


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


def repair(folder: Path, root: str | None, dark: DarkPlaces = NO_DARK_FRAMES) -> Iterator[RepairStep]:
    """Restore every damaged file of a dataset.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    root : str or None
        Folder of the sources; None for built-in scenes, or if no source is needed.
    dark : DarkPlaces
        Where the dark frames and their map are, if rows name any.

    Yields
    ------
    RepairStep
        One for each damaged or foreign file.

    Raises
    ------
    LockedError
        If a run holds the folder.
    DamageError
        If config or manifest cannot be restored.
    ConfigError
        If sources are needed and ``root`` is None.
    SourceChangedError
        If the manifest must be regenerated and a source was changed or deleted.
    MachineError
        If a file cannot be read or written, or the self-test fails.
    """
    storage = LocalStorage(folder)
    try:
        storage.hold()
        yield from _repair(folder, root, storage.scratch, dark)
    except OSError as error:
        raise machine_error(error, folder) from error
    finally:
        storage.close()


def _repair(folder: Path, root: str | None, temporary: Path, dark: DarkPlaces) -> Iterator[RepairStep]:
    facts = _intact_facts(folder)
    text, step = _settings(folder, facts, temporary)
    yield from step
    config = _config(folder / "config.yaml", root)
    set_dark_places(config, dark)
    regenerator = PairRegenerator(root, dark)
    yield from _manifest(folder, facts, config, temporary)
    names = set()
    for number, rows in shard_rows(folder / "manifest.csv"):
        pairs = [row for row in rows if row["status"] == "ok"]
        yield from _shard(folder, number, pairs, regenerator, temporary)
        if pairs:
            names.add(shard_name(number))
    yield from _set_aside(folder, names)
    derived = facts.get(PARQUET_SHA256)
    if config.output.parquet and not _is_intact_parquet(folder, facts):
        check_parquet(config.output)
        derived = _write_parquet(folder, temporary)
        yield RepairStep(parquet.NAME, "written from manifest.csv")
    if not facts:
        yield _dataset(folder, text, config, temporary)
    elif derived != facts.get(PARQUET_SHA256):
        _write(temporary, folder / "dataset.json", dataset_text(facts | {PARQUET_SHA256: derived}))
        yield RepairStep("dataset.json", f"has the SHA-256 of the new {parquet.NAME}")


def _intact_facts(folder: Path) -> Facts:
    """Return the contents of ``dataset.json``, empty if it is damaged."""
    try:
        return read_dataset(folder / "dataset.json")
    except DamageError:
        return {}


def _place(temporary: Path, path: Path) -> None:
    """Rename a finished file to its final name; create its folder if that was deleted."""
    path.parent.mkdir(exist_ok=True)
    commit_file(temporary, path)


def _write(temporary: Path, path: Path, text: str) -> None:
    part = temporary / path.name
    part.write_bytes(text.encode("utf-8"))
    _place(part, path)


# -------------------------------------------------------------------------------------------------------- settings


def _settings(folder: Path, facts: Facts, temporary: Path) -> tuple[str, list[RepairStep]]:
    """Return the text of ``config.yaml``, checked against its digest, and the steps that restored it."""
    path = folder / "config.yaml"
    try:
        text = path.read_bytes().decode("utf-8")
    except (OSError, ValueError):
        text = ""
    if not facts:
        proofs = _sha256(text), json.dumps(text)[1:-1], _fingerprint(folder)
        if not _is_proved(folder, *proofs) or not _is_canonical(path, text):
            raise DamageError(f"{folder}: both config.yaml and dataset.json are damaged; {AGAIN}")
        return text, []
    if _sha256(text) == facts["config_sha256"]:
        return text, []
    kept = str(facts.get("config", ""))
    if _sha256(kept) != facts["config_sha256"]:
        raise DamageError(f"{path}: dataset.json holds no copy of it; {AGAIN}")
    _write(temporary, path, kept)
    return kept, [RepairStep("config.yaml", "restored from dataset.json")]


AGAIN = "regenerate the dataset with the settings and sources it was made from"


def _is_proved(folder: Path, *proofs: str) -> bool:
    """Return whether a damaged ``dataset.json`` still contains one of the texts that prove another file intact.

    Without this check, a repair after damage to two files would certify the damaged one. Each file has two such texts,
    so that a flipped bit in one leaves the other. If no digest at all is readable, nothing contradicts the file, and it
    is accepted.
    """
    try:
        left = (folder / "dataset.json").read_bytes()
    except OSError:
        return True
    any_digest = re.search(rb'"[0-9a-f]{64}"', left)
    return any_digest is None or any(proof.encode() in left for proof in proofs)


def _is_canonical(path: Path, text: str) -> bool:
    """Return whether ``config.yaml`` is exactly as a run writes it."""
    try:
        return dataset_yaml(_config(path, None)) == text
    except ConfigError:
        return False


def _config(path: Path, root: str | None) -> Config:
    config, kind = read_dataset_yaml(path)
    config.source.root = (root or "") if kind == "folder" else None
    return config


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


# -------------------------------------------------------------------------------------------------------- manifest


def _manifest(folder: Path, facts: Facts, config: Config, temporary: Path) -> Iterator[RepairStep]:
    """Ensure that ``manifest.csv`` is intact; restore it from the shards, or from the sources, and check its digest."""
    path = folder / "manifest.csv"
    if not facts:
        if not _is_intact_manifest(folder):
            raise DamageError(f"{folder}: both manifest.csv and dataset.json are damaged; {AGAIN}")
        return
    if path.is_file() and file_sha256(path) == facts["manifest_sha256"]:
        return
    if _write_manifest(_readable_rows_in_order(folder, facts), path, facts, temporary):
        yield RepairStep("manifest.csv", "restored from the rows in the shards")
    elif _write_manifest(_regenerated_rows(folder, facts, config, temporary), path, facts, temporary):
        yield RepairStep("manifest.csv", "regenerated from the settings and the sources")
    else:
        raise SourceChangedError(
            f"{path}: the regenerated manifest has another SHA-256 than the lost one: a source was changed, added or "
            f"deleted; {ADVICE}"
        )


def _is_intact_manifest(folder: Path) -> bool:
    try:
        for _ in shard_rows(folder / "manifest.csv"):
            pass
    except DamageError:
        return False
    return _is_proved(folder, file_sha256(folder / "manifest.csv"), _fingerprint(folder))


def _fingerprint(folder: Path) -> str:
    try:
        return fingerprint(file_sha256(folder / "config.yaml"), file_sha256(folder / "manifest.csv"))
    except OSError:
        return "none"


def _write_manifest(rows: Iterable[Row], path: Path, facts: Facts, temporary: Path) -> bool:
    """Write the rows as the manifest if they give its recorded digest; return whether they do.

    Tries the header of every version, because the lost manifest may be of an older one.
    """
    complete, part = temporary / f"{path.name}.all", temporary / path.name
    _write_csv(complete, rows, NAMES)
    for names in HEADERS:
        _write_csv(part, read_rows(complete), names)
        if file_sha256(part) == facts["manifest_sha256"]:
            _place(part, path)
            return True
    return False


def _write_csv(path: Path, rows: Iterable[Row], names: Sequence[str]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        write_rows(stream, rows, names)


def _is_intact(folder: Path, entry: Facts) -> bool:
    return entry["file"] is None or (
        (folder / entry["file"]).is_file() and file_sha256(folder / entry["file"]) == entry["sha256"]
    )


def _readable_rows_in_order(folder: Path, facts: Facts) -> Iterator[Row]:
    """Yield the rows of pairs in intact shards and of failures in readable lines of the manifest, in order."""
    failures: dict[Any, list[Row]] = {}
    for row in readable_rows(folder / "manifest.csv"):
        if row["status"] == "failed":
            failures.setdefault(row["shard"], []).append(row)
    for number, entry in enumerate(facts["shards"]):
        inside = _rows_inside(folder, entry) if _is_intact(folder, entry) else []
        yield from sorted([*inside, *failures.get(number, [])], key=lambda row: int(image_key(row)))


def _rows_inside(folder: Path, entry: Facts) -> list[Row]:
    """Return the rows of an intact shard; ``source_noise_dn``, which they lack, is in its entry."""
    if not entry["file"]:
        return []
    rows = (row for content in json_inside(folder / entry["file"]) for row in rows_of_json(content))
    noises = iter(entry.get("source_noise_dn", ()))
    return [
        {**row, "source_noise_dn": noise}
        for of_image in group_by_image(rows)
        for noise in [next(noises, None)]
        for row in of_image
    ]


def _regenerated_rows(folder: Path, facts: Facts, config: Config, temporary: Path) -> Iterator[Row]:
    """Yield every row: read from intact shards, regenerated for damaged ones, which are replaced at the same time."""
    sources = list_photographs(_with_sources(config).source).sources
    config, frames, dark_folder = open_dark_frames(config)
    context = RunContext(config, str(temporary), os.getpid(), dark_frames=frames, dark_folder=dark_folder)
    for task, entry in zip(shard_tasks(sources, config.output.pairs_per_shard), facts["shards"], strict=False):
        if entry.get("provisional"):
            yield from (failed_row(source, None, task.shard, config.seed, "worker_died") for source in task.sources)
        elif _is_intact(folder, entry):
            inside = {image_key(of_image[0]): of_image for of_image in group_by_image(_rows_inside(folder, entry))}
            for source in task.sources:
                yield from inside.get(key_text(source.index)) or [_failure(config, task, source)]
        else:
            result = make_shard(context, task)
            if result.path is not None and result.sha256 == entry["sha256"]:
                _place(Path(result.path), folder / entry["file"])
            yield from result.rows


def _with_sources(config: Config) -> Config:
    if config.source.root == "":
        raise ConfigError(
            "repair: source.root is missing: rows are regenerated from the photographs; expected their "
            "folder; give source.root=…"
        )
    return config


def _failure(config: Config, task: ShardTask, source: Source) -> Row:
    try:
        load_source(config.source, source, config.output.layout)
    except SourceError as error:
        return failed_row(source, error.sha256, task.shard, config.seed, error.reason, error.text)
    raise SourceChangedError(f"source {source.name}: failed when the dataset was made, and can be used now; {ADVICE}")


# ---------------------------------------------------------------------------------------------------------- shards


def _shard(
    folder: Path, number: int, rows: Sequence[Row], regenerator: PairRegenerator, temporary: Path
) -> Iterator[RepairStep]:
    """Repair a shard, pair by pair; an error becomes a step, so that other shards are repaired nevertheless."""
    path = folder / "shards" / shard_name(number)
    wanted = expected_samples(rows)
    if not rows or (path.is_file() and not any(check_members(path, wanted))):
        return
    part = temporary / path.name
    kept = 0
    try:
        with ShardWriter(part) as writer:
            for sample, some, frames in zip(wanted, group_by_sample(rows), intact_frames(path, wanted), strict=True):
                kept += _repair_sample(writer, sample, some, frames, regenerator)
    except UnprocessGenError as error:
        part.unlink()
        exit_code = error.exit_code if isinstance(error, MachineError) else DamageError.exit_code
        yield RepairStep(f"shards/{path.name}", f"cannot be repaired: {error}", exit_code)
        return
    if path.exists() and not path.is_file():
        _move_aside(folder, path)
    _place(part, path)
    others = ", the others kept" if kept else ""
    yield RepairStep(f"shards/{path.name}", f"{len(rows) - kept} of {len(rows)} pairs regenerated{others}")


def _repair_sample(
    writer: ShardWriter,
    sample: ExpectedSample,
    rows: Sequence[Row],
    kept: dict[str, Frame],
    regenerator: PairRegenerator,
) -> int:
    """Append a sample, with kept or regenerated frames; return how many of its pairs were kept."""
    intact = [row for row in rows if CLEAN in kept and noisy_member_of(row) in kept]
    pairs = {str(row["key"]): regenerator.regenerate_exactly(row) for row in rows if row not in intact}
    writer.add_frame(sample.key, CLEAN, kept[CLEAN] if CLEAN in kept else pairs[str(rows[0]["key"])].clean)
    for row in rows:
        member = noisy_member_of(row)
        writer.add_frame(sample.key, member, kept[member] if row in intact else pairs[str(row["key"])].noisy)
    writer.add_rows(sample.key, sample.json)
    return len(intact)


def _set_aside(folder: Path, names: set[str]) -> Iterator[RepairStep]:
    """Move files that are not part of the dataset out of ``shards``."""
    for name in sorted(set(os.listdir(folder / "shards")) - names if (folder / "shards").is_dir() else ()):
        yield RepairStep(f"shards/{name}", f"moved to {_move_aside(folder, folder / 'shards' / name)}")


def _move_aside(folder: Path, path: Path) -> Path:
    place = folder / "set_aside"
    place.mkdir(exist_ok=True)
    name, again = place / path.name, 0
    while os.path.lexists(name):
        again += 1
        name = place / f"{path.name}.{again}"
    os.replace(path, name)
    return name


# ---------------------------------------------------------------------------------------------------------- Parquet


def _is_intact_parquet(folder: Path, facts: Facts) -> bool:
    path = folder / parquet.NAME
    if not path.is_file():
        return False
    sha256 = file_sha256(path)
    return bool(facts[PARQUET_SHA256] == sha256) if PARQUET_SHA256 in facts else _is_proved(folder, sha256)


def _write_parquet(folder: Path, temporary: Path) -> str:
    """Write ``manifest.parquet`` from the manifest, and return its SHA-256, which depends on the version of pyarrow."""
    part = temporary / parquet.NAME
    parquet.write_parquet(folder / "manifest.csv", part)
    sha256 = file_sha256(part)
    _place(part, folder / parquet.NAME)
    return sha256


# ---------------------------------------------------------------------------------------------------- dataset.json


def _dataset(folder: Path, text: str, config: Config, temporary: Path) -> RepairStep:
    """Restore ``dataset.json`` from the other files: to the same bytes if its facts about the run are readable."""
    path = folder / "dataset.json"
    old = _readable(path)
    manifest = folder / "manifest.csv"
    tally = Tally.of(read_rows(manifest))
    known = dataset_facts(
        text,
        file_sha256(manifest),
        [_entry(folder, number, rows, old) for number, rows in shard_rows(manifest)],
        ({PARQUET_SHA256: file_sha256(folder / parquet.NAME)} if config.output.parquet else {}) | tally.facts(),
    )
    digest = old.pop("dataset_sha256", None)
    same = dataset_text(old | known)
    if json.loads(same)["dataset_sha256"] == digest:
        _write(temporary, path, same)
        return RepairStep(path.name, "restored, to the same bytes")
    source = {"kind": source_kind(config), "root": config.source.root or None}
    lost = dict.fromkeys(("not_matched", "skipped_links", "run", "versions"))
    _write(temporary, path, dataset_text(known | lost | {"source": source}))
    return RepairStep(path.name, "rebuilt from the other files; host, time and versions of the run are lost")


def _readable(path: Path) -> Facts:
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return dict(found) if isinstance(found, dict) else {}


def _entry(folder: Path, number: int, rows: Sequence[Row], old: Facts) -> Facts:
    """Return a shard's entry for ``dataset.json``; the result of its self-test is only in the old file."""
    path = folder / "shards" / shard_name(number)
    killer = "provisional" if all(row["reason"] == "worker_died" for row in rows) else None
    try:
        self_test = old["shards"][number].get("self_test")
    except (KeyError, IndexError, TypeError, AttributeError):
        self_test = None
    if not path.is_file():
        return ShardResult(number, None, 0, None, tuple(rows), killer, self_test).entry()
    return ShardResult(
        number, str(path), path.stat().st_size, file_sha256(path), tuple(rows), killer, self_test
    ).entry()
