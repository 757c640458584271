"""Evaluate a physical noise profile for the ISO, exposure and temperature of one image.

Profiles are in electrons before the system gain K, and behind it in DN of the sensor they were calibrated on. A number
may depend on ISO (`iso_forms.ISO_FORMS`). A profile is valid for the calibrated ISOs only; a dual-gain sensor has
a branch on each side of the switch. Exponentials and logarithms are defined in `decimal` and rounded once, because the
last bit of libm's results differs between machines. `core.fixed_point` finds those of lines faster.
"""

from __future__ import annotations

import bisect
import functools
from collections.abc import Sequence
from decimal import Decimal, localcontext
from typing import Any, NamedTuple

from unprocess_gen.config.limits import EXPOSURE_S, ISO, OVERRIDDEN, TEMPERATURE_C
from unprocess_gen.config.schema import BranchConfig, Config
from unprocess_gen.core import fixed_point
from unprocess_gen.core.exact_distributions import DIGITS, normal_quantile
from unprocess_gen.core.random_streams import SCATTER, body_key, purpose
from unprocess_gen.planning.draws import Draw
from unprocess_gen.planning.parameters import draw_parameter
from unprocess_gen.simulation.kernels.draws import draws
from unprocess_gen.simulation.numbers import DN, RATE, SHAPE, SITES, Number
from unprocess_gen.simulation.plan import NUMBERS, Physics
from unprocess_gen.simulation.reference import cfa

MIDDLE = 0.5
"""Uniform at which a line has no scatter."""


class DrawnSensor(NamedTuple):
    """Drawn state of a sensor, from which the numbers of its effects follow."""

    iso: float
    exposure_s: float
    temperature_c: float
    unit: str
    seed: int


class PhysicalNoise:
    """A physical noise profile in a scene and on a sensor, with its distributions parsed."""

    def __init__(self, config: Config) -> None:
        noise, scene, sensor = config.noise, config.scene, config.sensor
        assert noise.white_level_dn is not None and noise.black_level_dn is not None
        self.noise, self.sensor = noise, sensor
        self.fixed_pattern_in_clean = config.clean.includes_fixed_pattern
        self.distributions = {
            Draw.ISO: ISO.parse("iso", scene.iso if noise.iso is None else noise.iso),
            Draw.EXPOSURE_S: EXPOSURE_S.parse("exposure_s", scene.exposure_s),
            Draw.TEMPERATURE_C: TEMPERATURE_C.parse("temperature_c", scene.temperature_c),
        }
        self.scale = (sensor.white_level_dn - sensor.black_level_dn) / (noise.white_level_dn - noise.black_level_dn)
        self.has_lens_shading = any(noise.lens_shading or ())
        self._numbers = [self._numbers_of(branch) for branch in noise.branches]

    def _numbers_of(self, branch: BranchConfig) -> list[tuple[str, Number, Any]]:
        """Names, declarations and values of the numbers that the profile has in a branch."""
        values = (
            (name, declared, getattr(branch if declared.in_branch else self.noise, declared.key or name))
            for name, declared in NUMBERS.items()
        )
        return [number for number in values if number[2] is not None]

    def draw(self, uniforms: Sequence[float], stream_key: int, seed: int) -> DrawnSensor:
        """Draw ISO, exposure, temperature and sensor unit; ``stream_key`` identifies it with ``sensor.units=image``."""
        units, drawn = self.sensor.units, self.distributions.items()
        unit = f"{stream_key:016x}" if units == "image" else str(int(uniforms[Draw.SENSOR_UNIT] * units))
        iso, seconds, celsius = (draw_parameter(distribution, uniforms[draw]) for draw, distribution in drawn)
        return DrawnSensor(iso, seconds, celsius, unit, seed)

    def physics(self, drawn: DrawnSensor) -> Physics:
        """Convert the numbers of the profile to DN of the sensor, with the scatter of the unit.

        DN of the profile become DN of the sensor by the factor s = (W - B) / (W_profile - B_profile).
        """
        noise, iso = self.noise, drawn.iso
        # fixed patterns stay the same if a number is overridden
        key = body_key(drawn.seed, noise.name.removesuffix(OVERRIDDEN), drawn.unit)
        number = next(n for n, branch in enumerate(noise.branches) if branch.iso[0] <= iso <= branch.iso[1])
        scatter = None if noise.scatter == "off" else _scatter_of_body(key)
        heat = _doublings(drawn.temperature_c, noise.dark_reference_c, noise.dark_doubling_c)
        values: dict[str, Any] = {}
        for name, declared, value in self._numbers[number]:
            if declared.kind == RATE:
                value = value * drawn.exposure_s * heat
            elif declared.kind == DN:
                uniform = MIDDLE if scatter is None or declared.counter < 0 else scatter[declared.counter]
                value = evaluate(value, iso, uniform) * self.scale
            elif declared.kind == SHAPE:
                (value,) = linear_values(value, iso)
            elif declared.kind == SITES:
                errors = by_site(linear_values(value, iso), self.sensor.pattern)
                value = tuple(error * self.scale for error in errors)
            elif declared.count > 1:
                value = tuple(map(float, value))
            values[name] = value
        return Physics(
            iso=iso,
            exposure_s=drawn.exposure_s,
            temperature_c=drawn.temperature_c,
            dark_offset=self.sensor.dark_offset,
            sensor_unit=drawn.unit,
            body_key=key,
            fixed_pattern_in_clean=self.fixed_pattern_in_clean,
            **values,
        )


