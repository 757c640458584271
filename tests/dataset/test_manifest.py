"""Manifest rows hold their plans bit for bit; manifests have the columns that their settings can fill."""

from __future__ import annotations

import dataclasses
import io
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import get_type_hints

import pytest
from helpers.datasets import Settings
from helpers.records import FACTS, PAIR, PATCH, PHYSICS, PLAN, SHA256, SOURCE
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.core.errors import REASONS, DamageError
from unprocess_gen.core.fields import Numbers
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.manifest import read_rows, write_rows
from unprocess_gen.dataset.row import (
    COLUMN_NAMES,
    COLUMNS,
    columns_of,
    failed_row,
    pair_row,
    patch_from_row,
    plan_from_row,
    row_json,
    without_empty,
)
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.plan import (
    TIERS,
    CameraPlan,
    DarkFramePlan,
    IspPlan,
    NoisePlan,
    Physics,
    Place,
    Plan,
    ScenePlan,
    SensorPlan,
    SourcePlan,
)

CONTRACT = [
    *("key", "source", "source_sha256", "status", "reason", "width", "height", "orientation", "shard", "seed"),
    *("stream_key", "camera", "w_nexus_6p", "w_sony_a7r", "w_olympus_em10", "w_sony_rx100"),
    *(f"rgb2cam_{row}{column}" for row in range(3) for column in range(3)),
    *("red_gain", "blue_gain", "inverse_rgb_gain", "tone", "gamma", "highlight", "highlight_threshold"),
    *("pattern", "bits", "black_level_dn", "white_level_dn", "noise", "a_dn", "b_dn2", "dark_variance_dn2"),
    *("effects", "skipped", "accuracy", "clean_xxh3", "noisy_xxh3", "clean_clipped_low", "clean_clipped_high"),
    *("noisy_clipped_low", "noisy_clipped_high", "saturated"),
]

KEY = "00000003-p0007-l01d02"
PHYSICAL = PLAN.replace(
    effects=("prnu", "shot", "read", "quantise"), skipped=("row: hidden",), physics=PHYSICS, level=1, draw=2, frame=5
)
DARK = PHYSICAL.replace(dark=DarkFramePlan("ab" * 32, (0, 4), 0.0, 1.0))
RAW = PHYSICAL.replace(
    shrink=2, raw_pattern="GBRG", raw_black_dn=(512.25, 1e-05, 513.0, 0.0), raw_white_dn=(16383.0,) * 4,
    mosaic_xxh3="ab" * 16, source_iso=100.0, source_exposure_s=0.04, own_a_dn=0.5, own_b_dn2=2.25,
)  # fmt: skip
FRAME = dataclasses.replace(SOURCE, clip="c")


def csv_text(rows: Iterable[Row]) -> str:
    stream = io.StringIO(newline="")
    write_rows(stream, rows, COLUMN_NAMES)
    return stream.getvalue()


def row_of(plan: Plan = PLAN, source: Source = SOURCE, key: str = "00000003", patch: Patch = PATCH) -> Row:
    return pair_row(key, source, SHA256, 1, 0, plan, PAIR, ("1" * 32, "2" * 32), patch)


def through_csv(rows: list[Row], folder: Path) -> list[Row]:
    path = folder / "manifest.csv"
    path.write_text(csv_text(rows), encoding="utf-8", newline="")
    return list(read_rows(path))


BY_NAME = {column.name: column for column in COLUMNS}


def number(name: str) -> st.SearchStrategy[float]:
    """Return any number that a column allows."""
    allowed = BY_NAME[name].limit
    assert isinstance(allowed, Numbers)
    return st.floats(allowed.low, allowed.high).map(lambda value: value + 0.0)  # no -0.0, which reads as 0


def levels(bits: int) -> st.SearchStrategy[tuple[int, int, int]]:
    """Return bits, black level and white level of a sensor."""
    black = st.integers(0, 2**bits - 2)
    return black.flatmap(lambda low: st.tuples(st.just(bits), st.just(low), st.integers(low + 1, 2**bits - 1)))


