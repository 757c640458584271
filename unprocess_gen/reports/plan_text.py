"""Format the estimate of a run for the verb ``plan``: sizes, time, noise, warnings, and each effect with its reason."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence

from unprocess_gen.config import interpretation
from unprocess_gen.config.schema import Config
from unprocess_gen.config.values import value_range
from unprocess_gen.core.fields import value_text
from unprocess_gen.planning.advice import body_sentence, dark_scene_warning, sensor_warning
from unprocess_gen.planning.effect_selection import MIN_OUTLIERS, Prediction
from unprocess_gen.reports.estimate import RunEstimate, SourceEstimate
from unprocess_gen.reports.formatting import byte_size, counted
from unprocess_gen.simulation.effects import BY_NAME
from unprocess_gen.simulation.facts import DarkFrames
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import MONO
from unprocess_gen.sources.listing import unmatched_sentence

Estimates = Sequence[SourceEstimate]


def format_estimate(estimate: RunEstimate, with_numbers: bool = False) -> str:
    """Format an estimate for a terminal: lines without a final newline, with the sources of numbers on request."""
    run, read, config = estimate.run, estimate.source_estimates, estimate.run.config
    about = "" if estimate.exact else "about "
    place = config.source.list or config.source.place or "the synthetic pictures"
    listed = f"{len(run.sources)} in {place}; {len(read)} of them read"
    per_shard = f"{counted(estimate.shards, 'shard')} of {config.output.pairs_per_shard}"
    size = f"about {estimate.bytes:,} in shards, {byte_size(estimate.bytes)}; {byte_size(estimate.free_bytes)} free"
    total, start, pairs = map(format_duration, (estimate.seconds, estimate.start_seconds, estimate.pair_seconds))
    return "\n".join(
        [
            *_labelled("sources", [listed, unmatched_sentence(run.listing.unmatched), *run.listing.warnings]),
            *_labelled("pairs", [f"{about}{estimate.pairs}, in {per_shard}"]),
            *_labelled("splits", [_split_sentence(config, len(run.sources))]),
            *_labelled("patches", [_patch_sentence(config, read)]),
            *_labelled("targets", [", ".join(config.output.targets)]),
            *_labelled("bytes", [size + (": NOT ENOUGH" if estimate.free_bytes < estimate.bytes else "")]),
            f"time      about {total} with {counted(estimate.n_jobs, 'worker')}: start-up {start}, pairs {pairs}",
            *_failure_lines(config, read),
            *noise_lines(config, [source for source in read if source.levels], run.settings.dark_frames, with_numbers),
        ]
    )


def totals_line(estimates: Sequence[RunEstimate]) -> str:
    """Totals of a planned sweep, whose jobs run one after the other, in one line."""
    pairs = sum(job.pairs for job in estimates)
    about = "" if all(job.exact for job in estimates) else "about "
    seconds = sum(job.seconds for job in estimates)
    return (
        f"totals    {len(estimates)} jobs: {about}{pairs:,} pairs in {sum(job.shards for job in estimates):,} shards, "
        f"{about}{sum(job.bytes for job in estimates):,} bytes, about " + format_duration(seconds)
    )


def format_duration(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours, whichever reads best."""
    if seconds < 90:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _labelled(label: str, sentences: Iterable[str | None]) -> list[str]:
    """Wrap sentences in lines of at most 120 characters, the first one with a label; nothing without a sentence."""
    texts = [sentence for sentence in sentences if sentence]
    lines = [line for text in texts for line in textwrap.wrap(text, 110, break_on_hyphens=False)]
    return [f"{label if number == 0 else '':10}{line}" for number, line in enumerate(lines)]


def _split_sentence(config: Config, sources: int) -> str:
    """State the share of each split, and the number of sources that it leads to expect; empty without splits."""
    expected = (f"{name} {share:.4g} (about {share * sources:.0f})" for name, share in (config.split or {}).items())
    return f"{', '.join(expected)} of {sources} sources" if config.split else ""


def _patch_sentence(config: Config, estimates: Estimates) -> str:
    """State what is cut from each image; empty for complete images."""
    rule, counts = interpretation.patch_rule(config.source), [source.patches for source in estimates if source.patches]
    if rule is None or not counts:
        return ""
    places = f"{rule.count} at random places" if rule.kind == "random" else f"a grid, {rule.stride} apart"
    return f"{rule.side} x {rule.side}, {places}: {value_range(counts)} per image"


def _failure_lines(config: Config, estimates: Estimates) -> list[str]:
    settings = config.source
    failures = {source.source.name: source.failure for source in estimates if source.failure is not None}
    failed = {name: failure for name, failure in failures.items() if failure.status == "failed"}
    lines = [f"fails     {name}: {failure.reason}\n          {failure.text}" for name, failure in failed.items()]
    if len(failed) > settings.max_failed:
        lines.append(f"          more than source.max_failed={settings.max_failed}: the run will exit with 3")
    if filtered := len(failures) - len(failed):
        lines.append(f"filtered  {filtered} of {len(estimates)} sources read, by source.min_side={settings.min_side}")
    return lines


