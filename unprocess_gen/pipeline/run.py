"""Resolve a config to a run: list its sources, open its dark frames, and divide it into shards.

A config is complete after `resolve`; no later step changes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from unprocess_gen.config.bodies import body_sentence
from unprocess_gen.config.schema import Config
from unprocess_gen.core.source import Source
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.tasks import ShardTask
from unprocess_gen.planning.dark_scene import dark_scene_warning
from unprocess_gen.planning.sensor_levels import sensor_warning
from unprocess_gen.sources.listing import Listing, list_photographs


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
        return shard_tasks(self.sources, self.config.output.pairs_per_shard)

    def warnings(self) -> tuple[str, ...]:
        """Collect what the user should know before the run begins, a sentence each."""
        checks = body_sentence, dark_scene_warning, sensor_warning
        warnings = *self.listing.warnings, *(check(self.config) for check in checks)
        return tuple(dict.fromkeys(filter(None, warnings)))


def resolve(config: Config) -> Run:
    """List the sources of a validated config and complete it with the digests of dark frames.

    Raises ConfigError if sources or dark frames cannot be used, SourceChangedError if recorded dark frames changed.
    """
    listing = list_photographs(config.source)
    return Run(PairSettings.read(config), listing)


def shard_tasks(sources: Sequence[Source], per_shard: int) -> list[ShardTask]:
    """Split the listing into shards: shard s begins at source s·N, N = ``per_shard``."""
    starts = range(0, len(sources), per_shard)
    return [ShardTask(shard, tuple(sources[start : start + per_shard])) for shard, start in enumerate(starts)]
