"""Manifest rows hold their plans bit for bit; manifests have the columns that their settings can fill."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from helpers.datasets import Settings
from helpers.records import PAIR, PATCH, PHYSICS, PLAN, SHA256, SOURCE
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import asdict

from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.fields import Choice, Field, Integers, Numbers
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.manifest import csv_lines, read_rows
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
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.plan import (
    FLAG,
    GAMMA,
    HEX_128,
    HEX_256,
    HEX_KEY,
    LEVELS,
    LIST,
    PRIMARIES,
    PROFILE,
    DarkFramePlan,
    Plan,
    PlanRecord,
    fields_of,
    part_in,
)
from unprocess_gen.simulation.profiles import Profile

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
    return ",".join(COLUMN_NAMES) + "\n" + csv_lines(rows, COLUMN_NAMES).decode()


def row_of(plan: Plan = PLAN, source: Source = SOURCE, key: str = "00000003", patch: Patch = PATCH) -> Row:
    return pair_row(key, source, SHA256, 1, 0, plan, PAIR, ("1" * 32, "2" * 32), patch)


def through_csv(rows: list[Row], folder: Path) -> list[Row]:
    path = folder / "manifest.csv"
    path.write_text(csv_text(rows), encoding="utf-8", newline="")
    return list(read_rows(path))


BY_NAME = {column.name: column for column in COLUMNS}


word = st.text(st.characters(codec="ascii", categories=["Ll", "Nd"]), min_size=1, max_size=9)


def values_of(field: Field) -> st.SearchStrategy[Any]:
    """Any value that a field of one column allows."""
    limit = field.limit
    strategies = {
        LIST: st.lists(word, max_size=3).map(tuple),
        HEX_KEY: st.integers(0, 2**64 - 1),
        HEX_128: st.just("0f" * 16),
        HEX_256: st.just("0f" * 32),
        LEVELS: st.tuples(*[st.integers(0, 65535).map(float)] * 4),
        GAMMA: st.just("srgb") | st.floats(0.1, 10),
        FLAG: st.booleans(),
        PRIMARIES: st.sampled_from(["acescg", "0.64;0.33;0.3;0.6;-0.15;6e-05;0.3127;0.329"]),
        PROFILE: word.map(Profile),
    }
    if limit in strategies:
        return strategies[limit]
    if isinstance(limit, Numbers):
        return st.floats(limit.low, limit.high).map(lambda value: value + 0.0)  # no -0.0, which reads as 0
    if isinstance(limit, Integers):
        return st.integers(limit.low, limit.high)
    return st.sampled_from(limit.words) if isinstance(limit, Choice) else word


def records(record: type[PlanRecord]) -> st.SearchStrategy[Any]:
    """Records with any value in their fields; those that a plan may lack are there, or not."""
    fields: dict[str, st.SearchStrategy[Any]] = {}
    for name, (kind, declared) in fields_of(record).items():
        if part := part_in(kind):
            fields[name] = records(part) if kind is part else st.none() | records(part)
        elif declared is not None:
            value = values_of(declared)
            fields[name] = st.tuples(*[value] * len(declared.columns)) if declared.columns else value
    return st.builds(record, **fields)


plans = st.builds(
    lambda plan, bits, levels: plan.replace(bits=bits, black_level_dn=min(levels), white_level_dn=max(levels)),
    records(Plan),
    st.just(16),
    st.lists(st.integers(0, 65534), min_size=2, max_size=2, unique=True),
).filter(lambda plan: plan.physics is None or plan.physics.dn_per_e > 0)

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
        (["source.root=photos"], {"source_noise_dn", "profile", "pixels_xxh3"}),
        (["source.root=photos", "source.icc=ignore", "source.include=['*.png']"], {"source_noise_dn"}),
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
    patch = Patch(3, 2, 7, 2, 4)
    written = row_of(plan, dataclasses.replace(FRAME, name=name), KEY, patch)
    (row,) = through_csv([written], tmp_path_factory.mktemp("csv"))
    assert repr(row) == repr(dict(written))
    assert (repr(asdict(plan_from_row(row))), patch_from_row(row)) == (repr(asdict(plan)), patch)
    loaded = json.loads(row_json([written]))
    assert loaded == without_empty(written)
    assert repr(asdict(plan_from_row(loaded))) == repr(asdict(plan))


def test_failed_row_read_from_csv_is_the_row(tmp_path: Path) -> None:
    row = failed_row(SOURCE, SHA256, 2, 5, "empty", "why")
    assert through_csv([row], tmp_path) == [dict(row)]


def test_a_field_of_any_part_and_a_part_are_replaced_by_their_names() -> None:
    camera = PLAN.camera.replace(red_gain=3.0)
    changed = PHYSICAL.replace(camera=camera, draw=9, row_std_dn=7.0, seed=5)
    assert (changed.camera, changed.place.draw, changed.numbers.row_std_dn, changed.seed) == (camera, 9, 7.0, 5)
    assert changed.replace(camera=PHYSICAL.camera, draw=2, row_std_dn=0.5, seed=0) == PHYSICAL
    with pytest.raises(TypeError):
        PLAN.replace(gain=1.0)


def test_field_of_an_absent_column_keeps_its_default() -> None:
    row = {name: value for name, value in row_of(PHYSICAL, FRAME, KEY).items() if name not in ("draw", "dsnu_std_e")}
    assert plan_from_row(row) == PHYSICAL.replace(draw=0)


NEEDED = [*CONTRACT[9:38], "sensor_clip", "accuracy", "scene", "exposure_ratio", "saturated_as", "noise_law"]


@pytest.mark.parametrize("name", [*NEEDED, "exposure_s", "body_key"])
def test_row_without_a_needed_value_is_damage(name: str) -> None:
    row = {**row_of(PHYSICAL, FRAME, KEY), name: None}
    with pytest.raises(DamageError, match=f"row {KEY}: not a plan \\(.*{name} is empty"):
        plan_from_row(row)
    with pytest.raises(DamageError, match=f"row {KEY}: not a patch \\(height is empty"):
        patch_from_row({**row, "height": None})


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
