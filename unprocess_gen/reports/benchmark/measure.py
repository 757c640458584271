"""Measure the error and the time of every method of every stage, and of complete tiers, on this machine.

Errors are measured against the reference (`method_errors`), on photographs subsampled to a regular grid:

========================================  =============================================================================
stage                                     error
========================================  =============================================================================
curve, colour, mosaic, quantise           clean frame at 14 bits, DN; all methods in that precision together, because
                                          one kernel computes them
normal                                    σ, against the exact quantile of a fixed, dense set of random words
shot                                      max: largest CDF difference on flat fields with read noise;
                                          rms: photographs, in σ of their shot and read noise
effects                                   noisy frame without shot noise at 14 bits, DN
tier, tier_own                            clean frame, DN: with two-parameter noise at 14 bits; with the given config
tier_noisy, tier_electrons                noisy frame at 14 bits, in σ: two-parameter noise; physical noise
========================================  =============================================================================

Rows of tiers also have the errors of the noisy frame in DN and in σ.

Times (`method_times`) are medians over rounds. Each round runs every measurement once on one photograph, and ratios are
taken within a round. Decoding and compilation are excluded; the first use of new memory is included, as in a run.
Complete runs are measured by `complete_runs`, and `conclusion` states in words what the tiers save and cost.
"""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from unprocess_gen.config.accuracy import METHODS, STAGES, Method, methods_of_stage
from unprocess_gen.config.interpretation import accuracy_budget, is_normalised, is_physical
from unprocess_gen.config.schema import AccuracyConfig, Config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.random_streams import Words
from unprocess_gen.core.types import Float, Srgb
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.reports.benchmark import method_times as times
from unprocess_gen.reports.benchmark.complete_runs import (
    JPEG_QUALITY,
    REFERENCE_PIXELS,
    RunFiles,
    RunKey,
    RunMeasurement,
    affordable,
    measure_runs,
    run_files,
    run_rows,
)
from unprocess_gen.reports.benchmark.conclusion import conclude
from unprocess_gen.reports.benchmark.method_errors import (
    MethodError,
    NoisyError,
    clean_error,
    noisy_error,
    noisy_errors,
    normal_error,
    normal_words,
    polynomial_normals,
    shot_error,
)
from unprocess_gen.reports.benchmark.session import (
    GIVEN,
    PHYSICAL,
    REFERENCE,
    TWO_PARAMETER,
    BenchmarkImage,
    BenchmarkProfiles,
    BenchmarkSession,
    SampleSizes,
    as_mosaics,
    budget_for,
    chosen_methods,
    cut_image,
    open_session,
)
from unprocess_gen.reports.formatting import counted
from unprocess_gen.simulation.reference import noise

__all__ = ["BenchmarkProfiles", "BenchmarkReport", "Measurement", "SampleSizes", "measure_accuracy"]


@dataclass(frozen=True, slots=True)
class Measurement:
    """Error and time of a method or tier: one row of ``accuracy.csv``. None means that a value was not measured.

    The errors of the noisy frame, in DN and in standard deviations of its noise, belong to rows of tiers.
    """

    stage: str
    method: str
    tier: str
    error_max: float | None
    error_rms: float | None
    error_unit: str
    changed_share: float | None
    ns_per_pixel: float | None
    ratio_to_reference: float | None
    noisy_changed_share: float | None = None
    noisy_max_dn: float | None = None
    noisy_rms_dn: float | None = None
    noisy_max_std: float | None = None
    noisy_rms_std: float | None = None


@dataclass(frozen=True, slots=True)
class BenchmarkReport:
    """Hold all measurements.

    Attributes
    ----------
    rows : tuple of Measurement
        Error and time of every method and tier.
    runs : tuple of RunMeasurement
        Error and time of complete runs.
    conclusion : str
        One sentence about the runs with the given settings.
    conditions : dict of str to str
        Conditions of the measurements, as text by name.
    """

    rows: tuple[Measurement, ...]
    runs: tuple[RunMeasurement, ...]
    conclusion: str
    conditions: dict[str, str]


TIER_CONFIGS = {"tier": TWO_PARAMETER, "tier_noisy": TWO_PARAMETER, "tier_electrons": PHYSICAL, "tier_own": GIVEN}
"""The config with which each end-to-end stage is measured."""

TIER_STAGES = tuple(TIER_CONFIGS)


