"""Checks of the noise: untouched datasets pass, and planted faults are found."""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.noise_faults import FAULTS, replace_noisy_frames
from helpers.noise_sums import numpy_sums
from helpers.promise_report import Figure
from numpy.typing import NDArray

from unprocess_gen import RawPairs, make_pair
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.lookup_tables import quantile_table
from unprocess_gen.core.types import Facts, Patch, Plan
from unprocess_gen.dataset.manifest import plan_from_row, read_rows
from unprocess_gen.dataset.reader import mosaic_dn
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.reports.noise_check import law as laws
from unprocess_gen.reports.noise_check.checks import (
    CHECKS,
    FALSE_ALARM,
    LISTED,
    TESTS,
    Alarm,
    Checker,
    PooledScore,
    curve_group,
    failed_checks,
    overlaps,
    pair_scores,
    pair_sums,
    threshold,
)
from unprocess_gen.reports.noise_check.expectation import expectations, usable_values
from unprocess_gen.reports.noise_check.scores import Score, Scores, plane_names
from unprocess_gen.simulation.reference import noise as reference
from unprocess_gen.sources.scenes import synthetic

FACTS = Facts(512, 512, 256, 0, 255)
NIGHT_A7S2 = ("noise=sony_a7s2", "scene=night", "effects.row=on")
NIGHT_D850 = ("noise=nikon_d850", "scene=night", "effects.row=on")
EVERY_EFFECT = (
    *("noise=nikon_d850", "scene=low_light", "effects.all=on", "scene.exposure_s=2", "noise.hot_pixel_share=0.002"),
    *("noise.dead_pixel_share=0.001", "noise.prnu_std=0.01", "noise.full_well_e=9000", "noise.dark_e_per_s=20"),
)
GAINS = ("noise.gain_by_colour=[0.8,1.0,1.3]", "effects.gain_by_colour=on")
LAWS = {
    "default": (),
    "Poisson": ("noise.law=poisson",),
    "variance clipped at black": ("noise=imx385_iso3200_rvdd",),
    "random levels": ("noise=brooks2019",),
    "night": NIGHT_A7S2,
    "night, nearly no light": ("noise=sony_a7s2", "scene=night", "scene.exposure_ratio=1000"),
    "night, 14 bits": (*NIGHT_D850, "sensor=generic_14bit"),
    "extreme low light": ("noise=nikon_d850", "scene=night", "scene.iso=3200", "scene.exposure_ratio=200"),
    "dark default": ("scene.exposure_ratio=200",),
    "float32 without limits": ("output.dtype=float32", "sensor.clip=none", "noise=canon_5d4", "scene=indoor"),
    "float32 clean": ("output.clean_dtype=float32", "noise=sony_a7s2", "scene=night"),
    "clipped at black, packed": ("output.layout=packed", "sensor.clip=black", "noise=canon_70d", "scene=low_light"),
    "every effect": EVERY_EFFECT,
    "every effect, patterns in the clean frame": (*EVERY_EFFECT, "clean.includes_fixed_pattern=true"),
    "every effect, dark offset kept": (*EVERY_EFFECT, "sensor.dark_offset=kept"),
    "fast": ("accuracy=fast", "noise=sony_a7s2", "scene=video_night"),
    "10 bits": ("noise=oppo_reno10x", "noise.iso=1600", "sensor=generic_10bit"),
    "linear codes": ("isp=linear", "camera=identity", "gains=unity", "scene.exposure_ratio=15"),
    "correlated rows": (*NIGHT_D850, "sensor=generic_14bit", "noise.row_correlation=0.7"),
    "gains by colour": (*NIGHT_D850, "sensor=generic_14bit", *GAINS),
    "every effect, gains by colour, in float32": (*EVERY_EFFECT, *GAINS, "output.dtype=float32", "sensor.clip=none"),
    "every effect, gains by colour, patterns in the clean frame": (
        *(*EVERY_EFFECT, *GAINS, "clean.includes_fixed_pattern=true", "sensor.dark_offset=kept"),
    ),
    "pinned": ("noise=canon_700d", "scene=daylight", "sensor.saturated=pinned"),
}

QUICK_LAWS = (
    *("default", "random levels", "night, 14 bits", "float32 clean", "clipped at black, packed", "fast"),
    *("every effect, dark offset kept", "correlated rows", "gains by colour"),
)
"""Laws of the quick tests; the others are slow."""


