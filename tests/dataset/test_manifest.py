"""Manifest rows hold their plans bit for bit, in CSV and in JSON."""

from __future__ import annotations

import dataclasses
import io
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.configs import with_branch
from helpers.records import FACTS, PAIR, PATCH, PHYSICS, PLAN, SHA256, SOURCE
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.schema import ASSUMABLE, PHYSICAL_NUMBERS, replaced
from unprocess_gen.core.errors import REASONS, DamageError
from unprocess_gen.core.types import (
    TIERS,
    CameraPlan,
    Counts,
    DarkFramePlan,
    IspPlan,
    NoisePlan,
    Pair,
    Patch,
    Plan,
    Row,
    ScenePlan,
    SensorPlan,
    Source,
    SourcePlan,
)
from unprocess_gen.dataset import columns
from unprocess_gen.dataset.columns import COLUMN_NAMES, COLUMNS, FIRST, NO_FRAMES, Range
from unprocess_gen.dataset.keys import key_text
from unprocess_gen.dataset.manifest import (
    JSON_BYTES,
    failed_row,
    json_size,
    pair_row,
    patch_from_row,
    plan_from_row,
    read_rows,
    row_json,
    rows_of_json,
    write_rows,
)
from unprocess_gen.planning.effect_selection import IN_DARK_FRAMES
from unprocess_gen.planning.plan import plan_image, plan_levels
from unprocess_gen.simulation.effects import EFFECTS as ALL_EFFECTS
from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS as EFFECTS
from unprocess_gen.simulation.effects import REPLACED, Physics
from unprocess_gen.simulation.effects.prediction import STATISTICS

LATER = tuple(effect.name for effect in ALL_EFFECTS if effect.since)
"""Effects that version 0.1 did not have."""

CONTRACT = [
    *("key", "source", "source_sha256", "status", "reason", "width", "height", "orientation", "shard", "seed"),
    *("stream_key", "camera", "w_nexus_6p", "w_sony_a7r", "w_olympus_em10", "w_sony_rx100"),
    *(f"rgb2cam_{row}{column}" for row in range(3) for column in range(3)),
    *("red_gain", "blue_gain", "inverse_rgb_gain", "tone", "gamma", "highlight", "highlight_threshold"),
    *("pattern", "bits", "black_level_dn", "white_level_dn", "noise", "a_dn", "b_dn2", "effects", "skipped"),
    *("accuracy", "clean_xxh3", "noisy_xxh3", "clean_clipped_low", "clean_clipped_high"),
    *("noisy_clipped_low", "noisy_clipped_high", "saturated"),
]

PHYSICAL = PLAN.replace(effects=("prnu", "shot", "read", "quantise"), skipped=("row: hidden",), physics=PHYSICS)


DARK = PHYSICAL.replace(dark=DarkFramePlan("ab" * 32, (2, 4), 512.0, 0.5))


RAW = PHYSICAL.replace(
    shrink=2, raw_pattern="GBRG", raw_black_dn=(512.25, 1e-05, 513.0, 0.0), raw_white_dn=(16383.0,) * 4,
    mosaic_xxh3="ab" * 16, source_iso=100.0, source_exposure_s=0.04, own_a_dn=0.5, own_b_dn2=2.25,
)  # fmt: skip


def csv_text(rows: Iterable[Row]) -> str:
    stream = io.StringIO(newline="")
    write_rows(stream, rows)
    return stream.getvalue()


def row_of(plan: Plan = PLAN, source: Source = SOURCE) -> Row:
    return pair_row(key_text(source.index), source, SHA256, 1, 0, plan, PAIR, ("1" * 32, "2" * 32), PATCH)


def through_csv(rows: list[Row], folder: Path) -> list[Row]:
    path = folder / "manifest.csv"
    path.write_text(csv_text(rows), encoding="utf-8", newline="")
    return list(read_rows(path))


BY_NAME = {column.name: column for column in COLUMNS}


def number(name: str) -> st.SearchStrategy[float]:
    """Return any number that a column allows."""
    allowed = BY_NAME[name].allowed
    assert isinstance(allowed, Range)
    return st.floats(allowed.low, allowed.high).map(lambda value: value + 0.0)  # no -0.0, which reads as 0


