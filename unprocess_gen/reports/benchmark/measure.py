"""Measure the error and the time of every method of every stage, and of complete tiers, on this machine.

Errors are measured against the reference, on photographs subsampled to a regular grid (`methods.STAGE_ERRORS`). Frames
have 14 bits, except with the given config. The methods of curve, colour, mosaic and quantise are measured together in
one precision, because one kernel computes them; normal is compared with the exact quantile of a fixed, dense set of
random words.

Rows of tiers also have the errors of the noisy frame in DN and in σ.

Times are medians over rounds. Each round runs every measurement once on one photograph, and ratios are
taken within a round. Decoding and compilation are excluded; the first use of new memory is included, as in a run.
Complete runs are measured by `complete_runs`, and `report.conclude` states in words what the tiers save and cost.
"""

from __future__ import annotations

import itertools
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

from unprocess_gen.config.accuracy import METHODS, methods_of_stage
from unprocess_gen.config.interpretation import is_normalised, is_physical
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.reports.benchmark import complete_runs, methods
from unprocess_gen.reports.benchmark import session as sessions
from unprocess_gen.reports.benchmark.complete_runs import RunFiles, RunKey, RunMeasurement
from unprocess_gen.reports.benchmark.session import GIVEN, PHYSICAL, TWO_PARAMETER, BenchmarkImage, BenchmarkSession
from unprocess_gen.reports.benchmark.timing import measure_in_turns, median_ratio
from unprocess_gen.reports.formatting import counted


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
    """Methods and tiers, complete runs, the tier of the given settings, and what was measured."""

    rows: tuple[Measurement, ...]
    runs: tuple[RunMeasurement, ...]
    given_tier: str
    photographs: str
    conditions: dict[str, str]


TIER_STAGES = tuple(stage for stage in methods.STAGE_ERRORS if stage.startswith("tier"))
"""The end-to-end stages."""


def measure_accuracy(config: Config, sizes: sessions.SampleSizes | None = None, command: str = "") -> BenchmarkReport:
    """Measure every method and tier on photographs of a config's source; report progress on stderr.

    Rows are in the order of `METHODS`, then rows of tiers. ConfigError if no photograph can be read, or the config
    cannot be measured.
    """
    if is_normalised(config):
        raise ConfigError(
            "output.dtype=float32: cannot be measured, because errors are in integer DN; expected uint16; set "
            "output.dtype=uint16 (float32 frames are exact and equal in every tier)"
        )
    session = sessions.open_session(config, sizes or sessions.SampleSizes())
    tiers, rounds = session.tiers, session.sizes.rounds
    calls = _time_calls(session, session.images)
    steps = len(METHODS) + len(session.all_configs) * len(tiers) + (rounds + 1) * len(calls)
    steps += rounds * len(session.run_configs) * len(tiers)
    with complete_runs.run_files(config, session.sizes) as files, Progress(steps, unit="measurement") as progress:
        errors, frames = {}, {}
        for method in METHODS:
            errors[method.stage, method.name] = methods.method_error(session, method)
            progress.advance()
        for name in session.all_configs:
            for tier, accuracy in tiers.items():
                frames[name, tier] = methods.frame_errors(session, name, accuracy)
                progress.advance()
        corner = session.images[0].corner()
        measure_in_turns(_time_calls(session, [corner]), 1, progress.advance)  # compiles the remaining kernels
        times = measure_in_turns(calls, rounds, progress.advance)
        configs = {
            name: complete_runs.affordable(given, files, session.sizes) for name, given in session.run_configs.items()
        }
        run_times = complete_runs.measure_runs(configs, tiers, files, rounds, progress.advance)
    rows = (*_method_rows(session, errors, times), *_tier_rows(session, frames, times))
    noises = {name: noise_text(run, with_scene=name == GIVEN) for name, run in session.run_configs.items()}
    runs = tuple(complete_runs.run_rows(run_times, noises, frames))
    photographs = f"{counted(files.count, 'photograph')} ({files.pixels / 1e6:.1f} megapixels)"
    return BenchmarkReport(rows, runs, session.given_tier, photographs, _conditions(session, files, command))


# --------------------------------------------------------------------------------------------------------------- rows

RowKey = tuple[str, str]
"""Stage and name of a method; for tiers, config and name."""


