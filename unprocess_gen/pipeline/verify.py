"""Verify a finished dataset byte by byte, and make its pairs again from the manifest's rows.

A row decides every byte of its pair's members but the arrays' contents, and of those it holds a digest: so each shard
is held against the manifest member by member (`shards.check_members`), and whatever is wrong is named by shard, key and
member. Above the shards, ``dataset.json`` holds the manifest, the settings, every shard and itself by SHA-256. It costs
one pass over the data at the speed of SHA-256, about 1.5 GB/s, and a second one at that of XXH3.

A replay needs the row and the source, nothing else: no settings file, no other row.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import ConfigError, DamageError, MachineError, SourceError
from unprocess_gen.core.files import array_xxh3, file_sha256
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import NO_CLIP, Pair, Photograph, Row, Source
from unprocess_gen.dataset.keys import group_by_sample, image_key, sample_key
from unprocess_gen.dataset.manifest import (
    patch_from_row,
    plan_from_row,
    read_row,
    read_rows,
    row_json,
    rows_with_offsets,
)
from unprocess_gen.dataset.shards import CLEAN, Expected, check_members, form_of, noisy_member, shard_name
from unprocess_gen.pipeline.workspace import read_dataset
from unprocess_gen.simulation import self_test as selftest
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.sources import listing as sources
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import crop_patch

NO_LIMIT = 2**40
"""Pixels a replay accepts: the run that wrote the row had a limit of its own."""


@dataclass(frozen=True, slots=True)
class Damage:
    """One place that is not as it should be; ``key`` and ``member`` are empty where a whole file is meant."""

    file: str
    what: str
    key: str = ""
    member: str = ""

    def __str__(self) -> str:
        place = ".".join(part for part in (self.key, self.member) if part)
        return ": ".join(part for part in (self.file, place, self.what) if part)


def verify(folder: Path) -> list[Damage]:
    """Return every damage of a dataset; none means that each byte is the one its manifest stands for.

    Raises DamageError where there is no finished dataset at all.
    """
    if not (folder / "dataset.json").exists() and not (folder / "manifest.csv").exists():
        raise DamageError(f"{folder}: neither dataset.json nor manifest.csv is here; is this a finished dataset?")
    damages: list[Damage] = []
    facts: dict[str, Any] = {}
    rows: dict[int, list[Row]] | None = None
    try:
        facts = read_dataset(folder / "dataset.json")
    except DamageError as error:
        damages.append(Damage("dataset.json", _without_path(error)))
    damages += _check_files(folder, facts)
    try:
        rows = rows_by_shard(folder / "manifest.csv")
    except DamageError as error:
        damages.append(Damage("manifest.csv", _without_path(error)))
    return damages + list(_check_shards(folder, facts.get("shards"), rows))


def _without_path(error: DamageError) -> str:
    return str(error).partition(": ")[2]


def _check_files(folder: Path, facts: dict[str, Any]) -> Iterator[Damage]:
    for name, field in (("config.yaml", "config_sha256"), ("manifest.csv", "manifest_sha256")):
        try:
            found = file_sha256(folder / name)
        except OSError as error:
            yield Damage(name, f"cannot be read ({error.strerror})")
            continue
        if facts.get(field, found) != found:
            yield Damage(name, f"its SHA-256 is {found}, dataset.json says {facts[field]}")


def rows_by_shard(manifest: Path) -> dict[int, list[Row]]:
    """Return a manifest's rows by the number of their shard; DamageError where it cannot be read."""
    rows: dict[int, list[Row]] = {}
    for row in read_rows(manifest):
        shard = row["shard"]
        if not isinstance(shard, int):
            raise DamageError(f"{manifest}: row {row['key']} names no shard")
        rows.setdefault(shard, []).append(row)
    return rows