def levels(bits: int) -> st.SearchStrategy[tuple[int, int, int]]:
    """Return bits, black level and white level of a sensor."""
    black = st.integers(0, 2**bits - 2)
    return black.flatmap(lambda low: st.tuples(st.just(bits), st.just(low), st.integers(low + 1, 2**bits - 1)))


NUMBERS = [field.name for field in dataclasses.fields(Physics) if field.type == "float" and field.name in BY_NAME]
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
        name=word,
        weights=st.tuples(*[number("w_nexus_6p")] * 4),
        rgb2cam=st.tuples(*[number("rgb2cam_00")] * 9),
        highlight=st.sampled_from(["per_channel", "gray_mean", "none"]),
        **{name: number(name) for name in ("red_gain", "blue_gain", "inverse_rgb_gain", "highlight_threshold")},
    ),
    isp=st.builds(IspPlan, st.sampled_from(["smoothstep", "none"]), st.just("srgb") | st.floats(0.1, 10)),
    sensor=st.builds(
        lambda pattern, levels: SensorPlan(pattern, *levels),
        st.sampled_from(["RGGB", "BGGR", "GRBG", "GBRG"]),
        st.integers(1, 16).flatmap(levels),
    ),
    noise=st.builds(
        NoisePlan,
        name=word,
        law=st.sampled_from(["gaussian", "poisson"]),
        a_dn=number("a_dn"),
        b_dn2=number("b_dn2"),
        effects=st.lists(word, max_size=3).map(tuple),
        skipped=st.lists(word, max_size=3).map(tuple),
        sensor_clip=st.sampled_from(["sensor", "black"]),
        saturated=st.sampled_from(["noisy", "white"]),
        physics=st.none() | physics,
        level=st.integers(0, 99),
        draw=st.integers(0, 99),
        frame=st.integers(0, 10**9),
    ),
    accuracy=st.sampled_from(TIERS),
    split=st.sampled_from(["", "train", "fold-3"]),
)
names = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=40).filter(
    BY_NAME["source"].allowed.__contains__
)


# Columns --------------------------------------------------------------------------------------------------------------


def test_columns_have_the_order_of_the_contract() -> None:
    assert [name for name in COLUMN_NAMES if name in CONTRACT] == CONTRACT
    assert len(set(COLUMN_NAMES)) == len(COLUMN_NAMES)


(UNMEASURED,) = (column.empty_if for column in COLUMNS if column.name == "source_noise_dn")
OF_DARK_FRAMES = {column.empty_if for column in COLUMNS if column.name.startswith("dark_") and column.since == "0.2"}
(NO_LIGHT,) = (column.empty_if for column in COLUMNS if column.name == "cct_k")
OF_RAW = {column.empty_if for column in COLUMNS if "raw" in column.empty_if}
BY_DEFAULT = {
    *OF_RAW,
    NO_LIGHT,
    "exposure_ratio is 1, or output.frames is false",
    "it is 0",
    "all are 1",
    "all are 0",
    "there is no lens shading",
    UNMEASURED,
    *OF_DARK_FRAMES,
}
"""Conditions of numbers that version 0.1 did not have."""


