"""Checks of the noise: untouched datasets pass, and planted faults are found."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.noise_faults import (
    FAULTS,
    SITE_FAULTS,
    Fault,
    repeated_noise,
    replace_noisy_frames,
    with_numbers,
)
from helpers.promise_report import Figure
from numpy.typing import NDArray

from unprocess_gen import RawPairs, make_pair
from unprocess_gen.config.schema import replaced
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.lookup_tables import quantile_table
from unprocess_gen.core.types import Facts, Patch, Plan
from unprocess_gen.dataset.manifest import plan_from_row, read_rows
from unprocess_gen.dataset.reader import Sample
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.reports.noise_check import checks
from unprocess_gen.reports.noise_check.checks import (
    PAIRS_LISTED,
    TESTS,
    Alarm,
    Checker,
    Pool,
    curve_group,
    failed_checks,
    overlaps,
    pair_sums,
    threshold,
)
from unprocess_gen.reports.noise_check.expectation import PlaneNoise
from unprocess_gen.reports.noise_check.scores import Scores, scores_of
from unprocess_gen.simulation.effects import BY_NAME, order
from unprocess_gen.simulation.effects.expectation import RARE, Site, tukey_distribution
from unprocess_gen.sources.scenes import synthetic
from unprocess_gen.statistics.scores import FALSE_ALARM, Score

FACTS = Facts(512, 512, 256, 0, 255)
NIGHT_A7S2 = ("noise=sony_a7s2", "scene=night", "effects.row=on")
NIGHT_D850 = ("noise=nikon_d850", "scene=night", "effects.row=on")
NIGHT_14_BITS = (*NIGHT_D850, "sensor=generic_14bit")
EVERY_EFFECT = (
    *("noise=nikon_d850", "scene=low_light", "effects.all=on", "scene.exposure_s=2", "noise.hot_pixel_share=0.002"),
    *("noise.dead_pixel_share=0.001", "noise.prnu_std=0.01", "noise.full_well_e=9000", "noise.dark_e_per_s=20"),
)
GAINS = ("noise.gain_by_colour=[0.8,1.0,1.3]", "effects.gain_by_colour=on")
LAWS = {
    "default": (),
    "random levels": ("noise=brooks2019",),
    "night, 14 bits": NIGHT_14_BITS,
    "float32 clean": ("output.clean_dtype=float32", "noise=sony_a7s2", "scene=night"),
    "float32 without limits": ("output.dtype=float32", "sensor.clip=none", "noise=canon_5d4", "scene=indoor"),
    "clipped at black, packed": ("output.layout=packed", "sensor.clip=black", "noise=canon_70d", "scene=low_light"),
    "every effect": (*EVERY_EFFECT, "sensor.dark_offset=kept"),
    "every effect, gains by colour, patterns in the clean frame": (
        *(*EVERY_EFFECT, *GAINS, "clean.includes_fixed_pattern=true", "sensor.dark_offset=kept"),
    ),
    "linear codes": ("isp=linear", "camera=identity", "gains=unity", "scene.exposure_ratio=15"),
    "correlated rows": (*NIGHT_14_BITS, "noise.row_correlation=0.7"),
}


def with_bars(srgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Set an eighth of the rows above and below to black."""
    bar = len(srgb) // 8
    return np.pad(srgb[bar:-bar], ((bar, bar), (0, 0), (0, 0)))


KINDS: dict[str, Callable[[NDArray[np.uint8]], NDArray[np.uint8]]] = {
    "scene": lambda srgb: srgb,
    "black bars": with_bars,
    "patch of 64": lambda srgb: with_bars(srgb)[:64, :64].copy(),
    "black": np.zeros_like,
    "white": lambda srgb: np.full_like(srgb, 255),
    "one colour": lambda srgb: np.broadcast_to(srgb[:1, :1], srgb.shape).copy(),
}
"""Pictures in which many sites have exactly the same clean value, by what they show."""

