"""What accuracy costs: every method has its row, errors are within what is stated, and the report can be read."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import Door, fill
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.accuracy import METHODS, STAGES, choose_methods
from unprocess_gen.config.interpretation import accuracy_budget
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import AccuracyConfig, Config, NoiseConfig, SensorConfig
from unprocess_gen.config.serialization import read_option
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.reports import formatting, report_files
from unprocess_gen.reports.benchmark import measure as accuracy
from unprocess_gen.reports.benchmark import report
from unprocess_gen.reports.benchmark.measure import (
    BENCHMARKS_BY_NAME,
    EXACT,
    METHOD_BENCHMARKS,
    REFERENCE,
    TIER_STAGES,
    BenchmarkProfiles,
    BenchmarkReport,
    Measurement,
    SampleSizes,
)
from unprocess_gen.reports.estimate import estimate_run, format_estimate
from unprocess_gen.simulation.reference import noise as effects
from unprocess_gen.simulation.reference.poisson import gaussian_distance

Settings = Callable[..., Config]

LITTLE = SampleSizes(
    photographs=3, rounds=2, sampled=(64, 96), readable=(24, 32), compiled=(48, 64), flat=128, positions=16
)
TIERS = {
    name: read_option(conf_dir() / "accuracy" / f"{name}.yaml", AccuracyConfig) for name in (REFERENCE, EXACT, "fast")
}


def option(group: str, name: str, schema: type) -> Any:
    return read_option(conf_dir() / group / f"{name}.yaml", schema)


@pytest.fixture(scope="session")
def beside() -> BenchmarkProfiles:
    two_numbers, electrons = (option("noise", name, NoiseConfig) for name in ("imx385_iso3200", "sony_a7s2"))
    return BenchmarkProfiles(TIERS, two_numbers, electrons, option("sensor", "generic_14bit", SensorConfig))


@pytest.fixture(scope="session")
def found(settings: Settings, beside: BenchmarkProfiles) -> BenchmarkReport:
    return accuracy.measure_accuracy(settings("scene=low_light"), beside, LITTLE, "gen-dataset accuracy")


def rows_of(found: BenchmarkReport, *stages: str) -> dict[str, Measurement]:
    return {f"{row.stage}:{row.method}": row for row in found.rows if row.stage in stages}


# What is measured -----------------------------------------------------------------------------------------------------


def test_every_method_has_its_measurement() -> None:
    assert [one.spelled for one in METHOD_BENCHMARKS] == [method.spelled for method in METHODS]


def test_every_method_and_tier_has_one_row(found: BenchmarkReport) -> None:
    expected = [(method.stage, method.name) for method in METHODS]
    expected += [(stage, tier) for stage in TIER_STAGES for tier in TIERS]

    assert [(row.stage, row.method) for row in found.rows] == expected


def test_errors_and_times_are_there_where_they_can_be_measured(found: BenchmarkReport) -> None:
    for row in found.rows:
        measured = BENCHMARKS_BY_NAME.get(f"{row.stage}:{row.method}")
        assert (row.error_max is None) == (measured is not None and measured.error is None)
        assert (row.ns_per_pixel is None) == (measured is not None and measured.ns is None)
        assert (row.ns_per_pixel is None) == (row.ratio_to_reference is None)
        assert row.ns_per_pixel is None or row.ns_per_pixel > 0


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.spelled)
def test_a_method_is_measured_under_a_budget_that_takes_it(method: Any) -> None:
    assert method.spelled in accuracy.taken(accuracy_budget(accuracy.alone(method, TIERS)))


def test_a_method_is_measured_with_no_other_form_than_its_own() -> None:
    exact = set(choose_methods(accuracy_budget(TIERS[EXACT]), counts_electrons=True))
    for method in METHODS:
        if method.implementation == "float64":
            chosen = set(choose_methods(accuracy_budget(accuracy.alone(method, TIERS)), counts_electrons=True))
            assert len(chosen - exact) <= 1


def test_the_tiers_of_a_method_are_those_that_take_it(found: BenchmarkReport) -> None:
    assert rows_of(found, "curve")["curve:exact_table"].tier.split() == [EXACT, "fast"]  # fast: where electrons count
    assert rows_of(found, "curve")["curve:float32_table"].tier.split() == ["fast"]
    assert rows_of(found, "curve")["curve:numpy_table"].tier.split() == [REFERENCE]
    assert rows_of(found, "tier")["tier:fast"].tier == "fast"


def test_the_reference_is_its_own_measure(found: BenchmarkReport) -> None:
    for row in found.rows:
        if row.method == REFERENCE or (row.stage not in TIER_STAGES and row.tier == REFERENCE):
            assert row.ratio_to_reference == 1
            assert row.stage == "normal" or (row.error_max, row.error_rms) == (0, 0)


# What is stated holds -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.spelled)
def test_measured_errors_are_within_what_the_method_states(found: BenchmarkReport, method: Any) -> None:
    row = rows_of(found, method.stage)[method.spelled]
    if row.error_max is None:
        pytest.skip("cannot be called by itself yet")
    if method.stage == "normal":
        assert 0 < row.error_max <= method.normal_error
    elif method.stage == "shot":
        by_chance = 0.9 / LITTLE.flat  # what common uniforms leave: one site in twenty on either side, four deviations
        assert row.error_max <= (TIERS["fast"].law_distance + by_chance if method.approximates_law else 0)
    else:
        changed_by_chance = 5 * math.sqrt(method.clean_changed_share / (3 * math.prod(LITTLE.sampled)))
        assert row.error_max <= method.clean_dn
        assert (row.changed_share or 0) <= method.clean_changed_share + changed_by_chance


@pytest.mark.parametrize("stage", TIER_STAGES)
def test_the_exact_tier_differs_in_no_dn(found: BenchmarkReport, stage: str) -> None:
    row = rows_of(found, stage)[f"{stage}:exact"]

    assert (row.error_max, row.error_rms, row.changed_share) == (0, 0, 0)


# How errors are taken -------------------------------------------------------------------------------------------------


def test_an_error_is_the_largest_the_rms_and_the_share_of_all_frames_together() -> None:
    reference = [np.array([[5, 5]], dtype=np.uint16), np.array([[9, 9]], dtype=np.uint16)]
    ours = [np.array([[5, 8]], dtype=np.uint16), np.array([[5, 9]], dtype=np.uint16)]

    assert accuracy.compare(ours, reference, "DN") == (4, 2.5, "DN", 0.5)
    assert accuracy.compare(ours, reference, "σ", [np.full((1, 2), 2.0)] * 2) == (2, 1.25, "σ", 0.5)


def test_the_distance_of_laws_is_the_largest_difference_of_their_distribution_functions() -> None:
    one, other = np.array([[1, 1, 2, 3]], dtype=np.uint16), np.array([[2, 2, 2, 3]], dtype=np.uint16)

    assert accuracy.law_distance([one, one], [one, other]) == 0.5


def test_normals_in_place_of_counts_are_as_far_from_the_law_as_the_formula_says(
    settings: Settings, beside: BenchmarkProfiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = settings("noise=sony_a7s2", "scene=night", "source.limit=1")
    lab = accuracy.BenchmarkSession(
        accuracy._settings(config, beside), TIERS, accuracy._subjects(config, LITTLE), LITTLE
    )
    plans = [plan for _, plan in accuracy._flat_plans(lab, TIERS[REFERENCE])]
    counted = lab.flats(TIERS[REFERENCE])
    near = effects.READABLE_DRAWS._replace(poisson=lambda words, rate: rate + np.sqrt(rate) * effects.normals(words))
    monkeypatch.setattr(effects, "READABLE_DRAWS", near)
    lab._flats.clear()
    drawn = lab.flats(TIERS[REFERENCE])

    for plan, one, other in zip(plans, drawn, counted, strict=True):
        physics = plan.physics
        rate_e = (plan.white_level_dn - plan.black_level_dn) / plan.exposure_ratio / physics.dn_per_e
        if rate_e >= 10:  # the formula is the first term of an expansion
            stated = gaussian_distance(rate_e, physics.read_std_dn / physics.dn_per_e)
            assert accuracy.law_distance([one], [other]) == pytest.approx(stated, rel=0.2, abs=0.9 / LITTLE.flat)


def test_the_words_of_normals_reach_every_segment_and_both_ends_of_each() -> None:
    words, weights = accuracy.normal_words(positions=4)
    index = (words & 0x7FFFFFFF).astype(np.int64)

    assert weights.sum() == 2**31
    assert len(set(index.tolist())) == index.size
    assert {0, 1, 2**31 - 1, 2**30, 2**30 - 1, 2**30 + 2**25 - 1, 2**30 + 2**25} <= set(index.tolist())
    assert 0.4 < (words >> 31).mean() < 0.6


def test_the_true_normals_are_the_quantiles(found: BenchmarkReport) -> None:
    words = np.array([0, 2**31 - 1, 2**31, 2**32 - 1], dtype=np.uint32)

    assert accuracy.true_normals(words) == pytest.approx([6.337957, 2.918e-10, -6.337957, -2.918e-10], rel=1e-4)


@given(read_std_e=st.floats(0, 20), distance=st.sampled_from([0.0, 1e-3, 5e-3]))
def test_flat_fields_have_means_on_both_sides_of_where_a_normal_is_near_enough(
    read_std_e: float, distance: float
) -> None:
    rates = accuracy.flat_rates(read_std_e, distance)

    assert rates == sorted(set(rates))
    assert 0.01 < rates[0] <= 1
    assert 1000 <= rates[-1] < accuracy.MOST_FLAT_E


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise=sony_a7s2", "scene=night", "effects.prnu=on"),
        ("noise=brooks2019", "sensor=generic_10bit", "gains.highlight=gray_mean"),
        ("noise.law=poisson", "accuracy.name=mine", "accuracy.normal_error=1e-4"),
        ("noise=none", "accuracy=fast", "source.dequantize=dither"),
        ("noise.levels=[{a: 1, b: 2}, {a: 3, b: 4}]", "effects.heteroscedastic=on"),
    ],
    ids=lambda overrides: overrides[0],
)
def test_any_settings_can_be_measured(
    overrides: tuple[str, ...], settings: Settings, beside: BenchmarkProfiles, tmp_path: Path
) -> None:
    config = settings(*overrides)
    config.source.root = str(fill(tmp_path / "photos", 2))
    validate_config(config)
    found = accuracy.measure_accuracy(config, beside, SampleSizes(2, 1, (16, 16), (8, 8), (8, 8), 4, 2))

    assert all(row.error_max == 0 for row in found.rows if row.stage in TIER_STAGES and row.method == EXACT)
    assert ("mine" in {row.method for row in found.rows}) == ("accuracy.name=mine" in overrides)


def test_a_budget_that_is_no_tier_has_a_name_of_its_own(settings: Settings, beside: BenchmarkProfiles) -> None:
    config = settings("accuracy.law_distance=1e-3")

    assert list(accuracy._tiers(config, beside)) == [*TIERS, "exact_changed"]


def test_photographs_that_cannot_be_read_are_passed_over(
    settings: Settings, beside: BenchmarkProfiles, tmp_path: Path
) -> None:
    (fill(tmp_path, 2) / "000.png").write_bytes(b"")
    found = accuracy.measure_accuracy(
        settings(f"source.root={tmp_path}"), beside, SampleSizes(2, 1, (8, 8), (8, 8), (8, 8), 4, 2)
    )

    assert found.facts["measured on"].startswith("1 photographs")


def test_where_no_photograph_can_be_read_that_is_said(
    settings: Settings, beside: BenchmarkProfiles, tmp_path: Path
) -> None:
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"none of 1 photographs tried can be read"):
        accuracy.measure_accuracy(settings(f"source.root={tmp_path}"), beside, LITTLE)


# The report -----------------------------------------------------------------------------------------------------------


def test_the_table_of_numbers_has_the_columns_that_are_promised(found: BenchmarkReport) -> None:
    lines = list(csv.DictReader(report.csv_text(found.rows).splitlines()))

    assert list(lines[0]) == [
        *("stage", "method", "tier", "error_max", "error_rms", "error_unit", "changed_share"),
        *("ns_per_pixel", "ratio_to_reference"),
    ]
    assert len(lines) == len(found.rows)
    assert {line["stage"] for line in lines} == {*STAGES, *TIER_STAGES}


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
def test_the_front_is_what_nothing_beats_in_both(points: list[tuple[float, float]], front: list[int]) -> None:
    assert report.pareto_front(points) == front


def test_the_figure_is_a_picture_fit_for_a_page(found: BenchmarkReport) -> None:
    content = report.benchmark_figure(found.rows)
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)

    assert 700 <= picture.shape[0] <= 1200
    assert 800 <= picture.shape[1] <= 1200
    assert len(content) < 200_000
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_the_figure_can_be_drawn_of_any_errors_and_times() -> None:
    rows = [
        Measurement(stage, name, tier, error, error, "DN", 0.0, ns, 1.0)
        for stage in (*STAGES, *TIER_STAGES)
        for name, tier, error, ns in (("a", "fast", 1e-3, 0.01), ("b", "mine", 2.0, 4000.0), ("c", "", None, None))
    ]

    assert report.benchmark_figure(rows)[:4] == b"\x89PNG"


def test_the_page_is_one_file_without_a_script_and_escapes_names() -> None:
    name = "<script>alert('&\")</script>"
    page = report.benchmark_page(
        BenchmarkReport((Measurement(name, name, name, 1.0, 1.0, name, 0.5, 1.0, 1.0),), {name: name}), b"png"
    )

    assert "<script" not in page
    assert "&lt;script&gt;alert(&#39;&amp;&#34;)" in page
    assert 'src="data:image/png;base64,cG5n"' in page
    assert not re.search(r"(href|src)=\"(?!data:)", page)


def test_the_page_says_how_it_was_measured(found: BenchmarkReport) -> None:
    page = report.benchmark_page(found, b"")

    for fact in ("gen-dataset accuracy", "numpy ", "dead_leaves-0", "imx385_iso3200", "sony_a7s2", "low_light"):
        assert fact in page
    assert all(row.method in page for row in found.rows)


def test_the_terminals_lines_are_aligned(found: BenchmarkReport) -> None:
    lines = report.text_table(found.rows).splitlines()

    assert len(lines) == len(found.rows) + 1
    assert len({line.index(name) for line in lines for name in ("method", "exact_table") if name in line}) == 1


@pytest.mark.parametrize(
    ("value", "said"), [(None, "–"), (0.0, "0"), (1.234e-7, "1.2e-07"), (293.4, "290"), (5.33, "5.3")]
)
def test_numbers_are_spelled_for_people(value: float | None, said: str) -> None:
    assert formatting.short_number(value) == said


# The command ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the command measure little."""
    little = SampleSizes(2, 1, (16, 16), (8, 8), (8, 8), 4, 2)
    true = accuracy.measure_accuracy
    monkeypatch.setattr(
        accuracy, "measure_accuracy", lambda config, beside, command: true(config, beside, little, command)
    )


