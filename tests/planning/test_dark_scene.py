"""Runs warn of dark scenes whose noise profile has two numbers, because such a profile does not follow the scene."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Settings

from unprocess_gen.config.validation import validate_config
from unprocess_gen.planning.dark_scene import dark_scene_warning

WARNING = "scene=night: light is divided by 100 to 300, but noise=imx385_iso3200 ignores ISO 6400; "


@pytest.mark.parametrize("verb", [(), ("part", "0/1")])
def test_run_in_a_dark_scene_warns_of_two_numbers(verb: tuple[str, ...], run_main: RunMain, tmp_path: Path) -> None:
    done = run_main(*verb, "source.limit=1", "scene=night", "n_jobs=1", f"out={tmp_path / 'ds'}")
    assert done.code == 0, done.err
    assert WARNING in done.err
    assert "sony_a7s2" in done.err


@pytest.mark.parametrize("overrides", [(), ("scene=daylight",), ("scene=night", "noise=sony_a7s2")])
def test_bright_scenes_and_physical_profiles_raise_no_warning(overrides: tuple[str, ...], settings: Settings) -> None:
    config = settings(*overrides)
    validate_config(config)
    assert dark_scene_warning(config) == ""
