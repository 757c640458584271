"""Regenerate a dataset from its ``config.yaml`` in another folder, and compare the two."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import RESTORE, ConfigError, DamageError, SourceChangedError, SourceError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.dataset.columns import Value
from unprocess_gen.dataset.dataset_json import check_format, recorded_places
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.row import without_empty
from unprocess_gen.pipeline.replay import check_root
from unprocess_gen.pipeline.run import sources_of_rows
from unprocess_gen.sources.names import decode_name
from unprocess_gen.sources.reading import source_file


def recorded_config(folder: AnyPath, root: str | None, changes: Mapping[str, Any]) -> Config:
    """Settings of a dataset with ``changes``, which contain another ``out``, and dark frames or None.

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
    if "synthetic" in kind and root is not None:
        raise ConfigError(
            f"again: source.root={root}: {folder} was generated from a source of kind {kind}; expected no root; "
            "leave source.root out"
        )
    places = recorded_places(folder, root, frames)
    check_root(folder, kind, places.root, "again: ")
    config = replaced(config, {**changes, **places.settings})
    validate_config(config)
    place = config.source.place
    if place is not None and any_path(place).exists() and manifest.exists():
        _check_sizes(manifest, place)
    return config


def compare(folder: AnyPath, new_folder: AnyPath) -> str:
    """Compare the manifests of a dataset and of its copy; SourceChangedError or DamageError if they differ."""
    old, new = folder / "manifest.csv", new_folder / "manifest.csv"
    if new_folder.resolve() == any_path(folder).resolve():
        return f"{folder} was finished with the settings it was begun with"
    if not old.exists():
        return f"{folder} has no manifest.csv to compare with"
    with suppress(OSError):  # reported below
        if file_sha256(old) == file_sha256(new):
            return f"the same as {folder}, bit for bit"
    no_row = dict[str, Value]()
    for row, other in itertools.zip_longest(read_rows(old), read_rows(new), fillvalue=no_row):
        if row and without_empty(row).items() <= other.items():
            continue
        recorded, sha256 = row.get("source_sha256"), other.get("source_sha256")
        if recorded and sha256 and recorded != sha256 and row["source"] == other["source"]:
            raise SourceChangedError(
                f"source {row['source']}: has the SHA-256 {sha256}; expected {recorded}, as recorded; {RESTORE}"
            )
        raise DamageError(f"{new}: differs from {old}; check that the sources are the same")
    return f"the same rows as {folder}, in its cells; {new} has frames too"


def _check_sizes(manifest: AnyPath, root: str) -> None:
    """Compare the sizes of the source files with those that a manifest records; opens no source.

    SourceChangedError names the first file that is missing or has another size; DamageError if the manifest cannot be
    read.
    """
    place = any_path(root)
    # one listing instead of a request for each object
    sizes = {entry.path: entry.size for entry in place.walk_entries()} if isinstance(place, ObjectPath) else None
    for source in sources_of_rows(manifest):
        if not source.size_bytes:  # synthetic pictures and unreadable files have no size
            continue
        path, size = decode_name(source.name), None
        with suppress(OSError, ValueError, SourceError):
            size = sizes.get(path) if sizes else source_file(root, path).size()
        if size is None:
            raise SourceChangedError(f"source {source.name}: is missing from {root}; {RESTORE}")
        if size != source.size_bytes:
            raise SourceChangedError(
                f"source {source.name}: has {size} bytes in {root}; expected {source.size_bytes}, as recorded; "
                f"{RESTORE}"
            )
