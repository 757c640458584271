"""Record the sources of a run below ``.work``, in files of up to 4096 sources.

    .work/sources/00000.json    sources 0 to 4095, one list of values for each
    .work/listing.json          number of sources, and digests of these files; written last

A process that generates some of the shards reads only the files of their sources. A resumed run compares its own
listing with the record. Version 0.1 recorded name, size and digest of all sources in ``.work/sources.json``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import fields
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


def write_listing(storage: Storage, place: str, sources: Sequence[Source]) -> None:
    """Record the sources of a run.

    Raises ConfigError if another process has begun to record other sources: files of the record are never replaced.
    """
    digests: list[str] = []
    for first in range(0, len(sources), PER_FILE):
        rows = [[getattr(source, name) for name in _FIELDS] for source in sources[first : first + PER_FILE]]
        text = json.dumps(rows, separators=(",", ":"))
        _create(storage, place, f"{FOLDER}/{len(digests):05d}.json", text)
        digests.append(_sha256(text))
    _create(storage, place, INDEX, json.dumps({"sources": len(sources), "sha256": digests}))


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _create(storage: Storage, place: str, name: str, text: str) -> None:
    if not storage.create(name, text) and storage.read(name) != text:
        raise ConfigError(
            f"out={place}: was begun with other sources ({name} differs); choose another out, or remove it"
        )


class RecordedListing:
    """Read the recorded sources of a run; the file that was read last is kept.

    Raises FileNotFoundError if there is no record, DamageError if it cannot be read.
    """

    def __init__(self, storage: Storage, place: str) -> None:
        self._storage, self._place = storage, place
        self._last: tuple[int, list[Source]] = (-1, [])
        try:
            index = json.loads(storage.read(INDEX))
            self.count, self._sha256 = int(index["sources"]), list(map(str, index["sha256"]))
        except (ValueError, KeyError, TypeError) as error:
            raise _damage(place, INDEX, error) from error

    def sources(self, first: int, last: int) -> list[Source]:
        """Return the sources from index ``first`` to before ``last``; raise DamageError if they are damaged."""
        files = range(first // PER_FILE, -(-last // PER_FILE))
        return [source for number in files for source in self._file(number) if first <= source.index < last]

    def _file(self, number: int) -> list[Source]:
        if self._last[0] != number:
            name = f"{FOLDER}/{number:05d}.json"
            try:
                text = self._storage.read(name)
                if _sha256(text) != self._sha256[number]:
                    raise ValueError(f"its SHA-256 differs from that in {INDEX}")
                self._last = number, [Source(*values) for values in json.loads(text)]
            except (OSError, ValueError, TypeError, IndexError) as error:
                raise _damage(self._place, name, error) from error
        return self._last[1]


def recorded_files(storage: Storage, place: str) -> Iterator[tuple[str, RecordedFile]]:
    """Yield name, and size, digest and ETag of every recorded source; nothing if there is no record.

    Raises DamageError if the record is damaged.
    """
    with suppress(FileNotFoundError):
        listing = RecordedListing(storage, place)
        for first in range(0, listing.count, PER_FILE):
            for source in listing.sources(first, min(first + PER_FILE, listing.count)):
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
