"""Checks of the noise: untouched datasets pass, and planted faults are found."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.noise_faults import FAULTS, SITE_FAULTS, Fault, NoisyPair, replace_noisy_frames, with_numbers
from helpers.promise_report import Figure
from numpy.typing import NDArray

from unprocess_gen import RawPairs, make_pair
from unprocess_gen.calibration.deviations import FALSE_ALARM, Score, alarm_limit
from unprocess_gen.config.schema import replaced
from unprocess_gen.core.arrays import Frame
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.reports.noise_check import repetition
from unprocess_gen.reports.noise_check.alarms import (
    LEAST_SITES,
    PAIRS_LISTED,
    TESTS,
    Alarm,
    Checker,
    Pool,
    check_pairs,
    failed_checks,
)
from unprocess_gen.reports.noise_check.pair_scores import Scores, scores_of
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.sources import synthetic

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


def untouched(pair: NoisyPair) -> Frame:
    return pair.noisy


def scores_of_pair(clean: Frame, noisy: Frame, row: Row) -> Scores:
    """Scores of a pair that has enough sites."""
    noise = repetition.measure_noise(clean, noisy, row)
    return scores_of(noise)[0] if noise is not None and np.count_nonzero(noise.weight) >= LEAST_SITES else {}


def checked(
    settings: Settings,
    overrides: Sequence[str],
    number: int,
    side: int = 192,
    faults: Iterable[Fault] = (untouched,),
    kind: str = "scene",
    **numbers: Any,
) -> list[Checked]:
    """Plan and scores of a pair for each fault; ``numbers``: physical numbers of the row."""
    draws = np.random.default_rng(number)
    picture = synthetic.picture(synthetic.NAMES[number % len(synthetic.NAMES)])
    height, width = (min(side, length) // 2 * 2 for length in picture.shape[:2])
    y, x = (int(draws.integers(0, n - m + 1)) // 2 * 2 for n, m in zip(picture.shape, (height, width), strict=False))
    srgb = KINDS[kind](np.ascontiguousarray(picture[y : y + height, x : x + width]))
    if kind != "scene":
        srgb[0, 0] = number % 256  # equal pictures have equal noise
    pair = make_pair(srgb, replaced(settings(*overrides), {"seed": number}))
    plan = plan_from_row(pair.row)
    if numbers:
        assert plan.physics is not None
        pair = make_pair(srgb, plan.replace(**numbers))
        plan = plan_from_row(pair.row)
    noisy_frames = [fault(NoisyPair(srgb, pair.noisy, plan, np.random.default_rng(number))) for fault in faults]
    return [(plan, scores_of_pair(pair.clean, noisy, pair.row)) for noisy in noisy_frames]


def alarms(pairs: Sequence[Checked]) -> list[Alarm]:
    """Alarms of a dataset that consists of these pairs."""
    pool, limit, found = Pool(), alarm_limit(TESTS * (len(pairs) + 1)), list[Alarm]()
    for number, (plan, scores) in enumerate(pairs):
        found += failed_checks(f"{number:08d}", scores, limit)
        pool.add(scores, plan)
    return found + failed_checks("", pool.scores(), limit)


# Untouched pairs ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", slow_except(("default", "clipped at black, packed"), LAWS))
def test_untouched_pairs_raise_no_alarm(name: str, settings: Settings) -> None:
    pairs = [*checked(settings, LAWS[name], 0), *checked(settings, LAWS[name], 1)]
    assert any(scores for _, scores in pairs)
    assert [str(alarm) for alarm in alarms(pairs)] == []


ENDS = (
    *((), ("scene.exposure_ratio=200",), ("noise=canon_5d4", "scene=indoor"), ("noise=sony_a7s2", "scene=night")),
    ("noise=nikon_d850", "scene=long_exposure", "effects.hot_pixels=on", "sensor=generic_14bit"),
)


def alarms_of_datasets(datasets: Iterable[Sequence[Checked]]) -> tuple[list[str], list[Checked]]:
    """Alarms of datasets, and of all their pairs together as another one; and these pairs."""
    kept = list(datasets)
    everything = [pair for pairs in kept for pair in pairs]
    return [str(alarm) for pairs in (*kept, everything) for alarm in alarms(pairs)], everything


@pytest.mark.slow
def test_many_black_and_white_sites_raise_no_alarm(settings: Settings, figure: Figure) -> None:
    """Each combination counts as a dataset of 25 pairs."""
    found, everything = alarms_of_datasets(
        [pair for n in range(25) for pair in checked(settings, overrides, n, kind=kind)]
        for kind, overrides in itertools.product(KINDS, ENDS)
    )
    figure("noise-check", f"{len(found)} alarms in {len(everything)} pairs with black bars, black, white or one colour")
    assert found == []


NOISES = (
    *("imx385_iso1600", "imx385_iso25600", "imx385_iso3200_rvdd", "brooks2019", "imx385_iso3200 noise.law=poisson"),
    *("imx385 noise.iso=3200", "sony_a7s2", "nikon_d850", "canon_5d4", "canon_70d", "canon_700d", "oppo_reno10x"),
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
    """Each combination of profile, scene and variant counts as a dataset."""

    def datasets() -> Iterator[list[Checked]]:
        numbers = itertools.count()
        for noise, scene, variant in itertools.product(NOISES, SCENES, VARIANTS):
            overrides = (*f"noise={noise}".split(), f"scene={scene}", *variant)
            with suppress(ConfigError):  # a profile without numbers for the ISO of the scene, or for the sensor's bits
                yield [pair for _ in range(2) for pair in checked(settings, overrides, next(numbers))]

    found, everything = alarms_of_datasets(datasets())
    unusable = sum(not scores for _, scores in everything)
    largest = max(score.surprise for _, scores in everything for score in scores.values())
    figure(
        "noise-check",
        f"{len(found)} alarms in {len(everything)} untouched pairs, {unusable} of them without usable sites; "
        f"smallest probability of a score e^-{largest:.1f}",
    )
    assert found == []
    assert len(everything) >= 2000


def test_strong_row_noise_raises_no_alarm(settings: Settings) -> None:
    """Row offsets are as strong as the read noise."""
    numbers = {"row_std_dn": 15.0, "row_correlation": 0.9}
    pairs = [pair for n in range(3) for pair in checked(settings, NIGHT_14_BITS, n, 128, **numbers)]
    assert [str(alarm) for alarm in alarms(pairs)] == []


def test_overlapping_patches_levels_and_draws_raise_no_alarm(make: Make, tmp_path: Path) -> None:
    many = ("noise=brooks2019", "noise.levels=2", "noise.draws=2", "source.patch=[grid,128,64]", "source.downscale=2")
    make(None, tmp_path / "ds", "source.limit=1", *many)
    pairs = RawPairs(tmp_path / "ds")
    checker = check_pairs(pairs, len(pairs))
    assert (checker.count, checker.alarms, checker.wrong_pairs) == (len(pairs), [], 0)


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
    "row noise removed": "rows",
    "column stripes of a tenth of the read noise": "columns",
    "uniform noise of equal variance": "shape",
    "5 % more signal": "signal",
    "green sites swapped": "order of sites",
    "red and blue sites swapped": "order of sites",
    "correlation 0.05 of adjacent sites": "adjacent sites",
    "correlation 0.05 of diagonal sites": "adjacent sites",
    "correlation 0.05 of neighbours of a plane": "neighbours",
    "correlation 0.05 of diagonal neighbours of a plane": "neighbours",
    "a share of 1e-4 of white sites": "outliers",
    "even DN only": "odd codes",
}
"""Checks that must find a fault."""
OF_PHYSICAL_NUMBERS = ("row noise removed", "column stripes of a tenth of the read noise")


QUICK = (
    *("blur of 5 % over 3 x 3 sites, variance kept", "a share of 1e-4 of white sites", "even DN only"),
    *("red and blue sites swapped", "uniform noise of equal variance", "5 % more signal"),
)


@pytest.mark.parametrize("fault", slow_except(QUICK, FAULTS))
def test_planted_fault_is_found(fault: str, settings: Settings) -> None:
    overrides = NIGHT_14_BITS if fault in OF_PHYSICAL_NUMBERS else ()
    pairs = [pair for n in range(8) for pair in checked(settings, overrides, n, 256, [FAULTS[fault]])]
    found = alarms(pairs)
    assert found
    assert EXPECTED.get(fault, found[0].check) in {alarm.check for alarm in found}


@pytest.mark.slow
@pytest.mark.parametrize("name", COMBINATIONS)
def test_planted_faults_are_found_in_95_percent_of_runs(
    name: str, settings: Settings, figure: Figure, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, count, side = 20, 12, 512
    monkeypatch.setattr(repetition, "_repetition", kept(repetition._repetition))
    in_runs: Counter[str] = Counter()
    faults = {"default": SITE_FAULTS, LONG: SITE_FAULTS | NO_HOT_PIXELS}.get(name, FAULTS)
    for run in range(runs):
        numbers = range(run * count, (run + 1) * count)
        pairs = [checked(settings, COMBINATIONS[name], number, side, faults.values()) for number in numbers]
        for fault, of_fault in zip(faults, zip(*pairs, strict=True), strict=True):
            in_runs[fault] += bool(alarms(of_fault))
    fewest = min(in_runs[fault] for fault in faults)
    figure(
        "noise-check",
        f"{name}: each of {len(faults)} faults found in at least {fewest} of {runs} runs of {count} pairs",
    )
    assert fewest >= 0.95 * runs, in_runs


def kept(repetition: Callable[..., Any]) -> Callable[..., Any]:
    """Function that simulates the repetition of a clean frame once for all faults."""
    last: list[Any] = [None, None]

    def kept_repetition(clean_dn: Any, plan: Plan, *others: Any) -> Any:
        if last[0] != plan:
            last[:] = plan, repetition(clean_dn, plan, *others)
        return last[1]

    return kept_repetition


@pytest.mark.parametrize("missing", ["hot_pixel_share", "dead_pixel_share"])
def test_missing_defects_are_found(missing: str, settings: Settings) -> None:
    """Some pixels are hot and dead; the last effect decides."""
    shares = "effects.dead_pixels=on", "noise.hot_pixel_share=0.01", "noise.dead_pixel_share=0.01"
    faults = [untouched, with_numbers(**{missing: 0.0})]
    right, faulty = checked(settings, (*COMBINATIONS[LONG], *shares), 0, faults=faults)
    assert [str(alarm) for alarm in alarms([right])] == []
    assert "outliers" in {alarm.check for alarm in alarms([faulty])}


def repetitions(pairs: Iterable[Any], **numbers: int) -> list[Alarm]:
    """Alarms about repeated noise, if the rows of the pairs have these numbers and one more from pair to pair."""
    pairs = list(pairs)
    checker = Checker(len(pairs))
    for n, (clean, noisy, row) in enumerate(pairs):
        renumbered = {**row, **{name: first + n for name, first in numbers.items()}}
        checker.add(repetition.measure_noise(clean, noisy, renumbered))
    return [alarm for alarm in checker.alarms if alarm.check == "repetition"]


def test_repeated_draws_and_noise_are_found(settings: Settings) -> None:
    """Draws of a scene are equal byte by byte; frames of different scenes have the same deviates."""
    scenes = [np.ascontiguousarray(synthetic.picture(name)[:64, :64]) for name in synthetic.NAMES[:3]]
    pairs = [make_pair(srgb, settings()) for srgb in scenes]
    assert repetitions([(pairs[0].clean, pairs[0].noisy, pairs[0].row)] * 2) == []  # patches of a frame at one place
    assert repetitions([(pair.clean, pair.noisy, pair.row) for pair in pairs]) == []
    assert repetitions([(pairs[0].clean, pairs[0].noisy, pairs[0].row)] * 2, draw=0)
    noise = np.random.default_rng(0).standard_normal((64, 64))
    planned = [NoisyPair(srgb, pair.noisy, plan_from_row(pair.row)) for srgb, pair in zip(scenes, pairs, strict=True)]
    frames = [one.with_noise(noise) for one in planned]
    assert repetitions([(pair.clean, frame, pair.row) for pair, frame in zip(pairs, frames, strict=True)])


@pytest.mark.slow
@pytest.mark.parametrize(("recorded", "simulated"), [(0.9, 0.0), (0.0, 0.9)])
def test_wrong_correlation_of_rows_is_found(recorded: float, simulated: float, settings: Settings) -> None:
    numbers, fault = {"row_std_dn": 7.5, "row_correlation": recorded}, with_numbers(row_correlation=simulated)
    pairs = [pair for n in range(6) for pair in checked(settings, NIGHT_14_BITS, n, 192, [fault], **numbers)]
    assert "rows" in {alarm.check for alarm in alarms(pairs)}


def test_wrong_gains_by_colour_are_found(settings: Settings) -> None:
    overrides = ("noise=nikon_d850", "scene=low_light", "sensor=generic_14bit", *GAINS)
    fault = with_numbers(gain_by_colour=(1.3, 1.0, 0.8))
    pairs = [pair for n in range(2) for pair in checked(settings, overrides, n, faults=[fault])]
    assert {alarm.plane for alarm in alarms(pairs) if alarm.check in ("variance", "gain", "shape")} == {"R", "B"}


def test_replaced_noise_of_intact_shards_ends_verify_with_4(make: Make, run_main: RunMain, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=3")
    assert (run_main("verify", "ds", "--noise").code, run_main("verify", "ds").code) == (0, 0)
    replace_noisy_frames(tmp_path / "ds", lambda clean, noisy, row: noisy + np.uint16(20))
    assert run_main("verify", "ds").code == 0
    done = run_main("verify", "ds", "--noise")
    assert done.code == 4
    lines = done.err.splitlines()
    text = r"mean.* is [\d.]+ DN above that of recorded noise \(probability below 1e-\d+\): wrong black level"
    assert re.search(f"noise of all pairs together: {text}", lines[0])
    assert any(re.search(f"noise of 00000001: {text}", line) for line in lines)
    assert "noise of 3 pairs checked, 3 wrong" in done.out


def test_many_wrong_pairs_are_counted(make: Make, run_main: RunMain, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1", f"noise.draws={PAIRS_LISTED + 3}", "source.patch=[random,128,1]")
    replace_noisy_frames(tmp_path / "ds", lambda clean, noisy, row: noisy + np.uint16(20))
    done = run_main("verify", "ds", "--noise")
    assert done.code == 4
    assert sum("noise of 00000000" in line for line in done.err.splitlines()) == PAIRS_LISTED
    assert done.err.splitlines()[-1].endswith("noise of 3 other pairs: wrong too")


# Scores ---------------------------------------------------------------------------------------------------------------


def test_surprise_is_that_of_a_normal_distribution_for_small_steps() -> None:
    assert Score(7.0, 1.0, 1.0, step=1e-9).surprise == pytest.approx(24.5)
    assert Score(7.0, 1.0, 1.0, step=3.0).surprise < 13


def test_threshold_keeps_the_probability_of_a_false_alarm(settings: Settings) -> None:
    assert 2 * TESTS * 101 * math.exp(-alarm_limit(TESTS * 101)) == pytest.approx(FALSE_ALARM)
    assert len(checked(settings, (), 0)[0][1]) == TESTS - 2  # no hot pixels, and no pair before
