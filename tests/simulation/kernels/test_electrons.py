"""Pairs with counts of electrons equal the reference, and are regenerated from their rows."""

from __future__ import annotations

import dataclasses
import io
import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.datasets import Settings
from helpers.flats import (
    BLACK,
    COUNT,
    ISOS,
    SHA256,
    SPAN,
    WHITE,
    assert_same,
    flat,
    picture,
    plan_with,
    planned,
    signal_dn,
    with_physics,
)
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from unprocess_gen.core.random_streams import words
from unprocess_gen.core.types import Patch, Physics, Plan, Source, Srgb
from unprocess_gen.dataset.manifest import pair_row, plan_from_row, read_rows, write_rows
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference import noise as effects
from unprocess_gen.simulation.reference.cfa import PATTERNS
from unprocess_gen.simulation.reference.noise import EFFECTS
from unprocess_gen.simulation.reference.poisson import gaussian_from

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
        assert set(EFFECTS) == set(plan.effects) or not forced
        for saturated in ("noisy", "pinned"):
            assert_same(picture(), replace(plan, saturated=saturated))


@pytest.mark.parametrize("noise", TWO_NUMBERS)
def test_kernels_equal_reference_for_poisson_form_of_every_profile(settings: Settings, noise: str) -> None:
    plan = planned(settings, picture(), f"noise={noise}", *TWO_NUMBERS[noise], "noise.law=poisson")
    for saturated, clip in itertools.product(["noisy", "pinned"], ["sensor", "black"]):
        assert_same(picture(), replace(plan, saturated=saturated, sensor_clip=clip))


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
        plan = replace(everything, pattern=pattern, highlight=highlight, sensor_clip=clip)
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
    everything = replace(everything, tone="none", gamma=1.0)
    for bits, black, white in ((16, 4096, 65535), (14, 0, 16383), (8, 0, 255)):
        assert_same(srgb, replace(averaged(everything, fixed), bits=bits, black_level_dn=black, white_level_dn=white))


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
    plan = replace(everything, effects=PLAIN, bits=bits, black_level_dn=black, white_level_dn=white)
    for dn_per_e, ratio, distribution in (
        (1e-3, 1.0, "gaussian"),
        (0.7, 1.0, "tukey"),
        (40.0, 3.0, "tukey"),
        (4.0, 1e25, "gaussian"),
    ):
        one = with_physics(plan, dn_per_e=dn_per_e, read_law=distribution, read_shape=-0.1, read_std_dn=1.3)
        one = replace(one, exposure_ratio=ratio, a_dn=dn_per_e, b_dn2=1.69)
        assert_same(srgb, one, (1001, 1007))
        assert_same(srgb, one, (0, 63))


def test_tile_of_shot_and_read_noise_is_crop_of_frame(everything: Plan) -> None:
    plan = replace(everything, effects=PLAIN)
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
    saturated=st.sampled_from(["noisy", "pinned"]),
    ratio=number(1e-3, 1e3),
    origin=st.tuples(st.integers(0, 5000), st.integers(0, 5000)),
)  # fmt: skip
def test_kernels_equal_reference_for_any_numbers(
    on: set[str], changes: dict[str, Any], saturated: str, ratio: float, origin: tuple[int, int]
) -> None:
    plan = plan_with(*(effect for effect in EFFECTS if effect in on), **changes)
    plan = replace(plan, saturated=saturated, exposure_ratio=ratio, bits=12, black_level_dn=240, white_level_dn=4095)
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
    plan = replace(everything, level=3, draw=2, frame=1)
    for on in ([one for one in EFFECTS if one != effect], [effect] if effect else []):
        for saturated, clip in itertools.product(["noisy", "pinned"], ["sensor", "black"]):
            one = replace(plan, effects=tuple(on), saturated=saturated, sensor_clip=clip)
            assert_same(picture(), one, (3, 7))


@pytest.mark.parametrize("noise", TWO_NUMBERS)
def test_poisson_form_equals_reference_on_wide_images(settings: Settings, noise: str) -> None:
    plan = planned(settings, picture(), f"noise={noise}", *TWO_NUMBERS[noise], "noise.law=poisson")
    assert_same(np.random.default_rng(6).integers(0, 256, (3, 2049, 3)).astype(np.uint8), plan, (5, 9))


# Normal approximation of counts ---------------------------------------------------------------------------------------


def near_normal(plan: Plan, law_distance: float = 5e-3) -> Plan:
    return replace(plan, methods=("shot:gaussian_where_near",), law_distance=law_distance)


