"""Manifest rows: a row is a plan, in CSV and in JSON, to the last bit."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.errors import REASONS, DamageError
from unprocess_gen.manifest import (
    COLUMNS,
    JSON_BYTES,
    NAMES,
    Row,
    failed_row,
    json_size,
    key_text,
    ok_row,
    plan_of,
    read_rows,
    row_json,
    write_rows,
)
from unprocess_gen.plan import plan_image
from unprocess_gen.records import Counts, Pair, Plan, Source

CONTRACT = [
    "key",
    "source",
    "source_sha256",
    "status",
    "reason",
    "width",
    "height",
    "orientation",
    "shard",
    "seed",
    "stream_key",
    "camera",
    "w_nexus_6p",
    "w_sony_a7r",
    "w_olympus_em10",
    "w_sony_rx100",
    "rgb2cam_00",
    "rgb2cam_01",
    "rgb2cam_02",
    "rgb2cam_10",
    "rgb2cam_11",
    "rgb2cam_12",
    "rgb2cam_20",
    "rgb2cam_21",
    "rgb2cam_22",
    "red_gain",
    "blue_gain",
    "inverse_rgb_gain",
    "tone",
    "gamma",
    "highlight",
    "highlight_threshold",
    "pattern",
    "bits",
    "black_level_dn",
    "white_level_dn",
    "noise",
    "a_dn",
    "b_dn2",
    "effects",
    "skipped",
    "accuracy",
    "methods",
    "clean_xxh3",
    "noisy_xxh3",
    "clean_clipped_low",
    "clean_clipped_high",
    "noisy_clipped_low",
    "noisy_clipped_high",
    "saturated",
]

SHA256 = "ab" * 32
SOURCE = Source(3, "a, b.png", "a, b.png", 1234)
PAIR = Pair(np.zeros((2, 3), np.uint16), np.zeros((2, 3), np.uint16), Counts(1, 2, 3, 4, 5, 6))
PLAN = Plan(
    seed=0, stream_key=0x1F, camera="convex", weights=(0.1, 0.2, 0.3, 0.4), rgb2cam=(0.6, 0.3, 0.1) * 3, red_gain=2.0,
    blue_gain=1.7, inverse_rgb_gain=0.8, tone="smoothstep", gamma=2.2, highlight="per_channel", highlight_threshold=0.9,
    pattern="RGGB", bits=12, black_level_dn=240, white_level_dn=4095, sensor_clip="sensor", noise="imx385_iso3200",
    a_dn=7.0, b_dn2=38.0, effects=("heteroscedastic", "quantise"), skipped=(), accuracy="exact", methods=("a:b", "c:d"),
)  # fmt: skip


def csv_text(rows: Iterable[Row]) -> str:
    stream = io.StringIO(newline="")
    write_rows(stream, rows)
    return stream.getvalue()


def row_of(plan: Plan = PLAN, source: Source = SOURCE) -> Row:
    return ok_row(source, SHA256, 1, 0, plan, PAIR, ("1" * 32, "2" * 32))


def through_csv(rows: list[Row], folder: Path) -> list[Row]:
    path = folder / "manifest.csv"
    path.write_text(csv_text(rows), encoding="utf-8", newline="")
    return list(read_rows(path))


finite = st.floats(allow_nan=False, allow_infinity=False)
count = st.integers(0, 2**40)
word = st.text(st.characters(codec="ascii", categories=["Ll", "Nd"]), min_size=1, max_size=9)
plans = st.builds(
    Plan,
    seed=st.integers(0, 2**63 - 1),
    stream_key=st.integers(0, 2**64 - 1),
    camera=word,
    weights=st.tuples(*[finite] * 4),
    rgb2cam=st.tuples(*[finite] * 9),
    red_gain=finite,
    blue_gain=finite,
    inverse_rgb_gain=finite,
    tone=st.sampled_from(["smoothstep", "none"]),
    gamma=st.just("srgb") | st.floats(0.1, 10),
    highlight=st.sampled_from(["per_channel", "gray_mean", "none"]),
    highlight_threshold=finite,
    pattern=st.sampled_from(["RGGB", "BGGR", "GRBG", "GBRG"]),
    bits=st.integers(1, 16),
    black_level_dn=st.integers(0, 65534),
    white_level_dn=st.integers(1, 65535),
    sensor_clip=st.sampled_from(["sensor", "black"]),
    noise=word,
    a_dn=finite,
    b_dn2=finite,
    effects=st.lists(word, max_size=3).map(tuple),
    skipped=st.lists(word, max_size=3).map(tuple),
    accuracy=word,
    methods=st.lists(word, max_size=3).map(tuple),
)
names = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=40)


# Columns --------------------------------------------------------------------------------------------------------------


def test_columns_of_the_contract_are_there_in_its_order() -> None:
    assert [name for name in NAMES if name in CONTRACT] == CONTRACT


def test_no_column_stands_twice() -> None:
    assert len(set(NAMES)) == len(NAMES) == len(COLUMNS)


def test_every_column_says_what_it_means() -> None:
    assert all(column.meaning for column in COLUMNS)


def test_every_value_of_a_row_has_the_type_of_its_column() -> None:
    row = row_of()
    assert list(row) == list(NAMES)
    assert_typed(row)


def assert_typed(row: Row) -> None:
    for column in COLUMNS:
        expected = float if column.name == "gamma" else column.type
        assert type(row[column.name]) is expected, column.name


def test_no_value_of_a_pair_is_none() -> None:
    assert None not in row_of().values()


@pytest.mark.parametrize(("gamma", "value"), [(2.2, 2.2), (1.0, 1), ("srgb", "srgb")])
def test_gamma_is_a_number_or_srgb(gamma: float | str, value: float | str) -> None:
    assert row_of(dataclasses.replace(PLAN, gamma=gamma))["gamma"] == value


def test_a_failed_row_has_the_columns_of_any_row() -> None:
    row = failed_row(SOURCE, None, 0, 7, "empty")
    assert list(row) == list(NAMES)
    assert (row["status"], row["reason"], row["seed"], row["source_sha256"]) == ("failed", "empty", 7, "")


@pytest.mark.parametrize(("index", "key"), [(0, "00000000"), (12345678, "12345678"), (123456789, "123456789")])
def test_keys_are_eight_digits_and_more_where_needed(index: int, key: str) -> None:
    assert key_text(index) == key


# A row is a plan ------------------------------------------------------------------------------------------------------


@given(plans)
def test_a_row_holds_its_plan(plan: Plan) -> None:
    assert plan_of(row_of(plan)) == plan


@given(plan=plans, name=names)
def test_a_row_read_back_from_csv_holds_the_same_plan_to_the_last_bit(
    plan: Plan, name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    (row,) = through_csv([row_of(plan, dataclasses.replace(SOURCE, name=name))], tmp_path_factory.mktemp("csv"))
    assert repr(plan_of(row)) == repr(plan)
    assert row["source"] == name


@given(plans)
def test_a_row_read_back_from_json_holds_the_same_plan(plan: Plan) -> None:
    assert repr(plan_of(json.loads(row_json(row_of(plan))))) == repr(plan)


@given(plan=plans)
def test_a_row_read_back_from_csv_is_the_row(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> None:
    (row,) = through_csv([row_of(plan)], tmp_path_factory.mktemp("csv"))
    assert repr(row) == repr(dict(row_of(plan)))


@pytest.mark.parametrize("reason", REASONS)
def test_a_failed_row_read_back_from_csv_is_the_row(reason: str, tmp_path: Path) -> None:
    row = failed_row(SOURCE, SHA256, 2, 5, reason)
    assert through_csv([row], tmp_path) == [dict(row)]


def test_real_plans_come_back(settings: Callable[..., Any], tmp_path: Path) -> None:
    for noise in ("brooks2019", "imx385_iso3200_rvdd", "none"):
        for camera in ("convex", "choice", "identity"):
            plan = plan_image(settings(f"noise={noise}", f"camera={camera}", "isp=srgb"), SHA256)
            assert plan_of(through_csv([row_of(plan)], tmp_path)[0]) == plan


@pytest.mark.parametrize("name", [name for name in NAMES if name in {*CONTRACT[9:39], "sensor_clip", "accuracy"}])
def test_a_row_without_a_value_its_plan_needs_is_damage(name: str) -> None:
    with pytest.raises(DamageError, match=f"row 00000003: not a plan \\(.*{name}"):
        plan_of({**row_of(), name: None})


@pytest.mark.parametrize(
    ("name", "value"), [("stream_key", "xyz"), ("red_gain", "wide"), ("bits", "twelve"), ("gamma", "steep")]
)
def test_a_row_with_a_value_of_another_type_is_damage(name: str, value: str) -> None:
    with pytest.raises(DamageError, match="row 00000003: not a plan"):
        plan_of({**row_of(), name: value})


# CSV ------------------------------------------------------------------------------------------------------------------


def test_lines_end_with_a_line_feed_alone() -> None:
    text = csv_text([row_of(), row_of()])
    assert (text.count("\n"), text.count("\r"), text[-1]) == (3, 0, "\n")


def test_only_what_needs_quotes_has_them() -> None:
    text = csv_text([row_of()])
    assert text.count('"') == 2
    assert '"a, b.png"' in text


def test_floats_are_spelled_as_pythons_shortest_repr() -> None:
    cells = csv_text([row_of(dataclasses.replace(PLAN, a_dn=0.1, b_dn2=1e22))]).splitlines()[1].split(",")
    assert {"0.1", "1e+22"} <= set(cells)


def test_what_does_not_apply_is_empty() -> None:
    cells = csv_text([failed_row(Source(0, "x", "x", None), None, 0, 0, "empty")]).splitlines()[1].split(",")
    assert [cell for cell in cells if cell] == ["00000000", "x", "failed", "empty", "0", "0"]


def test_unknown_columns_are_left_out(tmp_path: Path) -> None:
    lines = csv_text([row_of()]).splitlines()
    (tmp_path / "m.csv").write_text(f"{lines[0]},later\n{lines[1]},9\n", encoding="utf-8")
    (row,) = read_rows(tmp_path / "m.csv")
    assert list(row) == list(NAMES)


def test_a_missing_manifest_is_damage(tmp_path: Path) -> None:
    with pytest.raises(DamageError, match=r"manifest.csv: no such manifest"):
        list(read_rows(tmp_path / "manifest.csv"))


HEADER = ",".join(NAMES)
BROKEN = [
    ("", "not a manifest, column key is missing"),
    ("key,source\n", "not a manifest, column source_sha256 is missing"),
    (HEADER.replace("saturated", "satiated") + "\n", "not a manifest, column saturated is missing"),
    (HEADER + "\n00000000,x\n", "not a readable manifest"),
    (HEADER + "\n" + "x," * len(NAMES) + "x\n", "not a readable manifest"),
    (csv_text([row_of()]).replace(",1234,", ",many,"), "not a readable manifest"),
    (csv_text([row_of()]).replace(",2.2,", ',2.2"x",').replace('"a, b.png"', '"a"b'), "not a readable manifest"),
    (csv_text([row_of()])[:-60], "not a readable manifest"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "sentence"), BROKEN)
def test_a_broken_manifest_is_damage(content: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(content, encoding="utf-8")
    with pytest.raises(DamageError, match=r"m.csv: " + sentence):
        list(read_rows(tmp_path / "m.csv"))


def test_a_manifest_that_is_not_utf8_is_damage(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_bytes(csv_text([row_of()]).encode("utf-8").replace(b"a, b", b"\xff, b"))
    with pytest.raises(DamageError, match="not a readable manifest"):
        list(read_rows(tmp_path / "m.csv"))


# JSON -----------------------------------------------------------------------------------------------------------------


@given(plans, names)
def test_json_takes_the_bytes_that_the_name_alone_decides(plan: Plan, name: str) -> None:
    assert len(row_json(row_of(plan, dataclasses.replace(SOURCE, name=name)))) == json_size(name)


def test_json_is_typed() -> None:
    loaded = json.loads(row_json(row_of()))
    assert loaded == dict(row_of())
    assert_typed(loaded)


def test_json_is_ascii_and_one_line() -> None:
    content = row_json(row_of(PLAN, dataclasses.replace(SOURCE, name="été \U0001f308.png")))
    assert content.isascii()
    assert content.index(b"\n") == len(content) - 1


LONGEST = -sys.float_info.min
"""A double whose spelling takes 24 characters, the most there are."""


def longest_row() -> Row:
    """The longest row that settings can lead to."""
    assert len(repr(LONGEST)) == 24
    methods = ("curve:exact_table", "pair:fused_float64", "normal:inverse_cdf_table")
    plan = dataclasses.replace(
        PLAN, seed=2**63 - 1, stream_key=2**64 - 1, camera="olympus_em10", weights=(LONGEST,) * 4,
        rgb2cam=(LONGEST,) * 9, red_gain=LONGEST, blue_gain=LONGEST, inverse_rgb_gain=LONGEST, gamma=2.2250738585072014,
        highlight_threshold=LONGEST, bits=16, black_level_dn=65534, white_level_dn=65535, noise="imx385_iso3200_rvdd",
        a_dn=LONGEST, b_dn2=LONGEST, methods=methods,
        skipped=(f"heteroscedastic: noise=imx385_iso3200_rvdd has no variance (a_dn={LONGEST!r}, b_dn2={LONGEST!r})",),
    )  # fmt: skip
    pair = Pair(PAIR.clean, PAIR.noisy, Counts(*[2**40] * 6))
    row = ok_row(Source(10**9, "", "", 2**30), SHA256, 8, 10**9, plan, pair, ("1" * 32, "2" * 32))
    return {**row, "width": 2**40, "height": 2**40}


def test_the_room_for_json_suffices_for_the_longest_row() -> None:
    text = json.dumps(dict(longest_row()), separators=(",", ":"))
    assert len(text) + 64 < JSON_BYTES
    assert len(row_json(longest_row())) == json_size("")


def test_a_row_that_does_not_fit_its_room_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"row 00000003 takes .* bytes as JSON, more than the"):
        row_json({**row_of(), "noise": "x" * 4000})


@given(st.integers(0, 3000))
def test_json_size_fills_whole_blocks_of_tar(length: int) -> None:
    assert json_size("x" * length) % 512 == 0
    assert json_size("x" * length) >= JSON_BYTES + length + 2


def test_no_number_in_json_is_lost_to_nan(settings: Callable[..., Any]) -> None:
    loaded = json.loads(row_json(row_of(plan_image(settings(), SHA256))), parse_constant=lambda text: pytest.fail(text))
    assert all(math.isfinite(value) for value in loaded.values() if isinstance(value, float))


def test_a_key_that_is_no_number_is_damage(dataset: Path, tmp_path: Path) -> None:
    """It becomes part of a file's name."""
    text = (dataset / "manifest.csv").read_text(encoding="utf-8")
    (tmp_path / "manifest.csv").write_text(text.replace("\n00000001,", "\n../../x1,"), encoding="utf-8")
    with pytest.raises(DamageError, match=r"the key is '../../x1', expected eight digits"):
        list(read_rows(tmp_path / "manifest.csv"))
