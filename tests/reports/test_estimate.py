"""The estimate of `plan`: which sources are read, when numbers are exact, and the text."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Settings
from helpers.photographs import fill
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import AccuracyConfig
from unprocess_gen.config.serialization import read_option
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Source
from unprocess_gen.reports.estimate import COMMIT_SECONDS, SAMPLE, estimate_run, format_estimate
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.reference.noise import EFFECTS


def listing(count: int) -> tuple[Source, ...]:
    return tuple(Source(i, f"{i}.png", f"{i}.png", 1) for i in range(count))


@given(total=st.integers(1, 500), count=st.integers(1, 50))
def test_spaced_sources_are_different_and_in_order(total: int, count: int) -> None:
    indices = [source.index for source in evenly_spaced(listing(total), count)]
    assert len(indices) == min(total, count)
    assert indices == sorted(set(indices))


@given(total=st.integers(1, 500), count=st.integers(1, 50))
def test_spaced_sources_have_even_distances(total: int, count: int) -> None:
    indices = [source.index for source in evenly_spaced(listing(total), count)]
    gaps = [after - before for before, after in zip(indices, [*indices[1:], total], strict=True)]
    assert max(gaps) - min(gaps) <= 1
    assert indices[0] == 0


def test_few_sources_are_all_read_and_bytes_are_exact(settings: Settings, tmp_path: Path) -> None:
    estimate = estimate_run(settings(f"source.root={fill(tmp_path / 'p', SAMPLE)}"), 1, read_all=False)
    assert (estimate.exact, len(estimate.source_estimates)) == (True, SAMPLE)


def test_many_sources_are_sampled(settings: Settings, tmp_path: Path) -> None:
    estimate = estimate_run(settings(f"source.root={fill(tmp_path / 'p', SAMPLE + 1)}"), 1, read_all=False)
    assert (estimate.exact, len(estimate.source_estimates), estimate.sources, estimate.shards) == (
        False,
        SAMPLE,
        SAMPLE + 1,
        3,
    )


def test_all_sources_are_read_on_request(settings: Settings, tmp_path: Path) -> None:
    estimate = estimate_run(settings(f"source.root={fill(tmp_path / 'p', SAMPLE + 1)}"), 1, read_all=True)
    assert (estimate.exact, len(estimate.source_estimates)) == (True, SAMPLE + 1)


def test_sampled_estimate_says_about(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', SAMPLE + 1)}")
    assert "about" in next(
        line
        for line in format_estimate(config, estimate_run(config, 1, False)).splitlines()
        if line.startswith("bytes")
    )
    assert "about" not in next(
        line for line in format_estimate(config, estimate_run(config, 1, True)).splitlines() if line.startswith("bytes")
    )


def test_time_of_pairs_is_divided_by_the_number_of_workers(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 3)}", "output.pairs_per_shard=1")
    estimate = estimate_run(config, 2, read_all=True)
    assert estimate.pair_seconds == pytest.approx(sum(source.seconds for source in estimate.source_estimates) / 2)


def test_no_more_workers_are_estimated_than_shards(settings: Settings, tmp_path: Path) -> None:
    estimate = estimate_run(settings(f"source.root={fill(tmp_path / 'p', 3)}"), 4, read_all=True)
    assert (estimate.shards, estimate.n_jobs) == (1, 1)
    assert estimate.pair_seconds == pytest.approx(sum(source.seconds for source in estimate.source_estimates))


def test_time_includes_start_up_and_disk(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 3)}", f"out={tmp_path}/not/yet/there")
    estimate = estimate_run(config, 1, read_all=True)
    assert estimate.start_seconds > 0.1  # the imports of this process alone
    assert estimate.disk_seconds > COMMIT_SECONDS
    assert estimate.seconds == estimate.start_seconds + estimate.pair_seconds + estimate.disk_seconds
    line = next(line for line in format_estimate(config, estimate).splitlines() if line.startswith("time"))
    assert re.fullmatch(r"time      about \S+ \w+ with 1 worker: start-up .*, pairs .*, disk .*", line)
    assert list(tmp_path.iterdir()) == [tmp_path / "p"]


# Sentences ------------------------------------------------------------------------------------------------------------


def estimate_text(settings: Settings, folder: Path, *overrides: str) -> str:
    """Return the estimate of two photographs, each sentence in one line."""
    config = settings(f"source.root={fill(folder / 'p', 2)}", f"out={folder}/ds", *overrides)
    text = format_estimate(config, estimate_run(config, 1, True))
    return re.sub(r"\n {10}(?=[a-z(°])", " ", text)


def test_sentences_name_what_is_simulated_and_left_out(settings: Settings, tmp_path: Path) -> None:
    text = estimate_text(settings, tmp_path, "noise=nikon_d850", "scene=daylight", "effects.row=off")
    assert re.search(r"^effects   Simulated: prnu \(assumed 0\.5 %\), shot, .*read, .*\.$", text, re.MULTILINE)
    assert re.search(r"^ {10}Left out, too small to see: dark_current \(0\.\d+ of the noise\), ", text, re.MULTILINE)
    assert re.search(
        r"^ {10}Left out though it would show: row \([\d.]+ of the noise; switched off\)\.$", text, re.MULTILINE
    )


def test_missing_number_is_named_once(settings: Settings, tmp_path: Path) -> None:
    text = estimate_text(settings, tmp_path, "noise=sony_a7s2")
    assert "lens_shading, gain_by_colour, column_temporal (column_temporal_std_dn)." in text


def test_sentences_say_none_if_nothing_visible_is_left_out(settings: Settings, tmp_path: Path) -> None:
    text = estimate_text(settings, tmp_path, "noise=nikon_d850", "scene=long_exposure")
    assert "Left out though it would show: none." in text


def test_assumed_numbers_that_are_off_are_named_if_they_would_show(settings: Settings, tmp_path: Path) -> None:
    text = estimate_text(settings, tmp_path, "noise=nikon_d850", "scene=long_exposure", "effects.assumed=off")
    visible = text.split("Left out though it would show: ")[1].split("\n")[0]
    assert visible.startswith("prnu (")
    assert "dark_current (" in visible
    assert "prnu_std is assumed, no source gives it: on only where switched on" in visible


def test_scene_names_what_the_profile_uses_and_ignores(settings: Settings, tmp_path: Path) -> None:
    night = "scene     night: ISO 6400, 0.1 s, 20 °C, light divided by "
    physical = estimate_text(settings, tmp_path / "a", "noise=sony_a7s2", "scene=night")
    assert night in physical
    assert "sony_a7s2 uses light, ISO, time and temperature\n" in physical
    fixed = estimate_text(settings, tmp_path / "b", "noise=sony_a7s2", "scene=night", "noise.iso=800")
    assert "uses light, time and temperature, and ignores ISO (noise.iso is used)\n" in fixed
    two_numbers = estimate_text(settings, tmp_path / "c", "scene=night")
    assert night in two_numbers
    assert "imx385_iso3200 uses only the light, and ignores ISO, time and temperature\n" in two_numbers


def test_dark_scene_with_a_profile_of_two_numbers_is_warned_about(settings: Settings, tmp_path: Path) -> None:
    text = estimate_text(settings, tmp_path / "a", "scene=night")
    warning = text.split("warning   ")[1]
    assert re.match(
        r"scene=night: light is divided by \d+ to \d+, which leaves \d+ to \d+ distinct DN in a clean ", warning
    )
    for profile in ("imx385", "nikon_d850", "sony_a7s2"):
        assert profile in warning
    assert "physical profiles" not in estimate_text(settings, tmp_path / "b", "scene=night", "noise=sony_a7s2")
    assert "warning" not in estimate_text(settings, tmp_path / "c")


@pytest.mark.parametrize(("ratio", "limit_db"), [(100, 54.5), (200, 48.5), (300, 45.0)])
def test_posterised_clean_frames_are_warned_about(
    settings: Settings, tmp_path: Path, ratio: int, limit_db: float
) -> None:
    text = estimate_text(
        settings, tmp_path, "sensor=generic_14bit", "noise=nikon_d850", f"scene.exposure_ratio={ratio}"
    )
    assert f"no denoiser exceeds a PSNR of {limit_db:g} dB" in text
    assert "output.clean_dtype=float32" in text


def test_bright_scenes_have_no_warning_of_few_levels(settings: Settings, tmp_path: Path) -> None:
    assert "warning" not in estimate_text(
        settings, tmp_path, "noise=nikon_d850", "scene=indoor", "sensor=generic_14bit"
    )


def test_failed_source_has_no_bytes_and_a_reason(settings: Settings, tmp_path: Path) -> None:
    (fill(tmp_path / "p", 1) / "000.png").write_bytes(b"")
    estimate = estimate_run(settings(f"source.root={tmp_path / 'p'}"), 1, read_all=True)
    assert (estimate.bytes, estimate.source_estimates[0].reason, estimate.source_estimates[0].levels) == (
        0,
        "empty",
        (),
    )


def test_free_bytes_are_measured_at_the_nearest_existing_folder(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", f"out={tmp_path}/not/yet/there")
    assert estimate_run(config, 1, True).free_bytes == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.1)


def test_estimate_without_readable_sources_has_a_text(settings: Settings, tmp_path: Path) -> None:
    (fill(tmp_path / "p", 1) / "000.png").write_bytes(b"")
    config = settings(f"source.root={tmp_path / 'p'}")
    assert "fails     000.png: empty" in format_estimate(config, estimate_run(config, 1, True))


def test_skipped_effects_are_listed_with_their_reason(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", "noise=none")
    assert "skipped   heteroscedastic: noise=none has no variance" in format_estimate(
        config, estimate_run(config, 1, True)
    )


@pytest.mark.parametrize(("method", "stated"), [("off", True), ("dither", True), ("dither_all", False)])
def test_highlights_next_to_empty_bands_are_stated(
    method: str, stated: bool, settings: Settings, tmp_path: Path
) -> None:
    (tmp_path / "p").mkdir()
    cv2.imwrite(str(tmp_path / "p" / "bright.png"), np.full((20, 20, 3), 254, dtype=np.uint8))
    config = settings(f"source.root={tmp_path / 'p'}", f"source.dequantize={method}", "gains=paper_max")
    text = format_estimate(config, estimate_run(config, 1, True))
    assert ("highlight 100.00% of the sites have highlights next to an empty band" in text) == stated


def test_shadows_without_noise_are_reported(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", "noise=imx385_iso3200_rvdd")
    assert "no noise up to 15.33 DN above black" in format_estimate(config, estimate_run(config, 1, True))


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


def test_negative_b_without_slope_has_a_text(settings: Settings, tmp_path: Path) -> None:
    overrides = ("noise.a=0", "noise.b=-5", "noise.negative_variance=clip")
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", *overrides)
    assert "b_dn2 -5" in format_estimate(config, estimate_run(config, 1, True))


def test_every_effect_of_a_profile_has_line_and_reason(settings: Settings, tmp_path: Path) -> None:
    config = settings("noise=sony_a7s2", "scene=night", f"source.root={fill(tmp_path / 'p', 2)}")
    estimate = format_estimate(config, estimate_run(config, 1, True))
    assert "scene     night: ISO 6400" in estimate
    assert "noise     sony_a7s2: " in estimate
    for effect in EFFECTS:
        assert re.search(rf"^{effect} .* [0-2] of 2 +[\d.]+ +\S", estimate, re.MULTILINE), effect


def test_unmatched_files_are_counted_by_suffix_with_advice(settings: Settings, tmp_path: Path) -> None:
    folder = fill(tmp_path / "p", 1)
    for name in ("a.heic", "b.heic", "c.txt"):
        (folder / name).touch()
    config = settings(f"source.root={folder}")
    estimate = estimate_run(config, 1, True)

    assert estimate.unmatched == {".heic": 2, ".txt": 1}
    line = format_estimate(config, estimate).splitlines()[1]
    assert "3 files are not matched by source.include (2 .heic, 1 .txt); convert " in line


@pytest.mark.parametrize("compiled", [False, True])
def test_compiling_kernels_is_announced_unless_they_are_compiled(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, compiled: bool
) -> None:
    monkeypatch.setattr("unprocess_gen.simulation.self_test.are_compiled", lambda kernels: compiled)
    caplog.set_level("INFO", "unprocess_gen")
    estimate_run(settings("source.limit=1"), 1, True)
    assert caplog.messages == ([] if compiled else ["compiling kernels, once per machine and version"])


def test_second_plan_announces_no_compiling(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Kernels of the tiers are recorded, too: those of the tier fast differ from those of the run."""
    known: set[str] = set()
    monkeypatch.setattr("unprocess_gen.simulation.self_test.has_run", known.__contains__)
    monkeypatch.setattr("unprocess_gen.simulation.self_test.note_run", known.add)
    self_test.failures.cache_clear()
    caplog.set_level("INFO", "unprocess_gen")
    config = settings("source.limit=1")
    tiers = {"fast": read_option(conf_dir() / "accuracy/fast.yaml", AccuracyConfig)}
    for _ in range(2):
        estimate_run(config, 1, True, tiers)
    assert caplog.messages == ["compiling kernels, once per machine and version"]


