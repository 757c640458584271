"""Evaluate a physical noise profile for the ISO, exposure and temperature of one image.

Profiles are in electrons before the system gain K, and behind it in DN of the sensor they were calibrated on. A number
may depend on ISO, in one of `FORMS`. A profile is valid for the calibrated ISOs only; a dual-gain sensor has a branch
on each side of the switch. Exponentials and logarithms are defined in `decimal` and rounded once, because the last bit
of libm's results differs between machines. `core.fixed_point` finds nearly all of them faster.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from decimal import Decimal, localcontext
from typing import Any

from unprocess_gen.config.distributions import draw_parameter, parse_drawn
from unprocess_gen.config.interpretation import branch_of, row_of_stop, table_words
from unprocess_gen.config.limits import EXPOSURE_S, ISO, READ_SHAPE, SCATTER, TEMPERATURE_C
from unprocess_gen.config.schema import BranchConfig, Config
from unprocess_gen.core import fixed_point
from unprocess_gen.core.exact_distributions import DIGITS, normal_quantile, tukey_std
from unprocess_gen.core.random_streams import body_key, scatter_uniforms
from unprocess_gen.core.types import Distribution
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
        self.read_shapes = [_parse_shape(branch.read_shape) for branch in noise.branches]
        self.scatter = SCATTER.word(noise.scatter)
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
        gain, shape = evaluate(branch.dn_per_e, iso=iso), 0.0
        values: dict[str, Any] = {}
        for name, declared in NUMBERS.items():
            value = getattr(branch if declared.in_branch else self.noise, declared.key or name)
            if value is None:
                continue
            if declared.kind == RATE:
                value = value * exposure[0] * exposure[1]
            elif declared.kind == SHAPE:
                value = shape = self._shape(branch, iso, uniform(declared))
            elif declared.kind == DN:
                value = evaluate(value, iso=iso, gain=gain, uniform=uniform(declared), shape=shape) * self.scale
            elif declared.kind == SITES:
                value = tuple(error * self.scale for error in _values_of_sites(value, branch, iso, self.sensor.pattern))
            elif declared.count > 1:
                value = tuple(map(float, value))
            values[name] = value
        return values

    def _scatter(self, body: int) -> Callable[[Number], float]:
        """Return the uniform at which each number of a body is drawn."""
        if self.scatter == "off":
            return lambda declared: MIDDLE
        scatter = _scatter_of_body(body)
        return lambda declared: scatter[declared.counter]

    def _shape(self, branch: BranchConfig, iso: float, uniform: float) -> float:
        """Return the shape of the read noise; without scatter, the median of a distribution."""
        shapes = self.read_shapes[self.noise.branches.index(branch)]
        if shapes is None:
            return _shape_at(branch.read_shape, iso)
        if self.scatter == "off":
            return sorted(shapes.numbers)[len(shapes.numbers) // 2]
        return draw_parameter(shapes, uniform)


def evaluate(form: Any, *, iso: float, gain: float = 1.0, uniform: float = 0.5, shape: float = 0.0) -> float:
    """Evaluate a number of a branch: a plain number, or one of `FORMS`; None gives 0.

    ``gain`` is K in DN of the profile; ``uniform`` draws the scatter of a line; ``shape`` is the λ of the Tukey-λ
    distribution.
    """
    if form is None:
        return 0.0
    if not isinstance(form, list | tuple):
        return float(form)
    kind, *numbers = form
    if kind not in LINES:
        return _number_of_iso(kind, iso, *numbers)
    return _number_of_line(kind, iso, gain, uniform, shape, *numbers)


LINES = ("line", "scale_line")
"""Forms that depend on the gain and a uniform; the other forms depend on the ISO only."""


# Numbers are computed once for each value of what they depend on. Most configs fix the ISO and the temperature, a
# profile lists few shapes, and the scatter of a body is the same for all its images. Without these caches, a plan takes
# 0.3 ms more.


@functools.lru_cache(maxsize=256)
def _number_of_iso(kind: str, iso: float, *numbers: float) -> float:
    """Evaluate a form that depends on the ISO only."""
    with localcontext(prec=DIGITS):
        return float(ISO_FUNCTIONS[kind](Decimal(iso), *map(Decimal, numbers)))


@functools.lru_cache(maxsize=256)
def _number_of_line(
    kind: str, iso: float, gain: float, uniform: float, shape: float, slope: float, intercept: float, std: float
) -> float:
    """Return σ from ln σ = slope · ln K + intercept + std · n, where n is a standard normal deviate (ELD).

    ``scale_line`` gives the scale of Tukey-λ noise, which is multiplied by its standard deviation at scale 1.
    """
    scale = _fixed_tukey_std(shape) if kind == "scale_line" else fixed_point.ONE
    value = fixed_point.nearest_log_linear(uniform, gain, slope, intercept, std, scale)
    if value is not None:
        return value
    with localcontext(prec=DIGITS):
        scatter = Decimal(std) * normal_quantile(Decimal(uniform)) if std else Decimal(0)
        sigma = (Decimal(slope) * Decimal(gain).ln() + Decimal(intercept) + scatter).exp()
        return float(sigma * _tukey_std(shape) if kind == "scale_line" else sigma)


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


@functools.lru_cache(maxsize=256)
def _tukey_std(shape: float) -> Decimal:
    """Return the standard deviation of Tukey's lambda distribution of scale 1, to `DIGITS` digits."""
    with localcontext(prec=DIGITS):
        return tukey_std(shape)


