"""Measure what each accuracy tier costs in complete runs, stage by stage, and its error against the reference.

Runs have one worker, read files and commit shards below a temporary folder. The tiers take turns, so that other
programs disturb all alike. A run counts with all processor time of the process, not with waiting for the disk. The time
of a stage is its shortest in all rounds. Errors are those of pairs on subsampled photographs, which share their random
numbers.
"""

from __future__ import annotations

import logging
import math
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from unprocess_gen.config.schema import Config, SourceConfig
from unprocess_gen.core.arrays import MOSAIC, Float
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.files import machine_error, write_file
from unprocess_gen.core.source import Source
from unprocess_gen.pipeline.generate import generate
from unprocess_gen.pipeline.pairs import PairSettings, PlannedImage, plan_pixels
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.reports.formatting import counted
from unprocess_gen.reports.pictures import picture_jpeg
from unprocess_gen.reports.timing import measure_in_turns, thread_ns
from unprocess_gen.simulation.conditions import noisy_frames
from unprocess_gen.simulation.frames import Pair
from unprocess_gen.simulation.kernels.render import render_clean
from unprocess_gen.simulation.kernels.site_patterns import forget_patterns
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import EXACT, REFERENCE, TIERS, Plan
from unprocess_gen.simulation.reference.electrons import noise_variance
from unprocess_gen.simulation.reference.sensor import in_dn
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.listing import list_photographs
from unprocess_gen.sources.loader import load_source

LOGGER = logging.getLogger("unprocess_gen")

STAGES = ("decode", "clean", "noise", "write", "run")
"""Stages of a complete run, and the run. Noise includes planning and rounding, write hashing and committing."""

ROUNDS = 7
"""Rounds of the compiled tiers; one before them fills caches."""

RUN_FILES, RUN_PIXELS = 16, 20_000_000
"""Most photographs of a run, and most pixels of its noisy frames if there are several photographs."""

MOST_REFERENCE_PIXELS = 24_000_000
"""Pixels of noisy frames above which the reference is not timed: a megapixel takes seconds and much memory."""

SAMPLES, SAMPLED_PIXELS = 8, 384 * 512
"""Photographs whose pairs are compared, and most pixels of each."""


class Measurement(NamedTuple):
    """Time and error of a stage in a tier: one row of ``accuracy.csv``. None means that a time was not measured.

    Errors are the fraction of the sites that differ, and the largest and RMS error in DN and in σ of the noise.
    """

    tier: str
    stage: str
    ns_per_pixel: float | None
    ratio_to_exact: float | None
    changed_share: float = 0.0
    max_dn: float = 0.0
    rms_dn: float = 0.0
    max_std: float = 0.0
    rms_std: float = 0.0


class RunTimes(NamedTuple):
    """Processor time of one run, ns per pixel; ``write_ns`` is what decoding and simulation leave."""

    decode_ns: float
    simulate_ns: float
    write_ns: float


@dataclass(frozen=True, slots=True)
class AccuracyReport:
    """Rows of all tiers, and what was measured."""

    rows: tuple[Measurement, ...]
    photographs: str
    noise: str
    conditions: dict[str, str]


@dataclass(frozen=True, slots=True)
class Inputs:
    """Files of the runs, as a config of sources, with their pixels.

    ``samples`` are the photographs, subsampled to a grid, because the centre would be brighter.
    """

    source: SourceConfig
    pixels: int
    samples: tuple[tuple[Photograph, Source, str], ...]


