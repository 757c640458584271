"""A physical profile in the levels of the default sensor is warned about, with the sensor that fits."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Settings

from unprocess_gen.planning.dark_scene import physical_profiles
from unprocess_gen.planning.sensor_levels import LEVEL_NAMES, fitting_sensor, sensor_warning


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


@pytest.mark.parametrize("overrides", [("sensor=generic_14bit", "noise=sony_a7s2"), ("noise=imx385_iso3200",)])
def test_chosen_sensor_and_two_number_profiles_are_not_warned_about(
    overrides: tuple[str, ...], settings: Settings
) -> None:
    assert sensor_warning(settings(*overrides)) == ""


@pytest.mark.parametrize("verb", [(), ("plan",), ("part", "0/1")], ids=["run", "plan", "part"])
def test_runs_and_plans_warn(verb: tuple[str, ...], run_main: RunMain, tmp_path: Path) -> None:
    done = run_main(*verb, "noise=oppo_reno10x", "source.limit=1", "source.patch=64", "n_jobs=1", f"out={tmp_path}/ds")
    assert done.code == 0
    assert "sensor=oppo_reno10x gives the calibrated levels" in " ".join((done.out + done.err).split())
