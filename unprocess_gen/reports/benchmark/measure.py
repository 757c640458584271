"""What accuracy costs: error and time of every method of every stage, and of whole tiers, on this machine.

**Errors** are against the readable forms (``accuracy=reference``), which share every uniform with all others, so that
frames are compared site by site. A method's error is that of pairs made under the exact budget, let out by just what
this method needs (`alone`); so nothing is measured of kernels that no dataset is made with.

    curve, colour, mosaic, quantise   the clean frame at 14 bits, DN: all of them in that precision, as one kernel is
    normal                            σ, against the true quantile of a fixed, dense set of words, weighted as words are
    shot                              max: largest difference of the distribution functions of flat fields, rounded
                                      frames with read noise; rms: photographs, in σ of their shot and read noise
    effects                           the noisy frame without shot noise at 14 bits, DN
    tier, tier_own                    the clean frame, DN: two-parameter noise at 14 bits; the settings as they are
    tier_noisy, tier_electrons        the noisy frame at 14 bits, in σ: two-parameter noise; a physical profile

``changed_share`` is the share of sites whose DN differs at all. Errors are measured on every so manyth pixel of whole
photographs, since centres alone are brighter than the rest.

**Times** are processor time of this thread, so that what else runs counts little, of calls in turns: each round runs
everything once on one photograph, a ratio is taken within its round, and medians over rounds are shown. Decoding and
compilation are not in them; the first touch of new memory is, as it is in a run. NumPy forms get smaller cut-outs, or
they would take all the time: as large as it takes for their arrays to leave the caches, as a photograph's do.

The compiled form has no stages one could run alone: the curve is folded into the matrix, and no other channel exists.
So a clean stage's time goes from the codes to the end of that stage, by the kernels' own loops on the same small
buffers: ``curve`` what looks the codes up, ``colour`` and ``mosaic``, which are one loop, that and all up to the clean
frame; ``quantise`` reads out DN, ``normal`` starts from words, ``shot`` from words and rates. The other physical
effects are differences between whole pairs with and without them; normals in place of counts are counts, and the
difference of pairs to those with them.
"""

from __future__ import annotations

import dataclasses
import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from unprocess_gen.config.accuracy import METHODS, STAGES, Budget, Method, choose_methods, methods_of_stage
from unprocess_gen.config.interpretation import accuracy_budget, is_normalised, is_physical
from unprocess_gen.config.schema import AccuracyConfig, CleanConfig, Config, EffectsConfig, NoiseConfig, SensorConfig
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.jit import kernel
from unprocess_gen.core.lookup_tables import normal_table
from unprocess_gen.core.random_streams import BLOCK, Words
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import MOSAIC, Float, Frame, Pair, Plan, Raw, Srgb
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.kernels import float_draws as floats
from unprocess_gen.simulation.kernels import gaussian_float32 as single
from unprocess_gen.simulation.kernels import physical as electrons
from unprocess_gen.simulation.kernels.clean import (
    PairParameters,
    fill_clean,
    fill_signal,
    parameter_pointers,
    row_products,
    sum_products,
)
from unprocess_gen.simulation.kernels.clean import pair_parameters as fused_scene
from unprocess_gen.simulation.kernels.normal import (
    QuantileTables,
    fill_coarse_normals,
    fill_fine_normals,
    normal_quantile_tables,
)
from unprocess_gen.simulation.kernels.poisson import CountBuffers, allocate_count_buffers
from unprocess_gen.simulation.kernels.poisson import fill_counts as draw_counts
from unprocess_gen.simulation.kernels.readout import round_and_clip
from unprocess_gen.simulation.kernels.segments import (
    LONG_SEGMENT,
    SEGMENT,
    Float32,
    SegmentBuffers,
    allocate_buffers,
    buffer_pointers,
)
from unprocess_gen.simulation.kernels.simd import pointer_to
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference import noise as effects
from unprocess_gen.simulation.reference.poisson import Tables as PoissonTables
from unprocess_gen.simulation.reference.poisson import gaussian_from, poisson_tables
from unprocess_gen.simulation.reference.sensor import quantise, to_dn
from unprocess_gen.simulation.reference.unprocess import camera_light, unprocess
from unprocess_gen.sources.loader import list_photographs, load_source


@dataclass(frozen=True, slots=True)
class BenchmarkProfiles:
    """What the settings are measured beside: every tier by its name, two noise profiles, and a sensor of 14 bits.

    ``two_numbers`` and ``electrons`` stand in where the settings' own profile is of the other kind.
    """

    tiers: dict[str, AccuracyConfig]
    two_numbers: NoiseConfig
    electrons: NoiseConfig
    sensor: SensorConfig


@dataclass(frozen=True, slots=True)
class SampleSizes:
    """How much is measured; pictures as height and width at most.

    ``photographs`` are read, ``sampled`` pixels of each serve for errors, cut-outs of ``readable`` and ``compiled`` for
    times. ``flat`` is the side of a flat field, ``positions`` how many words are taken in each segment of the normal's
    table.
    """

    photographs: int = 8
    rounds: int = 7
    sampled: tuple[int, int] = (384, 512)
    readable: tuple[int, int] = (512, 768)
    compiled: tuple[int, int] = (1024, 1536)
    flat: int = 512
    positions: int = 64


class MethodError(NamedTuple):
    """An error and its unit; ``changed_share``: of the DN, None where no DN are compared."""

    max: float
    rms: float
    unit: str
    changed_share: float | None = None


@dataclass(frozen=True, slots=True)
class Measurement:
    """A line of the report; None where nothing was measured (`METHOD_BENCHMARKS`)."""

    stage: str
    method: str
    tier: str
    error_max: float | None
    error_rms: float | None
    error_unit: str
    changed_share: float | None
    ns_per_pixel: float | None
    ratio_to_reference: float | None


