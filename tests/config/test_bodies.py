"""A body sets matrix, levels and noise of one real camera; what is given in addition to it wins."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from helpers.cases import slow_except
from helpers.datasets import Settings

import unprocess_gen as ug
from unprocess_gen.config.option_files import conf_dir, group_options
from unprocess_gen.config.serialization import dataset_yaml, read_option
from unprocess_gen.planning.advice import body_sentence, physical_profiles

BODIES = group_options("body")
# LibRaw 0.22.2, colordata.cpp: XYZ to camera times 10,000
LIBRAW = {
    "sony_a7s2": (5838, -1430, -246, -3497, 11477, 2297, -748, 1885, 5778),
    "nikon_d850": (10405, -3755, -1270, -5461, 13787, 1793, -1040, 2015, 6785),
    "canon_5d4": (6446, -366, -864, -4436, 12204, 2513, -952, 2496, 6348),
    "canon_70d": (7034, -804, -1014, -4420, 12564, 2058, -851, 1994, 5758),
    "canon_700d": (6602, -841, -939, -4472, 12458, 2247, -975, 2039, 6148),
}


def test_every_physical_profile_has_a_body() -> None:
    assert set(BODIES) == set(physical_profiles())


@pytest.mark.parametrize("body", slow_except(("sony_a7s2", "oppo_reno10x"), BODIES))
def test_body_has_matrix_and_noise_of_one_camera(body: str, settings: Settings) -> None:
    config = settings(f"body={body}")
    assert config.noise == read_option("noise", body).__class__(**vars(config.noise)) and config.noise.name == body
    if body in LIBRAW:
        assert config.camera.xyz2cam == tuple(number / 10_000 for number in LIBRAW[body])
        assert config.camera.name == body
    assert ("camera" in config.body.missing) == (body not in LIBRAW)


def test_settings_given_with_a_body_win() -> None:
    config = ug.load_config(["body=sony_a7s2", "camera=convex", "sensor.bits=15", "noise.draws=2", "noise.prnu_std=0"])
    assert (config.camera.name, config.sensor.bits, config.noise.prnu_std) == ("convex", 15, 0)
    assert body_sentence(config) == ""


def test_config_yaml_is_that_of_the_three_options() -> None:
    options = [f"{group}=nikon_d850" for group in ("camera", "sensor", "noise")]
    assert dataset_yaml(ug.load_config(["body=nikon_d850"])) == dataset_yaml(ug.load_config(options))
    assert dataset_yaml(ug.load_config(["body=null"])) == dataset_yaml(ug.load_config([]))


def test_recipe_with_a_body_takes_another_from_the_command_line() -> None:
    recipe = "+experiment=eld_body"
    assert ug.load_config([recipe]).body.name == "nikon_d850"
    other = ug.load_config([recipe, "body=canon_70d"])
    assert (other.camera.name, other.noise.name) == ("canon_70d", "canon_70d")
    assert ug.load_config([recipe, "body=null"]).noise.name == "imx385_iso3200"


def test_own_body_uses_its_own_options(tmp_path: Path) -> None:
    for group, text in {
        "body": "",
        "camera": (conf_dir() / "camera/canon_70d.yaml").read_text(encoding="utf-8"),
    }.items():
        (tmp_path / group).mkdir()
        (tmp_path / group / "mine.yaml").write_text(text, encoding="utf-8")
    own = {"defaults": [{"override /camera": "mine"}], "body": {"name": "mine", "missing": ["noise"]}}
    (tmp_path / "body" / "mine.yaml").write_text("# @package _global_\n" + yaml.safe_dump(own), encoding="utf-8")
    config = ug.load_config(["body=mine", "camera.name=other"], tmp_path)
    assert config.camera.name == "other"
    assert "no noise profile of it is published, so noise=imx385_iso3200 applies" in body_sentence(config)