def test_cells_are_empty_exactly_if_their_column_states_it() -> None:
    unread = dataclasses.replace(SOURCE, size_bytes=None, reason="unreadable")
    bare = PLAN.replace(effects=(), skipped=())
    conditions = {column.empty_if for column in COLUMNS} - {""}
    failed = {condition for condition in conditions if "the source failed" in condition}
    passed = {"the status is ok"}
    same = "the clean array has the dtype of the noisy one, or the source failed"
    unassumed, unsplit = "no effect uses one", "there are no splits, or the source failed"
    untargeted = "output.targets is empty, output.frames is false, or the source failed"
    absent = {unassumed, unsplit, untargeted, same, *BY_DEFAULT}
    measured = pair_row("0" * 8, SOURCE, SHA256, 1, 0, PHYSICAL, PAIR, ("1" * 32, "2" * 32), PATCH, 1.5)
    planned = pair_row("0" * 8, SOURCE, SHA256, 1, 0, PHYSICAL, None, ("", ""), PATCH)
    holding = {
        "planned": (planned, passed | absent | {NO_FRAMES}),
        "pair": (row_of(PHYSICAL), passed | absent),
        "measured": (measured, passed | absent - {UNMEASURED}),
        "split": (row_of(PHYSICAL.replace(split="val")), passed | absent - {unsplit}),
        "targets": ({**row_of(PHYSICAL), "targets": "linear_rgb:float32:" + "1" * 32}, passed | absent - {untargeted}),
        "light": (row_of(PHYSICAL.replace(light="a", cct_k=2856.0)), passed | absent - {NO_LIGHT}),
        "dark frame": (row_of(DARK), passed | absent - OF_DARK_FRAMES),
        "raw": (row_of(RAW), passed | absent - OF_RAW),
        "assumed": (row_of(PHYSICAL.replace(assumed=("prnu_std",))), passed | absent - {unassumed}),
        "float clean": (row_of(PHYSICAL.replace(clean_dtype="float32")), passed | absent - {same}),
        "without effects": (row_of(bare), passed | absent | {one for one in failed if one.startswith("no effect")}),
        "failed": (failed_row(SOURCE, SHA256, 0, 7, "corrupt", "why"), failed | absent),
        "unread": (failed_row(unread, None, 0, 7, "unreadable", "why"), conditions - passed),
    }
    for name, (row, held) in holding.items():
        for column in COLUMNS:
            assert (row[column.name] == column.empty) == (column.empty_if in held), f"{name}: {column.name}"


def test_every_value_of_a_row_has_its_columns_type() -> None:
    assert plan_from_row(row_of(RAW)) == RAW
    for plan in (PLAN, PHYSICAL):
        row = row_of(plan)
        assert list(row) == list(COLUMN_NAMES)
        assert_typed(row)


def assert_typed(row: Row) -> None:
    for column in COLUMNS:
        expected = float if column.name == "gamma" else column.type
        assert type(row[column.name]) is expected or column.empty_if in BY_DEFAULT, column.name


def test_physical_columns_of_another_profile_are_0_or_none() -> None:
    values = {name: row_of(PLAN)[name] for name in PHYSICAL_NAMES}
    assert values == {column.name: "none" if column.type is str else 0 for column in COLUMNS if column.name in values}


@pytest.mark.parametrize(("index", "key"), [(0, "00000000"), (12345678, "12345678"), (123456789, "123456789")])
def test_keys_have_eight_digits_or_more(index: int, key: str) -> None:
    assert key_text(index) == key


# A row is a plan ------------------------------------------------------------------------------------------------------