def evaluate(form: Any, iso: float, uniform: float = MIDDLE) -> float:
    """Evaluate a gain or standard deviation of a branch: a number, or one of `iso_forms.ISO_FORMS`.

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
    isos, low, high = _neighbours(iso, pairs)
    if low == high or isos[0] == isos[1]:
        return float(low)
    value = fixed_point.nearest_log_between(iso, *isos, low, high)
    if value is not None:
        return value
    with localcontext(prec=DIGITS):
        share = _share(iso, *isos)
        return float((Decimal(low).ln() + share * (Decimal(high).ln() - Decimal(low).ln())).exp())


@functools.lru_cache(maxsize=256)
def _linear_in_table(iso: float, *pairs: Any) -> tuple[float, ...]:
    """Interpolate in a table of ISO, number or four numbers, …: linear in ln ISO between neighbours."""
    isos, *ends = _neighbours(iso, pairs)
    count = max((len(end) for end in ends if isinstance(end, tuple)), default=1)
    low, high = (end if isinstance(end, tuple) else (end,) * count for end in ends)
    if isos[0] == isos[1]:
        return tuple(map(float, low))
    values = fixed_point.nearest_between(iso, *isos, low, high)
    if values is not None:
        return values
    with localcontext(prec=DIGITS):
        share = _share(iso, *isos)
        return tuple(float(Decimal(a) + share * (Decimal(b) - Decimal(a))) for a, b in zip(low, high, strict=True))


def _neighbours(iso: float, pairs: Sequence[Any]) -> tuple[tuple[float, float], Any, Any]:
    """Return the neighbours of an ISO in a table, and their values; twice the same one if the table has the ISO."""
    isos, values = pairs[::2], pairs[1::2]
    above = bisect.bisect_left(isos, iso)
    below = above if isos[above] == iso else above - 1
    return (isos[below], isos[above]), values[below], values[above]


def _share(iso: float, low: float, high: float) -> Decimal:
    """Place of an ISO between its neighbours, from 0 to 1 in ln ISO, in the decimal context of the caller."""
    return (Decimal(iso) / Decimal(low)).ln() / (Decimal(high) / Decimal(low)).ln()


@functools.lru_cache(maxsize=256)
def _scatter_of_body(body: int) -> list[float]:
    """Return the uniforms at which the numbers of a body are drawn, by `Number.counter`."""
    count = max(declared.counter for declared in NUMBERS.values()) + 1
    uniforms: list[float] = draws(body, count, purpose(SCATTER))[1].tolist()
    return uniforms


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
