"""The cost of accuracy: complete runs by tier and stage, their errors, and the report."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings, TreeHash
from helpers.photographs import fill
from helpers.promise_report import Figure

from unprocess_gen import RawPairs
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.reports import accuracy_page, tier_costs
from unprocess_gen.reports.tier_costs import STAGES, AccuracyReport, Measurement
from unprocess_gen.simulation.kernels.render import uses_float32
from unprocess_gen.simulation.plan import EXACT, FAST, REFERENCE, TIERS
from unprocess_gen.simulation.reference.electrons import noise_variance
from unprocess_gen.sources.listing import list_photographs


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tier_costs, "ROUNDS", 2)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder for temporary files of this process."""
    path = tmp_path / "temporary"
    path.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(path))
    return path


# Tiers ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "steep",
    ["", "gains.threshold=0.999", "gains.red=0.05", "camera=custom camera.xyz2cam=[1,0,0,0,0,1,1,-0.94,0]"],
)
def test_plans_that_amplify_rounding_errors_use_float64(settings: Settings, steep: str) -> None:
    plan = plan_image(settings("accuracy=fast", "noise=imx385_iso3200", *steep.split()), "0" * 64)

    assert uses_float32(plan) == (not steep)
    assert not uses_float32(plan.replace(accuracy=EXACT))
    assert not uses_float32(plan.replace(clean_dtype="float32"))


# Measurement ----------------------------------------------------------------------------------------------------------


OVERRIDES = (
    (),
    ("noise=sony_a7s2", "scene=night", "output.layout=packed"),
    pytest.param(
        ("noise=brooks2019", "noise.levels=2", "output.dtype=float32", "source.patch=8"), marks=pytest.mark.slow
    ),
)


@pytest.mark.parametrize("overrides", OVERRIDES)
def test_every_stage_of_every_tier_has_time_and_error(
    overrides: tuple[str, ...], settings: Settings, folder: Path, figure: Figure
) -> None:
    root = fill(folder.parent / "photos", 3)
    (root / "000.png").write_bytes(b"")  # is ignored
    measured = tier_costs.measure_accuracy(settings(*overrides, f"source.root={root}"), "gen-dataset accuracy")

    assert [(row.tier, row.stage) for row in measured.rows] == [(tier, stage) for tier in TIERS for stage in STAGES]
    for tier in TIERS:
        stages = {row.stage: row for row in measured.rows if row.tier == tier}
        total_ns = sum(stages[stage].ns_per_pixel or 0 for stage in STAGES[:-1])
        assert stages["run"].ns_per_pixel == pytest.approx(total_ns)
        assert tier != EXACT or {row.ratio_to_exact for row in stages.values()} <= {1, None}
        assert any(row[4:] != (0,) * 5 for row in stages.values()) == (tier == FAST and not overrides)
        figure("tiers", f"{tier}: error of the noisy frame at most {stages['run'].max_dn:.2g} DN")
    assert measured.photographs == "2 photographs (0.0 megapixels)"
    assert list(folder.iterdir()) == []


def test_errors_are_those_of_the_frames_in_dn_and_in_standard_deviations(settings: Settings, tmp_path: Path) -> None:
    config = settings("source.limit=1", "sensor=generic_14bit")
    inputs = tier_costs.select_inputs(config, tmp_path)
    images = [tier_costs.plan_samples(config, tier, inputs) for tier in (FAST, REFERENCE)]
    (pair,), (exact,) = ([next(image.pairs())[2] for image in planned] for planned in images)
    plan = images[1][0].plans[0]
    std = np.sqrt(noise_variance(exact.clean.astype(float), plan) + 1 / 12)
    errors = tier_costs.deviations([pair], [exact], [plan])
    for stage, ours, theirs in (("clean", pair.clean, exact.clean), ("run", pair.noisy, exact.noisy)):
        error, apart = errors[stage], ours.astype(float) - theirs
        in_std = apart / std
        expected = [np.mean(apart != 0), np.abs(apart).max(), np.sqrt(np.mean(apart**2)), np.abs(in_std).max()]
        np.testing.assert_allclose(error, [*expected, np.sqrt(np.mean(in_std**2))], rtol=1e-12)
        assert min(error) > 0


