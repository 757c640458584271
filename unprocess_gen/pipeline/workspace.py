"""The output folder of a run: lock, temporary files, commit of shards, manifest and ``dataset.json``.

    out/config.yaml              the resolved config, written first
    out/.work/sources.json       names and sizes of all sources, as the first run listed them
    out/.work/tmp/               unfinished shards; emptied at every start
    out/.work/rows/00000.json    rows and entry of a committed shard, until manifest.csv exists
    out/shards/                  committed shards only
    out/manifest.csv             written once every shard is committed or provisional
    out/dataset.json             written last; then .work is deleted, unless a shard is provisional
    out/report.html              the page of the verb ``report``; not part of the dataset

Only the coordinator renames files to their final names: it syncs them first, and commits a shard's rows before the
shard. So a committed shard has its rows whenever a run is killed, and everything else is regenerated to the same bytes.
The lock (`core.locks`) ends with the process. Syncing and renaming take 45 ms per shard.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

from yaml import YAMLError

from unprocess_gen.config.serialization import differences
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, DamageError, LockedError
from unprocess_gen.core.files import RESUME, commit_file, machine_error
from unprocess_gen.core.locks import FolderLock, NoLocksError
from unprocess_gen.core.object_store import AnyPath
from unprocess_gen.core.output_paths import enclosing_dataset
from unprocess_gen.core.types import Row, Source
from unprocess_gen.dataset.columns import NAMES
from unprocess_gen.dataset.dataset_json import MAX_BYTES, check_dataset_json
from unprocess_gen.dataset.manifest import read_rows, row_of_values, write_rows
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.tasks import ShardResult

REPORT = "report.html"
"""The page of a dataset, the one file in its folder that is not part of the dataset."""

SHOWN = 3
"""Differences named in an error; the others are counted."""


class Workspace:
    """Hold an output folder for this process, from `open` until `close`."""

    def __init__(self, out: Path, config_yaml: str) -> None:
        self.out = out
        self.config_yaml = config_yaml
        self.work = out / ".work"
        self.tmp = self.work / "tmp"
        self.rows = self.work / "rows"
        self.shards = out / "shards"
        self._lock = FolderLock(out)

    def __enter__(self) -> Workspace:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock."""
        self._lock.release()

    def open(self) -> None:
        """Create the folder if needed, and lock it.

        Raises LockedError if another run holds it, ConfigError if it cannot be written, contains other files or is
        inside a dataset.
        """
        self._refuse_datasets_around()
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"out={self.out}: cannot be written ({error.strerror})") from error
        self.hold()
        self._refuse_foreign_files()

    def hold(self) -> None:
        """Lock an existing folder; raise LockedError or ConfigError as `open` does."""
        try:
            self._lock.acquire(wait=False)
        except BlockingIOError:
            raise LockedError(
                f"out={self.out}: another run is writing to it; wait for that run, or choose another out"
            ) from None
        except NoLocksError as error:
            raise ConfigError(
                f"out={self.out}: this file system cannot lock it ({error.strerror}); choose another out"
            ) from error
        except OSError as error:
            raise ConfigError(f"out={self.out}: cannot be written ({error.strerror})") from error

    def _refuse_datasets_around(self) -> None:
        """Refuse a folder inside a dataset, finished or begun, which would become a foreign file of that dataset."""
        dataset = enclosing_dataset(Path(os.path.realpath(self.out)).parent)
        if dataset is not None:
            raise ConfigError(
                f"out={self.out}: is inside the dataset {dataset}; expected a folder outside of it; choose another out"
            )

    def _refuse_foreign_files(self) -> None:
        """Refuse a folder that contains files but no dataset, so that no file of the user is overwritten."""
        foreign = sorted(set(os.listdir(self.out)) - {".work"})
        if foreign and not (self.out / "config.yaml").exists():
            raise ConfigError(
                f"out={self.out}: contains {foreign[0]}, but no config.yaml; expected an empty folder or a dataset; "
                "choose another out"
            )

    @property
    def complete(self) -> bool:
        """True if the dataset is finished: no shard is missing or provisional."""
        path = self.out / "dataset.json"
        return path.exists() and not any(entry.get("provisional") for entry in read_dataset(path)["shards"])

    def check_begun(self, sources: Sequence[Source]) -> None:
        """Raise ConfigError if an earlier run began ``out`` with other settings or sources; name the differences."""
        self._check_same_settings()
        listing = self.work / "sources.json"
        if listing.exists():
            self._check_same_sources(_read_listing(listing), sources)

    def begin(self, sources: Sequence[Source]) -> None:
        """Start a dataset, or continue one that an earlier run began and `check_begun` has accepted.

        Raises ConfigError if the folder cannot be written; MachineError if the disk is full.
        """
        listing = self.work / "sources.json"
        try:
            self.work.mkdir(exist_ok=True)
            self.rows.mkdir(exist_ok=True)
            shutil.rmtree(self.tmp, ignore_errors=True)
            self.tmp.mkdir(exist_ok=True)  # rmtree can fail while an orphaned worker of a killed run still writes here
            if not listing.exists():
                self._write(
                    listing, json.dumps([[source.name, source.size_bytes, source.sha256] for source in sources])
                )
            if not (self.out / "config.yaml").exists():
                self._write(self.out / "config.yaml", self.config_yaml)
            self.shards.mkdir(exist_ok=True)  # after config.yaml, by which a later run recognises the folder
            self._refuse_foreign_shards()
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise machine_error(error, self.out, RESUME) from error
            raise ConfigError(f"out={self.out}: cannot be written ({error.strerror})") from error

    def _refuse_foreign_shards(self) -> None:
        for path in sorted(self.shards.iterdir()):
            if not self._rows_path(_shard_number(path.name)).exists():
                raise ConfigError(
                    f"out={self.out}: unexpected file {path}; expected only committed shards; remove it or choose "
                    "another out"
                )

    def check_complete(self, sources: Sequence[Source]) -> dict[str, Any]:
        """Return the contents of a finished dataset's ``dataset.json``.

        Raises ConfigError if it was made from other settings or sources, DamageError if a shard is missing or has
        another size.
        """
        if not (self.out / "config.yaml").exists():
            raise DamageError(
                f"{self.out}/config.yaml: is missing from a finished dataset; gen-dataset verify {self.out} "
                "--repair restores it"
            )
        self._check_same_settings()
        rows = read_rows(self.out / "manifest.csv")
        known = {str(row["source"]): (row["source_bytes"], row["source_sha256"]) for row in rows}
        self._check_same_sources(known, sources)
        facts = read_dataset(self.out / "dataset.json")
        for entry in facts["shards"]:
            _check_size(self.out, entry)
        shutil.rmtree(self.work, ignore_errors=True)
        return facts

    def _check_same_settings(self) -> None:
        path = self.out / "config.yaml"
        if not path.exists():
            return
        try:
            differing = differences(self.config_yaml, path.read_text(encoding="utf-8"))
        except (ValueError, YAMLError) as error:
            raise DamageError(f"{path}: cannot be read ({error_in_one_line(error)}); choose another out") from error
        if differing:
            raise ConfigError(
                f"out={self.out}: was begun with other settings: {_first(differing)}; choose another out, or remove it"
            )

    def _check_same_sources(self, known: dict[str, Any], sources: Sequence[Source]) -> None:
        found = {source.name: (source.size_bytes, source.sha256) for source in sources}
        differing = [
            *(f"{name} is new" for name in found if name not in known),
            *(f"{name} was deleted" for name in known if name not in found),
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
                f"out={self.out}: was begun with other sources: {_first(differing)}; choose another out, or remove it"
            )

    def committed(self, count: int) -> list[int]:
        """Return the numbers, below ``count``, of the shards that are committed."""
        return [shard for shard in range(count) if self._is_committed(shard)]

    def _is_committed(self, shard: int) -> bool:
        try:
            entry = self.entry(shard)
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return False
        try:
            _check_size(self.out, entry)
        except DamageError:
            return False
        return True

    def entry(self, shard: int) -> dict[str, Any]:
        """Return the entry of a committed shard in ``dataset.json``."""
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

    def commit(self, result: ShardResult) -> None:
        """Move a finished shard into place, durably: first its rows, then the file; raise MachineError on failure."""
        record = {"entry": result.entry(), "rows": [[row[name] for name in NAMES] for row in result.rows]}
        try:
            self._write(self._rows_path(result.shard), json.dumps(record, separators=(",", ":")))
            if result.path is not None:
                commit_file(Path(result.path), self.shards / shard_name(result.shard))
        except OSError as error:
            raise machine_error(error, self.out, RESUME) from error

    def finish(self, shards: int, provisional: dict[int, ShardResult], facts: dict[str, Any]) -> dict[str, Any]:
        """Write ``manifest.csv``, then ``dataset.json``, and return the latter's contents.

        Provisional shards get provisional rows; ``.work`` is then kept, so that the next run retries them. Raises
        MachineError if a file cannot be written.
        """
        try:
            manifest_sha256 = self._write_manifest(self.all_rows(shards, provisional))
            entries = [
                provisional[shard].entry() if shard in provisional else self.entry(shard) for shard in range(shards)
            ]
            dataset = dataset_facts(self.config_yaml, manifest_sha256, entries, facts)
            self._write(self.out / "dataset.json", dataset_text(dataset))
            shutil.rmtree(self.tmp if provisional else self.work)
        except OSError as error:
            raise machine_error(error, self.out, RESUME) from error
        return dataset

    def all_rows(self, shards: int, provisional: dict[int, ShardResult]) -> Iterator[Row]:
        """Yield every row of the dataset, in source order."""
        for shard in range(shards):
            yield from provisional[shard].rows if shard in provisional else self.committed_rows([shard])

    def _write_manifest(self, rows: Iterable[Row]) -> str:
        path = self.out / "manifest.csv"
        with self._written_durably(path) as stream:
            write_rows(stream, rows)
        with path.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()

    def _write(self, path: Path, text: str) -> None:
        with self._written_durably(path) as stream:
            stream.write(text)

    @contextlib.contextmanager
    def _written_durably(self, path: Path) -> Iterator[TextIO]:
        """Open a temporary text file below ``.work``; on leaving, sync it and rename it to ``path``."""
        temporary = self.work / (path.name + ".part")
        with temporary.open("w", encoding="utf-8", newline="") as stream:
            yield stream
        commit_file(temporary, path)


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
    """Return the contents of ``dataset.json``, including the text of ``config.yaml`` for `repair`."""
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
    """Return the digest that identifies a dataset, from those of its config and of its manifest."""
    return hashlib.sha256(f"{config_sha256}\n{manifest_sha256}\n".encode()).hexdigest()


