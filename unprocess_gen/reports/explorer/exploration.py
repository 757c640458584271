"""Open photographs, synthetic pictures and rows of a dataset as settings of a page, and make their pair."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import PurePosixPath
from typing import Any, NamedTuple

from numpy.typing import NDArray

from unprocess_gen.config.composition import composed_config
from unprocess_gen.config.option_files import OptionFolders
from unprocess_gen.config.schema import Config, SourceConfig
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.source_validation import require_kind
from unprocess_gen.core.arrays import PACKED, Srgb
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.output_paths import is_dataset
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.core.raw_files import RAW_FILES
from unprocess_gen.core.source import NO_CLIP, Source
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.dataset_json import recorded_places
from unprocess_gen.dataset.keys import image_key, pair_key, patch_key
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.reader import mosaic_dn
from unprocess_gen.dataset.row import pair_row
from unprocess_gen.dataset.selection import select_pairs
from unprocess_gen.pipeline.pairs import PairSettings, plan_pixels
from unprocess_gen.reports.estimate import predicted_levels
from unprocess_gen.reports.explorer.overrides import key_of, override_word, overrides_of
from unprocess_gen.reports.panels import MosaicArray
from unprocess_gen.reports.plan_text import noise_lines
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.frames import Pair
from unprocess_gen.simulation.pair import make_pairs
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import unpack
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.listing import list_photographs
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import crop_patch

PAIR_FOLDER = "pair"
"""Folder of the dataset that the command of a page makes."""
PLACE_KEYS = ("source.root", "source.list", "source.limit", "source.include")
"""Keys that say which photograph is open; a page has a control of its own for them."""
SOURCES_LISTED = 1000
"""Photographs or rows that a page offers; the others are opened by their name or key."""


class Shown(NamedTuple):
    """The pair of the settings, and what they follow from.

    ``choices`` are the options by group, ``srgb`` the pixels of the patch, ``clean`` and ``noisy`` mosaics in DN.
    ``keys`` identify all pairs of the image, ``lines`` are those of ``plan`` about the noise.
    """

    config: Config
    choices: dict[str, str | None]
    srgb: Srgb
    plan: Plan
    pair: Pair
    clean: MosaicArray
    noisy: MosaicArray
    saturated: NDArray[Any]
    row: Row
    keys: tuple[str, ...]
    lines: list[str]
    dark_pixels: DarkPixels | None


@dataclass(frozen=True)
class Exploration:
    """The settings of a page, by key as texts, and which pair of them is shown.

    ``typed`` are the overrides in the field of other settings, which win over ``settings``; ``flags`` are flags of
    Hydra. ``index`` is the number of the source in the listing, ``part`` the rest of the key of the pair.
    """

    folders: OptionFolders
    settings: dict[str, str] = field(default_factory=dict)
    typed: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    index: int = 0
    part: str = ""

    @property
    def overrides(self) -> list[str]:
        """The settings as a command line has them."""
        typed = set(map(key_of, self.typed))
        return [*self.typed, *(f"{key}={text}" for key, text in self.settings.items() if key not in typed)]

    @property
    def command(self) -> str:
        """The command that generates the pair, with the other pairs of its sources."""
        overrides = self.overrides
        out = [] if "out" in map(key_of, overrides) else [f"out={PAIR_FOLDER}"]
        return shlex.join(["gen-dataset", *self.flags, *overrides, *out])

    @property
    def source_config(self) -> SourceConfig:
        """The settings of the sources; ConfigError for raw ones."""
        return self._composed()[0].source

    def _composed(self) -> tuple[Config, dict[str, str | None]]:
        config, choices = composed_config(self.overrides, self.folders)
        require_kind(config.source, "explore", "srgb")
        return config, choices

    def with_settings(self, settings: dict[str, str]) -> Exploration:
        """Set keys, and remove them from the typed ones."""
        kept = self.without(settings.__contains__)
        return replace(kept, settings=kept.settings | settings)

    def with_option(self, group: str, option: str | None) -> Exploration:
        """Choose an option of a group, None for none, and forget settings that it replaces."""
        replaced = (group, "camera", "sensor", "noise") if group == "body" else (group,)
        kept = self.without(lambda key: key.partition(".")[0] in replaced)
        return kept.with_settings({group: "null" if option is None else option})

    def with_field(self, controls: Container[str]) -> Exploration:
        """Move settings without a control to the typed ones, except the place of the sources."""
        moved = [key for key in self.settings if key not in controls and key not in PLACE_KEYS]
        words = [override_word(key, self.settings[key]) for key in moved]
        return replace(self.without(moved.__contains__), typed=(*self.typed, *words))

    def without(self, is_replaced: Callable[[str], bool]) -> Exploration:
        """Forget the settings of some keys, typed ones too."""
        settings = {key: text for key, text in self.settings.items() if not is_replaced(key)}
        return replace(self, settings=settings, typed=tuple(w for w in self.typed if not is_replaced(key_of(w))))

    def shown(self) -> Shown:
        """Make the pair; ConfigError, SourceError or MachineError with the sentence of the command line."""
        config, choices = self._composed()
        sources, settings = listed_sources(config.source), PairSettings.read(config)
        if self.index >= len(sources):
            raise ConfigError(
                f"source number {self.index} is open, but the settings list only {len(sources)}; open another"
            )
        source = sources[self.index]
        sha256, photograph = _loaded_source(config.source, source, config.output.layout)
        image = plan_pixels(settings, photograph, source, sha256)
        is_cut, several = config.source.patch is not None, len(image.plans) > 1
        parts = {
            pair_key(patch_key(source.index, patch.patch, is_cut), plan.place, several): (patch, plan)
            for patch in image.patches
            for plan in image.plans
        }
        key = f"{source.index:08d}{self.part}"
        key = key if key in parts else next(iter(parts))
        patch, plan = parts[key]
        self_test.check([plan])
        srgb = crop_patch(image.srgb, patch)
        pair = next(make_pairs(srgb, [plan], patch.origin, image.dark_folder))
        digests = array_xxh3(pair.clean), array_xxh3(pair.noisy)
        row = pair_row(key, source, sha256, photograph.orientation, 0, plan, pair, digests, patch)
        saturated = pair.clean == plan.saturated_value
        level = predicted_levels(settings, image, source, sha256)[plan.place.level]
        return Shown(
            config=config,
            choices=choices,
            srgb=srgb,
            plan=plan,
            pair=pair,
            clean=mosaic_dn(pair.clean, row),
            noisy=mosaic_dn(pair.noisy, row),
            saturated=unpack(saturated, plan.sensor.pattern) if plan.output.layout == PACKED else saturated,
            row=row,
            keys=tuple(parts),
            lines=noise_lines(image.config or config, [level], settings.dark_frames),
            dark_pixels=image.dark_folder,
        )


@functools.lru_cache(maxsize=4)
def listed_sources(config: SourceConfig) -> tuple[Source, ...]:
    """List photographs, or repeat an earlier listing."""
    return tuple(list_photographs(config).sources)


@functools.lru_cache(maxsize=1)
def _loaded_source(config: SourceConfig, source: Source, layout: str) -> tuple[str, Photograph]:
    return load_source(config, source, layout)


# ------------------------------------------------------------------------------------------------------------- opening

Choices = dict[str, Callable[[Exploration], Exploration]]
"""What a page offers to open, by its label: each changes what the page shows."""


def open_place(
    place: AnyPath | None, keys: str | None, overrides: Sequence[str], flags: Sequence[str], folders: OptionFolders
) -> tuple[Exploration, Choices]:
    """List the choices of a photograph, folder or dataset, by default of ``source.root``, and the start."""
    added = tuple(override for override in overrides if override.startswith(("+", "~")) or "=" not in override)
    given = dict(override.split("=", 1) for override in overrides if override not in added)
    start = Exploration(folders, given, added, tuple(flags))
    if place is not None and is_dataset(place):
        return start, _open_rows(place, keys, start)
    if keys is not None:
        raise ConfigError(f"--keys {keys}: {place or 'the source'} is no dataset; expected one; leave --keys out")
    if place is not None:
        if root := start.settings.get("source.root"):
            raise ConfigError(f"explore: {place}: the source is also given by source.root={root}; expected one of them")
        start = start.with_settings({"source.root": _path_text(str(place))})
    config = start.source_config
    names = [] if place is None else list(any_path(place).entries()) or [place.name]
    if names and all(PurePosixPath(name).suffix.lower() in RAW_FILES for name in names):
        steps = f"gen-dataset source.kind=raw source.root={shlex.quote(str(place))} out=ds, then gen-dataset report ds"
        raise ConfigError(f"explore: {place}: raw frames cannot be explored; expected photographs; run {steps}")
    sources = listed_sources(config)[:SOURCES_LISTED]
    opened = partial(_open_source, start=start, config=config)
    return start, {f"{source.index} {source.name}": partial(opened, source=source) for source in sources}


def _path_text(path: str) -> str:
    """A path in which nothing is an interpolation."""
    return path.replace("${", "\\${")


def _open_source(state: Exploration, start: Exploration, config: SourceConfig, source: Source) -> Exploration:
    """Choose a source: a photograph of a folder by itself, others with the sources that are listed before them."""
    place = {key: text for key, text in start.settings.items() if key in PLACE_KEYS}
    root, index = config.root, source.index
    is_alone = config.list is None and source.clip == NO_CLIP and not source.occurrence
    if root is not None and is_alone and any_path(root).is_dir():
        place, index = {"source.root": _path_text(f"{root.rstrip('/')}/{source.path}")}, 0
    elif index + 1 < len(listed_sources(config)):
        place["source.limit"] = str(index + 1)
    kept = state.without(PLACE_KEYS.__contains__)
    return replace(kept, settings=kept.settings | place, index=index, part="")


def _open_rows(folder: AnyPath, keys: str | None, start: Exploration) -> Choices:
    manifest = folder / "manifest.csv"
    pairs = (row for row in read_rows(manifest) if row["status"] == "ok")
    rows = list(islice(select_pairs(manifest, keys).rows.values() if keys else pairs, SOURCES_LISTED))
    if not rows:
        raise ConfigError(f"{folder}: every source failed; expected a dataset with at least one pair")
    opened = partial(_open_row, folder=folder, start=start)
    return {f"{row['key']} {row['source']}": partial(opened, row=row) for row in rows}


def _open_row(_: Exploration, folder: AnyPath, row: Row, start: Exploration) -> Exploration:
    """Write the settings of a dataset as overrides that give the pair of the row, whatever was shown before."""
    given = dict(start.settings)
    recorded, kind = read_dataset_yaml(folder / "config.yaml")
    settings = overrides_of(recorded)
    settings.pop("source.limit", None)
    places = recorded_places(folder, given.pop("source.root", None))
    if kind == "folder" and places.root is None:
        raise ConfigError(f"explore: {folder} does not record the folder of its sources; give source.root=ROOT")
    for key, place in places.settings.items():
        if place:
            settings[key] = _path_text(place)
    state = replace(start, settings=settings | given)
    config = state.source_config
    source = next((source for source in listed_sources(config) if source.name == row["source"]), None)
    if source is None:
        raise ConfigError(f"explore: {row['source']}: is not among the sources of {folder}; restore the photograph")
    return replace(_open_source(state, state, config, source), part=str(row["key"]).removeprefix(image_key(row)))