# ------------------------------------------------------------------------------------------------------ scene and noise


def noise_lines(
    config: Config, estimates: Estimates, dark_frames: DarkFrames | None, with_numbers: bool = False
) -> list[str]:
    """Scene, noise, warnings and effects for the sources that can be read."""
    plans = [plan for source in estimates for plan in source.levels]
    if not plans:
        return []
    is_physical = interpretation.is_physical(config.noise)
    return [
        *_labelled("accuracy", [config.accuracy]),
        *_labelled("pattern", ["MONO: no colour filters" if config.sensor.pattern == MONO else ""]),
        *_labelled("body", [body_sentence(config) or config.body.name]),
        *_labelled("scene", [_scene_sentence(config, plans)]),
        *_labelled("noise", (_physical_sentences if is_physical else _line_sentences)(config, plans)),
        *_labelled("dark", [_dark_frames_sentence(config, dark_frames) if dark_frames else ""]),
        *_labelled("numbers", _number_sources(config, plans) if with_numbers else []),
        *_labelled("source", [_source_noise_sentence(config, [source.noise_ratio for source in estimates])]),
        *_labelled("warning", [dark_scene_warning(config), _rounding_warning(plans), sensor_warning(config)]),
        *(_effect_table if is_physical else _effect_lines)(config, estimates),
    ]


def _scene_sentence(config: Config, plans: Sequence[Plan]) -> str:
    """The scene, and what of it the noise profile ignores."""
    scene, physics = config.scene, [plan.physics for plan in plans if plan.physics is not None]
    iso, seconds, celsius = (
        value_range([getattr(numbers, name) for numbers in physics]) if physics else value_text(getattr(scene, name))
        for name in ("iso", "exposure_s", "temperature_c")
    )
    ratio = value_range([plan.scene.exposure_ratio for plan in plans], 4)
    ignored = "" if physics else f"; {config.noise.name} ignores ISO, time, temperature"
    return f"{scene.name}: ISO {iso}, {seconds} s, {celsius} °C, light divided by {ratio}{ignored}"


def _sensor_text(plans: Sequence[Plan]) -> str:
    """The levels of the pairs: with sensor=source those of the files."""
    black, white = ([getattr(plan.sensor, f"{end}_level_dn") for plan in plans] for end in ("black", "white"))
    return f"on this sensor (black {value_range(black)}, white {value_range(white)})"


def _line_sentences(config: Config, plans: Sequence[Plan]) -> list[str]:
    """The numbers of a profile with two numbers, and their conversion to the sensor."""
    noise = config.noise
    black, white = (noise.black_level_dn, noise.white_level_dn) if noise.units == "dn" else (0, 1)
    numbers = "; ".join(dict.fromkeys(f"a={level.a}, b={level.b}" for level in interpretation.noise_levels(noise)))
    a_dn, b_dn2 = ([getattr(plan.noise, name) for plan in plans] for name in ("a_dn", "b_dn2"))
    zero_dn = max((-b / a for a, b in zip(a_dn, b_dn2, strict=True) if a), default=0)
    return [
        f"{noise.name}: {numbers} ({noise.units}, black {black} {noise.black}, white {white})",
        f"{_sensor_text(plans)}: a_dn {value_range(a_dn)}, b_dn2 {value_range(b_dn2)}; variance = "
        "a_dn·(x - black) + b_dn2",
        f"no noise up to {zero_dn:.2f} DN above black, where the variance is negative" if zero_dn > 0 else "",
    ]


def _physical_sentences(config: Config, plans: Sequence[Plan]) -> list[str]:
    """The gain and the read noise of a physical profile, and their conversion to the sensor."""
    noise = config.noise
    assert noise.white_level_dn is not None and noise.black_level_dn is not None
    physics = [plan.physics for plan in plans if plan.physics is not None]
    gains, stds = ([getattr(numbers, name) for numbers in physics] for name in ("dn_per_e", "read_std_dn"))
    scale = value_range([plan.sensor.span_dn / (noise.white_level_dn - noise.black_level_dn) for plan in plans])
    return [
        f"{noise.name}: in DN of black {noise.black_level_dn}, white {noise.white_level_dn}; "
        f"{_sensor_text(plans)} times {scale}",
        f"system gain {value_range(gains, 4)} DN per electron, read noise {value_range(stds, 4)} DN standard deviation",
    ]


