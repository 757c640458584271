"""Pairs with counts of electrons equal the reference, and are regenerated from their rows."""

from __future__ import annotations

import dataclasses
import io
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.datasets import Settings
from helpers.flats import (
    ISOS,
    SHA256,
    assert_same,
    flat,
    picture,
    plan_with,
    planned,
    with_physics,
)
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from unprocess_gen.core.types import Patch, Plan, Source
from unprocess_gen.dataset.manifest import pair_row, plan_from_row, read_rows, write_rows
from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS as EFFECTS
from unprocess_gen.simulation.effects import Physics
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference.cfa import PATTERNS

PATCH = Patch(number=0, y=0, x=0, height=33, width=61)

TWO_NUMBERS = {
    "imx385_iso1600": (), "imx385_iso3200": (), "imx385_iso25600": (), "brooks2019": (), "none": (),
    "heteroscedastic": ("noise.a=0.7", "noise.b=2.5"),
}  # fmt: skip


# Kernels against the reference ----------------------------------------------------------------------------------------


SCENES = ("daylight", "low_light", "long_exposure")
QUICK = (*(("nikon_d850", scene) for scene in SCENES), ("imx385", "daylight"))


@pytest.mark.parametrize(("noise", "scene"), slow_except(QUICK, itertools.product(ISOS, SCENES)))
def test_kernels_equal_reference_for_every_profile_and_scene(settings: Settings, noise: str, scene: str) -> None:
    group = (f"noise={noise}", f"scene={scene}", f"noise.iso={ISOS[noise]}")
    for forced, fixed in itertools.product([False, True], ["false", "true"]):
        plan = planned(settings, picture(), *group, f"clean.includes_fixed_pattern={fixed}", forced=forced)
        assert set(EFFECTS) == set(plan.noise.effects) or not forced
        for saturated in ("noisy", "pinned", "white"):
            assert_same(picture(), plan.replace(saturated=saturated))


@pytest.mark.parametrize("noise", TWO_NUMBERS)
def test_kernels_equal_reference_for_poisson_form_of_every_profile(settings: Settings, noise: str) -> None:
    plan = planned(settings, picture(), f"noise={noise}", *TWO_NUMBERS[noise], "noise.law=poisson")
    for saturated, clip in itertools.product(["noisy", "pinned", "white"], ["sensor", "black"]):
        assert_same(picture(), plan.replace(saturated=saturated, sensor_clip=clip))


@pytest.mark.parametrize("noise", ["imx385_iso3200", "imx385_iso3200_rvdd", "heteroscedastic"])
def test_kernels_equal_reference_with_pinned_saturated_sites(settings: Settings, noise: str) -> None:
    numbers = TWO_NUMBERS.get(noise, ())
    assert_same(picture(), planned(settings, picture(), f"noise={noise}", *numbers, "sensor.saturated=pinned"))


@pytest.fixture(scope="module")
def everything(settings: Settings) -> Plan:
    """Return a plan with every effect on, for images of any size."""
    group = ("noise=nikon_d850", "scene=long_exposure", "noise.iso=1600")
    return with_physics(planned(settings, picture(), *group, forced=True), frame_size=(4096, 4096))


def averaged(plan: Plan, fixed: bool = True) -> Plan:
    """Return the plan with or without fixed patterns in the clean frame."""
    return with_physics(plan, fixed_pattern_in_clean=fixed)


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_kernels_equal_reference_for_every_pattern_highlight_and_clip(
    everything: Plan, pattern: str, fixed: bool
) -> None:
    for highlight, clip, offset in itertools.product(
        ["per_channel", "gray_mean", "none"], ["sensor", "black"], ["removed", "kept"]
    ):
        plan = everything.replace(pattern=pattern, highlight=highlight, sensor_clip=clip)
        assert_same(picture()[:21], with_physics(plan, dark_offset=offset, fixed_pattern_in_clean=fixed))


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 1025), (3, 1024), (2, 2049), (97, 1)])
def test_kernels_equal_reference_for_every_shape(everything: Plan, shape: tuple[int, int], fixed: bool) -> None:
    srgb = np.random.Generator(np.random.Philox(key=2)).integers(0, 256, (*shape, 3)).astype(np.uint8)
    assert_same(srgb, averaged(everything, fixed))
    assert_same(srgb, averaged(everything, fixed), (1001, 1007))


