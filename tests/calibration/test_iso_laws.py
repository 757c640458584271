"""Numbers of several ISOs become tables, in branches at a change of gain."""

from __future__ import annotations

import pytest

from unprocess_gen.calibration.gain import Estimate, estimate
from unprocess_gen.calibration.iso_laws import black_law, modes, table

ISOS = [100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0]


def exact(*values: float) -> list[Estimate]:
    return [estimate(value, 1e-3 * value) for value in values]


def test_lower_read_noise_begins_a_branch() -> None:
    """Values of the A7S II at full stops (PMN), which switches its gain at ISO 2000."""
    assert modes(ISOS, exact(1.01, 1.29, 2.06, 3.55, 6.30, 3.92)) == [[0, 1, 2, 3, 4], [5]]


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_read_noise_of_one_gain_mode_is_one_branch(power: float) -> None:
    """Standard deviations grow as ISO to a power of at most 1 behind an amplifier."""
    reads = [(1 + (iso / 100) ** (2 * power)) ** 0.5 for iso in ISOS]
    assert modes(ISOS, exact(*reads)) == [[*range(6)]]


def test_numbers_of_several_isos_are_a_table() -> None:
    """A standard deviation of 0 has no logarithm."""
    assert table(ISOS[:3], [3, 0, 3.5]) == ["by_iso", 100, 3, 200, 0.0035, 400, 3.5]
    assert (table(ISOS[:1], [2]), table(ISOS[:2], [0, 0])) == (2, 0)


def test_black_errors_of_unequal_steps_keep_their_iso() -> None:
    assert black_law([100, 125], [[1.0], [2.0]]) == ["by_iso", 100, 1, 125, 2]
    assert black_law([100, 125], [[1.0] * 4, [2.0] * 4]) == ["by_iso", 100, [1] * 4, 125, [2] * 4]