@pytest.mark.usefixtures("quick")
def test_the_command_writes_three_files_and_says_so(door: Door, tmp_path: Path) -> None:
    for _ in range(2):  # an earlier report is overwritten
        done = door("accuracy", f"source.root={fill(tmp_path / 'photos', 2)}", "out=new/report")

        assert done.code == 0
        assert sorted(path.name for path in (tmp_path / "new/report").iterdir()) == sorted(report.FILES)
        assert re.search(r"^tier_electrons +fast ", done.out, re.MULTILINE)
        assert "measurements" in done.err
    assert "gen-dataset accuracy source.root=" in (tmp_path / "new/report/accuracy.html").read_text()


@pytest.mark.parametrize("name", report_files.DATASET_ENTRIES)
def test_a_dataset_is_no_place_for_a_report(door: Door, tmp_path: Path, name: str) -> None:
    (tmp_path / "ds").mkdir()
    (tmp_path / "ds" / name).mkdir()
    done = door("accuracy", "out=ds")

    assert done.code == 2
    assert done.err == (
        f"gen-dataset: out=ds: contains a dataset ({name}); expected a folder without one; choose another out\n"
    )


def test_a_file_in_the_way_is_refused(door: Door, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = door("accuracy", "out=file")

    assert (done.code, done.err) == (
        2,
        "gen-dataset: out=file: cannot be written (file is not a folder); choose another out\n",
    )


def test_without_matplotlib_the_extra_is_named_before_anything_is_measured(
    door: Door, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report_files, "find_spec", lambda name: None)
    done = door("accuracy", "out=new")

    assert done.code == 2
    assert done.err == "gen-dataset: accuracy: drawing needs matplotlib; pip install 'unprocess_gen[figures]'\n"
    assert not (tmp_path / "new").exists()


# The price in a plan --------------------------------------------------------------------------------------------------


def test_a_plan_tells_the_price_of_what_is_chosen_beside_the_tiers(settings: Settings, tmp_path: Path) -> None:
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


def test_a_plan_says_what_a_loose_budget_gives_away(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", "accuracy=fast")

    assert (
        "accuracy  fast: clean within 1 DN, a fraction of 0.001 changed, normals within 0.001 σ, "
        "shot noise within 0.005 (CDF); " in format_estimate(config, estimate_run(config, 1, True))
    )


def test_a_plan_of_nothing_readable_has_no_price(settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"")
    config = settings(f"source.root={tmp_path}")

    assert "exact shot noise;" not in format_estimate(config, estimate_run(config, 1, True, TIERS))
