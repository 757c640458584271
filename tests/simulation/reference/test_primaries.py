"""The matrices between primaries: published values, white, and primaries that are none."""

import numpy as np
import pytest

from unprocess_gen.simulation.reference.primaries import PRIMARIES, primaries2srgb, primaries2xyz, xyz2srgb

PUBLISHED = {
    # http://www.brucelindbloom.com and colour-science 0.4, to the digits given there
    "srgb": (1, 0, 0, 0, 1, 0, 0, 0, 1),
    "p3": (1.2249402, -0.2249402, 0, -0.0420570, 1.0420570, 0, -0.0196376, -0.0786361, 1.0982736),
    "rec2020": (
        1.6604910,
        -0.5876411,
        -0.0728499,
        -0.1245505,
        1.1328999,
        -0.0083494,
        -0.0181508,
        -0.1005789,
        1.1187297,
    ),
}
ACESCG = 0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767


@pytest.mark.parametrize("name", PUBLISHED)
def test_matrices_are_the_published_ones(name: str) -> None:
    np.testing.assert_allclose(primaries2srgb(PRIMARIES[name]), PUBLISHED[name], atol=6e-8)


def test_colorants_of_srgb_are_those_of_its_profile() -> None:
    colorants = (0.4361, 0.3851, 0.1431, 0.2225, 0.7169, 0.0606, 0.0139, 0.0971, 0.7139)  # Lindbloom, adapted to D50
    np.testing.assert_allclose([*map(float, primaries2xyz(PRIMARIES["srgb"]))], colorants, atol=1e-4)


def test_white_stays_white_from_another_white() -> None:
    rows = np.reshape(primaries2srgb(ACESCG), (3, 3))
    np.testing.assert_allclose(rows.sum(axis=1), 1, atol=4e-16)
    np.testing.assert_allclose(rows[0], (1.7050510, -0.6217921, -0.0832589), atol=6e-8)


def test_colorants_give_the_matrix_of_their_primaries() -> None:
    assert xyz2srgb(primaries2xyz(ACESCG)) == primaries2srgb(ACESCG)


@pytest.mark.parametrize(
    "xy", [(0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.31, 0.33), (*ACESCG[:7], 0.0), (*ACESCG[:6], 2.0, 0.1)]
)
def test_impossible_primaries_are_refused(xy: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"singular|white"):
        primaries2xyz(xy)
