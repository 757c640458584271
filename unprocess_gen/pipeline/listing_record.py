"""Record the sources of a run below ``.work``, in files of up to 4096 sources.

    .work/sources/00000.json    sources 0 to 4095, one list of values for each
    .work/listing.json          number of sources, and digests of these files; written last

A process that generates some of the shards reads only the files of their sources. A resumed run compares its own
listing with the record. Version 0.1 recorded name, size and digest of all sources in ``.work/sources.json``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.types import Source
from unprocess_gen.pipeline.storage import Storage

PER_FILE = 4096
"""Sources in a file of the record."""

FOLDER = ".work/sources"
INDEX = ".work/listing.json"
OLD_RECORD = ".work/sources.json"

_FIELDS = tuple(field.name for field in fields(Source))


class RecordedFile(NamedTuple):
    """Hold what identifies the content of a source, as in `Source`; the digest is empty for a failed source."""

    size_bytes: int | None
    sha256: str | None
    etag: str | None = None


@dataclass(frozen=True, slots=True)
class ListingRecord:
    """Hold the number of recorded sources, and the SHA-256 of each file of the record."""

    sources: int
    sha256: tuple[str, ...]


def write_listing(storage: Storage, place: str, sources: Sequence[Source]) -> ListingRecord:
    """Record the sources of a run; return what identifies the record.

    Raises ConfigError if another process has begun to record other sources: files of the record are never replaced.
    """
    texts = (_text(sources[first : first + PER_FILE]) for first in range(0, len(sources), PER_FILE))
    digests: list[str] = []
    for number, text in enumerate(texts):
        digests.append(_sha256(text))
        _create(storage, place, f"{FOLDER}/{number:05d}.json", text)
    _create(storage, place, INDEX, json.dumps({"sources": len(sources), "sha256": digests}))
    return ListingRecord(len(sources), tuple(digests))


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _create(storage: Storage, place: str, name: str, text: str) -> None:
    if not storage.create(name, text) and storage.read(name) != text:
        raise ConfigError(
            f"out={place}: was begun with other sources ({name} differs); choose another out, or remove it"
        )


def _text(sources: Iterable[Source]) -> str:
    return json.dumps([[getattr(source, name) for name in _FIELDS] for source in sources], separators=(",", ":"))


def read_record(storage: Storage, place: str) -> ListingRecord | None:
    """Return what identifies the recorded sources, None if there is no record; raise DamageError if it is damaged."""
    try:
        found = json.loads(storage.read(INDEX))
        return ListingRecord(int(found["sources"]), tuple(map(str, found["sha256"])))
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise _damage(place, INDEX, error) from error


class RecordedListing:
    """Read the recorded sources of a run; the file that was read last is kept.

    Parameters
    ----------
    storage : Storage
        Where the dataset is written.
    place : str
        Its place, for messages.
    record : ListingRecord
        What identifies the record.
    """

    def __init__(self, storage: Storage, place: str, record: ListingRecord) -> None:
        self._storage, self._place, self._record = storage, place, record
        self._last: tuple[int, list[Source]] = (-1, [])

    def sources(self, first: int, last: int) -> list[Source]:
        """Return the sources from index ``first`` to before ``last``; raise DamageError if they are damaged."""
        files = range(first // PER_FILE, -(-last // PER_FILE))
        return [source for number in files for source in self._file(number) if first <= source.index < last]

    def _file(self, number: int) -> list[Source]:
        if self._last[0] != number:
            name = f"{FOLDER}/{number:05d}.json"
            try:
                text = self._storage.read(name)
                if _sha256(text) != self._record.sha256[number]:
                    raise ValueError(f"its SHA-256 differs from that in {INDEX}")
                self._last = number, [Source(*values) for values in json.loads(text)]
            except (OSError, ValueError, TypeError, IndexError) as error:
                raise _damage(self._place, name, error) from error
        return self._last[1]


def recorded_files(storage: Storage, place: str) -> Iterator[tuple[str, RecordedFile]]:
    """Yield name, and size, digest and ETag of every recorded source; nothing if there is no record.

    Raises DamageError if the record is damaged.
    """
    record = read_record(storage, place)
    if record is not None:
        listing = RecordedListing(storage, place, record)
        for first in range(0, record.sources, PER_FILE):
            for source in listing.sources(first, min(first + PER_FILE, record.sources)):
                yield source.name, RecordedFile(source.size_bytes, source.sha256, source.etag)
        return
    try:
        for name, size, sha256 in json.loads(storage.read(OLD_RECORD)):
            yield name, RecordedFile(size, sha256)
    except FileNotFoundError:
        return
    except (ValueError, TypeError) as error:
        raise _damage(place, OLD_RECORD, error) from error


def _damage(place: str, name: str, error: Exception) -> DamageError:
    return DamageError(
        f"{place}/{name}: cannot be read ({error_in_one_line(error)}); remove the folder and start again"
    )