@dataclass(frozen=True, slots=True)
class BenchmarkReport:
    """The rows, and the circumstances they were measured under, in words for people."""

    rows: tuple[Measurement, ...]
    facts: dict[str, str]


REFERENCE, EXACT = "reference", "exact"
"""The tier all others are held beside, and the one a method's own error is measured in."""

TIER_STAGES = ("tier", "tier_noisy", "tier_electrons", "tier_own")

LEAST_NS = 0.01
"""What a difference of times is at least: below it, nothing can be told from nothing."""


def measure_accuracy(
    config: Config, beside: BenchmarkProfiles, effort: SampleSizes | None = None, command: str = ""
) -> BenchmarkReport:
    """Measure every method and every tier on the photographs of the settings; a progress bar goes to stderr.

    ``command`` is what the report says it was made by. Raises ConfigError where no photograph can be read, or the
    settings cannot be measured.
    """
    if is_normalised(config):
        raise ConfigError(
            "output.dtype=float32: errors are measured in whole DN; say output.dtype=uint16 (frames in float32 are the "
            "same, and exact, in every tier)"
        )
    effort, config = effort or SampleSizes(), _as_mosaics(config)
    lab = BenchmarkSession(_settings(config, beside), _tiers(config, beside), _subjects(config, effort), effort)
    calls = len(METHOD_BENCHMARKS) + len(lab.tiers) * 3
    with MeasurementProgress(
        len(METHOD_BENCHMARKS) + len(TIER_STAGES) * len(lab.tiers) + calls * (effort.rounds + 1)
    ) as steps:
        errors = dict(_errors(lab, steps))
        _one_round(lab, lab.tiny(), steps)  # compiles what was not
        rounds = [_one_round(lab, lab.subjects[turn % len(lab.subjects)], steps) for turn in range(effort.rounds)]
    rows = (*_method_rows(lab, errors, rounds), *_tier_rows(lab, errors, rounds))
    return BenchmarkReport(rows, _facts(lab, command))


def measure_tier_times(config: Config, tiers: dict[str, AccuracyConfig], srgb: Srgb) -> dict[str, float]:
    """Return what a pair of the settings costs under their own budget and every tier, nanoseconds a pixel, by name.

    Quickly: medians of three turns on cut-outs of one picture, of the readable forms on a small one.
    """
    effort = SampleSizes(sampled=(16, 16), readable=(64, 96), compiled=(384, 512))
    lab = BenchmarkSession({"own": _as_mosaics(config)}, {**tiers, config.accuracy.name: config.accuracy}, (), effort)
    subject = BenchmarkImage("", ("0" * 64, 0), *_cuts(srgb, effort))
    for tier in lab.tiers:
        _pair_ns(lab, "own", lab.tiers[tier], lab.tiny(subject))
    turns = [{tier: _pair_ns(lab, "own", lab.tiers[tier], subject) for tier in lab.tiers} for _ in range(3)]
    return {tier: statistics.median(turn[tier] for turn in turns) for tier in lab.tiers}


def _as_mosaics(config: Config) -> Config:
    """Return the settings for frames that are not packed, which moves values and changes none."""
    return replace(config, output=replace(config.output, layout=MOSAIC))


# ---------------------------------------------------------------------------------------- what it is measured on


@dataclass(frozen=True, slots=True)
class BenchmarkImage:
    """A photograph: every so manyth of its pixels, and two cut-outs of its middle."""

    name: str
    identity: tuple[str, int]
    sampled: Srgb
    readable: Srgb
    compiled: Srgb


@dataclass
class BenchmarkSession:
    """What the measurements share: settings and tiers by name, the photographs, and the pairs that were made."""

    settings: dict[str, Config]
    tiers: dict[str, AccuracyConfig]
    subjects: tuple[BenchmarkImage, ...]
    effort: SampleSizes
    _made: dict[object, list[tuple[Pair, Plan]]] = field(default_factory=dict)
    _flats: dict[object, list[Frame]] = field(default_factory=dict)

    def plan(
        self, setting: str, accuracy: AccuracyConfig, subject: BenchmarkImage, srgb: Srgb, edit: str = "as_it_is"
    ) -> Plan:
        """Plan a picture of a subject under a budget."""
        config = replace(self.settings[setting], accuracy=accuracy)
        return EDITS[edit](plan_image(config, *subject.identity, facts_for(config, srgb)))

    def pairs(self, setting: str, accuracy: AccuracyConfig, edit: str = "as_it_is") -> list[tuple[Pair, Plan]]:
        """Make the pairs of all samples under a budget, once."""
        key = (setting, edit, _numbers(accuracy))
        if key not in self._made:
            plans = [self.plan(setting, accuracy, one, one.sampled, edit) for one in self.subjects]
            pairs = (make_pair(one.sampled, plan) for one, plan in zip(self.subjects, plans, strict=True))
            self._made[key] = list(zip(pairs, plans, strict=True))
        return self._made[key]

    def flats(self, accuracy: AccuracyConfig) -> list[Frame]:
        """Return noisy frames of flat fields in electrons under a budget, made once."""
        key = _numbers(accuracy)
        if key not in self._flats:
            self._flats[key] = [make_pair(white, plan).noisy for white, plan in _flat_plans(self, accuracy)]
        return self._flats[key]

    def tiny(self, subject: BenchmarkImage | None = None) -> BenchmarkImage:
        """Return a corner of a subject, to have the machine code ready."""
        subject = subject or self.subjects[0]
        corner = _copy(subject.sampled[:16, :16])
        return replace(subject, sampled=corner, readable=corner, compiled=corner)


def _numbers(accuracy: AccuracyConfig) -> object:
    return dataclasses.astuple(replace(accuracy, name=""))


