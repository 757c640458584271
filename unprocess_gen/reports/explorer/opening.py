"""Open a photograph, a folder of them, the built-in scenes or rows of a dataset as explorations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from unprocess_gen.config.composition import composed_config
from unprocess_gen.config.option_files import OptionFolders
from unprocess_gen.config.overrides import override_text, overrides_of
from unprocess_gen.config.raw_validation import require_photographs
from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.output_paths import is_dataset
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.core.source import NO_CLIP, Source
from unprocess_gen.dataset.keys import image_key
from unprocess_gen.dataset.row import Row
from unprocess_gen.dataset.selection import select_rows
from unprocess_gen.pipeline.replay import dark_frames_root, source_changes, source_root
from unprocess_gen.reports.explorer.exploration import Exploration, listed_sources

SOURCES_LISTED = 1000
"""Photographs or rows that a page offers; the others are opened by their name or key."""

Choices = dict[str, Callable[[], Exploration]]
"""What a page offers to open, by its label."""


def open_place(
    place: AnyPath | None, keys: str | None, overrides: Sequence[str], flags: Sequence[str], folders: OptionFolders
) -> Choices:
    """List the explorations of a photograph, a folder, a dataset, or without a place of ``source.root``.

    ConfigError if the place or a setting is wrong; DamageError if a manifest cannot be read.
    """
    start = Exploration(folders, flags=tuple(flags))
    start.add(overrides)
    if place is not None and is_dataset(place):
        return _open_rows(place, keys, start)
    if keys is not None:
        raise ConfigError(f"--keys {keys}: {place or 'the source'} is no dataset; expected one; leave --keys out")
    if place is not None:
        if root := start.settings.get("source.root"):
            raise ConfigError(f"explore: {place}: the source is also given by source.root={root}; expected one of them")
        start.settings["source.root"] = _path_text(str(place))
    config = _source_config(start)
    sources = listed_sources(config)[:SOURCES_LISTED]
    return {f"{source.index} {source.name}": partial(_open_source, start, config, source) for source in sources}


def _path_text(path: str) -> str:
    """Return a path in which nothing is an interpolation."""
    return path.replace("${", "\\${")


def _source_config(state: Exploration) -> SourceConfig:
    config, _ = composed_config(state.overrides, state.folders)
    require_photographs(config.source, "explore")
    return config.source


def _open_source(state: Exploration, config: SourceConfig, source: Source) -> Exploration:
    """Choose a source: a photograph of a folder by itself, others with the sources that are listed before them."""
    root = config.root
    is_alone = config.list is None and source.clip == NO_CLIP and not source.occurrence
    if root is not None and is_alone and any_path(root).is_dir():
        path = _path_text(f"{root.rstrip('/')}/{source.path}")
        kept = {key: text for key, text in state.settings.items() if key not in ("source.limit", "source.include")}
        return replace(state, settings=kept | {"source.root": path})
    is_last = source.index + 1 == len(listed_sources(config))
    limit = {} if is_last else {"source.limit": str(source.index + 1)}
    return replace(state, settings=state.settings | limit, index=source.index)


def _open_rows(folder: AnyPath, keys: str | None, start: Exploration) -> Choices:
    rows = [row for row in select_rows(folder / "manifest.csv", keys) if keys or row["status"] == "ok"]
    for row in rows:
        if row["status"] != "ok":
            raise ConfigError(f"--keys {keys}: {row['key']} has no pair ({row['reason']}); expected a row with a pair")
    if not rows:
        raise ConfigError(f"{folder}: every source failed; expected a dataset with at least one pair")
    return {f"{row['key']} {row['source']}": partial(_open_row, folder, row, start) for row in rows[:SOURCES_LISTED]}


def _open_row(folder: AnyPath, row: Row, start: Exploration) -> Exploration:
    """Return the settings of a dataset as overrides that give the pair of the row."""
    manifest, given = folder / "manifest.csv", dict(start.settings)
    recorded, kind = read_dataset_yaml(folder / "config.yaml")
    settings = overrides_of(recorded)
    settings.pop("source.limit", None)
    root = source_root(manifest, given.pop("source.root", None))
    if kind == "folder" and root is None:
        raise ConfigError(f"explore: {folder} does not record the folder of its sources; give source.root=ROOT")
    places = source_changes(root, folder) | {"noise.dark_frames": dark_frames_root(manifest)}
    for key, place in places.items():
        if place:
            settings[key] = _path_text(place) if isinstance(place, str) else override_text(place)
    state = replace(start, settings=settings | given, part=str(row["key"]).removeprefix(image_key(row)))
    config = _source_config(state)
    source = next((source for source in listed_sources(config) if source.name == row["source"]), None)
    if source is None:
        raise ConfigError(f"explore: {row['source']}: is not among the sources of {folder}; restore the photograph")
    return _open_source(state, config, source)
