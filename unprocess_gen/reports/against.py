"""Compare raw frames of a camera with the noise profile of a dataset: effects that it lacks, and numbers that are off.

The frames are measured as `calibrate` measures them. A number differs if a number of the profile, with the errors of
the measurement, would be as far away with the probability of an alarm of ``verify --noise``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from unprocess_gen.calibration.calibrate import Calibration, measure_all
from unprocess_gen.calibration.captures import Sensor, read_captures
from unprocess_gen.calibration.gain import Estimate
from unprocess_gen.calibration.measure import Watch
from unprocess_gen.calibration.profile import (
    NamedNumber,
    dark_variance,
    estimates,
    site_names,
)
from unprocess_gen.calibration.shape import NORMAL_SHAPE
from unprocess_gen.config.interpretation import is_physical, noise_distributions
from unprocess_gen.config.noise_validation import check_noise
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.planning.draws import DRAW_COUNT
from unprocess_gen.planning.noise_profile import PhysicalNoise
from unprocess_gen.planning.plan import TwoNumberLevel
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.simulation.effects import profile_keys
from unprocess_gen.simulation.plan import Physics
from unprocess_gen.statistics.scores import NORMAL_95, Score, alarm_limit

EFFECT_OF_NUMBER = {key: effect.name for key, (effect, _) in profile_keys().items()} | {"b_dn2": "heteroscedastic"}
"""Effect of each number that is compared, by its name in the list of estimates."""
ABSOLUTE = ("black_error_dn", "read_shape", "row_correlation")
"""Numbers whose differences are not stated relative to them, because they may be near 0."""
AT_TEMPERATURE = ("dark_e_per_s", "hot_pixel_share", "hot_pixel_e_per_s")
"""Numbers that can be compared only if the frames state their temperature."""
AGREES, DIFFERS, NOT_COMPARED = "agrees", "differs", "not compared"
LACKS, UNSEEN = "missing in the profile", "missing in the frames"


class Comparison(NamedTuple):
    """A measured number, the profile's number (None if it states none), and the verdict."""

    measured: NamedNumber
    profile: float | None
    score: Score
    verdict: str

    def __str__(self) -> str:
        name, iso, site, number = self.measured
        assert number is not None and self.profile is not None
        prefix = "".join([f"ISO {iso:g}: " if iso else "", f"site {site}: " if site else ""])
        unit = self.measured.unit and f" {self.measured.unit}"
        text = f"{prefix}{name} of the frames is {short_number(number.value, 4)}{unit}"
        text += f" ({short_number(number.low, 4)} to {short_number(number.high, 4)})"
        if self.verdict == LACKS:
            return f"{text}; the profile lacks it: effect {EFFECT_OF_NUMBER[name]} is missing in the dataset"
        if self.verdict == UNSEEN:
            return f"{text}; the profile has {short_number(self.profile, 4)}: the camera does not show it"
        side = "above" if self.score.total > 0 else "below"
        off = f"{short_number(abs(self.score.total), 3)}{unit}"
        off += f" or {abs(self.percent):.1f} %" if name not in ABSOLUTE else ""
        errors = f"{abs(self.score.errors):,.0f} standard errors"
        return f"{text}, {off} {side} that of the profile, {short_number(self.profile, 4)} ({errors})"

    @property
    def place(self) -> tuple[str, float | None]:
        """Name and ISO of the number."""
        return self.measured.name, self.measured.iso

    @property
    def percent(self) -> float:
        """Difference relative to the number of the profile; NaN without one."""
        return 100 * self.score.total / self.profile if self.profile else math.nan


class Comparisons(NamedTuple):
    """All comparisons of the frames with the profile, and notes on the frames."""

    numbers: list[Comparison]
    notes: list[str]

    @property
    def differences(self) -> list[Comparison]:
        """Numbers that differ; sites are left out of a number that differs at all sites together."""
        differing = [line for line in self.numbers if line.verdict not in (AGREES, NOT_COMPARED)]
        whole = {line.place for line in differing if line.measured.site is None}
        return [line for line in differing if line.measured.site is None or line.place not in whole]


def compare_frames(config: Config, frames: Path, watch: Watch = lambda frames: frames) -> Comparisons:
    """Measure raw frames, and compare them with the profile of a dataset; levels they do not state are the dataset's.

    Raises ConfigError or MachineError.
    """
    sensor = config.sensor
    default = Sensor(sensor.bits, sensor.black_level_dn, sensor.white_level_dn, sensor.pattern, (0, 0))
    captures = read_captures(frames, default)
    with_flats = {capture.iso for capture in captures.captures if capture.kind == "flat"}
    profile = Profile(config, captures.sensor, captures.isos)
    dark_only = [iso for iso in captures.isos if iso not in with_flats]
    known = {iso: Estimate(*[profile.numbers(iso, None)["dn_per_e"][0] or 1.0] * 3) for iso in dark_only}
    calibration = measure_all(captures, watch, known)
    return Comparisons(list(_compared(calibration, profile, known)), calibration.notes)


