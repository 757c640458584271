"""Gains of a light: published chromaticities, presets of cameras, and what is recorded and refused."""

from __future__ import annotations

import math
import statistics
from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings

from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.reference.light import LIGHTS, chromaticity

CIE = {"d65": (0.31272, 0.32903), "d50": (0.34567, 0.35850), "a": (0.44757, 0.40745)}
BODIES = ("sony_a7s2", "nikon_d850", "canon_5d4", "canon_70d", "canon_700d")
# 5 % and 95 % of the presets of some 440 cameras, red and blue (darktable, wb_presets.json)
PRESETS = {
    "daylight": ((1.51, 2.64), (1.22, 1.91)),
    "tungsten": ((0.97, 1.69), (1.98, 3.40)),
    "shade": ((1.80, 3.16), (1.00, 1.61)),
}


@pytest.mark.parametrize("name", CIE)
def test_standard_lights_have_the_chromaticity_of_cie(name: str) -> None:
    assert chromaticity(LIGHTS[name], LIGHTS[name].low_k, 0.0) == pytest.approx(CIE[name], abs=4e-4)


@pytest.mark.parametrize("light", PRESETS)
@pytest.mark.parametrize("body", BODIES)
def test_median_gains_are_within_the_presets_of_cameras(body: str, light: str, settings: Settings) -> None:
    config = settings(f"camera={body}", "gains=by_light", f"gains.light={light}")
    cameras = [plan_image(config, f"{number:064x}").camera for number in range(200)]
    red, blue = [one.red_gain for one in cameras], [one.blue_gain for one in cameras]
    for gains, (low, high) in zip((red, blue), PRESETS[light], strict=True):
        assert low * 0.95 <= statistics.median(gains) <= high * 1.05
    assert statistics.correlation([one.cct_k for one in cameras], red) > 0.5
    assert statistics.correlation(red, blue) < 0


def test_scene_mixes_lights_by_its_shares(settings: Settings) -> None:
    config = settings("gains=by_light", "scene=night")
    lights = [plan_image(config, f"{number:064x}").camera.light for number in range(400)]
    deviation = 5 * math.sqrt(0.8 * 0.2 / 400)
    assert lights.count("tungsten") / 400 == pytest.approx(0.8, abs=deviation) and set(lights) == {
        "tungsten",
        "daylight",
    }


def test_other_draws_do_not_move(settings: Settings) -> None:
    one, other = (plan_image(settings(gains), "0" * 64) for gains in ("gains=brooks2019", "gains=by_light"))
    assert (one.camera.rgb2cam, one.camera.inverse_rgb_gain) == (other.camera.rgb2cam, other.camera.inverse_rgb_gain)
    assert one.noise == other.noise and one.camera.light == "" and one.camera.cct_k == 0


def test_rows_have_light_and_temperature(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "gains=by_light", "source.limit=2", "source.patch=64")
    plans = [plan_from_row(row) for row in read_rows(tmp_path / "ds" / "manifest.csv")]
    assert [plan.camera.light for plan in plans] == ["daylight"] * len(plans)
    assert all(5000 <= plan.camera.cct_k <= 5800 for plan in plans)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["gains=by_light", "gains.red=2"], "gains.red=2: gains.light=scene gives this gain"),
        (["gains.red=null"], "gains.red=null: "),
        (["gains=by_light", "gains.light=moon"], "gains.light=moon: expected one of daylight"),
        (["gains=by_light", "scene.light=null"], "scene.light=null: scene=daylight states no light"),
        (["gains=by_light", "scene.light=[a,0.5]"], "scene.light=[a, 0.5]: expected one of daylight"),
        (
            ["gains=by_light", "camera=custom", "camera.xyz2cam=[-1,0,0,0,1,0,0,0,1]"],
            "gains.light=daylight: the camera",
        ),
    ],
)
def test_wrong_lights_are_refused(overrides: list[str], message: str, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("plan", *overrides, f"out={tmp_path}/ds")
    assert done.code == 2 and message in done.err and len(done.err.splitlines()) == 1
