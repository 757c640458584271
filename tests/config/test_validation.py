"""Configuration: values of ``conf/`` against their sources, refused values and their messages, ``config.yaml``."""

from __future__ import annotations

import dataclasses
import math
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.commands import RunMain
from helpers.datasets import Settings
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import unprocess_gen as ug
from unprocess_gen.config.distributions import parse_distribution
from unprocess_gen.config.option_files import ADDED_GROUPS, conf_dir
from unprocess_gen.config.schema import GROUPS, BranchConfig, Config, replaced
from unprocess_gen.config.serialization import (
    dataset_yaml,
    differences,
    parse_dataset_yaml,
    read_dataset_yaml,
)
from unprocess_gen.config.settings import all_settings, settings_of
from unprocess_gen.config.validation import validate_config
from unprocess_gen.config.yaml_files import parse_yaml_mapping
from unprocess_gen.core.arrays import FLOAT32, MOSAIC, PACKED, UINT16
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import Choice
from unprocess_gen.planning.plan import plan_image, plan_pairs
from unprocess_gen.simulation import tone_curves
from unprocess_gen.simulation.facts import Facts
from unprocess_gen.simulation.reference import cfa, unprocess
from unprocess_gen.sources.image.decode import ICC_CHOICES

FILES = sorted(
    path.relative_to(conf_dir()) for path in conf_dir().glob("*/*.yaml") if path.parent.name not in ADDED_GROUPS
)
MATRIX = "[0.7, 0.1, -0.1, -0.4, 1.2, 0.2, -0.1, 0.2, 0.6]"
NEEDS = {
    "camera/custom.yaml": [f"camera.xyz2cam={MATRIX}"],
    "noise/heteroscedastic.yaml": ["noise.a=3.5", "noise.b=12"],
    "body/imx385.yaml": ["noise.iso=3200"],
    "source/raw.yaml": [f"source.root={conf_dir()}"],
    "sensor/source.yaml": ["source.kind=raw", f"source.root={conf_dir()}", "source.include=[x.dng]"],
    "noise/imx385.yaml": ["noise.iso=3200"],  # the ISO of scene=daylight is not calibrated
}
KINDS = {"source/raw.yaml": "raw", "sensor/source.yaml": "raw", "source/linear.yaml": "synthetic_linear"}
SHA256 = "0" * 64


# Options in conf/ -----------------------------------------------------------------------------------------------------


def test_every_option_is_valid(settings: Settings) -> None:
    for file in FILES:  # a message names the option's key and value
        validate_config(settings(f"{file.parent}={file.stem}", *NEEDS.get(str(file), [])))


OPTIONS = """
source: default
body: sony_a7s2 nikon_d850 canon_5d4 canon_70d canon_700d oppo_reno10x imx385
camera: sony_a7s2 nikon_d850 canon_5d4 canon_70d canon_700d
camera: convex sony_a7r olympus_em10 sony_rx100 nexus_6p choice identity custom
gains: by_light brooks2019 fixed paper_min paper_max paper_literal fig6_top fig6_bottom unity
isp: smoothstep_gamma22 gamma22 srgb linear
sensor: sony_a7s2 nikon_d850 canon_5d4 canon_70d canon_700d oppo_reno10x imx385_gbrg
sensor: imx385_12bit generic_10bit generic_12bit generic_14bit generic_16bit
noise: imx385_iso1600 imx385_iso3200 imx385_iso6400 imx385_iso12800 imx385_iso25600 imx385_iso3200_rvdd brooks2019
noise: imx385_rvdd heteroscedastic none imx385 sony_a7s2 nikon_d850 canon_5d4 canon_70d canon_700d oppo_reno10x
scene: daylight indoor long_exposure low_light night video_night
effects: default
output: webdataset
executor: local dask
experiment: ipol_demo brooks2019_training crvd_like eld_low_light eld_body raw_low_light raw_training hdr_scenes
experiment: many_highlights no_highlights ntire_burst_sr bracket_hdr
sweep: iso_ladder cameras camera_by_iso gain_extremes paper_figure6
"""
"""Options that commands of users name."""