def test_failed_source_is_listed_with_its_explanation(settings: Settings, tmp_path: Path) -> None:
    (fill(tmp_path / "p", 1) / "000.png").write_bytes(b"no picture")
    config = settings(f"source.root={tmp_path / 'p'}")
    estimate = estimate_run(config, 1, True)

    detail = estimate.source_estimates[0].detail
    assert detail
    assert f"fails     000.png: unsupported\n          {detail}" in format_estimate(config, estimate)


def test_pairs_are_extrapolated_from_the_sample(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', SAMPLE + 4)}", "noise.draws=2")
    assert estimate_run(config, 1, False).pairs == 2 * (SAMPLE + 4)
    assert estimate_run(config, 1, True).pairs == 2 * (SAMPLE + 4)


def test_plan_states_source_and_uncertainty_of_numbers_at_its_isos(run_main: RunMain) -> None:
    for iso, profile in ((100, "Profile-1"), (6400, "Profile-2")):
        done = run_main("plan", "source.limit=1", "noise=nikon_d850", f"noise.iso={iso}", "sensor=generic_14bit")
        text = " ".join(done.out.split())
        assert f"read_std_dn: ELD, {profile}, Gaussian line; uncertainty: " in text
        assert f"row_std_dn: ELD, {profile}, row line; uncertainty: " in text
        assert "black_error_dn: ELD, color_bias of its dark frames; uncertainty: " in text
        assert max(map(len, done.out.splitlines())) <= 160
