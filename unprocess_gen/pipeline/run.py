"""Resolve a config to a run: list its sources, open its dark frames, and divide it into shards.

A config is complete after `resolve`; no later step changes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from unprocess_gen.config.bodies import body_sentence
from unprocess_gen.config.schema import TOGETHER, Config, OutputConfig
from unprocess_gen.core.types import Source
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.sizes import resolve_pairs_per_shard, shards_warning
from unprocess_gen.pipeline.tasks import ShardTask
from unprocess_gen.planning.dark_scene import dark_scene_warning
from unprocess_gen.planning.sensor_levels import sensor_warning
from unprocess_gen.sources.listing import Listing
from unprocess_gen.sources.loader import list_photographs


@dataclass(frozen=True, slots=True)
class Run:
    """Hold the settings of a run and its sources."""

    settings: PairSettings
    listing: Listing

    @property
    def config(self) -> Config:
        """The complete config."""
        return self.settings.config

    @property
    def sources(self) -> tuple[Source, ...]:
        """All sources, in the order of the manifest."""
        return self.listing.sources

    def tasks(self) -> list[ShardTask]:
        """Divide the sources into shards."""
        return shard_tasks(self.sources, self.starts())

    def starts(self) -> Sequence[int]:
        """Index of the first source of each shard."""
        return shard_starts(self.sources, self.config.output)

    def warnings(self) -> tuple[str, ...]:
        """Collect what the user should know before the run begins, a sentence each."""
        checks = body_sentence, dark_scene_warning, sensor_warning
        about_noise = [check(self.config) for check in checks]
        warnings = *self.listing.warnings, shards_warning(self.config, self.sources), *about_noise
        return tuple(dict.fromkeys(filter(None, warnings)))


def resolve(config: Config) -> Run:
    """List the sources of a validated config and complete it: dark frames' digests, a number of pairs per shard.

    Raises ConfigError if sources or dark frames cannot be used, SourceChangedError if recorded dark frames changed.
    """
    listing = list_photographs(config.source)
    settings = PairSettings.read(config)
    complete = resolve_pairs_per_shard(settings.config, listing.sources)
    return Run(replace(settings, config=complete), listing)


def shard_starts(sources: Sequence[Source], output: OutputConfig) -> Sequence[int]:
    """Return the index of the first source of each shard.

    Shard s begins at source s·N, N = ``pairs_per_shard``. With ``output.clips=together``, a shard ends with the clip
    that gives it N sources.
    """
    size = int(output.pairs_per_shard)
    if output.clips != TOGETHER:
        return range(0, len(sources), size)
    last = {source.clip: index for index, source in enumerate(sources)}
    starts: list[int] = []
    end = -1  # of the clips that have begun
    for index, source in enumerate(sources):
        if index > end and (not starts or index - starts[-1] >= size):
            starts.append(index)
        end = max(end, last[source.clip])
    return starts


def shard_tasks(sources: Sequence[Source], starts: Sequence[int]) -> list[ShardTask]:
    """Split the listing into tasks, by the index of the first source of each shard."""
    ends = *starts[1:], len(sources)
    return [
        ShardTask(shard, tuple(sources[place[0] : place[1]]))
        for shard, place in enumerate(zip(starts, ends, strict=True))
    ]
