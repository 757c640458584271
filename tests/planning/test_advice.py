"""Runs and plans warn of settings without effect, and mark profiles of which a number is overridden."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Settings

import unprocess_gen as ug
from unprocess_gen.planning.advice import (
    LEVEL_NAMES,
    fitting_sensor,
    physical_profiles,
    sensor_warning,
    warnings,
)

ISO = "scene.iso=800: no effect on noise=imx385_iso3200, which holds for one ISO; physical profiles follow"
NUMBER = "noise=imx385_iso3200: settings replace numbers of the profile; the column noise has imx385_iso3200*"
BITS = "sensor.bits=13: white_level_dn=4095 needs 12 bits, so noisy values reach 8191 DN; sensor.bits=12 clips"
CASES = [("scene.iso=800", ISO), ("noise.a=1", NUMBER), ("sensor.bits=13", BITS)]
DARK = "scene=night: light is divided by 100 to 300, but noise=imx385_iso3200 ignores ISO 6400; physical profiles"
LEVELS = "sensor=oppo_reno10x gives the calibrated levels"


@pytest.mark.parametrize("verb", [(), ("plan",), ("part", "0/1")], ids=["run", "plan", "part"])
@pytest.mark.parametrize(("option", "warning"), [("scene=night", DARK), ("noise=oppo_reno10x", LEVELS), *CASES])
def test_runs_and_plans_warn(
    option: str, warning: str, verb: tuple[str, ...], run_main: RunMain, tmp_path: Path
) -> None:
    done = run_main(*verb, option, "source.limit=1", "source.patch=64", "n_jobs=1", f"out={tmp_path}/ds")
    assert done.code == 0
    assert " ".join((done.out + done.err).split()).count(warning) == 1


@pytest.mark.parametrize(
    "overrides",
    [(), ("scene=daylight",), ("scene=night", "noise=sony_a7s2", "sensor=generic_14bit"), ("noise=imx385_iso3200",)],
)
def test_bright_scenes_chosen_sensors_and_physical_profiles_raise_no_warning(
    overrides: tuple[str, ...], settings: Settings
) -> None:
    assert warnings(settings(*overrides)) == []


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


CHOICES = ("noise.draws=2", "noise.law=poisson", "noise.levels=2", "noise.a=6.955588", "+experiment=crvd_like")
MARKED = {
    ("noise.b=1",): "imx385_iso3200*",
    ("noise.white_level_dn=4000",): "imx385_iso3200*",
    ("noise=brooks2019", "noise.a=0.01"): "brooks2019*",
    ("body=sony_a7s2", "noise.full_well_e=5000"): "sony_a7s2*",
    ("body=sony_a7s2", "noise.iso=3200", "noise.assumed=[]", "noise.scatter=unit"): "sony_a7s2",
    ("noise=heteroscedastic", "noise.a=1", "noise.b=4", "noise.bits=13"): "heteroscedastic",
    ("noise.name=mine", "noise.a=1"): "mine",
    **{(choice,): "imx385" if "crvd" in choice else "imx385_iso3200" for choice in CHOICES},
}


@pytest.mark.parametrize("overrides", MARKED)
def test_profile_is_marked_if_a_number_that_it_states_is_overridden(overrides: tuple[str, ...]) -> None:
    assert ug.load_config(overrides).noise.name == MARKED[overrides]


def test_profiles_of_own_files_and_jobs_of_sweeps_are_marked(run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "noise").mkdir()
    (tmp_path / "noise/mine.yaml").write_text("defaults: [imx385_iso1600]\nname: mine\nb: 50\n")
    for override, name in (("noise.a=1", "mine*"), ("noise.b=50", "mine")):
        assert ug.load_config(["noise=mine", override], tmp_path).noise.name == name
    done = run_main("-m", "noise=mine,none", "noise.b=50,60", f"--config-dir={tmp_path}", "--cfg", "job")
    assert re.findall(r"^  name: (\S*mine\S*|\S*none\S*)$", done.out, re.M) == ["mine", "mine*", "none*", "none*"]


def test_mark_is_recorded_and_changes_no_fixed_pattern(run_main: RunMain, tmp_path: Path) -> None:
    common = ("body=sony_a7s2", "source.limit=1", "source.patch=[random,64,1]", "n_jobs=1", "sensor.units=1")
    for out, extra in (("a", ()), ("b", ("noise.full_well_e=90000",))):
        assert run_main(*common, *extra, f"out={tmp_path}/{out}").code == 0
    plain, marked = (ug.RawPairs(tmp_path / out)[0].row for out in "ab")
    assert (plain["noise"], marked["noise"]) == ("sony_a7s2", "sony_a7s2*")
    assert plain["body_key"] == marked["body_key"]
    assert run_main("again", f"{tmp_path}/b", f"out={tmp_path}/c", "n_jobs=1").code == 0
    assert [run_main(verb, f"{tmp_path}/{out}").code for verb, out in (("verify", "b"), ("replay", "c"))] == [0, 0]
    assert run_main(*common, "noise.full_well_e=90000", f"out={tmp_path}/b").out.count("nothing to do") == 1
