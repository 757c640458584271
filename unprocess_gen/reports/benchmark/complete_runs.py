"""Measure complete runs by tier, from files to committed shards, with `pipeline.generate` itself.

Runs have one worker, in this process, and write to a temporary folder. In each round every tier of a setting runs once,
directly after each other; the order is reversed in every second round. A run counts with all processor time of the
process, so the thread that hashes and writes is included, and waiting for the disk is not. The worker measures decoding
and simulation (`pipeline.tasks.StageTimes`); the rest is hashing, writing and committing.

The reported time is that of the fastest round. The reference is so slow that it runs in one round only.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2

from unprocess_gen.config.interpretation import noise_levels
from unprocess_gen.config.schema import AccuracyConfig, Config, SourceConfig
from unprocess_gen.core.errors import SourceError
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

REFERENCE_PIXELS = 24_000_000
"""Pixels of noisy frames above which runs of NumPy tiers are left out; they take about a second per megapixel."""


class RunTimes(NamedTuple):
    """Processor time of one run, seconds; ``write_s`` is what decoding and simulation leave."""

    decode_s: float
    simulate_s: float
    write_s: float

    @property
    def total_s(self) -> float:
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
    lowest_ratio: float | None
    highest_ratio: float | None
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
    count, pixels : int
        Number of photographs that can be read, and of their pixels.
    folder : Path
        Temporary folder for datasets.
    """

    source: SourceConfig
    count: int
    pixels: int
    folder: Path


RunKey = tuple[str, str]
"""Names of a setting and a tier."""

RunRounds = dict[RunKey, list[RunTimes]]
"""The times of a tier's runs, one for each round; empty if it was left out."""


@contextmanager
def run_files(config: Config, sizes: SampleSizes) -> Iterator[RunFiles]:
    """Select the photographs of complete runs, and create a temporary folder that is deleted at the end.

    Takes the first photographs of the config's source, until there are enough pixels. Built-in scenes are written as
    JPEG files first, so that runs decode files.

    Parameters
    ----------
    config : Config
        Validated config.
    sizes : SampleSizes
        How many photographs and pixels are enough.

    Yields
    ------
    RunFiles
        The photographs and the folder.

    Raises
    ------
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
    sources = list_photographs(config.source).sources
    files, count, pixels, listed = folder / "photographs", 0, 0, 0
    for source in sources:
        listed += 1
        with suppress(SourceError):
            _, photograph = load_source(config.source, source, config.output.layout)
            height, width = photograph.srgb.shape[:2]
            count, pixels = count + 1, pixels + height * width
            if config.source.root is None:
                _write_scene(config, source, files)
        if count >= sizes.run_files or pixels >= sizes.run_pixels:
            break
    selected = replace(config.source, limit=listed)
    if config.source.root is None:
        selected = replace(selected, root=str(files), include=["*.jpg"], clips=False)
    return RunFiles(selected, count, pixels, folder)


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


def time_run(config: Config) -> RunTimes:
    """Generate a dataset, delete it, and return the processor time that generating took.

    Parameters
    ----------
    config : Config
        Validated config with ``n_jobs=1``; ``out`` does not exist.

    Returns
    -------
    RunTimes
        Seconds.
    """
    forget_bodies()
    try:
        with _without_messages():
            started = time.process_time()
            times = generate(config).times
            total_s = time.process_time() - started
    finally:
        shutil.rmtree(config.out, ignore_errors=True)
    return RunTimes(times.decode_s, times.simulate_s, max(total_s - times.decode_s - times.simulate_s, 0.0))


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
    if _noisy_pixels(config, files) <= 2 * max(sizes.run_pixels, files.pixels):
        return config
    return replace(config, noise=replace(config.noise, levels=None, draws=1))


def _noisy_pixels(config: Config, files: RunFiles) -> int:
    return files.pixels * len(noise_levels(config.noise)) * config.noise.draws


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
    for number in range(rounds):
        for setting, config in configs.items():
            for name, tier in _ordered(tiers.items(), number):
                if _is_measured(tier, config, files, number):
                    if number == 0 and not tier.readable:
                        time_run(_first_photograph(run_config(config, files, tier)))  # fills caches
                    found[setting, name].append(time_run(run_config(config, files, tier)))
                progress.advance()
    return found


def _ordered(tiers: Iterable[tuple[str, AccuracyConfig]], number: int) -> list[tuple[str, AccuracyConfig]]:
    """Return the tiers in the order of a round, so that a drift within rounds cancels."""
    return list(tiers)[:: -1 if number % 2 else 1]


def _is_measured(tier: AccuracyConfig, config: Config, files: RunFiles, number: int) -> bool:
    return not tier.readable or (number == 0 and _noisy_pixels(config, files) <= REFERENCE_PIXELS)


def _first_photograph(config: Config) -> Config:
    return replace(config, source=replace(config.source, limit=1))


def run_rows(
    rounds: RunRounds, pixels: int, noises: Mapping[str, str], errors: Mapping[RunKey, NoisyError]
) -> Iterator[RunMeasurement]:
    """Yield time and error of each tier of each setting.

    Parameters
    ----------
    rounds : dict of (str, str) to list of RunTimes
        Times by setting and tier.
    pixels : int
        Number of pixels of all photographs.
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
        cost = run_cost(times, rounds[setting, EXACT], pixels)
        yield RunMeasurement(setting, noises[setting], tier, *cost, *errors[setting, tier])


class RunCost(NamedTuple):
    """The time of a tier's runs, as in `RunMeasurement`."""

    ns_per_pixel: float | None = None
    ratio_to_exact: float | None = None
    lowest_ratio: float | None = None
    highest_ratio: float | None = None
    decode_share: float | None = None
    simulate_share: float | None = None
    write_share: float | None = None


def run_cost(times: Sequence[RunTimes], exact: Sequence[RunTimes], pixels: int) -> RunCost:
    """Return the time of a tier's runs: that of the fastest, its shares, and the ratios to exact.

    Parameters
    ----------
    times, exact : sequence of RunTimes
        Times of the tier and of ``exact``, by round; the tier can have fewer rounds, or none.
    pixels : int
        Number of pixels of all photographs.

    Returns
    -------
    RunCost
        All None if the tier did not run.
    """
    if not times:
        return RunCost()
    least = min(times, key=lambda one: one.total_s)
    ratios = [one.total_s / other.total_s for one, other in zip(times, exact, strict=False)]
    ratio = least.total_s / min(one.total_s for one in exact)
    shares = [stage_s / least.total_s for stage_s in least]
    return RunCost(least.total_s / pixels * 1e9, ratio, min(ratios), max(ratios), *shares)
