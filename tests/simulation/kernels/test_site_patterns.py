"""Fixed patterns of a sensor unit equal the reference for any crop."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.flats import dead, hot_pixel_means, plan_with, response

from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.simulation.kernels import site_patterns
from unprocess_gen.simulation.kernels.site_patterns import SitePatterns, forget_patterns, patterns_at
from unprocess_gen.simulation.kernels.strips import SiteMap
from unprocess_gen.simulation.plan import Physics
from unprocess_gen.simulation.plan_slots import slots_of
from unprocess_gen.simulation.slots import NormalPattern, Patterns

CROPS = (
    ((1, 1), (0, 0)), ((1, 1), (7, 63)), ((3, 64), (0, 64)), ((2, 65), (5, 63)), ((4, 511), (1, 1)), ((3, 512), (9, 0)),
    ((3, 513), (8, 37)), ((2, 1100), (1001, 1007)), ((2, 2049), (0, 511)), ((97, 1), (3, 4095)), ((40, 200), (301, 77)),
)  # fmt: skip
"""Shape and origin of crops, with sides and origins next to the sizes of blocks and strips."""

SHARES = {"hot_pixel_share": 0.05, "dead_pixel_share": 0.03}
NUMBERS = {"prnu_std": 0.05, "hot_pixel_e": 300.0, "body_key": 0xFEDCBA9876543210} | SHARES
DEFECTS = ("hot_pixels", "dead_pixels")


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    forget_patterns()
    yield
    forget_patterns()


def patterns_of(*on: str, **numbers: float) -> tuple[Patterns, Physics]:
    plan = plan_with(*on, **NUMBERS | numbers)
    assert plan.physics is not None
    return slots_of(plan).patterns, plan.physics


def means_of(found: SitePatterns, shape: tuple[int, int], first: int) -> np.ndarray:
    """Return the mean excess of each pixel: -1 if it is dead, 0 if it has no defect."""
    pitch, column = found.defects.steps
    if not column:  # no pixel has a defect
        return np.zeros(shape)
    return found.means_e[found.defects.values.reshape(-1, pitch)[:, first : first + shape[1]]]


def assert_defects(on: tuple[str, ...], shape: tuple[int, int], origin: tuple[int, int], **shares: float) -> None:
    patterns, physics = patterns_of(*on, **shares)
    expected = hot_pixel_means(physics, shape, origin) if "hot_pixels" in on else np.zeros(shape)
    if "dead_pixels" in on:
        expected = np.where(dead(physics, shape, origin), -1.0, expected)
    found = means_of(patterns_at(patterns, shape, origin), shape, origin[1] % BLOCK)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("shape", "origin"), CROPS)
def test_defects_of_a_crop_equal_the_reference(shape: tuple[int, int], origin: tuple[int, int]) -> None:
    for on in (DEFECTS, DEFECTS[:1], DEFECTS[1:]):
        for hot_share, dead_share in ((0.05, 0.03), (1.0, 0.3), (0.3, 1.0)):
            assert_defects(on, shape, origin, hot_pixel_share=hot_share, dead_pixel_share=dead_share)


@pytest.mark.parametrize(("shape", "origin"), CROPS)
@pytest.mark.parametrize("prnu_std", [0.002, 0.5])
def test_response_of_a_crop_equals_the_reference(
    shape: tuple[int, int], origin: tuple[int, int], prnu_std: float
) -> None:
    """The large standard deviation gives pixels without any response."""
    patterns, physics = patterns_of("prnu", prnu_std=prnu_std)
    found, first = patterns_at(patterns, shape, origin), origin[1] % BLOCK
    pitch = found.response.steps[0]
    assert found.response.steps == (pitch, 1)
    assert pitch % BLOCK == 0
    ours = found.response.values.reshape(-1, pitch)[:, first : first + shape[1]]
    assert ours.dtype == np.float32
    np.testing.assert_array_equal(ours.astype(np.float64), response(physics, shape, origin))


def test_patterns_are_computed_once_for_all_frames_of_a_body() -> None:
    pattern = NormalPattern(5, 2, 0.1, 1.0, 0.0)
    first = patterns_at(Patterns(electrons=pattern), (4, 70), (1, 1)).response.values
    assert patterns_at(Patterns(electrons=pattern), (4, 70), (1, 1)).response.values is first
    other = patterns_at(Patterns(electrons=pattern._replace(body_key=2)), (4, 70), (1, 1)).response.values
    assert not np.array_equal(other, first)


@pytest.mark.parametrize("limits", [{}, {"FRAME_BYTES": 0, "MOST_DEFECTS": 0}, {"MOST_FRAMES": 0}])
@pytest.mark.parametrize("share", [0.0, 2e-4])
def test_patterns_of_live_crops_equal_those_of_other_crops(
    share: float, limits: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are cut from patterns of the frame, which grow, unless these are too large or too many."""
    for name, limit in limits.items():
        monkeypatch.setattr(site_patterns, name, limit)
    patterns, _ = patterns_of("prnu", *DEFECTS, hot_pixel_share=share, dead_pixel_share=share)
    for shape, origin in CROPS:
        frame = origin[0] + shape[0], origin[1] + shape[1]
        expected, live = (patterns_at(patterns, shape, origin, sides) for sides in (None, frame))
        first = origin[1] % BLOCK
        for ours, theirs in zip(live[:3], expected[:3], strict=True):
            np.testing.assert_array_equal(sites(ours, shape, first), sites(theirs, shape, first))
    assert not limits.get("MOST_FRAMES", 1) or len(site_patterns._frames) == 2


def sites(values: SiteMap, shape: tuple[int, int], first: int) -> np.ndarray:
    """Return the values of the sites of a crop."""
    row, column = values.steps
    places = np.arange(shape[0])[:, None] * row + (first + np.arange(shape[1])) * column
    return np.asarray(values.values[places])