def test_options_are_those_of_the_contract() -> None:
    options = {folder.name: {file.stem for file in folder.glob("*.yaml")} for folder in conf_dir().glob("*/")}
    for line in OPTIONS.strip().splitlines():
        group, names = line.split(": ")
        assert set(names.split()) <= options[group], group


@pytest.mark.parametrize("name", ["photo.jpg", "photo.JPEG", "photo.png", "a.tif", "a.tiff", "a.webp", "a.bmp"])
def test_default_globs_match_every_image_format(name: str, settings: Settings, tmp_path: Path) -> None:
    from unprocess_gen.sources.listing import list_folder

    (tmp_path / name).write_bytes(b"x")
    assert len(list_folder(str(tmp_path), settings().source.include, True, None).sources) == 1


GAINS = {
    "brooks2019": (("uniform", 1.9, 2.4), ("uniform", 1.5, 1.9), ("truncated_normal", 0.8, 0.1, 0.5, 1.1)),
    "fixed": (2.15, 1.7, 0.8),
    "paper_min": (1.9, 1.5, 1 / 0.85),
    "paper_max": (2.4, 1.9, 1 / 2.05),
    "paper_literal": (("uniform", 1.9, 2.4), ("uniform", 1.5, 1.9), ("inverse_truncated_normal", 0.8, 0.1, 0.5, 1.1)),
    "fig6_top": (1.9, 1.5, 0.85),
    "fig6_bottom": (2.4, 1.9, 2.05),
    "unity": (1, 1, 1),
}


@pytest.mark.parametrize("name", GAINS)
def test_gains_are_those_of_the_contract(name: str, settings: Settings) -> None:
    gains = settings(f"gains={name}").gains
    assert (gains.red, gains.blue, gains.inverse_rgb) == GAINS[name]
    assert gains.highlight == ("none" if name == "unity" else "per_channel")
    assert gains.threshold == 0.9


# Refused values -------------------------------------------------------------------------------------------------------

