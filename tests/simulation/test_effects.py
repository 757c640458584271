"""Each physical effect has its distribution, and fixed patterns belong to a sensor unit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from helpers.datasets import Settings
from helpers.flats import (
    BLACK,
    COUNT,
    SILENT,
    SPAN,
    bounds_off,
    flat,
    hot_pixel_means,
    noisy_dn,
    picture,
    plan_with,
    planned,
    poisson_reach,
    response,
    signal_dn,
    with_physics,
)
from helpers.moments import REACH, bernstein

from unprocess_gen.simulation import plan_slots
from unprocess_gen.simulation.effects import EFFECTS, PHYSICAL_EFFECTS
from unprocess_gen.simulation.effects.dsnu import Dsnu
from unprocess_gen.simulation.effects.effect import Effect
from unprocess_gen.simulation.effects.prnu import Prnu
from unprocess_gen.simulation.kernels import readout
from unprocess_gen.simulation.lookup_tables import exponential_levels
from unprocess_gen.simulation.pair import crop_maker, make_pair
from unprocess_gen.simulation.plan import DarkFramePlan
from unprocess_gen.simulation.plan_slots import slots_of
from unprocess_gen.simulation.reference.electrons import columns_dn
from unprocess_gen.simulation.self_test import GOLDEN_PHYSICS, GOLDEN_PLAN, golden_image
from unprocess_gen.simulation.slots import Patterns, Slots

# Slots ----------------------------------------------------------------------------------------------------------------

IN_EVERY_PAIR = {"heteroscedastic", "quantise"}
"""Two-parameter noise, which is no physical effect, and rounding, which no slot decides."""


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_every_physical_effect_fills_a_slot_of_the_kernels(effect: Effect) -> None:
    """Kernels simulate slots only: without one, only the reference would have the effect that a row names."""
    filled = effect.slots(plan_with(effect.name).replace(dark=DarkFramePlan("0" * 64, (0, 0), 0.0, 1.0)))
    assert filled.keys() <= {*Slots._fields, *Patterns._fields}
    assert bool(filled) != (effect.name in IN_EVERY_PAIR)


def test_two_effects_in_one_slot_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Dsnu, "slots", Prnu.slots)
    with pytest.raises(AssertionError, match="the effects prnu and dsnu both fill the slot electrons"):
        slots_of(plan_with("prnu", "dsnu", prnu_std=0.125))


ALONE = [(name,) for name in PHYSICAL_EFFECTS]
EVERY = GOLDEN_PHYSICS.replace(
    column_temporal_std_dn=1.5, dsnu_std_e=0.5, gain_by_colour=(0.9, 1.0, 1.1),
    lens_shading=(-0.3, 0.0, 0.0), frame_size=(19, 83),
)  # fmt: skip


@pytest.mark.parametrize("changes", [{"row_correlation": 0.5}, {"fixed_pattern_in_clean": True}], ids=str)
@pytest.mark.parametrize("effects", [*ALONE, PHYSICAL_EFFECTS], ids=lambda on: on[0] if len(on) == 1 else "all")
def test_crops_in_each_epoch_are_those_of_the_pair(effects: tuple[str, ...], changes: dict[str, Any]) -> None:
    """Crops keep slots between epochs if these have no words of the frame."""
    physics, srgb = EVERY.replace(**changes), golden_image()
    plan = GOLDEN_PLAN.replace(physics=physics, effects=effects, exposure_ratio=1.5, frame=3)
    make = crop_maker(plan, (8, 64), srgb.shape[:2], (6, 10), 256)
    for epoch in (0, 1, 2):
        pair = make_pair(srgb, plan.replace(epoch=epoch))
        clean, noisy, _ = make(np.ascontiguousarray(srgb[6:14, 10:74]), (6, 10), epoch)
        np.testing.assert_array_equal(clean, pair.clean[6:14, 10:74])
        np.testing.assert_array_equal(noisy, pair.noisy[6:14, 10:74])
    assert slots_of(plan).depends_on_epoch == (slots_of(plan) != slots_of(plan.replace(epoch=1)))


OTHER_SENSORS = [
    GOLDEN_PLAN.sensor.replace(**{name: value})
    for name, value in (
        ("pattern", "BGGR"), ("bits", 12), ("black_level_dn", 65), ("white_level_dn", 1000), ("sensor_clip", "black"),
        ("saturated_as", "white"),
    )
]  # fmt: skip
CHANGES: list[dict[str, Any]] = [
    {}, {"seed": 1}, {"stream_key": 5}, {"frame": 3}, {"level": 2}, {"draw": 1}, {"epoch": 4}, {"a_dn": 7.0},
    {"dtype": "float32"}, {"clean_dtype": "float32"}, {"layout": "packed"}, {"exposure_ratio": 3.0},
    {"inverse_rgb_gain": 0.5}, *({"sensor": sensor} for sensor in OTHER_SENSORS),
    *({"physics": EVERY.replace(**numbers), "effects": PHYSICAL_EFFECTS}
      for numbers in ({}, {"full_well_e": 200.0}, {"body_key": 3}, {"fixed_pattern_in_clean": True})),
]  # fmt: skip


def test_plans_share_slots_and_read_outs_only_if_theirs_are_equal() -> None:
    plans = [GOLDEN_PLAN.replace(**before).replace(**after) for before in CHANGES for after in CHANGES]
    for plan in plans:
        assert slots_of(plan) == plan_slots._slots_of(plan)
        given = (plan,), (4, 6), (0, 1), plan.accuracy == "fast"
        for shared, own in zip(readout.readout_of(*given), readout._readout_of(*given), strict=True):
            np.testing.assert_array_equal(shared, own)


# Shot noise -----------------------------------------------------------------------------------------------------------


def assert_poisson(counts: np.ndarray, rate: float) -> None:
    """Check mean, variance, third moment and fraction of zeros; words resolve probabilities to 2**-32."""
    reach = poisson_reach(rate)
    deviation = counts - rate
    for power, moment, variance in (
        (1, 0.0, rate),
        (2, rate, rate + 2 * rate**2),
        (3, rate, rate + 24 * rate**2 + 15 * rate**3),
    ):
        bound = bernstein(variance, reach**power + moment, counts.size) + 2.0**-31 * reach**power
        assert abs(float((deviation**power).mean()) - moment) <= bound, power
    zero = math.exp(-min(rate, 700.0))
    assert abs(float((counts == 0).mean()) - zero) <= bernstein(zero * (1 - zero), 1, counts.size) + 2.0**-31


@pytest.mark.parametrize("code", [1, 9, 43, 170, 600, 5000, 60000])
def test_shot_noise_is_poisson_count_of_electrons(code: int) -> None:
    counts = noisy_dn(plan_with("shot"), code) / 8
    assert (counts == np.rint(counts)).all()
    assert_poisson(counts, signal_dn(code) / 8)


@pytest.mark.parametrize("code", [0, 300, 5000, 40000])
def test_poisson_form_has_mean_variance_and_skewness(code: int) -> None:
    """Only counts have a third moment, a²·u. The fourth is that of a normal plus a⁴·rate; the sixth is a bound."""
    a, b = 12.5, 900.0
    plan = plan_with().replace(
        physics=None, effects=("heteroscedastic", "quantise"), noise_law="poisson", a_dn=a, b_dn2=b
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


# Rows and columns -----------------------------------------------------------------------------------------------------

OFFSETS = 2**15


def assert_normal_offsets(offsets: np.ndarray, std: float) -> None:
    """Check mean and variance of rounded normals."""
    variance, reach = std**2 + 1 / 12, REACH * std + 1
    assert bounds_off(offsets, 0, variance, reach) <= 1
    assert bounds_off(offsets**2, variance, 2 * variance**2, reach**2) <= 1


@pytest.mark.parametrize("correlation", [0.9, 0.5, -0.7])
def test_correlated_rows_are_an_autoregressive_process(correlation: float) -> None:
    """What a row adds to its share of the row before is independent, with variance 1 - r² of that of an offset."""
    rows = noisy_dn(plan_with("row", row_std_dn=300.0, row_correlation=correlation), 0, OFFSETS, 1)[:, 0]
    added = (rows[1:] - correlation * rows[:-1]) / math.sqrt(1 - correlation**2)
    assert_normal_offsets(added, 300.0)
    neighbours = added[1:] * added[:-1]
    assert bounds_off(neighbours, 0, 300.0**4, (REACH * 300) ** 2) <= 1
    repeated = (1 + correlation**2) / (1 - correlation**2)  # squares of neighbours have the correlation r²
    bound = bernstein(2 * 300.0**4, (REACH * 300) ** 2, int(rows.size / repeated))
    assert abs(float((rows**2).mean()) - 300.0**2) <= bound


# Gain by colour and lens shading -------------------------------------------------------------------------------------


def test_each_colour_counts_electrons_by_its_gain() -> None:
    """DN are multiples of the gain; the clean frame does not depend on it."""
    gains, code = (0.5, 1.0, 2.0), 600
    plan = plan_with("shot", "gain_by_colour", gain_by_colour=gains)
    deviation = noisy_dn(plan, code)
    for colour, relative in zip("RGB", gains, strict=True):
        for site in (place for place in range(4) if plan.sensor.pattern[place] == colour):
            counts = deviation[site // 2 :: 2, site % 2 :: 2] / (8 * relative)
            assert (counts == np.rint(counts)).all()
            assert_poisson(counts, signal_dn(code) / (8 * relative))
    assert (make_pair(flat(code), plan).clean == make_pair(flat(code), plan_with("shot")).clean).all()


def test_lens_shading_follows_its_polynomial_in_both_frames() -> None:
    shading, (height, width) = (-0.3, 0.1, -0.2), (301, 400)
    plan = plan_with("lens_shading", lens_shading=shading, frame_size=(height, width))
    y, x = np.mgrid[:height, :width]
    square = ((y - 150) ** 2 + (x - 199.5) ** 2) / (150**2 + 199.5**2)
    expected = signal_dn(50000) * (1 + shading[0] * square + shading[1] * square**2 + shading[2] * square**3)
    pair = make_pair(flat(50000, height, width), plan)
    assert np.abs(pair.clean - (expected + BLACK)).max() <= 0.5 + SPAN * 2.0**-24
    assert (pair.noisy == pair.clean).all()


def test_image_outside_the_frame_of_the_shading_is_refused() -> None:
    plan = plan_with("lens_shading", lens_shading=(-0.3, 0.0, 0.0), frame_size=(40, 60))
    with pytest.raises(ValueError, match=r"exceeds the frame \[40, 60\] of the lens shading at \[30, 0\]"):
        make_pair(flat(0, 11, 60), plan, (30, 0))


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


@pytest.mark.parametrize("doubling", [7.0, pytest.param(5.5, marks=pytest.mark.slow)])
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
    return hot_pixel_means(SILENT.replace(hot_pixel_share=SHARE, hot_pixel_e=200.0), (1024, 1024))


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


# Fixed patterns -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", [0, 800, 20000, 50000])
def test_prnu_scales_with_signal_and_is_fixed_between_frames(code: int) -> None:
    plan = plan_with("prnu", prnu_std=0.01)
    pattern = response(plan.physics, (1024, 1024))  # type: ignore[arg-type]
    frame = noisy_dn(plan, code)
    np.testing.assert_array_equal(frame, np.rint(signal_dn(code) * pattern + BLACK) - BLACK)
    np.testing.assert_array_equal(frame, noisy_dn(plan.replace(stream_key=2), code))


def test_black_error_depends_on_cfa_site_alone() -> None:
    plan = plan_with("black_error", black_error_dn=(1.0, -2.0, 3.0, -4.0))
    assert noisy_dn(plan, 0, 4, 5).tolist() == [[1, -2, 1, -2, 1], [3, -4, 3, -4, 3]] * 2
    assert (make_pair(flat(0, 2, 2), plan, (1, 1)).noisy.astype(int) - BLACK).tolist() == [[-4, 3], [-2, 1]]


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
        prnu_std=0.05, dark_e=5.0, dark_offset="kept", hot_pixel_share=0.2, hot_pixel_e=100.0, read_std_dn=20.0,
        row_std_dn=10.0, column_std_dn=150.0, black_error_dn=(20.0, -30.0, 40.0, -50.0), dead_pixel_share=0.1,
        fixed_pattern_in_clean=True,
    )  # fmt: skip
    clean = make_pair(flat(5000, *size), plan).clean.astype(np.float64)
    noisy = [make_pair(flat(5000, *size), plan.replace(stream_key=frame)) for frame in range(frames)]
    assert all((one.clean == clean).all() for one in noisy)
    mean = np.mean([one.noisy for one in noisy], axis=0)
    electrons = 5000 * 1.3 / 8 + 5 + 800  # no pixel has more, in the mean
    variance, reach = 64 * electrons + 20**2 + 10**2, 8 * poisson_reach(electrons) + REACH * 30
    assert np.abs(mean - clean).max() <= bernstein(variance, reach, frames, 1e-15) + 0.5
    assert (clean[mean == 0] == 0).all()


def test_clean_frame_with_fixed_patterns_keeps_dark_offset_of_frames() -> None:
    """If the dark mean is removed, the clean frame contains light only."""
    size, dark_e = (16, 31), 7.3
    plan = plan_with("shot", "dark_current", dark_e=dark_e, dark_offset="kept", fixed_pattern_in_clean=True)
    clean = make_pair(flat(5000, *size), plan).clean
    assert (clean == round(signal_dn(5000) + BLACK + 8 * dark_e)).all()
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
    full = np.rint(8 * 2000 + BLACK + np.tile(columns_dn(slots_of(plan).fixed_columns, size, (0, 0)), (size[0], 1)))
    assert (clean <= full).all()
    assert 0.1 < (clean == full).mean() < 0.3
    noisy = np.array([make_pair(flat(5000, *size), plan.replace(stream_key=key)).noisy for key in range(frames)])
    assert (noisy.mean(axis=0) <= full).all()
    overfull = hot_pixel_means(plan.physics, size) > 3000  # type: ignore[arg-type]
    assert overfull.any()
    assert (noisy[:, overfull] == full[overfull]).all()
    assert (clean[overfull] == full[overfull]).all()
