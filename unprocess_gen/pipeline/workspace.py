"""The folder of a dataset while it is made: who may write, what is done already, and what makes it final.

    out/config.yaml              the settings, from the first moment
    out/.work/sources.json       names and sizes of all sources, as the first run found them
    out/.work/tmp/               shards that workers are writing; swept at every start
    out/.work/rows/00000.json    rows and entry of a committed shard, until manifest.csv exists
    out/shards/                  committed shards only
    out/manifest.csv             written when every shard is committed or given up for now
    out/dataset.json             written last: the dataset is complete, and .work goes, unless a shard is provisional
    out/report.html              a page for people, where one was asked for; no part of the dataset, nothing reads it

Only the coordinator moves anything to its final name: synced first, rows before shard, so whatever moment a run is
killed at, a shard in place has its rows, and all else is made again to the same bytes. The lock is the kernel's
(flock on the folder itself): it leaves no file and dies with the process. Syncing and renaming cost 45 ms a shard.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import itertools
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from yaml import YAMLError

from unprocess_gen.config.serialization import differences
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, DamageError, LockedError
from unprocess_gen.core.files import commit_file, machine_error
from unprocess_gen.core.types import Row, Source
from unprocess_gen.dataset.columns import NAMES
from unprocess_gen.dataset.manifest import read_rows, row_of_values, write_rows
from unprocess_gen.dataset.shards import shard_name

REPORT = "report.html"
"""The page of a dataset, the one file in its folder that is not of the dataset."""

SHOWN = 3
"""Differences named in an error; the rest is counted."""


@dataclass(frozen=True, slots=True)
class ShardResult:
    """A shard that a worker finished: where it lies (None: no pair in it, no file), and its rows.

    ``killer`` names the photograph at which workers died twice; then the rows are provisional and there is no file.
    ``self_test`` says what was wrong with the process that made the shard, where the run was told to go on with it.
    """

    shard: int
    path: str | None
    bytes: int
    sha256: str | None
    rows: tuple[Row, ...]
    killer: str | None = None
    self_test: str | None = None

    def entry(self) -> dict[str, Any]:
        """Return what ``dataset.json`` says of the shard."""
        pairs = sum(row["status"] == "ok" for row in self.rows)
        return {
            **({"provisional": True} if self.killer else {}),
            **({"self_test": self.self_test} if self.self_test else {}),
            "file": None if self.path is None else f"shards/{shard_name(self.shard)}",
            "pairs": pairs,
            "failed": len(self.rows) - pairs,
            "bytes": self.bytes,
            "sha256": self.sha256,
        }


class Workspace:
    """An output folder, held by this process from `open` until `close`."""

    def __init__(self, out: Path, config_yaml: str) -> None:
        self.out = out
        self.config_yaml = config_yaml
        self.work = out / ".work"
        self.tmp = self.work / "tmp"
        self.rows = self.work / "rows"
        self.shards = out / "shards"
        self._lock: int | None = None

    def __enter__(self) -> Workspace:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def open(self) -> None:
        """Make the folder if need be and hold it.

        Raises LockedError where another run holds it, ConfigError where it cannot be written or holds something else.
        """
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"out={self.out}: cannot be written ({error.strerror})") from error
        self.hold()
        self._refuse_foreign_files()

    def hold(self) -> None:
        """Hold a folder that is there; raises LockedError and ConfigError as `open` does."""
        try:
            self._lock = os.open(self.out, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise ConfigError(f"out={self.out}: cannot be written ({error.strerror})") from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise LockedError(f"out={self.out}: another run is writing to it; wait for it or choose another") from None
        except OSError as error:
            raise ConfigError(f"out={self.out}: this file system cannot lock it ({error.strerror})") from error

    def _refuse_foreign_files(self) -> None:
        """Refuse a folder that holds what no run of ours left there, so that nothing of anyone's is overwritten."""
        foreign = sorted(set(os.listdir(self.out)) - {".work"})
        if foreign and not (self.out / "config.yaml").exists():
            raise ConfigError(f"out={self.out}: holds {foreign[0]}, which is not of a dataset; choose an empty folder")

    @property
    def complete(self) -> bool:
        """Whether the dataset is finished: nothing is left to make, or to try again."""
        path = self.out / "dataset.json"
        return path.exists() and not any(entry.get("provisional") for entry in read_dataset(path)["shards"])

    def begin(self, sources: Sequence[Source]) -> None:
        """Start, or go on with what an earlier run began.

        Raises ConfigError where that run had other settings or other sources, naming what differs; ConfigError too
        where the folder cannot be written.
        """
        self._same_settings()
        listing = self.work / "sources.json"
        if listing.exists():
            self._same_sources(_read_listing(listing), sources)
        try:
            self.work.mkdir(exist_ok=True)
            self.rows.mkdir(exist_ok=True)
            shutil.rmtree(self.tmp, ignore_errors=True)
            self.tmp.mkdir(exist_ok=True)  # a worker that outlives a killed run for a moment may have kept it
            if not listing.exists():
                self._write(listing, json.dumps([[one.name, one.size_bytes, one.sha256] for one in sources]))
            if not (self.out / "config.yaml").exists():
                self._write(self.out / "config.yaml", self.config_yaml)
            self.shards.mkdir(exist_ok=True)  # after config.yaml, by which a later run knows the folder for ours
            self._refuse_foreign_shards()
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise machine_error(error, self.out) from error
            raise ConfigError(f"out={self.out}: cannot be written ({error.strerror})") from error

    def _refuse_foreign_shards(self) -> None:
        for path in sorted(self.shards.iterdir()):
            if not self._rows_path(_shard_number(path.name)).exists():
                raise ConfigError(
                    f"out={self.out}: holds {path}, which no run of ours made; remove it or choose another"
                )

    def check_complete(self, sources: Sequence[Source]) -> dict[str, Any]:
        """Return the ``dataset.json`` of a finished dataset.

        Raises ConfigError where it was made from other settings or sources, DamageError where a shard is missing or of
        another size.
        """
        if not (self.out / "config.yaml").exists():
            raise DamageError(f"{self.out}/config.yaml: is missing from a finished dataset; remove {self.out}")
        self._same_settings()
        rows = read_rows(self.out / "manifest.csv")
        known = {str(row["source"]): (row["source_bytes"], row["source_sha256"]) for row in rows}
        self._same_sources(known, sources)
        facts = read_dataset(self.out / "dataset.json")
        for entry in facts["shards"]:
            _same_size(self.out, entry)
        shutil.rmtree(self.work, ignore_errors=True)
        return facts

    def _same_settings(self) -> None:
        path = self.out / "config.yaml"
        if not path.exists():
            return
        try:
            differing = differences(self.config_yaml, path.read_text(encoding="utf-8"))
        except (ValueError, YAMLError) as error:
            raise DamageError(f"{path}: cannot be read ({error_in_one_line(error)}); choose another out") from error
        if differing:
            raise ConfigError(
                f"out={self.out}: was begun with other settings: {_some(differing)}; choose another out, or remove it"
            )

    def _same_sources(self, known: dict[str, Any], sources: Sequence[Source]) -> None:
        found = {source.name: (source.size_bytes, source.sha256) for source in sources}
        differing = [
            *(f"{name} is new" for name in found if name not in known),
            *(f"{name} is gone" for name in known if name not in found),
            *(
                f"{name} has {found[name][0]} bytes, had {known[name][0]}"
                for name in found
                if name in known and found[name][0] != known[name][0]
            ),
            *(
                f"{name} has other bytes than it had"
                for name, (size, sha256) in found.items()
                if name in known and size == known[name][0] and sha256 and known[name][1] not in (None, "", sha256)
            ),
        ]
        if differing:
            raise ConfigError(
                f"out={self.out}: was begun with other sources: {_some(differing)}; choose another out, or remove it"
            )

    def committed(self, count: int) -> list[int]:
        """Return which of ``count`` shards are in place with their rows."""
        return [shard for shard in range(count) if self._is_committed(shard)]

    def _is_committed(self, shard: int) -> bool:
        try:
            entry = self.entry(shard)
        except (FileNotFoundError, ValueError, KeyError):
            return False
        try:
            _same_size(self.out, entry)
        except DamageError:
            return False
        return True

    def entry(self, shard: int) -> dict[str, Any]:
        """Return what ``dataset.json`` will say of a committed shard."""
        return dict(self._record(shard)["entry"])

    def committed_rows(self, shards: Iterable[int]) -> Iterator[Row]:
        """Yield the rows of committed shards, shard by shard."""
        for shard in shards:
            for values in self._record(shard)["rows"]:
                yield row_of_values(values)

    def _record(self, shard: int) -> dict[str, Any]:
        record: dict[str, Any] = json.loads(self._rows_path(shard).read_text(encoding="utf-8"))
        return record

    def _rows_path(self, shard: int) -> Path:
        return self.rows / f"{shard:05d}.json"

    def commit(self, made: ShardResult) -> None:
        """Put a finished shard into place, durably: its rows first, then the shard. MachineError if that fails."""
        record = {"entry": made.entry(), "rows": [[row[name] for name in NAMES] for row in made.rows]}
        try:
            self._write(self._rows_path(made.shard), json.dumps(record, separators=(",", ":")))
            if made.path is not None:
                commit_file(Path(made.path), self.shards / shard_name(made.shard))
        except OSError as error:
            raise machine_error(error, self.out) from error

    def finish(self, shards: int, given_up: dict[int, ShardResult], facts: dict[str, Any]) -> dict[str, Any]:
        """Write ``manifest.csv`` and, last, ``dataset.json``; return what the latter says. MachineError on failure.

        Shards that are ``given_up`` for now have provisional rows; then ``.work`` stays, for the next run to go on.
        """
        try:
            manifest_sha256 = self._write_manifest(self.all_rows(shards, given_up))
            entries = [given_up[shard].entry() if shard in given_up else self.entry(shard) for shard in range(shards)]
            dataset = dataset_facts(self.config_yaml, manifest_sha256, entries, facts)
            self._write(self.out / "dataset.json", dataset_text(dataset))
            shutil.rmtree(self.tmp if given_up else self.work)
        except OSError as error:
            raise machine_error(error, self.out) from error
        return dataset

    def all_rows(self, shards: int, given_up: dict[int, ShardResult]) -> Iterator[Row]:
        """Yield every row of the dataset, in source order."""
        for shard in range(shards):
            yield from given_up[shard].rows if shard in given_up else self.committed_rows([shard])

    def _write_manifest(self, rows: Iterable[Row]) -> str:
        path = self.out / "manifest.csv"
        with self._written_aside(path) as stream:
            write_rows(stream, rows)
        with path.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()

    def _write(self, path: Path, text: str) -> None:
        with self._written_aside(path) as stream:
            stream.write(text)

    @contextlib.contextmanager
    def _written_aside(self, path: Path) -> Iterator[TextIO]:
        """Write a text file below ``.work``, sync it and rename it into place."""
        aside = self.work / (path.name + ".part")
        with aside.open("w", encoding="utf-8", newline="") as stream:
            yield stream
        commit_file(aside, path)


