"""Test the physical effects: kernels equal the reference, each effect has its distribution, and none changes another.

Distributions are measured on flats of a sensor with an integer DN per electron, so that counts are not rounded. Bounds
follow from the sample size (`moments.bernstein`), with one false alarm in 10¹² comparisons.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
from helpers.moments import REACH, SAMPLER_ERROR, bernstein
from helpers.promise_report import Figure
from helpers.published import CRVD
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from unprocess_gen.config.interpretation import branch_of
from unprocess_gen.config.schema import Config
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.exact_distributions import tukey_std
from unprocess_gen.core.lookup_tables import OCTAVES, SEGMENTS, exponential_levels, tukey_table
from unprocess_gen.core.random_streams import words
from unprocess_gen.core.types import Patch, Physics, Plan, Source, Srgb
from unprocess_gen.dataset.manifest import pair_row, plan_from_row, read_rows, write_rows
from unprocess_gen.planning.effect_selection import facts_of
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.kernels.physical import make_noisy
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.simulation.reference import noise as effects
from unprocess_gen.simulation.reference.cfa import PATTERNS
from unprocess_gen.simulation.reference.colour import IDENTITY
from unprocess_gen.simulation.reference.noise import EFFECTS
from unprocess_gen.simulation.reference.poisson import gaussian_from
from unprocess_gen.simulation.reference.sensor import noisy_limits, to_dn
from unprocess_gen.simulation.reference.unprocess import unprocess
from unprocess_gen.sources.scenes import synthetic

Settings = Callable[..., Config]
SHA256 = "7" * 64
PATCH = Patch(number=0, y=0, x=0, height=33, width=61)

ISOS = {
    "imx385": 3200, "sony_a7s2": 800, "nikon_d850": 1600, "canon_5d4": 400, "canon_70d": 3200, "canon_700d": 6400,
    "oppo_reno10x": 1600,
}  # fmt: skip
"""Physical profiles, each with an ISO at which it was calibrated."""

TWO_NUMBERS = {
    "imx385_iso1600": (), "imx385_iso3200": (), "imx385_iso25600": (), "brooks2019": (), "none": (),
    "heteroscedastic": ("noise.a=0.7", "noise.b=2.5"),
}  # fmt: skip

FORCED = (
    "noise.prnu_std=0.05", "noise.dark_e_per_s=40", "noise.hot_pixel_share=0.02", "noise.hot_pixel_e_per_s=3000",
    "noise.dead_pixel_share=0.01", "noise.full_well_e=900", "effects.all=on",
)  # fmt: skip
"""Parameters with which every effect is visible in a small picture."""


@functools.lru_cache(maxsize=1)
def picture() -> Srgb:
    """Return a crop of odd size with clipped highlights, deep shadows and saturated colours."""
    return np.ascontiguousarray(synthetic.scene("highlights-0")[150:183, 300:361])


def planned(settings: Settings, srgb: Srgb, *overrides: str, forced: bool = False) -> Plan:
    """Plan a picture; ``forced`` adds column offsets and black-level errors to profiles that have none."""
    config = settings(*overrides, *(FORCED if forced else ()))
    for branch in config.noise.branches if forced else ():
        branch.row_std_dn = branch.row_std_dn or 1.5
        branch.column_std_dn = branch.column_std_dn or 1.25
        branch.black_error_dn = branch.black_error_dn or [0.5, -1.5, 2.5, -3.75]
    validate_config(config)
    return plan_image(config, SHA256, facts=facts_of(srgb))


def assert_same(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> None:
    fast, reference = make_pair(srgb, plan, origin), reference_pair(srgb, plan, origin)
    np.testing.assert_array_equal(fast.clean, reference.clean)
    np.testing.assert_array_equal(fast.noisy, reference.noisy)
    assert fast.counts == reference.counts


# Kernels against the reference ----------------------------------------------------------------------------------------


def slow_except(*profiles: str) -> list[object]:
    """Return every profile; all except the given ones are marked slow."""
    return [noise if noise in profiles else pytest.param(noise, marks=pytest.mark.slow) for noise in ISOS]


@pytest.mark.parametrize("scene", ["daylight", "low_light", "long_exposure"])
@pytest.mark.parametrize("noise", slow_except("nikon_d850", "imx385"))
def test_kernels_equal_reference_for_every_profile_and_scene(settings: Settings, noise: str, scene: str) -> None:
    group = (f"noise={noise}", f"scene={scene}", f"noise.iso={ISOS[noise]}")
    for forced, fixed, saturated in itertools.product([False, True], ["false", "true"], ["noisy", "pinned"]):
        overrides = (f"clean.includes_fixed_pattern={fixed}", f"sensor.saturated={saturated}")
        plan = planned(settings, picture(), *group, *overrides, forced=forced)
        assert set(EFFECTS) == set(plan.effects) or not forced
        assert_same(picture(), plan)


@pytest.mark.parametrize("noise", TWO_NUMBERS)
def test_kernels_equal_reference_for_poisson_form_of_every_profile(settings: Settings, noise: str) -> None:
    for saturated, clip in itertools.product(["noisy", "pinned"], ["sensor", "black"]):
        overrides = ("noise.law=poisson", f"sensor.saturated={saturated}", f"sensor.clip={clip}")
        plan = planned(settings, picture(), f"noise={noise}", *TWO_NUMBERS[noise], *overrides)
        assert_same(picture(), plan)


@pytest.mark.parametrize("noise", ["imx385_iso3200", "imx385_iso3200_rvdd", "heteroscedastic"])
def test_kernels_equal_reference_with_pinned_saturated_sites(settings: Settings, noise: str) -> None:
    numbers = TWO_NUMBERS.get(noise, ())
    assert_same(picture(), planned(settings, picture(), f"noise={noise}", *numbers, "sensor.saturated=pinned"))


@pytest.fixture(scope="module")
def everything(settings: Settings) -> Plan:
    """Return a plan with every effect on."""
    group = ("noise=nikon_d850", "scene=long_exposure", "noise.iso=1600")
    return planned(settings, picture(), *group, forced=True)


def averaged(plan: Plan, fixed: bool = True) -> Plan:
    """Return the plan with or without fixed patterns in the clean frame."""
    return with_physics(plan, fixed_pattern_in_clean=fixed)


def with_physics(plan: Plan, **changes: Any) -> Plan:
    assert plan.physics is not None
    return replace(plan, physics=replace(plan.physics, **changes))


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
"""Effects that `_fill_shot_read_pair` simulates."""


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
        assert_noisy_alone(srgb, one, (0, 63))


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
            "read_law": st.sampled_from(["gaussian", "tukey"]), "read_shape": st.sampled_from([0.0, -0.2, 0.1]),
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


# Noisy frame alone ----------------------------------------------------------------------------------------------------


def assert_noisy_alone(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> None:
    """Check `make_noisy` on the unrounded clean frame of the reference, including its counts."""
    light = unprocess(srgb, plan, origin)
    light = light if plan.exposure == 1 else np.minimum(light, 1) * plan.exposure
    clean_dn = to_dn(light, plan.black_level_dn, plan.white_level_dn, plan.brightest)
    limits_dn = noisy_limits(plan.bits, plan.black_level_dn, plan.sensor_clip)
    noisy, counts = make_noisy(clean_dn, plan, limits_dn, origin)
    pair = make_pair(srgb, plan, origin)
    np.testing.assert_array_equal(noisy, pair.noisy)
    assert noisy.dtype == pair.noisy.dtype
    of_pair = pair.counts.noisy_clipped_low, pair.counts.noisy_clipped_high, pair.counts.zero_variance
    assert tuple(counts) == (0, 0, *of_pair[:2], 0, of_pair[2])


WITHOUT_WELL = tuple(effect for effect in EFFECTS if effect != "full_well")


@pytest.mark.parametrize("effect", [None, *WITHOUT_WELL])
def test_make_noisy_equals_pair_with_and_without_every_effect(everything: Plan, effect: str | None) -> None:
    plan = replace(everything, level=3, draw=2, frame=1)
    for on in ([one for one in WITHOUT_WELL if one != effect], [effect] if effect else []):
        for saturated, clip in itertools.product(["noisy", "pinned"], ["sensor", "black"]):
            one = replace(plan, effects=tuple(on), saturated=saturated, sensor_clip=clip)
            assert_noisy_alone(picture(), one, (3, 7))


@pytest.mark.parametrize("noise", TWO_NUMBERS)
def test_make_noisy_equals_pair_for_poisson_form(settings: Settings, noise: str) -> None:
    plan = planned(settings, picture(), f"noise={noise}", *TWO_NUMBERS[noise], "noise.law=poisson")
    assert_noisy_alone(picture(), plan)
    assert_noisy_alone(np.random.default_rng(6).integers(0, 256, (3, 2049, 3)).astype(np.uint8), plan, (5, 9))


def test_crop_of_clean_frame_gets_noise_of_its_sites(everything: Plan) -> None:
    clean_dn = np.random.default_rng(7).uniform(100, 4000, (60, 200))
    for some in (WITHOUT_WELL, ("shot", "read", "row", "quantise")):
        plan = replace(everything, effects=some)

        cut_out = make_noisy(clean_dn[8:40, 64:128], plan, (0.0, 4095.0), (8, 64))[0]

        np.testing.assert_array_equal(cut_out, make_noisy(clean_dn, plan, (0.0, 4095.0))[0][8:40, 64:128])


def test_make_noisy_refuses_clean_frame_that_depends_on_level(everything: Plan) -> None:
    for plan in (everything, replace(averaged(everything), effects=WITHOUT_WELL)):
        with pytest.raises(ValueError, match="clean frame depends on the noise level"):
            make_noisy(np.zeros((2, 2)), plan, (0.0, 4095.0))


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
    """Nor does the choice of kernel: a PRNU of 1 everywhere selects `_fill_physical_pair`."""
    plan = near_normal(replace(everything, effects=PLAIN), law_distance)
    other = with_physics(replace(plan, effects=("prnu", *PLAIN)), prnu_std=0.0)
    srgb = np.random.Generator(np.random.Philox(key=5)).integers(0, 256, (9, 1200, 3)).astype(np.uint8)
    frame = make_pair(srgb, plan)
    np.testing.assert_array_equal(frame.noisy, make_pair(srgb, other).noisy)
    np.testing.assert_array_equal(make_pair(srgb[3:, 70:], plan, (3, 70)).noisy, frame.noisy[3:, 70:])
    for one in (plan, other):
        assert_noisy_alone(srgb, one, (3, 7))


# Replay ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("noise", ISOS)
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


# Flats ----------------------------------------------------------------------------------------------------------------

BLACK, WHITE = 4096, 65535
SPAN = WHITE - BLACK

SILENT = Physics(
    iso=100.0, exposure_s=1.0, temperature_c=25.0, dn_per_e=8.0, prnu_std=0.0, dark_e=0.0, dark_offset="removed",
    hot_pixel_share=0.0, hot_pixel_e=0.0, full_well_e=1e6, read_law="gaussian", read_shape=0.0, read_std_dn=0.0,
    row_std_dn=0.0, column_std_dn=0.0, black_error_dn=(0.0, 0.0, 0.0, 0.0), dead_pixel_share=0.0, sensor_unit="0",
    body_key=0xB0D1, fixed_pattern_in_clean=False,
)  # fmt: skip


def plan_with(*on: str, frame: int = 0xF4A3E, **changes: Any) -> Plan:
    """Return a plan with only these effects, a 16-bit sensor, and light equal to the code divided by 65535."""
    physics = replace(SILENT, **changes)
    return Plan(
        seed=0, stream_key=frame, downscale=1, dequantize="off", scene="flat", exposure_ratio=1.0, camera="identity",
        weights=(0.0,) * 4,
        rgb2cam=IDENTITY, red_gain=1.0, blue_gain=1.0, inverse_rgb_gain=1.0, tone="none", gamma=1.0, highlight="none",
        highlight_threshold=0.9, pattern="RGGB", bits=16, black_level_dn=BLACK, white_level_dn=WHITE,
        sensor_clip="sensor", saturated="noisy", noise="flat", noise_law="gaussian", a_dn=physics.dn_per_e,
        b_dn2=physics.read_std_dn**2, effects=(*on, "quantise"), skipped=(), accuracy="exact", methods=(),
        physics=physics,
    )  # fmt: skip


def flat(code: int, height: int = 1024, width: int = 1024) -> Srgb:
    return np.full((height, width, 3), code, dtype=np.uint16)


def noisy_dn(plan: Plan, code: int = 0, height: int = 1024, width: int = 1024) -> np.ndarray:
    """Return the noisy frame of a flat, DN above black."""
    return make_pair(flat(code, height, width), plan).noisy.astype(np.float64) - BLACK


def signal_dn(code: int) -> float:
    return code / 65535 * SPAN


COUNT = 1024 * 1024


def bounds_off(values: np.ndarray, mean: float, variance: float, reach: float) -> float:
    """Return the error of the mean in units of its Bernstein bound."""
    return abs(float(values.mean()) - mean) / bernstein(variance, reach, values.size)


# Shot noise -----------------------------------------------------------------------------------------------------------


def poisson_reach(rate: float) -> float:
    """Return the largest distance of a count from its mean: Bernstein's tail at 2**-33, the least tail probability."""
    log = 33 * math.log(2)
    return log / 3 + math.sqrt(log**2 / 9 + 2 * log * rate) + 1


