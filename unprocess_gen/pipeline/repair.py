"""Repair a dataset: make again just what is damaged, to the same bytes, and prove it.

Each part is held by another, so any one can be lost: ``dataset.json`` holds the settings' text and the digests of all
else; ``manifest.csv`` holds every row, and the shards hold the rows of their pairs; a pair follows from its row and its
source. What is sound is kept: of a damaged shard only the pairs whose arrays do not fit their digests are made again.
Everything is written aside and compared before it takes the place of what was there. Files that are not of the dataset
are not thrown away but moved to ``set_aside``.

What cannot be had back is the part of ``dataset.json`` that only the run knew (its time, host and versions), where that
file is the damaged one and the damage lies there: it is then written anew, and says so. One process does all the work:
a dataset that is damaged throughout is made faster by ``gen-dataset again``.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml, read_dataset_yaml, source_kind
from unprocess_gen.core.errors import ConfigError, DamageError, SourceError, UnprocessGenError
from unprocess_gen.core.files import commit_file, file_sha256, machine_error
from unprocess_gen.core.types import Frame, Row, Source
from unprocess_gen.dataset.keys import group_by_image, group_by_sample, image_key, key_text
from unprocess_gen.dataset.manifest import failed_row, readable_rows, rows_of_json, write_rows
from unprocess_gen.dataset.shards import CLEAN, Expected, ShardWriter, check_members, json_inside, salvage, shard_name
from unprocess_gen.pipeline.generate import RunContext, ShardTask, make_shard, shard_tasks, tally
from unprocess_gen.pipeline.verify import Maker, expected, noisy_member_of, rows_by_shard
from unprocess_gen.pipeline.workspace import (
    ShardResult,
    Workspace,
    dataset_facts,
    dataset_text,
    fingerprint,
    read_dataset,
)
from unprocess_gen.sources.loader import list_photographs, load_source

Facts = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Step:
    """What was done about one damaged file, or why nothing could be (``mended`` is then false)."""

    file: str
    what: str
    mended: bool = True

    def __str__(self) -> str:
        return f"{self.file}: {self.what}"


def repair(folder: Path, root: str | None) -> Iterator[Step]:
    """Mend what is damaged, yielding each step; ``root`` is the folder of the sources, None for built-in scenes.

    Raises LockedError where a run holds the folder, DamageError where settings or manifest cannot be had back,
    ConfigError where sources are needed and ``root`` is not given, MachineError where nothing can be written or this
    machine computes differently.
    """
    with Workspace(folder, "") as workspace:
        workspace.hold()
        try:
            with _bench(workspace) as aside:
                yield from _repair(folder, root, aside)
        except OSError as error:
            raise machine_error(error, folder) from error


@contextlib.contextmanager
def _bench(workspace: Workspace) -> Iterator[Path]:
    """Provide an empty folder to write in, on the dataset's own file system; nothing of it stays."""
    aside = workspace.work / "repair"
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        yield aside
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        with contextlib.suppress(OSError):  # what a run with provisional rows left there stays
            workspace.work.rmdir()


def _repair(folder: Path, root: str | None, aside: Path) -> Iterator[Step]:
    facts = _sound_facts(folder)
    text, step = _settings(folder, facts, aside)
    yield from step
    config = _config(folder / "config.yaml", root)
    yield from _manifest(folder, facts, config, aside)
    rows = rows_by_shard(folder / "manifest.csv")
    for number in sorted(rows):
        yield from _shard(folder, number, [row for row in rows[number] if row["status"] == "ok"], root, aside)
    names = {shard_name(number) for number in rows if any(row["status"] == "ok" for row in rows[number])}
    yield from _set_aside(folder, names)
    if not facts:
        yield _dataset(folder, text, rows, config, aside)


def _sound_facts(folder: Path) -> Facts:
    """Return what ``dataset.json`` says; nothing where a byte of it is wrong."""
    try:
        return read_dataset(folder / "dataset.json")
    except DamageError:
        return {}


def _place(aside: Path, path: Path) -> None:
    """Put a finished file where it belongs, in a folder that may be gone too."""
    path.parent.mkdir(exist_ok=True)
    commit_file(aside, path)


def _write(aside: Path, path: Path, text: str) -> None:
    part = aside / path.name
    part.write_bytes(text.encode("utf-8"))
    _place(part, path)


# -------------------------------------------------------------------------------------------------------- settings


def _settings(folder: Path, facts: Facts, aside: Path) -> tuple[str, list[Step]]:
    """Return the text of ``config.yaml``, proved, and what had to be done for it."""
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
    _write(aside, path, kept)
    return kept, [Step("config.yaml", "written again from dataset.json")]


