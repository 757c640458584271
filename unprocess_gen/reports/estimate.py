"""Estimate the pairs, shards, bytes, time and effects of a run, without writing anything.

Up to `SAMPLE` evenly spaced sources are read, or all of them on request. The bytes of the shards are exact if all were
read, because the size of a pair depends only on its width, height and name.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import textwrap
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
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
from unprocess_gen.core.object_store import is_url
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import DarkFrames, Frame, Plan, Source
from unprocess_gen.dataset.shards import shard_bytes
from unprocess_gen.pipeline.progress import COMPILING
from unprocess_gen.pipeline.sizes import shards_warning, source_bytes, with_pairs_per_shard
from unprocess_gen.pipeline.storage import open_storage
from unprocess_gen.planning.dark_scene import dark_scene_warning
from unprocess_gen.planning.effect_selection import Prediction, facts_for
from unprocess_gen.planning.plan import plan_levels, plan_pairs, with_dark_frames, with_draws
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
from unprocess_gen.sources.dark_frames import DarkFolder, open_dark_frames
from unprocess_gen.sources.listing import unmatched_sentence
from unprocess_gen.sources.loader import list_photographs, load_source
from unprocess_gen.sources.patches import crop_patch, list_patches, pixels_in_none

LOGGER = logging.getLogger("unprocess_gen")

SAMPLE = 16
"""Number of sources read unless all are asked for."""

COMMIT_SECONDS = 0.045
"""Time to sync and rename a shard (``docs/design/dataset_format.md``)."""

IMPORT_SECONDS = min(time.process_time(), 3.0)
"""Time that a process needs for its imports and settings: what this one took so far, unless it did something else."""

TRIAL_BYTES = 2**24
"""Bytes written to measure the disk."""


@dataclass(frozen=True, slots=True)
class SourceEstimate:
    """Hold what one source would give, or why it fails.

    Attributes
    ----------
    source : Source
        The source.
    bytes : int
        Bytes of its pairs in a shard; 0 if it fails.
    seconds : float
        Time it took to make them.
    levels : tuple of Plan
        The plan of each noise level; empty if it fails.
    reason, detail : str or None, str
        Reason class and explanation of the failure.
    predictions : tuple of tuple of Prediction
        For each noise level, the decision about each effect of a physical profile.
    patches, pairs : int
        Number of patches and of pairs.
    pixels, unused_pixels : int
        Number of pixels, and of those that are in no patch.
    clean_levels : int
        Distinct DN in the clean frame; 0 if it is not rounded. Of several patches, in the first.
    bands : EmptyBands
        Bands of raw levels that no 8-bit code of the source reaches, in the complete image.
    noise_ratio : float or None
        Noise of the source itself relative to the simulated noise; None for built-in scenes, or if it is not known.
    """

    source: Source
    bytes: int
    seconds: float
    levels: tuple[Plan, ...]
    reason: str | None
    predictions: tuple[tuple[Prediction, ...], ...] = ()
    patches: int = 0
    pairs: int = 0
    pixels: int = 0
    unused_pixels: int = 0
    clean_levels: int = 0
    bands: EmptyBands = NO_BANDS
    noise_ratio: float | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True)
class RunEstimate:
    """Hold what a run would make.

    Attributes
    ----------
    sources, shards, pairs_per_shard, bytes : int
        Number of sources, of shards and of sources per shard, and bytes of all shards.
    exact : bool
        Whether every source was read.
    pair_seconds : float
        Time to make the pairs with ``n_jobs`` workers.
    start_seconds : float
        Time until the first pair: imports, settings, workers, and loading the kernels.
    disk_seconds : float
        Time to write the shards, at the rate of a trial.
    n_jobs : int
        Number of workers; there are no more than shards.
    free_bytes : int
        Free bytes on the disk of ``out``.
    source_estimates : tuple of SourceEstimate
        The sources that were read.
    tier_ns : dict of str to float
        Time of a pair in ns per pixel under the chosen accuracy and each tier, measured now; empty if no source is
        readable.
    unmatched : dict of str to int
        Number of files that no pattern of ``source.include`` matches, by suffix.
    warnings : tuple of str
        Sentences about the listing, such as clips of different photographs, and about too many shards.
    dark_frames : DarkFrames or None
        The dark frames from which noise is sampled.
    """

    sources: int
    shards: int
    pairs_per_shard: int
    bytes: int
    exact: bool
    pair_seconds: float
    start_seconds: float
    disk_seconds: float
    n_jobs: int
    free_bytes: int
    source_estimates: tuple[SourceEstimate, ...]
    tier_ns: dict[str, float]
    unmatched: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    dark_frames: DarkFrames | None = None

    @property
    def seconds(self) -> float:
        """Time of a run."""
        return self.start_seconds + self.pair_seconds + self.disk_seconds

    @property
    def pairs(self) -> int:
        """Number of pairs, extrapolated unless ``exact``."""
        pairs = sum(source.pairs for source in self.source_estimates)
        return pairs if self.exact else pairs * self.sources // len(self.source_estimates)


def estimate_run(
    config: Config, n_jobs: int, read_all: bool, tiers: Mapping[str, AccuracyConfig] | None = None
) -> RunEstimate:
    """Estimate a run by making the pairs of a sample of its sources.

    Parameters
    ----------
    config : Config
        Validated config.
    n_jobs : int
        Number of workers, 1 or more; the time is divided by it.
    read_all : bool
        Whether to read every source, which makes the bytes exact.
    tiers : mapping of str to AccuracyConfig, optional
        Accuracy tiers whose time is measured for comparison.

    Returns
    -------
    RunEstimate
        The estimate.

    Raises
    ------
    ConfigError
        If the sources cannot be listed.
    """
    listing = list_photographs(config.source)
    config, dark_frames, dark_folder = open_dark_frames(config)
    sources = listing.sources
    config = with_pairs_per_shard(config, sources, open_storage(config.out))
    too_many = shards_warning(config, sources)
    chosen = sources if read_all else evenly_spaced(sources, SAMPLE)
    shards = -(-len(sources) // config.output.pairs_per_shard)
    n_jobs = min(n_jobs, shards)
    start_seconds = IMPORT_SECONDS * (1 if n_jobs == 1 else 2)  # workers start after the coordinator
    start_seconds += _compile_kernels(without_dark_frames(config), (tiers or {}).values())
    estimates = tuple(estimate_source(config, source, dark_frames, dark_folder) for source in chosen)
    exact = len(chosen) == len(sources)
    size = _bytes_of_shards(estimates, len(sources), config.output.pairs_per_shard)
    return RunEstimate(
        sources=len(sources),
        shards=shards,
        pairs_per_shard=config.output.pairs_per_shard,
        bytes=size,
        exact=exact,
        pair_seconds=sum(source.seconds for source in estimates) / len(estimates) * len(sources) / n_jobs,
        start_seconds=start_seconds,
        disk_seconds=shards * COMMIT_SECONDS + size * _seconds_per_byte(_local_folder(config.out)),
        n_jobs=n_jobs,
        free_bytes=free_bytes(_local_folder(config.out)),
        source_estimates=estimates,
        tier_ns=_tier_ns(without_dark_frames(config), estimates, tiers or {}),
        unmatched=listing.unmatched,
        warnings=(*listing.warnings, *([too_many] if too_many else [])),
        dark_frames=dark_frames,
    )


def _local_folder(out: str) -> Path:
    """Return the folder in which shards are written: the temporary one if ``out`` is in an object store."""
    return Path(tempfile.gettempdir() if is_url(out) else out)


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


def _bytes_of_shards(estimates: tuple[SourceEstimate, ...], sources: int, per_shard: int) -> int:
    """Return the bytes of all shards, extrapolated unless every source was read."""
    if len(estimates) == sources:
        shards = (estimates[start : start + per_shard] for start in range(0, sources, per_shard))
        return sum(shard_bytes([source.bytes for source in shard if source.bytes]) for shard in shards)
    mean_total = sum(source.bytes for source in estimates) * sources // len(estimates)
    return mean_total + -(-sources // per_shard) * shard_bytes([0])


def estimate_source(
    config: Config,
    source: Source,
    dark_frames: DarkFrames | None = None,
    dark_folder: DarkFolder | None = None,
) -> SourceEstimate:
    """Make the pairs of one source, with the digests that a shard needs, and discard them."""
    started = time.perf_counter()
    try:
        sha256, photograph = load_source(config.source, source, config.output.layout)
    except SourceError as error:
        return SourceEstimate(source, 0, time.perf_counter() - started, (), error.reason, detail=error.text)
    identity, facts = source.stream_identity(sha256), facts_for(config, photograph.srgb, source.frames)
    planned = plan_levels(config, *identity, facts, dark_frames)
    levels, predictions = tuple(plan for plan, _ in planned), tuple(of_level for _, of_level in planned)
    plans = with_draws(config, levels, source.frame)
    if dark_frames is not None and facts is not None:
        plans = with_dark_frames(plans, dark_frames, facts)
    height, width = photograph.srgb.shape[:2]
    output = config.output
    cuts = list_patches(patch_rule(config.source), plans[0].stream_key, height, width, output.layout)
    clean: Frame | None = None
    for patch in cuts:
        for number, pair in enumerate(make_pairs(crop_patch(photograph.srgb, patch), plans, patch.origin, dark_folder)):
            clean = pair.clean if clean is None else clean
            for frame in (pair.clean, pair.noisy) if number == 0 else (pair.noisy,):
                array_xxh3(frame)
                hashlib.sha256(frame.data)
    size = source_bytes(config, source.name, height, width)
    seconds = time.perf_counter() - started
    return SourceEstimate(
        source,
        size,
        seconds,
        levels,
        None,
        predictions,
        patches=len(cuts),
        pairs=len(cuts) * len(plans),
        pixels=width * height,
        unused_pixels=pixels_in_none(cuts, height, width),
        clean_levels=_levels_in(clean),
        bands=empty_bands(photograph.srgb, levels[0]),
        noise_ratio=None if config.source.root is None else noise_ratio(photograph.srgb, levels[0]),
    )


def _levels_in(clean: Frame | None) -> int:
    """Return the number of distinct DN in a frame; 0 for a frame of floats."""
    if clean is None or clean.dtype != np.uint16:
        return 0
    return int(np.count_nonzero(np.bincount(clean.reshape(-1), minlength=2**16)))


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
    plans, *of_tiers = (
        plan_pairs(one, "0" * 64, facts=facts_for(one, srgb))
        for one in (config, *(replace(config, accuracy=tier) for tier in tiers))
    )
    own = {self_test.kernels(plan) for plan in plans}
    needed = own | {self_test.kernels(plan) for some in of_tiers for plan in some}
    missing = {kernels for kernels in needed if not self_test.are_compiled(kernels)}
    if missing:
        LOGGER.info(COMPILING)
    started = time.perf_counter()
    for _ in make_pairs(srgb, plans):
        pass
    for kernels in own:
        self_test.failures(kernels)  # a run does so before its first pair
    seconds = time.perf_counter() - started
    for kernels in missing - own:
        self_test.failures(kernels)  # records that they are compiled
    return 0.0 if own & missing else seconds


# ------------------------------------------------------------------------------------------------------------- text


def format_estimate(config: Config, estimate: RunEstimate) -> str:
    """Format an estimate for a terminal.

    Parameters
    ----------
    config : Config
        The config of the run.
    estimate : RunEstimate
        The estimate.

    Returns
    -------
    str
        Lines without a final newline.
    """
    about = "" if estimate.exact else "about "
    sampled = len(estimate.source_estimates)
    unmatched = unmatched_sentence(estimate.unmatched)
    lines = [
        f"sources   {estimate.sources} in {config.source.root or 'the built-in scenes'}; {sampled} of them read",
        *(f"          {sentence}" for sentence in (unmatched, *estimate.warnings) if sentence),
        f"pairs     {about}{estimate.pairs}, in {counted(estimate.shards, 'shard')} of {estimate.pairs_per_shard}",
        *_patch_lines(config, estimate.source_estimates),
        f"bytes     {about}{estimate.bytes:,} in shards, {byte_size(estimate.bytes)}"
        + ("" if estimate.exact else " (--all reads every source: exact)"),
        f"disk      {byte_size(estimate.free_bytes)} free"
        + ("" if estimate.free_bytes > estimate.bytes else ": NOT ENOUGH"),
        f"time      about {format_duration(estimate.seconds)} with {counted(estimate.n_jobs, 'worker')}: start-up "
        f"{format_duration(estimate.start_seconds)}, pairs {format_duration(estimate.pair_seconds)}, disk "
        f"{format_duration(estimate.disk_seconds)}",
        *_failure_lines(config, estimate.source_estimates),
        *_accuracy_lines(config.accuracy, estimate.tier_ns),
        *_noise_lines(config, estimate.source_estimates, estimate.dark_frames),
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
    if rule is None and cropped:
        fraction = sum(source.unused_pixels for source in cropped) / sum(source.pixels for source in readable)
        return [
            f"packed    {len(cropped)} of {len(readable)} images have an odd side, whose last row or column is "
            f"omitted: {fraction:.2%} of the pixels"
        ]
    if rule is None or not readable:
        return []
    places = f"{rule.count} at random places" if rule.kind == "random" else f"a grid, {rule.stride} apart"
    fraction = sum(source.unused_pixels for source in readable) / sum(source.pixels for source in readable)
    counts = value_range([source.patches for source in readable])
    return [f"patches   {rule.side} x {rule.side}, {places}: {counts} per image; {fraction:.1%} of the pixels unused"]


def _accuracy_lines(chosen: AccuracyConfig, tier_ns: dict[str, float]) -> list[str]:
    """Return the chosen budget, and its time compared with that of the tiers."""
    clean = f"clean {chosen.clean_dn:g} DN"
    if chosen.clean_dn:
        clean = f"clean within {chosen.clean_dn:g} DN, a fraction of {chosen.clean_changed_share:g} changed"
    shot = f"shot noise within {chosen.law_distance:g} (CDF)" if chosen.law_distance else "exact shot noise"
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
    exposure_ratios = [plan.exposure_ratio for plan in plans]
    warnings = dark_scene_warning(config, exposure_ratios, levels), posterisation_warning(plans, levels)
    highlights = highlight_sentence([source.bands for source in estimates if source.levels])
    lines = _labelled("scene", [scene_sentence(config, plans)])
    if is_physical(config.noise):
        predictions = [of_level for source in estimates for of_level in source.predictions]
        lines += _physical_lines(config, plans)
        lines += _labelled("dark", [] if dark_frames is None else [dark_frames_sentence(config, dark_frames)])
        lines += _labelled("effects", effect_sentences(config, predictions))
    else:
        lines += _two_number_lines(config, plans)
    lines += _labelled("highlight", [highlights] if highlights else [])
    ratios = [source.noise_ratio for source in estimates if source.noise_ratio is not None]
    lines += _labelled("source", source_noise_sentences(ratios, config.source.downscale))
    lines += _labelled("warning", [warning for warning in warnings if warning])
    return [*lines, *effect_table(config, predictions)] if is_physical(config.noise) else lines


def _labelled(label: str, sentences: Iterable[str]) -> list[str]:
    """Return sentences in lines of at most 120 characters, the first one with a label."""
    lines = [line for one in sentences for line in textwrap.wrap(one, 110, break_on_hyphens=False)]
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
        f"a_dn {value_range([plan.a_dn for plan in plans])}, b_dn2 {value_range([plan.b_dn2 for plan in plans])}",
    ]
    zero = max(
        (-plan.b_dn2 / plan.a_dn for plan in plans if "heteroscedastic" in plan.effects and plan.a_dn), default=0
    )
    if zero > 0:
        lines.append(f"          no noise up to {zero:.2f} DN above black, where the fitted variance is negative")
    lines += [f"effect    {name}: {EFFECT_REASONS[name]}" for name in first.effects]
    lines += [f"skipped   {reason}" for reason in first.skipped]
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
    physics = [plan.physics for plan in plans if plan.physics is not None]
    distributions = sorted({"Gaussian" if one.read_law == "gaussian" else "Tukey lambda" for one in physics})
    if uses_dark_frames(config.noise):
        distributions = ["dark frames"]
    scale = (sensor.white_level_dn - sensor.black_level_dn) / (noise.white_level_dn - noise.black_level_dn)
    lines = [
        f"noise     {noise.name}: in DN of black {noise.black_level_dn}, white {noise.white_level_dn}; "
        f"on this sensor (black {sensor.black_level_dn}, white {sensor.white_level_dn}) times {scale:.6g}",
        f"          system gain {value_range([one.dn_per_e for one in physics], 4)} DN per electron, read noise "
        f"{value_range([one.read_std_dn for one in physics], 4)} DN standard deviation ({', '.join(distributions)})",
    ]
    if noise.assumed:
        lines += _labelled("", [f"assumed, without a source: {', '.join(noise.assumed)}"])
    return [*lines, *_provenance_lines(config, [one.iso for one in physics])]


def _provenance_lines(config: Config, isos: list[float]) -> list[str]:
    """Return where the numbers of a physical profile come from, and their uncertainty, at the ISOs that occur."""
    lines = [
        line
        for one in provenance_at(config.noise, isos)
        for line in textwrap.wrap(
            f"{', '.join(one.numbers)}: {one.source}; uncertainty: {one.uncertainty}", 108, subsequent_indent="  "
        )
    ]
    return [f"{'' if number else 'numbers':9} {line}" for number, line in enumerate(lines)]
