"""Matrix and gains at the white point of a frame follow the DNG specification."""

from __future__ import annotations

import numpy as np
import pytest

from unprocess_gen.sources.raw.colour import D50, DngColour, temperature

WARM = (0.9054, -0.4504, 0.0215, -0.4751, 1.2611, 0.2388, -0.0296, 0.0802, 0.6816)
COLD = (0.7662, -0.2686, -0.0660, -0.5240, 1.2965, 0.2530, -0.0796, 0.1508, 0.6167)
"""Matrices of a Sony ILCE-7RM4 for 2850 K and 6500 K, as in its DNG files."""


def planck_xy(kelvin: float) -> tuple[float, float]:
    """Return a chromaticity of the daylight locus (CIE 15)."""
    t = 1000 / kelvin
    x = 0.244063 + 0.09911 * t + 2.9678 * t**2 - 4.6070 * t**3
    return x, -3 * x * x + 2.87 * x - 0.275


@pytest.mark.parametrize("kelvin", [4000, 5003, 6504, 7000])
def test_temperature_is_that_of_daylight(kelvin: int) -> None:
    assert temperature(planck_xy(kelvin)) == pytest.approx(kelvin, rel=0.004)


@pytest.mark.parametrize("white", [(0.4476, 0.4074), (0.38, 0.377), D50, (0.3127, 0.3290), (0.29, 0.31)])
def test_white_point_gives_back_its_chromaticity(white: tuple[float, float]) -> None:
    stated = DngColour((WARM, COLD), (2850.0, 6500.0), white_xy=white)
    red, blue = stated.gains() or (0.0, 0.0)
    found = DngColour((WARM, COLD), (2850.0, 6500.0), neutral=(1 / red, 1.0, 1 / blue)).white()
    assert found == pytest.approx(white, abs=1e-6)


def test_matrix_is_mixed_by_reciprocal_temperature() -> None:
    share = (1 / temperature(D50) - 1 / 6500) / (1 / 2850 - 1 / 6500)
    scale = np.diag([1.02, 1.0, 0.97])
    wanted = np.diag([1.1, 1, 1]) @ scale @ (share * np.reshape(WARM, (3, 3)) + (1 - share) * np.reshape(COLD, (3, 3)))
    calibration = tuple(scale.ravel().tolist())
    for order in (1, -1):  # either light can be the first
        matrices, lights = (WARM, COLD)[::order], (2850.0, 6500.0)[::order]
        colour = DngColour(matrices, lights, (calibration, calibration), (1.1, 1.0, 1.0))
        assert colour.matrix_at(D50) == pytest.approx(wanted.ravel(), abs=1e-12)


def test_white_outside_of_the_lights_takes_the_nearer_matrix() -> None:
    colour = DngColour((WARM, COLD), (2850.0, 6500.0))
    assert colour.matrix_at((0.52, 0.41)) == WARM
    assert colour.matrix_at((0.28, 0.29)) == COLD