AGAIN = "make the dataset again with the settings and sources it was made from"


def _is_proved(folder: Path, *proofs: str) -> bool:
    """Whether a damaged ``dataset.json`` still says one of the things that prove another file.

    Each file has more than one such proof, so that damage to one of them leaves the other. Where no digest is left at
    all, with the whole file perhaps, there is nothing to contradict it either.
    """
    try:
        left = (folder / "dataset.json").read_bytes()
    except OSError:
        return True
    says_any = re.search(rb'"[0-9a-f]{64}"', left)
    return says_any is None or any(proof.encode() in left for proof in proofs)


def _is_canonical(path: Path, text: str) -> bool:
    """Whether ``config.yaml`` is just as a run writes it."""
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


def _manifest(folder: Path, facts: Facts, config: Config, aside: Path) -> Iterator[Step]:
    """Make sure of ``manifest.csv``: as it is, from the shards, or from the sources; proved by its digest."""
    path = folder / "manifest.csv"
    if not facts:
        if not _is_whole_manifest(folder):
            raise DamageError(f"{folder}: both manifest.csv and dataset.json are damaged; {AGAIN}")
        return
    if path.is_file() and file_sha256(path) == facts["manifest_sha256"]:
        return
    if _write_manifest(_kept_rows(folder, facts), path, facts, aside):
        yield Step("manifest.csv", "written again from the rows in the shards")
    elif _write_manifest(_remade_rows(folder, facts, config, aside), path, facts, aside):
        yield Step("manifest.csv", "made again from the settings and the sources")
    else:
        raise DamageError(f"{path}: does not come out as it was: were these the same sources?")


def _is_whole_manifest(folder: Path) -> bool:
    try:
        rows_by_shard(folder / "manifest.csv")
    except DamageError:
        return False
    return _is_proved(folder, file_sha256(folder / "manifest.csv"), _fingerprint(folder))


def _fingerprint(folder: Path) -> str:
    try:
        return fingerprint(file_sha256(folder / "config.yaml"), file_sha256(folder / "manifest.csv"))
    except OSError:
        return "none"


def _write_manifest(rows: Iterable[Row], path: Path, facts: Facts, aside: Path) -> bool:
    """Put the rows in the manifest's place if they are the ones it was made of."""
    part = aside / path.name
    with part.open("w", encoding="utf-8", newline="") as stream:
        write_rows(stream, rows)
    if file_sha256(part) != facts["manifest_sha256"]:
        return False
    _place(part, path)
    return True


def _is_sound(folder: Path, entry: Facts) -> bool:
    return entry["file"] is None or (
        (folder / entry["file"]).is_file() and file_sha256(folder / entry["file"]) == entry["sha256"]
    )


def _kept_rows(folder: Path, facts: Facts) -> Iterator[Row]:
    """Yield what rows there are, in order: pairs' from sound shards, failures' from the manifest's readable lines."""
    failures: dict[Any, list[Row]] = {}
    for row in readable_rows(folder / "manifest.csv"):
        if row["status"] == "failed":
            failures.setdefault(row["shard"], []).append(row)
    for number, entry in enumerate(facts["shards"]):
        inside = _rows_inside(folder / entry["file"]) if entry["file"] and _is_sound(folder, entry) else []
        yield from sorted([*inside, *failures.get(number, [])], key=lambda row: int(image_key(row)))


def _rows_inside(shard: Path) -> list[Row]:
    return [row for content in json_inside(shard) for row in rows_of_json(content)]


def _remade_rows(folder: Path, facts: Facts, config: Config, aside: Path) -> Iterator[Row]:
    """Yield every row: those in sound shards as they are, all others made again, and their shards mended with them."""
    sources = list_photographs(_with_sources(config).source).sources
    bench = RunContext(config, str(aside), os.getpid())
    for task, entry in zip(shard_tasks(sources, config.output.pairs_per_shard), facts["shards"], strict=False):
        if entry.get("provisional"):
            yield from (failed_row(one, None, task.shard, config.seed, "worker_died") for one in task.sources)
        elif _is_sound(folder, entry):
            found = group_by_image(_rows_inside(folder / entry["file"]) if entry["file"] else ())
            inside = {image_key(some[0]): some for some in found}
            for source in task.sources:
                yield from inside.get(key_text(source.index)) or [_failure(config, task, source)]
        else:
            made = make_shard(bench, task)
            if made.path is not None and made.sha256 == entry["sha256"]:
                _place(Path(made.path), folder / entry["file"])
            yield from made.rows