def _settings(config: Config, beside: BenchmarkProfiles) -> dict[str, Config]:
    """Return the settings as they are, and at 14 bits with noise of either kind: their own, where it is of that."""
    at_14_bits = replace(config, sensor=beside.sensor)
    # What was said of one kind's effects is no word about the other's.
    other = replace(at_14_bits, effects=EffectsConfig(tolerance=config.effects.tolerance), clean=CleanConfig())
    if is_physical(config.noise):
        two_numbers, physical = replace(other, noise=beside.two_numbers), at_14_bits
    else:
        two_numbers = replace(at_14_bits, noise=replace(config.noise, law="gaussian"))
        physical = _at_some_iso(replace(other, noise=beside.electrons))
    for one in (two_numbers, physical):
        validate_config(one)
    return {"two_numbers": two_numbers, "electrons": physical, "own": config}


FALLBACK_ISO = 1600
"""Where a stand-in profile was not calibrated at the scene's ISO."""


def _at_some_iso(config: Config) -> Config:
    try:
        validate_config(config)
    except ConfigError:
        return replace(config, noise=replace(config.noise, iso=FALLBACK_ISO))
    return config


def _tiers(config: Config, beside: BenchmarkProfiles) -> dict[str, AccuracyConfig]:
    """Return every tier, and the settings' own budget where it is none of them."""
    own = config.accuracy
    if any(_numbers(own) == _numbers(tier) for tier in beside.tiers.values()):
        return beside.tiers
    return {**beside.tiers, f"{own.name}_changed" if own.name in beside.tiers else own.name: own}


def _subjects(config: Config, effort: SampleSizes) -> tuple[BenchmarkImage, ...]:
    """Read photographs, spread over the listing; those that fail are passed over."""
    sources = evenly_spaced(list_photographs(config.source).sources, effort.photographs)
    subjects = []
    for source in sources:
        with suppress(SourceError):
            sha256, photograph = load_source(config.source, source)
            identity = source.stream_identity(sha256)
            subjects.append(BenchmarkImage(source.name, identity, *_cuts(photograph.srgb, effort)))
    if not subjects:
        raise ConfigError(f"source.root={config.source.root}: none of {len(sources)} photographs tried can be read")
    return tuple(subjects)


def _cuts(srgb: Srgb, effort: SampleSizes) -> tuple[Srgb, Srgb, Srgb]:
    """Return every so manyth pixel of a picture, and its middle in two sizes."""
    step = max(1, math.ceil(math.sqrt(srgb.shape[0] * srgb.shape[1] / math.prod(effort.sampled))))
    return _copy(srgb[::step, ::step]), _middle(srgb, effort.readable), _middle(srgb, effort.compiled)


