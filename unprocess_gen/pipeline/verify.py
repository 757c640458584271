"""Verify a finished dataset byte by byte, or every dataset of a sweep.

``dataset.json`` records the SHA-256 of itself, the manifest, the config and every shard. A manifest row determines
every byte of its sample except the contents of the arrays, of which it records a digest. So each shard is compared with
the manifest member by member (`shards.check_members`), and damage is reported by shard, key and member.

Each shard is read once for its members, at the speed of XXH3. If they are intact, a second pass computes its SHA-256
at about 1.5 GB/s. The manifest is read once, in step with the shards, so that memory does not grow with its rows.
"""

from __future__ import annotations

import heapq
import itertools
import operator
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.dataset.dataset_json import check_format, read_dataset
from unprocess_gen.dataset.keys import group_by_sample
from unprocess_gen.dataset.manifest import ShardRows, shard_rows
from unprocess_gen.dataset.reader import SWEEP_TABLE, read_sweep_table
from unprocess_gen.dataset.row import has_frames
from unprocess_gen.dataset.shards import check_members, shard_name
from unprocess_gen.pipeline.progress import with_bar

CONFIG, MANIFEST, DATASET = "config.yaml", "manifest.csv", "dataset.json"


@dataclass(frozen=True, slots=True)
class Damage:
    """Describe one difference from what a dataset records; ``key`` and ``member`` are empty if it is about a file."""

    file: str
    what: str
    key: str = ""
    member: str = ""

    def __str__(self) -> str:
        place = ".".join(part for part in (self.key, self.member) if part)
        return ": ".join(part for part in (self.file, place, self.what) if part)


class SweepVerification(NamedTuple):
    """Outcome for one dataset of a sweep: its folder's name in ``sweep.csv``, and its damage."""

    folder: str
    damages: tuple[Damage, ...]


def verify(folder: AnyPath) -> list[Damage]:
    """Compare every byte of a finished dataset with what it records.

    Raises DamageError if the folder contains no finished dataset; MachineError if a file exists but cannot be read.
    """
    with machine_errors(folder):
        if not (folder / DATASET).exists() and not (folder / MANIFEST).exists():
            raise DamageError(
                f"{folder}: contains neither dataset.json nor manifest.csv; expected a finished dataset; "
                "check the folder, or run the command that began it again"
            )
        damages: list[Damage] = []
        facts: dict[str, Any] = {}
        check_format(folder)
        try:
            if (folder / DATASET).exists():
                facts = read_dataset(folder / DATASET)
            else:
                damages.append(Damage(DATASET, "is missing"))
        except DamageError as error:
            damages.append(Damage(DATASET, _without_path(error)))
        damages += check_files(folder, facts)
        listed = {number: entry for number, entry in enumerate(facts.get("shards", [])) if entry["file"] is not None}
        try:
            if (folder / MANIFEST).exists():
                return damages + _check_shards(folder, listed, shard_rows(folder / MANIFEST))
        except DamageError as error:
            damages.append(Damage(MANIFEST, _without_path(error)))
        return damages + _check_shards(folder, listed, iter(()))


def is_sweep(folder: AnyPath) -> bool:
    """Check whether a folder is a sweep's: it has a ``sweep.csv`` and is no dataset."""
    return (folder / SWEEP_TABLE).is_file() and not (folder / DATASET).exists()


def verify_sweep(folder: AnyPath) -> Iterator[SweepVerification]:
    """Verify every dataset that ``sweep.csv`` lists, and find those that an ended sweep left unfinished.

    Raises DamageError if ``sweep.csv`` cannot be read or names a folder elsewhere.
    """
    jobs = {job["folder"]: job["exit"] for job in read_sweep_table(folder / SWEEP_TABLE)}
    for name, exit_code in jobs.items():
        dataset = folder / name
        if (dataset / DATASET).exists() or (dataset / MANIFEST).exists():
            yield SweepVerification(name, tuple(verify(dataset)))
        else:
            what = f"is missing: the job ended with exit code {exit_code}; rerun the sweep to finish it"
            yield SweepVerification(name, (Damage(DATASET, what),))
    for name in sorted(any_path(folder).entries().keys() - jobs.keys()):
        if (folder / name / ".work").exists() and not (folder / name / DATASET).exists():
            what = "is missing: the sweep ended before this job; rerun the sweep to finish it"
            yield SweepVerification(name, (Damage(DATASET, what),))


def _without_path(error: DamageError) -> str:
    return str(error).partition(": ")[2]


def check_files(folder: AnyPath, facts: dict[str, Any]) -> Iterator[Damage]:
    """Compare the digests of config and manifest with those in the contents of ``dataset.json``."""
    for name, field in ((CONFIG, "config_sha256"), (MANIFEST, "manifest_sha256")):
        try:
            digest = file_sha256(folder / name)
        except FileNotFoundError:
            yield Damage(name, "is missing")
            continue
        except OSError as error:
            yield Damage(name, f"cannot be read ({error.strerror})")
            continue
        if facts.get(field, digest) != digest:
            yield Damage(name, f"its SHA-256 is {digest}, dataset.json records {facts[field]}")


def _check_shards(folder: AnyPath, listed: dict[int, dict[str, Any]], expected: Iterator[ShardRows]) -> list[Damage]:
    """Compare the shards with ``dataset.json`` and the manifest, or with the one of them that is readable.

    ``listed`` has the entries of shards with a file, in ascending order; ``expected`` is empty if the manifest
    cannot be read. Raises DamageError if that is found out on the way.
    """
    present = any_path(folder / "shards").entries()
    foreign, damages = set(present), list[Damage]()
    first = next(expected, None)
    shards = _merged(listed, itertools.chain([] if first is None else [first], expected))
    for number, rows in with_bar(shards, "shard", len(listed)):
        pairs = [*filter(has_frames, rows)]
        if not pairs and number not in listed:
            continue
        path = folder / "shards" / shard_name(number)
        foreign.discard(path.name)
        if path.name not in present:
            damages.append(Damage(f"shards/{path.name}", "is missing"))
            continue
        with any_path(path).local_copy() as file:
            problems = [] if first is None else [*check_members(file, group_by_sample(pairs))]
            entry = listed.get(number)
            if not problems and entry is not None and (digest := file_sha256(file)) != entry["sha256"]:
                problems = [("", "", f"its SHA-256 is {digest}, dataset.json records {entry['sha256']}")]
            damages += [Damage(f"shards/{path.name}", what, key, member) for key, member, what in problems]
    return [Damage(f"shards/{name}", "is not part of this dataset") for name in sorted(foreign)] + damages


def _merged(listed: Iterable[int], expected: Iterable[ShardRows]) -> Iterator[ShardRows]:
    """Yield every shard that ``dataset.json`` or the manifest has, in ascending order; without rows if only listed."""
    without_rows: Iterable[ShardRows] = ((number, []) for number in listed)
    shards = heapq.merge(without_rows, expected, key=operator.itemgetter(0))
    for number, parts in itertools.groupby(shards, key=operator.itemgetter(0)):
        yield number, [row for _, rows in parts for row in rows]