def _number_sources(config: Config, plans: Sequence[Plan]) -> list[str]:
    """The source and the uncertainty of each number of a physical profile, and the numbers that have no source."""
    isos = [plan.physics.iso for plan in plans if plan.physics is not None]
    sources = interpretation.provenance_at(config.noise, isos)
    stated = [f"{', '.join(each.numbers)}: {each.source}; uncertainty: {each.uncertainty}" for each in sources]
    return [*stated, f"assumed, without a source: {', '.join(config.noise.assumed) or 'none'}"]


def _dark_frames_sentence(config: Config, dark_frames: DarkFrames) -> str:
    """Number, sizes, black level and noise of dark frames."""
    sizes = sorted({f"{frame.width} x {frame.height}" for frame in dark_frames.frames})
    return (
        f"{counted(len(dark_frames.frames), 'dark frame')} in {config.noise.dark_frames}: {', '.join(sizes)} pixels, "
        f"black level {dark_frames.black_dn:g} DN, standard deviation {math.sqrt(dark_frames.variance_dn2):.4g} DN"
    ) + ("" if dark_frames.scale == 1 else f" on this sensor (times {dark_frames.scale:.6g})")


# ------------------------------------------------------------------------------------------------------------- warnings

FEW_LEVELS = 256
"""Levels between black and the white of a darkened scene below which ``plan`` warns: fewer than 8-bit codes."""

NOISY_SOURCE = 0.2
"""Noise of a source, relative to the simulated noise, above which ``plan`` counts it: it adds 2 % to the total."""


def _rounding_warning(plans: Sequence[Plan]) -> str:
    """Warn if rounded clean frames have few levels.

    The rounding error, uniform in ±½ DN, gives the unrounded mean a PSNR of 20 log10(√12 · span / exposure ratio).
    """
    span_dn = min(plan.sensor.span_dn / plan.scene.exposure_ratio for plan in plans)
    if plans[0].output.clean_normalised or span_dn >= FEW_LEVELS:
        return ""
    return (
        f"no denoiser exceeds a PSNR of {20 * math.log10(math.sqrt(12) * span_dn):.1f} dB, because clean frames are "
        f"rounded and white of the scene is {span_dn:.3g} DN above black; output.clean_dtype=float32 keeps the mean"
    )


def _source_noise_sentence(config: Config, ratios: Sequence[float | None]) -> str:
    """Count the sources that bring visible noise into the clean frame."""
    measured = [ratio for ratio in ratios if ratio is not None]
    noisy = sum(ratio > NOISY_SOURCE for ratio in measured)
    remedy = "" if config.source.kind == "raw" else f"; source.downscale={2 * config.source.downscale} averages it"
    sentence = f"the noise of {noisy} of {len(measured)} sources exceeds a fifth of the simulated noise{remedy}"
    return sentence if noisy else ""


# -------------------------------------------------------------------------------------------------------------- effects

_TABLE_LINE = "{:16}{:>13}  {:12} {:>11}  {:9}{}"


def _effect_lines(config: Config, estimates: Estimates) -> list[str]:
    """The effects of a profile with two numbers."""
    noise = estimates[0].levels[0].noise
    return [*_labelled("effects", [", ".join(noise.effects)]), *_labelled("skipped", noise.skipped)]


def _effect_table(config: Config, estimates: Estimates) -> list[str]:
    """A line per effect: what it adds where it is strongest, the noise there, and why it is simulated or not."""
    lines = [_TABLE_LINE.format("effect", "adds", "in", "noise there", "images", "why")]
    levels = [level for source in estimates for level in source.predictions]
    for by_image in zip(*levels, strict=True):
        effect = BY_NAME[by_image[0].effect]
        strongest = max(by_image, key=lambda image: (image.simulated, image.outliers >= MIN_OUTLIERS, image.ratio))
        size = f"{strongest.predicted_dn:.3g} DN", strongest.statistic, f"{strongest.masking_dn:.3g} DN"
        if interpretation.missing_number(config.noise, effect.name) is not None:
            size = "", "", ""
        elif effect.has_outliers:
            size = f"{strongest.outliers:.3g} pixels", "outliers", ""
        images = f"{sum(image.simulated for image in by_image)} of {len(by_image)}"
        reason = _reason(strongest, config.effects.tolerance)
        if strongest.simulated and interpretation.assumed_numbers(config.noise, effect.name):
            reason += " (assumed number)"
        lines.append(_TABLE_LINE.format(effect.name, *size, images, reason).rstrip())
    return lines


def _reason(prediction: Prediction, tolerance: float) -> str:
    is_visible = prediction.outliers >= MIN_OUTLIERS or prediction.ratio > tolerance
    if prediction.forced:
        return f"{prediction.why} (it would be visible)" if is_visible and not prediction.simulated else prediction.why
    if not prediction.simulated:
        return "too small to see"
    return "visible" if is_visible else "too much together with the omitted effects"
