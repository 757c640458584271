"""The benchmark of accuracy: a row for every method, errors within the stated limits, and a complete report."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings, TreeHash
from helpers.photographs import fill
from helpers.promise_report import Figure

from unprocess_gen.config.accuracy import METHODS, STAGES, Method, choose_methods
from unprocess_gen.config.schema import AccuracyConfig, Config
from unprocess_gen.config.serialization import read_tiers
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.reports import report_files
from unprocess_gen.reports.benchmark import complete_runs, figure, measure, methods, report, session
from unprocess_gen.reports.benchmark.complete_runs import RunFiles, RunMeasurement, RunTimes
from unprocess_gen.reports.benchmark.measure import TIER_STAGES, BenchmarkReport, Measurement
from unprocess_gen.reports.benchmark.session import EXACT, REFERENCE, SampleSizes
from unprocess_gen.reports.benchmark.timing import measure_in_turns
from unprocess_gen.reports.estimate import estimate_run
from unprocess_gen.reports.plan_text import format_estimate
from unprocess_gen.simulation.effects.heteroscedastic import noise_variance
from unprocess_gen.sources.loader import list_photographs, load_source

LITTLE = SampleSizes(photographs=3, rounds=2, sampled=(64, 96), readable=(24, 32), compiled=(48, 64), run_files=2)
SMALLEST = SampleSizes(2, 1, (16, 16), (8, 8), (8, 8), run_files=1)


TIERS = read_tiers()


@pytest.fixture(scope="session")
def measured(settings: Settings) -> BenchmarkReport:
    config = settings("scene=low_light", "source.downscale=2")
    return measure.measure_accuracy(config, LITTLE, "gen-dataset accuracy")


def rows_of(measured: BenchmarkReport, stage: str) -> dict[str, Measurement]:
    return {row.method: row for row in measured.rows if row.stage == stage}


# Methods and tiers ----------------------------------------------------------------------------------------------------


def test_measurements_take_turns() -> None:
    called: list[tuple[str, int]] = []
    calls = {name: lambda number, name=name: called.append((name, number)) for name in "ab"}

    assert measure_in_turns(calls, 3) == {"a": [None] * 3, "b": [None] * 3}
    assert called == [("a", 0), ("b", 0), ("b", 1), ("a", 1), ("a", 2), ("b", 2)]


def test_every_method_and_tier_has_one_row_with_its_tiers(measured: BenchmarkReport) -> None:
    expected = [(method.stage, method.name) for method in METHODS]
    expected += [(stage, tier) for stage in TIER_STAGES for tier in TIERS]

    assert [(row.stage, row.method) for row in measured.rows] == expected
    curve = rows_of(measured, "curve")
    assert curve["exact_table"].tier.split() == [EXACT, "fast"]  # fast: for physical noise
    assert curve["float32_table"].tier == rows_of(measured, "tier")["fast"].tier == "fast"
    assert curve["numpy_table"].tier == REFERENCE


def test_only_fused_readout_has_no_time(measured: BenchmarkReport) -> None:
    without = {
        f"{row.stage}:{row.method}" for row in measured.rows if not (row.ns_per_pixel and row.ratio_to_reference)
    }

    assert without == {"quantise:fused_float32", "quantise:fused_float64"}


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.spelled)
def test_budget_for_a_method_chooses_it_and_changes_no_other(method: Method) -> None:
    budget = session.budget_for(method, TIERS)
    exact = set(choose_methods(TIERS[EXACT], counts_electrons=True))

    assert method.spelled in session.chosen_methods(budget)
    if method.implementation == "float64":
        assert len(set(choose_methods(budget, counts_electrons=True)) - exact) <= 1


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.spelled)
def test_measured_errors_are_within_the_stated_limits(
    measured: BenchmarkReport, method: Method, figure: Figure
) -> None:
    row = rows_of(measured, method.stage)[method.name]
    assert row.error_max is not None
    if method.stage == "normal":
        assert 0 < row.error_max <= method.normal_error
    else:
        changed_by_chance = 5 * math.sqrt(method.clean_changed_share / (3 * math.prod(LITTLE.sampled)))
        assert row.error_max <= method.clean_dn
        assert (row.changed_share or 0) <= method.clean_changed_share + changed_by_chance
    figure("tiers", f"{method.stage}: error {row.error_max:.2g} {row.error_unit}")


def test_exact_and_reference_have_no_errors(measured: BenchmarkReport) -> None:
    for stage in TIER_STAGES:
        exact, reference = (rows_of(measured, stage)[name] for name in (EXACT, REFERENCE))
        assert (exact.error_max, exact.error_rms, exact.changed_share) == (0, 0, 0)
        assert reference.ratio_to_reference == 1
    for run in measured.runs:
        errors = (run.noisy_changed_share, run.noisy_max_dn, run.noisy_rms_dn, run.noisy_max_std, run.noisy_rms_std)
        is_exact = run.tier != "fast" or run.setting != "given"  # Poisson counts have no method in float32
        assert (errors == (0, 0, 0, 0, 0)) == is_exact


def test_errors_of_a_tier_are_those_of_its_frames(settings: Settings) -> None:
    opened = session.open_session(settings("source.limit=1"), LITTLE)
    ((pair, plan),) = opened.sampled_pairs("given", TIERS["fast"])
    ((reference, _),) = opened.sampled_pairs("given", TIERS[REFERENCE])
    errors = methods.frame_errors(opened, "given", TIERS["fast"])
    noisy = pair.noisy.astype(float) - reference.noisy
    std = np.sqrt(noise_variance(reference.clean.astype(float), plan) + 1 / 12)

    for error, difference in (
        (errors.clean_dn, pair.clean.astype(float) - reference.clean),
        (errors.noisy_dn, noisy),
        (errors.noisy_std, noisy / std),
    ):
        assert (error.max, error.changed_share) == (np.abs(difference).max(), np.mean(difference != 0))
        assert error.rms == pytest.approx(np.sqrt(np.mean(difference**2)), rel=1e-12)
    assert errors.noisy_dn.max > 0


def test_exact_normals_are_quantiles_at_dense_words() -> None:
    words = np.array([0, 2**31 - 1, 2**31, 2**32 - 1], dtype=np.uint32)
    dense, weights = methods.normal_words()

    assert methods.exact_normals(words) == pytest.approx([6.337957, 2.918e-10, -6.337957, -2.918e-10], rel=1e-4)
    assert (weights.sum(), *np.unique(dense & 0x7FFFFFFF)[[0, -1]]) == (2**31, 0, 2**31 - 1)


# Complete runs --------------------------------------------------------------------------------------------------------


def test_every_tier_runs_in_every_setting(measured: BenchmarkReport) -> None:
    noises = {"given": "imx385_iso3200", "daylight": "sony_a7s2, ISO 100", "night": "sony_a7s2, ISO 6400"}
    expected = [(setting, text, tier) for setting, text in noises.items() for tier in TIERS]

    assert [(run.setting, run.noise, run.tier) for run in measured.runs] == expected
    exact = {run.setting: run for run in measured.runs if run.tier == EXACT}
    for run in measured.runs:
        shares = (run.decode_share or 0, run.simulate_share or 0, run.write_share or 0)
        assert min(shares) > 0
        assert sum(shares) == pytest.approx(1, abs=1e-12)
        assert run.ratio_to_exact == pytest.approx((run.ns_per_pixel or 0) / (exact[run.setting].ns_per_pixel or 0))


def test_settings_of_runs_include_both_kinds_of_noise(settings: Settings) -> None:
    for overrides, names in (
        ((), ["given", "daylight", "night"]),
        (("noise=sony_a7s2", "scene=low_light"), ["given", "two_parameter_noise", "daylight", "night"]),
        (("noise=sony_a7s2", "scene=night", "effects.assumed=off"), ["given", "two_parameter_noise", "daylight"]),
    ):
        config = settings(*overrides, "effects.tolerance=0.2")
        configs = session.run_settings(config)
        assert list(configs) == names
        assert {(run.effects.assumed, run.effects.tolerance) for run in configs.values()} == {
            (config.effects.assumed, 0.2)
        }


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

    def generate(config: Config) -> Any:
        summary = true(config)
        made.append(tree_hash(Path(config.out)))
        return summary

    monkeypatch.setattr(complete_runs, "generate", generate)
    config = settings(f"source.root={photos}", "noise.levels=2")
    with complete_runs.run_files(config, LITTLE) as files:
        for tier in TIERS.values():
            assert min(complete_runs.time_run(config, files, tier)) > 0
    expected = [
        make(photos, folder.parent / tier, f"accuracy={tier}", "noise.levels=2", f"source.limit={files.source.limit}")
        for tier in TIERS
    ]

    assert files.count == 2
    assert made == [tree_hash(summary.out) for summary in expected]
    assert list(folder.iterdir()) == []


def test_ended_measurement_leaves_nothing(folder: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    level = complete_runs.LOGGER.level

    def generate(config: Config) -> Any:
        Path(config.out).mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(complete_runs, "generate", generate)
    with pytest.raises(KeyboardInterrupt):
        measure.measure_accuracy(settings(), SMALLEST)

    assert list(folder.iterdir()) == []
    assert complete_runs.LOGGER.level == level


def test_temporary_folder_without_space_is_reported(folder: Path, settings: Settings) -> None:
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


def test_runs_with_too_many_frames_have_one_level(settings: Settings) -> None:
    config = settings("noise.levels=5", "noise.draws=2")
    files = RunFiles(config.source, (1000,), Path())

    assert complete_runs.affordable(config, files, replace(LITTLE, run_pixels=5000)) == config
    single = complete_runs.affordable(config, files, replace(LITTLE, run_pixels=4999))
    assert (single.noise.levels, single.noise.draws) == (None, 1)


@pytest.mark.parametrize(
    ("megapixels", "levels", "limits"), [((4, 2, 1), 1, [2]), ((4, 2), 3, [1]), ((24, 1), 1, [1]), ((25,), 1, [])]
)
def test_reference_runs_once_on_few_photographs(
    megapixels: tuple[int, ...], levels: int, limits: list[int], settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[str, int]] = []

    def time_run(config: Config, files: RunFiles, tier: AccuracyConfig) -> RunTimes:
        ran.append((tier.name, files.source.limit or 0))
        return RunTimes(1.0, 2.0, 3.0)

    monkeypatch.setattr(complete_runs, "time_run", time_run)
    config = settings(f"noise.levels={levels}")
    files = RunFiles(config.source, tuple(number * 1_000_000 for number in megapixels), Path()).at_most(10**9)
    times = complete_runs.measure_runs({"given": config}, TIERS, files, 3, lambda: None)

    assert [limit for name, limit in ran if name == REFERENCE] == limits
    assert [limit for name, limit in ran if name != REFERENCE] == [1] * 2 + [len(megapixels)] * 6
    assert len(times["given", REFERENCE]) == len(limits)


def test_cost_of_runs_is_the_shortest_of_each_stage() -> None:
    slow, fast, exact = RunTimes(1.0, 4.0, 4.0), RunTimes(2.0, 2.0, 1.0), RunTimes(1.0, 6.0, 1.0)

    assert complete_runs.run_cost([slow, fast], [exact, exact]) == (4, 0.5, 0.75, 1.0, 0.25, 0.5, 0.25)


# The conclusion -------------------------------------------------------------------------------------------------------


def run(tier: str = "fast", ratio: float | None = 0.9, changed: float = 0.02, **changes: Any) -> RunMeasurement:
    """Return a row of complete runs with the given settings."""
    values: dict[str, Any] = dict.fromkeys((field.name for field in fields(RunMeasurement)), ratio)
    errors = {"noisy_max_dn": 2.0, "noisy_rms_dn": 0.1, "noisy_max_std": 0.3, "noisy_rms_std": 0.004}
    named = {"setting": "given", "noise": "imx385_iso3200", "tier": tier, "noisy_changed_share": changed}
    return RunMeasurement(**{**values, **named, **errors, **changes})


def concluded(measured: RunMeasurement, given: str) -> str:
    return report.conclude(BenchmarkReport((), (measured,), given, "2 photographs (5.2 megapixels)", {}))


START = "In a complete run of 2 photographs (5.2 megapixels) with noise=imx385_iso3200, the tier "
MOVES = (
    "moves 2 % of the noisy DN, by at most 2 DN or 0.3 standard deviations of the noise (RMS 0.1 DN, 0.004 standard "
    "deviations)."
)
NO_DIFFERENCE = {"lower_quartile_ratio": 0.9, "upper_quartile_ratio": 1.1}


@pytest.mark.parametrize(
    ("measured", "given", "sentence"),
    [
        (run(), "exact", f"fast takes 0.9 of the processor time of exact and {MOVES}"),
        (run(), "fast", f"fast takes 0.9 of the processor time of exact and {MOVES}"),
        (run("mine", 1.25), "mine", f"mine takes 1.25 times the processor time of exact and {MOVES}"),
        (
            run(ratio=0.96, **NO_DIFFERENCE),
            "exact",
            f"fast takes about as long as exact (ratio 0.96, no clear difference) and {MOVES}",
        ),
        (
            run("reference", 12.34, changed=0.0),
            "reference",
            "reference takes 12.3 times the processor time of exact and changes no noisy DN of the reference.",
        ),
        (run("reference", None), "reference", f"reference was too slow to be timed and {MOVES}"),
    ],
)
def test_conclusion_is_true_for_any_result(measured: RunMeasurement, given: str, sentence: str) -> None:
    assert concluded(measured, given) == START + sentence


def test_documentation_has_the_recommendations() -> None:
    page = (Path(__file__).parents[2] / "docs/accuracy.md").read_text(encoding="utf-8")
    lines = [f"| {' | '.join(line)} |" for line in report.RECOMMENDATIONS.lines]

    assert "\n".join(lines) in page
    assert {tier for _, tier, _ in report.RECOMMENDATIONS.lines} == set(TIERS)


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise=sony_a7s2", "scene=night", "effects.prnu=on"),
        pytest.param(("noise=brooks2019", "sensor=generic_10bit", "gains.highlight=gray_mean"), marks=pytest.mark.slow),
        pytest.param(("noise.law=poisson", "accuracy.name=mine", "accuracy.normal_error=1e-4"), marks=pytest.mark.slow),
        pytest.param(("noise=none", "accuracy=fast", "source.dequantize=dither"), marks=pytest.mark.slow),
        ("noise.levels=[{a: 1, b: 2}, {a: 3, b: 4}]", "effects.heteroscedastic=on"),
    ],
    ids=lambda overrides: overrides[0],
)
def test_any_config_can_be_measured(overrides: tuple[str, ...], settings: Settings, tmp_path: Path) -> None:
    root = fill(tmp_path / "photos", 2)
    (root / "000.png").write_bytes(b"")  # is ignored
    config = settings(*overrides, f"source.root={root}")
    validate_config(config)
    measured = measure.measure_accuracy(config, SMALLEST)

    assert all(rows_of(measured, stage)[EXACT].error_max == 0 for stage in TIER_STAGES)
    assert ("mine" in rows_of(measured, "tier")) == ("accuracy.name=mine" in overrides)
    assert measured.conditions["photographs"].startswith("001.png, of ")


def test_budget_that_is_no_tier_has_its_own_name(settings: Settings) -> None:
    opened = session.open_session(settings("accuracy.normal_error=1e-4"), SMALLEST)

    assert list(opened.tiers) == [*TIERS, "exact_changed"]
    assert opened.given_tier == "exact_changed"


def test_no_readable_photograph_is_an_error(settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"none of 1 photographs tried can be read"):
        measure.measure_accuracy(settings(f"source.root={tmp_path}"), LITTLE)


# The report -----------------------------------------------------------------------------------------------------------

COLUMNS = {
    Measurement: "stage method tier error_max error_rms error_unit changed_share ns_per_pixel ratio_to_reference",
    RunMeasurement: "setting noise tier ns_per_pixel ratio_to_exact lower_quartile_ratio upper_quartile_ratio "
    "decode_share simulate_share write_share",
}
NOISY_COLUMNS = "noisy_changed_share noisy_max_dn noisy_rms_dn noisy_max_std noisy_rms_std"


@pytest.mark.parametrize("kind", COLUMNS)
def test_csv_files_have_the_documented_columns(kind: type, measured: BenchmarkReport) -> None:
    columns = f"{COLUMNS[kind]} {NOISY_COLUMNS}".split()
    rows = measured.rows if kind is Measurement else measured.runs
    lines = list(csv.DictReader(report.csv_text(kind, rows).splitlines()))

    assert list(lines[0]) == columns
    assert [line[columns[0]] for line in lines] == [getattr(row, columns[0]) for row in rows]


def test_front_contains_points_that_no_other_dominates() -> None:
    assert figure.pareto_front([(1, 9), (2, 5), (3, 7), (4, 0), (4, 0), (5, 0)]) == [0, 1, 3, 4]


def test_figure_can_be_drawn_for_any_errors_and_times() -> None:
    rows = [
        Measurement(stage, name, tier, error, error, "DN", 0.0, ns, 1.0)
        for stage in (*STAGES, *TIER_STAGES)
        for name, tier, error, ns in (("a", "fast", 1e-3, 0.01), ("b", "mine", 2.0, 4000.0), ("c", "", None, None))
    ]
    runs = [run("fast", ratio) for ratio in (1e-3, 1.0, 400.0, None)]

    picture = cv2.imdecode(np.frombuffer(figure.benchmark_figure(rows, runs), np.uint8), cv2.IMREAD_COLOR)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert figure.benchmark_figure([])[:4] == b"\x89PNG"


def test_page_has_every_row_and_condition_and_no_markup(measured: BenchmarkReport) -> None:
    name = "<script>alert('&\")</script>"
    page = report.benchmark_page(replace(measured, conditions={**measured.conditions, name: name}), b"png")

    for fact in ("gen-dataset accuracy", "numpy ", "dead_leaves-0", "imx385_iso3200", "sony_a7s2", "low_light"):
        assert fact in page
    assert all(row.method in page for row in measured.rows)
    assert "`" not in page
    assert "<script" not in page
    assert "&lt;script&gt;alert(&#39;&amp;&#34;)" in page
    assert 'src="data:image/png;base64,cG5n"' in page
    assert not re.search(r"(href|src)=\"(?!data:)", page)


# The verb accuracy ----------------------------------------------------------------------------------------------------


def test_accuracy_writes_four_files_and_reports_them(
    run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = measure.measure_accuracy
    monkeypatch.setattr(measure, "measure_accuracy", lambda config, command: true(config, SMALLEST, command))
    written = tmp_path / "new/report"
    written.mkdir(parents=True)
    for name in report.REPORT_FILES:
        (written / name).write_text("an earlier report")
    done = run_main("accuracy", f"source.root={fill(tmp_path / 'photos', 2)}", "out=new/report")

    assert done.code == 0
    assert sorted(path.name for path in written.iterdir()) == sorted(report.REPORT_FILES)
    assert all(b"earlier" not in path.read_bytes() for path in written.iterdir())
    assert re.search(r"^tier_electrons +fast ", done.out, re.MULTILINE)
    assert re.search(r"^night .* fast ", done.out, re.MULTILINE)
    printed = " ".join(done.out.split())
    assert printed.count("In a complete run of 1 photograph (0.0 megapixels) with noise=imx385_iso3200") == 1
    assert all(f"{use}: {tier}; {reason}" in printed for use, tier, reason in report.RECOMMENDATIONS.lines)
    assert "measurements" in done.err
    assert "image" not in done.err  # of the runs that are measured
    assert "gen-dataset accuracy source.root=" in (tmp_path / "new/report/accuracy.html").read_text()


@pytest.mark.parametrize("name", [*report_files.DATASET_ENTRIES, None])
def test_dataset_folder_and_file_are_refused(run_main: RunMain, tmp_path: Path, name: str | None) -> None:
    if name is None:
        (tmp_path / "ds").write_text("")
        problem = "is a file; expected a folder"
    else:
        (tmp_path / "ds" / name).mkdir(parents=True)
        problem = f"contains a dataset ({name}); expected a folder without one; choose another out"
    done = run_main("accuracy", "out=ds")

    assert (done.code, done.err) == (2, f"gen-dataset: out=ds: {problem}\n")


# Times in a plan ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tier", "budget"),
    [
        ("exact", "clean within 0 DN (0 % changed), normals within 1e-06 σ"),
        ("fast", "clean within 1 DN (0.1 % changed), normals within 0.001 σ"),
    ],
)
def test_plan_compares_the_time_with_the_tiers(tier: str, budget: str, settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 2)}", f"accuracy={tier}")
    text = format_estimate(estimate_run(config, 1, True, TIERS))

    assert f"\naccuracy  {tier}: {budget}, shot noise within 0 (CDF); " in text
    other = {"exact": "fast", "fast": "exact"}[tier]
    assert re.search(rf"; [\d.e+]+ ns per pixel here \({other} [\d.e+]+\)\n", text)
