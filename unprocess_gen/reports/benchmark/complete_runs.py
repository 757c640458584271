"""Measure complete runs by tier, from files to committed shards, with `pipeline.generate` itself.

Runs have one worker, in this process, and write to a temporary folder. In each round every tier of a setting runs once,
directly after each other; the order is reversed in every second round. A run counts with all processor time of the
process, so the thread that hashes and writes is included, and waiting for the disk is not. The worker measures decoding
and simulation (`pipeline.tasks.StageTimes`); the rest is hashing, writing and committing.

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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2

from unprocess_gen.config.interpretation import noise_levels
from unprocess_gen.config.schema import AccuracyConfig, Config, SourceConfig
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.files import machine_error
from unprocess_gen.core.types import Source
from unprocess_gen.pipeline.generate import generate
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.reports.benchmark.method_errors import NoisyError
from unprocess_gen.reports.benchmark.session import EXACT, SampleSizes
from unprocess_gen.simulation.kernels.body import forget_bodies
from unprocess_gen.sources.loader import list_photographs, load_source

LOGGER = logging.getLogger("unprocess_gen")

JPEG_QUALITY = 95
"""Quality of the files of built-in scenes."""

REFERENCE_PIXELS, MOST_REFERENCE_PIXELS = 6_000_000, 24_000_000
"""Pixels of noisy frames that are enough for a run of a NumPy tier, and those above which it is left out.

A megapixel takes 0.2 to 0.9 s, and a run makes at least one photograph.
"""


class RunTimes(NamedTuple):
    """Processor time of one run, ns per pixel; ``write_ns`` is what decoding and simulation leave."""

    decode_ns: float
    simulate_ns: float
    write_ns: float

    @property
    def total_ns(self) -> float:
        """Sum of the stages."""
        return sum(self)


@dataclass(frozen=True, slots=True)
class RunMeasurement:
    """Hold time and error of complete runs of one setting in one tier: one row of ``accuracy_runs.csv``.

    None means that the value was not measured. Errors are those of the noisy frames against the reference.
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
    noisy_changed_share: float
    noisy_max_dn: float
    noisy_rms_dn: float
    noisy_max_std: float
    noisy_rms_std: float


@dataclass(frozen=True, slots=True)
class RunFiles:
    """Hold the photographs of complete runs.

    Attributes
    ----------
    source : SourceConfig
        Settings that select these photographs.
    pixels_of_sources : tuple of int
        Number of pixels of each source; 0 if it cannot be read.
    folder : Path
        Temporary folder for datasets.
    """

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
        """Return the first photographs that have no more pixels together, but at least one that can be read."""
        first = next(at for at, number in enumerate(self.pixels_of_sources) if number)
        totals = list(itertools.accumulate(self.pixels_of_sources))
        limit = max(first + 1, sum(total <= pixels for total in totals))
        return RunFiles(replace(self.source, limit=limit), self.pixels_of_sources[:limit], self.folder)


RunKey = tuple[str, str]
"""Names of a setting and a tier."""

RunRounds = dict[RunKey, list[RunTimes]]
"""The times of a tier's runs, one for each round; empty if it was left out."""


@contextmanager
def run_files(config: Config, sizes: SampleSizes) -> Iterator[RunFiles]:
    """Select the photographs of complete runs, and create a temporary folder that is deleted at the end.

    Takes the first photographs of the config's source up to a number of photographs and of pixels, but at least one.
    Built-in scenes are written as JPEG files first, so that runs decode files.

    Parameters
    ----------
    config : Config
        Validated config.
    sizes : SampleSizes
        The largest number of photographs and of pixels.

    Yields
    ------
    RunFiles
        The photographs and the folder.

    Raises
    ------
    ConfigError
        If no photograph can be read.
    MachineError
        If the folder or a file in it cannot be written.
    """
    try:
        folder = tempfile.TemporaryDirectory(prefix="unprocess-gen-accuracy-")
    except OSError as error:
        raise machine_error(error, Path(tempfile.gettempdir()), "set TMPDIR to a folder with space") from error
    with folder as name:
        yield _select(config, sizes, Path(name))