def _time_calls(session: BenchmarkSession, images: Sequence[BenchmarkImage]) -> dict[RowKey, Callable[[int], float]]:
    """Every time measurement, ns per pixel; each round uses the next image."""
    calls: dict[RowKey, Callable[[BenchmarkImage], float]] = {
        (method.stage, method.name): partial(methods.method_ns, session, method)
        for method in METHODS
        if methods.has_time(method)
    }
    for name, (tier, accuracy) in itertools.product(session.configs, session.tiers.items()):
        calls[name, tier] = partial(methods.pair_ns, session, name, accuracy)

    def measure(call: Callable[[BenchmarkImage], float], number: int) -> float:
        return call(images[number % len(images)])

    return {key: partial(measure, call) for key, call in calls.items()}


def _method_rows(
    session: BenchmarkSession, errors: Mapping[RowKey, methods.Deviation], times: Mapping[RowKey, Sequence[float]]
) -> Iterator[Measurement]:
    by_tier = {name: sessions.chosen_methods(tier) for name, tier in session.tiers.items()}
    for method in METHODS:
        tiers = " ".join(name for name, chosen in by_tier.items() if method.spelled in chosen)
        key, error = (method.stage, method.name), errors[method.stage, method.name]
        unit = methods.STAGE_ERRORS[method.stage].unit if method.stage != "normal" else "σ"
        ns = _median_times(times, key, (method.stage, methods_of_stage(method.stage)[-1].name))
        yield Measurement(*key, tiers, error.max, error.rms, unit, error.changed_share, *ns)


def _tier_rows(
    session: BenchmarkSession, frames: Mapping[RunKey, methods.FrameErrors], times: Mapping[RowKey, Sequence[float]]
) -> Iterator[Measurement]:
    for stage, tier in itertools.product(TIER_STAGES, session.tiers):
        config, _, name, unit = methods.STAGE_ERRORS[stage]
        error: methods.Deviation = getattr(frames[config, tier], name)
        ns = _median_times(times, (config, tier), (config, sessions.REFERENCE))
        noisy = frames[config, tier].noisy_columns()
        yield Measurement(stage, tier, tier, error.max, error.rms, unit, error.changed_share, *ns, *noisy)


def _median_times(
    times: Mapping[RowKey, Sequence[float]], key: RowKey, reference: RowKey
) -> tuple[float | None, float | None]:
    """The median time and the median ratio to the reference; None if the time was not measured."""
    if key not in times:
        return None, None
    return statistics.median(times[key]), median_ratio(times[key], times[reference])


# --------------------------------------------------------------------------------------------------------- conditions


def _conditions(session: BenchmarkSession, files: RunFiles, command: str) -> dict[str, str]:
    """Facts about the measurements that differ between reports; the template has the others."""
    given, two_parameter, physical = (session.configs[name] for name in (GIVEN, TWO_PARAMETER, PHYSICAL))
    versions = (f"{name} {version(name)}" for name in ("unprocess_gen", "numpy", "numba", "llvmlite"))
    names = ", ".join(image.name for image in session.images)
    sites = sum(image.sampled[..., 0].size for image in session.images)
    return {
        "command": command,
        "date": time.strftime("%Y-%m-%d %H:%M %Z"),
        "machine": f"{processor()}; one thread of {os.cpu_count()}; {platform.system()} {platform.machine()}",
        "versions": f"Python {platform.python_version()}, {', '.join(versions)}",
        "photographs": f"{names}, of {given.source.place or 'the built-in scenes'}; errors on {sites:,} of their sites",
        "complete runs": f"the first photographs with {files.pixels / 1e6:.1f} megapixels",
        "rounds": str(session.sizes.rounds),
        "noise at 14 bits": f"{noise_text(two_parameter)}; physical {noise_text(physical)}",
        "given settings": f"{given.sensor.bits} bits, noise {noise_text(given)}, accuracy {given.accuracy.name}",
    }


def noise_text(config: Config, with_scene: bool = True) -> str:
    """The noise profile; scene and ISO if it is physical."""
    if not is_physical(config.noise):
        return config.noise.name
    iso = config.scene.iso if config.noise.iso is None else config.noise.iso
    return f"{config.noise.name}{f', scene {config.scene.name}' if with_scene else ''}, ISO {iso}"


def processor() -> str:
    """The model name of the processor."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
