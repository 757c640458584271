"""Runs and plans warn of a noise profile that ignores a dark scene, and of one in the levels of the default sensor."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Settings

from unprocess_gen.planning.advice import (
    LEVEL_NAMES,
    dark_scene_warning,
    fitting_sensor,
    physical_profiles,
    sensor_warning,
)

DARK = "scene=night: light is divided by 100 to 300, but noise=imx385_iso3200 ignores ISO 6400; physical profiles"
LEVELS = "sensor=oppo_reno10x gives the calibrated levels"


@pytest.mark.parametrize("verb", [(), ("plan",), ("part", "0/1")], ids=["run", "plan", "part"])
@pytest.mark.parametrize(("option", "warning"), [("scene=night", DARK), ("noise=oppo_reno10x", LEVELS)])
def test_runs_and_plans_warn(
    option: str, warning: str, verb: tuple[str, ...], run_main: RunMain, tmp_path: Path
) -> None:
    done = run_main(*verb, option, "source.limit=1", "source.patch=64", "n_jobs=1", f"out={tmp_path}/ds")
    assert done.code == 0
    assert warning in " ".join((done.out + done.err).split())


@pytest.mark.parametrize(
    "overrides",
    [(), ("scene=daylight",), ("scene=night", "noise=sony_a7s2", "sensor=generic_14bit"), ("noise=imx385_iso3200",)],
)
def test_bright_scenes_chosen_sensors_and_physical_profiles_raise_no_warning(
    overrides: tuple[str, ...], settings: Settings
) -> None:
    assert dark_scene_warning(settings(*overrides)) + sensor_warning(settings(*overrides)) == ""


@pytest.mark.parametrize("profile", physical_profiles())
def test_advice_gives_the_levels_of_the_calibration(profile: str, settings: Settings) -> None:
    config = settings(f"noise={profile}")
    calibrated = {key: getattr(config.noise, key) for key in LEVEL_NAMES}
    is_default = calibrated == {key: getattr(config.sensor, key) for key in LEVEL_NAMES}
    advice = fitting_sensor(calibrated, profile)
    advised = settings(f"noise={profile}", *advice)

    assert bool(sensor_warning(config)) != is_default
    assert is_default or f"; {' '.join(advice)} gives the calibrated levels" in sensor_warning(config)
    assert {key: getattr(advised.sensor, key) for key in LEVEL_NAMES} == calibrated
    assert sensor_warning(advised) == ""