REFUSED = [
    ("seed=-1", r"seed=-1: expected 0 to 9223372036854775807"),
    ("n_jobs=0", r"n_jobs=0: expected 1 to 1024 or -1"),
    (
        "executor.address=tcp://host:8786",
        r"executor.address=tcp://host:8786: .*connects to no scheduler; set executor=dask",
    ),
    ("out=''", r"out='': expected the name of a folder"),
    ("source.root=/no/such/folder", r"source.root=/no/such/folder: no such folder"),
    ("source.include=[]", r"source.include=\[\]: expected at least one pattern"),
    ("camera.law=fixed", r"camera.name=convex: expected one of nexus_6p, sony_a7r, olympus_em10, sony_rx100"),
    (
        f"camera.xyz2cam={MATRIX}",
        r"camera.xyz2cam=\[0.7, .*\]: a matrix needs camera.law=custom, not convex; set camera=custom",
    ),
    ("camera.law=custom", r"camera.xyz2cam=null: camera=custom needs a matrix; expected nine numbers"),
    ("camera.law=custom;camera.xyz2cam=[1,2,3]", r"camera.xyz2cam=\[1.0, 2.0, 3.0\]: .*nine"),
    ("camera.law=custom;camera.xyz2cam=[1,2,3,2,4,6,1,1,1]", r"camera.xyz2cam=\[1.0, 2.0, .*\]: .*invert"),
    ("camera.law=custom;camera.xyz2cam=[nan,0,0,0,1,0,0,0,1]", r"camera.xyz2cam=\[nan, 0.0, .*\]: "),
    ("gains.red=0", r"gains.red=0: expected a gain above 0"),
    ("camera.weights=[0,0,0,0]", r"camera.weights=\[0.0, .*\]: their sum is 0"),
    ("camera=sony_a7r;camera.weights=[1,0,0,0]", r"camera.weights=.*: weights need camera.law=convex, not fixed"),
    ("camera.weights=[1,1]", r"camera.weights=\[1.0, 1.0\]: expected a list of 4 numbers"),
    ("body.missing=[a]", r"body.missing=\[a\]: expected a list of camera, sensor, noise"),
    (
        "camera=custom;camera.name=sony_a7r;camera.xyz2cam=[1,0,0,0,1,0,0,0,1]",
        r"camera.name=sony_a7r: is the name of",
    ),
    ("gains.red=nan", r"gains.red=nan: expected a finite number or a distribution: \[uniform, lowest, highest\]"),
    ("gains.red=true", r"gains.red=true: expected a finite number or a distribution"),
    ("gains.red=[normal,2,1]", r"gains.red=\[normal, 2, 1\]: expected a finite number or a distribution: \[uniform"),
    ("gains.red=[uniform,2]", r"gains.red=\[uniform, 2\]: expected finite numbers: \[uniform, lowest, highest\]"),
    ("gains.red=[uniform,2,1]", r"gains.red=\[uniform, 2, 1\]: expected the lowest value below the highest"),
    ("gains.blue=[truncated_normal,1,0,0.5,2]", r"gains.blue=.*: expected a standard deviation above 0"),
    ("gains.blue=[truncated_normal,1,0.1,0.5,1.7]", r"gains.blue=.*: expected limits within six standard dev"),
    ("gains.inverse_rgb=[inverse_truncated_normal,1,1,-1,2]", r"gains.inverse_rgb=.*: expected a gain above 0"),
    ("gains.red=[inverse_truncated_normal,1,1,0.5,2]", r"gains.red=.*: expected a finite number or a distribution"),
    ("gains.highlight=clip", r"gains.highlight=clip: expected one of per_channel, gray_mean, none"),
    ("gains.threshold=1", r"gains.threshold=1.0: expected 0 up to, but not including, 1"),
    ("isp.gamma=0", r"isp.gamma=0: expected a number from 0.1 to 10, or srgb"),
    ("isp.gamma=rec709", r"isp.gamma=rec709: expected a number from 0.1 to 10, or srgb"),
    ("sensor.bits=17", r"sensor.bits=17: expected 1 to 16"),
    ("sensor.black_level_dn=4095", r"sensor.black_level_dn=4095: expected 0 to 4094"),
    ("sensor.white_level_dn=240", r"sensor.white_level_dn=240: expected 241 to 4095 \(above the black level"),
    ("sensor.clip=none", r"sensor.clip=none: output.dtype=uint16 holds no values beyond .*; set output.dtype=float32"),
    ("noise.units=null", r"noise.units=null: expected one of dn, normalized"),
    ("noise.bits=null", r"noise.units=dn: imx385_iso3200 needs bits, .* got null, 240, 4095"),
    ("noise.white_level_dn=240", r"noise.white_level_dn=240: expected 241 to 4095"),
    ("noise.a=nan", r"noise.a=nan: expected a finite number"),
    ("noise.a=-1", r"noise.a=-1: expected a slope of the variance of 0 or more"),
    ("noise.a=[log_uniform,0,1]", r"noise.a=\[log_uniform, 0, 1\]: expected a lowest value above 0"),
    ("noise=brooks2019;noise.a=0", r"noise.a=0: expected more than 0, because noise.b depends on ln a"),
    ("noise=brooks2019;noise.b=[log_linear_in_a,2,1,-1]", r"noise.b=.*: expected a slope of -10 to 10"),
    ("noise=brooks2019;noise.black=included", r"noise.black=included: normalized units have black at 0"),
    ("noise.b=-1", r"noise.b=-1: variance at black is -1; expected 0 or more; set noise.negative_variance=clip"),
    ("noise=imx385_iso3200_rvdd;noise.negative_variance=refuse", r"noise.b=-2043.51144: variance at black is -122"),
    ("output.dtype=float32;effects.quantise=on", r"effects.quantise=on: output.dtype=float32 is not rounded; set "),
    ("output.pairs_per_shard=0", r"output.pairs_per_shard=0: expected 1 to 1000000"),
    ("noise=imx385", r"scene.iso=100: noise=imx385 is calibrated for ISO 1600, 3200, .* give noise.iso="),
    (
        "noise=imx385_iso3200_rvdd;noise.law=poisson",
        r"noise.law=poisson: expected noise.black=subtracted and noise.b of 0",
    ),
    ("noise=sony_a7s2;noise.prnu_std=0.6", r"noise.prnu_std=0.6: expected 0 to 0.5"),
    ("noise=sony_a7s2;noise.dark_e_per_s=1e6;scene.exposure_s=1e5", r"noise.dark_e_per_s=1000000.0: more than 1e\+09"),
    ("effects.all=maybe", r"effects.all=maybe: expected one of auto, on, off"),
    ("noise=oppo_reno10x;effects.row=on", r"effects.row=on: noise=oppo_reno10x gives no row_std_dn"),
    ("noise=imx385_iso3200;noise.prnu_std=2", r"noise.prnu_std=2.0: expected 0 to 0.5 or null"),  # used or not
    ("noise=imx385_iso3200;scene.iso=-1", r"scene.iso=-1: expected more than 0, up to 1e\+07"),
    ("noise=nikon_d850;noise.a=[uniform,2,1]", r"noise.a=\[uniform, 2, 1\]: expected the lowest value below"),
    ("noise=nikon_d850;scene.iso=-1", r"scene.iso=-1: expected more than 0, up to 1e\+07"),
    ("scene.exposure_ratio=0", r"scene.exposure_ratio=0: expected 0.001 to 1e\+06"),
    ("scene.temperature_c=[choice]", r"scene.temperature_c=\[choice\]: expected at least one value"),
]