def _read_listing(path: Path) -> dict[str, Any]:
    try:
        return {name: (size, sha256) for name, size, sha256 in json.loads(path.read_text(encoding="utf-8"))}
    except (ValueError, TypeError) as error:
        raise DamageError(
            f"{path}: cannot be read ({error_in_one_line(error)}); remove the folder and start again"
        ) from error


def dataset_facts(
    config_yaml: str, manifest_sha256: str, entries: list[dict[str, Any]], facts: dict[str, Any]
) -> dict[str, Any]:
    """Return what ``dataset.json`` says, the settings' text among it, so that ``config.yaml`` can be had back."""
    config_sha256 = hashlib.sha256(config_yaml.encode()).hexdigest()
    return {
        "fingerprint": fingerprint(config_sha256, manifest_sha256),
        "manifest_sha256": manifest_sha256,
        "config_sha256": config_sha256,
        "self_test": "failed" if any("self_test" in entry for entry in entries) else "passed",
        **facts,
        "config": config_yaml,
        "shards": entries,
    }


def fingerprint(config_sha256: str, manifest_sha256: str) -> str:
    """Return the digest that stands for a dataset: of its settings, and of its manifest, which holds all others."""
    return hashlib.sha256(f"{config_sha256}\n{manifest_sha256}\n".encode()).hexdigest()


