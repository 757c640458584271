"""Check the values of ``dataset.json``, so that an edited file is reported as damage by every verb."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from unprocess_gen.dataset.columns import NOT_NEGATIVE
from unprocess_gen.dataset.shards import shard_name

MAX_BYTES = 2**30
"""Largest ``dataset.json`` that is read: three million shards."""

PARQUET_SHA256 = "parquet_sha256"
"""Key of the digest of ``manifest.parquet``; missing if the dataset has no such file."""

MAX_COUNT = 2**63 - 1

_DIGEST = re.compile("[0-9a-f]{64}")


def check_dataset_json(facts: Any) -> None:
    """Check the types and ranges of the values of a ``dataset.json``.

    Parameters
    ----------
    facts : object
        The loaded file, of this or an older version; values that only describe the run are not checked.

    Raises
    ------
    ValueError
        If a value is missing, of another type or not allowed. The sentence names the key and the value.
    """
    if not isinstance(facts, dict):
        raise ValueError("expected an object")
    for key in ("fingerprint", "manifest_sha256", "config_sha256"):
        _check(facts, key, _is_digest, "64 hexadecimal digits")
    if PARQUET_SHA256 in facts:
        _check(facts, PARQUET_SHA256, _is_digest, "64 hexadecimal digits")
    _check(facts, "pairs", _is_count, "a number of 0 or more")
    for key in ("failed", "sites"):
        _check(facts, key, _is_counts, "an object of numbers")
    _check(facts, "source", _is_source, "an object with kind and root")
    _check(facts, "shards", lambda value: isinstance(value, list), "a list")
    for number, entry in enumerate(facts["shards"]):
        try:
            _check_entry(number, entry)
        except ValueError as error:
            raise ValueError(f"shards[{number}]: {error}") from None


def _check_entry(number: int, entry: Any) -> None:
    if not isinstance(entry, dict):
        raise ValueError("expected an object")
    name = f"shards/{shard_name(number)}"
    _check(entry, "file", lambda value: value in (None, name), f"null or {name}")
    for key in ("pairs", "failed", "bytes"):
        _check(entry, key, _is_count, "a number of 0 or more")
    _check(entry, "sha256", lambda value: _is_digest(value) or entry["file"] is None, "64 hexadecimal digits")
    if "source_noise_dn" in entry:
        _check(entry, "source_noise_dn", _is_noise, "a list of null and numbers of 0 or more")


def _check(facts: dict[str, Any], key: str, allows: Callable[[Any], bool], expected: str) -> None:
    if key not in facts:
        raise ValueError(f"{key} is missing")
    if not allows(facts[key]):
        raise ValueError(f"{key}={str(facts[key])[:40]!r}: expected {expected}")


def _is_digest(value: Any) -> bool:
    return isinstance(value, str) and _DIGEST.fullmatch(value) is not None


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_COUNT


def _is_counts(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_count, value.values()))


def _is_noise(value: Any) -> bool:
    return isinstance(value, list) and all(one is None or one in NOT_NEGATIVE for one in value)


def _is_source(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("kind"), str) and isinstance(value.get("root"), str | None)