def test_bad_value_is_refused_with_key_value_and_expectation(settings: Settings) -> None:
    for overrides, sentence in REFUSED:
        with pytest.raises(ConfigError) as error:
            validate_config(settings(*overrides.split(";")))
            pytest.fail(f"{overrides}: accepted")
        assert re.match(sentence, str(error.value)), f"{overrides}: {error.value}"
        assert "\n" not in str(error.value), overrides


ACCEPTED = [
    "seed=9223372036854775807", "n_jobs=1024", "gains.red=1e-3", "gains.red=[uniform,0.001,9]", "gains.threshold=0",
    "gains.threshold=0.999", "isp.gamma=10", "sensor.black_level_dn=4094", "sensor.white_level_dn=241",
    "noise.a=[uniform,0,1]", "output.pairs_per_shard=1000000", "noise.bits=14",
]  # fmt: skip


PATHS = {"out": "x://y", "source.list": "none", "source.root": "none", "noise.dark_frames": "none"}
"""Keys whose values may be any text, with paths that cannot be used."""

TEXTS = dict.fromkeys(("camera.name", "noise.name", "scene.name", "body.name", "executor.address"), "'a b'") | PATHS
"""Keys that take texts, with a text that is none of theirs."""

BRANCH = {"iso": "[100, 200]", **dict.fromkeys(("dn_per_e", "read_std_dn", "row_std_dn", "column_std_dn"), "1")}


@pytest.mark.parametrize("wrong", ["banana", pytest.param(("[[[]]]", "{x: [1]}"), marks=pytest.mark.slow)])
@pytest.mark.parametrize("key", all_settings(Config))
def test_every_key_refuses_a_wrong_type_and_a_wrong_word_whether_it_is_used_or_not(key: str, wrong: Any) -> None:
    for value in [TEXTS.get(key, wrong)] if isinstance(wrong, str) else [PATHS.get(key, text) for text in wrong]:
        with pytest.raises(ConfigError, match=rf"^{re.escape(key)}(\[0\])?(=|: expected|\.x: no such key)") as refused:
            ug.load_config([f"{key}={value}"])
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("key", settings_of(BranchConfig))
def test_every_key_of_a_branch_refuses_a_wrong_type_and_a_wrong_word(key: str) -> None:
    for value in ("banana", "{x: [1]}"):
        branch = ", ".join(f"{name}: {number}" for name, number in (BRANCH | {key: value}).items())
        with pytest.raises(ConfigError, match=rf"noise\.branches.*\b{key}(=|: )"):
            ug.load_config([f"noise.branches=[{{{branch}}}]"])


@pytest.mark.parametrize("group", [*GROUPS, ""])
def test_wrong_word_ends_a_run_and_a_plan_with_exit_code_2(group: str, run_main: RunMain, tmp_path: Path) -> None:
    key = next(key for key in all_settings(Config) if key.rpartition(".")[0] == group and key not in TEXTS)
    for verb in ((), ("plan",)):
        done = run_main(*verb, f"{key}=banana")
        assert (done.code, done.out, done.err.count("\n"), list(tmp_path.iterdir())) == (2, "", 1, [])
        assert done.err.startswith(f"gen-dataset: {key}=banana: ")