NUMBERS = [name for name, kind in get_type_hints(Physics).items() if kind is float and name in BY_NAME]
word = st.text(st.characters(codec="ascii", categories=["Ll", "Nd"]), min_size=1, max_size=9)
physics = st.builds(
    Physics,
    **{name: number(name) for name in NUMBERS} | {"dn_per_e": st.floats(1e-9, 1e20)},
    dark_offset=st.sampled_from(["removed", "kept"]),
    read_law=st.sampled_from(["gaussian", "tukey_lambda"]),
    black_error_dn=st.tuples(*[number("black_error_dn_00")] * 4),
    sensor_unit=st.integers(0, 2**64 - 1).map("{:016x}".format) | st.integers(0, 10**6).map(str),
    body_key=st.integers(0, 2**64 - 1),
    fixed_pattern_in_clean=st.booleans(),
    gain_by_colour=st.tuples(*[number("gain_r")] * 3),
    lens_shading=st.tuples(*[number("lens_shading_2")] * 3),
    frame_size=st.tuples(st.integers(1, 2**32 - 1), st.integers(1, 2**32 - 1)),
)
plans = st.builds(
    Plan,
    seed=st.integers(0, 2**63 - 1),
    stream_key=st.integers(0, 2**64 - 1),
    source=st.builds(SourcePlan, st.integers(1, 64), st.sampled_from(["off", "dither", "dither_all"])),
    scene=st.builds(ScenePlan, word, number("exposure_ratio")),
    camera=st.builds(
        CameraPlan,
        camera=word,
        weights=st.tuples(*[number("w_nexus_6p")] * 4),
        rgb2cam=st.tuples(*[number("rgb2cam_00")] * 9),
        **{name: number(name) for name in ("red_gain", "blue_gain", "inverse_rgb_gain")},
    ),
    isp=st.builds(
        IspPlan,
        st.sampled_from(["smoothstep", "none"]),
        st.just("srgb") | st.floats(0.1, 10),
        st.sampled_from(["per_channel", "gray_mean", "none"]),
        number("highlight_threshold"),
    ),
    sensor=st.builds(
        lambda pattern, levels, clip, saturated: SensorPlan(pattern, *levels, clip, saturated),
        st.sampled_from(["RGGB", "BGGR", "GRBG", "GBRG"]),
        st.integers(1, 16).flatmap(levels),
        st.sampled_from(["sensor", "black"]),
        st.sampled_from(["noisy", "white"]),
    ),
    noise=st.builds(
        NoisePlan,
        noise=word,
        noise_law=st.sampled_from(["gaussian", "poisson"]),
        a_dn=number("a_dn"),
        b_dn2=number("b_dn2"),
        effects=st.lists(word, max_size=3).map(tuple),
        skipped=st.lists(word, max_size=3).map(tuple),
    ),
    physics=st.none() | physics,
    place=st.builds(Place, st.integers(0, 10**9), st.integers(0, 99), st.integers(0, 99)),
    accuracy=st.sampled_from(TIERS),
    split=st.sampled_from(["", "train", "fold-3"]),
)
names = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=40).filter(
    BY_NAME["source"].limit.allows
)


# Columns --------------------------------------------------------------------------------------------------------------


def test_columns_have_the_order_of_the_contract() -> None:
    assert [name for name in COLUMN_NAMES if name in CONTRACT] == CONTRACT
    assert len(set(COLUMN_NAMES)) == len(COLUMN_NAMES)


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        (["source.patch=64"], {"patch", "patch_y", "patch_x"}),
        (["source.clips=true"], {"clip", "frame"}),
        (["noise.draws=2"], {"level", "draw"}),
        (["noise.levels=[{a: 1, b: 2}]"], set[str]()),
        (["split={a: 0.5, b: 0.5}"], {"split"}),
        (["gains=by_light"], {"light", "cct_k"}),
        (["source.root=photos"], {"source_noise_dn"}),
        (["scene=night"], {"light_clipped_high"}),
        (["output.clean_dtype=float32"], {"clean_dtype"}),
        (["output.targets=[linear_rgb]"], {"targets"}),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_settings_add_the_columns_that_they_fill(settings: Settings, overrides: list[str], names: set[str]) -> None:
    few = columns_of(settings())
    assert set(columns_of(settings(*overrides))) - set(few) == names
    assert not {"iso", "dark_frame", "raw_pattern", "patch", "level", "clip", "split"} & set(few)