def _select(config: Config, sizes: SampleSizes, folder: Path) -> RunFiles:
    files, pixels_of_sources = folder / "photographs", []
    for source in list_photographs(config.source).sources:
        pixels_of_sources.append(0)
        with suppress(SourceError):
            _, photograph = load_source(config.source, source, config.output.layout)
            pixels_of_sources[-1] = photograph.srgb.shape[0] * photograph.srgb.shape[1]
            if config.source.root is None:
                _write_scene(config, source, files)
        if sum(map(bool, pixels_of_sources)) >= sizes.run_files or sum(pixels_of_sources) >= sizes.run_pixels:
            break
    if not any(pixels_of_sources):
        raise ConfigError(
            f"source.root={config.source.root}: none of {len(pixels_of_sources)} photographs can be read with "
            f"output.layout={config.output.layout}; expected at least one"
        )
    source_config = config.source
    if source_config.root is None:
        source_config = replace(source_config, root=str(files), include=["*.jpg"], clips=False)
    return RunFiles(source_config, tuple(pixels_of_sources), folder).at_most(sizes.run_pixels)


def _write_scene(config: Config, source: Source, folder: Path) -> None:
    """Write a built-in scene, in full size, as a JPEG file."""
    _, scene = load_source(replace(config.source, downscale=1), source)
    _, content = cv2.imencode(".jpg", scene.srgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    try:
        folder.mkdir(exist_ok=True)
        (folder / f"{source.name}.jpg").write_bytes(content.tobytes())
    except OSError as error:
        raise machine_error(error, folder, "set TMPDIR to a folder with space") from error


def run_config(config: Config, files: RunFiles, tier: AccuracyConfig) -> Config:
    """Return the config of one complete run: selected photographs, one worker, temporary output."""
    return replace(config, source=files.source, accuracy=tier, n_jobs=1, out=str(files.folder / "dataset"))


def time_run(config: Config, pixels: int) -> RunTimes:
    """Generate a dataset, delete it, and return the processor time that generating took.

    Parameters
    ----------
    config : Config
        Validated config with ``n_jobs=1``; ``out`` does not exist.
    pixels : int
        Number of pixels of its photographs.

    Returns
    -------
    RunTimes
        Nanoseconds per pixel.
    """
    forget_bodies()
    try:
        with _without_messages():
            started = time.process_time()
            times = generate(config).times
            total_s = time.process_time() - started
    finally:
        shutil.rmtree(config.out, ignore_errors=True)
    write_s = max(total_s - times.decode_s - times.simulate_s, 0.0)
    return RunTimes(*(1e9 * stage_s / pixels for stage_s in (times.decode_s, times.simulate_s, write_s)))


@contextmanager
def _without_messages() -> Iterator[None]:
    """Suppress the progress and the warnings of runs, which would repeat for every run."""
    level = LOGGER.level
    LOGGER.setLevel(logging.ERROR)
    try:
        yield
    finally:
        LOGGER.setLevel(level)


def affordable(config: Config, files: RunFiles, sizes: SampleSizes) -> Config:
    """Return the config, with one noise level and one draw if it would make too many noisy frames."""
    if files.pixels * _pairs(config) <= 2 * max(sizes.run_pixels, files.pixels):
        return config
    return replace(config, noise=replace(config.noise, levels=None, draws=1))


def _pairs(config: Config) -> int:
    """Return the number of pairs of a photograph."""
    return len(noise_levels(config.noise)) * config.noise.draws


def measure_runs(
    configs: Mapping[str, Config],
    tiers: Mapping[str, AccuracyConfig],
    files: RunFiles,
    rounds: int,
    progress: Progress,
) -> RunRounds:
    """Run every tier of every setting in each round, and return the times.

    Parameters
    ----------
    configs : mapping of str to Config
        Validated configs by name of the setting.
    tiers : mapping of str to AccuracyConfig
        Tiers by name.
    files : RunFiles
        The photographs.
    rounds : int
        Number of rounds, 1 or more.
    progress : Progress
        Is advanced by ``len(configs) * len(tiers) * rounds``.

    Returns
    -------
    dict of (str, str) to list of RunTimes
        Times by setting and tier.
    """
    found: RunRounds = {(setting, tier): [] for setting in configs for tier in tiers}
    one = files.at_most(0)
    for config in configs.values():
        for tier in tiers.values():
            if not tier.readable:
                time_run(run_config(config, one, tier), one.pixels)  # compiles, tests and fills caches
    for number in range(rounds):
        for setting, config in configs.items():
            for name, tier in list(tiers.items())[:: -1 if number % 2 else 1]:
                for some in _photographs(tier, config, files, number):
                    found[setting, name].append(time_run(run_config(config, some, tier), some.pixels))
                progress.advance()
    return found


def _photographs(tier: AccuracyConfig, config: Config, files: RunFiles, number: int) -> Iterator[RunFiles]:
    """Yield the photographs of a tier's run in a round; none if it does not run."""
    if not tier.readable:
        yield files
    elif number == 0:
        some = files.at_most(REFERENCE_PIXELS // _pairs(config))
        if some.pixels * _pairs(config) <= MOST_REFERENCE_PIXELS:
            yield some


def run_rows(
    rounds: RunRounds, noises: Mapping[str, str], errors: Mapping[RunKey, NoisyError]
) -> Iterator[RunMeasurement]:
    """Yield time and error of each tier of each setting.

    Parameters
    ----------
    rounds : dict of (str, str) to list of RunTimes
        Times by setting and tier.
    noises : mapping of str to str
        Description of the noise by setting.
    errors : mapping of (str, str) to NoisyError
        Errors of the noisy frames by setting and tier.

    Yields
    ------
    RunMeasurement
        In the order of ``rounds``.
    """
    for (setting, tier), times in rounds.items():
        cost = run_cost(times, rounds[setting, EXACT])
        yield RunMeasurement(setting, noises[setting], tier, *cost, *errors[setting, tier])


class RunCost(NamedTuple):
    """The time of a tier's runs, as in `RunMeasurement`."""

    ns_per_pixel: float | None = None
    ratio_to_exact: float | None = None
    lower_quartile_ratio: float | None = None
    upper_quartile_ratio: float | None = None
    decode_share: float | None = None
    simulate_share: float | None = None
    write_share: float | None = None


def run_cost(times: Sequence[RunTimes], exact: Sequence[RunTimes]) -> RunCost:
    """Return the time of a tier's runs: the shortest of each stage, their shares, and the ratios to exact.

    Parameters
    ----------
    times, exact : sequence of RunTimes
        Times of the tier and of ``exact``, by round; the tier can have fewer rounds, or none.

    Returns
    -------
    RunCost
        All None if the tier did not run.
    """
    if not times:
        return RunCost()
    least, least_exact = (RunTimes(*map(min, zip(*each, strict=True))) for each in (times, exact))
    ratios = [one.total_ns / other.total_ns for one, other in zip(times, exact, strict=False)]
    ratio = least.total_ns / least_exact.total_ns
    shares = [stage_ns / least.total_ns for stage_ns in least]
    return RunCost(least.total_ns, ratio, *_quartiles(ratios), *shares)


def _quartiles(ratios: Sequence[float]) -> tuple[float, float]:
    """Return the lower and the upper quartile."""
    if len(ratios) == 1:
        return ratios[0], ratios[0]
    lower, _, upper = statistics.quantiles(ratios, method="inclusive")
    return lower, upper