def test_runs_have_the_bytes_of_generate(
    folder: Path, photos: Path, settings: Settings, make: Make, tree_hash: TreeHash, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    true = tier_costs.generate

    def generate(config: Config) -> Any:
        summary = true(config)
        made.append(tree_hash(Path(config.out)))
        return summary

    monkeypatch.setattr(tier_costs, "generate", generate)
    monkeypatch.setattr(tier_costs, "RUN_FILES", 2)
    config = settings(f"source.root={photos}", "noise.levels=2")
    inputs = tier_costs.select_inputs(config, folder)
    times = tier_costs.time_run(config, inputs, FAST, folder / "dataset")
    make(photos, folder / "ds", "accuracy=fast", "noise.levels=2", f"source.limit={inputs.source.limit}")

    assert len(inputs.samples) == 2
    assert min(times) > 0
    assert made == [tree_hash(folder / "ds")]
    assert not (folder / "dataset").exists()
    assert "\naccuracy: fast\n" in (folder / "ds/config.yaml").read_text(encoding="utf-8")
    assert {row["accuracy"] for *_, row in RawPairs(folder / "ds")} == {FAST}


def test_ended_measurement_leaves_nothing(folder: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    level = tier_costs.LOGGER.level

    def generate(config: Config) -> Any:
        Path(config.out).mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(tier_costs, "generate", generate)
    with pytest.raises(KeyboardInterrupt):
        tier_costs.measure_accuracy(settings("source.limit=1"))

    assert list(folder.iterdir()) == []
    assert tier_costs.LOGGER.level == level
    folder.rmdir()
    with pytest.raises(MachineError, match=r"set TMPDIR to a folder with space"):
        tier_costs.measure_accuracy(settings())


def test_photographs_end_with_enough_pixels(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synthetic = tier_costs.select_inputs(
        settings("source.limit=2", "source.downscale=2"), tmp_path / "synthetic"
    ).source
    assert [source.path[-4:] for source in list_photographs(synthetic).sources] == [".jpg"] * 2
    root = fill(tmp_path / "photos", 9)
    (root / "000.png").write_bytes(b"")  # cannot be read
    for pixels, overrides, count in (
        (13 * 17 + 14 * 18, (), 2),
        (13 * 17 + 14 * 18 - 1, (), 1),
        (1, (), 1),
        (10**6, (), 8),
        (6 * (13 * 17 + 14 * 18), ("noise.levels=3", "noise.draws=2"), 2),
    ):
        monkeypatch.setattr(tier_costs, "RUN_PIXELS", pixels)
        inputs = tier_costs.select_inputs(settings(f"source.root={root}", *overrides), tmp_path)
        assert (len(inputs.samples), inputs.source.limit) == (count, count + 1)
    with pytest.raises(ConfigError, match=r"none of 1 photographs can be read"):
        tier_costs.select_inputs(settings(f"source.root={root}", "source.limit=1"), tmp_path)


# The report -----------------------------------------------------------------------------------------------------------


def rows_of(tier: str, ratio: float | None, changed: float) -> list[Measurement]:
    return [Measurement(tier, stage, ratio, ratio, changed, 2.0, 0.1, 0.3, 0.004) for stage in STAGES]


def measured(fast: float, reference: float | None = 31.0) -> AccuracyReport:
    rows = [*rows_of(REFERENCE, reference, 0), *rows_of(EXACT, 1.0, 0), *rows_of(FAST, fast, 0.02)]
    return AccuracyReport(tuple(rows), "2 photographs (5.2 megapixels)", "imx385_iso3200", {})


TIME = "the processor time of exact"
MOVES = "moves 2 % of the noisy DN by at most 2 DN or 0.3 standard deviations of the noise"


@pytest.mark.parametrize(
    ("given", "fast", "reference"),
    [
        (measured(0.9), f"0.9 of {TIME}", f"takes 31 times {TIME}"),
        (measured(0.96), "about as long as exact (ratio 0.96)", f"takes 31 times {TIME}"),
        (measured(0.9, None), f"0.9 of {TIME}", "was too slow to be timed"),
    ],
)  # fmt: skip
def test_conclusion_is_true_for_any_result(given: AccuracyReport, fast: str, reference: str) -> None:
    assert accuracy_page.conclude(given) == (
        "In a complete run of 2 photographs (5.2 megapixels) with noise=imx385_iso3200, "
        f"fast takes {fast} and {MOVES}; reference {reference} and changes no DN."
    )
    picture = cv2.imdecode(np.frombuffer(accuracy_page.accuracy_figure(given.rows), np.uint8), cv2.IMREAD_COLOR)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_accuracy_writes_three_files_and_prints_the_table(run_main: RunMain, tmp_path: Path) -> None:
    written = tmp_path / "new/report"
    written.mkdir(parents=True)
    (written / "accuracy.csv").write_text("an earlier report")
    done = run_main("accuracy", f"source.root={fill(tmp_path / 'photos', 2)}", "out=new/report")

    assert done.code == 0
    assert sorted(path.name for path in written.iterdir()) == sorted(accuracy_page.REPORT_FILES)
    lines = list(csv.DictReader((written / "accuracy.csv").read_text().splitlines()))
    assert list(lines[0]) == [
        *("tier", "stage", "ns_per_pixel", "ratio_to_exact", "changed_share", "max_dn", "rms_dn", "max_std", "rms_std")
    ]
    assert len(lines) == len(TIERS) * len(STAGES)
    assert re.search(r"^fast +noise ", done.out, re.MULTILINE)
    assert "In a complete run of 2 photographs (0.0 megapixels) with noise=imx385_iso3200, fast " in " ".join(
        done.out.split()
    )
    assert "measurements" in done.err
    assert "image" not in done.err  # of the runs that are measured
    assert "gen-dataset accuracy source.root=" in (written / "accuracy.html").read_text()
    (tmp_path / "ds/manifest.csv").mkdir(parents=True)
    refused = run_main("accuracy", "out=ds")
    assert (refused.code, "out=ds: contains a dataset (manifest.csv); " in refused.err) == (2, True)
