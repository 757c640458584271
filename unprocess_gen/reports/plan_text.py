"""Format the estimate of a run for the verb ``plan``: sizes, time, noise, warnings, and each effect with its reason."""

from __future__ import annotations

import math
import operator
import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from unprocess_gen.config import interpretation
from unprocess_gen.config.schema import Config
from unprocess_gen.config.values import value_range
from unprocess_gen.core.fields import value_text
from unprocess_gen.planning.advice import body_sentence, warnings
from unprocess_gen.planning.effect_selection import MIN_OUTLIERS, Prediction
from unprocess_gen.reports.estimate import PlanAndPredictions, RunEstimate, SourceEstimate
from unprocess_gen.reports.formatting import byte_size, counted
from unprocess_gen.simulation.effects import BY_NAME
from unprocess_gen.simulation.facts import DarkFrames
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import MONO
from unprocess_gen.sources.listing import unmatched_sentence

Estimates = Sequence[SourceEstimate]


def format_estimate(estimate: RunEstimate, with_numbers: bool = False, with_table: bool = True) -> str:
    """Format an estimate for a terminal: lines without a final newline, with the sources of numbers on request.

    Without ``with_table``, the effects of physical profiles are a list of those that are simulated.
    """
    run, read, config = estimate.run, estimate.source_estimates, estimate.run.config
    about = "" if estimate.exact else "about "
    place = config.source.list or config.source.place or "the synthetic pictures"
    listed = f"{len(run.sources)} in {place}; {len(read)} of them read"
    per_shard = f"{counted(run.shards, 'shard')} of {config.output.pairs_per_shard}"
    size = f"about {estimate.bytes:,} in shards, {byte_size(estimate.bytes)}; {byte_size(estimate.free_bytes)} free"
    total, start, pairs = map(format_duration, (estimate.seconds, estimate.start_seconds, estimate.pair_seconds))
    levels = [level for source in read for level in source.levels]
    return "\n".join(
        [
            *_labelled("sources", [listed, unmatched_sentence(run.listing.unmatched), *run.listing.warnings]),
            *_labelled("profiles", [_profile_sentence(read)]),
            *_labelled("pairs", [f"{about}{estimate.pairs}, in {per_shard}"]),
            *_labelled("splits", [_split_sentence(config, len(run.sources))]),
            *_labelled("patches", [_patch_sentence(config, read)]),
            *_labelled("bursts", _burst_sentences(config)),
            *_labelled("targets", [", ".join(config.output.targets)]),
            *_labelled("bytes", [size + (": NOT ENOUGH" if estimate.free_bytes < estimate.bytes else "")]),
            f"time      about {total} with {counted(estimate.n_jobs, 'worker')}: start-up {start}, pairs {pairs}",
            *_failure_lines(config, read),
            *_labelled("note", (f"{source.source.name} {source.note}" for source in read if source.note)),
            *noise_lines(
                config, levels, run.settings.dark_frames, [s.noise_ratio for s in read], with_numbers, with_table
            ),
        ]
    )


_JOB_LINE = "{:>5}  {:>9}  {:>10}  {:>9}  {:34}  {}"
IN_TABLE = ("pairs ", "bytes ", "time ", "scene ", "noise ", "effect ")
"""Labels whose lines the table of jobs replaces, unless they are common."""
UNSHARED = ("bytes ", "time ")
"""Labels whose lines have measurements of each job."""


def sweep_lines(jobs: Mapping[str, RunEstimate], with_numbers: bool = False) -> list[str]:
    """Format the estimates of a sweep by job: what is common, a table of jobs, what only some of them have, totals."""
    owners: dict[str, list[int]] = {}  # of each line, with those that continue it: the numbers of its jobs
    for number, estimate in enumerate(jobs.values(), start=1):
        for block in re.split(r"\n(?=\S)", format_estimate(estimate, with_numbers, with_table=False)):
            owners.setdefault(block, []).append(number)
    everywhere = [text for text, numbers in owners.items() if len(numbers) == len(jobs)]
    common = [text for text in everywhere if not text.startswith(UNSHARED)]
    others = [
        f"{text}\n{'':10}in jobs {', '.join(map(str, numbers))}"
        for text, numbers in owners.items()
        if text not in common and not text.startswith(IN_TABLE)
    ]
    rows: list[tuple[object, ...]] = [("job", "pairs", "size", "time", "noise", "settings")]
    for number, (name, job) in enumerate(jobs.items(), start=1):
        size, time = byte_size(job.bytes), format_duration(job.seconds)
        rows.append((number, f"{job.pairs:,}", size, time, _noise_cell(job), name))
    return [*common, "", *(_JOB_LINE.format(*row) for row in rows), "", *others, totals_line(list(jobs.values()))]