def test_physical_profiles_and_manifests_without_frames_have_their_columns(settings: Settings) -> None:
    physical = set(columns_of(settings("noise=nikon_d850", "noise.lens_shading=[-0.1,0,0]")))
    assert {"iso", "dn_per_e", "row_std_dn", "body_key", "frame_height", "assumed"} <= physical
    assert "frame_height" not in columns_of(settings("noise=nikon_d850"))
    assert not {"clean_xxh3", "noisy_xxh3", "saturated"} & set(columns_of(settings("output.frames=false")))


@pytest.mark.parametrize(
    ("plan", "empty"),
    [
        (PLAN, {"iso", "read_law", "patch", "patch_y", "level", "draw", "frame", "clip", "dark_frame", "raw_pattern"}),
        (PHYSICAL, {"dark_frame", "dark_frame_y", "raw_pattern", "source_iso", "split", "light", "frame_height"}),
        (DARK, {"raw_pattern", "frame_height"}),
        (RAW.replace(own_a_dn=0.0), {"own_a_dn", "dark_frame"}),
    ],
    ids=["two numbers", "physical", "dark frame", "raw"],
)
def test_cells_that_do_not_apply_are_empty(plan: Plan, empty: set[str]) -> None:
    row = row_of(plan) if plan is PLAN else row_of(plan, FRAME, KEY)
    assert list(row) == list(COLUMN_NAMES)
    assert {row[name] for name in empty} <= {None, ""}
    for name, value in without_empty(row).items():
        assert name not in empty
        assert type(value) is (float if name == "gamma" else BY_NAME[name].type), name


def test_zeros_of_numbers_that_apply_are_written() -> None:
    row = row_of(DARK, dataclasses.replace(FRAME, frame=0), KEY)
    assert [row[name] for name in ("dark_frame_y", "dark_black_dn", "full_well_e", "patch_y")] == [0, 0.0, 0.0, 0]


# A row is a plan ------------------------------------------------------------------------------------------------------


