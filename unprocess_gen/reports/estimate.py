"""Estimate the pairs, shards, bytes, time and effects of a run, without writing anything.

The pairs of up to `SAMPLE` evenly spaced sources are made, or those of all on request. Bytes follow from the headers of
all sources, because the size of a pair depends only on its width, height and name; they are exact if all were read.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import textwrap
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from unprocess_gen.config.interpretation import (
    is_physical,
    noise_levels,
    patch_rule,
    provenance_at,
    uses_dark_frames,
    without_dark_frames,
)
from unprocess_gen.config.schema import AccuracyConfig, Config
from unprocess_gen.config.values import value_range
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.files import array_xxh3, free_bytes
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import DarkFrames, Frame, Plan, Source
from unprocess_gen.dataset.shards import shard_bytes
from unprocess_gen.pipeline.pairs import PairSettings, plan_pixels
from unprocess_gen.pipeline.progress import COMPILING, with_bar
from unprocess_gen.pipeline.run import Run, resolve
from unprocess_gen.pipeline.sizes import SAMPLE as SIZE_SAMPLE
from unprocess_gen.pipeline.sizes import estimate_shards, shards_warning, source_bytes
from unprocess_gen.planning.dark_scene import dark_scene_warning
from unprocess_gen.planning.effect_selection import Prediction, facts_for
from unprocess_gen.planning.plan import plan_levels, plan_pairs
from unprocess_gen.planning.sensor_levels import sensor_warning
from unprocess_gen.planning.source_noise import noise_ratio
from unprocess_gen.reports.benchmark.measure import measure_tier_times
from unprocess_gen.reports.effect_summary import (
    dark_frames_sentence,
    effect_sentences,
    effect_table,
    posterisation_warning,
    scene_sentence,
    source_noise_sentences,
)
from unprocess_gen.reports.empty_bands import NONE as NO_BANDS
from unprocess_gen.reports.empty_bands import EmptyBands, empty_bands, highlight_sentence
from unprocess_gen.reports.formatting import byte_size, counted
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.pair import make_pairs
from unprocess_gen.sources.listing import unmatched_sentence
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import pixels_in_none

LOGGER = logging.getLogger("unprocess_gen")

SAMPLE = 8
"""Number of sources of which pairs are made, unless all are asked for."""

HEADER_BYTES = 2**31
"""Bytes of the files whose headers are read, at most; of more, evenly spaced ones are read."""

SLOW_TIER = "reference"
"""The tier that is not timed for comparison."""

COMMIT_SECONDS = 0.045
"""Time to sync and rename a shard (``docs/design/dataset_format.md``)."""

IMPORT_SECONDS = min(time.process_time(), 3.0)
"""Time that a process needs for its imports and settings: what this one took so far, unless it did something else."""

TRIAL_BYTES = 2**24
"""Bytes written to measure the disk."""


@dataclass(frozen=True, slots=True)
class SourceEstimate:
    """The pairs of a source, or why it fails.

    ``bytes`` are those of its pairs in a shard, ``seconds`` the time it took to make them. ``levels`` and
    ``predictions`` have an item for each noise level. ``unused_pixels`` are in no patch. ``clean_levels`` counts the
    distinct DN of the first clean frame, 0 if it is not rounded. ``noise_ratio`` compares the noise of the source with
    the simulated noise; None if it is not known.
    """

    source: Source
    seconds: float
    bytes: int = 0
    levels: tuple[Plan, ...] = ()
    reason: str | None = None
    detail: str = ""
    predictions: tuple[tuple[Prediction, ...], ...] = ()
    patches: int = 0
    pairs: int = 0
    pixels: int = 0
    unused_pixels: int = 0
    clean_levels: int = 0
    bands: EmptyBands = NO_BANDS
    noise_ratio: float | None = None


@dataclass(frozen=True, slots=True)
class RunEstimate:
    """The size and time of a run, and the sources that were read.

    ``start_seconds`` is the time until the first pair: imports, settings, workers, and loading the kernels.
    ``pair_seconds`` is the time to make the pairs with ``n_jobs`` workers, ``disk_seconds`` to write the shards.
    ``tier_ns`` holds the time of a pair in ns per pixel under the chosen accuracy and other tiers, measured now.
    """

    run: Run
    n_jobs: int
    source_estimates: tuple[SourceEstimate, ...]
    headers: int
    bytes: int
    free_bytes: int
    start_seconds: float
    pair_seconds: float
    disk_seconds: float
    tier_ns: dict[str, float]

    @property
    def exact(self) -> bool:
        """True if every source was read."""
        return len(self.source_estimates) == len(self.run.sources)

    @property
    def shards(self) -> int:
        """Number of shards."""
        return len(self.run.tasks())

    @property
    def seconds(self) -> float:
        """Time of a run."""
        return self.start_seconds + self.pair_seconds + self.disk_seconds

    @property
    def pairs(self) -> int:
        """Number of pairs, extrapolated unless ``exact``."""
        pairs = sum(source.pairs for source in self.source_estimates)
        return pairs if self.exact else pairs * len(self.run.sources) // len(self.source_estimates)


def estimate_run(
    config: Config, n_jobs: int, read_all: bool, tiers: Mapping[str, AccuracyConfig] | None = None
) -> RunEstimate:
    """Estimate a run by making the pairs of a sample of its sources, or of all; the time is divided by ``n_jobs``.

    ``tiers`` are accuracy tiers whose time is measured for comparison.
    """
    run = resolve(config)
    config, sources, tasks = run.config, run.sources, run.tasks()
    quick = {name: tier for name, tier in (tiers or {}).items() if name != SLOW_TIER}
    n_jobs = min(n_jobs, len(tasks))
    start_seconds = IMPORT_SECONDS * (1 if n_jobs == 1 else 2)  # workers start after the coordinator
    start_seconds += _compile_kernels(without_dark_frames(config), quick.values())
    sample = sources if read_all else evenly_spaced(sources, SAMPLE)
    estimates = tuple(estimate_source(run.settings, source) for source in with_bar(sample, "photograph"))
    if len(sample) == len(sources):
        headers, size = 0, _bytes_of_shards(estimates, config.output.pairs_per_shard)
    else:
        headers = _headers_read(config, sources)
        size = estimate_shards(config, tasks, headers).total
    folder = any_path(config.out).scratch_place("")[0]
    sampled_bytes = sum(source.bytes for source in estimates)
    growth = size / sampled_bytes if sampled_bytes and headers else len(sources) / len(sample)
    return RunEstimate(
        run,
        n_jobs,
        estimates,
        headers,
        size,
        free_bytes=free_bytes(folder),
        start_seconds=start_seconds,
        pair_seconds=sum(source.seconds for source in estimates) * growth / n_jobs,
        disk_seconds=len(tasks) * COMMIT_SECONDS + size * _seconds_per_byte(folder),
        tier_ns=_tier_ns(without_dark_frames(config), estimates, quick),
    )


def _headers_read(config: Config, sources: Sequence[Source]) -> int:
    """Return the number of sources whose headers are read: all, as long as their files have `HEADER_BYTES`."""
    if config.source.root is not None and not isinstance(any_path(config.source.root), Path):
        return SIZE_SAMPLE
    mean_bytes = sum(source.size_bytes or 0 for source in sources) // len(sources)
    return min(len(sources), max(SIZE_SAMPLE, HEADER_BYTES // max(mean_bytes, 1)))


def _seconds_per_byte(out: Path) -> float:
    """Return the time to write and sync a byte on the disk of ``out``, measured with a file without a name.

    0 if the folder cannot be written.
    """
    folder = next(path for path in (out.absolute(), *out.absolute().parents) if path.is_dir())
    try:
        with tempfile.TemporaryFile(dir=folder) as trial:
            started = time.perf_counter()
            trial.write(bytes(TRIAL_BYTES))
            trial.flush()
            os.fsync(trial.fileno())
            return (time.perf_counter() - started) / TRIAL_BYTES
    except OSError:
        return 0.0


def _bytes_of_shards(estimates: tuple[SourceEstimate, ...], per_shard: int) -> int:
    """Return the bytes of all shards from those of every source."""
    shards = (estimates[start : start + per_shard] for start in range(0, len(estimates), per_shard))
    return sum(shard_bytes([source.bytes for source in shard if source.bytes]) for shard in shards)


def estimate_source(settings: PairSettings, source: Source) -> SourceEstimate:
    """Make the pairs of one source, with the digests that a shard needs, and discard them."""
    config, started = settings.config, time.perf_counter()
    try:
        sha256, photograph = load_source(config.source, source, config.output.layout)
    except SourceError as error:
        return SourceEstimate(source, time.perf_counter() - started, reason=error.reason, detail=error.text)
    image = plan_pixels(settings, photograph.srgb, source, sha256)
    planned = plan_levels(config, *source.stream_identity(sha256), image.facts, settings.dark_frames)
    levels, predictions = tuple(plan for plan, _ in planned), tuple(chosen for _, chosen in planned)
    height, width = photograph.srgb.shape[:2]
    clean: Frame | None = None
    for _, plan, pair in image.pairs():
        clean = pair.clean if clean is None else clean
        for frame in (pair.clean, pair.noisy) if plan is image.plans[0] else (pair.noisy,):
            array_xxh3(frame)
            hashlib.sha256(frame.data)
    return SourceEstimate(
        source,
        time.perf_counter() - started,
        source_bytes(config, source.name, height, width),
        levels,
        predictions=predictions,
        patches=len(image.patches),
        pairs=len(image.patches) * len(image.plans),
        pixels=width * height,
        unused_pixels=pixels_in_none(image.patches, height, width),
        clean_levels=_count_levels(clean),
        bands=empty_bands(photograph.srgb, levels[0]),
        noise_ratio=None if config.source.root is None else noise_ratio(photograph.srgb, levels[0]),
    )


def _count_levels(clean: Frame | None) -> int:
    """Return the number of distinct DN in a frame; 0 for a frame of floats."""
    if clean is None or clean.dtype != np.uint16:
        return 0
    return int(np.count_nonzero(np.bincount(clean.reshape(-1))))


def _tier_ns(
    config: Config, estimates: tuple[SourceEstimate, ...], tiers: Mapping[str, AccuracyConfig]
) -> dict[str, float]:
    """Measure the time of each tier on the first readable source."""
    for estimate in estimates:
        if estimate.levels:
            return measure_tier_times(config, dict(tiers), load_source(config.source, estimate.source)[1].srgb)
    return {}


def _compile_kernels(config: Config, tiers: Iterable[AccuracyConfig]) -> float:
    """Make pairs of a tiny image, so that the time of the first source does not include compilation.

    Logs first that kernels will be compiled, those of the tiers included, because it takes up to 20 seconds. Return the
    seconds that a run spends on its kernels, 0 if they had to be compiled: a run then only loads them.
    """
    srgb = np.zeros((2, 2, 3), dtype=np.uint8)
    configs = (config, *(replace(config, accuracy=tier) for tier in tiers))
    plans = [plan_pairs(other, "0" * 64, facts=facts_for(other, srgb)) for other in configs]
    needed = [{self_test.kernels(plan) for plan in group} for group in plans]
    missing = {kernels for kernels in set().union(*needed) if not self_test.are_compiled(kernels)}
    if missing:
        LOGGER.info(COMPILING)
    started = time.perf_counter()
    for _ in make_pairs(srgb, plans[0]):
        pass
    for kernels in needed[0]:
        self_test.failures(kernels)  # a run does so before its first pair
    seconds = time.perf_counter() - started
    for kernels in missing - needed[0]:
        self_test.failures(kernels)  # records that they are compiled
    return 0.0 if needed[0] & missing else seconds


# ------------------------------------------------------------------------------------------------------------- text


def format_estimate(config: Config, estimate: RunEstimate) -> str:
    """Format an estimate for a terminal: lines without a final newline."""
    run, read = estimate.run, estimate.source_estimates
    about = "" if estimate.exact else "about "
    per_shard = run.config.output.pairs_per_shard
    notes = unmatched_sentence(run.listing.unmatched), *run.listing.warnings, shards_warning(run.config, run.sources)
    basis = "" if estimate.exact else f", from {estimate.headers} headers (--all reads every source: exact)"
    lines = [
        f"sources   {len(run.sources)} in {config.source.root or 'the built-in scenes'}; {len(read)} of them read",
        *(f"          {note}" for note in notes if note),
        f"pairs     {about}{estimate.pairs}, in {counted(estimate.shards, 'shard')} of {per_shard}",
        *_patch_lines(config, read),
        f"bytes     {about}{estimate.bytes:,} in shards, {byte_size(estimate.bytes)}{basis}",
        f"disk      {byte_size(estimate.free_bytes)} free"
        + ("" if estimate.free_bytes > estimate.bytes else ": NOT ENOUGH"),
        f"time      about {format_duration(estimate.seconds)} with {counted(estimate.n_jobs, 'worker')}: start-up "
        f"{format_duration(estimate.start_seconds)}, pairs {format_duration(estimate.pair_seconds)}, disk "
        f"{format_duration(estimate.disk_seconds)}",
        *_failure_lines(config, read),
        *_accuracy_lines(config.accuracy, estimate.tier_ns),
        *_noise_lines(config, read, run.settings.dark_frames),
    ]
    return "\n".join(lines)


def format_duration(seconds: float) -> str:
    """Return a duration in seconds, minutes or hours, whichever reads best."""
    if seconds < 90:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _patch_lines(config: Config, estimates: tuple[SourceEstimate, ...]) -> list[str]:
    """Return what is cut from each image and the fraction of its pixels in no patch; nothing for complete images."""
    rule, readable = patch_rule(config.source), [source for source in estimates if source.patches]
    cropped = [source for source in readable if source.unused_pixels]
    if not readable or (rule is None and not cropped):
        return []
    unused = sum(source.unused_pixels for source in readable) / sum(source.pixels for source in readable)
    if rule is None:
        return [
            f"packed    {len(cropped)} of {len(readable)} images have an odd side, whose last row or column is "
            f"omitted: {unused:.2%} of the pixels"
        ]
    places = f"{rule.count} at random places" if rule.kind == "random" else f"a grid, {rule.stride} apart"
    counts = value_range([source.patches for source in readable])
    return [f"patches   {rule.side} x {rule.side}, {places}: {counts} per image; {unused:.1%} of the pixels unused"]


def _accuracy_lines(chosen: AccuracyConfig, tier_ns: dict[str, float]) -> list[str]:
    """Return the chosen budget, and its time compared with that of the tiers."""
    clean = f"clean {chosen.clean_dn:g} DN"
    if chosen.clean_dn:
        clean = f"clean within {chosen.clean_dn:g} DN, a fraction of {chosen.clean_changed_share:g} changed"
    shot = (
        f"shot noise within {chosen.law_distance:g} (CDF)"
        if chosen.law_distance and chosen.normal_shot
        else "exact shot noise"
    )
    line = f"accuracy  {chosen.name}: {clean}, normals within {chosen.normal_error:g} σ, {shot}"
    if chosen.name not in tier_ns:
        return [line]
    others = ", ".join(f"{name} {ns:.3g}" for name, ns in tier_ns.items() if name != chosen.name)
    return [f"{line}; {tier_ns[chosen.name]:.3g} ns per pixel here" + (f" ({others})" if others else "")]


def _failure_lines(config: Config, estimates: tuple[SourceEstimate, ...]) -> list[str]:
    failed = [source for source in estimates if source.reason is not None]
    lines = [f"fails     {source.source.name}: {source.reason}\n          {source.detail}" for source in failed]
    if len(failed) > config.source.max_failed:
        lines.append(f"          more than source.max_failed={config.source.max_failed}: the run will exit with 3")
    return lines


def _noise_lines(config: Config, estimates: tuple[SourceEstimate, ...], dark_frames: DarkFrames | None) -> list[str]:
    plans = [plan for source in estimates for plan in source.levels]
    if not plans:
        return []
    levels = [source.clean_levels for source in estimates if source.clean_levels]
    exposure_ratios = [plan.scene.exposure_ratio for plan in plans]
    warnings = (
        dark_scene_warning(config, exposure_ratios, levels),
        posterisation_warning(plans, levels),
        sensor_warning(config),
    )
    highlights = highlight_sentence([source.bands for source in estimates if source.levels])
    lines = _labelled("scene", [scene_sentence(config, plans)])
    if is_physical(config.noise):
        predictions = [level for source in estimates for level in source.predictions]
        lines += _physical_lines(config, plans)
        lines += _labelled("dark", [] if dark_frames is None else [dark_frames_sentence(config, dark_frames)])
        lines += _labelled("effects", effect_sentences(config, predictions))
    else:
        lines += _two_number_lines(config, plans)
    lines += _labelled("highlight", [highlights] if highlights else [])
    ratios = [source.noise_ratio for source in estimates if source.noise_ratio is not None]
    lines += _labelled("source", source_noise_sentences(ratios, config.source.downscale))
    lines += _labelled("warning", [warning for warning in warnings if warning])
    return lines + (effect_table(config, predictions) if is_physical(config.noise) else [])


def _labelled(label: str, sentences: Iterable[str]) -> list[str]:
    """Return sentences in lines of at most 120 characters, the first one with a label."""
    lines = [line for sentence in sentences for line in textwrap.wrap(sentence, 110, break_on_hyphens=False)]
    return [f"{label if number == 0 else '':10}{line}" for number, line in enumerate(lines)]


def _two_number_lines(config: Config, plans: list[Plan]) -> list[str]:
    """Return the numbers and the effects of a profile with two numbers."""
    sensor, noise, first = config.sensor, config.noise, plans[0]
    profile_levels = (noise.black_level_dn, noise.white_level_dn) if noise.units == "dn" else (0, 1)
    numbers = "; ".join(dict.fromkeys(f"a={level.a}, b={level.b}" for level in noise_levels(noise)))
    lines = [
        f"noise     {noise.name}: {numbers} ({noise.units}, black {profile_levels[0]} "
        f"{noise.black}, white {profile_levels[1]})",
        f"          on this sensor (black {sensor.black_level_dn}, white {sensor.white_level_dn}): "
        f"a_dn {value_range([plan.noise.a_dn for plan in plans])}, "
        f"b_dn2 {value_range([plan.noise.b_dn2 for plan in plans])}",
    ]
    fitted = [plan.noise for plan in plans if "heteroscedastic" in plan.noise.effects and plan.noise.a_dn]
    zero = max((-noise.b_dn2 / noise.a_dn for noise in fitted), default=0)
    if zero > 0:
        lines.append(f"          no noise up to {zero:.2f} DN above black, where the fitted variance is negative")
    lines += [f"effect    {name}: {EFFECT_REASONS[name]}" for name in first.noise.effects]
    lines += [f"skipped   {reason}" for reason in first.noise.skipped]
    return lines


EFFECT_REASONS = {
    "heteroscedastic": "on; shot and read noise together, variance = a_dn·(x - black) + b_dn2",
    "quantise": "on; integer output is always rounded and clipped",
}
"""Why each effect of a two-parameter profile is simulated."""


def _physical_lines(config: Config, plans: list[Plan]) -> list[str]:
    """Return the scene and the numbers of a physical noise profile for the sources that were read."""
    sensor, noise = config.sensor, config.noise
    assert noise.white_level_dn is not None and noise.black_level_dn is not None
    physics = [plan.noise.physics for plan in plans if plan.noise.physics is not None]
    distributions = sorted({"Gaussian" if numbers.read_law == "gaussian" else "Tukey lambda" for numbers in physics})
    if uses_dark_frames(config.noise):
        distributions = ["dark frames"]
    gains, stds = zip(*((numbers.dn_per_e, numbers.read_std_dn) for numbers in physics), strict=True)
    scale = (sensor.white_level_dn - sensor.black_level_dn) / (noise.white_level_dn - noise.black_level_dn)
    lines = [
        f"noise     {noise.name}: in DN of black {noise.black_level_dn}, white {noise.white_level_dn}; "
        f"on this sensor (black {sensor.black_level_dn}, white {sensor.white_level_dn}) times {scale:.6g}",
        f"          system gain {value_range(gains, 4)} DN per electron, read noise {value_range(stds, 4)} DN standard "
        f"deviation ({', '.join(distributions)})",
    ]
    if noise.assumed:
        lines += _labelled("", [f"assumed, without a source: {', '.join(noise.assumed)}"])
    return [*lines, *_provenance_lines(config, [numbers.iso for numbers in physics])]


def _provenance_lines(config: Config, isos: list[float]) -> list[str]:
    """Return where the numbers of a physical profile come from, and their uncertainty, at the ISOs that occur."""
    lines: list[str] = []
    for origin in provenance_at(config.noise, isos):
        text = f"{', '.join(origin.numbers)}: {origin.source}; uncertainty: {origin.uncertainty}"
        lines += textwrap.wrap(text, 108, subsequent_indent="  ")
    return [f"{'' if number else 'numbers':9} {line}" for number, line in enumerate(lines)]