def measure_accuracy(config: Config, command: str = "") -> AccuracyReport:
    """Measure every tier, with progress on stderr; ConfigError without a photograph, MachineError without a folder."""
    try:
        temporary = tempfile.TemporaryDirectory(prefix="unprocess-gen-accuracy-")
    except OSError as error:
        raise machine_error(error, Path(tempfile.gettempdir()), "set TMPDIR to a folder with space") from error
    with temporary as name:
        inputs = select_inputs(config, Path(name))
        times = measure_runs(config, inputs, Path(name) / "dataset")
    images = {tier: plan_samples(config, tier, inputs) for tier in TIERS}
    pairs = {tier: [next(image.pairs())[2] for image in planned] for tier, planned in images.items()}
    stage_ns = {tier: stages_ns(runs, clean_share(images[tier])) for tier, runs in times.items() if runs}
    rows: list[Measurement] = []
    for tier in TIERS:
        errors = deviations(pairs[tier], pairs[REFERENCE], [image.plans[0] for image in images[REFERENCE]])
        for stage in STAGES:
            ns, exact_ns = (stage_ns[name][stage] if name in stage_ns else None for name in (tier, EXACT))
            ratio = ns / exact_ns if ns is not None and exact_ns else None  # a stage can be too short to be measured
            rows.append(Measurement(tier, stage, ns, ratio, *errors.get(stage, ())))
    conditions = {
        "command": command,
        "date": time.strftime("%Y-%m-%d %H:%M %Z"),
        "machine": platform.platform(),
        "versions": ", ".join(f"{name} {version(name)}" for name in ("unprocess_gen", "numpy", "numba", "llvmlite")),
        "settings": f"{config.sensor.bits} bits, noise {config.noise.name}, scene {config.scene.name}",
    }
    photographs = f"{counted(len(inputs.samples), 'photograph')} ({inputs.pixels / 1e6:.1f} megapixels)"
    return AccuracyReport(tuple(rows), photographs, config.noise.name, conditions)


# -------------------------------------------------------------------------------------------------------------- inputs


def select_inputs(config: Config, folder: Path) -> Inputs:
    """Select the first photographs; synthetic ones are written to ``folder``. ConfigError without one."""
    source = config.source if config.source.place is not None else _written_pictures(config.source, folder)
    listed, most_pixels = list_photographs(source).sources, RUN_PIXELS // noisy_frames(config)
    samples, pixels, limit = list[tuple[Photograph, Source, str]](), 0, 0
    for number, photo in enumerate(listed, start=1):
        with suppress(SourceError):
            sha256, photograph = load_source(source, photo, config.output.layout)
            size = photograph.srgb[..., 0].size
            if samples and pixels + size > most_pixels:
                break
            step = max(1, math.ceil(math.sqrt(size / SAMPLED_PIXELS)))
            sampled = photograph.srgb[::step, ::step].copy()  # a view would keep all pixels in memory
            samples.append((replace(photograph, srgb=sampled), photo, sha256))
            pixels, limit = pixels + size, number
        if len(samples) == RUN_FILES:
            break
    if not samples:
        raise ConfigError(
            f"source.root={source.place}: none of {len(listed)} photographs can be read with "
            f"output.layout={config.output.layout}; expected at least one"
        )
    return Inputs(replace(source, limit=limit), pixels, tuple(samples))


def _written_pictures(source: SourceConfig, folder: Path) -> SourceConfig:
    """Write synthetic pictures as JPEG, so that runs read files."""
    for picture in list_photographs(source).sources[:RUN_FILES]:
        _, photograph = load_source(replace(source, downscale=1), picture)
        write_file(folder / "photographs" / f"{picture.name}.jpg", picture_jpeg(photograph.srgb, 95))
    return replace(source, root=str(folder / "photographs"), include=("*.jpg",), clips=False)


# ---------------------------------------------------------------------------------------------------------------- times


def measure_runs(config: Config, inputs: Inputs, out: Path) -> dict[str, list[RunTimes]]:
    """Times of the runs of every tier by round; of the reference one, or none if its run would be too long."""
    is_short = inputs.pixels * noisy_frames(config) <= MOST_REFERENCE_PIXELS
    compiled = [tier for tier in TIERS if tier != REFERENCE]

    def measure(tier: str, _: int) -> RunTimes:
        times = time_run(config, inputs, tier, out)
        progress.advance()
        return times

    with Progress(len(compiled) * (ROUNDS + 1) + is_short, unit="measurement") as progress:
        times = measure_in_turns({tier: partial(measure, tier) for tier in compiled}, ROUNDS + 1)
        reference = [measure(REFERENCE, 0)] if is_short else []
    return {REFERENCE: reference} | {tier: runs[1:] for tier, runs in times.items()}