@given(plan=plans, name=names)
def test_row_read_from_csv_or_json_is_the_row_of_the_same_plan(
    plan: Plan, name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    written = row_of(plan, dataclasses.replace(FRAME, name=name), KEY)
    (row,) = through_csv([written], tmp_path_factory.mktemp("csv"))
    assert repr(row) == repr(dict(written))
    assert repr(plan_from_row(row)) == repr(plan)
    loaded = json.loads(row_json([written]))
    assert loaded == without_empty(written)
    assert repr(plan_from_row(loaded)) == repr(plan)


@pytest.mark.parametrize(
    "plan", [DARK, RAW, PHYSICAL.replace(assumed=("prnu_std", "dark_e_per_s"), clean_dtype="float32")]
)
def test_plans_with_every_part_survive_csv(plan: Plan, tmp_path: Path) -> None:
    patch = Patch(7, 2, 4, 2, 3)
    (row,) = through_csv([row_of(plan, FRAME, KEY, patch)], tmp_path)
    assert (plan_from_row(row), patch_from_row(row)) == (plan, patch)
    assert patch_from_row(row_of(PLAN)) == PATCH


@pytest.mark.parametrize("reason", list(REASONS)[:2])
def test_failed_row_read_from_csv_is_the_row(reason: str, tmp_path: Path) -> None:
    row = failed_row(SOURCE, SHA256, 2, 5, reason, "why")
    assert through_csv([row], tmp_path) == [dict(row)]


@pytest.mark.parametrize("noise", ["brooks2019", "imx385_iso3200_rvdd", "sony_a7s2", "oppo_reno10x"])
def test_drawn_plans_survive_csv(settings: Settings, noise: str, tmp_path: Path) -> None:
    plan = plan_image(settings(f"noise={noise}", "camera=choice", "isp=srgb", "scene=night"), SHA256, facts=FACTS)
    assert plan_from_row(through_csv([row_of(plan)], tmp_path)[0]) == plan


def test_field_of_an_absent_column_keeps_its_default() -> None:
    row = {name: value for name, value in row_of(PHYSICAL, FRAME, KEY).items() if name not in ("draw", "dsnu_std_e")}
    assert plan_from_row(row) == PHYSICAL.replace(draw=0)


NEEDED = [*CONTRACT[9:38], "sensor_clip", "accuracy", "scene", "exposure_ratio", "saturated_as", "noise_law"]


@pytest.mark.parametrize("name", [*NEEDED, "exposure_s", "body_key"])
def test_row_without_a_needed_value_is_damage(name: str) -> None:
    row = {**row_of(PHYSICAL, FRAME, KEY), name: None}
    with pytest.raises(DamageError, match=f"row {KEY}: not a plan \\(.*{name} is empty"):
        plan_from_row(row)


@pytest.mark.parametrize(
    ("name", "value"), [("stream_key", "xyz"), ("red_gain", "wide"), ("bits", "twelve"), ("gamma", "steep")]
)
def test_a_row_with_a_value_of_another_type_is_damage(name: str, value: str) -> None:
    with pytest.raises(DamageError, match="row 00000003: not a plan"):
        plan_from_row({**row_of(), name: value})


@pytest.mark.parametrize("name", ["height", "width"])
def test_row_without_its_size_is_damage(name: str) -> None:
    with pytest.raises(DamageError, match=f"row 00000003: not a patch \\({name} is empty"):
        patch_from_row({**row_of(), name: None})


# CSV ------------------------------------------------------------------------------------------------------------------


def test_csv_has_line_feeds_few_quotes_and_pythons_shortest_floats() -> None:
    text = csv_text([row_of(PLAN.replace(a_dn=0.1, b_dn2=1e22))])
    assert (text.count("\n"), text.count("\r"), text[-1]) == (2, 0, "\n")
    assert text.count('"') == 2
    assert '"a, b.png"' in text
    assert {"0.1", "1e+22"} <= set(text.splitlines()[1].split(","))


def test_unknown_columns_are_left_out(tmp_path: Path) -> None:
    lines = csv_text([row_of()]).splitlines()
    (tmp_path / "m.csv").write_text(f"{lines[0]},later\n{lines[1]},9\n", encoding="utf-8")
    (row,) = read_rows(tmp_path / "m.csv")
    assert list(row) == list(COLUMN_NAMES)


HEADER = ",".join(COLUMN_NAMES)
BROKEN = [
    ("", "not a manifest, column key is missing"),
    ("key,source\n", "not a manifest, column source_sha256 is missing"),
    (HEADER + "\n00000000,x\n", "not a readable manifest"),
    (HEADER + "\n" + "x," * len(COLUMN_NAMES) + "x\n", "not a readable manifest"),
    (csv_text([row_of()]).replace(",1234,", ",many,"), "not a readable manifest"),
    (csv_text([row_of()]).replace(",2.2,", ',2.2"x",').replace('"a, b.png"', '"a"b'), "not a readable manifest"),
    (csv_text([row_of()])[:-60], "not a readable manifest"),
    (csv_text([row_of()]).replace("\n00000003,", "\n../../x1,"), "not a readable manifest .the key is '../../x1'"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "sentence"), BROKEN)
def test_a_broken_manifest_is_damage(content: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(content, encoding="utf-8")
    with pytest.raises(DamageError, match=r"m.csv: " + re.escape(sentence).replace("\\ \\.", " .")):
        list(read_rows(tmp_path / "m.csv"))


# JSON -----------------------------------------------------------------------------------------------------------------


def test_json_of_a_sample_has_the_first_row_and_what_differs_in_others() -> None:
    first = row_of(PHYSICAL, FRAME, "00000003-l00d00")
    other = {**first, "key": "00000003-l00d01", "skipped": "", "b_dn2": 2.0}
    content = row_json([first, other])
    assert content.isascii()
    assert content.index(b"\n") == len(content) - 1
    assert json.loads(content) == {
        **without_empty(first), "others": [{"key": "00000003-l00d01", "b_dn2": 2.0, "skipped": ""}]
    }  # fmt: skip
