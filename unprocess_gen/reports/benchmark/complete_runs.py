"""Measure complete runs by tier, from files to committed shards, with `pipeline.generate` itself.

Runs have one worker, in this process, and write to a temporary folder. They take turns (`timing.measure_in_turns`). A
run counts with all processor time of the process, so the thread that hashes and writes is included, and waiting for the
disk is not. The worker measures decoding and simulation; the rest is hashing, writing and committing.

The reported time of a stage, per pixel, is its shortest in all rounds, because other programs only lengthen it. The
reference is so slow that it runs in one round only, and on fewer photographs.
"""

from __future__ import annotations

import itertools
import logging
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from unprocess_gen.config.interpretation import noise_levels
from unprocess_gen.config.schema import AccuracyConfig, Config, SourceConfig
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.files import machine_error
from unprocess_gen.core.types import Source
from unprocess_gen.pipeline.generate import generate
from unprocess_gen.reports.benchmark.methods import FrameErrors
from unprocess_gen.reports.benchmark.session import EXACT, SampleSizes
from unprocess_gen.reports.benchmark.timing import measure_in_turns
from unprocess_gen.reports.encoding import picture_jpeg
from unprocess_gen.reports.report_files import write_files
from unprocess_gen.simulation.kernels.body import forget_bodies
from unprocess_gen.sources.loader import list_photographs, load_source

LOGGER = logging.getLogger("unprocess_gen")

JPEG_QUALITY = 95
"""Quality of the files of built-in scenes."""

REFERENCE_PIXELS, MOST_REFERENCE_PIXELS = 6_000_000, 24_000_000
"""Pixels of noisy frames that are enough for a run of a NumPy tier, and those above which it is left out.

A megapixel takes up to a second and much memory, and a run makes at least one photograph.
"""


class RunTimes(NamedTuple):
    """Processor time of one run, ns per pixel; ``write_ns`` is what decoding and simulation leave."""

    decode_ns: float
    simulate_ns: float
    write_ns: float


@dataclass(frozen=True, slots=True)
class RunMeasurement:
    """Time and error of complete runs of one setting in one tier: one row of ``accuracy_runs.csv``.

    None means that the value was not measured. Errors are of the noisy frames against the reference.
    """

    setting: str
    noise: str
    tier: str
    ns_per_pixel: float | None
    ratio_to_exact: float | None
    lower_quartile_ratio: float | None
    upper_quartile_ratio: float | None
    decode_share: float | None
    simulate_share: float | None
    write_share: float | None
    noisy_changed_share: float | None
    noisy_max_dn: float
    noisy_rms_dn: float
    noisy_max_std: float
    noisy_rms_std: float


@dataclass(frozen=True, slots=True)
class RunFiles:
    """Photographs of complete runs, with their pixels (0 if unreadable), and a temporary folder."""

    source: SourceConfig
    pixels_of_sources: tuple[int, ...]
    folder: Path

    @property
    def count(self) -> int:
        """Number of photographs that can be read."""
        return sum(pixels > 0 for pixels in self.pixels_of_sources)

    @property
    def pixels(self) -> int:
        """Number of pixels of all photographs."""
        return sum(self.pixels_of_sources)

    def at_most(self, pixels: int) -> RunFiles:
        """The first photographs that have no more pixels together, but at least one that can be read."""
        first = next(index for index, number in enumerate(self.pixels_of_sources) if number)
        limit = max(first + 1, sum(total <= pixels for total in itertools.accumulate(self.pixels_of_sources)))
        return RunFiles(replace(self.source, limit=limit), self.pixels_of_sources[:limit], self.folder)


@contextmanager
def run_files(config: Config, sizes: SampleSizes) -> Iterator[RunFiles]:
    """Select the first photographs up to a number and some pixels; the temporary folder is deleted at the end.

    Built-in scenes are written as JPEG files first, so that runs decode files. ConfigError if no photograph can be
    read; MachineError if the folder cannot be written.
    """
    try:
        folder = tempfile.TemporaryDirectory(prefix="unprocess-gen-accuracy-")
    except OSError as error:
        raise machine_error(error, Path(tempfile.gettempdir()), "set TMPDIR to a folder with space") from error
    with folder as name:
        yield _select(config, sizes, Path(name))


def _select(config: Config, sizes: SampleSizes, folder: Path) -> RunFiles:
    source_config, scenes, pixels = config.source, folder / "photographs", list[int]()
    for source in list_photographs(source_config).sources:
        pixels.append(0)
        with suppress(SourceError):
            pixels[-1] = load_source(source_config, source, config.output.layout)[1].srgb[..., 0].size
            if source_config.place is None:
                _write_scene(source_config, source, scenes)
        if sum(map(bool, pixels)) >= sizes.run_files or sum(pixels) >= sizes.run_pixels:
            break
    if not any(pixels):
        raise ConfigError(
            f"source.root={source_config.place}: none of {len(pixels)} photographs can be read with "
            f"output.layout={config.output.layout}; expected at least one"
        )
    if source_config.place is None:
        source_config = replace(source_config, root=str(scenes), include=("*.jpg",), clips=False)
    return RunFiles(source_config, tuple(pixels), folder).at_most(sizes.run_pixels)


