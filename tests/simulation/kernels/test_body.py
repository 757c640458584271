"""Fixed patterns of a body equal the reference for any crop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from helpers.flats import plan_with

from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.core.types import Physics, Plan
from unprocess_gen.simulation.kernels import body
from unprocess_gen.simulation.kernels.body import Body, body_of, forget_bodies
from unprocess_gen.simulation.kernels.simd import VECTOR_WIDTH
from unprocess_gen.simulation.kernels.strips import STRIP
from unprocess_gen.simulation.reference import noise

CROPS = (
    ((1, 1), (0, 0)), ((1, 1), (7, 63)), ((3, 64), (0, 64)), ((2, 65), (5, 63)), ((4, 511), (1, 1)), ((3, 512), (9, 0)),
    ((3, 513), (8, 37)), ((2, 1100), (1001, 1007)), ((2, 2049), (0, 511)), ((97, 1), (3, 4095)), ((40, 200), (301, 77)),
)  # fmt: skip
"""Shape and origin of crops, with sides and origins next to the sizes of blocks and strips."""

NUMBERS = {
    "prnu_std": 0.05, "hot_pixel_share": 0.05, "hot_pixel_e": 300.0, "dead_pixel_share": 0.03,
    "body_key": 0xFEDCBA9876543210,
}  # fmt: skip
PLAN = plan_with("prnu", "shot", "hot_pixels", "dead_pixels", **NUMBERS)


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    forget_bodies()
    yield
    forget_bodies()


def physics(plan: Plan) -> Physics:
    assert plan.physics is not None
    return plan.physics


def means_of(found: Body, shape: tuple[int, int], first: int) -> np.ndarray:
    """Return the mean excess of each pixel from the lists of strips: -1 if it is dead, 0 if it has no defect."""
    strips = -(-shape[1] // STRIP)
    assert len(found.starts) == shape[0] * strips + 1
    assert (found.starts[0], found.starts[-1]) == (0, len(found.positions))
    means_e = np.zeros(shape)
    for strip, (start, after) in enumerate(zip(found.starts[:-1], found.starts[1:], strict=True)):
        y, left = strip // strips, strip % strips * STRIP
        x = found.positions[start:after] - first + left
        assert (np.diff(x) > 0).all()
        assert ((x >= left) & (x < min(left + STRIP, shape[1]))).all()
        means_e[y, x] = found.means_e[start:after]
    return means_e


def expected_means(plan: Plan, shape: tuple[int, int], origin: tuple[int, int]) -> np.ndarray:
    hot = noise.hot_pixel_means(physics(plan), shape, origin) if "hot_pixels" in plan.effects else np.zeros(shape)
    if "dead_pixels" not in plan.effects:
        return hot
    return np.where(noise.dead(physics(plan), shape, origin), -1.0, hot)


@pytest.mark.parametrize(("shape", "origin"), CROPS)
def test_defects_of_a_crop_equal_the_reference(shape: tuple[int, int], origin: tuple[int, int]) -> None:
    for on in (("hot_pixels", "dead_pixels"), ("hot_pixels",), ("dead_pixels",)):
        for hot_share, dead_share in ((0.05, 0.03), (1.0, 0.3), (0.3, 1.0)):
            plan = plan_with(*on, **NUMBERS | {"hot_pixel_share": hot_share, "dead_pixel_share": dead_share})
            found = means_of(body_of(plan, shape, origin), shape, origin[1] % VECTOR_WIDTH)
            np.testing.assert_array_equal(found, expected_means(plan, shape, origin))


@pytest.mark.parametrize(("shape", "origin"), CROPS)
@pytest.mark.parametrize("prnu_std", [0.002, 0.5])
def test_response_of_a_crop_equals_the_reference(
    shape: tuple[int, int], origin: tuple[int, int], prnu_std: float
) -> None:
    """The large standard deviation gives pixels without any response."""
    plan = plan_with("prnu", **NUMBERS | {"prnu_std": prnu_std})
    found, first = body_of(plan, shape, origin), origin[1] % BLOCK
    pitch = found.response_steps[0]
    assert found.response_steps == (pitch, 1)
    assert pitch % BLOCK == 0
    ours = found.response.reshape(-1, pitch)[:, first : first + shape[1]]
    assert ours.dtype == np.float32
    np.testing.assert_array_equal(ours.astype(np.float64), noise.response(physics(plan), shape, origin))


@pytest.mark.parametrize("expected", [1, 100, 8000])
def test_more_defects_than_expected_are_all_listed(expected: int, monkeypatch: pytest.MonkeyPatch) -> None:
    shape, origin = (40, 200), (301, 77)
    monkeypatch.setattr(body, "_expected_defects", lambda patterns, sites: expected)
    found = means_of(body_of(PLAN, shape, origin), shape, origin[1] % VECTOR_WIDTH)
    np.testing.assert_array_equal(found, expected_means(PLAN, shape, origin))


@pytest.mark.parametrize(
    "plan",
    [
        replace(PLAN, effects=("shot", "read")),
        plan_with("prnu", "hot_pixels", "dead_pixels", body_key=1),
        replace(PLAN, physics=None, noise_law="poisson"),
    ],
    ids=["effects are off", "shares are 0", "two numbers"],
)
def test_a_body_without_patterns_is_empty(plan: Plan) -> None:
    found = body_of(plan, (5, 1100), (0, 3))
    assert found.response_steps == (0, 0)
    assert (found.response == 1).all()
    assert found.positions.size == found.means_e.size == 0
    assert not found.starts.any()


def test_patterns_are_computed_once_for_all_frames_of_a_body() -> None:
    first = body_of(PLAN, (4, 70), (1, 1))
    other_frame = replace(PLAN, frame=9, level=2, draw=3, stream_key=5)
    assert body_of(other_frame, (4, 70), (1, 1)) is first
    other_body = replace(PLAN, physics=replace(physics(PLAN), body_key=2))
    assert body_of(other_body, (4, 70), (1, 1)) is not first
    assert not np.array_equal(body_of(other_body, (4, 70), (1, 1)).response, first.response)
