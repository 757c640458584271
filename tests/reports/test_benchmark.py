"""The benchmark of accuracy: a row for every method, errors within the stated limits, and a complete report."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings, TreeHash
from helpers.photographs import fill
from helpers.promise_report import Figure
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.accuracy import METHODS, STAGES, choose_methods
from unprocess_gen.config.interpretation import accuracy_budget
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import AccuracyConfig, Config, NoiseConfig, SceneConfig, SensorConfig, SourceConfig
from unprocess_gen.config.serialization import read_option
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.pipeline.progress import Progress
from unprocess_gen.reports import formatting, report_files
from unprocess_gen.reports.benchmark import complete_runs, figure, measure, method_errors, report, session, tables
from unprocess_gen.reports.benchmark.complete_runs import RunFiles, RunMeasurement, RunTimes
from unprocess_gen.reports.benchmark.conclusion import RECOMMENDATIONS, conclude
from unprocess_gen.reports.benchmark.measure import (
    BENCHMARKS_BY_NAME,
    METHOD_BENCHMARKS,
    TIER_STAGES,
    BenchmarkReport,
    Measurement,
)
from unprocess_gen.reports.benchmark.session import EXACT, REFERENCE, BenchmarkProfiles, SampleSizes
from unprocess_gen.reports.estimate import estimate_run, format_estimate
from unprocess_gen.simulation.reference import noise
from unprocess_gen.simulation.reference.poisson import gaussian_distance
from unprocess_gen.sources.loader import list_photographs, load_source

LITTLE = SampleSizes(
    photographs=3,
    rounds=2,
    sampled=(64, 96),
    readable=(24, 32),
    compiled=(48, 64),
    flat=128,
    positions=16,
    run_files=2,
)
SMALLEST = SampleSizes(2, 1, (16, 16), (8, 8), (8, 8), 4, 2, run_files=1)
TIERS = {
    name: read_option(conf_dir() / "accuracy" / f"{name}.yaml", AccuracyConfig) for name in (REFERENCE, EXACT, "fast")
}


def option(group: str, name: str, schema: type) -> Any:
    return read_option(conf_dir() / group / f"{name}.yaml", schema)


@pytest.fixture(scope="session")
def profiles() -> BenchmarkProfiles:
    two_numbers, electrons = (option("noise", name, NoiseConfig) for name in ("imx385_iso3200", "sony_a7s2"))
    scenes = {name: option("scene", name, SceneConfig) for name in ("daylight", "night")}
    return BenchmarkProfiles(TIERS, two_numbers, electrons, option("sensor", "generic_14bit", SensorConfig), scenes)


@pytest.fixture(scope="session")
def found(settings: Settings, profiles: BenchmarkProfiles) -> BenchmarkReport:
    return measure.measure_accuracy(
        settings("scene=low_light", "source.downscale=2"), profiles, LITTLE, "gen-dataset accuracy"
    )


def rows_of(found: BenchmarkReport, *stages: str) -> dict[str, Measurement]:
    return {f"{row.stage}:{row.method}": row for row in found.rows if row.stage in stages}


# Rows -----------------------------------------------------------------------------------------------------------------


def test_every_method_has_a_benchmark() -> None:
    assert [one.spelled for one in METHOD_BENCHMARKS] == [method.spelled for method in METHODS]


def test_every_method_and_tier_has_one_row(found: BenchmarkReport) -> None:
    expected = [(method.stage, method.name) for method in METHODS]
    expected += [(stage, tier) for stage in TIER_STAGES for tier in TIERS]

    assert [(row.stage, row.method) for row in found.rows] == expected


def test_measurable_errors_and_times_have_values(found: BenchmarkReport) -> None:
    for row in found.rows:
        measured = BENCHMARKS_BY_NAME.get(f"{row.stage}:{row.method}")
        assert (row.error_max is None) == (measured is not None and measured.error is None)
        assert (row.ns_per_pixel is None) == (measured is not None and measured.ns is None)
        assert (row.ns_per_pixel is None) == (row.ratio_to_reference is None)
        assert row.ns_per_pixel is None or row.ns_per_pixel > 0


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.spelled)
def test_budget_for_a_method_chooses_it(method: Any) -> None:
    assert method.spelled in session.chosen_methods(accuracy_budget(session.budget_for(method, TIERS)))


def test_budget_for_a_method_changes_no_other_method() -> None:
    exact = set(choose_methods(accuracy_budget(TIERS[EXACT]), counts_electrons=True))
    for method in METHODS:
        if method.implementation == "float64":
            chosen = set(choose_methods(accuracy_budget(session.budget_for(method, TIERS)), counts_electrons=True))
            assert len(chosen - exact) <= 1


def test_tiers_of_a_method_are_those_that_choose_it(found: BenchmarkReport) -> None:
    assert rows_of(found, "curve")["curve:exact_table"].tier.split() == [EXACT, "fast"]  # fast: for physical noise
    assert rows_of(found, "curve")["curve:float32_table"].tier.split() == ["fast"]
    assert rows_of(found, "curve")["curve:numpy_table"].tier.split() == [REFERENCE]
    assert rows_of(found, "tier")["tier:fast"].tier == "fast"


def test_reference_has_ratio_one_and_no_error(found: BenchmarkReport) -> None:
    for row in found.rows:
        if row.method == REFERENCE or (row.stage not in TIER_STAGES and row.tier == REFERENCE):
            assert row.ratio_to_reference == 1
            assert row.stage == "normal" or (row.error_max, row.error_rms) == (0, 0)


# Stated errors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.spelled)
def test_measured_errors_are_within_the_stated_limits(found: BenchmarkReport, method: Any, figure: Figure) -> None:
    row = rows_of(found, method.stage)[method.spelled]
    if row.error_max is None:
        pytest.skip("kernel cannot be called separately")
    if method.stage == "normal":
        assert 0 < row.error_max <= method.normal_error
    elif method.stage == "shot":
        by_chance = 0.9 / LITTLE.flat  # left by common uniforms: one site in twenty on either side, four sigma
        assert row.error_max <= (TIERS["fast"].law_distance + by_chance if method.approximates_law else 0)
    else:
        changed_by_chance = 5 * math.sqrt(method.clean_changed_share / (3 * math.prod(LITTLE.sampled)))
        assert row.error_max <= method.clean_dn
        assert (row.changed_share or 0) <= method.clean_changed_share + changed_by_chance
    figure("tiers", f"{method.stage}: error {row.error_max:.2g} {row.error_unit}")


@pytest.mark.parametrize("stage", TIER_STAGES)
def test_exact_tier_changes_no_dn(found: BenchmarkReport, stage: str) -> None:
    row = rows_of(found, stage)[f"{stage}:exact"]

    assert (row.error_max, row.error_rms, row.changed_share) == (0, 0, 0)


# Complete runs --------------------------------------------------------------------------------------------------------


def run(tier: str = "fast", ratio: float | None = 0.9, changed: float = 0.02, **changes: Any) -> RunMeasurement:
    """Return a row of complete runs with the given settings."""
    shares = {"decode_share": 0.25, "simulate_share": 0.25, "write_share": 0.5}
    errors = {"noisy_max_dn": 2.0, "noisy_rms_dn": 0.1, "noisy_max_std": 0.3, "noisy_rms_std": 0.004}
    times = dict.fromkeys(("ns_per_pixel", "ratio_to_exact", "lower_quartile_ratio", "upper_quartile_ratio"), ratio)
    named = {"setting": "given", "noise": "imx385_iso3200", "tier": tier, "noisy_changed_share": changed}
    return RunMeasurement(**{**named, **times, **shares, **errors, **changes})


def runs_of(found: BenchmarkReport, setting: str) -> dict[str, RunMeasurement]:
    return {run.tier: run for run in found.runs if run.setting == setting}


def test_every_tier_runs_in_every_setting(found: BenchmarkReport) -> None:
    expected = [(setting, tier) for setting in ("given", "daylight", "night") for tier in TIERS]

    assert [(run.setting, run.tier) for run in found.runs] == expected
    assert [run.noise for run in found.runs[::3]] == [
        "imx385_iso3200",
        "sony_a7s2, ISO 100",
        "sony_a7s2, ISO 6400",
    ]


def test_shares_of_a_run_sum_to_one(found: BenchmarkReport) -> None:
    for run in found.runs:
        shares = (run.decode_share or 0, run.simulate_share or 0, run.write_share or 0)
        assert sum(shares) == pytest.approx(1, abs=1e-12)
        assert all(share > 0 for share in shares)


def test_ratios_of_runs_are_to_exact_in_the_same_setting(found: BenchmarkReport) -> None:
    for setting in ("given", "daylight", "night"):
        runs = runs_of(found, setting)
        assert (
            runs["exact"].ratio_to_exact
            == runs["exact"].lower_quartile_ratio
            == runs["exact"].upper_quartile_ratio
            == 1
        )
        for run in runs.values():
            assert run.ratio_to_exact == pytest.approx((run.ns_per_pixel or 0) / (runs["exact"].ns_per_pixel or 0))


def test_exact_runs_have_the_noisy_frames_of_the_reference(found: BenchmarkReport) -> None:
    for run in found.runs:
        errors = (run.noisy_changed_share, run.noisy_max_dn, run.noisy_rms_dn, run.noisy_max_std, run.noisy_rms_std)
        assert (errors == (0, 0, 0, 0, 0)) == (run.tier != "fast")


def test_tier_own_has_the_noisy_errors_of_the_given_settings(found: BenchmarkReport) -> None:
    for name, row in rows_of(found, "tier_own").items():
        run = runs_of(found, "given")[name.partition(":")[2]]
        for error in ("changed_share", "max_dn", "rms_dn", "max_std", "rms_std"):
            assert getattr(row, f"noisy_{error}") == getattr(run, f"noisy_{error}")


def test_noisy_errors_of_a_tier_are_those_of_its_frames(settings: Settings, profiles: BenchmarkProfiles) -> None:
    opened = session.open_session(settings("source.limit=1"), profiles, LITTLE)
    pair, plan = opened.sampled_pairs("given", TIERS["fast"])[0]
    reference, _ = opened.sampled_pairs("given", TIERS[REFERENCE])[0]
    difference = pair.noisy.astype(float) - reference.noisy
    std = np.sqrt(noise.noise_variance(reference.clean.astype(float), plan) + 1 / 12)
    error = method_errors.noisy_errors(opened, "given", TIERS["fast"])

    assert error.changed_share == np.mean(difference != 0) > 0
    assert (error.max_dn, error.max_std) == (np.abs(difference).max(), np.abs(difference / std).max())
    assert error.rms_dn == pytest.approx(np.sqrt(np.mean(difference**2)), rel=1e-12)
    assert error.rms_std == pytest.approx(np.sqrt(np.mean((difference / std) ** 2)), rel=1e-12)


def test_settings_of_runs_include_both_kinds_of_noise(settings: Settings, profiles: BenchmarkProfiles) -> None:
    for overrides, names in (
        ((), ["given", "daylight", "night"]),
        (("noise=sony_a7s2", "scene=low_light"), ["given", "two_parameter_noise", "daylight", "night"]),
        (("noise=sony_a7s2", "scene=night"), ["given", "two_parameter_noise", "daylight"]),
    ):
        assert list(session.run_settings(settings(*overrides), profiles)) == names


@pytest.mark.parametrize("assumed", ["use", "off"])
def test_runs_decide_about_assumed_numbers_as_given(
    assumed: str, settings: Settings, profiles: BenchmarkProfiles
) -> None:
    configs = session.run_settings(settings(f"effects.assumed={assumed}", "effects.tolerance=0.2"), profiles)

    assert {(config.effects.assumed, config.effects.tolerance) for config in configs.values()} == {(assumed, 0.2)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder for temporary files of this process."""
    path = tmp_path / "temporary"
    path.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(path))
    return path


