"""Scores of methods: the definitions, the intervals, and what is refused."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import Cli, RunMain
from helpers.datasets import Make, text_rows

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.reports.scoring.items import Item, Items, dataset_items
from unprocess_gen.reports.scoring.metrics import BAND, BORDER, _developed, raw_scores, scores_of, target_scores
from unprocess_gen.reports.scoring.scoring import (
    DRAWS,
    MethodError,
    _expansion,
    read_scores,
    score_item,
    score_items,
    summaries,
)
from unprocess_gen.simulation.reference import isp

PEAK = 3855
ROW: dict[str, Any] = {
    "black_level_dn": 240,
    "white_level_dn": 240 + PEAK,
    "pattern": "GBRG",
    "key": "k",
    "source": "s",
}
LAST_DIGIT = 0.5e-6
"""Largest rounding error of a score."""


def random(*shape: int, seed: int = 0) -> Any:
    return np.random.default_rng(seed).uniform(240, 4000, shape)


# Definitions ----------------------------------------------------------------------------------------------------------


def test_psnr_of_a_constant_error_is_its_ratio_to_the_peak() -> None:
    clean = random(24, 26)
    assert raw_scores(clean, clean + 0.25, ROW)["raw_psnr"] == pytest.approx(20 * math.log10(PEAK / 0.25), abs=1e-9)
    same = raw_scores(clean, clean.copy(), ROW)
    assert (same["raw_psnr"], same["raw_psnr_unsaturated"], same["raw_ssim"]) == (
        None,
        None,
        pytest.approx(1, abs=1e-12),
    )


def test_sites_that_are_white_in_the_clean_frame_are_left_out() -> None:
    clean, output = random(24, 26), random(24, 26)
    clean[3:9, 5:8] = 240 + PEAK
    output[clean >= 240 + PEAK] = 0
    expected = scores_of("raw", clean[clean < 4000][None, None], output[clean < 4000][None, None], PEAK)
    assert raw_scores(clean, output, ROW)["raw_psnr_unsaturated"] == pytest.approx(expected["raw_psnr"], abs=1e-9)
    assert raw_scores(np.full_like(clean, 4095), output, ROW)["raw_psnr_unsaturated"] is None


@pytest.mark.parametrize("shape", [(11, 40, 3), (30, 17, 4), (2 * BAND + 10, 14, 1), (2 * BAND + 11, 14, 1)])
def test_ssim_is_that_of_scikit_image(shape: tuple[int, ...]) -> None:
    similarity = pytest.importorskip("skimage.metrics").structural_similarity
    x, y = random(*shape), random(*shape) + random(*shape, seed=1) / 4
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": PEAK}
    expected = np.mean([similarity(x[..., c], y[..., c], **window) for c in range(shape[2])])
    assert scores_of("raw", x, y, PEAK)["raw_ssim"] == pytest.approx(expected, abs=1e-9)
    assert scores_of("raw", x[:10], y[:10], PEAK)["raw_ssim"] is None


def test_target_is_compared_without_its_border() -> None:
    target = random(2 * BORDER + 20, 2 * BORDER + 24, 3).astype(np.float32) / 4000
    output = target.astype(np.float64)
    output[: BORDER - 1] = output[:, -BORDER:] = 9
    assert target_scores(target, output)["linear_psnr"] is None
    output[BORDER, BORDER, 1] += 0.5
    assert target_scores(target, output)["linear_psnr"] == pytest.approx(10 * math.log10(20 * 24 * 3 / 0.25), abs=1e-9)


def test_bands_are_developed_as_the_frame(dataset: Path) -> None:
    clean, _, row = ug.RawPairs(dataset)[0]
    repeats = 3 * BAND // clean.shape[0] + 2
    tall = np.tile(clean, (repeats, 1))[: 2 * BAND + 2]
    plan = plan_from_row(row)
    assert (_developed(tall, plan) == isp.to_codes(isp.develop(tall.astype(np.float64), plan))).all()


@pytest.fixture(scope="module")
def kinds(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that makes a dataset of two synthetic pictures, with a setting."""
    folder = tmp_path_factory.mktemp("kinds")

    def made(setting: str) -> Path:
        if not (folder / setting).exists():
            make(None, folder / setting, "source.limit=2", "source.downscale=4", *setting.split())
        return folder / setting

    return made


