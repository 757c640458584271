"""Evaluate a physical noise profile for the ISO, exposure and temperature of one image.

Profiles are in electrons before the system gain K, and behind it in DN of the sensor they were calibrated on. A number
may depend on ISO, in one of `forms.ISO_FORMS`. A profile is valid for the calibrated ISOs only; a dual-gain sensor has
a branch on each side of the switch. Exponentials and logarithms are defined in `decimal` and rounded once, because the
last bit of libm's results differs between machines. `core.fixed_point` finds those of lines faster.
"""

from __future__ import annotations

import bisect
import functools
from collections.abc import Callable, Sequence
from decimal import Decimal, localcontext
from typing import Any

from unprocess_gen.config.distributions import draw_parameter, parse_drawn
from unprocess_gen.config.interpretation import branch_of
from unprocess_gen.config.limits import EXPOSURE_S, ISO, TEMPERATURE_C
from unprocess_gen.config.schema import BranchConfig, Config
from unprocess_gen.core import fixed_point
from unprocess_gen.core.exact_distributions import DIGITS, normal_quantile
from unprocess_gen.core.random_streams import body_key, scatter_uniforms
from unprocess_gen.planning.draws import Draw
from unprocess_gen.simulation.effects import NUMBERS, Physics
from unprocess_gen.simulation.effects.numbers import DN, RATE, SHAPE, SITES, Number
from unprocess_gen.simulation.reference import cfa

MIDDLE = 0.5
"""Uniform at which a line has no scatter."""


class PhysicalNoise:
    """A physical noise profile in a scene and on a sensor, with its distributions parsed."""

    def __init__(self, config: Config) -> None:
        noise, scene, sensor = config.noise, config.scene, config.sensor
        assert noise.white_level_dn is not None and noise.black_level_dn is not None
        self.noise, self.sensor = noise, sensor
        self.fixed_pattern_in_clean = config.clean.includes_fixed_pattern
        self.iso = parse_drawn("iso", scene.iso if noise.iso is None else noise.iso, ISO)
        self.exposure_s = parse_drawn("exposure_s", scene.exposure_s, EXPOSURE_S)
        self.temperature_c = parse_drawn("temperature_c", scene.temperature_c, TEMPERATURE_C)
        self.scale = (sensor.white_level_dn - sensor.black_level_dn) / (noise.white_level_dn - noise.black_level_dn)

    def draw(self, uniforms: Sequence[float], stream_key: int, seed: int) -> Physics:
        """Draw ISO, exposure, temperature and the scatter of the profile, and convert its numbers to the sensor's DN.

        DN of the profile become DN of the sensor by the factor s = (W - B) / (W_profile - B_profile). ``uniforms`` are
        those of `draws`; ``stream_key`` identifies the camera body if ``sensor.units=image``.
        """
        noise, sensor = self.noise, self.sensor
        iso = draw_parameter(self.iso, uniforms[Draw.ISO])
        seconds = draw_parameter(self.exposure_s, uniforms[Draw.EXPOSURE_S])
        celsius = draw_parameter(self.temperature_c, uniforms[Draw.TEMPERATURE_C])
        branch = branch_of(noise, iso)
        assert branch is not None
        units = sensor.units
        unit = f"{stream_key:016x}" if units == "image" else str(int(uniforms[Draw.SENSOR_UNIT] * units))
        body = body_key(seed, noise.name, unit)
        exposure = seconds, _doublings(celsius, noise.dark_reference_c, noise.dark_doubling_c)
        return Physics(
            iso=iso,
            exposure_s=seconds,
            temperature_c=celsius,
            dark_offset=sensor.dark_offset,
            sensor_unit=unit,
            body_key=body,
            fixed_pattern_in_clean=self.fixed_pattern_in_clean,
            **self._numbers(branch, iso, exposure, self._scatter(body)),
        )

    def _numbers(
        self, branch: BranchConfig, iso: float, exposure: tuple[float, float], uniform: Callable[[Number], float]
    ) -> dict[str, Any]:
        """Return the numbers of the effects that the profile has; ``exposure`` is the time and the warmth."""
        values: dict[str, Any] = {}
        for name, declared in NUMBERS.items():
            value = getattr(branch if declared.in_branch else self.noise, declared.key or name)
            if value is None:
                continue
            if declared.kind == RATE:
                value = value * exposure[0] * exposure[1]
            elif declared.kind == DN:
                value = evaluate(value, iso, uniform(declared)) * self.scale
            elif declared.kind == SHAPE:
                (value,) = linear_values(value, iso)
            elif declared.kind == SITES:
                errors = by_site(linear_values(value, iso), self.sensor.pattern)
                value = tuple(error * self.scale for error in errors)
            elif declared.count > 1:
                value = tuple(map(float, value))
            values[name] = value
        return values

    def _scatter(self, body: int) -> Callable[[Number], float]:
        """Return the uniform at which each number of a body is drawn."""
        if self.noise.scatter == "off":
            return lambda declared: MIDDLE
        scatter = _scatter_of_body(body)
        return lambda declared: MIDDLE if declared.counter < 0 else scatter[declared.counter]


