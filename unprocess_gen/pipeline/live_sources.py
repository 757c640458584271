"""Find the pairs of epoch 0: from the rows of a manifest, or planned from listed photographs."""

from __future__ import annotations

import abc
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from unprocess_gen.config.interpretation import noise_levels, patch_rule
from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.sequences import Recent
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.columns import Value
from unprocess_gen.dataset.keys import pair_key, patch_key
from unprocess_gen.dataset.reader import DatasetRows
from unprocess_gen.dataset.row import pair_row, patch_from_row, plan_from_row
from unprocess_gen.pipeline.pairs import PairSettings, plan_pixels
from unprocess_gen.pipeline.replay import PairRegenerator, places_of, source_of
from unprocess_gen.pipeline.run import resolve
from unprocess_gen.simulation.frames import Pair, Patch
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.loader import load_source

KEPT = 4096
"""Plans that a process keeps, 8 kB each: reading or drawing one again takes longer than a patch of 128 x 128."""


@dataclass(frozen=True, slots=True)
class LiveImage:
    """All that decides a pair in epoch 0, as `dataset.row.pair_row` takes it.

    ``recorded`` reads the row of the pair from the manifest of a dataset, if the row has digests.
    """

    source: Source
    sha256: str
    orientation: int
    shard: int
    key: str
    plan: Plan
    patch: Patch
    source_noise_dn: float | None = None
    recorded: Callable[[], dict[str, Value]] | None = None

    @property
    def cache_name(self) -> str:
        """Name of the decoded image in a `PixelCache`."""
        prepared = self.plan.source
        if not prepared.is_raw:
            return f"{self.sha256}-{prepared.downscale}"
        means = prepared.raw_pattern, *prepared.raw_black_dn, *prepared.raw_white_dn
        return "-".join(map(str, (prepared.mosaic_xxh3, prepared.shrink, *(means if prepared.shrink > 1 else ()))))

    def row(self, plan: Plan, epoch: int, patch: Patch, pair: Callable[[], Pair]) -> dict[str, Value]:
        """Build the row of a pair in an epoch, or read the recorded one."""
        if self.recorded is not None and not epoch and patch == self.patch:
            return self.recorded()
        made = pair()
        digests = array_xxh3(made.clean), array_xxh3(made.noisy)
        identity = self.key, self.source, self.sha256, self.orientation, self.shard
        row = pair_row(*identity, plan.replace(epoch=epoch), made, digests, patch, self.source_noise_dn)
        return {**row, "epoch": epoch} if epoch else dict(row)


class LiveSource(abc.ABC):
    """Pairs of epoch 0: the name of their dataset, their settings, and each of them by number."""

    name = ""
    settings: PairSettings

    @abc.abstractmethod
    def __len__(self) -> int: ...

    @abc.abstractmethod
    def image(self, number: int) -> LiveImage:
        """Find all that decides a pair."""

    @abc.abstractmethod
    def decode(self, image: LiveImage) -> Srgb:
        """Decode the image of a pair."""


class RecordedPairs(DatasetRows, LiveSource):
    """Pairs of a dataset, or of those in a split; reads its manifest and its sources, and no shard."""

    def __init__(self, root: str | None, folder: AnyPath, split: str | None = None) -> None:
        super().__init__(folder, split)
        config, _ = read_dataset_yaml(folder / "config.yaml")
        places = places_of(folder, root)
        self.settings = PairSettings.read(replaced(config, {"noise.dark_frames": places.dark_frames}))
        self._sources = PairRegenerator(places.root, places.dark_frames)
        self._kept: Recent[int, LiveImage] = Recent(KEPT)

    def image(self, number: int) -> LiveImage:
        """Read all that decides the pair of a row."""
        image = self._kept.get(number)
        if image is None:
            row = self.row(number)
            numbers, noise_dn = (int(row["orientation"] or 1), int(row["shard"] or 0)), row["source_noise_dn"]
            identity = source_of(row), str(row["source_sha256"]), *numbers, str(row["key"])
            assert not isinstance(noise_dn, str)
            parts = plan_from_row(row), patch_from_row(row), noise_dn
            recorded = partial(self.row, number) if row["clean_xxh3"] else None
            image = self._kept.keep(number, LiveImage(*identity, *parts, recorded))
        return image

    def decode(self, image: LiveImage) -> Srgb:
        """Decode the image of a pair; raise as `PairRegenerator.photograph`."""
        return self._sources.photograph(image.source, image.sha256, image.plan.source).srgb


class PlannedPairs(LiveSource):
    """Pairs of listed photographs, planned when they are read, as a run would make them."""

    def __init__(self, config: Config, root: str | None) -> None:
        config = config if root is None else replaced(config, {"source.root": root})
        validate_config(config)
        rule = patch_rule(config.source)
        if rule is not None and rule.kind == "grid":
            raise ConfigError(
                f"source.patch={config.source.patch}: the number of patches depends on the sizes of the images; "
                "expected random patches or null; give LivePairs a finished dataset"
            )
        run = resolve(config)
        self.settings = run.settings
        self._sources = [source for source in run.sources if source.reason is None]
        self._patches = 1 if rule is None else rule.count
        self._plans = len(noise_levels(config.noise)) * config.noise.draws
        self._planned: Recent[int, tuple[str, int, tuple[Plan, ...], tuple[Patch, ...]]] = Recent(KEPT)
        self._decoded: tuple[Source, str, Photograph] | None = None

    def __len__(self) -> int:
        return len(self._sources) * self._patches * self._plans

    def image(self, number: int) -> LiveImage:
        """Plan a pair; raise as `load_source`."""
        index, rest = divmod(number, self._patches * self._plans)
        source, config = self._sources[index], self.settings.config
        planned = self._planned.get(index)
        if planned is None:
            sha256, photograph = self._load(source)
            image = plan_pixels(self.settings, photograph, source, sha256)
            planned = self._planned.keep(index, (sha256, photograph.orientation, image.plans, image.patches))
        sha256, orientation, plans, patches = planned
        patch, plan = patches[rest // self._plans], plans[rest % self._plans]
        sample = patch_key(source.index, patch, several=config.source.patch is not None)
        key = pair_key(sample, plan, several=self._plans > 1)
        shard = source.index // self.settings.config.output.pairs_per_shard
        return LiveImage(source, sha256, orientation, shard, key, plan, patch)

    def decode(self, image: LiveImage) -> Srgb:
        """Decode the image of a pair; raise as `load_source`."""
        return self._load(image.source)[1].srgb

    def _load(self, source: Source) -> tuple[str, Photograph]:
        """Load a source; the last one stays decoded, because pairs of one image are consecutive."""
        decoded, config = self._decoded, self.settings.config
        if decoded is None or decoded[0] != source:
            decoded = self._decoded = source, *load_source(config.source, source, config.output.layout)
        return decoded[1:]