def _compared(calibration: Calibration, profile: Profile, known: dict[float, Estimate]) -> Iterator[Comparison]:
    """Yield the comparison of each estimate."""
    celsius, isos = calibration.celsius, calibration.captures.isos
    variances = [NamedNumber("b_dn2", result.iso, None, dark_variance(result)) for result in calibration.isos]
    listed = [estimate for estimate in [*estimates(calibration), *variances] if estimate.name in EFFECT_OF_NUMBER]
    limit, sites = alarm_limit(len(listed)), site_names(calibration.sensor)
    tukey = {result.iso: result.shape.is_tukey for result in calibration.isos}
    for estimate in listed:
        numbers = profile.numbers(estimate.iso or isos[0], celsius)
        place = 1 + sites.index(estimate.site) if estimate.site else 0
        if estimate.name not in numbers:
            continue
        expected = numbers[estimate.name][place]
        is_open = estimate.number is None or not math.isfinite(estimate.number.high) or expected is None
        is_open |= estimate.name == "dn_per_e" and estimate.iso in known
        is_open |= estimate.name in AT_TEMPERATURE and celsius is None and bool(expected)
        # a normal distribution is nearest to Tukey's at a shape that a fit may miss
        is_open |= estimate.name == "read_shape" and expected == NORMAL_SHAPE and not tukey[estimate.iso or 0.0]
        if is_open or estimate.number is None or expected is None:
            yield Comparison(estimate, expected, Score(0.0, 1.0, 0.0), NOT_COMPARED)
            continue
        score = _score(estimate.number, expected)
        verdict = AGREES
        if score.surprise > limit:
            verdict = DIFFERS if expected and estimate.number.value else UNSEEN if expected else LACKS
            verdict = DIFFERS if estimate.name == "black_error_dn" else verdict
        yield Comparison(estimate, expected, score, verdict)


def _score(number: Estimate, expected: float) -> Score:
    """Return the score of a difference, with the error on the side of the expected number."""
    error = (number.high - number.value if expected > number.value else number.value - number.low) / NORMAL_95
    return Score(number.value - expected, 1.0, error**2)


class Profile:
    """Numbers of a dataset's noise profile in DN of the sensor that recorded the frames."""

    def __init__(self, config: Config, sensor: Sensor, isos: list[float]) -> None:
        levels = dataclasses.replace(
            config.sensor,
            bits=sensor.bits,
            black_level_dn=round(sensor.black_dn),
            white_level_dn=round(sensor.white_dn),
            pattern=sensor.pattern,
        )
        noise = config.noise
        if is_physical(noise):
            noise = dataclasses.replace(noise, iso=None, scatter="off")
        elif len(isos) > 1 or any(distribution.kind != "constant" for distribution in noise_distributions(noise)):
            problem = "is for one ISO" if len(isos) > 1 else "draws its numbers"
            raise ConfigError(f"verify: --against: noise={noise.name} {problem}; expected frames and a profile of one")
        self.config = dataclasses.replace(config, sensor=levels, noise=noise)
        for iso in isos:
            try:
                check_noise(noise, dataclasses.replace(config.scene, iso=iso))
            except ConfigError as error:
                raise ConfigError(f"verify: --against: the frames are of ISO {iso:g}: {error}") from error

    def numbers(self, iso: float, celsius: float | None) -> dict[str, list[float | None]]:
        """Return the numbers at an ISO by their names in the list of estimates: of the sensor, then of each site."""
        scene = dataclasses.replace(self.config.scene, iso=iso, exposure_s=1.0)
        if celsius is not None:
            scene = dataclasses.replace(scene, temperature_c=celsius)
        config, middle = dataclasses.replace(self.config, scene=scene), [0.5] * DRAW_COUNT
        if is_physical(config.noise):
            profile = PhysicalNoise(config)
            physics = profile.physics(profile.draw(middle, 0, 0))
            return {name: self._number(name, physics) for name in EFFECT_OF_NUMBER if name != "b_dn2"}
        a, b = TwoNumberLevel(config).two_numbers(middle)
        two: dict[str, float | None] = {"dn_per_e": a, "b_dn2": b, "read_std_dn": None, "read_shape": None}
        return {name: [two.get(name, 0.0)] * 5 for name in EFFECT_OF_NUMBER if name != "full_well_e"}

    def _number(self, name: str, physics: Physics) -> list[float | None]:
        if getattr(self.config.effects, EFFECT_OF_NUMBER[name]) == "off":
            return [0.0 if name != "full_well_e" else None] * 5
        if name == "black_error_dn":
            return [sum(physics.black_error_dn) / 4, *physics.black_error_dn]
        if name == "read_shape" and physics.read_law == "gaussian":
            return [NORMAL_SHAPE] * 5
        value: Any = getattr(physics, name.removesuffix("_per_s"), getattr(self.config.noise, name, None))
        if name == "dn_per_e":
            colours = "GGGG" if self.config.sensor.pattern == "MONO" else self.config.sensor.pattern
            return [value, *(value * physics.gain_by_colour["RGB".index(colour)] for colour in colours)]
        return [value] * 5
