"""Select the pairs of a dataset that sheets show, and load their frames and sources."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Photograph, Plan, Row, Source, Srgb
from unprocess_gen.dataset.manifest import patch_from_row, plan_from_row
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.dataset.selection import select_pairs
from unprocess_gen.pipeline.replay import ADVICE, recorded_source, source_of, source_root
from unprocess_gen.reports.sheets.panels import MosaicArray
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import crop_patch

PAIRS_SHOWN = 8
"""Number of pairs shown if no keys are given."""

Load = Callable[[SourceConfig, Source], tuple[str, Photograph]]


class SheetPair(NamedTuple):
    """The frames, row and plan of a pair, and its source pixels or the reason why they are missing."""

    clean: MosaicArray
    noisy: MosaicArray
    row: Row
    plan: Plan
    source: Srgb | None
    missing_source: str

    @property
    def key(self) -> str:
        """The key of the row."""
        return str(self.row["key"])


def selected_pairs(folder: AnyPath, keys: Sequence[str], source: AnyPath | None) -> Iterator[SheetPair]:
    """Yield pairs in the order of the manifest; a photograph shared by adjacent pairs is decoded once."""
    if source is not None and not source.is_dir():
        raise ConfigError(f"source.root={source}: is not a folder; expected the folder of the photographs")
    pairs, manifest = RawPairs(folder), folder / "manifest.csv"
    if not len(pairs):
        raise ConfigError(f"{folder}: every source failed; expected a dataset with at least one pair")
    spaced = evenly_spaced(range(len(pairs)), PAIRS_SHOWN)
    root = source_root(manifest, None if source is None else str(source))
    load = functools.lru_cache(maxsize=1)(load_source)
    for number in select_pairs(manifest, ",".join(keys)).rows if keys else spaced:
        clean, noisy, row = pairs[number]
        part, missing = _load_part(row, root, load)
        yield SheetPair(mosaic_dn(clean, row), mosaic_dn(noisy, row), row, plan_from_row(row), part, missing)


def _load_part(row: Row, root: str | None, load: Load) -> tuple[Srgb | None, str]:
    """Load the part of the source that a row's frames show; None and the reason if it is not available."""
    if root is None and row["source_bytes"] != 0:
        return None, "the dataset does not record where its photographs are; give source.root=ROOT"
    source = source_of(row)
    config = recorded_source(root, source, plan_from_row(row).source)
    try:
        sha256, photograph = load(config, source)
    except (SourceError, MachineError, ConfigError) as error:  # the sheet is drawn without this photograph
        return None, f"{str(error).partition(';')[0]}; {ADVICE}"
    if sha256 != row["source_sha256"]:
        return None, f"it has changed: its SHA-256 differs from the row's; {ADVICE}"
    patch, (height, width) = patch_from_row(row), photograph.srgb.shape[:2]
    part = crop_patch(photograph.srgb, patch)
    if part.shape[:2] != (patch.height, patch.width):
        return None, f"its {width} x {height} pixels do not contain the row's patch"
    return part, ""