def _noise_cell(estimate: RunEstimate) -> str:
    """The numbers of the noise of a job, in DN of its sensor."""
    plans = [plan for source in estimate.source_estimates for plan, _ in source.levels]
    if not plans:
        return ""
    if plans[0].physics is None:
        return f"a_dn {_range(plans, 'noise.a_dn', 4)}, b_dn2 {_range(plans, 'noise.b_dn2', 4)}"
    return f"{_range(plans, 'physics.dn_per_e', 3)} DN/e, read {_range(plans, 'physics.read_std_dn', 3)} DN"


def totals_line(estimates: Sequence[RunEstimate]) -> str:
    """Totals of a planned sweep, whose jobs run one after the other, in one line."""
    about = "" if all(job.exact for job in estimates) else "about "
    totals = [(job.pairs, job.run.shards, job.bytes, job.seconds) for job in estimates]
    pairs, shards, size, seconds = map(sum, zip(*totals, strict=True))
    made = f"{about}{pairs:,} pairs in {shards:,} shards, {about}{size:,} bytes, about {format_duration(seconds)}"
    free = f"{byte_size(estimates[-1].free_bytes)} free" + (": NOT ENOUGH" if estimates[-1].free_bytes < size else "")
    return f"totals    {len(estimates)} jobs: {made}; {free}"


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


def _profile_sentence(estimates: Estimates) -> str:
    """Count the photographs of each colour profile, and those whose colours are refused."""
    names = Counter(source.profile for source in estimates if source.profile)
    names["refused"] += sum(source.failure is not None and source.failure.reason == "icc" for source in estimates)
    return ", ".join(f"{count} {name}" for name, count in names.most_common() if count)


def _patch_sentence(config: Config, estimates: Estimates) -> str:
    """State what is cut from each image; empty for complete images."""
    rule, counts = interpretation.patch_rule(config.source), [source.patches for source in estimates if source.patches]
    if rule is None or not counts:
        return ""
    places = f"{rule.count} at random places" if rule.kind == "random" else f"a grid, {rule.stride} apart"
    return f"{rule.side} x {rule.side}, {places}: {value_range(counts)} per image"


def _burst_sentences(config: Config) -> list[str]:
    """State frames, largest motion, margin and exposures of bursts; nothing without them."""
    rule, patch = interpretation.burst_rule(config.source), interpretation.patch_rule(config.source)
    if rule is None:
        return []
    margin = f", a margin of {rule.margin(patch.side, patch.side)[0]} pixels" if patch else ""
    stops = sorted({*rule.exposures})
    exposures = ", ".join(f"{stop:g}" for stop in stops)
    above = config.source.kind == "srgb" and stops[-1] > 0
    return [
        f"{counted(rule.frames, 'frame')} at 1/{rule.downscale} of the resolution, moved by up to {rule.shift:g} "
        f"pixels and {rule.rotation_deg:g} degrees{margin}; ev {exposures}",
        "ev above 0 saturates photographs, which contain no light above white; use source.kind=linear" if above else "",
    ]


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
    config: Config,
    levels: Sequence[PlanAndPredictions],
    dark_frames: DarkFrames | None,
    noise_ratios: Sequence[float | None] = (),
    with_numbers: bool = False,
    with_table: bool = True,
) -> list[str]:
    """Scene, noise, warnings and effects of the plans of all noise levels of the sources that can be read.

    ``noise_ratios`` are the noise of each source over the simulated noise, if it is known.
    """
    plans = [plan for plan, _ in levels]
    if not plans:
        return []
    is_physical, noise = interpretation.is_physical(config.noise), plans[0].noise
    return [
        *_labelled("accuracy", [config.accuracy]),
        *_labelled("pattern", ["MONO: no colour filters" if config.sensor.pattern == MONO else ""]),
        *_labelled("body", [body_sentence(config) or config.body.name]),
        *_labelled("scene", [_scene_sentence(config, plans)]),
        *_labelled("noise", (_physical_sentences if is_physical else _line_sentences)(config, plans)),
        *_labelled("dark", [_dark_frames_sentence(config, dark_frames) if dark_frames else ""]),
        *_labelled("numbers", _number_sources(config, plans) if with_numbers else []),
        *_labelled("source", [_source_noise_sentence(config, noise_ratios)]),
        *_labelled("warning", [*warnings(config), _rounding_warning(plans)]),
        *_labelled("effects", [] if is_physical and with_table else [_simulated(plans)]),
        *_labelled("skipped", [] if is_physical else noise.skipped),
        *(_effect_table(config, [predictions for _, predictions in levels]) if is_physical and with_table else []),
    ]


def _simulated(plans: Sequence[Plan]) -> str:
    """Effects that are simulated in any of the plans."""
    return ", ".join(dict.fromkeys(effect for plan in plans for effect in plan.noise.effects))


def _range(plans: Sequence[Plan], path: str, digits: int = 6) -> str:
    """Smallest and largest value of a number of the plans: ``sensor.black_level_dn``."""
    return value_range(list(map(operator.attrgetter(path), plans)), digits)


