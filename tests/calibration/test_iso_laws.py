"""Numbers of several ISOs become laws where they fit, tables where they do not, and branches at a change of gain."""

from __future__ import annotations

import pytest

from unprocess_gen.calibration.gain import Estimate, estimate
from unprocess_gen.calibration.iso_laws import black_law, gain_law, joined_branches, modes, std_law

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


def test_line_is_used_where_it_fits() -> None:
    assert gain_law(ISOS, exact(*(0.01 * iso for iso in ISOS))) == ["per_iso", 0.01]
    assert gain_law(ISOS, exact(*(0.01 * iso + 1 for iso in ISOS))) == [
        "per_iso",
        pytest.approx(0.01),
        pytest.approx(1),
    ]
    assert gain_law(ISOS, exact(1, 2, 3, 9, 16, 32)) is None


def test_gains_on_no_line_are_joined_in_pairs() -> None:
    """Neighbours whose gains rise faster than ISO do not lie on a line that is positive at ISO 0."""
    assert joined_branches(ISOS, exact(1, 2, 3, 9, 16, 32), [[*range(6)]]) == [[0, 1], [1, 2], [3, 4], [4, 5]]


def test_table_is_used_where_no_law_fits() -> None:
    assert std_law(ISOS[:3], exact(3, 4, 3.5)) == ["by_iso", 100, 3, 200, 4, 400, 3.5]
    assert std_law(ISOS[:3], exact(2, 2, 2)) == ["root", pytest.approx(4)]


def test_black_errors_of_unequal_steps_keep_their_iso() -> None:
    """Rows divide the range of ln ISO into equal parts."""
    law = black_law([100, 125, 1600], [[1.0], [2.0], [3.0]], by_colour=False)
    assert law[0] == "by_log_iso"
    rows = law[1:]
    assert [rows[0][0], rows[int(0.0805 * len(rows))][0], rows[-1][0]] == [1, 2, 3]
