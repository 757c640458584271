"""The estimate of `plan`: which sources are read, when numbers are exact, and the text."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.photographs import fill

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.pipeline.progress import COMPILING
from unprocess_gen.reports.estimate import COMMIT_SECONDS, SAMPLE, estimate_run
from unprocess_gen.reports.plan_text import format_estimate
from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS as EFFECTS


@pytest.mark.parametrize(("count", "read_all"), [(SAMPLE, False), (SAMPLE + 1, False), (SAMPLE + 1, True)])
def test_sources_are_sampled_and_their_sizes_give_the_bytes(
    count: int, read_all: bool, settings: Settings, make: Make, tmp_path: Path
) -> None:
    photos = fill(tmp_path / "p", count)
    estimate = estimate_run(settings(f"source.root={photos}", "noise.draws=2"), 1, read_all)
    made = make(photos, tmp_path / "ds", "noise.draws=2")

    is_exact = read_all or count == SAMPLE
    assert len(estimate.source_estimates) == (count if read_all else SAMPLE)
    assert (estimate.exact, estimate.pairs, estimate.shards) == (is_exact, 2 * count, -(-count // 8))
    assert estimate.bytes == pytest.approx(made.bytes, rel=0.3)
    lines = format_estimate(estimate).splitlines()
    assert lines[2].startswith(f"bytes     about {estimate.bytes:,} in shards, ")


@pytest.mark.parametrize(("per_shard", "workers"), [(1, 2), (8, 1)])
def test_time_of_pairs_is_divided_by_the_workers_that_have_a_shard(
    per_shard: int, workers: int, settings: Settings, tmp_path: Path
) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 3)}", f"output.pairs_per_shard={per_shard}")
    estimate = estimate_run(config, 2, read_all=True)
    assert estimate.n_jobs == workers
    assert estimate.pair_seconds == pytest.approx(sum(source.seconds for source in estimate.source_estimates) / workers)


def test_time_includes_start_up_and_disk(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 3)}", f"out={tmp_path}/not/yet/there")
    estimate = estimate_run(config, 1, read_all=True)
    assert estimate.start_seconds > 0.1  # the imports of this process alone
    assert estimate.disk_seconds > COMMIT_SECONDS
    assert estimate.seconds == estimate.start_seconds + estimate.pair_seconds + estimate.disk_seconds
    line = next(line for line in format_estimate(estimate).splitlines() if line.startswith("time"))
    assert re.fullmatch(r"time      about \S+ \w+ with 1 worker: start-up .*, pairs .*, disk .*", line)
    assert list(tmp_path.iterdir()) == [tmp_path / "p"]
    assert estimate.free_bytes == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.1)


# Sentences ------------------------------------------------------------------------------------------------------------


def estimate_text(settings: Settings, folder: Path, *overrides: str) -> str:
    """Return the estimate of two photographs, each sentence in one line."""
    config = settings(f"source.root={fill(folder / 'p', 2)}", f"out={folder}/ds", *overrides)
    text = format_estimate(estimate_run(config, 1, True))
    return re.sub(r"\n {10}(?=[a-z(°])", " ", text)


def test_effects_are_listed_with_reasons(settings: Settings, tmp_path: Path) -> None:
    text = estimate_text(settings, tmp_path, "noise=nikon_d850", "scene=daylight", "effects.row=off")
    assert re.search(r"^effects   prnu, shot, read, .*; reasons below$", text, re.MULTILINE)
    assert re.search(r"^dark_current .* 0 of 2 .* too small to see$", text, re.MULTILINE)
    assert re.search(r"^row .* 0 of 2 .* switched off, though it would show$", text, re.MULTILINE)


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ("noise=none", "skipped   heteroscedastic: noise=none has no variance"),
        ("noise=imx385_iso3200_rvdd", "no noise up to 15.33 DN above black"),
        ("noise.a=0 noise.b=-5 noise.negative_variance=clip", "b_dn2 -5"),
        (
            "noise=sony_a7s2",
            "noise=sony_a7s2 gives no column_temporal_std_dn",
        ),
        (
            "noise=nikon_d850 scene=long_exposure",
            "prnu_std=0.005, dark_e_per_s=1.0, dark_reference_c=25.0, ",
        ),
    ],
)
def test_effects_of_a_profile_are_explained(overrides: str, sentence: str, settings: Settings, tmp_path: Path) -> None:
    assert sentence in estimate_text(settings, tmp_path, *overrides.split())


def test_scene_names_what_the_profile_uses_and_ignores(settings: Settings, tmp_path: Path) -> None:
    night = "scene     night: ISO 6400, 0.1 s, 20 °C, light divided by "
    physical = estimate_text(settings, tmp_path / "a", "noise=sony_a7s2", "scene=night")
    assert night in physical
    assert "; sony_a7s2 ignores" not in physical
    fixed = estimate_text(settings, tmp_path / "b", "noise=sony_a7s2", "scene=night", "noise.iso=800")
    assert "; sony_a7s2 ignores ISO (noise.iso is used)\n" in fixed
    two_numbers = estimate_text(settings, tmp_path / "c", "scene=night")
    assert night in two_numbers
    assert "; imx385_iso3200 ignores ISO, time, temperature\n" in two_numbers


def test_dark_scene_with_a_profile_of_two_numbers_is_warned_about(settings: Settings, tmp_path: Path) -> None:
    text = estimate_text(settings, tmp_path / "a", "scene=night")
    warning = text.split("warning   ")[1]
    assert re.match(
        r"scene=night: light is divided by \d+ to \d+, which leaves \d+ to \d+ distinct DN in a clean ", warning
    )
    for profile in ("imx385", "nikon_d850", "sony_a7s2"):
        assert profile in warning
    assert "physical profiles" not in estimate_text(settings, tmp_path / "b", "scene=night", "noise=sony_a7s2")
    bright = ("noise=nikon_d850", "scene=indoor", "sensor=generic_14bit")
    assert "warning" not in estimate_text(settings, tmp_path / "c") + estimate_text(settings, tmp_path / "d", *bright)


@pytest.mark.parametrize(("ratio", "limit_db"), [(100, 54.5), (200, 48.5), (300, 45.0)])
def test_posterised_clean_frames_are_warned_about(
    settings: Settings, tmp_path: Path, ratio: int, limit_db: float
) -> None:
    text = estimate_text(
        settings, tmp_path, "sensor=generic_14bit", "noise=nikon_d850", f"scene.exposure_ratio={ratio}"
    )
    assert f"no denoiser exceeds a PSNR of {limit_db:g} dB" in text
    assert "output.clean_dtype=float32" in text


def test_failed_source_has_no_bytes_and_a_reason(settings: Settings, tmp_path: Path) -> None:
    (fill(tmp_path / "p", 1) / "000.png").write_bytes(b"no picture")
    config = settings(f"source.root={tmp_path / 'p'}")
    estimate = estimate_run(config, 1, read_all=True)
    [source] = estimate.source_estimates
    assert (estimate.bytes, source.reason, source.levels) == (0, "unsupported", ())
    assert source.detail
    assert f"fails     000.png: unsupported\n          {source.detail}" in format_estimate(estimate)


@pytest.mark.parametrize(("method", "stated"), [("off", True), ("dither", True), ("dither_all", False)])
def test_highlights_next_to_empty_bands_are_stated(
    method: str, stated: bool, settings: Settings, tmp_path: Path
) -> None:
    (tmp_path / "p").mkdir()
    cv2.imwrite(str(tmp_path / "p" / "bright.png"), np.full((20, 20, 3), 254, dtype=np.uint8))
    config = settings(f"source.root={tmp_path / 'p'}", f"source.dequantize={method}", "gains=paper_max")
    text = format_estimate(estimate_run(config, 1, True))
    assert ("highlight 100 % of the sites are highlights where 8-bit codes are coarse" in text) == stated


def test_every_noise_level_is_listed(run_main: RunMain, tmp_path: Path) -> None:
    levels = "noise.levels=[{a: 1, b: 2},{a: 30, b: 900}]"
    estimate = run_main("plan", "source.limit=1", "noise=heteroscedastic", levels, f"out={tmp_path}/ds").out
    assert "a=1, b=2; a=30, b=900 (" in estimate
    assert "a_dn 1 to 30, b_dn2 2 to 900" in estimate

    estimate = run_main(
        "plan", "source.limit=1", "noise=nikon_d850", "noise.levels=[100,6400]", f"out={tmp_path}/ds"
    ).out
    assert "ISO 100 to 6400" in estimate
    assert " of 2 " in estimate


def test_empty_folder_is_refused(settings: Settings, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no file matches source.include="):
        estimate_run(settings(f"source.root={tmp_path}"), 1, read_all=False)


def test_every_effect_of_a_profile_has_line_and_reason(settings: Settings, tmp_path: Path) -> None:
    config = settings("noise=sony_a7s2", "scene=night", f"source.root={fill(tmp_path / 'p', 2)}")
    estimate = format_estimate(estimate_run(config, 1, True))
    assert "scene     night: ISO 6400" in estimate
    assert "noise     sony_a7s2: " in estimate
    for effect in EFFECTS:
        assert re.search(rf"^{effect} .* [0-2] of 2 +[\d.]+ +\S", estimate, re.MULTILINE), effect


def test_unmatched_files_are_counted_by_suffix_with_advice(settings: Settings, tmp_path: Path) -> None:
    folder = fill(tmp_path / "p", 1)
    for name in ("a.heic", "b.heic", "c.txt"):
        (folder / name).touch()
    config = settings(f"source.root={folder}")
    line = format_estimate(estimate_run(config, 1, True)).splitlines()[1]
    assert "3 files are not matched by source.include (2 .heic, 1 .txt); convert " in line


@pytest.mark.parametrize("compiled", [False, True])
def test_compiling_kernels_is_announced_unless_they_are_compiled(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, compiled: bool
) -> None:
    monkeypatch.setattr("unprocess_gen.simulation.self_test.are_compiled", lambda kernels: compiled)
    caplog.set_level("INFO", "unprocess_gen")
    estimate_run(settings("source.limit=1"), 1, True)
    assert caplog.messages == ([] if compiled else [COMPILING])


def test_plan_states_source_and_uncertainty_of_numbers_at_its_isos(run_main: RunMain) -> None:
    for iso, profile in ((100, "Profile-1"), (6400, "Profile-2")):
        done = run_main("plan", "source.limit=1", "noise=nikon_d850", f"noise.iso={iso}", "sensor=generic_14bit")
        text = " ".join(done.out.split())
        assert f"read_std_dn: ELD, {profile}, Gaussian line; uncertainty: " in text
        assert f"row_std_dn: ELD, {profile}, row line; uncertainty: " in text
        assert "black_error_dn: ELD, color_bias of its dark frames; uncertainty: " in text
        assert max(map(len, done.out.splitlines())) <= 160


def test_plan_states_how_much_rests_on_assumed_numbers(run_main: RunMain) -> None:
    """At white in daylight the variance is (p·u)² + K·u + read² + 1/12, of which PRNU is assumed."""
    overrides = ("noise=sony_a7s2", "scene=daylight", "sensor=generic_14bit")
    plan = ug.plan_image(np.full((8, 8, 3), 255, np.uint8), ug.load_config(overrides))
    light_dn, physics = float(plan.sensor.span_dn), plan.noise.physics
    assert physics is not None
    assumed = (physics.prnu_std * light_dn) ** 2
    share = assumed / (assumed + physics.dn_per_e * light_dn + physics.read_std_dn**2 + 1 / 12)
    assert f"0% at black and {share:.0%} at white rest on assumed numbers" in run_main("plan", *overrides).out
