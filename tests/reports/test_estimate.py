"""The estimate of `plan`: which sources are read, when numbers are exact, and the text."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.photographs import fill
from PIL import Image

from unprocess_gen.pipeline.progress import COMPILING
from unprocess_gen.reports.estimate import SAMPLE, estimate_run
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
    assert (estimate.exact, estimate.pairs, estimate.run.shards) == (is_exact, 2 * count, -(-count // 8))
    assert made.bytes < estimate.bytes < 4 * made.bytes  # the rows of these pairs take less than 8 kB
    lines = format_estimate(estimate).splitlines()
    assert lines[1] == f"profiles  {count if read_all else SAMPLE} sRGB"
    assert lines[3].startswith(f"bytes     about {estimate.bytes:,} in shards, ")


def test_time_has_start_up_and_pairs_by_the_workers_with_a_shard(settings: Settings, tmp_path: Path) -> None:
    root = f"source.root={fill(tmp_path / 'p', 3)}"
    for per_shard, workers in ((1, 2), (8, 1)):
        config = settings(root, f"output.pairs_per_shard={per_shard}", f"out={tmp_path}/not/yet/there")
        estimate = estimate_run(config, 2, read_all=True)
        seconds = sum(source.seconds for source in estimate.source_estimates)
        assert estimate.n_jobs == workers
        assert estimate.pair_seconds == pytest.approx(seconds / workers)
        assert estimate.start_seconds > 0.1  # the imports of this process alone
        assert estimate.seconds == estimate.start_seconds + estimate.pair_seconds
    assert " with 1 worker: start-up " in format_estimate(estimate)
    assert list(tmp_path.iterdir()) == [tmp_path / "p"]
    assert estimate.free_bytes == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.1)


@pytest.mark.parametrize("compiled", [False, True])
def test_compiling_kernels_is_announced_unless_they_are_compiled(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, compiled: bool
) -> None:
    monkeypatch.setattr("unprocess_gen.simulation.self_test.are_compiled", lambda kernels: compiled)
    caplog.set_level("INFO", "unprocess_gen")
    estimate_run(settings("source.limit=1"), 1, True)
    assert caplog.messages == ([] if compiled else [COMPILING])


# Sentences ------------------------------------------------------------------------------------------------------------


def estimate_text(settings: Settings, folder: Path, *overrides: str) -> str:
    """Return the estimate of two photographs, each sentence in one line."""
    config = settings(f"source.root={fill(folder / 'p', 2)}", f"out={folder}/ds", *overrides)
    text = format_estimate(estimate_run(config, 1, True))
    return re.sub(r"\n {10}(?=\S)", " ", text)


@pytest.mark.parametrize("overrides", ["body=nikon_d850 scene=long_exposure", "scene=night"])
def test_estimate_fits_on_one_screen(overrides: str, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("plan", *overrides.split(), f"source.root={fill(tmp_path / 'p', 2)}")
    lines = done.out.splitlines()
    assert len(lines) <= 32
    assert max(map(len, lines)) <= 140


def test_every_effect_has_size_noise_and_reason(settings: Settings, tmp_path: Path) -> None:
    text = estimate_text(settings, tmp_path, "noise=nikon_d850", "scene=daylight", "effects.row=off")
    for effect in EFFECTS:
        assert re.search(rf"^{effect} +(\S+ (DN|pixels)  .*)?[0-2] of 2 +\S", text, re.MULTILINE)
    columns = {line.index(" in ") for line in text.splitlines() if line.startswith("effect ")}
    columns |= {line.index(" pixel ") for line in text.splitlines() if line.startswith("read ")}
    columns |= {line.index(" outliers ") for line in text.splitlines() if line.startswith("hot_pixels ")}
    assert len(columns) == 1, text
    assert re.search(r"^read .* DN  pixel .* DN  2 of 2 +visible$", text, re.MULTILINE)
    assert re.search(r"^prnu .* 2 of 2 +visible \(assumed number\)$", text, re.MULTILINE)
    assert re.search(r"^dark_current .* 0 of 2 +too small to see$", text, re.MULTILINE)
    assert re.search(r"^row .* 0 of 2 +switched off \(it would be visible\)$", text, re.MULTILINE)
    assert re.search(r"^dsnu +0 of 2 +noise=nikon_d850 gives no dsnu_std_e$", text, re.MULTILINE)


def test_read_noise_that_fills_codes_has_this_reason(settings: Settings, tmp_path: Path) -> None:
    flat = tmp_path / "flat.png"
    Image.fromarray(np.full((96, 128, 3), 150, np.uint8)).save(flat)
    text = estimate_text(settings, tmp_path, "noise=nikon_d850", "scene.iso=800", f"source.root={flat}")
    assert re.search(r"^read .* 1 of 1 +fills the codes between electrons, which are \S+ DN apart$", text, re.MULTILINE)


NIGHT = r"scene     night: ISO 6400, 0\.1 s, 20 °C, light divided by "
IGNORED = "; imx385_iso3200 ignores ISO, time, temperature\n"
DARK = r"warning   scene=night: light is divided by \d+ to \d+, but noise=imx385_iso3200 ignores ISO 6400.*nikon_d850"
FEW_LEVELS = "sensor=generic_14bit noise=nikon_d850 scene.exposure_ratio=100"


@pytest.mark.parametrize(
    ("overrides", "present", "absent"),
    [
        ("noise=none", "skipped   heteroscedastic: noise=none has no variance", "warning"),
        ("noise=imx385_iso3200_rvdd", r"no noise up to 15\.33 DN above black", "warning"),
        ("noise.a=0 noise.b=-5 noise.negative_variance=clip", "b_dn2 -5", "warning"),
        ("noise=sony_a7s2 scene=night", NIGHT, "; sony_a7s2 ignores"),
        ("scene=night", f"{NIGHT}[^;]*{IGNORED}", "PSNR of 54"),
        ("scene=night", DARK, "PSNR of 54"),
        ("noise=nikon_d850 scene=indoor sensor=generic_14bit", "scene     indoor", "warning"),
        (FEW_LEVELS, r"no denoiser exceeds a PSNR of 54\.5 dB", "ignores"),
        (f"{FEW_LEVELS} output.clean_dtype=float32", "scene     ", "PSNR"),
    ],
)
def test_sentences_state_the_numbers_and_warn(
    overrides: str, present: str, absent: str, settings: Settings, tmp_path: Path
) -> None:
    text = estimate_text(settings, tmp_path, *overrides.split())
    assert re.search(present, text)
    assert absent not in text


def test_failed_source_has_no_bytes_and_a_reason(settings: Settings, tmp_path: Path) -> None:
    (fill(tmp_path / "p", 1) / "000.png").write_bytes(b"no picture")
    config = settings(f"source.root={tmp_path / 'p'}")
    estimate = estimate_run(config, 1, read_all=True)
    [source] = estimate.source_estimates
    assert (estimate.bytes, source.levels) == (0, ()) and source.failure is not None
    assert f"fails     000.png: unsupported\n          {source.failure.text}" in format_estimate(estimate)


def test_every_noise_level_is_listed(run_main: RunMain, tmp_path: Path) -> None:
    levels = "noise.levels=[{a: 1, b: 2},{a: 30, b: 900}]"
    text = run_main("plan", "source.limit=1", "noise=heteroscedastic", levels, f"out={tmp_path}/ds").out
    assert "a=1, b=2; a=30, b=900 (" in text
    assert "a_dn 1 to 30, b_dn2 2 to 900" in text

    text = run_main("plan", "source.limit=1", "noise=nikon_d850", "noise.levels=[100,6400]", f"out={tmp_path}/ds").out
    assert "ISO 100 to 6400" in text
    assert " of 2 " in text


def test_unmatched_files_are_counted_by_suffix_with_advice(settings: Settings, tmp_path: Path) -> None:
    folder = fill(tmp_path / "p", 1)
    for name in ("a.jxl", "b.jxl", "c.txt"):
        (folder / name).touch()
    config = settings(f"source.root={folder}")
    line = format_estimate(estimate_run(config, 1, True)).splitlines()[1]
    assert "3 files are not matched by source.include (2 .jxl, 1 .txt); convert " in line


def test_sources_of_numbers_are_stated_on_request(run_main: RunMain) -> None:
    overrides = ("source.limit=1", "noise=nikon_d850", "noise.iso=100", "sensor=generic_14bit")
    text = " ".join(run_main("plan", "--numbers", *overrides).out.split())
    assert "read_std_dn: ELD, Profile-1, Gaussian line; uncertainty: " in text
    assert "black_error_dn: ELD, color_bias of its dark frames; uncertainty: " in text
    assert "assumed, without a source: prnu_std, " in text
    assert "uncertainty" not in run_main("plan", *overrides).out
