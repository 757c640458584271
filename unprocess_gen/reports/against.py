"""Compare raw frames of a camera with the noise profile of a dataset: effects that it lacks, and numbers that are off.

The frames are measured as `calibrate` measures them. A number differs if a number of the profile, with the errors of
the measurement, would be as far away with the probability of an alarm of ``verify --noise``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from unprocess_gen.calibration.calibrate import Calibration, calibrate
from unprocess_gen.calibration.captures import Sensor, read_captures
from unprocess_gen.calibration.deviations import NORMAL_95, Score, alarm_limit
from unprocess_gen.calibration.gain import Estimate
from unprocess_gen.calibration.iso_results import Watch
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

EFFECT_OF_NUMBER = {key: effect.name for key, (effect, _) in profile_keys().items()} | {"b_dn2": "heteroscedastic"}
"""Effect of each number that is compared, by its name in the list of estimates."""
ABSOLUTE = ("black_error_dn", "read_shape", "row_correlation")
"""Numbers whose differences are not stated relative to them, because they may be near 0."""
AT_TEMPERATURE = ("dark_e_per_s", "hot_pixel_share", "hot_pixel_e_per_s")
"""Numbers that can be compared only if the frames state their temperature."""


class Comparison(NamedTuple):
    """A measured number, its estimate, that of the profile, the score of their difference, and True for an alarm."""

    measured: NamedNumber
    number: Estimate
    profile: float
    score: Score
    differs: bool

    def __str__(self) -> str:
        name, iso, site, _ = self.measured
        prefix = "".join([f"ISO {iso:g}: " if iso else "", f"site {site}: " if site else ""])
        unit, off = self.measured.unit and f" {self.measured.unit}", self.score.total
        value, low, high, expected = (
            short_number(end, 4) for end in (self.number.value, self.number.low, self.number.high, self.profile)
        )
        text = f"{prefix}{name} of the frames is {value}{unit} ({low} to {high})"
        if not self.profile and name != "black_error_dn":
            return f"{text}; the profile lacks it: effect {EFFECT_OF_NUMBER[name]} is missing in the dataset"
        if not self.number.value and name != "black_error_dn":
            return f"{text}; the profile has {expected}: the camera does not show it"
        size = f"{short_number(abs(off), 3)}{unit}"
        size += "" if name in ABSOLUTE else f" or {abs(100 * off / self.profile):.1f} %"
        errors = f"{abs(self.score.errors):,.0f} standard errors"
        return f"{text}, {size} {'above' if off > 0 else 'below'} that of the profile, {expected} ({errors})"


class Comparisons(NamedTuple):
    """All comparisons of the frames with the profile, and notes on the frames."""

    numbers: list[Comparison]
    notes: list[str]

    @property
    def differences(self) -> list[Comparison]:
        """Numbers that differ; sites are left out of a number that differs at all sites together."""
        differing = [line for line in self.numbers if line.differs]
        everywhere = {line.measured[:2] for line in differing if line.measured.site is None}
        return [line for line in differing if line.measured.site is None or line.measured[:2] not in everywhere]


def compare_frames(config: Config, frames: Path, watch: Watch = lambda frames: frames) -> Comparisons:
    """Measure raw frames, and compare them with the profile of a dataset, which has the levels that no file states."""
    sensor = config.sensor
    default = Sensor(sensor.bits, sensor.black_level_dn, sensor.white_level_dn, sensor.pattern, (0, 0))
    captures = read_captures(frames, default)
    config = _recorded_config(config, captures.sensor, captures.isos)
    with_flats = {capture.iso for capture in captures.captures if capture.kind == "flat"}
    dark_only = [iso for iso in captures.isos if iso not in with_flats]
    gains = {iso: _profile_numbers(config, iso, None)["dn_per_e"][0] or 1.0 for iso in dark_only}
    calibration = calibrate(captures, watch, {iso: Estimate(gain, gain, gain) for iso, gain in gains.items()})
    return Comparisons(list(_compared(calibration, config, dark_only)), captures.notes)


def _compared(calibration: Calibration, config: Config, dark_only: list[float]) -> Iterator[Comparison]:
    """Yield the comparison of each number that both have."""
    celsius, isos = calibration.celsius, calibration.captures.isos
    variances = [NamedNumber("b_dn2", result.iso, None, dark_variance(result)) for result in calibration.isos]
    listed = [entry for entry in [*estimates(calibration), *variances] if entry.name in EFFECT_OF_NUMBER]
    limit, sites = alarm_limit(len(listed)), [None, *site_names(calibration.captures.sensor)]
    profile = {iso: _profile_numbers(config, iso, celsius) for iso in isos}
    tukey = {result.iso: result.shape.is_tukey for result in calibration.isos}
    for entry in listed:
        name, iso, site, number = entry
        expected = profile[iso or isos[0]].get(name, [None] * 5)[sites.index(site)]
        if number is None or expected is None or not math.isfinite(number.high):
            continue
        if (name == "dn_per_e" and iso in dark_only) or (name in AT_TEMPERATURE and celsius is None and expected):
            continue
        # a normal distribution is nearest to Tukey's at a shape that a fit may miss
        if name == "read_shape" and expected == NORMAL_SHAPE and not tukey[iso or 0.0]:
            continue
        error = (number.high - number.value if expected > number.value else number.value - number.low) / NORMAL_95
        score = Score(number.value - expected, 1.0, error**2)
        yield Comparison(entry, number, expected, score, score.surprise > limit)


def _recorded_config(config: Config, sensor: Sensor, isos: list[float]) -> Config:
    """The config of a dataset for the sensor that recorded the frames; ConfigError if the profile lacks an ISO."""
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
    for iso in isos:
        try:
            check_noise(noise, dataclasses.replace(config.scene, iso=iso))
        except ConfigError as error:
            raise ConfigError(f"verify: --against: the frames are of ISO {iso:g}: {error}") from error
    return dataclasses.replace(config, sensor=levels, noise=noise)


def _profile_numbers(config: Config, iso: float, celsius: float | None) -> dict[str, list[float | None]]:
    """The numbers of a profile at an ISO by their names in the list of estimates: of the sensor, then of each site."""
    celsius = config.scene.temperature_c if celsius is None else celsius
    scene = dataclasses.replace(config.scene, iso=iso, exposure_s=1.0, temperature_c=celsius)
    config, middle = dataclasses.replace(config, scene=scene), [0.5] * DRAW_COUNT
    numbers: dict[str, list[float | None]]
    if not is_physical(config.noise):
        a, b = TwoNumberLevel(config).two_numbers(middle)
        numbers = {name: [0.0] * 5 for name in EFFECT_OF_NUMBER if name != "full_well_e"}
        return numbers | {"dn_per_e": [a] * 5, "b_dn2": [b] * 5, "read_std_dn": [None] * 5, "read_shape": [None] * 5}
    profile = PhysicalNoise(config)
    physics = profile.physics(profile.draw(middle, 0, 0))
    names = [name for name in EFFECT_OF_NUMBER if name != "b_dn2"]
    values = (getattr(physics, name.removesuffix("_per_s"), getattr(config.noise, name, None)) for name in names)
    numbers = {name: [value] * 5 for name, value in zip(names, values, strict=True)}
    colours = "GGGG" if config.sensor.pattern == "MONO" else config.sensor.pattern
    gains = (physics.dn_per_e * physics.gain_by_colour["RGB".index(colour)] for colour in colours)
    numbers["dn_per_e"] = [physics.dn_per_e, *gains]
    numbers["black_error_dn"] = [sum(physics.black_error_dn) / 4, *physics.black_error_dn]
    if physics.read_law == "gaussian":
        numbers["read_shape"] = [NORMAL_SHAPE] * 5
    off = [name for name in names if getattr(config.effects, EFFECT_OF_NUMBER[name]) == "off"]
    return numbers | {name: [None if name == "full_well_e" else 0.0] * 5 for name in off}