def evaluate(form: Any, iso: float, uniform: float = MIDDLE) -> float:
    """Evaluate a gain or standard deviation of a branch: a number, or one of `forms.ISO_FORMS`.

    ``uniform`` draws the scatter of a line.
    """
    if not isinstance(form, list | tuple):
        return float(form)
    kind, *numbers = form
    return _on_line(iso, uniform, *numbers) if kind == "line" else _in_table(iso, *numbers)


def linear_values(form: Any, iso: float) -> tuple[float, ...]:
    """Evaluate a shape, or black-level errors of a branch: one number or four, or a table of them."""
    if not isinstance(form, list | tuple):
        return (float(form),)
    if form[0] != "by_iso":
        return tuple(map(float, form))
    return _linear_in_table(iso, *form[1:])


# Numbers are computed once for each value of what they depend on. Most configs fix the ISO and the temperature, and the
# scatter of a body is the same for all its images. Without these caches, a plan takes 0.3 ms more.


@functools.lru_cache(maxsize=256)
def _on_line(iso: float, uniform: float, slope: float, intercept: float, std: float = 0.0) -> float:
    """Return x from ln x = slope · ln ISO + intercept + std · n, where n is a standard normal deviate."""
    value = fixed_point.nearest_log_linear(uniform, iso, slope, intercept, std)
    if value is not None:
        return value
    with localcontext(prec=DIGITS):
        scatter = Decimal(std) * normal_quantile(Decimal(uniform)) if std else Decimal(0)
        return float((Decimal(slope) * Decimal(iso).ln() + Decimal(intercept) + scatter).exp())


@functools.lru_cache(maxsize=256)
def _in_table(iso: float, *pairs: float) -> float:
    """Interpolate in a table of ISO, x, …: ln x is linear in ln ISO between neighbours."""
    share, low, high = _neighbours(iso, pairs)
    if not share:
        return float(low)
    with localcontext(prec=DIGITS):
        return float((_logarithm(low) + share * (_logarithm(high) - _logarithm(low))).exp())


@functools.lru_cache(maxsize=256)
def _linear_in_table(iso: float, *pairs: Any) -> tuple[float, ...]:
    """Interpolate in a table of ISO, number or four numbers, …: linear in ln ISO between neighbours."""
    share, *ends = _neighbours(iso, pairs)
    count = max((len(end) for end in ends if isinstance(end, tuple)), default=1)
    low, high = (end if isinstance(end, tuple) else (end,) * count for end in ends)
    with localcontext(prec=DIGITS):
        return tuple(float(Decimal(a) + share * (Decimal(b) - Decimal(a))) for a, b in zip(low, high, strict=True))


def _neighbours(iso: float, pairs: Sequence[Any]) -> tuple[Decimal, Any, Any]:
    """Return the place of an ISO between its neighbours in a table, from 0 to 1 in ln ISO, and their values."""
    isos, values = pairs[::2], pairs[1::2]
    above = bisect.bisect_left(isos, iso)
    if isos[above] == iso:
        return Decimal(0), values[above], values[above]
    low, high = isos[above - 1 : above + 1]
    with localcontext(prec=DIGITS):
        return _logarithm(iso, low) / _logarithm(high, low), values[above - 1], values[above]


@functools.lru_cache(maxsize=256)
def _logarithm(x: float, unit: float = 0.0) -> Decimal:
    """Return ln x, or ln (x / unit), in the decimal context of the callers; most are the same for all images."""
    return (Decimal(x) / Decimal(unit) if unit else Decimal(x)).ln()


@functools.lru_cache(maxsize=256)
def _scatter_of_body(body: int) -> list[float]:
    """Return the uniforms at which the numbers of a body are drawn, by `Number.counter`."""
    return scatter_uniforms(body, max(declared.counter for declared in NUMBERS.values()) + 1)


@functools.lru_cache(maxsize=256)
def _doublings(celsius: float, reference_c: float, doubling_c: float) -> float:
    """Return the factor of the dark current against the reference temperature: 2**((T - T_ref) / T_doubling)."""
    with localcontext(prec=DIGITS):
        exponent = (Decimal(celsius) - Decimal(reference_c)) / Decimal(doubling_c)
        return float((exponent * Decimal(2).ln()).exp())


def by_site(by_colour: Sequence[float], pattern: str) -> list[float]:
    """Return values in the order of the sites (0, 0), (0, 1), (1, 0), (1, 1) from one, or from R, G1, B, G2."""
    red, green_1, blue, green_2 = by_colour if len(by_colour) == 4 else tuple(by_colour) * 4
    by_plane = dict(zip(cfa.plane_sites(pattern), (red, green_1, green_2, blue), strict=True))
    return [by_plane[y, x] for y in (0, 1) for x in (0, 1)]
