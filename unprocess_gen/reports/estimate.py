"""Estimate the pairs, shards, bytes, time and effects of a run, without writing anything.

The pairs of up to `SAMPLE` evenly spaced sources are made, or of all sources on request.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unprocess_gen.config.interpretation import without_dark_frames
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.files import array_xxh3, free_bytes
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Frame, Plan, Source
from unprocess_gen.pipeline.pairs import PairSettings, plan_pixels
from unprocess_gen.pipeline.progress import COMPILING, with_bar
from unprocess_gen.pipeline.run import Run, resolve
from unprocess_gen.pipeline.sizes import source_bytes
from unprocess_gen.pipeline.targets import targets_of
from unprocess_gen.planning.effect_selection import Prediction, facts_for
from unprocess_gen.planning.plan import plan_levels, plan_pairs
from unprocess_gen.planning.source_noise import noise_ratio
from unprocess_gen.reports.highlights import coarse_share
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.pair import make_pairs
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import pixels_in_none

LOGGER = logging.getLogger("unprocess_gen")

SAMPLE = 8
"""Number of sources of which pairs are made, unless all are asked for."""

TRIAL_BYTES = 2**24
"""Bytes written to measure the disk."""


@dataclass(frozen=True, slots=True)
class SourceEstimate:
    """The pairs of a source, or why it has none: ``status`` is ``ok``, ``failed`` or ``filtered``.

    ``bytes`` is the size of its pairs in a shard, ``seconds`` the time it took to make them. ``levels`` and
    ``predictions`` have an item for each noise level. ``unused_pixels`` are in no patch. ``clean_levels`` counts the
    distinct DN of the first clean frame, 0 if it is not rounded. ``coarse_share`` is that of `highlights.coarse_share`.
    ``noise_ratio`` compares the noise of the source with the simulated noise; None if it is not known.
    """

    source: Source
    seconds: float
    bytes: int = 0
    levels: tuple[Plan, ...] = ()
    status: str = "ok"
    reason: str | None = None
    detail: str = ""
    predictions: tuple[tuple[Prediction, ...], ...] = ()
    patches: int = 0
    pairs: int = 0
    pixels: int = 0
    unused_pixels: int = 0
    clean_levels: int = 0
    coarse_share: float = 0.0
    noise_ratio: float | None = None


@dataclass(frozen=True, slots=True)
class RunEstimate:
    """The size and time of a run, and the sources that were read.

    ``start_seconds`` is the time until the first pair: imports, settings, workers, and loading the kernels.
    ``pair_seconds`` is the time to make the pairs with ``n_jobs`` workers, ``disk_seconds`` to write the shards.
    """

    run: Run
    n_jobs: int
    source_estimates: tuple[SourceEstimate, ...]
    shards: int
    bytes: int
    free_bytes: int
    start_seconds: float
    pair_seconds: float
    disk_seconds: float

    @property
    def exact(self) -> bool:
        """True if every source was read."""
        return len(self.source_estimates) == len(self.run.sources)

    @property
    def seconds(self) -> float:
        """Time of a run."""
        return self.start_seconds + self.pair_seconds + self.disk_seconds

    @property
    def pairs(self) -> int:
        """Number of pairs, extrapolated unless ``exact``."""
        pairs = sum(source.pairs for source in self.source_estimates)
        return pairs if self.exact else pairs * len(self.run.sources) // len(self.source_estimates)


def estimate_run(config: Config, n_jobs: int, read_all: bool) -> RunEstimate:
    """Estimate a run by making the pairs of a sample of its sources, or of all; the time is divided by ``n_jobs``."""
    run = resolve(config)
    config, sources, shards = run.config, run.sources, len(run.tasks())
    n_jobs = min(n_jobs, shards)
    start_seconds = _import_seconds() * (1 if n_jobs == 1 else 2)  # workers start after the coordinator
    start_seconds += _compile_kernels(without_dark_frames(config))
    sample = sources if read_all else evenly_spaced(sources, SAMPLE)
    estimates = tuple(estimate_source(run.settings, source) for source in with_bar(sample, "photograph"))
    growth = len(sources) / len(sample)
    size = round(sum(source.bytes for source in estimates) * growth)
    folder = any_path(config.out).scratch_place("")[0]
    commit_s = _write_seconds(folder, 1)
    byte_s = max(_write_seconds(folder, TRIAL_BYTES) - commit_s, 0.0) / TRIAL_BYTES
    return RunEstimate(
        run,
        n_jobs,
        estimates,
        shards,
        size,
        free_bytes=free_bytes(folder),
        start_seconds=start_seconds,
        pair_seconds=sum(source.seconds for source in estimates) * growth / n_jobs,
        disk_seconds=shards * commit_s + size * byte_s,
    )


@functools.cache
def _import_seconds() -> float:
    """Processor time of this process before its first estimate: of a command, its imports and settings."""
    return time.process_time()


def _write_seconds(out: Path, size: int) -> float:
    """Measure the time to write and sync a file on the disk of ``out``; 0 if the folder cannot be written."""
    folder = next(path for path in (out.absolute(), *out.absolute().parents) if path.is_dir())
    started = time.perf_counter()
    try:
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(bytes(size))
            trial.flush()
            os.fsync(trial.fileno())
    except OSError:
        return 0.0
    return time.perf_counter() - started


def estimate_source(settings: PairSettings, source: Source) -> SourceEstimate:
    """Make the pairs of one source, with the digests that a shard needs, and discard them."""
    config, started = settings.config, time.perf_counter()
    try:
        sha256, photograph = load_source(config.source, source, config.output.layout)
    except SourceError as error:
        seconds = time.perf_counter() - started
        return SourceEstimate(source, seconds, status=error.status, reason=error.reason, detail=error.text)
    image = plan_pixels(settings, photograph, source, sha256)
    assert image.config is not None
    planned = plan_levels(image.config, *source.stream_identity(sha256), image.facts, settings.dark_frames)
    levels, predictions = zip(*planned, strict=True)
    height, width = photograph.srgb.shape[:2]
    clean_levels, planned_s = 0, time.perf_counter() - started
    for patch, plan, pair in image.pairs():
        clean_levels = clean_levels or count_levels(pair.clean)
        targets = targets_of(config.output.targets, photograph.srgb, plan, patch, pair).values()
        for frame in (*((pair.clean, *targets) if plan is image.plans[0] else ()), pair.noisy):
            array_xxh3(frame)
            hashlib.sha256(frame.data)
    return SourceEstimate(
        source,
        time.perf_counter() - started if config.output.frames else planned_s,
        source_bytes(config, height, width),
        levels,
        predictions=predictions,
        patches=len(image.patches),
        pairs=len(image.patches) * len(image.plans),
        pixels=width * height,
        unused_pixels=pixels_in_none(image.patches, height, width),
        clean_levels=clean_levels,
        coarse_share=coarse_share(photograph.srgb, levels[0]),
        noise_ratio=None if config.source.place is None else noise_ratio(photograph.srgb, levels[0]),
    )


def count_levels(clean: Frame) -> int:
    """Count the distinct DN of a clean frame; 0 if it is not rounded."""
    return int(np.count_nonzero(np.bincount(clean.reshape(-1)))) if clean.dtype == np.uint16 else 0


def _compile_kernels(config: Config) -> float:
    """Make pairs of a tiny image, so that the time of the first source does not include compilation.

    Log first that kernels will be compiled, because it takes up to 20 seconds. Return the seconds that a run spends on
    its kernels, 0 if they had to be compiled: a run then only loads them.
    """
    srgb = np.zeros((2, 2, 3), dtype=np.uint8)
    plans = plan_pairs(config, "0" * 64, facts=facts_for(config, srgb))
    needed = {self_test.kernels(plan) for plan in plans}
    are_missing = not all(map(self_test.are_compiled, needed))
    if are_missing:
        LOGGER.info(COMPILING)
    started = time.perf_counter()
    for _ in make_pairs(srgb, plans):
        pass
    for kernels in needed:
        self_test.failures(kernels)  # a run does so before its first pair
    return 0.0 if are_missing else time.perf_counter() - started