def _with_sources(config: Config) -> Config:
    if config.source.root == "":
        raise ConfigError("repair: rows must be made again from the photographs: give source.root=…")
    return config


def _failure(config: Config, task: ShardTask, source: Source) -> Row:
    try:
        load_source(config.source, source, config.output.layout)
    except SourceError as error:
        return failed_row(source, error.sha256, task.shard, config.seed, error.reason)
    raise DamageError(f"source {source.name}: failed when the dataset was made, and can be used now; {AGAIN}")


# ---------------------------------------------------------------------------------------------------------- shards


def _shard(folder: Path, number: int, rows: Sequence[Row], root: str | None, aside: Path) -> Iterator[Step]:
    """Mend a shard, pair by pair; what hinders it becomes a step, so that the others are mended all the same."""
    path = folder / "shards" / shard_name(number)
    wanted = expected(rows)
    if not rows or (path.is_file() and not any(check_members(path, wanted))):
        return
    part = aside / path.name
    kept, maker = 0, Maker(root)
    try:
        with ShardWriter(part) as writer:
            for sample, some, frames in zip(wanted, group_by_sample(rows), salvage(path, wanted), strict=True):
                kept += _mend_sample(writer, sample, some, frames, maker)
    except UnprocessGenError as error:
        part.unlink()
        yield Step(f"shards/{path.name}", f"cannot be mended: {error}", mended=False)
        return
    if path.exists() and not path.is_file():
        _move_aside(folder, path)
    _place(part, path)
    yield Step(f"shards/{path.name}", f"{len(rows) - kept} of {len(rows)} pairs made again, the others kept")


def _mend_sample(
    writer: ShardWriter, sample: Expected, rows: Sequence[Row], kept: dict[str, Frame], maker: Maker
) -> int:
    """Append a sample, its frames kept or made again; return how many of its pairs were kept."""
    whole = [row for row in rows if CLEAN in kept and noisy_member_of(row) in kept]
    made = {str(row["key"]): maker.make_again(row) for row in rows if row not in whole}
    writer.add_frame(sample.key, CLEAN, kept[CLEAN] if CLEAN in kept else made[str(rows[0]["key"])].clean)
    for row in rows:
        member = noisy_member_of(row)
        writer.add_frame(sample.key, member, kept[member] if row in whole else made[str(row["key"])].noisy)
    writer.add_rows(sample.key, sample.json)
    return len(whole)


def _set_aside(folder: Path, names: set[str]) -> Iterator[Step]:
    """Move what is not of the dataset out of ``shards``."""
    for name in sorted(set(os.listdir(folder / "shards")) - names if (folder / "shards").is_dir() else ()):
        yield Step(f"shards/{name}", f"moved to {_move_aside(folder, folder / 'shards' / name)}")


def _move_aside(folder: Path, path: Path) -> Path:
    place = folder / "set_aside"
    place.mkdir(exist_ok=True)
    name, again = place / path.name, 0
    while os.path.lexists(name):
        again += 1
        name = place / f"{path.name}.{again}"
    os.replace(path, name)
    return name


# ---------------------------------------------------------------------------------------------------- dataset.json


def _dataset(folder: Path, text: str, rows: dict[int, list[Row]], config: Config, aside: Path) -> Step:
    """Write ``dataset.json`` again from all that it stands for; the same bytes, if its own digest can be met."""
    path = folder / "dataset.json"
    old = _readable(path)
    pairs, failed, sites = tally(row for number in sorted(rows) for row in rows[number])
    known = dataset_facts(
        text,
        file_sha256(folder / "manifest.csv"),
        [_entry(folder, number, rows[number], old) for number in sorted(rows)],
        {"pairs": pairs, "failed": failed, "sites": sites},
    )
    digest = old.pop("dataset_sha256", None)
    same = dataset_text(old | known)
    if json.loads(same)["dataset_sha256"] == digest:
        _write(aside, path, same)
        return Step(path.name, "written again, to the same bytes")
    source = {"kind": source_kind(config), "root": config.source.root or None}
    lost = dict.fromkeys(("not_matched", "skipped_links", "run", "versions"))
    _write(aside, path, dataset_text(known | lost | {"source": source}))
    return Step(path.name, "written anew from the rest; which machine made the dataset, when and with what, is lost")


def _readable(path: Path) -> Facts:
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return dict(found) if isinstance(found, dict) else {}


def _entry(folder: Path, number: int, rows: Sequence[Row], old: Facts) -> Facts:
    """Return what ``dataset.json`` says of a shard; of its self-test only the old file knows."""
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