def dataset_text(facts: dict[str, Any]) -> str:
    """Return the text of ``dataset.json``: the facts and, as the last key, the SHA-256 of the text without it."""
    return _text(facts | {"dataset_sha256": hashlib.sha256(_text(facts).encode()).hexdigest()})


def read_dataset(path: AnyPath) -> dict[str, Any]:
    """Read a ``dataset.json`` and check it against its own SHA-256.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    dict
        Its contents, without ``dataset_sha256``.

    Raises
    ------
    DamageError
        If the file cannot be read or any byte of it was changed.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"more than {MAX_BYTES} bytes")
        text = path.read_bytes().decode("ascii")
        facts = json.loads(text)
        facts.pop("dataset_sha256")
        intact = dataset_text(facts) == text
        if intact:
            check_dataset_json(facts)
    except (OSError, ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise DamageError(f"{path}: cannot be read ({error_in_one_line(error)})") from error
    if not intact:
        raise DamageError(f"{path}: was changed: its SHA-256 differs from dataset_sha256")
    return dict(facts)


def _text(facts: dict[str, Any]) -> str:
    return json.dumps(facts, indent=1) + "\n"


def _check_size(out: Path, entry: dict[str, Any]) -> None:
    if entry["file"] is None:
        return
    path = out / entry["file"]
    size = path.stat().st_size if path.is_file() else None
    if size != entry["bytes"]:
        found = "is missing" if size is None else f"has {size} bytes"
        raise DamageError(
            f"{path}: {found}, expected {entry['bytes']} bytes; gen-dataset verify {out} --repair restores it"
        )


def _shard_number(name: str) -> int:
    """Return the number in a shard's file name, -1 for other names."""
    found = re.fullmatch(r"shard-(\d{5,})\.tar", name)
    return int(found[1]) if found else -1


def _first(differing: Sequence[str]) -> str:
    rest = len(differing) - SHOWN
    return "; ".join(itertools.islice(differing, SHOWN)) + (f"; and {rest} more" if rest > 0 else "")
