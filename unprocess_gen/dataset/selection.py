"""Select manifest rows by source index or key: the option ``--keys`` of every verb."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.keys import burst_key, image_key, key_text, sample_key
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.row import KEY_TEXT

KEYS_FORM = (
    "expected source indices and ranges such as 3,7-9, or keys: 00000003 names all pairs of an image, "
    "00000003-p0007 those of a patch, 00000003-f02 a frame of a burst, 00000003-l01d02 a level and a draw"
)
"""What ``--keys`` takes, as messages and help texts describe it."""

_RANGE = re.compile(r"(\d{1,12})-(\d{1,12})")
_INDEX = re.compile(r"\d{1,12}")


class SelectedPairs(NamedTuple):
    """Rows of selected pairs by their number in `RawPairs`, and number of failed rows in a range, which are skipped."""

    rows: dict[int, Row]
    failed: int


def parse_keys(text: str) -> tuple[dict[str, str], dict[str, range]]:
    """Read ``--keys``, such as ``3,7-9,00000003-p0007``: keys with what the user wrote for each, and ranges by text."""
    names: dict[str, str] = {}
    ranges: dict[str, range] = {}
    for item in map(str.strip, text.split(",")):
        if _INDEX.fullmatch(item):
            names[key_text(int(item))] = item
        elif span := _RANGE.fullmatch(item):
            first, last = int(span[1]), int(span[2])
            if last < first:
                raise ConfigError(f"--keys {item}: ends before it begins; expected {last}-{first}")
            ranges[item] = range(first, last + 1)
        elif KEY_TEXT.allows(item):
            names[item] = item
        else:
            raise ConfigError(f"--keys {text[:60]}: {item[:40]!r} is no key; {KEYS_FORM}")
    return names, ranges


def select_rows(manifest: AnyPath, keys: str | None = None, skipped: list[Row] | None = None) -> Iterator[Row]:
    """Select rows of a manifest, all of them without ``keys``, in its order.

    Failed rows in a range are skipped and appended to ``skipped``; a failed row is selected by its own index or key.
    ConfigError if the manifest has no row for an index, a key or a complete range.
    """
    if keys is None:
        yield from read_rows(manifest)
        return
    names, ranges = parse_keys(keys)
    matches: set[str] = set()
    ends = "", ""
    for row in read_rows(manifest):
        key, index = str(row["key"]), int(image_key(row))
        ends = ends[0] or key, key
        named = names.keys() & {key, sample_key(row), burst_key(key), image_key(row)}
        around = {text for text, indices in ranges.items() if index in indices}
        matches |= named | around
        if named or (around and row["status"] == "ok"):
            yield row
        elif around and skipped is not None and row["status"] == "failed":
            skipped.append(row)
    for name, written in {**names, **dict.fromkeys(ranges)}.items():
        if name not in matches:
            known = f"it has keys from {ends[0]} to {ends[1]}" if ends[0] else "it has none"
            raise ConfigError(f"--keys {written or name}: {manifest} has no such key; {known}; {KEYS_FORM}")


def select_pairs(manifest: AnyPath, keys: str) -> SelectedPairs:
    """Select pairs of a dataset; ConfigError as `select_rows`, and if a failed row is named by its own index or key."""
    skipped: list[Row] = []
    rows = {str(row["key"]): row for row in select_rows(manifest, keys, skipped)}
    for row in rows.values():
        if row["status"] != "ok":
            raise ConfigError(f"--keys {row['key']}: {row['status']} ({row['reason']}), so it has no frames")
    pairs = (str(row["key"]) for row in read_rows(manifest) if row["status"] == "ok")
    return SelectedPairs({number: rows[key] for number, key in enumerate(pairs) if key in rows}, len(skipped))
