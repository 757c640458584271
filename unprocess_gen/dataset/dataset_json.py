"""Read and write ``dataset.json``; its records are typed, so that every verb reports an edited file as damage."""

from __future__ import annotations

import contextlib
import hashlib
import json
from typing import Any, Literal, NamedTuple

import msgspec

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.core.records import MAX_BYTES, Amount, Count, Digest, check_record, parse_json, parse_record
from unprocess_gen.dataset.shards import shard_name


class SourceFacts(msgspec.Struct, frozen=True, omit_defaults=True):
    """Kind and place of the sources, and the file that lists them."""

    kind: Literal["folder", "synthetic", "raw", "linear", "synthetic_linear"]
    root: str | None
    list: str | None = None


class DarkFrameFacts(msgspec.Struct, frozen=True, omit_defaults=True):
    """Place and statistics of the dark frames of a run."""

    root: str | None = None
    count: Count = 0
    sizes: list[str] = []
    black_dn: float = 0.0
    std_dn: Amount = 0.0


class ShardFacts(msgspec.Struct, frozen=True):
    """File, counts and digest of a shard; no file if all its sources failed."""

    file: str | None
    pairs: Count
    failed: Count
    bytes: Count
    sha256: Digest | None


class RunFacts(msgspec.Struct, frozen=True):
    """Host and process that finished a dataset; a run in parts has no times."""

    host: str
    platform: str
    python: str
    n_jobs: int = 0
    seconds: Amount = 0.0
    shards_made: Count = 0
    parts: Count | None = None
    max_failed: Count | None = None


class DatasetFacts(msgspec.Struct, frozen=True):
    """Contents of a ``dataset.json`` that a verb reads; None is what a repair could not restore."""

    format: Literal[1]
    fingerprint: Digest
    manifest_sha256: Digest
    config_sha256: Digest
    pairs: Count
    failed: dict[str, Count]
    sites: dict[str, Count]
    source: SourceFacts
    shards: list[ShardFacts]
    config: str
    self_test: str
    filtered: Count = 0
    not_matched: Count | None = None
    skipped_links: Count | None = None
    run: RunFacts | None = None
    versions: dict[str, str] | None = None
    dark_frames: DarkFrameFacts | None = None


FORMAT = 1
"""Format of the datasets that this version writes and reads; the first key of ``dataset.json``."""

_START = f'{{\n "format": {FORMAT},'.encode()


def check_format(folder: AnyPath) -> None:
    """Raise DamageError if the ``dataset.json`` of a folder states another format, or none."""
    path = folder / "dataset.json"
    with contextlib.suppress(OSError, ValueError), path.open("rb") as stream:  # `verify` reports damage
        start = stream.read(len(_START))
        if start != _START:
            check_format_of(path, parse_json(start + stream.read(MAX_BYTES)))


def check_format_of(path: AnyPath, facts: Any) -> None:
    """Raise DamageError if the contents of a ``dataset.json`` state another format, or none."""
    if isinstance(facts, dict) and facts.get("format") != FORMAT:
        stated = f"format={repr(facts['format'])[:40]}" if "format" in facts else "has no format"
        raise DamageError(
            f"{path}: {stated}; expected a dataset of format {FORMAT}; regenerate it with this version of unprocess_gen"
        )


def check_dataset_json(facts: Any) -> DatasetFacts:
    """Check the types and ranges of a loaded ``dataset.json``; ValueError names the key."""
    checked = check_record(facts, DatasetFacts)
    for number, entry in enumerate(checked.shards):
        check_shard(number, entry)
    return checked


def check_shard(number: int, entry: ShardFacts) -> None:
    """Raise ValueError if the entry of a shard has another file than the shard."""
    name = f"shards/{shard_name(number)}"
    if entry.file not in (None, name):
        raise ValueError(f"shards[{number}].file={entry.file[:40]!r}: expected null or {name}")
    if entry.file is not None and entry.sha256 is None:
        raise ValueError(f"shards[{number}].sha256=null: expected 64 hexadecimal digits")


def dataset_facts(
    config_yaml: str, manifest_sha256: str, entries: list[dict[str, Any]], facts: dict[str, Any]
) -> dict[str, Any]:
    """Contents of ``dataset.json``, including the text of ``config.yaml``, from which a repair restores it."""
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
    """Digest that identifies a dataset, from the digests of its config and of its manifest."""
    return hashlib.sha256(f"{config_sha256}\n{manifest_sha256}\n".encode()).hexdigest()


def dataset_text(facts: dict[str, Any]) -> str:
    """Text of ``dataset.json``: the facts and, as the last key, the SHA-256 of the text without it."""
    text = json.dumps(facts, indent=1) + "\n"
    return f'{text[: -len(_END)]},\n "dataset_sha256": "{hashlib.sha256(text.encode()).hexdigest()}"{_END}'


def read_dataset(path: AnyPath) -> dict[str, Any]:
    """Read a ``dataset.json`` and check it against its own SHA-256; DamageError if it is damaged."""
    try:
        if (any_path(path).size() or 0) > MAX_BYTES:
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


class Places(NamedTuple):
    """Places of sources, of the file that lists them, and of dark frames; None for what is unknown or not used."""

    root: str | None
    list: str | None
    dark_frames: str | None

    @property
    def settings(self) -> dict[str, str | None]:
        """Settings that give these places."""
        sources = {"source.root": self.root, "source.list": self.list if self.root else None}
        return sources | {"noise.dark_frames": self.dark_frames}


class _Recorded(msgspec.Struct, frozen=True):
    source: SourceFacts = SourceFacts("synthetic", None)
    dark_frames: DarkFrameFacts | None = None


def recorded_places(folder: AnyPath, root: str | None = None, dark_frames: str | None = None) -> Places:
    """Places that are given, else those in ``dataset.json``, which may be missing or damaged."""
    try:
        recorded = parse_record((folder / "dataset.json").read_bytes(), _Recorded)
    except (OSError, ValueError):
        recorded = _Recorded()
    recorded_frames = recorded.dark_frames or DarkFrameFacts()
    recorded_root = recorded.source.root if root is None else root
    return Places(recorded_root, recorded.source.list, dark_frames or recorded_frames.root)


_END = "\n}\n"
"""End of the text of a mapping. A digest is inserted there: serializing twice takes a fifth of a merge."""
