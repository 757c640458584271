"""Conversion of light to DN, and of noise profiles to the sensor's DN."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.simulation.plan import SensorPlan
from unprocess_gen.simulation.reference.sensor import noise_in_dn, quantise, to_dn

IMX385, GENERIC_14 = (240, 4095), (1024, 16383)


def convert(a: float, b: float, **options: object) -> tuple[float, float]:
    defaults = {"units": "dn", "black": "subtracted", "profile_levels_dn": IMX385, "sensor_levels_dn": IMX385}
    return noise_in_dn(a, b, **(defaults | options))  # type: ignore[arg-type]


def hold_close(found: float, exact: Fraction, operations: int) -> None:
    """Each operation is off by half a unit in the last place, 2**-53, at the most."""
    assert abs(Fraction(found) - exact) <= operations * abs(exact) / 2**53 * (1 + Fraction(1, 10**6))


# Light to DN ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("black", "white"), [(240, 4095), (64, 1023), (256, 4095), (1024, 16383), (4096, 65535), (0, 1), (100, 4196)]
)
def test_light_is_clipped_and_linear_between_the_levels(black: int, white: int) -> None:
    light = np.array([-0.5, -1e-300, 0.0, 2.0**-13, 0.25, 1.0, 1 + 2**-52, 9.0, math.inf])
    span = white - black
    expected = [*[black] * 3, black + span * 2.0**-13, black + span * 0.25, *[white] * 4]
    assert to_dn(light, black, white).tolist() == expected


# Quantising -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "limits", "expected"),
    [
        ([0.5, 1.5, 2.5, 3.5, 4094.5], (0, 4095), [0, 2, 2, 4, 4094]),
        ([0.49, 0.51, math.nextafter(2.5, 0), math.nextafter(2.5, 9), 7.0], (0, 4095), [0, 1, 2, 3, 7]),
        ([-1.0, -70000.0, 70000.0, 1e10, 1e300, math.inf, -math.inf], (0, 65535), [0, 0, *[65535] * 4, 0]),
        ([-5.0, 239.6, 240.4, 4095.6], (240, 4095), [240, 240, 240, 4095]),
    ],
    ids=["halves to even", "nearest", "clipped before the cast", "limits of the caller"],
)
def test_values_are_rounded_then_clipped_then_cast(
    values: list[float], limits: tuple[int, int], expected: list[int]
) -> None:
    """A cast alone would wrap: 70000 to 4464, and -1 to 65535 or to 0, by the processor."""
    found = quantise(np.array(values), *limits)
    assert (found.tolist(), found.dtype) == (expected, np.uint16)


@pytest.mark.parametrize(
    ("bits", "black", "clip", "limits"),
    [(12, 240, "sensor", (0, 4095)), (12, 240, "black", (240, 4095)), (16, 4096, "sensor", (0, 65535)),
     (10, 64, "black", (64, 1023)), (14, 0, "black", (0, 16383))],
)  # fmt: skip
def test_noisy_frames_keep_the_pedestal_unless_clipped_at_black(
    bits: int, black: int, clip: str, limits: tuple[int, int]
) -> None:
    assert SensorPlan("RGGB", bits, black, 2**bits - 1, clip).limits_dn == limits


# Noise profiles -------------------------------------------------------------------------------------------------------


@given(st.floats(0, 1e4), st.floats(-1e6, 1e6))
def test_a_profile_on_its_own_sensor_is_unchanged(a: float, b: float) -> None:
    assert convert(a, b) == (a, b)


def test_an_included_black_level_is_subtracted() -> None:
    """RVDD: -2043.51144 + 8.0034 · 240 = -122.69544; the sum's own size, 2043, decides its rounding."""
    a, b = convert(8.0034, -2043.51144, black="included")
    assert a == 8.0034
    exact = Fraction("-122.69544")
    slack = Fraction(math.ulp(8.0034)) / 2 * 240 + Fraction(math.ulp(2043.51144)) * Fraction(3, 2)
    assert abs(Fraction(b) - exact) <= slack


def test_a_profile_is_scaled_by_the_ratio_of_level_ranges() -> None:
    """s = 15359 / 3855: slope times s, intercept times s²."""
    s = Fraction(16383 - 1024, 4095 - 240)
    a, b = convert(6.955588, 38.117816, sensor_levels_dn=GENERIC_14)
    hold_close(a, Fraction(6.955588) * s, 2)
    hold_close(b, Fraction(38.117816) * s * s, 4)


def test_the_profiles_black_level_is_subtracted_before_scaling() -> None:
    s = Fraction(16383 - 1024, 4095 - 240)
    _, b = convert(1.0, 10.0, black="included", sensor_levels_dn=GENERIC_14)
    hold_close(b, 250 * s * s, 4)


def test_normalized_units_use_the_sensors_range() -> None:
    """Brooks et al.: a · 3855, b · 3855²; the profile has no levels of its own."""
    a, b = convert(0.01, 0.001, units="normalized", profile_levels_dn=(0, 0))
    hold_close(a, Fraction(0.01) * 3855, 1)
    hold_close(b, Fraction(0.001) * 3855**2, 2)