def _check_shards(
    folder: Path, entries: list[dict[str, Any]] | None, rows: dict[int, list[Row]] | None
) -> Iterator[Damage]:
    """Hold the shards against ``dataset.json`` and the manifest, or against the one of them that can be read."""
    listed = {number: entry for number, entry in enumerate(entries or []) if entry["file"] is not None}
    filled = {number for number, some in (rows or {}).items() if any(row["status"] == "ok" for row in some)}
    wanted = {shard_name(number): number for number in sorted(listed.keys() | filled)}
    present = {path.name for path in (folder / "shards").iterdir()} if (folder / "shards").is_dir() else set()
    for name in sorted(present - wanted.keys()):
        yield Damage(f"shards/{name}", "is not part of this dataset")
    for name, number in wanted.items():
        if name not in present:
            yield Damage(f"shards/{name}", "is missing")
        else:
            path = folder / "shards" / name
            damages = list(_check_members(path, rows[number] if number in filled and rows else []) if rows else ())
            yield from damages or _check_sha256(path, listed.get(number))


def _check_members(path: Path, rows: Iterable[Row]) -> Iterator[Damage]:
    for key, member, what in check_members(path, expected(rows)):
        yield Damage(f"shards/{path.name}", what, key, member)


def _check_sha256(path: Path, entry: dict[str, Any] | None) -> Iterator[Damage]:
    if entry is not None and (found := file_sha256(path)) != entry["sha256"]:
        yield Damage(f"shards/{path.name}", f"its SHA-256 is {found}, dataset.json says {entry['sha256']}")


def expected(rows: Iterable[Row]) -> list[Expected]:
    """Return what rows say of the members of each of their samples; DamageError where a value is missing."""
    return [_expected(some) for some in group_by_sample(row for row in rows if row["status"] == "ok")]


def _expected(rows: Sequence[Row]) -> Expected:
    width, height = rows[0]["width"], rows[0]["height"]
    if not isinstance(width, int) or not isinstance(height, int):
        raise DamageError(f"row {rows[0]['key']}: width and height are {width} and {height}")
    form = form_of(str(rows[0]["dtype"]), str(rows[0]["layout"]), height, width)
    noisy = tuple((noisy_member_of(row), str(row["noisy_xxh3"])) for row in rows)
    return Expected(sample_key(rows[0]), form, ((CLEAN, str(rows[0]["clean_xxh3"])), *noisy), row_json(rows))


def noisy_member_of(row: Row) -> str:
    """Return the member that holds a row's noisy frame."""
    return noisy_member(int(row["level"] or 0), int(row["draw"] or 0))


# ---------------------------------------------------------------------------------------------------------- replay


@dataclass(frozen=True, slots=True)
class Replayed:
    """What came of making one row again; ``complaint`` is empty where the pair is the same, bit for bit."""

    key: str
    source: str
    complaint: str