def test_limits_of_ranges_are_accepted(settings: Settings) -> None:
    for override in ACCEPTED:  # a message names key and value
        validate_config(settings(override))


def test_single_picture_is_accepted_as_source_root(settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    validate_config(settings(f"source.root={tmp_path}/file"))


@pytest.mark.parametrize(("key", "good", "bad"), [("source.patch", 2, 2.0), ("source.limit", 1, True)])
def test_value_is_refused_after_an_equal_one_was_accepted(
    key: str, good: object, bad: object, settings: Settings
) -> None:
    validate_config(replaced(settings(), {key: good}))
    with pytest.raises(ConfigError, match=f"{key}={str(bad).lower()}"):
        validate_config(replaced(settings(), {key: bad}))


# config.yaml ----------------------------------------------------------------------------------------------------------


def test_config_yaml_round_trip_keeps_the_text(settings: Settings, tmp_path: Path) -> None:
    for file in FILES:
        text = dataset_yaml(settings(f"{file.parent}={file.stem}", *NEEDS.get(str(file), [])))
        (tmp_path / "config.yaml").write_text(text, encoding="utf-8")
        again, kind = read_dataset_yaml(tmp_path / "config.yaml")
        assert kind == KINDS.get(str(file), "synthetic"), file
        assert dataset_yaml(again) == text, file


def test_keys_that_format_1_gained_may_be_missing(settings: Settings, tmp_path: Path) -> None:
    text = dataset_yaml(settings())
    (tmp_path / "config.yaml").write_text(older := text.replace("  exclude: []\n", ""), encoding="utf-8")
    assert older != text and differences(text, older) == []
    assert dataset_yaml(read_dataset_yaml(tmp_path / "config.yaml")[0]) == text


def test_config_yaml_contains_source_kind_but_no_path(settings: Settings, tmp_path: Path) -> None:
    loaded = yaml.safe_load(dataset_yaml(settings(f"source.root={tmp_path}")))
    assert loaded["source"]["kind"] == "folder"
    assert str(tmp_path) not in dataset_yaml(settings(f"source.root={tmp_path}"))


def test_config_yaml_has_the_keys_that_decide_data(settings: Settings) -> None:
    omitted = {"out", "n_jobs", "self_test", "check_disk", "source.root", "source.list", "source.max_failed"}
    omitted |= {"noise.dark_frames", "noise.provenance", "body.name", "body.missing"}
    omitted |= {"source.primaries", "source.burst", "scene.ev"}  # unless they have a value
    omitted |= {"executor.kind", "executor.address", "executor.no_workers_s"}
    loaded = yaml.safe_load(dataset_yaml(settings()))
    groups = {group: loaded.get(group, {}) for group in GROUPS} | {"source.raw": loaded["source"].pop("raw")}
    keys = {f"{group}.{name}" for group, values in groups.items() for name in values} | (loaded.keys() - groups.keys())
    assert keys | omitted == all_settings(Config).keys()
    assert not keys & omitted


def test_schema_and_option_files_have_the_same_defaults(settings: Settings) -> None:
    """Except of the noise, because each profile must state its numbers and levels."""
    assert dataclasses.replace(Config(), noise=settings().noise) == settings()


@pytest.mark.parametrize(
    ("overrides", "decided"),
    [
        (("noise=imx385_iso3200",), "noisy"),
        (("noise=nikon_d850",), "white"),
        (("noise=nikon_d850", "sensor.clip=black"), "white"),
        (("noise=nikon_d850", "output.dtype=float32", "sensor.clip=none", "noise.full_well_e=null"), "noisy"),
        (("noise=nikon_d850", "output.dtype=float32", "sensor.clip=none", "noise.full_well_e=60000"), "white"),
        (("noise=nikon_d850", "sensor.saturated=noisy"), "noisy"),
    ],
)
def test_auto_pins_saturated_sites_of_limited_physical_profiles(
    overrides: tuple[str, ...], decided: str, settings: Settings
) -> None:
    config = settings(*overrides)
    validate_config(config)
    assert plan_image(config, "0" * 64, facts=Facts(64, 48, 256, 0, 255)).sensor.saturated_as == decided


SPELLINGS = [
    ("gains.red=2", "gains.red=2.0"),
    ("gains.red=[uniform,1,2]", "gains.red=[uniform,1.0,2.0]"),
    ("scene.exposure_ratio=100", "scene.exposure_ratio=100.0"),
    ("noise.iso=[choice,100,800]", "noise.iso=[choice,100.0,8e2]"),
    ("noise.a=3", "noise.a=3.0"),
    ("noise.b=30", "noise.b=3e1"),
    ("isp.gamma=2", "isp.gamma=2.0"),
    ("gains.threshold=0", "gains.threshold=0.0"),
    ("source.dequantize=off", "source.dequantize=false"),
    ("effects.heteroscedastic=on", "effects.heteroscedastic=true"),
]


@pytest.mark.parametrize(("one", "other"), SPELLINGS)
def test_equal_values_have_one_spelling(one: str, other: str, settings: Settings) -> None:
    assert dataset_yaml(settings(one)) == dataset_yaml(settings(other))


def test_differences_contain_key_and_both_values(settings: Settings) -> None:
    ours, theirs = dataset_yaml(settings("seed=1", "isp=srgb")), dataset_yaml(settings())
    assert differences(ours, theirs) == [
        "isp.gamma=srgb (there: 2.2)",
        "isp.tone=none (there: smoothstep)",
        "seed=1 (there: 0)",
    ]


def test_missing_config_yaml_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"config.yaml: no such file; expected the config.yaml of a dataset"):
        read_dataset_yaml(tmp_path / "config.yaml")