def assert_poisson(counts: np.ndarray, rate: float) -> None:
    """Check mean, variance, third moment and fraction of zeros; words resolve probabilities to 2**-32."""
    reach = poisson_reach(rate)
    deviation = counts - rate
    for order, moment, variance in (
        (1, 0.0, rate),
        (2, rate, rate + 2 * rate**2),
        (3, rate, rate + 24 * rate**2 + 15 * rate**3),
    ):
        bound = bernstein(variance, reach**order + moment, counts.size) + 2.0**-31 * reach**order
        assert abs(float((deviation**order).mean()) - moment) <= bound, order
    zero = math.exp(-min(rate, 700.0))
    assert abs(float((counts == 0).mean()) - zero) <= bernstein(zero * (1 - zero), 1, counts.size) + 2.0**-31


@pytest.mark.parametrize("code", [1, 9, 43, 170, 600, 5000, 60000])
def test_shot_noise_is_poisson_count_of_electrons(code: int) -> None:
    counts = noisy_dn(plan_with("shot"), code) / 8
    assert (counts == np.rint(counts)).all()
    assert_poisson(counts, signal_dn(code) / 8)


def test_poisson_check_rejects_another_rate() -> None:
    counts = noisy_dn(plan_with("shot"), 600) / 8
    with pytest.raises(AssertionError):
        assert_poisson(counts, signal_dn(600) / 8 * 1.01)