@given(plan=plans, name=names)
def test_row_read_from_csv_is_the_row_of_the_same_plan(
    plan: Plan, name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    written = row_of(plan, dataclasses.replace(SOURCE, name=name))
    (row,) = through_csv([written], tmp_path_factory.mktemp("csv"))
    assert repr(row) == repr(dict(written))
    assert repr(plan_from_row(row)) == repr(plan)


@given(plans)
def test_row_read_from_json_has_the_same_plan(plan: Plan) -> None:
    assert repr(plan_from_row(json.loads(row_json([row_of(plan)])))) == repr(plan)


@pytest.mark.parametrize("reason", REASONS)
def test_failed_row_read_from_csv_is_the_row(reason: str, tmp_path: Path) -> None:
    row = failed_row(SOURCE, SHA256, 2, 5, reason)
    assert through_csv([row], tmp_path) == [dict(row)]


PROFILES = ("sony_a7s2", "nikon_d850", "canon_5d4", "canon_70d", "canon_700d", "oppo_reno10x")


@pytest.mark.parametrize("noise", ["brooks2019", "imx385_iso3200_rvdd", "none", *PROFILES])
def test_drawn_plans_survive_csv(settings: Callable[..., Any], noise: str, tmp_path: Path) -> None:
    for options in (("camera=choice", "isp=srgb"), ("camera=identity", "scene=night")):
        plan = plan_image(settings(f"noise={noise}", *options), SHA256, facts=FACTS)
        assert (plan.noise.physics is not None) == (noise in PROFILES)
        assert plan_from_row(through_csv([row_of(plan)], tmp_path)[0]) == plan


PHYSICAL_NAMES = COLUMN_NAMES[COLUMN_NAMES.index("iso") : COLUMN_NAMES.index("level")]
NUMBERED = ("level", "draw", "frame", "downscale", "dequantize")
NEEDED = [name for name in COLUMN_NAMES if name in {*CONTRACT[9:39], "sensor_clip", "accuracy"}]
NEEDED_PHYSICAL = ["scene", "exposure_ratio", "saturated_as", "noise_law", *PHYSICAL_NAMES, *NUMBERED]


def test_field_of_a_later_column_keeps_its_default(monkeypatch: pytest.MonkeyPatch) -> None:
    """A row of an older version lacks the columns that hold the field."""
    later = dataclasses.replace(BY_NAME["draw"], since="9.0")
    row = row_of(PLAN.replace(draw=2)) | {"draw": None}
    with pytest.raises(DamageError, match="draw is empty"):
        plan_from_row(row)
    monkeypatch.setitem(columns.COLUMNS_OF[NoisePlan], "draw", (later,))

    assert plan_from_row(row) == PLAN.replace(draw=0)
    assert plan_from_row(row | {"draw": 2}).noise.draw == 2


@pytest.mark.parametrize(("plan", "names"), [(PLAN, NEEDED), (PHYSICAL, NEEDED_PHYSICAL)], ids=["normal", "physical"])
def test_row_without_a_needed_value_is_damage(plan: Plan, names: list[str]) -> None:
    assert len(names) > 30
    for name in names:
        with pytest.raises(DamageError) as caught:
            plan_from_row({**row_of(plan), name: None})
            pytest.fail(f"{name} may be empty")
        assert re.match(f"row 00000003: not a plan \\(.*{name}", str(caught.value))


@pytest.mark.parametrize(
    ("name", "value"), [("stream_key", "xyz"), ("red_gain", "wide"), ("bits", "twelve"), ("gamma", "steep")]
)
def test_a_row_with_a_value_of_another_type_is_damage(name: str, value: str) -> None:
    with pytest.raises(DamageError, match="row 00000003: not a plan"):
        plan_from_row({**row_of(), name: value})


@pytest.mark.parametrize("name", ["patch", "patch_y", "patch_x", "height", "width"])
def test_row_without_its_place_in_the_full_frame_is_damage(name: str) -> None:
    with pytest.raises(DamageError, match=f"row 00000003: not a patch \\({name} is empty"):
        patch_from_row({**row_of(), name: None})


# CSV ------------------------------------------------------------------------------------------------------------------


def test_lines_end_with_a_line_feed() -> None:
    text = csv_text([row_of(), row_of()])
    assert (text.count("\n"), text.count("\r"), text[-1]) == (3, 0, "\n")


def test_cells_are_quoted_only_if_needed() -> None:
    text = csv_text([row_of()])
    assert text.count('"') == 2
    assert '"a, b.png"' in text


def test_floats_are_spelled_as_pythons_shortest_repr() -> None:
    cells = csv_text([row_of(PLAN.replace(a_dn=0.1, b_dn2=1e22))]).splitlines()[1].split(",")
    assert {"0.1", "1e+22"} <= set(cells)


def test_unknown_columns_are_left_out(tmp_path: Path) -> None:
    lines = csv_text([row_of()]).splitlines()
    (tmp_path / "m.csv").write_text(f"{lines[0]},later\n{lines[1]},9\n", encoding="utf-8")
    (row,) = read_rows(tmp_path / "m.csv")
    assert list(row) == list(COLUMN_NAMES)


HEADER = ",".join(COLUMN_NAMES)
BROKEN = [
    ("", "not a manifest, column key is missing"),
    ("key,source\n", "not a manifest, column source_sha256 is missing"),
    (HEADER.replace("saturated", "satiated") + "\n", "not a manifest, column saturated is missing"),
    (HEADER + "\n00000000,x\n", "not a readable manifest"),
    (HEADER + "\n" + "x," * len(COLUMN_NAMES) + "x\n", "not a readable manifest"),
    (csv_text([row_of()]).replace(",1234,", ",many,"), "not a readable manifest"),
    (csv_text([row_of()]).replace(",2.2,", ',2.2"x",').replace('"a, b.png"', '"a"b'), "not a readable manifest"),
    (csv_text([row_of()])[:-60], "not a readable manifest"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "sentence"), BROKEN)
def test_a_broken_manifest_is_damage(content: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(content, encoding="utf-8")
    with pytest.raises(DamageError, match=r"m.csv: " + sentence):
        list(read_rows(tmp_path / "m.csv"))


# JSON -----------------------------------------------------------------------------------------------------------------


@given(plans, names)
def test_json_size_depends_on_the_source_name_only(plan: Plan, name: str) -> None:
    assert len(row_json([row_of(plan, dataclasses.replace(SOURCE, name=name))])) == json_size(name)


def test_json_is_typed() -> None:
    loaded = json.loads(row_json([row_of()]))
    row = row_of()
    assert loaded == {column.name: row[column.name] for column in COLUMNS if column.in_json and column.since == FIRST}
    assert_typed(row | loaded)


def test_json_contains_a_later_column_unless_it_is_empty() -> None:
    plan = PHYSICAL.replace(assumed=("prnu_std", "dark_e_per_s"))
    content = row_json([row_of(plan)])
    assert json.loads(content)["assumed"] == "prnu_std;dark_e_per_s"
    (row,) = rows_of_json(content)
    assert plan_from_row(row) == plan
    (older,) = rows_of_json(row_json([row_of(PHYSICAL)]))
    assert plan_from_row(older) == PHYSICAL


def test_json_is_ascii_and_one_line() -> None:
    content = row_json([row_of(PLAN, dataclasses.replace(SOURCE, name="été \U0001f308.png"))])
    assert content.isascii()
    assert content.index(b"\n") == len(content) - 1


LONGEST = -sys.float_info.min
"""A double with the longest spelling: 24 characters."""


LONGEST_NAME = "n" * 100
"""Longest name of a camera, scene or noise profile (`test_config` refuses longer ones)."""


def widened(reason: str) -> str:
    """Return a reason of the planner with the longest numbers and the longest statistic."""
    reason = re.sub(r"(?<![\w.])\d[\d.]*(e[+-]?\d+)?", f"{1.23456e-300:g}", reason)
    return re.sub(f"in the ({'|'.join(STATISTICS)})", f"in the {max(STATISTICS, key=len)}", reason)


def longest_reasons(settings: Callable[..., Any]) -> dict[str, str]:
    """The longest thing the planner says of each effect of a profile, of all that it has to say: what it predicts,
    that it is switched off, that a number is assumed, that a profile with the longest name gives none.
    """
    iso = {"noise.iso": 3200}
    half_of_heat = {"noise.name": LONGEST_NAME, "noise.hot_pixel_e_per_s": None, **iso}
    absent = ("prnu_std", "dark_e_per_s", "hot_pixel_share", "dead_pixel_share")
    half = replaced(settings("noise=oppo_reno10x"), half_of_heat)
    lacking = settings("noise=oppo_reno10x", "effects.tolerance=1.23456")
    lacking = replaced(lacking, half_of_heat | {f"noise.{key}": None for key in absent})
    all_given = settings("noise=nikon_d850", "noise.full_well_e=1e5", "noise.assumed=[]")
    all_given = with_branch(all_given, column_std_dn=1.0, column_temporal_std_dn=1.0)
    numbers = {"noise.gain_by_colour": [0.9, 1.0, 1.1], "noise.lens_shading": [-0.1, 0.0, 0.0]}
    all_given = replaced(all_given, numbers | iso)
    assumed = settings("noise=nikon_d850")
    assumed = replaced(assumed, {"noise.assumed": PHYSICAL_NUMBERS, **iso})
    found: dict[str, list[str]] = {effect: [] for effect in EFFECTS}
    for config in (lacking, half, all_given, assumed, settings("noise=nikon_d850", "effects.all=off")):
        for one in plan_levels(config, SHA256, facts=FACTS)[0][1]:
            if one.effect not in LATER or "gives no" not in one.reason:  # rows do not name those
                found[one.effect].append(widened(one.reason))
    return {effect: max(reasons, key=len) for effect, reasons in found.items()}


def longest_rows(settings: Callable[..., Any]) -> Iterator[Row]:
    """The longest rows that settings can lead to, of a profile of two numbers and of a physical one: the longest
    spelling in every column, each effect named twice, as simulated and as skipped for the longest reason.
    """
    assert len(repr(LONGEST)) == 24
    camera, noise = (dataclasses.replace(part, name=LONGEST_NAME) for part in (PLAN.camera, PLAN.noise))
    plan = PLAN.replace(seed=2**63 - 1, stream_key=2**64 - 1, camera=camera, noise=noise)
    plan = plan.replace(
        split="s" * 32,
        scene=ScenePlan(LONGEST_NAME, LONGEST),
        weights=(LONGEST,) * 4, rgb2cam=(LONGEST,) * 9, red_gain=LONGEST, blue_gain=LONGEST, inverse_rgb_gain=LONGEST,
        gamma=2.2250738585072014, highlight_threshold=LONGEST, bits=16, black_level_dn=65534, white_level_dn=65535,
        saturated="white", a_dn=LONGEST, b_dn2=LONGEST,
        dtype="float32", layout="mosaic",
        accuracy="reference",
        effects=("heteroscedastic", "quantise"),
        skipped=(f"heteroscedastic: noise={LONGEST_NAME} has no variance (a_dn={LONGEST!r}, b_dn2={LONGEST!r})",),
    )  # fmt: skip
    numbers = {field.name: LONGEST for field in dataclasses.fields(Physics) if field.type == "float"}
    physics = dataclasses.replace(
        PHYSICS, **numbers, dark_offset="removed", read_law="tukey_lambda", black_error_dn=(LONGEST,) * 4,
        sensor_unit="f" * 16, body_key=2**64 - 1, gain_by_colour=(LONGEST,) * 3, lens_shading=(LONGEST,) * 3,
        frame_size=(2**32 - 1, 2**32 - 1),
    )  # fmt: skip
    skipped = tuple(f"{effect}: {reason}" for effect, reason in longest_reasons(settings).items())
    physical = plan.replace(effects=EFFECTS, skipped=skipped, physics=physics, assumed=ASSUMABLE)
    pair = Pair(PAIR.clean, PAIR.noisy, Counts(*[2**40] * 6))
    sampled = {effect: f"{effect}: {IN_DARK_FRAMES}" for effect in (*REPLACED, "read")}
    dark = physical.replace(
        effects=tuple("dark_frame" if effect == "read" else effect for effect in EFFECTS),
        skipped=tuple(sampled.get(one.partition(": ")[0], one) for one in skipped),
        dark=DarkFramePlan("f" * 64, (2**32 - 2,) * 2, LONGEST, LONGEST),
    )
    for one in (plan, physical, dark):
        source, patch = Source(10**9, "", "", 2**30), Patch(2**38, 2**40, 2**40, 2, 2)
        key = f"1000000000-p{patch.number}-l99d99"
        row = pair_row(key, source, SHA256, 8, 10**9, one, pair, ("1" * 32, "2" * 32), patch)
        yield {**row, "width": 2**40, "height": 2**40}


def test_json_size_suffices_for_the_longest_rows(settings: Callable[..., Any]) -> None:
    for row in longest_rows(settings):
        assert len(row_json([row]).rstrip()) < JSON_BYTES
        assert len(row_json([row])) == json_size("")


def test_row_longer_than_its_json_size_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"row 00000003 takes .* bytes as JSON, more than the"):
        row_json([{**row_of(), "noise": "x" * JSON_BYTES}])


@given(st.integers(0, 3000))
def test_json_size_is_a_multiple_of_tar_blocks(length: int) -> None:
    assert json_size("x" * length) % 512 == 0
    assert json_size("x" * length) >= JSON_BYTES + 2 * (length + 2)


def test_key_that_is_no_number_is_damage(dataset: Path, tmp_path: Path) -> None:
    """Keys become part of file names."""
    text = (dataset / "manifest.csv").read_text(encoding="utf-8")
    (tmp_path / "manifest.csv").write_text(text.replace("\n00000001,", "\n../../x1,"), encoding="utf-8")
    with pytest.raises(DamageError, match=r"the key is '../../x1', expected eight digits"):
        list(read_rows(tmp_path / "manifest.csv"))
