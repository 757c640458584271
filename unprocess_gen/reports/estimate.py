"""What a run would make, told before it: pairs, shards, bytes, time, effects and why. Writes nothing.

Reads `SAMPLE` photographs spread over the listing, or all of them; the bytes of the shards are exact when all were
read, since a pair's size depends on its width, height and name alone.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unprocess_gen.config.interpretation import is_physical, noise_levels, patch_rule
from unprocess_gen.config.schema import AccuracyConfig, Config
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Plan, Source
from unprocess_gen.dataset.manifest import json_size
from unprocess_gen.dataset.shards import form_of, image_bytes, shard_bytes
from unprocess_gen.planning.effect_selection import COST_NS, Prediction, facts_for
from unprocess_gen.planning.plan import plan_levels, plan_pairs, with_draws
from unprocess_gen.reports.benchmark import measure as accuracy
from unprocess_gen.simulation.pair import make_pairs
from unprocess_gen.sources.loader import list_photographs, load_source
from unprocess_gen.sources.patches import crop_patch, list_patches, pixels_in_none

SAMPLE = 16


@dataclass(frozen=True, slots=True)
class SourceEstimate:
    """What one photograph would give: the bytes of its pairs (0 where it fails), the time, the plans of its
    noise levels or the reason.

    ``predictions``: what was decided about each effect of a physical profile, and why. ``patches`` and ``pairs`` are
    how many it gives, ``pixels`` and ``left_out`` how many it has and how many of them lie in no patch; ``complaint``
    says more of the reason.
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
    left_out: int = 0
    complaint: str = ""


@dataclass(frozen=True, slots=True)
class RunEstimate:
    """What a run would make; ``exact`` where every photograph was read.

    ``prices``: what a pair costs under the chosen accuracy and every tier, nanoseconds a pixel, measured just now;
    empty where no photograph could be read.
    """

    sources: int
    shards: int
    bytes: int
    exact: bool
    seconds: float
    n_jobs: int
    free_bytes: int
    looks: tuple[SourceEstimate, ...]
    prices: dict[str, float]