def test_runs_have_the_bytes_of_generate_and_leave_nothing(
    folder: Path, photos: Path, settings: Settings, make: Make, tree_hash: TreeHash, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    true = complete_runs.generate

    def generate(config: Any) -> Any:
        summary = true(config)
        made.append(tree_hash(Path(config.out)))
        return summary

    monkeypatch.setattr(complete_runs, "generate", generate)
    config = settings(f"source.root={photos}", "noise.levels=2")
    with complete_runs.run_files(config, LITTLE) as files:
        for tier in TIERS.values():
            times = complete_runs.time_run(complete_runs.run_config(config, files, tier), files.pixels)
            assert min(times) > 0
    expected = [
        make(photos, folder.parent / tier, f"accuracy={tier}", "noise.levels=2", f"source.limit={files.source.limit}")
        for tier in TIERS
    ]

    assert files.count == 2
    assert made == [tree_hash(summary.out) for summary in expected]
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, MachineError])
def test_ended_measurement_leaves_nothing(
    error: type[BaseException],
    folder: Path,
    settings: Settings,
    profiles: BenchmarkProfiles,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    level = complete_runs.LOGGER.level
    true = complete_runs.generate

    def generate(config: Any) -> Any:
        true(config)
        assert any(folder.glob("*/dataset/dataset.json"))
        raise error

    monkeypatch.setattr(complete_runs, "generate", generate)
    with pytest.raises(error):
        measure.measure_accuracy(settings(), profiles, SMALLEST)

    assert list(folder.iterdir()) == []
    assert complete_runs.LOGGER.level == level


def test_temporary_folder_without_space_is_reported(
    folder: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.rmdir()
    with pytest.raises(MachineError, match=r"set TMPDIR to a folder with space"):
        complete_runs.run_files(settings(), LITTLE).__enter__()


def test_built_in_scenes_are_read_from_files(folder: Path, settings: Settings) -> None:
    with complete_runs.run_files(settings("source.include=['*.png']", "source.downscale=2"), LITTLE) as files:
        listed = list_photographs(files.source).sources

        assert len(listed) == files.count == 2
        assert all(source.path.endswith(".jpg") for source in listed)
        assert load_source(files.source, listed[0])[1].srgb.shape == (256, 384, 3)


def test_photographs_of_runs_end_with_enough_pixels(folder: Path, settings: Settings, tmp_path: Path) -> None:
    root = fill(tmp_path / "photos", 9)
    (root / "000.png").write_bytes(b"")  # cannot be read
    many = replace(LITTLE, run_files=99)
    pixels = (0, 13 * 17, 14 * 18, 15 * 19)
    for sizes, count in (
        (replace(many, run_pixels=13 * 17 + 14 * 18), 2),
        (replace(many, run_pixels=13 * 17 + 14 * 18 - 1), 1),
        (replace(many, run_pixels=1), 1),
        (LITTLE, 2),
        (many, 8),
    ):
        with complete_runs.run_files(settings(f"source.root={root}"), sizes) as files:
            assert (files.count, files.source.limit) == (count, count + 1)
            assert files.pixels_of_sources[:4] == pixels[: count + 1]


def test_photographs_that_cannot_be_packed_are_an_error(folder: Path, settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos/a.png"), np.zeros((1, 9, 3), np.uint8))
    config = settings(f"source.root={tmp_path / 'photos'}", "output.layout=packed")
    with pytest.raises(ConfigError, match=r"none of 1 photographs can be read with output.layout=packed"):
        complete_runs.run_files(config, LITTLE).__enter__()


def test_runs_with_too_many_frames_have_one_level(settings: Settings) -> None:
    config = settings("noise.levels=5", "noise.draws=2")
    files = RunFiles(config.source, (1000,), Path())

    assert complete_runs.affordable(config, files, replace(LITTLE, run_pixels=5000)) == config
    one = complete_runs.affordable(config, files, replace(LITTLE, run_pixels=4999))
    assert (one.noise.levels, one.noise.draws) == (None, 1)


@pytest.mark.parametrize(
    ("megapixels", "levels", "limits"), [((4, 2, 1), 1, [2]), ((4, 2), 3, [1]), ((24, 1), 1, [1]), ((25,), 1, [])]
)
def test_reference_runs_once_on_few_photographs(
    megapixels: tuple[int, ...], levels: int, limits: list[int], settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[str, int]] = []

    def time_run(config: Config, pixels: int) -> RunTimes:
        assert pixels == sum(megapixels[: config.source.limit]) * 1_000_000
        ran.append((config.accuracy.name, config.source.limit or 0))
        return RunTimes(1.0, 2.0, 3.0)

    monkeypatch.setattr(complete_runs, "time_run", time_run)
    config = settings(f"noise.levels={levels}")
    files = RunFiles(config.source, tuple(number * 1_000_000 for number in megapixels), Path()).at_most(10**9)
    with Progress(9) as progress:
        times = complete_runs.measure_runs({"given": config}, TIERS, files, 3, progress)

    assert [limit for name, limit in ran if name == REFERENCE] == limits
    assert [limit for name, limit in ran if name != REFERENCE] == [1] * 2 + [len(megapixels)] * 6
    cost = complete_runs.run_cost(times["given", REFERENCE], times["given", EXACT])
    assert cost.ratio_to_exact == (1 if limits else None)


def test_cost_of_runs_is_the_shortest_of_each_stage() -> None:
    slow, fast, exact = RunTimes(1.0, 4.0, 4.0), RunTimes(2.0, 2.0, 1.0), RunTimes(1.0, 6.0, 1.0)
    cost = complete_runs.run_cost([slow, fast], [exact, exact])

    assert (cost.ns_per_pixel, cost.ratio_to_exact) == (4, 0.5)
    assert (cost.lower_quartile_ratio, cost.upper_quartile_ratio) == (0.75, 1.0)
    assert (cost.decode_share, cost.simulate_share, cost.write_share) == (0.25, 0.5, 0.25)


# The conclusion -------------------------------------------------------------------------------------------------------


def concluded(*runs: RunMeasurement, given: str = "exact") -> str:
    return conclude(runs, TIERS[given], TIERS, RunFiles(SourceConfig(), (5_000_000, 0, 210_000), Path()))


def test_conclusion_has_the_numbers_of_the_table(found: BenchmarkReport) -> None:
    run = runs_of(found, "given")["fast"]
    table = tables.run_table([run])
    cells = dict(zip(table.headings, next(iter(table.lines)), strict=True))

    assert found.conclusion.startswith(
        "In a complete run of 2 photographs (0.2 megapixels, noise=imx385_iso3200), `fast` "
    )
    ratio = re.search(r"takes (?:about as long as `exact` \(ratio )?([\d.]+)", found.conclusion)
    assert ratio is not None and ratio[1] == cells["of exact"]
    assert found.conclusion.endswith(
        f" and moves {cells['changed']} of the noisy DN, by at most {cells['max DN']} DN or {cells['max σ']} standard "
        f"deviations of the noise (RMS {cells['RMS DN']} DN, {cells['RMS σ']} standard deviations)."
    )


START = "In a complete run of 2 photographs (5.2 megapixels, noise=imx385_iso3200), "
MOVES = (
    "moves 2 % of the noisy DN, by at most 2 DN or 0.3 standard deviations of the noise (RMS 0.1 DN, 0.004 standard "
    "deviations)."
)


@pytest.mark.parametrize(
    ("measured", "given", "sentence"),
    [
        (run(), "exact", f"{START}`fast` takes 0.9 of the processor time of `exact` and {MOVES}"),
        (run(), "fast", f"{START}`fast` takes 0.9 of the processor time of `exact` and {MOVES}"),
        (run(ratio=1.25), "exact", f"{START}`fast` takes 1.25 times the processor time of `exact` and {MOVES}"),
        (
            run(ratio=0.96, lower_quartile_ratio=0.9, upper_quartile_ratio=1.1),
            "exact",
            f"{START}`fast` takes about as long as `exact` (ratio 0.96, no clear difference) and {MOVES}",
        ),
        (
            run(ratio=0.9999),
            "exact",
            f"{START}`fast` takes about as long as `exact` (ratio 1, no clear difference) and {MOVES}",
        ),
        (
            run("reference", 12.34, changed=0.0),
            "reference",
            f"{START}`reference` takes 12.3 times the processor time of `exact` and changes no noisy DN of the "
            "reference.",
        ),
        (run("reference", None), "reference", f"{START}`reference` was too slow to be timed and {MOVES}"),
        (run("exact"), "exact", "No tier other than `exact` was measured."),
    ],
)
def test_conclusion_is_true_for_any_result(measured: RunMeasurement, given: str, sentence: str) -> None:
    assert concluded(measured, given=given) == sentence


def test_conclusion_names_a_budget_that_is_no_tier() -> None:
    own = replace(TIERS[EXACT], normal_error=1e-3)
    tiers = {**TIERS, "exact_changed": own}
    sentence = conclude([run("exact_changed")], own, tiers, RunFiles(SourceConfig(), (1,), Path()))

    assert "`exact_changed` takes 0.9 of" in sentence


def test_documentation_has_the_recommendations() -> None:
    page = (Path(__file__).parents[2] / "docs/accuracy.md").read_text(encoding="utf-8")

    assert f"\n{tables.markdown_table(tables.recommendation_table())}\n" in page


def test_each_recommended_tier_exists() -> None:
    assert {each.tier for each in RECOMMENDATIONS} == set(TIERS)


# Errors ---------------------------------------------------------------------------------------------------------------


def test_error_is_taken_over_all_frames() -> None:
    reference = [np.array([[5, 5]], dtype=np.uint16), np.array([[9, 9]], dtype=np.uint16)]
    ours = [np.array([[5, 8]], dtype=np.uint16), np.array([[5, 9]], dtype=np.uint16)]

    assert method_errors.compare_frames(ours, reference, "DN") == (4, 2.5, "DN", 0.5)
    assert method_errors.compare_frames(ours, reference, "σ", [np.full((1, 2), 2.0)] * 2) == (2, 1.25, "σ", 0.5)


def test_cdf_difference_is_the_largest_over_all_frames() -> None:
    one, other = np.array([[1, 1, 2, 3]], dtype=np.uint16), np.array([[2, 2, 2, 3]], dtype=np.uint16)

    assert method_errors.cdf_difference([one, one], [one, other]) == 0.5


def test_gaussian_approximation_has_the_stated_cdf_difference(
    settings: Settings, profiles: BenchmarkProfiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = settings("noise=sony_a7s2", "scene=night", "source.limit=1")
    opened = session.open_session(config, profiles, LITTLE)
    plans = [plan for _, plan in opened.flat_plans(TIERS[REFERENCE])]
    counted = opened.flat_frames(TIERS[REFERENCE])
    monkeypatch.setattr(noise, "poisson", lambda words, rate: rate + np.sqrt(rate) * noise.normals(words))
    opened.clear()
    drawn = opened.flat_frames(TIERS[REFERENCE])

    for plan, one, other in zip(plans, drawn, counted, strict=True):
        physics = plan.physics
        rate_e = (plan.white_level_dn - plan.black_level_dn) / plan.exposure_ratio / physics.dn_per_e
        if rate_e >= 10:  # the formula is the first term of an expansion
            stated = gaussian_distance(rate_e, physics.read_std_dn / physics.dn_per_e)
            assert method_errors.cdf_difference([one], [other]) == pytest.approx(stated, rel=0.2, abs=0.9 / LITTLE.flat)


def test_normal_words_include_both_ends_of_every_segment() -> None:
    words, weights = method_errors.normal_words(positions=4)
    index = (words & 0x7FFFFFFF).astype(np.int64)

    assert weights.sum() == 2**31
    assert len(set(index.tolist())) == index.size
    assert {0, 1, 2**31 - 1, 2**30, 2**30 - 1, 2**30 + 2**25 - 1, 2**30 + 2**25} <= set(index.tolist())
    assert 0.4 < (words >> 31).mean() < 0.6


def test_exact_normals_are_quantiles(found: BenchmarkReport) -> None:
    words = np.array([0, 2**31 - 1, 2**31, 2**32 - 1], dtype=np.uint32)

    assert method_errors.exact_normals(words) == pytest.approx([6.337957, 2.918e-10, -6.337957, -2.918e-10], rel=1e-4)


@given(read_std_e=st.floats(0, 20), distance=st.sampled_from([0.0, 1e-3, 5e-3]))
def test_flat_fields_surround_the_limits_of_the_approximation(read_std_e: float, distance: float) -> None:
    rates = session.flat_rates(read_std_e, distance)

    assert rates == sorted(set(rates))
    assert 0.01 < rates[0] <= 1
    assert 1000 <= rates[-1] < session.MOST_FLAT_E


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise=sony_a7s2", "scene=night", "effects.prnu=on"),
        pytest.param(("noise=brooks2019", "sensor=generic_10bit", "gains.highlight=gray_mean"), marks=pytest.mark.slow),
        ("noise.law=poisson", "accuracy.name=mine", "accuracy.normal_error=1e-4"),
        pytest.param(("noise=none", "accuracy=fast", "source.dequantize=dither"), marks=pytest.mark.slow),
        ("noise.levels=[{a: 1, b: 2}, {a: 3, b: 4}]", "effects.heteroscedastic=on"),
    ],
    ids=lambda overrides: overrides[0],
)
def test_any_config_can_be_measured(
    overrides: tuple[str, ...], settings: Settings, profiles: BenchmarkProfiles, tmp_path: Path
) -> None:
    config = settings(*overrides)
    config.source.root = str(fill(tmp_path / "photos", 2))
    validate_config(config)
    found = measure.measure_accuracy(config, profiles, SMALLEST)

    assert all(row.error_max == 0 for row in found.rows if row.stage in TIER_STAGES and row.method == EXACT)
    assert ("mine" in {row.method for row in found.rows}) == ("accuracy.name=mine" in overrides)


def test_budget_that_is_no_tier_has_its_own_name(settings: Settings, profiles: BenchmarkProfiles) -> None:
    config = settings("accuracy.law_distance=1e-3")

    assert list(session.compared_tiers(config, profiles)) == [*TIERS, "exact_changed"]


def test_unreadable_photographs_are_ignored(settings: Settings, profiles: BenchmarkProfiles, tmp_path: Path) -> None:
    (fill(tmp_path, 2) / "000.png").write_bytes(b"")
    found = measure.measure_accuracy(
        settings(f"source.root={tmp_path}"), profiles, SampleSizes(2, 1, (8, 8), (8, 8), (8, 8), 4, 2)
    )

    assert found.conditions["photographs"].startswith("1 photographs")


def test_no_readable_photograph_is_an_error(settings: Settings, profiles: BenchmarkProfiles, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"none of 1 photographs tried can be read"):
        measure.measure_accuracy(settings(f"source.root={tmp_path}"), profiles, LITTLE)


# The report -----------------------------------------------------------------------------------------------------------


def test_csv_has_the_documented_columns(found: BenchmarkReport) -> None:
    lines = list(csv.DictReader(tables.csv_text(found.rows).splitlines()))

    assert list(lines[0]) == [
        *("stage", "method", "tier", "error_max", "error_rms", "error_unit", "changed_share"),
        *("ns_per_pixel", "ratio_to_reference", "noisy_changed_share", "noisy_max_dn", "noisy_rms_dn"),
        *("noisy_max_std", "noisy_rms_std"),
    ]
    assert len(lines) == len(found.rows)
    assert {line["stage"] for line in lines} == {*STAGES, *TIER_STAGES}


def test_csv_of_runs_has_the_documented_columns(found: BenchmarkReport) -> None:
    lines = list(csv.DictReader(tables.runs_csv_text(found.runs).splitlines()))

    assert list(lines[0]) == [
        *("setting", "noise", "tier", "ns_per_pixel", "ratio_to_exact", "lower_quartile_ratio", "upper_quartile_ratio"),
        *("decode_share", "simulate_share", "write_share", "noisy_changed_share", "noisy_max_dn", "noisy_rms_dn"),
        *("noisy_max_std", "noisy_rms_std"),
    ]
    assert len(lines) == len(found.runs)


def test_markdown_tables_have_equal_cells(found: BenchmarkReport) -> None:
    for table in (tables.method_table(found.rows), tables.run_table(found.runs), tables.recommendation_table()):
        lines = tables.markdown_table(table).splitlines()
        assert {line.count("|") for line in lines} == {len(table.headings) + 1}


@pytest.mark.parametrize(
    ("points", "front"),
    [
        ([], []),
        ([(1, 1)], [0]),
        ([(1, 9), (2, 5), (3, 7), (4, 0)], [0, 1, 3]),
        ([(1, 0), (2, 0)], [0]),
        ([(1, 0), (1, 0)], [0, 1]),
        ([(2, 1), (1, 2), (2, 2)], [0, 1]),
    ],
)
def test_front_contains_points_that_no_other_dominates(points: list[tuple[float, float]], front: list[int]) -> None:
    assert figure.pareto_front(points) == front


def test_figure_has_the_size_of_a_page(found: BenchmarkReport) -> None:
    content = figure.benchmark_figure(found.rows, found.runs)
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)

    assert 700 <= picture.shape[0] <= 1200
    assert 800 <= picture.shape[1] <= 1200
    assert len(content) < 200_000
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_figure_can_be_drawn_for_any_errors_and_times() -> None:
    rows = [
        Measurement(stage, name, tier, error, error, "DN", 0.0, ns, 1.0)
        for stage in (*STAGES, *TIER_STAGES)
        for name, tier, error, ns in (("a", "fast", 1e-3, 0.01), ("b", "mine", 2.0, 4000.0), ("c", "", None, None))
    ]
    runs = [run("fast", ratio) for ratio in (1e-3, 1.0, 400.0, None)]

    assert figure.benchmark_figure(rows, runs)[:4] == figure.benchmark_figure(rows)[:4] == b"\x89PNG"


def test_page_has_no_script_and_escapes_names() -> None:
    name = "<script>alert('&\")</script>"
    page = report.benchmark_page(
        BenchmarkReport(
            (Measurement(name, name, name, 1.0, 1.0, name, 0.5, 1.0, 1.0),), (run(name),), name, {name: name}
        ),
        b"png",
    )

    assert "<script" not in page
    assert "&lt;script&gt;alert(&#39;&amp;&#34;)" in page
    assert 'src="data:image/png;base64,cG5n"' in page
    assert not re.search(r"(href|src)=\"(?!data:)", page)


def test_page_lists_the_conditions(found: BenchmarkReport) -> None:
    page = report.benchmark_page(found, b"")

    for fact in ("gen-dataset accuracy", "numpy ", "dead_leaves-0", "imx385_iso3200", "sony_a7s2", "low_light"):
        assert fact in page
    assert all(row.method in page for row in found.rows)


def test_lines_of_the_text_table_are_aligned(found: BenchmarkReport) -> None:
    lines = tables.text_table(tables.method_table(found.rows)).splitlines()

    assert len(lines) == len(found.rows) + 1
    assert len({line.index(name) for line in lines for name in ("method", "exact_table") if name in line}) == 1


@pytest.mark.parametrize(
    ("value", "expected"), [(None, "–"), (0.0, "0"), (1.234e-7, "1.2e-07"), (293.4, "290"), (5.33, "5.3")]
)
def test_short_numbers_have_few_digits(value: float | None, expected: str) -> None:
    assert formatting.short_number(value) == expected


# The verb accuracy ----------------------------------------------------------------------------------------------------


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the verb measure little."""
    little = SMALLEST
    true = measure.measure_accuracy
    monkeypatch.setattr(
        measure, "measure_accuracy", lambda config, profiles, command: true(config, profiles, little, command)
    )


@pytest.mark.usefixtures("quick")
def test_accuracy_writes_three_files_and_reports_them(run_main: RunMain, tmp_path: Path) -> None:
    written = tmp_path / "new/report"
    written.mkdir(parents=True)
    for name in report.FILES:
        (written / name).write_text("an earlier report")
    done = run_main("accuracy", f"source.root={fill(tmp_path / 'photos', 2)}", "out=new/report")

    assert done.code == 0
    assert sorted(path.name for path in written.iterdir()) == sorted(report.FILES)
    assert all(b"earlier" not in path.read_bytes() for path in written.iterdir())
    assert re.search(r"^tier_electrons +fast ", done.out, re.MULTILINE)
    assert re.search(r"^night .* fast ", done.out, re.MULTILINE)
    printed = " ".join(done.out.split())
    assert printed.count("In a complete run of 1 photograph (0.0 megapixels, noise=imx385_iso3200), `fast` ") == 1
    assert all(f"{each.use}: {each.tier}; {each.reason}" in printed for each in RECOMMENDATIONS)
    assert "measurements" in done.err
    assert "image" not in done.err  # of the runs that are measured
    assert "gen-dataset accuracy source.root=" in (tmp_path / "new/report/accuracy.html").read_text()


@pytest.mark.parametrize("name", report_files.DATASET_ENTRIES)
def test_dataset_folder_is_refused(run_main: RunMain, tmp_path: Path, name: str) -> None:
    (tmp_path / "ds").mkdir()
    (tmp_path / "ds" / name).mkdir()
    done = run_main("accuracy", "out=ds")

    assert done.code == 2
    assert done.err == (
        f"gen-dataset: out=ds: contains a dataset ({name}); expected a folder without one; choose another out\n"
    )


def test_existing_file_is_refused(run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = run_main("accuracy", "out=file")

    assert (done.code, done.err) == (
        2,
        "gen-dataset: out=file: is a file; expected a folder\n",
    )


def test_missing_library_is_reported_before_measuring(
    run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report_files, "find_spec", lambda name: None)
    done = run_main("accuracy", "out=new")

    assert done.code == 2
    assert (
        done.err
        == "gen-dataset: accuracy: drawing needs matplotlib; in the source folder, run: pip install '.[figures]'\n"
    )
    assert not (tmp_path / "new").exists()


# Times in a plan ------------------------------------------------------------------------------------------------------


def test_plan_compares_the_time_with_the_tiers(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 2)}")
    line = next(
        line
        for line in format_estimate(config, estimate_run(config, 1, True, TIERS)).splitlines()
        if "accuracy" in line
    )

    assert re.fullmatch(
        r"accuracy  exact: clean 0 DN, normals within 1e-06 σ, exact shot noise; [\d.e+]+ ns per pixel here "
        r"\(reference [\d.e+]+, fast [\d.e+]+\)",
        line,
    )


def test_plan_describes_a_loose_budget(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", "accuracy=fast")

    assert (
        "accuracy  fast: clean within 1 DN, a fraction of 0.001 changed, normals within 0.001 σ, "
        "shot noise within 0.005 (CDF); " in format_estimate(config, estimate_run(config, 1, True))
    )


def test_plan_without_readable_sources_has_no_time(settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"")
    config = settings(f"source.root={tmp_path}")

    assert "exact shot noise;" not in format_estimate(config, estimate_run(config, 1, True, TIERS))