def test_no_light_gives_no_shot_noise() -> None:
    assert (noisy_dn(plan_with("shot"), 0) == 0).all()


@pytest.mark.parametrize("code", [0, 300, 5000, 40000])
def test_poisson_form_has_mean_variance_and_skewness(code: int) -> None:
    """Only counts have a third moment, a²·u. The fourth is that of a normal plus a⁴·rate; the sixth is a bound."""
    a, b = 12.5, 900.0
    plan = replace(
        plan_with(), physics=None, effects=("heteroscedastic", "quantise"), noise_law="poisson", a_dn=a, b_dn2=b
    )
    deviation = noisy_dn(plan, code) - signal_dn(code)
    rate = signal_dn(code) / a
    variance = a * a * rate + b + 1 / 12
    reach = a * poisson_reach(rate) + REACH * math.sqrt(b) + 1
    fourth = 3 * variance**2 + a**4 * rate
    sixth = 15 * variance**3 + 25 * a**4 * rate * variance + 10 * (a**3 * rate) ** 2 + a**6 * rate
    assert bounds_off(deviation, 0, variance, reach) <= 1
    assert bounds_off(deviation**2, variance, fourth - variance**2, reach**2) <= 1
    assert bounds_off(deviation**3, a**3 * rate, sixth, reach**3) <= 1


# Read noise -----------------------------------------------------------------------------------------------------------


SHAPES = (0.0, 1e-13, 0.015, 0.1571, 1.0, -0.1, -0.2429)


def tukey(tail: mpmath.mpf, shape: float) -> mpmath.mpf:
    """Return the quantile of a tail probability in the Tukey lambda distribution of scale 1."""
    if abs(shape) < 1e-12:
        return mpmath.log((1 - tail) / tail)
    return ((1 - tail) ** mpmath.mpf(shape) - tail ** mpmath.mpf(shape)) / mpmath.mpf(shape)


def tukey_deviation(shape: float) -> mpmath.mpf:
    """Return the standard deviation by numerical integration of the squared quantile function."""
    halves = [mpmath.mpf(10) ** -power for power in (60, 30, 15, 8, 4, 2, 1)] + [mpmath.mpf(1) / 2]
    beyond = 0
    if shape < 0:  # contribution below 1e-60: the square is nearly u**(2·shape) / shape**2
        beyond = mpmath.mpf(10) ** (-60 * (2 * mpmath.mpf(shape) + 1)) / (2 * mpmath.mpf(shape) + 1) / shape**2
    return mpmath.sqrt(2 * (mpmath.quad(lambda u: tukey(u, shape) ** 2, halves) + beyond))


