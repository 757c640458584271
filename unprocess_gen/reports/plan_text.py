"""Format the estimate of a run for the verb ``plan``: sizes, time, noise, and a table of effects with reasons."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence

import numpy as np

from unprocess_gen.config import interpretation
from unprocess_gen.config.bodies import body_sentence
from unprocess_gen.config.schema import BRANCH_FIELDS, Config, NoiseConfig, SourceConfig
from unprocess_gen.config.values import value_range, value_text
from unprocess_gen.core.types import DarkFrames, Patch, Plan
from unprocess_gen.planning.dark_scene import dark_scene_warning
from unprocess_gen.planning.effect_selection import MIN_OUTLIERS, Prediction
from unprocess_gen.planning.sensor_levels import sensor_warning
from unprocess_gen.reports.empty_bands import highlight_sentence
from unprocess_gen.reports.estimate import RunEstimate, SourceEstimate
from unprocess_gen.reports.formatting import byte_size, counted
from unprocess_gen.simulation.effects import BY_NAME
from unprocess_gen.simulation.effects.expectation import Site
from unprocess_gen.simulation.reference.cfa import MONO
from unprocess_gen.sources.listing import unmatched_sentence


def format_estimate(estimate: RunEstimate) -> str:
    """Format an estimate for a terminal: lines without a final newline."""
    run, read, config = estimate.run, estimate.source_estimates, estimate.run.config
    about = "" if estimate.exact else "about "
    notes = unmatched_sentence(run.listing.unmatched), *run.listing.warnings
    place = config.source.place or "the built-in scenes"
    readable = [source for source in read if source.levels]
    lines = [
        f"sources   {len(run.sources)} in {config.source.list or place}; {len(read)} of them read",
        *(f"          {note}" for note in notes if note),
        f"pairs     {about}{estimate.pairs}, in {counted(estimate.shards, 'shard')} of {config.output.pairs_per_shard}",
        *_labelled("splits", [_split_sentence(config, len(run.sources))]),
        *_patch_lines(config, read),
        *_labelled("targets", [", ".join(config.output.targets)]),
        f"bytes     about {estimate.bytes:,} in shards, {byte_size(estimate.bytes)}",
        f"disk      {byte_size(estimate.free_bytes)} free"
        + ("" if estimate.free_bytes > estimate.bytes else ": NOT ENOUGH"),
        f"time      about {format_duration(estimate.seconds)} with {counted(estimate.n_jobs, 'worker')}: start-up "
        f"{format_duration(estimate.start_seconds)}, pairs {format_duration(estimate.pair_seconds)}, disk "
        f"{format_duration(estimate.disk_seconds)}",
        *_failure_lines(config, read),
        f"accuracy  {config.accuracy}",
        *_pattern_lines(config),
        *noise_lines(config, readable, estimate.run.settings.dark_frames),
    ]
    return "\n".join(lines)


def format_duration(seconds: float) -> str:
    """Format a duration in seconds, minutes or hours, whichever reads best."""
    if seconds < 90:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _labelled(label: str, sentences: Iterable[str | None], indent: str = "") -> list[str]:
    """Wrap sentences in lines of at most 120 characters, the first one with a label; nothing without a sentence."""
    texts = [sentence for sentence in sentences if sentence]
    lines = [
        line for text in texts for line in textwrap.wrap(text, 110, subsequent_indent=indent, break_on_hyphens=False)
    ]
    return [f"{label if number == 0 else '':10}{line}" for number, line in enumerate(lines)]


def _split_sentence(config: Config, sources: int) -> str:
    """State the share of each split, and the number of sources that it leads to expect; empty without splits."""
    expected = (f"{name} {share:.4g} (about {share * sources:.0f})" for name, share in (config.split or {}).items())
    return f"{', '.join(expected)} of {sources} sources" if config.split else ""


def _patch_lines(config: Config, estimates: Sequence[SourceEstimate]) -> list[str]:
    """State what is cut from each image, and the fraction of its pixels in no patch; nothing for complete images."""
    rule, readable = interpretation.patch_rule(config.source), [source for source in estimates if source.patches]
    cropped = sum(source.unused_pixels > 0 for source in readable)
    if not readable or (rule is None and not cropped):
        return []
    unused = sum(source.unused_pixels for source in readable) / sum(source.pixels for source in readable)
    if rule is None:
        return [
            f"packed    {cropped} of {len(readable)} images have an odd side, whose last row or column is omitted: "
            f"{unused:.2%} of the pixels"
        ]
    places = f"{rule.count} at random places" if rule.kind == "random" else f"a grid, {rule.stride} apart"
    counts = value_range([source.patches for source in readable])
    return [f"patches   {rule.side} x {rule.side}, {places}: {counts} per image; {unused:.1%} of the pixels unused"]


def _pattern_lines(config: Config) -> list[str]:
    """State that a sensor has no colour filters; nothing for others."""
    is_mono = config.sensor.pattern == MONO
    return ["pattern   MONO: no colour filters; each site is the mean of the three channels"] if is_mono else []


def _failure_lines(config: Config, estimates: Sequence[SourceEstimate]) -> list[str]:
    failed = [source for source in estimates if source.status == "failed"]
    lines = [f"fails     {source.source.name}: {source.reason}\n          {source.detail}" for source in failed]
    if len(failed) > config.source.max_failed:
        lines.append(f"          more than source.max_failed={config.source.max_failed}: the run will exit with 3")
    if filtered := sum(source.status == "filtered" for source in estimates):
        lines.append(
            f"filtered  {filtered} of {len(estimates)} sources read, by source.min_side={config.source.min_side}"
        )
    return lines


# ------------------------------------------------------------------------------------------------------ scene and noise


def noise_lines(config: Config, estimates: Sequence[SourceEstimate], dark_frames: DarkFrames | None) -> list[str]:
    """Scene, noise, effects and warnings for the sources that can be read."""
    plans = [plan for source in estimates for plan in source.levels]
    if not plans:
        return []
    levels = [source.clean_levels for source in estimates if source.clean_levels]
    ratios = [source.noise_ratio for source in estimates if source.noise_ratio is not None]
    warnings = (
        dark_scene_warning(config, [plan.scene.exposure_ratio for plan in plans], levels),
        posterisation_warning(plans, levels),
        sensor_warning(config),
    )
    return [
        *_labelled("body", [_body_text(config)]),
        *_labelled("scene", [_scene_sentence(config, plans)]),
        *(_physical_lines if interpretation.is_physical(config.noise) else _two_number_lines)(config, plans),
        *_labelled("dark", [_dark_frames_sentence(config, dark_frames)] if dark_frames else []),
        *_labelled("highlight", [highlight_sentence([source.bands for source in estimates])]),
        *_labelled("source", [source_noise_sentence(ratios, averaging(config.source))]),
        *_labelled("warning", warnings),
        *effect_table(config, [level for source in estimates for level in source.predictions]),
    ]


def _body_text(config: Config) -> str:
    """Name the body and the options that it has chosen, and what is not taken from it."""
    name = config.body.name
    return body_sentence(config) or f"{name}: camera, sensor and noise of one body" if name is not None else ""


def _scene_sentence(config: Config, plans: Sequence[Plan]) -> str:
    """The scene, and what of it the noise profile ignores."""
    physics = [plan.noise.physics for plan in plans if plan.noise.physics is not None]
    scene, noise = config.scene, config.noise
    ignored = []
    if physics:
        iso, seconds, celsius = (
            value_range([getattr(numbers, name) for numbers in physics])
            for name in ("iso", "exposure_s", "temperature_c")
        )
        is_heated = any(interpretation.missing_number(noise, name) is None for name in ("dark_current", "hot_pixels"))
        ignored += ["ISO (noise.iso is used)"] if noise.iso is not None else []
        ignored += [] if is_heated else ["time", "temperature"]
    else:
        iso, seconds, celsius = map(value_text, (scene.iso, scene.exposure_s, scene.temperature_c))
        ignored = ["ISO", "time", "temperature"]
    ratio = value_range([plan.scene.exposure_ratio for plan in plans], 4)
    text = f"{plans[0].scene.name}: ISO {iso}, {seconds} s, {celsius} °C, light divided by {ratio}"
    return f"{text}; {noise.name} ignores {', '.join(ignored)}" if ignored else text


def _two_number_lines(config: Config, plans: Sequence[Plan]) -> list[str]:
    """The numbers and the effects of a profile with two numbers."""
    noise, first = config.noise, plans[0].noise
    profile_levels = (noise.black_level_dn, noise.white_level_dn) if noise.units == "dn" else (0, 1)
    numbers = "; ".join(dict.fromkeys(f"a={level.a}, b={level.b}" for level in interpretation.noise_levels(noise)))
    fitted = [plan.noise for plan in plans if "heteroscedastic" in plan.noise.effects and plan.noise.a_dn]
    zero_dn = max((-fit.b_dn2 / fit.a_dn for fit in fitted), default=0)
    below = f"no noise up to {zero_dn:.2f} DN above black, where the fitted variance is negative"
    return [
        f"noise     {noise.name}: {numbers} ({noise.units}, black {profile_levels[0]} "
        f"{noise.black}, white {profile_levels[1]})",
        f"          on this sensor ({_sensor_text(plans)}): a_dn {value_range([plan.noise.a_dn for plan in plans])}, "
        f"b_dn2 {value_range([plan.noise.b_dn2 for plan in plans])}; variance = a_dn·(x - black) + b_dn2",
        *([f"          {below}"] if zero_dn > 0 else []),
        f"effects   {', '.join(first.effects)}",
        *(f"skipped   {reason}" for reason in first.skipped),
    ]


def _sensor_text(plans: Sequence[Plan]) -> str:
    """The levels of the pairs: with sensor=source those of the files."""
    black, white = ([getattr(plan.sensor, f"{end}_level_dn") for plan in plans] for end in ("black", "white"))
    return f"black {value_range(black)}, white {value_range(white)}"


def _physical_lines(config: Config, plans: Sequence[Plan]) -> list[str]:
    """The numbers of a physical noise profile for the sources that were read, where they come from, and the effects."""
    noise = config.noise
    assert noise.white_level_dn is not None and noise.black_level_dn is not None
    physics = [plan.noise.physics for plan in plans if plan.noise.physics is not None]
    distributions = sorted({"Gaussian" if numbers.read_law == "gaussian" else "Tukey lambda" for numbers in physics})
    distribution = "dark frames" if interpretation.uses_dark_frames(noise) else ", ".join(distributions)
    gains, stds = zip(*((numbers.dn_per_e, numbers.read_std_dn) for numbers in physics), strict=True)
    scale = value_range([plan.sensor.span_dn / (noise.white_level_dn - noise.black_level_dn) for plan in plans])
    assumed = ", ".join(f"{key}={_number_text(noise, key)}" for key in noise.assumed)
    provenance = (
        f"{', '.join(origin.numbers)}: {origin.source}; uncertainty: {origin.uncertainty}"
        for origin in interpretation.provenance_at(noise, [numbers.iso for numbers in physics])
    )
    simulated = {name for plan in plans for name in plan.noise.effects}
    return [
        f"noise     {noise.name}: in DN of black {noise.black_level_dn}, white {noise.white_level_dn}; "
        f"on this sensor ({_sensor_text(plans)}) times {scale}",
        f"          system gain {value_range(gains, 4)} DN per electron, read noise {value_range(stds, 4)} DN standard "
        f"deviation ({distribution})",
        *_labelled("", [assumed and f"assumed, without a source: {assumed}", _assumed_sentence(config, plans)]),
        *_labelled("numbers", provenance, indent="  "),
        *_labelled("effects", [f"{', '.join(name for name in BY_NAME if name in simulated)}; reasons below"]),
    ]


def _assumed_sentence(config: Config, plans: Sequence[Plan]) -> str | None:
    """The largest shares of the variance of a pixel, at black and at white of the scene, due to assumed numbers."""
    if not config.noise.assumed or interpretation.uses_dark_frames(config.noise):
        return None
    shares = []
    for plan in plans:
        signals_dn = np.array([0.0, plan.sensor.span_dn * min(plan.scene.exposure, 1.0)])
        site = Site(plan, Patch(0, 0, 0, 2, 2), (0, 0))
        variances = {name: BY_NAME[name].expected(site).variance(signals_dn) for name in plan.noise.effects}
        assumed = [
            variance for name, variance in variances.items() if interpretation.assumed_numbers(config.noise, name)
        ]
        shares.append(np.sum(assumed, axis=0) / np.sum(list(variances.values()), axis=0) * np.ones(2))
    black, white = np.max(shares, axis=0)
    return f"of the variance of a pixel, {black:.0%} at black and {white:.0%} at white rest on assumed numbers"


LONGEST_CELL = 20
"""Characters of the longest assumed value that is shown."""


def _number_text(noise: NoiseConfig, key: str) -> str:
    text = value_text(getattr(noise.branches[0] if key in BRANCH_FIELDS else noise, key))
    return text if len(text) <= LONGEST_CELL else "…"


def _dark_frames_sentence(config: Config, dark_frames: DarkFrames) -> str:
    """Number, sizes, black level and noise of dark frames."""
    sizes = sorted({f"{frame.width} x {frame.height}" for frame in dark_frames.frames})
    return (
        f"{counted(len(dark_frames.frames), 'dark frame')} in {config.noise.dark_frames}: {', '.join(sizes)} pixels, "
        f"black level {dark_frames.black_dn:g} DN, standard deviation {math.sqrt(dark_frames.variance_dn2):.4g} DN"
    ) + ("" if dark_frames.scale == 1 else f" on this sensor (times {dark_frames.scale:.6g})")


POSTERISED_BELOW = 256
"""Levels between black and the white of a darkened scene below which ``plan`` warns: fewer than 8-bit codes."""


def posterisation_warning(plans: Sequence[Plan], levels: Sequence[int]) -> str | None:
    """Warn if rounded clean frames have few levels.

    The rounding error is uniform in ±½ DN, so its mean square is 1/12 DN². White of the darkened scene is
    span / exposure ratio above black. A denoiser that returned the unrounded mean would have a PSNR of
    20 log10(√12 · span / ratio).
    """
    spans_dn = [(plan.sensor.white_level_dn - plan.sensor.black_level_dn) / plan.scene.exposure_ratio for plan in plans]
    if not levels or min(spans_dn) >= POSTERISED_BELOW:
        return None
    bound = value_range([round(20 * math.log10(math.sqrt(12) * span_dn), 1) for span_dn in spans_dn])
    return (
        f"clean frames are rounded to {value_range(levels)} levels; compared with them no denoiser exceeds a PSNR of "
        f"{bound} dB (peak: white of the darkened scene); output.clean_dtype=float32 keeps the unrounded mean"
    )


NOISY_SOURCE = 0.2
"""Noise of a source, relative to the simulated noise, above which ``plan`` counts it: it adds 2 % to the total."""


def averaging(source: SourceConfig) -> str:
    """Return the setting that averages the noise of sources further; empty if none is left."""
    if source.kind == "raw":
        return f"source.shrink={2 * source.shrink}" if source.shrink < 4 else ""
    return f"source.downscale={2 * source.downscale}"


def source_noise_sentence(ratios: Sequence[float], remedy: str) -> str | None:
    """Count the sources that bring visible noise into the clean frame, and name the remedy."""
    if not ratios:
        return None
    noisy = sum(ratio > NOISY_SOURCE for ratio in ratios)
    advice = "; it stays in the clean frame" + (f": {remedy} averages it" if remedy else "") if noisy else ""
    return (
        f"the noise of {noisy} of {len(ratios)} sources exceeds a fifth of the simulated noise "
        f"({value_range(ratios, 2)} of it){advice}"
    )


# --------------------------------------------------------------------------------------------------------------- table

_TABLE_LINE = "{:16}{:>13}  {:14}{:>11}{:>10}  {:9}{:>9}  {}"


def effect_table(config: Config, predictions: Sequence[Sequence[Prediction]]) -> list[str]:
    """A line per effect: the image in which it is strongest, how often it is simulated, and why; none without effects.

    Hot and dead pixels are judged by the number of pixels that exceed the noise, other effects by their ratio to
    the noise that hides them.
    """
    lines = [_TABLE_LINE.format("effect", "adds", "seen in", "noise there", "ratio", "images", "ns/pixel", "decision")]
    for by_image in zip(*predictions, strict=True):
        effect = BY_NAME[by_image[0].effect]
        strongest = max(by_image, key=lambda image: (image.simulated, image.outliers >= MIN_OUTLIERS, image.ratio))
        size = f"{strongest.predicted_dn:.3g} DN", strongest.statistic, f"{strongest.masking_dn:.3g} DN"
        ratio = f"{strongest.ratio:.3g}" if math.isfinite(strongest.ratio) else "no noise"
        if effect.has_outliers:
            size, ratio = (f"{strongest.outliers:.3g} pixels", "outliers", ""), ""
        images = f"{sum(image.simulated for image in by_image)} of {len(by_image)}"
        decision = _decision(strongest, config.effects.tolerance)
        line = _TABLE_LINE.format(effect.name, *size, ratio, images, f"{effect.cost_ns:.1f}", decision)
        lines.append(line.rstrip())
    return lines if len(lines) > 1 else []


def _decision(prediction: Prediction, tolerance: float) -> str:
    is_visible = prediction.outliers >= MIN_OUTLIERS or prediction.ratio > tolerance
    if prediction.forced:
        return f"{prediction.why}, though it would show" if is_visible and not prediction.simulated else prediction.why
    if not prediction.simulated:
        return "too small to see"
    return "visible" if is_visible else "too much together with the omitted effects"