def measure_accuracy(
    config: Config, profiles: BenchmarkProfiles, sizes: SampleSizes | None = None, command: str = ""
) -> BenchmarkReport:
    """Measure every method and tier on photographs of a config's source; report progress on stderr.

    Parameters
    ----------
    config : Config
        Validated config.
    profiles : BenchmarkProfiles
        Tiers, noise profiles and sensor for comparison.
    sizes : SampleSizes, optional
        How much is measured.
    command : str
        The command line, which the report quotes.

    Returns
    -------
    BenchmarkReport
        Measurements in the order of `METHODS`, then those of tiers.

    Raises
    ------
    ConfigError
        If no photograph can be read, or the config cannot be measured.
    """
    if is_normalised(config):
        raise ConfigError(
            "output.dtype=float32: cannot be measured, because errors are in integer DN; expected uint16; set "
            "output.dtype=uint16 (float32 frames are exact and equal in every tier)"
        )
    session = open_session(config, profiles, sizes or SampleSizes())
    settings, tiers, rounds_wanted = session.run_configs, session.tiers, session.sizes.rounds
    error_steps = len(METHOD_BENCHMARKS) + (len(TIER_STAGES) + len(session.all_configs)) * len(tiers)
    round_steps = len(METHOD_BENCHMARKS) + len(session.configs) * len(tiers)
    run_steps = len(settings) * len(tiers) * rounds_wanted
    with (
        run_files(config, session.sizes) as files,
        Progress(error_steps + round_steps * (rounds_wanted + 1) + run_steps, unit="measurement") as progress,
    ):
        errors = dict(_measure_errors(session, progress))
        noisy = dict(_measure_noisy_errors(session, progress))
        _measure_round(session, session.corner(), progress)  # compiles the remaining kernels
        rounds = [
            _measure_round(session, session.images[number % len(session.images)], progress)
            for number in range(rounds_wanted)
        ]
        run_configs = {name: affordable(one, files, session.sizes) for name, one in settings.items()}
        run_times = measure_runs(run_configs, tiers, files, rounds_wanted, progress)
    rows = (*_method_rows(session, errors, rounds), *_tier_rows(session, errors, noisy, rounds))
    noises = {name: _noise_text(one, with_scene=name == GIVEN) for name, one in settings.items()}
    runs = tuple(run_rows(run_times, noises, noisy))
    conclusion = conclude(runs, config.accuracy, tiers, files)
    return BenchmarkReport(rows, runs, conclusion, _conditions(session, command) | _run_conditions(session, files))


def measure_tier_times(config: Config, tiers: dict[str, AccuracyConfig], srgb: Srgb) -> dict[str, float]:
    """Return the time of a pair under the config's budget and every tier, ns per pixel, by name of the tier.

    The times are quick estimates: medians of three calls on crops of one image.
    """
    sizes = SampleSizes(sampled=(16, 16), readable=(64, 96), compiled=(384, 512))
    all_tiers = {**tiers, config.accuracy.name: config.accuracy}
    session = BenchmarkSession({GIVEN: as_mosaics(config)}, all_tiers, (), sizes)
    image = BenchmarkImage("", ("0" * 64, 0), *cut_image(srgb, sizes))
    for tier in all_tiers.values():
        times.time_pair(session, GIVEN, tier, session.corner(image))
    rounds = [
        {name: times.time_pair(session, GIVEN, tier, image) for name, tier in all_tiers.items()} for _ in range(3)
    ]
    return {name: statistics.median(one[name] for one in rounds) for name in all_tiers}


# ------------------------------------------------------------------------------------------------------------ methods

ErrorFunction = Callable[[BenchmarkSession, Method], MethodError]
TimeFunction = Callable[[BenchmarkSession, Method, BenchmarkImage], float]


class MethodBenchmark(NamedTuple):
    """The functions that measure error and time of a method; None if its kernel cannot be called separately."""

    spelled: str
    error: ErrorFunction | None
    ns: TimeFunction | None


def _clean_error(session: BenchmarkSession, method: Method) -> MethodError:
    return clean_error(session, TWO_PARAMETER, budget_for(method, session.tiers))


def _shot_error(session: BenchmarkSession, method: Method) -> MethodError:
    return shot_error(session, budget_for(method, session.tiers))


def _effects_error(session: BenchmarkSession, method: Method) -> MethodError:
    return noisy_error(session, PHYSICAL, budget_for(method, session.tiers), "without_shot", "DN")


def _normal_error_of(sampler: Callable[[Words], Float]) -> ErrorFunction:
    return lambda session, method: normal_error(sampler, session.sizes.positions)