@pytest.mark.parametrize("fixed", [False, True])
def test_kernels_equal_reference_on_sixteen_bits(everything: Plan, fixed: bool) -> None:
    srgb = np.random.Generator(np.random.Philox(key=1)).integers(0, 65536, (37, 53, 3)).astype(np.uint16)
    everything = everything.replace(tone="none", gamma=1.0)
    for bits, black, white in ((16, 4096, 65535), (14, 0, 16383), (8, 0, 255)):
        assert_same(srgb, averaged(everything, fixed).replace(bits=bits, black_level_dn=black, white_level_dn=white))


PLAIN = ("shot", "read", "row", "black_error", "quantise")
"""Effects without fixed patterns of single pixels, which need no body."""


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 511), (3, 512), (2, 577), (2, 1100), (97, 1)])
@pytest.mark.parametrize(("bits", "black", "white"), [(16, 4096, 65535), (14, 0, 16383), (8, 0, 255)])
def test_shot_and_read_noise_alone_equal_reference(
    everything: Plan, shape: tuple[int, int], bits: int, black: int, white: int
) -> None:
    """Rates are from 0 to millions."""
    srgb = np.random.Generator(np.random.Philox(key=3)).integers(0, 65536, (*shape, 3)).astype(np.uint16)
    srgb[:, : shape[1] // 8] = 0
    srgb[:, -1:] >>= 14
    plan = everything.replace(effects=PLAIN, bits=bits, black_level_dn=black, white_level_dn=white)
    for dn_per_e, ratio, distribution in (
        (1e-3, 1.0, "gaussian"),
        (0.7, 1.0, "tukey"),
        (40.0, 3.0, "tukey"),
        (4.0, 1e25, "gaussian"),
    ):
        one = with_physics(plan, dn_per_e=dn_per_e, read_law=distribution, read_shape=-0.1, read_std_dn=1.3)
        one = one.replace(exposure_ratio=ratio, a_dn=dn_per_e, b_dn2=1.69)
        assert_same(srgb, one, (1001, 1007))
        assert_same(srgb, one, (0, 63))


def test_tile_of_shot_and_read_noise_is_crop_of_frame(everything: Plan) -> None:
    plan = everything.replace(effects=PLAIN)
    frame = make_pair(picture(), plan)
    for top, left in ((0, 1), (7, 15), (31, 60)):
        np.testing.assert_array_equal(
            make_pair(picture()[top:, left:], plan, (top, left)).noisy, frame.noisy[top:, left:]
        )


def number(low: float, high: float) -> st.SearchStrategy[float]:
    """Draw 0 or numbers from 1e-9 up, so that no product of two underflows."""
    return st.floats(low, high) if low else st.just(0.0) | st.floats(1e-9, high)


@hypothesis_settings(max_examples=60, deadline=None)
@given(
    on=st.sets(st.sampled_from(EFFECTS)),
    changes=st.fixed_dictionaries(
        {
            "dn_per_e": number(1e-3, 100), "prnu_std": number(0, 0.5), "dark_e": number(0, 1e4),
            "dark_offset": st.sampled_from(["removed", "kept"]), "hot_pixel_share": number(0, 1),
            "hot_pixel_e": number(0, 1e5), "full_well_e": number(1, 1e6),
            "read_law": st.sampled_from(["gaussian", "tukey", "tukey_lambda"]),
            "read_shape": st.sampled_from([0.0, -0.2, 0.1]),
            "read_std_dn": number(0, 1e4), "row_std_dn": number(0, 1e3), "column_std_dn": number(0, 1e3),
            "black_error_dn": st.tuples(*[st.integers(-5000, 5000).map(lambda n: n / 8)] * 4),
            "dead_pixel_share": number(0, 1), "fixed_pattern_in_clean": st.booleans(),
        }
    ),
    saturated=st.sampled_from(["noisy", "pinned", "white"]),
    ratio=number(1e-3, 1e3),
    origin=st.tuples(st.integers(0, 5000), st.integers(0, 5000)),
)  # fmt: skip
def test_kernels_equal_reference_for_any_numbers(
    on: set[str], changes: dict[str, Any], saturated: str, ratio: float, origin: tuple[int, int]
) -> None:
    plan = plan_with(*(effect for effect in EFFECTS if effect in on), **changes)
    plan = plan.replace(saturated=saturated, exposure_ratio=ratio, bits=12, black_level_dn=240, white_level_dn=4095)
    assert_same(picture()[:9, :33], plan, origin)


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize(
    ("top", "left", "height", "width"), [(0, 1, 9, 9), (3, 0, 30, 1), (7, 15, 1, 46), (32, 60, 1, 1), (1, 1, 32, 60)]
)
def test_tile_is_crop_of_frame(everything: Plan, top: int, left: int, height: int, width: int, fixed: bool) -> None:
    plan = averaged(everything, fixed)
    frame, cut = make_pair(picture(), plan), (slice(top, top + height), slice(left, left + width))
    tile = make_pair(picture()[cut], plan, origin=(top, left))
    np.testing.assert_array_equal(tile.clean, frame.clean[cut])
    np.testing.assert_array_equal(tile.noisy, frame.noisy[cut])


# Each effect ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", [None, *EFFECTS])
def test_pairs_equal_reference_with_and_without_every_effect(everything: Plan, effect: str | None) -> None:
    plan = everything.replace(level=3, draw=2, frame=1)
    for on in ([one for one in EFFECTS if one != effect], [effect] if effect else []):
        for saturated, clip in itertools.product(["noisy", "pinned", "white"], ["sensor", "black"]):
            one = plan.replace(effects=tuple(on), saturated=saturated, sensor_clip=clip)
            assert_same(picture(), one, (3, 7))


@pytest.mark.parametrize("noise", TWO_NUMBERS)
def test_poisson_form_equals_reference_on_wide_images(settings: Settings, noise: str) -> None:
    plan = planned(settings, picture(), f"noise={noise}", *TWO_NUMBERS[noise], "noise.law=poisson")
    assert_same(np.random.default_rng(6).integers(0, 256, (3, 2049, 3)).astype(np.uint8), plan, (5, 9))


# Replay ---------------------------------------------------------------------------------------------------------------


REPLAYED = (("imx385", False), ("imx385", True), ("sony_a7s2", True), ("nikon_d850", True), ("canon_70d", False))


@pytest.mark.parametrize(("noise", "forced"), slow_except(REPLAYED, itertools.product(ISOS, [False, True])))
def test_pair_is_regenerated_from_row_alone(settings: Settings, noise: str, forced: bool, tmp_path: Path) -> None:
    overrides = (f"noise={noise}", "scene=low_light", f"noise.iso={ISOS[noise]}", "sensor.units=7")
    plan = planned(settings, picture(), *overrides, forced=forced)
    pair = make_pair(picture(), plan)
    row = pair_row("00000000", Source(0, "a.png", "a.png", 1), SHA256, 1, 0, plan, pair, ("0" * 32, "0" * 32), PATCH)
    stream = io.StringIO(newline="")
    write_rows(stream, [row])
    (tmp_path / "m.csv").write_text(stream.getvalue(), encoding="utf-8", newline="")
    (read,) = read_rows(tmp_path / "m.csv")

    assert plan_from_row(read) == plan
    again = make_pair(picture(), plan_from_row(read))
    np.testing.assert_array_equal(again.clean, pair.clean)
    np.testing.assert_array_equal(again.noisy, pair.noisy)
    assert again.counts == pair.counts


def test_row_contains_every_field_of_physics() -> None:
    """Replay needs every parameter."""
    pair = make_pair(flat(0, 2, 2), plan_with())
    row = pair_row("00000000", Source(0, "a", "a", 1), SHA256, 1, 0, plan_with(), pair, ("0" * 32, "0" * 32), PATCH)
    for field in dataclasses.fields(Physics):
        assert field.name in row or f"{field.name}_00" in row or field.name in SEVERAL_COLUMNS


SEVERAL_COLUMNS = {"gain_by_colour", "lens_shading", "frame_size"}
"""Fields whose columns have other names; `test_manifest` converts rows to plans and back."""