def _write_scene(config: SourceConfig, source: Source, folder: Path) -> None:
    """Write a built-in scene, in full size, as a JPEG file."""
    _, scene = load_source(replace(config, downscale=1), source)
    write_files(folder, {f"{source.name}.jpg": picture_jpeg(scene.srgb, JPEG_QUALITY)})


def time_run(config: Config, files: RunFiles, tier: AccuracyConfig) -> RunTimes:
    """Generate a dataset of these photographs with one worker, delete it, and return the processor time."""
    out = files.folder / "dataset"
    run_config = replace(config, source=files.source, accuracy=tier, n_jobs=1, out=str(out))
    forget_bodies()
    level = LOGGER.level
    LOGGER.setLevel(logging.ERROR)  # progress and warnings would repeat for every run
    try:
        started = time.process_time()
        times = generate(run_config).times
        total_s = time.process_time() - started
    finally:
        LOGGER.setLevel(level)
        shutil.rmtree(out, ignore_errors=True)
    write_s = max(total_s - times.decode_s - times.simulate_s, 0.0)
    return RunTimes(*(1e9 * stage_s / files.pixels for stage_s in (times.decode_s, times.simulate_s, write_s)))


def affordable(config: Config, files: RunFiles, sizes: SampleSizes) -> Config:
    """The config, with one noise level and one draw if it would make too many noisy frames."""
    if files.pixels * _pairs(config) <= 2 * max(sizes.run_pixels, files.pixels):
        return config
    return replace(config, noise=replace(config.noise, levels=None, draws=1))


def _pairs(config: Config) -> int:
    """Number of pairs of a photograph."""
    return len(noise_levels(config.noise)) * config.noise.draws


RunKey = tuple[str, str]
"""Names of a setting and a tier."""


def measure_runs(
    configs: Mapping[str, Config],
    tiers: Mapping[str, AccuracyConfig],
    files: RunFiles,
    rounds: int,
    advance: Callable[[], None],
) -> dict[RunKey, list[RunTimes]]:
    """Times of every tier of every setting by round; ``advance`` is called after each run that counts.

    A NumPy tier has one time, or none if its run would be too long.
    """
    for config, tier in itertools.product(configs.values(), tiers.values()):
        if not tier.readable:
            time_run(config, files.at_most(0), tier)  # compiles, tests and fills caches

    def measure(config: Config, tier: AccuracyConfig, number: int) -> RunTimes | None:
        if not tier.readable:
            return time_run(config, files, tier)
        few = files.at_most(REFERENCE_PIXELS // _pairs(config))
        is_affordable = few.pixels * _pairs(config) <= MOST_REFERENCE_PIXELS
        return time_run(config, few, tier) if number == 0 and is_affordable else None

    runs = {
        (setting, name): partial(measure, config, tier)
        for setting, config in configs.items()
        for name, tier in tiers.items()
    }
    times = measure_in_turns(runs, rounds, advance)
    return {key: [time for time in durations if time is not None] for key, durations in times.items()}


def run_rows(
    times: Mapping[RunKey, Sequence[RunTimes]], noises: Mapping[str, str], errors: Mapping[RunKey, FrameErrors]
) -> Iterator[RunMeasurement]:
    """Time and error of each tier of each setting, with the description of the noise of the setting."""
    for (setting, tier), tier_times in times.items():
        cost = run_cost(tier_times, times[setting, EXACT]) if tier_times else (None,) * 7
        columns: list[Any] = [*cost, *errors[setting, tier].noisy_columns()]
        yield RunMeasurement(setting, noises[setting], tier, *columns)


def run_cost(times: Sequence[RunTimes], exact: Sequence[RunTimes]) -> tuple[float, ...]:
    """The columns of `RunMeasurement` from ``ns_per_pixel`` to ``write_share``."""
    least, least_exact = ([min(stage) for stage in zip(*rounds, strict=True)] for rounds in (times, exact))
    ratios = [sum(run) / sum(exact_run) for run, exact_run in zip(times, exact, strict=False)]
    quartiles = statistics.quantiles(ratios, method="inclusive") if len(ratios) > 1 else ratios
    shares = [stage_ns / sum(least) for stage_ns in least]
    return sum(least), sum(least) / sum(least_exact), quartiles[0], quartiles[-1], *shares
