"""A run is a list of shards: its config, its sources, and the files with which it begins.

    out/.work/listing.jsonl    the sources as the first process listed them, a line of JSON each
    out/.work/run.json         config, version, shards, parts, and what the listing left out
    out/config.yaml            the config again, by which a user recognises the folder

They are created in this order and never replaced. Whoever comes first creates them; others compare what they have with
what is recorded. A part reads the listing instead of making its own.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.metadata import version
from typing import Any

import msgspec
from yaml import YAMLError

from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import dataset_yaml, differences, source_kind
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.paths import AnyPath, absolute_text
from unprocess_gen.core.records import Count, Digest, check_record, parse_record
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.dataset_json import DarkFrameFacts, SourceFacts
from unprocess_gen.dataset.keys import group_by_image
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.row import columns_of
from unprocess_gen.pipeline.deaths import DEATHS
from unprocess_gen.pipeline.folder import WORK, OutFolder
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.tasks import ShardTask
from unprocess_gen.planning.advice import body_sentence, warnings
from unprocess_gen.sources.listing import Listing, list_photographs
from unprocess_gen.sources.recorded import RecordedSources, recorded_text

RUN, LISTING = f"{WORK}/run.json", f"{WORK}/listing.jsonl"

MOST_BYTES = 2**35
"""Largest listing that is read: a hundred million sources."""

DIFFERENCES_SHOWN = 3
"""Differences named in an error; the others are counted."""


class RunFile(msgspec.Struct, frozen=True):
    """Facts on which all processes of a run agree; ``parts`` is None if it was not begun by a part."""

    version: str
    config: str
    columns: tuple[str, ...]
    sources: Count
    shards: Count
    parts: Count | None
    listing_sha256: Digest
    max_failed: Count
    not_matched: Count
    skipped_links: Count
    source: SourceFacts
    dark_frames: DarkFrameFacts | None = None

    def facts(self) -> dict[str, Any]:
        """Facts about the sources, as ``dataset.json`` has them."""
        facts = {name: getattr(self, name) for name in ("not_matched", "skipped_links", "source", "dark_frames")}
        return {name: msgspec.to_builtins(fact) for name, fact in facts.items() if fact is not None}


@dataclass(frozen=True)
class Run:
    """The settings of a run and its sources; shard s has those from index s·N on, N = ``output.pairs_per_shard``."""

    settings: PairSettings
    listing: Listing

    @property
    def config(self) -> Config:
        """The complete config."""
        return self.settings.config

    @property
    def sources(self) -> Sequence[Source]:
        """All sources, in the order of the manifest."""
        return self.listing.sources

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-len(self.sources) // self.config.output.pairs_per_shard)

    def task(self, shard: int) -> ShardTask:
        """The work of a shard."""
        first = shard * self.config.output.pairs_per_shard
        return ShardTask(shard, tuple(self.sources[first : first + self.config.output.pairs_per_shard]))

    def warnings(self) -> tuple[str, ...]:
        """Sentences that the user should read before the run begins."""
        sentences = *self.listing.warnings, body_sentence(self.config), *warnings(self.config)
        return tuple(dict.fromkeys(filter(None, sentences)))

    @cached_property
    def listing_text(self) -> bytes:
        """Lines of `LISTING`."""
        return recorded_text(self.sources)

    def file(self, parts: int | None) -> RunFile:
        """Facts on which all processes of the run must agree, as this process finds them."""
        config = self.config
        source = {"root": absolute_text(config.source.place), "list": absolute_text(config.source.list)}
        return RunFile(
            version=version("unprocess_gen"),
            config=dataset_yaml(config),
            columns=columns_of(config),
            sources=len(self.sources),
            shards=self.shards,
            parts=parts,
            listing_sha256=hashlib.sha256(self.listing_text).hexdigest(),
            max_failed=config.source.max_failed,
            not_matched=self.listing.not_matched,
            skipped_links=self.listing.skipped_links,
            source=check_record({"kind": source_kind(config), **source}, SourceFacts),
            dark_frames=_dark_facts(self.settings),
        )


def resolve(config: Config) -> Run:
    """List the sources of a validated config and complete it with the digests of dark frames.

    ConfigError if sources or dark frames cannot be used, SourceChangedError if recorded dark frames changed.
    """
    listing, settings = list_photographs(config.source, config.out), PairSettings.read(config)
    if settings.dark_folder is not None and settings.dark_folder.warning:
        listing = replace(listing, warnings=(*listing.warnings, settings.dark_folder.warning))
    return Run(settings, listing)


def resolve_part(folder: OutFolder, config: Config) -> Run:
    """Find the run of a part as `resolve`, but read its listing if another part has recorded one."""
    known = read_run(folder)
    recorded = None if known is None else _read_listing(folder, known)
    if known is None or recorded is None:
        return resolve(config)
    return Run(PairSettings.read(config), Listing(recorded, known.skipped_links, {"": known.not_matched}))


def _dark_facts(settings: PairSettings) -> DarkFrameFacts | None:
    """Place, number, sizes and noise of the dark frames."""
    root, dark_frames = settings.config.noise.dark_frames, settings.dark_frames
    if root is None or dark_frames is None:
        return None
    sizes = sorted({f"{frame.width}x{frame.height}" for frame in dark_frames.frames})
    std_dn = math.sqrt(dark_frames.variance_dn2)
    return DarkFrameFacts(absolute_text(root), len(dark_frames.frames), sizes, dark_frames.black_dn, std_dn)


# -------------------------------------------------------------------------------------------------------------- files


def read_run(folder: OutFolder, most_shards: int | None = None) -> RunFile | None:
    """Read what a run has recorded; None if none has begun. MachineError if it has more than ``most_shards``."""

    def parse(content: bytes) -> RunFile:
        run = parse_record(content, RunFile)
        if most_shards is not None and run.shards > most_shards:
            raise ValueError(f"shards={run.shards}: more than {LISTING} has sources")
        return run

    return folder.record(RUN, parse)


def begin(folder: OutFolder, run: Run, parts: int | None = None) -> None:
    """Record a run, or check that it is the one that is recorded.

    ConfigError if it was begun with other settings, sources or parts, a part also if by another version; if the folder
    cannot be written. MachineError if the disk is full.
    """
    own, known = run.file(parts), read_run(folder)
    try:
        if known is None:
            check_settings(folder, own.config, run.config.source.place)
            if not folder.create(LISTING, run.listing_text) and folder.read(LISTING, MOST_BYTES) != run.listing_text:
                raise ConfigError(
                    f"out={folder}: was begun with other sources ({LISTING} differs); choose another out, or remove it"
                )
            folder.create(RUN, json.dumps(msgspec.to_builtins(own), indent=1).encode() + b"\n")
            known = read_run(folder) or own  # another process may have been first
        check_settings(folder, own.config, run.config.source.place)
        _check_record(folder, run, known, own)
        folder.create("config.yaml", known.config.encode())
        if not (folder / LISTING).is_listed():
            folder.create(LISTING, run.listing_text)
        for name in ("shards", DEATHS):
            (folder / name).mkdir(exist_ok=True)
        folder.delete_unfinished()
        for name in sorted((folder / "shards").entries()):
            match = re.fullmatch(r"shard-(\d{5,})\.tar", name)
            if match is None or int(match[1]) >= known.shards:
                raise ConfigError(
                    f"out={folder}: unexpected file {folder}/shards/{name}; expected only committed shards; remove it "
                    "or choose another out"
                )
        _ = folder.scratch
    except OSError as error:
        raise folder.cannot_write(error) from error
    except ConfigError:
        if folder.finished() is not None:  # by another run since this one began
            folder.remove_work()
        raise


def check_version(folder: OutFolder, known: RunFile) -> None:
    """Raise ConfigError if another version of unprocess_gen began a run."""
    own = version("unprocess_gen")
    if known.version != own:
        raise ConfigError(
            f"out={folder}: was begun by unprocess_gen {known.version}, this is {own}; expected the same version; "
            "install it, or choose another out"
        )


def _check_record(folder: OutFolder, run: Run, known: RunFile, own: RunFile) -> None:
    """Raise ConfigError if a run was begun with other sources or parts, or a part by another version."""
    if own.parts:
        check_version(folder, known)
    if own.parts and known.parts not in (None, own.parts):
        raise ConfigError(
            f"part K/{own.parts}: {folder} was begun with {known.parts} parts; expected K/{known.parts}; choose "
            "another out"
        )
    if known.listing_sha256 != own.listing_sha256:
        _check_sources(folder, lambda: iter(_read_listing(folder, known) or ()), run.sources, listed=True)


def check_finished(folder: OutFolder, config: Config, sources: Sequence[Source], facts: dict[str, Any]) -> None:
    """Raise ConfigError if a dataset was made from other settings or sources, DamageError if a tar has another size."""
    repair = f"gen-dataset verify {folder} --repair restores it"
    if (folder / "config.yaml").size() is None:
        raise DamageError(f"{folder}/config.yaml: is missing from a finished dataset; {repair}")
    check_settings(folder, dataset_yaml(config))
    _check_sources(folder, lambda: sources_of_rows(folder / "manifest.csv"), sources, listed=False)
    sizes = (folder / "shards").entries()
    for entry in facts["shards"]:
        size = sizes.get(str(entry["file"]).partition("/")[2])
        if entry["file"] is not None and size != entry["bytes"]:
            problem = "is missing" if size is None else f"has {size} bytes"
            raise DamageError(f"{folder}/{entry['file']}: {problem}, expected {entry['bytes']} bytes; {repair}")


def check_settings(folder: OutFolder, config_yaml: str, place: str | None = None) -> None:
    """Raise ConfigError if ``out`` was begun with another ``config.yaml``; ``place`` is that of the sources."""
    known = read_run(folder)
    differing: list[str] = []
    try:
        if known is not None and known.config != config_yaml:
            differing = differences(config_yaml, known.config)
        if not differing and (folder / "config.yaml").size() is not None:
            differing = differences(config_yaml, folder.read("config.yaml").decode())
    except (ValueError, YAMLError) as error:
        raise DamageError(
            f"{folder}/config.yaml: cannot be read ({error_in_one_line(error)}); choose another out"
        ) from error
    if differing:
        remedy = "remove it"
        if folder.finished() is None:
            sources = f" source.root={shlex.quote(place)}" if isinstance(place, str) else ""
            out = shlex.quote(str(folder))
            remedy = f"finish it with its own settings: gen-dataset again {out} out={out}{sources}"
        raise ConfigError(
            f"out={folder}: was begun with other settings: {_first(differing)}; choose another out, or {remedy}"
        )


# ------------------------------------------------------------------------------------------------------------ sources


def _read_listing(folder: OutFolder, known: RunFile) -> RecordedSources | None:
    """Read the listing of a run, None if it was lost; MachineError if it was edited."""

    def parse(content: bytes) -> RecordedSources:
        if hashlib.sha256(content).hexdigest() != known.listing_sha256:
            raise ValueError(f"its SHA-256 differs from that in {RUN}")
        return RecordedSources(content)

    return folder.record(LISTING, parse, MOST_BYTES)


def sources_of_rows(manifest: AnyPath) -> Iterator[Source]:
    """Yield the source of every image, with name, size and digest only."""
    for index, rows in enumerate(group_by_image(read_rows(manifest))):
        size, name = rows[0]["source_bytes"], str(rows[0]["source"])
        yield Source(index, name, name, size if isinstance(size, int) else None, sha256=str(rows[0]["source_sha256"]))


def _check_sources(
    folder: OutFolder, known: Callable[[], Iterator[Source]], sources: Sequence[Source], listed: bool
) -> None:
    """Raise ConfigError if the sources are not the known ones, which were ``listed`` before or are rows of a manifest.

    Both are in the order of the listing, so equal ones are compared without holding the known ones: a million take
    0.4 GB.
    """
    change = partial(_change, listed=listed)
    pairs = itertools.zip_longest(known(), sources)
    if all(old and new and old.name == new.name and not change(old, new) for old, new in pairs):
        return
    files, present = ({source.name: source for source in side} for side in (known(), sources))
    changes = ((name, files.get(name), present.get(name)) for name in present | files)
    differing = [
        f"{name} {'is new' if old is None else 'was deleted' if new is None else change(old, new)}"
        for name, old, new in changes
        if old is None or new is None or change(old, new)
    ]
    if differing:
        raise ConfigError(
            f"out={folder}: was begun with other sources: {_first(differing)}; choose another out, or remove it"
        )


def _change(old: Source, new: Source, listed: bool) -> str:
    """Describe how a source differs from its row in a manifest, or from an earlier listing.

    A listing hashes the files that could be identical. If one of them has changed, another one can have another number
    among identical files, and so other noise. A row is compared only with a digest that the listing has.
    """
    if new.size_bytes != old.size_bytes:
        return f"has {new.size_bytes} bytes, had {old.size_bytes}"
    if listed:
        is_same = new.sha256 == old.sha256 and (not old.etag or new.etag in (None, old.etag))
    else:
        is_same = not old.sha256 or new.sha256 in (None, old.sha256)
    return "" if is_same else "has other bytes than it had"


def _first(differing: Sequence[str]) -> str:
    rest = len(differing) - DIFFERENCES_SHOWN
    return "; ".join(differing[:DIFFERENCES_SHOWN]) + (f"; and {rest} more" if rest > 0 else "")