@functools.lru_cache(maxsize=256)
def _fixed_tukey_std(shape: float) -> int:
    return fixed_point.fixed(_tukey_std(shape))


@functools.lru_cache(maxsize=256)
def _place(iso: float, low: float, high: float) -> Decimal:
    """Return the place of an ISO in the range of ln ISO of a branch, from 0 to 1."""
    with localcontext(prec=DIGITS):
        return (Decimal(iso) / Decimal(low)).ln() / (Decimal(high) / Decimal(low)).ln()


def _per_iso(iso: Decimal, slope: Decimal, intercept: Decimal = Decimal(0)) -> Decimal:
    return slope * iso + intercept


def _root(iso: Decimal, *coefficients: Decimal) -> Decimal:
    """Return √(c0 + c1·ISO + c2·ISO²): the standard deviation of a variance that is a polynomial in ISO."""
    total = Decimal(0)
    for coefficient in reversed(coefficients):
        total = total * iso + coefficient
    return total.sqrt()


def _by_iso(iso: Decimal, *pairs: Decimal) -> Decimal:
    """Interpolate standard deviations: ln σ is linear in ln ISO between neighbours of a table of ISO, σ, …."""
    share, low, high = _neighbours(iso, pairs)
    return (low.ln() + share * (high.ln() - low.ln())).exp()


def _neighbours(iso: Decimal, pairs: Sequence[Decimal]) -> tuple[Decimal, Decimal, Decimal]:
    """Return the place of an ISO between its neighbours in a table, from 0 to 1 in ln ISO, and their values."""
    isos, values = pairs[::2], pairs[1::2]
    above = next((place for place, table_iso in enumerate(isos) if iso <= table_iso), len(isos) - 1)
    if iso >= isos[above] or not above:
        return Decimal(0), values[above], values[above]
    low, high = isos[above - 1], isos[above]
    return (iso / low).ln() / (high / low).ln(), values[above - 1], values[above]


ISO_FUNCTIONS: dict[str, Callable[..., Decimal]] = {"per_iso": _per_iso, "root": _root, "by_iso": _by_iso}
FORMS = (*ISO_FUNCTIONS, *LINES)
"""Functions that a branch may contain instead of a number, as ``[form, number, …]``."""


ROW_DIGITS = 28
"""Digits of the product that selects a row. At the ISO where a row starts, the logarithms are a little too small, and
this product rounds up to the row; datasets depend on it."""


def _values_of_sites(value: Any, branch: BranchConfig, iso: float, pattern: str) -> Sequence[float]:
    """Return the values of the four sites of the CFA pattern, DN of the profile.

    A branch has one for all sites, four, or a table of rows. ``by_log_iso``: rows divide the branch's range of ln ISO
    into equal parts. ``by_stop``: two rows for each full stop. ``by_colour``: fours are R, G1, B, G2, where G1 is the
    green of the red rows; otherwise they are sites, row by row.
    """
    if not isinstance(value, list | tuple):
        return (float(value),) * 4
    words, rest = table_words(value)
    if "by_stop" in words:
        rest = rest[row_of_stop(iso)]
    elif "by_log_iso" in words:
        rest = rest[_row_of_range(iso, branch.iso[0], branch.iso[1], len(rest))]
    values = list(map(float, rest))
    return _by_site(values, pattern) if "by_colour" in words else values


def _row_of_range(iso: float, low: float, high: float, rows: int) -> int:
    """Return the row of a table ``by_log_iso`` for an ISO in the range of a branch."""
    if low == high:
        return 0
    with localcontext(prec=ROW_DIGITS):
        return min(int(_place(iso, low, high) * rows), rows - 1)


def _by_site(by_colour: Sequence[float], pattern: str) -> list[float]:
    """Return values in the order of the sites (0, 0), (0, 1), (1, 0), (1, 1) from R, G1, B, G2."""
    red, green_1, blue, green_2 = by_colour
    by_plane = dict(zip(cfa.plane_sites(pattern), (red, green_1, green_2, blue), strict=True))
    return [by_plane[y, x] for y in (0, 1) for x in (0, 1)]


def _parse_shape(value: Any) -> Distribution | None:
    """Return the distribution that shapes are drawn from; None for a table by ISO."""
    return (
        None if table_words(value)[0][:1] in (["by_iso"], ["by_stop"]) else parse_drawn("read_shape", value, READ_SHAPE)
    )


def _shape_at(table: Sequence[Any], iso: float) -> float:
    """Return the shape at an ISO from a table ``by_stop``, or ``by_iso``: linear in ln ISO."""
    kind, *numbers = table
    return float(numbers[row_of_stop(iso)]) if kind == "by_stop" else _interpolated(iso, *numbers)


@functools.lru_cache(maxsize=256)
def _interpolated(iso: float, *pairs: float) -> float:
    with localcontext(prec=DIGITS):
        share, low, high = _neighbours(Decimal(iso), [Decimal(number) for number in pairs])
        return float(low + share * (high - low))
