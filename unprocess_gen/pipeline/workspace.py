"""Check and lock the output folder of a run, and write the files that begin and finish a dataset.

    out/config.yaml              the resolved config, written first
    out/.work/lock               the process that coordinates a run (`core.locks`)
    out/.work/sources/           all sources as the first run listed them (`run_records`)
    out/.work/tmp/WRITER/        unfinished files of one writer, which it deletes when it ends
    out/.work/rows/00000.json    rows and entry of a committed shard, until manifest.csv exists (`run_records`)
    out/shards/                  complete shards
    out/manifest.csv             written once every shard is committed or provisional
    out/dataset.json             written last; then .work is deleted, unless a shard is provisional
    out/report.html              the page of the verb ``report``; not part of the dataset

Workers sync and rename their shards, then the shards' records. A shard without a record is regenerated, to the same
bytes, whenever a run is killed. Correct data do not depend on the lock: two runs that hold it at once make the same
files, and neither deletes what the other one is writing.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from yaml import YAMLError

from unprocess_gen.config.serialization import differences
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import RESUME, ConfigError, DamageError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.core.records import MAX_BYTES, parse_json
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.dataset_json import FORMAT, check_dataset_json, check_format, check_format_of
from unprocess_gen.dataset.keys import group_by_image
from unprocess_gen.dataset.manifest import header_text, read_rows
from unprocess_gen.pipeline.run_records import INDEX, ShardRecords, recorded_sources, write_listing
from unprocess_gen.pipeline.storage import WORK, Storage, cannot_write
from unprocess_gen.pipeline.tasks import Tally

REPORT = "report.html"
"""The page of a dataset, a file in its folder that is not part of the dataset."""

DIFFERENCES_SHOWN = 3
"""Differences named in an error; the others are counted."""


class Workspace:
    """Hold an output folder for this process, from `open` until the context ends.

    ``config_yaml`` is the text of the dataset's ``config.yaml``; ``records`` are the committed shards.
    """

    def __init__(self, out: str | Path, config_yaml: str) -> None:
        self.out = str(out)
        self.config_yaml = config_yaml
        self.storage = Storage(self.out)
        self.records = ShardRecords(self.storage)

    def __enter__(self) -> Workspace:
        return self

    def __exit__(self, *_: object) -> None:
        self.storage.close()

    def open(self) -> None:
        """Create the folder if needed, and lock it; a finished dataset is locked only if it can be written to.

        Raises LockedError if another run holds it, ConfigError if it cannot be written, contains other files or is
        inside a dataset.
        """
        self.storage.open()
        check_format(self.storage.path)
        self._refuse_foreign_files()
        try:
            self.storage.hold()
        except ConfigError:
            if not self.is_complete():
                raise

    def _refuse_foreign_files(self) -> None:
        """Refuse a folder that contains files but no dataset, so that no file of the user is overwritten."""
        entries = self.storage.path.entries()
        foreign = sorted(entries.keys() - {WORK})
        if foreign and "config.yaml" not in entries:
            raise ConfigError(
                f"out={self.out}: contains {foreign[0]}, but no config.yaml; expected an empty folder or a dataset; "
                "choose another out"
            )

    def is_complete(self) -> bool:
        """True if the dataset is finished: no shard is missing or provisional."""
        facts = self.facts()
        return facts is not None and not any(entry.get("provisional") for entry in facts["shards"])

    def facts(self) -> dict[str, Any] | None:
        """Return the contents of ``dataset.json``, None without one; raise DamageError if it is damaged."""
        if (self.storage / "dataset.json").size() is None:
            return None
        check_format(any_path(self.out))
        try:
            return read_dataset(any_path(self.out) / "dataset.json")
        except DamageError as error:
            raise DamageError(f"{error}; gen-dataset verify {self.out} --repair restores it") from error

    def check_begun(self, sources: Sequence[Source], root: str | None) -> None:
        """Raise ConfigError if an earlier run began ``out`` with other settings or sources; name the differences."""
        self._check_same_settings(root)
        known = partial(recorded_sources, self.storage)
        if next(known(), None) is not None:
            self._check_same_sources(known, sources, _is_listed_alike)

    def begin(self, sources: Sequence[Source], shards: int) -> None:
        """Start a dataset of some shards, or continue one that an earlier run began and `check_begun` has accepted.

        Raises ConfigError if the folder cannot be written; MachineError if the disk is full.
        """
        try:
            self._check_same_settings()  # another run may have begun since `check_begun`, where there are no locks
            if (self.storage / INDEX).size() is None:
                write_listing(self.storage, sources)
            if not self.storage.create("config.yaml", self.config_yaml):
                self._check_same_settings()
            self.storage.begin()  # after config.yaml, by which a later run recognises the folder
            self._refuse_foreign_shards(shards)
            _ = self.storage.scratch
        except OSError as error:
            raise cannot_write(error, self.out) from error

    def _refuse_foreign_shards(self, shards: int) -> None:
        for name in sorted((self.storage / "shards").entries()):
            if not 0 <= _shard_number(name) < shards:
                raise ConfigError(
                    f"out={self.out}: unexpected file {self.out}/shards/{name}; expected only committed shards; remove "
                    "it or choose another out"
                )

    def check_complete(self, sources: Sequence[Source]) -> dict[str, Any]:
        """Return the contents of a finished dataset's ``dataset.json``.

        Raises ConfigError if it was made from other settings or sources, DamageError if a shard is missing or has
        another size.
        """
        if (self.storage / "config.yaml").size() is None:
            raise DamageError(
                f"{self.out}/config.yaml: is missing from a finished dataset; gen-dataset verify {self.out} "
                "--repair restores it"
            )
        self._check_same_settings()
        known = partial(_sources_of_rows, any_path(self.out) / "manifest.csv")
        self._check_same_sources(known, sources, _is_alike)
        facts = self.facts()
        assert facts is not None
        sizes = {f"shards/{name}": size for name, size in (self.storage / "shards").entries().items()}
        for entry in facts["shards"]:
            size = sizes.get(entry["file"])
            if entry["file"] is not None and size != entry["bytes"]:
                problem = "is missing" if size is None else f"has {size} bytes"
                raise DamageError(
                    f"{self.out}/{entry['file']}: {problem}, expected {entry['bytes']} bytes; gen-dataset verify "
                    f"{self.out} --repair restores it"
                )
        self.storage.remove_work(keep_records=False)
        return facts

    def _check_same_settings(self, root: str | None = None) -> None:
        if (self.storage / "config.yaml").size() is None:
            return
        try:
            differing = differences(self.config_yaml, self.storage.read("config.yaml"))
        except (ValueError, YAMLError) as error:
            raise DamageError(
                f"{self.out}/config.yaml: cannot be read ({error_in_one_line(error)}); choose another out"
            ) from error
        if differing:
            remedy = "remove it"
            if not self.is_complete():
                out = shlex.quote(self.out)
                sources = f" source.root={shlex.quote(root)}" if isinstance(root, str) else ""
                remedy = f"finish it with its own settings: gen-dataset again {out} out={out}{sources}"
            raise ConfigError(
                f"out={self.out}: was begun with other settings: {_first(differing)}; choose another out, or {remedy}"
            )

    def _check_same_sources(
        self, known: Callable[[], Iterator[Source]], sources: Sequence[Source], same: Callable[[Source, Source], bool]
    ) -> None:
        """Raise ConfigError if the sources are not those that are known; name the differences.

        Both are in the order of the listing, so equal ones are compared without holding the known ones: a million take
        0.4 GB.
        """
        pairs = itertools.zip_longest(known(), sources)
        if all(old and new and old.name == new.name and same(old, new) for old, new in pairs):
            return
        files, listed = ({source.name: source for source in side} for side in (known(), sources))
        changes = (_change(name, files.get(name), listed.get(name), same) for name in listed | files)
        differing = [change for change in changes if change]
        if differing:
            raise ConfigError(
                f"out={self.out}: was begun with other sources: {_first(differing)}; choose another out, or remove it"
            )

    def finish(
        self, shards: int, columns: Sequence[str], facts_of: Callable[[Tally], dict[str, Any]]
    ) -> dict[str, Any]:
        """Write ``manifest.csv`` with some columns, then ``dataset.json``, and return the latter's contents.

        If a shard is provisional, ``.work`` is kept, so that the next run retries it. Raises MachineError or
        DamageError.
        """
        entries: list[dict[str, Any]] = []
        tally = Tally()
        with machine_errors(any_path(self.out), RESUME):
            manifest = self.storage.scratch / "manifest.csv"
            digest = hashlib.sha256()
            with manifest.open("wb", buffering=2**20) as stream:
                for text in self._manifest(shards, columns, entries, tally):
                    digest.update(text)
                    stream.write(text)
            manifest_sha256 = digest.hexdigest()
            (self.storage / "manifest.csv").commit(manifest)
            dataset = dataset_facts(self.config_yaml, manifest_sha256, entries, facts_of(tally))
            self.storage.write("dataset.json", dataset_text(dataset))
            self.storage.remove_work(keep_records=any(entry.get("provisional") for entry in entries))
        return dataset

    def _manifest(
        self, shards: int, columns: Sequence[str], entries: list[dict[str, Any]], tally: Tally
    ) -> Iterator[bytes]:
        """Yield the text of the manifest; append the entry of each shard, and add its counts."""
        yield header_text(columns).encode()
        for record in self.storage.path.map(self.records.record, range(shards)):
            entries.append(record.entry)
            tally.add(record.tally)
            yield record.csv


def _sources_of_rows(manifest: AnyPath) -> Iterator[Source]:
    """Yield the source of every image, with name, size and digest only."""
    for index, rows in enumerate(group_by_image(read_rows(manifest))):
        size, name = rows[0]["source_bytes"], str(rows[0]["source"])
        sha256 = str(rows[0]["source_sha256"])
        yield Source(index, name, name, size if isinstance(size, int) else None, sha256=sha256)


def _change(name: str, old: Source | None, new: Source | None, same: Callable[[Source, Source], bool]) -> str:
    """Describe how a source differs from the known file of its name; empty if it does not."""
    if old is None or new is None:
        return f"{name} is new" if old is None else f"{name} was deleted"
    if new.size_bytes != old.size_bytes:
        return f"{name} has {new.size_bytes} bytes, had {old.size_bytes}"
    return "" if same(old, new) else f"{name} has other bytes than it had"


def _is_alike(old: Source, new: Source) -> bool:
    """Check whether a source has the size of the one in the manifest, and its digest if the listing hashed it."""
    return new.size_bytes == old.size_bytes and (not old.sha256 or new.sha256 in (None, old.sha256))


def _is_listed_alike(old: Source, new: Source) -> bool:
    """Check whether a source was listed before with the same size, digest and ETag.

    A listing hashes the files that could be identical. If one of them has changed, another one can have another number
    among identical files, and so other noise.
    """
    same_etag = not old.etag or new.etag in (None, old.etag)
    return (new.size_bytes, new.sha256) == (old.size_bytes, old.sha256) and same_etag


def dataset_facts(
    config_yaml: str, manifest_sha256: str, entries: list[dict[str, Any]], facts: dict[str, Any]
) -> dict[str, Any]:
    """Return the contents of ``dataset.json``, including the text of ``config.yaml`` for `repair`."""
    config_sha256 = hashlib.sha256(config_yaml.encode()).hexdigest()
    return {
        "format": FORMAT,
        "fingerprint": fingerprint(config_sha256, manifest_sha256),
        "manifest_sha256": manifest_sha256,
        "config_sha256": config_sha256,
        "self_test": "failed" if any("self_test" in entry for entry in entries) else "passed",
        **facts,
        "config": config_yaml,
        "shards": entries,
    }


def fingerprint(config_sha256: str, manifest_sha256: str) -> str:
    """Return the digest that identifies a dataset, from the digests of its config and of its manifest."""
    return hashlib.sha256(f"{config_sha256}\n{manifest_sha256}\n".encode()).hexdigest()


def dataset_text(facts: dict[str, Any]) -> str:
    """Return the text of ``dataset.json``: the facts and, as the last key, the SHA-256 of the text without it."""
    text = json.dumps(facts, indent=1) + "\n"
    return f'{text[: -len(_END)]},\n "dataset_sha256": "{hashlib.sha256(text.encode()).hexdigest()}"{_END}'


def read_dataset(path: AnyPath) -> dict[str, Any]:
    """Read a ``dataset.json`` and check it against its own SHA-256.

    Raises DamageError.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"more than {MAX_BYTES} bytes")
        content = path.read_bytes()
        facts = parse_json(content)
        check_format_of(path, facts)
        facts.pop("dataset_sha256")
        intact = dataset_text(facts).encode() == content
        if intact:
            check_dataset_json(facts)
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise DamageError(f"{path}: cannot be read ({error_in_one_line(error)})") from error
    if not intact:
        raise DamageError(f"{path}: was changed: its SHA-256 differs from dataset_sha256")
    return dict(facts)


_END = "\n}\n"
"""End of the text of a mapping. A digest is inserted there: serializing twice takes a fifth of a merge."""


def _shard_number(name: str) -> int:
    """Return the number in a shard's file name, -1 for other names."""
    match = re.fullmatch(r"shard-(\d{5,})\.tar", name)
    return int(match[1]) if match else -1


def _first(differing: Sequence[str]) -> str:
    rest = len(differing) - DIFFERENCES_SHOWN
    return "; ".join(itertools.islice(differing, DIFFERENCES_SHOWN)) + (f"; and {rest} more" if rest > 0 else "")
