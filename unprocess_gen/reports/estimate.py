"""Estimate the pairs, shards, bytes, time and effects of a run, without writing anything.

The pairs of up to `SAMPLE` evenly spaced sources are made, or of all sources on request.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass

from unprocess_gen.config.schema import Config
from unprocess_gen.core.arrays import Array
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.files import array_xxh3, free_bytes
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.source import Source
from unprocess_gen.pipeline.pairs import PairSettings, PlannedImage, plan_pixels
from unprocess_gen.pipeline.progress import COMPILING, with_bar
from unprocess_gen.pipeline.run import Run, resolve
from unprocess_gen.pipeline.sizes import source_bytes
from unprocess_gen.planning.advice import clipped_low_warning
from unprocess_gen.planning.effect_selection import Prediction
from unprocess_gen.planning.plan import plan_levels
from unprocess_gen.planning.source_noise import noise_ratio
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.sources.loader import load_source

LOGGER = logging.getLogger("unprocess_gen")

SAMPLE = 8
"""Number of sources of which pairs are made, unless all are asked for."""

PlanAndPredictions = tuple[Plan, tuple[Prediction, ...]]
"""A plan, and a prediction for every effect of a physical profile; no predictions for a profile with two numbers."""


@dataclass(frozen=True, slots=True)
class SourceEstimate:
    """The pairs of a source, or why it has none; ``levels`` has a plan with its predictions for each noise level.

    ``bytes`` is their size in a shard, ``seconds`` the time it took to make them, ``noise_ratio`` the noise of the
    source over the simulated noise, if it is known. ``profile`` has its colours, ``note`` is about the source.
    """

    source: Source
    seconds: float = 0.0
    failure: SourceError | None = None
    bytes: int = 0
    levels: tuple[PlanAndPredictions, ...] = ()
    patches: int = 0
    pairs: int = 0
    noise_ratio: float | None = None
    profile: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True)
class RunEstimate:
    """The size and time of a run, and the sources that were read.

    ``start_seconds`` is for imports and settings, of the workers too; ``pair_seconds`` for pairs with ``n_jobs``
    workers.
    """

    run: Run
    n_jobs: int
    source_estimates: tuple[SourceEstimate, ...]
    bytes: int
    free_bytes: int
    start_seconds: float
    pair_seconds: float

    @property
    def exact(self) -> bool:
        """True if every source was read."""
        return len(self.source_estimates) == len(self.run.sources)

    @property
    def seconds(self) -> float:
        """Time of a run that does not wait for the disk."""
        return self.start_seconds + self.pair_seconds

    @property
    def pairs(self) -> int:
        """Number of pairs, extrapolated unless ``exact``."""
        pairs = sum(source.pairs for source in self.source_estimates)
        return pairs * len(self.run.sources) // len(self.source_estimates)


def estimate_run(config: Config, n_jobs: int, read_all: bool) -> RunEstimate:
    """Estimate a run by making the pairs of a sample of its sources, or of all; the time is divided by ``n_jobs``."""
    start_seconds, run = _import_seconds(), resolve(config)
    sample = run.sources if read_all else evenly_spaced(run.sources, SAMPLE)
    estimates = tuple(estimate_source(run.settings, source) for source in with_bar(sample, "photograph"))
    n_jobs, growth = min(n_jobs, run.shards), len(run.sources) / len(sample)
    return RunEstimate(
        run,
        n_jobs,
        estimates,
        bytes=round(sum(source.bytes for source in estimates) * growth),
        free_bytes=free_bytes(any_path(config.out).scratch_place("")[0]),
        start_seconds=start_seconds * (1 if n_jobs == 1 else 2),  # workers start after the coordinator
        pair_seconds=sum(source.seconds for source in estimates) * growth / n_jobs,
    )


@functools.cache
def _import_seconds() -> float:
    """Processor time of this process before its first estimate: of a command, its imports and settings."""
    return time.process_time()


def estimate_source(settings: PairSettings, source: Source) -> SourceEstimate:
    """Make the pairs of one source, with the digests that a shard needs, and discard them."""
    config, started = settings.config, time.perf_counter()
    try:
        sha256, photograph = load_source(config.source, source, config.output.layout)
    except SourceError as error:
        return SourceEstimate(source, time.perf_counter() - started, error)
    image = plan_pixels(settings, photograph, source, sha256)
    seconds = time.perf_counter() - started
    levels = predicted_levels(settings, image, source, sha256)
    _compile_kernels([plan for plan, _ in levels])
    started, clipped, sites = time.perf_counter(), 0, 0
    for sample in image.samples():
        arrays: list[Array] = []
        for pair in sample.pairs():
            clipped += pair.counts.clean_clipped_low
            sites += sample.patch.width * sample.patch.height
            if not arrays:
                arrays += pair.clean, *sample.targets(config.output.targets, pair).values()
            arrays.append(pair.noisy)
        for array in arrays:
            array_xxh3(array)
            hashlib.sha256(array.data)
    warning = clipped_low_warning(clipped, sites) if photograph.raw is not None else ""
    return SourceEstimate(
        source,
        seconds=seconds + (time.perf_counter() - started) * config.output.frames,
        bytes=source_bytes(config, *photograph.srgb.shape[:2]),
        levels=levels,
        patches=len(image.patches),
        pairs=len(image.patches) * len(image.plans),
        noise_ratio=None if config.source.place is None else noise_ratio(photograph.srgb, image.plans[0]),
        profile=photograph.profile.name,
        note="; ".join(filter(None, (photograph.note, warning))),
    )


def predicted_levels(
    settings: PairSettings, image: PlannedImage, source: Source, sha256: str
) -> tuple[PlanAndPredictions, ...]:
    """The plan of an image at each noise level, with what decided its effects."""
    assert image.config is not None
    identity = source.stream_identity(sha256)
    levels = plan_levels(image.config, *identity, image.facts, settings.dark_frames)
    return tuple((plan, () if selection is None else selection.predictions()) for plan, selection in levels)


def _compile_kernels(plans: Sequence[Plan]) -> None:
    """Load and test the kernels of plans; report first if they must be compiled, which takes up to 20 seconds."""
    for kernels in self_test.kernels(plans):
        if not self_test.are_compiled(kernels):
            LOGGER.info(COMPILING)
        self_test.failures(kernels)
