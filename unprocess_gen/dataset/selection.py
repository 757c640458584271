"""Select manifest rows by position or by key."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import Row
from unprocess_gen.dataset.keys import image_key, sample_key
from unprocess_gen.dataset.manifest import read_rows


def select_rows(manifest: Path, rows: str | None, keys: str | None) -> Iterator[Row]:
    """Yield the rows numbered ``A:B`` (from 0, B not included) or those with the ``keys`` K,…; all without either.

    Raises ConfigError for a range that is none, and for keys that the manifest does not have.
    """
    if keys is not None:
        yield from _with_keys(manifest, keys.split(","))
        return
    first, last = _range(rows)
    yield from itertools.islice(read_rows(manifest), first, last)


def _range(rows: str | None) -> tuple[int, int | None]:
    found = re.fullmatch(r"(\d*):(\d*)", rows if rows is not None else ":")
    if found is None:
        raise ConfigError(f"--rows {rows}: expected A:B, such as 0:10")
    return int(found[1] or 0), int(found[2]) if found[2] else None


def _with_keys(manifest: Path, keys: Sequence[str]) -> Iterator[Row]:
    wanted = set(keys)
    missing = set(keys)
    for row in read_rows(manifest):
        # the key of an image, or of a patch, stands for all of its pairs
        named = {str(row["key"]), sample_key(row), image_key(row)} & wanted
        if named:
            missing -= named
            yield row
    if missing:
        raise ConfigError(f"--keys {min(missing)}: {manifest} has no such key")
