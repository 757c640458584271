"""Open a photograph, a folder of them, the built-in scenes or rows of a dataset as explorations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from unprocess_gen.config.composition import OptionFolders
from unprocess_gen.config.raw_validation import require_photographs
from unprocess_gen.config.recomposition import Recomposition, override_text, overrides_of
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.output_paths import is_dataset
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.random_streams import stream_key
from unprocess_gen.core.roots import root_path
from unprocess_gen.core.types import NO_CLIP, Row, Source
from unprocess_gen.dataset.keys import image_key
from unprocess_gen.dataset.selection import select_rows
from unprocess_gen.pipeline.replay import dark_frames_root, source_changes, source_of, source_root
from unprocess_gen.reports.explorer.exploration import Exploration
from unprocess_gen.sources.loader import list_photographs

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
    start = Exploration(Recomposition(folders), flags=tuple(flags))
    start.add(overrides)
    if place is not None and is_dataset(place):
        return _open_rows(place, keys, start)
    if keys is not None:
        raise ConfigError(f"--keys {keys}: {place or 'the source'} is no dataset; expected one; leave --keys out")
    if place is not None:
        if root := start.settings.get("source.root"):
            raise ConfigError(f"explore: {place}: the source is also given by source.root={root}; expected one of them")
        start.settings["source.root"] = _path_text(str(place))
    return _open_sources(start)


def _path_text(path: str) -> str:
    """Return a path in which nothing is an interpolation."""
    return path.replace("${", "\\${")


def _open_sources(start: Exploration) -> Choices:
    config = start.composition.config(start.overrides).source
    require_photographs(config, "explore")
    root = config.root
    is_folder = root is not None and config.list is None and not config.clips and root_path(root).is_dir()

    def opened(source: Source) -> Exploration:
        """One photograph of a folder is a source of its own, and so are the scenes up to one of them."""
        if is_folder:
            path = _path_text(f"{str(root).rstrip('/')}/{source.path}")
            kept = {key: text for key, text in start.settings.items() if key not in ("source.limit", "source.include")}
            return replace(start, settings=kept | {"source.root": path})
        limit = {"source.limit": str(source.index + 1)} if config.place is None else {}
        return replace(start, settings=start.settings | limit, index=source.index)

    sources = list_photographs(config).sources[:SOURCES_LISTED]
    return {f"{source.index} {source.name}": partial(opened, source) for source in sources}


def _open_rows(folder: AnyPath, keys: str | None, start: Exploration) -> Choices:
    rows = [row for row in select_rows(folder / "manifest.csv", None, keys) if keys or row["status"] == "ok"]
    for row in rows:
        if row["status"] != "ok":
            raise ConfigError(f"--keys {keys}: {row['key']} has no pair ({row['reason']}); expected a row with a pair")
    if not rows:
        raise ConfigError(f"{folder}: every source failed; expected a dataset with at least one pair")
    return {f"{row['key']} {row['source']}": partial(_open_row, folder, row, start) for row in rows[:SOURCES_LISTED]}


def _open_row(folder: AnyPath, row: Row, start: Exploration) -> Exploration:
    """Return the settings of a dataset as overrides that give the pair of the row."""
    manifest, source, given = folder / "manifest.csv", source_of(row), dict(start.settings)
    config, kind = read_dataset_yaml(folder / "config.yaml")
    require_photographs(config.source, "explore")
    settings = overrides_of(config)
    settings.pop("source.limit", None)
    index = int(image_key(row))
    root = source_root(manifest, given.pop("source.root", None)) if kind == "folder" else None
    if kind == "folder" and root is None:
        raise ConfigError(f"explore: {folder} does not record the folder of its sources; give --source ROOT")
    if root is None:
        settings["source.limit"] = str(index + 1)
    elif (
        isinstance(root, str)
        and source.clip == NO_CLIP
        and f"{stream_key(config.seed, str(row['source_sha256']), 0):016x}" == row["stream_key"]
        and root_path(root).is_dir()
    ):
        settings["source.root"], index = _path_text(f"{root.rstrip('/')}/{source.path}"), 0
        settings.pop("source.include", None)
    else:  # twins and frames of clips need their neighbours
        changes = source_changes(root, folder)
        settings |= {
            key: _path_text(value) if isinstance(value, str) else override_text(value)
            for key, value in changes.items()
            if value
        }
    if (dark_frames := dark_frames_root(manifest)) is not None:
        settings["noise.dark_frames"] = override_text(dark_frames)
    return replace(
        start,
        settings=settings | given,
        index=index,
        part=str(row["key"]).removeprefix(image_key(row)),
        digests=None if given or start.others else (str(row["clean_xxh3"]), str(row["noisy_xxh3"])),
    )
