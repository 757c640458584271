"""Evaluate a physical noise profile for the ISO, exposure and temperature of one image.

Profiles are in electrons before the system gain K, and behind it in DN of the sensor they were calibrated on. A number
may depend on ISO, in one of `FORMS`. A profile is valid for the calibrated ISOs only; a dual-gain sensor has a branch
on each side of the switch. Exponentials and logarithms are computed in `decimal` and rounded once, because the last bit
of libm's results differs between machines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from decimal import Decimal, localcontext
from typing import Any

from unprocess_gen.config.distributions import draw_parameter, parse_drawn
from unprocess_gen.config.interpretation import branch_of
from unprocess_gen.config.limits import EXPOSURE_S, ISO, READ_SHAPE, TEMPERATURE_C
from unprocess_gen.config.schema import BranchConfig, Config, NoiseConfig
from unprocess_gen.core.exact_distributions import DIGITS, normal_quantile, tukey_std
from unprocess_gen.core.random_streams import body_key
from unprocess_gen.core.types import Physics


def plan_physics(config: Config, uniforms: dict[str, float], stream_key: int) -> Physics:
    """Draw ISO, exposure, temperature and the scatter of a profile, and convert its numbers to the sensor's DN.

    DN of the profile become DN of the sensor by the factor s = (W - B) / (W_profile - B_profile).

    Parameters
    ----------
    config : Config
        A configuration with a physical noise profile that `validate_config` accepts.
    uniforms : dict of str to float
        A uniform in (0, 1) for each name of `plan.PARAMETERS`.
    stream_key : int
        Key of the image's random stream; identifies the camera body if ``sensor.units=image``.

    Returns
    -------
    Physics
        Numbers of the sensor for this image: electrons before the gain, DN of the sensor behind it.
    """
    noise, scene, sensor = config.noise, config.scene, config.sensor
    iso, seconds, celsius = (
        draw_parameter(parse_drawn(key, value, limit), uniforms[key])
        for key, value, limit in (
            ("iso", scene.iso if noise.iso is None else noise.iso, ISO),
            ("exposure_s", scene.exposure_s, EXPOSURE_S),
            ("temperature_c", scene.temperature_c, TEMPERATURE_C),
        )
    )
    branch = branch_of(noise, iso)
    assert branch is not None and noise.white_level_dn is not None and noise.black_level_dn is not None
    scale = (sensor.white_level_dn - sensor.black_level_dn) / (noise.white_level_dn - noise.black_level_dn)
    gain = number(branch.dn_per_e, iso=iso)
    shape = draw_parameter(parse_drawn("read_shape", branch.read_shape, READ_SHAPE), uniforms["read_shape"])
    warmth = _doublings(celsius, noise)
    unit = f"{stream_key:016x}" if sensor.units == "image" else str(int(uniforms["sensor_unit"] * sensor.units))
    errors = _black_error(branch, iso)
    return Physics(
        iso=iso,
        exposure_s=seconds,
        temperature_c=celsius,
        dn_per_e=gain * scale,
        prnu_std=noise.prnu_std or 0.0,
        dark_e=(noise.dark_e_per_s or 0.0) * seconds * warmth,
        dark_offset=sensor.dark_offset,
        hot_pixel_share=noise.hot_pixel_share or 0.0,
        hot_pixel_e=(noise.hot_pixel_e_per_s or 0.0) * seconds * warmth,
        full_well_e=noise.full_well_e or 0.0,
        read_law=branch.read_law,
        read_shape=shape,
        read_std_dn=number(branch.read_std_dn, iso=iso, gain=gain, uniform=uniforms["read_std"], shape=shape) * scale,
        row_std_dn=number(branch.row_std_dn, iso=iso, gain=gain, uniform=uniforms["row_std"]) * scale,
        column_std_dn=number(branch.column_std_dn, iso=iso, gain=gain, uniform=uniforms["column_std"]) * scale,
        black_error_dn=(errors[0] * scale, errors[1] * scale, errors[2] * scale, errors[3] * scale),
        dead_pixel_share=noise.dead_pixel_share or 0.0,
        sensor_unit=unit,
        body_key=body_key(config.seed, noise.name, unit),
        fixed_pattern_in_clean=config.clean.includes_fixed_pattern,
    )


def _doublings(celsius: float, noise: NoiseConfig) -> float:
    """Return the factor of the dark current against the reference temperature: 2**((T - T_ref) / T_doubling)."""
    with localcontext(prec=DIGITS):
        exponent = (Decimal(celsius) - Decimal(noise.dark_reference_c)) / Decimal(noise.dark_doubling_c)
        return float((exponent * Decimal(2).ln()).exp())


def number(form: Any, *, iso: float, gain: float = 1.0, uniform: float = 0.5, shape: float = 0.0) -> float:
    """Evaluate a number of a branch: a plain number, or one of `FORMS`; None gives 0.

    ``gain`` is K in DN of the profile; ``uniform`` draws the scatter of a line; ``shape`` is the λ of the Tukey-λ
    distribution.
    """
    if form is None:
        return 0.0
    if not isinstance(form, list):
        return float(form)
    with localcontext(prec=DIGITS):
        return float(FORMS[form[0]](Decimal(iso), Decimal(gain), uniform, shape, *map(Decimal, form[1:])))


def _per_iso(
    iso: Decimal, gain: Decimal, u: float, shape: float, slope: Decimal, intercept: Decimal = Decimal(0)
) -> Decimal:
    return slope * iso + intercept


def _root(iso: Decimal, gain: Decimal, u: float, shape: float, *coefficients: Decimal) -> Decimal:
    """Return √(c0 + c1·ISO + c2·ISO²): the standard deviation of a variance that is a polynomial in ISO."""
    total = Decimal(0)
    for coefficient in reversed(coefficients):
        total = total * iso + coefficient
    return total.sqrt()


def _line(
    iso: Decimal, gain: Decimal, u: float, shape: float, slope: Decimal, intercept: Decimal, std: Decimal
) -> Decimal:
    """Return σ from ln σ = slope · ln K + intercept + std · n, where n is a standard normal deviate (ELD)."""
    scatter = std * normal_quantile(Decimal(u)) if std else Decimal(0)
    return (slope * gain.ln() + intercept + scatter).exp()


def _scale_line(iso: Decimal, gain: Decimal, u: float, shape: float, *line: Decimal) -> Decimal:
    """Return the standard deviation of Tukey-λ noise: its scale by `_line`, times its standard deviation at scale 1."""
    return _line(iso, gain, u, shape, *line) * tukey_std(shape)


FORMS: dict[str, Callable[..., Decimal]] = {
    "per_iso": _per_iso,
    "root": _root,
    "line": _line,
    "scale_line": _scale_line,
}
"""Functions that a branch may contain instead of a number, as ``[form, number, …]``."""


def _black_error(branch: BranchConfig, iso: float) -> Sequence[float]:
    """Return the black-level errors of the four sites of the CFA pattern, DN of the profile.

    A branch has one for all sites, four, or a table of rows. Rows divide the branch's range of ln ISO into equal parts.
    """
    value = branch.black_error_dn
    if value is None:
        return (0.0,) * 4
    if not isinstance(value, list):
        return (float(value),) * 4
    if value[0] != "by_log_iso":
        return [float(each) for each in value]
    table, (low, high) = value[1:], branch.iso
    if low == high:
        return [float(each) for each in table[0]]
    with localcontext(prec=DIGITS):
        place = (Decimal(iso) / Decimal(low)).ln() / (Decimal(high) / Decimal(low)).ln()
    return [float(each) for each in table[min(int(place * len(table)), len(table) - 1)]]