def _scene_sentence(config: Config, plans: Sequence[Plan]) -> str:
    """The scene, and what of it the noise profile ignores."""
    scene, is_ignored = config.scene, plans[0].physics is None
    iso, seconds, celsius = (
        value_text(getattr(scene, name)) if is_ignored else _range(plans, f"physics.{name}")
        for name in ("iso", "exposure_s", "temperature_c")
    )
    ignored = f"; {config.noise.name} ignores ISO, time, temperature" if is_ignored else ""
    ratio = _range(plans, "scene.exposure_ratio", 4)
    ev = f", times 2^{_range(plans, 'scene.ev', 4)}" if config.source.kind == "linear" else ""
    return f"{scene.name}: ISO {iso}, {seconds} s, {celsius} °C, light divided by {ratio}{ev}{ignored}"


def _sensor_text(plans: Sequence[Plan]) -> str:
    """The levels of the pairs: with sensor=source those of the files."""
    black, white = (_range(plans, f"sensor.{end}_level_dn") for end in ("black", "white"))
    return f"on this sensor (black {black}, white {white})"


def _line_sentences(config: Config, plans: Sequence[Plan]) -> list[str]:
    """The numbers of a profile with two numbers, and their conversion to the sensor."""
    noise = config.noise
    black, white = (noise.black_level_dn, noise.white_level_dn) if noise.units == "dn" else (0, 1)
    numbers = "; ".join(dict.fromkeys(f"a={level.a}, b={level.b}" for level in interpretation.noise_levels(noise)))
    a_dn, b_dn2 = _range(plans, "noise.a_dn"), _range(plans, "noise.b_dn2")
    zero_dn = max((-plan.noise.b_dn2 / plan.noise.a_dn for plan in plans if plan.noise.a_dn), default=0)
    return [
        f"{noise.name}: {numbers} ({noise.units}, black {black} {noise.black}, white {white})",
        f"{_sensor_text(plans)}: a_dn {a_dn}, b_dn2 {b_dn2}; variance = a_dn·(x - black) + b_dn2",
        f"no noise up to {zero_dn:.2f} DN above black, where the variance is negative" if zero_dn > 0 else "",
    ]


def _physical_sentences(config: Config, plans: Sequence[Plan]) -> list[str]:
    """The gain and the read noise of a physical profile, and their conversion to the sensor."""
    name, black, white = config.noise.name, config.noise.black_level_dn, config.noise.white_level_dn
    assert white is not None and black is not None
    scale = value_range([plan.sensor.span_dn / (white - black) for plan in plans])
    gain, std = _range(plans, "physics.dn_per_e", 4), _range(plans, "physics.read_std_dn", 4)
    return [
        f"{name}: in DN of black {black}, white {white}; {_sensor_text(plans)} times {scale}",
        f"system gain {gain} DN per electron, read noise {std} DN standard deviation",
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
    has_remedy = config.source.kind != "raw" and config.source.burst is None
    remedy = "" if not has_remedy else f"; source.downscale={2 * config.source.downscale} averages it"
    sentence = f"the noise of {noisy} of {len(measured)} sources exceeds a fifth of the simulated noise{remedy}"
    return sentence if noisy else ""


# -------------------------------------------------------------------------------------------------------------- effects

_TABLE_LINE = "{:16}{:>13}  {:12} {:>11}  {:9}{}"


def _effect_table(config: Config, levels: Sequence[Sequence[Prediction]]) -> list[str]:
    """A line per effect: what it adds where it is strongest, the noise there, and why it is simulated or not."""
    lines = [_TABLE_LINE.format("effect", "adds", "in", "noise there", "images", "why")]
    for by_image in zip(*levels, strict=True):
        effect = BY_NAME[by_image[0].effect]
        strongest = max(by_image, key=lambda image: (image.simulated, image.outliers >= MIN_OUTLIERS, image.ratio))
        size = f"{strongest.predicted_dn:.3g} DN", strongest.statistic, f"{strongest.masking_dn:.3g} DN"
        if interpretation.missing_number(config.noise, effect.name) is not None:
            size = "", "", ""
        elif effect.has_outliers:
            size = f"{_count_text(strongest.outliers)} pixels", "outliers", ""
        images = f"{sum(image.simulated for image in by_image)} of {len(by_image)}"
        reason = _reason(strongest, config.effects.tolerance)
        if strongest.simulated and interpretation.assumed_numbers(config.noise, effect.name):
            reason += " (assumed number)"
        lines.append(_TABLE_LINE.format(effect.name, *size, images, reason).rstrip())
    return lines


def _count_text(expected: float) -> str:
    """An expected count in at most six characters."""
    return "<0.01" if 0 < expected < 0.01 else f"{expected:.3g}" if expected < 1000 else f"{expected:.0f}"


def _reason(prediction: Prediction, tolerance: float) -> str:
    is_visible = prediction.outliers >= MIN_OUTLIERS or prediction.ratio > tolerance
    if prediction.forced:
        return f"{prediction.why} (it would be visible)" if is_visible and not prediction.simulated else prediction.why
    if not prediction.simulated:
        return "too small to see"
    return prediction.kept_for or "visible"