@pytest.mark.parametrize("shape", SHAPES)
def test_tukey_standard_deviation_matches_quantiles(shape: float) -> None:
    with mpmath.workdps(30):
        exact = tukey_deviation(shape)
    assert float(tukey_std(shape)) == pytest.approx(float(exact), rel=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_tukey_quantiles_match_closed_form(shape: float) -> None:
    rng = np.random.Generator(np.random.Philox(key=3))
    spread = np.concatenate([2 ** np.arange(31), rng.integers(0, 2 ** np.arange(2, 32).repeat(5))])
    found = effects.by_inverse_cdf(spread.astype(np.uint32), tukey_table(shape))
    std = float(tukey_std(shape))
    for index, z in zip(spread.tolist(), found.tolist(), strict=True):
        exact = float(tukey((mpmath.mpf(index) + 0.5) / 2**32, shape)) / std
        assert abs(z - exact) <= 2e-7 * (1 + exact)


def table_moment(table: np.ndarray, order: int) -> float:
    """Return the exact moment of draws from a table, of both signs; each segment is a fraction of all words."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    t = (nodes + 1) / 2 / SEGMENTS
    values = table[:, :1] + t * (table[:, 1:2] + t * table[:, 2:3])
    share = np.repeat(2.0 ** (np.arange(OCTAVES) - 33.0), SEGMENTS) / SEGMENTS
    return float(2 * (share * ((values**order) @ (weights / 2))).sum())


@pytest.mark.parametrize("shape", SHAPES)
def test_tukey_table_has_variance_1(shape: float) -> None:
    """Except for the part beyond the least tail probability, 2**-33: below 1e-4 at shape -0.24."""
    with mpmath.workdps(20):
        ends = [mpmath.mpf(10) ** -40, mpmath.mpf(10) ** -20, mpmath.mpf(2) ** -33]
        beyond = 2 * mpmath.quad(lambda u: tukey(u, shape) ** 2, ends) / tukey_deviation(shape) ** 2
    assert 0 <= 1 - table_moment(tukey_table(shape), 2) <= float(beyond) + 1e-6


@pytest.mark.parametrize(("distribution", "shape"), [("gaussian", 0.0), *(("tukey", shape) for shape in SHAPES)])
def test_read_noise_has_given_standard_deviation_for_every_distribution(distribution: str, shape: float) -> None:
    std = 300.0
    plan = plan_with("read", read_law=distribution, read_shape=shape, read_std_dn=std)
    deviation = noisy_dn(plan, 32000) - signal_dn(32000)
    table = effects.read_table(plan.physics)  # type: ignore[arg-type]
    second, fourth, reach = table_moment(table, 2), table_moment(table, 4), float(np.abs(table[0]).sum()) * std + 1
    variance = std**2 * second + 1 / 12
    assert abs(second - 1) <= 1e-4
    assert bounds_off(deviation, 0, variance, reach) <= 1
    spread = std**4 * fourth + std**2 / 2 + 1 / 80 - variance**2
    assert bounds_off(deviation**2, variance, spread, reach**2) <= 1


def test_read_noise_check_rejects_another_standard_deviation() -> None:
    deviation = noisy_dn(plan_with("read", read_std_dn=303.0), 32000) - signal_dn(32000)
    assert bounds_off(deviation**2, 300.0**2, 2 * 300.0**4, (REACH * 300) ** 2) > 1


@pytest.mark.parametrize("iso", CRVD)
def test_imx385_read_noise_has_variance_of_crvd(settings: Settings, iso: int) -> None:
    plan = planned(settings, picture(), "noise=imx385", f"noise.iso={iso}")
    assert plan.physics is not None
    assert plan.physics.dn_per_e == CRVD[iso][0]
    assert plan.physics.read_std_dn**2 == pytest.approx(CRVD[iso][1], rel=1e-12)
    assert plan.b_dn2 == plan.physics.read_std_dn**2


@pytest.mark.parametrize("iso", CRVD)
def test_pmn_scale_gives_almost_twice_the_standard_deviation(iso: int) -> None:
    """PMN gives ln scale = 0.9550 ln K + 0.0162 and shape 0.015 for the same recordings."""
    gain, variance = CRVD[iso]
    scale = math.exp(0.9550 * math.log(gain) + 0.0162)
    assert 1.7 < scale * float(tukey_std(0.015)) / math.sqrt(variance) < 1.9


@pytest.mark.parametrize("noise", ISOS)
def test_plan_has_gain_and_read_variance_of_profile(settings: Settings, noise: str) -> None:
    plan = planned(settings, picture(), f"noise={noise}", f"noise.iso={ISOS[noise]}")
    assert plan.physics is not None
    assert branch_of(settings(f"noise={noise}").noise, ISOS[noise]) is not None
    assert (plan.a_dn, plan.b_dn2) == (plan.physics.dn_per_e, plan.physics.read_std_dn**2)
    assert plan.physics.dn_per_e > 0
    assert plan.physics.read_std_dn > 0


def test_tukey_scale_is_multiplied_by_standard_deviation_of_shape(settings: Settings) -> None:
    """Sony A7S II from ISO 200 to 1600, without scatter: ln scale = 0.740 ln K + 0.862, ln row = 0.788 ln K - 0.342."""
    plan = planned(settings, picture(), "noise=sony_a7s2", "noise.iso=800")
    assert plan.physics is not None
    gain, scale = 9.563e-4 * 800, (4095 - 240) / (16383 - 512)
    assert plan.physics.dn_per_e == pytest.approx(gain * scale, rel=1e-15)
    deviation = math.exp(0.740 * math.log(gain) + 0.862) * float(tukey_deviation(plan.physics.read_shape))
    assert plan.physics.read_std_dn == pytest.approx(deviation * scale, rel=1e-9)
    assert plan.physics.row_std_dn == pytest.approx(math.exp(0.788 * math.log(gain) - 0.342) * scale, rel=1e-12)


def test_scatter_about_line_is_normal_in_logarithm(settings: Settings) -> None:
    config = settings("noise=oppo_reno10x", "noise.iso=800")
    config.noise.branches[0].read_std_dn = ["line", 0.5, 1.25, 0.25]
    validate_config(config)
    facts = facts_of(picture())
    plans = [plan_image(config, f"{n:064x}", facts=facts) for n in range(150)]
    scale = (4095 - 240) / (1023 - 64)
    centre = 0.5 * math.log(0.0005995267 * 800 + 0.00868861) + 1.25
    normals = np.array([(math.log(math.sqrt(plan.b_dn2) / scale) - centre) / 0.25 for plan in plans])
    assert bounds_off(normals, 0, 1, REACH) <= 1
    assert bounds_off(normals**2, 1, 2, REACH**2) <= 1
    assert 0.11 < float((normals > 0.5).mean()) < 0.5  # 0.309, five standard deviations


# Rows and columns -----------------------------------------------------------------------------------------------------

OFFSETS = 2**15


def assert_normal_offsets(offsets: np.ndarray, std: float) -> None:
    """Check mean and variance of rounded normals."""
    variance, reach = std**2 + 1 / 12, REACH * std + 1
    assert bounds_off(offsets, 0, variance, reach) <= 1
    assert bounds_off(offsets**2, variance, 2 * variance**2, reach**2) <= 1


def test_row_has_one_offset_of_given_standard_deviation() -> None:
    deviation = noisy_dn(plan_with("row", row_std_dn=300.0), 0, OFFSETS, 5)
    assert (deviation == deviation[:, :1]).all()
    assert_normal_offsets(deviation[:, 0], 300.0)


def test_row_offsets_differ_between_frames() -> None:
    one, other = (noisy_dn(plan_with("row", row_std_dn=300.0, frame=frame), 0, OFFSETS, 1) for frame in (1, 2))
    assert_normal_offsets((one - other)[:, 0] / math.sqrt(2), 300.0)


def test_column_has_one_offset_of_given_standard_deviation() -> None:
    deviation = noisy_dn(plan_with("column", column_std_dn=300.0), 0, 5, OFFSETS)
    assert (deviation == deviation[:1]).all()
    assert_normal_offsets(deviation[0], 300.0)


def test_column_offsets_are_fixed_per_sensor_unit() -> None:
    plan = plan_with("column", column_std_dn=300.0)
    one, later, other = (
        noisy_dn(one, 0, 1, OFFSETS) for one in (plan, replace(plan, stream_key=2), with_physics(plan, body_key=9))
    )
    assert (one == later).all()
    assert_normal_offsets((one - other)[0] / math.sqrt(2), 300.0)


# Dark current ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dark_e", [0.5, 7.0, 150.0])
def test_dark_current_is_independent_poisson_count(dark_e: float) -> None:
    plan = plan_with("dark_current", dark_e=dark_e, dark_offset="kept")
    assert_poisson(noisy_dn(plan, 0) / 8, dark_e)
    assert_poisson((noisy_dn(plan, 32000) - round(signal_dn(32000))) / 8, dark_e)


def test_removed_dark_offset_keeps_variance() -> None:
    removed = noisy_dn(plan_with("dark_current", dark_e=7.0, dark_offset="removed"), 0)
    kept = noisy_dn(plan_with("dark_current", dark_e=7.0, dark_offset="kept"), 0)
    assert (kept - removed == 7 * 8).all()
    assert bounds_off(removed, 0, 7.0 * 64, 8 * poisson_reach(7.0)) <= 1


@pytest.mark.parametrize("doubling", [7.0, 5.5])
def test_dark_current_scales_with_temperature_and_exposure_time(settings: Settings, doubling: float) -> None:
    def dark_e(celsius: float, seconds: float) -> float:
        overrides = ("noise=sony_a7s2", f"noise.dark_doubling_c={doubling}", "noise.dark_e_per_s=3")
        plan = planned(settings, picture(), *overrides, f"scene.temperature_c={celsius}", f"scene.exposure_s={seconds}")
        assert plan.physics is not None
        assert plan.physics.hot_pixel_e == pytest.approx(plan.physics.dark_e * 50 / 3, rel=1e-12)
        return plan.physics.dark_e

    assert dark_e(25, 2) == 6
    for times in (-3, -1, 1, 2, 5):
        assert dark_e(25 + times * doubling, 2) == pytest.approx(6 * 2.0**times, rel=1e-12)
    assert dark_e(25 + doubling / 2, 4) == pytest.approx(12 * math.sqrt(2), rel=1e-12)


# Hot and dead pixels --------------------------------------------------------------------------------------------------

SHARE = 0.01


@pytest.fixture(scope="module")
def hot() -> np.ndarray:
    """Return the mean excess of about 10,000 hot pixels of a sensor unit, 0 for other pixels."""
    return effects.hot_pixel_means(replace(SILENT, hot_pixel_share=SHARE, hot_pixel_e=200.0), (1024, 1024))


def test_hot_pixels_have_given_fraction(hot: np.ndarray) -> None:
    assert bounds_off(hot > 0, SHARE, SHARE * (1 - SHARE), 1) <= 1


def test_hot_pixel_means_are_exponential(hot: np.ndarray) -> None:
    """Bound the Kolmogorov distance (Dvoretzky, Kiefer, Wolfowitz, Massart); levels have steps of 1/1024."""
    means = np.sort(hot[hot > 0])
    rank = np.arange(len(means) + 1) / len(means)
    cdf = 1 - np.exp(-means / 200)
    distance = max((rank[1:] - cdf).max(), (cdf - rank[:-1]).max())
    assert distance <= math.sqrt(math.log(2 / 1e-12) / (2 * len(means))) + 1 / 1024


def test_exponential_levels_have_its_mean_and_nearly_its_variance() -> None:
    """The variance is 1 minus the variance within the steps, mostly the last: 3e-3."""
    levels = exponential_levels()
    assert float(levels.mean()) == pytest.approx(1, rel=1e-14)
    assert 0.995 < float(levels.var()) < 1
    assert (np.diff(levels) > 0).all()


def test_hot_pixels_add_poisson_count_of_their_mean(hot: np.ndarray) -> None:
    plan = plan_with("hot_pixels", hot_pixel_share=SHARE, hot_pixel_e=200.0)
    counts = noisy_dn(plan, 0) / 8
    assert (counts[hot == 0] == 0).all()
    expected, highest = float(hot.mean()), float(hot.max())
    assert bounds_off(counts, expected, expected, poisson_reach(highest)) <= 1
    score = ((counts - hot) ** 2)[hot > 0] - hot[hot > 0]  # each of mean 0 and variance m + 2 m²
    bound = bernstein(float((hot + 2 * hot**2)[hot > 0].mean()), poisson_reach(highest) ** 2, score.size)
    assert abs(float(score.mean())) <= bound


def test_hot_and_dead_pixels_are_fixed_per_sensor_unit() -> None:
    plan = plan_with("hot_pixels", "dead_pixels", hot_pixel_share=SHARE, hot_pixel_e=1e4, dead_pixel_share=SHARE)
    one, later = (noisy_dn(replace(plan, stream_key=frame), 0) for frame in (1, 2))
    shining = [np.abs(frame) > 8 * 500 for frame in (one, later)]  # hot enough, or dead
    assert ((one == -BLACK) == (later == -BLACK)).all()
    assert (shining[0] != shining[1]).mean() < SHARE / 50  # those whose mean is 500
    assert (one != later).any()


def test_hot_and_dead_pixels_differ_between_sensor_units(hot: np.ndarray) -> None:
    physics = replace(SILENT, hot_pixel_share=SHARE, hot_pixel_e=200.0, dead_pixel_share=SHARE)
    other = replace(physics, body_key=9)
    both = (hot > 0) & (effects.hot_pixel_means(other, (1024, 1024)) > 0)
    assert bounds_off(both, SHARE**2, SHARE**2, 1) <= 1
    both = effects.dead(physics, (1024, 1024)) & effects.dead(other, (1024, 1024))
    assert bounds_off(both, SHARE**2, SHARE**2, 1) <= 1


def test_hot_and_dead_pixels_are_independent(hot: np.ndarray) -> None:
    dead = effects.dead(replace(SILENT, dead_pixel_share=SHARE), (1024, 1024))
    assert bounds_off(dead & (hot > 0), SHARE**2, SHARE**2, 1) <= 1


def test_dead_pixels_read_0_and_have_given_fraction() -> None:
    plan = plan_with("read", "dead_pixels", dead_pixel_share=SHARE, read_std_dn=30.0)
    frame = make_pair(flat(40000), plan).noisy
    assert bounds_off(frame == 0, SHARE, SHARE * (1 - SHARE), 1) <= 1
    assert frame[frame > 0].min() > 30000


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_none_or_all_pixels_can_be_dead_or_hot(share: float) -> None:
    assert ((noisy_dn(plan_with("dead_pixels", dead_pixel_share=share), 500, 64, 64) == -BLACK) == (share == 1)).all()
    means = effects.hot_pixel_means(replace(SILENT, hot_pixel_share=share, hot_pixel_e=9.0), (64, 64))
    assert ((means > 0) == (share == 1)).all()
    assert_same(flat(500, 64, 64), plan_with("hot_pixels", hot_pixel_share=share, hot_pixel_e=9.0))


# Fixed patterns -------------------------------------------------------------------------------------------------------


def test_prnu_has_mean_1_and_given_standard_deviation() -> None:
    pattern = effects.response(replace(SILENT, prnu_std=0.01), (1024, 1024))
    assert bounds_off(pattern, 1, 1e-4, REACH * 0.01) <= 1
    assert bounds_off((pattern - 1) ** 2, 1e-4, 2e-8, (REACH * 0.01) ** 2) <= 1


def test_prnu_response_is_never_negative() -> None:
    pattern = effects.response(replace(SILENT, prnu_std=0.5), (1024, 1024))
    assert pattern.min() == 0


@pytest.mark.parametrize("code", [0, 800, 20000, 50000])
def test_prnu_scales_with_signal_and_is_fixed_between_frames(code: int) -> None:
    plan = plan_with("prnu", prnu_std=0.01)
    pattern = effects.response(plan.physics, (1024, 1024))  # type: ignore[arg-type]
    frame = noisy_dn(plan, code)
    np.testing.assert_array_equal(frame, np.rint(signal_dn(code) * pattern + BLACK) - BLACK)
    np.testing.assert_array_equal(frame, noisy_dn(replace(plan, stream_key=2), code))


def test_prnu_differs_between_sensor_units() -> None:
    physics = replace(SILENT, prnu_std=0.01)
    one, other = (effects.response(replace(physics, body_key=key), (1024, 1024)) - 1 for key in (1, 2))
    assert bounds_off(one * other, 0, 1e-8, (REACH * 0.01) ** 2) <= 1


def test_black_error_depends_on_cfa_site_alone() -> None:
    plan = plan_with("black_error", black_error_dn=(1.0, -2.0, 3.0, -4.0))
    assert noisy_dn(plan, 0, 4, 5).tolist() == [[1, -2, 1, -2, 1], [3, -4, 3, -4, 3]] * 2
    assert (make_pair(flat(0, 2, 2), plan, (1, 1)).noisy.astype(int) - BLACK).tolist() == [[-4, 3], [-2, 1]]


@pytest.mark.parametrize(
    ("iso", "row"), [(100, 0), (141, 0), (142, 1), (199, 1), (201, 2), (282, 2), (283, 3), (400, 3)]
)
def test_black_error_table_divides_iso_range_evenly_in_logarithm(settings: Settings, iso: int, row: int) -> None:
    config = settings("noise=nikon_d850", f"noise.iso={iso}")
    config.noise.branches[0].iso = [100, 400]
    config.noise.branches[0].black_error_dn = ["by_log_iso", *([n, 10 * n, -n, 0.5] for n in range(4))]
    validate_config(config)
    physics = plan_image(config, SHA256, facts=facts_of(picture())).physics
    scale = (4095 - 240) / (16383 - 400)
    assert physics is not None
    assert physics.black_error_dn == pytest.approx([scale * one for one in (row, 10 * row, -row, 0.5)], rel=1e-12)


def test_black_error_table_accepts_a_single_iso(settings: Settings) -> None:
    config = settings("noise=nikon_d850", "noise.iso=100")
    config.noise.branches[0].iso = [100, 100]
    validate_config(config)
    physics = plan_image(config, SHA256, facts=facts_of(picture())).physics
    assert physics is not None
    assert physics.black_error_dn[0] < 0


def test_full_well_clips_clean_and_noisy_frames() -> None:
    plan = plan_with("shot", "full_well", full_well_e=5000.0)
    pair = make_pair(flat(60000), plan)  # 7031 electrons
    assert (pair.clean == BLACK + 8 * 5000).all()
    assert pair.counts.clean_clipped_high == COUNT
    pair = make_pair(flat(42600), plan)  # 4992 electrons
    assert (pair.clean == round(signal_dn(42600) + BLACK)).all()
    full = pair.noisy == BLACK + 8 * 5000
    assert 0.4 < full.mean() < 0.5
    assert pair.noisy[~full].max() < BLACK + 8 * 5000


def test_read_noise_is_added_after_full_well() -> None:
    frame = noisy_dn(plan_with("full_well", "read", full_well_e=5000.0, read_std_dn=100.0), 60000)
    assert bounds_off(frame, 8 * 5000, 100.0**2 + 1 / 12, REACH * 100 + 1) <= 1


def test_clean_frame_with_fixed_patterns_is_mean_of_noisy_frames() -> None:
    """It contains hot-pixel means, columns, black-level errors and dead pixels, but no temporal noise."""
    size, frames = (24, 31), 400
    plan = plan_with(
        *("prnu", "shot", "dark_current", "hot_pixels", "read", "row", "column", "black_error", "dead_pixels"),
        prnu_std=0.05, dark_e=5.0, hot_pixel_share=0.2, hot_pixel_e=100.0, read_std_dn=20.0, row_std_dn=10.0,
        column_std_dn=150.0, black_error_dn=(20.0, -30.0, 40.0, -50.0), dead_pixel_share=0.1,
        fixed_pattern_in_clean=True,
    )  # fmt: skip
    clean = make_pair(flat(5000, *size), plan).clean.astype(np.float64)
    noisy = [make_pair(flat(5000, *size), replace(plan, stream_key=frame)) for frame in range(frames)]
    assert all((one.clean == clean).all() for one in noisy)
    mean = np.mean([one.noisy for one in noisy], axis=0)
    electrons = 5000 * 1.3 / 8 + 5 + 800  # no pixel has more, in the mean
    variance, reach = 64 * electrons + 20**2 + 10**2, 8 * poisson_reach(electrons) + REACH * 30
    assert np.abs(mean - clean).max() <= bernstein(variance, reach, frames, 1e-15) + 0.5
    assert (clean[mean == 0] == 0).all()


def test_clean_frame_with_fixed_patterns_keeps_dark_offset_of_frames() -> None:
    """If the dark mean is removed, the clean frame contains light only."""
    size, frames, dark_e = (16, 31), 200, 7.3
    plan = plan_with("shot", "dark_current", dark_e=dark_e, dark_offset="kept", fixed_pattern_in_clean=True)
    clean = make_pair(flat(5000, *size), plan).clean
    assert (clean == round(signal_dn(5000) + BLACK + 8 * dark_e)).all()
    mean = np.mean([make_pair(flat(5000, *size), replace(plan, stream_key=key)).noisy for key in range(frames)], axis=0)
    rate = signal_dn(5000) / 8 + dark_e
    assert np.abs(mean - clean).max() <= bernstein(64 * rate, 16 * poisson_reach(rate), frames, 1e-15) + 0.5
    removed = make_pair(flat(5000, *size), with_physics(plan, dark_offset="removed")).clean
    assert (removed == round(signal_dn(5000) + BLACK)).all()


def test_mean_of_frames_does_not_exceed_full_well() -> None:
    """Hot pixels and dark current fill wells too; column offsets in DN are added afterwards."""
    size, frames = (24, 31), 100
    plan = plan_with(
        *("shot", "dark_current", "hot_pixels", "full_well", "column"),
        dark_e=50.0, dark_offset="kept", hot_pixel_share=0.3, hot_pixel_e=4000.0, full_well_e=2000.0,
        column_std_dn=20.0, fixed_pattern_in_clean=True,
    )  # fmt: skip
    clean = make_pair(flat(5000, *size), plan).clean.astype(np.float64)
    columns_dn = effects.offsets(plan, size, fixed_only=True)
    full = np.rint(8 * 2000 + BLACK + columns_dn)
    assert (clean <= full).all()
    assert 0.1 < (clean == full).mean() < 0.3
    noisy = np.array([make_pair(flat(5000, *size), replace(plan, stream_key=key)).noisy for key in range(frames)])
    assert (noisy.mean(axis=0) <= full).all()
    overfull = effects.hot_pixel_means(plan.physics, size) > 3000  # type: ignore[arg-type]
    assert overfull.any()
    assert (noisy[:, overfull] == full[overfull]).all()
    assert (clean[overfull] == full[overfull]).all()


# Independence of effects ----------------------------------------------------------------------------------------------

COUNTED = {"dark_e": 3.0, "hot_pixel_share": 0.3, "hot_pixel_e": 20.0, "dn_per_e": 16.0}


@pytest.mark.parametrize("effect", ["shot", "dark_current", "hot_pixels"])
def test_omitted_effect_in_electrons_changes_no_other_effect(effect: str, figure: Figure) -> None:
    """Electrons and DN are integers, so that the contribution of an effect is exact."""
    others = [one for one in ("shot", "dark_current", "hot_pixels") if one != effect]

    def frame(*on: str) -> np.ndarray:
        plan = replace(plan_with(*on, **COUNTED), black_level_dn=0)
        return make_pair(flat(8000, 256, 256), plan).noisy.astype(np.int64)

    alone = frame(effect) - frame()
    assert (alone != 0).any()
    assert (frame(*(one for one in EFFECTS if one in {effect, *others})) - frame(*others) == alone).all()
    figure("effects", f"{effect}: other effects unchanged at {alone.size} of {alone.size} sites")


ALL = {
    **COUNTED, "prnu_std": 0.02, "read_law": "tukey", "read_std_dn": 7.5, "row_std_dn": 3.3, "column_std_dn": 2.2,
    "black_error_dn": (1.5, 0.25, -3.125, 2.0), "dead_pixel_share": 0.1, "full_well_e": 1e5,
}  # fmt: skip


@pytest.mark.parametrize("effect", ["read", "row", "column", "black_error"])
def test_omitted_effect_in_dn_removes_only_its_values(effect: str) -> None:
    clean_dn = np.full((64, 96), 20000.0)
    on = [one for one in EFFECTS[:-1] if one != "dead_pixels"]
    with_it = effects.physical(clean_dn, plan_with(*on, **ALL))
    without = effects.physical(clean_dn, plan_with(*(one for one in on if one != effect), **ALL))
    alone = effects.physical(clean_dn, plan_with(effect, **ALL)) - clean_dn
    assert np.abs(alone).max() > 1
    np.testing.assert_allclose(with_it - without, alone, rtol=0, atol=1e-10)


def test_omitted_dead_pixels_change_no_other_pixel() -> None:
    with_it, without = (
        make_pair(flat(20000, 64, 96), plan_with(*on, **ALL)).noisy for on in (EFFECTS[:-1], EFFECTS[:-2])
    )
    dead = effects.dead(replace(SILENT, dead_pixel_share=0.1), (64, 96))
    assert (with_it[dead] == 0).all()
    assert (with_it[~dead] == without[~dead]).all()


def test_omitted_prnu_changes_nothing_in_the_dark() -> None:
    """With light it changes the mean of the shot noise."""
    with_it, without = (make_pair(flat(0, 64, 96), plan_with(*on, **ALL)).noisy for on in (EFFECTS[:-1], EFFECTS[1:-1]))
    np.testing.assert_array_equal(with_it, without)


def test_full_well_above_signal_changes_nothing() -> None:
    on = [one for one in EFFECTS[:-1] if one != "full_well"]
    with_it, without = (make_pair(flat(20000, 64, 96), plan_with(*one, **ALL)).noisy for one in (EFFECTS[:-1], on))
    np.testing.assert_array_equal(with_it, without)


def test_effects_of_frame_are_uncorrelated(figure: Figure) -> None:
    """Check the correlations between contributions of single effects."""
    added = []
    for effect in ("shot", "dark_current", "read"):
        plan = plan_with(effect, dark_e=500.0, read_std_dn=200.0, dark_offset="removed")
        frame = noisy_dn(plan, 30000) - signal_dn(30000)
        added.append(frame / frame.std())
    for one, other in itertools.combinations(added, 2):
        assert bounds_off(one * other, 0, 1.05, 50) <= 1
    largest = max(abs(float(np.mean(a * b))) for a, b in itertools.combinations(added, 2))
    figure("effects", f"largest correlation of two effects: {largest:.1g}")


# Exposure -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0, 100.0])
def test_exposure_ratio_darkens_scene_before_sensor(ratio: float) -> None:
    plan = replace(plan_with("shot", "read", read_std_dn=50.0), exposure_ratio=ratio)
    pair = make_pair(flat(24000), plan)
    signal = signal_dn(24000) / ratio
    assert (pair.clean == round(signal + BLACK)).all()
    variance = 8 * signal + 50**2 + 1 / 12
    reach = 8 * poisson_reach(signal / 8) + REACH * 50 + 1
    deviation = pair.noisy.astype(np.float64) - BLACK - signal
    assert bounds_off(deviation, 0, variance, reach) <= 1
    assert bounds_off(deviation**2, variance, 2 * variance**2 + 8**3 * signal, reach**2) <= 1


def test_darkened_scene_equals_darker_photograph(settings: Settings) -> None:
    linear = ("camera=identity", "gains=unity", "isp=linear")
    codes = np.random.Generator(np.random.Philox(key=4)).integers(0, 65536, (40, 50, 3)).astype(np.uint16)
    plan = planned(settings, codes, *linear, "scene.exposure_ratio=5", "noise=imx385_iso3200")
    five = make_pair(codes // 5 * 5, plan)
    one = make_pair(codes // 5, replace(plan, exposure_ratio=1.0))
    assert np.abs(five.clean.astype(int) - one.clean).max() <= 1  # 1/5 is not exact: halves may round either way
    assert (five.clean == one.clean).mean() > 0.999
    assert (five.noisy == one.noisy).mean() > 0.999


def test_two_parameter_noise_follows_darkened_scene(settings: Settings) -> None:
    linear = ("camera=identity", "gains=unity", "isp=linear")
    plan = planned(settings, flat(9, 1, 1), *linear, "scene.exposure_ratio=16", "noise=imx385_iso3200")
    pair = make_pair(flat(52000), plan)
    signal = 52000 / 65535 / 16 * (4095 - 240)
    variance = plan.a_dn * signal + plan.b_dn2 + 1 / 12
    assert (pair.clean == round(240 + signal)).all()
    deviation = pair.noisy - 240.0 - signal
    reach = REACH * math.sqrt(variance) + 1
    slack = SAMPLER_ERROR * 4 * variance
    assert abs(float(deviation.mean())) <= bernstein(variance, reach, COUNT) + slack
    assert abs(float((deviation**2).mean()) - variance) <= bernstein(2 * variance**2, reach**2, COUNT) + slack


# Saturation -----------------------------------------------------------------------------------------------------------

WHITES = {
    "gaussian": replace(plan_with(), physics=None, effects=("heteroscedastic", "quantise"), a_dn=8.0, b_dn2=900.0),
    "poisson": replace(
        plan_with(), physics=None, effects=("heteroscedastic", "quantise"), a_dn=8.0, b_dn2=900.0, noise_law="poisson"
    ),
    "physical": plan_with("shot", "read", "row", read_std_dn=30.0, row_std_dn=5.0),
}


@pytest.mark.parametrize("distribution", WHITES)
def test_noise_of_saturated_sites_is_clipped_at_white(distribution: str) -> None:
    frame = make_pair(flat(65535), WHITES[distribution]).noisy
    assert 0.49 < (frame == WHITE).mean() < 0.52
    assert frame.mean() < WHITE - 200  # (8·61439 + 900)**½ / (2π)**½ is 280


@pytest.mark.parametrize("distribution", WHITES)
def test_pinning_changes_saturated_sites_only(distribution: str) -> None:
    srgb = np.where(np.random.Generator(np.random.Philox(key=5)).random((200, 300, 1)) < 0.3, 65535, 65000)
    srgb = np.broadcast_to(srgb, (200, 300, 3)).astype(np.uint16)
    free, pinned = (
        make_pair(srgb, replace(WHITES[distribution], saturated=saturated)) for saturated in ("noisy", "pinned")
    )
    white = free.clean == WHITE
    assert 0 < white.mean() < 1
    np.testing.assert_array_equal(free.clean, pinned.clean)
    assert (pinned.noisy[white] == WHITE).all()
    np.testing.assert_array_equal(pinned.noisy[~white], free.noisy[~white])


# Sensor units ---------------------------------------------------------------------------------------------------------


def test_each_image_has_its_own_sensor_unit_by_default(settings: Settings) -> None:
    config = settings("noise=sony_a7s2")
    facts = facts_of(picture())
    bodies = {plan_image(config, f"{n:064x}", facts=facts).physics.body_key for n in range(40)}  # type: ignore[union-attr]
    assert len(bodies) == 40


def test_images_share_given_number_of_sensor_units(settings: Settings) -> None:
    config = settings("noise=sony_a7s2", "sensor.units=3")
    facts = facts_of(picture())
    physics = [plan_image(config, f"{n:064x}", facts=facts).physics for n in range(40)]
    bodies = {(one.sensor_unit, one.body_key) for one in physics if one is not None}
    assert {unit for unit, _ in bodies} == {"0", "1", "2"}
    assert len(bodies) == 3


def test_row_contains_every_field_of_physics() -> None:
    """Replay needs every parameter."""
    pair = make_pair(flat(0, 2, 2), plan_with())
    row = pair_row("00000000", Source(0, "a", "a", 1), SHA256, 1, 0, plan_with(), pair, ("0" * 32, "0" * 32), PATCH)
    for field in dataclasses.fields(Physics):
        assert field.name in row or f"{field.name}_00" in row