def estimate_run(
    config: Config, n_jobs: int, read_all: bool, tiers: Mapping[str, AccuracyConfig] | None = None
) -> RunEstimate:
    """Look at the photographs of a run; ``n_jobs`` is what the time is divided by, ``tiers`` what is priced beside it.

    Raises ConfigError as `photographs.list_photographs` does.
    """
    sources = list_photographs(config.source).sources
    chosen = sources if read_all else evenly_spaced(sources, SAMPLE)
    _warm_up(config)
    looks = tuple(estimate_source(config, source) for source in chosen)
    exact = len(chosen) == len(sources)
    per_shard = config.output.pairs_per_shard
    shards = -(-len(sources) // per_shard)
    if exact:
        shard_looks = (looks[at : at + per_shard] for at in range(0, len(looks), per_shard))
        total = sum(shard_bytes([one.bytes for one in shard if one.bytes]) for shard in shard_looks)
    else:
        total = sum(one.bytes for one in looks) * len(sources) // len(looks) + shards * shard_bytes([0])
    seconds = sum(one.seconds for one in looks) / len(looks) * len(sources) / n_jobs
    free = shutil.disk_usage(_existing(Path(config.out))).free
    prices = _prices(config, looks, tiers or {})
    return RunEstimate(len(sources), shards, total, exact, seconds, n_jobs, free, looks, prices)


def estimate_source(config: Config, source: Source) -> SourceEstimate:
    """Make the pairs of one photograph, with the digests that its shard takes, and throw them away."""
    started = time.perf_counter()
    try:
        sha256, photograph = load_source(config.source, source, config.output.layout)
    except SourceError as error:
        return SourceEstimate(source, 0, time.perf_counter() - started, (), error.reason, complaint=error.text)
    identity, facts = source.stream_identity(sha256), facts_for(config, photograph.srgb, source.frames)
    told = plan_levels(config, *identity, facts)
    levels, predictions = tuple(plan for plan, _ in told), tuple(of_level for _, of_level in told)
    plans = with_draws(config, levels, source.frame)
    height, width = photograph.srgb.shape[:2]
    output = config.output
    cuts = list_patches(patch_rule(config.source), plans[0].stream_key, height, width, output.layout)
    for patch in cuts:
        for number, pair in enumerate(make_pairs(crop_patch(photograph.srgb, patch), plans, patch.origin)):
            for frame in (pair.clean, pair.noisy) if number == 0 else (pair.noisy,):
                array_xxh3(frame)
                hashlib.sha256(frame.data)
    json_bytes = json_size(source.name, len(plans))
    forms = (form_of(output.dtype, output.layout, patch.height, patch.width) for patch in cuts)
    size = sum(image_bytes(form, json_bytes, len(plans)) for form in forms)
    seconds = time.perf_counter() - started
    pixels, left_out = width * height, pixels_in_none(cuts, height, width)
    pairs = len(cuts) * len(plans)
    return SourceEstimate(source, size, seconds, levels, None, predictions, len(cuts), pairs, pixels, left_out)


def _prices(config: Config, looks: tuple[SourceEstimate, ...], tiers: Mapping[str, AccuracyConfig]) -> dict[str, float]:
    """Measure what accuracy costs on the first photograph that can be read."""
    for one in looks:
        if one.levels:
            return accuracy.measure_tier_times(config, dict(tiers), load_source(config.source, one.source)[1].srgb)
    return {}


def _warm_up(config: Config) -> None:
    """Have the machine code ready, so that its compilation is not taken for the price of an image."""
    srgb = np.zeros((2, 2, 3), dtype=np.uint8)
    for _ in make_pairs(srgb, plan_pairs(config, "0" * 64, facts=facts_for(config, srgb))):
        pass


def _existing(path: Path) -> Path:
    path = Path(os.path.abspath(path))
    return path if path.exists() else _existing(path.parent)


# -------------------------------------------------------------------------------------------------------- for people


def format_estimate(config: Config, told: RunEstimate) -> str:
    """Return the forecast as lines for a terminal."""
    about = "" if told.exact else "about "
    lines = [
        f"sources   {told.sources} ({config.source.root or 'built-in scenes'}), {len(told.looks)} of them read",
        f"pairs     {_pairs(told)}, in {told.shards} shards of {config.output.pairs_per_shard}",
        *_patches(config, told.looks),
        f"bytes     {about}{told.bytes:,} in shards" + ("" if told.exact else " (--all reads every source: exact)"),
        f"disk      {told.free_bytes:,} bytes free" + ("" if told.free_bytes > told.bytes else ": NOT ENOUGH"),
        f"time      about {_duration(told.seconds)} with {told.n_jobs} worker{'s' if told.n_jobs > 1 else ''}, "
        "and what the disk takes to write it",
        *_failures(config, told),
        *_accuracy(config.accuracy, told.prices),
        *_noise(config, told.looks),
    ]
    return "\n".join(lines)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _pairs(told: RunEstimate) -> str:
    pairs = sum(one.pairs for one in told.looks)
    return str(pairs) if told.exact else f"about {pairs * told.sources // len(told.looks)}"


def _patches(config: Config, looks: tuple[SourceEstimate, ...]) -> list[str]:
    """Return what is cut out of an image and how much of it is in no patch; nothing where images stay whole."""
    law, cut_up = patch_rule(config.source), [one for one in looks if one.patches]
    odd = [one for one in cut_up if one.left_out]
    if law is None and odd:
        share = sum(one.left_out for one in odd) / sum(one.pixels for one in cut_up)
        return [f"packed    {len(odd)} of {len(cut_up)} images have an odd side, whose last row or column is left out: "
                f"{share:.2%} of the pixels"]  # fmt: skip
    if law is None or not cut_up:
        return []
    places = f"{law.count} at random places" if law.kind == "random" else f"a grid, {law.stride} apart"
    left_out = sum(one.left_out for one in cut_up) / sum(one.pixels for one in cut_up)
    counts = _span([one.patches for one in cut_up])
    return [f"patches   {law.side} x {law.side}, {places}: {counts} an image; {left_out:.1%} of the pixels are in none"]


def _accuracy(chosen: AccuracyConfig, prices: dict[str, float]) -> list[str]:
    """Return what is asked for, and its price beside that of the tiers."""
    clean = f"clean {chosen.clean_dn:g} DN"
    if chosen.clean_dn:
        clean = f"clean within {chosen.clean_dn:g} DN at a share of {chosen.clean_changed_share:g}"
    laws = f"laws within {chosen.law_distance:g}" if chosen.law_distance else "exact laws"
    line = f"accuracy  {chosen.name}: {clean}, normals {chosen.normal_error:g} σ, {laws}"
    if chosen.name not in prices:
        return [line]
    others = ", ".join(f"{name} {ns:.3g}" for name, ns in prices.items() if name != chosen.name)
    return [f"{line}; {prices[chosen.name]:.3g} ns a pixel here" + (f" ({others})" if others else "")]


def _failures(config: Config, told: RunEstimate) -> list[str]:
    failed = [one for one in told.looks if one.reason is not None]
    lines = [f"fails     {one.source.name}: {one.reason}\n          {one.complaint}" for one in failed]
    if len(failed) > config.source.max_failed:
        lines.append(f"          more than source.max_failed={config.source.max_failed}: the run will end with 3")
    return lines


def _noise(config: Config, looks: tuple[SourceEstimate, ...]) -> list[str]:
    plans = [plan for one in looks for plan in one.levels]
    if not plans:
        return []
    if is_physical(config.noise):
        return [*_physical(config, plans), *_table([of_level for one in looks for of_level in one.predictions])]
    sensor, noise, first = config.sensor, config.noise, plans[0]
    profile_levels = (noise.black_level_dn, noise.white_level_dn) if noise.units == "dn" else (0, 1)
    levels = noise_levels(noise)
    numbers = "; ".join(dict.fromkeys(f"a={one.a}, b={one.b}" for one in levels))
    lines = [
        f"noise     {noise.name}: {numbers} ({noise.units}, black {profile_levels[0]} "
        f"{noise.black}, white {profile_levels[1]})",
        f"          on this sensor (black {sensor.black_level_dn}, white {sensor.white_level_dn}): "
        f"a_dn {_span([plan.a_dn for plan in plans])}, b_dn2 {_span([plan.b_dn2 for plan in plans])}",
    ]
    zero = max(
        (-plan.b_dn2 / plan.a_dn for plan in plans if "heteroscedastic" in plan.effects and plan.a_dn), default=0
    )
    if zero > 0:
        lines.append(f"          no noise up to {zero:.2f} DN above black, where the fitted variance is below 0")
    lines += [f"effect    {name}: {EFFECT_REASONS[name]}" for name in first.effects]
    lines += [f"skipped   {reason}" for reason in first.skipped]
    return lines


EFFECT_REASONS = {
    "heteroscedastic": "on; shot and read noise in one, variance = a_dn·(x - black) + b_dn2",
    "quantise": "on; integer output is always rounded and clipped",
}
"""Why each effect of a two-parameter profile is simulated."""


def _span(values: list[float], digits: int = 6) -> str:
    low, high = f"{min(values):.{digits}g}", f"{max(values):.{digits}g}"
    return low if low == high else f"{low} to {high}"


def _physical(config: Config, plans: list[Plan]) -> list[str]:
    """Return what a physical profile and the scene say of the photographs read."""
    sensor, noise = config.sensor, config.noise
    assert noise.white_level_dn is not None and noise.black_level_dn is not None
    physics = [plan.physics for plan in plans if plan.physics is not None]
    laws = sorted({one.read_law if one.read_law == "gaussian" else "Tukey's law" for one in physics})
    scale = (sensor.white_level_dn - sensor.black_level_dn) / (noise.white_level_dn - noise.black_level_dn)
    lines = [
        f"scene     {plans[0].scene}: ISO {_span([one.iso for one in physics])}, "
        f"{_span([one.exposure_s for one in physics])} s, {_span([one.temperature_c for one in physics])} °C, "
        f"light divided by {_span([plan.exposure_ratio for plan in plans], 4)}",
        f"noise     {noise.name}: in DN of black {noise.black_level_dn}, white {noise.white_level_dn}; "
        f"on this sensor (black {sensor.black_level_dn}, white {sensor.white_level_dn}) times {scale:.6g}",
        f"          there K {_span([one.dn_per_e for one in physics], 4)} DN per electron, "
        f"read noise of deviation {_span([one.read_std_dn for one in physics], 4)} DN ({', '.join(laws)})",
    ]
    if noise.assumed:
        lines.append(f"          assumed, no source gives them: {', '.join(noise.assumed)}")
    return lines


def _table(predictions: list[tuple[Prediction, ...]]) -> list[str]:
    """Return a line for each effect: of the photograph where it shows best, and how often it is simulated."""
    lines = ["effect         predicted DN  in the         hidden by DN  simulated  ns/pixel  why"]
    for of_effect in zip(*predictions, strict=True):
        best = max(of_effect, key=lambda one: (one.simulated, one.ratio, one.outliers))
        simulated = f"{sum(one.simulated for one in of_effect)} of {len(of_effect)}"
        cost = f"{COST_NS[best.effect]:.1f}"
        lines.append(
            f"{best.effect:13}  {best.predicted_dn:12.3g}  {best.statistic:13}  {best.hidden_dn:12.3g}  "
            f"{simulated:9}  {cost:>8}  {best.why}"
        )
    return lines
