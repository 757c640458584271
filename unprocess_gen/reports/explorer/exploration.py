"""Hold the settings of a page, make their pair with the functions that make datasets, and write their command."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from unprocess_gen.config.composition import composed_config
from unprocess_gen.config.option_files import OptionFolders
from unprocess_gen.config.raw_validation import require_photographs
from unprocess_gen.config.schema import Config, SourceConfig
from unprocess_gen.core.arrays import PACKED, Srgb
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.keys import pair_key, patch_key
from unprocess_gen.dataset.manifest import pair_row
from unprocess_gen.dataset.reader import mosaic_dn
from unprocess_gen.dataset.row import Row
from unprocess_gen.pipeline.pairs import PairSettings, PlannedImage, plan_pixels
from unprocess_gen.planning.plan import plan_levels
from unprocess_gen.reports.estimate import SourceEstimate
from unprocess_gen.reports.plan_text import noise_lines
from unprocess_gen.reports.sheets.panels import MosaicArray
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.frames import Pair
from unprocess_gen.simulation.pair import make_pairs
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import unpack
from unprocess_gen.sources.listing import list_photographs
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import crop_patch
from unprocess_gen.sources.photograph import Photograph

PAIR_FOLDER = "pair"
"""Folder of the dataset that the command of a page makes."""


@dataclass(frozen=True, slots=True)
class Shown:
    """The pair of the settings, and what they follow from.

    ``choices`` are the options by group, ``srgb`` the pixels of the patch, ``clean`` and ``noisy`` the frames as
    mosaics in DN, ``saturated`` marks sites of the clean one. ``keys`` identify all pairs of the image, ``lines`` are
    lines of ``plan`` about the noise.
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
    lines: tuple[str, ...]
    dark_pixels: DarkPixels | None = None


@dataclass
class Exploration:
    """The settings of a page, by key as texts, and which pair of them is shown.

    ``others`` are overrides that add something (``+experiment=…``), ``flags`` are flags of Hydra. ``index`` is the
    number of the source in the listing, ``part`` the rest of the key of the pair.
    """

    folders: OptionFolders
    settings: dict[str, str] = field(default_factory=dict)
    others: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    index: int = 0
    part: str = ""

    @property
    def overrides(self) -> list[str]:
        """The settings as a command line has them."""
        return [*self.others, *(f"{key}={text}" for key, text in self.settings.items())]

    @property
    def command(self) -> str:
        """The command that generates the pair, with the other pairs of its sources."""
        out = [] if "out" in self.settings else [f"out={PAIR_FOLDER}"]
        return shlex.join(["gen-dataset", *self.flags, *self.overrides, *out])

    def add(self, overrides: Sequence[str]) -> None:
        """Apply overrides as the command line does."""
        for override in overrides:
            key, _, text = override.partition("=")
            if key.startswith(("+", "~")) or not text:
                self.others += (override,)
            else:
                self.settings.pop(key, None)
                self.settings[key] = text

    def choose(self, group: str, option: str | None) -> None:
        """Choose an option of a group, None for none, and forget settings that it replaces."""
        replaced_groups = (group, "camera", "sensor", "noise") if group == "body" else (group,)
        self.settings = {
            key: text for key, text in self.settings.items() if key.partition(".")[0] not in replaced_groups
        }
        self.settings[group] = "null" if option is None else option

    def shown(self) -> Shown:
        """Make the pair; ConfigError, SourceError or MachineError with the sentence of the command line."""
        config, choices = composed_config(self.overrides, self.folders)
        require_photographs(config.source, "explore")
        source = listed_sources(config.source)[self.index]
        sha256, photograph = _loaded_source(config.source, source, config.output.layout)
        settings = PairSettings.read(config)
        image = plan_pixels(settings, photograph, source, sha256)
        is_cut, several = config.source.patch is not None, len(image.plans) > 1
        parts = {
            pair_key(patch_key(source.index, patch, is_cut), plan, several): (patch, plan)
            for patch in image.patches
            for plan in image.plans
        }
        key = f"{source.index:08d}{self.part}"
        key = key if key in parts else next(iter(parts))
        patch, plan = parts[key]
        self_test.check(self_test.kernels(plan))
        srgb = crop_patch(image.srgb, patch)
        pair = next(make_pairs(srgb, [plan], patch.origin, image.dark_folder))
        digests = array_xxh3(pair.clean), array_xxh3(pair.noisy)
        row = pair_row(key, source, sha256, photograph.orientation, 0, plan, pair, digests, patch)
        frames = mosaic_dn(pair.clean, row), mosaic_dn(pair.noisy, row)
        saturated = pair.clean == plan.saturated_value
        if plan.output.layout == PACKED:
            saturated = unpack(saturated, plan.sensor.pattern)
        lines = tuple(_plan_lines(settings, source, sha256, image, plan, pair))
        keys = tuple(parts)
        return Shown(config, choices, srgb, plan, pair, *frames, saturated, row, keys, lines, image.dark_folder)


def _plan_lines(
    settings: PairSettings, source: Source, sha256: str, image: PlannedImage, plan: Plan, pair: Pair
) -> list[str]:
    """Lines of ``plan`` about the scene and the noise of a pair."""
    assert image.config is not None
    levels = plan_levels(image.config, *source.stream_identity(sha256), image.facts, settings.dark_frames)
    estimate = SourceEstimate(
        source,
        0.0,
        levels=(plan,),
        predictions=(levels[plan.place.level][1],),
    )
    return noise_lines(image.config, [estimate], settings.dark_frames)


@functools.lru_cache(maxsize=4)
def listed_sources(config: SourceConfig) -> tuple[Source, ...]:
    """List photographs, or return them as they were listed before."""
    return list_photographs(config).sources


@functools.lru_cache(maxsize=1)
def _loaded_source(config: SourceConfig, source: Source, layout: str) -> tuple[str, Photograph]:
    return load_source(config, source, layout)