NOT_CONFIGS: list[Any] = [
    b"", b"[1, 2]", b"seed: 0", b"a: [", b"\xff\xfe", b"source: {kind: folder, rot: 1}", b"source: 3",
    b"source: {kind: folder}\nseed: abc", b"source: {kind: folder}\nnew: 1",
]  # fmt: skip


@pytest.mark.parametrize("content", NOT_CONFIGS)
def test_invalid_config_yaml_is_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=r"config.yaml: not the config.yaml of a dataset \(") as error:
        read_dataset_yaml(tmp_path / "config.yaml")
    assert "\n" not in str(error.value)


HOSTILE = [
    *(None, True, -1, 0, 3, 2**63, -(2**63), math.nan, math.inf, -math.inf, 1e300, -1e300, 1e-300, 2.5),
    *("x", "", "../../etc", "a\nb", "${oc.env:HOME}", [], {}, [1], ["x"], [["x"]], {"a": 1}, [{"a": -1, "b": 2}]),
    *(["uniform", 1, 2], ["uniform", -1e300, 1e300], ["choice", 1e300], ["choice", 1, math.nan], [100, 200]),
    *(["truncated_normal", 0, 1e-300, -1e-300, 1e-300], ["log_uniform", 1e-320, 1e308]),
    *(["log_linear_in_a", 10, 50, 10], ["line", 1e9, 1e9, 1e9]),
    ["by_iso", 100, [1e300] * 4],
]
"""Values that a careless or hostile editor could write anywhere in a ``config.yaml``."""


DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def paths_of(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from paths_of(value, (*path, key))


@pytest.mark.parametrize("overrides", [(), ("noise=sony_a7s2", "scene=low_light")], ids=str)
@pytest.mark.parametrize("examples", [30, pytest.param(600, marks=pytest.mark.slow)])
def test_edited_config_yaml_is_refused_or_can_be_planned(
    examples: int, overrides: tuple[str, ...], settings: Settings, tmp_path: Path
) -> None:
    @hypothesis_settings(max_examples=examples)
    @given(data=st.data())
    def check(data: st.DataObject) -> None:
        check_edited_config(data, dataset_yaml(settings(*overrides)), tmp_path / "config.yaml")

    check()


def check_edited_config(data: st.DataObject, text: str, path: Path) -> None:
    """Edit the text of a ``config.yaml`` in one place and check that it is refused in one line or can be planned."""
    tree = parse_yaml_mapping(text)
    *parents, key = data.draw(st.sampled_from(list(paths_of(tree))))
    group = reduce(lambda node, name: node[name], parents, tree)
    if data.draw(st.booleans()):
        group[key] = data.draw(st.sampled_from(HOSTILE))
    elif isinstance(group, dict):
        del group[key]
    path.write_text(yaml.dump(tree, Dumper=DUMPER), encoding="utf-8")
    try:
        config, _ = read_dataset_yaml(path)
    except ConfigError as error:
        assert "\n" not in str(error)
    else:
        plan_pairs(config, SHA256, facts=Facts(64, 48, 256, 3, 250))


EDITED = [
    ("isp", "gamma", None, "isp.gamma=null: expected a number from 0.1 to 10, or srgb"),
    ("gains", "red", math.nan, "gains.red=nan: expected a finite number"),
    ("gains", "red", math.inf, "gains.red=inf: expected a finite number"),
    ("source", "max_pixels", -1, "source.max_pixels=-1: expected 1 to"),
    ("source", "max_pixels", 2**63, "source.max_pixels=9223372036854775808: expected 1 to"),
    ("sensor", "bits", "twelve", "sensor.bits=twelve: expected a value of type int"),
    ("sensor", "bits", True, "sensor.bits=true: expected a value of type int"),
    ("source", "include", "*.jpg", r"source.include=\*.jpg: expected a value of type list"),
    ("source", "root", "/etc", "unknown key source.root"),
    ("noise", "gain", 1, "unknown key noise.gain"),
    ("noise", "gain", {}, "unknown key noise.gain"),
    ("source", "kind", "web", "source.kind=web: expected one of folder, synthetic"),
    ("gains", "threshold", None, r"gains.threshold=null: expected a value of type float"),
    ("gains", "threshold", ..., r"missing key gains\.threshold"),
]


@pytest.mark.parametrize(("group", "key", "value", "problem"), EDITED)
def test_config_yaml_with_bad_value_is_refused_with_its_key(
    group: str, key: str, value: Any, problem: str, settings: Settings, tmp_path: Path
) -> None:
    tree = yaml.safe_load(dataset_yaml(settings()))
    tree[group] |= {key: value}
    if value is ...:
        del tree[group][key]
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(tree), encoding="utf-8")
    with pytest.raises(ConfigError, match=problem) as error:
        read_dataset_yaml(tmp_path / "config.yaml")
    assert "\n" not in str(error.value)


def test_dollar_signs_in_config_yaml_are_literal(settings: Settings) -> None:
    config = settings()
    config = replaced(config, {"source.include": ["${oc.env:HOME}/*.jpg"]})
    assert parse_dataset_yaml(dataset_yaml(config))[0].source.include == ("${oc.env:HOME}/*.jpg",)


@pytest.mark.parametrize("number", [10**400, -(10**5000)], ids=["large", "larger"])
def test_integers_that_no_float_holds_are_refused(number: int) -> None:
    with pytest.raises(ConfigError, match=r"gains.red=an integer of \d+ bits: expected a finite number"):
        parse_distribution("gains.red", number, ("uniform",))


def test_choices_match_their_implementations() -> None:
    words = {key: one.limit.words for key, one in all_settings(Config).items() if isinstance(one.limit, Choice)}
    assert words["gains.highlight"] == tuple(unprocess.INVERSE_HIGHLIGHTS)
    assert set(words["isp.tone"]) == set(unprocess.INVERSE_TONES) == set(tone_curves.EXACT_INVERSE_TONES)
    assert words["sensor.pattern"] == (*cfa.PATTERNS, cfa.MONO)
    assert words["source.icc"] == ICC_CHOICES
    assert (words["output.dtype"], words["output.layout"]) == ((UINT16, FLOAT32), (MOSAIC, PACKED))


def test_every_setting_has_a_meaning_and_none_is_needed_without_docstrings() -> None:
    assert all(setting.meaning for setting in all_settings(Config).values())
    subprocess.run([sys.executable, "-OO", "-c", "import unprocess_gen.config.schema"], check=True)
