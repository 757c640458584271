"""Camera matrices: white stays exactly white in any order of additions; other colours change by rounding only."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.colour import CAMERAS, IDENTITY, RGB2XYZ, Matrix

U = Fraction(1, 2**53)
"""Largest relative error of one operation: half a unit in the last place of 1."""

entries = st.floats(-4, 4, allow_subnormal=False)
matrices = st.tuples(*[entries] * 9)


@st.composite
def weights(draw: st.DrawFn) -> tuple[float, ...]:
    """Draw four uniform numbers divided by their sum, including corners and edges."""
    uniforms = draw(st.tuples(*[st.floats(0, 1)] * 4))
    total = sum(uniforms)
    assume(total > 1e-6)
    return tuple(uniform / total for uniform in uniforms)


def rows(matrix: Matrix) -> list[tuple[float, float, float]]:
    return [matrix[0:3], matrix[3:6], matrix[6:9]]


def sums(row: tuple[float, float, float]) -> set[float]:
    """Return the sums of the entries in every order of additions."""
    return {(a + b) + c for a, b, c in itertools.permutations(row)}


def exact_product(left: list[Fraction], right: list[Fraction]) -> list[Fraction]:
    return [sum(left[3 * i + k] * right[3 * k + j] for k in range(3)) for i in range(3) for j in range(3)]


def fractions(numbers: Matrix) -> list[Fraction]:
    return [Fraction(number) for number in numbers]


# White ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", CAMERAS)
def test_rows_of_a_camera_sum_to_exactly_1(camera: str) -> None:
    for row in rows(colour.rgb2cam(CAMERAS[camera])):
        assert sums(row) == {1.0}


@pytest.mark.parametrize("count", [2000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_rows_of_custom_matrices_sum_to_exactly_1(count: int) -> None:
    """Any matrix that `camera=custom` accepts: rows with entries up to 4, including cancellation."""
    random_rows = np.random.Generator(np.random.Philox(key=1)).uniform(-4, 4, (count, 3))
    taken = [row for row in random_rows.tolist() if abs(sum(row)) > 0.01]
    missed = [row for row in taken if sums(colour.normalise_rows((*row, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))[:3]) != {1.0}]
    assert missed == []


# Accuracy -------------------------------------------------------------------------------------------------------------


def hold_near_exact(xyz2cam: Matrix, exact_xyz2cam: list[Fraction], mixed_of: int) -> None:
    """Compare each entry with the exactly normalised exact product.

    A sum of n rounded products is off by n·u of the sum of their sizes; a quotient by the sizes' share of the row sum;
    the grid by two units of 2**-52 of the largest entry. All to first order, hence the last factor.
    """
    found = fractions(colour.rgb2cam(xyz2cam))
    product = exact_product(exact_xyz2cam, fractions(RGB2XYZ))
    size = exact_product(
        [abs(entry) for entry in exact_xyz2cam], [abs(entry) for entry in fractions(RGB2XYZ)]
    )  # no cancellation in the sizes
    for i in (0, 3, 6):
        total, total_size = sum(product[i : i + 3]), sum(size[i : i + 3])
        exact = [entry / total for entry in product[i : i + 3]]
        largest = max(abs(entry) for entry in exact)
        for j in range(3):
            operations = (3 + mixed_of) * U * size[i + j] / abs(total)
            operations += abs(exact[j]) * ((3 + mixed_of + 2) * U * total_size / abs(total) + U)
            assert abs(found[i + j] - exact[j]) <= (operations + 2 * 2 * U * largest) * (1 + Fraction(1, 10**6))


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_camera_is_the_exactly_normalised_product(camera: str) -> None:
    hold_near_exact(CAMERAS[camera], fractions(CAMERAS[camera]), 0)


@given(weights())
def test_a_mixture_is_the_exactly_normalised_product(mix: tuple[float, ...]) -> None:
    """The error is relative to the sizes of the entries, because some of them cancel between cameras."""
    mixed = colour.mix(tuple(CAMERAS.values()), mix)
    exact = [sum(Fraction(w) * Fraction(m[i]) for w, m in zip(mix, CAMERAS.values(), strict=True)) for i in range(9)]
    for i in range(9):
        size = sum(Fraction(w) * abs(Fraction(m[i])) for w, m in zip(mix, CAMERAS.values(), strict=True))
        assert abs(Fraction(mixed[i]) - exact[i]) <= 4 * U * size * (1 + Fraction(1, 10**6)) + Fraction(1, 2**1070)
    hold_near_exact(mixed, fractions(mixed), 0)


# Inverse --------------------------------------------------------------------------------------------------------------


def exact_inverse(numbers: Matrix) -> list[Fraction] | None:
    """Invert by Gauss-Jordan elimination in fractions, independent of cofactors."""
    left = [[Fraction(entry) for entry in row] + [Fraction(int(i == j)) for j in range(3)] for i, row in
            enumerate(rows(numbers))]  # fmt: skip
    for column in range(3):
        pivot = next((row for row in range(column, 3) if left[row][column]), None)
        if pivot is None:
            return None
        left[column], left[pivot] = left[pivot], left[column]
        left[column] = [entry / left[column][column] for entry in left[column]]
        for row in range(3):
            if row != column:
                factor = left[row][column]
                left[row] = [a - factor * b for a, b in zip(left[row], left[column], strict=True)]
    return [entry for row in left for entry in row[3:]]


@given(matrices)
def test_an_inverse_is_exact_and_rounded_once(own: Matrix) -> None:
    exact = exact_inverse(own)
    assume(exact is not None and max(abs(entry) for entry in exact) < 1e300)
    assert list(colour.invert(own)) == [float(entry) for entry in exact or ()]


@pytest.mark.parametrize(
    "singular",
    [
        (0.0,) * 9,
        (1.0, 2.0, 3.0, 2.0, 4.0, 6.0, 1.0, 1.0, 1.0),
        (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0),
        (0.0, 1.0, 1.0, 0.0, 1.0, 2.0, 0.0, 2.0, 1.0),
    ],
)
def test_a_singular_matrix_is_refused(singular: Matrix) -> None:
    with pytest.raises(ValueError, match="singular"):
        colour.invert(singular)
    assert colour.condition(singular) == math.inf
    with pytest.raises(ValueError, match="not invertible"):
        colour.normalise_rows(singular)
    with pytest.raises(ValueError, match="not invertible"):
        colour.rgb2cam(singular)


def nearly_singular(condition: float) -> Matrix:
    """Return a matrix with two rows that differ by e.

    Its norm is 2 + e, that of its inverse (2 + e) / e, so the condition number is 4 / e + 4 + e.
    """
    e = 4 / condition
    return (1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 1.0 + e)


@pytest.mark.parametrize("condition", [1.1e10, 1e14])
def test_a_nearly_singular_matrix_is_refused(condition: float) -> None:
    with pytest.raises(ValueError, match=r"not invertible \(condition number above 1e\+10\)"):
        colour.normalise_rows(nearly_singular(condition))


of_any_size = st.floats(-1, 1) | st.floats(-1e-3, 1e-3) | st.sampled_from([0.0, 1.0, -1.0])


@given(st.lists(of_any_size, min_size=9, max_size=9), st.integers(-320, 308))
def test_the_determinant_accepts_only_invertible_matrices(numbers: list[float], power: int) -> None:
    """The quick test of the determinant may refuse what fractions accept, but not the reverse."""
    own = colour.matrix([number * 10.0**power for number in numbers])
    if colour._is_well_conditioned(own):
        assert colour.condition(own) <= 2e9


def test_a_row_that_sums_to_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="sums to zero"):
        colour.normalise_rows((1.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_an_entry_that_is_not_finite_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        colour.normalise_rows((bad, *IDENTITY[1:]))


# The four cameras -----------------------------------------------------------------------------------------------------


def as_array(camera: Matrix) -> np.ndarray:
    return np.array(camera).reshape(3, 3)


@pytest.mark.parametrize(
    ("camera", "condition", "determinant"),
    [
        ("nexus_6p", 1.842, 0.529),
        ("sony_a7r", 2.724, 0.2435),
        ("olympus_em10", 2.392, 0.2595),
        ("sony_rx100", 2.027, 0.325),
    ],
)
def test_condition_numbers_of_cameras_equal_the_measured_ones(
    camera: str, condition: float, determinant: float
) -> None:
    """The measured numbers are compared to their printed digits."""
    found = as_array(colour.rgb2cam(CAMERAS[camera]))
    assert abs(np.linalg.cond(found, 2) - condition) <= 0.0005
    assert abs(np.linalg.det(found) - determinant) <= 0.0005


def test_cameras_are_in_the_order_of_the_manifests_weights() -> None:
    assert list(CAMERAS) == ["nexus_6p", "sony_a7r", "olympus_em10", "sony_rx100"]