@functools.lru_cache(maxsize=64)
def decoded(path: Path) -> NDArray[np.uint8]:
    """Return a photograph at half its size."""
    image = cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_2)
    assert image is not None
    return image[..., ::-1]  # type: ignore[return-value]


def photograph(number: int, side: int) -> NDArray[np.uint8]:
    """Return a square of a photograph in the folder PHOTOS, or of a built-in scene; less if it is smaller."""
    paths = sorted(Path(os.environ["PHOTOS"]).glob("*.jpg")) if "PHOTOS" in os.environ else []
    if paths:
        image = decoded(paths[number % len(paths)])
    else:
        image = synthetic.scene(synthetic.NAMES[number % len(synthetic.NAMES)])
    draws = np.random.default_rng(number)
    height, width = (min(side, length) // 2 * 2 for length in image.shape[:2])
    y, x = (int(draws.integers(0, n - m + 1)) // 2 * 2 for n, m in zip(image.shape, (height, width), strict=False))
    return np.ascontiguousarray(image[y : y + height, x : x + width])


Checked = tuple[Plan, Scores]


def checked(settings: Settings, overrides: Sequence[str], number: int, side: int, fault: str = "") -> Checked:
    """Return the plan and the scores of a pair, with a fault if one is named."""
    return checked_with_faults(settings, overrides, number, side, (fault,))[0]


def checked_with_faults(
    settings: Settings, overrides: Sequence[str], number: int, side: int, faults: Iterable[str]
) -> list[Checked]:
    """Return the plan and the scores of a pair for each fault; an empty name leaves the pair untouched."""
    config = settings(*overrides)
    config.seed = number  # an override would compose another config for each pair
    validate_config(config)
    srgb = photograph(number, side)
    pair = make_pair(srgb, config)
    plan = plan_from_row(pair.row)
    found: list[Checked] = []
    for fault in faults:
        draws = np.random.default_rng(number)
        noisy = FAULTS[fault](srgb, pair.noisy, plan, draws) if fault else pair.noisy
        sums = pair_sums(pair.clean, noisy, pair.row)
        found.append((plan, {} if sums is None else pair_scores(sums)))
    return found


def alarms(some: Iterable[Checked], pairs: int) -> list[Alarm]:
    """Return the alarms of a dataset that has these pairs."""
    pooled: dict[tuple[str, str], PooledScore] = {}
    found: list[Alarm] = []
    for number, (plan, scores) in enumerate(some):
        found += failed_checks(f"{number:08d}", scores, threshold(pairs))
        for name, score in scores.items():
            pooled.setdefault(name, PooledScore()).add(score, 1.0, curve_group(plan))
    return found + failed_checks("", {name: score.score() for name, score in pooled.items()}, threshold(pairs))


# Untouched pairs ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", slow_except(QUICK_LAWS, LAWS))
def test_untouched_pairs_raise_no_alarm(name: str, settings: Settings) -> None:
    pairs = [checked(settings, LAWS[name], number, 192) for number in range(2 if name in QUICK_LAWS else 3)]
    assert any(scores for _, scores in pairs)
    assert [str(alarm) for alarm in alarms(pairs, len(pairs))] == []


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
    *(("effects.all=on", "clean.includes_fixed_pattern=true"), ("isp=srgb", "sensor.saturated=pinned")),
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
            pairs = [checked(settings, overrides, len(everything) + number, 256) for number in range(2)]
        except ConfigError:  # a profile without numbers for the ISO of the scene, or for the bits of the sensor
            continue
        everything += pairs
        unusable += sum(not scores for _, scores in pairs)
        largest = max(largest, *(score.surprise for _, scores in pairs for score in scores.values()), 0.0)
        found += [f"{' '.join(overrides)}: {alarm}" for alarm in alarms(pairs, len(pairs))]
    found += [str(alarm) for alarm in alarms(everything, len(everything))]
    figure(
        "noise-check",
        f"{len(found)} alarms in {len(everything)} untouched pairs, {unusable:.0f} of them without usable sites; "
        f"smallest probability of a score e^-{largest:.1f}",
    )
    assert found == []
    assert len(everything) >= 2000


@pytest.mark.parametrize("overrides", [("noise=none",), ("noise=heteroscedastic", "noise.a=0.0002", "noise.b=0.01")])
def test_noise_below_rounding_is_not_checked(overrides: tuple[str, ...], settings: Settings) -> None:
    assert checked(settings, overrides, 1, 128)[1] == {}


@pytest.mark.slow
def test_scores_of_untouched_pairs_have_unit_variance(settings: Settings) -> None:
    scores = [checked(settings, ("noise=imx385", "noise.iso=6400", "effects.row=on"), n, 128)[1] for n in range(40)]
    for name in ("variance", "variance against signal", "kurtosis", "row means", "column means", "vertical neighbours"):
        square = np.mean([one[name, ""].total ** 2 / one[name, ""].std ** 2 for one in scores])
        assert 0.4 < square < 2, (name, square)  # chi squared with 40 degrees of freedom: 0.5 to 1.6


# Faults ---------------------------------------------------------------------------------------------------------------

COMBINATIONS = {
    "night, sony_a7s2": NIGHT_A7S2,
    "night, nikon_d850": NIGHT_D850,
    "night, nikon_d850, 14 bits": (*NIGHT_D850, "sensor=generic_14bit"),
    "video at night, canon_700d": ("noise=canon_700d", "scene=video_night", "effects.row=on"),
}
EXPECTED = {
    "black level off by 20 DN": "mean",
    "row noise removed": "row means",
    "column stripes of a tenth of the read noise": "column differences",
    "uniform noise of equal variance": "kurtosis",
    "5 % more signal": "mean against signal",
}
"""Checks that must find a fault; swapped sites are found by one of several."""


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_fault_is_found_at_night(fault: str, settings: Settings) -> None:
    pairs = [checked(settings, (*NIGHT_D850, "sensor=generic_14bit"), number, 384, fault) for number in range(3)]
    found = alarms(pairs, len(pairs))
    assert found
    assert EXPECTED.get(fault, found[0].check) in {alarm.check for alarm in found}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMBINATIONS)
def test_planted_faults_are_found_in_95_percent_of_runs(name: str, settings: Settings, figure: Figure) -> None:
    runs, count, side = 20, 12, 512
    in_runs: Counter[str] = Counter()
    in_pairs: Counter[str] = Counter()
    for run in range(runs):
        numbers = range(run * count, (run + 1) * count)
        pairs = [checked_with_faults(settings, COMBINATIONS[name], number, side, FAULTS) for number in numbers]
        for fault, of_fault in zip(FAULTS, zip(*pairs, strict=True), strict=True):
            in_runs[fault] += bool(alarms(of_fault, count))
            in_pairs[fault] += sum(bool(failed_checks("", scores, threshold(1))) for _, scores in of_fault)
    fewest = min(in_runs[fault] for fault in FAULTS)
    least = min(in_pairs[fault] for fault in FAULTS)
    figure(
        "noise-check",
        f"{name}: each of {len(FAULTS)} faults found in at least {fewest} of {runs} runs of {count} pairs, and in at "
        f"least {least / (runs * count):.0%} of single pairs",
    )
    assert fewest >= 0.95 * runs


def with_numbers(
    settings: Settings,
    overrides: Sequence[str],
    number: int,
    recorded: dict[str, Any],
    simulated: dict[str, Any],
    side: int = 256,
) -> Checked:
    """Return the plan and the scores of a pair whose row records some numbers, and whose noise has others."""
    config = settings(*overrides)
    config.seed = number
    validate_config(config)
    srgb = photograph(number, side)
    plan = plan_from_row(make_pair(srgb, config).row)
    assert plan.physics is not None
    plan = replace(plan, physics=replace(plan.physics, **recorded))
    assert plan.physics is not None
    pair = make_pair(srgb, plan)
    noisy = make_pair(srgb, replace(plan, physics=replace(plan.physics, **simulated))).noisy
    sums = pair_sums(pair.clean, noisy, pair.row)
    assert sums is not None
    return plan, pair_scores(sums)


NIGHT_ROWS = (*NIGHT_D850, "sensor=generic_14bit")
ROWS_DN = 15.0
"""Standard deviation of row offsets that are as strong as the read noise of `NIGHT_ROWS`."""


@pytest.mark.parametrize("correlation", [0.0, 0.9, -0.5])
def test_strong_row_noise_raises_no_alarm(correlation: float, settings: Settings) -> None:
    """Row offsets as large as all other noise move the means of columns and correlate vertical neighbours."""
    numbers = {"row_std_dn": ROWS_DN, "row_correlation": correlation}
    pairs = [with_numbers(settings, NIGHT_ROWS, number, numbers, {}) for number in range(4)]
    assert [str(alarm) for alarm in alarms(pairs, len(pairs))] == []
    assert max(abs(score.errors) for _, scores in pairs for score in scores.values()) < 6


@pytest.mark.parametrize(("recorded", "simulated"), [(0.9, 0.0), (0.0, 0.9)])
def test_wrong_correlation_of_rows_is_found(recorded: float, simulated: float, settings: Settings) -> None:
    numbers = {"row_std_dn": ROWS_DN / 2, "row_correlation": recorded}
    other = {"row_correlation": simulated}
    pairs = [with_numbers(settings, NIGHT_ROWS, number, numbers, other) for number in range(6)]
    assert "row differences" in {alarm.check for alarm in alarms(pairs, len(pairs))}


@pytest.mark.parametrize("simulated", [(1.0, 1.0, 1.0), (1.3, 1.0, 0.8)])
def test_wrong_gains_by_colour_are_found(simulated: tuple[float, float, float], settings: Settings) -> None:
    overrides = ("noise=nikon_d850", "scene=low_light", "sensor=generic_14bit", *GAINS)
    pairs = [with_numbers(settings, overrides, number, {}, {"gain_by_colour": simulated}) for number in range(2)]
    found = {(alarm.check, alarm.plane) for alarm in alarms(pairs, len(pairs))}
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
    assert "noise of all pairs together: mean" in lines[0]
    line = next(line for line in lines if "noise of 00000001: mean" in line)
    for said in (
        "DN from what black_level_dn",
        "standard errors; likely cause: another black level",
        "other checks",
    ):
        assert said in line
    assert "noise of 3 pairs checked, 3 wrong" in done.out


def test_many_wrong_pairs_are_counted(make: Make, run_main: RunMain, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1", f"noise.draws={LISTED + 3}", "source.patch=[random,128,1]")
    replace_noisy_frames(tmp_path / "ds", lambda clean, noisy, row: noisy + np.uint16(20))
    done = run_main("verify", "ds", "--noise")
    assert done.code == 4
    assert sum("noise of 00000000" in line for line in done.err.splitlines()) == LISTED
    assert done.err.splitlines()[-1].endswith("noise of 3 other pairs: wrong too")


# Law ------------------------------------------------------------------------------------------------------------------


def test_every_effect_has_an_entry() -> None:
    assert laws.EFFECTS.keys() == {"heteroscedastic", "dark_frame", *reference.EFFECTS}


def test_pair_with_an_unknown_effect_is_not_checked(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(laws.EFFECTS, "row")
    assert checked(settings, NIGHT_A7S2, 0, 128)[1] == {}


@pytest.mark.parametrize(
    ("law", "shape"), [("tukey", -0.2429), ("tukey", -0.4), ("tukey_lambda", -0.4), ("tukey", 0.0)]
)
def test_tukey_factor_agrees_with_the_table_of_draws(law: str, shape: float) -> None:
    table = quantile_table(law, shape)
    widths = np.repeat(2.0 ** np.arange(32), 32) / 32 / 2**32
    values, weights = [], []
    for position, weight in ((0.1127017, 5 / 18), (0.5, 8 / 18), (0.8872983, 5 / 18)):  # Gauss-Legendre
        t = position / 32
        values.append(table[:, 0] + t * (table[:, 1] + t * table[:, 2]))
        weights.append(widths * weight)
    frequencies = np.array([0.0, 0.3, 1.0, 2.5, 4.0])
    expected = [float((np.cos(frequency * np.array(values)) * np.array(weights)).sum()) for frequency in frequencies]
    np.testing.assert_allclose(laws.tukey_factor(frequencies, law, shape), expected, atol=3e-4)


@pytest.mark.parametrize("name", ["default", "Poisson", "night", "every effect", "fast"])
def test_characteristic_function_agrees_with_drawn_noise(name: str, settings: Settings) -> None:
    """The reference draws the noise of flat fields; the largest of all errors is below 5 standard errors."""
    config = settings(*LAWS[name])
    validate_config(config)
    plan = plan_image(config, "0" * 64, facts=FACTS)
    law = laws.NoiseLaw(plan, Patch(0, 0, 0, 512, 512))
    for light in (3.0, 200.0):
        clean = np.full((512, 512), plan.black_level_dn + light)
        noisy = reference.noisy(clean, plan)
        noise = noisy - clean - np.tile(law.offset_dn, (256, 1))
        signal = np.full(1, light)
        std = np.sqrt(law.variance(signal))
        for k in (1.0, 2.0):
            cosine = np.cos(k * noise / std)
            rounding = np.sinc(k / std / (2 * np.pi)) if "quantise" in plan.effects else 1.0  # not rounded here
            expected = law.factors(signal, k / std).value.real / rounding
            lines = 1 + (law.rows.variance / std**2) ** 2 * 512
            error = cosine.std() / 512 * math.sqrt(float(lines[0]))
            assert abs(cosine.mean() - expected[0]) < 5 * error + 2e-4


def test_sites_near_the_limits_are_not_used(settings: Settings) -> None:
    config = settings("sensor.clip=black")
    plan = plan_image(config, "0" * 64)
    law = laws.NoiseLaw(plan, Patch(0, 0, 0, 2, 2))
    dn = np.arange(4096.0)
    used = dn[usable_values(law, dn, (0, 0))]
    assert used.min() > plan.black_level_dn + 30
    assert used.max() < plan.white_level_dn - 300


def test_expectations_without_rounding_know_x_exactly(settings: Settings) -> None:
    plan = plan_image(settings("output.dtype=float32"), "0" * 64)
    law = laws.NoiseLaw(plan, Patch(0, 0, 0, 2, 2))
    of = expectations(law, np.array([300.0, 1000.0]), (0, 0))
    assert not of.rounding_std.any() and not of.cosine.slope.any() and of.cosine.unknown.max() < 1e-12


def test_expectations_between_two_dn_are_within_their_error(settings: Settings) -> None:
    config = settings("noise=canon_5d4", "scene=night", "output.dtype=float32", "sensor.clip=none")
    plan = plan_image(config, "0" * 64, facts=FACTS)
    assert plan.physics is not None
    law = laws.NoiseLaw(replace(plan, physics=replace(plan.physics, read_std_dn=0.3)), Patch(0, 0, 0, 2, 2))
    signal = np.arange(1.0, 40.0)
    of = expectations(law, signal + plan.black_level_dn, (0, 0))
    for k, cosine in ((1, of.cosine), (2, of.double)):
        for distance in np.linspace(-0.5, 0.5, 21):
            std = np.sqrt(law.variance(signal + distance))
            exact = law.factors(signal + distance, k / std).value.real
            error = np.abs(cosine.mean + distance * cosine.by_clean + distance**2 * cosine.by_square - exact)
            assert (error <= 1.2 * cosine.unknown + 1e-5).all()
        assert cosine.unknown[5:].max() < 1e-3


def test_few_electrons_raise_no_alarm_in_float32(settings: Settings) -> None:
    overrides = ("noise=canon_5d4", "scene=night", "output.dtype=float32", "sensor.clip=none")
    pair = with_numbers(settings, overrides, 5, {"read_std_dn": 0.3}, {}, side=512)
    assert alarms([pair], 1) == []


# Scores ---------------------------------------------------------------------------------------------------------------


def test_surprise_is_that_of_a_normal_distribution_for_small_steps() -> None:
    assert Score(7.0, 1.0, step=1e-9).surprise == pytest.approx(24.5)
    assert Score(7.0, 1.0, step=3.0).surprise < 13


def test_possible_expectations_raise_no_surprise() -> None:
    assert Score(5.0, 1.0, above=6.0).surprise == 0
    assert Score(-5.0, 1.0, above=6.0).errors == -5
    assert Score(-5.0, 1.0, below=math.inf).errors == 0


def test_rounding_errors_of_one_curve_add_linearly(settings: Settings) -> None:
    same, different = PooledScore(), PooledScore()
    for group in range(100):
        same.add(Score(0.0, 1.0, rounding=1.0), 1.0, 0)
        different.add(Score(0.0, 1.0, rounding=1.0), 1.0, group)
    assert same.score().rounding == pytest.approx(math.hypot(100, 15))
    assert different.score().rounding == pytest.approx(math.hypot(10, 15))
    assert same.score().variance == 100


def test_threshold_keeps_the_probability_of_a_false_alarm() -> None:
    assert 2 * TESTS * 101 * math.exp(-threshold(100)) == pytest.approx(FALSE_ALARM)
    assert len(CHECKS) + 2 * len(plane_names("RGGB")) == TESTS


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.9, -0.6])
def test_sums_of_correlations_of_rows_are_those_of_the_matrix(correlation: float) -> None:
    count = 2400
    powers = np.zeros(count)
    powers[:200] = np.float_power(correlation, np.arange(200))  # the squares of smaller ones would underflow
    covariance = 3.0 * powers[np.abs(np.subtract.outer(np.arange(count), np.arange(count)))]
    first = np.array([4 * group + row for group in range(count // 4) for row in (0, 1)])
    rows, others = covariance[first] - covariance[first + 2], (first, first + 2)
    for of, matrix in (
        (laws.row_offsets(3.0, correlation), covariance),
        (laws.row_differences(3.0, correlation), rows[:, others[0]] - rows[:, others[1]]),
    ):
        middle = matrix[len(matrix) // 2] / of.variance
        assert matrix[0, 0] == pytest.approx(of.variance)
        assert np.abs(middle).sum() == pytest.approx(of.magnitudes)
        assert (middle**2).sum() == pytest.approx(of.squares)


@pytest.mark.parametrize(
    ("pattern", "names"),
    [("RGGB", "R Gr Gb B"), ("BGGR", "B Gb Gr R"), ("GRBG", "Gr R B Gb"), ("GBRG", "Gb B R Gr")],
)
def test_planes_are_named_by_pattern(pattern: str, names: str) -> None:
    assert plane_names(pattern) == names.split()


def test_overlapping_patches_count_common_noise(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1", "source.patch=[grid,128,64]", "noise.draws=2")
    found = list(overlaps(tmp_path / "ds"))
    assert (min(found), max(found)) == (4, 9)  # 3 x 3 patches overlap, 2 x 2 in the corners; draws do not
    make(None, tmp_path / "rows", "source.limit=1", "source.patch=128", *NIGHT_A7S2)
    assert set(overlaps(tmp_path / "rows")) == {6}  # six patches share rows of 768 sites


def test_patches_share_correlated_rows_beyond_their_own(make: Make, tmp_path: Path) -> None:
    overrides = *LAWS["correlated rows"], "source.limit=1", "source.patch=[grid,64,64]"
    make(None, tmp_path / "ds", *overrides)
    in_row = len({row["patch_x"] for row in read_rows(tmp_path / "ds" / "manifest.csv")})
    # offsets have a correlation of 1 % at a distance of 13 rows, and so reach into the patches above and below
    assert set(overlaps(tmp_path / "ds")) == {2 * in_row, 3 * in_row}


def test_clips_and_levels_are_checked(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=2", "noise=brooks2019", "noise.levels=2", "noise.draws=2")
    checker = Checker(tmp_path / "ds")
    for clean, noisy, row in RawPairs(tmp_path / "ds"):
        checker.add(row, pair_sums(clean, noisy, row))
    found = checker.result()
    assert (found.count, found.alarms, found.wrong_pairs) == (8, [], 0)


@pytest.mark.parametrize("name", ["night", "float32 clean", "float32 without limits", "every effect"])
def test_sums_equal_those_of_numpy(name: str, settings: Settings) -> None:
    config = settings(*LAWS[name])
    validate_config(config)
    pair = make_pair(photograph(3, 96)[:, :70], config)
    sums = pair_sums(pair.clean, pair.noisy, pair.row)
    assert sums is not None
    expected = numpy_sums(sums, mosaic_dn(pair.clean, pair.row), mosaic_dn(pair.noisy, pair.row))
    for what, values in expected.items():
        np.testing.assert_allclose(getattr(sums, what), values, rtol=1e-5, atol=1e-3, err_msg=what)


def test_averaged_plan_has_no_fixed_patterns_in_its_noise(settings: Settings) -> None:
    config = settings(*EVERY_EFFECT)
    plan = plan_image(config, "0" * 64, facts=FACTS)
    assert plan.physics is not None
    averaged = replace(plan, physics=replace(plan.physics, fixed_pattern_in_clean=True))
    patch = Patch(0, 0, 0, 4, 4)
    signal = np.full(1, 1000.0)
    assert laws.NoiseLaw(plan, patch).fixed_variance(signal) > 0
    law = laws.NoiseLaw(averaged, patch)
    assert law.fixed_variance(signal) == 0
    assert not law.offset_dn.any()
