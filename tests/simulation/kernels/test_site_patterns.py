"""Fixed patterns of a sensor unit are computed once, and those of live crops equal those of other crops."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers.flats import plan_with

from unprocess_gen.core.random_streams import BLOCK
from unprocess_gen.simulation.kernels import site_patterns
from unprocess_gen.simulation.kernels.site_patterns import forget_patterns, patterns_at
from unprocess_gen.simulation.kernels.strips import SiteMap
from unprocess_gen.simulation.plan_slots import slots_of
from unprocess_gen.simulation.slots import NormalPattern, Patterns

CROPS = (
    ((1, 1), (0, 0)), ((1, 1), (7, 63)), ((3, 64), (0, 64)), ((2, 65), (5, 63)), ((4, 511), (1, 1)), ((3, 512), (9, 0)),
    ((3, 513), (8, 37)), ((2, 1100), (1001, 1007)), ((2, 2049), (0, 511)), ((97, 1), (3, 4095)), ((40, 200), (301, 77)),
)  # fmt: skip
"""Shape and origin of crops, with sides and origins next to the sizes of blocks and strips."""


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    forget_patterns()
    yield
    forget_patterns()


def test_patterns_are_computed_once_for_all_frames_of_a_body() -> None:
    pattern = NormalPattern(5, 2, 0.1, 1.0, 0.0)
    first = patterns_at(Patterns(electrons=pattern), (4, 70), (1, 1))[0].response.values
    assert patterns_at(Patterns(electrons=pattern), (4, 70), (1, 1))[0].response.values is first
    other = patterns_at(Patterns(electrons=pattern._replace(body_key=2)), (4, 70), (1, 1))[0].response.values
    assert not np.array_equal(other, first)


@pytest.mark.parametrize("limits", [{}, {"FRAME_BYTES": 0, "MOST_DEFECTS": 0}, {"MOST_FRAMES": 0}])
@pytest.mark.parametrize("share", [0.0, 2e-4])
def test_patterns_of_live_crops_equal_those_of_other_crops(
    share: float, limits: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are cut from patterns of the frame, which grow, unless these are too large or too many."""
    for name, limit in limits.items():
        monkeypatch.setattr(site_patterns, name, limit)
    patterns = slots_of(
        plan_with(
            *("prnu", "hot_pixels", "dead_pixels"), body_key=0xFEDCBA9876543210, prnu_std=0.05, hot_pixel_e=300.0,
            hot_pixel_share=share, dead_pixel_share=share,
        )
    ).patterns  # fmt: skip
    for shape, origin in CROPS:
        frame = origin[0] + shape[0], origin[1] + shape[1]
        expected, live = (patterns_at(patterns, shape, origin, sides)[0] for sides in (None, frame))
        first = origin[1] % BLOCK
        for ours, theirs in zip(live[:3], expected[:3], strict=True):
            np.testing.assert_array_equal(sites(ours, shape, first), sites(theirs, shape, first))
    assert not limits.get("MOST_FRAMES", 1) or len(site_patterns._frames) == 2


def sites(values: SiteMap, shape: tuple[int, int], first: int) -> np.ndarray:
    """Return the values of the sites of a crop."""
    row, column = values.steps
    places = np.arange(shape[0])[:, None] * row + (first + np.arange(shape[1])) * column
    return np.asarray(values.values[places])