Checked = tuple[Plan, Scores]


def checked(
    settings: Settings,
    overrides: Sequence[str],
    number: int,
    side: int = 192,
    faults: Iterable[Fault] = (lambda srgb, noisy, plan, draws: noisy,),
    kind: str = "scene",
    **numbers: Any,
) -> list[Checked]:
    """Plan and scores of a pair for each fault; ``numbers``: physical numbers of the row."""
    draws = np.random.default_rng(number)
    picture = synthetic.scene(synthetic.SCENES[number % len(synthetic.SCENES)])
    height, width = (min(side, length) // 2 * 2 for length in picture.shape[:2])
    y, x = (int(draws.integers(0, n - m + 1)) // 2 * 2 for n, m in zip(picture.shape, (height, width), strict=False))
    srgb = KINDS[kind](np.ascontiguousarray(picture[y : y + height, x : x + width]))
    if kind != "scene":
        srgb[0, 0] = number % 256  # equal pictures have equal noise
    pair = make_pair(srgb, replaced(settings(*overrides), {"seed": number}))
    if numbers:
        plan = plan_from_row(pair.row)
        assert plan.noise.physics is not None
        pair = make_pair(srgb, plan.replace(physics=replace(plan.noise.physics, **numbers)))
    plan, results = plan_from_row(pair.row), list[Checked]()
    for fault in faults:
        noisy = fault(srgb, pair.noisy, plan, np.random.default_rng(number))
        sums = pair_sums(pair.clean, noisy, pair.row)
        results.append((plan, {} if sums is None else scores_of(sums)))
    return results


def alarms(pairs: Sequence[Checked]) -> list[Alarm]:
    """Alarms of a dataset that consists of these pairs."""
    pool, limit, found = Pool(), threshold(len(pairs)), list[Alarm]()
    for number, (plan, scores) in enumerate(pairs):
        found += failed_checks(f"{number:08d}", scores, limit)
        pool.add(scores, 1, curve_group(plan))
    return found + failed_checks("", pool.scores(), limit)


# Untouched pairs ------------------------------------------------------------------------------------------------------


QUICK_LAWS = ("default", "clipped at black, packed", "correlated rows")


@pytest.mark.parametrize("name", slow_except(QUICK_LAWS, LAWS))
def test_untouched_pairs_raise_no_alarm(name: str, settings: Settings) -> None:
    pairs = [*checked(settings, LAWS[name], 0), *checked(settings, LAWS[name], 1)]
    assert any(scores for _, scores in pairs)
    assert [str(alarm) for alarm in alarms(pairs)] == []


END_LAWS = (
    *((), ("scene.exposure_ratio=200",), ("noise=canon_5d4", "scene=indoor"), ("noise=sony_a7s2", "scene=night")),
    ("noise=nikon_d850", "scene=long_exposure", "effects.hot_pixels=on", "sensor=generic_14bit"),
)


@pytest.mark.parametrize("kind", slow_except(("patch of 64", "black", "white"), KINDS))
def test_black_and_white_sites_raise_no_alarm(kind: str, settings: Settings) -> None:
    for overrides in END_LAWS:
        pairs = [pair for n in range(4) for pair in checked(settings, overrides, n, kind=kind)]
        assert [str(alarm) for alarm in alarms(pairs)] == []


@pytest.mark.slow
def test_many_black_and_white_sites_raise_no_alarm(settings: Settings, figure: Figure) -> None:
    """Each combination counts as a dataset of 50 pairs, and all together as another one."""
    everything: list[Checked] = []
    found: list[str] = []
    for kind, overrides in itertools.product(KINDS, END_LAWS):
        pairs = [pair for n in range(50) for pair in checked(settings, overrides, n, 320, kind=kind)]
        found += [f"{kind}, {' '.join(overrides)}: {alarm}" for alarm in alarms(pairs)]
        everything += pairs
    found += [str(alarm) for alarm in alarms(everything)]
    figure("noise-check", f"{len(found)} alarms in {len(everything)} pairs with black bars, black, white or one colour")
    assert found == []


NOISES = (
    *(("noise=imx385_iso1600",), ("noise=imx385_iso25600",), ("noise=imx385_iso3200_rvdd",), ("noise=brooks2019",)),
    *(("noise=imx385_iso3200", "noise.law=poisson"), ("noise=imx385", "noise.iso=3200"), ("noise=sony_a7s2",)),
    *(
        ("noise=nikon_d850",),
        ("noise=canon_5d4",),
        ("noise=canon_70d",),
        ("noise=canon_700d",),
        ("noise=oppo_reno10x",),
    ),
)
SCENES = ("daylight", "indoor", "low_light", "night", "long_exposure", "video_night")
VARIANTS = (
    *((), ("sensor=generic_10bit",), ("sensor=generic_14bit",), ("sensor=generic_16bit",), ("accuracy=fast",)),
    *(("output.dtype=float32", "sensor.clip=none"), ("output.layout=packed", "sensor.clip=black")),
    *(("effects.all=on",), ("effects.all=on", "output.dtype=float32"), ("scene.exposure_ratio=200",)),
    *(("effects.all=on", "clean.includes_fixed_pattern=true"), ("isp=srgb", "sensor.saturated=white")),
    *(("effects.all=on", "sensor.dark_offset=kept", "scene.exposure_s=30", "scene.temperature_c=40"),),
    *(("camera=identity", "gains=unity"), ("source.dequantize=dither",), ("output.clean_dtype=float32",)),
    *(("effects.row=on", "noise.row_correlation=0.8"), (*GAINS, "accuracy=fast"), (*GAINS, "effects.all=on")),
)


@pytest.mark.slow
def test_two_thousand_untouched_pairs_raise_no_alarm(settings: Settings, figure: Figure) -> None:
    """Each combination of profile, scene and variant counts as a dataset, and all together as another one."""
    found: list[str] = []
    everything: list[Checked] = []
    largest = unusable = 0.0
    for noise, scene, variant in itertools.product(NOISES, SCENES, VARIANTS):
        overrides = (*noise, f"scene={scene}", *variant)
        try:
            pairs = [pair for n in range(2) for pair in checked(settings, overrides, len(everything) + n, 256)]
        except ConfigError:  # a profile without numbers for the ISO of the scene, or for the bits of the sensor
            continue
        everything += pairs
        unusable += sum(not scores for _, scores in pairs)
        largest = max(largest, *(score.surprise for _, scores in pairs for score in scores.values()), 0.0)
        found += [f"{' '.join(overrides)}: {alarm}" for alarm in alarms(pairs)]
    found += [str(alarm) for alarm in alarms(everything)]
    figure(
        "noise-check",
        f"{len(found)} alarms in {len(everything)} untouched pairs, {unusable:.0f} of them without usable sites; "
        f"smallest probability of a score e^-{largest:.1f}",
    )
    assert found == []
    assert len(everything) >= 2000


@pytest.mark.parametrize("overrides", [("noise=none",), ("noise=heteroscedastic", "noise.a=0.0002", "noise.b=0.01")])
def test_noise_below_rounding_is_not_checked(overrides: tuple[str, ...], settings: Settings) -> None:
    assert checked(settings, overrides, 1)[0][1] == {}


@pytest.mark.slow
def test_scores_of_untouched_pairs_have_unit_variance(settings: Settings) -> None:
    scores = [checked(settings, ("noise=imx385", "noise.iso=6400", "effects.row=on"), n, 128)[0][1] for n in range(40)]
    for name in ("mean", "variance", "variance against signal", "row means", "column means", "neighbours"):
        square = np.mean([one[name, ""].total ** 2 / one[name, ""].std ** 2 for one in scores])
        assert 0.4 < square < 2, (name, square)  # chi squared with 40 degrees of freedom: 0.5 to 1.6


# Faults ---------------------------------------------------------------------------------------------------------------

LONG = "long exposure, nikon_d850"
HOT = ("effects.hot_pixels=on", "scene.exposure_s=30", "scene.temperature_c=35", "sensor=generic_14bit")
NO_HOT_PIXELS = {"hot pixels missing": with_numbers(hot_pixel_share=0.0)}
COMBINATIONS = {
    "night, sony_a7s2": NIGHT_A7S2,
    "night, nikon_d850": NIGHT_D850,
    "night, nikon_d850, 14 bits": NIGHT_14_BITS,
    "video at night, canon_700d": ("noise=canon_700d", "scene=video_night", "effects.row=on"),
    "default": (),
    LONG: ("noise=nikon_d850", "scene=long_exposure", *HOT),
}
EXPECTED = {
    "black level off by 20 DN": "mean",
    "row noise removed": "row means",
    "column stripes of a tenth of the read noise": "column differences",
    "uniform noise of equal variance": "variance",
    "5 % more signal": "mean against signal",
    "correlation 0.05 of adjacent sites": "adjacent sites",
    "correlation 0.05 of diagonal sites": "diagonal sites",
    "correlation 0.05 of neighbours of a plane": "neighbours",
    "correlation 0.05 of diagonal neighbours of a plane": "diagonal neighbours",
    "a share of 1e-4 of white sites": "outliers",
    "even DN only": "odd codes",
}
"""Checks that must find a fault; swapped sites are found by one of several."""


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_fault_is_found_at_night(fault: str, settings: Settings) -> None:
    pairs = [pair for n in range(3) for pair in checked(settings, NIGHT_14_BITS, n, 384, [FAULTS[fault]])]
    found = alarms(pairs)
    assert found
    assert EXPECTED.get(fault, found[0].check) in {alarm.check for alarm in found}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMBINATIONS)
def test_planted_faults_are_found_in_95_percent_of_runs(name: str, settings: Settings, figure: Figure) -> None:
    runs, count, side = 20, 12, 512
    in_runs: Counter[str] = Counter()
    in_pairs: Counter[str] = Counter()
    faults = {"default": SITE_FAULTS, LONG: SITE_FAULTS | NO_HOT_PIXELS}.get(name, FAULTS)
    for run in range(runs):
        numbers = range(run * count, (run + 1) * count)
        pairs = [checked(settings, COMBINATIONS[name], number, side, faults.values()) for number in numbers]
        for fault, of_fault in zip(faults, zip(*pairs, strict=True), strict=True):
            in_runs[fault] += bool(alarms(of_fault))
            in_pairs[fault] += sum(bool(failed_checks("", scores, threshold(1))) for _, scores in of_fault)
    fewest = min(in_runs[fault] for fault in faults)
    least = min(in_pairs[fault] for fault in faults)
    figure(
        "noise-check",
        f"{name}: each of {len(faults)} faults found in at least {fewest} of {runs} runs of {count} pairs, and in at "
        f"least {least / (runs * count):.0%} of single pairs",
    )
    assert fewest >= 0.95 * runs


@pytest.mark.parametrize("missing", ["hot_pixel_share", "dead_pixel_share"])
def test_missing_defects_are_found(missing: str, settings: Settings) -> None:
    """Some pixels are hot and dead; the last effect decides."""
    shares = "effects.dead_pixels=on", "noise.hot_pixel_share=0.01", "noise.dead_pixel_share=0.01"
    faults: list[Fault] = [lambda srgb, noisy, plan, draws: noisy, with_numbers(**{missing: 0.0})]
    untouched, faulty = checked(settings, (*COMBINATIONS[LONG], *shares), 0, faults=faults)
    assert [str(alarm) for alarm in alarms([untouched])] == []
    assert "defects" in {alarm.check for alarm in alarms([faulty])}


def repetitions(pairs: Iterable[Sample], **numbers: int) -> list[Alarm]:
    """Alarms about repeated noise, if the rows of the pairs have these numbers and one more from pair to pair."""
    pairs = list(pairs)
    checker = Checker(np.ones((len(pairs), 2), np.int64))
    for n, (clean, noisy, row) in enumerate(pairs):
        row = {**row, **{name: first + n for name, first in numbers.items()}}
        checker.add(row, pair_sums(clean, noisy, row))
    return [alarm for alarm in checker.alarms if alarm.check == "repetition"]


def test_repeated_draws_and_noise_are_found(settings: Settings) -> None:
    """Draws of a scene are equal byte by byte; frames of different scenes have the same deviates."""
    scenes = [np.ascontiguousarray(synthetic.scene(name)[:64, :64]) for name in synthetic.SCENES[:3]]
    pairs = [make_pair(srgb, settings()) for srgb in scenes]
    assert repetitions([(pairs[0].clean, pairs[0].noisy, pairs[0].row)] * 2) == []  # patches of a frame at one place
    assert repetitions([(pair.clean, pair.noisy, pair.row) for pair in pairs]) == []
    assert repetitions([(pairs[0].clean, pairs[0].noisy, pairs[0].row)] * 2, draw=0)
    draws = np.random.default_rng(0)
    repeated = [
        repeated_noise(srgb, pair.noisy, plan_from_row(pair.row), draws)
        for srgb, pair in zip(scenes, pairs, strict=True)
    ]
    assert repetitions([(pair.clean, noisy, pair.row) for pair, noisy in zip(pairs, repeated, strict=True)])


ROWS_DN = 15.0
"""Standard deviation of row offsets that are as strong as the read noise of `NIGHT_14_BITS`."""


@pytest.mark.parametrize("correlation", [0.0, 0.9, -0.5])
def test_strong_row_noise_raises_no_alarm(correlation: float, settings: Settings) -> None:
    """Row offsets as large as all other noise move the means of columns."""
    numbers = {"row_std_dn": ROWS_DN, "row_correlation": correlation}
    pairs = [pair for n in range(4) for pair in checked(settings, NIGHT_14_BITS, n, 256, **numbers)]
    assert [str(alarm) for alarm in alarms(pairs)] == []
    assert max(abs(score.errors) for _, scores in pairs for score in scores.values()) < 6


@pytest.mark.parametrize(("recorded", "simulated"), [(0.9, 0.0), (0.0, 0.9)])
def test_wrong_correlation_of_rows_is_found(recorded: float, simulated: float, settings: Settings) -> None:
    numbers, fault = {"row_std_dn": ROWS_DN / 2, "row_correlation": recorded}, with_numbers(row_correlation=simulated)
    pairs = [pair for n in range(6) for pair in checked(settings, NIGHT_14_BITS, n, 256, [fault], **numbers)]
    assert "row differences" in {alarm.check for alarm in alarms(pairs)}


@pytest.mark.parametrize("simulated", [(1.0, 1.0, 1.0), (1.3, 1.0, 0.8)])
def test_wrong_gains_by_colour_are_found(simulated: tuple[float, float, float], settings: Settings) -> None:
    overrides = ("noise=nikon_d850", "scene=low_light", "sensor=generic_14bit", *GAINS)
    fault = with_numbers(gain_by_colour=simulated)
    pairs = [pair for n in range(2) for pair in checked(settings, overrides, n, 256, [fault])]
    found = {(alarm.check, alarm.plane) for alarm in alarms(pairs)}
    assert {("variance against signal", "R"), ("variance against signal", "B")} <= found
    assert not {plane for _, plane in found} & {"Gr", "Gb"}


def test_replaced_noise_of_intact_shards_ends_verify_with_4(make: Make, run_main: RunMain, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=3", *NIGHT_A7S2)
    assert (run_main("verify", "ds", "--noise").code, run_main("verify", "ds").code) == (0, 0)
    replace_noisy_frames(tmp_path / "ds", lambda clean, noisy, row: noisy + np.uint16(20))
    assert run_main("verify", "ds").code == 0
    done = run_main("verify", "ds", "--noise")
    assert done.code == 4
    lines = done.err.splitlines()
    number = r"(18|19|20)\.\d+ ± 0\.\d+ DN above black_level_dn \([\d,]+ standard errors\): wrong black level"
    assert re.search(f"noise of all pairs together: mean.* is {number}", lines[0])
    assert any(re.search(f"noise of 00000001: mean.* is {number}", line) for line in lines)
    assert "noise of 3 pairs checked, 3 wrong" in done.out


def test_many_wrong_pairs_are_counted(make: Make, run_main: RunMain, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1", f"noise.draws={PAIRS_LISTED + 3}", "source.patch=[random,128,1]")
    replace_noisy_frames(tmp_path / "ds", lambda clean, noisy, row: noisy + np.uint16(20))
    done = run_main("verify", "ds", "--noise")
    assert done.code == 4
    assert sum("noise of 00000000" in line for line in done.err.splitlines()) == PAIRS_LISTED
    assert done.err.splitlines()[-1].endswith("noise of 3 other pairs: wrong too")


# Expectations ---------------------------------------------------------------------------------------------------------


def plane_noise(plan: Plan) -> PlaneNoise:
    """Noise of the first plane of a large patch."""
    return PlaneNoise(Site(plan, Patch(0, 0, 0, 512, 512), (0, 0)))


def test_pair_with_an_unknown_effect_is_not_checked(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "BY_NAME", {name: effect for name, effect in BY_NAME.items() if name != "row"})
    assert checked(settings, NIGHT_A7S2, 0)[0][1] == {}


@pytest.mark.parametrize("shape", [-0.2429, -0.4, 0.0])
def test_read_noise_agrees_with_the_table_of_draws(shape: float) -> None:
    table = quantile_table("tukey_lambda", shape)
    widths = np.repeat(2.0 ** np.arange(32), 32) / 32 / 2**32
    values, weights = [], []
    for position, weight in ((0.1127017, 5 / 18), (0.5, 8 / 18), (0.8872983, 5 / 18)):  # Gauss-Legendre
        t = position / 32
        values.append(table[:, 0] + t * (table[:, 1] + t * table[:, 2]))
        weights.append(widths * weight)
    expected = [float((np.cos(frequency * np.array(values)) * np.array(weights)).sum()) for frequency in (0, 0.5, 1, 2)]
    factors, quantiles, logarithms = tukey_distribution(shape)
    largest = -float(np.interp(math.log(RARE), logarithms, quantiles))
    np.testing.assert_allclose(factors[[0, 50, 100, 200]], expected, atol=3e-4)
    assert np.sum(np.where(np.array(values) > largest, weights, 0)) / 2 == pytest.approx(RARE, rel=0.05)


@pytest.mark.parametrize("overrides", [(), ("noise.law=poisson",), EVERY_EFFECT, ("accuracy=fast", *NIGHT_A7S2)])
def test_characteristic_function_agrees_with_drawn_noise(overrides: tuple[str, ...], settings: Settings) -> None:
    """The reference draws the noise of flat fields; the largest of all errors is below 5 standard errors."""
    plan = plan_image(settings(*overrides), "0" * 64, facts=FACTS)
    noise = plane_noise(plan)
    for light in (3.0, 200.0):
        clean = np.full((512, 512), plan.sensor.black_level_dn + light)
        drawn = (order.noisy(clean, plan) - clean)[::2, ::2] - noise.offset_dn
        signal = np.full(1, light)
        std = np.sqrt(noise.variance(signal))
        for k in (1.0, 2.0):
            cosine = np.cos(k * drawn[np.isfinite(drawn)] / std)
            rounding = np.sinc(k / std / (2 * np.pi)) if "quantise" in plan.noise.effects else 1.0  # not rounded here
            expected = noise.characteristic(signal, k / std).real / rounding
            error = cosine.std() / 256 * math.sqrt(float(1 + (noise.row_variance / std[0] ** 2) ** 2 * 256))
            assert abs(cosine.mean() - expected[0]) < 5 * error + 2e-4


def test_sites_near_the_limits_are_not_used(settings: Settings) -> None:
    plan = plan_image(settings("sensor.clip=black"), "0" * 64)
    dn = np.arange(4096.0)
    used = dn[plane_noise(plan).is_usable(dn, 1.0)]
    assert used.min() > plan.sensor.black_level_dn + 30
    assert used.max() < plan.sensor.white_level_dn - 300


def test_few_electrons_raise_no_alarm_in_float32(settings: Settings) -> None:
    """Where an electron is many DN, the noise changes much within a DN."""
    overrides = ("noise=canon_5d4", "scene=night", "output.dtype=float32", "sensor.clip=none")
    assert alarms(checked(settings, overrides, 5, 512, read_std_dn=0.3)) == []


# Scores ---------------------------------------------------------------------------------------------------------------


def test_surprise_is_that_of_a_normal_distribution_for_small_steps() -> None:
    assert Score(7.0, 1.0, 1.0, step=1e-9).surprise == pytest.approx(24.5)
    assert Score(7.0, 1.0, 1.0, step=3.0).surprise < 13


def test_rounding_errors_of_a_curve_add_linearly() -> None:
    same, different = Pool(), Pool()
    for group in range(100):
        same.add({("mean", ""): Score(0.0, 1.0, 1.0, rounding=1.0)}, 1, 0)
        different.add({("mean", ""): Score(0.0, 1.0, 1.0, rounding=1.0)}, 1, group)
    assert same.scores()["mean", ""].rounding == pytest.approx(math.hypot(100, 15))
    assert different.scores()["mean", ""].rounding == pytest.approx(math.hypot(10, 15))
    assert same.scores()["mean", ""].variance == 100


def test_threshold_keeps_the_probability_of_a_false_alarm(settings: Settings) -> None:
    assert 2 * TESTS * 101 * math.exp(-threshold(100)) == pytest.approx(FALSE_ALARM)
    assert len(checked(settings, (), 0)[0][1]) == TESTS - 1  # the pair before is compared in datasets


# Datasets -------------------------------------------------------------------------------------------------------------


def test_overlapping_patches_count_common_noise(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1", "source.patch=[grid,128,64]", "noise.draws=2")
    in_sites, _ = zip(*overlaps(tmp_path / "ds"), strict=True)
    assert (min(in_sites), max(in_sites)) == (4, 9)  # 3 x 3 patches overlap, 2 x 2 in the corners; draws do not


def test_patches_share_correlated_rows_beyond_their_own(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", *LAWS["correlated rows"], "source.limit=1", "source.patch=[grid,64,64]")
    in_row = len({row["patch_x"] for row in read_rows(tmp_path / "ds" / "manifest.csv")})
    # offsets have a correlation of 1 % at a distance of 13 rows, and so reach into the patches above and below
    assert {in_rows for _, in_rows in overlaps(tmp_path / "ds")} == {2 * in_row, 3 * in_row}


def test_levels_and_draws_are_checked(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=2", "noise=brooks2019", "noise.levels=2", "noise.draws=2")
    checker = Checker(np.array(list(overlaps(tmp_path / "ds"))))
    for clean, noisy, row in RawPairs(tmp_path / "ds"):
        checker.add(row, pair_sums(clean, noisy, row))
    assert (checker.count, checker.alarms, checker.wrong_pairs) == (8, [], 0)
