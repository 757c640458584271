"""Regenerate a dataset from its ``config.yaml`` in another folder, and compare the two."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError, DamageError, SourceChangedError, SourceError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.dataset.columns import Value
from unprocess_gen.dataset.dataset_json import check_format
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.row import without_empty
from unprocess_gen.pipeline.replay import ADVICE, check_root, places_of
from unprocess_gen.sources.names import decode_name
from unprocess_gen.sources.reading import source_file


def recorded_config(folder: AnyPath, root: str | None, changes: Mapping[str, Any]) -> Config:
    """Settings of a dataset with ``changes``, which contain another ``out`` and the dark frames.

    SourceChangedError if sources are missing or have other sizes than the manifest records.
    """
    check_format(folder)
    config, kind = read_dataset_yaml(folder / "config.yaml")
    manifest, out = folder / "manifest.csv", any_path(changes["out"])
    if out.resolve() == any_path(folder).resolve() and (out / "dataset.json").exists():
        raise ConfigError(f"again: out={out}: is the dataset itself; expected another folder")
    frames = changes["noise.dark_frames"]
    if frames is not None and config.noise.dark_frames_sha256 is None:
        raise ConfigError(
            f"again: noise.dark_frames={frames}: {folder} was generated without dark frames; leave it out"
        )
    if kind == "synthetic" and root is not None:
        raise ConfigError(
            f"again: source.root={root}: {folder} was generated from a source of kind {kind}; expected no root; "
            "leave source.root out"
        )
    places = places_of(folder, root, frames)
    check_root(folder, kind, places.root, "again: ")
    config = replaced(config, {**changes, **places.settings})
    validate_config(config)
    place = config.source.place
    if place is not None and any_path(place).exists() and manifest.exists():
        _check_sizes(manifest, place)
    return config


def compare(folder: AnyPath, new_folder: AnyPath) -> str:
    """Compare the manifests of a dataset and of its copy; DamageError if they differ."""
    old, new = folder / "manifest.csv", new_folder / "manifest.csv"
    if new_folder.resolve() == any_path(folder).resolve():
        return f"{folder} was finished with the settings it was begun with"
    if not old.exists():
        return f"{folder} has no manifest.csv to compare with"
    if not _have_same_rows(old, new):
        _check_digests(old, new)
        raise DamageError(f"{new}: differs from {old}; check that the sources are the same")
    if any_path(old).size() == any_path(new).size():
        return f"the same as {folder}, bit for bit"
    return f"the same rows as {folder}, in its cells; {new} has frames too"


def _check_sizes(manifest: AnyPath, root: str) -> None:
    """Compare the sizes of the source files with those that a manifest records; opens no source.

    SourceChangedError names the first file that is missing or has another size; DamageError if the manifest cannot be
    read.
    """
    last = ""
    place = any_path(root)
    # one listing instead of a request for each object
    sizes = {entry.path: entry.size for entry in place.walk_entries()} if isinstance(place, ObjectPath) else None
    for row in read_rows(manifest):
        name, recorded = str(row["source"]), row["source_bytes"]
        if name == last or not recorded:  # synthetic pictures and unreadable files have no size
            continue
        last = name
        path = decode_name(name)
        try:
            size = sizes[path] if sizes else source_file(root, path).entry().size
        except (OSError, ValueError, KeyError, SourceError):
            raise SourceChangedError(f"source {name}: is missing from {root}; {ADVICE}") from None
        if size != recorded:
            raise SourceChangedError(
                f"source {name}: has {size} bytes in {root}; expected {recorded}, as recorded; {ADVICE}"
            )


def _check_digests(old: AnyPath, new: AnyPath) -> None:
    """Raise SourceChangedError that names the first source with another SHA-256 in a new manifest."""
    recorded = {row["source"]: row["source_sha256"] for row in read_rows(old)}
    for row in read_rows(new):
        name, sha256 = row["source"], row["source_sha256"]
        if sha256 and recorded.get(name) and sha256 != recorded[name]:
            raise SourceChangedError(
                f"source {name}: has the SHA-256 {sha256}; expected {recorded[name]}, as recorded; {ADVICE}"
            )


def _have_same_rows(old: AnyPath, new: AnyPath) -> bool:
    """Check whether a new manifest has the rows of an older one, in every cell that is not empty there."""
    with suppress(OSError):  # reported below
        if file_sha256(old) == file_sha256(new):
            return True
    no_row = dict[str, Value]()
    rows = itertools.zip_longest(read_rows(old), read_rows(new), fillvalue=no_row)
    return all(row and without_empty(row).items() <= other.items() for row, other in rows)
