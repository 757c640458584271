"""Find the pairs of epoch 0: from the rows of a finished dataset, or planned from listed photographs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from unprocess_gen.config.interpretation import noise_levels, patch_rule
from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.paths import AnyPath, folder_name
from unprocess_gen.core.types import Pair, Patch, Photograph, Plan, Row, Source, Srgb
from unprocess_gen.dataset.keys import pair_key, patch_key
from unprocess_gen.dataset.manifest import (
    pair_row,
    patch_from_row,
    plan_from_row,
    read_columns,
    read_row,
    rows_with_offsets,
)
from unprocess_gen.pipeline.pairs import PairSettings, plan_pixels
from unprocess_gen.pipeline.replay import PairRegenerator, dark_places, source_of, source_root
from unprocess_gen.sources.dark_frames import with_dark_places
from unprocess_gen.sources.loader import list_photographs, load_source
from unprocess_gen.sources.pixel_cache import PixelCache


@dataclass(frozen=True, slots=True)
class LiveImage:
    """Hold the pixels of a pair, and all that decides it in epoch 0.

    Attributes
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        The decoded image.
    source, sha256, orientation, shard, key
        As `dataset.manifest.pair_row` takes them.
    plan : Plan
        All parameters of the pair.
    patch : Patch
        Part of the image that the pair shows.
    recorded : Row or None
        Row of the pair in the manifest of a dataset.
    """

    srgb: Srgb
    source: Source
    sha256: str
    orientation: int
    shard: int
    key: str
    plan: Plan
    patch: Patch
    recorded: Row | None = None

    def row(self, plan: Plan, patch: Patch, pair: Pair) -> dict[str, object]:
        """Return the row of a pair of this image; the recorded one in epoch 0."""
        recorded, epoch = self.recorded, plan.noise.epoch
        if recorded is not None and not epoch and patch == self.patch:
            return dict(recorded)
        digests = array_xxh3(pair.clean), array_xxh3(pair.noisy)
        noise_dn = recorded["source_noise_dn"] if recorded else None
        assert not isinstance(noise_dn, str)
        identity = self.source, self.sha256, self.orientation, self.shard
        row = pair_row(self.key, *identity, plan, pair, digests, patch, noise_dn)
        return {**row, "epoch": epoch} if epoch else dict(row)


class LiveSource(Protocol):
    """Pairs of epoch 0: the name of their dataset, their settings, and each of them by number."""

    name: str
    settings: PairSettings

    def __len__(self) -> int: ...

    def image(self, number: int) -> LiveImage:
        """Return the pixels and the plan of a pair."""


class RecordedPairs:
    """Pairs of a finished dataset; reads its manifest and its sources, and no shard."""

    def __init__(self, folder: AnyPath, root: str | None, cache: PixelCache | None) -> None:
        self.name, self._cache = folder_name(folder), cache
        self._manifest = folder / "manifest.csv"
        config, _ = read_dataset_yaml(folder / "config.yaml")
        dark = dark_places(self._manifest)
        self.settings = PairSettings.read(with_dark_places(config, dark))
        self._sources = PairRegenerator(source_root(self._manifest, root), dark)
        self._columns = read_columns(self._manifest)
        pairs = (offset for offset, row in rows_with_offsets(self._manifest) if row["status"] == "ok")
        self._offsets = np.fromiter(pairs, dtype=np.int64)

    def __len__(self) -> int:
        return len(self._offsets)

    def image(self, number: int) -> LiveImage:
        """Return the pixels and the plan of a row; raise as `PairRegenerator.photograph`."""
        row = dict(read_row(self._manifest, int(self._offsets[number]), self._columns))
        plan, patch, source = plan_from_row(row), patch_from_row(row), source_of(row)
        sha256 = str(row["source_sha256"])

        def decode() -> Srgb:
            return self._sources.photograph(row).srgb

        name = _cache_name(sha256, source, plan.source.downscale)
        srgb = decode() if self._cache is None else self._cache.get(name, decode)
        numbers = int(row["orientation"] or 1), int(row["shard"] or 0)
        return LiveImage(srgb, source, sha256, *numbers, str(row["key"]), plan, patch, row)


class PlannedPairs:
    """Pairs of listed photographs, planned when they are read, as a run would make them."""

    def __init__(self, config: Config, root: str | None, cache: PixelCache | None) -> None:
        config = config if root is None else replaced(config, {"source.root": root})
        validate_config(config)
        rule = patch_rule(config.source)
        if rule is not None and rule.kind == "grid":
            raise ConfigError(
                f"source.patch={config.source.patch}: the number of patches depends on the sizes of the images; "
                "expected random patches or null; give LivePairs a finished dataset"
            )
        self.name, self._cache = "", cache
        self.settings = PairSettings.read(config)
        listed = list_photographs(config.source).sources
        self._sources = [source for source in listed if source.reason is None]
        self._patches = 1 if rule is None else rule.count
        self._plans = len(noise_levels(config.noise)) * config.noise.draws
        self._digests: dict[int, tuple[str, int]] = {}
        self._kept: tuple[int, Photograph] | None = None

    def __len__(self) -> int:
        return len(self._sources) * self._patches * self._plans

    def image(self, number: int) -> LiveImage:
        """Plan a pair; raise as `load_source`."""
        image, rest = divmod(number, self._patches * self._plans)
        source, config = self._sources[image], self.settings.config
        sha256, photograph = self._load(image)
        planned = plan_pixels(self.settings, photograph.srgb, source, sha256)
        patch, plan = planned.patches[rest // self._plans], planned.plans[rest % self._plans]
        sample = patch_key(source.index, patch, several=config.source.patch is not None)
        key = pair_key(sample, plan, several=self._plans > 1)
        shard = source.index // config.output.pairs_per_shard
        return LiveImage(photograph.srgb, source, sha256, photograph.orientation, shard, key, plan, patch)

    def _load(self, number: int) -> tuple[str, Photograph]:
        """Load a source; its digest and orientation are kept, because they name its pixels in the cache."""
        source, config = self._sources[number], self.settings.config
        if number not in self._digests or self._cache is None:
            return self._decode(number)
        sha256, orientation = self._digests[number]
        name = _cache_name(sha256, source, config.source.downscale)
        return sha256, Photograph(self._cache.get(name, lambda: self._decode(number)[1].srgb), orientation)

    def _decode(self, number: int) -> tuple[str, Photograph]:
        """Decode a source; the last one stays decoded, because pairs of one image are consecutive."""
        source, config = self._sources[number], self.settings.config
        kept = self._kept
        if kept is None or kept[0] != number:
            sha256, photograph = load_source(config.source, source, config.output.layout)
            self._digests[number] = sha256, photograph.orientation
            kept = self._kept = number, photograph
        return self._digests[number][0], kept[1]


def _cache_name(sha256: str, source: Source, downscale: int) -> str:
    return f"{sha256}-{source.frame}-{downscale}"
