"""Regenerate a dataset from its ``config.yaml`` in another folder, and compare the two."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.dataset.dataset_json import check_format
from unprocess_gen.pipeline.replay import check_source_digests, check_source_sizes, source_changes, source_root
from unprocess_gen.pipeline.verify import have_same_rows


def recorded_config(folder: AnyPath, root: str | None, changes: Mapping[str, Any]) -> Config:
    """Settings of a dataset with ``changes``, which contain another ``out`` and the dark frames."""
    check_format(folder)
    config, kind = read_dataset_yaml(folder / "config.yaml")
    out = any_path(changes["out"])
    if out.resolve() == any_path(folder).resolve() and (out / "dataset.json").exists():
        raise ConfigError(f"again: out={out}: is the dataset itself; expected another folder")
    frames = changes["noise.dark_frames"]
    if frames is not None and config.noise.dark_frames_sha256 is None:
        raise ConfigError(
            f"again: noise.dark_frames={frames}: {folder} was generated without dark frames; leave it out"
        )
    config = replaced(config, {**changes, **source_changes(_root(folder, kind, root), folder)})
    validate_config(config)
    return config


def _root(folder: AnyPath, kind: str, root: str | None) -> str | None:
    """Root of the sources, given or recorded; None for the synthetic pictures."""
    if kind == "synthetic":
        if root is not None:
            raise ConfigError(
                f"again: source.root={root}: {folder} was generated from a source of kind {kind}; expected no root; "
                "leave source.root out"
            )
        return None
    known_root = source_root(folder / "manifest.csv", root)
    if known_root is None:
        raise ConfigError(
            f"again: source.root is missing: {folder} does not record the folder of its sources; expected "
            "that folder; give source.root=…"
        )
    return known_root


def check_sources(folder: AnyPath, config: Config) -> None:
    """Raise SourceChangedError if sources are missing or have other sizes than the manifest records."""
    manifest, root = folder / "manifest.csv", config.source.place
    if root is not None and any_path(root).exists() and manifest.exists():
        check_source_sizes(manifest, root)


def compare(folder: AnyPath, new_folder: AnyPath) -> str:
    """Compare the manifests of a dataset and of its copy; DamageError if they differ."""
    old, new = folder / "manifest.csv", new_folder / "manifest.csv"
    if new_folder.resolve() == any_path(folder).resolve():
        return f"{folder} was finished with the settings it was begun with"
    if not old.exists():
        return f"{folder} has no manifest.csv to compare with"
    if not have_same_rows(old, new):
        check_source_digests(old, new)
        raise DamageError(f"{new}: differs from {old}; check that the sources are the same")
    if old.stat().st_size == new.stat().st_size:
        return f"the same as {folder}, bit for bit"
    return f"the same rows as {folder}, in its cells; {new} has frames too"
