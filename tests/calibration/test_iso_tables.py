"""Numbers of several ISOs become tables, in branches at a change of gain."""

from __future__ import annotations

import numpy as np
import pytest

from unprocess_gen.calibration.gain import Transfer, estimate, gain_change, root_estimate
from unprocess_gen.calibration.profile import modes, std_table, table

ISOS = [100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0]
POWERS = [[(1 + (iso / 100) ** (2 * power)) ** 0.5 for iso in ISOS] for power in (0.0, 0.5, 1.0)]


@pytest.mark.parametrize(
    ("reads", "branches"),
    [([1.01, 1.29, 2.06, 3.55, 6.30, 3.92], [[0, 1, 2, 3, 4], [5]]), *((reads, [[*range(6)]]) for reads in POWERS)],
)
def test_lower_read_noise_begins_a_branch(reads: list[float], branches: list[list[int]]) -> None:
    """The A7S II (PMN) switches its gain at ISO 2000; behind an amplifier, noise is ISO to a power of at most 1."""
    assert modes(ISOS, [estimate(read, 1e-3 * read) for read in reads]) == branches


def test_numbers_of_several_isos_are_a_table() -> None:
    """A standard deviation of 0 has no logarithm; unequal steps keep their ISO."""
    assert std_table(ISOS[:3], [3, 0, 3.5]) == ["by_iso", 100, 3, 200, 0.0035, 400, 3.5]
    assert (std_table(ISOS[:1], [2]), std_table(ISOS[:2], [0, 0])) == (2, 0)
    assert table([100, 125], [[1.0] * 4, [2.0] * 4]) == ["by_iso", 100, [1] * 4, 125, [2] * 4]


@pytest.mark.parametrize("errors", [-3.0, -1.0, 0.0, 1.0, 2.5, 2.99, 3.01, 9.0])
def test_interval_of_a_deviation_contains_its_value(errors: float) -> None:
    number = root_estimate(errors * 0.04, 0.04)
    assert (number.value == 0) == (errors < 3)
    assert number.low <= number.value < number.high


@pytest.mark.parametrize("change", [0.0, -0.05, 0.1])
def test_change_of_the_gain_is_that_of_the_line(change: float) -> None:
    """Variance/signal is a line, and errors of levels of 1 % do not show 0.1 % of change."""
    signal = np.linspace(100.0, 4000.0, 10)
    curve = Transfer(signal, signal * (0.3 + 0.3 * change * signal / 4000), 1e-3 * signal, 0 * signal, 0 * signal)
    number = gain_change([curve] * 4, 5.0)
    assert number.value == pytest.approx(change, abs=1e-9)
    assert (number.low < 0 < number.high) == (change == 0) and number.error > 1e-3