METHOD_BENCHMARKS = (
    MethodBenchmark("curve:float32_table", _clean_error, times.time_clean),
    MethodBenchmark("curve:exact_table", _clean_error, times.time_clean),
    MethodBenchmark("curve:numpy_table", _clean_error, times.time_numpy_curve),
    MethodBenchmark("colour:fused_float32", _clean_error, times.time_clean),
    MethodBenchmark("colour:fused_float64", _clean_error, times.time_clean),
    MethodBenchmark("colour:numpy_float64", _clean_error, times.time_numpy_colour),
    MethodBenchmark("mosaic:at_site_float32", _clean_error, times.time_clean),
    MethodBenchmark("mosaic:at_site", _clean_error, times.time_clean),
    MethodBenchmark("mosaic:after_colour", _clean_error, times.time_numpy_mosaic),
    MethodBenchmark("normal:polynomial_float32", _normal_error_of(polynomial_normals), times.time_noise),
    MethodBenchmark("normal:quadratic_float64", _normal_error_of(noise.normals), times.time_noise),
    MethodBenchmark("normal:numpy_float64", _normal_error_of(noise.normals), times.time_numpy_normals),
    MethodBenchmark("shot:gaussian_where_near", _shot_error, times.time_shot),
    MethodBenchmark("shot:inversion", _shot_error, times.time_shot),
    MethodBenchmark("shot:numpy_inversion", _shot_error, times.time_shot),
    MethodBenchmark("effects:fused_float64", _effects_error, times.time_effects),
    MethodBenchmark("effects:numpy_float64", _effects_error, times.time_effects),
    MethodBenchmark("quantise:fused_float32", _clean_error, None),
    MethodBenchmark("quantise:fused_float64", _clean_error, None),
    MethodBenchmark("quantise:numpy_float64", _clean_error, times.time_numpy_readout),
)
"""How each method of `METHODS` is measured, in the same order."""

BENCHMARKS_BY_NAME = {benchmark.spelled: benchmark for benchmark in METHOD_BENCHMARKS}

RowKey = tuple[str, str]
"""Stage and name of a method or tier; for times of tiers, config and name."""

RoundTimes = dict[RowKey, float]
"""Times of one round, ns per pixel."""


def _measure_errors(session: BenchmarkSession, progress: Progress) -> Iterator[tuple[RowKey, MethodError | None]]:
    """Yield the error of every method and tier."""
    for method in METHODS:
        error = BENCHMARKS_BY_NAME[method.spelled].error
        yield (method.stage, method.name), None if error is None else error(session, method)
        progress.advance()
    for stage, config_name in TIER_CONFIGS.items():
        for name, tier in session.tiers.items():
            error_of = noisy_error if stage in ("tier_noisy", "tier_electrons") else clean_error
            yield (stage, name), error_of(session, config_name, tier)
            progress.advance()


def _measure_noisy_errors(session: BenchmarkSession, progress: Progress) -> Iterator[tuple[RunKey, NoisyError]]:
    """Yield the error of the noisy frames of every config under every tier."""
    for config_name in session.all_configs:
        for name, tier in session.tiers.items():
            yield (config_name, name), noisy_errors(session, config_name, tier)
            progress.advance()


def _measure_round(session: BenchmarkSession, image: BenchmarkImage, progress: Progress) -> RoundTimes:
    """Run every time measurement once on one image."""
    found: RoundTimes = {}
    for method in METHODS:
        ns = BENCHMARKS_BY_NAME[method.spelled].ns
        if ns is not None:
            found[method.stage, method.name] = ns(session, method, image)
        progress.advance()
    for config_name in session.configs:
        for name, tier in session.tiers.items():
            found[config_name, name] = times.time_pair(session, config_name, tier, image)
            progress.advance()
    return found


Errors = dict[RowKey, MethodError | None]


def _method_rows(session: BenchmarkSession, errors: Errors, rounds: Sequence[RoundTimes]) -> Iterator[Measurement]:
    by_tier = {name: chosen_methods(accuracy_budget(tier)) for name, tier in session.tiers.items()}
    for stage in STAGES:
        reference = methods_of_stage(stage)[-1].name
        for method in methods_of_stage(stage):
            tiers = " ".join(name for name, chosen in by_tier.items() if method.spelled in chosen)
            key = (stage, method.name)
            yield _measurement(key, tiers, errors[key], _median_times(rounds, key, (stage, reference)))