def at_mean(rate_e: float, read_std_e: float, *on: str) -> tuple[Srgb, Plan]:
    """Return a flat with a mean of ``rate_e`` electrons, and a plan with shot and read noise."""
    code = 10000
    dn_per_e = signal_dn(code) / rate_e
    return flat(code), plan_with(*(on or ("shot", "read")), dn_per_e=dn_per_e, read_std_dn=read_std_e * dn_per_e)


@pytest.mark.parametrize("read_std_e", [0.0, 0.5, 2.0, 6.0])
@pytest.mark.parametrize("edge", [0.5, 0.999, 1.001, 4.0])
@pytest.mark.parametrize("which", [0, 1])
def test_normal_for_counts_keeps_distance_mean_and_variance(read_std_e: float, edge: float, which: int) -> None:
    rate_e = edge * (gaussian_from(read_std_e, 5e-3)[which] or 200.0)
    srgb, plan = at_mean(rate_e, read_std_e)
    assert plan.physics is not None
    exact, ours = make_pair(srgb, plan).noisy, make_pair(srgb, near_normal(plan)).noisy
    shares = np.bincount(exact.ravel(), minlength=2**16) - np.bincount(ours.ravel(), minlength=2**16)
    assert np.abs(np.cumsum(shares)).max() / COUNT <= 5e-3 + 0.9 / 1024
    frame, std_dn = ours - float(BLACK), plan.physics.dn_per_e * math.sqrt(rate_e + read_std_e**2)
    variance_dn2 = std_dn**2 + 1 / 12
    if ours.min() > 0 and ours.max() < WHITE:
        assert abs(frame.mean() - rate_e * plan.physics.dn_per_e) <= 7 * math.sqrt(variance_dn2 / COUNT)
        assert frame.var() == pytest.approx(variance_dn2, rel=7 * math.sqrt(3 / COUNT))


def test_counts_are_used_between_limits_of_normal_approximation() -> None:
    dn_per_e, read_std_e = 8.0, 2.0
    low, high = gaussian_from(read_std_e, 5e-3)
    assert 0 < low < high
    plan = plan_with("shot", "read", dn_per_e=dn_per_e, read_std_dn=read_std_e * dn_per_e)
    rates_e = np.linspace(0, 1.5 * high, 1500)
    codes = np.rint(rates_e * dn_per_e / SPAN * 65535).astype(np.uint16)
    srgb = np.ascontiguousarray(np.broadcast_to(codes[:, None], (300, 1500, 1)).repeat(3, axis=2))
    rates_e = np.array([signal_dn(int(code)) / dn_per_e for code in codes])
    changed = (make_pair(srgb, plan).noisy != make_pair(srgb, near_normal(plan)).noisy).any(axis=0)
    assert not changed[(rates_e > low * 1.0001) & (rates_e < high * 0.9999)].any()
    assert changed[rates_e > high * 1.0001].all()
    assert changed[(rates_e > 0.5) & (rates_e < low * 0.9999)].all()


def test_normal_for_counts_uses_word_of_shot_stream() -> None:
    srgb, plan = at_mean(1000.0, 1.0)
    n = effects.normals(words(plan.stream_key, "shot", (1024, 1024)))
    assert plan.physics is not None
    wanted = (1000.0 + math.sqrt(1000.0) * n) * plan.physics.dn_per_e + effects.read(plan, n)
    off = np.abs(make_pair(srgb, near_normal(plan)).noisy - BLACK - wanted)
    assert off.max() <= 0.5 + 1e-3 * math.sqrt(1000.0) * plan.physics.dn_per_e


def test_counts_are_used_if_read_noise_shows_electron_steps() -> None:
    for read_std_e, on in ((0.49, ("shot", "read")), (5.0, ("shot",))):
        srgb, plan = at_mean(1e4, read_std_e, *on)
        np.testing.assert_array_equal(make_pair(srgb, plan).noisy, make_pair(srgb, near_normal(plan)).noisy)


@pytest.mark.parametrize("law_distance", [1e-3, 5e-3, 0.5])
def test_other_effects_do_not_change_normal_for_counts(everything: Plan, law_distance: float) -> None:
    """Nor does a response of 1 everywhere, whether it is stored for each pixel or not."""
    plan = near_normal(replace(everything, effects=PLAIN), law_distance)
    others = [with_physics(replace(plan, effects=("prnu", *PLAIN)), prnu_std=std) for std in (0.0, 1e-30)]
    srgb = np.random.Generator(np.random.Philox(key=5)).integers(0, 256, (9, 1200, 3)).astype(np.uint8)
    frame = make_pair(srgb, plan)
    for other in others:
        np.testing.assert_array_equal(frame.noisy, make_pair(srgb, other).noisy)
    for one in (plan, *others):
        np.testing.assert_array_equal(make_pair(srgb[3:, 70:], one, (3, 70)).noisy, frame.noisy[3:, 70:])


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