def time_run(config: Config, inputs: Inputs, tier: str, out: Path) -> RunTimes:
    """Generate a dataset with one worker, delete it, and return the processor time."""
    forget_patterns()
    level = LOGGER.level
    LOGGER.setLevel(logging.ERROR)  # progress and warnings would repeat for every run
    try:
        started = time.process_time()
        times = generate(replace(config, source=inputs.source, accuracy=tier, n_jobs=1, out=str(out))).times
        total_s = time.process_time() - started
    finally:
        LOGGER.setLevel(level)
        shutil.rmtree(out, ignore_errors=True)
    write_s = max(total_s - times.decode_s - times.simulate_s, 0.0)
    return RunTimes(*(1e9 * stage_s / inputs.pixels for stage_s in (times.decode_s, times.simulate_s, write_s)))


def stages_ns(runs: Sequence[RunTimes], clean_share: float) -> dict[str, float]:
    """Shortest time of each stage, ns per pixel; ``clean_share`` is the share of the clean frame in the simulation."""
    decode_ns, simulate_ns, write_ns = (min(stage) for stage in zip(*runs, strict=True))
    clean_ns = simulate_ns * clean_share
    stages = decode_ns, clean_ns, simulate_ns - clean_ns, write_ns, decode_ns + simulate_ns + write_ns
    return dict(zip(STAGES, stages, strict=True))


def clean_share(images: Sequence[PlannedImage]) -> float:
    """Share of the clean frames in the time of the pairs of images, from the shortest times of three rounds."""

    def time_of(work: Callable[[PlannedImage], object], _: int) -> float:
        return thread_ns(lambda: [work(image) for image in images], 1)

    works = {"clean": _clean_frame, "pairs": lambda image: list(image.pairs())}
    times = measure_in_turns({name: partial(time_of, work) for name, work in works.items()}, 3)
    return min(min(times["clean"]) / min(times["pairs"]), 1.0)


def _clean_frame(image: PlannedImage) -> object:
    plan = image.plans[0]
    if plan.accuracy == REFERENCE:
        return make_pair(image.srgb, plan.replace(physics=None, effects=("quantise",)))
    return render_clean(image.srgb, plan)


# --------------------------------------------------------------------------------------------------------------- errors


def plan_samples(config: Config, tier: str, inputs: Inputs) -> list[PlannedImage]:
    """Plan the samples in a tier as complete mosaics, with their first noise level and draw."""
    source, output = replace(config.source, patch=None), replace(config.output, layout=MOSAIC)
    settings = PairSettings.read(replace(config, source=source, output=output, accuracy=tier))
    images = [plan_pixels(settings, *sample) for sample in inputs.samples[:SAMPLES]]
    return [replace(image, plans=image.plans[:1]) for image in images]


def deviations(pairs: Sequence[Pair], reference: Sequence[Pair], plans: Sequence[Plan]) -> dict[str, list[float]]:
    """Errors by stage: last values of a `Measurement`; σ is that of shot, read and rounding noise at each site."""
    parts = []
    for pair, exact, plan in zip(pairs, reference, plans, strict=True):
        levels_dn = plan.sensor.black_level_dn, plan.sensor.white_level_dn
        clean, noisy, exact_clean, exact_noisy = (
            in_dn(frame, levels_dn).ravel() for frame in (pair.clean, pair.noisy, exact.clean, exact.noisy)
        )
        std = np.sqrt(noise_variance(exact_clean, plan) + 1 / 12)
        parts.append((clean - exact_clean, noisy - exact_noisy, std))
    clean, noisy, std = map(np.concatenate, zip(*parts, strict=True))
    errors = _deviation(noisy, noisy / std)
    return {"clean": _deviation(clean, clean / std), "noise": errors, "run": errors}


def _deviation(*errors: Float) -> list[float]:
    """The fraction of sites that differ, and the largest and RMS error, each in DN and in σ."""
    sizes = [size for error in errors for size in (float(np.abs(error).max()), float(np.sqrt(np.mean(error**2))))]
    return [np.count_nonzero(errors[0]) / errors[0].size, *sizes]
