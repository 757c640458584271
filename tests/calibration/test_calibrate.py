"""A simulated camera is measured; real frames give the published numbers; the profile is used as it was written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from helpers.captures import Camera, record
from helpers.commands import RunMain

Estimates = dict[tuple[str, float | None, str | None], dict[str, Any]]

EMVA = next(
    (folder for parent in Path(__file__).parents if (folder := parent / "shared/data/emva1288_ccd").is_dir()), None
)


def estimates(profile: Path) -> Estimates:
    rows = json.loads(profile.with_suffix(".json").read_text())
    return {(row["name"], row["iso"], row["site"]): row for row in rows}


@pytest.fixture
def calibrated(run_main: RunMain, tmp_path: Path) -> Any:
    """Return a function that calibrates a folder and returns the profile."""

    def calibrate(folder: Path, *flags: str, name: str = "mine") -> Path:
        profile = tmp_path / "mine" / "noise" / f"{name}.yaml"
        profile.parent.mkdir(parents=True, exist_ok=True)
        done = run_main("calibrate", folder, "--to", profile, *flags)
        assert done.code == 0, done.err
        return profile

    return calibrate


def test_simulated_camera_is_measured(calibrated: Any, run_main: RunMain, tmp_path: Path) -> None:
    """Tolerances: 4 standard errors of the numbers of frames and sites."""
    camera = Camera("sony_a7s2", 3200, side=256)
    folder = record(
        tmp_path / "captures", camera, darks=6, long_s=(8.0,), levels=(0.02, 0.05, 0.09, 0.15, 0.2, 0.25, 0.3)
    )
    page = tmp_path / "page.html"
    profile = calibrated(folder, "--keep-darks", str(tmp_path / "darks"), "--report", str(page))
    assert "Next to known sensors" in page.read_text(encoding="utf-8")
    found, truth = estimates(profile), camera.truth

    def relative(name: str, true: float, iso: float | None = 3200) -> float:
        return abs(float(found[name, iso, None]["value"]) / true - 1)

    assert relative("dn_per_e", truth["dn_per_e"]) <= 0.008
    assert relative("read_std_dn", truth["read_std_dn"]) <= 0.005
    assert relative("row_std_dn", truth["row_std_dn"]) <= 0.09
    assert relative("prnu_std", truth["prnu_std"], None) <= 0.25
    assert relative("dark_e_per_s", truth["dark_e"], None) <= 0.02
    assert abs(found["read_shape", 3200, None]["value"] - truth["read_shape"]) <= 0.02
    assert abs(found["black_error_dn", 3200, "R"]["value"] - truth["black_error_dn_00"]) <= 0.05
    assert found["full_well_e", None, None]["value"] is None

    out = tmp_path / "ds"
    settings = ["--config-dir", profile.parents[1], "noise=mine", "scene.iso=3200", "sensor=generic_14bit"]
    done = run_main(*settings, "source.limit=1", f"out={out}", f"noise.dark_frames={tmp_path / 'darks' / 'iso3200'}")
    assert done.code == 0, done.err
    assert run_main("verify", out, "--noise").code == 0


@pytest.mark.skipif(EMVA is None, reason="the real frames of EMVA 1288 are not on this machine")
def test_real_frames_give_published_numbers(calibrated: Any) -> None:
    """K: 0.2808 by the documentation of the frames, 0.283 to 0.291 by range of the fit; row noise 0.505 DN."""
    found = estimates(calibrated(EMVA))
    gain = found["dn_per_e", 100, None]
    assert gain["low"] <= 0.283 <= 0.291 <= gain["high"]
    assert found["dn_per_e_emva1288", 100, None]["value"] == pytest.approx(0.2808, rel=0.01)
    assert found["row_std_dn", 100, None]["value"] == pytest.approx(0.505, rel=0.05)