def source_root(manifest: Path, root: str | None) -> str | None:
    """Return the folder of the sources: the one given, or the one that ``dataset.json`` beside the manifest names."""
    if root is not None:
        return root
    try:
        recorded = json.loads((manifest.parent / "dataset.json").read_text(encoding="utf-8"))["source"]["root"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return None if recorded is None else str(recorded)


def spread(manifest: Path, count: int) -> Iterator[Row]:
    """Yield ``count`` rows of pairs (or all there are), evenly spread over a manifest."""
    places = [at for at, row in rows_with_offsets(manifest) if row["status"] == "ok"]
    return (read_row(manifest, at) for at in evenly_spaced(places, count))


def replay(rows: Iterable[Row], root: str | None, to: Path | None = None) -> Iterator[Replayed]:
    """Make the pairs of rows again, compare them with the rows' digests, and keep them in ``to`` if it is given.

    ``root`` is the folder of the sources; rows of built-in scenes need none. Failed photographs have no pair and are
    passed over. Raises ConfigError and MachineError as `Maker.make` does.
    """
    maker = Maker(root)
    for row in rows:
        if row["status"] != "ok":
            continue
        yield Replayed(str(row["key"]), str(row["source"]), _replay(row, maker, to))


def _is_scene(row: Row) -> bool:
    return row["source_bytes"] == 0


def _replay(row: Row, maker: Maker, to: Path | None) -> str:
    try:
        pair = maker.make(row)
    except DamageError as error:
        return str(error)
    if to is not None:
        _keep(pair, to, str(row["key"]))
    return _unlike(pair, row)


class Maker:
    """Make pairs again from rows and the folder of their sources, ``root``; built-in scenes need none.

    The last photograph is kept decoded, since the pairs of one image stand side by side.
    """

    def __init__(self, root: str | None) -> None:
        self._root = root
        self._kept: tuple[SourceConfig, Source, str, Photograph] | None = None

    def make(self, row: Row) -> Pair:
        """Return a row's pair, whatever its digests.

        Raises DamageError where its source has changed, ConfigError where it was made from a folder's file and there
        is no folder, MachineError where this machine computes differently (`selftest`).
        """
        if self._root is None and not _is_scene(row):
            raise ConfigError(f"row {row['key']} was made from the file {row['source']}: give source.root=…")
        plan = plan_from_row(row)
        selftest.check(selftest.kernels(plan))
        try:
            sha256, photograph = self._load(row)
        except SourceError as error:
            sha256 = error.sha256 or str(row["source_sha256"])
            raise DamageError(_changed(sha256, row) or f"its source cannot be used ({error})") from error
        except MachineError as error:
            raise DamageError(str(error)) from error
        if complaint := _changed(sha256, row):
            raise DamageError(complaint)
        patch = patch_from_row(row)
        pixels = crop_patch(photograph.srgb, patch)
        if pixels.shape[:2] != (patch.height, patch.width):
            raise DamageError(
                f"its {patch.width} x {patch.height} pixels from row {patch.y}, column {patch.x} on "
                f"are not all in its source of {photograph.srgb.shape[1]} x {photograph.srgb.shape[0]}"
            )
        return make_pair(pixels, plan, patch.origin)

    def make_again(self, row: Row) -> Pair:
        """Return the pair of a row; raises as `make`, and DamageError where the pair is not the row's."""
        pair = self.make(row)
        if complaint := _unlike(pair, row):
            raise DamageError(complaint)
        return pair

    def _load(self, row: Row) -> tuple[str, Photograph]:
        root = None if _is_scene(row) else self._root
        config = SourceConfig(root=root, max_pixels=NO_LIMIT, downscale=int(row["downscale"] or 1))
        source = source_of(row)
        if self._kept is None or self._kept[:2] != (config, source):
            self._kept = None  # two photographs at a time would take twice the memory
            self._kept = config, source, *load_source(config, source)
        return self._kept[2:]


def _unlike(pair: Pair, row: Row) -> str:
    return "; ".join(
        f"the XXH3-128 of {name} is {found}, the row says {row[f'{name}_xxh3']}"
        for name, found in (("clean", array_xxh3(pair.clean)), ("noisy", array_xxh3(pair.noisy)))
        if found != row[f"{name}_xxh3"]
    )


def _changed(sha256: str, row: Row) -> str:
    if sha256 == row["source_sha256"]:
        return ""
    return f"its source has changed: SHA-256 is {sha256}, the row says {row['source_sha256']}"


def _keep(pair: Pair, to: Path, key: str) -> None:
    to.mkdir(parents=True, exist_ok=True)
    np.save(to / f"{key}.clean.npy", pair.clean)
    np.save(to / f"{key}.noisy.npy", pair.noisy)


def source_of(row: Row) -> Source:
    """Return the source that a row was made from."""
    name, size = str(row["source"]), row["source_bytes"]
    path = sources.decode_name(name)
    clip, frame = str(row["clip"]) or NO_CLIP, int(row["frame"] or 0)
    return Source(int(image_key(row)), name, path, size if isinstance(size, int) else None, clip=clip, frame=frame)