KINDS = (
    *("sensor=imx385_12bit", "sensor.pattern=MONO", "output.clean_dtype=float32"),
    *("output.layout=packed output.dtype=float32", "source.clips=true"),
)


@pytest.mark.parametrize("setting", KINDS)
def test_noisy_frames_of_every_kind_have_the_scores_of_their_arrays(setting: str, kinds: Callable[[str], Path]) -> None:
    pairs, scored = ug.RawPairs(kinds(setting)), score_items(dataset_items(kinds(setting)), "noisy")
    assert [record["key"] for record in scored["pairs"]] == [row["key"] for row in pairs.rows]
    for record, (clean, noisy, row) in zip(scored["pairs"], pairs, strict=True):
        span = 1 if noisy.dtype == np.float32 else PEAK
        clean = clean * np.float64(PEAK) + 240 if clean.dtype != noisy.dtype else clean
        height, width = (side // 2 * 2 for side in noisy.shape[-2:])
        mse = np.mean((noisy.astype(np.float64) - clean)[..., :height, :width] ** 2)
        assert record["raw_psnr"] == pytest.approx(10 * math.log10(span**2 / mse), abs=1e-5)
        if setting == KINDS[0]:
            error = ug.develop(noisy, row).astype(np.float64) - ug.develop(clean, row)
            expected = 10 * math.log10(255**2 / np.mean(error**2))
            assert record["srgb_psnr"] == pytest.approx(expected, abs=LAST_DIGIT)
    assert scored["all"]["raw_psnr"]["mean"] == pytest.approx(
        np.mean([record["raw_psnr"] for record in scored["pairs"]]), abs=2 * LAST_DIGIT
    )
    sources = {record["source"] for record in scored["pairs"]}
    assert scored["all"]["raw_psnr"]["sources"] == len(sources) == (1 if "clips" in setting else 2)


@pytest.mark.parametrize(("method", "least_db"), [("gaussian", 10.7), ("non_local_means", 12)])
@pytest.mark.parametrize("pattern", ["RGGB", "MONO"])
def test_methods_of_the_package_smooth_a_flat_clip(method: str, least_db: float, pattern: str) -> None:
    """The squared taps of a Gaussian of 1 site sum to 0.0796, which is 11.0 dB; less at borders."""
    pytest.importorskip("skimage")
    clean, noise = np.full((2, 128, 160), 1000.0), np.random.default_rng(3).normal(0, 30, (2, 128, 160))
    row = ROW | {"pattern": pattern, "a_dn": 0.5, "dark_variance_dn2": 30**2 - 0.5 * 760}
    item = Item("ds", clean, clean + noise, [row, row], is_clip=True, compare=raw_scores)
    (noisy, restored) = ([r["raw_psnr"] for r in score_item(name, ".", item)[0]] for name in ("noisy", method))
    assert min(np.subtract(restored, noisy)) > least_db
    if method == "gaussian":
        assert max(np.subtract(restored, noisy)) < 11.3


# Means and intervals --------------------------------------------------------------------------------------------------


def records(values: Any, frames: int = 1) -> list[dict[str, Any]]:
    return [
        {"key": f"{n}-{k}", "dataset": "ds", "source": str(n), "iso": 100.0 * (n % 2 + 1), "raw_psnr": float(value)}
        for n, value in enumerate(values)
        for k in range(frames)
    ]


def test_interval_is_that_of_the_mean_of_independent_sources() -> None:
    values = np.random.default_rng(1).normal(40, 3, 200)
    found = summaries(records(values))["all"]["raw_psnr"]
    half = 1.96 * values.std() / math.sqrt(len(values))
    tolerance = 4 * half / 1.96 * 2.7 / math.sqrt(DRAWS)  # four standard errors of a 2.5 % quantile of normal draws
    assert found["mean"] == pytest.approx(values.mean(), abs=LAST_DIGIT)
    assert found["low"] == pytest.approx(values.mean() - half, abs=tolerance)
    assert found["high"] == pytest.approx(values.mean() + half, abs=tolerance)


@pytest.mark.parametrize(("sources", "t", "share"), [(5, 2.776445, 3e-3), (20, 2.093024, 1e-5), (201, 1.971896, 1e-6)])
def test_intervals_of_few_sources_are_those_of_student(sources: int, t: float, share: float) -> None:
    """The mean of drawn sources has a variance that is (n - 1) / n of that of the mean of sources."""
    assert _expansion(sources) == pytest.approx(math.sqrt(sources / (sources - 1)) * t / 1.959964, rel=share)


def test_frames_of_a_source_are_drawn_together() -> None:
    values = np.random.default_rng(2).normal(40, 3, 12)
    once, often = summaries(records(values))["all"]["raw_psnr"], summaries(records(values, 9))["all"]["raw_psnr"]
    for end in ("mean", "low", "high"):
        assert once[end] == pytest.approx(often[end], abs=2 * LAST_DIGIT)


def test_groups_have_the_frames_of_their_value_and_a_source_has_no_interval() -> None:
    some = records([30, 40, 50])
    some[2]["raw_psnr"] = None
    found = summaries(some)
    assert found["all"]["raw_psnr"] == found["all"]["raw_psnr"] | {"mean": 35, "frames": 2, "omitted": 1, "sources": 2}
    assert list(found["by_iso"]) == ["100", "200"] and found["by_camera"] == {} and "by_dataset" not in found
    one = found["by_iso"]["200"]["raw_psnr"]
    assert (one["mean"], one["low"], one["high"], one["sources"]) == (40, None, None, 1)


# Command line ---------------------------------------------------------------------------------------------------------

METHODS = """
def raises(noisy, row): raise ValueError("two\\nlines")
def exits(noisy, row): raise SystemExit(4)
def nan(noisy, row): return noisy * float("nan")
def huge(noisy, row): return noisy * 1e200
def shape(noisy, row): return noisy[:-1]
def text(noisy, row): return noisy.astype(str)
def one(noisy): return noisy
number = 5
"""


@pytest.fixture(autouse=True)
def _own_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore ``sys.path``, to which loading a method adds a folder."""
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.mark.parametrize(
    ("method", "code", "complaint"),
    [
        ("mine.py:raises", 3, r"00000000: raised ValueError: two lines \(mine.py:2\)"),
        ("mine.py:exits", 3, "raised SystemExit: 4"),
        ("mine.py:nan", 3, "returned NaN"),
        ("mine.py:huge", 3, "values above"),
        ("mine.py:shape", 3, r"returned uint16 \(\d+, \d+\); expected numbers \(\d+, \d+\)"),
        ("mine.py:text", 3, "returned <U5"),
        ("mine.py:one", 2, r"too many positional arguments; expected a function one\(noisy, row\) in mine.py"),
        ("mine.py:number", 2, "5 is not a callable"),
        ("mine.py:other", 2, "'other'; expected a function other"),
        ("broken.py:f", 2, "SyntaxError: .*broken.py"),
        ("none.py:f", 2, "No such file"),
        ("nothing_here:f", 2, "No module named 'nothing_here'"),
        ("nosy", 2, "no such method; expected noisy, .*did you mean noisy?"),
    ],
)
def test_bad_methods_are_refused_in_one_line(
    method: str, code: int, complaint: str, run_main: RunMain, tmp_path: Path, dataset: Path
) -> None:
    (tmp_path / "mine.py").write_text(METHODS)
    (tmp_path / "broken.py").write_text("def f(:")
    done = run_main("score", dataset, "--method", method, "--to", "scores")
    assert (done.code, done.out, len(done.err.splitlines())) == (code, "", 1), done.err
    assert re.search(complaint, done.err), done.err
    assert not (tmp_path / "scores").exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("nowhere",), "nowhere: no such folder; expected .*the name of a benchmark build"),
        (("DS", "--keys", "77"), "--keys 77: .* has no such key"),
        (("DS", "--split", "test"), "split='test': no pair is in it; there are no splits"),
        (("DS", "--to", "DS/in"), "is inside the dataset"),
        (("DS", "--against", "no.json"), "no.json: .*No such file.*; expected a score.json"),
        (("DS", "n_jobs=0"), "n_jobs=0: expected"),
        (("begun",), "begun: is not finished; expected a dataset.json; rerun its command"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(
    arguments: tuple[str, ...], complaint: str, run_main: RunMain, tmp_path: Path, dataset: Path
) -> None:
    (tmp_path / "begun/shards").mkdir(parents=True)
    done = run_main("score", *(word.replace("DS", str(dataset)) for word in arguments), "--method", "noisy")
    assert (done.code, len(done.err.splitlines())) == (2, 1), done.err
    assert re.search(complaint, done.err), done.err
    assert not (tmp_path / "scores").exists()


def test_methods_are_compared_pair_by_pair_with_the_same_digits_for_any_n_jobs(
    run_main: RunMain, tmp_path: Path, dataset: Path
) -> None:
    (tmp_path / "brighter.py").write_text("def restore(noisy, row): return noisy + 1.5")
    assert run_main("score", dataset, "--method", "noisy", "--to", "a").code == 0
    against = ("--method", "brighter.py:restore", "--against", "a/score.json")
    results = []
    for n_jobs in (1, 2):
        done = run_main("score", dataset, *against, f"n_jobs={n_jobs}", "--to", "b")
        assert done.code == 0 and "minus noisy" in done.out, done.err
        results.append(json.loads((tmp_path / "b/score.json").read_text()))
        assert results[-1].pop("seconds_per_megapixel") > 0
    assert results[0] == results[1]
    first, second = json.loads((tmp_path / "a/score.json").read_text()), results[0]
    for name, difference in second["against"]["all"].items():
        both = [(b[name], a[name]) for a, b in zip(first["pairs"], second["pairs"], strict=True)]
        expected = [b - a for b, a in both if a is not None and b is not None]
        assert difference["frames"] == len(expected)
        if expected:
            assert difference["mean"] == pytest.approx(np.mean(expected), abs=4 * LAST_DIGIT)
            if difference["sources"] > 1:
                assert difference["low"] <= difference["mean"] <= difference["high"]
    lines = text_rows(tmp_path / "b", "score.csv")
    assert [line["raw_psnr"] for line in lines] == [repr(record["raw_psnr"]) for record in second["pairs"]]
    part = run_main("score", dataset, *against, "--keys", lines[0]["key"], "--to", "c")
    assert (part.code, len(part.err.splitlines())) == (2, 1)
    assert "has other pairs; expected the same dataset, --keys and --split" in part.err


@pytest.mark.parametrize("value", ["x", [1], math.nan])
def test_comparison_with_an_edited_file_is_refused(value: Any, tmp_path: Path) -> None:
    pair = {"key": "0", "dataset": "ds", "source": "s", "raw_psnr": value}
    other: dict[str, Any] = {
        "method": "noisy",
        "data": {"datasets": {"ds": "1"}, "keys": None, "split": None},
        "pairs": [pair],
    }
    (tmp_path / "other.json").write_text(json.dumps(other))
    with pytest.raises(ConfigError, match=r"other.json: .*; expected a score.json"):
        read_scores(tmp_path / "other.json", other["data"])


@pytest.mark.slow
def test_digits_do_not_depend_on_the_instructions_of_the_processor(cli: Cli, tmp_path: Path, make: Make) -> None:
    """Float32 in `develop` changed codes of such pairs, and so the last digits."""
    oldest = {
        "OPENCV_CPU_DISABLE": "SSE4.1,SSE4.2,AVX,FP16,AVX2,FMA3,AVX512F",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
        "OPENBLAS_CORETYPE": "Prescott",
    }
    make(None, tmp_path / "ds", "source.limit=6")
    for name, env in (("new", {}), ("old", oldest)):
        done = cli("score", "ds", "--method", "noisy", "--to", name, **env)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "new/score.csv").read_bytes() == (tmp_path / "old/score.csv").read_bytes()


def test_sweep_is_scored_by_dataset(run_main: RunMain, tmp_path: Path) -> None:
    noise = "noise=imx385_iso1600,imx385_iso12800"
    assert run_main("-m", noise, "source.limit=2", "source.downscale=4", "n_jobs=1", "out=sweep").code == 0
    assert run_main("score", "sweep", "--method", "noisy", "--keys", "0-1").code == 0
    scored = json.loads((tmp_path / "scores/sweep-noisy/score.json").read_text())
    assert list(scored["by_dataset"]) == ["noise=imx385_iso12800", "noise=imx385_iso1600"]
    high, low = (group["raw_psnr"]["mean"] for group in scored["by_dataset"].values())
    assert high + 3 < low
    assert {name: group["raw_psnr"]["mean"] for name, group in scored["by_iso"].items()} == {"1600": low, "12800": high}
    assert {record["dataset"] for record in scored["pairs"]} == {*scored["by_dataset"]} == {*scored["data"]["datasets"]}


@pytest.mark.slow
def test_build_is_made_and_scored_by_its_name(run_main: RunMain, tmp_path: Path) -> None:
    pytest.importorskip("skimage")
    assert run_main("score", "photos_patches", "--method", "noisy").code == 0
    scored = json.loads((tmp_path / "scores/photos_patches-noisy/score.json").read_text())
    assert round(scored["all"]["raw_psnr"]["mean"], 2) == 37.79  # its card
    (tmp_path / "photos_patches").mkdir()
    both = run_main("score", "photos_patches", "--method", "noisy")
    assert both.code == 2 and "is a folder and the name of a build; the folder is scored" in both.err


# Bursts ---------------------------------------------------------------------------------------------------------------


def test_output_of_the_shape_of_the_target_is_compared_with_it(tmp_path: Path) -> None:
    frames, target = random(3, 24, 24), random(96, 96, 3).astype(np.float32)
    rows = [ROW | {"key": str(number), "clip": "burst"} for number in range(3)]
    (tmp_path / "m.py").write_text("import numpy as np\ndef up(noisy, rows): return np.ones((96, 96, len(rows)))\n")
    item = Item("ds", frames, frames, rows, is_clip=True, target=target, compare=raw_scores)
    (record,), _ = score_item("m.py:up", str(tmp_path), item)
    assert (record["key"], record["source"]) == ("0", "burst") and record["linear_psnr"] is not None
    each, _ = score_item("noisy", str(tmp_path), item)
    assert [record["key"] for record in each] == ["0", "1", "2"] and "linear_psnr" not in each[0]
    with pytest.raises(MethodError, match=r"expected numbers \(3, 24, 24\) or \(96, 95, 3\)"):
        score_item("m.py:up", str(tmp_path), item._replace(target=target[:, 1:]))


@pytest.mark.slow
def test_bursts_of_a_photograph_are_one_source(make: Make, tmp_path: Path) -> None:
    burst = "source.burst={frames: 2, shift: 4, downscale: 2}"
    make(None, tmp_path / "ds", "source.limit=2", burst, "source.patch=[random,128,2]", "output.targets=[linear_rgb]")
    (tmp_path / "up.py").write_text(
        "def up(noisy, rows): return noisy[0].repeat(2, 0).repeat(2, 1)[..., None] * [1, 1, 1]"
    )
    scored = score_items(dataset_items(tmp_path / "ds"), f"{tmp_path}/up.py:up")
    counts = [scored["all"]["linear_psnr"][name] for name in ("frames", "sources")]
    assert counts == [4, 2] and {record["key"][-3:] for record in scored["pairs"]} == {"f00"}
    (clip, *_) = ug.RawClips(tmp_path / "ds")
    inside = slice(BORDER, -BORDER)
    error = clip.noisy[0].repeat(2, 0).repeat(2, 1)[inside, inside, None] - clip.target[inside, inside].astype(float)
    assert scored["pairs"][0]["linear_psnr"] == pytest.approx(-10 * math.log10(np.mean(error**2)), abs=LAST_DIGIT)


def test_frames_of_other_kinds_are_scored_by_their_own_definition() -> None:
    item = Item("real", np.ones((1, 4, 4, 3)), np.zeros((1, 4, 4, 3)), [ROW], compare=lambda *_: {"srgb_psnr": 1.0})
    scored = score_items(Items({"datasets": {"real": "0"}}, 1, [item]), "noisy")
    assert scored["all"]["srgb_psnr"]["mean"] == 1