def _tier_rows(
    session: BenchmarkSession, errors: Errors, noisy: Mapping[RunKey, NoisyError], rounds: Sequence[RoundTimes]
) -> Iterator[Measurement]:
    for stage, config_name in TIER_CONFIGS.items():
        for name in session.tiers:
            ns = _median_times(rounds, (config_name, name), (config_name, REFERENCE))
            yield _measurement((stage, name), name, errors[stage, name], ns, noisy[config_name, name])


def _median_times(
    rounds: Sequence[RoundTimes], key: RowKey, reference: RowKey
) -> tuple[float, float] | tuple[None, None]:
    """Return the median time and the median ratio to the reference; None if the time was not measured."""
    if key not in rounds[0]:
        return None, None
    return (
        statistics.median(one[key] for one in rounds),
        statistics.median(one[key] / one[reference] for one in rounds),
    )


def _measurement(
    key: RowKey,
    tiers: str,
    error: MethodError | None,
    ns: tuple[float, float] | tuple[None, None],
    noisy: NoisyError | tuple[()] = (),
) -> Measurement:
    if error is None:
        return Measurement(*key, tiers, None, None, "", None, *ns)
    return Measurement(*key, tiers, error.max, error.rms, error.unit, error.changed_share, *ns, *noisy)


# --------------------------------------------------------------------------------------------------------- conditions


def _conditions(session: BenchmarkSession, command: str) -> dict[str, str]:
    """Return what a reader must know about the measurements."""
    sizes, given, images = session.sizes, session.configs[GIVEN], session.images
    sites = sum(image.sampled.shape[0] * image.sampled.shape[1] for image in images)
    words, _ = normal_words(sizes.positions)
    two_parameter = session.configs[TWO_PARAMETER]
    sensor = two_parameter.sensor
    return {
        "command": command,
        "date": time.strftime("%Y-%m-%d %H:%M %Z"),
        "machine": f"{processor()}; one thread of {os.cpu_count()}; {platform.system()} {platform.machine()}",
        "versions": f"Python {platform.python_version()}, "
        + ", ".join(f"{name} {version(name)}" for name in ("unprocess_gen", "numpy", "numba", "llvmlite")),
        "photographs": f"{len(images)} photographs from {given.source.root or 'the built-in scenes'}: "
        + ", ".join(image.name for image in images),
        "errors": f"on {sites:,} sites of these photographs, {words.size:,} random words for normal deviates, flat "
        f"fields of {sizes.flat}² sites for distributions; 0 means that none of these differed",
        "times": f"medians of {sizes.rounds} rounds, processor time of one thread; crops of at most "
        f"{' x '.join(map(str, sizes.compiled))} pixels, for NumPy {' x '.join(map(str, sizes.readable))}",
        "at 14 bits": f"black {sensor.black_level_dn}, white {sensor.white_level_dn}; two-parameter noise "
        f"{two_parameter.noise.name}; physical noise {_physical_noise(session.configs[PHYSICAL])}",
        "given settings": f"{given.sensor.bits} bits, black {given.sensor.black_level_dn}, white "
        f"{given.sensor.white_level_dn}; noise {given.noise.name}; accuracy {given.accuracy.name}",
    }


def _run_conditions(session: BenchmarkSession, files: RunFiles) -> dict[str, str]:
    """Return what a reader must know about complete runs."""
    root = session.configs[GIVEN].source.root
    reference = files.at_most(REFERENCE_PIXELS)
    place = f"the first of {root}" if root else f"built-in scenes, as JPEG files of quality {JPEG_QUALITY}"
    return {
        "complete runs": f"{counted(files.count, 'photograph')}, {files.pixels / 1e6:.1f} megapixels ({place}); one "
        "worker; processor time of all threads, without compilation and without waiting for the disk; the shortest of "
        f"each stage in {counted(session.sizes.rounds, 'round')}, for the reference one round with "
        f"{reference.pixels / 1e6:.1f} megapixels"
    }


def _noise_text(config: Config, with_scene: bool) -> str:
    return _physical_noise(config, with_scene) if is_physical(config.noise) else config.noise.name


def _physical_noise(config: Config, with_scene: bool = True) -> str:
    iso = config.scene.iso if config.noise.iso is None else config.noise.iso
    return f"{config.noise.name}{f', scene {config.scene.name}' if with_scene else ''}, ISO {iso}"


def processor() -> str:
    """Return the model name of the processor."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