def dataset_text(facts: dict[str, Any]) -> str:
    """Return ``dataset.json``: the facts, and last the SHA-256 of the text without it."""
    return _text(facts | {"dataset_sha256": hashlib.sha256(_text(facts).encode()).hexdigest()})


def read_dataset(path: Path) -> dict[str, Any]:
    """Return what a ``dataset.json`` says; DamageError where a byte of it is not as it was written."""
    try:
        text = path.read_bytes().decode("ascii")
        facts = json.loads(text)
        facts.pop("dataset_sha256")
        whole = dataset_text(facts) == text
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise DamageError(f"{path}: cannot be read ({error_in_one_line(error)})") from error
    if not whole:
        raise DamageError(f"{path}: is not as it was written: its own SHA-256 does not fit")
    return dict(facts)


def _text(facts: dict[str, Any]) -> str:
    return json.dumps(facts, indent=1) + "\n"


def _same_size(out: Path, entry: dict[str, Any]) -> None:
    if entry["file"] is None:
        return
    path = out / entry["file"]
    size = path.stat().st_size if path.is_file() else None
    if size != entry["bytes"]:
        found = "is missing" if size is None else f"has {size} bytes"
        raise DamageError(
            f"{path}: {found}, the dataset says {entry['bytes']}; gen-dataset verify {out} --repair mends it"
        )


def _shard_number(name: str) -> int:
    """Return the number in a shard's file name, -1 for other names."""
    found = re.fullmatch(r"shard-(\d{5,})\.tar", name)
    return int(found[1]) if found else -1


def _some(differing: Sequence[str]) -> str:
    rest = len(differing) - SHOWN
    return "; ".join(itertools.islice(differing, SHOWN)) + (f"; and {rest} more" if rest > 0 else "")