def _middle(srgb: Srgb, most: tuple[int, int]) -> Srgb:
    top, left = (max(side - limit, 0) // 2 for side, limit in zip(srgb.shape[:2], most, strict=True))
    return _copy(srgb[top : top + most[0], left : left + most[1]])


def _copy(srgb: Srgb) -> Srgb:
    """Copy a part, so that the whole can be let go of."""
    part: Srgb = srgb.copy()
    return part


def _with_shot(plan: Plan) -> Plan:
    return replace(plan, effects=tuple(one for one in effects.EFFECTS if one in plan.effects or one == "shot"))


def _without_shot(plan: Plan) -> Plan:
    return replace(plan, effects=tuple(one for one in plan.effects if one != "shot"))


def _without_effects(plan: Plan) -> Plan:
    return replace(plan, effects=("quantise",))


EDITS: dict[str, Callable[[Plan], Plan]] = {
    "as_it_is": lambda plan: plan,
    "with_shot": _with_shot,
    "without_shot": _without_shot,
    "without_effects": _without_effects,
}

FLAT_RATES_E = (1.0, 10.0, 100.0, 1000.0)
MOST_FLAT_E = 4000.0
FLAT_DN_PER_E = 8.0
"""So fine that rounding to DN hides nothing of the law, where the range has room for it."""


def _flat_plans(lab: BenchmarkSession, accuracy: AccuracyConfig) -> Iterator[tuple[Srgb, Plan]]:
    """Yield white pictures and plans that darken them to a mean of so many electrons, with Gaussian read noise."""
    white = np.full((lab.effort.flat, lab.effort.flat, 3), 255, dtype=np.uint8)
    plan = lab.plan("electrons", accuracy, lab.subjects[0], white)
    assert plan.physics is not None
    read_std_e = plan.physics.read_std_dn / plan.physics.dn_per_e
    rates_e = flat_rates(read_std_e, max(tier.law_distance for tier in lab.tiers.values()))
    span_dn = plan.white_level_dn - plan.black_level_dn
    gain = min(FLAT_DN_PER_E, span_dn / (2 * max(rates_e)))
    physics = replace(
        plan.physics,
        dn_per_e=gain,
        read_std_dn=gain * read_std_e,
        read_law="gaussian",
        fixed_pattern_in_clean=False,
    )
    flat = replace(
        plan,
        rgb2cam=colour.IDENTITY,
        red_gain=1.0,
        blue_gain=1.0,
        inverse_rgb_gain=1.0,
        physics=physics,
        a_dn=gain,
        b_dn2=physics.read_std_dn**2,
        effects=("shot", "read", "quantise"),
    )
    for rate_e in rates_e:
        yield white, replace(flat, exposure_ratio=span_dn / (gain * rate_e))


def flat_rates(read_std_e: float, law_distance: float) -> list[float]:
    """Return the mean electrons of the flat fields: few and many, and where a normal is just near enough."""
    below, above = gaussian_from(read_std_e, law_distance)
    edges = (0.5 * below, 0.99 * below, 1.01 * above, 2 * above)
    return sorted({*FLAT_RATES_E, *(rate for rate in edges if 0.01 < rate < MOST_FLAT_E)})


# ------------------------------------------------------------------------------------------------------- errors


def taken(asked: Budget) -> frozenset[str]:
    """Return the methods that a budget takes, for noise of two numbers or of counts."""
    return frozenset(spelled for counts in (False, True) for spelled in choose_methods(asked, counts))


def alone(method: Method, tiers: dict[str, AccuracyConfig]) -> AccuracyConfig:
    """Return the budget that takes a method and is exact otherwise; of those that go together, all of them."""
    exact = tiers[EXACT]
    if method.spelled in taken(accuracy_budget(exact)):
        return exact
    if method.readable:
        return tiers[REFERENCE]
    together = [
        one for one in METHODS if one.implementation == method.implementation and one.implementation != "float64"
    ] or [method]
    return replace(
        exact,
        clean_dn=max(exact.clean_dn, *(one.clean_dn for one in together)),
        clean_changed_share=max(exact.clean_changed_share, *(one.clean_changed_share for one in together)),
        normal_error=max(exact.normal_error, *(one.normal_error for one in together)),
        law_distance=max(tier.law_distance for tier in tiers.values()) if method.approximates_law else 0.0,
    )


def clean_error(lab: BenchmarkSession, setting: str, accuracy: AccuracyConfig) -> MethodError:
    """Return the error of the clean frames under a budget."""
    ours, reference = ([pair.clean for pair, _ in lab.pairs(setting, one)] for one in (accuracy, lab.tiers[REFERENCE]))
    return compare(ours, reference, "DN")


def noisy_error(
    lab: BenchmarkSession, setting: str, accuracy: AccuracyConfig, edit: str = "as_it_is", unit: str = "σ"
) -> MethodError:
    """Return the error of the noisy frames under a budget, in DN or in σ of shot, read and rounding noise."""
    ours, reference = (lab.pairs(setting, one, edit) for one in (accuracy, lab.tiers[REFERENCE]))
    stds_dn = [noise_std_dn(pair, plan) for pair, plan in reference] if unit == "σ" else None
    return compare([pair.noisy for pair, _ in ours], [pair.noisy for pair, _ in reference], unit, stds_dn)


def noise_std_dn(pair: Pair, plan: Plan) -> Float:
    """Return the standard deviation of shot, read and rounding noise at each site, ``[H, W]`` DN."""
    return np.asarray(np.sqrt(effects.noise_variance(pair.clean.astype(np.float64), plan) + 1 / 12))


def compare(
    ours: Sequence[Frame], reference: Sequence[Frame], unit: str, scales_dn: Sequence[Float] | None = None
) -> MethodError:
    """Return the error of all frames together, in DN or in units of ``scales_dn``."""
    differences = [one.astype(np.float64) - other for one, other in zip(ours, reference, strict=True)]
    changed = sum(int(np.count_nonzero(one)) for one in differences) / sum(one.size for one in differences)
    if scales_dn is not None:
        differences = [one / scale for one, scale in zip(differences, scales_dn, strict=True)]
    every = np.concatenate([one.ravel() for one in differences])
    return MethodError(float(np.abs(every).max()), math.sqrt(float(np.mean(every * every))), unit, changed)


def shot_error(lab: BenchmarkSession, accuracy: AccuracyConfig) -> MethodError:
    """Return the distance of the laws on flat fields as max, the difference on photographs in σ as rms."""
    on_photographs = noisy_error(lab, "electrons", accuracy, "with_shot")
    distance = law_distance(lab.flats(accuracy), lab.flats(lab.tiers[REFERENCE]))
    return MethodError(distance, on_photographs.rms, "distribution (max), σ (rms)", on_photographs.changed_share)


def law_distance(ours: Sequence[Frame], reference: Sequence[Frame]) -> float:
    """Return the largest difference of the distribution functions of two frames, over all pairs of them.

    Frames of common uniforms: what both share by chance cancels, and some 5e-4 is left of 512² sites.
    """
    return max(_distance(one, other) for one, other in zip(ours, reference, strict=True))


def _distance(one: Frame, other: Frame) -> float:
    codes = int(max(one.max(), other.max())) + 1
    shares = np.bincount(one.ravel(), minlength=codes) - np.bincount(other.ravel(), minlength=codes)
    return float(np.abs(np.cumsum(shares)).max() / one.size)


def normal_error(sampler: Callable[[Words], Float], positions: int) -> MethodError:
    """Return the error of normals against the true quantiles, in σ."""
    words, weights = normal_words(positions)
    truth = true_normals(words)
    off = np.abs(sampler(words) - truth)
    return MethodError(float(off.max()), math.sqrt(float(np.sum(weights * off * off) / np.sum(weights))), "σ")


def normal_words(positions: int) -> tuple[Words, Float]:
    """Return uint32 words from every segment of every octave of the tail, ends included, and how many each stands for.

    Up to ``positions`` words a segment, evenly spread; the signs take turns.
    """
    parts = [np.arange(32)]
    weights = [np.ones(32)]
    for octave in range(6, 32):  # of 32 segments; those before are whole in the first 32 words
        words_a_segment = 2 ** (octave - 6)
        taken = min(positions, words_a_segment)
        offsets = np.arange(taken) * (words_a_segment - 1) // max(taken - 1, 1)
        starts = 2 ** (octave - 1) + np.arange(32) * words_a_segment
        parts.append((starts[:, None] + offsets).ravel())
        weights.append(np.full(32 * taken, words_a_segment / taken))
    index = np.concatenate(parts)
    signs = (np.arange(index.size) % 2) << 31
    return (index | signs).astype(np.uint32), np.concatenate(weights)


def true_normals(words: Words) -> Float:
    """Return the normal quantile of each word's own probability, right to 1e-15 of it."""
    quantile = NormalDist().inv_cdf
    tails = ((words & np.uint32(0x7FFFFFFF)).astype(np.float64) + 0.5) * 2.0**-32
    upper = np.array([-quantile(tail) for tail in tails.tolist()])
    return np.where(words >> np.uint32(31), -upper, upper)


def quadratic_normals(words: Words) -> Float:
    """Return the normals of uint32 words ``[n]`` that decide the compiled form's DN."""
    normals: Float = floats.by_inverse_cdf(words[None], normal_table())[0]
    return normals


def polynomial_normals(words: Words) -> Float:
    """Return the float32 form's normals of uint32 words ``[n]``."""
    whole = np.resize(words, -(-words.size // LONG_SEGMENT) * LONG_SEGMENT)
    depths, out = np.empty((2, whole.size), dtype=np.float32)
    fill_coarse_normals(whole, depths, out)
    return out[: words.size].astype(np.float64)


# -------------------------------------------------------------------------------------------------------- times

Clock = Callable[[], float]
"""Runs something once and returns the nanoseconds a pixel it took."""


def clocked(call: Callable[[], object], pixels: int) -> float:
    """Run a call and return what it took of this thread's processor time, nanoseconds a pixel, more than 0."""
    started = time.thread_time_ns()
    call()
    return max(time.thread_time_ns() - started, 1) / pixels


def _pair_ns(
    lab: BenchmarkSession, setting: str, accuracy: AccuracyConfig, subject: BenchmarkImage, edit: str = "as_it_is"
) -> float:
    """Make a pair, of a camera body not seen before, and return what it took."""
    readable = accuracy.readable
    srgb = subject.readable if readable else subject.compiled
    plan = lab.plan(setting, accuracy, subject, srgb, edit)
    electrons.prnu_response.cache_clear()
    return clocked(lambda: make_pair(srgb, plan), srgb.shape[0] * srgb.shape[1])


def _difference_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage, edits: tuple[str, str]) -> float:
    """Return by how much a pair with some effects takes longer than one without them."""
    accuracy = alone(method, lab.tiers)
    longer, shorter = (_pair_ns(lab, "electrons", accuracy, subject, edit) for edit in edits)
    return max(longer - shorter, LEAST_NS)


def _numpy_shot_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    return _difference_ns(lab, method, subject, ("with_shot", "without_shot"))


def _counts_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    plan, light = _light_of(lab, subject, subject.readable)
    physics = lab.plan("electrons", lab.tiers[EXACT], subject, subject.readable).physics
    assert physics is not None
    span_dn = plan.white_level_dn - plan.black_level_dn
    rates = np.resize(np.clip(light, 0, 1) * plan.exposure * span_dn / physics.dn_per_e, (BUFFERS, LONG_SEGMENT))
    words = _some_words(rates.size).reshape(rates.shape)
    turns = -(-subject.compiled.shape[0] * subject.compiled.shape[1] // rates.size)
    given = normal_quantile_tables(), poisson_tables(), allocate_count_buffers(LONG_SEGMENT), np.empty(LONG_SEGMENT)
    return clocked(lambda: _counts(rates, turns, words, *given), turns * rates.size)


def _near_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    """Return what counts take, and by how much a pair takes longer without them: there is no loop of its own."""
    ours, exact = (
        _pair_ns(lab, "electrons", accuracy, subject, "with_shot")
        for accuracy in (alone(method, lab.tiers), lab.tiers[EXACT])
    )
    return max(_counts_ns(lab, method, subject) + ours - exact, LEAST_NS)


def _effects_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    return _difference_ns(lab, method, subject, ("without_shot", "without_effects"))


def _clean_plan(lab: BenchmarkSession, srgb: Srgb, subject: BenchmarkImage) -> tuple[Plan, Float]:
    plan = lab.plan("two_numbers", lab.tiers[EXACT], subject, srgb)
    return plan, linear_table(plan.tone, plan.gamma, int(np.iinfo(srgb.dtype).max) + 1)


def _scene(lab: BenchmarkSession, subject: BenchmarkImage) -> tuple[Srgb, PairParameters]:
    srgb = subject.compiled
    plan, curve = _clean_plan(lab, srgb, subject)
    return srgb, fused_scene(plan, curve, srgb.shape, (0, 0))


def _look_up_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    srgb, scene = _scene(lab, subject)
    out = np.empty(LONG_SEGMENT)
    return clocked(lambda: _signals(srgb, scene, out), srgb.shape[0] * srgb.shape[1])


def _look_up32_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    srgb, scene = _scene(lab, subject)
    products, out = scene.products.astype(np.float32), np.empty(LONG_SEGMENT, dtype=np.float32)
    return clocked(lambda: _signals32(srgb, products, scene.site_channels, out), srgb.shape[0] * srgb.shape[1])


def _clean_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    srgb, scene = _scene(lab, subject)
    counts = np.zeros(6, dtype=np.int64)
    return clocked(lambda: _cleans(srgb, scene, allocate_buffers(), counts), srgb.shape[0] * srgb.shape[1])


def _clean32_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    srgb, scene = _scene(lab, subject)
    of_scene = single.dn_products32(scene), single.site_parameters32(scene), single.clean_parameters32(scene)
    return clocked(lambda: _cleans32(srgb, *of_scene, single.allocate_buffers32()), srgb.shape[0] * srgb.shape[1])


def _numpy_curve_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    srgb = subject.readable
    _, curve = _clean_plan(lab, srgb, subject)
    return clocked(lambda: curve[srgb], srgb.shape[0] * srgb.shape[1])


def _numpy_colour_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    srgb = subject.readable
    plan, curve = _clean_plan(lab, srgb, subject)
    return clocked(lambda: camera_light(srgb, plan, curve), srgb.shape[0] * srgb.shape[1])


def _numpy_mosaic_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    srgb = subject.readable
    plan, curve = _clean_plan(lab, srgb, subject)
    return clocked(lambda: unprocess(srgb, plan, curve=curve), srgb.shape[0] * srgb.shape[1])


BUFFERS = 8
"""Chunks of light or words that take turns, so that no two calls in a row see the same: they fit the nearest caches."""


def _light_of(lab: BenchmarkSession, subject: BenchmarkImage, srgb: Srgb) -> tuple[Plan, Float]:
    plan, curve = _clean_plan(lab, srgb, subject)
    return plan, unprocess(srgb, plan, curve=curve)


LIMITS_DN = (0.0, 16383.0)


def _round_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    chunks, turns = _chunks_of_dn(lab, subject)
    buffers = np.empty(LONG_SEGMENT, dtype=np.uint16), np.zeros(6, dtype=np.int64)
    return clocked(lambda: _digits(chunks, turns, LIMITS_DN, *buffers), turns * chunks.size)


def _round32_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    plan, _ = _clean_plan(lab, subject.compiled, subject)
    doubles, turns = _chunks_of_dn(lab, subject)
    chunks, law = doubles.astype(np.float32), single.noise_parameters32(plan, LIMITS_DN)
    black, noisy = np.uint32(plan.black_level_dn), np.empty(LONG_SEGMENT, dtype=np.uint16)
    return clocked(lambda: _digits32(chunks, turns, law, black, noisy), turns * chunks.size)


def _chunks_of_dn(lab: BenchmarkSession, subject: BenchmarkImage) -> tuple[Float, int]:
    """Return chunks of a photograph's DN before rounding, and how often they go round for as many as it has pixels."""
    plan, light = _light_of(lab, subject, subject.readable)
    chunks = np.resize(to_dn(light, plan.black_level_dn, plan.white_level_dn, plan.brightest), (BUFFERS, LONG_SEGMENT))
    return chunks, -(-subject.compiled.shape[0] * subject.compiled.shape[1] // chunks.size)


def _numpy_round_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    plan, light = _light_of(lab, subject, subject.readable)
    black_dn, white_dn = plan.black_level_dn, plan.white_level_dn
    return clocked(lambda: quantise(to_dn(light, black_dn, white_dn, plan.brightest), black_dn, white_dn), light.size)


def _some_words(count: int) -> Words:
    """Return words spread evenly over all 2**32, in an order without order."""
    return (np.arange(count, dtype=np.uint64) * np.uint64(2654435769)).astype(np.uint32)


def _normals_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    """Return the time of the quick normals, which stand in wherever the exact ones give the same DN."""
    return _clocked_normals(_normals, subject)


def _normals32_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    return _clocked_normals(_normals32, subject)


def _clocked_normals(kernel: Callable[..., None], subject: BenchmarkImage) -> float:
    chunks = _some_words(BUFFERS * LONG_SEGMENT).reshape(BUFFERS, LONG_SEGMENT)
    turns = -(-subject.compiled.shape[0] * subject.compiled.shape[1] // chunks.size)
    depths, out = np.empty((2, LONG_SEGMENT), dtype=np.float32)
    return clocked(lambda: kernel(chunks, turns, depths, out), turns * chunks.size)


def _numpy_normals_ns(lab: BenchmarkSession, method: Method, subject: BenchmarkImage) -> float:
    words = _some_words(subject.readable.shape[0] * subject.readable.shape[1])
    return clocked(lambda: effects.normals(words), words.size)


@kernel
def _signals(srgb: Srgb, scene: PairParameters, out: Float) -> None:
    """Look up the codes, the matrix folded into the curve."""
    height, width = srgb.shape[:2]
    bared = parameter_pointers(scene)
    for y in range(height):
        for start in range(0, width, LONG_SEGMENT):
            n = min(LONG_SEGMENT, width - start)
            fill_signal(pointer_to(srgb, 3 * (y * width + start)), srgb.itemsize == 1, y, n, bared, pointer_to(out, 0))


@kernel
def _signals32(srgb: Srgb, products: Float32, sites: NDArray[np.int64], out: Float32) -> None:
    """As `_signals`, in float32."""
    height, width = srgb.shape[:2]
    for y in range(height):
        even, odd = row_products(pointer_to(products, 0), products.shape[2], pointer_to(sites, 0), y)
        for start in range(0, width, LONG_SEGMENT):
            n, codes = min(LONG_SEGMENT, width - start), pointer_to(srgb, 3 * (y * width + start))
            sum_products(codes, even, odd, products.shape[2], n, srgb.itemsize == 1, pointer_to(out, 0))


@kernel
def _cleans(srgb: Srgb, scene: PairParameters, room: SegmentBuffers, counts: NDArray[np.int64]) -> None:
    """Go from codes to the clean frame."""
    run, bared, tally = buffer_pointers(room), parameter_pointers(scene), pointer_to(counts, 0)
    height, width = srgb.shape[:2]
    for y in range(height):
        for start in range(0, width, SEGMENT):
            n, codes = min(SEGMENT, width - start), pointer_to(srgb, 3 * (y * width + start))
            fill_clean(codes, srgb.itemsize == 1, y, 0, n, bared, run, run.clean, tally)


@kernel
def _cleans32(
    srgb: Srgb, products: Float32, sites: Float32, light: single.CleanParameters32, room: single.SegmentBuffers32
) -> None:
    """As `_cleans`, in float32."""
    height, width = srgb.shape[:2]
    run = single.buffer_pointers32(room)
    for y in range(height):
        even, odd = row_products(pointer_to(products, 0), products.shape[2], pointer_to(light.site_channels, 0), y)
        of_sites = single.load_site_parameters(sites, y & 1, 0)
        for start in range(0, width, SEGMENT):
            n = min(SEGMENT, width - start)
            codes = pointer_to(srgb, 3 * (y * width + start))
            sum_products(codes, even, odd, products.shape[2], n, srgb.itemsize == 1, run.signal)
            blocks = -(-n // BLOCK)
            some_bright = single.fill_linear32(blocks, of_sites[0], light, run, run.clean)[1]
            if some_bright:
                single.recompute_bright32(blocks, of_sites, light, run, run.clean)


@kernel
def _digits(chunks: Float, turns: int, limits_dn: tuple[float, float], noisy: Raw, counts: NDArray[np.int64]) -> None:
    """Round chunks of DN in turns."""
    for _ in range(turns):
        for chunk in range(chunks.shape[0]):
            round_and_clip(chunks[chunk], limits_dn, noisy, counts)


@kernel
def _digits32(chunks: Float32, turns: int, law: single.NoiseParameters32, black: np.uint32, noisy: Raw) -> None:
    """As `_digits`, in float32."""
    for _ in range(turns):
        for chunk in range(chunks.shape[0]):
            single.round_and_clip32(
                chunks.shape[1], law, black, pointer_to(chunks, chunk * chunks.shape[1]), pointer_to(noisy, 0)
            )


@kernel
def _normals(chunks: Words, turns: int, depths: Float32, out: Float32) -> None:
    """Make normals of chunks of words in turns."""
    for _ in range(turns):
        for chunk in range(chunks.shape[0]):
            fill_fine_normals(chunks[chunk], depths, out)


@kernel
def _counts(
    rates: Float,
    turns: int,
    words: Words,
    normal: QuantileTables,
    tables: PoissonTables,
    room: CountBuffers,
    out: Float,
) -> None:
    """Draw counts of chunks of rates in turns."""
    for _ in range(turns):
        for chunk in range(rates.shape[0]):
            draw_counts(words[chunk], rates[chunk], normal, tables, room, out)


@kernel
def _normals32(chunks: Words, turns: int, depths: Float32, out: Float32) -> None:
    """As `_normals`, for the form in float32."""
    for _ in range(turns):
        for chunk in range(chunks.shape[0]):
            fill_coarse_normals(chunks[chunk], depths, out)


# --------------------------------------------------------------------------------------------- the table of both

ErrorFunction = Callable[[BenchmarkSession, Method], MethodError]
TimeFunction = Callable[[BenchmarkSession, Method, BenchmarkImage], float]


class MethodBenchmark(NamedTuple):
    """How error and time of a method are measured; None where its kernel cannot be called by itself yet."""

    spelled: str
    error: ErrorFunction | None
    ns: TimeFunction | None


def _of_clean(lab: BenchmarkSession, method: Method) -> MethodError:
    return clean_error(lab, "two_numbers", alone(method, lab.tiers))


def _of_shot(lab: BenchmarkSession, method: Method) -> MethodError:
    return shot_error(lab, alone(method, lab.tiers))


def _of_effects(lab: BenchmarkSession, method: Method) -> MethodError:
    return noisy_error(lab, "electrons", alone(method, lab.tiers), "without_shot", "DN")


def _of_normals(sampler: Callable[[Words], Float]) -> ErrorFunction:
    return lambda lab, method: normal_error(sampler, lab.effort.positions)


METHOD_BENCHMARKS = (
    MethodBenchmark("curve:float32_table", _of_clean, _look_up32_ns),
    MethodBenchmark("curve:exact_table", _of_clean, _look_up_ns),
    MethodBenchmark("curve:numpy_table", _of_clean, _numpy_curve_ns),
    MethodBenchmark("colour:fused_float32", _of_clean, _clean32_ns),
    MethodBenchmark("colour:fused_float64", _of_clean, _clean_ns),
    MethodBenchmark("colour:numpy_float64", _of_clean, _numpy_colour_ns),
    MethodBenchmark("mosaic:at_site_float32", _of_clean, _clean32_ns),
    MethodBenchmark("mosaic:at_site", _of_clean, _clean_ns),
    MethodBenchmark("mosaic:after_colour", _of_clean, _numpy_mosaic_ns),
    MethodBenchmark("normal:polynomial_float32", _of_normals(polynomial_normals), _normals32_ns),
    MethodBenchmark("normal:quadratic_float64", _of_normals(quadratic_normals), _normals_ns),
    MethodBenchmark("normal:numpy_float64", _of_normals(effects.normals), _numpy_normals_ns),
    MethodBenchmark("shot:gaussian_where_near", _of_shot, _near_ns),
    MethodBenchmark("shot:inversion", _of_shot, _counts_ns),
    MethodBenchmark("shot:numpy_inversion", _of_shot, _numpy_shot_ns),
    MethodBenchmark("effects:fused_float64", _of_effects, _effects_ns),
    MethodBenchmark("effects:numpy_float64", _of_effects, _effects_ns),
    MethodBenchmark("quantise:fused_float32", _of_clean, _round32_ns),
    MethodBenchmark("quantise:fused_float64", _of_clean, _round_ns),
    MethodBenchmark("quantise:numpy_float64", _of_clean, _numpy_round_ns),
)
"""How every method of `METHODS` is measured, in its order."""

BENCHMARKS_BY_NAME = {one.spelled: one for one in METHOD_BENCHMARKS}
TIER_SETTING = {"tier": "two_numbers", "tier_noisy": "two_numbers", "tier_electrons": "electrons", "tier_own": "own"}


def _errors(lab: BenchmarkSession, steps: MeasurementProgress) -> Iterator[tuple[tuple[str, str], MethodError | None]]:
    """Yield the error of every method and tier, by stage and name."""
    for method in METHODS:
        error = BENCHMARKS_BY_NAME[method.spelled].error
        yield (method.stage, method.name), None if error is None else error(lab, method)
        steps.advance()
    for stage in TIER_STAGES:
        for name, tier in lab.tiers.items():
            of = noisy_error if stage in ("tier_noisy", "tier_electrons") else clean_error
            yield (stage, name), of(lab, TIER_SETTING[stage], tier)
            steps.advance()


Times = dict[tuple[str, str], float]


def _one_round(lab: BenchmarkSession, subject: BenchmarkImage, steps: MeasurementProgress) -> Times:
    """Run everything once on one subject; nanoseconds a pixel by stage (of a tier: setting) and name."""
    times: Times = {}
    for method in METHODS:
        ns = BENCHMARKS_BY_NAME[method.spelled].ns
        if ns is not None:
            times[method.stage, method.name] = ns(lab, method, subject)
        steps.advance()
    for setting in lab.settings:
        for name, tier in lab.tiers.items():
            times[setting, name] = _pair_ns(lab, setting, tier, subject)
            steps.advance()
    return times


def _method_rows(
    lab: BenchmarkSession, errors: dict[tuple[str, str], MethodError | None], rounds: Sequence[Times]
) -> Iterator[Measurement]:
    chosen = {name: taken(accuracy_budget(tier)) for name, tier in lab.tiers.items()}
    for stage in STAGES:
        reference = methods_of_stage(stage)[-1].name
        for method in methods_of_stage(stage):
            tiers = " ".join(name for name, spelled in chosen.items() if method.spelled in spelled)
            key = (stage, method.name)
            yield _row(stage, method.name, tiers, errors[key], rounds, key, (stage, reference))


def _tier_rows(
    lab: BenchmarkSession, errors: dict[tuple[str, str], MethodError | None], rounds: Sequence[Times]
) -> Iterator[Measurement]:
    for stage in TIER_STAGES:
        for name in lab.tiers:
            setting = TIER_SETTING[stage]
            yield _row(stage, name, name, errors[stage, name], rounds, (setting, name), (setting, REFERENCE))


def _row(
    stage: str,
    name: str,
    tiers: str,
    error: MethodError | None,
    rounds: Sequence[Times],
    key: tuple[str, str],
    reference: tuple[str, str],
) -> Measurement:
    ns = ratio = None
    if key in rounds[0]:
        ns = statistics.median(times[key] for times in rounds)
        ratio = statistics.median(times[key] / times[reference] for times in rounds)
    if error is None:
        return Measurement(stage, name, tiers, None, None, "", None, ns, ratio)
    return Measurement(stage, name, tiers, error.max, error.rms, error.unit, error.changed_share, ns, ratio)


# ----------------------------------------------------------------------------------------------- circumstances


def _facts(lab: BenchmarkSession, command: str) -> dict[str, str]:
    """Return what a reader must know of how the numbers came about."""
    effort, settings = lab.effort, lab.settings
    sites = sum(one.sampled.shape[0] * one.sampled.shape[1] for one in lab.subjects)
    words, _ = normal_words(effort.positions)
    sensor = settings["two_numbers"].sensor
    own = settings["own"]
    return {
        "command": command,
        "date": time.strftime("%Y-%m-%d %H:%M %Z"),
        "machine": f"{processor()}; one thread of {os.cpu_count()}; {platform.system()} {platform.machine()}",
        "versions": f"Python {platform.python_version()}, "
        + ", ".join(f"{name} {version(name)}" for name in ("unprocess_gen", "numpy", "numba", "llvmlite")),
        "measured on": f"{len(lab.subjects)} photographs from {own.source.root or 'the built-in scenes'}: "
        + ", ".join(one.name for one in lab.subjects),
        "errors": f"of {sites:,} sites of these photographs, {words.size:,} words for the normals, flat fields of "
        f"{effort.flat}² sites for the laws; a zero says that none of these differed",
        "times": f"medians of {effort.rounds} rounds, in turns, processor time of one thread; at most "
        f"{' x '.join(map(str, effort.compiled))} pixels, for NumPy {' x '.join(map(str, effort.readable))}",
        "at 14 bits": f"black {sensor.black_level_dn}, white {sensor.white_level_dn}; noise of two numbers "
        f"{settings['two_numbers'].noise.name}; of electrons {_physical(settings['electrons'])}",
        "the settings' own": f"{own.sensor.bits} bits, black {own.sensor.black_level_dn}, white "
        f"{own.sensor.white_level_dn}; noise {own.noise.name}; accuracy {own.accuracy.name}",
    }


def _physical(config: Config) -> str:
    iso = config.scene.iso if config.noise.iso is None else config.noise.iso
    return f"{config.noise.name}, scene {config.scene.name}, ISO {iso}"


def processor() -> str:
    """Return what the processor calls itself."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


PLAIN_LINE_S = 5.0
"""Seconds between progress lines where there is no terminal."""


class MeasurementProgress:
    """A bar over measurements on a terminal, a plain line every few seconds elsewhere; both on stderr."""

    def __init__(self, total: int) -> None:
        self._total, self._done, self._last_line = total, 0, time.monotonic()
        self._plain = not sys.stderr.isatty()
        self._bar = tqdm(total=total, desc="measuring", unit="step", file=sys.stderr, disable=self._plain)

    def __enter__(self) -> MeasurementProgress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def advance(self) -> None:
        """Count a measurement."""
        self._done += 1
        self._bar.update()
        now = time.monotonic()
        if self._plain and (now - self._last_line >= PLAIN_LINE_S or self._done == self._total):
            self._last_line = now
            print(f"gen-dataset: {self._done}/{self._total} measurements", file=sys.stderr, flush=True)
